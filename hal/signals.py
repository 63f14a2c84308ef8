"""The vocabulary of the cart: every record that travels through the store, and the geometry that they share.

Frames: M map (east, north, up, metres from the site's origin), C cart (centre of the rear axle; x forward, y left),
G GPS antenna. Angles are radians, counter-clockwise; yaw counts from east. Degrees stay inside device codecs.
`t_data_ns` of a sample says when a record was true; records carry no stamp of their own.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated

from rtdb.records import Record, array, enum8, f8, flag, i64, seq, text, u8, u32

# -- geometry -------------------------------------------------------------------------------------------------------


def yaw_of_heading(heading_rad: float) -> float:
    """Turn a compass heading (clockwise from true north) into a yaw (counter-clockwise from east), in (-pi, pi]."""
    return wrap(math.pi / 2 - heading_rad)


def heading_of_yaw(yaw_rad: float) -> float:
    """Turn a yaw into a heading in [0, 2 pi)."""
    return (math.pi / 2 - yaw_rad) % (2 * math.pi)


def wrap(angle_rad: float) -> float:
    """Wrap an angle into (-pi, pi]."""
    return math.pi - (math.pi - angle_rad) % (2 * math.pi)


@dataclass(frozen=True, slots=True)
class LocalPlane:
    """East-north plane tangent at a site's origin: metres per radian from the WGS-84 series at its latitude.

    The east scale is that of the origin's latitude: at 100 m east and north of it that is wrong by 1.3 mm, at a
    kilometre by 0.13 m. Source: series in docs/cart.md, as used by geodetic surveys.
    """

    lat_rad: float
    lon_rad: float
    north_m_per_rad: float
    east_m_per_rad: float

    @classmethod
    def at(cls, lat_rad: float, lon_rad: float) -> "LocalPlane":
        """Make the plane at an origin."""
        c = math.cos
        north = 111_132.95 - 559.85 * c(2 * lat_rad) + 1.18 * c(4 * lat_rad)
        east = 111_412.88 * c(lat_rad) - 93.5 * c(3 * lat_rad) + 0.12 * c(5 * lat_rad)
        return cls(lat_rad, lon_rad, math.degrees(north), math.degrees(east))

    def to_map(self, lat_rad: float, lon_rad: float) -> tuple[float, float]:
        """Give (x_m, y_m) in M of a geographic position."""
        return wrap(lon_rad - self.lon_rad) * self.east_m_per_rad, (lat_rad - self.lat_rad) * self.north_m_per_rad

    def to_geo(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Give (lat_rad, lon_rad) of a point in M."""
        return self.lat_rad + y_m / self.north_m_per_rad, self.lon_rad + x_m / self.east_m_per_rad


# -- mission: known before the drive ---------------------------------------------------------------------------------


class Site(Record, frozen=True):
    """Where the map's origin is on Earth."""

    name: Annotated[str, text(32, "name of the site")] = ""
    lat_rad: Annotated[float, f8("rad", "latitude of the origin, WGS-84")] = 0.0
    lon_rad: Annotated[float, f8("rad", "longitude of the origin, WGS-84")] = 0.0
    alt_m: Annotated[float, f8("m", "altitude of the origin over sea level")] = 0.0


class Course(Record, frozen=True):
    """Way-points to visit in order, each a GPS coordinate with a target radius, as in the P545 field trials."""

    lat_rad: Annotated[tuple[float, ...], seq("f8", 64, "rad", "latitude of each way-point")] = ()
    lon_rad: Annotated[tuple[float, ...], seq("f8", 64, "rad", "longitude of each way-point")] = ()
    radius_m: Annotated[tuple[float, ...], seq("f8", 64, "m", "target radius of each way-point")] = ()
    speed_mps: Annotated[float, f8("m/s", "largest speed wanted")] = 0.0
    start_lat_rad: Annotated[float, f8("rad", "latitude of the start mark, on which the crew puts C")] = 0.0
    start_lon_rad: Annotated[float, f8("rad", "longitude of the start mark")] = 0.0
    start_sigma_m: Annotated[float, f8("m", "how well they do that, standard deviation per axis; 0 = no mark")] = 0.0
    start_yaw_rad: Annotated[float, f8("rad", "yaw of the start mark")] = 0.0
    start_yaw_sigma_rad: Annotated[float, f8("rad", "how well they line the cart up, standard deviation")] = 0.0


# -- sensors ---------------------------------------------------------------------------------------------------------


class FixQuality(IntEnum):
    """Quality field of GGA."""

    NONE = 0
    AUTONOMOUS = 1
    DIFFERENTIAL = 2
    PPS = 3
    RTK_FIXED = 4
    RTK_FLOAT = 5
    DEAD_RECKONING = 6
    MANUAL = 7
    SIMULATOR = 8


class GpsFix(Record, frozen=True):
    """One epoch of the GPS receiver. Without a fix (mode 1) the position is the last one and means nothing."""

    mode: Annotated[int, u8("", "1 no fix, 2 position, 3 position and altitude")] = 1
    quality: Annotated[FixQuality, enum8("kind of fix")] = FixQuality.NONE
    lat_rad: Annotated[float, f8("rad", "latitude of the antenna G, WGS-84")] = 0.0
    lon_rad: Annotated[float, f8("rad", "longitude of the antenna G, WGS-84")] = 0.0
    alt_m: Annotated[float, f8("m", "altitude of G over sea level; valid in mode 3")] = 0.0
    satellites: Annotated[int, u8("", "satellites used")] = 0
    hdop: Annotated[float, f8("", "horizontal dilution of precision, 0 = unknown")] = 0.0
    sigma_east_m: Annotated[float, f8("m", "receiver's own standard deviation, 0 = unknown")] = 0.0
    sigma_north_m: Annotated[float, f8("m", "receiver's own standard deviation, 0 = unknown")] = 0.0
    speed_mps: Annotated[float, f8("m/s", "speed over ground, 0 if unknown")] = 0.0
    course_valid: Annotated[bool, flag("course_rad is valid: the receiver gives none when standing")] = False
    course_rad: Annotated[float, f8("rad", "yaw of the velocity over ground")] = 0.0
    time_of_day_s: Annotated[float, f8("s", "UTC time of the measurement since midnight, -1 = unknown")] = -1.0
    utc_ns: Annotated[int, i64("ns", "UTC of the measurement since 1970, 0 = date unknown")] = 0


class CompassHeading(Record, frozen=True):
    """One reading of the compass, turned to true north by the declination of place and date."""

    yaw_rad: Annotated[float, f8("rad", "yaw of the cart, declination applied, in (-pi, pi]")] = 0.0
    pitch_rad: Annotated[float, f8("rad", "nose up positive")] = 0.0
    roll_rad: Annotated[float, f8("rad", "left side up positive")] = 0.0
    valid: Annotated[bool, flag("the compass gives a heading and raises no alarm")] = False


class Scan(Record, frozen=True):
    """One sweep of a planar range scanner, counter-clockwise from `first_rad` in steps of `step_rad`, in C."""

    first_rad: Annotated[float, f8("rad", "direction of the first ray, 0 = ahead, left positive")] = 0.0
    step_rad: Annotated[float, f8("rad", "angle between rays")] = 0.0
    max_m: Annotated[float, f8("m", "reach; a range of this size means that nothing was seen")] = 0.0
    mount_x_m: Annotated[float, f8("m", "the scanner's place ahead of the rear axle")] = 0.0
    range_m: Annotated[tuple[float, ...], seq("f4", 181, "m", "range of each ray")] = ()


class Odometry(Record, frozen=True):
    """Wheel odometry from the free-running tick counters of the rear wheels."""

    left_m: Annotated[float, f8("m", "travel of the left wheel since the driver started, backward counts down")] = 0.0
    right_m: Annotated[float, f8("m", "travel of the right wheel")] = 0.0
    speed_mps: Annotated[float, f8("m/s", "mean speed of both wheels over the last 100 ms")] = 0.0
    valid: Annotated[bool, flag("both wheels report")] = False
    frames_lost: Annotated[int, u32("", "frames missed so far; travel is not lost with them")] = 0


# -- actuators and safety ---------------------------------------------------------------------------------------------


class SystemState(IntEnum):
    """State of the safety node."""

    INIT = 0
    MANUAL = 1
    READY = 2
    ENABLED = 3
    OVERRIDE = 4
    STOPPING = 5
    FAULT = 6
    ESTOP = 7


def state_of(code: int) -> SystemState:
    """Name a state from the bus; one that is not defined is as bad as a fault."""
    return _STATES.get(code, SystemState.FAULT)


_STATES = {int(state): state for state in SystemState}


class SafetyState(Record, frozen=True):
    """What the safety node reports."""

    state: Annotated[SystemState, enum8("state of the node")] = SystemState.INIT
    estop: Annotated[bool, flag("emergency stop is active")] = False
    host_timeout: Annotated[bool, flag("the host was silent")] = False
    bad_crc: Annotated[bool, flag("frames of the host had wrong checksums")] = False
    bad_counter: Annotated[bool, flag("frames of the host were missing or repeated, or its data cycle stood still")] = (
        False
    )
    override: Annotated[bool, flag("a person took over")] = False
    fault_code: Annotated[int, u32("", "0 none; see docs/cart.md")] = 0


class ActuatorState(Record, frozen=True):
    """What the steering, brake and drive nodes report."""

    steer_rad: Annotated[float, f8("rad", "road-wheel angle, left positive")] = 0.0
    steer_command_rad: Annotated[float, f8("rad", "angle that the node is asked for")] = 0.0
    brake: Annotated[float, f8("1", "brake effort [0, 1]")] = 0.0
    brake_command: Annotated[float, f8("1", "effort that the brake node applies")] = 0.0
    drive: Annotated[float, f8("1", "drive torque as a fraction of the largest [-1, 1]")] = 0.0
    steer_enabled: Annotated[bool, flag("the steering node obeys the host")] = False
    brake_enabled: Annotated[bool, flag("the brake node obeys the host")] = False
    drive_enabled: Annotated[bool, flag("the drive node obeys the host")] = False
    rejected: Annotated[bool, flag("a node refused a frame since the last report")] = False


class DriveCommand(Record, frozen=True):
    """How to drive: a speed to reach and a steering angle."""

    speed_mps: Annotated[float, f8("m/s", "speed wanted, backward negative", low=-1.5, high=5.5)] = 0.0
    steer_rad: Annotated[float, f8("rad", "road-wheel angle wanted, left positive", low=-0.47, high=0.47)] = 0.0
    decel_mps2: Annotated[float, f8("m/s2", "largest deceleration to use when slowing down", low=0.0, high=1.5)] = 1.5


STOP = DriveCommand()


class PedalCommand(Record, frozen=True):
    """How to drive, nearer to the actuators: pedals instead of a speed. Passed while the motion is in the envelope."""

    steer_rad: Annotated[float, f8("rad", "road-wheel angle wanted, left positive", low=-0.47, high=0.47)] = 0.0
    throttle: Annotated[float, f8("1", "share of the drive force, backward negative", low=-1.0, high=1.0)] = 0.0
    brake: Annotated[float, f8("1", "brake effort; above 0 the throttle counts for nothing", low=0.0, high=1.0)] = 0.0


class Limit(IntEnum):
    """Why the limits did not pass a command as it was."""

    NONE = 0
    NO_COMMAND = 1
    STALE = 2
    NOT_FINITE = 3
    SPEED = 4
    STEER = 5
    LATERAL = 6


class ActuatorCommand(Record, frozen=True):
    """What the host sends to the nodes."""

    speed_mps: Annotated[float, f8("m/s", "speed asked of the drive node")] = 0.0
    steer_rad: Annotated[float, f8("rad", "angle asked of the steering node")] = 0.0
    brake: Annotated[float, f8("1", "effort asked of the brake node [0, 1]")] = 0.0
    enable: Annotated[bool, flag("the host asks to be obeyed")] = False
    limit: Annotated[Limit, enum8("why the command was changed")] = Limit.NONE
    origin_cycle: Annotated[int, i64("", "data cycle of the command, as sent in SYSTEM_CMD")] = 0


class LinkCounters(Record, frozen=True):
    """What a transport counted. Not part of the trace."""

    received: Annotated[int, u32("", "good frames or sentences")] = 0
    damaged: Annotated[int, u32("", "refused: wrong checksum, length or syntax")] = 0
    lost: Annotated[int, u32("", "missing by their counter")] = 0


# -- autonomy ---------------------------------------------------------------------------------------------------------


class Pose(Record, frozen=True):
    """Where the cart is: C in M, estimated."""

    x_m: Annotated[float, f8("m", "east")] = 0.0
    y_m: Annotated[float, f8("m", "north")] = 0.0
    yaw_rad: Annotated[float, f8("rad", "yaw, in (-pi, pi]")] = 0.0
    speed_mps: Annotated[float, f8("m/s", "speed of C, forward positive")] = 0.0
    yaw_rate_radps: Annotated[float, f8("rad/s", "yaw rate")] = 0.0
    covariance: Annotated[tuple[float, ...], array("f8", 9, "m2, m rad, rad2", "of (x, y, yaw), row by row")] = (
        0.0,
    ) * 9
    sigma_m: Annotated[float, f8("m", "largest standard deviation of the position in any direction")] = 0.0
    fix_age_s: Annotated[float, f8("s", "time since the last position fix that was used")] = 0.0


class FollowState(Record, frozen=True):
    """Progress along the course."""

    waypoint: Annotated[int, u32("", "index of the way-point aimed at")] = 0
    finished: Annotated[bool, flag("the last way-point is reached")] = False
    lateral_error_m: Annotated[float, f8("m", "signed distance of C from the course line, left positive")] = 0.0


class PlanState(Record, frozen=True):
    """What the route planner found."""

    found: Annotated[bool, flag("there is a way to all way-points that are left")] = False
    length_m: Annotated[float, f8("m", "length of the route, from where the cart was when it was planned")] = 0.0
    reason: Annotated[str, text(160, "why there is none")] = ""


class AvoidState(Record, frozen=True):
    """What the avoider sees. Its sectors are road-wheel angles, from right to left."""

    turned: Annotated[bool, flag("it steers elsewhere than it is told to")] = False
    stuck: Annotated[bool, flag("no sector is free: it stands")] = False
    first_rad: Annotated[float, f8("rad", "road-wheel angle of the first sector")] = 0.0
    step_rad: Annotated[float, f8("rad", "angle between sectors")] = 0.0
    free_m: Annotated[tuple[float, ...], seq("f4", 64, "m", "free way of the body in each sector; none: no scan")] = ()


class Hold(IntEnum):
    """Why the guard holds the cart back."""

    NONE = 0
    NO_COMMAND = 1
    UNCERTAIN = 2
    OUTSIDE = 3
    OBSTACLE = 4


class GuardState(Record, frozen=True):
    """What the guard thinks."""

    hold: Annotated[Hold, enum8("why it holds the cart back")] = Hold.NONE


class ModuleState(IntEnum):
    """State of a module, as its host sees it."""

    WAITING = 0
    RUNNING = 1
    STALE = 2
    FAULT = 3
    LATE = 4


class ModuleStatus(Record, frozen=True):
    """What a module's host says of it."""

    state: Annotated[ModuleState, enum8("state of the module")] = ModuleState.WAITING
    steps: Annotated[int, u32("", "steps done when the state last changed")] = 0
    reason: Annotated[str, text(160, "why it does not run, or what became of new wiring")] = ""


class ModuleTiming(Record, frozen=True):
    """What the steps of a module with a budget took on this machine. Not part of the trace."""

    steps: Annotated[int, u32("", "steps timed")] = 0
    last_s: Annotated[float, f8("s", "the last step")] = 0.0
    longest_s: Annotated[float, f8("s", "the longest step")] = 0.0
    over_budget: Annotated[int, u32("", "steps that took longer than the budget")] = 0


# -- truth: only in the world store, which modules never see -----------------------------------------------------------


class CartTruth(Record, frozen=True):
    """Where the simulated cart really is: C in M."""

    x_m: Annotated[float, f8("m", "east")] = 0.0
    y_m: Annotated[float, f8("m", "north")] = 0.0
    yaw_rad: Annotated[float, f8("rad", "yaw, continuous")] = 0.0
    speed_mps: Annotated[float, f8("m/s", "forward speed of C")] = 0.0
    yaw_rate_radps: Annotated[float, f8("rad/s", "yaw rate")] = 0.0
    accel_x_mps2: Annotated[float, f8("m/s2", "forward acceleration")] = 0.0
    accel_y_mps2: Annotated[float, f8("m/s2", "lateral acceleration, left positive")] = 0.0
    steer_rad: Annotated[float, f8("rad", "road-wheel angle")] = 0.0
    brake: Annotated[float, f8("1", "brake effort")] = 0.0
    distance_m: Annotated[float, f8("m", "path length driven")] = 0.0


class ObstacleKind(IntEnum):
    """What stands about."""

    BOX = 0
    CAR = 1
    POST = 2
    ISLAND = 3
    KERB = 4
    PERSON = 5
    WALL = 6


class Scene(Record, frozen=True):
    """The static world in M: boxes by their centre, and the outline of the area that may be driven."""

    kind: Annotated[tuple[int, ...], seq("u8", 192, "", "ObstacleKind of each box")] = ()
    x_m: Annotated[tuple[float, ...], seq("f4", 192, "m", "east of the centre")] = ()
    y_m: Annotated[tuple[float, ...], seq("f4", 192, "m", "north of the centre")] = ()
    z_m: Annotated[tuple[float, ...], seq("f4", 192, "m", "height of the centre over the origin")] = ()
    yaw_rad: Annotated[tuple[float, ...], seq("f4", 192, "rad", "direction of the length")] = ()
    length_m: Annotated[tuple[float, ...], seq("f4", 192, "m", "size along its yaw")] = ()
    width_m: Annotated[tuple[float, ...], seq("f4", 192, "m", "size across")] = ()
    height_m: Annotated[tuple[float, ...], seq("f4", 192, "m", "size upward")] = ()
    boundary_x_m: Annotated[tuple[float, ...], seq("f4", 32, "m", "corners of the area that may be driven, east")] = ()
    boundary_y_m: Annotated[tuple[float, ...], seq("f4", 32, "m", "north")] = ()


class ActorsTruth(Record, frozen=True):
    """Where the moving actors really are, in M."""

    kind: Annotated[tuple[int, ...], seq("u8", 8, "", "ObstacleKind of each actor")] = ()
    x_m: Annotated[tuple[float, ...], seq("f8", 8, "m", "east")] = ()
    y_m: Annotated[tuple[float, ...], seq("f8", 8, "m", "north")] = ()
    yaw_rad: Annotated[tuple[float, ...], seq("f8", 8, "rad", "direction of walking")] = ()


class Clearance(Record, frozen=True):
    """How close the cart's body really is to anything that it must not touch."""

    distance_m: Annotated[float, f8("m", "to the nearest obstacle or actor, at most 5; negative when touching")] = 5.0
    collided: Annotated[bool, flag("it has touched something since the start")] = False
    kind: Annotated[ObstacleKind, enum8("what the nearest thing is")] = ObstacleKind.BOX


class FaultEvent(Record, frozen=True):
    """A fault that the scenario injects begins or ends."""

    kind: Annotated[str, text(32, "kind of fault")] = ""
    active: Annotated[bool, flag("it begins")] = False
