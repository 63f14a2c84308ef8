"""Records as protobuf messages: what recordings hold, readable by any tool that knows MCAP and protobuf.

A record is the message `fairway.<name>`. Types that a field brings along stand inside it: a nested record under its own
name, the values of an enum as `<field>_values`, an image as `<field>_image` {height, width, channels, data}. What has a
fixed width is written first, in one call of `struct`; behind it come texts, tuples, records and images, each with its
length. A count that is larger than what there is room for, which only a foreign writer can leave in a slot, is cut to
the room: reading such a value is an error, recording it must not end the recording.
"""

import functools
import struct
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from .layout import KINDS, Extent, Field, Kind, struct_format, type_name
from .packing import Scope, image_view, named, split

if TYPE_CHECKING:
    from google.protobuf.descriptor_pb2 import DescriptorProto, FileDescriptorProto

    from .records import Schema

CAUSES_NUMBER = (
    1000  # protobuf field in every recorded message: channel id, write number, channel id, write number, ...
)
_WIDER = {"b": "i", "h": "i", "B": "I", "H": "I"}  # protobuf has no fixed width below four bytes


def compile_proto(schema: "Schema") -> Callable[[bytes], bytes]:
    """Make `to_proto(payload) -> bytes`."""
    scope: Scope = {"unpack": struct.Struct(struct_format(schema, "x")).unpack, "join": b"".join}
    return eval(f"lambda b: (lambda v: {_body(schema, 0, 0, scope)})(unpack(b))", scope)  # type: ignore[no-any-return]


def _body(schema: "Schema", at: int, base: int, scope: Scope) -> str:
    """Spell out the message of the record whose first value is v[at] and whose bytes begin at b[base]."""
    fixed_format, fixed, tail = ["<"], [], []
    for f in schema.fields:
        kind = KINDS[f.spec.kind]
        if f.spec.shape == "one" and kind.wire != 2:
            tag = _tag(f.number, kind.wire)
            fixed_format.append(f"{len(tag)}s{_wire_code(kind)}")
            fixed.append(f"{named(scope, tag)}, v[{at}]")
        else:
            tail.append(_with_length(f, at, base, scope))
        at += f.n_values
    head = f"{named(scope, struct.Struct(''.join(fixed_format)).pack)}({', '.join(fixed)})"
    return head if not tail else f"join(({', '.join([head, *tail])}))"


def _with_length(f: Field, at: int, base: int, scope: Scope) -> str:
    tag, count = _tag(f.number, 2), len(f.counts)
    if f.spec.kind == "record" and f.spec.shape == "one":
        return f"{named(scope, functools.partial(_delimited, tag))}({_body(f.record, at, base + f.offset, scope)})"
    if f.spec.kind == "record":
        many = named(scope, functools.partial(_messages, tag, f.record.to_proto, base + f.data_offset, f.record.size))
        return f"{many}(b, {_used(f, at)})"
    if f.spec.kind == "image":
        image = named(scope, functools.partial(_image, tag, base + f.data_offset, f.extent))
        return f"{image}(b, (v[{at}], v[{at + 1}], v[{at + 2}]))"
    if f.spec.kind == "str":
        return f"{named(scope, functools.partial(_delimited, tag))}(v[{at}].rstrip(b'\\0'))"
    packed = named(scope, functools.partial(_packed, tag, _wire_code(KINDS[f.spec.kind])))
    return f"{packed}(v[{at + count}:{at + count}+{_used(f, at)}])"


def _used(f: Field, at: int) -> str:
    return f"(v[{at}] if v[{at}] <= {f.spec.n} else {f.spec.n})" if f.counts else str(f.spec.n)


def _wire_code(kind: Kind) -> str:
    return _WIDER.get(kind.code, kind.code) if kind.wire == 5 else kind.code


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _tag(number: int, wire: int) -> bytes:
    return _varint(number << 3 | wire)


def _delimited(tag: bytes, data: bytes) -> bytes:
    return tag + _varint(len(data)) + data


def _packed(tag: bytes, code: str, values: tuple[Any, ...]) -> bytes:
    return _delimited(tag, struct.pack(f"<{len(values)}{code}", *values)) if values else b""


def _messages(tag: bytes, to_proto: Callable[[Any], bytes], offset: int, size: int, buffer: bytes, count: int) -> bytes:
    return b"".join(_delimited(tag, to_proto(part)) for part in split(buffer, offset, size, count))


def _image(tag: bytes, offset: int, extent: Extent, buffer: bytes, used: Extent) -> bytes:
    h, w, c = map(min, used, extent)
    data = image_view(buffer, offset, extent, (h, w, c)).tobytes()
    head = struct.pack("<BIBIBI", 1 << 3 | 5, h, 2 << 3 | 5, w, 3 << 3 | 5, c)
    return _delimited(tag, head + _delimited(_tag(4, 2), data))


# -- causes -----------------------------------------------------------------------------------------------------------


def causes_to_proto(pairs: list[int]) -> bytes:
    """Encode the causes of a write, as (channel id, write number) one after the other."""
    return _causes_prefix(len(pairs)) + struct.pack(f"<{len(pairs)}Q", *pairs)


@functools.cache
def _causes_prefix(n: int) -> bytes:
    return _tag(CAUSES_NUMBER, 2) + _varint(8 * n)


# -- descriptors ------------------------------------------------------------------------------------------------------


def file_descriptor(schema: "Schema") -> "FileDescriptorProto":
    """Give the protobuf file of a record: message `fairway.<name>`, with room for the causes of a write."""
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto

    file = FileDescriptorProto(name=f"fairway/{schema.name}.proto", package="fairway", syntax="proto3")
    message = file.message_type.add(name=schema.name)
    _describe(schema, message, f".fairway.{schema.name}")
    message.field.add(
        name="causes",
        number=CAUSES_NUMBER,
        type=FieldDescriptorProto.TYPE_FIXED64,
        label=FieldDescriptorProto.LABEL_REPEATED,
    )
    return file


def _describe(schema: "Schema", message: "DescriptorProto", path: str) -> None:
    """Declare the fields of a record, and the types that they bring along, in a message."""
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto

    declared: set[str] = set()
    for f in schema.fields:
        field = message.field.add(
            name=f.name,
            number=f.number,
            type=getattr(FieldDescriptorProto, f"TYPE_{KINDS[f.spec.kind].proto.upper()}"),
            label=FieldDescriptorProto.LABEL_REPEATED if f.spec.shape != "one" else FieldDescriptorProto.LABEL_OPTIONAL,
        )
        if f.spec.kind not in ("enum", "image", "record"):
            continue
        name = type_name(f)
        field.type_name = f"{path}.{name}"
        if name in declared:
            continue
        declared.add(name)
        if f.spec.kind == "enum":
            enum = message.enum_type.add(name=name)
            for value_name, value in sorted(f.values, key=lambda item: item[1]):  # protobuf wants zero first
                enum.value.add(name=f"{f.name}_{value_name}", number=value)
        elif f.spec.kind == "image":
            image = message.nested_type.add(name=name)
            for k, extent in enumerate(("height", "width", "channels"), 1):
                image.field.add(name=extent, number=k, type=FieldDescriptorProto.TYPE_FIXED32, label=1)
            image.field.add(name="data", number=4, type=FieldDescriptorProto.TYPE_BYTES, label=1)
        else:
            _describe(f.record, message.nested_type.add(name=name), f"{path}.{name}")
