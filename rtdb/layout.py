"""Where the fields of a record lie: little-endian and naturally aligned, as a C compiler places them.

typedef struct {                                 offset
    int64_t   t_ns;                                   0
    fw_Point  where;             (two doubles)        8   a record inside a record; all records align to 8
    uint32_t  marks_n;                               24   a sequence: how many are used,
    double    marks[4];                              32   then room for all
    uint32_t  pixels_h, pixels_w, pixels_c;          64   an image: the used extent,
    uint8_t   pixels[480][640][3];                   76   then room for the largest; used is the corner
} fw_Frame;                                                pixels[:pixels_h, :pixels_w, :pixels_c]
"""

import keyword
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import TYPE_CHECKING, Any

from .errors import RecordError

if TYPE_CHECKING:
    import numpy as np

    from .records import Schema

Extent = tuple[int, int, int]  # of an image: height, width, channels
MAX_BYTES = 1 << 28  # of a record
MAX_DEPTH = 8  # of records in records
MAX_NUMBER = 999  # of a protobuf field; behind it stand the causes of a write


@dataclass(frozen=True, slots=True)
class Kind:
    """How a value is stored: its struct code, alignment in bytes, numpy and C type, protobuf type and wire type."""

    code: str
    size: int
    numpy: str
    c: str
    proto: str
    wire: int


KINDS = {
    "f8": Kind("d", 8, "<f8", "double", "double", 1),
    "f4": Kind("f", 4, "<f4", "float", "float", 5),
    "i64": Kind("q", 8, "<i8", "int64_t", "sfixed64", 1),
    "u64": Kind("Q", 8, "<u8", "uint64_t", "fixed64", 1),
    "i32": Kind("i", 4, "<i4", "int32_t", "sfixed32", 5),
    "u32": Kind("I", 4, "<u4", "uint32_t", "fixed32", 5),
    "i16": Kind("h", 2, "<i2", "int16_t", "sfixed32", 5),
    "u16": Kind("H", 2, "<u2", "uint16_t", "fixed32", 5),
    "i8": Kind("b", 1, "i1", "int8_t", "sfixed32", 5),
    "u8": Kind("B", 1, "u1", "uint8_t", "fixed32", 5),
    "bool": Kind("?", 1, "?", "bool", "bool", 0),
    "enum": Kind("B", 1, "u1", "uint8_t", "enum", 0),
    "str": Kind("s", 1, "S", "char", "string", 2),
    "image": Kind("B", 1, "u1", "uint8_t", "message", 2),
    "record": Kind("", 8, "", "", "message", 2),
}
_ALONE = ("enum", "str", "image")  # kinds that do not come as arrays and sequences
_SHAPES = ("one", "array", "seq")


@dataclass(frozen=True, slots=True)
class Spec:
    """What a field's annotation says. `n`: capacity; `shape`: "one", "array" (exactly n) or "seq" (up to n).

    low, high: range of its values, ends included. The store keeps any value; who runs modules holds them to it.
    """

    kind: str
    unit: str
    doc: str
    n: int = 1
    shape: str = "one"
    extent: Extent | None = None  # of the largest image
    low: float = -math.inf
    high: float = math.inf


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a schema, with its place in the C layout and its protobuf number."""

    name: str
    spec: Spec
    number: int
    offset: int = 0
    values: tuple[tuple[str, int], ...] = ()  # of an enum
    enum: type[IntEnum] | None = field(default=None, compare=False)  # its class, where it is known
    inner: "Schema | None" = field(default=None, compare=False)  # of a record

    @property
    def record(self) -> "Schema":
        """The schema of a field that is a record."""
        assert self.inner is not None
        return self.inner

    @property
    def extent(self) -> Extent:
        """The largest extent of a field that is an image."""
        assert self.spec.extent is not None
        return self.spec.extent

    @property
    def counts(self) -> tuple[str, ...]:
        """Names of the u32 in front of the data that say how much of it is used."""
        if self.spec.kind == "image":
            return f"{self.name}_h", f"{self.name}_w", f"{self.name}_c"
        return (f"{self.name}_n",) if self.spec.shape == "seq" else ()

    @property
    def align(self) -> int:
        """Natural alignment in bytes."""
        return max(4 if self.counts else 1, KINDS[self.spec.kind].size)

    @property
    def data_offset(self) -> int:
        """Offset of the first element: behind the counts."""
        item = KINDS[self.spec.kind].size
        return self.offset + -(-4 * len(self.counts) // item) * item

    @property
    def size(self) -> int:
        """Bytes in the C layout, without padding."""
        item = self.record.size if self.spec.kind == "record" else KINDS[self.spec.kind].size
        return self.data_offset - self.offset + item * self.spec.n

    @property
    def dimensions(self) -> tuple[int, ...]:
        """Shape of the data as an array; () for one value."""
        return self.spec.extent or ((self.spec.n,) if self.spec.shape != "one" else ())

    @property
    def n_values(self) -> int:
        """How many values `struct.unpack` gives for it; images and many records are left to a view."""
        if self.spec.kind == "record" and self.spec.shape == "one":
            return sum(f.n_values for f in self.record.fields)
        if self.spec.kind in ("record", "image"):
            return len(self.counts)
        return len(self.counts) + (1 if self.spec.kind == "str" else self.spec.n)


def place(name: str, fields: Sequence[Field]) -> tuple[tuple[Field, ...], int]:
    """Give the fields their offsets; returns them and the record's size, a multiple of 8."""
    placed: list[Field] = []
    end = 0
    for f in fields:
        _check(name, f)
        offset = -(-end // f.align) * f.align
        placed.append(replace(f, offset=offset))
        end = placed[-1].offset + placed[-1].size
        if end > MAX_BYTES:
            raise RecordError(f"{name}.{f.name} makes the record larger than {MAX_BYTES} bytes")
    _check_names(name, placed)
    return tuple(placed), -(-end // 8) * 8


# -- what no record may be: a declaration may come from a damaged or hostile file -------------------------------------

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def _is_name(name: str) -> bool:
    return bool(_NAME.fullmatch(name)) and not keyword.iskeyword(name)


def _whole(value: object, low: int, high: int) -> bool:
    return type(value) is int and low <= value <= high


def _check(record: str, f: Field) -> None:
    """Refuse a field that has no layout, in C or in protobuf."""
    spec, at = f.spec, f"{record}.{f.name}"
    if not _is_name(f.name):
        raise RecordError(f"{at}: a field's name is letters, digits and _")
    if spec.kind not in KINDS:
        raise RecordError(f"{at}: there is no kind {spec.kind!r}; there are {', '.join(KINDS)}")
    if spec.shape not in _SHAPES or (spec.kind in _ALONE and spec.shape != "one"):
        raise RecordError(f"{at}: {spec.kind} does not come as {spec.shape!r}")
    if not _whole(spec.n, 1, MAX_BYTES) or (spec.shape == "one" and spec.kind not in ("str", "image") and spec.n != 1):
        raise RecordError(f"{at}: a capacity of {spec.n!r} makes no sense")
    if not _whole(f.number, 1, MAX_NUMBER):
        raise RecordError(f"{at}: a field number is 1..{MAX_NUMBER}, got {f.number!r}")
    if (f.inner is None) != (spec.kind != "record"):
        raise RecordError(f"{at}: a nested record, and only that, has fields of its own")
    (spec.unit + spec.doc).encode()  # raises for what is no text
    _check_range(at, spec)
    _check_extent(at, spec)
    _check_values(at, f)


def _check_range(at: str, spec: Spec) -> None:
    if not (isinstance(spec.low, int | float) and isinstance(spec.high, int | float) and spec.low <= spec.high):
        raise RecordError(f"{at}: a range from {spec.low!r} to {spec.high!r} holds nothing")
    if (spec.low, spec.high) != (-math.inf, math.inf) and spec.kind in (*_ALONE, "bool", "record"):
        raise RecordError(f"{at}: {spec.kind} has no range; numbers have")


def _check_extent(at: str, spec: Spec) -> None:
    extent: tuple[int, ...] | None = spec.extent  # of any length, when it comes from a file
    if spec.kind != "image" and extent is None:
        return
    if spec.kind != "image" or extent is None or len(extent) != 3:
        raise RecordError(f"{at}: {spec.kind} of extent {extent!r}; an image, and only that, has three")
    if not all(_whole(n, 1, MAX_BYTES) for n in extent) or math.prod(extent) != spec.n:
        raise RecordError(f"{at}: an image of extent {extent!r} and {spec.n!r} bytes makes no sense")


def _check_values(at: str, f: Field) -> None:
    numbers = [number for _, number in f.values]
    if (f.spec.kind == "enum") != bool(numbers):
        raise RecordError(f"{at}: an enum, and only that, has values")
    if not all(_whole(number, 0, 127) for number in numbers):
        raise RecordError(f"{at}: enum8 holds values 0..127")
    if numbers and 0 not in numbers:
        raise RecordError(f"{at}: an enum needs a value 0, which protobuf takes for absent")
    if len(set(numbers)) != len(numbers) or not all(_NAME.fullmatch(name) for name, _ in f.values):
        raise RecordError(f"{at}: the values of an enum have names of letters, digits and _, each a number of its own")


def _check_names(record: str, fields: Sequence[Field]) -> None:
    """Refuse two things of one name: numpy, C and protobuf make names from those of the fields."""
    if not _is_name(record):
        raise RecordError(f"{record!r}: a record's name is letters, digits and _")
    if not fields:
        raise RecordError(f"{record} has no fields; a record needs one")
    names = Counter(["causes"])
    for f in fields:
        names.update([f.name, *f.counts])
        if f.spec.kind in ("enum", "image"):
            names.update([type_name(f), *(f"{f.name}_{value}" for value, _ in f.values)])
    names.update({type_name(f) for f in fields if f.spec.kind == "record"})
    twice = [name for name, n in names.items() if n > 1]
    if twice:
        raise RecordError(f"{record}: {', '.join(twice)} would stand for two things; rename a field")
    if len({f.number for f in fields}) != len(fields):
        raise RecordError(f"{record}: two fields have the same number")
    known: dict[str, str] = {record: ""}
    for f in fields:
        for inner in nested_in(f.record) if f.spec.kind == "record" else ():
            if known.setdefault(inner.name, inner.to_text()) != inner.to_text():
                raise RecordError(f"{record}.{f.name}: there are two records called {inner.name} in it; rename one")


def nested_in(schema: "Schema") -> list["Schema"]:
    """List a schema and all that are nested in it, the innermost first."""
    inner = [s for f in schema.fields if f.spec.kind == "record" for s in nested_in(f.record)]
    return [*inner, schema]


def type_name(f: Field) -> str:
    """Name of the protobuf type that a field brings along, inside its record's message."""
    return f.record.name if f.spec.kind == "record" else f"{f.name}_{'values' if f.spec.kind == 'enum' else 'image'}"


# -- the layout, said in other languages ------------------------------------------------------------------------------


def struct_format(schema: "Schema", blob: str) -> str:
    """Give the layout to `struct`. blob: what images and many records are, "s" (bytes) or "x" (left out)."""
    return "<" + _format(schema, blob)


def _format(schema: "Schema", blob: str) -> str:
    parts, end = [], 0
    for f in schema.fields:
        parts.append("x" * (f.offset - end) + "I" * len(f.counts))
        parts.append("x" * (f.data_offset - f.offset - 4 * len(f.counts)))
        if f.spec.kind == "record" and f.spec.shape == "one":
            parts.append(_format(f.record, blob))
        elif f.spec.kind in ("record", "image"):
            parts.append(f"{f.offset + f.size - f.data_offset}{blob}")
        else:
            parts.append(f"{f.spec.n}{KINDS[f.spec.kind].code}")
        end = f.offset + f.size
    return "".join([*parts, "x" * (schema.size - end)])


def dtype(schema: "Schema") -> "np.dtype[Any]":
    """Give the layout to numpy."""
    import numpy as np

    names: list[str] = []
    formats: list[Any] = []
    offsets: list[int] = []
    for f in schema.fields:
        item: Any = dtype(f.record) if f.spec.kind == "record" else KINDS[f.spec.kind].numpy
        names += [*f.counts, f.name]
        formats += ["<u4"] * len(f.counts)
        formats.append(f"S{f.spec.n}" if f.spec.kind == "str" else (item, f.dimensions) if f.dimensions else item)
        offsets += [*(f.offset + 4 * k for k in range(len(f.counts))), f.data_offset]
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": schema.size})


def c_structs(schema: "Schema") -> dict[str, str]:
    """Give the layout to C: structs by the names of their records, the innermost first."""
    return {s.name: _c_struct(s) for s in nested_in(schema)}


def _c_struct(schema: "Schema") -> str:
    lines = [f"/* {_comment(schema.doc.splitlines()[0] if schema.doc else schema.name)} */", "typedef struct {"]
    for k, f in enumerate(schema.fields):
        align = "_Alignas(8) " if k == 0 else ""  # the size is a multiple of 8
        if f.spec.shape == "seq" and k > 0:
            align = f"_Alignas({f.align}) "  # the count of a sequence of doubles
        for count in f.counts:
            lines.append(f"    {align}uint32_t {count};")
            align = ""
        many = "".join(f"[{n}]" for n in ((f.spec.n,) if f.spec.kind == "str" else f.dimensions))
        unit = f"[{f.spec.unit}] " if f.spec.unit else ""
        c = f"fw_{f.record.name}" if f.spec.kind == "record" else KINDS[f.spec.kind].c
        lines.append(f"    {align}{c} {f.name}{many}; /* {_comment(unit + f.spec.doc)} */")
    name = schema.name
    lines += [f"}} fw_{name};", f'_Static_assert(sizeof(fw_{name}) == {schema.size}, "{name}");']
    return "\n".join(lines)


def _comment(words: str) -> str:
    return words.replace("*/", "* /").replace("\n", " ")
