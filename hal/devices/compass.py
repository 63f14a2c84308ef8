"""Model of an electronic compass's serial side: Honeywell HMR3000 or OceanServer OS5000.

    measurement                          end
        |              $PTNTHPR...........|
        |<---------- latency ------------>|
                       |<- at the baud -->|

What the compass measures wrongly is the simulator's business; the rounding of the text and the time on the line
are made here. Level wire gives bytes, level direct gives the same sentences rounded alike, without the text.
"""

import math
from collections.abc import Callable
from typing import Final, Literal

import msgspec

from hal.codecs import nmea
from hal.codecs.nmea import Hdg, Hdt, Hpr, Ohpr, Os5000, Sentence

from .talker import Talker

__all__ = ["Compass"]

_TEMPERATURE_DEGC: Final = 20.0
"""What the OS5000 says of its own board."""


class Compass(Talker):
    """Measures every `period_ns` from `t0_ns` on; what it says of a measurement ends `latency_ns` after it.

    In each tick: `measure` if it is `due`, then `poll`. Set `silent` for an outage: nothing is measured or sent
    then, and a sentence under way is cut off for good.

    `sentences` are some of HPR, HDG, HDT (hmr3000) or C, OHPR, HDT (os5000); without, the first one. Each is a
    reading of its own to the driver. `variation_rad` is the declination that is set in the compass, for HDG and HDT.
    """

    def __init__(
        self,
        *,
        personality: Literal["hmr3000", "os5000"] = "hmr3000",
        period_ns: int = 100_000_000,
        latency_ns: int = 20_000_000,
        baud: int = 19_200,
        level: Literal["wire", "direct"] = "wire",
        sentences: tuple[str, ...] | None = None,
        variation_rad: float | None = None,
        t0_ns: int = 0,
    ) -> None:
        if personality not in _WRITERS:
            raise ValueError(f"personality {personality!r}, expected {' or '.join(_WRITERS)}")
        super().__init__(period_ns=period_ns, latency_ns=latency_ns, baud=baud, level=level, t0_ns=t0_ns)
        writers = _WRITERS[personality]
        sentences = tuple(writers)[:1] if sentences is None else sentences
        if not sentences or not set(sentences) <= set(writers):
            raise ValueError(f"sentences {sentences} of {personality}: expected some of {', '.join(writers)}")
        if "HDT" in sentences and variation_rad is None:
            raise ValueError("HDT is a true heading: expected the variation_rad that is set in the compass")
        self._writers = [writers[name] for name in sentences]
        self._variation_deg = None if variation_rad is None else math.degrees(variation_rad)
        longest = _Measurement(359.9, -89.9, -179.9, self._variation_deg)
        self.refuse_if_too_long(sum(len(nmea.format(write(longest))) for write in self._writers))

    def measure(self, t_ns: int, heading_rad: float, pitch_rad: float, roll_rad: float, *, alarm: bool = False) -> None:
        """Measure now: the magnetic heading, clockwise; nose up and left side up are positive.

        With an alarm the HMR3000 leaves the heading empty and HPR says status P. The OS5000 knows no alarms: it
        says a disturbed heading as if nothing were wrong. ValueError if not due.
        """
        if not self.due(t_ns):
            raise ValueError(
                f"measured at {t_ns} ns, expected a multiple of {self._period_ns} ns after {self._t0_ns} ns"
            )
        if self.silent:
            return
        measured = _Measurement(
            # float(): numpy rounds its own floats in another way than the text does
            heading_deg=math.degrees(float(heading_rad)) % 360.0,
            pitch_deg=math.degrees(float(pitch_rad)),
            roll_deg=math.degrees(float(roll_rad)),
            variation_deg=self._variation_deg,
            alarm=alarm,
        )
        sentences = [write(measured) for write in self._writers]
        self.say(t_ns, sentences)


# ---- what the sentences say --------------------------------------------------------------------------


class _Measurement(msgspec.Struct, frozen=True, gc=False):
    """One measurement in the units of NMEA."""

    heading_deg: float
    pitch_deg: float
    roll_deg: float
    variation_deg: float | None
    """Declination that is set in the compass, None if it is not."""
    alarm: bool = False

    @property
    def heading_unless_alarm_deg(self) -> float | None:
        return None if self.alarm else self.heading_deg

    @property
    def true_heading_deg(self) -> float:
        assert self.variation_deg is not None
        return (self.heading_deg + self.variation_deg) % 360.0


def _hpr(m: _Measurement) -> Sentence:
    return Hpr(
        heading_deg=m.heading_unless_alarm_deg,
        heading_status="P" if m.alarm else "N",
        pitch_deg=m.pitch_deg,
        pitch_status="N",
        roll_deg=m.roll_deg,
        roll_status="N",
    )


def _hdg(m: _Measurement) -> Sentence:
    return Hdg(heading_deg=m.heading_unless_alarm_deg, variation_deg=m.variation_deg)


def _hdt(m: _Measurement) -> Sentence:
    return Hdt(heading_deg=None if m.alarm else m.true_heading_deg)


def _hdt_without_alarm(m: _Measurement) -> Sentence:
    return Hdt(heading_deg=m.true_heading_deg)


def _c(m: _Measurement) -> Sentence:
    return Os5000(
        heading_deg=m.heading_deg, pitch_deg=m.pitch_deg, roll_deg=m.roll_deg, temperature_degc=_TEMPERATURE_DEGC
    )


def _ohpr(m: _Measurement) -> Sentence:
    return Ohpr(
        heading_deg=m.heading_deg, pitch_deg=m.pitch_deg, roll_deg=m.roll_deg, temperature_degc=_TEMPERATURE_DEGC
    )


_WRITERS: Final[dict[str, dict[str, Callable[[_Measurement], Sentence]]]] = {
    "hmr3000": {"HPR": _hpr, "HDG": _hdg, "HDT": _hdt},
    "os5000": {"C": _c, "OHPR": _ohpr, "HDT": _hdt_without_alarm},
}
