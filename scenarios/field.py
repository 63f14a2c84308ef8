"""Fields of boxes, drawn from a seed: with gaps that a cart fits through, and always with a way to the finish."""

import math
from itertools import product

import numpy as np

from autonomy.plan import Target, find_route, grid_of
from sim.site import Obstacle, Site, scene_of

from .course import CourseImpossible, segment_to_box
from .scenario import FieldSetup, ObstacleSetup

START_CLEAR_M = 7.0  # a cart that stands needs room ahead before it can turn
WAYPOINT_CLEAR_M = 4.0
GROWN_M, CELL_M = 1.5, 0.5  # half the cart's width and 0.9 m, on a coarse grid: what is found here can be driven
TRIES = 50
Point = tuple[float, float]


def draw_field(
    field: FieldSetup, site: Site, start: Point, waypoints: list[Target], rng: np.random.Generator
) -> tuple[ObstacleSetup, ...]:
    """Draw the boxes among what stands there; CourseImpossible if none are found in a bounded number of tries."""
    for _ in range(TRIES):
        boxes = _draw(field, site, start, waypoints, rng)
        if boxes is not None and _solvable(site, boxes, start, waypoints):
            return boxes
    raise CourseImpossible(
        f"no field of {field.count} boxes with gaps of {field.min_gap_m:g} m and a way through fits into "
        f"east {field.east_m[0]:g} to {field.east_m[1]:g} m, north {field.north_m[0]:g} to {field.north_m[1]:g} m"
    )


def _draw(
    field: FieldSetup, site: Site, start: Point, waypoints: list[Target], rng: np.random.Generator
) -> tuple[ObstacleSetup, ...] | None:
    keep = [(start, START_CLEAR_M), *((t[:2], max(WAYPOINT_CLEAR_M, t.radius_m)) for t in waypoints)]
    there, boxes = list(site.all_obstacles()), list[ObstacleSetup]()
    while len(boxes) < field.count:
        for _ in range(60):
            length_m, width_m = rng.uniform(*field.size_m, 2).tolist()
            box = ObstacleSetup(
                kind="box",
                east_m=float(rng.uniform(*field.east_m)),
                north_m=float(rng.uniform(*field.north_m)),
                yaw_deg=float(rng.uniform(0.0, 180.0)),
                length_m=length_m,
                width_m=width_m,
                surveyed=len(boxes) >= field.unsurveyed,
            )
            if all(segment_to_box(p, p, box) > clear_m for p, clear_m in keep) and all(
                gap_m(box, other) > field.min_gap_m for other in there
            ):
                break
        else:
            return None
        boxes.append(box)
        there.append(box)
    return tuple(boxes)


def _solvable(site: Site, boxes: tuple[ObstacleSetup, ...], start: Point, waypoints: list[Target]) -> bool:
    scene = scene_of(site.model_copy(update={"obstacles": (*site.obstacles, *boxes)}))
    grid = grid_of(scene, [start, *(t[:2] for t in waypoints)], GROWN_M, CELL_M)
    return find_route(grid, start, waypoints, CELL_M)[1] == ""


def gap_m(a: Obstacle, b: Obstacle) -> float:
    """Give the distance between two boxes that do not overlap: from a corner of one to the other."""
    return min(segment_to_box(p, p, box) for box, other in ((a, b), (b, a)) for p in _corners(other))


def _corners(box: Obstacle) -> list[Point]:
    length_m, width_m, _ = box.size_m
    c, s = math.cos(math.radians(box.yaw_deg)), math.sin(math.radians(box.yaw_deg))
    return [
        (
            box.east_m + i * length_m / 2 * c - j * width_m / 2 * s,
            box.north_m + i * length_m / 2 * s + j * width_m / 2 * c,
        )
        for i, j in product((-1, 1), (-1, 1))
    ]
