"""Records: what objects hold. A record is declared once, as a typed class with unit and meaning on each field:

    class Pose(Record):
        '''Pose of the cart in the map.'''
        x_m: Annotated[float, f8("m", "east of the map's origin")]
        quality: Annotated[Quality, enum8("kind of fix")] = Quality.NONE

From the declaration follow a fixed little-endian C layout, the object that modules hold (a frozen msgspec struct), a
numpy view, JSON, protobuf for recordings, and a C header. Field numbers of protobuf stand in a lock file beside the
module that declares the records (`signals.py` -> `signals.lock.json`); it only ever grows, so that old recordings stay
readable: a field that was added takes its default, one that was removed is ignored, and one whose type or unit
changed is an error that names it.
"""

import functools
import hashlib
import json
import struct
import sys
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import msgspec

from .errors import RecordError

if TYPE_CHECKING:
    import numpy as np
    from google.protobuf.descriptor_pb2 import FileDescriptorProto

R = TypeVar("R", bound="Record")


class Record(msgspec.Struct, frozen=True, gc=False):
    """Base of all records. Instances are immutable values."""


@dataclass(frozen=True, slots=True)
class Kind:
    """How a scalar is stored: its struct code, size in bytes, numpy and C type, protobuf type and wire type."""

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
    "u8": Kind("B", 1, "u1", "uint8_t", "fixed32", 5),
    "bool": Kind("?", 1, "?", "bool", "bool", 0),
    "enum": Kind("B", 1, "u1", "uint8_t", "enum", 0),
    "str": Kind("s", 1, "S", "char", "string", 2),
}


@dataclass(frozen=True, slots=True)
class Spec:
    """What a field's annotation says. `n`: capacity; `shape`: "one", "array" (exactly n) or "seq" (up to n)."""

    kind: str
    unit: str
    doc: str
    n: int = 1
    shape: str = "one"


def _scalar(kind: str) -> Callable[[str, str], Spec]:
    return lambda unit, doc: Spec(kind, unit, doc)


f8, f4, i64, u64, i32, u32, u8 = (_scalar(kind) for kind in ("f8", "f4", "i64", "u64", "i32", "u32", "u8"))


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


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a schema, with its place in the C layout and its protobuf number."""

    name: str
    spec: Spec
    number: int
    offset: int
    values: tuple[tuple[str, int], ...] = ()  # of an enum

    @property
    def align(self) -> int:
        """Natural alignment in bytes."""
        return max(4, KINDS[self.spec.kind].size) if self.spec.shape == "seq" else KINDS[self.spec.kind].size

    @property
    def data_offset(self) -> int:
        """Offset of the first element: behind the count, for a seq."""
        return self.offset + (self.align if self.spec.shape == "seq" else 0)

    @property
    def size(self) -> int:
        """Bytes in the C layout, without padding."""
        return self.data_offset - self.offset + KINDS[self.spec.kind].size * self.spec.n


class Schema:
    """The layout of a record. Made from a class, or from the text that a store or a recording carries."""

    def __init__(
        self,
        name: str,
        doc: str,
        fields: list[tuple[str, Spec, int, tuple[tuple[str, int], ...]]],
        cls: type[Record] | None = None,
    ) -> None:
        self.name, self.doc, self.cls = name, doc, cls
        placed: list[Field] = []
        end = 0
        for field_name, spec, number, values in fields:
            field = Field(field_name, spec, number, 0, values)
            offset = -(-end // field.align) * field.align
            placed.append(Field(field_name, spec, number, offset, values))
            end = offset + field.size
        self.fields = tuple(placed)
        self.size = -(-end // 8) * 8
        self.format = self._format()
        self._struct = struct.Struct(self.format)
        self.pack: Callable[[Any], bytes] = self._compile_pack()
        self.unpack: Callable[[bytes], Any] = self._compile_unpack()
        self.to_proto: Callable[[bytes], bytes] = self._compile_proto()

    # -- text ---------------------------------------------------------------------------------------------------

    def to_text(self) -> str:
        """Describe the schema as JSON; `Schema.from_text` reads it back."""
        return json.dumps(
            {
                "name": self.name,
                "doc": self.doc,
                "size": self.size,
                "fields": [
                    {
                        "name": f.name,
                        "kind": f.spec.kind,
                        "unit": f.spec.unit,
                        "doc": f.spec.doc,
                        "n": f.spec.n,
                        "shape": f.spec.shape,
                        "number": f.number,
                        "values": dict(f.values),
                    }
                    for f in self.fields
                ],
            },
            separators=(",", ":"),
        )

    @classmethod
    def from_text(cls, text: str) -> "Schema":
        """Make a schema without its class: values unpack to dictionaries."""
        try:
            raw = json.loads(text)
            fields = [
                (
                    f["name"],
                    Spec(f["kind"], f["unit"], f["doc"], f["n"], f["shape"]),
                    f["number"],
                    tuple(f["values"].items()),
                )
                for f in raw["fields"]
            ]
            return cls(raw["name"], raw["doc"], fields)
        except (ValueError, KeyError, TypeError) as error:
            raise RecordError(f"schema text is damaged ({error}): {text[:60]!r}") from error

    @property
    def hash(self) -> str:
        """Hash of what two programs must agree on: names, kinds, sizes, units and offsets."""
        lines = [f"{f.name} {f.spec.kind} {f.spec.shape} {f.spec.n} {f.spec.unit} {f.offset}" for f in self.fields]
        return hashlib.sha256("\n".join([self.name, *lines]).encode()).hexdigest()[:16]

    def check_fits(self, other: "Schema", source: str) -> None:
        """Refuse `other` (of an older recording or client) if a field of the same name means something else."""
        mine = {f.name: f.spec for f in self.fields}
        for f in other.fields:
            spec = mine.get(f.name)
            if spec and (spec.kind, spec.unit, spec.shape) != (f.spec.kind, f.spec.unit, f.spec.shape):
                raise RecordError(
                    f"{source}: field {self.name}.{f.name} was {f.spec.kind} {f.spec.shape} [{f.spec.unit}] and is now "
                    f"{spec.kind} {spec.shape} [{spec.unit}]; a changed meaning needs a new field name"
                )

    # -- values -------------------------------------------------------------------------------------------------

    def _format(self) -> str:
        parts, end = ["<"], 0
        for f in self.fields:
            parts.append("x" * (f.offset - end))
            kind = KINDS[f.spec.kind]
            if f.spec.shape == "seq":
                parts.append("I" + "x" * (f.align - 4))
            parts.append(f"{f.spec.n}{kind.code}" if f.spec.kind == "str" or f.spec.shape != "one" else kind.code)
            end = f.offset + f.size
        parts.append("x" * (self.size - end))
        return "".join(parts)

    def _compile_pack(self) -> Callable[[Any], bytes]:
        """Make `pack(record) -> bytes`; one call of struct.pack, spelled out once per record."""
        terms: list[str] = []
        scope: dict[str, Any] = {"pack": self._struct.pack, "full": _full, "encoded": _encoded}
        for f in self.fields:
            if f.spec.shape == "seq":
                terms.append(f"len(r.{f.name}), *full(r.{f.name}, {f.spec.n}, {f.name!r})")
            elif f.spec.shape == "array":
                terms.append(f"*full(r.{f.name}, {f.spec.n}, {f.name!r}, True)")
            elif f.spec.kind == "str":
                terms.append(f"encoded(r.{f.name}, {f.spec.n}, {f.name!r})")
            elif f.spec.kind == "enum":
                scope[f"e_{f.name}"] = {value: value for _, value in f.values}
                terms.append(f"e_{f.name}[r.{f.name}]")
            else:
                terms.append(f"r.{f.name}")
        call = eval(f"lambda r: pack({', '.join(terms)})", scope)
        name, cls = self.name, self.cls

        def pack(record: Any) -> bytes:
            if cls is not None and type(record) is not cls:
                raise RecordError(f"expected a {name}, got {type(record).__name__}: {record!r:.80}")
            try:
                return call(record)  # type: ignore[no-any-return]
            except (struct.error, TypeError, OverflowError, AttributeError, KeyError, UnicodeError) as error:
                raise RecordError(f"{name}: {self._misfit(record)} ({error})") from error

        return pack

    def _misfit(self, record: Any) -> str:
        """Name the first field whose value its kind cannot hold."""
        for f in self.fields:
            value = getattr(record, f.name)
            for item in value if f.spec.shape != "one" and isinstance(value, tuple | list) else (value,):
                try:
                    if f.spec.kind == "enum" and item not in dict(f.values).values():
                        raise OverflowError
                    struct.pack("<" + KINDS[f.spec.kind].code, item if f.spec.kind != "str" else item.encode())
                except (struct.error, OverflowError, AttributeError, UnicodeError):
                    return f"{f.name}={value!r:.60} does not fit {f.spec.kind}"
        return "a value does not fit"

    def _compile_unpack(self) -> Callable[[bytes], Any]:
        """Make `unpack(bytes) -> record`, or -> dict where the class is not known."""
        terms: list[str] = []
        scope: dict[str, Any] = {"unpack": self._struct.unpack, "make": self.cls or dict}
        at, plain = 0, True
        for k, f in enumerate(self.fields):
            if f.spec.shape != "one":
                plain = False
                count = 0 if f.spec.shape == "array" else 1
                stop = f"{at} + {f.spec.n}" if count == 0 else f"{at + 1} + v[{at}]"
                terms.append(f"v[{at + count}:{stop}]")
                at += count + f.spec.n
                continue
            if f.spec.kind == "str":
                plain = False
                terms.append(f"v[{at}].rstrip(b'\\0').decode()")
            elif f.spec.kind == "enum":
                plain = False
                enum = _enum_of(self.cls, f.name) if self.cls else None
                scope[f"e{k}"] = {v: enum(v) if enum else n for n, v in f.values}
                terms.append(f"e{k}.get(v[{at}], v[{at}])")
            else:
                terms.append(f"v[{at}]")
            at += 1
        if self.cls is None:
            terms = [f"{f.name}={term}" for f, term in zip(self.fields, terms, strict=True)]
        elif plain:
            return eval("lambda b: make(*unpack(b))", scope)  # type: ignore[no-any-return]
        return eval(f"lambda b: (lambda v: make({', '.join(terms)}))(unpack(b))", scope)  # type: ignore[no-any-return]

    def dtype(self) -> "np.dtype[Any]":
        """Give the numpy structured dtype of the C layout; a seq also has a field `<name>_n`."""
        import numpy as np

        names: list[str] = []
        formats: list[Any] = []
        offsets: list[int] = []
        for f in self.fields:
            kind = KINDS[f.spec.kind].numpy
            if f.spec.shape == "seq":
                names.append(f"{f.name}_n")
                formats.append("<u4")
                offsets.append(f.offset)
            names.append(f.name)
            formats.append(f"S{f.spec.n}" if kind == "S" else kind if f.spec.shape == "one" else (kind, (f.spec.n,)))
            offsets.append(f.data_offset)
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": self.size})

    def c_struct(self) -> str:
        """Give the record as a C struct."""
        lines = [f"/* {self.doc.splitlines()[0] if self.doc else self.name} */", "typedef struct {"]
        for k, f in enumerate(self.fields):
            align = "_Alignas(8) " if k == 0 else ""  # the size is a multiple of 8
            if f.spec.shape == "seq":
                lines.append(f"    _Alignas({8 if k == 0 else f.align}) uint32_t {f.name}_n;")
                align = ""
            many = f"[{f.spec.n}]" if f.spec.shape != "one" or f.spec.kind == "str" else ""
            unit = f"[{f.spec.unit}] " if f.spec.unit else ""
            lines.append(f"    {align}{KINDS[f.spec.kind].c} {f.name}{many}; /* {unit}{f.spec.doc} */")
        return "\n".join(
            [*lines, f"}} fw_{self.name};", f'_Static_assert(sizeof(fw_{self.name}) == {self.size}, "{self.name}");']
        )

    # -- protobuf -----------------------------------------------------------------------------------------------

    def _compile_proto(self) -> Callable[[bytes], bytes]:
        """Make `to_proto(payload) -> bytes`: first what has a fixed width, in one struct.pack."""
        fixed_format, fixed, tail = ["<"], [], []
        scope: dict[str, Any] = {"unpack": self._struct.unpack}
        at = 0
        for k, f in enumerate(self.fields):
            kind = KINDS[f.spec.kind]
            if f.spec.shape != "one":
                count = 1 if f.spec.shape == "seq" else 0
                stop = f"{at + 1} + v[{at}]" if count else f"{at} + {f.spec.n}"
                code = {"?": "?", "B": "I"}.get(kind.code, kind.code)
                scope[f"p{k}"] = functools.partial(_packed, _varint(f.number << 3 | 2), code)
                tail.append(f"p{k}(v[{at + count}:{stop}])")
                at += count + f.spec.n
                continue
            if f.spec.kind == "str":
                scope[f"p{k}"] = functools.partial(_delimited, _varint(f.number << 3 | 2))
                tail.append(f"p{k}(v[{at}].rstrip(b'\\0'))")
            else:
                tag = _varint(f.number << 3 | kind.wire)
                scope[f"t{k}"] = tag
                fixed_format.append(f"{len(tag)}s{'I' if f.spec.kind == 'u8' else kind.code}")
                fixed.append(f"t{k}, v[{at}]")
            at += 1
        scope["pack"] = struct.Struct("".join(fixed_format)).pack
        body = " + ".join([f"pack({', '.join(fixed)})", *tail])
        return eval(f"lambda b: (lambda v: {body})(unpack(b))", scope)  # type: ignore[no-any-return]

    def file_descriptor(self) -> "FileDescriptorProto":
        """Give the protobuf file of this record: message `fairway.<name>`, with room for the causes of a write."""
        from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto

        file = FileDescriptorProto(name=f"fairway/{self.name}.proto", package="fairway", syntax="proto3")
        message = file.message_type.add(name=self.name)
        for f in self.fields:
            proto = KINDS[f.spec.kind].proto
            field = message.field.add(
                name=f.name,
                number=f.number,
                type=getattr(FieldDescriptorProto, f"TYPE_{proto.upper()}"),
                label=FieldDescriptorProto.LABEL_REPEATED
                if f.spec.shape != "one"
                else FieldDescriptorProto.LABEL_OPTIONAL,
            )
            if f.spec.kind == "enum":
                enum = message.enum_type.add(name=f"{f.name}_values")
                for name, value in sorted(f.values, key=lambda item: item[1]):  # protobuf wants zero first
                    enum.value.add(name=f"{f.name}_{name}", number=value)
                field.type_name = f".fairway.{self.name}.{f.name}_values"
        message.field.add(
            name="causes",
            number=CAUSES_NUMBER,
            type=FieldDescriptorProto.TYPE_FIXED64,
            label=FieldDescriptorProto.LABEL_REPEATED,
        )
        return file


CAUSES_NUMBER = (
    1000  # protobuf field in every recorded message: channel id, write number, channel id, write number, ...
)


def causes_to_proto(pairs: list[int]) -> bytes:
    """Encode the causes of a write, as (channel id, write number) one after the other."""
    return _causes_prefix(len(pairs)) + struct.pack(f"<{len(pairs)}Q", *pairs)


@functools.cache
def _causes_prefix(n: int) -> bytes:
    return _varint(CAUSES_NUMBER << 3 | 2) + _varint(8 * n)


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _delimited(tag: bytes, data: bytes) -> bytes:
    return tag + _varint(len(data)) + data


def _packed(tag: bytes, code: str, values: tuple[Any, ...]) -> bytes:
    return _delimited(tag, struct.pack(f"<{len(values)}{code}", *values)) if values else b""


def _full(values: tuple[Any, ...], n: int, name: str, exact: bool = False) -> tuple[Any, ...]:
    if len(values) > n or (exact and len(values) != n):
        raise RecordError(f"field {name} holds {'exactly' if exact else 'at most'} {n} values, got {len(values)}")
    return values if len(values) == n else (*values, *(0,) * (n - len(values)))


def _encoded(value: str, n: int, name: str) -> bytes:
    data = value.encode()
    if len(data) > n or "\0" in value:
        raise RecordError(f"field {name} holds at most {n} bytes of text without NUL, got {value!r:.60}")
    return data


def _enum_of(cls: type[Record], name: str) -> type[IntEnum]:
    enum = get_args(get_type_hints(cls, include_extras=True)[name])[0]
    if not (isinstance(enum, type) and issubclass(enum, IntEnum)):
        raise RecordError(f"{cls.__name__}.{name} is declared with enum8 but typed {enum!r}; it needs an IntEnum")
    return enum


@functools.cache
def schema_of(cls: type[Record]) -> Schema:
    """Give the schema of a record class."""
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
        values = tuple((e.name, e.value) for e in _enum_of(cls, name)) if spec.kind == "enum" else ()
        if any(not 0 <= value <= 127 for _, value in values):
            raise RecordError(f"{cls.__name__}.{name}: enum8 holds values 0..127")
        if values and 0 not in dict(values).values():
            raise RecordError(f"{cls.__name__}.{name}: an enum needs a value 0, which protobuf takes for absent")
        if numbers is not None and name not in numbers:
            raise RecordError(
                f"{cls.__name__}.{name} has no field number; add it: python -m rtdb.lock {cls.__module__}"
            )
        fields.append((name, spec, numbers[name] if numbers is not None else k + 1, values))
    return Schema(cls.__name__, (cls.__doc__ or "").strip(), fields, cls)


# -- the lock file of field numbers -------------------------------------------------------------------------------


def lock_path(module: str) -> Path | None:
    """Give the path of a module's lock file, whether it is there or not."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return Path(file).with_suffix(".lock.json") if file else None


@functools.cache
def _lock(path: Path) -> dict[str, dict[str, int]]:
    return json.loads(path.read_text())  # type: ignore[no-any-return]


def _numbers(cls: type[Record]) -> dict[str, int] | None:
    """Field numbers of a class from its module's lock file; None where the module has none (a student's file)."""
    path = lock_path(cls.__module__)
    return _lock(path).get(cls.__name__, {}) if path and path.is_file() else None
