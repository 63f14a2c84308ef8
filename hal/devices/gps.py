"""Model of a GPS receiver's serial side: what it measures leaves the line as NMEA sentences.

    measurement                                             end
        |                      GGA............ RMC..........|
        |<----------------- latency ----------------------->|
                               |<- bytes at the baud rate ->|

The errors of the measurement are the simulator's business; the rounding of the text and the time on the line
are made here. Level wire gives bytes, level direct gives the same sentences rounded alike, without the text.
"""

import math
from collections.abc import Callable
from datetime import date
from typing import Final, Literal

import msgspec

from hal.codecs import nmea
from hal.codecs.nmea import Gga, Gll, Gsa, Gst, Rmc, Sentence, Vtg, Zda
from hal.signals import FixQuality, heading_of_yaw

from .talker import Talker

__all__ = ["GpsReceiver"]

_KNOTS_PER_MPS: Final = 3600 / 1852
_COURSE_FROM_MPS: Final = 0.3
"""Below this speed the course is left empty, as u-blox receivers do."""
_UNIX_DAY: Final = date(1970, 1, 1).toordinal()
_CS_PER_DAY: Final = 8_640_000

_MODE_LETTER: Final = {
    FixQuality.NONE: "N",
    FixQuality.AUTONOMOUS: "A",
    FixQuality.DIFFERENTIAL: "D",
    FixQuality.PPS: "P",
    FixQuality.RTK_FIXED: "R",
    FixQuality.RTK_FLOAT: "F",
    FixQuality.DEAD_RECKONING: "E",
    FixQuality.MANUAL: "M",
    FixQuality.SIMULATOR: "S",
}


class GpsReceiver(Talker):
    """Measures every `period_ns` from `t0_ns` on; the burst of a measurement ends `latency_ns` after it.

    In each tick: `measure` if it is `due`, then `poll`. Set `silent` for an outage: nothing is measured
    or sent then, and a burst under way is cut off for good.
    """

    def __init__(
        self,
        *,
        period_ns: int = 200_000_000,
        latency_ns: int = 100_000_000,
        baud: int = 38_400,
        level: Literal["wire", "direct"] = "wire",
        sentences: tuple[str, ...] = ("GGA", "RMC"),
        talker: str = "GP",
        variation_rad: float | None = None,
        t0_ns: int = 0,
    ) -> None:
        super().__init__(period_ns=period_ns, latency_ns=latency_ns, baud=baud, level=level, t0_ns=t0_ns)
        unknown = [name for name in sentences if name not in _WRITERS]
        if unknown or not sentences:
            raise ValueError(f"sentences {sentences}: expected some of {', '.join(_WRITERS)}")
        self._writers = [_WRITERS[name] for name in sentences]
        self._talker = talker
        self._variation_deg = None if variation_rad is None else math.degrees(variation_rad)
        longest = _LONGEST if variation_rad is not None else msgspec.structs.replace(_LONGEST, variation_deg=None)
        self.refuse_if_too_long(sum(len(nmea.format(write(talker, longest))) for write in self._writers))

    def measure(
        self,
        t_ns: int,
        *,
        lat_rad: float,
        lon_rad: float,
        alt_m: float,
        east_mps: float,
        north_mps: float,
        quality: FixQuality,
        satellites: int,
        hdop: float,
        sigma_m: float,
        utc_ns: int,
    ) -> None:
        """Measure now: the antenna and its velocity, errors included. ValueError if not due or not sayable.

        Quality NONE leaves position and velocity empty. `utc_ns` outside 1980 to 2079 leaves the date empty.
        """
        if not self.due(t_ns):
            raise ValueError(
                f"measured at {t_ns} ns, expected a multiple of {self._period_ns} ns after {self._t0_ns} ns"
            )
        if self.silent:
            return
        valid = quality != FixQuality.NONE
        moves = valid and math.hypot(east_mps, north_mps) >= _COURSE_FROM_MPS
        # Rounded before it is split, so that 23:59:59.999 becomes 00:00:00.00 of the next day.
        days, centiseconds = divmod((utc_ns + 5_000_000) // 10_000_000, _CS_PER_DAY)
        measured = _Measurement(
            valid=valid,
            quality=quality,
            lat_deg=math.degrees(lat_rad) if valid else None,
            lon_deg=math.degrees(lon_rad) if valid else None,
            # float(): numpy rounds its own floats in another way than the text does
            alt_m=float(alt_m) if valid else None,
            speed_mps=math.hypot(east_mps, north_mps) if valid else None,
            course_deg=math.degrees(heading_of_yaw(math.atan2(north_mps, east_mps))) if moves else None,
            satellites=satellites,
            hdop=float(hdop) if valid else None,
            sigma_m=float(sigma_m) if valid else None,
            time_s=centiseconds / 100,
            date=date.fromordinal(_UNIX_DAY + days),
            variation_deg=self._variation_deg,
        )
        sentences = [write(self._talker, measured) for write in self._writers]
        self.say(t_ns, sentences)


# ---- what the sentences say --------------------------------------------------------------------------


class _Measurement(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """One measurement in the units of NMEA but for the speed; None is what the receiver does not know."""

    valid: bool
    quality: FixQuality
    lat_deg: float | None
    lon_deg: float | None
    alt_m: float | None
    speed_mps: float | None
    course_deg: float | None
    satellites: int
    hdop: float | None
    sigma_m: float | None
    time_s: float
    date: date
    variation_deg: float | None = None
    """Magnetic, as the receiver's own model has it; east positive."""

    @property
    def speed_kn(self) -> float | None:
        return None if self.speed_mps is None else self.speed_mps * _KNOTS_PER_MPS

    @property
    def status(self) -> str:
        return "A" if self.valid else "V"

    @property
    def date_known(self) -> bool:
        """Say whether two digits of the year can tell it."""
        return 1980 <= self.date.year < 2080


_LONGEST: Final = _Measurement(
    valid=True,
    quality=FixQuality.AUTONOMOUS,
    lat_deg=-89.0,
    lon_deg=-179.0,
    alt_m=9999.9,
    speed_mps=50.0,
    course_deg=359.99,
    satellites=12,
    hdop=99.99,
    sigma_m=99.99,
    time_s=86_399.99,
    date=date(2026, 12, 31),
    variation_deg=-179.9,
)
"""As long as the sentences of a cart get; a longer measurement is refused when it comes."""


def _gga(talker: str, m: _Measurement) -> Sentence:
    return Gga(
        talker=talker,
        time_s=m.time_s,
        lat_deg=m.lat_deg,
        lon_deg=m.lon_deg,
        quality=int(m.quality),
        satellites=m.satellites,
        hdop=m.hdop,
        altitude_m=m.alt_m,
    )


def _rmc(talker: str, m: _Measurement) -> Sentence:
    return Rmc(
        talker=talker,
        time_s=m.time_s,
        status=m.status,
        lat_deg=m.lat_deg,
        lon_deg=m.lon_deg,
        speed_kn=m.speed_kn,
        course_deg=m.course_deg,
        date=(m.date.day, m.date.month, m.date.year % 100) if m.date_known else None,
        variation_deg=m.variation_deg,
        mode=_MODE_LETTER[m.quality],
    )


def _vtg(talker: str, m: _Measurement) -> Sentence:
    return Vtg(
        talker=talker,
        course_deg=m.course_deg,
        speed_kn=m.speed_kn,
        speed_kmh=None if m.speed_mps is None else m.speed_mps * 3.6,
        mode=_MODE_LETTER[m.quality],
    )


def _gsa(talker: str, m: _Measurement) -> Sentence:
    return Gsa(talker=talker, selection="A", fix=3 if m.valid else 1, hdop=m.hdop)


def _gst(talker: str, m: _Measurement) -> Sentence:
    return Gst(talker=talker, time_s=m.time_s, sigma_lat_m=m.sigma_m, sigma_lon_m=m.sigma_m)


def _gll(talker: str, m: _Measurement) -> Sentence:
    return Gll(
        talker=talker,
        lat_deg=m.lat_deg,
        lon_deg=m.lon_deg,
        time_s=m.time_s,
        status=m.status,
        mode=_MODE_LETTER[m.quality],
    )


def _zda(talker: str, m: _Measurement) -> Sentence:
    day, month, year = (m.date.day, m.date.month, m.date.year) if m.date_known else (None, None, None)
    return Zda(talker=talker, time_s=m.time_s, day=day, month=month, year=year, zone_hours=0, zone_minutes=0)


_WRITERS: Final[dict[str, Callable[[str, _Measurement], Sentence]]] = {
    "GGA": _gga,
    "RMC": _rmc,
    "VTG": _vtg,
    "GSA": _gsa,
    "GST": _gst,
    "GLL": _gll,
    "ZDA": _zda,
}
