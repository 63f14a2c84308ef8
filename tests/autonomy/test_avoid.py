"""The avoider: free ways against a body that is moved step by step, sectors and their cost, and whole steps."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autonomy.avoid import (
    ANGLES,
    HALF_WIDTH_M,
    NOSE_M,
    SECTORS,
    STEP_RAD,
    WHEELBASE_M,
    Avoid,
    binary,
    choose,
    free_way,
    sector,
)
from hal.signals import STOP, DriveCommand, Odometry, Scan
from rtdb import Sample

RAYS, REACH_M = 61, 4.0
MARGIN_M = Avoid.params["margin_m"].default
angles = st.sampled_from(ANGLES)
masks = st.lists(st.booleans(), min_size=SECTORS, max_size=SECTORS)


# -- the free way of a sector -----------------------------------------------------------------------------------------


def driven(point, steer_rad, look_m):
    """The second opinion: drive the body along the circle, a centimetre at a time, until the point is in it."""
    curvature, half_m = math.tan(steer_rad) / WHEELBASE_M, HALF_WIDTH_M + MARGIN_M
    for k in range(int(look_m / 0.01)):
        s = 0.01 * k
        x, y = (math.sin(curvature * s) / curvature, (1 - math.cos(curvature * s)) / curvature) if curvature else (s, 0)
        dx, dy, c, n = point[0] - x, point[1] - y, math.cos(curvature * s), math.sin(curvature * s)
        if 0.0 <= dx * c + dy * n <= NOSE_M and abs(dy * c - dx * n) <= half_m:
            return s
    return look_m


@given(st.tuples(st.floats(NOSE_M + 0.02, 6.0), st.floats(-4.0, 4.0)), angles)
@settings(max_examples=300, deadline=None)
def test_free_way_is_what_the_body_can_drive_before_the_point_is_in_it(point, steer_rad):
    exact, stepped = free_way([point], steer_rad, MARGIN_M, 4.0), driven(point, steer_rad, 4.0)
    grazed = driven((point[0], point[1] + 0.02), steer_rad, 4.0), driven((point[0], point[1] - 0.02), steer_rad, 4.0)
    assert exact == pytest.approx(stepped, abs=0.03) or min(grazed) - 0.03 <= exact <= max(grazed) + 0.03


def test_what_stands_beside_the_body_does_not_stop_it_but_it_may_not_turn_there():
    post = [(1.0, 0.75)]
    assert free_way(post, 0.0, MARGIN_M, 4.0) == 4.0
    assert free_way(post, -0.3, MARGIN_M, 4.0) == 4.0
    assert free_way(post, 0.3, MARGIN_M, 4.0) < 0.5


# -- sectors ----------------------------------------------------------------------------------------------------------


def test_between_the_thresholds_a_sector_stays_what_it_was():
    assert binary([1.0, 2.5, 2.5, 4.0], [True, True, False, False], 2.0, 3.0) == [False, True, False, True]


@given(masks, angles, angles, angles)
def test_a_blocked_sector_is_never_chosen_and_a_free_one_is_if_there_is_any(free, wanted, wheels, last):
    k = choose(free, wanted, wheels, last)
    assert k is None if not any(free) else free[k]


@given(masks, angles, angles, angles)
def test_the_wanted_sector_is_chosen_whenever_it_is_free(free, wanted, wheels, last):
    free[sector(wanted)] = True
    assert choose(free, wanted, wheels, last) == sector(wanted)


def test_of_two_ways_around_the_one_begun_is_kept():
    free = [abs(angle) > 0.2 for angle in ANGLES]
    left, right = (ANGLES[choose(free, 0.0, 0.0, last)] for last in (0.15, -0.15))
    assert left == pytest.approx(-right)
    assert left > 0.2


# -- whole steps ------------------------------------------------------------------------------------------------------


def scan_of(*hits):
    """Rays over 120 degrees; hits: (angle_rad, range_m) put on the nearest ray."""
    first, step = -math.pi / 3, 2 * math.pi / 3 / (RAYS - 1)
    ranges = [REACH_M] * RAYS
    for angle, range_m in hits:
        ranges[round((angle - first) / step)] = range_m
    return Scan(first, step, REACH_M, 2.0, tuple(ranges))


def wall(ahead_m, from_m, to_m):
    """Hits on a wall across, some way ahead of the scanner, from left to left."""
    all_angles = [-math.pi / 3 + k * 2 * math.pi / 3 / (RAYS - 1) for k in range(RAYS)]
    return [
        (a, ahead_m / math.cos(a))
        for a in all_angles
        if from_m <= ahead_m * math.tan(a) <= to_m and ahead_m / math.cos(a) < REACH_M
    ]


class Rig:
    """Steps one avoider by hand."""

    def __init__(self):
        self.avoid, self.writes = Avoid(), 0
        self.avoid.dt_s, self.avoid.t_ns = 0.04, 0
        self.avoid.reset()

    def step(self, *hits, speed_mps=1.5, steer_rad=0.0, ahead_m=0.0, scan=True):
        self.writes += 1
        self.avoid.t_ns += 40_000_000
        inputs = {
            "drive_in": DriveCommand(speed_mps, steer_rad, 1.0),
            "odometry": Odometry(ahead_m, ahead_m, speed_mps, True),
            "scan": scan_of(*hits) if scan else None,
            "wheels": None,
        }
        self.avoid.__dict__.update(inputs)
        self.avoid.samples = {n: Sample(v, self.writes, 0, 0, ()) for n, v in inputs.items() if v is not None}
        self.avoid._out.clear()
        self.avoid.step()
        return self.avoid._out[Avoid.outputs["drive"]], self.avoid._out[Avoid.outputs["state"]]


def test_where_nothing_is_in_the_way_the_command_passes_as_it_is():
    drive, state = Rig().step(steer_rad=0.1234)
    assert drive == DriveCommand(1.5, 0.1234, 1.0)
    assert (state.turned, state.stuck) == (False, False)


def test_a_wall_on_the_right_half_of_the_way_is_passed_on_the_left():
    drive, state = Rig().step(*wall(2.5, -3.0, 0.3))
    assert state.turned
    assert drive.steer_rad > 0.1
    assert 0.0 < drive.speed_mps <= 1.5


@given(st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(0.1, 3.9)), max_size=12), st.floats(-0.46, 0.46))
@settings(max_examples=150, deadline=None)
def test_the_cart_is_never_steered_into_a_blocked_sector(hits, steer_rad):
    drive, state = Rig().step(*hits, steer_rad=steer_rad)
    free_m = state.free_m[sector(drive.steer_rad)]
    assert drive.speed_mps == 0.0 or free_m > 0.4 * Avoid.params["blocked_m"].default
    assert drive.speed_mps**2 <= 2.0 * 1.0 * max(free_m - 0.8, 0.0) + 1e-9, "and it could stop"


def test_where_nothing_is_free_it_stands():
    drive, state = Rig().step(*wall(0.8, -9.0, 9.0))
    assert (drive.speed_mps, state.stuck) == (0.0, True)


def test_it_slows_down_with_the_free_distance():
    speeds = [Rig().step(*wall(m, -9.0, 9.0), speed_mps=3.0)[0].speed_mps for m in (3.5, 3.0, 2.5, 2.0, 1.5)]
    assert speeds == sorted(speeds, reverse=True)
    assert speeds[0] > speeds[-1] > 0.0


def test_what_went_out_of_sight_is_remembered_beside_the_cart():
    rig = Rig()
    rig.step((0.5, 1.6))  # 1.4 m ahead of the scanner, 0.77 m to the left
    drive, state = rig.step(steer_rad=0.4, ahead_m=2.6)
    assert state.turned, "the post is beside the cart now, where the scanner does not see it"
    assert drive.steer_rad < 0.2


def test_what_is_seen_to_be_gone_is_forgotten():
    rig = Rig()
    assert rig.step((0.0, 1.5))[1].turned
    assert not rig.step()[1].turned


def test_a_scanner_that_falls_silent_stops_the_cart_and_one_that_never_was_does_not():
    rig = Rig()
    assert rig.step(scan=False)[0].speed_mps == 1.5
    rig.step()
    assert rig.step(scan=False)[0] == STOP


def test_sectors_are_even_and_symmetric():
    assert pytest.approx(0.0) == ANGLES[SECTORS // 2]
    assert ANGLES[-1] == pytest.approx(-ANGLES[0]) == pytest.approx(15 * STEP_RAD)
