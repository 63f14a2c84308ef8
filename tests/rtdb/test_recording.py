"""Recordings: what was written is read back, whole or cut off, by this version or a later one."""

import io
import sys
from collections.abc import Sequence
from enum import IntEnum
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import pytest

from rtdb import HOST_DEPENDENT, ObjectMissing, Record, RecordError, RecordingError, Store
from rtdb.json_object import json_schema
from rtdb.recorder import Recorder
from rtdb.recording import Recorded, Recording
from rtdb.records import array, enum8, f8, flag, i64, image, nested, seq, text, u8, u32

T0_NS = 1_700_000_000_000_000_000


class Mode(IntEnum):
    OFF = 0
    ON = 1


class Count(Record):
    n: Annotated[int, i64("", "number")] = 0


class Mixed(Record):
    """A bit of everything."""

    x_m: Annotated[float, f8("m", "east")] = 0.0
    ok: Annotated[bool, flag("flag")] = False
    mode: Annotated[Mode, enum8("mode")] = Mode.OFF
    words: Annotated[str, text(12, "words")] = ""
    some: Annotated[tuple[float, ...], seq("f8", 4, "m", "numbers")] = ()
    three: Annotated[tuple[int, ...], array("u8", 3, "", "bytes")] = (0, 0, 0)


def mixed(k):
    return Mixed(k / 3, k % 2 == 0, Mode(k % 2), f"wörd {k}", tuple(float(i) for i in range(k % 5)), (k % 256, 0, 255))


def drive(path, ticks=200, order: Sequence[str] = ("a", "b", "c"), noise=0, t0_ns=T0_NS):
    """Record three components on two stores; returns what should be read back, by topic."""
    expected = {"a/in": [], "b/out": [], "c/slow": []}
    with Store.create(t0_ns=t0_ns) as cart, Store.create(t0_ns=t0_ns) as world:
        made = {}
        for name in order:
            if name == "a":
                made["a"] = cart.join("a").insert("in", Mixed)
            if name == "b":
                made["b"] = cart.join("b").insert("out", Count, n_causes=2)
                made["pid"] = cart.find("b/out") and cart.join("host").insert("pid", Count, flags=HOST_DEPENDENT)
            if name == "c":
                made["c"] = world.join("c").insert("slow", Count, every=5, phase=3)
        with Recorder(path, [cart, world], {"scenario": "test"}) as recorder:
            for c in range(1, ticks + 1):
                now = cart.now_ns
                value = mixed(c)
                w = made["a"].write(value, now - 3)
                expected["a/in"].append(Recorded(value, c, w, max(0, now - 3), ()))
                seen = cart.snapshot().get(made["a"])
                if seen and c % 2:
                    w = made["b"].write(Count(c), seen.t_data_ns, ((made["a"].oid, seen.write),))
                    expected["b/out"].append(Recorded(Count(c), c, w, seen.t_data_ns, (("a/in", seen.write),)))
                made["pid"].write(Count(c * noise))
                w = made["c"].write(Count(-c), now)
                if c % 5 == 3:
                    expected["c/slow"].append(Recorded(Count(-c), c, w, now, ()))
                cart.tick()
                world.tick()
                recorder.record()
    return expected


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.mcap"


CLASSES = {"a/in": Mixed, "b/out": Count, "c/slow": Count}


def read_all(recording):
    return {topic: recording.read(topic, cls) for topic, cls in CLASSES.items()}


def test_what_became_visible_is_read_back(path):
    expected = drive(path)
    recording = Recording(path)
    assert recording.complete
    assert read_all(recording) == expected
    assert (recording.tick_ns, recording.t0_ns, recording.metadata["scenario"]) == (10_000_000, T0_NS, "test")
    assert (recording.last_cycle, recording.time_s(150)) == (200, 1.5)


def test_causes_are_read_back_by_topic(path):
    drive(path, ticks=9)
    causes = [(row.cycle, row.causes) for row in Recording(path).read("b/out", Count)]
    assert causes == [(3, (("a/in", 2),)), (5, (("a/in", 4),)), (7, (("a/in", 6),)), (9, (("a/in", 8),))]


def test_who_catches_up_now_and_then_records_what_one_does_who_comes_after_each_tick(tmp_path):
    with Store.create(t0_ns=T0_NS) as cart, Store.create(t0_ns=T0_NS) as world:
        a = cart.join("a").insert("in", Mixed)
        b = cart.join("b").insert("out", Count, every=2, n_causes=1)
        c = world.join("c").insert("slow", Count, every=5, phase=3)
        with (
            Recorder(tmp_path / "each.mcap", [cart, world], {}) as each,
            Recorder(tmp_path / "now-and-then.mcap", [cart, world], {}) as looking_on,
        ):
            for k in range(1, 120):
                b.write(Count(k), inputs=[cart.at_cycle(k - 1).get(a)] if k > 2 else ())
                a.write(mixed(k))
                c.write(Count(k))
                if k == 60:
                    cart.join("late").insert("comer", Count).write(Count(1))
                cart.tick()
                world.tick()
                each.record()
                if k % 17 == 0:
                    looking_on.catch_up(k)
            looking_on.catch_up(k)
    one, other = Recording(tmp_path / "each.mcap"), Recording(tmp_path / "now-and-then.mcap")
    assert other.trace_hash() == one.trace_hash()
    assert other.last_cycle == one.last_cycle
    assert looking_on.lost == 0


def test_who_catches_up_too_late_counts_what_aged_out(path):
    with Store.create() as store:
        n = store.join("a").insert("n", Count, history_s=0.05)
        with Recorder(path, [store], {}) as recorder:
            for k in range(100):
                n.write(Count(k))
                store.tick()
            recorder.catch_up(store.cycle)
        rows = Recording(path).read("a/n", Count)
        assert 0 < len(rows) < 100
        assert recorder.lost == 100 - len(rows)
        assert all(row.value.n == row.cycle - 1 for row in rows)


def test_stores_of_different_times_are_recorded_in_that_of_the_first_and_one_that_stands_is_not_waited_for(path):
    with Store.create(t0_ns=T0_NS) as cart, Store.create(t0_ns=5_000) as world:
        n, m = cart.join("a").insert("n", Count), world.join("b").insert("m", Count)
        n.write(Count(1), t_data_ns=T0_NS + 7)
        m.write(Count(2), t_data_ns=5_007)
        cart.tick()
        for _ in range(3):
            world.tick()
        m.write(Count(3))
        world.tick()
        with Recorder(path, [cart, world], {}) as recorder:
            recorder.catch_up(4)
    recording = Recording(path)
    assert [(row.cycle, row.t_data_ns) for row in recording.read("a/n", Count)] == [(1, T0_NS + 7)]
    assert [(row.cycle, row.value.n) for row in recording.read("b/m", Count)] == [(1, 2), (4, 3)]
    assert recording.read("b/m", Count)[0].t_data_ns == T0_NS + 7


def test_objects_that_come_during_the_recording_are_in_it(path):
    with Store.create() as store, Recorder(path, [store], {}) as recorder:
        a = store.join("a")
        for k in range(5):
            a.insert(f"n{k}", Count).write(Count(k))
            store.tick()
            recorder.record()
    recording = Recording(path)
    assert {t: [(r.value.n, r.cycle) for r in recording.read(t, Count)] for t in recording.channels} == {
        f"a/n{k}": [(k, k + 1)] for k in range(5)
    }


def test_a_cause_that_has_not_become_visible_yet_is_recorded(path):
    """A free-running component may name the newest write of an object whose edge is later than its own."""
    with Store.create() as store:
        a = store.join("a")
        out = a.insert("out", Count, n_causes=1)
        with Recorder(path, [store], {}) as recorder:
            late = a.insert("late", Count, every=100)
            out.write(Count(1), causes=((late.oid, late.write(Count(1))),))
            store.tick()
            recorder.record()
    assert Recording(path).read("a/out", Count)[0].causes == (("a/late", 1),)


# -- cut off ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_a_recording_that_was_cut_off_is_readable_up_to_there(path, share):
    expected = drive(path, ticks=3000)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    recording = Recording(path)
    assert not recording.complete
    assert recording.last_cycle >= 3000 * (share - 0.2)
    for topic, rows in read_all(recording).items():
        assert rows == expected[topic][: len(rows)]
        assert len(rows) >= len(expected[topic]) * (share - 0.2)


def test_a_recording_cut_off_anywhere_is_a_beginning_and_is_said_to_be_incomplete(path):
    expected = drive(path, ticks=12)
    data = path.read_bytes()
    readable = 0
    for size in range(0, len(data), 7):
        path.write_bytes(data[:size])
        try:
            recording = Recording(path)
        except RecordingError:
            continue
        readable += 1
        assert not recording.complete
        for topic in recording.channels.keys() & expected.keys():
            rows = recording.read(topic, CLASSES[topic])
            assert rows == expected[topic][: len(rows)]
    assert readable > 10


def test_a_recorder_that_was_never_closed_leaves_what_it_flushed(path):
    with Store.create() as store:
        writer = store.join("a").insert("n", Count)
        recorder = Recorder(path, [store], {})
        for c in range(1, 3001):
            writer.write(Count(c))
            store.tick()
            recorder.record()
        data = path.read_bytes()
        recorder.close()
    path.write_bytes(data)
    recording = Recording(path)
    rows = recording.read("a/n", Count)
    assert not recording.complete
    assert [row.value.n for row in rows] == list(range(1, len(rows) + 1))
    assert len(rows) > 1000


def test_no_more_than_a_second_and_a_half_is_lost_when_the_process_dies(path):
    """As the recorder's first lines promise: flushed once a second of store time."""
    with Store.create() as store:
        writer = store.join("a").insert("n", Count)
        recorder = Recorder(path, [store], {})
        for c in range(1, 401):
            writer.write(Count(c))
            store.tick()
            recorder.record()
        data = path.read_bytes()
        recorder.close()
    path.write_bytes(data)
    assert Recording(path).last_cycle >= 250


# -- evolution --------------------------------------------------------------------------------------------------


class V1:
    class Thing(Record):
        x_m: Annotated[float, f8("m", "east")] = 0.0
        old: Annotated[int, i64("", "went away")] = 0
        mode: Annotated[Mode, enum8("mode")] = Mode.OFF


class V2:
    class Thing(Record):
        mode: Annotated[Mode, enum8("mode")] = Mode.OFF
        x_m: Annotated[float, f8("m", "east")] = 0.0
        quality: Annotated[float, f8("", "was added")] = 0.25
        note: Annotated[str, text(8, "was added")] = "none"


class OtherUnit:
    class Thing(Record):
        x_m: Annotated[float, f8("km", "east")] = 0.0


class OtherType:
    class Thing(Record):
        x_m: Annotated[int, i64("m", "east")] = 0


class OtherShape:
    class Thing(Record):
        x_m: Annotated[tuple[float, ...], seq("f8", 3, "m", "east")] = ()


class Demanding:
    class Thing(Record):
        needed: Annotated[int, u8("", "has no default")]
        x_m: Annotated[float, f8("m", "east")] = 0.0


@pytest.fixture
def old(path):
    """A recording of the first version."""
    with Store.create() as store:
        writer = store.join("a").insert("thing", V1.Thing)
        with Recorder(path, [store], {}) as recorder:
            for c in (1, 2):
                writer.write(V1.Thing(c * 1.5, c, Mode.ON))
                store.tick()
                recorder.record()
    return Recording(path)


def test_a_field_that_was_added_takes_its_default_and_one_that_was_removed_is_ignored(old):
    assert [row.value for row in old.read("a/thing", V2.Thing)] == [
        V2.Thing(Mode.ON, 1.5, 0.25, "none"),
        V2.Thing(Mode.ON, 3.0, 0.25, "none"),
    ]


@pytest.mark.parametrize("later", [OtherUnit, OtherType, OtherShape])
def test_a_field_that_changed_its_meaning_is_an_error_that_names_it(old, later):
    with pytest.raises(RecordError, match=r"Thing\.x_m"):
        old.read("a/thing", later.Thing)


def test_a_field_that_was_added_without_a_default_is_an_error_that_names_it(old):
    with pytest.raises(RecordError, match=r"has no field Thing\.needed, which has no default"):
        old.read("a/thing", Demanding.Thing)


def test_a_topic_that_was_not_recorded_is_an_error_that_names_what_was(old):
    with pytest.raises(ObjectMissing, match=r"no/thing.*a/thing"):
        old.read("no/thing", V1.Thing)
    assert old.find("no/thing", V1.Thing) == []
    assert len(old.find("a/thing", V1.Thing)) == 2


# -- evolution, of a recording that is years old -------------------------------------------------------------------

OLDER = Path(__file__).parent / "data" / "older.mcap"


class Gear(IntEnum):
    NEUTRAL = 0
    FORWARD = 1


class Older:
    """What older.mcap was recorded with. Never changed: programs of that time are gone, their recordings are not."""

    class Spot(Record):
        x_m: Annotated[float, f8("m", "east")] = 0.0
        h_m: Annotated[float, f8("m", "was removed since")] = 0.0


class OlderTrip(Record):
    """A bit of everything, as it was once declared."""

    number: Annotated[int, u32("", "number")] = 0
    heading_deg: Annotated[float, f8("deg", "was removed since")] = 0.0
    title: Annotated[str, text(12, "is called name since")] = ""
    gear: Annotated[Gear, enum8("gear")] = Gear.NEUTRAL
    speed_mps: Annotated[float, f8("m/s", "speed")] = 0.0
    gains: Annotated[tuple[float, ...], array("f8", 3, "1", "gains")] = (0.0, 0.0, 0.0)
    start: Annotated[Older.Spot, nested("where it begins")] = Older.Spot()
    stops: Annotated[tuple[Older.Spot, ...], nested("on the way", at_most=3)] = ()


class OlderView(Record, eq=False):
    """An image, as it was once declared."""

    pixels: Annotated[np.ndarray, image(2, 3, 3, "blue, green, red")]


def older_trip(k):
    return OlderTrip(
        number=k,
        heading_deg=45.0,
        title=f"trip {k}",
        gear=Gear.FORWARD,
        speed_mps=k * 0.5,
        gains=(1.0, 2.0, 3.0),
        start=Older.Spot(x_m=10.0 * k, h_m=1.0),
        stops=tuple(Older.Spot(x_m=float(i)) for i in range(k)),
    )


def write_older(path):
    """Write older.mcap: `python tests/rtdb/test_recording.py --write`, with the program of that time."""
    with Store.create(t0_ns=T0_NS) as store:
        a = store.join("a")
        trip, view, lamp = a.insert("trip", OlderTrip), a.insert("view", OlderView), a.insert("lamp", json_schema(64))
        with Recorder(path, [store], {}) as recorder:
            for k in (1, 2):
                trip.write(older_trip(k))
                view.write(OlderView(np.full((k, 3, 3), k, np.uint8)))
                lamp.write({"on": k == 1, "current_a": k * 0.5})
                store.tick()
                recorder.record()


class Newer:
    """Today's declarations."""

    class Spot(Record):
        sigma_m: Annotated[float, f8("m", "was added")] = 0.5
        x_m: Annotated[float, f8("m", "east")] = 0.0

    class Reason(Record):
        code: Annotated[int, u8("", "code")] = 7


class Trip(Record):
    """What became of OlderTrip: added, removed, renamed, moved, more room."""

    gear: Annotated[Gear, enum8("gear")] = Gear.NEUTRAL
    name: Annotated[str, text(20, "was called title")] = "nameless"
    number: Annotated[int, u32("", "number")] = 0
    quality: Annotated[float, f8("1", "was added")] = 0.25
    reason: Annotated[Newer.Reason, nested("was added")] = Newer.Reason()
    speed_mps: Annotated[float, f8("m/s", "speed")] = 0.0
    start: Annotated[Newer.Spot, nested("where it begins")] = Newer.Spot()
    stops: Annotated[tuple[Newer.Spot, ...], nested("on the way", at_most=5)] = ()


class View(Record, eq=False):
    taken_s: Annotated[float, f8("s", "was added")] = -1.0
    pixels: Annotated[np.ndarray, image(4, 4, 3, "larger ones by now")] = msgspec.field(
        default_factory=lambda: np.zeros((0, 0, 3), np.uint8)
    )


def test_an_older_recording_is_read_with_todays_records():
    """Added: the default. Removed: ignored. Renamed: removed and added. Moved within the record: linked by its name."""
    assert [row.value for row in Recording(OLDER).read("a/trip", Trip)] == [
        Trip(
            gear=Gear.FORWARD,
            name="nameless",
            number=k,
            quality=0.25,
            reason=Newer.Reason(7),
            speed_mps=k * 0.5,
            start=Newer.Spot(0.5, 10.0 * k),
            stops=tuple(Newer.Spot(0.5, float(i)) for i in range(k)),
        )
        for k in (1, 2)
    ]


def test_an_older_recording_is_read_with_the_records_of_its_time():
    assert [row.value for row in Recording(OLDER).read("a/trip", OlderTrip)] == [older_trip(1), older_trip(2)]


def test_images_of_an_older_recording_are_read_back_read_only():
    rows = Recording(OLDER).read("a/view", View)
    assert [(row.value.taken_s, row.value.pixels.tolist()) for row in rows] == [
        (-1.0, [[[1] * 3] * 3]),
        (-1.0, [[[2] * 3] * 3] * 2),
    ]
    assert not rows[0].value.pixels.flags.writeable


def test_json_of_an_older_recording_is_read_back_as_dictionaries():
    recording = Recording(OLDER)
    rows = recording.read_json("a/lamp")
    assert [row.value for row in rows] == [{"on": True, "current_a": 0.5}, {"on": False, "current_a": 1.0}]
    with pytest.raises(RecordingError, match="a/lamp is JSON without a record; use read_json"):
        recording.read("a/lamp", Trip)
    with pytest.raises(RecordingError, match="a/trip holds the record OlderTrip, not JSON; use read"):
        recording.read_json("a/trip")
    with pytest.raises(ObjectMissing, match="holds no a/gone; it holds a/lamp, a/trip, a/view"):
        recording.read_json("a/gone")


def declared(**fields):
    """A class of today in which only these fields are left, each with a default of None."""
    return msgspec.defstruct("Trip", [(name, hint, None) for name, hint in fields.items()], bases=(Record,))


class FarSpot(Record):
    x_m: Annotated[float, f8("km", "east")] = 0.0


Renumbered = IntEnum("Renumbered", {"NEUTRAL": 0, "FORWARD": 2})


@pytest.mark.parametrize(
    ("later", "said"),
    [
        (declared(speed_mps=Annotated[float, f8("km/h", "speed")]), r"Trip\.speed_mps was f8 one \[m/s\] .* \[km/h\]"),
        (declared(number=Annotated[int, i64("", "number")]), r"Trip\.number was u32 one \[\] and is now i64 one \[\]"),
        (declared(number=Annotated[str, text(4, "number")]), r"Trip\.number was u32 one .* now str one"),
        (
            declared(gains=Annotated[tuple, array("f8", 2, "1", "gains")]),
            r"Trip\.gains was f8 array of 3 .* of 2 \[1\]",
        ),
        (declared(gains=Annotated[tuple, seq("f8", 3, "1", "gains")]), r"Trip\.gains was f8 array of 3 .* now f8 seq"),
        (declared(gear=Annotated[Renumbered, enum8("gear")]), r"FORWARD of field Trip\.gear was 1 and is now 2"),
        (declared(start=Annotated[float, f8("m", "start")]), r"Trip\.start was record one .* now f8 one \[m\]"),
        (
            declared(start=Annotated[FarSpot, nested("where it begins")]),
            r"Trip\.start\.x_m was f8 one \[m\] and is now f8 one \[km\]",
        ),
        (
            declared(stops=Annotated[tuple[Demanding.Thing, ...], nested("on the way", at_most=3)]),
            r"has no field Trip\.stops\.needed, which has no default",
        ),
    ],
)
def test_a_type_or_unit_that_changed_since_an_older_recording_is_an_error_that_names_the_field(later, said):
    recording = Recording(OLDER)
    with pytest.raises(RecordError, match=rf"older\.mcap.*{said}"):
        recording.read("a/trip", later)


def test_the_program_of_today_writes_what_the_older_one_wrote(path):
    write_older(path)
    assert Recording(path).trace_hash() == Recording(OLDER).trace_hash()


# -- trace ------------------------------------------------------------------------------------------------------


def trace(path, **options):
    drive(path, ticks=30, **options)
    return Recording(path).trace_hash()


def test_the_trace_does_not_depend_on_who_came_first(path):
    assert trace(path) == trace(path, order=("c", "b", "a")) == trace(path, order=("b", "a", "c"))


def test_what_depends_on_the_host_is_recorded_but_not_in_the_trace(path):
    quiet = trace(path, noise=0)
    assert trace(path, noise=1) == quiet
    assert [row.value.n for row in Recording(path).read("host/pid", Count)] == list(range(1, 31))


def one_run(path, values, data_time=0, name="n"):
    with Store.create() as store:
        writer = store.join("a").insert(name, Count)
        with Recorder(path, [store], {}) as recorder:
            for value in values:
                if value is not None:
                    writer.write(Count(value), data_time)
                store.tick()
                recorder.record()
    return Recording(path).trace_hash()


def test_the_trace_tells_values_times_names_and_cycles_apart(path):
    runs = [
        one_run(path, [1, 2]),
        one_run(path, [1, 3]),
        one_run(path, [1, 2], data_time=1),
        one_run(path, [1, 2], name="m"),
        one_run(path, [1, None, 2]),
        one_run(path, [1]),
    ]
    assert len(set(runs)) == len(runs)
    assert one_run(path, [1, 2]) == runs[0]


def test_the_trace_does_not_depend_on_which_host_dependent_objects_there_are(path):
    """A run with more tools or processes beside it is the same run, causes included."""
    hashes = []
    for host in (False, True):
        with Store.create() as store:
            if host:
                store.join("aa").insert("pid", Count, flags=HOST_DEPENDENT)
            a = store.join("b")
            source, sink = a.insert("in", Count), a.insert("out", Count, n_causes=1)
            with Recorder(path, [store], {}) as recorder:
                sink.write(Count(1), causes=((source.oid, source.write(Count(1))),))
                store.tick()
                recorder.record()
        hashes.append(Recording(path).trace_hash())
    assert hashes[0] == hashes[1]


# -- not a recording --------------------------------------------------------------------------------------------


def foreign():
    """An MCAP file of somebody else."""
    from mcap.writer import Writer

    file = io.BytesIO()
    writer = Writer(file)
    writer.start(profile="", library="other")
    schema = writer.register_schema("s", "jsonschema", b"{}")
    channel = writer.register_channel("t", "json", schema)
    writer.add_message(channel, 1, b"{}", 1)
    writer.finish()
    return file.getvalue()


@pytest.mark.parametrize(
    "data",
    [b"", b"junk", bytes(1000), b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + bytes(range(256)), foreign()],
    ids=["empty", "junk", "zeros", "magic", "damaged", "foreign"],
)
def test_a_file_that_is_no_recording_is_one_clear_error(path, data):
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=r"run\.mcap is not a recording of Fairway") as refused:
        Recording(path)
    assert "\n" not in str(refused.value)


def test_a_recording_that_is_not_there_is_one_clear_error(tmp_path):
    with pytest.raises(RecordingError, match=r"no recording at .*gone\.mcap"):
        Recording(tmp_path / "gone.mcap")
    with pytest.raises(RecordingError, match=r"recording"):
        Recording(tmp_path)


def test_a_recording_of_a_later_format_is_refused(path):
    with Store.create() as store, Recorder(path, [store], {"format": "2"}):
        pass
    with pytest.raises(RecordingError, match="format 2"):
        Recording(path)


def test_an_object_that_is_deleted_and_inserted_again_goes_on_in_its_topic(tmp_path):
    with Store.create() as store, Recorder(tmp_path / "run.mcap", [store], {}) as recorder:
        a = store.join("a")
        for n in (1, 2):
            writer = a.insert("n", Count)
            writer.write(Count(n))
            store.tick()
            recorder.record()
            writer.delete()
    recording = Recording(tmp_path / "run.mcap")
    assert [r.value.n for r in recording.read("a/n", Count)] == [1, 2]
    assert list(recording.channels) == ["a/n"]


def test_a_name_that_another_record_took_keeps_both(tmp_path):
    with Store.create() as store, Recorder(tmp_path / "run.mcap", [store], {}) as recorder:
        a = store.join("a")
        a.insert("n", Count).write(Count(1))
        store.tick()
        recorder.record()
        a.insert("n", Mixed).write(mixed(2))  # in place of the first
        store.tick()
        recorder.record()
    recording = Recording(tmp_path / "run.mcap")
    first, second = recording.channels
    assert (first, second.split("@")[0]) == ("a/n", "a/n")
    assert [r.value for r in recording.read(first, Count)] == [Count(1)]
    assert [r.value for r in recording.read(second, Mixed)] == [mixed(2)]


if __name__ == "__main__" and sys.argv[1:] == ["--write"]:
    OLDER.parent.mkdir(exist_ok=True)
    write_older(OLDER)
