"""Metrics: numbers computed from a recording, whatever it came from. They see records, never a simulator.

A metric gives a value and, where that makes sense, when it came about; None where the recording lacks what it needs.
"""

import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

from hal.signals import (
    ActuatorCommand,
    ActuatorState,
    CartTruth,
    Clearance,
    Course,
    FaultEvent,
    GuardState,
    Hold,
    LinkCounters,
    LocalPlane,
    Pose,
    SafetyState,
    Site,
    SystemState,
    wrap,
)
from rtdb.recording import Recorded, Recording

STANDING_MPS = 0.05


@dataclass(frozen=True, slots=True)
class Measured:
    """A metric's value and the time, since the start of the drive, at which it came about."""

    value: float
    at_s: float | None = None


@dataclass(frozen=True, slots=True)
class Metric:
    """A metric with its unit and meaning."""

    name: str
    unit: str
    doc: str
    measure: "Callable[[Evidence], Measured | None]"


METRICS: dict[str, Metric] = {}


def metric(unit: str) -> "Callable[[Callable[[Evidence], Measured | None]], Callable[[Evidence], Measured | None]]":
    """Register a metric under the function's name; its docstring is its meaning."""

    def register(measure: "Callable[[Evidence], Measured | None]") -> "Callable[[Evidence], Measured | None]":
        METRICS[measure.__name__] = Metric(measure.__name__, unit, (measure.__doc__ or "").strip(), measure)
        return measure

    return register


class Evidence:
    """A recording, with what several metrics need computed once."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording

    def time_s(self, row: Recorded[CartTruth] | Recorded[ActuatorState] | Recorded[FaultEvent]) -> float:
        """Time of a recorded row since the start."""
        return self.recording.time_s(row.cycle)

    @cached_property
    def truth(self) -> list[Recorded[CartTruth]]:
        """The true motion, empty on a real cart."""
        return self.recording.find("world/cart", CartTruth)

    @cached_property
    def waypoints(self) -> list[tuple[float, float, float]]:
        """Way-points as (x_m, y_m, radius_m) in M."""
        sites, courses = self.recording.find("mission/site", Site), self.recording.find("mission/course", Course)
        if not sites or not courses:
            return []
        plane, course = LocalPlane.at(sites[0].value.lat_rad, sites[0].value.lon_rad), courses[0].value
        return [
            (*plane.to_map(lat, lon), radius)
            for lat, lon, radius in zip(course.lat_rad, course.lon_rad, course.radius_m, strict=True)
        ]

    @cached_property
    def reached_s(self) -> list[float]:
        """When each way-point was first within its radius of C, in order, as far as the cart got."""
        out: list[float] = []
        for row in self.truth:
            while len(out) < len(self.waypoints):
                x, y, radius_m = self.waypoints[len(out)]
                if math.hypot(row.value.x_m - x, row.value.y_m - y) > radius_m:
                    break
                out.append(self.time_s(row))
        return out

    @cached_property
    def pose_errors(self) -> list[tuple[float, float]]:
        """(time, distance between estimated and true C), truth taken at the estimate's data time."""
        cycles = [row.cycle for row in self.truth]
        out = []
        for pose in self.recording.find("localise/pose", Pose):
            k = bisect_right(cycles, (pose.t_data_ns - self.recording.t0_ns) // self.recording.tick_ns) - 1
            if k >= 0 and pose.value.sigma_m < 100.0:
                true = self.truth[k].value
                out.append(
                    (
                        self.recording.time_s(pose.cycle),
                        math.hypot(pose.value.x_m - true.x_m, pose.value.y_m - true.y_m),
                    )
                )
        return out

    @cached_property
    def fault_s(self) -> float | None:
        """When the first fault of the scenario began."""
        faults = [row for row in self.recording.find("world/fault", FaultEvent) if row.value.active]
        return self.time_s(faults[0]) if faults else None

    @cached_property
    def moved_s(self) -> float:
        """When the cart first moved."""
        return next((self.time_s(row) for row in self.truth if abs(row.value.speed_mps) > STANDING_MPS), 0.0)

    def after_fault(self) -> list[Recorded[CartTruth]]:
        """The motion since the first fault."""
        return [row for row in self.truth if self.fault_s is not None and self.time_s(row) >= self.fault_s]


@metric("")
def waypoints_missed(e: Evidence) -> Measured | None:
    """Way-points that C did not come within the radius of, in order."""
    if not e.truth or not e.waypoints:
        return None
    return Measured(len(e.waypoints) - len(e.reached_s), e.reached_s[-1] if e.reached_s else 0.0)


@metric("s")
def finish_time_s(e: Evidence) -> Measured | None:
    """When the last way-point was reached; infinite if it was not."""
    if not e.truth or not e.waypoints:
        return None
    done = len(e.reached_s) == len(e.waypoints)
    last_s = e.reached_s[-1] if e.reached_s else 0.0
    return Measured(last_s if done else math.inf, last_s)


@metric("m/s")
def mean_speed_mps(e: Evidence) -> Measured | None:
    """Mean speed from the first movement to the last way-point reached; 0 if none was."""
    if not e.reached_s:
        return Measured(0.0) if e.truth and e.waypoints else None
    rows = [row for row in e.truth if e.moved_s <= e.time_s(row) <= e.reached_s[-1]]
    span_s = e.time_s(rows[-1]) - e.time_s(rows[0]) if len(rows) > 1 else 0.0
    return Measured((rows[-1].value.distance_m - rows[0].value.distance_m) / span_s) if span_s > 0 else None


@metric("m")
def course_deviation_max_m(e: Evidence) -> Measured | None:
    """Largest distance of C from the straight lines between start and way-points, until the last one is reached."""
    if not e.truth or not e.waypoints:
        return None
    first = e.truth[0].value
    line = [(first.x_m, first.y_m), *((x, y) for x, y, _ in e.waypoints)]
    end_s = e.reached_s[-1] if len(e.reached_s) == len(e.waypoints) else math.inf
    worst = Measured(0.0)
    for row in e.truth:
        if e.time_s(row) > end_s:
            break
        distance_m = min(_to_segment(row.value.x_m, row.value.y_m, a, b) for a, b in pairwise(line))
        if distance_m > worst.value:
            worst = Measured(distance_m, e.time_s(row))
    return worst


def _to_segment(x: float, y: float, a: tuple[float, float], b: tuple[float, float]) -> float:
    dx, dy = b[0] - a[0], b[1] - a[1]
    part = min(max(((x - a[0]) * dx + (y - a[1]) * dy) / max(dx * dx + dy * dy, 1e-12), 0.0), 1.0)
    return math.hypot(x - a[0] - part * dx, y - a[1] - part * dy)


@metric("m")
def pose_error_max_m(e: Evidence) -> Measured | None:
    """Largest distance between estimated and true position."""
    if not e.pose_errors:
        return None
    at_s, error_m = max(e.pose_errors, key=lambda row: row[1])
    return Measured(error_m, at_s)


@metric("m")
def pose_error_rms_m(e: Evidence) -> Measured | None:
    """Root mean square of that distance."""
    return Measured(math.sqrt(sum(d * d for _, d in e.pose_errors) / len(e.pose_errors))) if e.pose_errors else None


@metric("m/s2")
def lateral_accel_max_mps2(e: Evidence) -> Measured | None:
    """Largest lateral acceleration."""
    if not e.truth:
        return None
    row = max(e.truth, key=lambda row: abs(row.value.accel_y_mps2))
    return Measured(abs(row.value.accel_y_mps2), e.time_s(row))


@metric("m/s2")
def decel_max_mps2(e: Evidence) -> Measured | None:
    """Largest deceleration."""
    if not e.truth:
        return None
    row = min(e.truth, key=lambda row: row.value.accel_x_mps2)
    return Measured(max(0.0, -row.value.accel_x_mps2), e.time_s(row))


@metric("s")
def latency_max_s(e: Evidence) -> Measured | None:
    """Longest time from the oldest sensor data behind a command to the frame that carries it, while enabled."""
    worst: Measured | None = None
    for row in e.recording.find("actuators/command", ActuatorCommand):
        sent_ns = e.recording.t0_ns + (row.cycle - 1) * e.recording.tick_ns  # it shows one tick after it was sent
        if row.value.enable and (worst is None or (sent_ns - row.t_data_ns) / 1e9 > worst.value):
            worst = Measured((sent_ns - row.t_data_ns) / 1e9, e.recording.time_s(row.cycle))
    return worst


@metric("s")
def brake_delay_s(e: Evidence) -> Measured | None:
    """From the first fault to the first report of the brake node's braking that stops the cart."""
    if e.fault_s is None:
        return None
    braking_s = math.inf
    for row in e.recording.find("actuators/state", ActuatorState):
        if e.time_s(row) < e.fault_s:
            continue
        if row.value.brake_command < 0.02:
            braking_s = math.inf
        elif math.isinf(braking_s):
            braking_s = e.time_s(row)
        if row.value.brake_command > 0.2:  # for good
            return Measured(braking_s - e.fault_s, braking_s)
    return Measured(math.inf)


@metric("m")
def stop_distance_m(e: Evidence) -> Measured | None:
    """Distance travelled from the first fault to standstill; infinite if the cart did not stop."""
    rows = e.after_fault()
    if not rows:
        return None
    for row in rows:
        if abs(row.value.speed_mps) < STANDING_MPS:
            return Measured(row.value.distance_m - rows[0].value.distance_m, e.time_s(row))
    return Measured(math.inf)


@metric("m/s")
def speed_at_fault_mps(e: Evidence) -> Measured | None:
    """How fast the cart was when the first fault began: a stop from standstill would prove nothing."""
    rows = e.after_fault()
    return Measured(rows[0].value.speed_mps, e.fault_s) if rows else None


@metric("m/s")
def final_speed_mps(e: Evidence) -> Measured | None:
    """Speed at the end of the recording."""
    return Measured(abs(e.truth[-1].value.speed_mps), e.time_s(e.truth[-1])) if e.truth else None


@metric("rad")
def heading_error_max_rad(e: Evidence) -> Measured | None:
    """Largest error of the estimated yaw."""
    cycles = [row.cycle for row in e.truth]
    worst: Measured | None = None
    for pose in e.recording.find("localise/pose", Pose) if e.truth else []:
        k = bisect_right(cycles, (pose.t_data_ns - e.recording.t0_ns) // e.recording.tick_ns) - 1
        if k >= 0:
            error = abs(wrap(pose.value.yaw_rad - e.truth[k].value.yaw_rad))
            if worst is None or error > worst.value:
                worst = Measured(error, e.recording.time_s(pose.cycle))
    return worst


@metric("")
def safety_trips(e: Evidence) -> Measured | None:
    """How often the safety node went from enabled to stopping, fault or emergency stop."""
    states = e.recording.find("safety/state", SafetyState)
    bad = (SystemState.STOPPING, SystemState.FAULT, SystemState.ESTOP)
    trips = [b for a, b in pairwise(states) if a.value.state is SystemState.ENABLED and b.value.state in bad]
    return Measured(len(trips), e.recording.time_s(trips[0].cycle) if trips else None) if states else None


@metric("")
def collisions(e: Evidence) -> Measured | None:
    """1 if the cart's body touched anything, else 0; where nothing stands about, there is nothing to touch."""
    rows = e.recording.find("world/clearance", Clearance)
    hit = next((row for row in rows if row.value.collided), None)
    if not rows:
        return Measured(0) if e.truth else None
    return Measured(1, e.recording.time_s(hit.cycle)) if hit else Measured(0)


@metric("m")
def clearance_min_m(e: Evidence) -> Measured | None:
    """Smallest distance between the cart's body and anything that it must not touch, at most 5."""
    rows = e.recording.find("world/clearance", Clearance)
    if not rows:
        return None
    row = min(rows, key=lambda row: row.value.distance_m)
    return Measured(row.value.distance_m, e.recording.time_s(row.cycle))


@metric("s")
def guard_hold_s(e: Evidence) -> Measured | None:
    """How long the guard held the cart back, after it had first let it go."""
    rows = e.recording.find("guard/state", GuardState)
    held_s, first, free = 0.0, None, False
    for a, b in pairwise(rows):
        free = free or a.value.hold is Hold.NONE
        if free and a.value.hold is not Hold.NONE:
            held_s += e.recording.time_s(b.cycle) - e.recording.time_s(a.cycle)
            first = first if first is not None else e.recording.time_s(a.cycle)
    return Measured(held_s, first) if rows else None


@metric("")
def frames_damaged(e: Evidence) -> Measured | None:
    """CAN frames that the host refused."""
    rows = e.recording.find("actuators/counters", LinkCounters)
    return Measured(rows[-1].value.damaged) if rows else None


@metric("s")
def first_trip_s(e: Evidence) -> Measured | None:
    """When the safety node first stopped the cart; infinite if it never did."""
    trips = METRICS["safety_trips"].measure(e)
    return None if trips is None else Measured(trips.at_s, trips.at_s) if trips.at_s is not None else Measured(math.inf)
