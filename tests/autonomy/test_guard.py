"""The guard, step by step: obstacles in its corridor, uncertain pose, far from the course."""

import math

import pytest

from autonomy.guard import Guard, along_arc
from hal.signals import Course, DriveCommand, GuardState, Hold, LocalPlane, Pose, Scan, Site
from rtdb import Sample

RAYS = 61
PLANE = LocalPlane.at(math.radians(39.0), math.radians(-86.0))


def scan(*hits):
    """Rays over 120 degrees, 6 m; hits: (angle_rad, range_m) put on the nearest ray."""
    first, step = -math.pi / 3, 2 * math.pi / 3 / (RAYS - 1)
    ranges = [6.0] * RAYS
    for angle, range_m in hits:
        ranges[round((angle - first) / step)] = range_m
    return Scan(first, step, 6.0, 2.0, tuple(ranges))


class Rig:
    """Steps one guard by hand."""

    def __init__(self):
        self.guard = Guard()
        self.guard.dt_s = 0.04
        self.guard.reset()

    def step(self, speed_mps=3.0, steer_rad=0.0, pose=None, scan=None, site=None, course=None):
        inputs = {"drive_in": DriveCommand(speed_mps, steer_rad), "pose": pose or Pose(sigma_m=0.3), "scan": scan,
                  "site": site, "course": course}  # fmt: skip
        self.guard.__dict__.update(inputs)
        self.guard.samples = {name: Sample(v, 1, 0, 0, ()) for name, v in inputs.items() if v is not None}
        self.guard._out.clear()
        self.guard.step()
        out = {type(v): v for v in self.guard._out.values()}
        return out[DriveCommand], out[GuardState].hold


def test_free_way_passes_the_command_as_it_is():
    drive, hold = Rig().step(scan=scan())
    assert (drive, hold) == (DriveCommand(3.0, 0.0), Hold.NONE)


def test_obstacle_ahead_stops_the_cart_and_holds_until_the_way_was_free_for_a_second():
    rig = Rig()
    assert rig.step(scan=scan((0.0, 0.8))) == (DriveCommand(0.0, 0.0, 1.5), Hold.OBSTACLE)
    holds = [rig.step(scan=scan())[1] for _ in range(30)]
    assert holds[:24] == [Hold.OBSTACLE] * 24
    assert holds[-1] is Hold.NONE


def test_distant_obstacle_cuts_the_speed_to_what_the_free_distance_allows():
    drive, hold = Rig().step(scan=scan((0.0, 3.0)))
    assert hold is Hold.NONE
    assert drive.speed_mps == pytest.approx(math.sqrt(2 * 1.2 * (3.0 - 1.0)))


def test_obstacle_beside_the_corridor_is_passed():
    assert Rig().step(scan=scan((0.7, 2.0)))[1] is Hold.NONE


def test_corridor_bends_with_the_steering():
    straight, bent = Rig().step(scan=scan((0.7, 1.6)))[0], Rig().step(steer_rad=0.4, scan=scan((0.7, 1.6)))[0]
    assert straight.speed_mps == 3.0
    assert bent.speed_mps < 3.0


def test_uncertain_pose_holds_the_cart():
    assert Rig().step(pose=Pose(sigma_m=1.6))[1] is Hold.UNCERTAIN
    assert Rig().step(pose=Pose(sigma_m=0.3, fix_age_s=9.0))[1] is Hold.UNCERTAIN


def test_cart_far_from_its_course_is_held():
    site = Site("t", PLANE.lat_rad, PLANE.lon_rad, 0.0)
    points = [PLANE.to_geo(x, 0.0) for x in (20.0, 60.0)]
    course = Course(tuple(p[0] for p in points), tuple(p[1] for p in points), (3.0, 3.0), 3.0,
                    PLANE.lat_rad, PLANE.lon_rad, 0.2)  # fmt: skip
    assert Rig().step(pose=Pose(x_m=30.0, y_m=7.0, sigma_m=0.3), site=site, course=course)[1] is Hold.NONE
    assert Rig().step(pose=Pose(x_m=30.0, y_m=9.0, sigma_m=0.3), site=site, course=course)[1] is Hold.OUTSIDE


@pytest.mark.parametrize("curvature", [-0.25, -0.01, 0.01, 0.25])
def test_points_on_the_arc_lie_beside_it_by_nothing(curvature):
    for s in (0.5, 2.0, 4.0):
        x, y = math.sin(curvature * s) / curvature, (1.0 - math.cos(curvature * s)) / curvature
        assert along_arc(x, y, curvature) == pytest.approx((s, 0.0), abs=1e-9)
