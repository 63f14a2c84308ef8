"""Follow: plan a line through the way-points, once per course, then track it by pure pursuit.

The line: straight legs whose corners are rounded as far as the target radius of the way-point allows, so that turns are
taken economically; a corner too sharp for that is driven up to and turned at full lock. Along the line stands a speed
that keeps lateral acceleration and braking comfortable. Tracking: steer on the circle through the rear axle and a goal
point a look-ahead further on the line, curvature = 2 y / L^2 (Coulter, Implementation of the Pure Pursuit Path Tracking
Algorithm, CMU-RI-TR-92-01, 1992).
"""

import math
from itertools import pairwise
from typing import NamedTuple

from autonomy import Input, Module, Output, Param
from hal.signals import STOP, Course, DriveCommand, FollowState, LocalPlane, Pose, Site

Point = tuple[float, float]
SPACING_M = 0.5


class Station(NamedTuple):
    """A point of the line: how far along it is, how fast to be there, and which way-point comes next."""

    s_m: float
    x_m: float
    y_m: float
    speed_mps: float
    waypoint: int


class Follow(Module):
    """Drive the cart along the course."""

    site = Input(Site, static=True)
    course = Input(Course, static=True)
    pose = Input(Pose, max_age_s=0.25)
    drive = Output(DriveCommand, safe=STOP)
    state = Output(FollowState, safe=FollowState())

    wheelbase_m = Param(1.66, unit="m")
    max_steer_rad = Param(0.46, unit="rad")
    turn_radius_m = Param(3.8, unit="m")
    lookahead_s = Param(1.0, unit="s")
    min_lookahead_m = Param(2.2, unit="m")
    lateral_mps2 = Param(1.2, unit="m/s2")
    decel_mps2 = Param(0.7, unit="m/s2")
    cut = Param(0.5, unit="1")

    def reset(self) -> None:
        """Forget the line."""
        self._line: list[Station] = []
        self._at = 0
        self._course: Course | None = None

    def step(self) -> None:
        """Aim at the goal point; choose the speed."""
        if self.course is not self._course:
            if self.course != self._course:  # the first one, or a new one
                self._line, self._at = self._plan() if self.course.lat_rad else [], 0
            self._course = self.course
        if not self._line:  # a course without way-points: it knows no way
            self.drive, self.state = DriveCommand(0.0, 0.0, 1.0), FollowState()
            return
        here = (self.pose.x_m, self.pose.y_m)
        self._at = nearest(self._line, self._at, here)
        end = self._line[-1]
        last = end.s_m - self._line[self._at].s_m
        finished = last < SPACING_M or (last < 2.0 and math.dist(here, (end.x_m, end.y_m)) < SPACING_M)
        lateral_m = self._lateral_error(here)
        self.state = FollowState(self._line[self._at].waypoint, finished, lateral_m)
        if finished:
            self.drive = DriveCommand(0.0, 0.0, 1.0)
            return
        lookahead_m = max(self.min_lookahead_m, self.lookahead_s * abs(self.pose.speed_mps))
        steer_rad = math.atan(self.wheelbase_m * self._curvature(self._goal(lookahead_m)))
        steer_rad = min(max(steer_rad, -self.max_steer_rad), self.max_steer_rad)
        self.drive = DriveCommand(speed_mps=self._speed(steer_rad, lateral_m), steer_rad=steer_rad, decel_mps2=1.0)

    def _plan(self) -> list[Station]:
        """Turn the course into a line in M that begins where the cart stands."""
        return planned_line(
            self.site,
            self.course,
            (self.pose.x_m, self.pose.y_m),
            cut=self.cut,
            turn_radius_m=self.turn_radius_m,
            lateral_mps2=self.lateral_mps2,
            decel_mps2=self.decel_mps2,
        )

    def _goal(self, lookahead_m: float) -> Point:
        """Give the point of the line a look-ahead on; beyond the end, straight on."""
        wanted_m = self._line[self._at].s_m + lookahead_m
        for k in range(self._at, len(self._line) - 1):
            if self._line[k + 1].s_m >= wanted_m:
                break
        a, b = self._line[k], self._line[k + 1]
        part = (wanted_m - a.s_m) / (b.s_m - a.s_m)
        return a.x_m + part * (b.x_m - a.x_m), a.y_m + part * (b.y_m - a.y_m)

    def _curvature(self, goal: Point) -> float:
        dx, dy = goal[0] - self.pose.x_m, goal[1] - self.pose.y_m
        c, s = math.cos(self.pose.yaw_rad), math.sin(self.pose.yaw_rad)
        ahead_m, left_m = dx * c + dy * s, dy * c - dx * s
        if ahead_m < 0:  # behind: the tightest turn on that side
            return math.copysign(1.0, left_m)
        return 2.0 * left_m / (dx * dx + dy * dy)

    def _speed(self, steer_rad: float, lateral_m: float) -> float:
        """Give the line's speed here, and no more than the present steering, or finding back to the line, allows."""
        curvature = abs(math.tan(steer_rad)) / self.wheelbase_m
        planned_mps = self._line[self._at].speed_mps
        if abs(lateral_m) > 0.7:
            planned_mps = min(planned_mps, math.sqrt(self.lateral_mps2 * self.turn_radius_m))
        return min(planned_mps, math.sqrt(self.lateral_mps2 / curvature)) if curvature > 1e-6 else planned_mps

    def _lateral_error(self, here: Point) -> float:
        a, b = self._line[min(self._at, len(self._line) - 2)], self._line[min(self._at, len(self._line) - 2) + 1]
        return on_leg((a.x_m, a.y_m), (b.x_m, b.y_m), here)[1]


# -- the line -------------------------------------------------------------------------------------------------------


def planned_line(
    site: Site,
    course: Course,
    start: Point,
    *,
    cut: float = 0.5,
    turn_radius_m: float = 3.8,
    lateral_mps2: float = 1.2,
    decel_mps2: float = 0.7,
) -> list[Station]:
    """Plan the line from a start through the way-points, in M, with the speed that it allows at each station.

    cut: share of a way-point's radius by which a corner may be missed.
    """
    plane = LocalPlane.at(site.lat_rad, site.lon_rad)
    corners = [start, *(plane.to_map(lat, lon) for lat, lon in zip(course.lat_rad, course.lon_rad, strict=True))]
    points = rounded(corners, [cut * radius_m for radius_m in course.radius_m], turn_radius_m)
    radii = widened(bend_radii(points), turn_radius_m)
    speeds = [min(course.speed_mps, math.sqrt(lateral_mps2 * radius_m)) for radius_m in radii]
    return stations(points, speeds, decel_mps2)


def rounded(corners: list[Point], allowed_m: list[float], least_radius_m: float) -> list[tuple[float, float, int]]:
    """Give points (x, y, way-point ahead) every half metre along legs whose corners are rounded.

    allowed_m: how far the line may stay away from each corner after the first. An arc of radius R misses a corner that
    turns by a by R (1 / cos(a/2) - 1). Where even the least radius would miss it by more, the corner stays.
    """
    points: list[tuple[float, float, int]] = [(*corners[0], 0)]
    for k in range(1, len(corners)):
        corner = corners[k]
        if k == len(corners) - 1:
            _straight(points, corner, k - 1)
            break
        before, after = corners[k - 1], corners[k + 1]
        a_in = math.atan2(corner[1] - before[1], corner[0] - before[0])
        a_out = math.atan2(after[1] - corner[1], after[0] - corner[0])
        turn = math.remainder(a_out - a_in, 2 * math.pi)
        miss = 1.0 / math.cos(turn / 2) - 1.0 if abs(turn) < 3.0 else math.inf
        longest = 0.45 * min(math.dist(before, corner), math.dist(corner, after))
        radius_m = min(allowed_m[k - 1] / max(miss, 1e-9), longest / max(math.tan(abs(turn) / 2), 1e-9))
        if abs(turn) < 0.02 or radius_m < least_radius_m:
            _straight(points, corner, k - 1)
            continue
        tangent_m = radius_m * math.tan(abs(turn) / 2)
        start = (corner[0] - tangent_m * math.cos(a_in), corner[1] - tangent_m * math.sin(a_in))
        _straight(points, start, k - 1)
        side = math.copysign(1.0, turn)
        centre = (start[0] - side * radius_m * math.sin(a_in), start[1] + side * radius_m * math.cos(a_in))
        n = max(2, int(radius_m * abs(turn) / SPACING_M))
        for i in range(1, n + 1):
            a = a_in + turn * i / n
            point = (centre[0] + side * radius_m * math.sin(a), centre[1] - side * radius_m * math.cos(a))
            points.append((*point, k - 1 if i <= n // 2 else k))
    return points


def _straight(points: list[tuple[float, float, int]], end: Point, waypoint: int) -> None:
    x, y, _ = points[-1]
    length = math.dist((x, y), end)
    n = max(1, int(length / SPACING_M))
    if length > 1e-6:
        points += [(x + (end[0] - x) * i / n, y + (end[1] - y) * i / n, waypoint) for i in range(1, n + 1)]


def bend_radii(points: list[tuple[float, float, int]]) -> list[float]:
    """Give the radius of the line at each point."""
    out = [math.inf]
    for (ax, ay, _), (x, y, _), (bx, by, _) in zip(points, points[1:], points[2:], strict=False):
        turn = abs(math.remainder(math.atan2(by - y, bx - x) - math.atan2(y - ay, x - ax), 2 * math.pi))
        length_m = (math.dist((ax, ay), (x, y)) + math.dist((x, y), (bx, by))) / 2
        out.append(length_m / turn if turn > 1e-6 else math.inf)
    return [*out, math.inf]


def widened(radii_m: list[float], least_m: float) -> list[float]:
    """Spread each corner that is too sharp to follow over where the cart turns at full lock: before and behind it."""
    out = [max(radius_m, least_m) for radius_m in radii_m]
    for k, radius_m in enumerate(radii_m):
        if radius_m < least_m:
            for j in range(max(0, k - 7), min(len(out), k + 11)):
                out[j] = least_m
    return out


def stations(points: list[tuple[float, float, int]], speeds: list[float], accel_mps2: float) -> list[Station]:
    """Put lengths and speeds together; lower speeds to what braking to the next and gaining from the last allows."""
    lengths = [0.0]
    for (ax, ay, _), (bx, by, _) in pairwise(points):
        lengths.append(lengths[-1] + math.dist((ax, ay), (bx, by)))
    planned = [*speeds[:-1], 0.3]
    for k in range(len(points) - 2, -1, -1):
        step_m = lengths[k + 1] - lengths[k]
        planned[k] = min(planned[k], math.sqrt(planned[k + 1] ** 2 + 2.0 * accel_mps2 * step_m))
    for k in range(1, len(points)):  # from standstill it may gain as it likes: the cart itself is slow enough
        step_m = lengths[k] - lengths[k - 1]
        planned[k] = min(planned[k], math.sqrt(max(planned[k - 1], 1.5) ** 2 + 2.0 * accel_mps2 * step_m))
    return [Station(s, x, y, v, w) for s, (x, y, w), v in zip(lengths, points, planned, strict=True)]


def nearest(line: list[Station], at: int, here: Point) -> int:
    """Give the nearest station, looking a few metres ahead of the last one: progress never goes back."""
    best, best_m = at, math.inf
    for k in range(at, min(at + 12, len(line))):
        distance_m = math.hypot(line[k].x_m - here[0], line[k].y_m - here[1])
        if distance_m < best_m:
            best, best_m = k, distance_m
    return best


def on_leg(start: Point, end: Point, here: Point) -> tuple[float, float]:
    """Give (distance along, signed distance to the left of) the leg from start to end."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    length = math.hypot(dx, dy)
    px, py = here[0] - start[0], here[1] - start[1]
    return (px * dx + py * dy) / length, (dx * py - dy * px) / length
