"""Driver of the cart's actuators and safety node: the host end of the CAN bus.

Every 20 ms it sends the three actuator commands in one burst, every 50 ms SYSTEM_CMD, also while disabled. It enables
once the safety node is ready and a fresh command is there; it never clears a fault by itself.
"""

import math

import msgspec

from hal.bus import CanBus
from hal.codecs.cartcan import (
    BrakeCmd,
    BrakeRpt,
    Direction,
    SteerCmd,
    SteerRpt,
    SystemCmd,
    SystemRpt,
    ThrottleCmd,
    ThrottleRpt,
    WheelTicks,
)
from hal.limits import Envelope, limit
from hal.signals import (
    ActuatorCommand,
    ActuatorState,
    DriveCommand,
    Limit,
    LinkCounters,
    Odometry,
    PedalCommand,
    SafetyState,
    SystemState,
    state_of,
)

from .odometry import OdometryDriver

BURST_NS = 20_000_000
SYSTEM_NS = 50_000_000
IDLE_BURSTS = 4  # sent disabled before enabling; the nodes want three good ones
ASK_BURSTS = 15  # asked for that long without an answer: idle again, as a lost frame may have spoilt the request
ACCEL_LIMIT_MPS2 = 1.0
FULL_BRAKE_MPS2 = 5.0  # deceleration at effort 1, empty cart
HOLD_EFFORT = 0.15
STANDSTILL_MPS = 0.05
BRAKE_EXCESS_MPS, RELEASE_EXCESS_MPS = 0.25, 0.10


def brake_effort(command: DriveCommand, speed_mps: float, braking: bool = False) -> float:
    """Decide the brake effort [0, 1] that slows the cart from its measured speed to the commanded one.

    braking: it brakes already. It begins only when the cart is clearly too fast, and ends when it no longer is.
    """
    wanted, actual = abs(command.speed_mps), abs(speed_mps)
    if wanted == 0.0 and actual < STANDSTILL_MPS:
        return HOLD_EFFORT
    excess_mps = actual - wanted
    if wanted > 0.0 and excess_mps < (RELEASE_EXCESS_MPS if braking else BRAKE_EXCESS_MPS):
        return 0.0
    decel_mps2 = min(command.decel_mps2, 0.3 + 2.0 * excess_mps)
    return min(max(decel_mps2 / FULL_BRAKE_MPS2, 0.0), 1.0)


class Heard(msgspec.Struct):
    """What one poll brought, with data stamps."""

    odometry: list[tuple[Odometry, int]] = []
    safety: list[tuple[SafetyState, int]] = []
    actuators: list[tuple[ActuatorState, int]] = []


NOTHING = Heard()  # of a poll that brought no frame; never written to
# Looked up once: in Python 3.11 a member of an enum costs three times what the comparison with it does.
INIT, READY, ENABLED = SystemState.INIT, SystemState.READY, SystemState.ENABLED
FORWARD, REVERSE = Direction.FORWARD, Direction.REVERSE
HARMLESS = (Limit.NONE, Limit.LATERAL)
SILENCE = (Limit.NO_COMMAND, Limit.STALE)
NO_ANGLE = (Limit.NO_COMMAND, Limit.NOT_FINITE, Limit.STEER)  # the command's angle is not there, or is none


class CartDriver:
    """Sans-I/O host end: `poll` reads the bus, `command` writes it."""

    def __init__(self, bus: CanBus, metres_per_tick: float, envelope: Envelope | None = None) -> None:
        self.port = bus.port("HOST", [SystemRpt, SteerRpt, BrakeRpt, ThrottleRpt, WheelTicks])
        self.envelope = envelope or Envelope()
        self.state = INIT
        self._odometry = OdometryDriver(metres_per_tick)
        self._speed_mps = 0.0
        self._steer: SteerRpt | None = None
        self._brake: BrakeRpt | None = None
        self._idle = self._asking = 0
        self._enable = self._braking = False
        self._steer_rad = 0.0
        self._origin_cycle = 0
        self._received = self._lost = 0
        self._counters: dict[int, int] = {}

    def poll(self) -> Heard:
        """Read what the nodes sent since the last poll."""
        frames = self.port.receive()
        if not frames:
            return NOTHING
        heard, counters = Heard(), self._counters
        for received in frames:
            message, t_ns = received.message, received.t_ns
            if message is None:
                continue
            self._received += 1
            frame_id, counter = received.frame_id, received.counter
            self._lost += (counter - counters.get(frame_id, counter - 1) - 1) & 15
            counters[frame_id] = counter
            if isinstance(message, WheelTicks):
                odometry = self._odometry.hear(message, counter, t_ns)
                self._speed_mps = odometry.speed_mps
                heard.odometry.append((odometry, t_ns))
            elif isinstance(message, SteerRpt):
                self._steer = message
            elif isinstance(message, BrakeRpt):
                self._brake = message
            elif isinstance(message, ThrottleRpt):
                if self._steer is not None and self._brake is not None:
                    heard.actuators.append((actuator_state(self._steer, self._brake, message), t_ns))
            elif isinstance(message, SystemRpt):
                self.state = state_of(message.state)
                heard.safety.append((safety_state(message), t_ns))
        return heard

    @property
    def counters(self) -> LinkCounters:
        """Frames received, refused and missed so far."""
        return LinkCounters(self._received, self.port.damaged, self._lost)

    def _meant(self, command: DriveCommand | PedalCommand | None) -> DriveCommand | None:
        """Give the command that the limits look at: of pedals, to go on at the present speed with their steering."""
        if not isinstance(command, PedalCommand):
            return command
        finite = math.isfinite(command.throttle + command.brake)
        return DriveCommand(self._speed_mps if finite else math.nan, command.steer_rad)

    def _throttle(self, pedals: PedalCommand | None, speed_mps: float, enable: bool) -> ThrottleCmd:
        """Make the throttle's command: never against the brake."""
        if pedals is not None:
            throttle = 0.0 if self._braking else pedals.throttle
            direction = FORWARD if throttle >= 0 else REVERSE
            return ThrottleCmd.of_percent(percent_ratio=throttle, enable=enable, direction=direction)
        direction = FORWARD if speed_mps >= 0 else REVERSE
        speed_mps = 0.0 if self._braking else speed_mps
        return ThrottleCmd.of_speed(
            speed_mps=speed_mps, accel_limit_mps2=ACCEL_LIMIT_MPS2, enable=enable, direction=direction
        )

    def command(
        self, t_ns: int, command: DriveCommand | PedalCommand | None, origin_ns: int, origin_cycle: int
    ) -> ActuatorCommand | None:
        """Send what is due at t_ns; returns what the burst asked for, None between bursts.

        Pedals are passed while the cart's speed is within the limits for their steering angle, else the limits decide.
        origin_ns, origin_cycle: when the oldest sensor data behind the command was true.
        """
        if t_ns % SYSTEM_NS == 0:
            self.port.send(
                SystemCmd.of(cycle=self._origin_cycle, request_enable=self._enable, host_state=int(self.state)), t_ns
            )
        if t_ns % BURST_NS != 0:
            return None
        pedals = command if isinstance(command, PedalCommand) else None
        drive, why = limit(self._meant(command), t_ns - origin_ns, self.envelope)
        self._origin_cycle = origin_cycle
        self._idle = min(self._idle + 1, IDLE_BURSTS) if self.state is READY else 0
        self._asking = self._asking + 1 if self._enable and self.state is READY else 0
        if self._asking > ASK_BURSTS:
            self._enable, self._idle = False, 0
        ready = self._idle >= IDLE_BURSTS and why in HARMLESS
        obeyed = self._enable and (self.state is READY or self.state is ENABLED)
        self._enable = ready or (obeyed and why not in SILENCE)
        enable = self._enable or self.state is ENABLED  # the brake of a stale host must still be obeyed
        if why in NO_ANGLE:
            drive = DriveCommand(0.0, self._steer_rad)  # a stop without an angle of its own keeps the last good one
        self._steer_rad = drive.steer_rad
        passed = pedals is not None and why is Limit.NONE
        most = self.envelope.max_decel_mps2 / FULL_BRAKE_MPS2
        effort = min(pedals.brake, most) if pedals and passed else brake_effort(drive, self._speed_mps, self._braking)
        self._braking = effort > 0.0
        self.port.send(SteerCmd.of(angle_rad=drive.steer_rad, enable=enable), t_ns)
        self.port.send(BrakeCmd.of(effort_ratio=effort, enable=enable), t_ns)
        self.port.send(self._throttle(pedals if passed else None, drive.speed_mps, enable), t_ns)
        return ActuatorCommand(drive.speed_mps, drive.steer_rad, effort, self._enable, why, origin_cycle)


def actuator_state(steer: SteerRpt, brake: BrakeRpt, throttle: ThrottleRpt) -> ActuatorState:
    """Join the reports of the three nodes."""
    return ActuatorState(
        steer_rad=steer.angle_rad or 0.0,
        steer_command_rad=steer.angle_cmd_rad or 0.0,
        brake=brake.effort_ratio or 0.0,
        brake_command=brake.effort_cmd_ratio or 0.0,
        drive=throttle.output_ratio or 0.0,
        steer_enabled=bool(steer.enabled),
        brake_enabled=bool(brake.enabled),
        drive_enabled=bool(throttle.enabled),
        rejected=bool(steer.cmd_rejected or brake.cmd_rejected or throttle.cmd_rejected),
    )


def safety_state(report: SystemRpt) -> SafetyState:
    """Translate SYSTEM_RPT."""
    return SafetyState(
        state=state_of(report.state),
        estop=bool(report.estop),
        host_timeout=bool(report.host_timeout),
        bad_crc=bool(report.bad_crc),
        bad_counter=bool(report.bad_counter),
        override=bool(report.override_steer or report.override_brake or report.override_throttle),
        fault_code=report.fault_code,
    )
