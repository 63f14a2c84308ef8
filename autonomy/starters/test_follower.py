"""What must be true of the module, as sentences. `pytest test_follower.py` checks them."""

import math

from autonomy.starters.follower import Follower
from autonomy.trial import trial
from hal.signals import Course, LocalPlane, Pose, Site

SITE = Site("field", math.radians(39.0), math.radians(-86.0), 200.0)


def course_to(x_m: float, y_m: float) -> Course:
    """Make a course of one way-point, by metres east and north."""
    lat_rad, lon_rad = LocalPlane.at(SITE.lat_rad, SITE.lon_rad).to_geo(x_m, y_m)
    return Course(lat_rad=(lat_rad,), lon_rad=(lon_rad,), radius_m=(3.0,), speed_mps=3.0)


def test_it_steers_to_the_side_where_the_way_point_is() -> None:
    """Left is positive."""
    for y_m, side in ((10.0, 1.0), (-10.0, -1.0)):
        drive = trial(Follower(), site=SITE, course=course_to(20.0, y_m), pose=Pose())["drive"]
        assert drive.steer_rad * side > 0.1


def test_it_drives_as_fast_as_the_course_wants_when_the_way_point_is_straight_ahead() -> None:
    drive = trial(Follower(), site=SITE, course=course_to(50.0, 0.0), pose=Pose())["drive"]
    assert drive.speed_mps == 3.0


def test_it_stops_at_the_last_way_point() -> None:
    outputs = trial(Follower(), site=SITE, course=course_to(20.0, 0.0), pose=Pose(x_m=19.5))
    assert outputs["drive"].speed_mps == 0.0
    assert outputs["state"].finished
