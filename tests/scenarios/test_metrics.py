"""Metrics and verdicts, over recordings of motions that are known by hand."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hal.signals import (
    ActuatorCommand,
    ActuatorState,
    CartTruth,
    Course,
    FaultEvent,
    LocalPlane,
    ModuleState,
    ModuleStatus,
    Pose,
    SafetyState,
    Site,
    SystemState,
)
from rtdb import Component, Store, Writer
from rtdb.recorder import Recorder
from rtdb.recording import Recording
from scenarios.judge import Criterion, Verdict, find, judge
from scenarios.metrics import METRICS, Evidence, Measured

TICK_NS = 10_000_000
T0_NS = 1_700_000_000_000_000_000
ALWAYS_S = 1e9  # a time at which every object of a scene has a value, to learn its record
PLANE = LocalPlane.at(math.radians(39.18), math.radians(-86.52))
SITE = Site("field", PLANE.lat_rad, PLANE.lon_rad, 200.0)

Scene = dict[str, Callable[[float], Any]]
"""Object name -> what is true at a time; None writes nothing."""


def record(
    folder: Path,
    scene: Scene,
    seconds: float,
    waypoints: tuple[tuple[float, float, float], ...] = (),
    late_ticks: int = 0,
) -> Recording:
    """Record a scene: each value shows at the edge at which it is true, late_ticks later where it is a pose."""
    path = folder / "run.mcap"
    with Store.create(tick_ns=TICK_NS, t0_ns=T0_NS) as cart, Store.create(tick_ns=TICK_NS, t0_ns=T0_NS) as world:
        if waypoints:
            geo = [PLANE.to_geo(x, y) for x, y, _ in waypoints]
            mission = cart.join("mission")
            mission.insert("site", Site).write(SITE)
            course = Course(tuple(g[0] for g in geo), tuple(g[1] for g in geo), tuple(w[2] for w in waypoints))
            mission.insert("course", Course).write(course)
        owners: dict[str, Component] = {}
        writers: dict[str, Writer[Any]] = {}
        for name, tell in scene.items():
            component, _, obj = name.partition("/")
            if component not in owners:
                owners[component] = (world if component == "world" else cart).join(component)
            writers[name] = owners[component].insert(obj, type(tell(ALWAYS_S)), history_s=0.05)
        with Recorder(path, [cart, world], {"scenario": "test/scene", "seed": "7"}) as recorder:
            for cycle in range(1, round(seconds * 100) + 1):
                for name, tell in scene.items():
                    true_at = cycle - (late_ticks if name == "localise/pose" else 0)
                    value = tell(true_at / 100)
                    if value is not None:
                        writers[name].write(value, T0_NS + true_at * TICK_NS)
                cart.tick()
                world.tick()
                recorder.record()
    return Recording(path)


def measure(recording: Recording, name: str) -> Measured | None:
    return METRICS[name].measure(Evidence(recording))


def value(recording: Recording, name: str) -> float:
    measured = measure(recording, name)
    assert measured is not None
    return measured.value


def straight(t_s: float) -> CartTruth:
    """Stand for 1 s, then eastward: 1 m/s2 up to 3 m/s, on to 10 s, then -1.5 m/s2 to standstill."""
    up, hold = min(max(t_s - 1.0, 0.0), 3.0), max(0.0, min(t_s, 10.0) - 4.0)
    down = min(max(t_s - 10.0, 0.0), 2.0)
    x_m = up**2 / 2 + 3.0 * hold + 3.0 * down - 0.75 * down**2
    speed = up - 1.5 * down
    accel = 1.0 if 1.0 < t_s <= 4.0 else -1.5 if 10.0 < t_s <= 12.0 else 0.0
    return CartTruth(x_m=x_m, speed_mps=speed, accel_x_mps2=accel, distance_m=x_m)


LINE: Scene = {"world/cart": straight}
END_M = straight(20.0).x_m


# -- the course -------------------------------------------------------------------------------------------------------


def test_way_points_reached_missed_and_when(tmp_path: Path) -> None:
    run = record(tmp_path, LINE, 14.0, ((10.5, 0.0, 1.0), (20.0, 2.0, 3.0)))
    assert value(run, "waypoints_missed") == 0
    # 20 m less the chord of 3 m at 2 m aside
    reached_m = 20.0 - math.sqrt(5.0)
    assert value(run, "finish_time_s") == pytest.approx(4.0 + (reached_m - 4.5) / 3.0, abs=0.02)
    assert Evidence(run).reached_s[0] == pytest.approx(4.0 + (9.5 - 4.5) / 3.0, abs=0.02)


def test_way_point_that_is_passed_too_far_off_is_missed_and_so_are_those_behind_it(tmp_path: Path) -> None:
    run = record(tmp_path, LINE, 14.0, ((5.0, 0.0, 1.0), (10.0, 2.0, 1.9), (15.0, 0.0, 1.0)))
    assert value(run, "waypoints_missed") == 2
    assert value(run, "finish_time_s") == math.inf


def test_mean_speed_counts_from_the_first_movement_to_the_last_way_point(tmp_path: Path) -> None:
    run = record(tmp_path, LINE, 14.0, ((19.5, 0.0, 0.1),))
    # from 1.05 s, when the cart is faster than 5 cm/s, to 19.4 m
    end_s = 4.0 + (19.4 - 4.5) / 3.0
    assert value(run, "mean_speed_mps") == pytest.approx(19.4 / (end_s - 1.05), rel=0.005)


def test_deviation_is_the_distance_from_the_nearest_leg_until_the_last_way_point(tmp_path: Path) -> None:
    def bulge(t_s: float) -> CartTruth:
        x_m = 2.0 * t_s
        return CartTruth(x_m=x_m, y_m=1.3 * math.exp(-((x_m - 8.0) ** 2)) + (9.0 if x_m > 16 else 0.0), speed_mps=2.0)

    run = record(tmp_path, {"world/cart": bulge}, 10.0, ((15.0, 0.0, 1.0),))
    measured = measure(run, "course_deviation_max_m")
    assert measured is not None
    assert measured.value == pytest.approx(1.3, abs=0.01)
    assert measured.at_s == pytest.approx(4.0, abs=0.02)


# -- motion -----------------------------------------------------------------------------------------------------------


def test_largest_deceleration_and_lateral_acceleration_with_their_times(tmp_path: Path) -> None:
    def lively(t_s: float) -> CartTruth:
        return CartTruth(accel_x_mps2=-1.7 if t_s == 2.0 else 3.0, accel_y_mps2=-1.9 if t_s == 3.0 else 1.2)

    run = record(tmp_path, {"world/cart": lively}, 5.0)
    assert measure(run, "decel_max_mps2") == Measured(1.7, 2.0)
    assert measure(run, "lateral_accel_max_mps2") == Measured(1.9, 3.0)


def test_cart_that_only_speeds_up_does_not_brake(tmp_path: Path) -> None:
    assert value(record(tmp_path, {"world/cart": lambda t: CartTruth(accel_x_mps2=1.0)}, 1.0), "decel_max_mps2") == 0.0


def test_pose_error_compares_with_the_truth_of_the_time_that_the_pose_is_of(tmp_path: Path) -> None:
    """A pose that is right but 80 ms old is no error; at 3 m/s it would look like one of 0.24 m."""

    def pose(t_s: float) -> Pose:
        return Pose(x_m=straight(t_s).x_m + (0.3 if t_s == 6.0 else 0.0), y_m=0.4 if t_s == 6.0 else 0.0, sigma_m=0.5)

    run = record(tmp_path, {**LINE, "localise/pose": pose}, 12.0, late_ticks=8)
    measured = measure(run, "pose_error_max_m")
    assert measured is not None
    assert measured.value == pytest.approx(0.5, abs=1e-9)
    assert measured.at_s == pytest.approx(6.08)
    assert value(run, "pose_error_rms_m") == pytest.approx(0.5 / math.sqrt(1200), rel=0.01)


def test_heading_error_is_wrapped(tmp_path: Path) -> None:
    scene: Scene = {
        "world/cart": lambda t: CartTruth(yaw_rad=math.pi + 0.1 + 2 * math.pi),  # the truth counts on
        "localise/pose": lambda t: Pose(yaw_rad=-math.pi + 0.2, sigma_m=0.5),
    }
    assert value(record(tmp_path, scene, 1.0), "heading_error_max_rad") == pytest.approx(0.1)


def test_latency_is_from_the_oldest_data_to_the_frame_and_counts_while_enabled(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Store.create(tick_ns=TICK_NS, t0_ns=T0_NS) as cart:
        command = cart.join("actuators").insert("command", ActuatorCommand)
        with Recorder(path, [cart], {"scenario": "", "seed": "0"}) as recorder:
            for cycle in range(1, 60):
                cart.tick()
                recorder.record()
                if cycle % 2:
                    continue
                old = 25 if cycle < 20 else 6 if cycle == 40 else 4
                command.write(ActuatorCommand(enable=cycle >= 20), T0_NS + (cycle - old) * TICK_NS)
    measured = measure(Recording(path), "latency_max_s")
    assert measured is not None
    assert measured.value == pytest.approx(0.06)
    assert measured.at_s == pytest.approx(0.41)


# -- faults -----------------------------------------------------------------------------------------------------------


def braking(onset_s: float, before: float = 0.0) -> Callable[[float], ActuatorState]:
    return lambda t_s: ActuatorState(brake_command=0.27 if t_s >= onset_s else before)


def fault_at(fault_s: float) -> Callable[[float], FaultEvent | None]:
    return lambda t_s: FaultEvent("host-silence", True) if t_s in (fault_s, ALWAYS_S) else None


def test_fault_metrics_measure_from_the_fault_on(tmp_path: Path) -> None:
    scene: Scene = {**LINE, "world/fault": fault_at(9.5), "actuators/state": braking(9.7)}
    run = record(tmp_path, scene, 14.0)
    assert value(run, "brake_delay_s") == pytest.approx(0.2)
    assert value(run, "speed_at_fault_mps") == pytest.approx(3.0)
    assert value(run, "stop_distance_m") == pytest.approx(1.5 + 3.0, abs=0.05)
    assert value(run, "final_speed_mps") == 0.0


def test_brake_that_held_the_speed_before_the_fault_is_not_what_stops_the_cart(tmp_path: Path) -> None:
    def pulses(t_s: float) -> ActuatorState:
        effort = 0.27 if t_s >= 9.8 else 0.13 if round(t_s * 100) % 10 < 4 and t_s < 9.7 else 0.0
        return ActuatorState(brake_command=effort)

    run = record(tmp_path, {**LINE, "world/fault": fault_at(9.5), "actuators/state": pulses}, 14.0)
    assert value(run, "brake_delay_s") == pytest.approx(0.3)


def test_cart_that_never_brakes_or_stops_is_infinite(tmp_path: Path) -> None:
    scene: Scene = {**LINE, "world/fault": fault_at(5.0), "actuators/state": lambda t: ActuatorState()}
    run = record(tmp_path, scene, 8.0)
    assert value(run, "brake_delay_s") == math.inf
    assert value(run, "stop_distance_m") == math.inf


def test_trips_are_counted_from_enabled_to_a_stop(tmp_path: Path) -> None:
    def state(t_s: float) -> SafetyState:
        plan = [
            (1, SystemState.READY),
            (3, SystemState.ENABLED),
            (4, SystemState.STOPPING),
            (5, SystemState.FAULT),
            (6, SystemState.READY),
            (7, SystemState.ENABLED),
            (8, SystemState.READY),  # the driver lets go: no trip
            (9, SystemState.ENABLED),
            (math.inf, SystemState.ESTOP),
        ]
        return SafetyState(next(s for until, s in plan if t_s < until))

    measured = measure(record(tmp_path, {"safety/state": state}, 10.0), "safety_trips")
    assert measured == Measured(2, 3.0)


# -- what is not there is not measured ----------------------------------------------------------------------------


def test_what_a_recording_lacks_is_unknown_and_never_passes(tmp_path: Path) -> None:
    """A real drive has no truth: every criterion that needs it is UNKNOWN."""
    run = record(tmp_path, {"localise/pose": lambda t: Pose()}, 1.0)
    criteria = tuple(Criterion(name, op, 0.0) for name in METRICS for op in ("<=", ">="))
    result = judge(run, criteria)
    assert [f.criterion.metric for f in result.findings if f.verdict is not Verdict.UNKNOWN] == []
    assert result.verdict is Verdict.UNKNOWN


def test_every_metric_has_a_meaning_and_says_its_unit_in_its_name() -> None:
    endings = {"m/s2": "_mps2", "m/s": "_mps", "m": "_m", "s": "_s", "rad": "_rad", "": ""}
    for name, metric in METRICS.items():
        assert name == metric.name
        assert len(metric.doc) > 10
        assert name.endswith(endings[metric.unit]), name


# -- verdicts ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("op", "limit", "verdict"),
    [("<=", 2.0, "PASS"), ("<", 2.0, "FAIL"), (">=", 2.0, "PASS"), (">", 2.0, "FAIL"), ("==", 2.0, "PASS"),
     ("==", 2.1, "FAIL"), ("<=", 1.9, "FAIL"), (">=", 2.1, "FAIL")],
)  # fmt: skip
def test_criterion_compares_as_its_operator_says(op: str, limit: float, verdict: str) -> None:
    assert find(Criterion("final_speed_mps", op, limit), Measured(2.0)).verdict == verdict


def test_value_that_is_no_number_never_passes() -> None:
    for op in ("<=", ">=", "=="):
        assert find(Criterion("final_speed_mps", op, 0.0), Measured(math.nan)).verdict is Verdict.FAIL


@pytest.mark.parametrize("text", ["", "2.0", "<=2.0", "=< 2.0", "<= two", "<= nan", "<= inf", "<= 1 2"])
def test_criterion_that_cannot_be_read_says_how_one_looks(text: str) -> None:
    with pytest.raises(ValueError, match=r'an operator, a blank and a number, such as "<= 2.0"'):
        Criterion.parse("final_speed_mps", text)


def test_one_failed_criterion_fails_the_drive_and_worse_things_come_first(tmp_path: Path) -> None:
    run = record(tmp_path, LINE, 2.0)
    good, bad = Criterion("decel_max_mps2", "<=", 1.0), Criterion("final_speed_mps", "<=", 0.5)
    unknown = Criterion("brake_delay_s", "<=", 1.0)
    assert judge(run, (good,)).verdict is Verdict.PASS
    assert judge(run, (good, unknown)).verdict is Verdict.UNKNOWN
    assert judge(run, (good, bad, unknown)).verdict is Verdict.FAIL
    assert judge(run, (good,), reason="no room for the course").verdict is Verdict.INVALID


def test_module_that_broke_makes_an_error_with_its_reason(tmp_path: Path) -> None:
    def status(t_s: float) -> ModuleStatus:
        broken = t_s >= 0.5
        return ModuleStatus(ModuleState.FAULT, 3, "cycle 50: ValueError: no way") if broken else ModuleStatus()

    run = record(tmp_path, {**LINE, "follow/status": status}, 1.0)
    result = judge(run, (Criterion("decel_max_mps2", "<=", 1.0),))
    assert result.verdict is Verdict.ERROR
    assert "follow: cycle 50: ValueError: no way" in result.reason


def test_result_file_says_what_was_judged_and_infinite_values_are_text(tmp_path: Path) -> None:
    run = record(tmp_path, LINE, 2.0, ((50.0, 0.0, 1.0),))
    result = judge(run, (Criterion("finish_time_s", "<=", 5.0), Criterion("final_speed_mps", ">=", 0.5)))
    result.write(tmp_path / "result.json")
    written = json.loads((tmp_path / "result.json").read_text())
    assert (written["scenario"], written["seed"], written["verdict"]) == ("test/scene", 7, "FAIL")
    assert written["duration_s"] == pytest.approx(2.0)
    assert written["trace"] == run.trace_hash()
    late, fast = written["criteria"]
    assert (late["metric"], late["op"], late["limit"], late["unit"]) == ("finish_time_s", "<=", 5.0, "s")
    assert (late["value"], late["verdict"]) == ("inf", "FAIL")
    assert (fast["value"], fast["verdict"]) == (pytest.approx(1.0), "PASS")
    assert set(written["metrics"]) == set(METRICS)
    assert list(tmp_path.glob("*.tmp")) == []
