"""Onset: since when a criterion has been broken. A metric says when it was worst; a person wants to see where it began.

The metric is measured again over the recording up to a moment, and that moment is halved in on. This is exact for an
upper limit of a maximum or a count and a lower limit of a minimum: once broken, they stay broken however much more is
driven. Of other metrics nothing is said.
"""

from typing import Any, TypeVar

from rtdb.recording import Recorded, Recording
from rtdb.records import Record

from .judge import Criterion, Verdict, find
from .metrics import METRICS, Evidence

R = TypeVar("R", bound=Record)


class _UpTo(Recording):
    """A recording as it was after `last` cycles. It shares what has been parsed with the whole one."""

    def __init__(self, whole: Recording, parsed: dict[str, list[Recorded[Any]]]) -> None:
        self.__dict__.update(whole.__dict__)
        self._whole, self._parsed, self._last = whole, parsed, whole.last_cycle

    def cut(self, cycle: int) -> Recording:
        """Make the recording up to a cycle."""
        out = _UpTo(self._whole, self._parsed)
        out._last = cycle
        return out

    @property
    def last_cycle(self) -> int:
        """The cycle up to which this goes."""
        return self._last

    def read(self, topic: str, cls: type[R]) -> list[Recorded[R]]:
        """Read the writes up to the cut."""
        if topic not in self._parsed:
            self._parsed[topic] = self._whole.read(topic, cls)
        return [row for row in self._parsed[topic] if row.cycle <= self._last]


def stays_broken(criterion: Criterion) -> bool:
    """Tell whether a criterion that is broken at some moment of a drive is broken from then on."""
    if METRICS[criterion.metric].unit == "":
        return criterion.op not in (">=", ">")
    return criterion.op in (
        ("<=", "<") if "_max_" in criterion.metric else (">=", ">") if "_min_" in criterion.metric else ()
    )


class Onset:
    """Finds out since when criteria have been broken in one recording."""

    def __init__(self, recording: Recording) -> None:
        self._whole = _UpTo(recording, {})

    def since_s(self, criterion: Criterion, worst_s: float | None) -> float | None:
        """Give when a criterion broke for good; None where that cannot be said of its metric.

        worst_s: when the metric was at its worst.
        """
        if worst_s is None or not stays_broken(criterion):
            return None
        low, high = 0, min(self._whole.last_cycle, round(worst_s * 1e9 / self._whole.tick_ns) + 1)
        if self._broken(criterion, low) or not self._broken(criterion, high):
            return None
        while high - low > 1:
            middle = (low + high) // 2
            if self._broken(criterion, middle):
                high = middle
            else:
                low = middle
        return self._whole.time_s(high)

    def _broken(self, criterion: Criterion, cycle: int) -> bool:
        measured = METRICS[criterion.metric].measure(Evidence(self._whole.cut(cycle)))
        return find(criterion, measured).verdict is Verdict.FAIL
