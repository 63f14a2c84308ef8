"""What must be true of the module, as sentences. `pytest test_driver.py` checks them."""

import math

from autonomy.starters.driver import Driver
from autonomy.trial import trial
from hal.signals import Course, LocalPlane, Odometry, Site

SITE = Site("field", math.radians(39.0), math.radians(-86.0), 200.0)


def course_to(x_m: float, y_m: float) -> Course:
    """Make a course of one way-point, by metres east and north; the cart starts at the origin and looks east."""
    lat_rad, lon_rad = LocalPlane.at(SITE.lat_rad, SITE.lon_rad).to_geo(x_m, y_m)
    return Course((lat_rad,), (lon_rad,), (3.0,), 3.0, start_lat_rad=SITE.lat_rad, start_lon_rad=SITE.lon_rad)


def test_it_steers_to_the_side_where_the_way_point_is() -> None:
    """Left is positive."""
    for y_m, side in ((10.0, 1.0), (-10.0, -1.0)):
        drive = trial(Driver(), dt_s=0.1, site=SITE, course=course_to(20.0, y_m), odometry=Odometry())["drive"]
        assert drive.steer_rad * side > 0.1


def test_it_stops_when_its_wheels_have_brought_it_to_the_last_way_point() -> None:
    mine, course = Driver(), course_to(20.0, 0.0)
    outputs = trial(mine, dt_s=0.1, site=SITE, course=course, odometry=Odometry())
    assert outputs["drive"].speed_mps == 3.0
    outputs = trial(mine, t_s=0.1, dt_s=0.1, site=SITE, course=course, odometry=Odometry(left_m=19.0, right_m=19.0))
    assert outputs["drive"].speed_mps == 0.0
    assert outputs["state"].finished
