"""Who brakes: whole drives on a straight, each with one layer of the chain and without the layers above it.

    guard -> limits (in the host's driver) -> safety node -> actuator nodes

Every stop must end at standstill, no harder than 1.8 m/s2, with a rear axle that never locks.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import pytest

from autonomy.host import Host
from autonomy.wiring import Stack, load_stack
from hal.bus import Level
from hal.codecs.cartcan import BrakeCmd, BrakeRpt, Message, SteerRpt, SystemCmd, SystemRpt, ThrottleCmd, ThrottleRpt
from hal.devices.safety import FaultCode
from hal.faults import HostSilence
from hal.limits import Envelope
from hal.signals import (
    ActuatorCommand,
    DriveCommand,
    GuardState,
    Hold,
    Limit,
    ModuleState,
    ModuleStatus,
    SystemState,
)
from rtdb.recording import Recording
from scenarios.run import Drive, Setup
from scenarios.run import drive as drive_into
from scenarios.scenario import GpsOutageFault, Scenario, load_scenario
from sim.plant import Demand, Ground

MS = 1_000_000
AT_S = 8.0  # when a layer fails; the cart has reached its 3 m/s by then
DRY, WET = 0.8, 0.5  # friction of the plant's tyres, and what a stop must still do with
BRAKING = 0.02  # effort that the brake node reports once it brakes
SAFETY_REPORT_MS, BRAKE_REPORT_MS, POLL_MS = 50, 20, 10
"""Periods of the nodes on the bus."""


class WatchedPlant:
    """The plant, with an eye on every step of it. friction_factor: 1 = dry asphalt."""

    def __init__(self, plant: Any, friction_factor: float) -> None:
        self._plant, self._friction_factor = plant, friction_factor
        self.locked = False
        self.decel_mps2 = 0.0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._plant, name)

    def step(self, demand: Demand, ground: Ground) -> None:
        self._plant.step(demand, msgspec.structs.replace(ground, friction_factor=self._friction_factor))
        state = self._plant.state
        self.locked = self.locked or state.rear_locked
        self.decel_mps2 = max(self.decel_mps2, -state.ax_mps2)


@dataclass
class Ride:
    """A drive with ears on its bus."""

    drive: Drive
    plant: WatchedPlant
    frames: list[tuple[int, Message]] = field(default_factory=list)
    commands: list[ActuatorCommand] = field(default_factory=list)
    hung: set[str] = field(default_factory=set)
    over: bool = False

    def __post_init__(self) -> None:
        kinds = (BrakeCmd, BrakeRpt, SteerRpt, SystemCmd, SystemRpt, ThrottleCmd, ThrottleRpt)
        self._ear = self.drive.sim.bus.port("EAR", kinds)
        self._commands = self.drive.cart.find("actuators/command", ActuatorCommand)

    def run(self, until_s: float = 1e9) -> "Ride":
        """Drive on until a time, or to the end."""
        while not self.over and self.drive.time_s < until_s - 1e-6:
            self.over = self.drive.tick()
            self.frames += [(r.t_ns, r.message) for r in self._ear.receive() if r.message is not None]
            sample = self._commands.visible(self.drive.cart.cycle)
            if sample is not None:
                self.commands.append(sample.value)
        return self

    @property
    def now_ns(self) -> int:
        return self.drive.sim.t_ns

    @property
    def speed_mps(self) -> float:
        return float(self.plant.state.vx_mps)

    def first(self, kind: type[Message], wanted: Callable[[Any], bool], after_ns: int) -> int:
        """When a message of a kind that is wanted was sent first."""
        return next(t_ns for t_ns, m in self.frames if isinstance(m, kind) and t_ns > after_ns and wanted(m))

    def braking_report_ms(self, after_ns: int) -> float:
        """From a time to the brake node's first report that it brakes."""
        return (self.first(BrakeRpt, lambda m: (m.effort_cmd_ratio or 0.0) > BRAKING, after_ns) - after_ns) / MS

    def braking_frame_ms(self, after_ns: int) -> float:
        """From a time to the host's first command to brake."""
        return (self.first(BrakeCmd, lambda m: m.enable and m.effort > 0, after_ns) - after_ns) / MS

    def last_sent_ns(self, kind: type[Message]) -> int:
        return max(t_ns for t_ns, m in self.frames if isinstance(m, kind))

    def states(self, after_ns: int = 0) -> set[SystemState]:
        return {SystemState(m.state) for t_ns, m in self.frames if isinstance(m, SystemRpt) and t_ns > after_ns}

    def must_have_stopped_well(self) -> None:
        assert abs(self.speed_mps) < 0.01
        assert 0.8 <= self.plant.decel_mps2 <= 1.8
        assert not self.plant.locked
        assert self.drive.sim.drive.output == 0.0
        assert self.drive.sim.brake.effort > 0.0


def straight(*faults: GpsOutageFault, duration_s: float = 22.0) -> Scenario:
    """A straight of 200 m on the pad at 3 m/s."""
    base = load_scenario("safety/host-dies")
    far = base.course.waypoints[0].model_copy(update={"east_m": 200.0})
    course = base.course.model_copy(update={"waypoints": (far,)})
    return base.model_copy(update={"course": course, "faults": faults, "duration_s": duration_s})


@contextmanager
def riding(
    scenario: Scenario | None = None, *, stack: Stack | None = None, level: Level = "direct", friction: float = DRY
) -> Iterator[Ride]:
    """Ride the straight up to the moment at which the test takes something away; the cart rolls at its speed then."""
    hung: set[str] = set()
    step = Host.step

    def step_unless_hung(host: Host, cycle: int, *rest: int) -> None:
        if host.wire.component not in hung:
            step(host, cycle, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Host, "step", step_unless_hung)
        drive = Drive(Setup(scenario=scenario or straight(), level=level, stack=stack))
    with drive:
        plant = WatchedPlant(drive.sim.plant, friction / DRY)
        drive.sim.plant = plant
        ride = Ride(drive, plant, hung=hung).run(AT_S)
        assert ride.speed_mps > 2.5
        assert ride.drive.hal.driver.state is SystemState.ENABLED
        assert ride.drive.sim.brake.effort < 0.2
        yield ride


def freeze(ride: Ride, component: str) -> int:
    """Let a module hang right after a step: its last output stays. Returns when that was written."""
    wire = next(w for w in ride.drive.stack.wires if w.component == component)
    while ride.drive.cart.cycle % wire.every != wire.phase:
        ride.run(ride.drive.time_s + 0.01)
    ride.hung.add(component)
    return ride.now_ns


def remove_safety_node(ride: Ride) -> None:
    ride.drive.sim.safety.poll = lambda *_: None  # type: ignore[method-assign]


@pytest.fixture
def no_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    def pass_all(command: DriveCommand | None, age_ns: int, envelope: Envelope) -> tuple[DriveCommand, Limit]:
        return command or DriveCommand(), Limit.NONE

    monkeypatch.setattr("hal.drivers.cart.limit", pass_all)


# -- guard ------------------------------------------------------------------------------------------------------------

NO_GPS = GpsOutageFault(kind="gps-outage", at_s=6.0, for_s=60.0)


def test_the_guard_stops_a_cart_that_does_not_know_where_it_is() -> None:
    with riding(straight(NO_GPS)) as ride:
        state = ride.drive.cart.find("guard/state", GuardState)
        while state.read(state.head).value.hold is Hold.NONE:
            assert not ride.over
            ride.run(ride.drive.time_s + 0.01)
        assert ride.speed_mps > 2.5
        held_ns = ride.now_ns
        ride.run()
        assert ride.braking_report_ms(held_ns) <= 100
        ride.must_have_stopped_well()
        assert ride.states(held_ns) == {SystemState.ENABLED}  # nobody below had to act
        assert {c.limit for c in ride.commands[-800:]} == {Limit.NONE}


def test_without_the_guard_the_same_outage_does_not_stop_the_cart() -> None:
    stack = load_stack(straight().stack_path())
    with riding(straight(NO_GPS), stack=Stack(stack.wires, "follow/drive")) as ride:
        ride.run()
        assert ride.speed_mps > 2.5


# -- limits -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("component", ["guard", "follow", "localise"])
def test_a_module_that_hangs_is_braked_within_300_ms(component: str) -> None:
    """The limits see the age; modules behind the hung one may see it first, by the age of their inputs."""
    with riding() as ride:
        hung_ns = freeze(ride, component)
        ride.run()
        assert ride.braking_frame_ms(hung_ns) <= 300
        assert ride.braking_report_ms(hung_ns) <= 300
        ride.must_have_stopped_well()


@pytest.mark.parametrize("friction", [DRY, WET])
def test_a_frozen_guard_is_stopped_by_the_limits_before_the_safety_node_knows(friction: float) -> None:
    with riding(friction=friction) as ride:
        hung_ns = freeze(ride, "guard")
        ride.run()
        brake_ms = ride.braking_frame_ms(hung_ns)
        stopping = ride.first(SystemRpt, lambda m: m.state == SystemState.STOPPING, hung_ns)
        assert brake_ms < (stopping - hung_ns) / MS
        assert Limit.STALE in {c.limit for c in ride.commands}
        assert not ride.commands[-1].enable
        ride.must_have_stopped_well()


# -- safety node ------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("no_limits")
def test_without_limits_the_safety_node_sees_the_data_cycle_stand_still() -> None:
    with riding() as ride:
        hung_ns = freeze(ride, "guard")
        ride.run()
        cycles = [(t_ns, m.cycle) for t_ns, m in ride.frames if isinstance(m, SystemCmd)]
        moved_ns = max(b[0] for a, b in pairwise(cycles) if b[1] != a[1])
        stopping_ns = ride.first(SystemRpt, lambda m: m.state == SystemState.STOPPING, moved_ns)
        assert 250 < (stopping_ns - moved_ns) / MS <= 250 + SAFETY_REPORT_MS
        assert ride.braking_report_ms(moved_ns) <= 250 + SAFETY_REPORT_MS + BRAKE_REPORT_MS + POLL_MS
        assert moved_ns - hung_ns <= 2 * 50 * MS  # SYSTEM_CMD carries the cycle of the burst before it
        assert ride.drive.sim.safety.fault is FaultCode.CYCLE_STANDS
        ride.must_have_stopped_well()


@pytest.mark.usefixtures("no_limits")
@pytest.mark.parametrize(("level", "friction"), [("direct", DRY), ("wire", DRY), ("direct", WET)])
def test_a_silent_host_is_stopped_by_the_nodes_within_300_ms(level: Level, friction: float) -> None:
    with riding(level=level, friction=friction) as ride:
        ride.drive.sim.bus.faults.append(HostSilence(ride.now_ns))
        ride.run()
        last_ns = ride.last_sent_ns(BrakeCmd)
        assert ride.now_ns - last_ns > 2_000 * MS
        assert ride.braking_report_ms(last_ns) <= 300
        ride.must_have_stopped_well()
        assert ride.states() >= {SystemState.STOPPING, SystemState.FAULT}


# -- actuator nodes ---------------------------------------------------------------------------------------------------


def test_without_host_and_safety_node_the_actuators_stop_the_cart_by_themselves() -> None:
    with riding() as ride:
        ride.drive.sim.bus.faults.append(HostSilence(ride.now_ns))
        remove_safety_node(ride)
        ride.run()
        assert ride.braking_report_ms(ride.last_sent_ns(BrakeCmd)) <= 300
        assert ride.states(ride.last_sent_ns(SystemRpt)) == set()
        ride.must_have_stopped_well()


def test_when_the_safety_node_dies_the_actuators_stop_a_cart_whose_host_drives_on() -> None:
    with riding() as ride:
        remove_safety_node(ride)
        ride.run()
        assert ride.braking_report_ms(ride.last_sent_ns(SystemRpt)) <= 300
        assert ride.last_sent_ns(BrakeCmd) > ride.now_ns - 100 * MS  # the host goes on to the end
        ride.must_have_stopped_well()


def test_a_silence_that_ends_does_not_let_the_cart_drive_on() -> None:
    """The host falls silent for 150 ms, not for good: the stop stands all the same."""
    with riding() as ride:
        from_ns = ride.now_ns
        ride.drive.sim.bus.faults.append(
            lambda frame: None if frame.sender == "HOST" and from_ns <= frame.t_ns < from_ns + 150 * MS else frame
        )
        ride.run(AT_S + 0.3)
        driven = [m.enabled for t_ns, m in ride.frames if isinstance(m, ThrottleRpt) and t_ns > from_ns + 120 * MS]
        assert not any(driven)
        ride.run()
        ride.must_have_stopped_well()


# -- the emergency stop -----------------------------------------------------------------------------------------------


def test_only_the_emergency_stop_is_harder_than_the_others() -> None:
    with riding() as ride:
        ride.drive.sim.estop_button = True
        pressed_ns = ride.now_ns
        ride.run(AT_S + 4.0)
        assert ride.braking_report_ms(pressed_ns) <= 2 * BRAKE_REPORT_MS
        assert abs(ride.speed_mps) < 0.01
        assert ride.plant.decel_mps2 > 2.0
        assert ride.drive.sim.drive.contactor_open


# -- broken modules ---------------------------------------------------------------------------------------------------

BROKEN = """
import math
from autonomy.{base} import {cls}
from hal.signals import DriveCommand

class Broken({cls}):
    def step(self):
        super().step()
        if self.t_ns >= {at_ns}:
            {deed}
"""
DEEDS = {
    "nan-speed": ("self.drive = DriveCommand(speed_mps=math.nan)", "not finite"),
    "infinite-angle": ("self.drive = DriveCommand(speed_mps=3.0, steer_rad=math.inf)", "not finite"),
    "raises": ("raise ZeroDivisionError('the map is flat')", "ZeroDivisionError: the map is flat"),
    "wrong-type": ("self.drive = 3.0", "output drive is a DriveCommand"),
    "forgets": ("self._out.clear()", "was not assigned"),
}


def broken(tmp_path: Path, component: str, deed: str) -> Stack:
    """The shipped stack with a module that does something bad from AT_S on."""
    scenario = straight()
    path = tmp_path / f"broken_{component}_{deed.replace('-', '_')}.py"
    path.write_text(
        BROKEN.format(
            base=component,
            cls=component.capitalize(),
            at_ns=scenario.t0_ns + round(AT_S * 1e9),
            deed=DEEDS[deed][0],
        )
    )
    return load_stack(scenario.stack_path()).use(component, f"{path}:Broken")


@pytest.mark.parametrize("component", ["follow", "guard"])
@pytest.mark.parametrize("deed", DEEDS)
def test_a_broken_module_stops_the_cart_by_its_safe_value_and_says_why(
    tmp_path: Path, component: str, deed: str
) -> None:
    with riding(stack=broken(tmp_path, component, deed)) as ride:
        broke_ns = ride.now_ns
        ride.run()
        assert ride.braking_report_ms(broke_ns) <= 300
        ride.must_have_stopped_well()
        assert ride.states(broke_ns) == {SystemState.ENABLED}
        assert all(c.limit is Limit.NONE for c in ride.commands if c.enable)
        status = ride.drive.cart.find(f"{component}/status", ModuleStatus)
        sample = status.read(status.head)
        assert sample.value.state is ModuleState.FAULT
        assert DEEDS[deed][1] in sample.value.reason


def test_the_reason_of_a_broken_module_stands_in_the_recording(tmp_path: Path) -> None:
    setup = Setup(scenario=straight(duration_s=14.0), level="direct", stack=broken(tmp_path, "follow", "raises"))
    drive_into(setup, tmp_path / "run.mcap")
    rows = Recording(tmp_path / "run.mcap").find("follow/status", ModuleStatus)
    assert [row.value.state for row in rows][-2:] == [ModuleState.RUNNING, ModuleState.FAULT]
    assert rows[-1].value.reason.endswith("ZeroDivisionError: the map is flat (broken_follow_raises.py:10)")
