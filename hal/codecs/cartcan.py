"""The cart's CAN frames: twelve messages between host, safety node and actuators.

The layout is our own, made after common practice: a rolling counter and a checksum in each frame, as in
Dataspeed's and openpilot's cars. Classic CAN, 11-bit ids, always 8 bytes, little endian ("Intel") signals:

    byte   0     1     2     3     4     5        6           7
         +-----+-----+-----+-----+-----+-----+-----------+-----+
         |  signals, the lowest bit first    | 0 | count | crc |
         +-----+-----+-----+-----+-----+-----+-----------+-----+
                                              7 4 3     0

`crc` is CRC-8 SAE J1850 over the id's high byte, the id's low byte and bytes 0 to 6.
`cart.dbc` beside this file says the same for other tools; a test holds the two together.

A message holds raw integers; counter and checksum belong to the frame. `of()` makes a message from SI units
by one rule: raw = round(value / scale), half to even, then clamped to the signal's range. Properties with a
unit in their name go back. A report whose raw value is the signal's largest code has nothing to say: the
property is None there, and `of()` takes None for it.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any, ClassVar, Final, Generic, NoReturn, Self, TypeVar, overload

import msgspec

from hal.codecs import CodecError
from hal.signals import SystemState

__all__ = [
    "MESSAGES",
    "BrakeCmd",
    "BrakeRpt",
    "Direction",
    "Estop",
    "EstopSource",
    "FrameError",
    "Message",
    "NodeInfo",
    "PowerRpt",
    "Signal",
    "SteerCmd",
    "SteerMode",
    "SteerRpt",
    "SystemCmd",
    "SystemRpt",
    "SystemState",
    "ThrottleCmd",
    "ThrottleMode",
    "ThrottleRpt",
    "WheelTicks",
    "crc8",
    "decode",
    "encode",
    "from_candump",
    "to_candump",
]


class FrameError(CodecError):
    """Raised when a frame, a raw value or a line of a candump log is not what this bus carries."""


class EstopSource(IntEnum):
    """Who asked for the emergency stop."""

    NONE = 0
    BUTTON = 1
    REMOTE = 2
    HOST = 3
    NODE_FAULT = 4
    WATCHDOG = 5


class SteerMode(IntEnum):
    """What the steering does with a command."""

    NONE = 0
    HOLD = 1
    ANGLE = 2


class ThrottleMode(IntEnum):
    """What the value of a throttle command means."""

    NONE = 0
    PERCENT = 1
    SPEED = 2


class Direction(IntEnum):
    """Position of the drive's direction switch."""

    NEUTRAL = 0
    FORWARD = 1
    REVERSE = 2


# Unit on the bus -> (to SI, from SI), as Python source: what is done to every message is written out per message.
# Units that are not here are SI already, or are kept as they are (degC).
_SI: Final[dict[str, tuple[str, str]]] = {
    "deg": ("radians({})", "degrees({})"),
    "deg/s": ("radians({})", "degrees({})"),
    "%": ("({}) / 100.0", "({}) * 100.0"),
    "%/s": ("({}) / 100.0", "({}) * 100.0"),
    "ms": ("({}) / 1000.0", "({}) * 1000.0"),
}
_AS_IT_IS: Final = ("{}", "{}")
_MATH: Final[dict[str, Any]] = {"radians": math.radians, "degrees": math.degrees}


def _function(argument: str, source: str) -> Callable[[Any], Any]:
    """Make a function of an expression."""
    return eval(f"lambda {argument}: {source}", dict(_MATH))  # type: ignore[no-any-return]


@dataclass(frozen=True)
class Signal:
    """One row of the layout: where the bits are, and what a raw number is worth."""

    name: str
    start: int
    """The lowest bit's number."""
    length: int
    signed: bool
    scale: float
    minimum: float
    """Range in `unit`; in reports it ends one step below the code for "not available"."""
    maximum: float
    unit: str
    choices: type[IntEnum] | None = None

    @cached_property
    def raw_minimum(self) -> int:
        """The lowest raw value of the range."""
        return round(self.minimum / self.scale)

    @cached_property
    def raw_maximum(self) -> int:
        """The highest raw value of the range."""
        return round(self.maximum / self.scale)

    @cached_property
    def unavailable(self) -> int:
        """The largest positive code, which says "not available" in reports."""
        return (1 << (self.length - self.signed)) - 1

    def quantise(self, value: float) -> int:
        """Return the raw integer nearest to a value in `unit`, inside the signal's range."""
        try:
            raw = round(value / self.scale)
        except (ValueError, OverflowError) as error:
            raise FrameError(f"{self.name}: {value} came, expected a finite number") from error
        if raw < self.raw_minimum:
            return self.raw_minimum
        return raw if raw <= self.raw_maximum else self.raw_maximum

    def value(self, raw: int) -> float:
        """Return what a raw integer is worth in `unit`."""
        return raw * self.scale

    @property
    def si(self) -> tuple[str, str]:
        """How a value in `unit` becomes one in SI units (rad, s, ratio), and the way back, as Python source."""
        return _SI.get(self.unit, _AS_IT_IS)

    @cached_property
    def from_si(self) -> Callable[[float], int]:
        """The function from a value in SI units to the nearest raw integer."""
        convert = _function("value", self.si[1].format("value"))
        return lambda value: self.quantise(convert(value))

    @cached_property
    def to_si(self) -> Callable[[int], float]:
        """The function from a raw integer to what it is worth in SI units."""
        return _function("raw", self.si[0].format(f"raw * {self.scale}"))


def _number(
    name: str,
    start: int,
    length: int,
    *,
    scale: float = 1.0,
    unit: str = "",
    signed: bool = False,
    limits: tuple[float, float] | None = None,
    report: bool = False,
) -> Signal:
    """Return a signal whose range, unless given, is all its codes; in a report, all but the largest."""
    if limits is None:
        lowest = -(1 << (length - 1)) if signed else 0
        highest = (1 << (length - signed)) - 1 - report
        limits = round(lowest * scale, 6), round(highest * scale, 6)
    return Signal(name, start, length, signed, scale, *limits, unit)


def _reading(name: str, start: int, length: int, scale: float, unit: str, *, signed: bool = False) -> Signal:
    return _number(name, start, length, scale=scale, unit=unit, signed=signed, report=True)


def _choice(name: str, start: int, length: int, choices: type[IntEnum]) -> Signal:
    return Signal(name, start, length, False, 1.0, 0.0, float(max(choices)), "", choices)


def _flags(**start: int) -> tuple[Signal, ...]:
    return tuple(_number(name, bit, 1) for name, bit in start.items())


class Message(msgspec.Struct, frozen=True, gc=False):
    """Base of the twelve messages; a message's fields are the raw integers of its signals, in that order."""

    ID: ClassVar[int]
    NAME: ClassVar[str]
    PERIOD_NS: ClassVar[int]
    SENDER: ClassVar[str]
    """Name of the one node that sends it, or "ANY"."""
    SIGNALS: ClassVar[tuple[Signal, ...]]

    @classmethod
    def _make(cls, *values: float | None) -> Self:
        """Make a message from SI values in the order of the signals; None means "not available"."""
        raise NotImplementedError  # each message has its own, written out below


_T = TypeVar("_T", float, "float | None")


class _Quantity(Generic[_T]):
    """Attribute that shows a raw field in SI units; in a report None stands for "not available".

    It stands in the text of a class; below, a property with its formula written out takes its place.
    """

    def __init__(self, field: str, *, report: bool) -> None:
        self._field = field
        self._report = report

    @overload
    def __get__(self, message: None, owner: type[Message]) -> Self: ...
    @overload
    def __get__(self, message: Message, owner: type[Message]) -> _T: ...
    def __get__(self, message: Message | None, owner: type[Message]) -> Any:
        return self

    def written_out(self, owner: type[Message]) -> property:
        """Give the property that takes its place: `None if m.angle == 32767 else radians(m.angle * 0.01)`."""
        signal = next(signal for signal in owner.SIGNALS if signal.name == self._field)
        none = f"None if m.{signal.name} == {signal.unavailable} else " if self._report else ""
        return property(_function("m", none + signal.si[0].format(f"m.{signal.name} * {signal.scale}")))


def _set(field: str) -> _Quantity[float]:
    return _Quantity(field, report=False)


def _read(field: str) -> "_Quantity[float | None]":
    return _Quantity(field, report=True)


class Estop(Message, frozen=True, gc=False):
    """Emergency stop: every node obeys it directly. Sent at once when it changes. Made with `Estop(...)`."""

    ID = 0x010
    NAME = "ESTOP"
    PERIOD_NS = 100_000_000
    SENDER = "SAFETY"
    SIGNALS = (*_flags(active=0), _choice("source", 1, 3, EstopSource), *_flags(latched=4))

    active: int = 0
    source: int = 0
    latched: int = 0


class SystemCmd(Message, frozen=True, gc=False):
    """What the host asks of the safety node, with the data cycle its commands come from."""

    ID = 0x040
    NAME = "SYSTEM_CMD"
    PERIOD_NS = 50_000_000
    SENDER = "HOST"
    SIGNALS = (
        *_flags(request_enable=0, clear_faults=1, clear_override=2, request_estop=3),
        _number("host_state", 4, 4),
        _number("cycle", 8, 32),
    )

    request_enable: int = 0
    clear_faults: int = 0
    clear_override: int = 0
    request_estop: int = 0
    host_state: int = 0
    cycle: int = 0

    @classmethod
    def of(
        cls,
        *,
        cycle: int,
        request_enable: bool = False,
        clear_faults: bool = False,
        clear_override: bool = False,
        request_estop: bool = False,
        host_state: int = 0,
    ) -> Self:
        """Make a message; the cycle wraps at 32 bits."""
        wrapped = cycle & 0xFFFFFFFF
        return cls._make(request_enable, clear_faults, clear_override, request_estop, host_state, wrapped)


class SystemRpt(Message, frozen=True, gc=False):
    """State of the cart as the safety node sees it. Made with `SystemRpt(...)`."""

    ID = 0x050
    NAME = "SYSTEM_RPT"
    PERIOD_NS = 50_000_000
    SENDER = "SAFETY"
    SIGNALS = (
        _choice("state", 0, 4, SystemState),
        *_flags(steer_enabled=4, brake_enabled=5, throttle_enabled=6, estop=7),
        *_flags(override_steer=8, override_brake=9, override_throttle=10),
        *_flags(host_timeout=11, bad_crc=12, bad_counter=13, low_battery=14, key_on=15),
        _number("fault_code", 16, 16),
        _number("cycle_echo", 32, 16),
    )

    state: int = 0
    steer_enabled: int = 0
    brake_enabled: int = 0
    throttle_enabled: int = 0
    estop: int = 0
    override_steer: int = 0
    override_brake: int = 0
    override_throttle: int = 0
    host_timeout: int = 0
    bad_crc: int = 0
    bad_counter: int = 0
    low_battery: int = 0
    key_on: int = 0
    fault_code: int = 0
    cycle_echo: int = 0
    """The lower 16 bits of the last `SystemCmd.cycle`."""


class SteerCmd(Message, frozen=True, gc=False):
    """Angle of the road wheels, left positive."""

    ID = 0x100
    NAME = "STEER_CMD"
    PERIOD_NS = 20_000_000
    SENDER = "HOST"
    SIGNALS = (
        _number("angle", 0, 16, scale=0.01, unit="deg", signed=True, limits=(-45.0, 45.0)),
        _number("rate_limit", 16, 16, scale=0.01, unit="deg/s"),
        *_flags(enable=32),
        _choice("mode", 33, 2, SteerMode),
    )

    angle: int = 0
    rate_limit: int = 0
    enable: int = 0
    mode: int = 0

    angle_rad = _set("angle")
    rate_limit_radps = _set("rate_limit")

    @classmethod
    def of(
        cls,
        *,
        angle_rad: float,
        rate_limit_radps: float = 0.0,
        enable: bool = False,
        mode: SteerMode = SteerMode.ANGLE,
    ) -> Self:
        """Make a message; a rate limit of 0 (or rounded to 0) leaves the limit to the node."""
        return cls._make(angle_rad, rate_limit_radps, enable, mode)


class BrakeCmd(Message, frozen=True, gc=False):
    """Brake effort, 0 released to 1 fully applied."""

    ID = 0x110
    NAME = "BRAKE_CMD"
    PERIOD_NS = 20_000_000
    SENDER = "HOST"
    SIGNALS = (
        _number("effort", 0, 16, scale=0.01, unit="%", limits=(0.0, 100.0)),
        _number("rate_limit", 16, 16, scale=0.1, unit="%/s"),
        *_flags(enable=32, park=33),
    )

    effort: int = 0
    rate_limit: int = 0
    enable: int = 0
    park: int = 0

    effort_ratio = _set("effort")
    rate_limit_per_s = _set("rate_limit")

    @classmethod
    def of(
        cls,
        *,
        effort_ratio: float,
        rate_limit_per_s: float = 0.0,
        enable: bool = False,
        park: bool = False,
    ) -> Self:
        """Make a message; a rate limit of 0 (or rounded to 0) leaves the limit to the node."""
        return cls._make(effort_ratio, rate_limit_per_s, enable, park)


VALUE_SCALE: Final = 0.01  # of a throttle command, in m/s or %
_PERCENT, _SPEED = int(ThrottleMode.PERCENT), int(ThrottleMode.SPEED)  # looked up once


class ThrottleCmd(Message, frozen=True, gc=False):
    """Throttle as a percentage or as a speed: `mode` says what `value` means."""

    ID = 0x120
    NAME = "THROTTLE_CMD"
    PERIOD_NS = 20_000_000
    SENDER = "HOST"
    SIGNALS = (
        _number("value", 0, 16, scale=VALUE_SCALE, signed=True),
        _number("accel_limit", 16, 16, scale=0.001, unit="m/s^2"),
        *_flags(enable=32),
        _choice("mode", 33, 2, ThrottleMode),
        _choice("direction", 35, 2, Direction),
    )

    value: int = 0
    accel_limit: int = 0
    enable: int = 0
    mode: int = 0
    direction: int = 0

    accel_limit_mps2 = _set("accel_limit")

    @property
    def speed_mps(self) -> float | None:
        """The commanded speed, None in the other modes."""
        return self.value * VALUE_SCALE if self.mode == _SPEED else None

    @property
    def percent_ratio(self) -> float | None:
        """The commanded throttle, 1 = 100 %, None in the other modes."""
        return self.value * VALUE_SCALE / 100.0 if self.mode == _PERCENT else None

    @classmethod
    def of_speed(
        cls,
        *,
        speed_mps: float,
        accel_limit_mps2: float = 0.0,
        enable: bool = False,
        direction: Direction = Direction.NEUTRAL,
    ) -> Self:
        """Make a command for a speed."""
        return cls._make(speed_mps, accel_limit_mps2, enable, _SPEED, direction)

    @classmethod
    def of_percent(
        cls,
        *,
        percent_ratio: float,
        accel_limit_mps2: float = 0.0,
        enable: bool = False,
        direction: Direction = Direction.NEUTRAL,
    ) -> Self:
        """Make a command for a throttle position, 1 = 100 %."""
        return cls._make(percent_ratio * 100.0, accel_limit_mps2, enable, _PERCENT, direction)


class SteerRpt(Message, frozen=True, gc=False):
    """State of the steering; angles are of the road wheels, left positive."""

    ID = 0x200
    NAME = "STEER_RPT"
    PERIOD_NS = 20_000_000
    SENDER = "STEER"
    SIGNALS = (
        _reading("angle", 0, 16, 0.01, "deg", signed=True),
        _reading("angle_cmd", 16, 16, 0.01, "deg", signed=True),
        _reading("driver_torque", 32, 8, 0.1, "Nm", signed=True),
        *_flags(enabled=40, override=41, timeout=42, fault=43),
        *_flags(limit_left=44, limit_right=45, homed=46, cmd_rejected=47),
    )

    angle: int = 0
    angle_cmd: int = 0
    driver_torque: int = 0
    enabled: int = 0
    override: int = 0
    timeout: int = 0
    fault: int = 0
    limit_left: int = 0
    limit_right: int = 0
    homed: int = 0
    cmd_rejected: int = 0

    angle_rad = _read("angle")
    angle_cmd_rad = _read("angle_cmd")
    driver_torque_nm = _read("driver_torque")

    @classmethod
    def of(
        cls,
        *,
        angle_rad: float | None,
        angle_cmd_rad: float | None = None,
        driver_torque_nm: float | None = None,
        enabled: bool = False,
        override: bool = False,
        timeout: bool = False,
        fault: bool = False,
        limit_left: bool = False,
        limit_right: bool = False,
        homed: bool = False,
        cmd_rejected: bool = False,
    ) -> Self:
        """Make a message; None says "not available"."""
        return cls._make(
            angle_rad, angle_cmd_rad, driver_torque_nm,
            enabled, override, timeout, fault, limit_left, limit_right, homed, cmd_rejected,
        )  # fmt: skip


class BrakeRpt(Message, frozen=True, gc=False):
    """State of the brake, and how far the driver presses its pedal."""

    ID = 0x210
    NAME = "BRAKE_RPT"
    PERIOD_NS = 20_000_000
    SENDER = "BRAKE"
    SIGNALS = (
        _reading("effort", 0, 16, 0.01, "%"),
        _reading("effort_cmd", 16, 16, 0.01, "%"),
        _reading("pedal", 32, 8, 0.5, "%"),
        *_flags(enabled=40, override=41, timeout=42, fault=43, park_set=44, cmd_rejected=47),
    )

    effort: int = 0
    effort_cmd: int = 0
    pedal: int = 0
    enabled: int = 0
    override: int = 0
    timeout: int = 0
    fault: int = 0
    park_set: int = 0
    cmd_rejected: int = 0

    effort_ratio = _read("effort")
    effort_cmd_ratio = _read("effort_cmd")
    pedal_ratio = _read("pedal")

    @classmethod
    def of(
        cls,
        *,
        effort_ratio: float | None,
        effort_cmd_ratio: float | None = None,
        pedal_ratio: float | None = None,
        enabled: bool = False,
        override: bool = False,
        timeout: bool = False,
        fault: bool = False,
        park_set: bool = False,
        cmd_rejected: bool = False,
    ) -> Self:
        """Make a message; None says "not available"."""
        return cls._make(
            effort_ratio, effort_cmd_ratio, pedal_ratio, enabled, override, timeout, fault, park_set, cmd_rejected
        )


class ThrottleRpt(Message, frozen=True, gc=False):
    """State of the drive, and how far the driver presses the throttle pedal."""

    ID = 0x220
    NAME = "THROTTLE_RPT"
    PERIOD_NS = 20_000_000
    SENDER = "DRIVE"
    SIGNALS = (
        _reading("output", 0, 16, 0.01, "%", signed=True),
        _reading("cmd", 16, 16, 0.01, "%", signed=True),
        _reading("pedal", 32, 8, 0.5, "%"),
        *_flags(enabled=40, override=41, timeout=42, fault=43),
        _choice("direction", 44, 2, Direction),
        *_flags(cmd_rejected=47),
    )

    output: int = 0
    cmd: int = 0
    pedal: int = 0
    enabled: int = 0
    override: int = 0
    timeout: int = 0
    fault: int = 0
    direction: int = 0
    cmd_rejected: int = 0

    output_ratio = _read("output")
    cmd_ratio = _read("cmd")
    pedal_ratio = _read("pedal")

    @classmethod
    def of(
        cls,
        *,
        output_ratio: float | None,
        cmd_ratio: float | None = None,
        pedal_ratio: float | None = None,
        enabled: bool = False,
        override: bool = False,
        timeout: bool = False,
        fault: bool = False,
        direction: Direction = Direction.NEUTRAL,
        cmd_rejected: bool = False,
    ) -> Self:
        """Make a message; None says "not available"."""
        return cls._make(
            output_ratio, cmd_ratio, pedal_ratio, enabled, override, timeout, fault, direction, cmd_rejected
        )


class WheelTicks(Message, frozen=True, gc=False):
    """Counts of the wheel sensors, free running and wrapping at 65,536, and the time since the last frame."""

    ID = 0x300
    NAME = "WHEEL_TICKS"
    PERIOD_NS = 20_000_000
    SENDER = "ODOM"
    SIGNALS = (
        _number("left", 0, 16),
        _number("right", 16, 16),
        _number("dt", 32, 12, scale=0.1, unit="ms"),
        *_flags(valid_left=44, valid_right=45, reverse=46),
    )

    left: int = 0
    right: int = 0
    dt: int = 0
    valid_left: int = 0
    valid_right: int = 0
    reverse: int = 0

    dt_s = _set("dt")

    @classmethod
    def of(
        cls,
        *,
        left: int,
        right: int,
        dt_s: float,
        valid_left: bool = True,
        valid_right: bool = True,
        reverse: bool = False,
    ) -> Self:
        """Make a message from counts that need not be wrapped yet; a longer `dt_s` than 0.4095 is clamped."""
        return cls._make(left & 0xFFFF, right & 0xFFFF, dt_s, valid_left, valid_right, reverse)


class PowerRpt(Message, frozen=True, gc=False):
    """State of the traction battery and motor."""

    ID = 0x310
    NAME = "POWER_RPT"
    PERIOD_NS = 500_000_000
    SENDER = "DRIVE"
    SIGNALS = (
        _reading("voltage", 0, 16, 0.01, "V"),
        _reading("current", 16, 16, 0.1, "A", signed=True),
        _reading("soc", 32, 8, 0.5, "%"),
        _reading("motor_temp", 40, 8, 1.0, "degC", signed=True),
    )

    voltage: int = 0
    current: int = 0
    soc: int = 0
    motor_temp: int = 0

    voltage_v = _read("voltage")
    current_a = _read("current")
    soc_ratio = _read("soc")
    motor_temp_degc = _read("motor_temp")

    @classmethod
    def of(
        cls,
        *,
        voltage_v: float | None,
        current_a: float | None = None,
        soc_ratio: float | None = None,
        motor_temp_degc: float | None = None,
    ) -> Self:
        """Make a message; None says "not available"."""
        return cls._make(voltage_v, current_a, soc_ratio, motor_temp_degc)


class NodeInfo(Message, frozen=True, gc=False):
    """Firmware and error of a node; each node sends its own. Made with `NodeInfo(...)`."""

    ID = 0x400
    NAME = "NODE_INFO"
    PERIOD_NS = 1_000_000_000
    SENDER = "ANY"
    SIGNALS = (
        _number("node", 0, 8),
        _number("fw_major", 8, 8),
        _number("fw_minor", 16, 8),
        _number("protocol", 24, 8),
        _number("error_code", 32, 16),
    )

    node: int = 0
    fw_major: int = 0
    fw_minor: int = 0
    protocol: int = 0
    error_code: int = 0


MESSAGES: Final[dict[int, type[Message]]] = {
    message.ID: message
    for message in (
        Estop,
        SystemCmd,
        SystemRpt,
        SteerCmd,
        BrakeCmd,
        ThrottleCmd,
        SteerRpt,
        BrakeRpt,
        ThrottleRpt,
        WheelTicks,
        PowerRpt,
        NodeInfo,
    )
}
"""Every message of the bus by its id."""


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc << 1) ^ 0x11D if crc & 0x80 else crc << 1
        table.append(crc)
    return tuple(table)


_CRC: Final = _crc_table()


def _crc_state(data: bytes) -> int:
    """Return the checksum's register after some bytes, not yet inverted."""
    crc = 0xFF
    for byte in data:
        crc = _CRC[crc ^ byte]
    return crc


def crc8(data: bytes) -> int:
    """Return the CRC-8 SAE J1850 of some bytes (polynomial 0x1D, start 0xFF, inverted at the end)."""
    return _crc_state(data) ^ 0xFF


def _refuse_raw(message: Message) -> NoReturn:
    for signal in message.SIGNALS:
        raw = getattr(message, signal.name)
        lowest = -(1 << (signal.length - 1)) if signal.signed else 0
        if not lowest <= raw <= signal.unavailable:
            raise FrameError(f"{message.NAME}.{signal.name}: raw {raw} came, expected {lowest}..{signal.unavailable}")
    raise AssertionError(f"{message!r} fits its frame")


def _refuse_crc(frame_id: int, data: bytes) -> NoReturn:
    expected = crc8(frame_id.to_bytes(2, "big") + data[:7])
    raise FrameError(f"{MESSAGES[frame_id].NAME} 0x{frame_id:03x}: crc 0x{data[7]:02x}, expected 0x{expected:02x}")


_Encoder = Callable[[Message, int], bytes]
_Decoder = Callable[[bytes], tuple[Message, int]]


def _compile(message: type[Message]) -> tuple[_Encoder, _Decoder]:
    """Write the shifts of one message as Python source, byte by byte: about eight times faster than a loop.

    For BRAKE_CMD the two functions read, without the checksum:

        def encode(message, counter):
            effort = message.effort; rate_limit = message.rate_limit; ...
            if (effort | rate_limit) >> 16 | (enable | park) >> 1: refuse_raw(message)
            b0 = effort & 255; b1 = effort >> 8 & 255; b2 = ...; b4 = enable & 255 | park << 1 & 255
            return bytes((b0, b1, b2, b3, b4, 0, counter & 15, crc))

        def decode(data):
            b0, b1, b2, b3, b4, b5, b6, b7 = data
            return Message((b0 | b1 << 8) & 65535, (b2 | b3 << 8) & 65535, b4 & 1, b4 >> 1 & 1), b6 & 15
    """
    fetch, unpacked = [], []
    packed: list[list[str]] = [[] for _ in range(6)]
    by_length: dict[int, list[str]] = {}
    for signal in message.SIGNALS:
        name, mask = signal.name, (1 << signal.length) - 1
        fetch.append(f"{name}_ = message.{name}")
        covered = range(signal.start // 8, (signal.start + signal.length - 1) // 8 + 1)
        for k in covered:
            shift = signal.start - 8 * k
            packed[k].append(f"{name}_ << {shift} & 255" if shift > 0 else f"{name}_ >> {-shift} & 255")
        joined = " | ".join(f"b{k} << {8 * (k - covered[0])}" if k > covered[0] else f"b{k}" for k in covered)
        bits = f"({joined}) >> {signal.start % 8} & {mask}"
        if signal.signed:
            half = 1 << (signal.length - 1)
            by_length.setdefault(signal.length, []).append(f"{name}_ + {half}")
            unpacked.append(f"(({bits}) ^ {half}) - {half}")
        else:
            by_length.setdefault(signal.length, []).append(f"{name}_")
            unpacked.append(bits)
    too_large = " | ".join(f"({' | '.join(names)}) >> {length}" for length, names in by_length.items())
    state = str(_crc_state(message.ID.to_bytes(2, "big")))
    for i in range(7):
        state = f"crc[{state} ^ b{i}]"
    source = f"""
def encode(message, counter):
    {"; ".join(fetch)}
    if {too_large}: refuse_raw(message)
    {"; ".join(f"b{k} = {' | '.join(terms) or '0'}" for k, terms in enumerate(packed))}
    b6 = counter & 15
    return bytes((b0, b1, b2, b3, b4, b5, b6, 255 ^ {state}))

def decode(data):
    b0, b1, b2, b3, b4, b5, b6, b7 = data
    if {state} ^ b7 != 255: refuse_crc({message.ID}, data)
    return Message({", ".join(unpacked)}), b6 & 15
"""
    source = source.replace(" >> 0", "").replace(" << 0", "")
    names: dict[str, Any] = {
        "Message": message,
        "bytes": bytes,
        "crc": _CRC,
        "refuse_crc": _refuse_crc,
        "refuse_raw": _refuse_raw,
    }
    exec(compile(source, f"<frame {message.NAME}>", "exec"), names)  # from the table above, nothing else
    return names["encode"], names["decode"]


def _compile_maker(message: type[Message]) -> Callable[..., Message]:
    """Write out, for one message, what each SI value becomes. For BRAKE_CMD the function reads:

        def make(effort, rate_limit, enable, park):
            try:
                if effort is None: effort_ = 65535
                else:
                    effort_ = round(((effort) * 100.0) / 0.01)
                    if effort_ < 0: effort_ = 0
                    elif effort_ > 10000: effort_ = 10000
                ...
            except (ValueError, OverflowError):
                return slowly(effort, rate_limit, enable, park)
            return Message(effort_, rate_limit_, 1 if enable else 0, 1 if park else 0)

    `slowly` says which value is not finite.
    """
    arguments = ", ".join(signal.name for signal in message.SIGNALS)
    body, made = [], []
    for signal in message.SIGNALS:
        name, raw = signal.name, f"{signal.name}_"
        if signal.length == 1:
            made.append(f"1 if {name} else 0")
            continue
        made.append(raw)
        rounded = f"round({signal.si[1].format(name)} / {signal.scale})"
        if signal.scale == 1.0 and signal.si is _AS_IT_IS:
            rounded = f"{name} if type({name}) is int else round({name})"
        body.append(f"""
        if {name} is None: {raw} = {signal.unavailable}
        else:
            {raw} = {rounded}
            if {raw} < {signal.raw_minimum}: {raw} = {signal.raw_minimum}
            elif {raw} > {signal.raw_maximum}: {raw} = {signal.raw_maximum}""")
    source = f"""
def make({arguments}):
    try:{"".join(body) or " pass"}
    except (ValueError, OverflowError):
        return slowly({arguments})
    return Message({", ".join(made)})
"""

    def slowly(*values: float | None) -> Message:
        pairs = zip(message.SIGNALS, values, strict=True)
        return message(*(signal.unavailable if v is None else signal.from_si(v) for signal, v in pairs))

    names: dict[str, Any] = {"Message": message, "slowly": slowly, **_MATH}
    exec(compile(source, f"<maker {message.NAME}>", "exec"), names)  # from the table above, nothing else
    return names["make"]  # type: ignore[no-any-return]


for _message in MESSAGES.values():
    setattr(_message, "_make", staticmethod(_compile_maker(_message)))  # noqa: B010 - a method takes its place
    for _name, _attribute in [*vars(_message).items()]:
        if isinstance(_attribute, _Quantity):
            setattr(_message, _name, _attribute.written_out(_message))
_COMPILED: Final = {message: _compile(message) for message in MESSAGES.values()}
_ENCODERS: Final = {message: pair[0] for message, pair in _COMPILED.items()}
_DECODERS: Final = {message.ID: pair[1] for message, pair in _COMPILED.items()}


def encode(message: Message, counter: int) -> bytes:
    """Return the 8 bytes of a message's frame; the counter wraps at 16. FrameError if a raw does not fit."""
    return _ENCODERS[message.__class__](message, counter)


def decode(frame_id: int, data: bytes) -> tuple[Message, int]:
    """Return message and counter of a frame. FrameError for an unknown id, a wrong length or checksum."""
    decoder = _DECODERS.get(frame_id)
    if decoder is None:
        raise FrameError(f"frame 0x{frame_id:03x}: unknown id, expected one of {_known_ids()}")
    if len(data) != 8:
        raise FrameError(f"{MESSAGES[frame_id].NAME} 0x{frame_id:03x}: {len(data)} bytes, expected 8")
    return decoder(data)


def _known_ids() -> str:
    return " ".join(f"0x{frame_id:03x}" for frame_id in MESSAGES)


_CANDUMP: Final = re.compile(
    r"\((?P<s>\d+)\.(?P<fraction>\d{6}|\d{9})\) (?P<channel>\S+) "
    r"(?P<id>[0-7][0-9A-Fa-f]{2})#(?P<data>(?:[0-9A-Fa-f]{2}){0,8})(?: [RT])?",
    re.ASCII,
)


def to_candump(t_ns: int, frame_id: int, data: bytes, channel: str = "can0") -> str:
    """Return a line of a candump log, without line end; times are cut to microseconds."""
    if t_ns < 0 or not 0 <= frame_id <= 0x7FF or len(data) > 8:
        raise FrameError(
            f"candump: t_ns {t_ns}, id 0x{frame_id:x}, {len(data)} bytes; "
            "expected a time since 1970, an 11-bit id and at most 8 bytes"
        )
    s, us = divmod(t_ns // 1000, 1_000_000)
    return f"({s}.{us:06d}) {channel} {frame_id:03X}#{data.hex().upper()}"


def from_candump(line: str) -> tuple[int, int, bytes]:
    """Return time in nanoseconds, id and data of a line of a candump log. FrameError for anything else."""
    match = _CANDUMP.fullmatch(line.rstrip("\r\n"))
    if match is None:
        raise FrameError(f"candump: {line!r}, expected like '(1700000000.020000) can0 100#2EFBAE1505000905'")
    t_ns = int(match["s"]) * 1_000_000_000 + int(match["fraction"].ljust(9, "0"))
    return t_ns, int(match["id"], 16), bytes.fromhex(match["data"])
