"""Obstacles of a scenario: fields that are seeded, with room and a way through; the map; and the gate."""

import math
from collections import deque

import pytest

from autonomy.plan import Target
from autonomy.wiring import load_stack
from hal.signals import AvoidState, Course, GuardState, Hold, PlanState, Scene
from rtdb.recording import Recording
from scenarios.course import CourseImpossible, segment_to_box
from scenarios.field import START_CLEAR_M, WAYPOINT_CLEAR_M, draw_field, gap_m
from scenarios.judge import Verdict, judge
from scenarios.plan import course_record, furnished, map_record, obstacles, rng_of
from scenarios.run import Drive, DriveError, Setup, drive
from scenarios.scenario import STACKS, FieldSetup, ObstacleSetup, Scenario, load_scenario
from sim.site import Obstacle

FIELD, GATE = load_scenario("obstacles/field"), load_scenario("obstacles/gate")
SITE = FIELD.load_site()
FINISH = (FIELD.course.waypoints[-1].east_m, FIELD.course.waypoints[-1].north_m)


def drawn(seed, scenario=FIELD):
    site = scenario.load_site()
    return obstacles(scenario, site, course_record(scenario, site, rng_of(seed)), rng_of(seed))


# -- fields -----------------------------------------------------------------------------------------------------------


def test_a_field_is_that_of_its_seed():
    assert drawn(3) == drawn(3)
    assert len({drawn(seed) for seed in range(10)}) == 10


@pytest.mark.parametrize("seed", range(8))
def test_boxes_are_as_many_as_wanted_in_their_rectangle_and_apart(seed):
    boxes, field = drawn(seed), FIELD.field
    assert len(boxes) == field.count
    assert sum(not box.surveyed for box in boxes) == field.unsurveyed
    for k, box in enumerate(boxes):
        assert field.east_m[0] <= box.east_m <= field.east_m[1]
        assert field.north_m[0] <= box.north_m <= field.north_m[1]
        assert segment_to_box((0.0, 0.0), (0.0, 0.0), box) > START_CLEAR_M
        assert segment_to_box(FINISH, FINISH, box) > WAYPOINT_CLEAR_M
        for other in boxes[:k]:
            assert gap_m(box, other) > field.min_gap_m


def test_the_gap_between_boxes_is_that_of_their_nearest_corner_and_side():
    here = Obstacle(kind="box", east_m=0, north_m=0, length_m=2, width_m=2)
    assert gap_m(here, Obstacle(kind="box", east_m=5, north_m=0.5, length_m=2, width_m=1)) == pytest.approx(3.0)
    turned = Obstacle(kind="box", east_m=5, north_m=0, yaw_deg=45, length_m=2, width_m=2)
    assert gap_m(here, turned) == pytest.approx(4.0 - math.sqrt(2))


@pytest.mark.parametrize("seed", range(8))
def test_a_cart_gets_through_by_a_flood_of_its_own(seed):
    """The second opinion: points 0.4 m apart, four neighbours, 1.2 m from every box, flooded from the start."""
    boxes, n = drawn(seed), 0.4

    def free(cell):
        p = (cell[0] * n, cell[1] * n)
        return -10 < p[0] < 80 and -20 < p[1] < 20 and all(segment_to_box(p, p, box) > 1.2 for box in boxes)

    goal, seen, queue = (round(FINISH[0] / n), round(FINISH[1] / n)), {(0, 0)}, deque([(0, 0)])
    while queue and goal not in seen:
        x, y = queue.popleft()
        for cell in ((x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)):
            if cell not in seen and free(cell):
                seen.add(cell)
                queue.append(cell)
    assert goal in seen


def test_a_field_that_does_not_fit_makes_the_drive_invalid(monkeypatch):
    monkeypatch.setattr("scenarios.field.TRIES", 3)
    full = FIELD.field.model_copy(update={"count": 48, "north_m": (-3.0, 3.0)})
    with pytest.raises(DriveError, match=r"no field of 48 boxes with gaps of 3\.5 m") as error:
        Drive(Setup(scenario=FIELD.model_copy(update={"field": full})))
    assert error.value.invalid


def test_a_field_without_a_way_to_the_finish_is_drawn_again_and_then_refused(monkeypatch):
    monkeypatch.setattr("scenarios.field.TRIES", 2)
    ring = [(70, 8, 0), (70, -8, 0), (78, 0, 90), (62, 0, 90)]
    walls = tuple(Obstacle(kind="wall", east_m=x, north_m=y, yaw_deg=yaw, length_m=17) for x, y, yaw in ring)
    site = SITE.model_copy(update={"obstacles": walls})
    field = FieldSetup(count=2, east_m=(10, 50), north_m=(-5, 5))
    assert len(draw_field(field, SITE, (0.0, 0.0), [Target(70.0, 0.0, 3.0)], rng_of(0)("field"))) == 2
    with pytest.raises(CourseImpossible, match="a way through"):
        draw_field(field, site, (0.0, 0.0), [Target(70.0, 0.0, 3.0)], rng_of(0)("field"))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"unsurveyed": 5}, "unsurveyed is at most count, 3"),
        ({"north_m": (4.0, -4.0)}, "north_m is .from, to., got 4 before -4"),
        ({"size_m": (0.0, 1.0)}, "size_m is larger than 0"),
    ],
)
def test_what_is_wrong_in_a_field_is_said(change, said):
    with pytest.raises(ValueError, match=said):
        FieldSetup(**({"count": 3, "east_m": (8.0, 60.0), "north_m": (-4.0, 4.0)} | change))


def test_more_obstacles_than_a_scene_holds_are_refused():
    row = tuple(Obstacle(kind="post", east_m=x, north_m=30) for x in range(150))
    crowd = tuple(ObstacleSetup(kind="post", east_m=x, north_m=-30) for x in range(43))
    site = SITE.model_copy(update={"obstacles": row})
    course = course_record(GATE, SITE, rng_of(0))
    with pytest.raises(CourseImpossible, match="more than 192 obstacles"):
        obstacles(GATE.model_copy(update={"obstacles": crowd}), site, course, rng_of(0))


# -- the map ----------------------------------------------------------------------------------------------------------


def test_the_map_has_what_was_surveyed_and_the_world_has_all():
    boxes = drawn(0)
    chart = map_record(SITE, boxes)
    assert len(chart.kind) == FIELD.field.count - FIELD.field.unsurveyed
    assert set(chart.x_m) == {box.east_m for box in boxes if box.surveyed}
    assert len(furnished(SITE, boxes).all_obstacles()) == FIELD.field.count


def record(path, scenario, **how) -> Recording:
    drive(Setup(scenario=scenario, **how), path)
    return Recording(path)


@pytest.fixture(scope="module")
def seen(tmp_path_factory) -> Recording:
    """The first three seconds in a field."""
    short = FIELD.model_copy(update={"duration_s": 3.0})
    return record(tmp_path_factory.mktemp("field") / "run.mcap", short, level="direct")


def test_the_map_is_in_the_carts_store_and_the_route_is_planned_from_it_once(seen):
    (chart,) = seen.read("mission/map", Scene)
    (scene,) = seen.read("world/scene", Scene)
    assert (len(chart.value.kind), len(scene.value.kind)) == (10, 14)
    routes = seen.read("plan/route", Course)
    assert len(routes) >= 2
    assert {row.value for row in routes} == {routes[0].value}
    assert all(row.value.found and row.value.length_m > 69.0 for row in seen.read("plan/state", PlanState))
    assert len(seen.read("avoid/state", AvoidState)) > 50


def test_a_scenario_without_obstacles_of_its_own_has_no_map(tmp_path):
    short = load_scenario("safety/person-steps-out").model_copy(update={"duration_s": 0.5})
    run = record(tmp_path / "run.mcap", short, level="direct")
    assert not run.find("mission/map", Scene)


# -- who gets through -------------------------------------------------------------------------------------------------


def test_without_the_avoider_the_guard_holds_the_cart_at_the_gate(tmp_path):
    scenario = GATE.model_copy(update={"duration_s": 25.0, "stack": "reference"})
    run = record(tmp_path / "run.mcap", scenario, level="direct")
    result = judge(run, scenario.parsed_criteria)
    assert result.verdict is Verdict.FAIL
    assert run.read("guard/state", GuardState)[-1].value.hold is Hold.OBSTACLE


def test_where_no_way_is_known_the_cart_stands(tmp_path):
    ring = [(36, 8, 0), (36, -8, 0), (44, 0, 90), (28, 0, 90)]
    walls = tuple(ObstacleSetup(kind="wall", east_m=x, north_m=y, yaw_deg=yaw, length_m=17) for x, y, yaw in ring)
    scenario = GATE.model_copy(update={"obstacles": walls, "duration_s": 6.0})
    run = record(tmp_path / "run.mcap", scenario, level="direct")
    assert run.read("plan/state", PlanState)[-1].value.reason == "no way to way-point 1 at (36.0, 0.0) m"
    assert judge(run, Scenario.model_validate(scenario.model_dump() | {"criteria": {"final_speed_mps": "<= 0.01"}})
                 .parsed_criteria).verdict is Verdict.PASS  # fmt: skip


def test_the_stack_of_obstacles_is_the_reference_stack_with_planner_and_avoider():
    stack, reference = load_stack(STACKS / "obstacles.json"), load_stack(STACKS / "reference.json")
    modules = {wire.module for wire in stack.wires}
    assert modules - {wire.module for wire in reference.wires} == {"autonomy.plan:Plan", "autonomy.avoid:Avoid"}
    assert stack.command == reference.command
