"""The receiver model: what it says, when the bytes leave its line, what it refuses."""

import math
import pickle
from itertools import pairwise
from typing import Any

import pytest

from hal.codecs.nmea import Gga, Gll, Gsa, Gst, Rmc, Sentence, Splitter, Vtg, Zda, parse
from hal.devices.gps import GpsReceiver
from hal.signals import FixQuality

MS = 1_000_000
UTC_NS = 1_790_000_000_000_000_000  # 2026-09-21 14:13:20
ALL = ("GGA", "RMC", "VTG", "GSA", "GST", "GLL", "ZDA")


def measurement(**changed: Any) -> dict[str, Any]:
    values: dict[str, Any] = {
        "lat_rad": math.radians(39.165),
        "lon_rad": math.radians(-86.526),
        "alt_m": 235.26,
        "east_mps": 3.0,
        "north_mps": 0.0,
        "quality": FixQuality.DIFFERENTIAL,
        "satellites": 9,
        "hdop": 1.1,
        "sigma_m": 0.8,
        "utc_ns": UTC_NS,
    }
    return values | changed


def wire(receiver: GpsReceiver, t_ns: int) -> bytes:
    said = receiver.poll(t_ns)
    assert isinstance(said, bytes)
    return said


def sentences(data: bytes) -> dict[str, Sentence]:
    parsed = [parse(line) for line in Splitter().feed(data)]
    return {sentence.TYPE: sentence for sentence in parsed if sentence is not None}


def said_by(names: tuple[str, ...] = ALL, **changed: Any) -> dict[str, Sentence]:
    receiver = GpsReceiver(sentences=names, baud=115_200)
    receiver.measure(0, **measurement(**changed))
    return sentences(wire(receiver, 100 * MS))


def test_the_sentences_say_what_was_measured() -> None:
    said = said_by()
    time_s = 14 * 3600 + 13 * 60 + 20.0
    assert list(said) == list(ALL)
    assert said["GGA"] == Gga(
        time_s=time_s, lat_deg=39.165, lon_deg=-86.526, quality=2, satellites=9, hdop=1.1, altitude_m=235.3
    )
    assert said["RMC"] == Rmc(
        time_s=time_s,
        status="A",
        lat_deg=39.165,
        lon_deg=-86.526,
        speed_kn=5.832,
        course_deg=90.0,
        date=(21, 9, 26),
        mode="D",
    )
    assert said["VTG"] == Vtg(course_deg=90.0, speed_kn=5.832, speed_kmh=10.8, mode="D")
    assert said["GSA"] == Gsa(selection="A", fix=3, hdop=1.1)
    assert said["GST"] == Gst(time_s=time_s, sigma_lat_m=0.8, sigma_lon_m=0.8)
    assert said["GLL"] == Gll(lat_deg=39.165, lon_deg=-86.526, time_s=time_s, status="A", mode="D")
    assert said["ZDA"] == Zda(time_s=time_s, day=21, month=9, year=2026, zone_hours=0, zone_minutes=0)


def test_without_a_fix_the_position_is_empty_and_the_time_goes_on() -> None:
    said = said_by(quality=FixQuality.NONE, satellites=2)
    time_s = 14 * 3600 + 13 * 60 + 20.0
    assert said["GGA"] == Gga(time_s=time_s, quality=0, satellites=2)
    assert said["RMC"] == Rmc(time_s=time_s, status="V", date=(21, 9, 26), mode="N")
    assert said["VTG"] == Vtg(mode="N")
    assert said["GSA"] == Gsa(selection="A", fix=1)
    assert said["GST"] == Gst(time_s=time_s)
    assert said["GLL"] == Gll(time_s=time_s, status="V", mode="N")


@pytest.mark.parametrize(("speed_mps", "course_deg"), [(0.29, None), (0.3, 315.0), (2.0, 315.0)])
def test_the_course_is_empty_when_standing(speed_mps: float, course_deg: float | None) -> None:
    part = math.sqrt(0.5) * speed_mps * (1 + 1e-12)
    rmc = said_by(("RMC",), east_mps=-part, north_mps=part)["RMC"]
    assert isinstance(rmc, Rmc)
    assert rmc.course_deg == course_deg
    assert rmc.speed_kn == pytest.approx(speed_mps * 3600 / 1852, abs=5e-4)


def test_the_last_hundredth_of_a_day_rounds_into_the_next_day() -> None:
    day_ns = 86_400 * 1_000_000_000
    midnight_ns = UTC_NS // day_ns * day_ns
    rmc = said_by(("RMC",), utc_ns=midnight_ns - 4 * MS)["RMC"]
    assert isinstance(rmc, Rmc)
    assert (rmc.time_s, rmc.date) == (0.0, (21, 9, 26))
    rmc = said_by(("RMC",), utc_ns=midnight_ns - 6 * MS)["RMC"]
    assert isinstance(rmc, Rmc)
    assert (rmc.time_s, rmc.date) == (86_399.99, (20, 9, 26))


def test_an_unknown_date_is_left_empty() -> None:
    said = said_by(utc_ns=3600 * 1_000_000_000)
    assert isinstance(said["RMC"], Rmc)
    assert isinstance(said["ZDA"], Zda)
    assert (said["RMC"].time_s, said["RMC"].date, said["ZDA"].year) == (3600.0, None, None)


def test_measurements_are_due_at_multiples_of_the_period_from_the_origin() -> None:
    receiver = GpsReceiver(t0_ns=30 * MS)
    due = [t_ns for t_ns in range(0, 1000 * MS, 10 * MS) if receiver.due(t_ns)]
    assert due == [t * MS for t in (30, 230, 430, 630, 830)]
    with pytest.raises(ValueError, match="expected a multiple"):
        receiver.measure(40 * MS, **measurement())


def test_bytes_leave_at_the_baud_rate_and_the_last_one_exactly_at_the_end() -> None:
    """38,400 baud: a byte each 260.4 us, counted back from measurement + latency."""
    receiver = GpsReceiver()
    receiver.measure(200 * MS, **measurement())
    end_ns = 300 * MS
    whole = GpsReceiver()
    whole.measure(200 * MS, **measurement())
    burst = wire(whole, end_ns)
    assert whole.poll(end_ns + MS) == b""

    left = b""
    for t_ns in range(200 * MS, end_ns + 1, 50_000):
        left += wire(receiver, t_ns)
        behind = len(burst) - len(left)
        room = (end_ns - t_ns) / 1e9 * 38_400 / 10  # how many bytes can leave until the end
        assert behind - 1 < room
        assert behind >= room or behind == len(burst)
        assert left == burst[: len(left)]
        assert (t_ns == end_ns) == (behind == 0)


def test_the_last_byte_has_not_left_one_nanosecond_before_the_end() -> None:
    receiver = GpsReceiver()
    receiver.measure(0, **measurement())
    assert wire(receiver, 100 * MS - 1).endswith(b"\r")
    assert wire(receiver, 100 * MS) == b"\n"


@pytest.mark.parametrize("baud", [9_600, 38_400, 115_200, 460_800])
@pytest.mark.parametrize("step_ns", [10 * MS, MS, 37_013])
def test_direct_gives_each_sentence_at_the_poll_at_which_the_wire_completes_its_line(baud: int, step_ns: int) -> None:
    given = {"baud": baud, "sentences": ("GGA", "GST", "RMC"), "latency_ns": 230 * MS, "period_ns": 250 * MS}
    on_wire, direct = GpsReceiver(**given), GpsReceiver(**given, level="direct")  # type: ignore[arg-type]
    splitter = Splitter()
    heard = []
    for t_ns in range(0, 1100 * MS, step_ns):
        for receiver in (on_wire, direct):
            if t_ns % (250 * MS) == 0:  # the odd steps meet the first measurement only
                receiver.measure(t_ns, **measurement(utc_ns=UTC_NS + t_ns, alt_m=t_ns / 9e5))
        complete = [parse(line) for line in splitter.feed(wire(on_wire, t_ns))]
        assert direct.poll(t_ns) == complete
        heard += complete
    assert len(heard) == (12 if step_ns != 37_013 else 3)


def test_a_latency_longer_than_the_period_keeps_the_bursts_apart() -> None:
    receiver = GpsReceiver(latency_ns=300 * MS)
    ends = []
    for t_ns in range(0, 1000 * MS, 10 * MS):
        if receiver.due(t_ns):
            receiver.measure(t_ns, **measurement(utc_ns=UTC_NS + t_ns))
        if wire(receiver, t_ns).endswith(b"\n"):
            ends.append(t_ns)
    assert ends == [300 * MS, 500 * MS, 700 * MS, 900 * MS]


@pytest.mark.parametrize(
    "given",
    [
        {"baud": 4_800, "latency_ns": 1000 * MS},  # 5 Hz needs more than 9,600 baud
        {"baud": 4_800, "period_ns": 1000 * MS},
        {"latency_ns": 0},
        {"sentences": ALL, "baud": 19_200},
    ],
)
def test_a_burst_that_does_not_fit_is_refused_when_the_receiver_is_made(given: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="raise the baud rate or drop sentences"):
        GpsReceiver(**given)


def test_a_measurement_that_got_too_long_is_refused() -> None:
    receiver = GpsReceiver(latency_ns=39_200_000)
    with pytest.raises(ValueError, match=r"bytes take .* ms at 38400 baud, expected at most 39\.2 ms"):
        receiver.measure(0, **measurement(alt_m=-999_999.9, hdop=1234.5))
    receiver.measure(0, **measurement())


@pytest.mark.parametrize(
    "given",
    [{"sentences": ("GGA", "GSV")}, {"sentences": ()}, {"level": "os"}, {"baud": 0}, {"period_ns": 0}],
)
def test_senseless_parameters_are_refused(given: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="expected"):
        GpsReceiver(**given)


@pytest.mark.parametrize("level", ["wire", "direct"])
def test_a_silent_receiver_sends_nothing_and_starts_with_a_whole_burst(level: Any) -> None:
    receiver = GpsReceiver(level=level)
    said: list[tuple[int, Any]] = []
    for t_ns in range(0, 1000 * MS, 10 * MS):
        receiver.silent = 280 * MS <= t_ns < 450 * MS  # from the middle of the second burst on
        if receiver.due(t_ns):
            receiver.measure(t_ns, **measurement(utc_ns=UTC_NS + t_ns))
        if out := receiver.poll(t_ns):
            said.append((t_ns, out))
    times = [t_ns // MS for t_ns, _ in said]
    assert times[-1] == 900
    assert [(a, b) for a, b in pairwise(times) if b - a > 200] == [(270, 670) if level == "wire" else (100, 690)]
    if level == "wire":
        splitter = Splitter()
        assert len([line for _, data in said for line in splitter.feed(data)]) == 6
        assert splitter.damaged == 1  # the line that was cut off


@pytest.mark.parametrize("level", ["wire", "direct"])
def test_a_restored_snapshot_continues_with_the_same_burst(level: Any) -> None:
    receiver = GpsReceiver(level=level)
    receiver.measure(0, **measurement())
    assert receiver.poll(80 * MS if level == "wire" else 85 * MS)
    snapshot = pickle.loads(pickle.dumps(receiver.snapshot()))
    rest = receiver.poll(100 * MS)
    assert rest
    other = GpsReceiver(level=level)
    other.restore(snapshot)
    assert other.poll(100 * MS) == rest
    other.restore(snapshot)
    assert other.poll(100 * MS) == rest
