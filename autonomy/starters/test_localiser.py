"""What must be true of the module, as sentences. `pytest test_localiser.py` checks them."""

import math

import pytest

from autonomy.starters.localiser import Localiser
from autonomy.trial import trial
from hal.signals import Course, GpsFix, LocalPlane, Odometry, Site

SITE = Site("field", math.radians(39.0), math.radians(-86.0), 200.0)
COURSE = Course(start_lat_rad=SITE.lat_rad, start_lon_rad=SITE.lon_rad)


def test_both_wheels_by_a_metre_are_a_metre_straight_on() -> None:
    mine = Localiser()
    trial(mine, site=SITE, course=COURSE, odometry=Odometry())
    pose = trial(mine, t_s=0.04, site=SITE, course=COURSE, odometry=Odometry(left_m=1.0, right_m=1.0))["pose"]
    assert (pose.x_m, pose.y_m, pose.yaw_rad) == pytest.approx((1.0, 0.0, 0.0))


def test_it_turns_left_when_the_right_wheel_travels_further() -> None:
    mine = Localiser()
    trial(mine, site=SITE, course=COURSE, odometry=Odometry())
    pose = trial(mine, t_s=0.04, site=SITE, course=COURSE, odometry=Odometry(right_m=0.09))["pose"]
    assert pose.yaw_rad == pytest.approx(0.1)


def test_a_fix_in_the_east_draws_it_east() -> None:
    lat_rad, lon_rad = LocalPlane.at(SITE.lat_rad, SITE.lon_rad).to_geo(10.0, 0.0)
    fix = GpsFix(mode=3, lat_rad=lat_rad, lon_rad=lon_rad)
    pose = trial(Localiser(), site=SITE, course=COURSE, odometry=Odometry(), gps=fix)["pose"]
    assert 0.1 < pose.x_m < 5.0
