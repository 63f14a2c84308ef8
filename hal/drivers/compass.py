"""Driver of an electronic compass: each sentence that tells a heading becomes one `CompassHeading`.

    sentence                 true heading
    HDT                      as it is
    HDG                      heading + its own deviation + its own variation, else the driver's declination
    HDM, HPR, C, OHPR        heading + the driver's declination

HPR carries a letter of status for each of its values (Honeywell HMR3000): N normal, M and O low and high warning,
L and P low and high alarm, C tuning, V voltage alarm. A warning leaves the heading valid, all else does not.
The other sentences are valid with a heading. Nose up and left side up are positive in all of them.
"""

import copy
import math
from typing import Any, Final

from hal.codecs.nmea import (
    Hdg,
    Hdm,
    Hdt,
    Hpr,
    Ohpr,
    Os5000,
    Sentence,
    SentenceError,
    Splitter,
    parse,
)
from hal.signals import CompassHeading, LinkCounters, yaw_of_heading

__all__ = ["CompassDriver"]

_GOOD: Final = ("N", "M", "O")


class CompassDriver:
    """Turns the sentences of one compass into readings. It has no clock: every call says what time it is.

    `declination_rad` is that of place and date, east positive. `latency_ns` is the time from the measurement to
    the end of its sentence, from the compass's profile. A GPS receiver may speak on the same line: its sentences
    are counted and otherwise ignored.
    """

    _STATE = ("readings", "_splitter", "_received", "_refused", "_finished")

    def __init__(self, declination_rad: float, latency_ns: int = 20_000_000) -> None:
        self.readings = 0
        """Readings published, the invalid ones among them."""
        self._declination_rad = declination_rad
        self._latency_ns = latency_ns
        self._splitter = Splitter()
        self._received = 0
        self._refused = 0
        self._finished: list[tuple[CompassHeading, int]] = []

    @property
    def counters(self) -> LinkCounters:
        """Sound sentences, also of unknown types, and damaged ones. NMEA does not number them: lost is 0."""
        return LinkCounters(received=self._received, damaged=self._refused + self._splitter.damaged)

    def feed(self, data: bytes, t_ns: int) -> None:
        """Take the bytes that arrived by `t_ns` (level wire)."""
        if not data:
            return  # as in most ticks
        for line in self._splitter.feed(data):
            try:
                sentence = parse(line)
            except SentenceError:
                self._refused += 1
                continue
            if sentence is None:
                self._received += 1
            else:
                self.hear(sentence, t_ns)

    def hear(self, sentence: Sentence, t_ns: int) -> None:
        """Take one decoded sentence that was complete at `t_ns` (level direct)."""
        self._received += 1
        reading = self._reading(sentence)
        if reading is not None:
            self._finished.append((reading, t_ns - self._latency_ns))
            self.readings += 1

    def poll(self, t_ns: int) -> list[tuple[CompassHeading, int]]:
        """Return the readings since the last call, each with its `t_data_ns`, when it was measured."""
        if not self._finished:
            return []
        finished, self._finished = self._finished, []
        return finished

    def snapshot(self) -> tuple[Any, ...]:
        """Return what `restore` needs to continue exactly from here; it can be pickled."""
        return copy.deepcopy(tuple(getattr(self, name) for name in self._STATE))

    def restore(self, snapshot: tuple[Any, ...]) -> None:
        """Continue from `snapshot`, taken from a driver with the same declination and latency."""
        for name, value in zip(self._STATE, copy.deepcopy(snapshot), strict=True):
            setattr(self, name, value)

    def _reading(self, sentence: Sentence) -> CompassHeading | None:
        """Return what a sentence says of the heading, None if it is of another kind."""
        to_true_rad = self._declination_rad
        pitch_deg, roll_deg = None, None
        good = True
        match sentence:
            case Hdt():
                to_true_rad = 0.0
            case Hdg():
                if sentence.variation_deg is not None:
                    to_true_rad = math.radians(sentence.variation_deg)
                if sentence.deviation_deg is not None:
                    to_true_rad += math.radians(sentence.deviation_deg)
            case Hdm():
                pass
            case Hpr():
                pitch_deg, roll_deg = sentence.pitch_deg, sentence.roll_deg
                statuses = (sentence.heading_status, sentence.pitch_status, sentence.roll_status)
                good = all(status in _GOOD for status in statuses)
            case Ohpr() | Os5000():
                pitch_deg, roll_deg = sentence.pitch_deg, sentence.roll_deg
            case _:
                return None
        heading_deg = sentence.heading_deg
        return CompassHeading(
            yaw_rad=0.0 if heading_deg is None else yaw_of_heading(math.radians(heading_deg) + to_true_rad),
            pitch_rad=math.radians(pitch_deg or 0.0),
            roll_rad=math.radians(roll_deg or 0.0),
            valid=good and heading_deg is not None,
        )
