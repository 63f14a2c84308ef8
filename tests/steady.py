"""Whether this machine stood still during a test: what runs in real time shows nothing then, and is tried again.

A run stops its cart when its clock stands for a quarter of a second, as it should. On a machine that is shared that
happens, and says nothing about the program. `real_time` marks tests that need a steady machine: one that fails is
repeated where a CPU was seen to wake up late meanwhile, and only then.
"""

import os
import threading
import time

import pytest

LATE_S = 0.1
LOOK_S = 0.01


class Steady:
    """Watches each CPU from a thread of its own, from the first beginning on."""

    def __init__(self) -> None:
        self._threads: list[threading.Thread] = []
        self.worst_s = 0.0  # lateness since the beginning

    def begin(self) -> None:
        """Begin anew: what was before does not count."""
        if not self._threads:
            for cpu in os.sched_getaffinity(0):
                thread = threading.Thread(target=self._watch, args=(cpu,), name=f"watch-{cpu}", daemon=True)
                self._threads.append(thread)
                thread.start()
        self.worst_s = 0.0

    def _watch(self, cpu: int) -> None:
        os.sched_setaffinity(threading.get_native_id(), {cpu})
        while True:
            due_s = time.monotonic() + LOOK_S
            time.sleep(LOOK_S)
            self.worst_s = max(self.worst_s, time.monotonic() - due_s)

    def stood_still(self) -> bool:
        """Whether a CPU woke up late since the beginning."""
        return self.worst_s > LATE_S


STEADY = Steady()
real_time = pytest.mark.flaky(reruns=5, condition=STEADY.stood_still)
