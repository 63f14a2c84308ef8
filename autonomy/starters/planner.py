"""Planner: a route that goes around what is on the map, by a way-point beside each thing. Yours from here on."""

import math

from autonomy import Input, Module, Output, Param
from hal.signals import Course, LocalPlane, Pose, Scene, Site

Target = tuple[float, float, float]  # x_m, y_m, radius_m


class Planner(Module):
    """Give the follower a route."""

    # What it reads. The map is None where nothing was surveyed.
    site = Input(Site, static=True)
    course = Input(Course, static=True)
    map = Input(Scene, static=True, optional=True)
    pose = Input(Pose, max_age_s=0.25)
    # What it writes: a course with more way-points. In its place, when it breaks: none, and the cart stands.
    route = Output(Course, safe=Course())
    # What the wiring may change.
    away_m = Param(2.0, unit="m")

    def reset(self) -> None:
        """Nothing is planned. Called once, before the first step."""
        self._route: Course | None = None

    def step(self) -> None:
        """Plan once, then say the same again; called every second."""
        if self._route is None:
            self._route = self._plan(LocalPlane.at(self.site.lat_rad, self.site.lon_rad))
        self.route = self._route

    def _plan(self, plane: LocalPlane) -> Course:
        """Go from way-point to way-point, around what stands between them."""
        x_m, y_m, targets = self.pose.x_m, self.pose.y_m, list[Target]()
        for lat_rad, lon_rad, radius_m in zip(
            self.course.lat_rad, self.course.lon_rad, self.course.radius_m, strict=True
        ):
            to_x, to_y = plane.to_map(lat_rad, lon_rad)
            targets += [*self._around(x_m, y_m, to_x, to_y), (to_x, to_y, radius_m)]
            x_m, y_m = to_x, to_y
        geo = [plane.to_geo(x, y) for x, y, _ in targets]
        return Course(
            tuple(lat for lat, _ in geo), tuple(lon for _, lon in geo), tuple(r for *_, r in targets),
            self.course.speed_mps,
        )  # fmt: skip

    def _around(self, x_m: float, y_m: float, to_x: float, to_y: float) -> list[Target]:
        """Give a point beside each box that is too near to a leg, in the order in which the leg passes them."""
        if self.map is None:
            return []
        length_m = max(math.dist((x_m, y_m), (to_x, to_y)), 1e-6)
        c, s = (to_x - x_m) / length_m, (to_y - y_m) / length_m
        found = []
        for box_x, box_y, long_m, wide_m in zip(
            self.map.x_m, self.map.y_m, self.map.length_m, self.map.width_m, strict=True
        ):
            along_m, left_m = (box_x - x_m) * c + (box_y - y_m) * s, (box_y - y_m) * c - (box_x - x_m) * s
            room_m = math.hypot(long_m, wide_m) / 2 + self.away_m
            if 0.0 < along_m < length_m and abs(left_m) < room_m:
                aside_m = left_m - math.copysign(room_m, left_m)  # pass it on the side where the leg already is
                found.append((along_m, x_m + along_m * c - aside_m * s, y_m + along_m * s + aside_m * c))
        return [(x, y, 1.0) for _, x, y in sorted(found)]
