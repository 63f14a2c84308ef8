"""Seats: the places in a stack that a learned policy takes. Each is a module with an action in [-1, 1] for its step.

A seat looks (numbers of its features), something decides (an action), and the seat acts (outputs). In a gymnasium
environment the caller of `env.step` decides; in a drive a trained network does (`autonomy/policy.py`). Everything else
is the same code on the same inputs, so an episode and a drive of the same seed are the same, byte for byte.

A seat that drives acts neutrally (stands) until the safety node has enabled the cart and a first fix has come.
"""

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar

from autonomy import Input, Module, Output
from hal.signals import (
    STOP,
    ActuatorState,
    CompassHeading,
    Course,
    DriveCommand,
    FollowState,
    GpsFix,
    LocalPlane,
    Odometry,
    PedalCommand,
    Pose,
    SafetyState,
    Scan,
    Scene,
    Site,
    SystemState,
    wrap,
)

from . import features
from .features import ACTION, AHEAD, COMPASS, GPS, LINE, MOTION, RANGES, TRAVEL, WANTED, Feature, Line

MAX_STEER_RAD = 0.46
TRACK_M = 0.90


class Seat(Module):
    """Base of all seats."""

    sees: ClassVar[tuple[Feature, ...]] = ()
    n_actions: ClassVar[int] = 2
    drives: ClassVar[bool] = True  # commands the cart, and waits until it may
    _estimate: Pose | None = None

    site = Input(Site, static=True, pointer="mission/site")
    course = Input(Course, static=True, pointer="mission/course")
    odometry = Input(Odometry, max_age_s=0.5, pointer="odometry/travel")
    gps = Input(GpsFix, optional=True, static=True, pointer="gps/fix")
    compass = Input(CompassHeading, optional=True, static=True, max_age_s=0.5, pointer="compass/heading")
    wheels = Input(ActuatorState, optional=True, static=True, max_age_s=0.5, pointer="actuators/state")
    safety = Input(SafetyState, optional=True, static=True, pointer="safety/state")

    def reset(self) -> None:
        """Forget everything."""
        self.ready = False
        self.action = self.chosen = (0.0,) * self.n_actions
        self._line: Line | None = None
        self._plane = LocalPlane.at(0.0, 0.0)
        self._travel: Odometry | None = None
        self._x_m = self._y_m = self._yaw_rad = self._turn_radps = 0.0
        self._looked: tuple[int, list[float]] = (-1, [])

    def step(self) -> None:
        """Look, decide, act."""
        numbers = self.look()
        if self.ready:
            self.action = tuple(self.decide(numbers))
            self.act(self.action)
        else:
            self.rest()

    def decide(self, numbers: list[float]) -> Sequence[float]:
        """Choose an action (n_actions,) in [-1, 1] from the numbers of the features; here, what `chosen` says."""
        return self.chosen

    @abstractmethod
    def see(self) -> list[float]:
        """Give the numbers of the features."""

    @abstractmethod
    def act(self, action: Sequence[float]) -> None:
        """Turn an action into outputs."""

    @abstractmethod
    def rest(self) -> None:
        """Give outputs that do nothing, before the cart is ready."""

    def look(self) -> list[float]:
        """Give the numbers of the features at this step; asked again in the same step, the same ones."""
        if self._looked[0] != self.t_ns:
            self._move()
            if not self.ready:
                enabled = self.safety is not None and self.safety.state is SystemState.ENABLED
                self.ready = (enabled or not self.drives) and self.gps is not None and self.gps.mode >= 2
            self._looked = self.t_ns, self.see()
        return self._looked[1]

    @property
    def steering(self) -> float:
        """The steering of the last action, full right to full left in [-1, 1]; 0 for who does not steer."""
        return 0.0

    @property
    def estimate(self) -> Pose | None:
        """The pose that it said last, if that is its task."""
        return self._estimate

    def place(self) -> tuple[float, float, float]:
        """Give (x_m, y_m, yaw_rad) of C in M, as this seat knows it: by the wheels, from the start mark."""
        return self._x_m, self._y_m, self._yaw_rad

    def _move(self) -> None:
        """Follow the wheels, and find the place on the line."""
        odometry, before = self.odometry, self._travel
        if self._line is None:
            self._plane = LocalPlane.at(self.site.lat_rad, self.site.lon_rad)
            if self.course.start_sigma_m > 0:
                self._x_m, self._y_m = self._plane.to_map(self.course.start_lat_rad, self.course.start_lon_rad)
                self._yaw_rad = self.course.start_yaw_rad
            self._line = Line(self.site, self.course, self.place()[:2])
        if before is not None:
            left_m, right_m = odometry.left_m - before.left_m, odometry.right_m - before.right_m
            turn_rad, along_m = (right_m - left_m) / TRACK_M, (left_m + right_m) / 2
            middle_rad = self._yaw_rad + turn_rad / 2
            self._x_m += along_m * math.cos(middle_rad)
            self._y_m += along_m * math.sin(middle_rad)
            self._yaw_rad = wrap(self._yaw_rad + turn_rad)
            self._turn_radps = turn_rad / self.dt_s
        self._travelled = (left_m, right_m) if before is not None else (0.0, 0.0)
        self._travel = odometry
        x_m, y_m, _ = self.place()
        self._line.move(x_m, y_m)

    def _on_line(self) -> list[float]:
        """Give the numbers of MOTION, LINE, AHEAD."""
        assert self._line is not None
        x_m, y_m, yaw_rad = self.place()
        steer_rad = self.wheels.steer_rad if self.wheels is not None else 0.0
        return [
            self.odometry.speed_mps,
            self._turn_radps,
            steer_rad,
            *self._line.aside(x_m, y_m, yaw_rad),
            *self._line.ahead(x_m, y_m, yaw_rad),
        ]

    def _command(self, action: Sequence[float]) -> DriveCommand:
        """Speed and steering: 0 to the course's speed, full right to full left. At the end of the line it stops."""
        if self._line is not None and self._line.finished:
            return DriveCommand(0.0, 0.0, 1.0)
        speed_mps = (action[0] + 1.0) / 2.0 * self.course.speed_mps
        return DriveCommand(speed_mps, action[1] * MAX_STEER_RAD, 1.0)


class DriverSeat(Seat):
    """The whole stack: from sensors to the command that the actuators obey."""

    sees: ClassVar[tuple[Feature, ...]] = (MOTION, LINE, AHEAD, GPS, COMPASS, RANGES, ACTION)
    scan = Input(Scan, optional=True, static=True, max_age_s=0.5, pointer="synlaser/scan")
    drive = Output(DriveCommand, safe=STOP)
    state = Output(FollowState, safe=FollowState())

    @property
    def steering(self) -> float:
        """The steering of the last action."""
        return self.action[1]

    def see(self) -> list[float]:
        """Give the numbers of the features."""
        place = self.place()
        return [
            *self._on_line(),
            *features.gps(self.gps, self._plane, *place),
            *features.compass(self.compass, place[2]),
            *features.ranges(self.scan),
            *self.action,
        ]

    def act(self, action: Sequence[float]) -> None:
        """Command speed and steering."""
        assert self._line is not None
        self.drive = self._command(action)
        self.state = FollowState(self._line.waypoint, self._line.finished, self._looked[1][3])

    def rest(self) -> None:
        """Stand."""
        assert self._line is not None
        self.drive, self.state = DriveCommand(0.0, 0.0, 1.0), FollowState(self._line.waypoint)


class PedalSeat(DriverSeat):
    """The whole stack, down to the pedals."""

    sees: ClassVar[tuple[Feature, ...]] = (*DriverSeat.sees[:-1], Feature("action", 3, -1.0, 1.0, ACTION.doc))
    n_actions: ClassVar[int] = 3
    pedals = Output(PedalCommand, safe=PedalCommand(brake=0.27))

    @property
    def steering(self) -> float:
        """The steering of the last action."""
        return self.action[0]

    def act(self, action: Sequence[float]) -> None:
        """Steering, full right to full left; throttle, 0 to 1 above 0; brake, 0 to 0.3 above 0."""
        super().act((0.0, action[0]))
        self.pedals = PedalCommand(action[0] * MAX_STEER_RAD, max(action[1], 0.0), 0.3 * max(action[2], 0.0))

    def rest(self) -> None:
        """Stand."""
        super().rest()
        self.pedals = PedalCommand(brake=0.15)


class FollowSeat(DriverSeat):
    """The follower: from the estimated pose to a command."""

    sees: ClassVar[tuple[Feature, ...]] = (MOTION, LINE, AHEAD, ACTION)
    pose = Input(Pose, max_age_s=0.25, pointer="localise/pose")

    def place(self) -> tuple[float, float, float]:
        """Give the estimated pose."""
        return self.pose.x_m, self.pose.y_m, self.pose.yaw_rad

    def see(self) -> list[float]:
        """Give the numbers of the features."""
        return [*self._on_line(), *self.action]


class AvoidSeat(FollowSeat):
    """The avoider: from the follower's command and the range scan to another command."""

    sees: ClassVar[tuple[Feature, ...]] = (MOTION, LINE, AHEAD, RANGES, WANTED, ACTION)
    drive_in = Input(DriveCommand, max_age_s=0.25, pointer="follow/drive")

    def see(self) -> list[float]:
        """Give the numbers of the features."""
        wanted = self.drive_in.speed_mps, self.drive_in.steer_rad
        return [*self._on_line(), *features.ranges(self.scan), *wanted, *self.action]

    def act(self, action: Sequence[float]) -> None:
        """Slow the command down, and turn it: (0, 0) passes it on."""
        assert self._line is not None
        steer_rad = min(max(self.drive_in.steer_rad + action[1] * MAX_STEER_RAD, -MAX_STEER_RAD), MAX_STEER_RAD)
        speed_mps = self.drive_in.speed_mps * (1.0 + min(action[0], 0.0))
        self.drive = DriveCommand(speed_mps, steer_rad, self.drive_in.decel_mps2)
        self.state = FollowState(self._line.waypoint, self._line.finished, self._looked[1][3])


class LocaliseSeat(Seat):
    """The localiser: corrects what the wheels say, by up to STEP_M and STEP_RAD per step."""

    sees: ClassVar[tuple[Feature, ...]] = (TRAVEL, MOTION, GPS, COMPASS, Feature("action", 3, -1.0, 1.0, ACTION.doc))
    n_actions: ClassVar[int] = 3
    drives: ClassVar[bool] = False
    STEP_M, STEP_RAD = 0.05, 0.01
    pose = Output(Pose, safe=Pose(sigma_m=1e3))

    def see(self) -> list[float]:
        """Give the numbers of the features."""
        place = self.place()
        steer_rad = self.wheels.steer_rad if self.wheels is not None else 0.0
        return [
            *self._travelled,
            self.odometry.speed_mps,
            self._turn_radps,
            steer_rad,
            *features.gps(self.gps, self._plane, *place),
            *features.compass(self.compass, place[2]),
            *self.action,
        ]

    def act(self, action: Sequence[float]) -> None:
        """Shift the pose ahead, to the left, and turn it."""
        c, n = math.cos(self._yaw_rad), math.sin(self._yaw_rad)
        ahead_m, left_m = action[0] * self.STEP_M, action[1] * self.STEP_M
        self._x_m += ahead_m * c - left_m * n
        self._y_m += ahead_m * n + left_m * c
        self._yaw_rad = wrap(self._yaw_rad + action[2] * self.STEP_RAD)
        self.rest()

    def rest(self) -> None:
        """Say where the wheels have it."""
        sample = self.samples.get("gps")
        fixed = self.gps is not None and self.gps.mode >= 2 and sample is not None
        age_s = (self.t_ns - sample.t_data_ns) * 1e-9 if fixed and sample is not None else 1e3
        self._estimate = self.pose = Pose(
            x_m=self._x_m,
            y_m=self._y_m,
            yaw_rad=self._yaw_rad,
            speed_mps=self.odometry.speed_mps,
            yaw_rate_radps=self._turn_radps,
            covariance=(0.25, 0.0, 0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 0.01),
            sigma_m=0.5,
            fix_age_s=age_s,
        )


class PlanSeat(Seat):
    """The planner: moves the middle of each leg of the course aside, by up to ASIDE_M. For stacks with a `plan`."""

    sees: ClassVar[tuple[Feature, ...]] = (MOTION, LINE, AHEAD, Feature("action", 8, -1.0, 1.0, ACTION.doc))
    n_actions: ClassVar[int] = 8
    drives: ClassVar[bool] = False
    ASIDE_M = 4.0
    map = Input(Scene, optional=True, static=True, pointer="mission/map")
    pose = Input(Pose, optional=True, static=True, max_age_s=0.5, pointer="localise/pose")
    route = Output(Course, safe=Course())

    def place(self) -> tuple[float, float, float]:
        """Give the estimated pose, or where the wheels have it."""
        pose = self.pose
        return super().place() if pose is None else (pose.x_m, pose.y_m, pose.yaw_rad)

    def see(self) -> list[float]:
        """Give the numbers of the features."""
        return [*self._on_line(), *self.action]

    def act(self, action: Sequence[float]) -> None:
        """Give a course with one way-point more on each of the first legs."""
        course, plane = self.course, self._plane
        here = plane.to_map(course.start_lat_rad, course.start_lon_rad)
        points: list[tuple[float, float, float]] = []
        for k, (lat, lon, radius_m) in enumerate(zip(course.lat_rad, course.lon_rad, course.radius_m, strict=True)):
            there = plane.to_map(lat, lon)
            length_m = math.dist(here, there)
            if k < self.n_actions and length_m > 1.0 and len(points) < 56:
                aside = action[k] * self.ASIDE_M / length_m
                dx, dy = there[0] - here[0], there[1] - here[1]
                points.append((here[0] + dx / 2 - aside * dy, here[1] + dy / 2 + aside * dx, 1.0))
            points.append((*there, radius_m))
            here = there
        geo = [plane.to_geo(x, y) for x, y, _ in points]
        self.route = Course(
            tuple(lat for lat, _ in geo),
            tuple(lon for _, lon in geo),
            tuple(radius_m for *_, radius_m in points),
            course.speed_mps,
            course.start_lat_rad,
            course.start_lon_rad,
            course.start_sigma_m,
            course.start_yaw_rad,
            course.start_yaw_sigma_rad,
        )

    def rest(self) -> None:
        """Pass the course on."""
        self.route = self.course


SEATS: dict[str, type[Seat]] = {
    "driver": DriverSeat,
    "pedals": PedalSeat,
    "localise": LocaliseSeat,
    "plan": PlanSeat,
    "follow": FollowSeat,
    "avoid": AvoidSeat,
}
"""By the component of a stack that they replace. `driver` is that of the stack `bare`, `pedals` of `pedals`."""
