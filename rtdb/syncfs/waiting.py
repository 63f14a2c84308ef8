"""Waiting: stats of clocks that are held until the next edge. Answered by an edge, a flush, or a clock that stands."""

import logging
from collections.abc import Callable, Hashable
from typing import NamedTuple

from .pace import Pace
from .seats import Seat

log = logging.getLogger(__name__)


class Waiter(NamedTuple):
    """One held stat: since which edge, whose clock, when it came by the host's clock, and how it is answered."""

    asked: int
    seat: Seat | None
    since_s: float
    answer: Callable[[], None]


class Waiting:
    """All held stats, by pace."""

    def __init__(self) -> None:
        self._of: dict[Pace, dict[Hashable, Waiter]] = {}
        self._pace_of: dict[Hashable, Pace] = {}

    def __len__(self) -> int:
        return len(self._pace_of)

    def add(self, key: Hashable, pace: Pace, waiter: Waiter) -> None:
        """Hold a stat."""
        self._of.setdefault(pace, {})[key] = waiter
        self._pace_of[key] = pace

    def cancel(self, key: Hashable) -> None:
        """Forget a stat, if it is held."""
        pace = self._pace_of.pop(key, None)
        waiter = None if pace is None else self._of[pace].pop(key, None)
        if waiter is not None and waiter.seat is not None:
            waiter.seat.give_up()

    def edge(self, cycle: int) -> None:
        """Answer those whose edge has come."""
        for pace, waiters in list(self._of.items()):
            last = pace.last(cycle)
            due = [(key, waiter) for key, waiter in waiters.items() if waiter.asked < last]
            self._release(waiters, due, cycle)
            if not waiters:
                del self._of[pace]

    def stopped(self, cycle: int, before_s: float, *, participants: bool) -> None:
        """Answer those that came before a time, of a clock that stands.

        participants: also those that wait for their own clock, and will do their cycle again.
        """
        for waiters in list(self._of.values()):
            due = [
                (key, waiter)
                for key, waiter in waiters.items()
                if waiter.since_s < before_s and (waiter.seat is None or participants)
            ]
            self._release(waiters, due, cycle)

    def _release(self, waiters: dict[Hashable, Waiter], due: list[tuple[Hashable, Waiter]], cycle: int) -> None:
        for key, waiter in due:
            del waiters[key], self._pace_of[key]
            if waiter.seat is not None:
                waiter.seat.wake(cycle)
        for _, waiter in due:
            try:
                waiter.answer()
            except Exception:  # one client's trouble is not that of the others
                log.exception("a stat that waited")
