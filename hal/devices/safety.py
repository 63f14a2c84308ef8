"""Device model of the safety node: it owns SYSTEM_RPT and ESTOP, and decides whether the actuators may obey the host.

It believes only what it sees itself: frames of the host (counter, checksum, silence, the data cycle moving on), its own
count of wheel ticks, the driver's pedals. The rules and their sources stand in docs/cart.md.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

from hal.bus import CanBus, Received
from hal.codecs.cartcan import (
    BrakeCmd,
    BrakeRpt,
    Estop,
    EstopSource,
    SteerCmd,
    SteerRpt,
    SystemCmd,
    SystemRpt,
    ThrottleCmd,
    ThrottleRpt,
)
from hal.signals import SystemState

from .watch import GOOD_BEFORE_ENABLE, CommandWatch

ACTUATOR_TIMEOUT_NS = 100_000_000
SYSTEM_TIMEOUT_NS = 250_000_000
CYCLE_TIMEOUT_NS = 250_000_000
ENABLE_WINDOW_NS = 200_000_000
BOOT_NS = 300_000_000
STANDSTILL_NS = 500_000_000
FAULT_AFTER_NS = 2_000_000_000
OVERRIDE_FREE_NS = 500_000_000
TORQUE_OVERRIDE_NS = 100_000_000
OVERSPEED_NS = 100_000_000
REPORT_NS = 50_000_000
ESTOP_NS = 100_000_000
NOTHING_ASKED = SystemCmd()


class FaultCode(IntEnum):
    """Why the node left ENABLED, in SYSTEM_RPT.fault_code."""

    NONE = 0
    ACTUATOR_SILENT = 1
    HOST_SILENT = 2
    BAD_FRAMES = 3
    CYCLE_STANDS = 4
    OVERSPEED = 5
    CORNERING = 6
    DISABLED_MOVING = 7


# Looked up once: in Python 3.11 a member of an enum costs three times what the comparison with it does.
INIT, READY, ENABLED = SystemState.INIT, SystemState.READY, SystemState.ENABLED
OVERRIDE, STOPPING, ESTOP = SystemState.OVERRIDE, SystemState.STOPPING, SystemState.ESTOP
NO_FAULT = FaultCode.NONE


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyParams:
    """The node's own envelope: a little wider than what the host's limits pass, so that those act first."""

    max_speed_mps: float = 6.2
    max_lateral_mps2: float = 3.0
    wheelbase_m: float = 1.66
    metres_per_tick: float = 1.40 / 128


class SafetyNode:
    """Sans-I/O; polled at base ticks with what its inputs show."""

    def __init__(self, bus: CanBus, t_ns: int, params: SafetyParams | None = None) -> None:
        self.port = bus.port("SAFETY", [SystemCmd, SteerCmd, BrakeCmd, ThrottleCmd, SteerRpt, BrakeRpt, ThrottleRpt])
        self.params = params or SafetyParams()
        self.state = INIT
        self.fault = NO_FAULT
        self._commands = {m.ID: CommandWatch(ACTUATOR_TIMEOUT_NS) for m in (SteerCmd, BrakeCmd, ThrottleCmd)}
        self._system = CommandWatch(SYSTEM_TIMEOUT_NS)
        self._actuator_watches = tuple(self._commands.values())
        self._watches = (*self._actuator_watches, self._system)
        self._hear: dict[int, Callable[[Received, int], None]] = {
            **dict.fromkeys(self._commands, self._hear_command),
            SystemCmd.ID: self._hear_system,
            SteerRpt.ID: self._hear_steer,
            BrakeRpt.ID: self._hear_brake,
            ThrottleRpt.ID: self._hear_throttle,
        }
        self._asked = SystemCmd()
        self._request_ns: int | None = None  # since when SYSTEM_CMD asks to enable
        self._enable_ns: dict[int, int] = {}  # since when each command asks to be obeyed, after enough idle frames
        self._booted_ns = t_ns + BOOT_NS
        self._cycle, self._cycle_ns = -1, t_ns
        self._ticks, self._moved_ns, self._still_since_ns = 0, t_ns, t_ns
        self._speeds: deque[tuple[int, int]] = deque(maxlen=11)
        self._steer_tan = 0.0  # tangent of the steering angle, without its sign
        self._torque_since_ns: int | None = None
        self._overspeed_since_ns: int | None = None
        self._free_since_ns = t_ns
        self._override = [False, False, False]  # the driver steers, brakes, drives
        self._stopping_ns = t_ns
        self._estop_source = EstopSource.NONE
        self._estop_sent = False

    # -- inputs -------------------------------------------------------------------------------------------------

    def poll(self, t_ns: int, ticks: int, button: bool) -> None:
        """Hear, decide, report. ticks: the node's own wheel count; button: the emergency stop button is pressed."""
        if ticks != self._ticks:
            self._ticks, self._moved_ns = ticks, t_ns
        self._speeds.append((t_ns, ticks))
        for received in self.port.receive():
            self._hear[received.frame_id](received, t_ns)
        if True in self._override:
            self._free_since_ns = t_ns
        was, self.state = self.state, self._decide(t_ns, button)
        estop = self.state is ESTOP
        if estop != self._estop_sent or t_ns % ESTOP_NS == 0:
            self._estop_sent = estop
            self.port.send(Estop(active=estop, source=self._estop_source, latched=estop), t_ns)
        if self.state is not was or t_ns % REPORT_NS == 0:  # a change is told at once, like an emergency stop
            self._report(t_ns)

    @property
    def speed_mps(self) -> float:
        """Speed from the node's own ticks over the last 100 ms."""
        (t0, n0), (t1, n1) = self._speeds[0], self._speeds[-1]
        return (n1 - n0) * self.params.metres_per_tick / ((t1 - t0) * 1e-9) if t1 > t0 else 0.0

    def _hear_command(self, received: Received, _t_ns: int) -> None:
        """Note since when a command asks to be obeyed: after enough idle frames."""
        frame_id = received.frame_id
        watch = self._commands[frame_id]
        idle = watch.idle_streak
        if watch.judge(received) is None:
            return
        if not watch.asks:
            self._enable_ns.pop(frame_id, None)
        elif idle >= GOOD_BEFORE_ENABLE:
            self._enable_ns.setdefault(frame_id, received.t_ns)

    def _hear_system(self, received: Received, _t_ns: int) -> None:
        message = self._system.judge(received)
        if isinstance(message, SystemCmd):
            self._take(message, received.t_ns)

    def _hear_steer(self, received: Received, t_ns: int) -> None:
        if isinstance(message := received.message, SteerRpt):
            self._steer_tan = abs(math.tan(message.angle_rad or 0.0))
            strong = abs(message.driver_torque_nm or 0.0) > 3.0
            since_ns = self._torque_since_ns = (self._torque_since_ns or received.t_ns) if strong else None
            self._override[0] = since_ns is not None and t_ns - since_ns >= TORQUE_OVERRIDE_NS

    def _hear_brake(self, received: Received, _t_ns: int) -> None:
        if isinstance(message := received.message, BrakeRpt):
            self._override[1] = (message.pedal_ratio or 0.0) > 0.10

    def _hear_throttle(self, received: Received, _t_ns: int) -> None:
        if isinstance(message := received.message, ThrottleRpt):
            self._override[2] = (message.pedal_ratio or 0.0) > 0.05

    def _take(self, message: SystemCmd, t_ns: int) -> None:
        if not message.request_enable:
            self._request_ns = None
        elif not self._asked.request_enable:
            self._request_ns = t_ns
        ahead = (message.cycle - self._cycle) & 0xFFFFFFFF  # while enabled, only forward counts as advancing
        if self.state is not ENABLED or 0 < ahead < 1 << 31:
            self._cycle, self._cycle_ns = message.cycle, t_ns
        self._asked = message

    # -- decisions ----------------------------------------------------------------------------------------------

    def _decide(self, t_ns: int, button: bool) -> SystemState:
        state = self.state
        asked = NOTHING_ASKED if t_ns > self._system.fresh_until_ns else self._asked  # a dead host clears nothing
        if state is ESTOP:
            released = not button and not asked.request_estop and asked.clear_faults
            return self._ready() if released else state
        if button or asked.request_estop:
            self._estop_source = EstopSource.BUTTON if button else EstopSource.HOST
            return ESTOP
        if state is OVERRIDE:
            free = t_ns - self._free_since_ns >= OVERRIDE_FREE_NS
            cleared = self.fault is NO_FAULT or asked.clear_faults  # a fault from before is still latched
            return self._ready() if free and asked.clear_override and cleared else state
        if True in self._override:
            return OVERRIDE
        if state is INIT:
            return self._ready() if t_ns >= self._booted_ns else state
        if state is READY:
            return self._enter(t_ns) if self._may_enable(t_ns) else state
        if state is ENABLED:
            return self._stay_enabled(t_ns)
        if state is STOPPING:
            still = t_ns - max(self._moved_ns, self._stopping_ns) >= STANDSTILL_NS + FAULT_AFTER_NS
            return SystemState.FAULT if still else state
        return self._ready() if state is SystemState.FAULT and asked.clear_faults else state

    def _ready(self) -> SystemState:
        self.fault, self._estop_source = NO_FAULT, EstopSource.NONE
        self._enable_ns.clear()
        self._request_ns = None
        for watch in self._watches:
            watch.forgive()
        return READY

    def _may_enable(self, t_ns: int) -> bool:
        asks = [self._request_ns] if self._request_ns is not None and not self._system.silent(t_ns) else []
        asks += [since for frame_id, since in self._enable_ns.items() if not self._commands[frame_id].silent(t_ns)]
        return len(asks) == 1 + len(self._commands) and max(asks) - min(asks) <= ENABLE_WINDOW_NS

    def _enter(self, t_ns: int) -> SystemState:
        self._cycle_ns = t_ns
        self._overspeed_since_ns = None
        return ENABLED

    def _stay_enabled(self, t_ns: int) -> SystemState:
        if not self._asked.request_enable and not self._moving(t_ns):
            return self._ready()
        self.fault = self._why_stop(t_ns)
        if self.fault is NO_FAULT:
            return ENABLED
        self._stopping_ns = t_ns
        return STOPPING

    def _moving(self, t_ns: int) -> bool:
        return t_ns - self._moved_ns < STANDSTILL_NS

    def _why_stop(self, t_ns: int) -> FaultCode:
        speed_mps = abs(self.speed_mps)
        fast = speed_mps > self.params.max_speed_mps
        self._overspeed_since_ns = (self._overspeed_since_ns or t_ns) if fast else None
        for watch in self._actuator_watches:
            if t_ns > watch.fresh_until_ns:
                return FaultCode.ACTUATOR_SILENT
        if t_ns > self._system.fresh_until_ns:
            return FaultCode.HOST_SILENT
        for watch in self._watches:
            if watch.tripped:
                return FaultCode.BAD_FRAMES
        if t_ns - self._cycle_ns > CYCLE_TIMEOUT_NS:
            return FaultCode.CYCLE_STANDS
        if self._overspeed_since_ns is not None and t_ns - self._overspeed_since_ns >= OVERSPEED_NS:
            return FaultCode.OVERSPEED
        if speed_mps * speed_mps * self._steer_tan / self.params.wheelbase_m > self.params.max_lateral_mps2:
            return FaultCode.CORNERING
        if not self._asked.request_enable:
            return FaultCode.DISABLED_MOVING
        return NO_FAULT

    def _report(self, t_ns: int) -> None:
        enabled = self.state is ENABLED
        steer, brake, throttle = self._override
        self.port.send(
            SystemRpt(
                state=self.state,
                steer_enabled=enabled,
                brake_enabled=enabled,
                throttle_enabled=enabled,
                estop=self.state is ESTOP,
                override_steer=steer,
                override_brake=brake,
                override_throttle=throttle,
                host_timeout=self.fault in (FaultCode.ACTUATOR_SILENT, FaultCode.HOST_SILENT),
                bad_crc=any(w.bad_crc for w in self._watches),
                bad_counter=any(w.bad_counter for w in self._watches),
                key_on=1,
                fault_code=self.fault,
                cycle_echo=max(0, self._cycle) & 0xFFFF,
            ),
            t_ns,
        )
