"""Device model of the safety node: it owns SYSTEM_RPT and ESTOP, and decides whether the actuators may obey the host.

It believes only what it sees itself: frames of the host (counter, checksum, silence, the data cycle moving on), its own
count of wheel ticks, the driver's pedals. The rules and their sources stand in docs/cart.md.
"""

import math
from collections import deque
from dataclasses import dataclass
from enum import IntEnum

from hal.bus import CanBus
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
        self.state = SystemState.INIT
        self.fault = FaultCode.NONE
        self._commands = {m.ID: CommandWatch(ACTUATOR_TIMEOUT_NS) for m in (SteerCmd, BrakeCmd, ThrottleCmd)}
        self._system = CommandWatch(SYSTEM_TIMEOUT_NS)
        self._asked = SystemCmd()
        self._request_ns: int | None = None  # since when SYSTEM_CMD asks to enable
        self._enable_ns: dict[int, int] = {}  # since when each command asks to be obeyed, after enough idle frames
        self._booted_ns = t_ns + BOOT_NS
        self._cycle, self._cycle_ns = -1, t_ns
        self._ticks, self._moved_ns, self._still_since_ns = 0, t_ns, t_ns
        self._speeds: deque[tuple[int, int]] = deque(maxlen=11)
        self._steer_rad = 0.0
        self._torque_since_ns: int | None = None
        self._overspeed_since_ns: int | None = None
        self._free_since_ns = t_ns
        self._override = (False, False, False)
        self._stopping_ns = t_ns
        self._estop_source = EstopSource.NONE
        self._estop_sent = False

    # -- inputs -------------------------------------------------------------------------------------------------

    def poll(self, t_ns: int, ticks: int, button: bool) -> None:
        """Hear, decide, report. ticks: the node's own wheel count; button: the emergency stop button is pressed."""
        self._move(t_ns, ticks)
        self._hear(t_ns)
        was, self.state = self.state, self._decide(t_ns, button)
        estop = self.state is SystemState.ESTOP
        if estop != self._estop_sent or t_ns % ESTOP_NS == 0:
            self._estop_sent = estop
            self.port.send(Estop(active=estop, source=self._estop_source, latched=estop), t_ns)
        if self.state is not was or t_ns % REPORT_NS == 0:  # a change is told at once, like an emergency stop
            self._report(t_ns)

    def _move(self, t_ns: int, ticks: int) -> None:
        if ticks != self._ticks:
            self._ticks, self._moved_ns = ticks, t_ns
        self._speeds.append((t_ns, ticks))

    @property
    def speed_mps(self) -> float:
        """Speed from the node's own ticks over the last 100 ms."""
        (t0, n0), (t1, n1) = self._speeds[0], self._speeds[-1]
        return (n1 - n0) * self.params.metres_per_tick / ((t1 - t0) * 1e-9) if t1 > t0 else 0.0

    def _hear(self, t_ns: int) -> None:
        pedals = list(self._override)
        for received in self.port.receive():
            if received.frame_id == SystemCmd.ID:
                message = self._system.judge(received)
                if isinstance(message, SystemCmd):
                    self._take(message, received.t_ns)
            elif received.frame_id in self._commands:
                watch = self._commands[received.frame_id]
                idle = watch.idle_streak
                message = watch.judge(received)
                if message is None or not getattr(message, "enable", 0):
                    if message is not None:
                        self._enable_ns.pop(received.frame_id, None)
                elif idle >= GOOD_BEFORE_ENABLE:
                    self._enable_ns.setdefault(received.frame_id, received.t_ns)
            elif isinstance(received.message, SteerRpt):
                self._steer_rad = received.message.angle_rad or 0.0
                strong = abs(received.message.driver_torque_nm or 0.0) > 3.0
                self._torque_since_ns = (self._torque_since_ns or received.t_ns) if strong else None
                pedals[0] = self._torque_since_ns is not None and t_ns - self._torque_since_ns >= TORQUE_OVERRIDE_NS
            elif isinstance(received.message, BrakeRpt):
                pedals[1] = (received.message.pedal_ratio or 0.0) > 0.10
            elif isinstance(received.message, ThrottleRpt):
                pedals[2] = (received.message.pedal_ratio or 0.0) > 0.05
        self._override = (pedals[0], pedals[1], pedals[2])
        if any(pedals):
            self._free_since_ns = t_ns

    def _take(self, message: SystemCmd, t_ns: int) -> None:
        if not message.request_enable:
            self._request_ns = None
        elif not self._asked.request_enable:
            self._request_ns = t_ns
        ahead = (message.cycle - self._cycle) & 0xFFFFFFFF  # while enabled, only forward counts as advancing
        if self.state is not SystemState.ENABLED or 0 < ahead < 1 << 31:
            self._cycle, self._cycle_ns = message.cycle, t_ns
        self._asked = message

    # -- decisions ----------------------------------------------------------------------------------------------

    def _decide(self, t_ns: int, button: bool) -> SystemState:
        state = self.state
        asked = SystemCmd() if self._system.silent(t_ns) else self._asked  # a dead host clears nothing
        if state is SystemState.ESTOP:
            released = not button and not asked.request_estop and asked.clear_faults
            return self._ready() if released else state
        if button or asked.request_estop:
            self._estop_source = EstopSource.BUTTON if button else EstopSource.HOST
            return SystemState.ESTOP
        if state is SystemState.OVERRIDE:
            free = t_ns - self._free_since_ns >= OVERRIDE_FREE_NS
            cleared = self.fault is FaultCode.NONE or asked.clear_faults  # a fault from before is still latched
            return self._ready() if free and asked.clear_override and cleared else state
        if any(self._override):
            return SystemState.OVERRIDE
        if state is SystemState.INIT:
            return self._ready() if t_ns >= self._booted_ns else state
        if state is SystemState.READY:
            return self._enter(t_ns) if self._may_enable(t_ns) else state
        if state is SystemState.ENABLED:
            return self._stay_enabled(t_ns)
        if state is SystemState.STOPPING:
            still = t_ns - max(self._moved_ns, self._stopping_ns) >= STANDSTILL_NS + FAULT_AFTER_NS
            return SystemState.FAULT if still else state
        return self._ready() if state is SystemState.FAULT and asked.clear_faults else state

    def _ready(self) -> SystemState:
        self.fault, self._estop_source = FaultCode.NONE, EstopSource.NONE
        self._enable_ns.clear()
        self._request_ns = None
        for watch in (*self._commands.values(), self._system):
            watch.forgive()
        return SystemState.READY

    def _may_enable(self, t_ns: int) -> bool:
        asks = [self._request_ns] if self._request_ns is not None and not self._system.silent(t_ns) else []
        asks += [since for frame_id, since in self._enable_ns.items() if not self._commands[frame_id].silent(t_ns)]
        return len(asks) == 1 + len(self._commands) and max(asks) - min(asks) <= ENABLE_WINDOW_NS

    def _enter(self, t_ns: int) -> SystemState:
        self._cycle_ns = t_ns
        self._overspeed_since_ns = None
        return SystemState.ENABLED

    def _stay_enabled(self, t_ns: int) -> SystemState:
        if not self._asked.request_enable and not self._moving(t_ns):
            return self._ready()
        self.fault = self._why_stop(t_ns)
        if self.fault is FaultCode.NONE:
            return SystemState.ENABLED
        self._stopping_ns = t_ns
        return SystemState.STOPPING

    def _moving(self, t_ns: int) -> bool:
        return t_ns - self._moved_ns < STANDSTILL_NS

    def _why_stop(self, t_ns: int) -> FaultCode:
        watches = (*self._commands.values(), self._system)
        speed_mps = abs(self.speed_mps)
        fast = speed_mps > self.params.max_speed_mps
        self._overspeed_since_ns = (self._overspeed_since_ns or t_ns) if fast else None
        lateral_mps2 = speed_mps * speed_mps * abs(math.tan(self._steer_rad)) / self.params.wheelbase_m
        for watch in self._commands.values():
            if watch.silent(t_ns):
                return FaultCode.ACTUATOR_SILENT
        if self._system.silent(t_ns):
            return FaultCode.HOST_SILENT
        for watch in watches:
            if watch.tripped:
                return FaultCode.BAD_FRAMES
        if t_ns - self._cycle_ns > CYCLE_TIMEOUT_NS:
            return FaultCode.CYCLE_STANDS
        if self._overspeed_since_ns is not None and t_ns - self._overspeed_since_ns >= OVERSPEED_NS:
            return FaultCode.OVERSPEED
        if lateral_mps2 > self.params.max_lateral_mps2:
            return FaultCode.CORNERING
        if not self._asked.request_enable:
            return FaultCode.DISABLED_MOVING
        return FaultCode.NONE

    def _report(self, t_ns: int) -> None:
        watches = (*self._commands.values(), self._system)
        enabled = self.state is SystemState.ENABLED
        steer, brake, throttle = self._override
        self.port.send(
            SystemRpt(
                state=self.state,
                steer_enabled=enabled,
                brake_enabled=enabled,
                throttle_enabled=enabled,
                estop=self.state is SystemState.ESTOP,
                override_steer=steer,
                override_brake=brake,
                override_throttle=throttle,
                host_timeout=self.fault in (FaultCode.ACTUATOR_SILENT, FaultCode.HOST_SILENT),
                bad_crc=any(w.bad_crc for w in watches),
                bad_counter=any(w.bad_counter for w in watches),
                key_on=1,
                fault_code=self.fault,
                cycle_echo=max(0, self._cycle) & 0xFFFF,
            ),
            t_ns,
        )
