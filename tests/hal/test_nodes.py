"""The nodes on the bus against the rules of the layout: time-outs, bad frames, enabling, override, stopping, e-stop.

Time runs in polls of 10 ms. As in a drive, the nodes are polled first and the host sends afterwards, so a frame of one
tick is heard at the next.
"""

import math
from typing import TypeVar

import pytest

from hal.bus import CanBus, CanPort, Frame, Level, Received
from hal.codecs.cartcan import (
    BrakeCmd,
    BrakeRpt,
    Estop,
    EstopSource,
    Message,
    SteerCmd,
    SteerMode,
    SteerRpt,
    SystemCmd,
    SystemRpt,
    ThrottleCmd,
    ThrottleRpt,
    encode,
)
from hal.devices.actuators import BrakeNode, DriveNode, SteerNode
from hal.devices.safety import FaultCode, SafetyNode, SafetyParams
from hal.devices.watch import CommandWatch
from hal.signals import SystemState

MS = 1_000_000
TICK_NS = 10 * MS
T0_NS = 1_700_000_000_000_000_000
TICK_M = SafetyParams().metres_per_tick
STOP_EFFORT, PARK_EFFORT = 0.27, 0.4
ACTUATOR_COMMANDS = (SteerCmd, BrakeCmd, ThrottleCmd)
COMMANDS = (SystemCmd, *ACTUATOR_COMMANDS)
READY, ENABLED, OVERRIDE = SystemState.READY, SystemState.ENABLED, SystemState.OVERRIDE
STOPPING, FAULT, ESTOP = SystemState.STOPPING, SystemState.FAULT, SystemState.ESTOP
M = TypeVar("M", bound=Message)


class Rig:
    """The four nodes on a bus, a host that the test plays, and a cart that rolls at a given speed."""

    def __init__(self, level: Level = "wire") -> None:
        self.bus = CanBus(level)
        self.t_ns = T0_NS
        self.safety = SafetyNode(self.bus, T0_NS)
        self.steer, self.drive = SteerNode(self.bus), DriveNode(self.bus)
        self.brake = BrakeNode(self.bus, stop_effort=STOP_EFFORT, park_effort=PARK_EFFORT)
        self.nodes = (self.steer, self.brake, self.drive)
        self.ear = self.bus.port("EAR", [Estop, SystemRpt, SteerRpt, BrakeRpt, ThrottleRpt])
        self.heard: list[Received] = []
        # the cart and its driver
        self.speed_mps = self._metres = 0.0
        self.angle_rad = self.torque_nm = self.brake_pedal = self.throttle_pedal = 0.0
        self.button = False
        self.safety_runs = True
        self.liar: CanPort | None = None
        # the host
        self.sends: set[type[Message]] = set(COMMANDS)
        self.asks: set[type[Message]] = set()
        self.angle_wanted_rad, self.effort, self.speed_wanted_mps = 0.0, 0.0, 2.0
        self.clear_faults = self.clear_override = self.request_estop = False
        self.cycle, self.cycle_runs = 0, True
        self.late_ns = 0
        self.counters: dict[int, int] = {}

    # -- the host's side

    def message(self, kind: type[Message]) -> Message:
        enable = kind in self.asks
        if kind is SteerCmd:
            return SteerCmd.of(angle_rad=self.angle_wanted_rad, enable=enable)
        if kind is BrakeCmd:
            return BrakeCmd.of(effort_ratio=self.effort, enable=enable)
        if kind is ThrottleCmd:
            return ThrottleCmd.of_speed(speed_mps=self.speed_wanted_mps, accel_limit_mps2=1.0, enable=enable)
        return SystemCmd.of(
            cycle=self.cycle,
            request_enable=enable,
            clear_faults=self.clear_faults,
            clear_override=self.clear_override,
            request_estop=self.request_estop,
        )

    def send(self, kind: type[Message], *, skip: int = 0, damage: bool = False, late_ns: int = 0) -> None:
        """Send one frame of the host now. skip: counters left out; damage: one bit flips on the way."""
        counter = (self.counters.get(kind.ID, -1) + 1 + skip) & 15
        self.counters[kind.ID] = counter
        data: bytes | Message = self.message(kind)
        if self.bus.level == "wire":
            data = encode(self.message(kind), counter)
            data = bytes([data[0] ^ damage, *data[1:]])
        self.bus.carry(Frame(self.t_ns + late_ns, "HOST", kind.ID, data, counter))

    def tick(self) -> None:
        self.t_ns += TICK_NS
        t_ns = self.t_ns
        self._metres += self.speed_mps * TICK_NS * 1e-9
        if self.safety_runs:
            self.safety.poll(t_ns, math.floor(self._metres / TICK_M), self.button)
        if self.liar is not None and t_ns % (50 * MS) == 0:
            self.liar.send(SystemRpt(state=ENABLED), t_ns)
        self.steer.poll(t_ns, self.angle_rad, self.torque_nm)
        self.brake.poll(t_ns, self.brake.effort, self.brake_pedal)
        self.drive.poll(t_ns, self.speed_mps, self.drive.output, self.throttle_pedal)
        self.heard += self.ear.receive()
        self.cycle += self.cycle_runs
        for kind in COMMANDS:
            if kind in self.sends and t_ns % kind.PERIOD_NS == 0:
                self.send(kind, late_ns=self.late_ns)

    def run(self, ms: int) -> "Rig":
        for _ in range(ms // 10):
            self.tick()
        return self

    def run_to(self, period_ms: int) -> "Rig":
        """Run to the next tick on a grid."""
        self.tick()
        while self.t_ns % (period_ms * MS):
            self.tick()
        return self

    def enabled(self, speed_mps: float = 0.0) -> "Rig":
        """Boot and enable; then roll, and stop on a tick at which all commands were just sent."""
        self.run(500)
        self.asks = set(COMMANDS)
        self.run(200)
        assert self.states() == {ENABLED}
        assert all(node.enabled for node in self.nodes)
        self.speed_mps = speed_mps
        self.run(700).run_to(100)
        assert self.states() == {ENABLED}
        return self

    def lie(self) -> "Rig":
        """Put a safety node in place that says ENABLED whatever happens: what the other nodes do by themselves."""
        self.safety_runs, self.liar = False, self.bus.port("SAFETY", [])
        return self

    # -- what is seen

    def states(self) -> set[SystemState]:
        """States that the nodes and the safety node are in."""
        return {self.safety.state, *(node.state for node in self.nodes)}

    @property
    def since_ms(self) -> int:
        return (self.t_ns - T0_NS) // MS

    def ms_until(self, state: SystemState, at_most_ms: int = 5_000) -> int:
        """Run until the safety node is in a state; how long it took."""
        begun_ns = self.t_ns
        while self.safety.state is not state:
            assert self.t_ns - begun_ns < at_most_ms * MS, f"still {self.safety.state!r}"
            self.tick()
        return (self.t_ns - begun_ns) // MS

    def last(self, kind: type[M]) -> M:
        return next(r.message for r in reversed(self.heard) if isinstance(r.message, kind))

    def stops(self) -> bool:
        """Every node ends what the host asked of it, and the brake goes on."""
        return not any(n.enabled for n in self.nodes) and self.drive.output == 0.0 and self.brake.effort > 0.0


@pytest.fixture(params=["direct", "wire"])
def rig(request: pytest.FixtureRequest) -> Rig:
    return Rig(request.param)


# -- one command's watch ----------------------------------------------------------------------------------------------


def frame(t_ms: int, counter: int, *, good: bool = True, enable: bool = False) -> Received:
    return Received(t_ms * MS, SteerCmd.ID, SteerCmd.of(angle_rad=0.1, enable=enable) if good else None, counter)


@pytest.mark.parametrize(("t_ms", "silent"), [(99, False), (100, False), (101, True)])
def test_a_command_is_silent_after_more_than_its_time_out(t_ms: int, silent: bool) -> None:
    watch = CommandWatch(100 * MS)
    assert watch.silent(0)
    watch.judge(frame(0, 7))
    assert watch.silent(t_ms * MS) is silent


def test_only_good_frames_end_the_silence() -> None:
    watch = CommandWatch(100 * MS)
    watch.judge(frame(0, 7))
    for t_ms in (20, 40, 60, 80, 100):
        assert watch.judge(frame(t_ms, 7)) is None
    assert watch.silent(101 * MS)


@pytest.mark.parametrize(("after_ms", "taken"), [(100, False), (101, True)])
def test_the_first_frame_after_silence_restarts_the_counter(after_ms: int, taken: bool) -> None:
    watch = CommandWatch(100 * MS)
    watch.judge(frame(0, 7))
    assert (watch.judge(frame(after_ms, 3)) is not None) is taken
    assert watch.judge(frame(after_ms + 20, 4)) is not None


def test_the_counter_wraps_after_15() -> None:
    watch = CommandWatch(100 * MS)
    assert all(watch.judge(frame(20 * k, (13 + k) & 15)) is not None for k in range(20))


@pytest.mark.parametrize("wrong", [5, 6, 8, 9])
def test_a_repeated_or_skipped_counter_is_refused_and_the_next_one_is_counted_from_it(wrong: int) -> None:
    watch = CommandWatch(100 * MS)
    watch.judge(frame(0, 6))
    assert watch.judge(frame(20, wrong)) is None
    assert (watch.bad_counter, watch.bad_crc, watch.rejected) == (True, False, True)
    assert watch.judge(frame(40, wrong + 1)) is not None


def test_three_bad_frames_in_a_row_are_too_many_and_two_are_not() -> None:
    watch = CommandWatch(100 * MS)
    watch.judge(frame(0, 0))
    tripped = []
    for k in range(1, 4):
        watch.judge(frame(10 * k, 0, good=False))
        tripped.append(watch.tripped)
    assert tripped == [False, False, True]
    assert (watch.bad_crc, watch.bad_counter) == (True, False)


def test_bad_frames_add_up_to_five_when_fewer_good_ones_come_between() -> None:
    """Two bad, one good: never three in a row, but the leaky count is 1, 2, 1, 2, 3, 2, 3, 4, 3, 4, 5."""
    watch, counter, tripped = CommandWatch(100 * MS), 0, []
    watch.judge(frame(0, counter))
    for k in range(11):
        counter = counter + 1 if k % 3 == 2 else counter + 2
        assert (watch.judge(frame(20 * (k + 1), counter & 15)) is not None) is (k % 3 == 2)
        tripped.append(watch.tripped)
    assert tripped == [False] * 10 + [True]


def test_every_other_frame_bad_is_rejected_but_does_not_add_up() -> None:
    watch, counter = CommandWatch(100 * MS), 0
    watch.judge(frame(0, counter))
    for k in range(60):
        counter += 1 + k % 2
        watch.judge(frame(20 * (k + 1), counter & 15))
        assert not watch.tripped


def test_idle_frames_count_in_a_row_and_only_good_ones() -> None:
    watch = CommandWatch(100 * MS)
    for k in range(3):
        watch.judge(frame(20 * k, k))
    assert watch.idle_streak == 3
    watch.judge(frame(60, 0, good=False))
    assert watch.idle_streak == 0
    watch.judge(frame(160, 4))
    watch.judge(frame(180, 5, enable=True))
    assert watch.idle_streak == 0


# -- booting and enabling ---------------------------------------------------------------------------------------------


def test_the_safety_node_is_ready_300_ms_after_its_boot(rig: Rig) -> None:
    rig.run(290)
    assert rig.safety.state is SystemState.INIT
    rig.tick()
    assert rig.safety.state is READY


def test_until_it_is_enabled_the_cart_is_parked_and_obeys_nothing(rig: Rig) -> None:
    rig.angle_rad, rig.angle_wanted_rad, rig.effort = 0.1, 0.3, 0.0
    rig.run(1_000)
    assert rig.states() == {READY}
    assert (rig.brake.effort, rig.drive.output, rig.steer.target_rad) == (PARK_EFFORT, 0.0, 0.0)


def test_idle_frames_and_then_all_four_bits_enable_the_cart(rig: Rig) -> None:
    rig.enabled()
    rig.angle_wanted_rad, rig.effort = 0.2, 0.125
    rig.run(100)
    assert rig.steer.target_rad == pytest.approx(0.2, abs=1e-4)
    assert rig.brake.effort == pytest.approx(0.125)
    assert rig.drive.output > 0.0
    report = rig.last(SystemRpt)
    assert (report.steer_enabled, report.brake_enabled, report.throttle_enabled) == (1, 1, 1)
    assert (rig.last(SteerRpt).enabled, rig.last(BrakeRpt).enabled, rig.last(ThrottleRpt).enabled) == (1, 1, 1)


@pytest.mark.parametrize("kind", ACTUATOR_COMMANDS)
@pytest.mark.parametrize(("idle_frames", "accepted"), [(2, False), (3, True)])
def test_three_idle_frames_of_each_command_come_first(
    rig: Rig, kind: type[Message], idle_frames: int, accepted: bool
) -> None:
    rig.sends.remove(kind)
    rig.run(500)
    rig.sends.add(kind)
    rig.run(20 * idle_frames)
    rig.asks = set(COMMANDS)
    rig.run(1_000)
    assert (rig.safety.state is ENABLED) is accepted
    assert all(node.enabled for node in rig.nodes) is accepted


@pytest.mark.parametrize("kind", COMMANDS)
def test_one_missing_bit_refuses_the_request(rig: Rig, kind: type[Message]) -> None:
    rig.run(500)
    rig.asks = {other for other in COMMANDS if other is not kind}
    rig.run(2_000)
    assert rig.states() == {READY}
    assert not any(node.enabled for node in rig.nodes)


@pytest.mark.parametrize("kind", COMMANDS)
@pytest.mark.parametrize("early", [False, True])
@pytest.mark.parametrize(("apart_ms", "accepted"), [(200, True), (220, False)])
def test_all_bits_rise_within_200_ms_whichever_is_first(
    rig: Rig, kind: type[Message], early: bool, apart_ms: int, accepted: bool
) -> None:
    rig.run(490)
    others = {other for other in COMMANDS if other is not kind}
    rig.asks = {kind} if early else others
    rig.run(apart_ms)
    rig.asks = set(COMMANDS)
    rig.run(1_000)
    assert (rig.safety.state is ENABLED) is accepted


@pytest.mark.parametrize("early", [set(COMMANDS), {SystemCmd}, set(ACTUATOR_COMMANDS)])
def test_bits_that_rose_before_the_node_was_ready_do_not_count(rig: Rig, early: set[type[Message]]) -> None:
    rig.run(240)
    rig.asks = early
    rig.run(60)
    assert rig.states() <= {READY, SystemState.INIT}
    rig.asks = set(COMMANDS)
    rig.run(1_000)
    assert rig.states() == {READY}


@pytest.mark.parametrize("kind", ACTUATOR_COMMANDS)
def test_a_bad_frame_while_the_bit_rises_refuses_the_request(rig: Rig, kind: type[Message]) -> None:
    rig.run(500)
    rig.asks = set(COMMANDS)
    rig.counters[kind.ID] += 1  # one frame never came
    rig.run(1_000)
    assert rig.states() == {READY}


def test_nothing_jumps_on_entry_the_steering_starts_from_its_present_angle(rig: Rig) -> None:
    rig.angle_rad, rig.angle_wanted_rad = 0.15, -0.3
    rig.run(500)
    rig.asks = set(COMMANDS)
    while not rig.steer.enabled:
        rig.tick()
    assert rig.steer.target_rad == 0.15
    rig.run(20)
    assert rig.steer.target_rad == pytest.approx(-0.3, abs=1e-4)


def test_a_steering_command_to_hold_leaves_the_target(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.enabled().angle_wanted_rad = 0.1
    rig.run(50)
    monkeypatch.setattr(rig, "message", lambda kind: hold if kind is SteerCmd else Rig.message(rig, kind))
    hold = SteerCmd.of(angle_rad=0.4, enable=True, mode=SteerMode.HOLD)
    rig.run(100)
    assert rig.steer.target_rad == pytest.approx(0.1, abs=1e-4)


def test_the_drive_ramps_and_holds_a_speed_with_its_own_encoder(rig: Rig) -> None:
    rig.enabled().speed_wanted_mps = 2.0
    for _ in range(1_000):
        rig.speed_mps += (1.2 * rig.drive.output - 0.1) * 0.01
        rig.tick()
    assert rig.safety.state is ENABLED
    assert rig.speed_mps == pytest.approx(2.0, abs=0.1)


def test_a_standing_cart_is_disabled_by_the_host(rig: Rig) -> None:
    rig.enabled().asks = set()
    rig.run(200)
    assert rig.states() == {READY}
    assert rig.brake.effort == PARK_EFFORT
    assert not any(node.enabled for node in rig.nodes)


@pytest.mark.parametrize("dropped", [{SystemCmd}, set(COMMANDS)])
def test_a_rolling_cart_that_the_host_disables_is_stopped(rig: Rig, dropped: set[type[Message]]) -> None:
    rig.enabled(2.0).asks -= dropped
    rig.run(120)
    assert rig.states() == {STOPPING}
    assert rig.safety.fault is FaultCode.DISABLED_MOVING
    assert rig.stops()


def test_an_actuator_whose_bit_falls_lets_go_and_comes_back_only_after_idle_frames(rig: Rig) -> None:
    rig.enabled().asks -= {ThrottleCmd}
    rig.run(60)  # three frames
    assert not rig.drive.enabled
    rig.asks |= {ThrottleCmd}
    rig.run(500)
    assert rig.drive.enabled
    rig.run_to(100).asks -= {ThrottleCmd}
    rig.run(40)  # two frames
    rig.asks |= {ThrottleCmd}
    rig.run(500)
    assert not rig.drive.enabled


def test_each_actuator_itself_wants_three_idle_frames_right_before_its_bit(rig: Rig) -> None:
    rig.run(500).asks = set(ACTUATOR_COMMANDS)
    rig.run_to(100).asks = set()
    rig.run(40)  # two frames
    rig.asks = set(ACTUATOR_COMMANDS)
    rig.lie().run(500)
    assert {node.state for node in rig.nodes} == {ENABLED}
    assert not any(node.enabled for node in rig.nodes)


# -- silence ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ACTUATOR_COMMANDS)
@pytest.mark.parametrize(("age_ms", "ends"), [(99, False), (100, False), (101, True)])
def test_an_actuator_command_older_than_100_ms_ends_the_enabled_state(
    rig: Rig, kind: type[Message], age_ms: int, ends: bool
) -> None:
    rig.enabled(2.0).late_ns = (100 - age_ms) * MS
    rig.run_to(100)  # the last frame is sent off the grid of the polls
    rig.sends.remove(kind)
    rig.run(90)
    assert rig.safety.state is ENABLED
    rig.tick()
    assert rig.safety.state is (STOPPING if ends else ENABLED)
    rig.tick()
    assert rig.safety.state is STOPPING
    assert rig.safety.fault is FaultCode.ACTUATOR_SILENT


@pytest.mark.parametrize("kind", ACTUATOR_COMMANDS)
@pytest.mark.parametrize(("age_ms", "ends"), [(99, False), (100, False), (101, True)])
def test_an_actuator_ends_it_by_itself_after_100_ms(rig: Rig, kind: type[Message], age_ms: int, ends: bool) -> None:
    node = next(n for n in rig.nodes if n.command is kind)
    rig.enabled(2.0).lie().late_ns = (100 - age_ms) * MS
    rig.run_to(100)
    rig.sends.remove(kind)
    rig.run(90)
    assert node.enabled
    rig.tick()
    assert node.enabled is not ends
    rig.tick()
    assert not node.enabled
    assert sum(n.enabled for n in rig.nodes) == 2


@pytest.mark.parametrize(("age_ms", "ends"), [(249, False), (250, False), (251, True)])
def test_a_system_command_older_than_250_ms_ends_the_enabled_state(rig: Rig, age_ms: int, ends: bool) -> None:
    rig.enabled(2.0).late_ns = (250 - age_ms) * MS
    rig.run_to(100)
    rig.sends.remove(SystemCmd)
    rig.run(250)
    assert rig.safety.state is (STOPPING if ends else ENABLED)
    rig.tick()
    assert rig.safety.state is STOPPING
    assert rig.safety.fault in (FaultCode.HOST_SILENT, FaultCode.CYCLE_STANDS)


def test_silence_is_reported_as_the_hosts_time_out(rig: Rig) -> None:
    rig.enabled(2.0).sends.clear()
    rig.run(200)
    assert rig.last(SystemRpt).host_timeout
    assert rig.last(SystemRpt).fault_code == FaultCode.ACTUATOR_SILENT
    assert (rig.last(SteerRpt).timeout, rig.last(BrakeRpt).timeout, rig.last(ThrottleRpt).timeout) == (1, 1, 1)


def test_a_silent_host_is_braked_before_the_safety_node_has_reported_it(rig: Rig) -> None:
    rig.enabled(2.0).sends.clear()
    rig.run(120)
    assert rig.stops()


def test_frames_that_come_again_after_a_time_out_are_not_obeyed(rig: Rig) -> None:
    """The nodes alone: a safety node that goes on reporting ENABLED does not bring a node back by itself."""
    rig.enabled(2.0).lie().run(500)
    assert all(node.enabled for node in rig.nodes)
    rig.sends.clear()
    rig.run(150)
    assert rig.stops()
    rig.sends = set(COMMANDS)
    rig.run(300)
    assert rig.stops()
    rig.asks.clear()
    rig.run(100)
    rig.asks = set(COMMANDS)
    rig.run(100)
    assert all(node.enabled for node in rig.nodes)


def test_without_a_safety_node_the_actuators_stop_obeying_after_250_ms(rig: Rig) -> None:
    rig.enabled(2.0).safety_runs = False
    while rig.t_ns - max(r.t_ns for r in rig.heard if r.frame_id == SystemRpt.ID) < 250 * MS:
        assert all(node.enabled for node in rig.nodes)
        rig.tick()
    assert all(node.enabled for node in rig.nodes)
    rig.run(20)
    assert rig.stops()
    rig.run(1_000)
    assert rig.brake.effort == pytest.approx(STOP_EFFORT)


def test_the_first_frames_after_silence_start_at_any_counter(rig: Rig) -> None:
    rig.run(500).sends.clear()
    rig.run(400)
    rig.sends = set(COMMANDS)
    for kind in COMMANDS:
        rig.counters[kind.ID] += 7
    rig.run(200)
    assert not any((rig.last(SteerRpt).cmd_rejected, rig.last(SystemRpt).bad_counter))
    rig.asks = set(COMMANDS)
    rig.run(200)
    assert rig.states() == {ENABLED}


# -- bad frames -------------------------------------------------------------------------------------------------------


def test_one_bad_counter_is_not_obeyed_and_reported_and_forgotten(rig: Rig) -> None:
    rig.enabled(2.0)
    rig.sends.remove(SteerCmd)
    rig.run(10)
    rig.angle_wanted_rad = 0.3
    rig.send(SteerCmd, skip=1)
    rig.run(10)
    assert rig.steer.target_rad == 0.0
    assert (rig.last(SteerRpt).cmd_rejected, rig.last(BrakeRpt).cmd_rejected) == (1, 0)
    rig.send(SteerCmd)
    rig.run(20)
    assert rig.steer.target_rad == pytest.approx(0.3, abs=1e-4)
    assert rig.last(SteerRpt).cmd_rejected == 0
    assert rig.safety.state is ENABLED


@pytest.mark.parametrize("kind", COMMANDS)
@pytest.mark.parametrize(("bad", "ends"), [(2, False), (3, True)])
def test_three_bad_counters_in_a_row_end_the_enabled_state(rig: Rig, kind: type[Message], bad: int, ends: bool) -> None:
    rig.enabled(2.0)
    rig.sends.remove(kind)
    for _ in range(bad):
        rig.run(20)
        rig.send(kind, skip=1)
    rig.run(20)
    rig.send(kind)
    rig.sends.add(kind)
    rig.run(60)
    assert rig.safety.state is (STOPPING if ends else ENABLED)
    if ends:
        assert rig.safety.fault is FaultCode.BAD_FRAMES
        assert (rig.last(SystemRpt).bad_counter, rig.last(SystemRpt).bad_crc) == (1, 0)
        assert rig.stops()


@pytest.mark.parametrize("kind", COMMANDS)
@pytest.mark.parametrize(("bad", "ends"), [(1, False), (3, True)])
def test_three_damaged_frames_in_a_row_end_the_enabled_state(kind: type[Message], bad: int, ends: bool) -> None:
    rig = Rig("wire").enabled(2.0)
    rig.sends.remove(kind)
    for _ in range(bad):
        rig.run(20)
        rig.send(kind, damage=True)
    if not ends:
        rig.run(20)
        rig.send(kind)
        rig.sends.add(kind)
    rig.run(60)
    assert rig.safety.state is (STOPPING if ends else ENABLED)
    assert rig.last(SystemRpt).bad_crc == 1
    if ends:
        assert rig.safety.fault is FaultCode.BAD_FRAMES
        assert rig.stops()


def test_a_leaky_count_of_five_ends_the_enabled_state(rig: Rig) -> None:
    rig.enabled(2.0)
    rig.sends.remove(BrakeCmd)
    for k in range(11):
        assert rig.safety.state is ENABLED
        rig.send(BrakeCmd, skip=0 if k % 3 == 2 else 1)
        rig.run(10)
    assert rig.safety.state is STOPPING
    assert rig.safety.fault is FaultCode.BAD_FRAMES
    assert not rig.brake.enabled


# -- the driver of the cart takes over --------------------------------------------------------------------------------


@pytest.mark.parametrize(("torque_nm", "taken"), [(3.0, False), (3.1, True), (-3.1, True), (12.0, True)])
def test_more_than_3_newton_metres_at_the_wheel_for_100_ms_is_an_override(
    rig: Rig, torque_nm: float, taken: bool
) -> None:
    rig.enabled(2.0).torque_nm = torque_nm
    rig.run(100)
    assert rig.safety.state is ENABLED
    rig.run(100)
    assert (rig.safety.state is OVERRIDE) is taken
    assert rig.last(SystemRpt).override_steer == taken


def test_a_short_tug_at_the_wheel_is_no_override(rig: Rig) -> None:
    rig.enabled(2.0)
    for _ in range(10):
        rig.torque_nm = 8.0
        rig.run(80)
        rig.torque_nm = 0.0
        rig.run(40)
    assert rig.safety.state is ENABLED


@pytest.mark.parametrize(
    ("pedal", "pressed", "taken"),
    [
        ("brake_pedal", 0.10, False),
        ("brake_pedal", 0.105, True),
        ("throttle_pedal", 0.05, False),
        ("throttle_pedal", 0.055, True),
    ],
)
def test_a_pressed_pedal_is_an_override_at_once(rig: Rig, pedal: str, pressed: float, taken: bool) -> None:
    rig.enabled(2.0)
    setattr(rig, pedal, pressed)
    rig.run(30)
    assert (rig.safety.state is OVERRIDE) is taken
    rig.run(50)
    report = rig.last(SystemRpt)
    assert report.override_brake == (taken and pedal == "brake_pedal")
    assert report.override_throttle == (taken and pedal == "throttle_pedal")


def test_in_override_the_driver_has_steering_brake_and_throttle_alone(rig: Rig) -> None:
    rig.enabled(2.0).effort = 0.2
    rig.angle_wanted_rad = 0.2
    rig.brake_pedal = 0.3
    rig.run(100)
    for rig.angle_rad in (0.1, -0.2):
        rig.tick()
        assert (rig.drive.output, rig.brake.effort, rig.steer.target_rad) == (0.0, 0.0, rig.angle_rad)
    assert (rig.last(SteerRpt).override, rig.last(BrakeRpt).override, rig.last(ThrottleRpt).override) == (1, 1, 1)


def test_an_override_stays_until_it_is_cleared_with_hands_and_feet_off_for_500_ms(rig: Rig) -> None:
    rig.enabled().brake_pedal = 0.3
    rig.run(100)
    rig.clear_override = True
    rig.run(1_000)
    assert rig.states() == {OVERRIDE}  # the foot is still on it
    rig.brake_pedal, rig.clear_override = 0.0, False
    rig.run(3_000)
    assert rig.states() == {OVERRIDE}  # nobody cleared it
    rig.throttle_pedal, rig.clear_override = 0.2, True
    rig.run(100)
    rig.throttle_pedal = 0.0
    released_ns = rig.t_ns
    rig.ms_until(READY)
    assert 500 * MS <= rig.t_ns - released_ns <= 550 * MS


def test_after_an_override_the_cart_is_enabled_only_by_new_bits(rig: Rig) -> None:
    rig.enabled().brake_pedal = 0.3
    rig.run(100)
    rig.brake_pedal, rig.clear_override = 0.0, True
    rig.run(2_000)
    assert rig.states() == {READY}
    assert not any(node.enabled for node in rig.nodes)


def test_an_override_does_not_wipe_a_latched_fault(rig: Rig) -> None:
    rig.enabled(2.0).sends.clear()
    rig.run(200)
    rig.speed_mps = 0.0
    rig.ms_until(FAULT)
    rig.brake_pedal = 0.3
    rig.run(100)
    assert rig.states() == {OVERRIDE}
    rig.brake_pedal, rig.clear_override, rig.asks = 0.0, True, set()
    rig.sends = set(COMMANDS)
    rig.run(1_000)
    assert rig.states() == {OVERRIDE}
    rig.clear_faults = True
    rig.run(200)
    assert rig.states() == {READY}


# -- stopping ---------------------------------------------------------------------------------------------------------


def test_a_stop_cuts_the_drive_ramps_the_brake_and_holds_the_steering(rig: Rig) -> None:
    rig.enabled(2.0).angle_wanted_rad = 0.25
    rig.run(200)
    assert (rig.brake.effort, rig.safety.state) == (0.0, ENABLED)
    rig.speed_wanted_mps = 4.0
    rig.run(1_000)
    assert rig.drive.output > 0.0
    rig.sends.clear()
    efforts = []
    while len(efforts) < 60:
        rig.tick()
        if not rig.brake.enabled:
            assert rig.drive.output == 0.0
            assert rig.steer.target_rad == pytest.approx(0.25, abs=1e-4)
            efforts.append(rig.brake.effort)
    ramp = [min(0.01 * k, STOP_EFFORT) for k in range(1, 61)]  # 100 %/s from nothing, up to the stop effort
    assert efforts == pytest.approx(ramp)


def test_a_stop_eases_a_brake_that_was_on_harder(rig: Rig) -> None:
    rig.enabled(2.0).effort = 0.5
    rig.run(100)
    rig.sends.clear()
    rig.run(200)
    assert 0.3 < rig.brake.effort < 0.5
    rig.run(1_000)
    assert rig.brake.effort == pytest.approx(STOP_EFFORT)


def test_two_seconds_after_standstill_a_stop_becomes_a_fault(rig: Rig) -> None:
    rig.enabled(2.0).sends.clear()
    rig.run(5_000)
    assert rig.states() == {STOPPING}  # it still rolls
    rig.speed_mps = 0.0
    assert rig.ms_until(FAULT) == pytest.approx(2_500, abs=20)  # 500 ms without a tick is standstill
    rig.run(100)
    assert rig.stops()


def test_a_fault_stays_until_it_is_cleared(rig: Rig) -> None:
    rig.enabled(2.0).sends.clear()
    rig.run(200)
    rig.speed_mps = 0.0
    rig.ms_until(FAULT)
    rig.sends, rig.asks = set(COMMANDS), set()
    rig.run(500)
    rig.asks = set(COMMANDS)
    rig.run(2_000)
    assert rig.states() == {FAULT}
    assert rig.last(SystemRpt).fault_code == FaultCode.ACTUATOR_SILENT
    rig.clear_faults, rig.asks = True, set()
    rig.run(200)
    assert rig.states() == {READY}
    assert rig.last(SystemRpt).fault_code == FaultCode.NONE
    rig.clear_faults, rig.asks = False, set(COMMANDS)
    rig.run(300)
    assert rig.states() == {ENABLED}


def test_the_last_words_of_a_dead_host_clear_nothing(rig: Rig) -> None:
    """Its last frame said clear_faults; what happens after its death still latches."""
    rig.run(500).clear_faults = True
    rig.run_to(100)
    rig.sends.clear()
    rig.run(400)
    rig.button = True
    rig.run(100)
    rig.button = False
    rig.run(1_000)
    assert rig.states() == {ESTOP}


# -- the data cycle, the node's own envelope --------------------------------------------------------------------------


def test_a_data_cycle_that_stands_for_250_ms_stops_the_cart(rig: Rig) -> None:
    rig.enabled(2.0).cycle_runs = False  # the frame just sent carries the last cycle
    rig.run(250)
    assert rig.safety.state is ENABLED
    rig.tick()
    assert rig.safety.state is STOPPING
    assert rig.safety.fault is FaultCode.CYCLE_STANDS
    rig.run(60)
    assert rig.stops()
    assert rig.last(SystemRpt).cycle_echo == rig.cycle & 0xFFFF


def test_a_data_cycle_that_only_swings_to_and_fro_stands(rig: Rig) -> None:
    rig.enabled(2.0).cycle_runs = False
    high = rig.cycle
    for k in range(8):
        rig.cycle = high - k % 2
        rig.run(50)
    assert rig.safety.fault is FaultCode.CYCLE_STANDS


def test_a_data_cycle_may_wrap_at_32_bits(rig: Rig) -> None:
    rig.cycle = 2**32 - 200
    rig.enabled(2.0).run(1_000)
    assert rig.cycle > 2**32
    assert rig.safety.state is ENABLED


def test_a_host_that_starts_again_counts_its_cycles_from_zero(rig: Rig) -> None:
    rig.cycle = 100_000
    rig.enabled().asks = set()
    rig.run(200)
    rig.cycle = 0
    rig.run(200)
    rig.asks = set(COMMANDS)
    rig.run(1_000)
    assert rig.safety.state is ENABLED


@pytest.mark.parametrize(("speed_mps", "stopped"), [(6.0, False), (6.4, True), (-6.4, True)])
def test_overspeed_is_seen_from_the_nodes_own_ticks(rig: Rig, speed_mps: float, stopped: bool) -> None:
    rig.enabled(2.0).speed_mps = speed_mps
    rig.run(150)
    assert rig.safety.state is ENABLED  # 100 ms to measure, 100 ms to be sure
    rig.run(850)
    assert (rig.safety.state is STOPPING) is stopped
    assert (rig.safety.fault is FaultCode.OVERSPEED) is stopped


@pytest.mark.parametrize(("lateral_mps2", "stopped"), [(2.7, False), (3.3, True)])
@pytest.mark.parametrize("angle_rad", [0.3, -0.3])
def test_cornering_too_hard_is_seen_from_the_nodes_own_ticks(
    rig: Rig, lateral_mps2: float, stopped: bool, angle_rad: float
) -> None:
    rig.enabled(math.sqrt(lateral_mps2 * 1.66 / math.tan(0.3))).angle_rad = angle_rad
    rig.run(500)
    assert (rig.safety.state is STOPPING) is stopped
    assert (rig.safety.fault is FaultCode.CORNERING) is stopped


# -- emergency stop ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("begin", ["parked", "enabled", "override", "stopping"])
def test_the_button_brakes_fully_and_opens_the_contactor_at_once(rig: Rig, begin: str) -> None:
    if begin == "parked":
        rig.run(500)
    else:
        rig.enabled(3.0)
    if begin == "override":
        rig.brake_pedal = 0.3
        rig.run(100)
    elif begin == "stopping":
        rig.sends.clear()
        rig.run(200)
    rig.button = True
    rig.tick()
    assert rig.safety.state is ESTOP
    assert (rig.brake.effort, rig.drive.output, rig.drive.contactor_open) == (1.0, 0.0, True)
    frame = rig.last(Estop)
    assert (frame.active, frame.source, frame.latched) == (1, EstopSource.BUTTON, 1)
    assert rig.heard[-1].t_ns == rig.t_ns


def test_the_host_can_ask_for_an_emergency_stop(rig: Rig) -> None:
    rig.enabled(3.0).request_estop = True
    rig.run(60)
    assert rig.safety.state is ESTOP
    assert (rig.brake.effort, rig.drive.contactor_open) == (1.0, True)
    assert rig.last(Estop).source == EstopSource.HOST


def test_an_emergency_stop_holds_the_steering(rig: Rig) -> None:
    rig.enabled(3.0).angle_wanted_rad = 0.1
    rig.run(100)
    rig.button, rig.angle_wanted_rad = True, -0.3
    rig.run(200)
    assert rig.steer.target_rad == pytest.approx(0.1, abs=1e-4)


def test_an_emergency_stop_needs_the_button_out_and_faults_cleared(rig: Rig) -> None:
    rig.enabled().button = True
    rig.run(100)
    rig.button, rig.asks = False, set()
    rig.run(3_000)
    assert rig.states() == {ESTOP}
    assert rig.brake.effort == 1.0
    rig.button, rig.clear_faults = True, True
    rig.run(1_000)
    assert rig.states() == {ESTOP}
    rig.button = False
    rig.run(120)
    assert rig.states() == {READY}
    assert (rig.brake.effort, rig.drive.contactor_open) == (PARK_EFFORT, False)
    assert rig.last(Estop).active == 0


def test_an_emergency_stop_asked_by_the_host_lasts_as_long_as_it_asks(rig: Rig) -> None:
    rig.enabled().request_estop = True
    rig.clear_faults = True
    rig.ms_until(ESTOP)
    for _ in range(100):
        rig.tick()
        assert rig.safety.state is ESTOP
    rig.request_estop, rig.asks = False, set()
    rig.run(200)
    assert rig.states() == {READY}


def test_the_nodes_obey_the_stop_frame_without_a_word_of_the_safety_nodes_report(rig: Rig) -> None:
    rig.enabled(3.0)
    rig.bus.faults.append(lambda frame: None if frame.frame_id == SystemRpt.ID else frame)
    rig.button = True
    rig.tick()
    assert {node.state for node in rig.nodes} == {ENABLED}
    assert (rig.brake.effort, rig.drive.contactor_open, rig.drive.output) == (1.0, True, 0.0)


def test_the_nodes_obey_the_report_if_the_stop_frame_is_lost(rig: Rig) -> None:
    rig.enabled(3.0)
    rig.bus.faults.append(lambda frame: None if frame.frame_id == Estop.ID else frame)
    rig.button = True
    rig.run(60)
    assert (rig.brake.effort, rig.drive.contactor_open, rig.drive.output) == (1.0, True, 0.0)


def test_an_emergency_stop_outlives_the_safety_node(rig: Rig) -> None:
    rig.enabled(3.0).button = True
    rig.run(50)
    rig.safety_runs, rig.button = False, False
    rig.run(2_000)
    assert (rig.brake.effort, rig.drive.contactor_open) == (1.0, True)


# -- reports ----------------------------------------------------------------------------------------------------------


def test_every_report_comes_at_its_period(rig: Rig) -> None:
    rig.run(1_000)
    for kind in (Estop, SystemRpt, SteerRpt, BrakeRpt, ThrottleRpt):
        times = [r.t_ns - T0_NS for r in rig.heard if r.frame_id == kind.ID]
        assert times == [k * kind.PERIOD_NS for k in range(1, 1_000 * MS // kind.PERIOD_NS + 1)]
