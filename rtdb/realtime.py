"""Ask the system for what a real-time process needs, and say what it would not give."""

import errno
import gc
import os
from dataclasses import dataclass

from . import _core

LATENCY = "/dev/cpu_dma_latency"


@dataclass(frozen=True, slots=True)
class RealTime:
    """What `realtime` got, and one line for each thing that it did not get."""

    got: tuple[str, ...]
    refused: tuple[str, ...]

    def __bool__(self) -> bool:
        return not self.refused


def realtime(
    priority: int = 50, cpus: set[int] | None = None, *, lock_memory: bool = True, keep_awake: bool = True
) -> RealTime:
    """Make this process a real-time one: SCHED_FIFO, memory locked, on given CPUs, its garbage frozen.

    priority: 1..99, higher wins; cpus: where it may run [everywhere it may now]; keep_awake: no CPU of this machine
    sleeps while this process lives: it costs power, and one that sleeps wakes late, in a virtual machine by
    milliseconds at times (benchmarks/wakeup.py). Everything that is alive now is taken out of garbage collection, and
    collection is switched off: call `gc.collect()` where there is time for it. Nothing here raises: a laptop gives less
    than a cart.
    """
    got, refused = [], []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        got.append(f"SCHED_FIFO {priority}")
    except (OSError, ValueError) as error:
        refused.append(
            f"SCHED_FIFO {priority}: {getattr(error, 'strerror', None) or error}; "
            f"run as root, or allow it: `ulimit -r {priority}` (rtprio in limits.conf)"
        )
    if lock_memory:
        code = _core.lock_memory()
        if code:
            refused.append(f"locked memory: {os.strerror(code)}; allow it: `ulimit -l unlimited`")
        else:
            got.append("locked memory")
    if keep_awake:
        try:
            latency = os.open(LATENCY, os.O_WRONLY | os.O_CLOEXEC)  # stays open: the wish ends with this process
            os.write(latency, bytes(4))  # at most so many us to wake up
            got.append("awake CPUs")
        except OSError as error:
            refused.append(f"awake CPUs: {LATENCY}: {error.strerror}; run as root, or give its group to this user")
    if cpus is not None:
        try:
            os.sched_setaffinity(0, cpus)
            got.append(f"CPUs {', '.join(map(str, sorted(cpus)))}")
        except (OSError, ValueError) as error:
            why = (
                "no such CPU"
                if getattr(error, "errno", errno.EINVAL) == errno.EINVAL
                else getattr(error, "strerror", "")
            )
            refused.append(f"CPUs {', '.join(map(str, sorted(cpus)))}: {why}; there are {os.cpu_count()}")
    gc.collect()
    gc.freeze()
    gc.disable()
    got.append("frozen garbage")
    return RealTime(tuple(got), tuple(refused))
