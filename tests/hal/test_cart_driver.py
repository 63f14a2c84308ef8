"""The host end of the bus: what it sends and when, when it asks to be obeyed, how it brakes when it may not drive."""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import TypeVar

import msgspec
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from hal.bus import CanBus, Frame, Level
from hal.codecs.cartcan import (
    BrakeCmd,
    BrakeRpt,
    Direction,
    Message,
    SteerCmd,
    SteerMode,
    SteerRpt,
    SystemCmd,
    SystemRpt,
    ThrottleCmd,
    ThrottleMode,
    ThrottleRpt,
    WheelTicks,
)
from hal.drivers.cart import HOLD_EFFORT, STANDSTILL_MPS, CartDriver, actuator_state, brake_effort
from hal.limits import Envelope, limit
from hal.signals import ActuatorCommand, DriveCommand, Limit, PedalCommand, SystemState

MS = 1_000_000
TICK_NS = 10 * MS
T0_NS = 1_700_000_000_000_000_000
TICK_M = 1.40 / 128
M = TypeVar("M", bound=Message)
FORWARD = DriveCommand(speed_mps=2.0, steer_rad=0.1)
FULL_BRAKE_MPS2 = 5.0  # plant at effort 1: 2400 N on 480 kg


class Bench:
    """A driver, and a bus on which the test plays all the nodes."""

    def __init__(self, level: Level = "wire") -> None:
        self.bus = CanBus(level)
        self.ear = self.bus.port("EAR", [SystemCmd, SteerCmd, BrakeCmd, ThrottleCmd])
        self.driver = CartDriver(self.bus, TICK_M)
        self.safety = self.bus.port("SAFETY", [])
        self.odometer = self.bus.port("ODOM", [])
        self.t_ns = T0_NS
        self.state = SystemState.READY
        self.command: DriveCommand | PedalCommand | None = FORWARD
        self.age_ns: Callable[[], int] = lambda: 50 * MS
        self.speed_mps = self._metres = 0.0
        self.said: list[ActuatorCommand] = []
        self.frames: list[tuple[int, Message]] = []

    def tick(self) -> None:
        self.t_ns += TICK_NS
        self._metres += self.speed_mps * 0.01
        if self.t_ns % (50 * MS) == 0:
            self.safety.send(SystemRpt(state=self.state), self.t_ns)
        if self.t_ns % (20 * MS) == 0:
            ticks = math.floor(self._metres / TICK_M)
            self.odometer.send(WheelTicks.of(left=ticks, right=ticks, dt_s=0.02), self.t_ns)
        self.driver.poll()
        origin_ns = self.t_ns - self.age_ns()
        sent = self.driver.command(self.t_ns, self.command, origin_ns, (origin_ns - T0_NS) // TICK_NS)
        if sent is not None:
            self.said.append(sent)
        self.frames += [(r.t_ns, r.message) for r in self.ear.receive() if r.message is not None]

    def run(self, ms: int) -> None:
        for _ in range(ms // 10):
            self.tick()

    def enabled(self, speed_mps: float = 0.0) -> "Bench":
        """Let the safety node enable what is asked, and roll."""
        self.run(300)
        self.state, self.speed_mps = SystemState.ENABLED, speed_mps
        self.run(400)
        assert self.said[-1].enable
        return self

    def sent(self, kind: type[M], after_ns: int = 0) -> list[tuple[int, M]]:
        return [(t_ns, message) for t_ns, message in self.frames if isinstance(message, kind) and t_ns > after_ns]

    def last(self, kind: type[M]) -> M:
        return self.sent(kind)[-1][1]

    def asks(self) -> tuple[int, int, int, int]:
        """The four bits that enable: system, steering, brake, throttle."""
        return (
            self.last(SystemCmd).request_enable,
            self.last(SteerCmd).enable,
            self.last(BrakeCmd).enable,
            self.last(ThrottleCmd).enable,
        )


# -- what is sent, and when -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", list(SystemState))
@pytest.mark.parametrize("command", [None, FORWARD])
def test_bursts_come_every_20_ms_and_system_cmd_every_50_ms_in_every_state(
    state: SystemState, command: DriveCommand | None
) -> None:
    bench = Bench()
    bench.state, bench.command = state, command
    bench.run(1_000)
    for kind, period_ms in ((SteerCmd, 20), (BrakeCmd, 20), (ThrottleCmd, 20), (SystemCmd, 50)):
        assert [t_ns - T0_NS for t_ns, _ in bench.sent(kind)] == [
            k * period_ms * MS for k in range(1, 1_000 // period_ms + 1)
        ]


def test_the_three_commands_of_a_burst_stand_together_in_one_order() -> None:
    bench = Bench()
    bench.run(200)
    burst = [m.NAME for t_ns, m in bench.frames if t_ns == T0_NS + 120 * MS]
    assert burst == ["STEER_CMD", "BRAKE_CMD", "THROTTLE_CMD"]


def test_nothing_is_returned_between_bursts() -> None:
    bench = Bench()
    bench.run(100)
    assert len(bench.said) == 5


def test_a_drive_command_becomes_angle_speed_and_direction() -> None:
    bench = Bench().enabled()
    assert bench.last(SteerCmd).angle_rad == pytest.approx(0.1, abs=1e-4)
    assert bench.last(SteerCmd).mode == SteerMode.ANGLE
    throttle = bench.last(ThrottleCmd)
    assert (throttle.speed_mps, throttle.mode, throttle.direction) == (2.0, ThrottleMode.SPEED, Direction.FORWARD)
    bench.command = DriveCommand(speed_mps=-1.0)
    bench.run(20)
    assert (bench.last(ThrottleCmd).speed_mps, bench.last(ThrottleCmd).direction) == (-1.0, Direction.REVERSE)


def test_system_cmd_carries_the_data_cycle_of_the_burst_before_it() -> None:
    bench = Bench().enabled()
    bench.run(500)
    for t_ns, message in bench.sent(SystemCmd, after_ns=T0_NS + 500 * MS):
        origin_cycle = (t_ns - 50 * MS - T0_NS) // TICK_NS
        assert origin_cycle - 2 <= message.cycle < origin_cycle


def test_a_frozen_command_freezes_the_cycle_on_the_bus() -> None:
    bench = Bench().enabled()
    frozen_ns = bench.t_ns - 50 * MS
    bench.age_ns = lambda: bench.t_ns - frozen_ns
    bench.run(200)
    assert len({m.cycle for _, m in bench.sent(SystemCmd, after_ns=bench.t_ns - 120 * MS)}) == 1


# -- when it asks to be obeyed ----------------------------------------------------------------------------------------


def test_it_enables_when_the_node_is_ready_and_a_fresh_command_is_there() -> None:
    bench = Bench()
    bench.run(300)
    assert bench.asks() == (1, 1, 1, 1)


@pytest.mark.parametrize("state", [s for s in SystemState if s not in (SystemState.READY, SystemState.ENABLED)])
def test_it_asks_for_nothing_while_the_node_is_not_ready(state: SystemState) -> None:
    bench = Bench()
    bench.state = state
    bench.run(1_000)
    assert all(not m.request_enable for _, m in bench.sent(SystemCmd))
    assert all(not m.enable for kind in (SteerCmd, BrakeCmd, ThrottleCmd) for _, m in bench.sent(kind))


@pytest.mark.parametrize(
    ("command", "age_ms"),
    [(None, 50), (FORWARD, 251), (DriveCommand(speed_mps=math.nan), 50), (DriveCommand(speed_mps=7.0), 50)],
)
def test_it_does_not_enable_without_a_command_that_it_may_pass(command: DriveCommand | None, age_ms: int) -> None:
    bench = Bench()
    bench.command, bench.age_ns = command, lambda: age_ms * MS
    bench.run(1_000)
    assert all(not m.request_enable for _, m in bench.sent(SystemCmd))
    assert all(not m.enable for _, m in bench.sent(BrakeCmd))


def test_at_least_three_idle_bursts_come_between_ready_and_the_request() -> None:
    bench = Bench()
    bench.state = SystemState.INIT
    bench.run(500)
    bench.state = SystemState.READY
    ready_ns = bench.t_ns + 50 * MS  # its next report
    bench.run(400)
    idle = [m for t_ns, m in bench.sent(SteerCmd, after_ns=ready_ns) if not m.enable]
    assert len(idle) >= 3
    assert bench.asks() == (1, 1, 1, 1)


def test_all_four_bits_rise_within_200_ms() -> None:
    bench = Bench()
    bench.run(500)
    rises = [
        next(t_ns for t_ns, m in bench.frames if isinstance(m, kind) and getattr(m, bit))
        for kind, bit in ((SystemCmd, "request_enable"), (SteerCmd, "enable"), (BrakeCmd, "enable"))
    ]
    assert max(rises) - min(rises) <= 200 * MS


def test_a_request_that_is_not_answered_is_taken_back_and_made_again() -> None:
    """One frame lost at the rise of the bits spoils the request for the nodes: without this the cart never starts."""
    bench = Bench()
    bench.run(2_000)
    asked = [bool(m.enable) for _, m in bench.sent(SteerCmd)]
    rises = sum(b and not a for a, b in pairwise(asked))
    assert rises >= 3
    runs = "".join("1" if a else "0" for a in asked).strip("0").split("1")
    assert all(len(idle) >= 3 for idle in runs if idle)


@pytest.mark.parametrize(
    "state",
    [SystemState.STOPPING, SystemState.FAULT, SystemState.ESTOP, SystemState.OVERRIDE],
)
def test_it_never_clears_a_fault_or_an_override_by_itself(state: SystemState) -> None:
    bench = Bench().enabled(2.0)
    bench.state = state
    bench.run(3_000)
    assert all(not (m.clear_faults or m.clear_override or m.request_estop) for _, m in bench.sent(SystemCmd))
    assert bench.asks() == (0, 0, 0, 0)


# -- a stale command --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("level", ["direct", "wire"])
def test_a_command_that_grows_stale_is_braked_in_the_next_burst_and_the_request_is_cleared(level: Level) -> None:
    bench = Bench(level).enabled(speed_mps=2.0)
    assert bench.last(BrakeCmd).effort == 0
    frozen_ns = bench.t_ns - 50 * MS
    bench.age_ns = lambda: bench.t_ns - frozen_ns
    bench.run(500)
    stale_ns = frozen_ns + 250 * MS
    bursts = bench.sent(BrakeCmd, after_ns=stale_ns)
    assert all(m.effort == 0 for t_ns, m in bench.sent(BrakeCmd, after_ns=frozen_ns) if t_ns <= stale_ns)
    assert bursts[0][0] - stale_ns <= 20 * MS
    assert bursts[0][1].effort_ratio == pytest.approx(1.5 / FULL_BRAKE_MPS2)
    assert all(m.enable for _, m in bursts)  # a brake command that does not ask to be obeyed brakes nothing
    assert all(m.speed_mps == 0.0 for _, m in bench.sent(ThrottleCmd, after_ns=stale_ns))
    system = bench.sent(SystemCmd, after_ns=bursts[0][0])
    assert system
    assert not any(m.request_enable for _, m in system)
    assert bench.said[-1].limit is Limit.STALE
    assert not bench.said[-1].enable


def test_a_command_that_vanishes_is_braked_like_a_stale_one() -> None:
    bench = Bench().enabled(speed_mps=2.0)
    bench.command = None
    bench.run(100)
    assert bench.last(BrakeCmd).effort_ratio == pytest.approx(0.3)
    assert bench.asks() == (0, 1, 1, 1)


@pytest.mark.parametrize("broken", [DriveCommand(speed_mps=math.nan), DriveCommand(speed_mps=2.0, steer_rad=0.6)])
def test_a_command_outside_the_envelope_brakes_and_keeps_the_nodes_obedient(broken: DriveCommand) -> None:
    bench = Bench().enabled(speed_mps=2.0)
    bench.command = broken
    bench.run(100)
    assert bench.last(BrakeCmd).effort_ratio == pytest.approx(0.3)
    assert bench.last(ThrottleCmd).speed_mps == 0.0
    assert bench.asks() == (1, 1, 1, 1)


def test_fresh_commands_after_a_stale_spell_do_not_bring_the_request_back_while_enabled() -> None:
    bench = Bench().enabled(speed_mps=2.0)
    bench.age_ns = lambda: 300 * MS
    bench.run(20)
    bench.age_ns = lambda: 50 * MS
    bench.run(500)
    assert bench.asks() == (0, 1, 1, 1)


# -- what is heard ----------------------------------------------------------------------------------------------------


def test_lost_and_damaged_frames_are_counted_by_their_counters() -> None:
    bench = Bench()
    bench.run(400)
    before = bench.driver.counters
    assert (before.damaged, before.lost) == (0, 0)
    assert before.received == 400 // 20 + 400 // 50
    swallow = [bench.t_ns + 20 * MS, bench.t_ns + 40 * MS]

    def fault(frame: Frame) -> Frame | None:
        if frame.sender != "ODOM":
            return frame
        if frame.t_ns in swallow:
            return None
        if frame.t_ns == swallow[1] + 20 * MS and isinstance(frame.data, bytes):
            return msgspec.structs.replace(frame, data=bytes([frame.data[0] ^ 1, *frame.data[1:]]))
        return frame

    bench.bus.faults.append(fault)
    bench.run(200)
    after = bench.driver.counters
    assert after.damaged == 1
    assert after.lost == 3  # two swallowed, and the damaged one is missing too
    assert after.received == before.received + 200 // 20 - 3 + 200 // 50


def test_reports_become_signals_with_the_time_of_their_frames() -> None:
    bus = CanBus("wire")
    driver = CartDriver(bus, TICK_M)
    steer, brake, drive, safety = (bus.port(name, []) for name in ("STEER", "BRAKE", "DRIVE", "SAFETY"))
    drive.send(ThrottleRpt.of(output_ratio=0.1), 1)  # without the other two there is no whole state yet
    steer.send(SteerRpt.of(angle_rad=0.2, angle_cmd_rad=0.3, enabled=True), 2)
    brake.send(BrakeRpt.of(effort_ratio=0.25, effort_cmd_ratio=0.3, cmd_rejected=True), 3)
    drive.send(ThrottleRpt.of(output_ratio=0.5, enabled=True), 4)
    safety.send(SystemRpt(state=SystemState.OVERRIDE, override_brake=1, fault_code=3, bad_crc=1), 5)
    heard = driver.poll()
    assert [t_ns for _, t_ns in heard.actuators] == [4]
    state = heard.actuators[0][0]
    assert (state.steer_rad, state.steer_command_rad) == pytest.approx((0.2, 0.3), abs=1e-4)
    assert (state.brake, state.brake_command, state.drive) == pytest.approx((0.25, 0.3, 0.5))
    assert (state.steer_enabled, state.brake_enabled, state.drive_enabled) == (True, False, True)
    assert state.rejected
    (safe, t_ns), *_ = heard.safety
    assert t_ns == 5
    assert (safe.state, safe.override, safe.fault_code, safe.bad_crc) == (SystemState.OVERRIDE, True, 3, True)
    assert driver.state is SystemState.OVERRIDE


def test_a_reading_that_is_not_available_is_zero_and_not_the_largest_number() -> None:
    steer, brake, throttle = (
        SteerRpt.of(angle_rad=None),
        BrakeRpt.of(effort_ratio=None),
        ThrottleRpt.of(output_ratio=None),
    )
    state = actuator_state(steer, brake, throttle)
    assert (state.steer_rad, state.brake, state.drive) == (0.0, 0.0, 0.0)


# -- the brake --------------------------------------------------------------------------------------------------------

speeds = st.floats(0.0, 7.0)
passed = st.builds(
    DriveCommand, speed_mps=st.floats(-1.5, 5.5), steer_rad=st.just(0.0), decel_mps2=st.floats(-1.0, 9.0)
).map(lambda command: limit(command, 0, Envelope())[0])


@given(passed, speeds, st.booleans())
def test_the_brake_never_asks_for_more_than_the_command_allows(
    command: DriveCommand, speed_mps: float, braking: bool
) -> None:
    effort = brake_effort(command, speed_mps, braking)
    assert 0.0 <= effort <= 1.5 / FULL_BRAKE_MPS2 + 1e-12
    if effort != HOLD_EFFORT:
        assert effort * FULL_BRAKE_MPS2 <= command.decel_mps2 + 1e-9


@given(passed, speeds, speeds, st.booleans())
def test_a_faster_cart_is_braked_no_less(command: DriveCommand, a_mps: float, b_mps: float, braking: bool) -> None:
    slow, fast = sorted((a_mps, b_mps))
    assume(command.speed_mps != 0.0 or slow >= STANDSTILL_MPS)  # below that the brake holds
    assert brake_effort(command, slow, braking) <= brake_effort(command, fast, braking)


@given(st.floats(0.0, 5.5), st.floats(0.0, 5.5), speeds)
def test_a_slower_speed_wanted_brakes_no_less(a_mps: float, b_mps: float, speed_mps: float) -> None:
    slow, fast = sorted((a_mps, b_mps))
    assume(slow > 0.0 or speed_mps >= STANDSTILL_MPS)
    harder, softer = (brake_effort(DriveCommand(speed_mps=wanted_mps), speed_mps) for wanted_mps in (slow, fast))
    assert harder >= softer


@given(passed, speeds, st.booleans())
def test_no_brake_while_the_cart_is_slower_than_wanted(command: DriveCommand, speed_mps: float, braking: bool) -> None:
    assume(speed_mps <= abs(command.speed_mps) and command.speed_mps != 0.0)
    assert brake_effort(command, speed_mps, braking) == 0.0


@given(passed, speeds)
def test_a_brake_that_is_on_is_released_no_earlier_than_it_would_be_applied(
    command: DriveCommand, speed_mps: float
) -> None:
    assert brake_effort(command, speed_mps, True) >= brake_effort(command, speed_mps, False)


def test_the_brake_does_not_chatter_about_the_wanted_speed() -> None:
    """Slightly too fast is left alone; once braking, it brakes on until the cart is hardly too fast."""
    bench = Bench().enabled(speed_mps=2.2)
    assert bench.last(BrakeCmd).effort == 0
    bench.speed_mps = 2.5
    bench.run(300)
    assert bench.last(BrakeCmd).effort > 0
    bench.speed_mps = 2.2
    bench.run(300)
    assert bench.last(BrakeCmd).effort > 0
    bench.speed_mps = 2.0
    bench.run(300)
    assert bench.last(BrakeCmd).effort == 0


@pytest.mark.parametrize("speed_mps", [0.0, 0.049, -0.049])
def test_the_brake_holds_a_cart_that_is_to_stand(speed_mps: float) -> None:
    assert brake_effort(DriveCommand(), speed_mps) == HOLD_EFFORT > 0.0


@pytest.mark.parametrize("speed_mps", [0.05, 0.3, 1.0, 5.0, -0.05, -1.0])
def test_a_cart_that_is_to_stand_is_always_braked(speed_mps: float) -> None:
    assert brake_effort(DriveCommand(), speed_mps) > 0.05
    assert brake_effort(DriveCommand(), speed_mps) == brake_effort(DriveCommand(), -speed_mps)


def test_braking_uses_all_it_may_when_much_too_fast() -> None:
    assert brake_effort(DriveCommand(speed_mps=1.0, decel_mps2=1.2), 3.0) * FULL_BRAKE_MPS2 == pytest.approx(1.2)


# -- pedals -----------------------------------------------------------------------------------------------------------


def last_burst(bench: Bench) -> tuple[SteerCmd, BrakeCmd, ThrottleCmd]:
    return bench.sent(SteerCmd)[-1][1], bench.sent(BrakeCmd)[-1][1], bench.sent(ThrottleCmd)[-1][1]


def test_pedals_go_out_as_they_are_while_the_motion_is_within_the_envelope() -> None:
    bench = Bench().enabled(speed_mps=2.0)
    bench.command = PedalCommand(steer_rad=0.1, throttle=0.5)
    bench.run(200)
    steer, brake, throttle = last_burst(bench)
    assert steer.angle_rad == pytest.approx(0.1, abs=1e-3)
    assert brake.effort_ratio == 0.0
    assert (throttle.mode, throttle.percent_ratio) == (ThrottleMode.PERCENT, pytest.approx(0.5, abs=0.01))


def test_brake_pedal_takes_the_throttle_away_and_never_locks_the_axle() -> None:
    bench = Bench().enabled(speed_mps=2.0)
    bench.command = PedalCommand(throttle=1.0, brake=1.0)
    bench.run(200)
    _, brake, throttle = last_burst(bench)
    assert brake.effort_ratio == pytest.approx(0.3, abs=0.01)  # 1.5 m/s2
    assert throttle.percent_ratio == 0.0


@pytest.mark.parametrize(
    ("pedals", "speed_mps", "age_ms", "why"),
    [
        (PedalCommand(throttle=1.0), 2.0, 251, Limit.STALE),
        (PedalCommand(throttle=math.nan), 2.0, 50, Limit.NOT_FINITE),
        (PedalCommand(throttle=1.0, steer_rad=0.6), 2.0, 50, Limit.STEER),
        (PedalCommand(throttle=1.0), 5.8, 50, Limit.SPEED),
        (PedalCommand(throttle=1.0, steer_rad=0.45), 4.0, 50, Limit.LATERAL),
    ],
)
def test_limits_decide_where_pedals_would_leave_the_envelope(
    pedals: PedalCommand, speed_mps: float, age_ms: int, why: Limit
) -> None:
    bench = Bench().enabled(speed_mps=speed_mps)
    bench.command, bench.age_ns = pedals, lambda: age_ms * MS
    bench.run(300)
    _, brake, throttle = last_burst(bench)
    assert bench.said[-1].limit is why
    assert brake.effort_ratio is not None
    assert brake.effort_ratio > 0.0
    assert throttle.mode == ThrottleMode.SPEED
