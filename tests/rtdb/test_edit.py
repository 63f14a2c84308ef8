"""What `fairway db set` makes of a value and some words, where packing with the class is the second opinion; and how
values are shown."""

from enum import IntEnum
from typing import Annotated

import numpy as np
import pytest

from rtdb import Record, RecordError, Schema, schema_of
from rtdb.db.edit import edited, packable
from rtdb.db.values import (
    Part,
    did_you_mean,
    leaves,
    lines_of,
    one_line,
    part_of,
    text_of,
    to_json,
    tokens_of_pointer,
)
from rtdb.json_object import json_schema
from rtdb.records import array, enum8, f4, f8, flag, i8, i64, image, nested, seq, text, u8


class Mode(IntEnum):
    OFF = 0
    DRIVE = 3


class Point(Record):
    """A point."""

    x_m: Annotated[float, f8("m", "east")] = 0.0
    y_m: Annotated[float, f8("m", "north")] = 0.0


class Plan(Record, eq=False):
    """A bit of everything."""

    at: Annotated[Point, nested("where")] = Point()
    speed_mps: Annotated[float, f8("m/s", "speed")] = 0.0
    gain: Annotated[float, f4("", "gain")] = 0.0
    n: Annotated[int, u8("", "number")] = 0
    small: Annotated[int, i8("", "number")] = 0
    t_ns: Annotated[int, i64("ns", "time")] = 0
    ok: Annotated[bool, flag("well")] = False
    mode: Annotated[Mode, enum8("mode")] = Mode.OFF
    name: Annotated[str, text(8, "name")] = ""
    marks: Annotated[tuple[float, ...], seq("f8", 3, "m", "marks")] = ()
    pair: Annotated[tuple[int, ...], array("u8", 2, "", "pair")] = (0, 0)
    corners: Annotated[tuple[Point, ...], nested("corners", at_most=2)] = ()
    pixels: Annotated[np.ndarray, image(2, 3, 1, "grey")] = np.zeros((1, 2, 1), np.uint8)


STORED = Schema.from_text(schema_of(Plan).to_text())  # as another process sees it
OLD = Plan(
    at=Point(1.0, 2.0), speed_mps=3.5, gain=0.5, n=7, small=-1, t_ns=1 << 60, ok=True, mode=Mode.DRIVE, name="fred",
    marks=(1.0, 2.0), pair=(8, 9), corners=(Point(5.0, 6.0),), pixels=np.full((2, 2, 1), 9, np.uint8),
)  # fmt: skip


def fields(record: Plan) -> dict[str, object]:
    return {name: getattr(record, name) for name in Plan.__struct_fields__}


def after(*assignments: str, old: Plan | None = OLD) -> bytes:
    """The payload that assignments make of a value, without the class."""
    value = STORED.unpack(schema_of(Plan).pack(old)) if old is not None else None
    return STORED.pack(packable(STORED, edited(STORED, value, assignments)))


def payload(**changes: object) -> bytes:
    """The payload of the same change, with the class."""
    return schema_of(Plan).pack(Plan(**(fields(OLD) | changes)))


def test_a_value_that_nothing_is_replaced_in_is_the_same_bytes():
    assert after() == payload()


@pytest.mark.parametrize(
    ("assignment", "changes"),
    [
        ("speed_mps=1.25", {"speed_mps": 1.25}),
        ("speed_mps=-2", {"speed_mps": -2.0}),
        ("speed_mps=1.25 m/s", {"speed_mps": 1.25}),
        ("speed_mps= 1.25   m/s ", {"speed_mps": 1.25}),
        ("speed_mps=1e-3", {"speed_mps": 1e-3}),
        ("n=255", {"n": 255}),
        ("n=0x10", {"n": 16}),
        ("small=-128", {"small": -128}),
        ("t_ns=12 ns", {"t_ns": 12}),
        ("ok=false", {"ok": False}),
        ("mode=OFF", {"mode": Mode.OFF}),
        ("mode=0", {"mode": Mode.OFF}),
        ("name=", {"name": ""}),
        ("name=a = b", {"name": "a = b"}),
        ("name=8 bytes!", {"name": "8 bytes!"}),
        ("at.x_m=9", {"at": Point(9.0, 2.0)}),
        ("/at/x_m=9 m", {"at": Point(9.0, 2.0)}),
        ('at={"x_m": 9, "y_m": 8}', {"at": Point(9.0, 8.0)}),
        ("marks=[]", {"marks": ()}),
        ("marks=[1, 2.5, -3]", {"marks": (1.0, 2.5, -3.0)}),
        ("marks.1=7 m", {"marks": (1.0, 7.0)}),
        ("pair=[1, 2]", {"pair": (1, 2)}),
        ("corners.0.y_m=-1", {"corners": (Point(5.0, -1.0),)}),
        ('corners=[{"x_m": 1, "y_m": 2}, {"x_m": 3, "y_m": 4}]', {"corners": (Point(1.0, 2.0), Point(3.0, 4.0))}),
        ('{"n": 1, "mode": "OFF"}', {"n": 1, "mode": Mode.OFF}),
    ],
)
def test_an_assignment_replaces_that_field_and_nothing_else(assignment, changes):
    assert after(assignment) == payload(**changes)


def test_several_assignments_are_carried_out_in_order():
    assert after("n=1", "at.x_m=4", "n=2") == payload(n=2, at=Point(4.0, 2.0))


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("speed=1", ["Plan has no field 'speed'", "did you mean speed_mps?"]),
        ("at.x=1", ["Point has no field 'x'"]),
        ("speed_mps=fast", ["Plan.speed_mps", "a number [m/s]", "'fast'"]),
        ("speed_mps=true", ["Plan.speed_mps", "a number"]),
        ("speed_mps=1 km/h", ["Plan.speed_mps", "is in m/s", "1 km/h"]),
        ("n=1 m", ["Plan.n", "has no unit"]),
        ("n=256", ["Plan.n", "256", "u8"]),
        ("n=-1", ["Plan.n", "-1"]),
        ("n=1.5", ["Plan.n", "a whole number"]),
        ("gain=1e300", ["Plan.gain", "f4"]),
        ("ok=1", ["Plan.ok", "true or false"]),
        ("mode=DRIV", ["Plan.mode", "did you mean DRIVE?"]),
        ("mode=2", ["Plan.mode", "'2'", "DRIVE, OFF"]),
        ("name=nine byte", ["Plan.name", "at most 8 bytes"]),
        ("marks=1", ["Plan.marks", "a list"]),
        ("marks=[1,2,3,4]", ["Plan.marks", "at most 3"]),
        ("marks=[1,", ["Plan.marks", "a list of f8"]),
        ("marks=[true]", ["Plan.marks.0", "a number"]),
        ('marks=["1"]', ["Plan.marks.0", "a number"]),
        ("marks.2=1", ["Plan.marks has no element '2'", "it has 2"]),
        ("marks.x=1", ["Plan.marks has no element 'x'"]),
        ("pair=[1]", ["Plan.pair", "exactly 2"]),
        ("corners.0=1", ["Plan.corners.0", "Point"]),
        ('corners=[{"x_m": 1}]', ["Plan.corners.0", "missing: y_m"]),
        ('corners=[{"x_m": 1, "y": 2}]', ["Plan.corners.0", "no field 'y'", "it has x_m, y_m"]),
        ("at=1", ["Plan.at", "a Point"]),
        ("speed_mps.x=1", ["Plan.speed_mps.x", "no fields of its own"]),
        ("pixels=[1]", ["Plan.pixels", "image"]),
        ("n", ["'n' is no assignment", "field=value"]),
        ('{"nn": 1}', ["no field 'nn'", "did you mean n?"]),
        ('{"n": 300}', ["Plan.n", "300"]),
        ("{n: 1}", ["not JSON"]),
    ],
)
def test_what_does_not_fit_is_refused_by_the_name_of_the_field(assignment, words):
    with pytest.raises(RecordError) as refused:
        after(assignment)
    for word in words:
        assert word in str(refused.value)


def test_the_first_value_needs_all_fields():
    with pytest.raises(RecordError, match="nothing is written yet, so give all fields; missing: at, gain, n,"):
        after("speed_mps=1", old=None)
    point = Schema.from_text(schema_of(Point).to_text())
    assert edited(point, None, ["x_m=1", "y_m=2"]) == {"x_m": 1.0, "y_m": 2.0}


# -- JSON objects -----------------------------------------------------------------------------------------------------

JSON = json_schema(200)
DOCUMENT = {"speed_mps": 1.5, "on": True, "who": "fred", "wheels": [{"slip": 0}], "a.b": None}


def test_a_value_in_a_json_object_keeps_its_type():
    said = ["speed_mps=2 m/s", "on=false", "who=7", "wheels.0.slip=0.5", "/a.b=[1]"]
    wanted = {"speed_mps": 2, "on": False, "who": "7", "wheels": [{"slip": 0.5}], "a.b": [1]}
    assert edited(JSON, DOCUMENT, said) == wanted
    assert DOCUMENT["who"] == "fred", "the old value is not touched"


def test_a_json_object_can_be_replaced_as_a_whole():
    assert edited(JSON, DOCUMENT, ['{"new": 1}', "new=2"]) == {"new": 2}
    assert edited(JSON, None, ['{"new": 1}']) == {"new": 1}


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("sped_mps=1", ["no field 'sped_mps'", "did you mean speed_mps?"]),
        ("speed_mps=fast", ["speed_mps is 1.5", "'fast'"]),
        ("speed_mps=true", ["speed_mps is 1.5"]),
        ("speed_mps=1 km/h", ["speed_mps is in m/s"]),
        ("on=0", ["on is true"]),
        ("wheels.1.slip=0", ["no element '1'"]),
        ("wheels=7", ["wheels is"]),
        ("{", ["not JSON"]),
        ("[1]", ["'[1]' is no assignment"]),
    ],
)
def test_what_does_not_fit_into_a_json_object_is_refused_by_the_name_of_the_key(assignment, words):
    with pytest.raises(RecordError) as refused:
        edited(JSON, DOCUMENT, [assignment])
    for word in words:
        assert word in str(refused.value)


def test_a_json_object_that_is_not_written_yet_has_no_fields_to_replace():
    with pytest.raises(RecordError, match="nothing is written yet, so there is no a"):
        edited(JSON, None, ["a=1"])


# -- values as text ---------------------------------------------------------------------------------------------------


def test_lines_show_units_nested_records_and_images():
    value = STORED.unpack(schema_of(Plan).pack(OLD))
    assert list(lines_of(Part(value, schema=STORED))) == [
        "  at:",
        "    x_m = 1.0 m",
        "    y_m = 2.0 m",
        "  speed_mps = 3.5 m/s",
        "  gain = 0.5",
        "  n = 7",
        "  small = -1",
        "  t_ns = 1152921504606846976 ns",
        "  ok = true",
        '  mode = "DRIVE"',
        '  name = "fred"',
        "  marks = [1.0, 2.0] m",
        "  pair = [8, 9]",
        "  corners: 1 Point",
        "    0:",
        "      x_m = 5.0 m",
        "      y_m = 6.0 m",
        "  pixels = 2x2x1 uint8",
    ]


def test_one_line_has_the_paths_of_nested_fields():
    point = Schema.from_text(schema_of(Point).to_text())
    assert one_line(point, {"x_m": 1.0, "y_m": 2.0}) == "x_m=1.0 m, y_m=2.0 m"
    assert one_line(JSON, {"a": {"speed_mps": 1}, "b": []}) == "a.speed_mps=1 m/s, b=[]"
    assert one_line(JSON, {}) == "{}"
    assert [path for path, _ in leaves({"a": {"b": 1, "c.d": 2}, "e": {}})] == [("a", "b"), ("a", "c.d"), ("e",)]


def test_a_pointer_leads_to_a_value_and_its_unit():
    value = STORED.unpack(schema_of(Plan).pack(OLD))
    at = lambda pointer: part_of(STORED, value, tokens_of_pointer(pointer))  # noqa: E731
    assert (at("/corners/0/y_m").value, at("/corners/0/y_m").unit) == (6.0, "m")
    assert (at("/marks/1").value, at("/marks/1").unit) == (2.0, "m")
    assert list(lines_of(at("/corners/0"), "/corners/0"))[1:] == ["    x_m = 5.0 m", "    y_m = 6.0 m"]
    assert next(lines_of(at("/corners"), "/corners")) == "  /corners: 1 Point"
    assert part_of(JSON, {"a/b": {"~": 1}}, tokens_of_pointer("/a~1b/~0")).value == 1
    for pointer, words in (
        ("/at/x", "Plan.at has no field 'x'"),
        ("/corners/1", "Plan.corners has no element '1'; it has 1"),
        ("/n/x", "Plan.n has no fields"),
    ):
        with pytest.raises(RecordError, match=words):
            at(pointer)
    with pytest.raises(RecordError, match="try '/n'"):
        at("n")


def test_json_for_programs_is_json():
    value = {"a": float("nan"), "b": (1.0, float("inf")), "c": np.zeros((2, 3, 1), np.uint8), "d": {"e": True}}
    assert to_json(value) == {"a": None, "b": [1.0, None], "c": "2x3x1 uint8", "d": {"e": True}}
    assert text_of((1, "ä", None)) == '[1, "ä", null]'


def test_a_name_that_is_near_is_proposed_and_otherwise_all_are_listed():
    assert did_you_mean("gps/fx", ["gps/fix", "imu/rate"], "it has") == "did you mean gps/fix?"
    assert did_you_mean("zzz", ["b", "a"], "it has") == "it has a, b"
    assert did_you_mean("zzz", [], "it has") == "it has none"
