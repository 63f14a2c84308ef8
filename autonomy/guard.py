"""Guard: the last module before the limits. It holds the cart back for obstacles ahead, while lost, and far from the
course.

Ahead is the corridor that the commanded steering sweeps. The cart must be able to stop in front of whatever stands in
it: its speed is cut to what the free distance allows, v^2 = 2 a d. After a hold the way must be free for a while before
it lets go. Without a range scanner it watches the position alone.
"""

import math
from itertools import pairwise

from autonomy import Input, Module, Output, Param
from hal.signals import STOP, Course, DriveCommand, GuardState, Hold, LocalPlane, Pose, Scan, Site

Point = tuple[float, float]


class Guard(Module):
    """Pass the command on, slow it down, or stop."""

    drive_in = Input(DriveCommand, max_age_s=0.25)
    pose = Input(Pose, max_age_s=0.25)
    scan = Input(Scan, optional=True, static=True, max_age_s=0.5)
    site = Input(Site, optional=True, static=True)
    course = Input(Course, optional=True, static=True)
    drive = Output(DriveCommand, safe=STOP)
    state = Output(GuardState, safe=GuardState(Hold.NO_COMMAND))

    max_sigma_m = Param(1.5, unit="m")
    max_fix_age_s = Param(8.0, unit="s")
    wheelbase_m = Param(1.66, unit="m")
    half_width_m = Param(0.85, unit="m")
    stand_off_m = Param(1.0, unit="m")
    decel_mps2 = Param(1.2, unit="m/s2")
    release_s = Param(1.0, unit="s")
    max_astray_m = Param(8.0, unit="m")

    def reset(self) -> None:
        """Nothing is in the way."""
        self._free_s = self.release_s
        self._legs: list[tuple[Point, Point]] = []
        self._astray_m = 0.0
        self._steps = 0

    def step(self) -> None:
        """Decide."""
        command = self.drive_in
        free_m = self._free_ahead()
        blocked = free_m <= self.stand_off_m
        self._free_s = 0.0 if blocked else self._free_s + self.dt_s
        if self.pose.sigma_m > self.max_sigma_m or self.pose.fix_age_s > self.max_fix_age_s:
            hold = Hold.UNCERTAIN
        elif self._astray() > self.max_astray_m:
            hold = Hold.OUTSIDE
        elif self._free_s < self.release_s:
            hold = Hold.OBSTACLE
        else:
            hold = Hold.NONE
        self.state = GuardState(hold)
        if hold is not Hold.NONE:
            self.drive = DriveCommand(0.0, command.steer_rad, 1.5 if hold is Hold.OBSTACLE else 1.0)
            return
        safe_mps = math.sqrt(2.0 * self.decel_mps2 * (free_m - self.stand_off_m))
        self.drive = command if command.speed_mps <= safe_mps else DriveCommand(safe_mps, command.steer_rad, 1.5)

    def _astray(self) -> float:
        """Give the distance from the course, looked at five times a second; 0 without a course."""
        if self.site is None or self.course is None:
            return 0.0
        if not self._legs:
            plane, c = LocalPlane.at(self.site.lat_rad, self.site.lon_rad), self.course
            start = (
                plane.to_map(c.start_lat_rad, c.start_lon_rad)
                if c.start_sigma_m > 0
                else (self.pose.x_m, self.pose.y_m)
            )
            points = [start, *(plane.to_map(lat, lon) for lat, lon in zip(c.lat_rad, c.lon_rad, strict=True))]
            self._legs = list(pairwise(points))
        if self._steps % 5 == 0:
            here = (self.pose.x_m, self.pose.y_m)
            self._astray_m = min(to_leg(here, a, b) for a, b in self._legs)
        self._steps += 1
        return self._astray_m

    def _free_ahead(self) -> float:
        """Give the free distance ahead of the nose, along the arc that the cart is told to drive."""
        scan = self.scan
        if scan is None:
            return math.inf
        curvature = math.tan(self.drive_in.steer_rad) / self.wheelbase_m
        free_m = math.inf
        for k, range_m in enumerate(scan.range_m):
            if range_m >= scan.max_m - 1e-6:
                continue
            angle = scan.first_rad + k * scan.step_rad
            x_m, y_m = scan.mount_x_m + range_m * math.cos(angle), range_m * math.sin(angle)
            along_m, aside_m = along_arc(x_m, y_m, curvature)
            if abs(aside_m) <= self.half_width_m:
                free_m = min(free_m, along_m - scan.mount_x_m)
        return free_m


def to_leg(here: Point, a: Point, b: Point) -> float:
    """Give the distance from a point to a leg."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    part = min(max(((here[0] - a[0]) * dx + (here[1] - a[1]) * dy) / max(dx * dx + dy * dy, 1e-9), 0.0), 1.0)
    return math.hypot(here[0] - a[0] - part * dx, here[1] - a[1] - part * dy)


def along_arc(x_m: float, y_m: float, curvature: float) -> tuple[float, float]:
    """Give (distance along, signed distance aside of) the arc that begins at C with a curvature, of a point in C."""
    if abs(curvature) < 1e-6:
        return x_m, y_m
    radius_m = 1.0 / curvature
    angle = math.atan2(x_m * math.copysign(1.0, curvature), abs(radius_m) - y_m * math.copysign(1.0, curvature))
    return abs(radius_m) * abs(angle), radius_m - math.copysign(math.hypot(x_m, y_m - radius_m), radius_m)
