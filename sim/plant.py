"""The planar cart: one tyre per axle, three degrees of freedom, a fixed sequence of scalar operations.

This is the readable form, and the reference for the compiled kernel of the same equations. It uses only
+, -, *, /, comparisons, `sqrt`, `sin` and `cos`, in the order written, so that another language can follow.

Sources
    motion        single-track ("bicycle") model: Rajamani, Vehicle Dynamics and Control, 2012, chapters 2, 3
    lateral force Fiala's brush tyre: Pacejka, Tyre and Vehicle Dynamics, 2012, chapter 3
    slip          relaxation of the slip tangent, with damping at parking speed: Pacejka, chapter 8
    numbers       stand beside each parameter; "assumption" marks a plausible one without a measurement

How one step goes (semi-implicit Euler: forces use the new slip, the pose uses the new velocity)
    1. actuators   lag (trapezoidal rule), steering rate limit
    2. axle loads  weight, and the acceleration of the step before (quasi-static)
    3. slip        sigma dt'/dt = -v_side - |v_roll| t', implicit in t', so that v = 0 is not singular
    4. turning     the axes turn under the velocity: an exact rotation, which adds no energy
    5. along x     drive, slope, drag; then brake and rolling resistance as dry friction: at most what stops
                   the cart within this step, so they hold but never push
    6. across      Fiala, limited to what the longitudinal force leaves of the friction ellipse
    7. motion      velocity, then pose

A wheel locks when its brake asks for more than friction gives. Then friction points against the direction of
sliding: mu Fz cos(theta) along the wheel, mu Fz sin(theta) across, theta being the angle of sliding. At small
angles that is little side force, which is why a cart with locked rear wheels swaps ends (Seluga and Ojalvo,
Accident Analysis and Prevention 38(6), 2006).

Frames: M is the map (x east, y north), C the centre of the rear axle (x forward, y left). Slopes are small:
the pose advances as if distance along the slope were distance on the map (0.1 % wrong on a 5 % slope).
No roll, no load transfer from left to right, no spin of the wheels. Inputs must be finite: the limits in
front of the plant see to that.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import cos, pi, sin, sqrt
from typing import Protocol

import msgspec

GRAVITY_MPS2 = 9.81
STEP_S = 0.005
"""Default step. 0.010 is stable and allowed for training."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CartParams:
    """The simulated cart. A number without a source is an assumption; vary those in randomised runs."""

    # Body
    mass_kg: float = 480.0  # empty 410-450 kg (Wikipedia, "Golf cart"), plus computers and sensors
    load_kg: float = 0.0  # 0..240: up to two people and bags (assumption); sits at the centre of gravity
    wheelbase_m: float = 1.66  # 65.5 in, Club Car Tempo, as given in a web article
    track_m: float = 0.90  # assumption, between 0.88 front and 0.98 rear
    cg_height_m: float = 0.55  # assumption; 0.5-0.75 with two people
    front_weight_share: float = 0.47  # assumption; with the stiffnesses below the cart understeers a little
    yaw_inertia_kgm2: float = 420.0  # assumption
    wheel_radius_m: float = 1.40 / (2.0 * pi)  # circumference 1.40 m: an 18 x 8.50-8 tyre under load

    # Tyres, two wheels per axle
    front_stiffness_nprad: float = 2.0 * 11_000.0  # assumption: 11-13 kN/rad per wheel
    rear_stiffness_nprad: float = 2.0 * 13_000.0  # assumption: as above
    friction: float = 0.8  # dry asphalt; the speed class test of ANSI Z130.1 asks for at least 0.8
    relaxation_m: float = 0.25  # assumption: about one wheel radius
    parking_damping_spm: float = 0.25  # assumption: slip per m/s sideways; damping ratio 0.7 at rest
    parking_speed_mps: float = 2.0  # assumption: that damping fades out up to here

    # Longitudinal
    brake_force_n: float = 2_400.0  # assumption: at effort 1; 5 m/s2 empty, locks a dry rear axle
    brake_front_share: float = 0.0  # rear only, as most golf cars (Seluga and Ojalvo 2006)
    rolling_resistance: float = 0.015  # assumption: turf tyre on asphalt; grass 0.05 and more
    drag_area_m2: float = 1.5  # assumption: Cd A with roof and people
    air_density_kgpm3: float = 1.2  # 20 degrees Celsius, sea level
    drive_force_n: float = 640.0  # assumption: current limit, 1.2 m/s2 empty on the level
    drive_power_w: float = 3_000.0  # assumption: a 48 V drive
    max_speed_mps: float = 6.7  # 24 km/h, class limit of ANSI Z130.1; reached downhill, else 2 % less
    max_reverse_speed_mps: float = 3.0  # assumption
    speed_taper_mps: float = 0.5  # assumption: the controller fades the drive out over the last 0.5 m/s

    # Actuators: all assumptions, no measured golf cart was found
    steer_dead_time_s: float = 0.05  # 0.05-0.15
    steer_lag_s: float = 0.12  # 0.1-0.3
    max_steer_rate_radps: float = 0.6  # road wheel, 0.35-0.7
    max_steer_rad: float = 0.47  # 27 degrees: turning radius 3.3 m; 3.4 m is given for a cart of this size
    brake_dead_time_s: float = 0.0
    brake_lag_s: float = 0.15
    drive_dead_time_s: float = 0.0
    drive_lag_s: float = 0.3  # 0.3-0.6


class CartState(msgspec.Struct, frozen=True, gc=False):
    """Everything the next step needs, at one instant. Velocities are those of C, in the axes of C."""

    x_m: float = 0.0  # C in M, east
    y_m: float = 0.0  # C in M, north
    yaw_rad: float = 0.0  # counter-clockwise from east, continuous: never wrapped
    vx_mps: float = 0.0  # forward
    vy_mps: float = 0.0  # to the left, of the rear axle (not of the centre of gravity)
    yaw_rate_radps: float = 0.0
    steer_rad: float = 0.0  # actual road-wheel angle, left positive
    brake: float = 0.0  # actual effort [0, 1]
    drive: float = 0.0  # actual share of the drive force [-1, 1]
    front_slip: float = 0.0  # relaxed tangent of the slip angle; positive pushes to the left
    rear_slip: float = 0.0
    ax_mps2: float = 0.0  # what an accelerometer at the centre of gravity shows: slope included
    ay_mps2: float = 0.0
    left_travel_m: float = 0.0  # rear left wheel, signed: backward counts down; locked, not at all
    right_travel_m: float = 0.0
    distance_m: float = 0.0  # path length of C, never falling
    rear_locked: bool = False  # the rear brake asked for more than friction gave, while moving


class Demand(msgspec.Struct, frozen=True, gc=False):
    """What the actuator nodes ask of the cart. Values beyond the range are clipped."""

    steer_rad: float = 0.0  # road wheel, left positive
    brake: float = 0.0  # effort [0, 1]
    drive: float = 0.0  # share of the drive force [-1, 1]; negative is reverse
    contactor_open: bool = False  # the drive is dead at once, without lag or dead time


class Ground(msgspec.Struct, frozen=True, gc=False):
    """The ground under the cart."""

    grade_x: float = 0.0  # dz/dx of the terrain, east
    grade_y: float = 0.0  # dz/dy, north
    friction_factor: float = 1.0  # times CartParams.friction; wet grass 0.5


REST = Demand()
FLAT = Ground()


@dataclass(frozen=True, slots=True, kw_only=True)
class Coefficients:
    """What one step needs, computed once from `CartParams` and the step length."""

    dt_s: float
    mass_kg: float
    yaw_inertia_kgm2: float
    a_m: float  # centre of gravity to front axle
    b_m: float  # centre of gravity to rear axle
    front_share: float
    rear_share: float
    transfer: float  # cg height / wheelbase
    half_track_m: float
    front_stiffness_nprad: float
    rear_stiffness_nprad: float
    friction: float
    relaxation_m: float
    parking_damping_spm: float
    parking_speed_mps: float
    front_brake_n: float
    rear_brake_n: float
    rolling_resistance: float
    drag_kgpm: float  # half rho Cd A
    drive_force_n: float
    drive_power_w: float
    max_speed_mps: float
    max_reverse_speed_mps: float
    speed_taper_mps: float
    steer_gain: float
    brake_gain: float
    drive_gain: float
    max_steer_rad: float
    max_steer_step_rad: float


def coefficients(params: CartParams, dt_s: float) -> Coefficients:
    """Return the constants of a step of `dt_s`."""
    mass_kg = params.mass_kg + params.load_kg
    a_m = params.wheelbase_m * (1.0 - params.front_weight_share)
    return Coefficients(
        dt_s=dt_s,
        mass_kg=mass_kg,
        yaw_inertia_kgm2=params.yaw_inertia_kgm2,
        a_m=a_m,
        b_m=params.wheelbase_m - a_m,
        front_share=params.front_weight_share,
        rear_share=1.0 - params.front_weight_share,
        transfer=params.cg_height_m / params.wheelbase_m,
        half_track_m=0.5 * params.track_m,
        front_stiffness_nprad=params.front_stiffness_nprad,
        rear_stiffness_nprad=params.rear_stiffness_nprad,
        friction=params.friction,
        relaxation_m=params.relaxation_m,
        parking_damping_spm=params.parking_damping_spm,
        parking_speed_mps=params.parking_speed_mps,
        front_brake_n=params.brake_force_n * params.brake_front_share,
        rear_brake_n=params.brake_force_n * (1.0 - params.brake_front_share),
        rolling_resistance=params.rolling_resistance,
        drag_kgpm=0.5 * params.air_density_kgpm3 * params.drag_area_m2,
        drive_force_n=params.drive_force_n,
        drive_power_w=params.drive_power_w,
        max_speed_mps=params.max_speed_mps,
        max_reverse_speed_mps=params.max_reverse_speed_mps,
        speed_taper_mps=params.speed_taper_mps,
        steer_gain=_lag_gain(params.steer_lag_s, dt_s),
        brake_gain=_lag_gain(params.brake_lag_s, dt_s),
        drive_gain=_lag_gain(params.drive_lag_s, dt_s),
        max_steer_rad=params.max_steer_rad,
        max_steer_step_rad=params.max_steer_rate_radps * dt_s,
    )


def _lag_gain(lag_s: float, dt_s: float) -> float:
    """Return the share of the gap that a first-order lag closes in one step (trapezoidal rule, at most 1)."""
    return min(1.0, dt_s / (lag_s + 0.5 * dt_s))


def fiala_force_n(slip: float, stiffness_nprad: float, limit_n: float) -> float:
    """Return the side force of an axle; from a slip tangent of 3 limit / stiffness on, all of it slides."""
    sliding = 3.0 * limit_n / stiffness_nprad
    if slip >= sliding:
        return limit_n
    if slip <= -sliding:
        return -limit_n
    part = (slip if slip >= 0.0 else -slip) / sliding
    return stiffness_nprad * slip * (1.0 - part + part * part / 3.0)


CREEP2_M2PS2 = 0.1 * 0.1
"""Below about 0.1 m/s the angle of sliding has no meaning; the sum below fades it out."""


def slide_cosine(roll_mps: float, side_mps: float) -> float:
    """Return cos(theta) of the contact's velocity against the wheel plane, 1 at standstill."""
    roll2 = roll_mps * roll_mps + CREEP2_M2PS2
    return sqrt(roll2 / (roll2 + side_mps * side_mps))


def step_cart(  # noqa: PLR0915 - one straight sequence, to be compared line by line with the kernel
    s: CartState,
    *,
    steer_demand_rad: float,
    brake_demand: float,
    drive_demand: float,
    contactor_open: bool,
    ground: Ground,
    k: Coefficients,
) -> CartState:
    """Return the state one step later. The demands are those at the actuators: dead times are over."""
    dt = k.dt_s
    mass = k.mass_kg
    vx = s.vx_mps
    vy_C = s.vy_mps
    r = s.yaw_rate_radps
    yaw = s.yaw_rad

    # 1. Actuators
    limit = k.max_steer_rad
    target = limit if steer_demand_rad > limit else -limit if steer_demand_rad < -limit else steer_demand_rad
    change = k.steer_gain * (target - s.steer_rad)
    limit = k.max_steer_step_rad
    change = limit if change > limit else -limit if change < -limit else change
    steer = s.steer_rad + change
    target = 1.0 if brake_demand > 1.0 else 0.0 if brake_demand < 0.0 else brake_demand
    brake = s.brake + k.brake_gain * (target - s.brake)
    if contactor_open:
        drive = 0.0
    else:
        target = 1.0 if drive_demand > 1.0 else -1.0 if drive_demand < -1.0 else drive_demand
        drive = s.drive + k.drive_gain * (target - s.drive)

    # 2. Axle loads. Taking ax from the step before is stable: the loop gain mu h / L is far below 1.
    steer_sin = sin(steer)
    steer_cos = cos(steer)
    grade_x = ground.grade_x
    grade_y = ground.grade_y
    weight_n = mass * GRAVITY_MPS2 / sqrt(1.0 + grade_x * grade_x + grade_y * grade_y)
    shift_n = mass * s.ax_mps2 * k.transfer
    front_load_n = weight_n * k.front_share - shift_n
    rear_load_n = weight_n * k.rear_share + shift_n
    front_load_n = front_load_n if front_load_n > 0.0 else 0.0
    rear_load_n = rear_load_n if rear_load_n > 0.0 else 0.0
    friction = k.friction * ground.friction_factor
    front_limit_n = friction * front_load_n
    rear_limit_n = friction * rear_load_n

    # 3. Slip. The carcass yields no further than to full sliding, so nothing winds up in a long slide.
    front_y = vy_C + (k.a_m + k.b_m) * r
    front_roll = vx * steer_cos + front_y * steer_sin
    front_side = front_y * steer_cos - vx * steer_sin
    per_length = dt / k.relaxation_m
    speed = front_roll if front_roll >= 0.0 else -front_roll
    front_slip = (s.front_slip - per_length * front_side) / (1.0 + per_length * speed)
    limit = 3.0 * front_limit_n / k.front_stiffness_nprad
    front_slip = limit if front_slip > limit else -limit if front_slip < -limit else front_slip
    speed = vx if vx >= 0.0 else -vx
    rear_slip = (s.rear_slip - per_length * vy_C) / (1.0 + per_length * speed)
    limit = 3.0 * rear_limit_n / k.rear_stiffness_nprad
    rear_slip = limit if rear_slip > limit else -limit if rear_slip < -limit else rear_slip
    if speed < k.parking_speed_mps:
        fade = 1.0 - speed / k.parking_speed_mps
        damping = k.parking_damping_spm * fade * fade
    else:
        damping = 0.0

    # 4. Turning: Cayley's form of the rotation of the velocity of the centre of gravity by -r dt.
    vy = vy_C + k.b_m * r
    half = 0.5 * r * dt
    scale = 1.0 / (1.0 + half * half)
    turn_cos = (1.0 - half * half) * scale
    turn_sin = 2.0 * half * scale
    vx_turned = vx * turn_cos + vy * turn_sin
    vy_turned = vy * turn_cos - vx * turn_sin

    # 5. Along x. `push` is the force that would act, plus the one that would stop the cart within the step.
    front_grip_n = front_limit_n * slide_cosine(front_roll, front_side)
    rear_grip_n = rear_limit_n * slide_cosine(vx, vy_C)
    drive_n = drive * k.drive_force_n
    top = k.max_speed_mps if drive >= 0.0 else k.max_reverse_speed_mps
    room = (top - (vx if drive >= 0.0 else -vx)) / k.speed_taper_mps
    drive_n = drive_n * (0.0 if room < 0.0 else room if room < 1.0 else 1.0)
    if (drive_n if drive_n >= 0.0 else -drive_n) * speed > k.drive_power_w:
        drive_n = (k.drive_power_w if drive_n >= 0.0 else -k.drive_power_w) / speed
    drive_n = rear_grip_n if drive_n > rear_grip_n else -rear_grip_n if drive_n < -rear_grip_n else drive_n
    yaw_sin = sin(yaw)
    yaw_cos = cos(yaw)
    slope_x_n = -weight_n * (grade_x * yaw_cos + grade_y * yaw_sin)
    slope_y_n = -weight_n * (grade_y * yaw_cos - grade_x * yaw_sin)
    drag_n = k.drag_kgpm * vx * speed
    push_n = mass * vx_turned / dt + drive_n + slope_x_n - drag_n
    ahead = 1.0 if push_n >= 0.0 else -1.0
    front_brake_n = brake * k.front_brake_n
    front_brake_n = front_grip_n if front_brake_n > front_grip_n else front_brake_n
    rear_brake_n = brake * k.rear_brake_n
    grip_n = rear_grip_n + ahead * drive_n  # the tyre carries brake minus drive
    brake_locks = rear_brake_n > grip_n
    rear_brake_n = grip_n if brake_locks else rear_brake_n
    dry_n = rear_brake_n + front_brake_n * steer_cos + k.rolling_resistance * weight_n
    need_n = ahead * push_n
    used = ahead if need_n >= dry_n else ahead * need_n / dry_n
    front_x_n = -used * front_brake_n
    rear_x_n = drive_n - used * rear_brake_n

    # 6. Across: what the ellipse has left, which for a locked wheel is mu Fz sin(theta).
    left = front_limit_n * front_limit_n - front_x_n * front_x_n
    left_n = sqrt(left) if left > 0.0 else 0.0
    front_y_n = fiala_force_n(front_slip - damping * front_side, k.front_stiffness_nprad, left_n)
    left = rear_limit_n * rear_limit_n - rear_x_n * rear_x_n
    left_n = sqrt(left) if left > 0.0 else 0.0
    rear_y_n = fiala_force_n(rear_slip - damping * vy_C, k.rear_stiffness_nprad, left_n)

    # 7. Velocity. Dry friction is settled again, now that the steered wheel's side force is known.
    side_x_n = front_y_n * steer_sin
    push_n = push_n - side_x_n
    if push_n > dry_n:
        force_x_n = drive_n - drag_n - side_x_n - dry_n
        vx_new = vx_turned + dt * (force_x_n + slope_x_n) / mass
    elif push_n < -dry_n:
        force_x_n = drive_n - drag_n - side_x_n + dry_n
        vx_new = vx_turned + dt * (force_x_n + slope_x_n) / mass
    else:
        force_x_n = -mass * vx_turned / dt - slope_x_n
        vx_new = 0.0
    front_across_n = front_y_n * steer_cos + front_x_n * steer_sin
    force_y_n = front_across_n + rear_y_n
    vy_new = vy_turned + dt * (force_y_n + slope_y_n) / mass
    r_new = r + dt * (k.a_m * front_across_n - k.b_m * rear_y_n) / k.yaw_inertia_kgm2
    vy_C_new = vy_new - k.b_m * r_new

    # 7. Pose, with the yaw of mid-step
    yaw_change = r_new * dt
    yaw_middle = yaw + 0.5 * yaw_change
    yaw_sin = sin(yaw_middle)
    yaw_cos = cos(yaw_middle)
    locked = brake_locks and need_n > dry_n
    left_travel = s.left_travel_m
    right_travel = s.right_travel_m
    if not locked:
        differential = r_new * k.half_track_m
        left_travel = left_travel + (vx_new - differential) * dt
        right_travel = right_travel + (vx_new + differential) * dt
    return CartState(  # in the order of the fields: keywords would add 1 us to the 4 us of a step
        s.x_m + (vx_new * yaw_cos - vy_C_new * yaw_sin) * dt,
        s.y_m + (vx_new * yaw_sin + vy_C_new * yaw_cos) * dt,
        yaw + yaw_change,
        vx_new,
        vy_C_new,
        r_new,
        steer,
        brake,
        drive,
        front_slip,
        rear_slip,
        force_x_n / mass,
        force_y_n / mass,
        left_travel,
        right_travel,
        s.distance_m + sqrt(vx_new * vx_new + vy_C_new * vy_C_new) * dt,
        locked,
    )


def advance(state: CartState, demand: Demand, params: CartParams, ground: Ground, dt_s: float) -> CartState:
    """Return the state `dt_s` later, without dead times.

    Loops use `PythonPlant`, which prepares the constants once.
    """
    k = coefficients(params, dt_s)
    return step_cart(
        state,
        steer_demand_rad=demand.steer_rad,
        brake_demand=demand.brake,
        drive_demand=demand.drive,
        contactor_open=demand.contactor_open,
        ground=ground,
        k=k,
    )


class PlantSnapshot(msgspec.Struct, frozen=True):
    """A plant at one instant: the state, and the demands still under way (oldest first)."""

    state: CartState
    pending: tuple[Demand, ...]


class Plant(Protocol):
    """A simulated cart with a fixed step of its own: the seam between reference and compiled kernel."""

    @property
    def state(self) -> CartState:
        """The state after the last step."""

    def step(self, demand: Demand, ground: Ground) -> None:
        """Advance by one step."""

    def reset(self, state: CartState) -> None:
        """Start from `state`; no demand is under way."""

    def snapshot(self) -> PlantSnapshot:
        """Return what `restore` needs to continue exactly from here."""

    def restore(self, snapshot: PlantSnapshot) -> None:
        """Continue from `snapshot`, taken from a plant with the same parameters and step."""


class PythonPlant:
    """The reference plant: `step_cart` behind dead times of whole steps (rounded to the nearest)."""

    __slots__ = ("_brake_delay", "_drive_delay", "_k", "_pending", "_steer_delay", "dt_s", "params", "state")

    def __init__(self, params: CartParams | None = None, dt_s: float = STEP_S, state: CartState | None = None) -> None:
        self.params = CartParams() if params is None else params
        self.dt_s = dt_s
        self._k = coefficients(self.params, dt_s)
        # _pending[-1] is this step's demand, _pending[-1 - n] the one of n steps ago.
        self._steer_delay = -1 - round(self.params.steer_dead_time_s / dt_s)
        self._brake_delay = -1 - round(self.params.brake_dead_time_s / dt_s)
        self._drive_delay = -1 - round(self.params.drive_dead_time_s / dt_s)
        self._pending: deque[Demand] = deque()
        self.state = CartState()
        self.reset(self.state if state is None else state)

    def step(self, demand: Demand, ground: Ground = FLAT) -> None:
        """Advance by `dt_s`. An open contactor acts at once, everything else after its dead time."""
        pending = self._pending
        pending.append(demand)
        self.state = step_cart(
            self.state,
            steer_demand_rad=pending[self._steer_delay].steer_rad,
            brake_demand=pending[self._brake_delay].brake,
            drive_demand=pending[self._drive_delay].drive,
            contactor_open=demand.contactor_open,
            ground=ground,
            k=self._k,
        )

    def reset(self, state: CartState) -> None:
        """Start from `state`; until a first demand has passed its dead time, that actuator stays as it is."""
        self.state = state
        steps = -min(self._steer_delay, self._brake_delay, self._drive_delay)
        held = Demand(steer_rad=state.steer_rad, brake=state.brake, drive=state.drive)
        self._pending = deque([held] * steps, maxlen=steps)

    def snapshot(self) -> PlantSnapshot:
        """Return what `restore` needs to continue exactly from here."""
        return PlantSnapshot(state=self.state, pending=tuple(self._pending))

    def restore(self, snapshot: PlantSnapshot) -> None:
        """Continue from `snapshot`, taken from a plant with the same parameters and step."""
        steps = self._pending.maxlen
        if len(snapshot.pending) != steps:
            raise ValueError(
                f"snapshot with {len(snapshot.pending)} pending demands, expected {steps}: "
                "restore into a plant with the same dead times and step"
            )
        self.state = snapshot.state
        self._pending = deque(snapshot.pending, maxlen=steps)
