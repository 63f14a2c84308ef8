"""Hidden courses: way-points drawn from a seed, among the obstacles of a site, with room to drive.

As in the P545 field trials there is a published course and one that nobody has seen. Legs keep clear of obstacles and
of the boundary; corners keep more, because a cart swings out. At least one corner turns by more than 90 degrees.
"""

import math

import numpy as np

from sim.site import Obstacle, Site

LEG_M = (14.0, 34.0)
SHARP_RAD = math.radians(95.0)
LARGEST_TURN_RAD = math.radians(135.0)
LEG_CLEAR_M = 3.5
CORNER_CLEAR_M = 6.5
BOUNDARY_CLEAR_M = 7.0
TRIES = 400
Point = tuple[float, float]


class CourseImpossible(ValueError):
    """No course fits: the site is too full, or too small."""


def hidden_course(site: Site, start: Point, yaw_rad: float, count: int, rng: np.random.Generator) -> list[Point]:
    """Draw `count` way-points that follow a start; CourseImpossible if none is found in a bounded number of tries."""
    for _ in range(TRIES):
        points = _draw(site, start, yaw_rad, count, rng)
        if points is not None:
            return points
    raise CourseImpossible(
        f"no course of {count} way-points fits into site {site.name} from ({start[0]:.0f}, {start[1]:.0f}) m"
    )


def _draw(site: Site, start: Point, yaw_rad: float, count: int, rng: np.random.Generator) -> list[Point] | None:
    points, here, heading, sharpest = [], start, yaw_rad, 0.0
    for k in range(count):
        for _ in range(12):
            turn = float(rng.uniform(-1.0, 1.0)) * (LARGEST_TURN_RAD if k else math.radians(45.0))
            length = float(rng.uniform(*LEG_M))
            there = (here[0] + length * math.cos(heading + turn), here[1] + length * math.sin(heading + turn))
            if _clear(site, here, there):
                break
        else:
            return None
        points.append(there)
        here, heading = there, heading + turn
        if k:
            sharpest = max(sharpest, abs(turn))
    return points if sharpest > SHARP_RAD else None


def _clear(site: Site, a: Point, b: Point) -> bool:
    if site.boundary_m:
        xs, ys = [x for x, _ in site.boundary_m], [y for _, y in site.boundary_m]
        if not (
            min(xs) + BOUNDARY_CLEAR_M <= b[0] <= max(xs) - BOUNDARY_CLEAR_M
            and min(ys) + BOUNDARY_CLEAR_M <= b[1] <= max(ys) - BOUNDARY_CLEAR_M
        ):
            return False
    return all(
        segment_to_box(a, b, box) > LEG_CLEAR_M and segment_to_box(b, b, box) > CORNER_CLEAR_M
        for box in site.all_obstacles()
    )


def segment_to_box(a: Point, b: Point, box: Obstacle) -> float:
    """Give the distance from a segment to an obstacle's outline, sampled every half metre along the segment."""
    n = max(1, int(math.dist(a, b) / 0.5))
    return min(_to_box((a[0] + i / n * (b[0] - a[0]), a[1] + i / n * (b[1] - a[1])), box) for i in range(n + 1))


def _to_box(p: Point, box: Obstacle) -> float:
    length, width, _ = box.size_m
    yaw = math.radians(box.yaw_deg)
    dx, dy = p[0] - box.east_m, p[1] - box.north_m
    along = abs(dx * math.cos(yaw) + dy * math.sin(yaw)) - length / 2
    across = abs(dy * math.cos(yaw) - dx * math.sin(yaw)) - width / 2
    return math.hypot(max(along, 0.0), max(across, 0.0))
