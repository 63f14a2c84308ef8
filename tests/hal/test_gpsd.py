"""An outside judge: gpsd reads our simulated receiver from a pseudo-terminal, as it would read a real one."""

import json
import math
import os
import select
import shutil
import socket
import subprocess
import tty

import pytest

from hal.devices.gps import GpsReceiver
from hal.signals import FixQuality

GPSD = shutil.which("gpsd") or ("/usr/sbin/gpsd" if os.access("/usr/sbin/gpsd", os.X_OK) else None)
T0_NS = 1_795_359_600_000_000_000  # 2026-11-22T15:00:00Z
LAT_RAD, LON_RAD = math.radians(39.1829), math.radians(-86.5243)
SECOND_NS = 1_000_000_000
LOST_NS = T0_NS + 12 * SECOND_NS


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def gpsd():
    """Yield (file descriptor of the receiver's end of the line, stream of gpsd's JSON)."""
    if GPSD is None:
        pytest.skip("gpsd is not installed: apt-get install gpsd")
    ours, theirs = os.openpty()
    tty.setraw(ours)
    tty.setraw(theirs)
    port = free_port()
    daemon = subprocess.Popen(
        [GPSD, "-N", "-n", "-b", "-S", str(port), os.ttyname(theirs)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    link = None
    try:
        for _ in range(1000):  # 20 s: a daemon says to nobody when it listens
            try:
                link = socket.create_connection(("127.0.0.1", port), timeout=1.0)
                break
            except OSError:
                assert daemon.poll() is None, "gpsd ended at once"
                select.select([], [], [], 0.02)
        assert link is not None, "gpsd does not listen"
        link.settimeout(1.0)
        link.sendall(b'?WATCH={"enable":true,"json":true};\n')
        yield ours, link
    finally:
        if link is not None:
            link.close()
        daemon.terminate()
        daemon.wait()
        os.close(ours)
        os.close(theirs)


def reports(line, link, receiver, measure, rounds=40):
    """Feed an epoch, read what gpsd says, and so on: no clock but the receiver's own."""
    rest, t_ns = b"", T0_NS
    for _ in range(rounds):
        measure(receiver, t_ns)
        t_ns += SECOND_NS
        os.write(line, receiver.poll(t_ns))
        link.settimeout(0.25)
        try:
            rest += link.recv(65536)
        except TimeoutError:
            continue
        *whole, rest = rest.split(b"\n")
        yield from (json.loads(text) for text in whole if text.strip())


def standing(receiver, t_ns, quality=FixQuality.DIFFERENTIAL):
    receiver.measure(
        t_ns, lat_rad=LAT_RAD, lon_rad=LON_RAD, alt_m=236.8, east_mps=2.0, north_mps=0.0,
        quality=quality, satellites=9, hdop=0.9, sigma_m=0.7, utc_ns=t_ns,
    )  # fmt: skip


def test_gpsd_reads_position_time_quality_and_variation_of_our_receiver(gpsd):
    line, link = gpsd
    receiver = GpsReceiver(
        period_ns=SECOND_NS, t0_ns=T0_NS, sentences=("GGA", "GSA", "GST", "RMC"), variation_rad=math.radians(-4.7)
    )
    good = next(
        (r for r in reports(line, link, receiver, standing)
         if r["class"] == "TPV" and r.get("mode") == 3 and r.get("status") == 2 and "lat" in r
         and abs(r.get("magvar", 0.0) + 4.7) < 0.05),  # before it has read ours, gpsd gives its own: -4.5
        None,
    )  # fmt: skip
    assert good is not None, "gpsd never reported a differential 3D fix with variation"
    assert good["lat"] == pytest.approx(39.1829, abs=2e-7)
    assert good["lon"] == pytest.approx(-86.5243, abs=2e-7)
    assert good["altMSL"] == pytest.approx(236.8, abs=0.05)
    assert good["speed"] == pytest.approx(2.0, abs=0.01)
    assert good["track"] == pytest.approx(90.0, abs=0.01)
    assert good["time"].startswith("2026-11-22T15:00:")


def test_gpsd_sees_that_our_receiver_lost_its_fix(gpsd):
    line, link = gpsd
    receiver = GpsReceiver(period_ns=SECOND_NS, t0_ns=T0_NS, sentences=("GGA", "GSA", "RMC"))
    modes = [
        r["mode"]
        for r in reports(
            line, link, receiver,
            lambda rx, t_ns: standing(rx, t_ns, FixQuality.AUTONOMOUS if t_ns < LOST_NS else FixQuality.NONE),
            rounds=24,
        )
        if r["class"] == "TPV"
    ]  # fmt: skip
    assert 3 in modes
    assert modes[-1] == 1
