"""Records: what objects hold. A record is declared once, as a typed class with unit and meaning on each field:

    class Pose(Record):
        '''Pose of the cart in the map.'''
        x_m: Annotated[float, f8("m", "east of the map's origin")]
        speed_mps: Annotated[float, f8("m/s", "forward", low=-2, high=8)] = 0.0     # no part of what must agree
        quality: Annotated[Quality, enum8("kind of fix")] = Quality.NONE
        at: Annotated[Point, nested("the front axle")] = Point()
        outline: Annotated[tuple[Point, ...], nested("corners, counter-clockwise", at_most=8)] = ()

    class Frame(Record, eq=False):                                   # arrays have no plain equality
        pixels: Annotated[np.ndarray, image(480, 640, 3, "BGR")]     # uint8 (h, w, c), each at most that

From the declaration follow a fixed little-endian C layout, the object that modules hold (a frozen msgspec struct), a
numpy view, JSON, protobuf for recordings, and a C header. Field numbers of protobuf stand in a lock file beside the
module that declares the records (`signals.py` -> `signals.lock.json`); it only ever grows, so that old recordings stay
readable: a field that was added takes its default, one that was removed is ignored, and one whose type or unit
changed is an error that names it. In our own reader names link the fields, so that one that was renamed was removed
and added.

`layout.py` places the fields, `packing.py` makes bytes of records and back, `protobuf.py` makes messages of them.
"""

import functools
import hashlib
import json
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol, TypeVar, get_args, get_origin, get_type_hints

import msgspec

from . import layout, protobuf
from .errors import RecordError
from .layout import KINDS, MAX_DEPTH, Field, Kind, Spec
from .packing import compile_pack, compile_unpack
from .protobuf import CAUSES_NUMBER, causes_to_proto

if TYPE_CHECKING:
    import numpy as np
    from google.protobuf.descriptor_pb2 import FileDescriptorProto

__all__ = [
    "CAUSES_NUMBER",
    "KINDS",
    "Field",
    "Kind",
    "Record",
    "Schema",
    "Spec",
    "array",
    "causes_to_proto",
    "enum8",
    "f4",
    "f8",
    "flag",
    "frame_of",
    "i8",
    "i16",
    "i32",
    "i64",
    "image",
    "lock_path",
    "nested",
    "schema_of",
    "seq",
    "text",
    "u8",
    "u16",
    "u32",
    "u64",
]

R = TypeVar("R", bound="Record")


class Record(msgspec.Struct, frozen=True, gc=False):
    """Base of all records. Instances are immutable values."""


# -- declarations -----------------------------------------------------------------------------------------------------


class _Scalar(Protocol):
    def __call__(self, unit: str, doc: str, *, low: float = ..., high: float = ...) -> Spec: ...


def _scalar(kind: str) -> _Scalar:
    def declare(unit: str, doc: str, *, low: float = -math.inf, high: float = math.inf) -> Spec:
        return Spec(kind, unit, doc, low=low, high=high)

    return declare


f8, f4 = _scalar("f8"), _scalar("f4")
i64, i32, i16, i8 = _scalar("i64"), _scalar("i32"), _scalar("i16"), _scalar("i8")
u64, u32, u16, u8 = _scalar("u64"), _scalar("u32"), _scalar("u16"), _scalar("u8")


def flag(doc: str) -> Spec:
    """Declare a bool."""
    return Spec("bool", "", doc)


def enum8(doc: str) -> Spec:
    """Declare an IntEnum with values 0..127."""
    return Spec("enum", "", doc)


def text(n: int, doc: str) -> Spec:
    """Declare a string of at most n bytes of UTF-8."""
    return Spec("str", "", doc, n)


def array(kind: str, n: int, unit: str, doc: str) -> Spec:
    """Declare a tuple of exactly n scalars."""
    return Spec(kind, unit, doc, n, "array")


def seq(kind: str, n: int, unit: str, doc: str) -> Spec:
    """Declare a tuple of at most n scalars."""
    return Spec(kind, unit, doc, n, "seq")


def nested(doc: str, *, at_most: int = 0, exactly: int = 0) -> Spec:
    """Declare a record in a record; with `at_most` or `exactly` a tuple of records."""
    n, shape = (at_most, "seq") if at_most else (exactly, "array") if exactly else (1, "one")
    return Spec("record", "", doc, n, shape)


def image(height: int, width: int, channels: int, doc: str) -> Spec:
    """Declare a uint8 array (h, w, c) of at most that extent. It is read back as a view on the payload, read-only."""
    return Spec("image", "", doc, height * width * channels, extent=(height, width, channels))


# -- schemas ----------------------------------------------------------------------------------------------------------


class Schema:
    """The layout of a record. Made from a class, or from the text that a store or a recording carries."""

    def __init__(self, name: str, doc: str, fields: list[Field], cls: type[Record] | None = None) -> None:
        self.name, self.doc, self.cls = name, doc, cls
        self._dtype: np.dtype[Any] | None = None
        self.fields, self.size = layout.place(name, fields)
        self.pack: Callable[[Any], bytes] = compile_pack(self)
        self.unpack: Callable[[bytes], Any] = compile_unpack(self)
        self.to_proto: Callable[[bytes], bytes] = protobuf.compile_proto(self)

    def to_text(self) -> str:
        """Describe the schema as JSON; `Schema.from_text` reads it back."""
        return json.dumps(self._described(), separators=(",", ":"))

    def _described(self) -> dict[str, Any]:
        fields = []
        for f in self.fields:
            said: dict[str, Any] = {"name": f.name, "kind": f.spec.kind, "unit": f.spec.unit, "doc": f.spec.doc}
            said |= {"n": f.spec.n, "shape": f.spec.shape, "number": f.number, "values": dict(f.values)}
            if f.spec.extent:
                said["extent"] = f.spec.extent
            said |= {end: value for end in ("low", "high") if math.isfinite(value := getattr(f.spec, end))}
            if f.inner:
                said["record"] = f.inner._described()
            fields.append(said)
        return {"name": self.name, "doc": self.doc, "size": self.size, "fields": fields}

    @classmethod
    def from_text(cls, text: str) -> "Schema":
        """Make a schema without its class: values unpack to dictionaries."""
        try:
            return _schema_from(json.loads(text), 1)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise RecordError(f"schema text is damaged ({error}): {text[:60]!r}") from error

    @property
    def hash(self) -> str:
        """Hash of what two programs must agree on: names, kinds, sizes, units, offsets, and the values of enums."""
        lines = [self.name]
        for f in self.fields:
            lines.append(f"{f.name} {f.spec.kind} {f.spec.shape} {f.spec.n} {f.spec.unit} {f.offset}")
            lines += [f"{f.name} {number} {value}" for value, number in sorted(f.values, key=lambda item: item[1])]
            lines += [f"{f.name} {f.spec.extent}"] if f.spec.extent else [f"{f.name} {f.inner.hash}"] if f.inner else []
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]

    def check_fits(self, other: "Schema", source: str, path: str = "") -> None:
        """Refuse `other` (of an older recording or client) if a field of the same name means something else.

        And if a field that is not in it has no default.
        """
        mine = {f.name: f for f in self.fields}
        for info in msgspec.structs.fields(self.cls) if self.cls is not None else ():
            if info.required and info.name not in {f.name for f in other.fields}:
                raise RecordError(f"{source} has no field {path or self.name}.{info.name}, which has no default")
        for old in other.fields:
            new, name = mine.get(old.name), f"{path or self.name}.{old.name}"
            if new is None:
                continue
            if _meaning(new) != _meaning(old):
                raise RecordError(
                    f"{source}: field {name} was {_meaning(old)} and is now {_meaning(new)}; a changed meaning needs a "
                    f"new field name"
                )
            for value, number in old.values:
                if dict(new.values).get(value, number) != number:
                    raise RecordError(
                        f"{source}: {value} of field {name} was {number} and is now {dict(new.values)[value]}; the "
                        f"numbers of an enum do not change"
                    )
            if new.inner and old.inner:
                new.inner.check_fits(old.inner, source, name)

    def reader(self, cls: type[R], source: str) -> Callable[[bytes], R]:
        """Make the function that unpacks payloads of this schema to another version of the record, linked by names.

        A field that was added takes its default, one that was removed is ignored. source: for the error where the
        two do not fit, or are different records altogether.
        """
        wanted = schema_of(cls)
        if self.name != wanted.name:
            raise RecordError(f"{source} holds a {self.name}, not a {wanted.name}")
        wanted.check_fits(self, source)
        return compile_unpack(self, wanted)

    def dtype(self) -> "np.dtype[Any]":
        """Give the numpy structured dtype of the C layout.

        A seq also has a field `<name>_n`, an image the fields `<name>_h`, `<name>_w` and `<name>_c`.
        """
        if self._dtype is None:  # some 10 us
            self._dtype = layout.dtype(self)
        return self._dtype

    def c_struct(self) -> str:
        """Give the record as a C struct, behind those of the records in it."""
        return "\n".join(self.c_structs().values())

    def c_structs(self) -> dict[str, str]:
        """Give the C structs by the names of their records, for a header that declares each of them once."""
        return layout.c_structs(self)

    def file_descriptor(self) -> "FileDescriptorProto":
        """Give the protobuf file of this record: message `fairway.<name>`, with room for the causes of a write."""
        return protobuf.file_descriptor(self)


def _meaning(f: Field) -> str:
    many = f"{f.spec.shape} of {f.spec.n}" if f.spec.shape == "array" else f.spec.shape
    return f"{f.spec.kind} {many} [{f.spec.unit}]"


def _schema_from(raw: dict[str, Any], depth: int) -> Schema:
    """Make a schema of parsed JSON; what is wrong with it raises, one way or another."""
    from .json_object import JsonSchema, is_json

    if depth > MAX_DEPTH:
        raise RecordError(f"more than {MAX_DEPTH} records in each other")
    fields = []
    for f in raw["fields"]:
        extent = tuple(f["extent"]) if "extent" in f else None
        low, high = f.get("low", -math.inf), f.get("high", math.inf)
        spec = Spec(f["kind"], f["unit"], f["doc"], f["n"], f["shape"], extent, low, high)
        inner = _schema_from(f["record"], depth + 1) if "record" in f else None
        fields.append(Field(f["name"], spec, f["number"], values=tuple(f["values"].items()), inner=inner))
    made = JsonSchema if depth == 1 and is_json(fields) else Schema
    schema = made(raw["name"], raw["doc"], fields)
    if raw["size"] != schema.size:
        raise RecordError(f"the fields of {schema.name} take {schema.size} bytes, not {raw['size']}")
    return schema


def frame_of(schema: Schema, buffer: "bytes | memoryview") -> "np.ndarray[Any, np.dtype[np.void]]":
    """View a payload or an open slot as a structured array of shape (), writable if the buffer is.

        frame = frame_of(writer.schema, slot)
        frame["pixels"][:h, :w] = picture                  # in place: no copy besides this one
        frame["pixels_h"], frame["pixels_w"], frame["pixels_c"] = h, w, 3
        frame["camera"]["x_m"] = 1.5                       # of a nested record

    A slot holds what an earlier write left in it: set every field. The view is good as long as the buffer.
    """
    import numpy as np

    if memoryview(buffer).nbytes < schema.size:
        raise RecordError(f"a {schema.name} takes {schema.size} bytes, the buffer has {memoryview(buffer).nbytes}")
    return np.frombuffer(buffer, schema.dtype(), 1).reshape(())


@functools.cache
def schema_of(cls: type[Record] | Schema) -> Schema:
    """Give the schema of a record class; a schema is its own."""
    return cls if isinstance(cls, Schema) else _schema_of(cls, ())


def _schema_of(cls: type[Record], around: tuple[type[Record], ...]) -> Schema:
    if cls in around or len(around) >= MAX_DEPTH:
        path = " in ".join(c.__name__ for c in (cls, *reversed(around)))
        raise RecordError(f"{path}: a record cannot contain itself, nor more than {MAX_DEPTH} in each other")
    hints = get_type_hints(cls, include_extras=True)
    numbers = _numbers(cls)
    fields = []
    for k, name in enumerate(cls.__struct_fields__):
        hint = hints[name]
        spec = (
            next((m for m in get_args(hint)[1:] if isinstance(m, Spec)), None)
            if get_origin(hint) is Annotated
            else None
        )
        if spec is None:
            raise RecordError(f"{cls.__name__}.{name} needs a declaration: Annotated[{hint!r:.30}, f8(unit, meaning)]")
        if numbers is not None and name not in numbers:
            raise RecordError(
                f"{cls.__name__}.{name} has no field number; add it: python -m rtdb.lock {cls.__module__}"
            )
        if spec.kind == "image" and cls.__struct_config__.eq:
            raise RecordError(
                f"{cls.__name__}.{name} is an array, which has no plain equality; "
                f"declare class {cls.__name__}(Record, eq=False)"
            )
        field = Field(name, spec, k + 1 if numbers is None else numbers[name])
        typed, at = get_args(hint)[0], f"{cls.__name__}.{name}"
        if spec.kind == "enum":
            field = _with_enum(field, typed, at)
        elif spec.kind == "record":
            field = _with_record(field, typed, at, (*around, cls))
        fields.append(field)
    return Schema(cls.__name__, (cls.__doc__ or "").strip(), fields, cls)


def _with_enum(field: Field, typed: Any, at: str) -> Field:
    if not (isinstance(typed, type) and issubclass(typed, IntEnum)):
        raise RecordError(f"{at} is declared with enum8 but typed {typed!r}; it needs an IntEnum")
    return replace(field, values=tuple((e.name, e.value) for e in typed), enum=typed)


def _with_record(field: Field, typed: Any, at: str, around: tuple[type[Record], ...]) -> Field:
    if field.spec.shape != "one" and get_origin(typed) is tuple:
        typed = get_args(typed)[0]
    elif field.spec.shape != "one":
        typed = None
    if not (isinstance(typed, type) and issubclass(typed, Record)):
        raise RecordError(f"{at} is declared with nested; type it as a Record, or a tuple[Record, ...] of many")
    return replace(field, inner=_schema_of(typed, around))


# -- the lock file of field numbers -------------------------------------------------------------------------------


def lock_path(module: str) -> Path | None:
    """Give the path of a module's lock file, whether it is there or not."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return Path(file).with_suffix(".lock.json") if file else None


@functools.cache
def _lock(path: Path) -> dict[str, dict[str, int]]:
    return json.loads(path.read_text())  # type: ignore[no-any-return]


def forget_locks() -> None:
    """Read lock files anew, and make schemas anew: a lock has grown."""
    _lock.cache_clear()
    schema_of.cache_clear()


def _numbers(cls: type[Record]) -> dict[str, int] | None:
    """Field numbers of a class from its module's lock file; None where the module has none (a student's file)."""
    path = lock_path(cls.__module__)
    return _lock(path).get(cls.__name__, {}) if path and path.is_file() else None
