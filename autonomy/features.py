"""Features: what a learned policy sees of the cart, as numbers with a range. Pure functions from records.

A feature's range says how it is scaled into a flat observation: low becomes -1, high becomes 1, and what is beyond is
clipped. The list of features with their ranges is the observation's description; it travels with a policy.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from hal.signals import CompassHeading, Course, GpsFix, LocalPlane, Scan, Site, wrap

from .follow import Station, nearest, on_leg, planned_line

if TYPE_CHECKING:
    import numpy as np

PREVIEW = 10  # points of the line ahead
PREVIEW_STATIONS = 2  # from one to the next; stations lie half a metre apart
RAYS = 32


@dataclass(frozen=True, slots=True)
class Feature:
    """A named group of numbers: how many, their range, and what they are."""

    name: str
    size: int
    low: float
    high: float
    doc: str


MOTION = Feature("motion", 3, -7.0, 7.0, "speed m/s, yaw rate rad/s, road-wheel angle rad, as measured")
LINE = Feature(
    "line", 3, -5.0, 5.0, "distance to the left of the line m, direction against it rad, speed it allows m/s"
)
AHEAD = Feature("ahead", 2 * PREVIEW, -12.0, 12.0, "points of the line ahead in C, m: x, y of each, nearest first")
ACTION = Feature("action", 2, -1.0, 1.0, "the last action")
GPS = Feature("gps", 3, -10.0, 10.0, "latest fix as seen from the pose: ahead m, to the left m; GGA quality")
COMPASS = Feature("compass", 2, -math.pi, math.pi, "compass against the pose's yaw, rad; 1 if it is valid")
RANGES = Feature("ranges", RAYS, 0.0, 8.0, "free distance of rays from right to left, m; what is not seen is free")
WANTED = Feature("wanted", 2, -6.0, 6.0, "command to be checked: speed m/s, road-wheel angle rad")
TRAVEL = Feature("travel", 2, -1.0, 1.0, "travel of the left and right wheel since the last step, m")
TRUTH = Feature("truth", 8, -7.0, 7.0,
    "the truth: distance to the left of the line m, direction against it rad, speed m/s, yaw rate rad/s, sideways m/s, "
    "road-wheel angle rad, brake, distance to the nearest thing m",
)  # fmt: skip


def described(features: Sequence[Feature]) -> list[dict[str, Any]]:
    """Give the description of an observation, as JSON has it."""
    return [{"name": f.name, "size": f.size, "low": f.low, "high": f.high, "doc": f.doc} for f in features]


class Flat:
    """Scales the numbers of some features into one array (n,) in [-1, 1]."""

    def __init__(self, features: Sequence[Feature]) -> None:
        import numpy as np

        low = np.concatenate([np.full(f.size, f.low) for f in features])
        high = np.concatenate([np.full(f.size, f.high) for f in features])
        self.size = len(low)
        self._middle, self._scale = (low + high) / 2, 2.0 / (high - low)

    def __call__(self, numbers: list[float]) -> "np.ndarray[Any, np.dtype[np.float32]]":
        """Give the flat observation, a fresh array (n,) of float32."""
        import numpy as np

        scaled = (np.array(numbers) - self._middle) * self._scale
        flat: np.ndarray[Any, np.dtype[np.float32]] = np.minimum(np.maximum(scaled, -1.0), 1.0).astype(np.float32)
        return flat


class Line:
    """The line through a course that the reference follower would drive, and how far along it the cart has come."""

    def __init__(self, site: Site, course: Course, here: tuple[float, float] = (0.0, 0.0)) -> None:
        """Begin at the course's start mark; where it has none, `here`, in M."""
        plane = LocalPlane.at(site.lat_rad, site.lon_rad)
        start = plane.to_map(course.start_lat_rad, course.start_lon_rad) if course.start_sigma_m > 0 else here
        self.stations: list[Station] = planned_line(site, course, start) if course.lat_rad else []
        self.at = 0

    def move(self, x_m: float, y_m: float) -> float:
        """Take the cart's place, and give the distance in m that it has gained along the line since the last one."""
        if not self.stations:
            return 0.0
        before_m = self.stations[self.at].s_m
        self.at = nearest(self.stations, self.at, (x_m, y_m))
        return self.stations[self.at].s_m - before_m

    @property
    def finished(self) -> bool:
        """Whether the cart has come to the end of the line."""
        return self.at >= len(self.stations) - 1

    @property
    def waypoint(self) -> int:
        """Index of the way-point ahead."""
        return self.stations[self.at].waypoint if self.stations else 0

    def aside(self, x_m: float, y_m: float, yaw_rad: float) -> tuple[float, float, float]:
        """Give (distance to the left of the line m, direction against it rad, speed that it allows m/s)."""
        if not self.stations:
            return 0.0, 0.0, 0.0
        k = min(self.at, len(self.stations) - 2)
        a, b = self.stations[k], self.stations[k + 1]
        left_m = on_leg((a.x_m, a.y_m), (b.x_m, b.y_m), (x_m, y_m))[1]
        along_rad = math.atan2(b.y_m - a.y_m, b.x_m - a.x_m)
        return left_m, wrap(yaw_rad - along_rad), self.stations[self.at].speed_mps

    def along(self, x_m: float, y_m: float) -> float:
        """Give how far along the line a place is, m, between two stations, too; never beyond its end."""
        if not self.stations:
            return 0.0
        k = min(self.at, len(self.stations) - 2)
        a, b = self.stations[k], self.stations[k + 1]
        return min(a.s_m + on_leg((a.x_m, a.y_m), (b.x_m, b.y_m), (x_m, y_m))[0], self.stations[-1].s_m)

    def ahead(self, x_m: float, y_m: float, yaw_rad: float) -> list[float]:
        """Give points of the line ahead in C: x, y of each; the last one again where the line ends."""
        if not self.stations:
            return [0.0] * AHEAD.size
        c, n = math.cos(yaw_rad), math.sin(yaw_rad)
        out: list[float] = []
        last = len(self.stations) - 1
        for k in range(self.at + PREVIEW_STATIONS, self.at + PREVIEW_STATIONS * (PREVIEW + 1), PREVIEW_STATIONS):
            station = self.stations[min(k, last)]
            dx, dy = station.x_m - x_m, station.y_m - y_m
            out += (dx * c + dy * n, dy * c - dx * n)
        return out


def gps(fix: GpsFix | None, plane: LocalPlane, x_m: float, y_m: float, yaw_rad: float) -> tuple[float, float, float]:
    """Give the numbers of GPS."""
    if fix is None or fix.mode < 2:
        return 0.0, 0.0, 0.0
    gx, gy = plane.to_map(fix.lat_rad, fix.lon_rad)
    c, n, dx, dy = math.cos(yaw_rad), math.sin(yaw_rad), gx - x_m, gy - y_m
    return dx * c + dy * n, dy * c - dx * n, float(fix.quality)


def compass(heading: CompassHeading | None, yaw_rad: float) -> tuple[float, float]:
    """Give the numbers of COMPASS."""
    if heading is None or not heading.valid:
        return 0.0, 0.0
    return wrap(heading.yaw_rad - yaw_rad), 1.0


def ranges(scan: Scan | None) -> list[float]:
    """Give the numbers of RANGES: the nearest hit of each sector of the sweep."""
    free = RANGES.high
    if scan is None or not scan.range_m:
        return [free] * RAYS
    n, seen = len(scan.range_m), [r if r < scan.max_m else free for r in scan.range_m]
    edges = [k * n // RAYS for k in range(RAYS + 1)]
    return [min(seen[a : max(b, a + 1)]) for a, b in pairwise(edges)]
