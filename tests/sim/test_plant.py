"""Sentences of physics about the planar cart, each against a formula or a second, simpler model."""

from __future__ import annotations

import random
from collections.abc import Callable
from itertools import pairwise
from math import atan, atan2, cos, degrees, exp, hypot, isfinite, radians, sin, tan

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from sim.plant import (
    FLAT,
    GRAVITY_MPS2,
    CartParams,
    CartState,
    Demand,
    Ground,
    Plant,
    PythonPlant,
    advance,
)

FOUR_WHEEL = CartParams(brake_force_n=8_000.0, brake_front_share=0.73)
"""Brakes on all wheels, strong enough that both axles reach the friction limit."""


def drive_for(
    plant: PythonPlant,
    seconds: float,
    demand: Callable[[float, CartState], Demand] | Demand,
    ground: Ground = FLAT,
) -> list[CartState]:
    """Step for `seconds`; `demand` is constant or a function of time and state. Return every state."""
    states = [plant.state]
    for number in range(round(seconds / plant.dt_s)):
        now = demand if isinstance(demand, Demand) else demand(number * plant.dt_s, plant.state)
        plant.step(now, ground)
        states.append(plant.state)
    return states


def stop_from(speed_mps: float, params: CartParams, brake: float, ground: Ground = FLAT) -> list[CartState]:
    """Brake with the effort already applied, so that only the physics of the stop is left."""
    plant = PythonPlant(params, state=CartState(vx_mps=speed_mps, brake=brake))
    states = drive_for(plant, 12.0, Demand(brake=brake), ground)
    assert plant.state.vx_mps == 0.0
    return states


def kinetic_energy_j(cart: CartState, params: CartParams) -> float:
    mass_kg = params.mass_kg + params.load_kg
    b_m = params.wheelbase_m * params.front_weight_share
    side_mps = cart.vy_mps + b_m * cart.yaw_rate_radps
    moving = 0.5 * mass_kg * (cart.vx_mps**2 + side_mps**2)
    return moving + 0.5 * params.yaw_inertia_kgm2 * cart.yaw_rate_radps**2


def slalom(t_s: float, cart: CartState) -> Demand:
    """Weave at 5 m/s, up to about 3 m/s2 sideways."""
    return Demand(steer_rad=0.2 * sin(2.0 * t_s), drive=0.5 * (5.0 - cart.vx_mps) + 0.2)


# Cornering


@pytest.mark.parametrize("speed_mps", [2.0, 4.0, 6.0])
def test_steady_turn_has_the_radius_of_the_understeer_formula(speed_mps: float) -> None:
    """R = (L + K v^2) / tan(delta) with K = m (front share / C_front - rear share / C_rear)."""
    params = CartParams(drive_force_n=1_500.0, drive_power_w=10_000.0)
    steer_rad = 0.2
    sum_m = 0.0

    def cruise(_: float, cart: CartState) -> Demand:
        nonlocal sum_m
        error_mps = speed_mps - cart.vx_mps
        sum_m += error_mps * 0.005
        return Demand(steer_rad=steer_rad, drive=2.0 * error_mps + 2.0 * sum_m)

    cart = drive_for(PythonPlant(params, state=CartState(vx_mps=speed_mps)), 30.0, cruise)[-1]
    share = params.front_weight_share
    k = params.mass_kg * (share / params.front_stiffness_nprad - (1.0 - share) / params.rear_stiffness_nprad)
    expected_m = (params.wheelbase_m + k * speed_mps**2) / tan(steer_rad)
    assert cart.vx_mps == pytest.approx(speed_mps, abs=1e-3)
    assert hypot(cart.vx_mps, cart.vy_mps) / cart.yaw_rate_radps == pytest.approx(expected_m, rel=0.02)


@pytest.mark.parametrize("steer_rad", [-0.4, 0.1, 0.3])
@pytest.mark.parametrize("speed_mps", [1.0, -1.0])
def test_a_slow_cart_drives_like_a_kinematic_bicycle(speed_mps: float, steer_rad: float) -> None:
    """Second opinion: rear axle without slip, yaw rate v tan(delta) / L; within 2 % of the way after 10 m."""
    params = CartParams(rolling_resistance=0.0, drag_area_m2=0.0)
    start = CartState(
        vx_mps=speed_mps, steer_rad=steer_rad, yaw_rate_radps=speed_mps * tan(steer_rad) / params.wheelbase_m
    )
    plant = PythonPlant(params, state=start)
    x_m = y_m = yaw_rad = 0.0
    for _ in range(2_000):
        plant.step(Demand(steer_rad=steer_rad), FLAT)
        yaw_change = plant.state.vx_mps * tan(steer_rad) / params.wheelbase_m * plant.dt_s
        x_m += plant.state.vx_mps * cos(yaw_rad + 0.5 * yaw_change) * plant.dt_s
        y_m += plant.state.vx_mps * sin(yaw_rad + 0.5 * yaw_change) * plant.dt_s
        yaw_rad += yaw_change
    assert plant.state.distance_m > 8.0
    assert hypot(plant.state.x_m - x_m, plant.state.y_m - y_m) < 0.02 * plant.state.distance_m


def test_steering_to_the_other_side_gives_exactly_the_mirrored_path() -> None:
    def mirrored(t_s: float, cart: CartState) -> Demand:
        demand = slalom(t_s, cart)
        return replace(demand, steer_rad=-demand.steer_rad)

    left = drive_for(PythonPlant(), 12.0, slalom)
    right = drive_for(PythonPlant(), 12.0, mirrored)
    for one, other in zip(left, right, strict=True):
        assert (one.x_m, one.y_m, one.yaw_rad) == (other.x_m, -other.y_m, -other.yaw_rad)
        assert (one.vx_mps, one.vy_mps) == (other.vx_mps, -other.vy_mps)
        assert (one.left_travel_m, one.right_travel_m) == (other.right_travel_m, other.left_travel_m)
    assert max(abs(cart.y_m) for cart in left) > 0.5


def test_half_the_step_moves_a_12_s_slalom_by_less_than_5_cm() -> None:
    coarse = drive_for(PythonPlant(dt_s=0.005), 12.0, slalom)[::10]
    fine = drive_for(PythonPlant(dt_s=0.0025), 12.0, slalom)[::20]
    gap_m = max(hypot(a.x_m - b.x_m, a.y_m - b.y_m) for a, b in zip(coarse, fine, strict=True))
    assert coarse[-1].distance_m > 40.0
    assert gap_m < 0.05


def test_a_steady_turn_costs_the_drive_the_drag_of_the_steered_wheels() -> None:
    """Force balance along x; by the moment balance the front axle carries m ay (front share) across.

    A fine step, since the Euler step adds m v r^2 dt / 2, which is 2 % here at 5 ms.
    """
    params = CartParams()
    plant = PythonPlant(params, 0.0005, CartState(vx_mps=4.3, steer_rad=0.3))
    cart = drive_for(plant, 40.0, Demand(steer_rad=0.3, drive=0.25))[-1]
    share = params.front_weight_share
    side_mps = cart.vy_mps + params.wheelbase_m * share * cart.yaw_rate_radps
    drag_n = 0.5 * params.air_density_kgpm3 * params.drag_area_m2 * cart.vx_mps**2
    needed_n = params.rolling_resistance * params.mass_kg * GRAVITY_MPS2 + drag_n
    needed_n += params.mass_kg * (cart.ay_mps2 * share * tan(0.3) - cart.yaw_rate_radps * side_mps)
    assert cart.ay_mps2 > 0.5
    assert cart.drive * params.drive_force_n == pytest.approx(needed_n, rel=4e-3)


def test_yaw_is_continuous_over_full_circles() -> None:
    cart = drive_for(PythonPlant(), 40.0, Demand(steer_rad=0.47, drive=0.3))[-1]
    assert cart.yaw_rad > radians(720.0)


# Speed and travel


def test_cart_at_2_mps_for_5_s_is_10_m_on() -> None:
    """Drive force set to what rolling and air take at 2 m/s."""
    params = CartParams()
    drag_n = 0.5 * params.air_density_kgpm3 * params.drag_area_m2 * 2.0**2
    drive = (params.rolling_resistance * params.mass_kg * GRAVITY_MPS2 + drag_n) / params.drive_force_n
    start = CartState(vx_mps=2.0, drive=drive)
    cart = drive_for(PythonPlant(params, state=start), 5.0, Demand(drive=drive))[-1]
    assert cart.x_m == pytest.approx(10.0, abs=1e-6)
    assert cart.distance_m == pytest.approx(10.0, abs=1e-6)
    assert cart.left_travel_m == cart.right_travel_m == pytest.approx(10.0, abs=1e-6)


def test_a_coasting_cart_is_slowed_by_rolling_and_air() -> None:
    params = CartParams()
    states = drive_for(PythonPlant(params, state=CartState(vx_mps=6.0)), 0.1, Demand())
    drag_mps2 = 0.5 * params.air_density_kgpm3 * params.drag_area_m2 * 6.0**2 / params.mass_kg
    assert (6.0 - states[-1].vx_mps) / 0.1 == pytest.approx(0.015 * GRAVITY_MPS2 + drag_mps2, rel=0.01)


def test_full_drive_accelerates_by_1_2_mps2_and_ends_just_below_the_class_limit() -> None:
    states = drive_for(PythonPlant(), 40.0, Demand(drive=1.0))
    fastest_mps2 = max((b.vx_mps - a.vx_mps) / 0.005 for a, b in pairwise(states))
    assert fastest_mps2 == pytest.approx(1.2, abs=0.03)
    assert 6.5 < states[-1].vx_mps < 6.7


def test_reverse_is_slower_and_counts_the_wheels_down() -> None:
    cart = drive_for(PythonPlant(), 20.0, Demand(drive=-1.0))[-1]
    assert -3.0 < cart.vx_mps < -2.7
    assert cart.left_travel_m == cart.right_travel_m == pytest.approx(cart.x_m)
    assert cart.distance_m == pytest.approx(-cart.x_m)


def test_wheel_travel_gives_the_yaw_back() -> None:
    """Odometry: (right - left) / track is the yaw as long as nothing locks."""
    cart = drive_for(PythonPlant(), 12.0, slalom)[-1]
    assert (cart.right_travel_m - cart.left_travel_m) / 0.9 == pytest.approx(cart.yaw_rad, abs=1e-9)
    outward = drive_for(PythonPlant(), 5.0, Demand(steer_rad=0.3, drive=0.3))[-1]
    assert outward.right_travel_m > outward.left_travel_m


def test_an_open_contactor_cuts_the_drive_at_once() -> None:
    plant = PythonPlant()
    drive_for(plant, 3.0, Demand(drive=1.0))
    assert plant.state.drive > 0.9
    plant.step(Demand(drive=1.0, contactor_open=True), FLAT)
    assert plant.state.drive == 0.0
    assert plant.state.ax_mps2 < 0.0


# Braking


def test_four_wheel_brakes_stop_within_v2_over_2_mu_g() -> None:
    """Rolling resistance comes on top of full friction, so a little shorter."""
    cart = stop_from(6.6, FOUR_WHEEL, 1.0)[-1]
    friction_only_m = 6.6**2 / (2.0 * 0.8 * GRAVITY_MPS2)
    with_rolling_m = 6.6**2 / (2.0 * (0.8 + 0.015) * GRAVITY_MPS2)
    assert cart.distance_m == pytest.approx(friction_only_m, rel=0.04)
    assert cart.distance_m == pytest.approx(with_rolling_m, rel=0.02)


@pytest.mark.parametrize("friction_factor", [1.0, 0.5])
def test_locked_rear_wheels_stop_at_the_limit_of_the_unloaded_rear_axle(friction_factor: float) -> None:
    """m a = mu Fz_rear + rolling resistance, and Fz_rear = m g (rear share) - m a h / L."""
    params = CartParams(drag_area_m2=0.0)
    mu = 0.8 * friction_factor
    rear_share = 1.0 - params.front_weight_share
    transfer = params.cg_height_m / params.wheelbase_m
    a_mps2 = GRAVITY_MPS2 * (mu * rear_share + params.rolling_resistance)
    a_mps2 /= 1.0 + mu * transfer
    states = stop_from(6.6, params, 1.0, Ground(friction_factor=friction_factor))
    assert states[100].rear_locked
    assert states[-1].distance_m == pytest.approx(6.6**2 / (2.0 * a_mps2), rel=0.01)
    assert states[-1].left_travel_m < 0.05, "locked wheels do not turn, so odometry sees a cart at rest"


def test_a_rear_braked_cart_needs_twice_the_distance_of_a_four_wheel_braked_one() -> None:
    rear_m = stop_from(6.6, CartParams(), 1.0)[-1].distance_m
    all_m = stop_from(6.6, FOUR_WHEEL, 1.0)[-1].distance_m
    assert 1.8 < rear_m / all_m < 2.6


@pytest.mark.parametrize(("friction_factor", "at_least_deg"), [(1.0, 10.0), (0.5, 60.0)])
def test_locked_rear_wheels_and_a_little_steer_fishtail(friction_factor: float, at_least_deg: float) -> None:
    """More than twice the yaw that the steering alone gives on the same path, and far more when it is wet."""
    plant = PythonPlant(state=CartState(vx_mps=6.6, brake=1.0, steer_rad=0.02))
    demand = Demand(steer_rad=0.02, brake=1.0)
    cart = drive_for(plant, 8.0, demand, Ground(friction_factor=friction_factor))[-1]
    assert cart.vx_mps == 0.0
    assert degrees(cart.yaw_rad) > at_least_deg
    assert cart.yaw_rad > 2.0 * cart.distance_m * tan(0.02) / 1.66


def test_gentle_rear_braking_with_a_little_steer_stays_on_its_arc() -> None:
    plant = PythonPlant(state=CartState(vx_mps=6.6, brake=0.25, steer_rad=0.02))
    cart = drive_for(plant, 8.0, Demand(steer_rad=0.02, brake=0.25))[-1]
    assert cart.yaw_rad == pytest.approx(cart.distance_m * tan(0.02) / 1.66, rel=0.05)


def test_a_cart_with_all_wheels_locked_slides_straight_on_in_the_direction_of_its_motion() -> None:
    """Friction points against the motion, not along the wheels. Mass at ground level: nothing turns."""
    params = CartParams(
        brake_force_n=10_000.0,
        brake_front_share=0.5,
        cg_height_m=0.0,
        rolling_resistance=0.0,
        drag_area_m2=0.0,
    )
    start = CartState(vx_mps=5.0 * cos(0.4), vy_mps=5.0 * sin(0.4), brake=1.0)
    cart = drive_for(PythonPlant(params, state=start), 0.5, Demand(brake=1.0))[-1]
    assert hypot(cart.vx_mps, cart.vy_mps) == pytest.approx(5.0 - 0.5 * 0.8 * GRAVITY_MPS2, abs=0.1)
    assert atan(cart.vy_mps / cart.vx_mps) + cart.yaw_rad == pytest.approx(0.4, abs=0.06)


def test_a_motor_that_pulls_against_locked_brakes_changes_nothing_at_the_road() -> None:
    def after(drive: float) -> CartState:
        start = CartState(vx_mps=5.0, brake=1.0, drive=drive)
        plant = PythonPlant(CartParams(brake_force_n=5_000.0), state=start)
        return drive_for(plant, 0.5, Demand(brake=1.0, drive=drive))[-1]

    assert after(0.0).rear_locked
    assert after(1.0).rear_locked
    assert after(1.0).vx_mps == pytest.approx(after(0.0).vx_mps, abs=1e-9)


def test_the_brake_force_of_a_steered_front_wheel_points_along_that_wheel() -> None:
    """In the first 0.1 ms the tyres have not yet built up side force."""
    params = CartParams(brake_force_n=500.0, brake_front_share=1.0)
    start = CartState(vx_mps=5.0, steer_rad=0.3)
    free, braked = (
        advance(replace(start, brake=brake), Demand(steer_rad=0.3, brake=brake), params, FLAT, 1e-4)
        for brake in (0.0, 1.0)
    )
    assert params.mass_kg * (braked.ay_mps2 - free.ay_mps2) == pytest.approx(-500.0 * sin(0.3), rel=0.01)
    assert params.mass_kg * (braked.ax_mps2 - free.ax_mps2) == pytest.approx(-500.0 * cos(0.3), rel=0.01)


@pytest.mark.parametrize("friction_factor", [1.0, 0.5])
@pytest.mark.parametrize("load_kg", [0.0, 240.0])
def test_service_braking_of_1_5_mps2_on_the_rear_axle_does_not_lock_it(friction_factor: float, load_kg: float) -> None:
    """Also on wet grass, mu 0.4. The effort is chosen so that brake and rolling resistance make 1.5 m/s2."""
    params = CartParams(load_kg=load_kg, drag_area_m2=0.0)
    rolling_mps2 = params.rolling_resistance * GRAVITY_MPS2
    effort = (1.5 - rolling_mps2) * (params.mass_kg + load_kg) / params.brake_force_n
    states = stop_from(6.0, params, effort, Ground(friction_factor=friction_factor))
    assert not any(cart.rear_locked for cart in states)
    assert states[-1].distance_m == pytest.approx(6.0**2 / (2.0 * 1.5), rel=0.01)


@settings(max_examples=40, deadline=None)
@given(
    speed_mps=st.floats(-3.0, 7.0),
    steer_rad=st.floats(-0.47, 0.47),
    effort=st.floats(0.0, 1.0),
    front_share=st.sampled_from([0.0, 0.5, 0.73]),
    dt_s=st.sampled_from([0.005, 0.010]),
)
def test_a_brake_never_reverses_the_cart(
    speed_mps: float, steer_rad: float, effort: float, front_share: float, dt_s: float
) -> None:
    """Nor does rolling resistance. A cart that swapped ends (more than 60 degrees) slides by other rules."""
    start = CartState(vx_mps=speed_mps, steer_rad=steer_rad, brake=effort)
    plant = PythonPlant(CartParams(brake_front_share=front_share), dt_s, start)
    sign = 1.0 if speed_mps >= 0.0 else -1.0
    for cart in drive_for(plant, 6.0, Demand(steer_rad=steer_rad, brake=effort)):
        if abs(cart.yaw_rad) > radians(60.0):
            break
        assert sign * cart.vx_mps >= 0.0


# Standstill and slopes


@pytest.mark.parametrize(
    ("demand", "ground"),
    [
        (Demand(), FLAT),
        (Demand(steer_rad=0.4), FLAT),
        (Demand(brake=0.5), Ground(grade_x=0.05)),
        (Demand(brake=0.5, steer_rad=-0.4), Ground(grade_x=-0.05)),
        (Demand(brake=0.5, steer_rad=0.3), Ground(grade_x=0.03, grade_y=0.04)),
        (Demand(brake=0.5), Ground(grade_y=0.05)),
    ],
)
@pytest.mark.parametrize("dt_s", [0.005, 0.010])
def test_a_cart_at_rest_does_not_creep_in_60_s(demand: Demand, ground: Ground, dt_s: float) -> None:
    """The tyres may yield by millimetres at first; after that nothing moves."""
    plant = PythonPlant(dt_s=dt_s, state=CartState(brake=demand.brake))
    settled = drive_for(plant, 5.0, demand, ground)[-1]
    cart = drive_for(plant, 60.0, demand, ground)[-1]
    assert hypot(settled.x_m, settled.y_m) < 0.005
    assert hypot(cart.x_m - settled.x_m, cart.y_m - settled.y_m) < 1e-6
    assert abs(cart.yaw_rad - settled.yaw_rad) < 1e-6
    assert cart.vx_mps == 0.0


def test_without_brake_the_cart_rolls_down_the_slope() -> None:
    """5 % down along x: a = g (sin - c_roll cos) at first."""
    states = drive_for(PythonPlant(), 2.0, Demand(), Ground(grade_x=-0.05))
    slope_rad = atan(0.05)
    a_mps2 = GRAVITY_MPS2 * (sin(slope_rad) - 0.015 * cos(slope_rad))
    assert states[-1].vx_mps == pytest.approx(2.0 * a_mps2, rel=0.01)
    assert states[-1].x_m == pytest.approx(0.5 * a_mps2 * 2.0**2, rel=0.01)


def test_a_slope_follows_the_map_and_not_the_cart() -> None:
    """Heading north on ground that falls to the north, and backward on ground that falls to the south."""
    north = CartState(yaw_rad=radians(90.0))
    down = drive_for(PythonPlant(state=north), 2.0, Demand(), Ground(grade_y=-0.05))[-1]
    up = drive_for(PythonPlant(state=north), 2.0, Demand(), Ground(grade_y=0.05))[-1]
    assert down.y_m > 0.5
    assert up.y_m == pytest.approx(-down.y_m, rel=1e-9)


@pytest.mark.parametrize("yaw_deg", [0.0, 30.0, -140.0])
def test_a_cart_held_on_a_slope_feels_gravity_in_its_accelerometer(yaw_deg: float) -> None:
    """5 % up to the direction of 53 degrees: uphill ahead and uphill to the left read positive."""
    plant = PythonPlant(state=CartState(yaw_rad=radians(yaw_deg), brake=0.5))
    cart = drive_for(plant, 5.0, Demand(brake=0.5), Ground(grade_x=0.03, grade_y=0.04))[-1]
    uphill_rad = atan2(0.04, 0.03) - cart.yaw_rad
    slope_mps2 = GRAVITY_MPS2 * sin(atan(0.05))
    assert cart.ax_mps2 == pytest.approx(slope_mps2 * cos(uphill_rad), rel=1e-6)
    assert cart.ay_mps2 == pytest.approx(slope_mps2 * sin(uphill_rad), rel=1e-6)


# Actuators


@pytest.mark.parametrize("dt_s", [0.005, 0.010])
def test_a_small_step_of_the_steering_is_there_after_dead_time_and_lag(dt_s: float) -> None:
    """63 % of 0.05 rad after 0.05 s dead time and 0.12 s lag; nothing before the dead time is over."""
    states = drive_for(PythonPlant(dt_s=dt_s), 1.0, Demand(steer_rad=0.05))
    silent = round(0.05 / dt_s)
    assert states[silent].steer_rad == 0.0
    assert states[silent + 1].steer_rad > 0.0
    t63_s = next(n for n, cart in enumerate(states) if cart.steer_rad >= 0.05 * (1.0 - exp(-1.0))) * dt_s
    assert t63_s == pytest.approx(0.17, abs=dt_s + 1e-9)
    assert states[-1].steer_rad == pytest.approx(0.05, rel=1e-3)


def test_the_road_wheel_turns_no_faster_and_no_further_than_its_limits() -> None:
    states = drive_for(PythonPlant(), 3.0, Demand(steer_rad=2.0))
    rate_radps = max((b.steer_rad - a.steer_rad) / 0.005 for a, b in pairwise(states))
    assert rate_radps == pytest.approx(0.6)
    assert states[-1].steer_rad == pytest.approx(0.47, rel=1e-6)
    assert max(cart.steer_rad for cart in states) <= 0.47


@pytest.mark.parametrize(("field", "lag_s"), [("brake", 0.15), ("drive", 0.3)])
def test_brake_and_drive_follow_with_their_lag(field: str, lag_s: float) -> None:
    states = drive_for(PythonPlant(), 3.0, Demand(brake=1.0, drive=1.0))
    t63_s = next(n for n, cart in enumerate(states) if getattr(cart, field) >= 1.0 - exp(-1.0)) * 0.005
    assert t63_s == pytest.approx(lag_s, abs=0.006)


# Energy, determinism, robustness


@pytest.mark.parametrize("dt_s", [0.005, 0.010])
@pytest.mark.parametrize("seed", range(20))
def test_energy_never_grows_without_drive(seed: int, dt_s: float) -> None:
    """Spinning, sliding, braking and steering at random never exceeds the kinetic energy of the start.

    From a minimum it may rise by what the bent tyres give back, at most half sigma C slip^2 at full sliding.
    """
    rng = random.Random(seed)
    params = CartParams(brake_front_share=rng.choice([0.0, 0.7]), friction=rng.choice([0.2, 0.4, 0.8]))
    start = CartState(
        vx_mps=rng.uniform(-3.0, 7.0), vy_mps=rng.uniform(-2.0, 2.0), yaw_rate_radps=rng.uniform(-1.0, 1.0)
    )
    plant = PythonPlant(params, dt_s, start)
    start_j = lowest_j = kinetic_energy_j(start, params)
    demand = Demand()
    for number in range(round(20.0 / dt_s)):
        if number % 50 == 0:
            demand = Demand(steer_rad=rng.uniform(-0.5, 0.5), brake=rng.choice([0.0, 0.3, 1.0]))
        plant.step(demand, FLAT)
        cart = plant.state
        now_j = kinetic_energy_j(cart, params)
        bent_j = 0.5 * params.relaxation_m * params.front_stiffness_nprad * 0.24**2
        bent_j += 0.5 * params.relaxation_m * params.rear_stiffness_nprad * 0.24**2
        lowest_j = min(lowest_j, now_j)
        assert now_j <= start_j * (1.0 + 1e-12)
        assert now_j <= lowest_j + bent_j
    assert kinetic_energy_j(drive_for(plant, 60.0, Demand(brake=1.0))[-1], params) < 1e-12


@settings(max_examples=60, deadline=None)
@given(
    demands=st.lists(
        st.builds(
            Demand,
            steer_rad=st.floats(-1e3, 1e3),
            brake=st.floats(-2.0, 2.0),
            drive=st.floats(-2.0, 2.0),
            contactor_open=st.booleans(),
        ),
        min_size=1,
        max_size=12,
    ),
    ground=st.builds(
        Ground,
        grade_x=st.floats(-0.3, 0.3),
        grade_y=st.floats(-0.3, 0.3),
        friction_factor=st.floats(0.0, 1.5),
    ),
    dt_s=st.sampled_from([0.005, 0.010]),
)
def test_no_demand_makes_the_state_infinite_or_absurd(demands: list[Demand], ground: Ground, dt_s: float) -> None:
    plant = PythonPlant(dt_s=dt_s)
    for demand in demands:
        drive_for(plant, 0.5, demand, ground)
        values = msgspec.structs.astuple(plant.state)
        assert all(isfinite(value) for value in values)
        assert hypot(plant.state.vx_mps, plant.state.vy_mps) < 40.0
        assert abs(plant.state.yaw_rate_radps) < 15.0


def test_same_inputs_give_the_same_bytes() -> None:
    one, other = (msgspec.msgpack.encode(drive_for(PythonPlant(), 5.0, slalom)) for _ in range(2))
    assert one == other


def test_a_restored_snapshot_continues_with_the_same_bytes() -> None:
    plant = PythonPlant()
    drive_for(plant, 2.0, slalom)
    snapshot = plant.snapshot()
    first = msgspec.msgpack.encode(drive_for(plant, 2.0, slalom))
    drive_for(plant, 1.0, Demand(brake=1.0))
    plant.restore(snapshot)
    assert msgspec.msgpack.encode(drive_for(plant, 2.0, slalom)) == first
    with pytest.raises(ValueError, match="pending demands"):
        PythonPlant(dt_s=0.010).restore(snapshot)


def test_the_plant_is_advance_behind_a_dead_time() -> None:
    params = CartParams(steer_dead_time_s=0.0)
    plant: Plant = PythonPlant(params)
    state = plant.state
    demand = Demand(steer_rad=0.2, drive=0.7)
    for _ in range(400):
        plant.step(demand, FLAT)
        state = advance(state, demand, params, FLAT, 0.005)
    assert plant.state == state
