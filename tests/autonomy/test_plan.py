"""The planner: A* against Dijkstra, paths that can be driven, routes that visit everything, and an honest no."""

import math
from heapq import heappop, heappush
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autonomy.plan import Cell, Grid, Plan, Target, find_route, grid_of, inside, octile, search, straightened
from hal.signals import Course, LocalPlane, Pose, Scene, Site
from rtdb import Sample

SITE = Site("t", math.radians(39.0), math.radians(-86.0), 0.0)
PLANE = LocalPlane.at(SITE.lat_rad, SITE.lon_rad)
GROWN_M = 1.4
EMPTY = Scene()


def boxes(*rows, boundary=()):
    """A scene of (x, y, length, width) boxes."""
    x, y, length, width = zip(*rows, strict=True) if rows else ((), (), (), ())
    n = len(rows)
    return Scene((0,) * n, x, y, (0.5,) * n, (0.0,) * n, length, width, (1.0,) * n,
                 tuple(a for a, _ in boundary), tuple(b for _, b in boundary))  # fmt: skip


@st.composite
def grids(draw):
    """Small grids with random blocked cells, and two free ones."""
    nx, ny = draw(st.integers(2, 9)), draw(st.integers(2, 9))
    cells = [(i, j) for i in range(nx) for j in range(ny)]
    start, goal = draw(st.sampled_from(cells)), draw(st.sampled_from(cells))
    blocked = draw(st.sets(st.sampled_from(cells), max_size=nx * ny // 2)) - {start, goal}
    return Grid(0.0, 0.0, 1.0, nx, ny, frozenset(blocked)), start, goal


def dijkstra(grid, start, goal) -> float:
    """The second opinion: shortest lengths to everywhere, with rules of its own for what is a step."""
    length, heap = {start: 0.0}, [(0.0, start)]
    while heap:
        so_far, (x, y) = heappop(heap)
        if so_far > length[x, y]:
            continue
        for i, j in ((x + dx, y + dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)):
            square = {(a, b) for a in (x, i) for b in (y, j)}  # one, two or four cells that the step touches
            if all(0 <= a < grid.nx and 0 <= b < grid.ny for a, b in square) and not square & grid.blocked:
                there = so_far + math.hypot(i - x, j - y)
                if there < length.get((i, j), math.inf) - 1e-9:
                    length[i, j] = there
                    heappush(heap, (there, (i, j)))
    return length.get(goal, math.inf)


def length_of(path: list[Cell]) -> float:
    return sum(math.dist(a, b) for a, b in pairwise(path)) if path else math.inf


# -- the search -------------------------------------------------------------------------------------------------------


@given(grids())
@settings(max_examples=200, deadline=None)
def test_a_star_finds_a_path_as_short_as_dijkstra_does_or_none_where_there_is_none(case):
    grid, start, goal = case
    assert length_of(search(grid, start, goal)) == pytest.approx(dijkstra(grid, start, goal))


@given(grids())
@settings(max_examples=100, deadline=None)
def test_a_path_leads_from_start_to_goal_over_free_neighbours_and_cuts_no_corner(case):
    grid, start, goal = case
    path = search(grid, start, goal)
    if path:
        assert (path[0], path[-1]) == (start, goal)
        for (ax, ay), (bx, by) in pairwise(path):
            assert max(abs(ax - bx), abs(ay - by)) == 1
            assert not {(ax, ay), (ax, by), (bx, ay), (bx, by)} & grid.blocked


def test_where_nothing_is_blocked_the_path_is_as_long_as_the_estimate():
    grid = Grid(0.0, 0.0, 1.0, 20, 20, frozenset())
    for goal in ((19, 0), (19, 19), (7, 13)):
        assert length_of(search(grid, (0, 0), goal)) == pytest.approx(octile((0, 0), goal))


@given(grids())
@settings(max_examples=100, deadline=None)
def test_a_straightened_path_sees_from_point_to_point_and_is_not_longer(case):
    grid, start, goal = case
    path = [grid.centre(cell) for cell in search(grid, start, goal)]
    if path:
        short = straightened(grid, path)
        assert (short[0], short[-1]) == (path[0], path[-1])
        assert all(grid.sees(a, b) or math.dist(a, b) < 1.5 for a, b in pairwise(short))
        assert length_of(short) <= length_of(path) + 1e-9


def test_outside_of_the_boundary_is_blocked():
    corners = [(-5.0, -5.0), (15.0, -5.0), (15.0, 5.0), (-5.0, 5.0)]
    assert inside((0.0, 0.0), corners)
    assert not inside((0.0, 6.0), corners)
    grid = grid_of(boxes((5.0, 0.0, 1.0, 12.0), boundary=corners), [(0.0, 0.0), (10.0, 0.0)], GROWN_M, 0.25)
    assert find_route(grid, (0.0, 0.0), [Target(10.0, 0.0, 1.0)], 0.8) == (
        [], "no way to way-point 1 at (10.0, 0.0) m"
    )  # fmt: skip


# -- routes -----------------------------------------------------------------------------------------------------------


def clearance(scene, p):
    """Distance from a point to the nearest box; all boxes here stand along the axes."""
    return min(
        math.hypot(max(abs(p[0] - x) - length / 2, 0), max(abs(p[1] - y) - width / 2, 0))
        for x, y, length, width in zip(scene.x_m, scene.y_m, scene.length_m, scene.width_m, strict=True)
    )


FIELD = boxes((10, 0, 2, 2), (16, 4, 2, 2), (16, -3, 1, 3), (24, 1, 2, 6), (30, -4, 2, 2))


def test_a_route_keeps_clear_of_all_boxes_by_half_the_width_and_a_margin_but_for_half_a_cell():
    grid = grid_of(FIELD, [(0, 0), (40, 0)], GROWN_M, 0.25)
    route, reason = find_route(grid, (0.0, 0.0), [Target(40.0, 0.0, 3.0)], 0.8)
    assert reason == ""
    line = [(0.0, 0.0), *(t[:2] for t in route)]
    for a, b in pairwise(line):
        for i in range(101):
            p = (a[0] + i / 100 * (b[0] - a[0]), a[1] + i / 100 * (b[1] - a[1]))
            assert clearance(FIELD, p) > GROWN_M - 0.25 * math.sqrt(0.5) - 1e-9
    assert length_of(line) < 1.1 * 40.0, "it does not go round the whole field"
    assert len(route) < 12


def test_a_route_visits_every_way_point_in_order():
    targets = [Target(40.0, 0.0, 3.0), Target(10.5, 0.0, 3.0), Target(0.0, 8.0, 2.0)]  # the second one is in a box
    grid = grid_of(FIELD, [(0, 0), *(t[:2] for t in targets)], GROWN_M, 0.25)
    route, _ = find_route(grid, (0.0, 0.0), targets, 0.8)
    at = 0
    for target in targets:
        at = next(k for k in range(at, len(route)) if math.dist(route[k][:2], target[:2]) <= target.radius_m)


def test_a_way_point_that_is_built_over_and_a_cart_that_is_shut_in_are_named():
    scene = boxes((20, 0, 10, 10))
    grid = grid_of(scene, [(0, 0), (20, 0)], GROWN_M, 0.5)
    assert (
        find_route(grid, (0.0, 0.0), [Target(20.0, 0.0, 3.0)], 0.8)[1] == "way-point 1 at (20.0, 0.0) m is built over"
    )
    assert find_route(grid, (20.0, 0.0), [Target(0.0, 0.0, 3.0)], 0.8)[1] == "the cart at (20.0, 0.0) m is shut in"


# -- the module -------------------------------------------------------------------------------------------------------


def course_of(*points, radius_m=3.0):
    geo = [PLANE.to_geo(x, y) for x, y in points]
    return Course(tuple(a for a, _ in geo), tuple(b for _, b in geo), (radius_m,) * len(geo), 1.8)


class Rig:
    """Steps one planner by hand, and counts how often it plans."""

    def __init__(self):
        self.plan, self.planned = Plan(), 0
        self.plan.reset()
        inner = self.plan._plan

        def counted(here):
            self.planned += 1
            inner(here)

        self.plan._plan = counted

    def step(self, course, scene, x_m=0.0, y_m=0.0):
        inputs = {"site": SITE, "course": course, "map": scene, "pose": Pose(x_m, y_m)}
        self.plan.__dict__.update(inputs)
        self.plan.samples = {name: Sample(v, 1, 0, 0, ()) for name, v in inputs.items() if v is not None}
        self.plan._out.clear()
        self.plan.step()
        out = self.plan._out
        return out[Plan.outputs["route"]], out[Plan.outputs["state"]]


def points_of(route):
    return [PLANE.to_map(lat, lon) for lat, lon in zip(route.lat_rad, route.lon_rad, strict=True)]


def test_nothing_is_planned_again_while_nothing_changes():
    rig = Rig()
    first = rig.step(course_of((40, 0)), FIELD)
    assert [rig.step(course_of((40, 0)), FIELD, x_m=float(x)) for x in range(5)] == [first] * 5
    assert rig.planned == 1


def test_without_a_map_the_route_is_the_course():
    course = course_of((20, 0), (20, 20))
    route, state = Rig().step(course, None)
    assert points_of(route) == [pytest.approx(p, abs=1e-6) for p in points_of(course)]
    assert (route.radius_m, route.speed_mps, state.found) == (course.radius_m, course.speed_mps, True)


def test_a_new_map_is_planned_for_from_where_the_cart_is_and_not_back_to_what_it_has_visited():
    rig, course = Rig(), course_of((20, 0), (40, 0))
    rig.step(course, EMPTY)
    rig.step(course, EMPTY, x_m=19.0)
    route, state = rig.step(course, boxes((28, 0, 2, 2)), x_m=22.0)
    assert rig.planned == 2
    assert all(x > 22.0 for x, _ in points_of(route)), "it goes on"
    assert any(abs(y) > 2.0 for _, y in points_of(route)), "around the box"
    assert 18.0 < state.length_m < 22.0


def test_no_way_is_said_and_the_route_is_empty():
    ring = boxes((40, 6, 12, 1), (40, -6, 12, 1), (46, 0, 1, 12), (34, 0, 1, 12))
    route, state = Rig().step(course_of((40, 0)), ring)
    assert route.lat_rad == ()
    assert (state.found, state.length_m) == (False, 0.0)
    assert state.reason == "no way to way-point 1 at (40.0, 0.0) m"
