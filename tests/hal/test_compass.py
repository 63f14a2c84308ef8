"""The compass: what the model says and when, what the driver makes of it, both levels against each other."""

import math
import pickle
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.codecs.nmea import (
    COMPASS_SENTENCES,
    Gga,
    Hdg,
    Hdm,
    Hdt,
    Hpr,
    Ohpr,
    Os5000,
    Rmc,
    Sentence,
    SentenceError,
    Splitter,
    format,
    frame,
    parse,
)
from hal.devices.compass import Compass
from hal.drivers.compass import CompassDriver
from hal.signals import CompassHeading, LinkCounters, wrap

MS = 1_000_000
TICK_NS = 10 * MS
WEST_RAD = math.radians(-4.71)
"""Declination at Bloomington: magnetic north is 4.71 degrees west of true north."""
Level = Literal["wire", "direct"]
SETUPS: list[dict[str, Any]] = [
    {},
    {"sentences": ("HDG",)},
    {"sentences": ("HDG",), "variation_rad": WEST_RAD},
    {"sentences": ("HDT",), "variation_rad": WEST_RAD},
    {"sentences": ("HPR", "HDG", "HDT"), "variation_rad": WEST_RAD, "baud": 57_600},
    {"personality": "os5000"},
    {"personality": "os5000", "sentences": ("OHPR",)},
    {"personality": "os5000", "sentences": ("HDT",), "variation_rad": WEST_RAD},
    {"period_ns": 50 * MS, "t0_ns": 30 * MS},
    {"period_ns": 20 * MS, "latency_ns": 60 * MS},
]


def wire(compass: Compass, t_ns: int) -> bytes:
    said = compass.poll(t_ns)
    assert isinstance(said, bytes)
    return said


def lines_of(heading_deg: float, pitch_deg: float = 0.0, roll_deg: float = 0.0, **given: Any) -> bytes:
    alarm = given.pop("alarm", False)
    compass = Compass(**given)
    compass.measure(0, math.radians(heading_deg), math.radians(pitch_deg), math.radians(roll_deg), alarm=alarm)
    return wire(compass, 20 * MS)


def reading_of(sentence: Sentence, declination_rad: float = WEST_RAD) -> CompassHeading:
    driver = CompassDriver(declination_rad)
    driver.hear(sentence, 0)
    [(reading, _)] = driver.poll(0)
    return reading


def heading_deg(reading: CompassHeading) -> float:
    """True heading of a reading, by hand."""
    return (90.0 - math.degrees(reading.yaw_rad)) % 360.0


# ---- what the model says -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "lines"),
    [
        ({}, [frame("PTNTHPR,320.5,N,0.2,N,-18.3,N")]),
        ({"alarm": True}, [frame("PTNTHPR,,P,0.2,N,-18.3,N")]),
        ({"sentences": ("HDG",)}, [frame("HCHDG,320.5,,,,")]),
        ({"sentences": ("HDG",), "variation_rad": WEST_RAD, "alarm": True}, [frame("HCHDG,,,,4.7,W")]),
        ({"sentences": ("HDT",), "variation_rad": WEST_RAD}, [frame("HCHDT,315.8,T")]),
        ({"sentences": ("HDT",), "variation_rad": WEST_RAD, "alarm": True}, [frame("HCHDT,,T")]),
        ({"personality": "os5000"}, [frame("C320.5P0.2R-18.3T20.0")]),
        ({"personality": "os5000", "alarm": True}, [frame("C320.5P0.2R-18.3T20.0")]),
        ({"personality": "os5000", "sentences": ("OHPR",)}, [frame("OHPR,320.5,0.2,-18.3,20.0")]),
        (
            {"personality": "os5000", "sentences": ("HDT",), "variation_rad": WEST_RAD, "alarm": True},
            [frame("HCHDT,315.8,T")],
        ),
        (
            {"sentences": ("HDG", "HPR"), "baud": 38_400},
            [frame("HCHDG,320.5,,,,"), frame("PTNTHPR,320.5,N,0.2,N,-18.3,N")],
        ),
    ],
)
def test_each_personality_says_what_was_measured(given: dict[str, Any], lines: list[bytes]) -> None:
    assert lines_of(320.5, 0.2, -18.3, **given) == b"".join(lines)


@pytest.mark.parametrize(
    ("turned_deg", "text"), [(-0.04, b"0.0"), (359.97, b"0.0"), (725.0, b"5.0"), (-90.0, b"270.0")]
)
def test_headings_are_said_from_0_to_below_360(turned_deg: float, text: bytes) -> None:
    assert lines_of(turned_deg).startswith(b"$PTNTHPR," + text + b",N,")


def test_the_sentence_ends_20_ms_after_the_measurement_at_the_baud_rate() -> None:
    """36 bytes at 19,200 baud take 18.75 ms: the first has left 1.77 ms after the measurement."""
    compass = Compass()
    compass.measure(100 * MS, math.radians(123.4), math.radians(-1.0), math.radians(10.0))
    whole = frame("PTNTHPR,123.4,N,-1.0,N,10.0,N")
    byte_ns = 10_000_000_000 // 19_200
    left = b""
    for t_ns in range(100 * MS, 120 * MS + 1, 50_000):
        left += wire(compass, t_ns)
        assert left == whole[: len(left)]
        assert abs((120 * MS - t_ns) - (len(whole) - len(left)) * byte_ns) <= byte_ns or not left
        assert (t_ns == 120 * MS) == (left == whole)


@pytest.mark.parametrize("given", SETUPS)
@pytest.mark.parametrize("step_ns", [TICK_NS, MS])
def test_direct_gives_each_sentence_at_the_poll_at_which_the_wire_completes_its_line(
    given: dict[str, Any], step_ns: int
) -> None:
    on_wire, direct = Compass(**given), Compass(**given, level="direct")
    splitter = Splitter()
    heard = 0
    for t_ns in range(0, 500 * MS, step_ns):
        for compass in (on_wire, direct):
            if compass.due(t_ns):
                compass.measure(t_ns, t_ns * 1.7e-8, 0.3, t_ns * -1e-9)
        complete = [parse(line) for line in splitter.feed(wire(on_wire, t_ns))]
        assert direct.poll(t_ns) == complete
        heard += len(complete)
    assert heard >= 5


def test_measurements_are_due_at_multiples_of_the_period_from_the_origin() -> None:
    compass = Compass(t0_ns=30 * MS)
    assert [t_ms for t_ms in range(0, 500, 10) if compass.due(t_ms * MS)] == [30, 130, 230, 330, 430]
    with pytest.raises(ValueError, match="expected a multiple"):
        compass.measure(40 * MS, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    "given",
    [
        {"personality": "kvh"},
        {"sentences": ("C",)},
        {"sentences": ()},
        {"personality": "os5000", "sentences": ("HPR",)},
        {"sentences": ("HDT",)},
        {"level": "os"},
        {"baud": 0},
        {"period_ns": 0},
        {"baud": 9_600},
        {"latency_ns": 10 * MS},
        {"sentences": ("HPR", "HDG")},
    ],
)
def test_senseless_parameters_are_refused(given: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="expected"):
        Compass(**given)


@pytest.mark.parametrize("level", ["wire", "direct"])
def test_a_silent_compass_sends_nothing_and_starts_with_a_whole_sentence(level: Level) -> None:
    compass, driver = Compass(level=level), CompassDriver(0.0)
    measured = []
    for t_ns in range(0, 1000 * MS, TICK_NS):
        compass.silent = 220 * MS <= t_ns < 450 * MS  # from the middle of the third sentence on
        if compass.due(t_ns):
            compass.measure(t_ns, 1.0, 0.0, 0.0)
        carry(compass, driver, t_ns)
        measured += [t // MS for _, t in driver.poll(t_ns)]
    assert measured == [0, 100, 500, 600, 700, 800, 900]
    assert driver.counters == LinkCounters(received=7, damaged=1 if level == "wire" else 0)


# ---- what the driver makes of it ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sentence", "true_deg"),
    [
        (Hdt(heading_deg=100.0), 100.0),
        (Hdt(talker="HE", heading_deg=100.0), 100.0),
        (Hdm(heading_deg=100.0), 95.29),
        (Hdg(heading_deg=100.0), 95.29),
        (Hdg(heading_deg=100.0, variation_deg=3.0), 103.0),
        (Hdg(heading_deg=100.0, variation_deg=0.0), 100.0),
        (Hdg(heading_deg=100.0, deviation_deg=-2.0), 93.29),
        (Hdg(heading_deg=100.0, deviation_deg=-2.0, variation_deg=3.0), 101.0),
        (Hpr(heading_deg=100.0, heading_status="N", pitch_status="N", roll_status="N"), 95.29),
        (Os5000(heading_deg=100.0), 95.29),
        (Ohpr(heading_deg=100.0), 95.29),
        (Hdm(heading_deg=2.0), 357.29),
    ],
)
def test_declination_is_added_where_the_sentence_is_magnetic(sentence: Sentence, true_deg: float) -> None:
    reading = reading_of(sentence)
    assert reading.valid
    assert heading_deg(reading) == pytest.approx(true_deg, abs=1e-9)


def test_yaw_is_counter_clockwise_from_east() -> None:
    for heading, yaw in [(0.0, 90.0), (90.0, 0.0), (180.0, -90.0), (270.0, 180.0)]:
        assert math.degrees(reading_of(Hdt(heading_deg=heading)).yaw_rad) == pytest.approx(yaw)


@pytest.mark.parametrize(
    "sentence",
    [
        Hpr(heading_deg=1.0, pitch_deg=2.0, roll_deg=-3.0, heading_status="N", pitch_status="N", roll_status="N"),
        Ohpr(heading_deg=1.0, pitch_deg=2.0, roll_deg=-3.0),
        Os5000(heading_deg=1.0, pitch_deg=2.0, roll_deg=-3.0),
    ],
)
def test_pitch_and_roll_are_passed_on_in_radians(sentence: Sentence) -> None:
    reading = reading_of(sentence)
    assert (reading.pitch_rad, reading.roll_rad) == (math.radians(2.0), math.radians(-3.0))
    assert reading.valid


@pytest.mark.parametrize("place", ["heading_status", "pitch_status", "roll_status"])
@pytest.mark.parametrize(
    ("letter", "valid"),
    [("N", True), ("M", True), ("O", True), ("L", False), ("P", False), ("C", False), ("V", False), (None, False)],
)
def test_warnings_leave_the_heading_valid_and_alarms_do_not(place: str, letter: str | None, valid: bool) -> None:
    statuses = {"heading_status": "N", "pitch_status": "N", "roll_status": "N"} | {place: letter}
    assert reading_of(Hpr(heading_deg=10.0, pitch_deg=0.0, roll_deg=0.0, **statuses)).valid == valid  # type: ignore[arg-type]


@pytest.mark.parametrize("sentence", COMPASS_SENTENCES)
def test_without_a_heading_the_reading_is_invalid(sentence: type[Sentence]) -> None:
    reading = reading_of(sentence())
    assert not reading.valid
    assert reading.yaw_rad == 0.0


def test_an_alarm_of_the_model_arrives_as_an_invalid_reading_with_pitch_and_roll() -> None:
    driver = CompassDriver(WEST_RAD)
    driver.feed(lines_of(100.0, 2.0, -3.0, alarm=True), 20 * MS)
    [(reading, t_data_ns)] = driver.poll(20 * MS)
    assert reading == CompassHeading(pitch_rad=math.radians(2.0), roll_rad=math.radians(-3.0), valid=False)
    assert t_data_ns == 0


def test_a_gps_receiver_on_the_same_line_is_counted_and_ignored() -> None:
    driver = CompassDriver(0.0)
    driver.feed(format(Gga(quality=1)) + format(Hdm(heading_deg=1.0)) + format(Rmc()) + frame("GPTXT,1"), 0)
    assert len(driver.poll(0)) == 1
    assert driver.counters == LinkCounters(received=4)


def test_garbage_between_sentences_costs_only_what_it_hits() -> None:
    line = lines_of(100.0)
    driver = CompassDriver(0.0)
    for data in (b"\xff\x00garbage\r\n", line, line[:-6] + b"*00\r\n", line[:10], line, b"$C1X2*00\r\n", line):
        driver.feed(data, 20 * MS)
    assert len(driver.poll(20 * MS)) == 3
    assert driver.readings == 3
    assert driver.counters == LinkCounters(received=3, damaged=3)


@given(data=st.lists(st.binary(max_size=60) | st.sampled_from([b"$", b"\r\n", lines_of(10.0), b"$C1.0*"])))
def test_no_bytes_make_the_driver_stumble(data: list[bytes]) -> None:
    driver = CompassDriver(0.0)
    for piece in data:
        driver.feed(piece, 0)
    readings = driver.poll(0)
    assert len(readings) == driver.readings <= driver.counters.received
    assert all(-math.pi < reading.yaw_rad <= math.pi for reading, _ in readings)


# ---- model and driver together -----------------------------------------------------------------------


def carry(compass: Compass, driver: CompassDriver, t_ns: int) -> None:
    said = compass.poll(t_ns)
    if isinstance(said, bytes):
        driver.feed(said, t_ns)
    else:
        for sentence in said:
            driver.hear(sentence, t_ns)


def drive(level: Level, given: dict[str, Any], seconds: float = 3.0) -> list[tuple[int, CompassHeading, int]]:
    """Turn a compass with an alarm in the middle; return time of the poll, reading, t_data_ns."""
    compass = Compass(**given, level=level)
    driver = CompassDriver(WEST_RAD, given.get("latency_ns", 20 * MS))
    got = []
    for t_ns in range(0, int(seconds * 1e9), TICK_NS):
        if compass.due(t_ns):
            compass.measure(t_ns, t_ns * 2.3e-9, 0.02, -0.1 + t_ns * 5e-11, alarm=t_ns // (500 * MS) == 2)
        carry(compass, driver, t_ns)
        got += [(t_ns, reading, t_data_ns) for reading, t_data_ns in driver.poll(t_ns)]
    return got


@pytest.mark.parametrize("given", SETUPS)
def test_wire_and_direct_give_the_same_readings_at_the_same_time(given: dict[str, Any]) -> None:
    on_wire, direct = drive("wire", given), drive("direct", given)
    assert on_wire == direct
    assert len(on_wire) >= 28
    if given.get("personality") != "os5000":
        assert not all(reading.valid for _, reading, _ in on_wire)


@pytest.mark.parametrize("given", [setup for setup in SETUPS if len(setup.get("sentences", ())) <= 1])
@pytest.mark.parametrize("level", ["wire", "direct"])
def test_data_time_is_the_time_of_the_measurement(level: Level, given: dict[str, Any]) -> None:
    got = drive(level, given)
    measured = range(given.get("t0_ns", 0), 3000 * MS, given.get("period_ns", 100 * MS))
    assert [t_data_ns for _, _, t_data_ns in got] == list(measured)[: len(got)]
    assert {t_ns - t_data_ns for t_ns, _, t_data_ns in got} == {given.get("latency_ns", 20 * MS)}
    for _, reading, t_data_ns in got:
        if reading.valid:
            true_rad = math.pi / 2 - t_data_ns * 2.3e-9 - WEST_RAD
            assert abs(wrap(reading.yaw_rad - true_rad)) < math.radians(0.11)  # twice half a last digit


@given(
    heading=st.floats(-10.0, 10.0),
    pitch=st.floats(-1.5, 1.5),
    roll=st.floats(-3.0, 3.0),
    given=st.sampled_from(SETUPS[:8]),
)
def test_any_attitude_arrives_alike_on_both_levels(
    heading: float, pitch: float, roll: float, given: dict[str, Any]
) -> None:
    readings = []
    for level in ("wire", "direct"):
        compass, driver = Compass(**given, level=level), CompassDriver(WEST_RAD)
        compass.measure(0, heading, pitch, roll)
        carry(compass, driver, 20 * MS)
        readings.append(driver.poll(20 * MS))
    assert repr(readings[0]) == repr(readings[1])
    assert abs(wrap(readings[0][-1][0].yaw_rad - (math.pi / 2 - heading - WEST_RAD))) < math.radians(0.11)


@pytest.mark.parametrize("level", ["wire", "direct"])
def test_restored_snapshots_continue_with_the_same_sentence(level: Level) -> None:
    compass, driver = Compass(level=level), CompassDriver(WEST_RAD)
    compass.measure(0, 1.0, 0.1, 0.2)
    carry(compass, driver, 10 * MS)  # half of the sentence
    saved = pickle.loads(pickle.dumps((compass.snapshot(), driver.snapshot())))
    carry(compass, driver, 20 * MS)
    expected = driver.poll(20 * MS), driver.counters
    assert len(expected[0]) == 1
    for _ in range(2):
        compass, driver = Compass(level=level), CompassDriver(WEST_RAD)
        compass.restore(saved[0])
        driver.restore(saved[1])
        carry(compass, driver, 20 * MS)
        assert (driver.poll(20 * MS), driver.counters) == expected


# ---- real captures -----------------------------------------------------------------------------------


def test_gps_captures_give_as_many_readings_as_compass_sentences(shared_data: Path) -> None:
    """None of the present captures holds a compass: the driver must stay quiet on all their lines."""
    for path in sorted((shared_data / "nmea").glob("*.log")):
        driver = CompassDriver(0.0)
        driver.feed(path.read_bytes(), 0)
        expected = 0
        for line in Splitter().feed(path.read_bytes()):
            try:
                expected += isinstance(parse(line), COMPASS_SENTENCES)
            except SentenceError:
                continue
        assert len(driver.poll(0)) == expected
        assert driver.counters.received > 0
