"""Avoid: steer around what the range scanner sees, as near as possible to what the follower wants, by VFH+.

Source: Ulrich, Borenstein, VFH+: Reliable Obstacle Avoidance for Fast Mobile Robots, ICRA 1998. Its four stages, for a
cart that steers with its front wheels:

    1. histogram   sectors are directions of the front axle: road-wheel angles, from right to left. Each holds the
                   free way of the whole body, with a margin, along the circle that it drives at that angle.
                   So obstacles are grown by the cart's width, and no sector asks for more than its turning radius.
    2. binary      a sector is blocked when its free way is short; a free one becomes blocked later than a blocked
                   one becomes free (hysteresis). Where everything is blocked, it looks less far ahead.
    3. candidates  all sectors that are free.
    4. cost        distance to what the follower wants, to where the wheels point, to what was chosen last.

The scanner sees only what is ahead. What it saw stays in a small grid until it is seen to be gone. That grid lies where
the wheels say: over a few metres they are right to centimetres, while a GPS position wanders by decimetres.
"""

import math
from collections.abc import Sequence

from autonomy import Input, Module, Output, Param
from hal.signals import STOP, ActuatorState, AvoidState, DriveCommand, Odometry, Scan

Point = tuple[float, float]
SECTORS, STEP_RAD = 31, 0.03
ANGLES = [(k - SECTORS // 2) * STEP_RAD for k in range(SECTORS)]  # -0.45 to 0.45 rad
WHEELBASE_M, TRACK_M = 1.66, 0.90
NOSE_M, HALF_WIDTH_M, BESIDE_M = 1.95, 0.6, 0.2  # the body in C; margin to what is beside it already
CELL_M, KEEP_S, KEEP_M = 0.15, 10.0, 8.0  # the memory: what is older or farther is forgotten
WANTED, WHEELS, LAST = 5.0, 2.0, 2.0  # weights of the cost, as in the paper: WANTED > WHEELS + LAST


class Avoid(Module):
    """Turn the follower's command where it would hit something; slow down; stop where nothing is free."""

    drive_in = Input(DriveCommand, max_age_s=0.25)
    odometry = Input(Odometry, max_age_s=0.25)
    scan = Input(Scan, optional=True, static=True, max_age_s=0.5)
    wheels = Input(ActuatorState, optional=True, static=True, max_age_s=0.5)
    drive = Output(DriveCommand, safe=STOP)
    state = Output(AvoidState, safe=AvoidState())

    margin_m = Param(0.3, unit="m")
    look_m = Param(4.0, unit="m")
    blocked_m = Param(2.8, unit="m")
    free_m = Param(3.3, unit="m")
    stand_off_m = Param(0.8, unit="m")
    decel_mps2 = Param(1.0, unit="m/s2")
    lateral_mps2 = Param(1.2, unit="m/s2")

    def reset(self) -> None:
        """Nothing is seen yet."""
        self._seen: dict[tuple[int, int], tuple[float, float, int]] = {}  # cell -> the last hit in it, when
        self._scan_write = -1
        self._was_free = [True] * SECTORS
        self._last_rad = 0.0
        self._x_m = self._y_m = self._yaw_rad = 0.0  # C, as the wheels have it
        self._travel: Odometry | None = None

    def step(self) -> None:
        """Choose a sector, and a speed for its free way."""
        self._roll()
        if self.scan is None:  # no scanner at all, or one that fell silent
            self.drive, self.state = self.drive_in if self._scan_write < 0 else STOP, AvoidState()
            return
        points = self._look(self.scan)
        free_m = [free_way(points, angle, self.margin_m, self.look_m) for angle in ANGLES]
        wanted_rad = self.drive_in.steer_rad
        wheels_rad = self.wheels.steer_rad if self.wheels is not None else self._last_rad
        free: list[bool] = []
        for part in (1.0, 0.6, 0.4):  # in a tight place look less far
            free = binary(free_m, self._was_free, part * self.blocked_m, part * self.free_m)
            if any(free):
                break
        self._was_free = free
        k = choose(free, wanted_rad, wheels_rad, self._last_rad)
        turned, stuck = k is not None and k != sector(wanted_rad), k is None
        self.state = AvoidState(turned, stuck, ANGLES[0], STEP_RAD, tuple(free_m))
        if k is None:
            self.drive = DriveCommand(0.0, wanted_rad, 1.5)
            return
        self._last_rad = steer_rad = ANGLES[k] if turned else wanted_rad
        safe_mps = self._safe_mps(free_m[k])
        if turned:  # until the wheels have turned it goes elsewhere, and may have to wait for them
            safe_mps = min(safe_mps, self._safe_mps(free_m[sector(wheels_rad)]))
            safe_mps = min(safe_mps, math.sqrt(self.lateral_mps2 * WHEELBASE_M / max(abs(math.tan(steer_rad)), 1e-6)))
        if turned or self.drive_in.speed_mps > safe_mps:
            self.drive = DriveCommand(min(self.drive_in.speed_mps, safe_mps), steer_rad, 1.5)
        else:
            self.drive = self.drive_in

    def _safe_mps(self, free_m: float) -> float:
        return math.sqrt(2.0 * self.decel_mps2 * max(free_m - self.stand_off_m, 0.0))

    def _roll(self) -> None:
        """Move C by what the rear wheels have travelled."""
        now, before = self.odometry, self._travel or self.odometry
        left_m, right_m = now.left_m - before.left_m, now.right_m - before.right_m
        half_turn_rad = (right_m - left_m) / TRACK_M / 2.0
        self._x_m += (left_m + right_m) / 2.0 * math.cos(self._yaw_rad + half_turn_rad)
        self._y_m += (left_m + right_m) / 2.0 * math.sin(self._yaw_rad + half_turn_rad)
        self._yaw_rad, self._travel = self._yaw_rad + 2.0 * half_turn_rad, now

    def _look(self, scan: Scan) -> list[Point]:
        """Take a new scan into the memory; give all that is remembered, in C."""
        c, s = math.cos(self._yaw_rad), math.sin(self._yaw_rad)
        if self.samples["scan"].write != self._scan_write:
            self._scan_write = self.samples["scan"].write
            for cell, (x_m, y_m, _) in list(self._seen.items()):
                dx, dy = x_m - self._x_m, y_m - self._y_m
                if looks_through(scan, (dx * c + dy * s, dy * c - dx * s)):
                    del self._seen[cell]
            for k, range_m in enumerate(scan.range_m):
                if range_m < scan.max_m - 1e-6:
                    angle = scan.first_rad + k * scan.step_rad
                    ahead_m, left_m = scan.mount_x_m + range_m * math.cos(angle), range_m * math.sin(angle)
                    x_m, y_m = self._x_m + ahead_m * c - left_m * s, self._y_m + ahead_m * s + left_m * c
                    self._seen[int(x_m // CELL_M), int(y_m // CELL_M)] = (x_m, y_m, self.t_ns)
        points = []
        for cell, (x_m, y_m, t_ns) in list(self._seen.items()):
            dx, dy = x_m - self._x_m, y_m - self._y_m
            if self.t_ns - t_ns > KEEP_S * 1e9 or math.hypot(dx, dy) > KEEP_M:
                del self._seen[cell]
            else:
                points.append((dx * c + dy * s, dy * c - dx * s))
        return points


def looks_through(scan: Scan, point: Point) -> bool:
    """Say whether a ray of the scan goes past a point in C, so that nothing is there any more."""
    dx, dy = point[0] - scan.mount_x_m, point[1]
    k = round((math.atan2(dy, dx) - scan.first_rad) / scan.step_rad)
    return 0 <= k < len(scan.range_m) and math.hypot(dx, dy) + 0.3 < scan.range_m[k]


def free_way(points: Sequence[Point], steer_rad: float, margin_m: float, look_m: float) -> float:
    """Give how far C can go on the circle of a road-wheel angle before the body, with a margin, meets a point in C.

    About the middle of the circle a point keeps its radius rho, and its angle phi runs from ahead to behind:

        rho < R - half              passes on the inside
        rho > (front outer corner)  passes on the outside
        else                        is met by the front, or on the inside by the flank, at the angle phi_hit
    """
    curvature = math.tan(steer_rad) / WHEELBASE_M
    radius_m, side = 1.0 / max(abs(curvature), 1e-4), math.copysign(1.0, curvature)
    best_m = look_m
    for x_m, y_m in points:
        half_m = HALF_WIDTH_M + margin_m
        if x_m < NOSE_M:  # beside the body: what is near already may stay so, but come no nearer
            half_m = max(HALF_WIDTH_M, min(HALF_WIDTH_M + BESIDE_M, abs(y_m) - 0.02))
        inward_m = radius_m - side * y_m
        rho_m, phi = math.hypot(x_m, inward_m), math.atan2(x_m, inward_m)
        if phi < 0.0 or rho_m < radius_m - half_m or rho_m > math.hypot(radius_m + half_m, NOSE_M):
            continue
        if rho_m > radius_m + half_m and phi < math.acos((radius_m + half_m) / rho_m):
            continue  # outside of the body's flank, which only moves away from it
        phi_hit = math.asin(min(NOSE_M / rho_m, 1.0))
        if radius_m - half_m < rho_m:
            phi_hit = min(phi_hit, math.acos(min((radius_m - half_m) / rho_m, 1.0)))
        best_m = min(best_m, max((phi - phi_hit) * radius_m, 0.0))
    return best_m


def binary(free_m: Sequence[float], before: Sequence[bool], blocked_m: float, enough_m: float) -> list[bool]:
    """Say which sectors are free: those with free way enough, and those that were free and are not yet blocked."""
    return [m >= enough_m or (was and m > blocked_m) for m, was in zip(free_m, before, strict=True)]


def sector(steer_rad: float) -> int:
    """Give the sector of a road-wheel angle."""
    return min(max(round(steer_rad / STEP_RAD) + SECTORS // 2, 0), SECTORS - 1)


def choose(free: Sequence[bool], wanted_rad: float, wheels_rad: float, last_rad: float) -> int | None:
    """Give the free sector of least cost; None if there is none."""

    def cost(k: int) -> float:
        return sum(
            weight * abs(ANGLES[k] - ANGLES[sector(rad)])
            for weight, rad in ((WANTED, wanted_rad), (WHEELS, wheels_rad), (LAST, last_rad))
        )

    return min((k for k in range(SECTORS) if free[k]), key=cost, default=None)
