"""Containment: what keeps a module's endless loop, flood of prints or hunger for memory to itself.

What a module computes wrong (exceptions, values that are no numbers, forgotten outputs) its host sees by itself.
"""

import ctypes
import resource
import sys
import threading
import time
from typing import TYPE_CHECKING, TextIO, cast

if TYPE_CHECKING:
    from collections.abc import Iterator

PRINTS_BYTES = 1 << 20
HANG_CPU_S = 10.0  # of CPU time, so that a loaded machine decides nothing; with a budget 20 times that, at least 1 s
HANG_WALL_S = 60.0  # a step that sleeps uses no CPU time
LOOK_S = 0.1


class StepHung(BaseException):
    """A step does not end. No Exception, so that a module's own `except Exception` does not keep it going."""


class Watch:
    """Ends steps that do not end: a thread that raises StepHung in the one that runs the module.

    It can end Python code, not a call into C. Who holds a process of modules kills that process instead.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()  # so that nothing is raised behind the step that it is meant for
        self._now: tuple[int, float] | None = None  # a new object for each step
        self._raised = False
        self._thread: threading.Thread | None = None

    def begin(self, limit_s: float) -> None:
        """Note that a step begins in this thread, and how much CPU time it may use."""
        self._now = (threading.get_ident(), limit_s)
        if self._thread is None or not self._thread.is_alive():  # also in a forked child, which has no threads
            self._thread = threading.Thread(target=self._look, daemon=True, name="fairway module watch")
            self._thread.start()

    def end(self) -> None:
        """Note that it has ended."""
        with self._lock:
            self._now, raised = None, self._raised
            self._raised = False
        if raised:
            _raise_in(threading.get_ident(), None)  # it ended by itself meanwhile: take back what has not arrived yet

    def _look(self) -> None:
        seen: tuple[int, float] | None = None
        cpu_s = wall_s = 0.0
        while threading.main_thread().is_alive():
            time.sleep(LOOK_S)
            now = self._now
            if now is None:
                seen = None
                continue
            used_s = _cpu_s(now[0])
            if now is not seen:
                seen, cpu_s, wall_s = now, used_s, time.monotonic()
            elif used_s - cpu_s > now[1] or time.monotonic() - wall_s > HANG_WALL_S:
                with self._lock:
                    if self._now is now:
                        self._raised = True
                        _raise_in(now[0], StepHung)
                cpu_s, wall_s = used_s, time.monotonic()


def _cpu_s(ident: int) -> float:
    try:
        return time.clock_gettime(time.pthread_getcpuclockid(ident))
    except OSError:  # the thread has ended
        return 0.0


def _raise_in(ident: int, error: type[BaseException] | None) -> None:
    """Have an exception raised in a thread, or take back one that was not raised yet."""
    what = ctypes.py_object(error) if error is not None else None
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(ident), what)


class Prints:
    """Stands for a standard stream while a module runs: passes on the first PRINTS_BYTES, then says so and drops."""

    def __init__(self, stream: TextIO, module: str, limit: int = PRINTS_BYTES) -> None:
        self._stream, self._module, self._left = stream, module, limit

    def write(self, text: str) -> int:
        """Pass on what fits."""
        if self._left > 0:
            self._stream.write(text[: self._left])
            self._left -= len(text)
            if self._left <= 0:
                self._stream.write(f"\n[{self._module} has printed 1 MB: what else it prints is dropped]\n")
        return len(text)

    def writelines(self, lines: "Iterator[str]") -> None:
        """Write one after the other."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)


def capped(module: str) -> tuple[TextIO, TextIO]:
    """Make the standard output and error that a module prints to."""
    return cast(TextIO, Prints(sys.stdout, module)), cast(TextIO, Prints(sys.stderr, module))


def limit_memory(mb: int) -> None:
    """Let this process take so much more memory; then allocations fail, which a host takes for the module's fault."""
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    limit = _data_bytes() + (mb << 20)
    resource.setrlimit(resource.RLIMIT_DATA, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))


def _data_bytes() -> int:
    """Give what counts against RLIMIT_DATA now."""
    with open("/proc/self/status") as status:
        return next((int(line.split()[1]) << 10 for line in status if line.startswith("VmData:")), 0)
