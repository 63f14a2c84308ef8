"""The bus: both levels deliver the same, filters and faults do what they say, damage is counted."""

from dataclasses import replace

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.bus import CanBus, CanPort, Frame, Level, Received
from hal.codecs.cartcan import BrakeCmd, Estop, Message, SteerCmd, SystemCmd, WheelTicks, encode
from hal.errors import ProfileError
from hal.faults import HostSilence

LEVELS: tuple[Level, ...] = ("direct", "wire")
KINDS: tuple[type[Message], ...] = (Estop, SystemCmd, SteerCmd, BrakeCmd, WheelTicks)

messages = st.one_of(
    st.builds(SteerCmd.of, angle_rad=st.floats(-1.0, 1.0), enable=st.booleans()),
    st.builds(BrakeCmd.of, effort_ratio=st.floats(0.0, 1.0), enable=st.booleans()),
    st.builds(SystemCmd.of, cycle=st.integers(0, 2**33), request_enable=st.booleans()),
    st.builds(WheelTicks.of, left=st.integers(-5, 70_000), right=st.integers(-5, 70_000), dt_s=st.just(0.02)),
)


def flip(bit: int, frame: Frame) -> Frame:
    assert isinstance(frame.data, bytes)
    data = bytearray(frame.data)
    data[bit // 8] ^= 1 << bit % 8
    return msgspec.structs.replace(frame, data=bytes(data))


def carried(level: Level, sent: list[tuple[int, Message]]) -> tuple[list[Received], list[Received]]:
    """What two listeners hear of messages sent by three nodes."""
    bus = CanBus(level)
    senders = [bus.port(name, []) for name in ("A", "B", "C")]
    all_ears, some = bus.port("ALL", KINDS), bus.port("SOME", [SteerCmd, WheelTicks])
    for k, (sender, message) in enumerate(sent):
        senders[sender].send(message, 1_000 * k)
    return all_ears.receive(), some.receive()


@given(st.lists(st.tuples(st.integers(0, 2), messages), max_size=60))
def test_wire_and_direct_deliver_the_same_messages_in_the_same_order(sent: list[tuple[int, Message]]) -> None:
    direct, wire = carried("direct", sent), carried("wire", sent)
    assert direct == wire
    assert [r.message for r in wire[0]] == [message for _, message in sent]
    assert [r.t_ns for r in wire[0]] == [1_000 * k for k in range(len(sent))]


@pytest.mark.parametrize("level", LEVELS)
def test_a_port_hears_only_what_its_filter_accepts_and_never_itself(level: Level) -> None:
    bus = CanBus(level)
    steer, brake, deaf = bus.port("STEER", [SteerCmd]), bus.port("BRAKE", [BrakeCmd, SteerCmd]), bus.port("DEAF", [])
    steer.send(SteerCmd.of(angle_rad=0.1), 1)
    brake.send(BrakeCmd.of(effort_ratio=0.2), 2)
    assert steer.receive() == []
    assert [r.frame_id for r in brake.receive()] == [SteerCmd.ID]
    assert deaf.receive() == []
    assert bus.frames == 2


@pytest.mark.parametrize("level", LEVELS)
def test_a_port_that_connects_late_hears_what_is_sent_from_then_on(level: Level) -> None:
    bus = CanBus(level)
    host, early = bus.port("HOST", []), bus.port("EARLY", [SteerCmd])
    host.send(SteerCmd.of(angle_rad=0.1), 1)
    late = bus.port("LATE", [SteerCmd])
    host.send(SteerCmd.of(angle_rad=0.2), 2)
    assert [r.t_ns for r in early.receive()] == [1, 2]
    assert [r.t_ns for r in late.receive()] == [2]


@pytest.mark.parametrize("level", LEVELS)
def test_counters_run_per_id_and_sender_and_wrap_after_15(level: Level) -> None:
    bus = CanBus(level)
    ear, a, b = bus.port("EAR", [SteerCmd, BrakeCmd]), bus.port("A", []), bus.port("B", [])
    for k in range(18):
        a.send(SteerCmd(), k)
        if k % 2:
            a.send(BrakeCmd(), k)
        if k % 3 == 0:
            b.send(SteerCmd(), 1_000 + k)
    heard = ear.receive()
    assert [r.counter for r in heard if r.frame_id == SteerCmd.ID and r.t_ns < 1_000] == [*range(16), 0, 1]
    assert [r.counter for r in heard if r.frame_id == BrakeCmd.ID] == list(range(9))
    assert [r.counter for r in heard if r.t_ns >= 1_000] == list(range(6))


@pytest.mark.parametrize("level", LEVELS)
def test_what_was_received_once_is_not_received_again(level: Level) -> None:
    bus = CanBus(level)
    ear, host = bus.port("EAR", [SteerCmd]), bus.port("HOST", [])
    host.send(SteerCmd(), 1)
    assert len(ear.receive()) == 1
    assert ear.receive() == []


@pytest.mark.parametrize("bit", range(64))
def test_a_frame_with_one_flipped_bit_arrives_as_nothing_and_is_counted_at_every_port(bit: int) -> None:
    bus = CanBus("wire")
    ears: list[CanPort] = [bus.port("EAR", [SteerCmd]), bus.port("EAR2", [SteerCmd])]
    host = bus.port("HOST", [])
    bus.faults.append(lambda frame: flip(bit, frame) if frame.t_ns == 2 else frame)
    for t_ns in (1, 2, 3):
        host.send(SteerCmd.of(angle_rad=0.3, enable=True), t_ns)
    for ear in ears:
        heard = ear.receive()
        assert [r.message is None for r in heard] == [False, True, False]
        assert (heard[1].t_ns, heard[1].frame_id) == (2, SteerCmd.ID)
        assert heard[2].counter == 2
        assert ear.damaged == 1


@pytest.mark.parametrize("data", [b"", bytes(7), bytes(9)])
def test_a_frame_of_another_length_is_refused_and_counted(data: bytes) -> None:
    bus = CanBus("wire")
    ear = bus.port("EAR", [SteerCmd])
    bus.carry(Frame(1, "HOST", SteerCmd.ID, data, 0))
    assert [r.message for r in ear.receive()] == [None]
    assert ear.damaged == 1


def test_a_frame_under_another_id_is_refused_by_its_checksum() -> None:
    bus = CanBus("wire")
    ear = bus.port("EAR", [BrakeCmd])
    bus.carry(Frame(1, "HOST", BrakeCmd.ID, encode(SteerCmd.of(angle_rad=0.3), 0), 0))
    assert [r.message for r in ear.receive()] == [None]


@pytest.mark.parametrize("level", LEVELS)
def test_a_fault_can_swallow_frames_and_the_counters_show_the_gap(level: Level) -> None:
    bus = CanBus(level)
    ear, host = bus.port("EAR", [SteerCmd]), bus.port("HOST", [])
    bus.faults.append(lambda frame: None if 2 <= frame.t_ns <= 4 else frame)
    for t_ns in range(1, 7):
        host.send(SteerCmd(), t_ns)
    assert [(r.t_ns, r.counter) for r in ear.receive()] == [(1, 0), (5, 4), (6, 5)]


@pytest.mark.parametrize("level", LEVELS)
def test_faults_act_one_after_the_other(level: Level) -> None:
    bus = CanBus(level)
    ear, host = bus.port("EAR", [SteerCmd]), bus.port("HOST", [])
    seen: list[int] = []
    bus.faults.append(lambda frame: None if frame.t_ns == 1 else frame)
    bus.faults.append(lambda frame: (seen.append(frame.t_ns), frame)[1])
    for t_ns in (1, 2):
        host.send(SteerCmd(), t_ns)
    assert seen == [2]
    assert [r.t_ns for r in ear.receive()] == [2]


@pytest.mark.parametrize("level", LEVELS)
def test_host_silence_swallows_the_host_alone_from_its_time_on(level: Level) -> None:
    bus = CanBus(level)
    ear = bus.port("EAR", [SteerCmd, WheelTicks])
    host, odometer = bus.port("HOST", []), bus.port("ODOM", [])
    bus.faults.append(replace(HostSilence(0), from_ns=2))
    for t_ns in (1, 2, 3):
        host.send(SteerCmd(), t_ns)
        odometer.send(WheelTicks(), t_ns)
    heard = [(r.t_ns, r.frame_id) for r in ear.receive()]
    assert heard == [(1, SteerCmd.ID), *((t_ns, WheelTicks.ID) for t_ns in (1, 2, 3))]


def test_an_unknown_level_is_refused_by_name() -> None:
    with pytest.raises(ProfileError, match="'wired' is not one of direct, wire"):
        CanBus("wired")  # type: ignore[arg-type]
