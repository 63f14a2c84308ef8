"""Captures of real receivers through transport, driver, database and localiser."""

import re

import pytest

from hal.capture import CaptureError, read_capture
from scenarios.play import play


def test_capture_of_a_standing_receiver_comes_out_of_the_localiser(shared_data):
    *fixes, summary, estimate = play(shared_data / "nmea" / "ublox-zed-f9p-nmea.log", None)
    assert len(fixes) == 29
    assert all(re.match(r"00:\d\d:\d\d\.000  3D -45\.8775\d+ 170\.5001\d+ 1[45]\.\d m", line) for line in fixes)
    assert summary == "29 epochs from 1015 good sentences; 0 damaged, not decoded; 0 late"
    east_m, north_m = map(float, re.findall(r"(-?[\d.]+) m", estimate)[:2])
    assert abs(east_m) < 2.0
    assert abs(north_m) < 2.0


def test_damaged_sentences_are_counted_and_not_decoded(shared_data):
    *fixes, summary, _ = play(shared_data / "nmea" / "pygpsdata-nmeabadck.log", None)
    assert "2 damaged" in summary
    assert len(fixes) == 1
    assert "-102.24" in fixes[0], "a valid checksum proves no sense: the wrong place is accepted"


def test_capture_without_a_fix_says_so(tmp_path):
    capture = tmp_path / "none.log"
    capture.write_bytes(b"# a note\r\n$GPGGA,,,,,,0,,,,M,,M,,*66\r\n$GNRMC,,V,,,,,,,,,,N,V*37\r\n")
    assert list(play(capture, None))[-1] == "the localiser never had a fix to begin with"


def test_time_of_arrival_follows_the_receivers_own_clock(tmp_path):
    capture = tmp_path / "two.log"
    capture.write_bytes(
        b"$GNGGA,121614.00,5327.04173,N,00214.41443,W,1,12,0.66,37.4,M,48.5,M,,*68\r\n$GPGSA,A,3,,,,,,,,,,,,,1,1,1*1E\r\n"
    )
    assert [t for t, _ in read_capture(capture)] == [0, 0]


@pytest.mark.parametrize("data", [b"", b"hello\n", b"# only a note\n"])
def test_file_without_sentences_is_refused_in_one_line(tmp_path, data):
    capture = tmp_path / "empty.log"
    capture.write_bytes(data)
    with pytest.raises(CaptureError, match="holds no NMEA sentence"):
        read_capture(capture)
