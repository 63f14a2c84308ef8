"""Follower: aim at the next way-point, slowly while turning. Yours from here on."""

import math

from autonomy import Input, Module, Output, Param
from hal.signals import STOP, Course, DriveCommand, FollowState, LocalPlane, Pose, Site, wrap


class Follower(Module):
    """Drive from way-point to way-point."""

    # What it reads. A pose older than a quarter of a second is not used: `step` is not called then.
    site = Input(Site, static=True)
    course = Input(Course, static=True)
    pose = Input(Pose, max_age_s=0.25)
    # What it writes. `safe` is written in its place when it breaks.
    drive = Output(DriveCommand, safe=STOP)
    state = Output(FollowState, safe=FollowState())
    # What the wiring may change.
    gain = Param(1.0, unit="rad/rad")
    slow_mps = Param(1.5, unit="m/s")

    def reset(self) -> None:
        """Begin at the first way-point. Called once, before the first step."""
        self._next = 0

    def step(self) -> None:
        """Decide once; called every 40 ms. It must assign both outputs."""
        # Way-points are latitudes and longitudes; this turns one into metres east and north.
        plane = LocalPlane.at(self.site.lat_rad, self.site.lon_rad)
        x_m, y_m = plane.to_map(self.course.lat_rad[self._next], self.course.lon_rad[self._next])
        dx_m, dy_m = x_m - self.pose.x_m, y_m - self.pose.y_m
        distance_m = math.hypot(dx_m, dy_m)
        last = self._next == len(self.course.lat_rad) - 1
        near_m = max(1.0, self.course.radius_m[-1] / 2)  # its target radius, with room for what GPS gets wrong
        finished = last and distance_m < near_m
        if distance_m < 2.0 and not last:
            self._next += 1
        # How far the way-point is to the left of where the cart looks; wrap() keeps it within half a turn.
        error_rad = wrap(math.atan2(dy_m, dx_m) - self.pose.yaw_rad)
        steer_rad = max(-0.46, min(0.46, self.gain * error_rad))
        straight = abs(error_rad) < 0.2 and distance_m > 5.0
        speed_mps = self.course.speed_mps if straight else min(self.slow_mps, self.course.speed_mps)
        self.drive = DriveCommand(0.0 if finished else speed_mps, steer_rad, decel_mps2=1.0)
        self.state = FollowState(waypoint=self._next, finished=finished)
        self.show("aims at", [(self.pose.x_m, self.pose.y_m), (x_m, y_m)])  # a line in `fairway replay`
