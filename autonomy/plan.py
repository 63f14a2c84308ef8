"""Plan: a route through the way-points, around what stands on the map, by A* on a grid.

Boxes grow by half the cart's width and a margin, so that the cart may be a point. A* finds a shortest path from cell to
cell (Hart, Nilsson, Raphael, A Formal Basis for the Heuristic Determination of Minimum Cost Paths, IEEE Transactions on
Systems Science and Cybernetics 4(2), 1968). Then the path is pulled straight: of its cells only those stay that are
needed to see from one to the next. Of what is not on the map the route knows nothing: that is for whoever has a sensor.
"""

import math
from collections.abc import Iterator
from heapq import heappop, heappush
from itertools import pairwise
from typing import NamedTuple

from autonomy import Input, Module, Output, Param
from hal.signals import Course, LocalPlane, PlanState, Pose, Scene, Site

Point = tuple[float, float]
Cell = tuple[int, int]
MOST_WAYPOINTS = 64  # as many as a Course holds
STEPS = [(dx, dy, math.hypot(dx, dy)) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if dx or dy]


class Target(NamedTuple):
    """A point to visit, as near as its radius."""

    x_m: float
    y_m: float
    radius_m: float


class Plan(Module):
    """Give the follower a route that the map allows."""

    site = Input(Site, static=True)
    course = Input(Course, static=True)
    map = Input(Scene, static=True, optional=True)
    pose = Input(Pose, max_age_s=0.25)
    route = Output(Course, safe=Course())
    state = Output(PlanState, safe=PlanState())

    half_width_m = Param(0.6, unit="m")
    margin_m = Param(0.8, unit="m")
    cell_m = Param(0.25, unit="m")
    corner_m = Param(0.8, unit="m")

    def reset(self) -> None:
        """Nothing is planned."""
        self._known: tuple[Site, Course, Scene | None] | None = None
        self._targets: list[Target] = []
        self._route, self._state = Course(), PlanState()

    def step(self) -> None:
        """Plan when something changed; else say again what was planned."""
        before, self._known = self._known, (self.site, self.course, self.map)
        if before is None or before[:2] != self._known[:2]:
            plane, c = LocalPlane.at(self.site.lat_rad, self.site.lon_rad), self.course
            geo = zip(c.lat_rad, c.lon_rad, c.radius_m, strict=True)
            self._targets = [Target(*plane.to_map(lat, lon), radius_m) for lat, lon, radius_m in geo]
        here = (self.pose.x_m, self.pose.y_m)
        if len(self._targets) > 1 and math.dist(here, self._targets[0][:2]) <= self._targets[0].radius_m:
            del self._targets[0]  # a new map does not send the cart back to what it has visited
        if before != self._known:
            self._plan(here)
        self.route, self.state = self._route, self._state

    def _plan(self, here: Point) -> None:
        if self.map is None:  # nothing is known to stand about
            points, reason = self._targets, ""
        else:
            inflate_m = self.half_width_m + self.margin_m
            grid = grid_of(self.map, [here, *(t[:2] for t in self._targets)], inflate_m, self.cell_m)
            points, reason = find_route(grid, here, self._targets, self.corner_m)
        line = [here, *(p[:2] for p in points)] if points else []
        length_m = sum(math.dist(a, b) for a, b in pairwise(line))
        self._state = PlanState(not reason, length_m, reason)
        plane = LocalPlane.at(self.site.lat_rad, self.site.lon_rad)
        geo = [plane.to_geo(p.x_m, p.y_m) for p in points]
        self._route = Course(
            tuple(lat for lat, _ in geo),
            tuple(lon for _, lon in geo),
            tuple(p.radius_m for p in points),
            self.course.speed_mps,
        )


# -- the grid -------------------------------------------------------------------------------------------------------


class Grid(NamedTuple):
    """Cells around the origin (x0, y0) of cell (0, 0), and which of them C must not be in."""

    x0_m: float
    y0_m: float
    cell_m: float
    nx: int
    ny: int
    blocked: frozenset[Cell]

    def cell(self, x_m: float, y_m: float) -> Cell:
        """Give the cell that a point is in."""
        return round((x_m - self.x0_m) / self.cell_m), round((y_m - self.y0_m) / self.cell_m)

    def centre(self, cell: Cell) -> Point:
        """Give the centre of a cell."""
        return self.x0_m + cell[0] * self.cell_m, self.y0_m + cell[1] * self.cell_m

    def free(self, cell: Cell) -> bool:
        """Say whether C may be in a cell."""
        return 0 <= cell[0] < self.nx and 0 <= cell[1] < self.ny and cell not in self.blocked

    def neighbours(self, cell: Cell) -> Iterator[tuple[Cell, float]]:
        """Give the free cells around, with their distance in cells; not across the corner of a blocked one."""
        x, y = cell
        for dx, dy, cost in STEPS:
            there = (x + dx, y + dy)
            if self.free(there) and (not (dx and dy) or (self.free((x + dx, y)) and self.free((x, y + dy)))):
                yield there, cost

    def sees(self, a: Point, b: Point) -> bool:
        """Say whether the straight line between two points is free, looked at four times a cell."""
        n = max(1, math.ceil(4 * math.dist(a, b) / self.cell_m))
        return all(
            self.free(self.cell(a[0] + i / n * (b[0] - a[0]), a[1] + i / n * (b[1] - a[1]))) for i in range(n + 1)
        )

    def nearest_free(self, point: Point, within_m: float) -> Point | None:
        """Give the point itself if it is free, else the nearest centre of a free cell that is not too far."""
        if self.free(self.cell(*point)):
            return point
        (x, y), n = self.cell(*point), int(within_m / self.cell_m)
        around = [(x + i, y + j) for i in range(-n, n + 1) for j in range(-n, n + 1)]
        free = [self.centre(cell) for cell in around if self.free(cell)]
        best = min(free, key=lambda centre: math.dist(centre, point), default=None)
        return best if best is not None and math.dist(best, point) <= within_m else None


def grid_of(scene: Scene, points: list[Point], inflate_m: float, cell_m: float, room_m: float = 10.0) -> Grid:
    """Lay a grid over points and boxes, with room around; blocked: nearer than `inflate_m` to a box, or outside."""
    xs, ys = [*(x for x, _ in points), *scene.x_m], [*(y for _, y in points), *scene.y_m]
    x0_m, y0_m = min(xs) - room_m, min(ys) - room_m
    nx, ny = (int((max(v) - min(v) + 2 * room_m) / cell_m) + 1 for v in (xs, ys))
    grid, blocked = Grid(x0_m, y0_m, cell_m, nx, ny, frozenset()), set[Cell]()
    for x_m, y_m, yaw_rad, length_m, width_m in zip(
        scene.x_m, scene.y_m, scene.yaw_rad, scene.length_m, scene.width_m, strict=True
    ):
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        (i, j), n = grid.cell(x_m, y_m), math.ceil((math.hypot(length_m, width_m) / 2 + inflate_m) / cell_m)
        for cell in ((i + di, j + dj) for di in range(-n, n + 1) for dj in range(-n, n + 1)):
            px, py = grid.centre(cell)
            along = abs((px - x_m) * c + (py - y_m) * s) - length_m / 2
            across = abs((py - y_m) * c - (px - x_m) * s) - width_m / 2
            if math.hypot(max(along, 0.0), max(across, 0.0)) < inflate_m:
                blocked.add(cell)
    corners = list(zip(scene.boundary_x_m, scene.boundary_y_m, strict=True))
    if corners:
        blocked.update((i, j) for i in range(nx) for j in range(ny) if not inside(grid.centre((i, j)), corners))
    return grid._replace(blocked=frozenset(blocked))


def inside(point: Point, corners: list[Point]) -> bool:
    """Say whether a point is inside a polygon: a ray to the east crosses its outline an odd number of times."""
    (x, y), odd = point, False
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
        if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
            odd = not odd
    return odd


# -- the search -----------------------------------------------------------------------------------------------------


def search(grid: Grid, start: Cell, goal: Cell) -> list[Cell]:
    """Give a shortest path by A*, with start and goal; empty if there is none."""
    cost, came_from, done = {start: 0.0}, {start: start}, set[Cell]()
    heap = [(octile(start, goal), start)]
    while heap:
        _, here = heappop(heap)
        if here == goal:
            path = [goal]
            while path[-1] != start:
                path.append(came_from[path[-1]])
            return path[::-1]
        if here in done:
            continue  # it was put in again when a cheaper way to it was found
        done.add(here)
        for there, step in grid.neighbours(here):
            so_far = cost[here] + step
            if so_far < cost.get(there, math.inf):
                cost[there], came_from[there] = so_far, here
                heappush(heap, (so_far + octile(there, goal), there))
    return []


def octile(a: Cell, b: Cell) -> float:
    """Give the length of the shortest path in a grid where nothing is blocked: never more than the true one."""
    dx, dy = abs(a[0] - b[0]), abs(a[1] - b[1])
    return max(dx, dy) + (math.sqrt(2.0) - 1.0) * min(dx, dy)


def straightened(grid: Grid, points: list[Point]) -> list[Point]:
    """Leave out the points of a path that are not needed: from each, go to the last one that it sees."""
    out, k = [points[0]], 0
    while k < len(points) - 1:
        k = next((j for j in range(len(points) - 1, k + 1, -1) if grid.sees(points[k], points[j])), k + 1)
        out.append(points[k])
    return out


def find_route(grid: Grid, here: Point, targets: list[Target], corner_m: float) -> tuple[list[Target], str]:
    """Give the route through all targets, or none and why: every target is visited, and corners between them."""
    at, route = grid.nearest_free(here, 3.0), list[Target]()
    if at is None:
        return [], f"the cart at ({here[0]:.1f}, {here[1]:.1f}) m is shut in"
    for k, target in enumerate(targets, 1):
        to = grid.nearest_free(target[:2], target.radius_m)
        if to is None:
            return [], f"way-point {k} at ({target.x_m:.1f}, {target.y_m:.1f}) m is built over"
        cells = search(grid, grid.cell(*at), grid.cell(*to))
        if not cells:
            return [], f"no way to way-point {k} at ({target.x_m:.1f}, {target.y_m:.1f}) m"
        corners = straightened(grid, [at, *(grid.centre(cell) for cell in cells[1:-1]), to])[1:-1]
        route += [Target(*corner, corner_m) for corner in corners]
        route.append(Target(*to, target.radius_m if k == len(targets) else min(target.radius_m, corner_m)))
        at = to
    if len(route) > MOST_WAYPOINTS:
        return [], f"the route has {len(route)} way-points, a course holds {MOST_WAYPOINTS}"
    return route, ""
