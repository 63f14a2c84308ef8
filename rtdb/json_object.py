"""JSON objects: what components write that have no record, such as a student's first module or a browser.

    schema = json_schema(1000)                                  # at most 1000 bytes of JSON
    payload = schema.pack({"speed_mps": 1.5, "wheels": [{"slip": False}]})
    number_at(schema.unpack(payload), "/speed_mps", "m/s", low=-3, high=8)      # 1.5

In the store and in recordings it is a record with a single text, of unit "JSON", that holds one JSON object. Without a
record nobody has declared units, so the reader asks for one: it stands in the key (`speed_mps`), or in the wiring. A
bool is no number, nor is a string.
"""

import functools
import json
import math
import re
from collections.abc import Sequence
from typing import Any

from .errors import RecordError
from .layout import Field, Spec
from .records import Record, Schema

NAME, TEXT, UNIT = "Json", "json", "JSON"
MAX_DEPTH = 64  # of lists and objects in each other


class JsonSchema(Schema):
    """The schema of a JSON object: packs dictionaries, unpacks to dictionaries."""

    def __init__(self, name: str, doc: str, fields: list[Field], cls: type[Record] | None = None) -> None:
        super().__init__(name, doc, fields, cls)
        self.pack = self._pack
        self.unpack = self._unpack

    def _pack(self, document: Any) -> bytes:
        if not isinstance(document, dict):
            raise RecordError(f"a JSON object is packed from a dict, got {type(document).__name__}: {document!r:.60}")
        _check(document, "", 0)
        data = json.dumps(document, ensure_ascii=False, separators=(",", ":")).encode()
        n = self.fields[0].spec.n
        if len(data) > n:
            raise RecordError(f"this JSON takes {len(data)} bytes, the object has {n}; say less, or give it more room")
        return data.ljust(self.size, b"\0")

    def _unpack(self, payload: bytes) -> dict[str, Any]:
        try:
            return loads(bytes(payload).rstrip(b"\0").decode())
        except UnicodeDecodeError as error:
            raise RecordError(f"not JSON: byte {error.start} is not UTF-8") from error


def json_payload(data: bytes, size: int) -> bytes:
    """Give the payload of a JSON object whose text somebody wrote, as it was written."""
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        raise RecordError(f"not JSON: byte {error.start} is not UTF-8") from error
    _check(loads(text), "", 0)
    if len(data) > size:
        raise RecordError(f"this JSON takes {len(data)} bytes, the object has {size}; say less, or give it more room")
    return data.ljust(size, b"\0")


@functools.cache
def json_schema(n_bytes: int) -> JsonSchema:
    """Give the schema of a JSON object of at most n bytes."""
    field = Field(TEXT, Spec("str", UNIT, "the object as text", n_bytes), 1)
    return JsonSchema(NAME, "An object without a record: JSON.", [field])


def is_json(fields: Sequence[Field]) -> bool:
    """Tell whether these are the fields of a JSON object."""
    return [(f.name, f.spec.kind, f.spec.unit) for f in fields] == [(TEXT, "str", UNIT)]


def _check(value: Any, pointer: str, depth: int) -> None:
    """Refuse what is no JSON, by its pointer: json.dumps would write NaN, and make strings of other keys."""
    where = pointer or "the object"
    if depth > MAX_DEPTH:
        raise RecordError(f"{where}: more than {MAX_DEPTH} lists and objects in each other")
    if isinstance(value, dict):
        for key, item in value.items():
            if not isinstance(key, str):
                raise RecordError(f"{where} has the key {key!r}; keys are strings")
            _check_text(key, where)
            _check(item, f"{pointer}/{_escaped(key)}", depth + 1)
    elif isinstance(value, list | tuple):
        for k, item in enumerate(value):
            _check(item, f"{pointer}/{k}", depth + 1)
    elif isinstance(value, str):
        _check_text(value, where)
    elif isinstance(value, float):
        if not math.isfinite(value):
            raise RecordError(f"{where} is {value}, which JSON cannot say; leave the key out, or write null")
    elif isinstance(value, int):
        if value.bit_length() > 1023:
            raise RecordError(f"{where} is an integer of {value.bit_length()} bits, larger than any double")
    elif value is not None:
        raise RecordError(f"{where} is a {type(value).__name__}; JSON has dict, list, str, float, int, bool and None")


def _check_text(text: str, where: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise RecordError(f"{where}: {text!r:.60} is no Unicode text") from error


class _NotFinite(Exception):
    """A number in a text is NaN, infinite or too large for a double."""


def _finite(literal: str) -> float:
    value = float(literal)
    if not math.isfinite(value):
        raise _NotFinite(literal)
    return value


_DECODER = json.JSONDecoder(parse_constant=_finite, parse_float=_finite)


def loads(text: str) -> dict[str, Any]:
    """Read one JSON object. NaN and infinity are no JSON."""
    try:
        document = _DECODER.decode(text)
    except json.JSONDecodeError as error:
        near = text[max(0, error.pos - 10) : error.pos + 10]
        raise RecordError(f"not JSON: {error.msg} at character {error.pos}, near {near!r}") from error
    except _NotFinite as error:
        literal = str(error)
        tokens = re.finditer(r'"(?:[^"\\]|\\.)*"|' + re.escape(literal), text)  # not inside a string
        pos = next(token.start() for token in tokens if token[0] == literal)
        raise RecordError(f"not JSON: {literal} at character {pos} is no finite number") from error
    except RecursionError as error:
        raise RecordError(f"not JSON: too many brackets in each other, from character 0: {text[:20]!r}") from error
    except ValueError as error:  # a whole number of thousands of digits
        raise RecordError(f"not JSON: {error}") from error
    if not isinstance(document, dict):
        raise RecordError(f"a JSON object is expected, got {_kind(document)} at character 0: {text[:40]!r}")
    return document


# -- numbers with units -----------------------------------------------------------------------------------------------

UNIT_OF_SUFFIX = {
    "m": "m",
    "m2": "m2",
    "s": "s",
    "ns": "ns",
    "rad": "rad",
    "mps": "m/s",
    "mps2": "m/s2",
    "radps": "rad/s",
    "radps2": "rad/s2",
    "nm": "N m",
    "n": "N",
    "kg": "kg",
    "hz": "Hz",
    "v": "V",
    "a": "A",
    "w": "W",
    # units that ours are mistaken for: known, so that nobody reads them as something else
    "mm": "mm",
    "cm": "cm",
    "km": "km",
    "ft": "ft",
    "ms": "ms",
    "us": "us",
    "deg": "deg",
    "degps": "deg/s",
    "kmh": "km/h",
    "kph": "km/h",
    "mph": "mph",
    "kn": "kn",
    "rpm": "rpm",
    "pct": "%",
}


def unit_of_key(key: str) -> str | None:
    """Give the unit that stands at the end of a key, as m/s in `speed_mps`; None where there is none."""
    _, underscore, suffix = key.rpartition("_")
    return UNIT_OF_SUFFIX.get(suffix) if underscore else None


def number_at(
    document: Any,
    pointer: str,
    unit: str,
    *,
    low: float | None = None,
    high: float | None = None,
    unit_in_wiring: str | None = None,
) -> float:
    """Read the number at a JSON pointer (RFC 6901), which must be in a unit and within [low, high].

    The unit stands in the key, that of the list for an element of a list, or in the wiring; where it stands in both
    they must agree. What is dimensionless has the unit "1" in the wiring.
    """
    value, key = _resolve(document, pointer)
    _check_unit(pointer, key, unit, unit_in_wiring)
    if isinstance(value, bool) or not isinstance(value, int | float):
        shown = f" {value!r:.60}" if isinstance(value, bool | str) else ""
        raise RecordError(f"{pointer}: a number [{unit}] is expected, got {_kind(value)}{shown}; write a bare number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise RecordError(
            f"{pointer}: a finite number [{unit}] is expected, got {value!r:.60}; leave out what is unknown"
        )
    if (low is not None and number < low) or (high is not None and number > high):
        bounds = f"[{'-inf' if low is None else f'{low:g}'}, {'inf' if high is None else f'{high:g}'}]"
        raise RecordError(f"{pointer}: a number in {bounds} {unit} is expected, got {number!r}; check who writes it")
    return number


def _check_unit(pointer: str, key: str, unit: str, unit_in_wiring: str | None) -> None:
    in_key = unit_of_key(key)
    if in_key is None and unit_in_wiring is None:
        suffix = next((f"_{suffix}" for suffix, known in UNIT_OF_SUFFIX.items() if known == unit), None)
        advice = f"call it {key}{suffix}, or " if suffix and key else ""
        raise RecordError(
            f"{pointer}: {unit} is expected, but the key names no unit; {advice}say the unit in the wiring"
        )
    for place, said in (("key", in_key), ("wiring", unit_in_wiring)):
        if said not in (None, unit):
            raise RecordError(f"{pointer}: {unit} is expected, the {place} says {said}; have the writer convert it")


def _resolve(document: Any, pointer: str) -> tuple[Any, str]:
    """Follow a pointer; returns the value and the last key on the way, "" where there was none."""
    if pointer and not pointer.startswith("/"):
        raise RecordError(f"pointer {pointer!r} begins with no /; try {'/' + pointer!r}")
    value, key, done = document, "", ""
    for raw in pointer.split("/")[1:]:
        if re.search(r"~(?![01])", raw):
            raise RecordError(f"pointer {pointer!r}: after ~ comes 0 (for ~) or 1 (for /)")
        token = raw.replace("~1", "/").replace("~0", "~")
        there = f"in {done}" if done else "in the object"
        if isinstance(value, dict):
            if token not in value:
                raise RecordError(f"{pointer}: there is no key {token!r} {there}; {_listed(value)}")
            value, key = value[token], token
        elif isinstance(value, list | tuple):
            if not re.fullmatch(r"0|[1-9][0-9]{0,9}", token) or int(token) >= len(value):
                raise RecordError(f"{pointer}: there is no element {token!r} {there}, a list of {len(value)} from 0 on")
            value = value[int(token)]
        else:
            raise RecordError(f"{pointer}: {done} is {_kind(value)}, there is nothing called {token!r} in it")
        done = f"{done}/{raw}"
    return value, key


def _listed(document: dict[str, Any]) -> str:
    keys = [f"/{_escaped(key)}" for key in document]
    return f"there is {', '.join(keys[:12])}{', ...' if len(keys) > 12 else ''}" if keys else "it is empty"


def _escaped(key: str) -> str:
    return key.replace("~", "~0").replace("/", "~1")


def _kind(value: Any) -> str:
    names = {dict: "an object", list: "a list", tuple: "a list", str: "a string", bool: "a bool", type(None): "null"}
    return names.get(type(value), "a number" if isinstance(value, int | float) else f"a {type(value).__name__}")
