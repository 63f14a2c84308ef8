"""Avoider: steer past what the range scanner sees, as near as possible to what was wanted. Yours from here on."""

import math

from autonomy import Input, Module, Output, Param
from hal.signals import STOP, ActuatorState, DriveCommand, Odometry, Scan

WHEELBASE_M, TRACK_M = 1.66, 0.90
NOSE_M, TAIL_M, HALF_WIDTH_M = 1.95, -0.4, 0.6  # the body, from the middle of the rear axle
ANGLES = [0.06 * k for k in range(-7, 8)]  # road-wheel angles to choose from, left positive


class Avoider(Module):
    """Choose the steering angle that leaves the way free."""

    # What it reads: what the follower wants, the wheels' travel, the scanner, and how the wheels point.
    drive_in = Input(DriveCommand, max_age_s=0.25)
    odometry = Input(Odometry, max_age_s=0.25)
    scan = Input(Scan, optional=True, static=True, max_age_s=0.5)
    wheels = Input(ActuatorState, optional=True, static=True, max_age_s=0.5)
    # What it writes, and what is written in its place when it breaks.
    drive = Output(DriveCommand, safe=STOP)
    # What the wiring may change.
    margin_m = Param(0.35, unit="m")
    enough_m = Param(3.0, unit="m")

    def reset(self) -> None:
        """Nothing is seen yet."""
        self._points: list[tuple[float, float]] = []  # (ahead, left) of the rear axle, in metres
        self._scan_write, self._before = 0, Odometry()

    def step(self) -> None:
        """Choose an angle, and a speed for the way that it leaves; called every 40 ms."""
        self._move()
        if self.scan is None:
            self.drive = self.drive_in
            return
        if self.samples["scan"].write != self._scan_write:
            self._scan_write = self.samples["scan"].write
            self._look(self.scan)
        wanted_rad = self.drive_in.steer_rad
        free_m = {angle: self._free(angle) for angle in ANGLES}
        good = [angle for angle in ANGLES if free_m[angle] >= self.enough_m]
        best = min(good, key=lambda a: abs(a - wanted_rad)) if good else max(ANGLES, key=lambda a: free_m[a])
        straight_on = abs(best - wanted_rad) < 0.06
        safe_mps = math.sqrt(2.0 * max(free_m[best] - 0.8, 0.0))  # so that it can stop within that, at 1 m/s2
        speed_mps = min(self.drive_in.speed_mps, safe_mps if straight_on else min(safe_mps, 1.0))
        self.drive = DriveCommand(speed_mps, wanted_rad if straight_on else best, 1.5)

    def _look(self, scan: Scan) -> None:
        """Take what a scan shows; remember what it cannot show any more, because the cart is beside it."""
        hits = [(r, scan.first_rad + k * scan.step_rad) for k, r in enumerate(scan.range_m) if r < scan.max_m]
        seen = [(scan.mount_x_m + r * math.cos(a), r * math.sin(a)) for r, a in hits]
        beside = [
            (x, y)
            for x, y in self._points
            if x > -2.0 and abs(y) < 2.0 and abs(math.atan2(y, x - scan.mount_x_m)) > -scan.first_rad
        ]
        self._points = beside[-150:] + seen

    def _move(self) -> None:
        """Move the points back by what the rear wheels have travelled."""
        left_m, right_m = self.odometry.left_m - self._before.left_m, self.odometry.right_m - self._before.right_m
        self._before = self.odometry
        ahead_m, turn_rad = (left_m + right_m) / 2, (right_m - left_m) / TRACK_M
        c, s = math.cos(turn_rad), math.sin(turn_rad)
        self._points = [((x - ahead_m) * c + y * s, y * c - (x - ahead_m) * s) for x, y in self._points]

    def _free(self, steer_rad: float) -> float:
        """Give how far the body can go at an angle before a point is in it, up to 4 m."""
        half_m, x_m, y_m, yaw_rad, length_m = HALF_WIDTH_M + self.margin_m, 0.0, 0.0, 0.0, 0.0
        while length_m < 4.0:
            length_m += 0.4
            yaw_rad += 0.4 * math.tan(steer_rad) / WHEELBASE_M
            c, s = math.cos(yaw_rad), math.sin(yaw_rad)
            x_m, y_m = x_m + 0.4 * c, y_m + 0.4 * s
            for x, y in self._points:
                ahead_m, left_m = (x - x_m) * c + (y - y_m) * s, (y - y_m) * c - (x - x_m) * s
                if TAIL_M < ahead_m < NOSE_M and abs(left_m) < half_m:
                    return length_m - 0.4
        return length_m
