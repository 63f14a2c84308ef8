"""Driver: the whole stack in one module, from wheel ticks and GPS to speed and steering. Yours from here on."""

import math

from autonomy import Input, Module, Output, Param
from hal.signals import (
    STOP,
    CompassHeading,
    Course,
    DriveCommand,
    FollowState,
    GpsFix,
    LocalPlane,
    Odometry,
    Site,
    wrap,
)

TRACK_M = 0.90  # between the rear wheels


class Driver(Module):
    """Drive from way-point to way-point. Nobody stands behind it: neither guard nor localiser."""

    # What it reads. The stack wires site and course; `pointer` says where the others are.
    site = Input(Site, static=True)
    course = Input(Course, static=True)
    odometry = Input(Odometry, max_age_s=0.25, pointer="odometry/travel")
    gps = Input(GpsFix, static=True, optional=True, pointer="gps/fix")
    compass = Input(CompassHeading, static=True, optional=True, max_age_s=0.5, pointer="compass/heading")
    # What it writes: the command that the cart obeys, and how far it is.
    drive = Output(DriveCommand, safe=STOP)
    state = Output(FollowState, safe=FollowState())
    # What the wiring may change.
    gain = Param(1.0, unit="rad/rad")
    gps_gain = Param(0.03, unit="1")
    compass_gain = Param(0.007, unit="1")

    def reset(self) -> None:
        """Begin at the first way-point. Called once, before the first step."""
        self._next = self._fix_write = 0
        self._before: Odometry | None = None
        self._x_m = self._y_m = self._yaw_rad = 0.0

    def step(self) -> None:
        """Find out where the cart is, then where to go; called every 100 ms."""
        plane = LocalPlane.at(self.site.lat_rad, self.site.lon_rad)
        self._locate(plane)
        x_m, y_m = plane.to_map(self.course.lat_rad[self._next], self.course.lon_rad[self._next])
        dx_m, dy_m = x_m - self._x_m, y_m - self._y_m
        last = self._next == len(self.course.lat_rad) - 1
        near = math.hypot(dx_m, dy_m) < 2.0
        finished = last and near
        if near and not last:
            self._next += 1
        error_rad = wrap(math.atan2(dy_m, dx_m) - self._yaw_rad)
        steer_rad = max(-0.46, min(0.46, self.gain * error_rad))
        speed_mps = self.course.speed_mps if abs(error_rad) < 0.2 else min(1.5, self.course.speed_mps)
        self.drive = DriveCommand(0.0 if finished else speed_mps, steer_rad, decel_mps2=1.0)
        self.state = FollowState(waypoint=self._next, finished=finished)
        self.show("believed", [(self._x_m, self._y_m), (x_m, y_m)])  # a line in `fairway replay`

    def _locate(self, plane: LocalPlane) -> None:
        """Move on by what the wheels travelled; let compass and GPS draw a little."""
        if self._before is None:  # the crew has put the cart on the start mark
            self._x_m, self._y_m = plane.to_map(self.course.start_lat_rad, self.course.start_lon_rad)
            self._yaw_rad, self._before = self.course.start_yaw_rad, self.odometry
        left_m, right_m = self.odometry.left_m - self._before.left_m, self.odometry.right_m - self._before.right_m
        self._before = self.odometry
        self._yaw_rad = wrap(self._yaw_rad + (right_m - left_m) / TRACK_M)
        self._x_m += (left_m + right_m) / 2 * math.cos(self._yaw_rad)
        self._y_m += (left_m + right_m) / 2 * math.sin(self._yaw_rad)
        if self.compass is not None and self.compass.valid:
            self._yaw_rad = wrap(self._yaw_rad + self.compass_gain * wrap(self.compass.yaw_rad - self._yaw_rad))
        if self.gps is not None and self.gps.mode >= 2 and self.samples["gps"].write != self._fix_write:
            self._fix_write = self.samples["gps"].write
            x_m, y_m = plane.to_map(self.gps.lat_rad, self.gps.lon_rad)
            self._x_m += self.gps_gain * (x_m - 0.6 * math.cos(self._yaw_rad) - self._x_m)  # the antenna is ahead of C
            self._y_m += self.gps_gain * (y_m - 0.6 * math.sin(self._yaw_rad) - self._y_m)
