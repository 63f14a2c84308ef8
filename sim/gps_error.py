"""Position and velocity error of a satellite receiver, correlated in time.

Each axis has a slow part that wanders by decimetres to metres over minutes, and a white part of centimetres.
White noise alone is a wrong model: standing receivers (captures in gpsd's test data) move 0.04-0.17 m from
one fix to the next at 1 Hz, while their offset is several times that.

Slow part: first-order Gauss-Markov process in its exact discrete form (Gelb, Applied Optimal Estimation,
1974),
    b(k+1) = b(k) exp(-dt/tau) + w,   var w = sigma^2 (1 - exp(-2 dt/tau)),
so that the step length does not change the statistics.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, sqrt

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class GpsGrade:
    """Error sizes of one class of fix, for east and north."""

    name: str
    slow_sigma_m: float
    tau_s: float
    white_sigma_m: float
    up_factor: float = 2.0  # the height is this much worse; 1.5-3
    velocity_sigma_mps: float = 0.05  # white, each axis; 0.05-0.1


# Orders of magnitude used by several simulators (assumptions). After each, the usual range of slow sigma
# in m, tau in s, white sigma in m.
AUTONOMOUS = GpsGrade(name="autonomous", slow_sigma_m=2.0, tau_s=300.0, white_sigma_m=0.1)
"""2-4, 60-600, 0.1-0.5"""
SBAS = GpsGrade(name="sbas", slow_sigma_m=0.7, tau_s=200.0, white_sigma_m=0.04)
"""0.5-1, 60-600, 0.03-0.1"""
RTK_FLOAT = GpsGrade(name="rtk_float", slow_sigma_m=0.2, tau_s=60.0, white_sigma_m=0.02)
"""0.1-0.3, 30-120, 0.02"""
RTK_FIXED = GpsGrade(name="rtk_fixed", slow_sigma_m=0.008, tau_s=30.0, white_sigma_m=0.007)
"""0.005-0.01, 10-60, 0.005-0.01"""

GPS_GRADES = {grade.name: grade for grade in (AUTONOMOUS, SBAS, RTK_FLOAT, RTK_FIXED)}


class GpsError:
    """The error of one receiver. Call `advance` once per fix, with the time since the fix before.

    `grade` may be changed while running: the offset is kept in units of sigma, so it jumps to the size of the
    new class, as receivers do when the type of fix changes. Each `advance` draws nine numbers, whatever the
    grade.
    """

    __slots__ = ("_rng", "_slow", "_velocity", "_white", "grade")

    def __init__(self, rng: np.random.Generator, grade: GpsGrade) -> None:
        self._rng = rng
        self.grade = grade
        # All in units of sigma, east, north, up. The start is drawn from the stationary distribution.
        draw: list[float] = rng.standard_normal(9).tolist()
        self._slow, self._white, self._velocity = draw[0:3], draw[3:6], draw[6:9]

    def advance(self, dt_s: float) -> None:
        """Let `dt_s` pass; the slow part wanders, the white parts are drawn anew."""
        keep = exp(-dt_s / self.grade.tau_s)
        fresh = sqrt(1.0 - keep * keep)
        draw: list[float] = self._rng.standard_normal(9).tolist()
        self._slow = [keep * slow + fresh * new for slow, new in zip(self._slow, draw[0:3], strict=True)]
        self._white, self._velocity = draw[3:6], draw[6:9]

    @property
    def east_m(self) -> float:
        """Error to the east: reported minus true."""
        return self.grade.slow_sigma_m * self._slow[0] + self.grade.white_sigma_m * self._white[0]

    @property
    def north_m(self) -> float:
        """Error to the north: reported minus true."""
        return self.grade.slow_sigma_m * self._slow[1] + self.grade.white_sigma_m * self._white[1]

    @property
    def up_m(self) -> float:
        """Error upward: reported minus true."""
        up_m = self.grade.slow_sigma_m * self._slow[2] + self.grade.white_sigma_m * self._white[2]
        return self.grade.up_factor * up_m

    def velocity_error(self) -> tuple[float, float, float]:
        """Return the error of the velocity of this fix, m/s: east, north, up."""
        sigma_mps = self.grade.velocity_sigma_mps
        east, north, up = self._velocity
        return sigma_mps * east, sigma_mps * north, sigma_mps * self.grade.up_factor * up
