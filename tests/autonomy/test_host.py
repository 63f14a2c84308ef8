"""A host runs a module on the cut, and keeps the module's faults to itself."""

import math
import sys
from collections.abc import Callable
from typing import Any, ClassVar

import msgspec
import numpy as np
import pytest

from autonomy import Input, Module, ModuleError, Output, Param
from autonomy.host import Host
from autonomy.module import HOLD_STEPS
from autonomy.wiring import Wire
from hal.signals import (
    Course,
    DriveCommand,
    FollowState,
    GpsFix,
    ModuleState,
    ModuleStatus,
    Odometry,
    Pose,
)
from rtdb import STATIC, Object, Sample, Store, Writer

TICK_NS = 10_000_000
T0_NS = 1_700_000_000_000_000_000
SAFE = DriveCommand(speed_mps=-0.125, steer_rad=0.25)


class Probe(Module):
    """Does what the test says, and remembers what it was given."""

    course = Input(Course, static=True, optional=True)
    pose = Input(Pose, max_age_s=0.05)
    odometry = Input(Odometry)
    gps = Input(GpsFix, optional=True, max_age_s=0.1)
    drive = Output(DriveCommand, safe=SAFE)
    state = Output(FollowState, safe=FollowState(waypoint=99))
    gain = Param(1.5, unit="1")

    task: ClassVar[Callable[["Probe"], None]]
    resets: int = 0

    def reset(self) -> None:
        self.resets += 1
        self.first_draw = float(self.rng.random())
        self.seen: list[tuple[int, float, GpsFix | None, Course | None]] = []

    def step(self) -> None:
        self.seen.append((self.t_ns, self.pose.x_m, self.gps, self.course))
        self.drive = DriveCommand(speed_mps=0.1 * self.gain * self.pose.x_m)
        self.state = FollowState(waypoint=len(self.seen))
        Probe.task(self)


@pytest.fixture(autouse=True)
def _nothing_special() -> None:
    Probe.task = lambda probe: None


class Rig:
    """One module on a private store, with writers for all that it may read."""

    def __init__(
        self,
        cls: type[Module] = Probe,
        *,
        every: int = 1,
        phase: int = 0,
        seed: int = 0,
        name: str = "probe",
        leave_out: tuple[str, ...] = ("gps", "course"),
        params: dict[str, Any] | None = None,
    ) -> None:
        self.store = Store.create(tick_ns=TICK_NS, t0_ns=T0_NS)
        source = self.store.join("source")
        self.course: Writer[Course] = source.insert("course", Course, flags=STATIC)
        self.pose: Writer[Pose] = source.insert("pose", Pose)
        self.odometry: Writer[Odometry] = source.insert("odometry", Odometry)
        self.gps: Writer[GpsFix] = source.insert("gps", GpsFix)
        self.inputs = {port: f"source/{port}" for port in cls.inputs if port not in leave_out}
        wire = Wire(name, f"{cls.__module__}:{cls.__qualname__}", every, phase, self.inputs, params or {})
        self.host = Host(self.store, wire, seed)
        self.host.connect()
        self.name = name

    @property
    def module(self) -> Any:
        return self.host.module

    def tick(self, *, pose: bool = True) -> int:
        """Write inputs that are true now, tick, and let the host work on the new cut."""
        if pose:
            self.pose.write(Pose(x_m=float(self.store.cycle + 1)))
        self.odometry.write(Odometry(valid=True))
        return self.step()

    def step(self) -> int:
        cycle = self.store.tick()
        self.host.step(cycle)
        return cycle

    def ticks(self, n: int, **how: bool) -> None:
        for _ in range(n):
            self.tick(**how)

    def shown(self, name: str, cls: type[Any]) -> Sample[Any] | None:
        found: Object[Any] = self.store.find(f"{self.name}/{name}", cls)
        return found.visible(self.store.cycle)

    def value(self, name: str, cls: type[Any]) -> Any:
        sample = self.shown(name, cls)
        assert sample is not None, f"{name} shows nothing"
        return sample.value

    @property
    def status(self) -> ModuleStatus:
        found: ModuleStatus = self.value("status", ModuleStatus)
        return found


# -- inputs ---------------------------------------------------------------------------------------------------------


def test_module_is_called_once_all_inputs_are_there() -> None:
    rig = Rig()
    for _ in range(3):
        rig.step()
    assert rig.module.resets == 0
    assert rig.shown("drive", DriveCommand) is None
    assert rig.status.state is ModuleState.WAITING
    assert "input pose (source/pose) is not there yet" in rig.status.reason
    rig.ticks(2)
    assert len(rig.module.seen) == 2
    rig.step()
    assert rig.status.state is ModuleState.RUNNING


def test_reset_is_called_once_before_the_first_step() -> None:
    rig = Rig()
    rig.ticks(5)
    assert rig.module.resets == 1
    assert len(rig.module.seen) == 5


def test_step_reads_the_cut_of_its_cycle() -> None:
    rig = Rig()
    rig.ticks(4)
    assert [(t_ns, x_m) for t_ns, x_m, _, _ in rig.module.seen] == [
        (T0_NS + c * TICK_NS, float(c)) for c in (1, 2, 3, 4)
    ]


def test_optional_input_that_is_not_wired_reads_none() -> None:
    rig = Rig()
    rig.ticks(2)
    assert [(gps, course) for _, _, gps, course in rig.module.seen] == [(None, None)] * 2


def test_optional_input_reads_none_before_its_first_write_and_when_it_is_stale() -> None:
    rig = Rig(leave_out=())
    rig.tick()
    rig.gps.write(GpsFix(mode=3))
    rig.ticks(14)
    modes = [gps.mode if gps is not None else None for _, _, gps, _ in rig.module.seen]
    # written at the end of cycle 1, so its data time is that of cycle 1: up to cycle 11 it is at most 0.1 s old
    assert modes == [None] + [3] * 10 + [None] * 4


def test_module_stops_being_called_when_an_input_is_stale_and_goes_on_with_a_fresh_one() -> None:
    rig = Rig()
    rig.ticks(3)
    rig.ticks(10, pose=False)  # 0.05 s are five cycles
    assert len(rig.module.seen) == 3 + 4
    assert rig.status.state is ModuleState.STALE
    assert "input pose (source/pose) is 0.0" in rig.status.reason
    assert "at most 0.05 s" in rig.status.reason
    rig.ticks(3)
    assert len(rig.module.seen) == 3 + 4 + 3
    assert rig.module.resets == 1
    assert rig.status.state is ModuleState.RUNNING


def test_outputs_are_held_then_safe_while_an_input_is_stale() -> None:
    rig = Rig()
    rig.ticks(3)
    rig.ticks(4, pose=False)  # stale in the next one: the last value is that of cycle 7 with the pose of cycle 3
    steps = len(rig.module.seen)
    shown = []
    for _ in range(HOLD_STEPS + 3):
        rig.tick(pose=False)
        shown.append(rig.value("drive", DriveCommand))
    assert len(rig.module.seen) == steps
    held, safe = shown[: HOLD_STEPS + 1], shown[HOLD_STEPS + 1 :]  # what is written in a cycle shows in the next
    assert held == [DriveCommand(speed_mps=0.1 * 1.5 * 3)] * len(held)
    assert safe == [SAFE] * len(safe)
    assert safe


class Patient(Module):
    """Declares for how long each of its outputs stands."""

    pose = Input(Pose, max_age_s=0.05)
    drive = Output(DriveCommand, safe=SAFE, hold_steps=0)
    state = Output(FollowState, safe=FollowState(waypoint=99), hold_steps=5)

    def step(self) -> None:
        self.drive, self.state = DriveCommand(speed_mps=1.0), FollowState(waypoint=1)


def test_each_output_is_held_for_as_many_steps_as_it_declares() -> None:
    rig = Rig(Patient)
    rig.ticks(3)
    rig.ticks(5, pose=False)  # cycle 8 is the last one with a pose that is young enough
    shown = []
    for _ in range(8):
        rig.tick(pose=False)
        shown.append((rig.value("drive", DriveCommand) == SAFE, rig.value("state", FollowState).waypoint == 99))
    assert [drive for drive, _ in shown].index(True) + 5 == [state for _, state in shown].index(True)


# -- time and lineage -------------------------------------------------------------------------------------------------


def test_outputs_show_at_the_tick_after_the_step() -> None:
    rig = Rig(every=4, phase=2)
    seen = []
    for _ in range(9):
        cycle = rig.tick()
        sample = rig.shown("drive", DriveCommand)
        seen.append((cycle, sample.write if sample is not None else 0))
    assert seen == [(1, 0), (2, 0), (3, 1), (4, 1), (5, 1), (6, 1), (7, 2), (8, 2), (9, 2)]


def test_module_is_due_at_its_phase_only() -> None:
    rig = Rig(every=4, phase=3)
    rig.ticks(12)
    assert [(t_ns - T0_NS) // TICK_NS for t_ns, *_ in rig.module.seen] == [3, 7, 11]
    assert rig.module.dt_s == pytest.approx(0.04)


def test_data_time_of_outputs_is_the_oldest_of_the_inputs_that_are_not_static() -> None:
    rig = Rig(leave_out=())
    rig.course.write(Course(), T0_NS - 10_000_000_000)
    rig.gps.write(GpsFix(mode=3), T0_NS - 7_000_000)
    rig.pose.write(Pose(), T0_NS - 5_000_000)
    rig.odometry.write(Odometry(), T0_NS - 3_000_000)
    rig.step()
    rig.step()
    for name, cls in (("drive", DriveCommand), ("state", FollowState)):
        sample = rig.shown(name, cls)
        assert sample is not None
        assert sample.t_data_ns == T0_NS - 7_000_000


def test_causes_of_outputs_are_the_inputs_that_were_read() -> None:
    rig = Rig(leave_out=("course",))
    rig.tick()  # without a fix
    rig.gps.write(GpsFix(mode=3))
    rig.tick()
    read = {"pose": rig.pose, "odometry": rig.odometry, "gps": rig.gps}
    expected = [
        {(read[n].oid, 1) for n in ("pose", "odometry")},
        {(read["pose"].oid, 2), (read["odometry"].oid, 2), (read["gps"].oid, 1)},
    ]
    drive = rig.store.find("probe/drive", DriveCommand)
    assert [set(drive.read(k).causes) for k in (1, 2)] == expected


def test_static_input_neither_ages_nor_causes_outputs() -> None:
    rig = Rig(leave_out=("gps",))
    rig.course.write(Course(speed_mps=3.0), T0_NS - 10_000_000_000)
    rig.tick()
    rig.step()
    sample = rig.shown("drive", DriveCommand)
    assert sample is not None
    assert rig.course.oid not in dict(sample.causes)
    assert sample.t_data_ns > T0_NS - TICK_NS
    assert rig.module.seen[0][3] == Course(speed_mps=3.0)


# -- parameters and randomness ---------------------------------------------------------------------------------------


def test_parameters_come_from_the_wiring_else_from_the_class() -> None:
    by_default, wired = Rig(), Rig(params={"gain": 4})
    for rig in (by_default, wired):
        rig.ticks(2)
    assert by_default.value("drive", DriveCommand).speed_mps == 0.1 * 1.5
    assert wired.value("drive", DriveCommand).speed_mps == 0.1 * 4.0
    assert type(wired.module.gain) is float  # a whole number in JSON is still a float here


def test_random_numbers_depend_on_seed_and_component_alone() -> None:
    def draw(seed: int, name: str) -> float:
        rig = Rig(seed=seed, name=name)
        rig.tick()
        return float(rig.module.first_draw)

    np.random.seed(1)  # the global generator must not matter
    first = draw(3, "probe")
    np.random.seed(2)
    assert draw(3, "probe") == first
    assert len({first, draw(4, "probe"), draw(3, "other")}) == 3


# -- faults -----------------------------------------------------------------------------------------------------------


def _raise(error: BaseException) -> Callable[[Probe], None]:
    def task(probe: Probe) -> None:
        raise error

    return task


def _assign(name: str, value: Any) -> Callable[[Probe], None]:
    return lambda probe: setattr(probe, name, value)


def _forget(probe: Probe) -> None:
    probe._out.pop(Probe.outputs["state"])


def _read_attribute_that_is_not_there(probe: Probe) -> None:
    probe.drive = DriveCommand(speed_mps=probe.pose.sped_mps)  # type: ignore[attr-defined]


BREAKING = {
    "exception": (_raise(ZeroDivisionError("division by zero")), "ZeroDivisionError: division by zero"),
    "exit": (lambda probe: sys.exit(0), "SystemExit: 0"),
    "assertion": (_raise(AssertionError()), "AssertionError"),
    "mistyped field": (_read_attribute_that_is_not_there, "has no attribute 'sped_mps'"),
    "nan": (_assign("drive", DriveCommand(speed_mps=math.nan)), "output drive is not finite"),
    "infinite": (_assign("drive", DriveCommand(steer_rad=-math.inf)), "output drive is not finite"),
    "forgotten output": (_forget, "output state was not assigned in this step"),
    "wrong record": (_assign("state", DriveCommand()), "output state is a FollowState, got DriveCommand"),
    "no record": (_assign("drive", 2.0), "output drive is a DriveCommand, got 2.0"),
    "none": (_assign("drive", None), "output drive was not assigned"),
    "unknown port": (_assign("speed", DriveCommand()), "self.speed is not an output; Probe declares drive, state"),
    "does not fit": (_assign("state", FollowState(waypoint=-1)), "waypoint=-1 does not fit"),
    "text as number": (_assign("drive", DriveCommand(speed_mps="fast")), "speed_mps is a number [m/s], got 'fast'"),  # type: ignore[arg-type]
}


@pytest.mark.parametrize("case", BREAKING)
def test_what_a_module_does_wrong_latches_and_is_said_in_its_status(case: str) -> None:
    task, reason = BREAKING[case]
    rig = Rig()
    rig.ticks(3)
    Probe.task = task
    rig.tick()
    Probe.task = lambda probe: None  # it would work again, but nobody trusts it any more
    for _ in range(HOLD_STEPS):
        rig.tick()
        assert rig.value("drive", DriveCommand) == DriveCommand(speed_mps=0.1 * 1.5 * 3), "held"
    rig.ticks(3)
    assert len(rig.module.seen) == 4
    assert rig.status.state is ModuleState.FAULT
    assert rig.status.reason.startswith("cycle 4: ")
    assert reason in rig.status.reason
    assert reason in rig.host.fault
    assert rig.status.steps == 3
    assert rig.value("drive", DriveCommand) == SAFE
    assert rig.value("state", FollowState) == FollowState(waypoint=99)


def test_no_output_of_a_step_that_went_wrong_is_written() -> None:
    """The first output is sound, the second is not: neither shows."""
    rig = Rig()
    rig.ticks(2)
    Probe.task = _assign("state", FollowState(waypoint=-1))
    rig.tick()
    assert rig.store.find("probe/drive", DriveCommand).head == 2
    assert rig.store.find("probe/state", FollowState).head == 2


def test_long_reason_is_cut_at_what_the_status_holds() -> None:
    rig = Rig()
    Probe.task = _raise(ValueError("ä" * 500 + "\0"))
    rig.ticks(2)
    assert rig.status.reason.startswith("cycle 1: ValueError: ää")
    assert 150 < len(rig.status.reason.encode()) <= 160


def test_ctrl_c_is_not_a_fault_of_the_module() -> None:
    rig = Rig()
    Probe.task = _raise(KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        rig.tick()
    assert rig.host.fault == ""


class Reckless(Module):
    """Its reset raises."""

    pose = Input(Pose)
    drive = Output(DriveCommand, safe=SAFE)

    def reset(self) -> None:
        raise RuntimeError("no map")

    def step(self) -> None:
        self.drive = DriveCommand()


def test_reset_that_raises_is_a_fault_and_the_module_never_says_anything() -> None:
    rig = Rig(Reckless)
    rig.ticks(8)
    assert rig.status.state is ModuleState.FAULT
    assert "RuntimeError: no map" in rig.status.reason
    assert rig.shown("drive", DriveCommand) is None


class OwnInit(Module):
    """Has an __init__ that does not call its base's, and keeps a record of its own."""

    pose = Input(Pose)
    drive = Output(DriveCommand, safe=SAFE)

    def __init__(self) -> None:
        self.n = 0

    def step(self) -> None:
        self.n += 1
        self._before = DriveCommand(speed_mps=float(self.n))
        self.drive = self._before


def test_module_may_have_an_init_of_its_own_and_keep_records_under_names_with_an_underscore() -> None:
    rig = Rig(OwnInit)
    rig.ticks(3)
    assert rig.host.fault == ""
    assert rig.value("drive", DriveCommand) == DriveCommand(speed_mps=2.0)


class Downstream(Module):
    """Reads what Probe says."""

    drive_in = Input(DriveCommand)
    drive = Output(DriveCommand, safe=SAFE)

    def step(self) -> None:
        self.drive = msgspec.structs.replace(self.drive_in, steer_rad=0.25)


def test_other_modules_go_on_when_one_breaks() -> None:
    rig = Rig()
    wire = Wire("next", f"{__name__}:Downstream", 1, 0, {"drive_in": "probe/drive"})
    after = Host(rig.store, wire, 0)
    after.connect()
    found = rig.store.find("next/drive", DriveCommand)
    speeds = []
    for k in range(12):
        Probe.task = _raise(RuntimeError("broken")) if k == 4 else lambda probe: None
        after.step(rig.tick())
        sample = found.visible(rig.store.cycle)
        speeds.append(None if sample is None else sample.value.speed_mps)
    assert after.fault == ""
    assert speeds == [None, None, *(0.1 * 1.5 * k for k in (1, 2, 3, 4, 4, 4)), *[SAFE.speed_mps] * 4]


# -- wiring to the store --------------------------------------------------------------------------------------------


def test_input_that_points_at_nothing_is_named() -> None:
    with Store.create() as store:
        wire = Wire("next", f"{__name__}:Downstream", 1, 0, {"drive_in": "probe/drvie"})
        host = Host(store, wire, 0)
        with pytest.raises(ModuleError, match=r"next\.drive_in = probe/drvie: "):
            host.connect()


def test_input_that_points_at_another_record_is_named() -> None:
    with Store.create() as store:
        store.join("probe").insert("drive", Pose)
        wire = Wire("next", f"{__name__}:Downstream", 1, 0, {"drive_in": "probe/drive"})
        host = Host(store, wire, 0)
        with pytest.raises(ModuleError, match=r"next\.drive_in = probe/drive: .*Pose.*DriveCommand"):
            host.connect()
