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
from rtdb import Record, RecordError, Schema, schema_of
from rtdb.lock import extend_lock
from rtdb.records import array, causes_to_proto, enum8, f4, f8, flag, i32, i64, seq, text, u8, u32, u64


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
)
SIGNALS = [
    cls
    for _, cls in inspect.getmembers(hal.signals, inspect.isclass)
    if issubclass(cls, Record) and cls.__module__ == "hal.signals"
]


# -- layout -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def c_layout(tmp_path_factory):
    """Size and offsets as a C compiler sees them: {record: {field: offset}, with "" for the size}."""
    schemas = [schema_of(cls) for cls in (Every, SeqBehindInt, Small, Bytes, *SIGNALS)]
    lines = ["#include <stdbool.h>", "#include <stddef.h>", "#include <stdint.h>", "#include <stdio.h>"]
    lines += [s.c_struct().split("_Static_assert")[0] for s in schemas] + ["int main(void) {"]
    for s in schemas:
        lines.append(f'printf("{s.name} . %zu\\n", sizeof(fw_{s.name}));')
        for f in s.fields:
            for name in [f.name] + [f"{f.name}_n"] * (f.spec.shape == "seq"):
                lines.append(f'printf("{s.name} {name} %zu\\n", offsetof(fw_{s.name}, {name}));')
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


@pytest.mark.parametrize("cls", [Every, SeqBehindInt, Small, Bytes, *SIGNALS])
def test_a_c_compiler_and_numpy_lay_a_record_out_as_its_schema_says(c_layout, cls):
    schema = schema_of(cls)
    expected = {".": schema.size} | {f.name: f.data_offset for f in schema.fields}
    expected |= {f"{f.name}_n": f.offset for f in schema.fields if f.spec.shape == "seq"}
    dtype = schema.dtype()
    assert {".": dtype.itemsize} | {n: dtype.fields[n][1] for n in dtype.names} == expected
    assert c_layout[cls.__name__] == expected


@pytest.mark.parametrize("cls", [Every, SeqBehindInt, Small, Bytes, *SIGNALS])
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


@pytest.mark.parametrize("cls", [Every, SeqBehindInt, Small, Bytes, *SIGNALS])
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


BASE = {"kind": "f8", "unit": "m", "doc": "d", "n": 1, "shape": "one", "number": 1, "values": {}}


def schema_with(name="R", **change):
    fields = [BASE | {"name": "x"} | change, BASE | {"name": "y", "number": 2}]
    return Schema.from_text(json.dumps({"name": name, "doc": "", "size": 16, "fields": fields}))


@pytest.mark.parametrize(
    "change", [{"unit": "km"}, {"kind": "i64"}, {"name": "X"}, {"shape": "array"}, {"n": 2, "shape": "array"}]
)
def test_the_hash_covers_what_two_programs_must_agree_on(change):
    assert schema_with(**change).hash != schema_with().hash


def test_the_hash_does_not_cover_words_of_explanation():
    assert schema_with(doc="said better").hash == schema_with().hash


@pytest.mark.parametrize("change", [{"unit": "km"}, {"kind": "f4"}, {"shape": "array"}])
def test_a_field_that_changed_its_meaning_does_not_fit(change):
    with pytest.raises(RecordError, match=r"field R\.x was .* and is now"):
        schema_with().check_fits(schema_with(**change), "an old recording")


def test_a_field_that_came_or_went_fits():
    schema_with().check_fits(schema_with(name="R", unit="m"), "itself")
    old = Schema.from_text(json.dumps({"name": "R", "doc": "", "size": 8, "fields": [BASE | {"name": "gone"}]}))
    schema_with().check_fits(old, "an old recording")
    old.check_fits(schema_with(), "a new recording")


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
    """Writes and loads a module of records: fields by name, in order."""
    monkeypatch.syspath_prepend(tmp_path)
    name = f"things_{tmp_path.name.replace('-', '_')}"

    def load(*fields):
        body = "".join(f"    {field}: Annotated[float, f8('m', 'field')] = 0.0\n" for field in fields)
        (tmp_path / f"{name}.py").write_text(HEAD + body)
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
