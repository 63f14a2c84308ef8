"""Driver of a GPS receiver that talks NMEA 0183: sentences in, one `GpsFix` for each epoch out.

A receiver measures at one instant, an epoch, and then says it in a burst of sentences. Some carry the
epoch's time of day, others (GSA, VTG, unknown types) belong to the burst that they stand in. The driver
collects a burst and publishes its epoch once, as soon as it is finished:

1. a sentence with another time of day arrives; or
2. the sentence arrives that ended the last two epochs alike, the cycle ender (the idea is gpsd's); or
3. the line was quiet for 100 ms.

By rule 2 a fix waits for nothing once the receiver's habit is known. Rules 1 and 3 teach the habit, and a
sentence that follows the ender in the same burst refutes it.

The known limit: bursts that start with sentences without time, less than `quiet_ns` after the last one ended,
look like bursts that end with these sentences. No receiver in our captures does this.
"""

import copy
import math
from dataclasses import dataclass, field
from datetime import date
from typing import Any, Final

from hal.codecs.nmea import (
    Gga,
    Gll,
    Gsa,
    Gst,
    Hdg,
    Hdm,
    Hdt,
    Hpr,
    Rmc,
    Sentence,
    SentenceError,
    Splitter,
    Vtg,
    Zda,
    parse,
)
from hal.signals import FixQuality, GpsFix, LinkCounters, yaw_of_heading

__all__ = ["GpsDriver"]

_MPS_PER_KNOT: Final = 1852 / 3600
_TIMED: Final = (Gga, Rmc, Gll, Gst, Zda)
"""Types that carry the time of day."""
_SPENT_NS: Final = 900_000_000
"""How long after its start an epoch's time is known as published. Less than 1 s, because a receiver without a
clock may repeat the same time every second; more than the longest burst that fits into a second's period."""
_UNIX_DAY: Final = date(1970, 1, 1).toordinal()
_NS_PER_DAY: Final = 86_400_000_000_000

_QUALITY_OF_MODE: Final = {
    "A": FixQuality.AUTONOMOUS,
    "D": FixQuality.DIFFERENTIAL,
    "E": FixQuality.DEAD_RECKONING,
    "F": FixQuality.RTK_FLOAT,
    "M": FixQuality.MANUAL,
    "P": FixQuality.PPS,
    "R": FixQuality.RTK_FIXED,
    "S": FixQuality.SIMULATOR,
}
"""The mode letter that RMC and GLL carry since NMEA 2.3, for epochs without GGA."""


class GpsDriver:
    """Turns the sentences of one receiver into fixes. It has no clock: every call says what time it is.

    `latency_ns` is the time from the measurement to the end of the burst, from the receiver's profile.
    `quiet_ns` must exceed the time of one sentence on the line: 100 ms do from 9600 baud on, 4800 baud needs
    250 ms. A compass may speak on the same line: its sentences are counted and otherwise ignored.
    """

    _STATE = (
        *("epochs", "late", "_splitter", "_received", "_refused"),
        *("_epoch", "_ender", "_previous_end", "_last_ns", "_spent", "_held", "_finished"),
    )

    def __init__(self, latency_ns: int = 0, *, quiet_ns: int = 100_000_000) -> None:
        self.epochs = 0
        """Epochs published."""
        self.late = 0
        """Sentences that came after their epoch was published; they change nothing."""
        self._latency_ns = latency_ns
        self._quiet_ns = quiet_ns
        self._splitter = Splitter()
        self._received = 0
        self._refused = 0
        self._epoch: _Epoch | None = None
        self._ender: _Place | None = None
        self._previous_end: _Place | None = None
        self._last_ns = -quiet_ns
        self._spent: list[tuple[float, int]] = []  # time of day and first arrival of published epochs
        self._held = _Position()
        self._finished: list[tuple[GpsFix, int]] = []

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
                # Only its address is of use: an unknown sentence can end the burst.
                self._take(line[1:-3].partition(b",")[0].decode("ascii"), None, t_ns)
            else:
                self.hear(sentence, t_ns)

    def hear(self, sentence: Sentence, t_ns: int) -> None:
        """Take one decoded sentence that was complete at `t_ns` (level direct)."""
        self._received += 1
        if not isinstance(sentence, (Hdg, Hdt, Hdm, Hpr)):
            self._take(sentence.talker + sentence.TYPE, sentence, t_ns)

    def poll(self, t_ns: int) -> list[tuple[GpsFix, int]]:
        """Return the epochs finished since the last call, each with its `t_data_ns`, when it was measured."""
        self._close_if_quiet(t_ns)
        if not self._finished:
            return []
        finished, self._finished = self._finished, []
        return finished

    def snapshot(self) -> tuple[Any, ...]:
        """Return what `restore` needs to continue exactly from here; it can be pickled."""
        return copy.deepcopy(tuple(getattr(self, name) for name in self._STATE))

    def restore(self, snapshot: tuple[Any, ...]) -> None:
        """Continue from `snapshot`, taken from a driver with the same latency."""
        for name, value in zip(self._STATE, copy.deepcopy(snapshot), strict=True):
            setattr(self, name, value)

    # ---- epochs ------------------------------------------------------------------------------------

    def _take(self, address: str, sentence: Sentence | None, t_ns: int) -> None:
        """Put a sentence into its epoch; close the epoch before it or with it."""
        self._close_if_quiet(t_ns)
        within_burst = t_ns - self._last_ns < self._quiet_ns
        self._last_ns = t_ns
        timed, time_s = False, None
        if isinstance(sentence, _TIMED):
            timed, time_s = True, sentence.time_s
        if self._is_late(timed, time_s, t_ns, within_burst):
            self.late += 1
            if self._epoch is None and within_burst:
                # The burst went on behind its supposed end.
                self._ender = self._previous_end = None
            return
        if self._epoch is not None and timed and self._epoch.is_over(address, time_s):
            self._close(self._epoch)
        if self._epoch is None:
            self._epoch = _Epoch(t_ns)
        self._epoch.add(address, sentence, t_ns, timed=timed, time_s=time_s)
        if self._epoch.end == self._ender and self._epoch.has_position:
            self._close(self._epoch)

    def _is_late(self, timed: bool, time_s: float | None, t_ns: int, within_burst: bool) -> bool:
        """Say whether a sentence belongs to an epoch that is published already."""
        if time_s is None:
            # Without a time only the place in the burst tells. But a type that should carry the time and does
            # not comes from a receiver without a clock: it may start the next burst at once.
            return self._epoch is None and within_burst and not timed
        if self._epoch is not None and self._epoch.time_s == time_s:
            return False
        return any(spent_s == time_s and t_ns - first_ns < _SPENT_NS for spent_s, first_ns in self._spent)

    def _close_if_quiet(self, t_ns: int) -> None:
        if self._epoch is not None and t_ns - self._last_ns >= self._quiet_ns:
            self._close(self._epoch)

    def _close(self, epoch: "_Epoch") -> None:
        """Publish an epoch and learn from how it ended."""
        self._epoch = None
        if not epoch.has_position:
            return  # satellites in view, a lone ZDA: neither a fix nor the lack of one
        if epoch.end == self._previous_end:
            self._ender = epoch.end
        self._previous_end = epoch.end
        if epoch.time_s is not None:
            self._spent = [spent for spent in self._spent if epoch.last_ns - spent[1] < _SPENT_NS]
            self._spent.append((epoch.time_s, epoch.first_ns))
        self._held = epoch.position(self._held)
        self._finished.append((epoch.fix(self._held), epoch.last_ns - self._latency_ns))
        self.epochs += 1


_Place = tuple[str, int]
"""A place in the burst: address, and how many of it came so far. Some receivers end with a fourth GNGSA."""


@dataclass(frozen=True, slots=True)
class _Position:
    lat_rad: float = 0.0
    lon_rad: float = 0.0
    alt_m: float = 0.0


@dataclass(slots=True)
class _Epoch:
    """The sentences of one burst so far, the last one of each type."""

    first_ns: int
    last_ns: int = 0
    time_s: float | None = None
    timed: bool = False
    """A sentence of a type that carries the time was among them, with or without a time."""
    end: _Place = ("", 0)
    seen: dict[str, int] = field(default_factory=dict)
    gga: Gga | None = None
    rmc: Rmc | None = None
    gll: Gll | None = None
    gsa: Gsa | None = None
    gst: Gst | None = None
    vtg: Vtg | None = None
    zda: Zda | None = None

    @property
    def has_position(self) -> bool:
        """Say whether a sentence came that tells of the position, be it that there is none."""
        return self.gga is not None or self.rmc is not None or self.gll is not None

    def is_over(self, address: str, time_s: float | None) -> bool:
        """Say whether a sentence of a type that carries the time starts another epoch."""
        if not self.timed:
            return False  # what came before the first time belongs to it
        if time_s is None:
            return self.time_s is None and address in self.seen
        return self.time_s != time_s

    def add(self, address: str, sentence: Sentence | None, t_ns: int, *, timed: bool, time_s: float | None) -> None:
        self.last_ns = t_ns
        count = self.seen[address] = self.seen.get(address, 0) + 1
        self.end = address, count
        self.timed |= timed
        if time_s is not None:
            self.time_s = time_s
        match sentence:
            case Gga():
                self.gga = sentence
            case Rmc():
                self.rmc = sentence
            case Gll():
                self.gll = sentence
            case Gsa():
                # One for each constellation, and those without satellites say "no fix": the best one counts.
                if self.gsa is None or (sentence.fix or 0) >= (self.gsa.fix or 0):
                    self.gsa = sentence
            case Gst():
                self.gst = sentence
            case Vtg():
                self.vtg = sentence
            case Zda():
                self.zda = sentence

    # ---- the fix -----------------------------------------------------------------------------------

    def fix(self, position: _Position) -> GpsFix:
        """Make the fix of the epoch at a position."""
        mode = self._mode()
        gga, gst = self.gga, self.gst
        hdop = (gga and gga.hdop) or (self.gsa and self.gsa.hdop) or 0.0
        speed_mps, course_deg = self._velocity() if mode > 1 else (0.0, None)
        return GpsFix(
            mode=mode,
            quality=self._quality() if mode > 1 else FixQuality.NONE,
            lat_rad=position.lat_rad,
            lon_rad=position.lon_rad,
            alt_m=position.alt_m,
            satellites=(gga and gga.satellites) or 0,
            hdop=hdop,
            sigma_east_m=(gst and gst.sigma_lon_m) or 0.0,
            sigma_north_m=(gst and gst.sigma_lat_m) or 0.0,
            speed_mps=speed_mps,
            course_valid=course_deg is not None,
            course_rad=0.0 if course_deg is None else yaw_of_heading(math.radians(course_deg)),
            time_of_day_s=-1.0 if self.time_s is None else self.time_s,
            utc_ns=self._utc_ns(),
        )

    def position(self, held: _Position) -> _Position:
        """Return the position of the epoch; what it does not tell, or not as valid, is taken from `held`."""
        if self._mode() == 1:
            return held
        source = self._position_source()
        assert source is not None
        assert source.lat_deg is not None
        assert source.lon_deg is not None
        altitude_m = None if self.gga is None else self.gga.altitude_m
        return _Position(
            math.radians(source.lat_deg),
            math.radians(source.lon_deg),
            held.alt_m if altitude_m is None else altitude_m,
        )

    def _position_source(self) -> Gga | Rmc | Gll | None:
        for source in (self.gga, self.rmc, self.gll):
            if source is not None and source.lat_deg is not None and source.lon_deg is not None:
                return source
        return None

    def _mode(self) -> int:
        """Return 3 with position and altitude, 2 with a position only, 1 if any sentence says there is none.

        GSA knows best: some receivers hold the last altitude in a plane fix and write it into GGA all the
        same (Garmin 25LP: 746.1 m for ten seconds).
        """
        says_none = (
            (self.gga is not None and not self.gga.quality)
            or (self.rmc is not None and self.rmc.status not in ("A", "D"))
            or (self.gll is not None and self.gll.status not in ("A", "D", None))  # None: before NMEA 2.0
            or (self.gsa is not None and self.gsa.fix in (0, 1))
        )
        if says_none or self._position_source() is None:
            return 1
        in_plane = self.gsa is not None and self.gsa.fix == 2
        return 3 if self.gga is not None and self.gga.altitude_m is not None and not in_plane else 2

    def _quality(self) -> FixQuality:
        if self.gga is not None and self.gga.quality:
            # NovAtel's 9 is a fix with SBAS corrections.
            return FixQuality.DIFFERENTIAL if self.gga.quality == 9 else FixQuality(self.gga.quality)
        letter = (self.rmc and self.rmc.mode) or (self.gll and self.gll.mode) or "A"
        return _QUALITY_OF_MODE.get(letter, FixQuality.AUTONOMOUS)

    def _velocity(self) -> tuple[float, float | None]:
        """Return speed in m/s, 0 if unknown, and the course as the receiver gives it."""
        rmc, vtg = self.rmc, self.vtg
        course_deg = rmc.course_deg if rmc is not None else None
        if course_deg is None and vtg is not None:
            course_deg = vtg.course_deg
        if rmc is not None and rmc.speed_kn is not None:
            return rmc.speed_kn * _MPS_PER_KNOT, course_deg
        if vtg is not None and vtg.speed_kn is not None:
            return vtg.speed_kn * _MPS_PER_KNOT, course_deg
        if vtg is not None and vtg.speed_kmh is not None:
            return vtg.speed_kmh / 3.6, course_deg
        return 0.0, course_deg

    def _utc_ns(self) -> int:
        """Return nanoseconds since 1970, 0 without time or possible date. A week's roll-over stays in."""
        if self.time_s is None:
            return 0
        zda, rmc = self.zda, self.rmc
        if zda is not None and zda.day and zda.month and zda.year and 1980 <= zda.year < 2080:
            day, month, year = zda.day, zda.month, zda.year
        elif rmc is not None and rmc.date is not None:
            day, month, year = rmc.date
            year += 1900 if year >= 80 else 2000
        else:
            return 0
        try:
            days = date(year, month, day).toordinal() - _UNIX_DAY
        except ValueError:  # 30 February: some receivers count wrongly around a roll-over
            return 0
        return days * _NS_PER_DAY + round(self.time_s * 1e9)
