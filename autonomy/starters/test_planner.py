"""What must be true of the module, as sentences. `pytest test_planner.py` checks them."""

import math

from autonomy.starters.planner import Planner
from autonomy.trial import trial
from hal.signals import Course, LocalPlane, Pose, Scene, Site

SITE = Site("field", math.radians(39.0), math.radians(-86.0), 200.0)
PLANE = LocalPlane.at(SITE.lat_rad, SITE.lon_rad)
TO_THE_EAST = Course((SITE.lat_rad,), (PLANE.to_geo(30.0, 0.0)[1],), (3.0,), 2.0)


def box_at(x_m: float, y_m: float) -> Scene:
    """Make a map with one box of a metre."""
    return Scene((0,), (x_m,), (y_m,), (0.5,), (0.0,), (1.0,), (1.0,), (1.0,))


def test_route_is_the_course_where_nothing_is_on_the_map() -> None:
    route = trial(Planner(), dt_s=1.0, site=SITE, course=TO_THE_EAST, pose=Pose())["route"]
    assert len(route.lat_rad) == 1


def test_route_passes_a_box_on_the_far_side() -> None:
    for y_m in (0.5, -0.5):
        there = box_at(15.0, y_m)
        route = trial(Planner(), dt_s=1.0, site=SITE, course=TO_THE_EAST, pose=Pose(), map=there)["route"]
        x_m, there_m = PLANE.to_map(route.lat_rad[0], route.lon_rad[0])
        assert len(route.lat_rad) == 2
        assert abs(x_m - 15.0) < 0.1
        assert there_m * y_m < 0.0
        assert abs(there_m - y_m) > 2.0


def test_box_beside_the_way_changes_nothing() -> None:
    route = trial(Planner(), dt_s=1.0, site=SITE, course=TO_THE_EAST, pose=Pose(), map=box_at(15.0, 9.0))["route"]
    assert len(route.lat_rad) == 1
