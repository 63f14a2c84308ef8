"""NMEA sentences: known lines, random ones, real captures, and pynmeagps as the second opinion."""

import math
from functools import reduce
from itertools import pairwise
from operator import xor
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.codecs.nmea import (
    COMPASS_SENTENCES,
    MAX_LENGTH,
    SENTENCES,
    Gga,
    Gll,
    Gsa,
    Gst,
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
    Vtg,
    Zda,
    checksum,
    format,
    frame,
    parse,
    quantise,
)

GGA_LINE = b"$GNGGA,121614.00,5327.04173,N,00214.41443,W,1,12,0.66,37.4,M,48.5,M,,*68\r\n"
RMC_LINE = b"$GNRMC,103607.00,A,5327.03942,N,00214.42462,W,0.046,,060321,,,A,V*0F\r\n"
OTHER_TYPES = (b"GSV", b"TXT", b"GBS", b"DTM", b"GNS", b"TI,")  # the last is SkyTraq's $PSTI
CAPTURES = [
    "april6_2019",
    "bt451",
    "garmin25lp",
    "pygpsdata-badeof",
    "skytraq-dgps",
    "ublox-zed-f9p-nmea",
]


def seal(body: str) -> bytes:
    """Frame a body without the module's help."""
    return f"${body}*{reduce(xor, body.encode(), 0):02X}".encode()


# ---- random sentences --------------------------------------------------------------------------------


def number(lowest: float = -1e7, highest: float = 1e7) -> st.SearchStrategy[float | None]:
    return st.none() | st.floats(lowest, highest) | st.floats(max(-100.0, lowest), min(100.0, highest))


def integer(lowest: int, highest: int) -> st.SearchStrategy[int | None]:
    return st.none() | st.integers(lowest, highest)


def angle(limit: int) -> st.SearchStrategy[float | None]:
    near_whole = st.builds(lambda d, e: d + e, st.integers(1 - limit, limit - 1), st.floats(-1e-6, 1e-6))
    return st.none() | st.floats(-limit, limit) | near_whole


course = number(0.0, 360.0) | st.floats(359.9, 360.0)
text = st.none() | st.text("AVNDRTS0123", max_size=4)
FIELDS: dict[str, st.SearchStrategy[Any]] = {
    "time_s": st.none() | st.floats(0.0, 86_401.0) | st.integers(0, 86_400).map(float),
    "lat_deg": angle(90),
    "lon_deg": angle(180),
    "date": st.none() | st.tuples(st.integers(1, 31), st.integers(1, 12), st.integers(0, 99)),
    "quality": integer(0, 9),
    "satellites": integer(0, 99),
    "fix": integer(0, 9),
    "day": integer(1, 31),
    "month": integer(1, 12),
    "year": integer(0, 9999),
    "zone_hours": integer(-14, 14),
    "zone_minutes": integer(-59, 59),
    "course_deg": course,
    "course_magnetic_deg": course,
    "heading_deg": course,
    "orientation_deg": number(-360.0, 360.0),
    "variation_deg": number(-360.0, 360.0),
    "deviation_deg": number(-360.0, 360.0),
    "pitch_deg": number(-180.0, 180.0),
    "roll_deg": number(-180.0, 180.0),
    "temperature_degc": number(-999.9, 999.9),
    "depth_ft": number(-9999.9, 9999.9),
    "field_mgauss": number(0.0, 9999.9),
    **{f"field_{axis}_mgauss": number(-9999.9, 9999.9) for axis in "xyz"},
    "acceleration_g": number(0.0, 9.999),
    **{f"acceleration_{axis}_g": number(-9.999, 9.999) for axis in "xyz"},
    "gyro_x": number(-999.9, 999.9),
    "gyro_y": number(-999.9, 999.9),
}
TEXTS = {"station", "status", "mode", "navigation_status", "selection", "system"}


def strategy_of(sentence: type[Sentence]) -> st.SearchStrategy[Sentence]:
    fields: dict[str, st.SearchStrategy[Any]] = {}
    for name in sentence.__struct_fields__:
        is_text = name in TEXTS or name.endswith("_status")
        fields[name] = FIELDS.get(name, text if is_text else number())
    own = sentence.OWN_TALKER
    fields["talker"] = st.sampled_from(["GP", "GN", "HC", "II", ""]) if own is None else st.just(own)
    if sentence is Gsa:
        fields["satellites"] = st.lists(st.integers(0, 999), max_size=12).map(tuple)
    return st.builds(sentence, **fields)


sentences = st.sampled_from(SENTENCES).flatmap(strategy_of)


@given(sentence=sentences)
def test_quantise_is_parse_after_format_to_the_last_bit(sentence: Sentence) -> None:
    line = format(sentence)
    assert line.endswith(b"\r\n")
    assert len(line) <= MAX_LENGTH + 2
    quantised = quantise(sentence)
    assert parse(line) == quantised
    assert repr(parse(line)) == repr(quantised)  # tells -0.0 from 0.0
    assert type(quantised) is type(sentence)


@given(sentence=sentences)
def test_quantising_twice_changes_nothing(sentence: Sentence) -> None:
    once = quantise(sentence)
    assert repr(quantise(once)) == repr(once)
    assert format(once) == format(sentence)


@given(sentence=sentences)
def test_the_line_is_cut_out_of_a_stream(sentence: Sentence) -> None:
    line = format(sentence)
    assert Splitter().feed(b"rubbish\n" + line) == [line[:-2]]


@given(line=st.binary(max_size=130) | st.text(max_size=130).map(lambda t: b"$" + t.encode()))
def test_rubbish_is_refused_and_nothing_else_happens(line: bytes) -> None:
    with pytest.raises(SentenceError):
        parse(line)


@given(
    sentence=sentences,
    at=st.integers(0, 200),
    new=st.sampled_from([b"", b",", b".", b"-", b"X", b"9", b"1e5", b"_1"]),
)
def test_a_sealed_but_spoilt_sentence_parses_or_is_refused(sentence: Sentence, at: int, new: bytes) -> None:
    body = format(sentence)[1:-5]
    at %= len(body)
    line = seal((body[:at] + new + body[at + 1 :]).decode())
    try:
        parsed = parse(line)
    except SentenceError:
        return
    if parsed is not None:
        assert parse(format(parsed)) == quantise(parsed)


@given(sentence=sentences, flip=st.integers(0, 10_000))
def test_a_flipped_bit_is_noticed(sentence: Sentence, flip: int) -> None:
    line = bytearray(format(sentence)[:-2])
    at, bit = divmod(flip % (8 * len(line)), 8)
    line[at] ^= 1 << bit
    digit = at >= len(line) - 2 and bit == 5  # upper and lower case of a hexadecimal digit
    if digit and bytes(line).upper() == format(sentence)[:-2]:
        return
    with pytest.raises(SentenceError):
        parse(bytes(line))


# ---- known sentences ---------------------------------------------------------------------------------


def test_gga() -> None:
    fix = parse(GGA_LINE)
    assert fix == Gga(
        talker="GN",
        time_s=12 * 3600 + 16 * 60 + 14,
        lat_deg=(53 * 6_000_000 + 27_04173) / 6_000_000,  # in units of 0.00001 minutes
        lon_deg=-(2 * 6_000_000 + 14_41443) / 6_000_000,
        quality=1,
        satellites=12,
        hdop=0.66,
        altitude_m=37.4,
        geoid_separation_m=48.5,
    )
    assert format(fix) == GGA_LINE


def test_rmc() -> None:
    fix = parse(RMC_LINE)
    assert isinstance(fix, Rmc)
    assert (fix.status, fix.speed_kn, fix.course_deg, fix.date) == ("A", 0.046, None, (6, 3, 21))
    assert (fix.mode, fix.navigation_status, fix.variation_deg) == ("A", "V", None)
    assert format(fix) == RMC_LINE


@pytest.mark.parametrize("end", [b"", b"\r", b"\n", b"\r\n"])
def test_line_ends_and_lower_case_checksums_do_not_matter(end: bytes) -> None:
    assert parse(RMC_LINE[:-4] + b"0f" + end) == parse(RMC_LINE)


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        (b"$GPGGA,,,,,,0,,,,M,,M,,*66", Gga(quality=0)),
        (b"$GPGGA,,,,,,0,00,99.99,,,,,,*48", Gga(quality=0, satellites=0, hdop=99.99)),
        (b"$GNRMC,,V,,,,,,,,,,N,V*37", Rmc(talker="GN", status="V", mode="N", navigation_status="V")),
        (b"$GPRMC,,V,,,,,,,,,,N*53", Rmc(status="V", mode="N")),
        (b"$GPVTG,,,,,,,,,N*30", Vtg(mode="N")),
        (b"$GPGLL,,,,,,V,N*64", Gll(status="V", mode="N")),
        (
            b"$GPGSA,A,1,,,,,,,,,,,,,99.99,99.99,99.99*30",
            Gsa(selection="A", fix=1, pdop=99.99, hdop=99.99, vdop=99.99),
        ),
        (b"$GPZDA,,,,,00,00*48", Zda(zone_hours=0, zone_minutes=0)),
    ],
)
def test_receivers_without_a_fix(line: bytes, sentence: Sentence) -> None:
    assert parse(line) == sentence


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        (
            "GPRMC,120316,V,4221.4394,N,01321.9948,E,000.0,000.0,150305,001.4,E",
            Rmc(
                time_s=43_396.0,
                status="V",
                lat_deg=(42 * 600_000 + 214_394) / 600_000,
                lon_deg=(13 * 600_000 + 219_948) / 600_000,
                speed_kn=0.0,
                course_deg=0.0,
                date=(15, 3, 5),
                variation_deg=1.4,
            ),
        ),
        (
            "GPVTG,122.7,T,,M,000.0,N,000.0,K",
            Vtg(course_deg=122.7, speed_kn=0.0, speed_kmh=0.0),
        ),
        (
            "GNGST,003956.00,235111,,,,2.3,3.5,4.0",
            Gst(
                talker="GN",
                time_s=2396.0,
                residual_rms_m=235_111.0,
                sigma_lat_m=2.3,
                sigma_lon_m=3.5,
                sigma_altitude_m=4.0,
            ),
        ),
        (
            "GNGSA,A,3,82,66,81,,,,,,,,,,1.05,0.64,0.83,2",
            Gsa(
                talker="GN",
                selection="A",
                fix=3,
                satellites=(82, 66, 81),
                pdop=1.05,
                hdop=0.64,
                vdop=0.83,
                system="2",
            ),
        ),
        (
            "GPZDA,213121.000,07,04,2016,-05,00",
            Zda(time_s=77_481.0, day=7, month=4, year=2016, zone_hours=-5, zone_minutes=0),
        ),
        ("GPGLL,4530.0,S,17030.0,E", Gll(lat_deg=-45.5, lon_deg=170.5)),
        ("HCHDG,78.1,0.5,W,4.7,W", Hdg(heading_deg=78.1, deviation_deg=-0.5, variation_deg=-4.7)),
        ("HCHDG,78.1,,,,", Hdg(heading_deg=78.1)),
        ("HCHDG,78.1", Hdg(heading_deg=78.1)),
        ("HCHDT,271.5,T", Hdt(heading_deg=271.5)),
        ("HCHDM,271.5,M", Hdm(heading_deg=271.5)),
        ("HDM,271.5,M", Hdm(talker="", heading_deg=271.5)),
        (
            "PTNTHPR,85.9,N,-0.9,N,0.8,N",
            Hpr(
                heading_deg=85.9,
                heading_status="N",
                pitch_deg=-0.9,
                pitch_status="N",
                roll_deg=0.8,
                roll_status="N",
            ),
        ),
        (
            "PTNTHPR,,P,,P,0.8,N",
            Hpr(heading_status="P", pitch_status="P", roll_deg=0.8, roll_status="N"),
        ),
        (
            "C320.5P0.2R-18.3T19.0",
            Os5000(heading_deg=320.5, pitch_deg=0.2, roll_deg=-18.3, temperature_degc=19.0),
        ),
        ("C320.5R-18.3", Os5000(heading_deg=320.5, roll_deg=-18.3)),
        ("CP0.2", Os5000(pitch_deg=0.2)),
        ("C", Os5000()),
        (
            "OHPR,237.7,-14.3,175.5,30.1",
            Ohpr(heading_deg=237.7, pitch_deg=-14.3, roll_deg=175.5, temperature_degc=30.1),
        ),
        (
            "OHPR,320.5,0.2,-18.3,19.0,0.0,512.3,-101.5,180.2,468.8,1.002,0.003,-0.314,0.951,,0.1,-0.2,,",
            Ohpr(
                heading_deg=320.5,
                pitch_deg=0.2,
                roll_deg=-18.3,
                temperature_degc=19.0,
                depth_ft=0.0,
                field_mgauss=512.3,
                field_x_mgauss=-101.5,
                field_y_mgauss=180.2,
                field_z_mgauss=468.8,
                acceleration_g=1.002,
                acceleration_x_g=0.003,
                acceleration_y_g=-0.314,
                acceleration_z_g=0.951,
                gyro_x=0.1,
                gyro_y=-0.2,
            ),
        ),
    ],
)
def test_sentences_of_all_types(body: str, sentence: Sentence) -> None:
    assert parse(seal(body)) == sentence
    assert parse(format(sentence)) == sentence


@pytest.mark.parametrize(
    ("sentence", "line"),
    [
        (
            Hpr(
                heading_deg=85.94,
                heading_status="N",
                pitch_deg=-0.95,
                pitch_status="N",
                roll_deg=-0.01,
                roll_status="N",
            ),
            seal("PTNTHPR,85.9,N,-0.9,N,0.0,N"),
        ),
        (Hdg(heading_deg=359.97, variation_deg=-4.71), seal("HCHDG,0.0,,,4.7,W")),
        (
            Os5000(heading_deg=320.46, pitch_deg=0.24, roll_deg=-18.3, temperature_degc=19.0),
            b"$C320.5P0.2R-18.3T19.0*3C",
        ),
        (Os5000(heading_deg=359.97, roll_deg=-0.01), seal("C0.0R0.0")),
        (
            Ohpr(heading_deg=237.7, pitch_deg=-14.3, roll_deg=175.5, temperature_degc=30.1),
            b"$OHPR,237.7,-14.3,175.5,30.1*2B",
        ),
        (Ohpr(heading_deg=1.0, gyro_y=2.0), seal("OHPR,1.0,,,,,,,,,,,,,,,2.0")),
        (Ohpr(), seal("OHPR,,,,")),
        (Rmc(status="V"), seal("GPRMC,,V,,,,,,,,,")),
        (Vtg(mode="N"), seal("GPVTG,,T,,M,,N,,K,N")),
        (Gll(), seal("GPGLL,,,,,,")),
        (Zda(zone_hours=-5, zone_minutes=0), seal("GPZDA,,,,,-05,00")),
        (Gll(lat_deg=59.9999999999, lon_deg=-9.9999999999), seal("GPGLL,6000.00000,N,01000.00000,W,,")),
        (Gll(lat_deg=-1e-9, lon_deg=-1e-9), seal("GPGLL,0000.00000,N,00000.00000,E,,")),
        (Gll(time_s=59.999), seal("GPGLL,,,,,000100.00,")),
        (Gll(time_s=86_399.996), seal("GPGLL,,,,,235960.00,")),
        (Gll(time_s=86_400.5), seal("GPGLL,,,,,235960.50,")),
    ],
)
def test_how_sentences_are_written(sentence: Sentence, line: bytes) -> None:
    assert format(sentence) == line + b"\r\n"


@pytest.mark.parametrize(
    "line",
    [
        b"$TNHCQ,HDG*27",
        b"$TNHCQ,HDT*34",
        b"$TNHCQ,XDR*22",
        b"$PTNT,HPR*78",
        b"$PTNT,RCD*67",
        b"$PTNT,CCD*76",
        b"$PTNTHTM,14223,N,169,N,-43,N,13641,2454*15",
        b"$GPTXT,01,01,02,ANTSTATUS=OK*3B",
        b"$GNDTM,W84,,0.0,N,0.0,E,0.0,W84*71",
        seal("PGGA,1"),
        seal("C,1,2,3,4"),
        seal("HCHPR,1.0,2.0,3.0,4.0"),
        seal("PC"),
        seal("GNGGAX,1"),
        b"!" + seal("AIVDM,1,1,,A,15M,0")[1:],
    ],
)
def test_sound_sentences_of_other_types_are_none(line: bytes) -> None:
    assert parse(line) is None
    if line.startswith(b"$"):
        assert frame(line[1:-3].decode()) == line + b"\r\n"
        assert checksum(line[1:-3]) == int(line[-2:], 16)


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        (b"", "came, expected"),
        (b"$", "came, expected"),
        (b"$GPGGA,,,,,,0,,,,M,,M,,", "came, expected"),
        (b"$GPGGA,,,,,,0,,,,M,,M,,*6", "came, expected"),
        (b"GPGGA,,,,,,0,,,,M,,M,,*66", "came, expected"),
        (b"$GPGGA,,,,,,0,,,,M,,M,,*66 ", "came, expected"),
        (b"$GPTXT,\xff*00", "came, expected"),
        (b"$GPTXT,$GPTXT*00", "came, expected"),
        (b"$GPGGA,,,,,,0,,,,M,,M,,*67", "checksum 67, expected 66"),
        (seal("GPTXT," + "A" * 120), "bytes, expected at most 120"),
        (seal(",1"), "address"),
        (seal("GPGGA,,,,,,0,,,,M,,M,"), "13 fields, expected 14 to 14"),
        (seal("GPHDT,1.0,T,A"), "3 fields, expected 2 to 2"),
        (seal("GPRMC,,V,,,,,X.138,,,,"), "field 7 speed_kn: 'X.138' came"),
        (seal("GPRMC,,V,,,,,XXXXX,,,,"), "field 7 speed_kn: 'XXXXX' came"),
        (seal("GPRMC,,V,,,,,1e3,,,,"), "speed_kn"),
        (seal("GPRMC,,V,,,,,1_0,,,,"), "speed_kn"),
        (seal("GPRMC,,V,,,,, 1,,,,"), "speed_kn"),
        (seal("GPRMC,,V,,,,,nan,,,,"), "speed_kn"),
        (seal("GPRMC,,V,,,,,.,,,,"), "speed_kn"),
        (seal("GPRMC,,V,,,,,,360.1,,,"), "course_deg"),
        (seal("GPRMC,,V,,,,,,,,-1.0,E"), "variation_deg"),
        (seal("GPRMC,,V,,,,,,,,1.0,"), "variation_deg"),
        (seal("GPGLL,9000.00001,N,,"), "lat_deg"),
        (seal("GPGLL,9100.0,N,,"), "lat_deg"),
        (seal("GPGLL,4560.0,N,,"), "lat_deg"),
        (seal("GPGLL,500.0,N,,"), "lat_deg"),
        (seal("GPGLL,4500.0,,,"), "lat_deg"),
        (seal("GPGLL,4500.0,E,,"), "lat_deg"),
        (seal("GPGLL,,,18000.001,E"), "lon_deg"),
        (seal("GPGLL,,,,,240000,A"), "time_s"),
        (seal("GPGLL,,,,,126100,A"), "time_s"),
        (seal("GPGLL,,,,,120061,A"), "time_s"),
        (seal("GPGLL,,,,,1200,A"), "time_s"),
        (seal("GPGLL,,,,,,VALID"), "status"),
        (seal("GPZDA,,32,01,2016,,"), "day"),
        (seal("C360.5P0.2R-18.3T19.0"), "C, field 1 heading_deg"),
        (seal("C320.5P0.2R-1-8T19.0"), "C, field 3 roll_deg: '-1-8' came"),
        (seal("C320.5P0.2R-18.3TX"), "address"),
        (seal("C320.5R0.2P-18.3"), "address"),
        (seal("OHPR,320.5"), "1 fields, expected 3 to 18"),
        (seal("OHPR,320.5,X,0.0"), "pitch_deg"),
        (seal("GPHDT,1.0,M"), "field 2 unit: 'M' came, expected T"),
        (seal("GPGSA,A,1,X,,,,,,,,,,,,1,1,1"), "satellites"),
    ],
)
def test_damaged_lines_are_refused_with_the_reason(line: bytes, complaint: str) -> None:
    with pytest.raises(SentenceError, match=complaint.replace(".", r"\.")):
        parse(line)


def test_a_reserved_field_is_read_over() -> None:
    line = seal("OHPR,1.0,2.0,3.0,4.0,,,,,,,,,,whatever,5.0,6.0,7,8.9")
    assert parse(line) == Ohpr(
        heading_deg=1.0, pitch_deg=2.0, roll_deg=3.0, temperature_degc=4.0, gyro_x=5.0, gyro_y=6.0
    )


@pytest.mark.parametrize("sentence", COMPASS_SENTENCES)
def test_compass_sentences_have_a_heading(sentence: type[Sentence]) -> None:
    assert "heading_deg" in sentence.__struct_fields__


@pytest.mark.parametrize("date", ["2208-1", "000000", "321299", "22081999", "X"])
def test_a_damaged_date_does_not_spoil_the_fix(date: str) -> None:
    fix = parse(seal(f"GPRMC,000231.099,A,4829.0005,N,00022.0015,E,0.15,212.28,{date},,,A"))
    assert isinstance(fix, Rmc)
    assert fix.date is None
    assert fix.time_s == 151.099


def test_decimals_of_the_time_are_the_nearest_float() -> None:
    for hundredths in range(0, 8_640_000, 997):
        whole, rest = divmod(hundredths, 100)
        minutes, s = divmod(whole, 60)
        fix = parse(seal(f"GPGLL,,,,,{minutes // 60:02d}{minutes % 60:02d}{s:02d}.{rest:02d},A"))
        assert isinstance(fix, Gll)
        assert fix.time_s == hundredths / 100


@pytest.mark.parametrize(
    "sentence",
    [
        Gga(lat_deg=90.1),
        Gga(lon_deg=-180.1),
        Gga(altitude_m=math.nan),
        Gga(hdop=math.inf),
        Gga(time_s=-0.1),
        Gga(time_s=86_402.0),
        Gga(satellites=100),
        Gga(station="a,b"),
        Gga(talker="gp"),
        Gga(talker="P"),
        Gga(talker="GPS"),
        Hpr(talker="HC"),
        Ohpr(talker="HC"),
        Ohpr(acceleration_g=10.0),
        Os5000(talker="GP"),
        Os5000(pitch_deg=math.nan),
        Rmc(course_deg=-1.0),
        Rmc(variation_deg=math.nan),
        Rmc(date=(31, 13, 20)),
        Rmc(date=(1, 1, 2020)),
        Gsa(satellites=tuple(range(13))),
    ],
)
def test_what_cannot_be_written_cannot_be_quantised(sentence: Sentence) -> None:
    with pytest.raises(SentenceError):
        format(sentence)
    with pytest.raises(SentenceError):
        quantise(sentence)


@pytest.mark.parametrize("sentence", SENTENCES)
def test_fields_follow_the_table(sentence: type[Sentence]) -> None:
    named = [column.name for column in sentence.COLUMNS if column.name]
    assert set(sentence.__struct_fields__) == {"talker", *named}
    assert [name for name in sentence.__struct_fields__ if name != "talker"] == named


# ---- splitter ----------------------------------------------------------------------------------------

STREAM = (
    b"4,N,rest of a line\r\n# a comment\n"
    + GGA_LINE
    + b"$GPGGA,1216"  # cut off by the next one
    + RMC_LINE
    + b"\xb5b\x01\x07\x00$\xff\r\r\n\n!AIVDM,1*00\r$\n"
    + b"$" + b"A" * 119 + b"\n"
    + b"$" + b"A" * 120 + b"\n"
    + b"x" * 500 + b"\n$GPTXT*00"
)  # fmt: skip
LINES = [GGA_LINE[:-2], RMC_LINE[:-2], b"$\xff", b"!AIVDM,1*00", b"$", b"$" + b"A" * 119]
DAMAGED = 3  # the cut-off GGA, the binary bytes before a dollar, the line of 121 bytes


def test_splitter_gives_the_same_lines_at_every_position_of_a_split() -> None:
    for at in range(len(STREAM) + 1):
        splitter = Splitter()
        assert splitter.feed(STREAM[:at]) + splitter.feed(STREAM[at:]) == LINES
        assert splitter.damaged == DAMAGED
        assert splitter.feed(b"\r") == [b"$GPTXT*00"]


@given(
    data=st.lists(st.sampled_from([b"$", b"\r", b"\n", b"!", b"a", b"," * 60, GGA_LINE]) | st.binary()),
    cuts=st.lists(st.integers(0, 2000)),
)
def test_splitter_does_not_depend_on_how_the_bytes_arrive(data: list[bytes], cuts: list[int]) -> None:
    stream = b"".join(data)
    whole = Splitter()
    expected = whole.feed(stream)
    pieces = Splitter()
    lines = []
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    for start, end in pairwise(edges):
        lines += pieces.feed(stream[start:end])
    assert lines == expected
    assert pieces.damaged == whole.damaged
    assert pieces.feed(b"\n") == whole.feed(b"\n")


def test_splitter_forgets_what_is_too_long() -> None:
    splitter = Splitter()
    for _ in range(1000):
        assert splitter.feed(b"$" + b"\x00" * 1000) == []
    assert len(splitter._rest) <= MAX_LENGTH + 1
    assert splitter.damaged == 999
    assert splitter.feed(b"\n" + GGA_LINE) == [GGA_LINE[:-2]]
    assert splitter.damaged == 1000


# ---- second opinions ---------------------------------------------------------------------------------


@pytest.mark.parametrize("line", [GGA_LINE, RMC_LINE])
def test_pynmeagps_reads_the_same_position(line: bytes) -> None:
    pynmeagps = pytest.importorskip("pynmeagps", reason="pynmeagps gives a second opinion where installed")
    other, ours = pynmeagps.NMEAReader.parse(line), parse(line)
    assert isinstance(ours, Gga | Rmc)
    assert (other.lat, other.lon) == pytest.approx((ours.lat_deg, ours.lon_deg), abs=1e-9)


@given(sentence=strategy_of(Gga))
def test_pynmeagps_reads_what_is_written(sentence: Gga) -> None:
    pynmeagps = pytest.importorskip("pynmeagps", reason="pynmeagps gives a second opinion where installed")
    # It knows no sentence without talker, no leap second, and station ids only as numbers.
    time_s = None if sentence.time_s is None else min(sentence.time_s, 86_399.0)
    fix = quantise(msgspec.structs.replace(sentence, talker="GP", time_s=time_s, station="0120"))
    other = pynmeagps.NMEAReader.parse(format(fix))
    assert (other.msgID, other.diffStation) == ("GGA", 120)
    for ours, theirs in [
        (fix.lat_deg, other.lat),
        (fix.lon_deg, other.lon),
        (fix.altitude_m, other.alt),
        (fix.geoid_separation_m, other.sep),
        (fix.hdop, other.HDOP),
        (fix.satellites, other.numSV),
        (fix.quality, other.quality),
    ]:
        assert theirs == ("" if ours is None else pytest.approx(ours, abs=1e-8))


def lines_of(path: Path) -> list[bytes]:
    splitter = Splitter()
    return [line for line in splitter.feed(path.read_bytes()) if line.startswith(b"$")]


@pytest.mark.parametrize("name", CAPTURES)
def test_every_sound_sentence_of_a_capture_is_understood(shared_data: Path, name: str) -> None:
    decoded = 0
    for line in lines_of(shared_data / "nmea" / f"{name}.log"):
        sentence = parse(line)
        if sentence is None:
            assert line[3:6] in OTHER_TYPES
        else:
            decoded += 1
            assert parse(format(sentence)) == quantise(sentence)
    assert decoded >= 1


def test_sentences_of_a_ublox_receiver_are_written_as_it_writes_them(shared_data: Path) -> None:
    same = 0
    for line in lines_of(shared_data / "nmea" / "ublox-zed-f9p-nmea.log"):
        sentence = parse(line)
        if isinstance(sentence, Gga | Rmc | Gll | Gsa | Vtg | Zda):
            assert format(sentence) == line + b"\r\n"
            same += 1
    assert same > 200


def test_the_week_roll_over_damages_dates_but_not_fixes(shared_data: Path) -> None:
    fixes = [parse(line) for line in lines_of(shared_data / "nmea" / "april6_2019.log")]
    assert [fix.date for fix in fixes if isinstance(fix, Rmc)] == [None, None, (22, 8, 99)]


def test_an_end_within_a_sentence_is_kept_back(shared_data: Path) -> None:
    splitter = Splitter()
    data = (shared_data / "nmea" / "pygpsdata-badeof.log").read_bytes()
    assert len(splitter.feed(data)) == 4
    assert data.endswith(b"$")
    assert splitter.feed(b"\n") == [b"$"]


def test_a_checksum_does_not_prove_sense(shared_data: Path) -> None:
    """Of three lines with sound checksums two have letters for a speed and one a far-away position."""
    first, second, third = lines_of(shared_data / "nmea" / "pygpsdata-nmeabadck.log")
    for damaged in (first, third):
        with pytest.raises(SentenceError):
            parse(damaged)
    stray = parse(second)
    assert isinstance(stray, Rmc)
    assert stray.lon_deg == pytest.approx(-(102 + 14.42462 / 60))
