"""The follower: geometry by hand, then in closed loop with a bicycle that obeys at once."""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import pytest

from autonomy.follow import SPACING_M, Follow, bend_radii, nearest, on_leg, rounded, stations
from autonomy.host import Host
from autonomy.wiring import Wire
from hal.signals import Course, DriveCommand, FollowState, LocalPlane, Pose, Site, wrap
from rtdb import Store

Point = tuple[float, float]
TICK_NS = 40_000_000
SITE = Site("field", math.radians(39.18), math.radians(-86.52), 200.0)
PLANE = LocalPlane.at(SITE.lat_rad, SITE.lon_rad)
WHEELBASE_M, LATERAL_MPS2 = Follow.params["wheelbase_m"].default, Follow.params["lateral_mps2"].default


# -- geometry ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("start", "end", "here", "along", "left"),
    [
        ((0, 0), (10, 0), (3, 2), 3, 2),
        ((0, 0), (10, 0), (3, -2), 3, -2),
        ((0, 0), (10, 0), (-4, 0), -4, 0),
        ((0, 0), (10, 0), (15, 1), 15, 1),
        ((1, 1), (1, 9), (0, 4), 3, 1),  # northward, west of it is left
        ((1, 9), (1, 1), (0, 4), 5, -1),
        ((0, 0), (3, 4), (3, 4), 5, 0),
    ],
)
def test_place_on_a_leg_is_distance_along_and_to_the_left(
    start: Point, end: Point, here: Point, along: float, left: float
) -> None:
    assert on_leg(start, end, here) == pytest.approx((along, left))


def test_place_on_a_leg_does_not_change_when_all_is_turned_and_moved() -> None:
    expected = on_leg((0, 0), (7, 0), (2, 1.5))
    for angle in (0.3, 1.9, -2.5):
        c, s = math.cos(angle), math.sin(angle)
        start, end, here = ((4 + x * c - y * s, -3 + x * s + y * c) for x, y in ((0, 0), (7, 0), (2, 1.5)))
        assert on_leg(start, end, here) == pytest.approx(expected)


def test_rounded_corner_misses_the_way_point_by_no_more_than_allowed() -> None:
    corners, allowed_m = [(0.0, 0.0), (30.0, 0.0), (30.0, 30.0), (0.0, 45.0)], [2.0, 1.8, 1.0]
    points = rounded(corners, allowed_m, 3.8)
    for corner, limit_m in zip(corners[1:3], allowed_m[:2], strict=True):
        missed_m = min(math.dist(corner, (x, y)) for x, y, _ in points)
        assert 0.5 * limit_m < missed_m <= limit_m + 0.1, "a polygon's corners lie on the arc, its sides inside"
    assert points[0] == (0.0, 0.0, 0)
    assert points[-1] == pytest.approx((0.0, 45.0, 2))
    assert min(bend_radii(points)) >= 3.8 * 0.98


def test_line_has_no_gaps_and_way_points_come_in_order() -> None:
    points = rounded([(0.0, 0.0), (30.0, 0.0), (30.0, 30.0), (0.0, 45.0)], [2.0, 1.8, 1.0], 3.8)
    assert all(math.dist(a[:2], b[:2]) < 2 * SPACING_M for a, b in pairwise(points))
    ahead = [waypoint for _, _, waypoint in points]
    assert ahead == sorted(ahead)
    assert set(ahead) == {0, 1, 2}


def test_corner_too_sharp_to_round_stays() -> None:
    """A way-point of 0.5 m cannot be rounded with 3.8 m: the line goes to it."""
    points = rounded([(0.0, 0.0), (30.0, 0.0), (0.0, 5.0)], [0.25, 0.25], 3.8)
    assert min(math.dist((30.0, 0.0), (x, y)) for x, y, _ in points) < 1e-9


def test_planned_speed_lets_the_cart_brake_in_time() -> None:
    points = rounded([(0.0, 0.0), (20.0, 0.0), (20.0, 20.0)], [1.5, 1.5], 3.8)
    radii = bend_radii(points)
    line = stations(points, [min(5.0, math.sqrt(1.2 * r)) for r in radii], 0.7)
    for a, b in pairwise(line):
        assert a.speed_mps**2 <= b.speed_mps**2 + 2 * 0.7 * (b.s_m - a.s_m) + 1e-9
    for station, radius_m in zip(line, radii, strict=True):
        assert station.speed_mps**2 / radius_m <= 1.2 + 1e-9
    assert line[-1].speed_mps < 0.5
    assert max(station.speed_mps for station in line) > 3.0, "it does not creep"


def test_progress_never_goes_back_and_does_not_jump_to_a_later_part_of_the_course() -> None:
    """There and back on the same street: the way back is as near as the way there."""
    points = rounded([(0.0, 0.0), (30.0, 0.0), (0.0, 0.0)], [1.5, 1.5], 3.8)
    line = stations(points, [2.0] * len(points), 0.7)
    at = 0
    for x_m in range(28):
        before, at = at, nearest(line, at, (float(x_m), 0.1))
        assert at >= before
        assert line[at].s_m == pytest.approx(x_m, abs=SPACING_M)
    assert nearest(line, at, (0.0, 0.0)) == at, "carried back: it stays where it was"


# -- in closed loop ---------------------------------------------------------------------------------------------------


@dataclass
class Step:
    """One step of a drive."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    drive: DriveCommand
    state: FollowState


def drive(
    points: list[Point], *, radius_m: float = 3.0, speed_mps: float = 3.0, start: tuple[float, float, float] = (0, 0, 0)
) -> list[Step]:
    """Drive a course from a pose until the follower says that it is finished, at most 120 s."""
    x_m, y_m, yaw_rad, speed = *start, 0.0
    geo = [PLANE.to_geo(x, y) for x, y in points]
    course = Course(
        tuple(lat for lat, _ in geo), tuple(lon for _, lon in geo), (radius_m,) * len(points), speed_mps=speed_mps
    )
    out: list[Step] = []
    with Store.create(tick_ns=TICK_NS) as store:
        mission, localise = store.join("mission"), store.join("localise")
        mission.insert("site", Site).write(SITE)
        mission.insert("course", Course).write(course)
        pose = localise.insert("pose", Pose)
        inputs = {"site": "mission/site", "course": "mission/course", "pose": "localise/pose"}
        host = Host(store, Wire("follow", "autonomy.follow:Follow", 1, 0, inputs), 0)
        host.connect()
        drives, states = store.find("follow/drive", DriveCommand), store.find("follow/state", FollowState)
        for _ in range(3000):
            pose.write(Pose(x_m, y_m, wrap(yaw_rad), speed))
            cycle = store.tick()
            host.step(cycle)
            assert host.fault == ""
            told, state = drives.visible(cycle), states.visible(cycle)
            if told is None or state is None:
                continue
            out.append(Step(x_m, y_m, yaw_rad, speed, told.value, state.value))
            if state.value.finished and speed == 0.0:
                break
            dt_s, wanted = TICK_NS * 1e-9, told.value.speed_mps
            speed = min(wanted, speed + 1.0 * dt_s) if wanted > speed else max(wanted, speed - 1.5 * dt_s)
            yaw_rad += speed * math.tan(told.value.steer_rad) / WHEELBASE_M * dt_s
            x_m, y_m = x_m + speed * math.cos(yaw_rad) * dt_s, y_m + speed * math.sin(yaw_rad) * dt_s
    return out


def missed(steps: list[Step], points: list[Point]) -> list[float]:
    """Give the smallest distance to each way-point."""
    return [min(math.dist(point, (s.x_m, s.y_m)) for s in steps) for point in points]


def test_cart_on_the_line_drives_straight_to_the_end_and_stops_there() -> None:
    steps = drive([(40.0, 0.0)])
    assert max(abs(s.y_m) for s in steps) < 1e-3
    assert max(abs(s.drive.steer_rad) for s in steps) < 1e-3
    assert steps[-1].state.finished
    assert steps[-1].drive.speed_mps == 0.0
    assert steps[-1].x_m == pytest.approx(40.0, abs=1.0)
    assert max(s.speed_mps for s in steps) == pytest.approx(3.0)


@pytest.mark.parametrize("yaw_deg", [25.0, -25.0])
def test_cart_that_starts_askew_finds_back_to_the_line(yaw_deg: float) -> None:
    steps = drive([(60.0, 0.0)], start=(0.0, 0.0, math.radians(yaw_deg)))
    assert max(abs(s.y_m) for s in steps) > 0.2
    late = [s for s in steps if s.x_m > 30.0]
    assert max(abs(s.y_m) for s in late) < 0.05
    assert max(abs(s.state.lateral_error_m) for s in late) < 0.05


def test_lateral_error_is_positive_to_the_left() -> None:
    steps = drive([(60.0, 0.0)], start=(0.0, 0.0, 0.4))
    off = max(steps, key=lambda s: abs(s.y_m))
    assert off.y_m > 0
    assert off.state.lateral_error_m == pytest.approx(off.y_m, abs=0.05)


@pytest.mark.parametrize("turn_deg", [45.0, 90.0, 120.0, -90.0])
def test_corner_is_passed_within_its_radius_and_with_comfort(turn_deg: float) -> None:
    turn = math.radians(turn_deg)
    points = [(30.0, 0.0), (30.0 + 30.0 * math.cos(turn), 30.0 * math.sin(turn))]
    steps = drive(points, radius_m=3.0)
    assert steps[-1].state.finished
    assert all(m < 3.0 for m in missed(steps, points))
    lateral = [s.speed_mps**2 * abs(math.tan(s.drive.steer_rad)) / WHEELBASE_M for s in steps]
    assert max(lateral) < 1.25 * LATERAL_MPS2
    assert max(abs(s.drive.steer_rad) for s in steps) <= Follow.params["max_steer_rad"].default
    assert max(lateral) > 0.3, "there was a corner"


def test_square_is_driven_once_round_with_the_way_points_in_order() -> None:
    points = [(30.0, 0.0), (30.0, 30.0), (0.0, 30.0), (0.0, 0.0)]
    steps = drive(points)
    assert all(m < 3.0 for m in missed(steps, points))
    order = [s.state.waypoint for s in steps]
    assert order == sorted(order)
    assert set(order) == {0, 1, 2, 3}
    assert not steps[0].state.finished, "the end of the course is near its beginning, and yet it is not finished"


def test_cart_turns_round_when_the_way_point_is_behind_it() -> None:
    steps = drive([(-25.0, 0.0)], start=(0.0, 0.0, 0.1))
    assert steps[-1].state.finished
    assert math.dist((-25.0, 0.0), (steps[-1].x_m, steps[-1].y_m)) < 1.5


def test_speed_of_the_course_is_never_exceeded() -> None:
    for speed_mps in (1.0, 2.5):
        steps = drive([(20.0, 0.0), (20.0, 20.0)], speed_mps=speed_mps)
        assert max(s.drive.speed_mps for s in steps) == pytest.approx(speed_mps, abs=1e-6)


def test_follower_does_the_same_in_two_runs() -> None:
    def told() -> list[Any]:
        return [(s.drive, s.state) for s in drive([(15.0, 0.0), (15.0, 15.0)])]

    assert told() == told()


def test_follower_stands_while_its_course_is_empty_and_drives_a_new_one_from_where_the_cart_is() -> None:
    geo = [PLANE.to_geo(x, y) for x, y in ((40.0, 0.0), (10.0, 30.0))]
    courses = [Course((), (), (), 2.0), *(Course((lat,), (lon,), (3.0,), 2.0) for lat, lon in geo)]
    with Store.create(tick_ns=TICK_NS) as store:
        store.join("mission").insert("site", Site).write(SITE)
        route, pose = store.join("plan").insert("route", Course), store.join("localise").insert("pose", Pose)
        inputs = {"site": "mission/site", "course": "plan/route", "pose": "localise/pose"}
        host = Host(store, Wire("follow", "autonomy.follow:Follow", 1, 0, inputs), 0)
        host.connect()
        drives = store.find("follow/drive", DriveCommand)
        told = []
        for course in courses:
            for _ in range(3):  # the same again changes nothing
                route.write(course)
                pose.write(Pose(10.0, 0.0, 0.0, 1.0))
                host.step(store.tick())
            store.tick()
            shown = drives.visible(store.cycle)
            assert shown is not None
            told.append(shown.value)
    assert host.fault == ""
    assert [drive.speed_mps > 0.0 for drive in told] == [False, True, True]
    assert [round(drive.steer_rad, 2) for drive in told] == [0.0, 0.0, pytest.approx(0.46)]
