"""What a magnetic compass on a cart gets wrong: deviation, tilt under acceleration, traction current, noise.

The compass measures two vectors in the cart's axes C (x forward, y left, z up): the magnetic field, and by its
accelerometer the specific force, which it takes for the direction of up. It turns the field back by the tilt that
it believes in and reads the heading off the horizontal part (Caruso, Applications of Magnetoresistive Sensors in
Navigation Systems, SAE 970602, 1997). For small angles the error of the heading psi is

    tilt       tan(inclination) (pitch sin psi - roll cos psi)    for the tilt that is there and not believed in,
                                                                  with the other sign for one believed in only
    current    the field of the traction cable across the heading, over the horizontal field
    deviation  A + B sin psi + C cos psi + D sin 2 psi + E cos 2 psi

At Bloomington 1 degree of tilt gives up to 2.27 degrees. 1 m/s2 looks like 5.8 degrees of tilt.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import date
from functools import lru_cache
from math import atan2, cos, exp, hypot, inf, radians, sin, tan

import numpy as np

from hal.signals import heading_of_yaw

from .plant import GRAVITY_MPS2

_Vector = tuple[float, float, float]
_UT_M_PER_A = 0.2
"""Field of a straight wire: mu0 / 2 pi, in microtesla times metres per ampere."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CompassParams:
    """A compass, its mounting and the field of the place."""

    horizontal_ut: float = 20.67  # World Magnetic Model, 39.165 N, 86.526 W, 2026.9
    inclination_rad: float = radians(66.2)  # the same; down is positive
    # Largest deviation after the compass was adjusted on the cart. Together at most 1.36 degrees, inside the
    # 0.5-2 degrees of corrected steel vehicles (assumption); uncorrected ones have 5-30.
    constant_max_rad: float = radians(0.3)  # A
    one_cycle_max_rad: float = radians(0.5)  # B, C: hard iron
    two_cycle_max_rad: float = radians(0.25)  # D, E: soft iron
    noise_rad: float = radians(0.3)  # RMS; 0.1-0.5 is usual
    tilt_compensated: bool = True
    tilt_lag_s: float = 0.2  # first order, of the accelerometer's filter
    field_lag_s: float = 0.0  # first order; a compass that averages its heading has 0.1-0.5
    stray_ut: _Vector = (0.0, 0.0, 0.0)  # iron that came aboard after the adjustment, in C
    cable_distance_m: float = 1.6  # traction cable under the floor, compass on the roof
    cable_gap_m: float = inf  # the returning cable is this much farther away: infinite = one wire alone
    cable_field: _Vector = (0.0, -1.0, 0.0)  # direction of its field in C: the current flows forward, below


@dataclass(frozen=True, slots=True, kw_only=True)
class Deviation:
    """Deviation of one installed compass, radians: A + B sin psi + C cos psi + D sin 2 psi + E cos 2 psi."""

    a_rad: float = 0.0
    b_rad: float = 0.0
    c_rad: float = 0.0
    d_rad: float = 0.0
    e_rad: float = 0.0

    def at(self, heading_rad: float) -> float:
        """Return what the compass shows too much at a magnetic heading."""
        once, twice = heading_rad, 2.0 * heading_rad
        one_cycle = self.b_rad * sin(once) + self.c_rad * cos(once)
        return self.a_rad + one_cycle + self.d_rad * sin(twice) + self.e_rad * cos(twice)


class CompassError:
    """One compass on its cart. Five numbers are drawn for its deviation, then one for the noise of each heading."""

    __slots__ = ("_field", "_force", "_rng", "deviation", "params", "pitch_rad", "roll_rad")

    def __init__(self, rng: np.random.Generator, params: CompassParams | None = None) -> None:
        self._rng = rng
        self.params = p = params or CompassParams()
        draw: list[float] = rng.uniform(-1.0, 1.0, 5).tolist()
        self.deviation = Deviation(
            a_rad=p.constant_max_rad * draw[0],
            b_rad=p.one_cycle_max_rad * draw[1],
            c_rad=p.one_cycle_max_rad * draw[2],
            d_rad=p.two_cycle_max_rad * draw[3],
            e_rad=p.two_cycle_max_rad * draw[4],
        )
        self._field: _Vector | None = None  # filtered, in C; None before the first heading
        self._force: _Vector | None = None
        self.pitch_rad = 0.0
        """Tilt that the compass believed in at the last heading, and reports: nose up positive."""
        self.roll_rad = 0.0
        """Left side up positive."""

    def heading(
        self,
        yaw_rad: float,
        declination_rad: float,
        pitch_rad: float,
        roll_rad: float,
        ax_mps2: float,
        ay_mps2: float,
        current_a: float,
        dt_s: float,
    ) -> float:
        """Return the magnetic heading that the compass shows, in [0, 2 pi), clockwise from magnetic north.

        Yaw, pitch and roll are true. The accelerations are what an accelerometer shows, slope included, as in
        `CartState`: standing uphill `ax_mps2` is g sin(pitch). `current_a` flows through the traction cable,
        `dt_s` passed since the heading before. The first heading finds the filters settled.
        """
        p = self.params
        psi = heading_of_yaw(yaw_rad) - declination_rad
        down_ut = p.horizontal_ut * tan(p.inclination_rad)
        earth_ut = (p.horizontal_ut * cos(psi), p.horizontal_ut * sin(psi), -down_ut)
        cable_ut = _UT_M_PER_A * current_a * (1.0 / p.cable_distance_m - 1.0 / (p.cable_distance_m + p.cable_gap_m))
        bx_ut, by_ut, bz_ut = _tilted(earth_ut, pitch_rad, roll_rad)
        field_ut = (
            bx_ut + p.stray_ut[0] + cable_ut * p.cable_field[0],
            by_ut + p.stray_ut[1] + cable_ut * p.cable_field[1],
            bz_ut + p.stray_ut[2] + cable_ut * p.cable_field[2],
        )
        force_mps2 = (ax_mps2, ay_mps2, GRAVITY_MPS2 * cos(pitch_rad) * cos(roll_rad))
        self._field = _follow(self._field, field_ut, p.field_lag_s, dt_s)
        self._force = _follow(self._force, force_mps2, p.tilt_lag_s, dt_s)
        fx, fy, fz = self._force
        self.pitch_rad, self.roll_rad = atan2(fx, hypot(fy, fz)), atan2(fy, fz)
        x_ut, y_ut, _ = _levelled(self._field, self.pitch_rad, self.roll_rad) if p.tilt_compensated else self._field
        shown_rad = atan2(y_ut, x_ut)  # the field to the left: north is left of a cart that heads east
        noise_rad = p.noise_rad * float(self._rng.standard_normal())
        return (shown_rad + self.deviation.at(shown_rad) + noise_rad) % math.tau


def _tilted(level: _Vector, pitch_rad: float, roll_rad: float) -> _Vector:
    """Turn a vector from the cart's level axes into its tilted ones: first nose up, then left side up."""
    x, y, z = level
    x, z = x * cos(pitch_rad) + z * sin(pitch_rad), z * cos(pitch_rad) - x * sin(pitch_rad)
    y, z = y * cos(roll_rad) + z * sin(roll_rad), z * cos(roll_rad) - y * sin(roll_rad)
    return x, y, z


def _levelled(tilted: _Vector, pitch_rad: float, roll_rad: float) -> _Vector:
    """Undo `_tilted`."""
    x, y, z = tilted
    y, z = y * cos(roll_rad) - z * sin(roll_rad), z * cos(roll_rad) + y * sin(roll_rad)
    x, z = x * cos(pitch_rad) - z * sin(pitch_rad), z * cos(pitch_rad) + x * sin(pitch_rad)
    return x, y, z


def _follow(before: _Vector | None, now: _Vector, lag_s: float, dt_s: float) -> _Vector:
    """Return a first-order filter's output after `dt_s` of a constant input; it starts settled."""
    if before is None or lag_s == 0.0:
        return now
    keep = exp(-dt_s / lag_s)
    return (
        now[0] + keep * (before[0] - now[0]),
        now[1] + keep * (before[1] - now[1]),
        now[2] + keep * (before[2] - now[2]),
    )


# ---- the Earth's field -------------------------------------------------------------------------------


class NoMagneticModel(ValueError):
    """Raised for a date outside the World Magnetic Models that are installed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MagneticField:
    """The Earth's field at a place and date."""

    declination_rad: float
    """From true to magnetic north, east positive."""
    inclination_rad: float
    """Down positive."""
    horizontal_ut: float


_UNIX_DAY = date(1970, 1, 1).toordinal()
_NS_PER_DAY = 86_400_000_000_000
_FIRST_DAY, _END_DAY = date(2010, 1, 1).toordinal(), date(2030, 1, 1).toordinal()
"""The models that pygeomag 1.1 brings: 2010, 2015, 2020, 2025, five years each."""


def magnetic_field(lat_rad: float, lon_rad: float, alt_m: float, t_ns: int) -> MagneticField:
    """Return the field by the World Magnetic Model of the date, for the day, 0.001 degrees and 100 m.

    `t_ns` counts from 1970. Raises NoMagneticModel before 2010 and from 2030 on.
    """
    day = _UNIX_DAY + t_ns // _NS_PER_DAY
    if not _FIRST_DAY <= day < _END_DAY:
        raise NoMagneticModel(
            f"day {t_ns / _NS_PER_DAY:.0f} after 1970 came, expected one from 2010 to 2029: set the start of the "
            "run (start_utc) into these years, or install a pygeomag with a newer World Magnetic Model"
        )
    lat_deg, lon_deg = round(math.degrees(lat_rad), 3), round(math.degrees(lon_rad), 3)
    return _field_of_day(lat_deg, lon_deg, round(alt_m / 100.0) / 10.0, day)


def declination_rad(lat_rad: float, lon_rad: float, alt_m: float, t_ns: int) -> float:
    """Return the declination of `magnetic_field`, east positive."""
    return magnetic_field(lat_rad, lon_rad, alt_m, t_ns).declination_rad


@lru_cache(maxsize=256)
def _field_of_day(lat_deg: float, lon_deg: float, alt_km: float, day: int) -> MagneticField:
    """Ask pygeomag; 4 ms and more, therefore cached."""
    from pygeomag import GeoMag  # type: ignore[import-untyped]

    year = date.fromordinal(day).year
    start = date(year, 1, 1).toordinal()
    length = date(year + 1, 1, 1).toordinal() - start
    found = GeoMag(base_year=year).calculate(glat=lat_deg, glon=lon_deg, alt=alt_km, time=year + (day - start) / length)
    return MagneticField(
        declination_rad=radians(found.d), inclination_rad=radians(found.i), horizontal_ut=found.h / 1000.0
    )
