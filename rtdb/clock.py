"""Clocks: who ends the cycles of a store.

A stepped store is ticked by whoever holds its clock (`Store.tick`): simulation and tests. A barrier store ticks as soon
as all participants are done, a real-time one at absolute times; both are ticked by C code in a thread of its own,
which no garbage collection stops. `fairway db clock NAME` is such a clock in a process of its own, and a second one
waits as a standby.
"""

import contextlib
import os
import weakref
from dataclasses import dataclass
from enum import IntEnum
from types import TracebackType
from typing import Self

from . import _core


class Kind(IntEnum):
    """Who ends the cycles."""

    STEPPED = 0
    BARRIER = 1
    REAL = 2


@dataclass(frozen=True, slots=True)
class ClockInfo:
    """The clock of a store.

    `alive`: a process holds it; `skipped`: ticks that a late real-time clock left out; `takeovers`: how often a
    standby took it over; `late_ns`: how long the next tick of a real-time clock is overdue;
    `lateness_us`: ticks by how late they were, bin k counts from 2^k us.
    """

    kind: Kind
    alive: bool
    pid: int
    cycle: int
    skipped: int
    takeovers: int
    late_ns: int
    lateness_us: tuple[int, ...]
    tick_ns: int

    @property
    def stalled(self) -> bool:
        """Whether a real-time clock lives, but has not ticked for two ticks: its process was stopped, or starves."""
        return self.alive and self.late_ns > 2 * self.tick_ns


class RunningClock:
    """A clock in a thread of C. It ends with its `with`, with `stop`, or when nobody refers to it."""

    def __init__(self, store_name: str, wait_for: tuple[str, ...] = ()) -> None:
        self._core: _core.Clock = _core.start_clock(store_name, wait_for)
        _running.add(self)

    def stop(self) -> None:
        """End the ticks; a standby takes over."""
        self._core.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


class Edges:
    """Cycles as a file descriptor, for event loops: readable as each cycle begins, until `clear`.

    A thread of C hears of them, so that none waits for the interpreter. It ends with its `with`, with `close`, or when
    nobody refers to it.
    """

    def __init__(self, store_name: str, after: int) -> None:
        self._core: _core.Edges = _core.start_edges(store_name, after)
        _running.add(self)

    def fileno(self) -> int:
        """Give the descriptor, for `select` or a loop's `add_reader`; -1 when it is closed."""
        return self._core.fileno()

    def clear(self) -> None:
        """Make it unreadable until the next cycle. Look at the store's cycle behind this, not before."""
        descriptor = self.fileno()
        if descriptor >= 0:  # a loop may still have its turn with one that was closed
            with contextlib.suppress(BlockingIOError):
                os.read(descriptor, 4096)

    def close(self) -> None:
        """End it."""
        self._core.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


# A forked child has a copy of the attachment but not the thread: it lets go, so that the clock dies with its process.
_running: "weakref.WeakSet[RunningClock | Edges]" = weakref.WeakSet()


def _after_fork() -> None:
    for thread in list(_running):
        with contextlib.suppress(Exception):
            thread._core.forget()


os.register_at_fork(after_in_child=_after_fork)
