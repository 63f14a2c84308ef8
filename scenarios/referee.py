"""The referee of an episode: reward by named terms, and whether the episode has to end, from the truth.

Reward of a step of dt seconds, in the order of `Reward`:

    progress    metres gained along the course line
    aside       -0.5 dt |distance from the line|
    steering    -0.1 |change of the steering action|
    jerk        -0.02 dt |change of acceleration| / dt, at most 10 m/s3
    estimate    -0.5 dt |error of the pose estimate|, for a localiser only
    arrived     +10 once, within the last way-point's radius of the end of the line
    ended       -10 once, when the episode is terminated
"""

import math
from enum import StrEnum
from typing import Annotated

from autonomy.features import Line
from hal.limits import Envelope
from hal.signals import Course, Pose
from hal.signals import Site as SiteRecord
from rtdb.records import Record, f8
from sim.cart import SimCart

BREACH = 1.5  # of what the envelope allows to be asked for
GRAVITY_MPS2 = 9.81


class End(StrEnum):
    """Why an episode was terminated."""

    NONE = ""
    COLLISION = "collision"
    OFF_COURSE = "off course"
    ROLLOVER = "rollover"
    ENVELOPE = "envelope"


class Reward(Record, frozen=True):
    """The terms of one step's reward. Beside the trace: a drive without a referee has none."""

    total: Annotated[float, f8("1", "sum of the terms")] = 0.0
    progress: Annotated[float, f8("m", "gained along the line")] = 0.0
    aside: Annotated[float, f8("1", "for being aside of the line")] = 0.0
    steering: Annotated[float, f8("1", "for turning the wheel")] = 0.0
    jerk: Annotated[float, f8("1", "for jerking")] = 0.0
    estimate: Annotated[float, f8("1", "for a wrong pose")] = 0.0
    arrived: Annotated[float, f8("1", "for having arrived")] = 0.0
    ended: Annotated[float, f8("1", "for an early end")] = 0.0


TERMS = Reward.__struct_fields__[1:]


class Referee:
    """Watches one episode. Call `judge` once per step."""

    def __init__(self, sim: SimCart, site: SiteRecord, course: Course, off_course_m: float) -> None:
        self._sim, self._envelope, self._off_course_m = sim, Envelope(), off_course_m
        self.line = Line(site, course)
        params = sim.setup.params
        self._rollover_mps2 = GRAVITY_MPS2 * params.track_m / (2.0 * params.cg_height_m)
        self._boundary = sim.setup.site.boundary_m
        self._accel_mps2 = 0.0
        self._steering = 0.0
        self.arrived = False
        stations = self.line.stations  # who has a wrong pose stops a little before the end, or beyond it
        near_m = stations[-1].s_m - course.radius_m[-1] if stations else 0.0
        self._arrival = sum(station.s_m < near_m for station in stations)
        s = sim.plant.state
        self.line.move(s.x_m, s.y_m)
        self._along_m = self.line.along(s.x_m, s.y_m)
        self.aside_m, self.heading_rad, _ = self.line.aside(s.x_m, s.y_m, s.yaw_rad)

    def judge(self, dt_s: float, steering: float, pose: Pose | None) -> tuple[Reward, End]:
        """Give the reward of the step that is over, and whether the episode has to end.

        steering: the steering action; pose: the estimate to be judged, None where that is not the task.
        """
        s = self._sim.plant.state
        self.line.move(s.x_m, s.y_m)
        before_m, self._along_m = self._along_m, self.line.along(s.x_m, s.y_m)
        self.aside_m, self.heading_rad, _ = self.line.aside(s.x_m, s.y_m, s.yaw_rad)
        end = self._end()
        jerk = min(abs(s.ax_mps2 - self._accel_mps2) / dt_s, 10.0)
        arrived = self.line.at >= self._arrival and not self.arrived
        terms = (
            self._along_m - before_m,
            -0.5 * dt_s * min(abs(self.aside_m), 3.0),
            -0.1 * abs(steering - self._steering),
            -0.02 * dt_s * jerk,
            0.0 if pose is None else -0.5 * dt_s * min(math.hypot(pose.x_m - s.x_m, pose.y_m - s.y_m), 10.0),
            10.0 if arrived else 0.0,
            -10.0 if end is not End.NONE else 0.0,
        )
        self._accel_mps2, self._steering = s.ax_mps2, steering
        self.arrived = self.arrived or arrived
        return Reward(sum(terms), *terms), end

    def truth(self) -> list[float]:
        """Give the numbers of the feature TRUTH."""
        s = self._sim.plant.state
        return [
            self.aside_m, self.heading_rad, s.vx_mps, s.yaw_rate_radps, s.vy_mps, s.steer_rad, s.brake,
            self._sim.nearest_m,
        ]  # fmt: skip

    def _end(self) -> End:
        s = self._sim.plant.state
        if self._sim.collided:
            return End.COLLISION
        if abs(self.aside_m) > self._off_course_m or not self._inside(s.x_m, s.y_m):
            return End.OFF_COURSE
        if abs(s.ay_mps2) > self._rollover_mps2:
            return End.ROLLOVER
        limits = self._envelope
        if abs(s.vx_mps) > BREACH * limits.max_speed_mps or abs(s.ay_mps2) > BREACH * limits.max_lateral_mps2:
            return End.ENVELOPE
        return End.NONE

    def _inside(self, x_m: float, y_m: float) -> bool:
        """Whether a point lies within the site's outline; where there is none, everything does."""
        corners, inside = self._boundary, True
        if corners:
            inside = False
            for k, (ax, ay) in enumerate(corners):
                bx, by = corners[k - 1]
                if (ay > y_m) != (by > y_m) and x_m < ax + (y_m - ay) / (by - ay) * (bx - ax):
                    inside = not inside
        return inside
