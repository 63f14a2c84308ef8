"""Records: one declaration, and compilers, numpy, protobuf and msgspec as second opinions on what it means."""

import importlib
import inspect
import json
import math
import os
import subprocess
import sys
from enum import IntEnum
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import pytest
from google.protobuf import descriptor_pool, message_factory
from hypothesis import given
from hypothesis import strategies as st

import hal.signals
from rtdb import Record, RecordError, Schema, Store, schema_of
from rtdb.layout import MAX_BYTES, MAX_DEPTH
from rtdb.lock import extend_lock
from rtdb.records import (
    Field,
    Spec,
    array,
    causes_to_proto,
    enum8,
    f4,
    f8,
    flag,
    frame_of,
    i8,
    i16,
    i32,
    i64,
    image,
    nested,
    seq,
    text,
    u8,
    u16,
    u32,
    u64,
)


class Mode(IntEnum):
    OFF = 0
    ON = 1
    LAST = 127


class Every(Record):
    """One field of each kind and shape."""

    b: Annotated[bool, flag("flag")] = False
    d: Annotated[float, f8("m", "double")] = 0.0
    c: Annotated[int, u8("", "byte")] = 0
    f: Annotated[float, f4("s", "float")] = 0.0
    mode: Annotated[Mode, enum8("mode")] = Mode.OFF
    q: Annotated[int, i64("ns", "signed long")] = 0
    w: Annotated[str, text(5, "short text")] = ""
    Q: Annotated[int, u64("", "unsigned long")] = 0
    i: Annotated[int, i32("", "signed")] = 0
    v: Annotated[tuple[float, ...], array("f8", 3, "m", "vector")] = (0.0, 0.0, 0.0)
    I: Annotated[int, u32("", "unsigned")] = 0  # noqa: E741
    s: Annotated[tuple[float, ...], seq("f8", 4, "m", "doubles")] = ()
    t: Annotated[tuple[int, ...], seq("u8", 5, "", "bytes")] = ()
    u: Annotated[tuple[int, ...], seq("i32", 3, "", "numbers")] = ()
    x: Annotated[tuple[bool, ...], array("bool", 3, "", "flags")] = (False, False, False)
    y: Annotated[tuple[int, ...], array("u64", 2, "", "longs")] = (0, 0)
    z: Annotated[tuple[float, ...], seq("f4", 2, "", "floats")] = ()
    a: Annotated[int, i8("", "signed byte")] = 0
    h: Annotated[int, i16("", "signed short")] = 0
    e: Annotated[int, i8("", "in front of a short")] = 0
    H: Annotated[int, u16("", "unsigned short")] = 0
    k: Annotated[tuple[int, ...], seq("i16", 3, "", "shorts")] = ()
    l: Annotated[tuple[int, ...], array("i8", 3, "", "signed bytes")] = (0, 0, 0)  # noqa: E741


class SeqBehindInt(Record):
    """The count of a sequence of doubles stands behind a 4-byte number."""

    k: Annotated[int, u32("", "number")] = 0
    s: Annotated[tuple[float, ...], seq("f8", 2, "", "doubles")] = ()


class Small(Record):
    """Shorter than its own alignment."""

    k: Annotated[int, u32("", "number")] = 0


class Bytes(Record):
    c: Annotated[int, u8("", "byte")] = 0
    t: Annotated[tuple[int, ...], seq("u8", 6, "", "bytes")] = ()


class Point(Record):
    """A point; shorter than its own alignment."""

    x_m: Annotated[float, f4("m", "east")] = 0.0


class Stop(Record):
    """A record in a record, and of every sort of field."""

    kind: Annotated[int, u8("", "kind")] = 0
    at: Annotated[Point, nested("where")] = Point()
    mode: Annotated[Mode, enum8("mode")] = Mode.OFF
    name: Annotated[str, text(6, "name")] = ""
    some: Annotated[tuple[float, ...], seq("f8", 2, "m", "numbers")] = ()


class Route(Record):
    """Records in records in a record, one and many."""

    first: Annotated[Stop, nested("where it begins")] = Stop()
    number: Annotated[int, u8("", "number")] = 0
    last: Annotated[Stop, nested("where it ends")] = Stop()
    between: Annotated[tuple[Stop, ...], nested("on the way", at_most=3)] = ()
    corners: Annotated[tuple[Point, ...], nested("of the area", exactly=2)] = (Point(), Point())


class Frame(Record, eq=False):
    """An image between other fields."""

    k: Annotated[int, u8("", "number")]
    pixels: Annotated[np.ndarray, image(4, 5, 3, "blue, green, red")]
    at: Annotated[Point, nested("of the camera")] = Point()
    grey: Annotated[np.ndarray, image(1, 7, 1, "grey")] = msgspec.field(
        default_factory=lambda: np.zeros((0, 0, 1), np.uint8)
    )


class Pair(Record):
    """Records with images in a record."""

    left: Annotated[Frame, nested("left")]
    more: Annotated[tuple[Frame, ...], nested("others", at_most=2)] = ()


def ints(bits, signed):
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    return st.integers(low, high)


def doubles():
    return st.floats(allow_nan=False)


def singles():
    return st.floats(width=32, allow_nan=False)


def words(n):
    letters = st.characters(exclude_characters="\0", exclude_categories=["Cs"])
    return st.text(letters, max_size=n).filter(lambda s: len(s.encode()) <= n)


def tuples(items, least, most):
    return st.lists(items, min_size=least, max_size=most).map(tuple)


EVERY = st.builds(
    Every,
    b=st.booleans(),
    d=doubles(),
    c=ints(8, False),
    f=singles(),
    mode=st.sampled_from(Mode),
    q=ints(64, True),
    w=words(5),
    Q=ints(64, False),
    i=ints(32, True),
    v=tuples(doubles(), 3, 3),
    I=ints(32, False),
    s=tuples(doubles(), 0, 4),
    t=tuples(ints(8, False), 0, 5),
    u=tuples(ints(32, True), 0, 3),
    x=tuples(st.booleans(), 3, 3),
    y=tuples(ints(64, False), 2, 2),
    z=tuples(singles(), 0, 2),
    a=ints(8, True),
    h=ints(16, True),
    e=ints(8, True),
    H=ints(16, False),
    k=tuples(ints(16, True), 0, 3),
    l=tuples(ints(8, True), 3, 3),
)
POINT = st.builds(Point, singles())
STOP = st.builds(Stop, ints(8, False), POINT, st.sampled_from(Mode), words(6), tuples(doubles(), 0, 2))
ROUTE = st.builds(Route, STOP, ints(8, False), STOP, tuples(STOP, 0, 3), tuples(POINT, 2, 2))


def images(height, width, channels):
    extents = st.tuples(st.integers(0, height), st.integers(0, width), st.integers(0, channels))
    return extents.flatmap(
        lambda e: st.binary(min_size=math.prod(e), max_size=math.prod(e)).map(
            lambda data: np.frombuffer(data, np.uint8).reshape(e)
        )
    )


FRAME = st.builds(Frame, ints(8, False), images(4, 5, 3), POINT, images(1, 7, 1))
PAIR = st.builds(Pair, FRAME, tuples(FRAME, 0, 2))
OURS = [Every, SeqBehindInt, Small, Bytes, Point, Stop, Route, Frame, Pair]
SIGNALS = [
    cls
    for _, cls in inspect.getmembers(hal.signals, inspect.isclass)
    if issubclass(cls, Record) and cls.__module__ == "hal.signals"
]


def plain(value, by_name=False):
    """Turn a record, or what stands for one, into values that compare; enums by name as an unknown class gives them."""
    if isinstance(value, Record):
        value = {name: getattr(value, name) for name in value.__struct_fields__}
    if isinstance(value, dict):
        return {name: plain(item, by_name) for name, item in value.items()}
    if isinstance(value, tuple):
        return tuple(plain(item, by_name) for item in value)
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    return value.name if by_name and isinstance(value, IntEnum) else value


# -- layout -----------------------------------------------------------------------------------------------------


def members(schema, path="", base=0):
    """Offsets of all that a record consists of, by the name that C gives it."""
    offsets = {}
    for f in schema.fields:
        offsets |= {f"{path}{count}": base + f.offset + 4 * k for k, count in enumerate(f.counts)}
        offsets[f"{path}{f.name}"] = base + f.data_offset
        if f.spec.kind == "record":
            element = "" if f.spec.shape == "one" else f"[{f.spec.n - 1}]"
            at = base + f.data_offset + (f.spec.n - 1) * f.record.size
            offsets |= members(f.record, f"{path}{f.name}{element}.", at)
    return offsets


def numpy_offset(dtype, name):
    """Offset of a member of that name, as numpy says it."""
    offset = 0
    for part in name.split("."):
        field, _, element = part.rstrip("]").partition("[")
        dtype, at = dtype.fields[field][:2]
        offset += at
        if element:
            dtype = dtype.subdtype[0]
            offset += int(element) * dtype.itemsize
    return offset


@pytest.fixture(scope="module")
def c_layout(tmp_path_factory):
    """Size and offsets as a C compiler sees them: {record: {member: offset}, with "." for the size}."""
    schemas = [schema_of(cls) for cls in (*OURS, *SIGNALS)]
    structs = {}
    for s in schemas:
        structs |= s.c_structs()
    lines = ["#include <stdbool.h>", "#include <stddef.h>", "#include <stdint.h>", "#include <stdio.h>"]
    lines += [text.split("_Static_assert")[0] for text in structs.values()] + ["int main(void) {"]
    for s in schemas:
        lines.append(f'printf("{s.name} . %zu\\n", sizeof(fw_{s.name}));')
        lines += [f'printf("{s.name} {name} %zu\\n", offsetof(fw_{s.name}, {name}));' for name in members(s)]
    folder = tmp_path_factory.mktemp("layout")
    (folder / "layout.c").write_text("\n".join([*lines, "return 0; }"]))
    subprocess.run(
        [
            os.environ.get("CC", "cc"),
            "-std=c11",
            "-Wall",
            "-Werror",
            "-o",
            folder / "layout",
            folder / "layout.c",
        ],
        check=True,
    )
    layout = {}
    for line in subprocess.run([folder / "layout"], check=True, capture_output=True, text=True).stdout.splitlines():
        record, name, offset = line.split()
        layout.setdefault(record, {})[name] = int(offset)
    return layout


@pytest.mark.parametrize("cls", [*OURS, *SIGNALS])
def test_a_c_compiler_and_numpy_lay_a_record_out_as_its_schema_says(c_layout, cls):
    schema = schema_of(cls)
    dtype, expected = schema.dtype(), members(schema)
    assert {name: numpy_offset(dtype, name) for name in expected} == expected
    assert dtype.itemsize == schema.size
    assert c_layout[cls.__name__] == {".": schema.size} | expected


def test_the_members_of_nested_records_and_images_are_named_as_one_would_write_them():
    assert {"first.at.x_m", "between_n", "between[2].some_n", "corners[1].x_m"} <= members(schema_of(Route)).keys()
    assert {"left.pixels_h", "left.pixels_w", "left.pixels_c", "more[1].pixels"} <= members(schema_of(Pair)).keys()


@pytest.mark.parametrize("cls", [*OURS, *SIGNALS])
def test_the_c_struct_of_a_record_compiles_with_its_own_size_check(cls, tmp_path):
    source = tmp_path / "record.c"
    source.write_text(f"#include <stdbool.h>\n#include <stdint.h>\n#include <assert.h>\n{schema_of(cls).c_struct()}\n")
    done = subprocess.run(
        [os.environ.get("CC", "cc"), "-std=c11", "-fsyntax-only", source],
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


@given(EVERY)
def test_numpy_reads_the_packed_bytes_as_the_same_values(record):
    schema = schema_of(Every)
    row = np.frombuffer(schema.pack(record), schema.dtype())[0]
    for f in schema.fields:
        value = getattr(record, f.name)
        if f.spec.shape == "seq":
            assert tuple(row[f.name][: row[f"{f.name}_n"]].tolist()) == value
            assert not row[f.name][row[f"{f.name}_n"] :].any()
        elif f.spec.shape == "array":
            assert tuple(row[f.name].tolist()) == value
        else:
            assert row[f.name].item() == (value.encode() if f.spec.kind == "str" else value)


# -- values -----------------------------------------------------------------------------------------------------


@given(EVERY)
def test_unpack_gives_back_what_was_packed(record):
    schema = schema_of(Every)
    back = schema.unpack(schema.pack(record))
    assert back == record
    assert [type(getattr(back, f.name)) for f in schema.fields] == [
        type(getattr(record, f.name)) for f in schema.fields
    ]


@given(EVERY)
def test_a_schema_without_its_class_unpacks_the_same_values(record):
    schema = Schema.from_text(schema_of(Every).to_text())
    expected = {name: getattr(record, name) for name in Every.__struct_fields__} | {"mode": record.mode.name}
    assert schema.unpack(schema_of(Every).pack(record)) == expected


@given(st.one_of(STOP, ROUTE, FRAME, PAIR))
def test_records_in_records_and_images_round_trip(record):
    schema = schema_of(type(record))
    back = schema.unpack(schema.pack(record))
    assert type(back) is type(record)
    assert plain(back) == plain(record)


@given(st.one_of(STOP, ROUTE, FRAME, PAIR))
def test_they_unpack_the_same_without_their_classes(record):
    schema = schema_of(type(record))
    back = Schema.from_text(schema.to_text()).unpack(schema.pack(record))
    assert plain(back) == plain(record, by_name=True)


@given(st.one_of(STOP, ROUTE, FRAME, PAIR))
def test_a_schema_without_its_classes_packs_the_same_bytes(record):
    schema = schema_of(type(record))
    assert Schema.from_text(schema.to_text()).pack(record) == schema.pack(record)


@given(ROUTE)
def test_numpy_reads_nested_records_as_the_same_values(record):
    row = np.frombuffer(schema_of(Route).pack(record), schema_of(Route).dtype())[0]
    assert (row["number"], row["between_n"]) == (record.number, len(record.between))
    for there, stop in [
        (row["first"], record.first),
        (row["last"], record.last),
        *zip(row["between"], record.between, strict=False),
    ]:
        assert (there["kind"], there["at"]["x_m"], there["mode"]) == (stop.kind, stop.at.x_m, stop.mode)
        assert there["name"].decode() == stop.name
        assert tuple(there["some"][: there["some_n"]].tolist()) == stop.some
    assert row["corners"]["x_m"].tolist() == [corner.x_m for corner in record.corners]


def test_records_in_records_are_instances_of_their_classes():
    stop = Stop(7, Point(1.5), Mode.ON)
    back = schema_of(Route).unpack(schema_of(Route).pack(Route(stop, 1, between=(stop,))))
    assert (back.first, back.between, back.corners) == (stop, (stop,), (Point(), Point()))
    assert back.first.mode is Mode.ON


class Alike(Record):
    """A point, but in kilometres."""

    x_m: Annotated[float, f4("km", "east")] = 0.0


@pytest.mark.parametrize(
    ("route", "said"),
    [
        (Route(Stop(at=Point("far"))), r"first\.at\.x_m='far' does not fit f4"),
        (Route(Stop(256)), r"first\.kind=256 does not fit u8"),
        (Route(last=Stop(mode=5)), r"last\.mode=5 does not fit enum"),
        (Route(last=Stop(name="too long")), r"field last\.name holds at most 6 bytes"),
        (Route(last=Stop(some=(1.0,) * 3)), r"field last\.some holds at most 2 values, got 3"),
        (Route(Stop(at=Alike())), r"first\.at holds a Point, got Alike"),
        (Route(Point()), r"first holds a Stop, got Point"),
        (Route(None), r"first holds a Stop, got NoneType"),
        (Route(between=(Stop(),) * 4), r"field between holds at most 3 values, got 4"),
        (Route(between=(Stop(), Stop(256))), r"field between: Stop: kind=256"),
        (Route(between=(Point(),)), r"field between: expected a Stop, got Point"),
        (Route(between=5), r"between holds a Stop, got int"),
        (Route(between=None), r"between holds a Stop, got NoneType"),
        (Route(corners=(Point(),)), r"field corners holds exactly 2 values, got 1"),
    ],
)
def test_a_nested_value_that_does_not_fit_is_refused_with_its_path(route, said):
    with pytest.raises(RecordError, match=said):
        schema_of(Route).pack(route)


@pytest.mark.parametrize(
    "pixels",
    [
        None,
        b"",
        [[[1]]],
        np.zeros((5, 5, 3), np.uint8),
        np.zeros((4, 6, 3), np.uint8),
        np.zeros((4, 5, 4), np.uint8),
        np.zeros((4, 5), np.uint8),
        np.zeros((4, 5, 3), np.int8),
        np.zeros((4, 5, 3)),
    ],
)
def test_what_is_no_image_or_too_large_is_refused_with_the_extent(pixels):
    with pytest.raises(RecordError, match=r"field pixels holds a uint8 array \(h, w, c\) of at most \(4, 5, 3\), got"):
        schema_of(Frame).pack(Frame(1, pixels))


def test_an_image_need_not_be_contiguous():
    picture = np.arange(240, dtype=np.uint8).reshape(8, 10, 3)[::2, ::-2]
    schema = schema_of(Frame)
    assert np.array_equal(schema.unpack(schema.pack(Frame(1, picture))).pixels, picture)


@pytest.mark.parametrize("make", [bytes, bytearray, memoryview])
def test_an_image_is_read_back_as_a_view_on_the_payload_that_nobody_can_write(make):
    schema = schema_of(Pair)
    frame = Frame(1, np.full((3, 5, 3), 7, np.uint8))
    payload = make(schema.pack(Pair(frame, (frame, frame))))
    there = np.frombuffer(payload, np.uint8)
    back = schema.unpack(payload)
    for pixels in (back.left.pixels, *(f.pixels for f in back.more)):
        assert pixels.shape == (3, 5, 3)
        assert np.shares_memory(pixels, there)
        with pytest.raises(ValueError, match="read-only"):
            pixels[0] = 0


def test_an_image_outlives_the_record_it_came_in():
    schema = schema_of(Frame)
    pixels = schema.unpack(schema.pack(Frame(1, np.full((2, 2, 3), 9, np.uint8)))).pixels
    assert pixels.tolist() == [[[9] * 3] * 2] * 2


def test_a_record_with_an_image_must_not_compare_by_value():
    """Whether two arrays are equal is an array: comparing records would raise, far from the cause."""

    class Bad(Record):
        pixels: Annotated[np.ndarray, image(1, 1, 1, "grey")]

    with pytest.raises(RecordError, match=r"Bad\.pixels .*class Bad\(Record, eq=False\)"):
        schema_of(Bad)
    frame = Frame(1, np.zeros((2, 2, 3), np.uint8))
    assert frame == frame  # noqa: PLR0124
    assert Pair(frame) == Pair(frame)
    assert frame != Frame(1, np.zeros((2, 2, 3), np.uint8))


def counts(schema, record, **values):
    """The packed record, with counts that no writer of ours would write."""
    payload = bytearray(schema.pack(record))
    frame = frame_of(schema, memoryview(payload))
    for name, value in values.items():
        frame[name] = value
    return bytes(payload)


@pytest.mark.parametrize(
    ("record", "name", "said"),
    [
        (Every(), "s_n", "field s holds at most 4 values, its count says 5"),
        (Route(), "between_n", "field between holds at most 3 values, its count says 5"),
        (
            Frame(1, np.zeros((4, 4, 3), np.uint8)),
            "pixels_h",
            r"image of at most \(4, 5, 3\), its header says \(5, 4, 3\)",
        ),
        (
            Frame(1, np.zeros((4, 4, 1), np.uint8)),
            "pixels_c",
            r"image of at most \(4, 5, 3\), its header says \(4, 4, 5\)",
        ),
    ],
)
def test_a_count_that_is_larger_than_the_room_is_an_error_to_read_and_is_recorded_as_the_room(record, name, said):
    """A writer in another language may leave one in its slot: nobody reads beyond the field."""
    schema = schema_of(type(record))
    payload = counts(schema, record, **{name: 5})
    with pytest.raises(RecordError, match=said):
        schema.unpack(payload)
    assert parsed(schema, schema.to_proto(payload)).IsInitialized()


def test_an_open_slot_is_written_in_place():
    schema = schema_of(Pair)
    slot = bytearray(b"\xaa" * schema.size)
    frame = frame_of(schema, memoryview(slot))
    assert frame.shape == ()
    assert np.shares_memory(frame["left"]["pixels"], np.frombuffer(slot, np.uint8))
    frame["more_n"] = 0
    left = frame["left"]
    left["k"], left["at"]["x_m"] = 3, 1.5
    left["pixels"][:2, :5] = picture = np.arange(30, dtype=np.uint8).reshape(2, 5, 3)
    left["pixels_h"], left["pixels_w"], left["pixels_c"] = picture.shape
    left["grey_h"], left["grey_w"], left["grey_c"] = 0, 0, 1
    back = schema.unpack(bytes(slot))
    assert plain(back) == plain(Pair(Frame(3, picture, Point(1.5))))


def test_a_payload_is_looked_at_in_place_and_not_written():
    schema = schema_of(Frame)
    there = frame_of(schema, schema.pack(Frame(1, np.full((2, 2, 3), 9, np.uint8))))
    assert (there["pixels"][:2, :2] == 9).all()
    with pytest.raises(ValueError, match="read-only"):
        there["k"] = 1


def test_images_and_nested_records_go_through_the_store():
    with Store.create() as store:
        camera = store.join("camera")
        writers = [camera.insert("pair", Pair), camera.insert("route", Route)]
        frame = Frame(1, np.full((2, 5, 3), 9, np.uint8), Point(1.5))
        values = [Pair(frame, (frame,)), Route(Stop(name="first"), 5, between=(Stop(7),))]
        for writer, value in zip(writers, values, strict=True):
            writer.write(value)
        store.tick()
        for writer, value in zip(writers, values, strict=True):
            assert plain(store.snapshot().get(writer).value) == plain(value)
            assert plain(store.snapshot()[writer.name].value) == plain(value, by_name=True)
        assert (writers[0].history(0, store.now_ns)["value"]["left"]["pixels"][0, :2, :5] == 9).all()


def test_a_buffer_that_is_too_small_is_no_frame():
    schema = schema_of(Frame)
    with pytest.raises(RecordError, match=f"a Frame takes {schema.size} bytes, the buffer has {schema.size - 1}"):
        frame_of(schema, bytes(schema.size - 1))


def test_nan_and_infinity_survive():
    schema = schema_of(Every)
    back = schema.unpack(schema.pack(Every(d=math.nan, f=-math.inf, s=(math.inf, math.nan))))
    assert math.isnan(back.d)
    assert back.f == -math.inf
    assert back.s[0] == math.inf
    assert math.isnan(back.s[1])


def test_defaults_of_a_vocabulary_record_survive():
    for cls in SIGNALS:
        if not any(f.required for f in msgspec.structs.fields(cls)):
            assert schema_of(cls).unpack(schema_of(cls).pack(cls())) == cls()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("c", 256),
        ("c", -1),
        ("c", 1.5),
        ("c", None),
        ("d", "text"),
        ("d", None),
        ("f", 1e300),
        ("q", 2**63),
        ("Q", -1),
        ("i", 2**31),
        ("I", 2**32),
        ("I", "7"),
        ("w", "123456"),
        ("w", "äöü"),
        ("w", "a\0b"),
        ("w", None),
        ("w", 5),
        ("w", "\ud800"),
        ("v", (1.0, 2.0)),
        ("v", (1.0, 2.0, 3.0, 4.0)),
        ("v", (1.0, "x", 2.0)),
        ("v", None),
        ("s", (0.0,) * 5),
        ("s", ("x",)),
        ("s", None),
        ("t", (256,)),
        ("u", (1, 2, 2**31)),
        ("mode", 128),
        ("mode", -1),
        ("mode", 300),
        ("mode", "ON"),
        ("z", (1e300,)),
        ("y", (-1, 0)),
        ("a", 128),
        ("a", -129),
        ("h", 2**15),
        ("H", -1),
        ("H", 2**16),
        ("k", (2**15,)),
        ("l", (0, 0, -129)),
    ],
)
def test_a_value_that_does_not_fit_is_refused_with_the_name_of_its_field(field, value):
    with pytest.raises(RecordError, match=rf"(^|\W){field}(\W|$)"):
        schema_of(Every).pack(Every(**{field: value}))


def test_a_list_where_a_tuple_is_expected_does_not_hide_which_field_is_wrong():
    with pytest.raises(RecordError, match=r"Every: I="):
        schema_of(Every).pack(Every(v=[1.0, 2.0, 3.0], I=-1))


def test_an_enum_value_that_this_version_does_not_know_stays_a_number():
    schema = schema_of(Every)
    data = bytearray(schema.pack(Every(mode=Mode.ON)))
    offset = next(f.offset for f in schema.fields if f.name == "mode")
    data[offset] = 77
    assert schema.unpack(bytes(data)).mode == 77


def test_a_field_without_a_declaration_is_refused():
    class Bare(Record):
        x: float = 0.0

    with pytest.raises(RecordError, match=r"Bare\.x needs a declaration"):
        schema_of(Bare)


def test_an_enum8_needs_an_intenum_with_values_up_to_127():
    class Typed(Record):
        m: Annotated[int, enum8("mode")] = 0

    big = IntEnum("big", {"NONE": 0, "TOO_BIG": 128})

    class Big(Record):
        m: Annotated[big, enum8("mode")] = big.NONE

    with pytest.raises(RecordError, match=r"Typed\.m .*IntEnum"):
        schema_of(Typed)
    with pytest.raises(RecordError, match=r"Big\.m.*0\.\.127"):
        schema_of(Big)


class Loop(Record):
    again: Annotated["tuple[Loop, ...]", nested("itself", at_most=2)] = ()


def test_a_record_cannot_contain_itself():
    with pytest.raises(RecordError, match="Loop in Loop: a record cannot contain itself"):
        schema_of(Loop)


def test_records_are_nested_only_so_deep():
    cls = Point
    for k in range(MAX_DEPTH - 1):
        cls = msgspec.defstruct(f"Deep{k}", [("inner", Annotated[cls, nested("inner")], cls())], bases=(Record,))
    schema = schema_of(cls)
    assert Schema.from_text(schema.to_text()).hash == schema.hash
    deepest = msgspec.defstruct("Deepest", [("inner", Annotated[cls, nested("inner")], cls())], bases=(Record,))
    with pytest.raises(RecordError, match=f"nor more than {MAX_DEPTH} in each other"):
        schema_of(deepest)


@pytest.mark.parametrize(
    "hint",
    [
        Annotated[float, nested("a float")],
        Annotated[tuple[Point, ...], nested("many, said to be one")],
        Annotated[Point, nested("one, said to be many", at_most=3)],
    ],
)
def test_nested_needs_a_record_or_a_tuple_of_records(hint):
    with pytest.raises(RecordError, match=r"Bad\.x is declared with nested; type it as a Record"):
        schema_of(msgspec.defstruct("Bad", [("x", hint)], bases=(Record,)))


class Elsewhere:
    class Point(Record):
        """Another point."""

        y_m: Annotated[float, f8("m", "north")] = 0.0


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ([("a", Annotated[float, Spec("f9", "m", "")])], "there is no kind 'f9'; there are f8, f4"),
        ([("a", Annotated[tuple, array("str", 3, "", "")])], "str does not come as 'array'"),
        ([("a", Annotated[tuple, array("f8", 0, "", "")])], "a capacity of 0"),
        ([("a", Annotated[tuple, array("f8", MAX_BYTES, "", "")])], "larger than"),
        ([("a", Annotated[str, text(0, "")])], "a capacity of 0"),
        ([("a", Annotated[np.ndarray, image(0, 5, 3, "")])], "a capacity of 0"),
        ([("a", Annotated[np.ndarray, image(-1, -5, 3, "")])], r"extent \(-1, -5, 3\)"),
        ([("causes", Annotated[float, f8("", "")])], "causes would stand for two things"),
        ([("a", Annotated[tuple, seq("f8", 2, "", "")]), ("a_n", Annotated[int, u8("", "")])], "a_n would stand"),
        ([("a", Annotated[np.ndarray, image(1, 1, 1, "")]), ("a_w", Annotated[int, u8("", "")])], "a_w would stand"),
        ([("ä", Annotated[float, f8("", "")])], "a field's name is letters, digits and _"),
        (
            [("a", Annotated[Point, nested("")]), ("b", Annotated[Elsewhere.Point, nested("")])],
            "two records called Point",
        ),
        ([], "Bad has no fields"),
    ],
)
def test_a_declaration_that_has_no_layout_is_refused(fields, said):
    with pytest.raises(RecordError, match=said):
        schema_of(msgspec.defstruct("Bad", fields, bases=(Record,), eq=False))


def test_an_enum_without_a_zero_is_refused():
    """Protobuf asks for a value of zero: without one, the recording could not be read back."""
    late = IntEnum("late", {"ONE": 1, "TWO": 2})

    class Late(Record):
        m: Annotated[late, enum8("mode")] = late.ONE

    with pytest.raises(RecordError, match=r"Late\.m"):
        schema_of(Late)


def test_the_values_of_an_enum_stand_in_any_order():
    mixed = IntEnum("mixed", {"TWO": 2, "NONE": 0, "ONE": 1})

    class Mixed(Record):
        m: Annotated[mixed, enum8("mode")] = mixed.NONE

    schema = schema_of(Mixed)
    assert [parsed(schema, schema.to_proto(schema.pack(Mixed(value)))).m for value in mixed] == [2, 0, 1]


# -- schemas ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cls", [*OURS, *SIGNALS])
def test_a_schema_survives_as_text(cls):
    schema = schema_of(cls)
    back = Schema.from_text(schema.to_text())
    assert (back.name, back.doc, back.size, back.fields) == (
        schema.name,
        schema.doc,
        schema.size,
        schema.fields,
    )
    assert (back.hash, back.to_text()) == (schema.hash, schema.to_text())


@pytest.mark.parametrize(
    "damaged",
    [
        "",
        "junk",
        "{}",
        "[]",
        '{"name":"x","doc":"","fields":[{"name":"a"}]}',
        '{"name":"x","doc":"","fields":7}',
    ],
)
def test_a_damaged_schema_text_is_an_error_of_the_record(damaged):
    with pytest.raises(RecordError, match="damaged"):
        Schema.from_text(damaged)


BASE = {"kind": "f8", "unit": "m", "doc": "d", "n": 1, "shape": "one"}


def schema_with(*, name="x", values=(), inner=None, **change):
    """A schema of two fields, the first of them changed."""
    first = Field(name, Spec(**BASE | change), 1, values=values, inner=inner)
    return Schema("R", "", [first, Field("y", Spec(**BASE), 2)])


def enum_with(**values):
    return schema_with(kind="enum", unit="", values=tuple(values.items()))


def called(record, **change):
    return Schema(record, "", list(schema_with(**change).fields))


def nested_with(**change):
    """The changed field is R.x.x.x."""
    return schema_with(
        kind="record", unit="", inner=called("Outer", kind="record", unit="", inner=called("Inner", **change))
    )


def image_with(*extent):
    return schema_with(kind="image", unit="", n=math.prod(extent), extent=extent)


@pytest.mark.parametrize(
    "change", [{"unit": "km"}, {"kind": "i64"}, {"name": "X"}, {"shape": "array"}, {"n": 2, "shape": "array"}]
)
@pytest.mark.parametrize("with_change", [schema_with, nested_with])
def test_the_hash_covers_what_two_programs_must_agree_on(with_change, change):
    assert with_change(**change).hash != with_change().hash


def test_the_hash_covers_the_values_of_enums_and_the_extent_of_images():
    enums = [enum_with(OFF=0, ON=1), enum_with(OFF=0, ON=2), enum_with(OFF=0, AWAY=1), enum_with(OFF=0)]
    pictures = [image_with(2, 6, 1), image_with(6, 2, 1), image_with(2, 2, 3)]
    assert len({schema.hash for schema in enums + pictures}) == 7
    assert enum_with(ON=1, OFF=0).hash == enums[0].hash


@pytest.mark.parametrize("with_change", [schema_with, nested_with])
def test_the_hash_does_not_cover_words_of_explanation(with_change):
    assert with_change(doc="said better").hash == with_change().hash


@pytest.mark.parametrize("change", [{"unit": "km"}, {"kind": "f4"}, {"shape": "array"}])
def test_a_field_that_changed_its_meaning_does_not_fit(change):
    with pytest.raises(RecordError, match=r"field R\.x was .* and is now"):
        schema_with().check_fits(schema_with(**change), "an old recording")
    with pytest.raises(RecordError, match=r"field R\.x\.x\.x was .* and is now"):
        nested_with().check_fits(nested_with(**change), "an old recording")


def test_an_array_of_another_length_does_not_fit_and_more_room_does():
    with pytest.raises(RecordError, match=r"R\.x was f8 array of 3 \[m\] and is now f8 array of 2 \[m\]"):
        schema_with(shape="array", n=2).check_fits(schema_with(shape="array", n=3), "an old recording")
    schema_with(shape="seq", n=2).check_fits(schema_with(shape="seq", n=3), "an old recording")
    image_with(2, 3, 1).check_fits(image_with(4, 6, 3), "an old recording")


def test_an_enum_may_gain_and_lose_values_and_not_renumber_them():
    enum_with(OFF=0, ON=1).check_fits(enum_with(OFF=0, GONE=1, LATE=2), "an old recording")
    with pytest.raises(RecordError, match=r"ON of field R\.x was 2 and is now 1"):
        enum_with(OFF=0, ON=1).check_fits(enum_with(OFF=0, ON=2), "an old recording")


LaterMode = IntEnum("LaterMode", {"OFF": 0, "RENAMED": 1, "LAST": 127})


class LaterPoint(Record):
    y_m: Annotated[float, f8("m", "was added")] = 2.5
    x_m: Annotated[float, f4("m", "east")] = 0.0


class LaterStop(Record):
    mode: Annotated[LaterMode, enum8("mode")] = LaterMode.OFF
    at: Annotated[LaterPoint, nested("where")] = LaterPoint()
    kind: Annotated[int, u8("", "kind")] = 0
    name: Annotated[str, text(3, "less room")] = ""


class Later:
    class Route(Record):
        note: Annotated[str, text(8, "was added")] = "none"
        between: Annotated[tuple[LaterStop, ...], nested("more room", at_most=5)] = ()
        last: Annotated[LaterStop, nested("where it ends")] = LaterStop()
        corners: Annotated[tuple[LaterPoint, ...], nested("of the area", exactly=2)] = (LaterPoint(),) * 2

    class Frame(Record, eq=False):
        pixels: Annotated[np.ndarray, image(9, 9, 4, "more room")]
        added: Annotated[int, u8("", "was added")] = 3


@given(ROUTE)
def test_a_reader_makes_todays_records_of_an_older_programs_payload(record):
    def later(stop):
        return LaterStop(LaterMode(stop.mode), LaterPoint(x_m=stop.at.x_m), stop.kind, stop.name)

    stored = Schema.from_text(schema_of(Route).to_text())
    read = stored.reader(Later.Route, "object a/route")
    assert read(schema_of(Route).pack(record)) == Later.Route(
        "none",
        tuple(map(later, record.between)),
        later(record.last),
        tuple(LaterPoint(x_m=corner.x_m) for corner in record.corners),
    )


def test_a_reader_gives_images_of_an_older_programs_payload_as_views():
    schema = schema_of(Frame)
    payload = schema.pack(Frame(1, np.full((2, 5, 3), 9, np.uint8)))
    frame = Schema.from_text(schema.to_text()).reader(Later.Frame, "object a/frame")(payload)
    assert (frame.added, frame.pixels.shape, frame.pixels.min()) == (3, (2, 5, 3), 9)
    assert np.shares_memory(frame.pixels, np.frombuffer(payload, np.uint8))


def test_a_reader_of_something_else_is_an_error_that_names_it():
    class Different:
        class Route(Record):
            last: Annotated[LaterStop, nested("where it ends")]
            number: Annotated[int, u8("m", "number")] = 0

    stored = Schema.from_text(schema_of(Route).to_text())
    with pytest.raises(RecordError, match="object a/route holds a Route, not a Frame"):
        stored.reader(Later.Frame, "object a/route")
    with pytest.raises(RecordError, match=r"a/route: field Route\.number was u8 one \[\] and is now u8 one \[m\]"):
        stored.reader(Different.Route, "object a/route")
    gone = Schema("Route", "", [f for f in stored.fields if f.name != "last"])
    with pytest.raises(RecordError, match=r"a/route has no field Route\.last, which has no default"):
        gone.reader(Different.Route, "object a/route")


def test_a_field_that_came_or_went_fits():
    schema_with().check_fits(schema_with(), "itself")
    old = Schema("R", "", [Field("gone", Spec(**BASE), 1)])
    schema_with().check_fits(old, "an old recording")
    old.check_fits(schema_with(), "a new recording")


# -- damaged texts: they come from files and from other programs' memory ------------------------------------------

JSON_VALUES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 300),
    st.sampled_from(
        [10**9, 10**30, 1.5, math.inf, "", "f8", "record", "image", "seq", "x_m", "__class__", "a b", "\ud800"]
    ),
    st.lists(st.integers(-1, 9), max_size=4),
    st.sampled_from([{}, {"A": 0}, {"A": 1}, {"A": 0, "B": 0}, {"fields": []}]),
)


def places(document, path=()):
    """Paths of everything in a JSON document."""
    items = (
        document.items() if isinstance(document, dict) else enumerate(document) if isinstance(document, list) else ()
    )
    return [path, *(place for key, item in items for place in places(item, (*path, key)))]


@st.composite
def damaged_documents(draw):
    """The text of a schema in which values were replaced, removed or put where another was."""
    document = json.loads(schema_of(draw(st.sampled_from([Every, Route, Pair]))).to_text())
    for _ in range(draw(st.integers(1, 3))):
        *path, key = draw(st.sampled_from(places(document)[1:]))
        owner = document
        for step in path:
            owner = owner[step]
        deed = draw(st.sampled_from(["replace", "remove", "double", "wrap"]))
        if deed == "replace":
            owner[key] = draw(JSON_VALUES)
        elif deed == "remove":
            del owner[key]
        elif deed == "double" and isinstance(owner, list):
            owner.append(owner[key])
        elif isinstance(document.get("fields"), list):
            document = {**document, "fields": [*document["fields"], {"name": "w", "record": document}]}
    return json.dumps(document)


@st.composite
def damaged_texts(draw):
    """The text of a schema in which characters were changed."""
    text = schema_of(draw(st.sampled_from([Small, Route, Pair]))).to_text()
    for _ in range(draw(st.integers(1, 4))):
        at, n = draw(st.integers(0, len(text))), draw(st.integers(0, 5))
        text = text[:at] + draw(st.text(st.sampled_from('{}[]":,0129-e.\\unaxf8m \0'), max_size=4)) + text[at + n :]
    return text


@given(st.one_of(damaged_documents(), damaged_texts(), st.text(max_size=50)))
def test_what_is_left_of_a_damaged_schema_text_is_usable_or_refused(damaged):
    """It is a RecordError, and nothing else, or a schema of which all that one makes of schemas can be made."""
    try:
        schema = Schema.from_text(damaged)
    except RecordError:
        return
    assert schema.size <= MAX_BYTES
    assert Schema.from_text(schema.to_text()).to_text() == schema.to_text()
    assert len(schema.hash) == 16
    assert schema.dtype().itemsize == schema.size
    assert f"fw_{schema.name};" in schema.c_struct()
    parsed(schema, b"")
    if schema.size < 10_000:
        parsed(schema, schema.to_proto(bytes(schema.size)))
        assert set(schema.unpack(bytes(schema.size))) == {f.name for f in schema.fields}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"n": 10**12, "shape": "array"}, "a capacity of 1000000000000 makes no sense"),
        ({"n": MAX_BYTES, "shape": "array"}, "larger than"),
        ({"n": True}, "a capacity of True"),
        ({"number": 1000}, r"a field number is 1\.\.999, got 1000"),
        ({"number": 0}, r"a field number is 1\.\.999"),
        ({"name": "x;import os"}, "a field's name is letters"),
        ({"name": "class"}, "a field's name is letters"),
        ({"values": {"A": 0}}, "an enum, and only that, has values"),
        ({"extent": [1, 1, 1]}, "an image, and only that"),
        ({"kind": "image", "extent": [1, 1, 2]}, "image of extent"),
        ({"kind": "enum", "unit": "", "values": {"A": 0, "B": 0}}, "each a number of its own"),
        ({"kind": "f4"}, "the fields of Small take 8 bytes, not 16"),
        ({"kind": "record"}, "a nested record, and only that"),
        ({"doc": "\ud800"}, "surrogates"),
    ],
)
def test_a_schema_text_that_promises_nonsense_is_refused(change, said):
    raw = json.loads(schema_of(Small).to_text())
    raw["fields"][0] |= change
    raw["size"] = 16 if change == {"kind": "f4"} else raw["size"]
    with pytest.raises(RecordError, match=f"schema text is damaged .*{said}"):
        Schema.from_text(json.dumps(raw))


@pytest.mark.parametrize("text", ["[" * 100_000, '{"fields":' * 100_000, '{"fields":[{"record":' * 30_000])
def test_a_schema_text_without_end_is_refused(text):
    with pytest.raises(RecordError, match="damaged"):
        Schema.from_text(text)


def test_records_in_each_other_without_end_are_refused():
    raw = json.loads(schema_of(Small).to_text())
    for k in range(50):
        raw = {
            "name": f"R{k}",
            "doc": "",
            "size": 8,
            "fields": [BASE | {"name": "x", "kind": "record", "unit": "", "number": 1, "values": {}, "record": raw}],
        }
    with pytest.raises(RecordError, match=f"more than {MAX_DEPTH} records in each other"):
        Schema.from_text(json.dumps(raw))


def test_a_record_may_have_as_many_fields_as_there_are_numbers():
    fields = [Field(f"f{k}", Spec("str" if k % 2 else "u8", "", "", 3 if k % 2 else 1), k) for k in range(1, 1000)]
    schema = Schema.from_text(Schema("Wide", "", fields).to_text())
    assert schema.unpack(bytes(schema.size))["f999"] == ""
    assert parsed(schema, schema.to_proto(bytes(schema.size))).f998 == 0


# -- protobuf ---------------------------------------------------------------------------------------------------


def parsed(schema, data):
    """What Google's implementation makes of the bytes."""
    pool = descriptor_pool.DescriptorPool()
    pool.Add(schema.file_descriptor())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"fairway.{schema.name}")).FromString(data)


@given(EVERY, st.lists(st.integers(0, 2**64 - 1), max_size=6))
def test_protobuf_parses_the_recorded_bytes_to_the_same_values(record, causes):
    schema = schema_of(Every)
    message = parsed(schema, schema.to_proto(schema.pack(record)) + causes_to_proto(causes))
    for f in schema.fields:
        value = getattr(message, f.name)
        assert (tuple(value) if f.spec.shape != "one" else value) == getattr(record, f.name), f.name
    assert list(message.causes) == causes


def from_proto(schema, message):
    """What a parsed message says, as `plain` says it of a record."""
    out = {}
    for f in schema.fields:
        value = getattr(message, f.name)
        if f.spec.kind == "record":
            many = tuple(from_proto(f.record, item) for item in (value if f.spec.shape != "one" else [value]))
            out[f.name] = many if f.spec.shape != "one" else many[0]
        elif f.spec.kind == "image":
            out[f.name] = "|u1", (value.height, value.width, value.channels), value.data
        else:
            out[f.name] = tuple(value) if f.spec.shape != "one" else value
    return out


@given(st.one_of(STOP, ROUTE, FRAME, PAIR), st.lists(st.integers(0, 2**64 - 1), max_size=6))
def test_protobuf_parses_nested_records_and_images_to_the_same_values(record, causes):
    schema = schema_of(type(record))
    message = parsed(schema, schema.to_proto(schema.pack(record)) + causes_to_proto(causes))
    assert from_proto(schema, message) == plain(record)
    assert list(message.causes) == causes


def test_a_recorded_image_takes_the_bytes_that_are_used():
    schema = schema_of(Frame)
    sizes = [
        len(schema.to_proto(schema.pack(Frame(1, np.zeros(extent, np.uint8))))) for extent in [(0, 0, 3), (2, 3, 3)]
    ]
    assert sizes[1] - sizes[0] == 18


def test_all_vocabulary_records_parse_as_protobuf():
    assert len(SIGNALS) > 5
    for cls in SIGNALS:
        if not any(f.required for f in msgspec.structs.fields(cls)):
            schema = schema_of(cls)
            message = parsed(schema, schema.to_proto(schema.pack(cls())))
            for f in schema.fields:
                value = getattr(message, f.name)
                assert (tuple(value) if f.spec.shape != "one" else value) == getattr(cls(), f.name)


# -- field numbers ----------------------------------------------------------------------------------------------


def test_every_field_of_the_vocabulary_has_a_number_of_its_own():
    lock = json.loads(Path(hal.signals.__file__).with_suffix(".lock.json").read_text())
    for cls in SIGNALS:
        numbers = lock[cls.__name__]
        assert set(cls.__struct_fields__) <= set(numbers)
        assert len(set(numbers.values())) == len(numbers)
        assert all(1 <= number < 1000 for number in numbers.values())
        assert {f.name: f.number for f in schema_of(cls).fields}.items() <= numbers.items()
        assert "causes" not in numbers


HEAD = "from typing import Annotated\nfrom rtdb.records import Record, f8\nclass Thing(Record):\n    '''A thing.'''\n"


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Writes and loads a module of records: a Thing of fields by name, in order, or any source."""
    monkeypatch.syspath_prepend(tmp_path)
    name = f"things_{tmp_path.name.replace('-', '_')}"

    def load(*fields, source=""):
        body = "".join(f"    {field}: Annotated[float, f8('m', 'field')] = 0.0\n" for field in fields)
        (tmp_path / f"{name}.py").write_text(source or HEAD + body)
        importlib.invalidate_caches()
        sys.modules.pop(name, None)
        for cached in (tmp_path / "__pycache__").glob("*"):
            cached.unlink()
        return importlib.import_module(name)

    yield load
    sys.modules.pop(name, None)


def test_the_lock_only_grows(module, tmp_path):
    name = module("a", "b").__name__
    lock = tmp_path / f"{name}.lock.json"
    assert extend_lock(name) == ["Thing.a = 1", "Thing.b = 2"]
    module("c", "b", "a", "d")
    assert extend_lock(name) == ["Thing.c = 3", "Thing.d = 4"]
    module("d", "e")
    assert extend_lock(name) == ["Thing.e = 5"]
    before = lock.read_text()
    assert extend_lock(name) == []
    assert lock.read_text() == before
    assert json.loads(before) == {"Thing": {"a": 1, "b": 2, "c": 3, "d": 4, "e": 5}}


def test_the_numbers_of_a_schema_are_those_of_the_lock(module, tmp_path):
    name = module("a").__name__
    (tmp_path / f"{name}.lock.json").write_text('{"Thing": {"gone": 1, "a": 9}}')
    assert schema_of(module("a").Thing).fields[0].number == 9


def test_a_field_without_a_number_is_an_error_that_names_the_command(module, tmp_path):
    name = module("a", "b").__name__
    (tmp_path / f"{name}.lock.json").write_text('{"Thing": {"a": 1}}')
    with pytest.raises(RecordError, match=rf"Thing\.b has no field number.*python -m rtdb\.lock {name}"):
        schema_of(module("a", "b").Thing)


NESTED = """
from typing import Annotated
from rtdb.records import Record, f8, nested
class Inner(Record):
    FIRST: Annotated[float, f8('m', 'first')] = 0.0
    SECOND: Annotated[float, f8('m', 'second')] = 0.0
class Outer(Record):
    THIRD: Annotated[float, f8('m', 'third')] = 0.0
    inner: Annotated[Inner, nested('inner')] = Inner()
"""


def test_other_tools_link_the_fields_of_two_versions_by_the_numbers_of_the_lock(module):
    """A message of the older version, read with the descriptor of the newer one, nested records included."""

    def version(first, second, third):
        return module(source=NESTED.replace("FIRST", first).replace("SECOND", second).replace("THIRD", third))

    old = version("removed", "kept", "gone")
    assert extend_lock(old.__name__) == ["Inner.removed = 1", "Inner.kept = 2", "Outer.gone = 1", "Outer.inner = 2"]
    schema = schema_of(old.Outer)
    data = schema.to_proto(schema.pack(old.Outer(3.5, old.Inner(1.5, 2.5))))
    new = version("kept", "added", "came")
    assert extend_lock(new.__name__) == ["Inner.added = 3", "Outer.came = 3"]
    message = parsed(schema_of(new.Outer), data)
    assert (message.inner.kept, message.inner.added, message.came) == (2.5, 0.0, 0.0)


def test_a_module_without_a_lock_counts_its_fields(module):
    assert [f.number for f in schema_of(module("x", "y").Thing).fields] == [1, 2]


def test_the_command_prints_what_it_added(module, tmp_path):
    name = module("a").__name__
    path = os.pathsep.join([str(tmp_path), *sys.path])
    done = subprocess.run(
        [sys.executable, "-m", "rtdb.lock", name],
        env=os.environ | {"PYTHONPATH": path},
        check=True,
        capture_output=True,
        text=True,
    )
    assert done.stdout == "Thing.a = 1\n"
