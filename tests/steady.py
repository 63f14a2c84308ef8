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
AFTER_S = 5.0  # a run that several tests share may end that long after it


class Steady:
    """Watches each CPU from a thread of its own, from the first beginning on."""

    def __init__(self) -> None:
        self._threads: list[threading.Thread] = []
        self._since_s = 0.0
        self._late_at_s = 0.0  # when a CPU last woke up late

    def begin(self) -> None:
        """Begin anew: what was long before does not count."""
        if not self._threads:
            for cpu in os.sched_getaffinity(0):
                thread = threading.Thread(target=self._watch, args=(cpu,), name=f"watch-{cpu}", daemon=True)
                self._threads.append(thread)
                thread.start()
        self._since_s = time.monotonic() - AFTER_S

    def _watch(self, cpu: int) -> None:
        os.sched_setaffinity(threading.get_native_id(), {cpu})
        while True:
            due_s = time.monotonic() + LOOK_S
            time.sleep(LOOK_S)
            now_s = time.monotonic()
            if now_s - due_s > LATE_S:
                self._late_at_s = now_s

    def stood_still(self) -> bool:
        """Whether a CPU woke up late since the beginning, or shortly before."""
        return self._late_at_s > self._since_s


STEADY = Steady()
real_time = pytest.mark.flaky(reruns=5, condition=STEADY.stood_still)
