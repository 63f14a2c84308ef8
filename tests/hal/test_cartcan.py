"""The cart's CAN frames against the DBC, with cantools as the second opinion."""

import math
from pathlib import Path
from typing import Any

import cantools
import pytest
from cantools.database.can import Database
from hypothesis import given
from hypothesis import strategies as st

from hal.codecs import cartcan
from hal.codecs.cartcan import (
    MESSAGES,
    BrakeCmd,
    BrakeRpt,
    Direction,
    FrameError,
    Message,
    NodeInfo,
    PowerRpt,
    Signal,
    SteerCmd,
    SteerMode,
    SteerRpt,
    SystemCmd,
    SystemRpt,
    SystemState,
    ThrottleCmd,
    WheelTicks,
    crc8,
    decode,
    encode,
    from_candump,
    to_candump,
)

KNOWN = bytes.fromhex("2EFBAE1505000905")


@pytest.fixture(scope="module")
def dbc() -> Database:
    path = Path(cartcan.__file__).with_name("cart.dbc")
    database = cantools.database.load_file(path, strict=True)
    assert isinstance(database, Database)
    return database


def raw_values(signal: Signal) -> st.SearchStrategy[int]:
    lowest = -(1 << (signal.length - 1)) if signal.signed else 0
    return st.integers(lowest, signal.unavailable)


messages = st.sampled_from(list(MESSAGES.values())).flatmap(
    lambda message: st.builds(message, **{s.name: raw_values(s) for s in message.SIGNALS})
)
counters = st.integers(0, 15)


def fields(message: Message) -> dict[str, Any]:
    return {signal.name: getattr(message, signal.name) for signal in message.SIGNALS}


def test_dbc_and_table_name_the_same_messages(dbc: Database) -> None:
    nodes = {node.name for node in dbc.nodes}
    assert {m.frame_id: m.name for m in dbc.messages} == {i: m.NAME for i, m in MESSAGES.items()}
    for frame_id, message in MESSAGES.items():
        other = dbc.get_message_by_frame_id(frame_id)
        assert other.length == 8
        assert other.cycle_time is not None
        assert other.cycle_time * 1_000_000 == message.PERIOD_NS
        senders = set(other.senders) - {"Vector__XXX"}  # how a DBC says "nobody in particular"
        assert senders == (nodes - {"HOST"} if message.SENDER == "ANY" else {message.SENDER})


@pytest.mark.parametrize("message", MESSAGES.values(), ids=lambda m: m.NAME)
def test_dbc_and_table_agree_on_every_signal(dbc: Database, message: type[Message]) -> None:
    others = {s.name: s for s in dbc.get_message_by_frame_id(message.ID).signals}
    counter, crc = others.pop("counter"), others.pop("crc")
    assert (counter.start, counter.length, crc.start, crc.length) == (48, 4, 56, 8)
    assert set(others) == {s.name for s in message.SIGNALS}
    for signal in message.SIGNALS:
        other = others[signal.name]
        assert other.byte_order == "little_endian"
        assert other.offset == 0
        assert (other.start, other.length, other.is_signed, other.scale) == (
            signal.start,
            signal.length,
            signal.signed,
            signal.scale,
        )
        assert (other.minimum, other.maximum, other.unit or "") == (
            signal.minimum,
            signal.maximum,
            signal.unit,
        )
        choices = {c.value: c.name.lower() for c in signal.choices} if signal.choices else None
        assert (other.choices and {k: str(v) for k, v in other.choices.items()}) == choices


@pytest.mark.parametrize("message", MESSAGES.values(), ids=lambda m: m.NAME)
def test_fields_stand_in_the_order_of_the_table_and_start_at_zero(message: type[Message]) -> None:
    assert message.__struct_fields__ == tuple(s.name for s in message.SIGNALS)
    assert set(fields(message()).values()) == {0}


@given(message=messages, counter=counters)
def test_cantools_encodes_the_same_bytes(dbc: Database, message: Message, counter: int) -> None:
    data = encode(message, counter)
    values = fields(message) | {"counter": counter, "crc": data[7]}
    other = dbc.get_message_by_frame_id(message.ID)
    assert other.encode(values, scaling=False, strict=False) == data
    assert other.decode(data, decode_choices=False, scaling=False) == values
    assert decode(message.ID, data) == (message, counter)


def test_known_frame() -> None:
    command = SteerCmd.of(
        angle_rad=math.radians(-12.34),
        rate_limit_radps=math.radians(55.50),
        enable=True,
        mode=SteerMode.ANGLE,
    )
    assert command == SteerCmd(angle=-1234, rate_limit=5550, enable=1, mode=2)
    assert encode(command, 9) == KNOWN
    assert decode(0x100, KNOWN) == (command, 9)
    assert command.angle_rad == pytest.approx(math.radians(-12.34))


def test_crc_gives_the_check_values_of_sae_j1850() -> None:
    assert crc8(b"123456789") == 0x4B
    assert crc8(b"0") == 0x71
    assert crc8(bytes(2)) == 0xBE


def test_half_steps_of_the_steering_angle_go_to_the_even_neighbour_as_in_cantools(dbc: Database) -> None:
    other = dbc.get_message_by_name("STEER_CMD")
    angle = SteerCmd.SIGNALS[0]
    rest = {"rate_limit": 0, "enable": 0, "mode": 0, "counter": 0, "crc": 0}
    points = [(step + 0.5) * 0.01 for step in range(-4500, 4500)]
    assert len(points) == 9000
    for value in points:
        data = other.encode(rest | {"angle": value})
        assert angle.quantise(value) == int.from_bytes(data[:2], "little", signed=True)


@given(message=messages, value=st.floats(-1e6, 1e6))
def test_quantising_twice_changes_nothing(message: Message, value: float) -> None:
    for signal in message.SIGNALS:
        raw = signal.quantise(value)
        assert signal.raw_minimum <= raw <= signal.raw_maximum
        assert signal.quantise(signal.value(raw)) == raw
        assert signal.from_si(signal.to_si(raw)) == raw


@pytest.mark.parametrize("message", MESSAGES.values(), ids=lambda m: m.NAME)
def test_every_raw_value_survives_the_way_to_si_and_back(message: type[Message]) -> None:
    for signal in message.SIGNALS:
        if signal.length <= 16:
            for raw in range(signal.raw_minimum, signal.raw_maximum + 1):
                assert signal.from_si(signal.to_si(raw)) == raw


def test_values_outside_the_range_are_clamped() -> None:
    assert SteerCmd.of(angle_rad=2.0).angle == 4500
    assert SteerCmd.of(angle_rad=-2.0).angle == -4500
    assert BrakeCmd.of(effort_ratio=1.5).effort == 10_000
    assert BrakeCmd.of(effort_ratio=-0.5).effort == 0
    assert BrakeRpt.of(effort_ratio=0.5, pedal_ratio=9.0).pedal == 254


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_value_that_is_no_number_is_refused(value: float) -> None:
    with pytest.raises(FrameError, match="angle"):
        SteerCmd.of(angle_rad=value)


def test_the_largest_code_of_a_report_means_not_available() -> None:
    report = SteerRpt.of(angle_rad=None, angle_cmd_rad=1.0)
    assert report.angle == 32767
    assert report.angle_rad is None
    assert report.angle_cmd_rad == pytest.approx(1.0, abs=1e-4)
    assert report.driver_torque_nm is None
    power = PowerRpt.of(voltage_v=48.2, soc_ratio=0.755)
    assert power.voltage_v == pytest.approx(48.2)
    assert power.soc_ratio == pytest.approx(0.755)
    assert power.current_a is None
    assert power.motor_temp_degc is None
    assert PowerRpt.of(voltage_v=1e9).voltage_v == pytest.approx(655.34)


def test_a_measured_value_never_becomes_not_available() -> None:
    for message in (SteerRpt, BrakeRpt, PowerRpt):
        for signal in message.SIGNALS:
            if signal.unit:
                assert signal.quantise(1e12) == signal.unavailable - 1


def test_the_mode_of_a_throttle_command_says_what_its_value_means() -> None:
    speed = ThrottleCmd.of_speed(speed_mps=2.5, accel_limit_mps2=0.8, direction=Direction.FORWARD)
    assert (speed.value, speed.speed_mps, speed.percent_ratio) == (250, 2.5, None)
    assert speed.accel_limit_mps2 == pytest.approx(0.8)
    percent = ThrottleCmd.of_percent(percent_ratio=0.3)
    assert (percent.value, percent.speed_mps, percent.percent_ratio) == (3000, None, 0.3)
    assert ThrottleCmd(value=100).speed_mps is None


def test_counts_wrap() -> None:
    assert SystemCmd.of(cycle=2**32 + 5, request_enable=True) == SystemCmd(request_enable=1, cycle=5)
    ticks = WheelTicks.of(left=65_536 + 7, right=-1, dt_s=0.02)
    assert (ticks.left, ticks.right, ticks.dt_s) == (7, 65_535, 0.02)


@given(message=messages, counter=counters)
def test_every_flipped_bit_is_noticed(message: Message, counter: int) -> None:
    frame = int.from_bytes(encode(message, counter), "little")
    for bit in range(64):
        with pytest.raises(FrameError, match="crc"):
            decode(message.ID, (frame ^ 1 << bit).to_bytes(8, "little"))


def test_a_frame_under_another_id_is_refused() -> None:
    with pytest.raises(FrameError, match=r"BRAKE_CMD 0x110: crc 0x05"):
        decode(0x110, KNOWN)


@pytest.mark.parametrize("length", [0, 1, 7, 9])
def test_wrong_length_is_refused(length: int) -> None:
    with pytest.raises(FrameError, match=f"{length} bytes, expected 8"):
        decode(0x100, bytes(length))


def test_unknown_id_is_refused() -> None:
    with pytest.raises(FrameError, match="0x123: unknown id"):
        decode(0x123, KNOWN)


@pytest.mark.parametrize(
    "message", [SteerCmd(angle=40_000), SteerCmd(angle=-32_769), BrakeCmd(effort=-1), NodeInfo(node=256)]
)
def test_a_raw_value_that_does_not_fit_is_refused(message: Message) -> None:
    with pytest.raises(FrameError, match=rf"{message.NAME}\.\w+: raw"):
        encode(message, 0)


def test_counter_wraps_at_sixteen() -> None:
    assert encode(SteerCmd(), 16) == encode(SteerCmd(), 0)


def test_states_can_be_compared_with_their_names() -> None:
    report, _ = decode(0x050, encode(SystemRpt(state=SystemState.ENABLED, key_on=True), 0))
    assert report == SystemRpt(state=3, key_on=1)
    assert isinstance(report, SystemRpt)
    assert report.state == SystemState.ENABLED


def test_candump_line() -> None:
    line = "(1700000000.020000) can0 100#2EFBAE1505000905"
    assert to_candump(1_700_000_000_020_000_000, 0x100, KNOWN) == line
    assert from_candump(line) == (1_700_000_000_020_000_000, 0x100, KNOWN)
    assert from_candump(line + "\r\n") == from_candump(line)
    assert from_candump(line + " R") == from_candump(line)


@given(t_us=st.integers(0, 2**52), frame_id=st.integers(0, 0x7FF), data=st.binary(max_size=8))
def test_candump_round_trip(t_us: int, frame_id: int, data: bytes) -> None:
    line = to_candump(t_us * 1000 + 999, frame_id, data)
    assert from_candump(line) == (t_us * 1000, frame_id, data)
    assert to_candump(*from_candump(line)) == line


@pytest.mark.parametrize(
    "line",
    [
        "",
        "100#2EFB",
        "(1700000000.02) can0 100#2EFB",
        "(1700000000.020000) can0 900#2EFB",
        "(1700000000.020000) can0 100#2EF",
        "(1700000000.020000) can0 00000100#2EFB",
        "(1700000000.020000) can0 100#2EFBAE150500090500",
        "(1700000000.020000) can0 100#R",
    ],
)
def test_other_lines_are_no_candump_lines(line: str) -> None:
    with pytest.raises(FrameError, match="candump"):
        from_candump(line)


def test_what_cannot_stand_in_a_candump_line_is_refused() -> None:
    for t_ns, frame_id, data in [(-1, 0, b""), (0, 0x800, b""), (0, 0, bytes(9))]:
        with pytest.raises(FrameError, match="candump"):
            to_candump(t_ns, frame_id, data)
