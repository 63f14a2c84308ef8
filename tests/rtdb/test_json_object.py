"""JSON objects: whatever JSON can say goes through, and a number is taken only in a unit that somebody named."""

import contextlib
import json
import math
from pathlib import Path

import numpy as np
import pytest
from google.protobuf import descriptor_pool, message_factory
from hypothesis import given
from hypothesis import strategies as st

import hal.signals
from rtdb import Record, RecordError, Schema, Store, schema_of
from rtdb.json_object import UNIT_OF_SUFFIX, json_schema, number_at, unit_of_key
from rtdb.recorder import Recorder
from rtdb.recording import Recording

WORDS = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
SCALARS = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**70), 2**70), st.floats(allow_nan=False, allow_infinity=False), WORDS
)
DOCUMENTS = st.dictionaries(
    WORDS,
    st.recursive(
        SCALARS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(WORDS, inner, max_size=3), max_leaves=8
    ),
    max_size=4,
)
ROOM = json_schema(4096)


# -- documents ----------------------------------------------------------------------------------------------------


@given(DOCUMENTS)
def test_a_document_round_trips(document):
    assert ROOM.unpack(ROOM.pack(document)) == document


@given(DOCUMENTS)
def test_the_payload_is_text_that_any_json_parser_reads(document):
    payload = ROOM.pack(document)
    assert len(payload) == ROOM.size
    assert json.loads(payload.rstrip(b"\0")) == document


@pytest.mark.parametrize(
    ("document", "said"),
    [
        ({"a": math.nan}, "/a is nan, which JSON cannot say"),
        ({"a": [1, {"b": math.inf}]}, "/a/1/b is inf"),
        ({"a": -math.inf}, "/a is -inf"),
        ({1: 2}, "the object has the key 1; keys are strings"),
        ({"a": {None: 2}}, "/a has the key None; keys are strings"),
        ({"a": {"b/c": {True: 2}}}, "/a/b~1c has the key True"),
        ({"a": b"bytes"}, "/a is a bytes; JSON has dict, list, str"),
        ({"a": {1, 2}}, "/a is a set"),
        ({"a": np.float32(1)}, "/a is a float32"),
        ({"a": np.zeros(3)}, "/a is a ndarray"),
        ({"a": "\ud800"}, "/a: .* is no Unicode text"),
        ({"\ud800": 1}, "is no Unicode text"),
        ({"a": 10**400}, "/a is an integer of 1329 bits, larger than any double"),
        ([], "packed from a dict, got list"),
        ("{}", "packed from a dict, got str"),
        (None, "packed from a dict, got NoneType"),
        (Record(), "packed from a dict, got Record"),
    ],
)
def test_what_json_cannot_say_is_refused_with_its_place(document, said):
    with pytest.raises(RecordError, match=said):
        ROOM.pack(document)


def test_a_document_that_contains_itself_is_refused():
    document = {}
    document["a"] = [document]
    with pytest.raises(RecordError, match="more than 64 lists and objects in each other"):
        ROOM.pack(document)


def test_a_document_that_is_too_large_is_refused_and_one_that_just_fits_is_not():
    schema = json_schema(12)
    assert schema.size == 16
    assert schema.unpack(schema.pack({"a": "äö"})) == {"a": "äö"}  # each letter takes two bytes
    with pytest.raises(RecordError, match="takes 13 bytes, the object has 12"):
        schema.pack({"a": "äöx"})


def payload(text):
    return text.encode().ljust(ROOM.size, b"\0")


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (bytes(ROOM.size), "not JSON: Expecting value at character 0"),
        (payload("{"), "not JSON: .* at character 1"),
        (payload('{"a": 1,}'), r"not JSON: .* at character [78], near"),
        (payload('{"a": 1} x'), "not JSON: Extra data at character 9"),
        (payload('{"b": "NaN", "a": NaN}'), "not JSON: NaN at character 18 is no finite number"),
        (payload('{"a": [-Infinity]}'), "not JSON: -Infinity at character 7"),
        (payload('{"b": "1e999", "a": 1e999}'), "not JSON: 1e999 at character 20"),
        (payload("[1]"), "a JSON object is expected, got a list at character 0"),
        (payload("3"), "a JSON object is expected, got a number"),
        (payload('{"a": ' + "1" * 4000 + "1" * 80), "not JSON"),
        (payload("[" * 4000), "not JSON"),
        (b'{"a": "\xff"}'.ljust(ROOM.size, b"\0"), "not JSON: byte 7 is not UTF-8"),
        (b'{"a": 1}\0{', "not JSON: Extra data at character 8"),
    ],
)
def test_what_is_not_json_is_an_error_that_names_the_position(data, said):
    with pytest.raises(RecordError, match=said):
        ROOM.unpack(data)


@given(st.binary(max_size=60) | st.text(st.sampled_from('{}[]":,0129-+e.\\unatrufls \0N'), max_size=40).map(str.encode))
def test_bytes_of_any_sort_are_a_dictionary_or_a_record_error(data):
    with contextlib.suppress(RecordError):
        assert isinstance(ROOM.unpack(data), dict)


# -- as a schema --------------------------------------------------------------------------------------------------


def test_it_comes_back_from_the_text_of_its_schema():
    back = Schema.from_text(ROOM.to_text())
    assert (back.hash, back.to_text(), back.size) == (ROOM.hash, ROOM.to_text(), ROOM.size)
    assert back.unpack(back.pack({"a": [1, 2]})) == {"a": [1, 2]}
    assert json_schema(100).hash != ROOM.hash
    assert schema_of(ROOM) is ROOM


def test_a_record_with_a_text_called_json_is_no_json_object():
    raw = json.loads(ROOM.to_text())
    raw["fields"][0]["unit"] = ""
    schema = Schema.from_text(json.dumps(raw))
    assert schema.unpack(payload("no JSON")) == {"json": "no JSON"}
    with pytest.raises(RecordError, match=r"field Json\.json was str one \[\] and is now str one \[JSON\]"):
        ROOM.check_fits(schema, "object a/b")


def test_numpy_c_and_protobuf_see_its_text():
    data = ROOM.pack({"a": "ö"})
    assert np.frombuffer(data, ROOM.dtype())[0]["json"].decode() == '{"a":"ö"}'
    assert "char json[4096];" in ROOM.c_struct()
    pool = descriptor_pool.DescriptorPool()
    pool.Add(ROOM.file_descriptor())
    message = message_factory.GetMessageClass(pool.FindMessageTypeByName("fairway.Json")).FromString(
        ROOM.to_proto(data)
    )
    assert message.json == '{"a":"ö"}'


def test_it_goes_through_the_store_and_a_recording(tmp_path: Path):
    with Store.create() as store, Recorder(tmp_path / "run.mcap", [store], {}) as recorder:
        lamp = store.join("lamp").insert("state", json_schema(100))
        for on in (True, False):
            lamp.write({"on": on, "current_a": 0.5})
            store.tick()
            recorder.record()
        assert store.snapshot().get(lamp).value == {"on": False, "current_a": 0.5}
        assert store.snapshot()["lamp/state"].value == {"on": False, "current_a": 0.5}
        with pytest.raises(RecordError, match="/current_a is nan"):
            lamp.write({"current_a": math.nan})
    rows = Recording(tmp_path / "run.mcap").read_json("lamp/state")
    assert [row.value["on"] for row in rows] == [True, False]


# -- numbers ------------------------------------------------------------------------------------------------------

DOCUMENT = {
    "speed_mps": 1.5,
    "count": 3,
    "name": "cart",
    "on": True,
    "nothing": None,
    "wheels": [{"speed_mps": 2}, {"speed_mps": -0.5}],
    "range_m": [1.0, 2.5],
    "": {"": 7},
    "a/b_m": 4,
    "c~d_s": 5,
    "heading_deg": 90,
    "huge_m": 10**400,
}


@pytest.mark.parametrize(
    ("pointer", "unit", "number"),
    [
        ("/speed_mps", "m/s", 1.5),
        ("/wheels/0/speed_mps", "m/s", 2.0),
        ("/wheels/1/speed_mps", "m/s", -0.5),
        ("/range_m/1", "m", 2.5),  # an element has the unit of its list
        ("/a~1b_m", "m", 4.0),
        ("/c~0d_s", "s", 5.0),
    ],
)
def test_a_number_is_read_in_the_unit_of_its_key(pointer, unit, number):
    found = number_at(DOCUMENT, pointer, unit)
    assert (found, type(found)) == (number, float)


@pytest.mark.parametrize(("pointer", "number"), [("/count", 3.0), ("//", 7.0), ("/speed_mps", 1.5)])
def test_a_number_whose_key_names_no_unit_is_read_in_that_of_the_wiring(pointer, number):
    assert number_at(DOCUMENT, pointer, "m/s", unit_in_wiring="m/s") == number


@pytest.mark.parametrize(
    ("pointer", "unit", "wiring", "said"),
    [
        ("/gone", "m", None, r"/gone: there is no key 'gone' in the object; there is /speed_mps, /count"),
        ("/wheels/0/x", "m", None, r"there is no key 'x' in /wheels/0; there is /speed_mps$"),
        ("/wheels/2/speed_mps", "m/s", None, "there is no element '2' in /wheels, a list of 2 from 0 on"),
        ("/wheels/-", "m/s", None, "there is no element '-'"),
        ("/wheels/01", "m/s", None, "there is no element '01'"),
        ("/wheels/\u0660", "m/s", None, "there is no element"),
        ("/wheels/99999999999999999999", "m/s", None, "there is no element"),
        ("/speed_mps/x", "m/s", None, "/speed_mps is a number, there is nothing called 'x' in it"),
        ("/nothing/x", "m/s", None, "/nothing is null, there is nothing called 'x' in it"),
        ("speed_mps", "m/s", None, "pointer 'speed_mps' begins with no /; try '/speed_mps'"),
        ("/a~2b", "m", None, "after ~ comes 0"),
        ("/a~", "m", None, "after ~ comes 0"),
        ("/name", "m", "m", r"/name: a number \[m\] is expected, got a string 'cart'"),
        ("/on", "m", "m", r"a number \[m\] is expected, got a bool True"),
        ("/nothing", "m", "m", r"a number \[m\] is expected, got null; write"),
        ("/wheels", "m", "m", r"a number \[m\] is expected, got a list"),
        ("", "m", "m", r"a number \[m\] is expected, got an object"),
        (
            "/count",
            "m/s",
            None,
            "m/s is expected, but the key names no unit; call it count_mps, or say the unit in the",
        ),
        ("/count", "furlong", None, "furlong is expected, but the key names no unit; say the unit in the wiring"),
        ("/count", "1", None, "1 is expected, but the key names no unit; say the unit in the wiring"),
        ("/count", "m/s", "rad/s", "m/s is expected, the wiring says rad/s; have the writer convert it"),
        ("/speed_mps", "rad/s", None, "rad/s is expected, the key says m/s"),
        ("/speed_mps", "rad/s", "rad/s", "rad/s is expected, the key says m/s"),
        ("/speed_mps", "m/s", "rad/s", "m/s is expected, the wiring says rad/s"),
        ("/heading_deg", "rad", "rad", "rad is expected, the key says deg"),
        ("/huge_m", "m", None, r"a finite number \[m\] is expected, got 1000"),
    ],
)
def test_an_error_says_what_was_expected_what_came_and_what_to_do(pointer, unit, wiring, said):
    with pytest.raises(RecordError, match=said):
        number_at(DOCUMENT, pointer, unit, unit_in_wiring=wiring)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_number_is_finite_even_where_no_json_was_parsed(value):
    with pytest.raises(RecordError, match=r"/x_m: a finite number \[m\] is expected, got"):
        number_at({"x_m": value}, "/x_m", "m")


def test_a_number_outside_its_range_is_refused_and_the_bounds_are_inside():
    assert number_at(DOCUMENT, "/speed_mps", "m/s", low=1.5, high=1.5) == 1.5
    with pytest.raises(RecordError, match=r"/speed_mps: a number in \[2, inf\] m/s is expected, got 1\.5"):
        number_at(DOCUMENT, "/speed_mps", "m/s", low=2)
    with pytest.raises(RecordError, match=r"a number in \[-1, 1\] m/s is expected, got 1\.5"):
        number_at(DOCUMENT, "/speed_mps", "m/s", low=-1, high=1)


@given(DOCUMENTS, st.text(st.sampled_from("/~019ab-"), max_size=8), st.sampled_from(["m", "s"]))
def test_any_pointer_into_any_document_is_a_finite_number_or_a_record_error(document, pointer, unit):
    with contextlib.suppress(RecordError):
        assert math.isfinite(number_at(document, pointer, unit, unit_in_wiring=unit))


@pytest.mark.parametrize(
    ("key", "unit"),
    [("speed_mps", "m/s"), ("x_m", "m"), ("t_ns", "ns"), ("_m", "m"), ("m", None), ("mps", None), ("left_wheel", None)],
)
def test_the_unit_stands_behind_the_last_underscore(key, unit):
    assert unit_of_key(key) == unit


def test_the_suffixes_say_what_the_vocabulary_says():
    """Fields of hal.signals whose names end in a unit are declared in that unit."""
    classes = [
        c for c in vars(hal.signals).values() if isinstance(c, type) and issubclass(c, Record) and c is not Record
    ]
    fields = [f for cls in classes for f in schema_of(cls).fields if f.spec.unit not in ("", "1")]
    named = [f for f in fields if unit_of_key(f.name)]
    assert {f.name: unit_of_key(f.name) for f in named} == {f.name: f.spec.unit for f in named}
    assert (
        {f.spec.unit for f in named} == {"m", "rad", "m/s", "rad/s", "m/s2", "s", "ns"} <= set(UNIT_OF_SUFFIX.values())
    )
    assert {f.name for f in fields} - {f.name for f in named} == {"covariance"}
