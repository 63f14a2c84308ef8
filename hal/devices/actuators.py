"""Device models of the steering, brake and drive nodes: sans-I/O, polled at base ticks.

Each obeys its command only while the safety node reports ENABLED, its own command is not silent and the command's
enable bit rose after idle frames. Otherwise steering holds its angle, the drive gives nothing, and the brake ramps up.
"""

import math

from hal.bus import CanBus, CanPort, Received
from hal.codecs.cartcan import (
    BrakeCmd,
    BrakeRpt,
    Direction,
    Estop,
    Message,
    SteerCmd,
    SteerMode,
    SteerRpt,
    SystemRpt,
    ThrottleCmd,
    ThrottleMode,
    ThrottleRpt,
)
from hal.signals import SystemState, state_of

from .watch import GOOD_BEFORE_ENABLE, CommandWatch

COMMAND_TIMEOUT_NS = 100_000_000
SAFETY_TIMEOUT_NS = 250_000_000
REPORT_NS = 20_000_000
# Looked up once: in Python 3.11 a member of an enum costs three times what the comparison with it does.
INIT, READY, ENABLED = SystemState.INIT, SystemState.READY, SystemState.ENABLED
OVERRIDE, MANUAL, ESTOP = SystemState.OVERRIDE, SystemState.MANUAL, SystemState.ESTOP
ANGLE, PERCENT, SPEED = SteerMode.ANGLE, ThrottleMode.PERCENT, ThrottleMode.SPEED
FORWARD, REVERSE = Direction.FORWARD, Direction.REVERSE


class Node:
    """What the three actuator nodes share: listening, permission to act, the time of the next report."""

    command: type[Message]

    def __init__(self, bus: CanBus, name: str) -> None:
        self.port: CanPort = bus.port(name, [self.command, SystemRpt, Estop])
        self.watch = CommandWatch(COMMAND_TIMEOUT_NS)
        self.state = INIT
        self.estop = False
        self.enabled = False
        self._armed = False  # enough idle frames came before the enable bit
        self._trusted_until_ns = CommandWatch.NEVER_NS  # later than that, the safety node is silent
        self._asked: Message | None = None

    def _listen(self, t_ns: int) -> None:
        for received in self.port.receive():
            message = received.message
            if received.frame_id == self.command.ID:
                self._obey(received)
            elif isinstance(message, SystemRpt):
                self.state, self._trusted_until_ns = state_of(message.state), received.t_ns + SAFETY_TIMEOUT_NS
            elif isinstance(message, Estop):
                self.estop = bool(message.active)
        was, watch = self.enabled, self.watch
        self.enabled = (
            watch.asks
            and self._armed
            and self.state is ENABLED
            and not self.estop
            and not watch.tripped
            and t_ns <= watch.fresh_until_ns
            and t_ns <= self._trusted_until_ns
        )
        if was and not self.enabled:
            self._armed = False  # a stop is not taken back by frames that come again: idle ones come first
        if self.state is READY and not watch.asks:
            watch.forgive()

    def _obey(self, received: Received) -> None:
        idle = self.watch.idle_streak
        message = self.watch.judge(received)
        if message is not None:
            if not self.watch.asks:
                self._armed = False
            elif idle >= GOOD_BEFORE_ENABLE:
                self._armed = True
            self._asked = message

    def _take_rejected(self) -> bool:
        rejected, self.watch.rejected = self.watch.rejected, False
        return rejected


class SteerNode(Node):
    """Steering: a position servo. `target_rad` is what it asks of the mechanism."""

    command = SteerCmd

    def __init__(self, bus: CanBus) -> None:
        super().__init__(bus, "STEER")
        self.target_rad = 0.0

    def poll(self, t_ns: int, angle_rad: float, driver_torque_nm: float) -> None:
        """Act on what came; report when due."""
        was = self.enabled
        self._listen(t_ns)
        if self.state is OVERRIDE or (self.enabled and not was):
            self.target_rad = angle_rad  # released, or: nothing jumps on entry
        elif self.enabled and isinstance(self._asked, SteerCmd) and self._asked.mode == ANGLE:
            self.target_rad = self._asked.angle_rad
        if t_ns % REPORT_NS == 0:
            self.port.send(
                SteerRpt.of(
                    angle_rad=angle_rad,
                    angle_cmd_rad=self.target_rad,
                    driver_torque_nm=driver_torque_nm,
                    enabled=self.enabled,
                    override=self.state is OVERRIDE,
                    timeout=self.watch.silent(t_ns),
                    homed=True,
                    cmd_rejected=self._take_rejected(),
                ),
                t_ns,
            )


class BrakeNode(Node):
    """Brake: an effort servo, and the node that stops the cart when nobody else does."""

    command = BrakeCmd

    def __init__(self, bus: CanBus, *, stop_effort: float, park_effort: float, ramp_per_s: float = 1.0) -> None:
        super().__init__(bus, "BRAKE")
        self.effort = park_effort
        self._stop_effort, self._park_effort, self._ramp_per_s = stop_effort, park_effort, ramp_per_s
        self._polled_ns: int | None = None

    def poll(self, t_ns: int, pressure: float, pedal: float) -> None:
        """Act on what came; report when due. `pressure` is the effort that the mechanism has reached."""
        self._listen(t_ns)
        dt_s = 0.0 if self._polled_ns is None else (t_ns - self._polled_ns) * 1e-9
        self._polled_ns = t_ns
        if self.estop or self.state is ESTOP:
            self.effort = 1.0
        elif self.state is OVERRIDE or self.state is MANUAL:
            self.effort = 0.0
        elif self.enabled and isinstance(self._asked, BrakeCmd):
            self.effort = self._asked.effort_ratio
        elif self.state is READY or self.state is INIT:
            self.effort = self._park_effort
        else:  # stopping or fault, or the host or the safety node fell silent
            step = self._ramp_per_s * dt_s
            self.effort += min(max(self._stop_effort - self.effort, -step), step)
        if t_ns % REPORT_NS == 0:
            self.port.send(
                BrakeRpt.of(
                    effort_ratio=pressure,
                    effort_cmd_ratio=self.effort,
                    pedal_ratio=pedal,
                    enabled=self.enabled,
                    override=self.state is OVERRIDE,
                    timeout=self.watch.silent(t_ns),
                    cmd_rejected=self._take_rejected(),
                ),
                t_ns,
            )


class DriveNode(Node):
    """Drive: holds a speed with its own motor encoder, or gives a torque.

    Proportional-integral about a ramp; the torque that the ramp itself needs is fed forward, so that the integral
    carries rolling resistance and slope only and does not push the cart past the wanted speed.
    """

    command = ThrottleCmd
    gain_per_mps = 0.5  # ours; settles in about two seconds with the lag of the drive
    integral_per_m = 0.15
    full_accel_mps2 = 1.3  # at output 1, empty cart: what the ramp's torque is reckoned with

    def __init__(self, bus: CanBus) -> None:
        super().__init__(bus, "DRIVE")
        self.output = 0.0
        self.contactor_open = False
        self._ramp_mps = self._integral = 0.0
        self._polled_ns: int | None = None

    def poll(self, t_ns: int, speed_mps: float, output: float, pedal: float) -> None:
        """Act on what came; report when due. `output` is the torque that the motor gives."""
        self._listen(t_ns)
        dt_s = 0.0 if self._polled_ns is None else (t_ns - self._polled_ns) * 1e-9
        self._polled_ns = t_ns
        self.contactor_open = self.estop or self.state is ESTOP
        if self.enabled and isinstance(self._asked, ThrottleCmd):
            self.output = self._drive(self._asked, speed_mps, dt_s)
        else:
            self.output = self._integral = 0.0
            self._ramp_mps = speed_mps
        if t_ns % REPORT_NS == 0:
            direction = REVERSE if self.output < 0 else FORWARD
            self.port.send(
                ThrottleRpt.of(
                    output_ratio=output,
                    cmd_ratio=self.output,
                    pedal_ratio=pedal,
                    enabled=self.enabled,
                    override=self.state is OVERRIDE,
                    timeout=self.watch.silent(t_ns),
                    direction=direction,
                    cmd_rejected=self._take_rejected(),
                ),
                t_ns,
            )

    def _drive(self, asked: ThrottleCmd, speed_mps: float, dt_s: float) -> float:
        if asked.mode == PERCENT:
            return min(max(asked.percent_ratio or 0.0, -1.0), 1.0)
        wanted = asked.speed_mps
        if asked.mode != SPEED or not wanted:
            self._integral, self._ramp_mps = 0.0, speed_mps
            return 0.0
        rise, before_mps = (asked.accel_limit_mps2 or 1.0) * dt_s, self._ramp_mps
        self._ramp_mps = (
            min(max(wanted, self._ramp_mps - 10.0 * rise), self._ramp_mps + rise)
            if wanted > 0
            else max(min(wanted, self._ramp_mps + 10.0 * rise), self._ramp_mps - rise)
        )
        error = self._ramp_mps - speed_mps
        if self._ramp_mps == wanted:  # while the ramp still runs, its lag is no error to learn from
            self._integral = min(max(self._integral + self.integral_per_m * error * dt_s, -1.0), 1.0)
        low, high = (0.0, 1.0) if wanted > 0 else (-1.0, 0.0)
        speeding_up = (self._ramp_mps - before_mps) * wanted > 0 and dt_s > 0
        ramp = (self._ramp_mps - before_mps) / dt_s / self.full_accel_mps2 if speeding_up else 0.0
        output = self.gain_per_mps * error + self._integral + ramp
        return min(max(output, low), high) if math.isfinite(output) else 0.0
