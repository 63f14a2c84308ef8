"""Localiser: where the cart is, by its wheels, drawn to GPS and compass a little at a time. Yours from here on."""

import math

from autonomy import Input, Module, Output, Param
from hal.signals import CompassHeading, Course, GpsFix, LocalPlane, Odometry, Pose, Site, wrap

TRACK_M = 0.90  # between the rear wheels
ANTENNA_M = 0.60  # ahead of the rear axle


class Localiser(Module):
    """Count wheel ticks, and believe GPS a little."""

    # What it reads. Optional inputs are None while there is nothing; `static` ones do not age the pose.
    site = Input(Site, static=True)
    course = Input(Course, static=True)
    odometry = Input(Odometry, max_age_s=0.5)
    gps = Input(GpsFix, static=True, optional=True)
    compass = Input(CompassHeading, static=True, optional=True, max_age_s=0.5)
    # What it writes. In its place, when it breaks: a pose that nobody believes.
    pose = Output(Pose, safe=Pose(sigma_m=1e3))
    # How much of what GPS and compass say is believed at each reading.
    gps_gain = Param(0.03, unit="1")
    compass_gain = Param(0.003, unit="1")

    def reset(self) -> None:
        """Know nothing. Called once, before the first step."""
        self._before: Odometry | None = None
        self._fix_write, self._fix_age_s = 0, 1e3
        self._x_m = self._y_m = self._yaw_rad = 0.0

    def step(self) -> None:
        """Move on by what the wheels travelled, then correct; called every 40 ms."""
        plane = LocalPlane.at(self.site.lat_rad, self.site.lon_rad)
        if self._before is None:  # the crew has put the cart on the start mark
            self._x_m, self._y_m = plane.to_map(self.course.start_lat_rad, self.course.start_lon_rad)
            self._yaw_rad, self._before = self.course.start_yaw_rad, self.odometry
        left_m = self.odometry.left_m - self._before.left_m
        right_m = self.odometry.right_m - self._before.right_m
        self._before = self.odometry
        self._yaw_rad = wrap(self._yaw_rad + (right_m - left_m) / TRACK_M)
        self._x_m += (left_m + right_m) / 2 * math.cos(self._yaw_rad)
        self._y_m += (left_m + right_m) / 2 * math.sin(self._yaw_rad)
        if self.compass is not None and self.compass.valid:
            self._yaw_rad = wrap(self._yaw_rad + self.compass_gain * wrap(self.compass.yaw_rad - self._yaw_rad))
        self._fix_age_s += self.dt_s
        if self.gps is not None and self.gps.mode >= 2 and self.samples["gps"].write != self._fix_write:
            self._fix_write, self._fix_age_s = self.samples["gps"].write, 0.0  # a new fix, not the one from before
            x_m, y_m = plane.to_map(self.gps.lat_rad, self.gps.lon_rad)
            self._x_m += self.gps_gain * (x_m - ANTENNA_M * math.cos(self._yaw_rad) - self._x_m)
            self._y_m += self.gps_gain * (y_m - ANTENNA_M * math.sin(self._yaw_rad) - self._y_m)
        self.pose = Pose(
            self._x_m, self._y_m, self._yaw_rad, self.odometry.speed_mps, sigma_m=0.5, fix_age_s=self._fix_age_s
        )
