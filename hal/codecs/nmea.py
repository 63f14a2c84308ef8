"""NMEA 0183 sentences of GPS receivers and compasses.

A sentence is `$`, an address (talker and type), fields between commas, `*`, two hexadecimal digits, CR LF;
the digits are the exclusive or of all bytes between `$` and `*`. An empty field means "unknown", here None.
Values keep NMEA's own units, which stand in their names; the drivers convert them.

OceanServer's `$C320.5P0.2R-18.3T19.0*3C` is the odd one: letters stand before its values in place of commas.

Each type of sentence is a struct and, as `COLUMNS`, the table of its fields. `parse`, `format` and `quantise`
all follow that table: `quantise(s)` is what `parse(format(s))` gives, to the last bit and without the text.
"""

import re
from collections.abc import Callable, Hashable
from functools import cache, lru_cache, reduce
from operator import xor
from typing import Any, ClassVar, Final, NoReturn, Protocol, TypeVar

import msgspec

from hal.codecs import CodecError

__all__ = [
    "COMPASS_SENTENCES",
    "MAX_LENGTH",
    "SENTENCES",
    "Gga",
    "Gll",
    "Gsa",
    "Gst",
    "Hdg",
    "Hdm",
    "Hdt",
    "Hpr",
    "Ohpr",
    "Os5000",
    "Rmc",
    "Sentence",
    "SentenceError",
    "Splitter",
    "Vtg",
    "Zda",
    "checksum",
    "format",
    "frame",
    "parse",
    "quantise",
]

MAX_LENGTH: Final = 120
"""Bytes of the longest line that is looked at, without its end. The standard says 80; receivers exceed it."""


class SentenceError(CodecError):
    """Raised when a line is not a sound sentence, or when a value cannot be written as one."""


# ---- columns: how a value stands between commas --------------------------------------------------


class Column(Hashable, Protocol):
    """One value of a sentence: its attribute and the fields that it fills.

    The three methods take and give None for "unknown" and raise ValueError for what cannot be.
    """

    name: str
    """The struct's attribute, empty for a constant letter."""
    width: int
    """How many fields the value fills."""

    def read(self, fields: list[str], at: int) -> Any:
        """Return the value that stands at an index."""

    def write(self, value: Any) -> str:
        """Return the value as text, with commas between if it fills several fields."""

    def quantise(self, value: Any) -> Any:
        """Return the value as it comes back from its text."""


_is_number: Final = re.compile(r"-?(?:[0-9]+\.?[0-9]*|\.[0-9]+)").fullmatch
_is_magnitude: Final = re.compile(r"[0-9]+\.?[0-9]*|\.[0-9]+").fullmatch
_is_integer: Final = re.compile(r"-?[0-9]+").fullmatch
_is_clock: Final = re.compile(r"([01][0-9]|2[0-3])([0-5][0-9])([0-5][0-9]|60)(\.[0-9]*)?").fullmatch
_is_date: Final = re.compile(r"(0[1-9]|[12][0-9]|3[01])(0[1-9]|1[0-2])([0-9]{2})").fullmatch


def _in_range(value: float, lowest: float, highest: float) -> float:
    if not lowest <= value <= highest:  # false for NaN too
        _refuse(value, lowest, highest)
    return value


def _refuse(value: float, lowest: float, highest: float) -> NoReturn:
    raise ValueError(f"{value} came, expected {lowest}..{highest}")


class _Number:
    """A decimal number, written with a fixed number of decimals."""

    width = 1

    def __init__(self, name: str, decimals: int, lowest: float = -1e7, highest: float = 1e7) -> None:
        self.name = name
        self._decimals = decimals
        self._format = f"%.{decimals}f"
        self._lowest, self._highest = lowest, highest

    def read(self, fields: list[str], at: int) -> float | None:
        text = fields[at]
        if not text:
            return None
        if not _is_number(text):
            raise ValueError(f"{text!r} came, expected a number")
        return _in_range(float(text), self._lowest, self._highest) + 0.0  # + 0.0: no negative zero

    def write(self, value: float | None) -> str:
        return "" if value is None else self._format % self.quantise(value)

    def quantise(self, value: float | None) -> float | None:
        if value is None:
            return None
        if not self._lowest <= value <= self._highest:
            _refuse(value, self._lowest, self._highest)
        # round() gives the float nearest to the decimal text, as float(text) does
        return round(value, self._decimals) + 0.0


class _Course(_Number):
    """An angle clockwise from north in degrees: what rounds up to 360 is written as 0."""

    def __init__(self, name: str, decimals: int) -> None:
        super().__init__(name, decimals, 0.0, 360.0)

    def quantise(self, value: float | None) -> float | None:
        rounded = super().quantise(value)
        return 0.0 if rounded == 360.0 else rounded


class _Signed:
    """A magnitude and a letter: the first letter is positive."""

    width = 2

    def __init__(self, name: str, letters: str, decimals: int) -> None:
        self.name = name
        self._letters = letters
        self._format = f"%.{decimals}f,%s"
        self._decimals = decimals

    def read(self, fields: list[str], at: int) -> float | None:
        text, letter = fields[at], fields[at + 1]
        sign = _sign(letter, self._letters, needed=bool(text))
        if not text:
            return None
        if not _is_magnitude(text):
            raise ValueError(f"{text!r} came, expected a number without sign")
        return sign * _in_range(float(text), 0.0, 360.0) + 0.0

    def write(self, value: float | None) -> str:
        if value is None:
            return ","
        rounded = self.quantise(value)
        assert rounded is not None
        return self._format % (abs(rounded), self._letters[rounded < 0])

    def quantise(self, value: float | None) -> float | None:
        return None if value is None else round(_in_range(value, -360.0, 360.0), self._decimals) + 0.0


def _sign(letter: str, letters: str, *, needed: bool) -> int:
    """Return +1 or -1 for the first or second letter; a letter without a value means nothing."""
    if letter == letters[0]:
        return 1
    if letter == letters[1]:
        return -1
    if letter or needed:
        raise ValueError(f"{letter!r} came, expected {letters[0]} or {letters[1]}")
    return 0


class _Angle:
    """Latitude or longitude: degrees and minutes without a space, then the hemisphere.

    Counted in whole units of the last decimal of the minutes, so that 59.999999' becomes the next degree and
    the text's value is one exact integer divided once.
    """

    width = 2
    _UNITS = 6_000_000  # 60 minutes of five decimals

    def __init__(self, name: str, letters: str, degrees: int) -> None:
        self.name = name
        self._letters = letters
        self._format = f"%0{degrees}d%02d.%05d,%s"
        self._is_angle = re.compile(rf"([0-9]{{{degrees}}})([0-5][0-9])(?:\.([0-9]*))?").fullmatch
        self._limit = 90 if degrees == 2 else 180
        self._shape = "d" * degrees + "mm.mmmm"

    def read(self, fields: list[str], at: int) -> float | None:
        text = fields[at]
        sign = _sign(fields[at + 1], self._letters, needed=bool(text))
        if not text:
            return None
        match = self._is_angle(text)
        if match is None:
            raise ValueError(f"{text!r} came, expected {self._shape} with minutes below 60")
        degrees, minutes, decimals = match.groups("")
        scale: int = 10 ** len(decimals)
        units = 60 * scale * int(degrees) + int(minutes + decimals)
        if units > 60 * scale * self._limit:
            raise ValueError(f"{text!r} came, expected at most {self._limit} degrees")
        return sign * units / (60 * scale)

    def _units(self, value: float) -> int:
        if not -self._limit <= value <= self._limit:
            _refuse(value, -self._limit, self._limit)
        return round(value * self._UNITS)

    def write(self, value: float | None) -> str:
        if value is None:
            return ","
        units = self._units(value)
        degrees, rest = divmod(abs(units), self._UNITS)
        return self._format % (degrees, *divmod(rest, 100_000), self._letters[units < 0])

    def quantise(self, value: float | None) -> float | None:
        return None if value is None else self._units(value) / self._UNITS


class _Clock:
    """Time of day as hhmmss.ss; 86,400 s and more is the leap second 23:59:60."""

    width = 1
    name = "time_s"

    def read(self, fields: list[str], at: int) -> float | None:
        text = fields[at]
        if not text:
            return None
        match = _is_clock(text)
        if match is None:
            raise ValueError(f"{text!r} came, expected hhmmss or hhmmss.ss")
        hours, minutes, seconds, decimals = match.groups("")
        return float(f"{int(hours) * 3600 + int(minutes) * 60 + int(seconds)}{decimals}")

    def write(self, value: float | None) -> str:
        if value is None:
            return ""
        quantised = self.quantise(value)
        assert quantised is not None
        seconds, hundredths = divmod(round(quantised * 100.0), 100)
        if seconds == 86_400:
            return f"235960.{hundredths:02d}"
        minutes = seconds // 60
        return f"{minutes // 60:02d}{minutes % 60:02d}{seconds % 60:02d}.{hundredths:02d}"

    def quantise(self, value: float | None) -> float | None:
        if value is None:
            return None
        if not 0.0 <= value <= 86_401.0:
            _refuse(value, 0.0, 86_401.0)
        return min(round(value, 2), 86_400.99) + 0.0


def _ddmmyy(date: tuple[int, int, int]) -> str:
    day, month, year = date
    return f"{day:02d}{month:02d}{year:02d}"


class _Date:
    """Date as ddmmyy. An unreadable one is None: some receivers damage it around the GPS week's roll-over."""

    width = 1
    name = "date"

    def read(self, fields: list[str], at: int) -> tuple[int, int, int] | None:
        match = _is_date(fields[at])
        return None if match is None else (int(match[1]), int(match[2]), int(match[3]))

    def write(self, value: tuple[int, int, int] | None) -> str:
        if value is None:
            return ""
        text = _ddmmyy(value)
        if not _is_date(text):
            self.quantise(value)
        return text

    def quantise(self, value: tuple[int, int, int] | None) -> tuple[int, int, int] | None:
        if value is not None and not _is_date(_ddmmyy(value)):
            raise ValueError(f"{value} came, expected (day, month, year of two digits)")
        return value


class _Integer:
    """A whole number, written with at least some digits."""

    width = 1

    def __init__(self, name: str, digits: int, lowest: int, highest: int) -> None:
        self.name = name
        self._format = f"%0{digits}d"
        self._range = lowest, highest

    def read(self, fields: list[str], at: int) -> int | None:
        text = fields[at]
        if not text:
            return None
        if not _is_integer(text):
            raise ValueError(f"{text!r} came, expected a whole number")
        value = int(text)
        _in_range(value, *self._range)
        return value

    def write(self, value: int | None) -> str:
        if self.quantise(value) is None:
            return ""
        assert value is not None
        return self._format % value if value >= 0 else "-" + self._format % -value

    def quantise(self, value: int | None) -> int | None:
        if value is not None:
            _in_range(value, *self._range)
        return value


class _Integers:
    """A list of whole numbers in a fixed number of fields; the empty ones are left out."""

    def __init__(self, name: str, width: int) -> None:
        self.name = name
        self.width = width

    def read(self, fields: list[str], at: int) -> tuple[int, ...]:
        texts = [text for text in fields[at : at + self.width] if text]
        for text in texts:
            if not _is_integer(text):
                raise ValueError(f"{text!r} came, expected a whole number")
        return self.quantise(tuple(map(int, texts)))

    def write(self, value: tuple[int, ...]) -> str:
        texts = [f"{number:02d}" for number in self.quantise(value)]
        return ",".join(texts + [""] * (self.width - len(texts)))

    def quantise(self, value: tuple[int, ...]) -> tuple[int, ...]:
        if len(value) > self.width or any(not 0 <= number <= 999 for number in value):
            raise ValueError(f"{value} came, expected at most {self.width} numbers 0..999")
        return value


class _Text:
    """One to four letters or digits, for instance a status."""

    width = 1

    def __init__(self, name: str) -> None:
        self.name = name

    def read(self, fields: list[str], at: int) -> str | None:
        return self.quantise(fields[at])

    def write(self, value: str | None) -> str:
        return self.quantise(value) or ""

    def quantise(self, value: str | None) -> str | None:
        if not value:
            return None
        if len(value) > 4 or not value.isalnum() or not value.isascii():
            raise ValueError(f"{value!r} came, expected at most four letters or digits")
        return value


class _Unit:
    """A constant letter behind a value. Some receivers leave it out without a value."""

    width = 1
    name = ""

    def __init__(self, letter: str) -> None:
        self._letter = letter

    def read(self, fields: list[str], at: int) -> None:
        if fields[at] not in ("", self._letter):
            raise ValueError(f"{fields[at]!r} came, expected {self._letter}")

    def write(self, value: None) -> str:
        return self._letter

    def quantise(self, value: None) -> None:
        return None


class _Reserved:
    """A field that the maker keeps for itself: read over, written empty."""

    width = 1
    name = ""

    def read(self, fields: list[str], at: int) -> None:
        """Take whatever stands there."""

    def write(self, value: None) -> str:
        return ""

    def quantise(self, value: None) -> None:
        return None


_TIME: Final = _Clock()
_LATITUDE: Final = _Angle("lat_deg", "NS", 2)
_LONGITUDE: Final = _Angle("lon_deg", "EW", 3)
_VARIATION: Final = _Signed("variation_deg", "EW", 1)
_HEADING: Final = _Course("heading_deg", 1)
_PITCH: Final = _Number("pitch_deg", 1, -180.0, 180.0)
_ROLL: Final = _Number("roll_deg", 1, -180.0, 180.0)
_TEMPERATURE: Final = _Number("temperature_degc", 1, -999.9, 999.9)
_RESERVED: Final = _Reserved()
_STATUS: Final = _Text("status")
_MODE: Final = _Text("mode")


# ---- sentences -----------------------------------------------------------------------------------


class Sentence(msgspec.Struct, frozen=True, gc=False, kw_only=True):
    """Base of the sentences. After `talker` the fields follow the table `COLUMNS`; None is an empty field."""

    TYPE: ClassVar[str]
    COLUMNS: ClassVar[tuple[Column, ...]]
    ACCEPTED: ClassVar[int]
    """The fewest fields that are accepted: old versions of the standard have fewer."""
    WRITTEN: ClassVar[int]
    """The fewest fields that are written: empty ones after these are left out at the end."""
    OWN_TALKER: ClassVar[str | None] = None
    """The one talker of a maker's own sentence."""

    talker: str = "GP"


class Gga(Sentence, frozen=True, gc=False, kw_only=True):
    """Position fix with its quality."""

    TYPE = "GGA"
    COLUMNS = (
        _TIME,
        _LATITUDE,
        _LONGITUDE,
        _Integer("quality", 1, 0, 9),
        _Integer("satellites", 2, 0, 99),
        _Number("hdop", 2),
        _Number("altitude_m", 1),
        _Unit("M"),
        _Number("geoid_separation_m", 1),
        _Unit("M"),
        _Number("age_s", 1),
        _Text("station"),
    )
    ACCEPTED = WRITTEN = 14

    time_s: float | None = None
    lat_deg: float | None = None
    lon_deg: float | None = None
    quality: int | None = None
    satellites: int | None = None
    hdop: float | None = None
    altitude_m: float | None = None
    geoid_separation_m: float | None = None
    age_s: float | None = None
    station: str | None = None


class Rmc(Sentence, frozen=True, gc=False, kw_only=True):
    """The recommended minimum: position, speed and course over ground, date."""

    TYPE = "RMC"
    COLUMNS = (
        _TIME,
        _STATUS,
        _LATITUDE,
        _LONGITUDE,
        _Number("speed_kn", 3),
        _Course("course_deg", 2),
        _Date(),
        _VARIATION,
        _MODE,
        _Text("navigation_status"),
    )
    ACCEPTED = WRITTEN = 11

    time_s: float | None = None
    status: str | None = None
    lat_deg: float | None = None
    lon_deg: float | None = None
    speed_kn: float | None = None
    course_deg: float | None = None
    date: tuple[int, int, int] | None = None
    """Day, month, year of two digits; None if empty or damaged."""
    variation_deg: float | None = None
    """East positive."""
    mode: str | None = None
    navigation_status: str | None = None


class Vtg(Sentence, frozen=True, gc=False, kw_only=True):
    """Speed and course over ground."""

    TYPE = "VTG"
    COLUMNS = (
        _Course("course_deg", 2),
        _Unit("T"),
        _Course("course_magnetic_deg", 2),
        _Unit("M"),
        _Number("speed_kn", 3),
        _Unit("N"),
        _Number("speed_kmh", 3),
        _Unit("K"),
        _MODE,
    )
    ACCEPTED = WRITTEN = 8

    course_deg: float | None = None
    course_magnetic_deg: float | None = None
    speed_kn: float | None = None
    speed_kmh: float | None = None
    mode: str | None = None


class Gst(Sentence, frozen=True, gc=False, kw_only=True):
    """The receiver's own opinion of its errors, one standard deviation each."""

    TYPE = "GST"
    COLUMNS = (
        _TIME,
        _Number("residual_rms_m", 2),
        _Number("sigma_major_m", 2),
        _Number("sigma_minor_m", 2),
        _Number("orientation_deg", 2, -360.0, 360.0),  # SkyTraq writes negative ones
        _Number("sigma_lat_m", 2),
        _Number("sigma_lon_m", 2),
        _Number("sigma_altitude_m", 2),
    )
    ACCEPTED = WRITTEN = 8

    time_s: float | None = None
    residual_rms_m: float | None = None
    sigma_major_m: float | None = None
    sigma_minor_m: float | None = None
    orientation_deg: float | None = None
    sigma_lat_m: float | None = None
    sigma_lon_m: float | None = None
    sigma_altitude_m: float | None = None


class Gsa(Sentence, frozen=True, gc=False, kw_only=True):
    """Kind of fix (1 none, 2 in the plane, 3 in space), satellites used, dilutions of precision."""

    TYPE = "GSA"
    COLUMNS = (
        _Text("selection"),
        _Integer("fix", 1, 0, 9),
        _Integers("satellites", 12),
        _Number("pdop", 2),
        _Number("hdop", 2),
        _Number("vdop", 2),
        _Text("system"),
    )
    ACCEPTED = WRITTEN = 17

    selection: str | None = None
    fix: int | None = None
    satellites: tuple[int, ...] = ()
    pdop: float | None = None
    hdop: float | None = None
    vdop: float | None = None
    system: str | None = None


class Zda(Sentence, frozen=True, gc=False, kw_only=True):
    """Time and date in UTC, and the local zone."""

    TYPE = "ZDA"
    COLUMNS = (
        _TIME,
        _Integer("day", 2, 1, 31),
        _Integer("month", 2, 1, 12),
        _Integer("year", 4, 0, 9999),
        _Integer("zone_hours", 2, -14, 14),
        _Integer("zone_minutes", 2, -59, 59),
    )
    ACCEPTED = WRITTEN = 6

    time_s: float | None = None
    day: int | None = None
    month: int | None = None
    year: int | None = None
    zone_hours: int | None = None
    zone_minutes: int | None = None


class Gll(Sentence, frozen=True, gc=False, kw_only=True):
    """Position and time."""

    TYPE = "GLL"
    COLUMNS = (_LATITUDE, _LONGITUDE, _TIME, _STATUS, _MODE)
    ACCEPTED = 4
    WRITTEN = 6

    lat_deg: float | None = None
    lon_deg: float | None = None
    time_s: float | None = None
    status: str | None = None
    mode: str | None = None


class Hdg(Sentence, frozen=True, gc=False, kw_only=True):
    """Heading of a magnetic sensor; deviation and variation are east positive, to be added."""

    TYPE = "HDG"
    COLUMNS = (_HEADING, _Signed("deviation_deg", "EW", 1), _VARIATION)
    ACCEPTED = 1
    WRITTEN = 5

    talker: str = "HC"
    heading_deg: float | None = None
    deviation_deg: float | None = None
    variation_deg: float | None = None


class Hdt(Sentence, frozen=True, gc=False, kw_only=True):
    """Heading from true north."""

    TYPE = "HDT"
    COLUMNS = (_HEADING, _Unit("T"))
    ACCEPTED = WRITTEN = 2

    talker: str = "HC"
    heading_deg: float | None = None


class Hdm(Sentence, frozen=True, gc=False, kw_only=True):
    """Heading from magnetic north."""

    TYPE = "HDM"
    COLUMNS = (_HEADING, _Unit("M"))
    ACCEPTED = WRITTEN = 2

    talker: str = "HC"
    heading_deg: float | None = None


class Hpr(Sentence, frozen=True, gc=False, kw_only=True):
    """Heading, pitch and roll of Honeywell's HMR3000: `$PTNTHPR`. Status N is normal, P and L are alarms."""

    TYPE = "TNTHPR"
    OWN_TALKER = "P"
    COLUMNS = (
        _HEADING,
        _Text("heading_status"),
        _PITCH,
        _Text("pitch_status"),
        _ROLL,
        _Text("roll_status"),
    )
    ACCEPTED = WRITTEN = 6

    talker: str = "P"
    heading_deg: float | None = None
    heading_status: str | None = None
    pitch_deg: float | None = None
    pitch_status: str | None = None
    roll_deg: float | None = None
    roll_status: str | None = None


class Ohpr(Sentence, frozen=True, gc=False, kw_only=True):
    """Format 2 of OceanServer's OS5000: `$OHPR`.

    A compass says only the values that it is set to, and a value that is off leaves no gap. These are the places
    when all are on; the factory's setting is the first four.
    """

    TYPE = "HPR"
    OWN_TALKER = "O"
    COLUMNS = (
        _HEADING,
        _PITCH,
        _ROLL,
        _TEMPERATURE,
        _Number("depth_ft", 1, -9999.9, 9999.9),
        _Number("field_mgauss", 1, 0.0, 9999.9),
        _Number("field_x_mgauss", 1, -9999.9, 9999.9),
        _Number("field_y_mgauss", 1, -9999.9, 9999.9),
        _Number("field_z_mgauss", 1, -9999.9, 9999.9),
        _Number("acceleration_g", 3, 0.0, 9.999),
        _Number("acceleration_x_g", 3, -9.999, 9.999),
        _Number("acceleration_y_g", 3, -9.999, 9.999),
        _Number("acceleration_z_g", 3, -9.999, 9.999),
        _RESERVED,
        _Number("gyro_x", 1, -999.9, 999.9),
        _Number("gyro_y", 1, -999.9, 999.9),
        _RESERVED,
        _RESERVED,
    )
    ACCEPTED = 3
    WRITTEN = 4

    talker: str = "O"
    heading_deg: float | None = None
    pitch_deg: float | None = None
    roll_deg: float | None = None
    temperature_degc: float | None = None
    depth_ft: float | None = None
    field_mgauss: float | None = None
    """Length of the vector that follows."""
    field_x_mgauss: float | None = None
    field_y_mgauss: float | None = None
    field_z_mgauss: float | None = None
    acceleration_g: float | None = None
    """Length of the vector that follows."""
    acceleration_x_g: float | None = None
    acceleration_y_g: float | None = None
    acceleration_z_g: float | None = None
    gyro_x: float | None = None
    """Of the maker's own unit, as `gyro_y`."""
    gyro_y: float | None = None


class Os5000(Sentence, frozen=True, gc=False, kw_only=True):
    """Format 1 of OceanServer's OS5000, its factory setting. An unknown value is left out with its letter."""

    TYPE = ""
    OWN_TALKER = "C"
    COLUMNS = (_HEADING, _PITCH, _ROLL, _TEMPERATURE)
    ACCEPTED = WRITTEN = 4

    talker: str = "C"
    heading_deg: float | None = None
    pitch_deg: float | None = None
    roll_deg: float | None = None
    temperature_degc: float | None = None


COMPASS_SENTENCES: Final = (Hdg, Hdt, Hdm, Hpr, Ohpr, Os5000)
"""Those that tell a heading."""
SENTENCES: Final[tuple[type[Sentence], ...]] = (Gga, Rmc, Vtg, Gst, Gsa, Zda, Gll, *COMPASS_SENTENCES)
"""Every type of sentence that is decoded."""


# ---- text ----------------------------------------------------------------------------------------

_FRAME: Final = re.compile(rb"[$!]([ -#%-)+-~]+)\*([0-9A-Fa-f]{2})(?:\r\n|\r|\n)?").fullmatch
_is_talker: Final = re.compile(r"(?:[A-OQ-Z0-9][A-Z0-9])?").fullmatch  # P is for makers' own sentences
_is_os5000: Final = re.compile(r"C([-.0-9]*)(?:P([-.0-9]*))?(?:R([-.0-9]*))?(?:T([-.0-9]*))?").fullmatch


class _Layout(msgspec.Struct, frozen=True):
    """A type's table with what the loops below need, computed once."""

    sentence: type[Sentence]
    columns: tuple[tuple[str, int, Column], ...]
    """Name, index of the first field, column."""
    most: int
    """How many fields there are with all optional ones."""
    texts: Callable[[Any], tuple[str, ...]]
    """The texts of a sentence, its address first."""
    rounded: Callable[[Any], Any]
    """The sentence with every value as it comes back from its text."""


def _layout(sentence: type[Sentence]) -> _Layout:
    columns, at = [], 0
    for column in sentence.COLUMNS:
        columns.append((column.name, at, column))
        at += column.width
    return _Layout(sentence, tuple(columns), at, *_written_out(sentence))


def _written_out(sentence: type[Sentence]) -> tuple[Callable[[Any], tuple[str, ...]], Callable[[Any], Any]]:
    """Write the loops over the columns out as Python source: half the time. For HDT the two functions read:

    lambda s: (s.talker + 'HDT', write0(s.heading_deg), 'T')
    lambda s: Sentence(talker=s.talker, heading_deg=quantise0(s.heading_deg))
    """
    scope: dict[str, Any] = {"Sentence": sentence}
    texts, values = [f"s.talker + {sentence.TYPE!r}"], ["talker=s.talker"]
    for k, column in enumerate(sentence.COLUMNS):
        if column.name:
            scope[f"write{k}"], scope[f"quantise{k}"] = _remembering(column)
            texts.append(f"write{k}(s.{column.name})")
            values.append(f"{column.name}=quantise{k}(s.{column.name})")
        else:
            texts.append(repr(column.write(None)))
    return (
        eval(f"lambda s: ({', '.join(texts)})", scope),
        eval(f"lambda s: Sentence({', '.join(values)})", scope),
    )


@cache
def _remembering(column: Column) -> tuple[Callable[[Any], str], Callable[[Any], Any]]:
    """Give the column's `write` and `quantise`, which know their latest answers: a burst says most values twice."""
    return lru_cache(32, typed=True)(column.write), lru_cache(32, typed=True)(column.quantise)


_LAYOUTS: Final = {sentence.TYPE: _layout(sentence) for sentence in SENTENCES}


def checksum(body: bytes) -> int:
    """Return the exclusive or of some bytes, those between `$` and `*`."""
    return reduce(xor, body, 0)


def frame(body: str) -> bytes:
    """Return a body, for instance a query like `TNHCQ,HDG`, as a line with `$`, checksum, CR LF."""
    data = body.encode("ascii")
    return b"$%b*%02X\r\n" % (data, checksum(data))


def parse(line: bytes) -> Sentence | None:
    """Return the sentence of a line with or without its end, or None for a sound one of another type.

    Raises SentenceError for a line that is damaged: frame, checksum, number of fields, or any field.
    """
    match = _FRAME(line)
    if match is None:
        raise SentenceError(f"{line[:MAX_LENGTH]!r} came, expected '$', printable text, '*', two digits")
    body, given = match.groups()
    if len(body) > MAX_LENGTH - 4:
        raise SentenceError(f"{line[:MAX_LENGTH]!r}...: {len(body) + 4} bytes, expected at most {MAX_LENGTH}")
    expected = checksum(body)
    if int(given, 16) != expected:
        raise SentenceError(f"{line!r}: checksum {given.decode()}, expected {expected:02X}")
    address, *fields = body.decode("ascii").split(",")
    lettered = None if fields else _is_os5000(address)
    if lettered is not None:
        address, fields = "C", list(lettered.groups(""))
    if not address.isalnum():
        raise SentenceError(f"{line!r}: address {address!r}, expected letters and digits")
    talker = address[0] if address[0] == "P" or lettered is not None else address[:-3]
    layout = _LAYOUTS.get(address[len(talker) :])
    if layout is None or line[0] != 0x24 or not _may_say(talker, layout.sentence):
        return None
    if not layout.sentence.ACCEPTED <= len(fields) <= layout.most:
        raise SentenceError(f"{line!r}: {len(fields)} fields, expected {layout.sentence.ACCEPTED} to {layout.most}")
    fields += [""] * (layout.most - len(fields))
    values: dict[str, Any] = {"talker": talker}
    name, at = "", 0
    try:
        for name, at, column in layout.columns:
            value = column.read(fields, at)
            if name:
                values[name] = value
    except ValueError as error:
        raise SentenceError(f"{address}, field {at + 1} {name or 'unit'}: {error}") from error
    return layout.sentence(**values)


@lru_cache(maxsize=64)
def _may_say(talker: str, sentence: type[Sentence]) -> bool:
    return _is_talker(talker) is not None if sentence.OWN_TALKER is None else talker == sentence.OWN_TALKER


def format(sentence: Sentence) -> bytes:
    """Return a sentence as a line with `$`, checksum, CR LF. SentenceError if a value cannot be written."""
    layout = _checked_layout(sentence)
    try:
        texts = layout.texts(sentence)
    except ValueError:
        raise _refused(sentence, layout) from None
    if isinstance(sentence, Os5000):
        return frame("".join(letter + text for letter, text in zip(("", "", *"PRT"), texts, strict=True) if text))
    body = ",".join(texts)
    for _ in range(layout.most - sentence.WRITTEN):
        body = body.removesuffix(",")
    return frame(body)


_S = TypeVar("_S", bound=Sentence)


def quantise(sentence: _S) -> _S:
    """Return the sentence as `parse(format(sentence))` gives it, to the last bit."""
    layout = _checked_layout(sentence)
    try:
        return layout.rounded(sentence)  # type: ignore[no-any-return]
    except ValueError:
        raise _refused(sentence, layout) from None


def _refused(sentence: Sentence, layout: _Layout) -> SentenceError:
    """Say which value of a sentence cannot be."""
    for name, _, column in layout.columns:
        try:
            column.quantise(getattr(sentence, name) if name else None)
        except ValueError as error:
            return SentenceError(f"{sentence.talker}{sentence.TYPE} {name}: {error}")
    raise AssertionError(f"{sentence!r} can be written")


def _checked_layout(sentence: Sentence) -> _Layout:
    if not _may_say(sentence.talker, type(sentence)):
        raise SentenceError(f"{sentence.TYPE}: talker {sentence.talker!r}, expected two capitals or digits")
    return _LAYOUTS[sentence.TYPE]


class Splitter:
    """Cuts a stream of bytes into lines that may be sentences; the same ones however the bytes arrive.

    A line ends with CR, LF or both and starts with `$` or `!`. A `$` inside a line starts anew: what it cuts
    off is damaged, as is a line of more than 120 bytes. Other lines (comments, rubbish) are skipped.
    """

    def __init__(self) -> None:
        self.damaged = 0
        """How many beginnings and remains of lines were thrown away."""
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Take the next bytes and return the lines that they complete, without their ends."""
        *ended, rest = _LINE_END.split(self._rest + data)
        lines = []
        for text in ended:
            line = self._after_last_dollar(text)
            if line.startswith((b"$", b"!")):
                if len(line) <= MAX_LENGTH:
                    lines.append(line)
                else:
                    self.damaged += 1
        # One byte more than allowed is enough to know later that the line is too long.
        self._rest = self._after_last_dollar(rest)[: MAX_LENGTH + 1]
        return lines

    def _after_last_dollar(self, text: bytes) -> bytes:
        """Return the text from its last `$` on and count the pieces before it as damaged."""
        *cut, last = _BEFORE_DOLLAR.split(text)
        self.damaged += sum(1 for piece in cut if piece)
        return last


_LINE_END: Final = re.compile(rb"[\r\n]")
_BEFORE_DOLLAR: Final = re.compile(rb"(?=\$)")
