"""One process, one store, private or shared: edges, cuts, history, refusals, images."""

import contextlib
from typing import Annotated

import numpy as np
import pytest
from conftest import Count, count_to, segment_path, shown

from rtdb import (
    AgedOut,
    DataTimeBackward,
    Deleted,
    Flag,
    InUse,
    NameTaken,
    NotOwner,
    NotYet,
    ObjectMissing,
    Record,
    RecordError,
    Store,
    StoreFull,
    TooFast,
)
from rtdb.records import f8, text

TICK_S = 0.01


class Pose(Record):
    x_m: Annotated[float, f8("m", "east")] = 0.0
    y_m: Annotated[float, f8("m", "north")] = 0.0


class Other:
    """Another program's records."""

    class Pose(Record):
        """Of the same name, in another unit."""

        x_m: Annotated[float, f8("mm", "east")] = 0.0


class Note(Record):
    words: Annotated[str, text(8, "words")] = ""


def insert_raw(store, name, *, size=8, n_slots=8, every=1, phase=0, flags=0, n_causes=0):
    """Insert an object of component 0 past the checks of Python."""
    return store.core.insert(name, 0, 0, size, n_slots, every, phase, flags, n_causes, 0, 0, 0, 0)


def names(store):
    """The objects of a store, without those that components write about themselves."""
    return [obj.name for obj in store.objects() if not obj.name.endswith("/health")]


# -- edges -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("every", "phase"), [(1, 0), (2, 0), (2, 1), (4, 3), (10, 0)])
def test_a_write_shows_at_the_due_tick_and_stays_until_the_next(store, every, phase):
    writer = store.join("a").insert("n", Count, every=every, phase=phase)
    for c in range(1, 45):
        writer.write(Count(c))
        store.tick()
        due = c - (c - phase) % every
        assert shown(store.snapshot(), writer) == (due if due >= 1 else None)


def test_objects_that_are_not_due_keep_what_they_show(store):
    a = store.join("a")
    fast, slow = a.insert("fast", Count), a.insert("slow", Count, every=5, phase=2)
    seen = []
    for c in range(1, 10):
        fast.write(Count(c))
        slow.write(Count(c))
        store.tick()
        seen.append((shown(store.snapshot(), fast), shown(store.snapshot(), slow)))
    assert seen == [(1, None), (2, 2), (3, 2), (4, 2), (5, 2), (6, 2), (7, 7), (8, 7), (9, 7)]


def test_nothing_shows_before_the_edge(store):
    writer = store.join("a").insert("n", Count)
    writer.write(Count(7))
    assert store.snapshot().get(writer) is None
    assert writer.latest().value == Count(7)
    with pytest.raises(ObjectMissing, match="a/n shows nothing yet in cycle 0"):
        store.snapshot()["a/n"]


def test_latest_runs_ahead_of_what_is_visible(store):
    writer = store.join("a").insert("n", Count)
    writer.write(Count(1))
    store.tick()
    writer.write(Count(2))
    assert (shown(store.snapshot(), writer), writer.latest().value.n) == (1, 2)


def test_the_last_write_before_an_edge_is_the_one_that_shows(store):
    writer = store.join("a").insert("n", Count)
    for n in (5, 6, 7):
        writer.write(Count(n))
    store.tick()
    assert shown(store.snapshot(), writer) == 7
    assert writer.read(2).value.n == 6


def test_a_phase_beyond_the_period_is_taken_within_it(store):
    writer = store.join("a").insert("n", Count, every=4, phase=6)
    assert writer.phase == 2


# -- cuts --------------------------------------------------------------------------------------------------


def test_cuts_are_repeatable_and_coherent_over_all_objects(store):
    a = store.join("a")
    rates = ((1, 0), (2, 1), (3, 0), (7, 4))
    writers = [a.insert(f"n{every}", Count, every=every, phase=phase, history_s=9.0) for every, phase in rates]
    then = []
    for c in range(1, 60):
        for writer in writers:
            writer.write(Count(c))
        store.tick()
        then.append([shown(store.snapshot(), writer) for writer in writers])
    for c, row in enumerate(then, start=1):
        assert [shown(store.at_cycle(c), writer) for writer in writers] == row
        assert row == [c - (c - p) % e if c - (c - p) % e >= 1 else None for e, p in rates]


def test_at_a_time_gives_the_cut_of_the_last_tick_before_it(unique):
    with Store.create(unique(), t0_ns=5_000_000_000) as store:
        count_to(store, writer := store.join("a").insert("n", Count), 6)
        assert store.now_ns == 5_060_000_000
        for t_ns, expected in (
            (5_030_000_000, 3),
            (5_039_999_999, 3),
            (5_040_000_000, 4),
            (5_060_000_000, 6),
        ):
            assert shown(store.at(t_ns), writer) == expected
        assert store.at(5_009_999_999).get(writer) is None
        assert store.at(0).get(writer) is None


def test_a_cut_that_was_taken_does_not_move_on_with_the_clock(store):
    count_to(store, writer := store.join("a").insert("n", Count), 3)
    cut = store.snapshot()
    count_to(store, writer, 9)
    assert (cut.cycle, shown(cut, writer)) == (3, 3)


def test_cuts_stay_as_long_as_the_history_and_then_age_out(store):
    writer = store.join("a").insert("n", Count, history_s=20 * TICK_S)
    count_to(store, writer, 100)
    ages = {}
    for c in range(1, 101):
        try:
            ages[c] = shown(store.at_cycle(c), writer)
        except AgedOut:
            ages[c] = "aged out"
    assert all(value in {c, "aged out"} for c, value in ages.items())
    assert all(ages[c] == c for c in range(80, 101))
    assert ages[70] == "aged out"


def test_an_old_cut_of_a_slow_object_outlives_that_of_a_fast_one(store):
    a = store.join("a")
    fast, slow = a.insert("fast", Count, history_s=0.1), a.insert("slow", Count, every=10, history_s=2.0)
    for c in range(1, 101):
        fast.write(Count(c))
        if c % 10 == 0:
            slow.write(Count(c))
        store.tick()
    assert shown(store.at_cycle(15), slow) == 10
    with pytest.raises(AgedOut, match="a/fast"):
        store.at_cycle(15).get(fast)


def test_what_stopped_changing_never_ages_out_of_the_current_cut(store):
    writer = store.join("a").insert("n", Count, history_s=TICK_S)
    writer.write(Count(42))
    for _ in range(500):
        store.tick()
    assert shown(store.snapshot(), writer) == 42
    assert shown(store.at_cycle(1), writer) == 42


def test_the_time_before_the_first_write_is_never_given_a_later_value(store):
    writer = store.join("a").insert("n", Count, history_s=5 * TICK_S)
    for _ in range(10):
        store.tick()
    assert store.at_cycle(3).get(writer) is None
    for c in range(11, 60):
        writer.write(Count(c))
        store.tick()
    with pytest.raises(AgedOut):
        store.at_cycle(3).get(writer)


def test_a_cycle_in_the_future_is_not_yet(store):
    writer = store.join("a").insert("n", Count)
    store.tick()
    with pytest.raises(NotYet, match="future"):
        store.at_cycle(2).get(writer)


def test_a_write_that_has_not_happened_is_not_yet_and_one_that_wrapped_is_aged_out(store):
    writer = store.join("a").insert("n", Count, history_s=2 * TICK_S)
    count_to(store, writer, 20)
    with pytest.raises(NotYet):
        writer.read(21)
    with pytest.raises(NotYet):
        writer.read(0)
    with pytest.raises(AgedOut):
        writer.read(3)
    assert writer.read(20).value.n == 20


# -- writing -----------------------------------------------------------------------------------------------


def test_a_writer_that_is_too_fast_is_refused_counted_and_harms_nothing(store):
    writer = store.join("a").insert("n", Count, history_s=0.0)
    count_to(store, writer, 5)
    for n in range(6, 5 + writer.n_slots - 1):
        writer.write(Count(n))
    for k in (1, 2):
        with pytest.raises(TooFast, match="a/n"):
            writer.write(Count(99))
        assert writer.refused == k
    assert writer.latest().value.n == 5 + writer.n_slots - 2
    assert (shown(store.snapshot(), writer), shown(store.at_cycle(4), writer)) == (5, 4)


@pytest.mark.parametrize("ticks", [1, 2, 3, 10])
def test_a_writer_that_was_refused_goes_on_after_two_ticks(store, ticks):
    """Once the two newest cuts show its newest write, all other slots are free again."""
    writer = store.join("a").insert("n", Count, history_s=0.0)
    count_to(store, writer, 2)
    written = 2
    while writer.refused == 0:
        with contextlib.suppress(TooFast):
            writer.write(Count(written + 1))
            written += 1
    for _ in range(ticks):
        store.tick()
    assert shown(store.snapshot(), writer) == written
    if ticks >= 2:
        for n in range(100, 100 + writer.n_slots - 1):
            writer.write(Count(n))
        assert shown(store.at_cycle(store.cycle - 1), writer) == written
    for _ in range(2):
        store.tick()
    writer.write(Count(7))
    store.tick()
    assert shown(store.snapshot(), writer) == 7


def test_before_anything_is_visible_the_next_edge_still_finds_a_value(store):
    writer = store.join("a").insert("n", Count, history_s=0.0, every=10, phase=9)
    accepted = 0
    for c in range(1, 10):
        for _ in range(3):
            try:
                writer.write(Count(c))
                accepted = c
            except TooFast:
                break
        store.tick()
    assert accepted == 9
    assert shown(store.snapshot(), writer) == 9


def test_an_honest_writer_is_never_refused(store):
    a = store.join("a")
    writers = [a.insert(f"n{every}", Count, every=every, history_s=0.0) for every in (1, 3, 10)]
    for c in range(1, 200):
        for writer in writers:
            if c % writer.every == 0:
                writer.write(Count(c))
        store.tick()
    assert [writer.refused for writer in writers] == [0, 0, 0]


def test_a_data_time_before_that_of_the_write_before_is_refused(store):
    writer = store.join("a").insert("n", Count)
    for t in (-5, 50, 50, 70):
        writer.write(Count(t), t_data_ns=t)
    for t in (69, 0, -(2**63)):
        with pytest.raises(DataTimeBackward, match="a/n"):
            writer.write(Count(t), t_data_ns=t)
    with pytest.raises(DataTimeBackward, match="a/n"), writer.frame(t_data_ns=69):
        pass
    assert [writer.read(w).t_data_ns for w in (1, 2, 3, 4)] == [-5, 50, 50, 70]
    assert (writer.head, writer.latest().value.n, writer.write(Count(70), t_data_ns=70)) == (4, 70, 5)


def test_data_time_is_now_unless_it_is_said(store):
    writer = store.join("a").insert("n", Count)
    for _ in range(3):
        store.tick()
    writer.write(Count(1))
    sample = writer.latest()
    assert (sample.t_data_ns, sample.t_commit_ns) == (30_000_000, 30_000_000)


def test_causes_come_back_as_they_were_written(store):
    a = store.join("a")
    source, sink = a.insert("in", Count), a.insert("out", Count, n_causes=3)
    causes = ((source.oid, source.write(Count(1))), (source.oid, source.write(Count(2))), (2**64 - 1, 2**63))
    sink.write(Count(3), causes=causes)
    sink.write(Count(4))
    assert (sink.read(1).causes, sink.read(2).causes) == (causes, ())


def test_more_causes_than_there_is_room_for_are_refused(store):
    writer = store.join("a").insert("out", Count, n_causes=1)
    with pytest.raises(RecordError, match="a/out"):
        writer.write(Count(3), causes=((1, 1), (1, 2)))
    assert writer.head == 0


def test_writing_in_place_shows_nothing_before_the_commit(store):
    writer = store.join("a").insert("n", Count)
    writer.write(Count(1))
    with writer.frame(t_data_ns=9) as frame:
        frame.memory[:] = writer.schema.pack(Count(2))
        store.tick()
        assert (shown(store.snapshot(), writer), writer.head, frame.write) == (1, 1, 0)
    store.tick()
    assert (shown(store.snapshot(), writer), writer.latest().t_data_ns) == (2, 9)


def test_beginning_again_abandons_what_was_begun(store):
    writer = store.join("a").insert("n", Count)
    writer.frame().__enter__().array["n"] = 1
    with writer.frame() as frame:
        frame.array["n"] = 2
    assert (frame.write, writer.head, writer.latest().value.n) == (1, 1, 2)
    with pytest.raises(NotOwner):
        store.core.commit(writer.handle, writer.size, 0, ())


def test_a_write_abandons_the_frame_that_was_begun(store):
    writer = store.join("a").insert("n", Count)

    def write_within():
        with writer.frame() as frame:
            frame.array["n"] = 1
            writer.write(Count(2))

    with pytest.raises(NotOwner, match="a/n"):
        write_within()
    assert (writer.head, writer.latest().value.n) == (1, 2)


def test_a_record_of_another_type_is_refused(store):
    writer = store.join("a").insert("n", Count)
    with pytest.raises(RecordError, match="expected a Count, got Pose"):
        writer.write(Pose(1.0, 2.0))
    assert writer.head == 0


# -- history -----------------------------------------------------------------------------------------------


def test_history_is_what_was_written(store):
    writer = store.join("a").insert("pose", Pose, every=2)
    written = []
    for c in range(40):
        w = writer.write(Pose(float(c), -c / 3), t_data_ns=store.now_ns // 2)
        written.append((w, store.now_ns, store.now_ns // 2, (float(c), -c / 3)))
        store.tick()
    rows = writer.history(0, store.now_ns)
    assert [row.item() for row in rows] == written
    assert rows["value"]["x_m"].tolist() == [float(c) for c in range(40)]
    part = writer.history(100_000_000, 200_000_000)
    assert part["write"].tolist() == list(range(11, 22))


def test_history_reaches_back_to_the_oldest_write_that_is_left(store):
    writer = store.join("a").insert("n", Count, history_s=10 * TICK_S)
    count_to(store, writer, 50)
    rows = writer.history(0, store.now_ns)
    assert np.array_equal(rows["value"]["n"], rows["write"])
    assert rows["write"][-1] == 50
    assert rows["write"][0] == 50 - writer.n_slots + 2
    assert np.all(np.diff(rows["write"].astype(int)) == 1)


def test_history_of_a_time_without_writes_is_empty(store):
    writer = store.join("a").insert("n", Count)
    assert len(writer.history(0, 10**9)) == 0
    count_to(store, writer, 5)
    assert len(writer.history(10**12, 10**13)) == 0
    assert len(writer.history(-10, -1)) == 0


def test_as_of_gives_the_newest_write_at_or_before_a_time(store):
    writer = store.join("a").insert("n", Count, history_s=5 * TICK_S)
    assert store.core.as_of(writer.handle, 10**9) == 0
    count_to(store, writer, 4)  # committed at 0, 10, 20, 30 ms
    assert [store.core.as_of(writer.handle, t) for t in (-1, 0, 9_999_999, 10_000_000, 10**12)] == [
        0,
        1,
        1,
        2,
        4,
    ]
    count_to(store, writer, 30)
    with pytest.raises(AgedOut):
        store.core.as_of(writer.handle, 0)


# -- directory ---------------------------------------------------------------------------------------------


def test_a_name_is_inserted_once(store):
    writer = store.join("a").insert("n", Count)
    with pytest.raises(NameTaken, match="a/n"):
        insert_raw(store, "a/n")
    assert names(store) == ["a/n"]
    assert store.find("a/n", Count).oid == writer.oid


def test_a_component_finds_its_own_object_again(store):
    a = store.join("a")
    first = a.insert("n", Count)
    first.write(Count(3))
    again = a.insert("n", Count)
    assert (again.oid, again.write(Count(4))) == (first.oid, 2)


def test_a_component_is_joined_once(store):
    store.join("a")
    with pytest.raises(InUse, match="cannot join a"):
        store.join("a")


def test_nobody_writes_the_objects_of_a_component_that_was_left(store):
    a = store.join("a")
    writer = a.insert("n", Count)
    writer.write(Count(1))
    store.tick()
    a.leave()
    with pytest.raises(NotOwner, match="a/n"):
        writer.write(Count(2))
    assert shown(store.snapshot(), writer) == 1
    store.join("a").insert("n", Count).write(Count(5))
    assert writer.latest().value.n == 5


@pytest.mark.parametrize("name", ["", "with blank", "tab\t", "hash#", "/lead", "trail/", "new\nline"])
def test_names_that_would_not_print_are_refused(store, name):
    with pytest.raises(RecordError):
        store.join(name)
    store.join("a")
    with pytest.raises(RecordError):
        insert_raw(store, name)


def test_a_component_has_no_slash_in_its_name(store):
    with pytest.raises(RecordError):
        store.join("a/b")


def test_a_name_has_at_most_63_bytes(store):
    a = store.join("a")
    assert a.insert("x" * 61, Count).name == "a/" + "x" * 61
    with pytest.raises(RecordError, match="63 bytes"):
        a.insert("x" * 62, Count)


@pytest.mark.parametrize("history_s", [1e6, 1e9, 2**32 * TICK_S])
def test_a_history_that_is_too_long_is_refused(store, history_s):
    a = store.join("a")
    with pytest.raises((RecordError, StoreFull)):
        a.insert("n", Count, history_s=history_s)
    assert names(store) == []


@pytest.mark.parametrize("every", [0, -1])
def test_a_period_that_is_not_positive_is_refused(store, every):
    with pytest.raises(RecordError):
        store.join("a").insert("n", Count, every=every)
    with pytest.raises(RecordError):
        store.join("b", every=every)
    assert [c.name for c in store.components()] == ["a"]


@pytest.mark.parametrize("wrong", [{"every": 2**32 + 1}, {"n_causes": 2**32}])
def test_a_number_that_does_not_fit_is_refused_and_not_cut_off(store, wrong):
    a = store.join("a")
    with pytest.raises((RecordError, OverflowError)):
        a.insert("n", Count, **wrong)


@pytest.mark.parametrize(
    ("n_slots", "every", "phase", "n_causes"), [(3, 1, 0, 0), (8, 0, 0, 0), (8, 2, 2, 0), (8, 1, 0, 9)]
)
def test_the_core_refuses_what_makes_no_sense(store, n_slots, every, phase, n_causes):
    store.join("a")
    with pytest.raises(RecordError, match="out of range"):
        insert_raw(store, "a/n", n_slots=n_slots, every=every, phase=phase, n_causes=n_causes)
    assert names(store) == []


def test_an_object_of_a_component_that_one_is_not_is_refused(store):
    store.join("a").leave()
    with pytest.raises(NotOwner):
        insert_raw(store, "a/n")


def test_a_full_directory_takes_no_more_objects_and_harms_none():
    with Store.create(max_objects=3) as store:
        a = store.join("a")
        writers = [a.insert(f"n{k}", Count) for k in range(3)]
        with pytest.raises(StoreFull, match="a/n3"):
            a.insert("n3", Count)
        for k, writer in enumerate(writers):
            writer.write(Count(k))
        store.tick()
        assert [shown(store.snapshot(), writer) for writer in writers] == [0, 1, 2]


def test_a_full_segment_takes_no_more_objects_and_harms_none(store):
    a = store.join("a")
    writers = []

    def fill():
        for k in range(200):
            writers.append(a.insert(f"n{k}", Count, history_s=5.0))

    with pytest.raises(StoreFull, match="no room is left"):
        fill()
    assert len(writers) > 5
    for c in range(1, 600):
        for k, writer in enumerate(writers):
            writer.write(Count(1000 * c + k))
        store.tick()
    cut = store.at_cycle(400)
    assert [shown(cut, writer) for writer in writers] == [400_000 + k for k in range(len(writers))]


def test_objects_that_were_refused_leave_no_trace(store):
    a = store.join("a")
    a.insert("first", Count)
    with pytest.raises(StoreFull):
        a.insert("huge", Count, history_s=10_000.0)
    a.insert("second", Count)
    first, second = store.objects("a/first") + store.objects("a/second")
    assert (names(store), second.oid) == (["a/first", "a/second"], first.oid + 1)


def test_find_without_a_class_gives_dictionaries_and_with_the_wrong_one_an_error(store):
    store.join("a").insert("pose", Pose).write(Pose(1.0, 2.0))
    assert store.find("a/pose").latest().value == {"x_m": 1.0, "y_m": 2.0}
    with pytest.raises(RecordError, match="a/pose"):
        store.find("a/pose", Count)
    with pytest.raises(RecordError, match=r"a/pose.*x_m"):
        store.find("a/pose", Other.Pose)
    with pytest.raises(ObjectMissing, match="a/nothing"):
        store.find("a/nothing")
    with pytest.raises(ObjectMissing, match="a/nothing"):
        store.find("a/nothing", timeout_s=0.001)


def test_find_gives_the_class_that_was_asked_for_even_if_another_has_its_name(store):
    store.join("a").insert("n", Count)
    mine = store.find("a/n", Count)
    other = type("Count", (Count,), {"__module__": __name__, "__qualname__": Count.__qualname__})
    assert store.find("a/n", other).schema.cls is other
    assert store.find("a/n", Count).schema.cls is mine.schema.cls


def test_changed_lists_what_the_latest_tick_made_visible(store):
    a = store.join("a")
    fast, slow = a.insert("fast", Count), a.insert("slow", Count, every=3)
    slow.write(Count(8))
    fast.write(Count(9))
    seen = []
    for _ in range(4):
        store.tick()
        seen.append([handle for handle, _ in store.core.changed() if handle in (fast.handle, slow.handle)])
    assert seen == [[fast.handle], [], [slow.handle], []]


def test_components_tell_who_lives(store):
    a, b = store.join("a", participant=True), store.join("b")
    a.done(7)
    b.leave()
    told = {c.name: (c.participant, c.done) for c in store.components()}
    assert told == {"a": (True, 7), "b": (False, 0)}
    assert store.components()[0].alive


# -- mistakes ----------------------------------------------------------------------------------------------


def write_late(store, writer):
    writer.write(Count(8), t_data_ns=-1)


def write_until_refused(store, writer):
    for _ in range(writer.n_slots):
        writer.write(Count(8))


def fill_the_segment(store, writer):
    store.join("full").insert("full", Count, history_s=1e4)


def commit_nothing(store, writer):
    store.core.commit(writer.handle, writer.size, 0, ())


MISTAKES = {
    "another record": (lambda store, w: w.write(Pose()), RecordError),
    "a number for a record": (lambda store, w: w.write(7), RecordError),
    "a value out of range": (lambda store, w: w.write(Count(2**63)), RecordError),
    "a text for a number": (lambda store, w: w.write(Count("7")), RecordError),
    "more bytes than a slot has": (lambda store, w: store.core.write(w.handle, bytes(9), 10**9, ()), RecordError),
    "a text for a time": (lambda store, w: w.write(Count(8), t_data_ns="now"), TypeError),
    "a time beyond 64 bits": (lambda store, w: w.write(Count(8), t_data_ns=2**63), OverflowError),
    "data time going backward": (write_late, DataTimeBackward),
    "too many causes": (lambda store, w: w.write(Count(8), causes=((1, 1),)), RecordError),
    "causes without end": (lambda store, w: w.write(Count(8), causes=((1, 1),) * 9), (RecordError, ValueError)),
    "a list of causes": (lambda store, w: w.write(Count(8), causes=[(1, 1)]), (RecordError, TypeError)),
    "half a cause": (lambda store, w: w.write(Count(8), causes=((1,),)), (RecordError, TypeError, ValueError)),
    "a writer that is too fast": (write_until_refused, TooFast),
    "a commit of nothing": (commit_nothing, NotOwner),
    "a second writer": (lambda store, w: store.join("a"), InUse),
    "a full segment": (fill_the_segment, StoreFull),
    "an object that is not there": (lambda store, w: store.find("a/m"), ObjectMissing),
    "a handle that names nothing": (lambda store, w: store.core.latest(99 << 32 | 9), ObjectMissing),
    "a negative handle": (lambda store, w: store.core.latest(-1), ObjectMissing),
    "a component that is not there": (lambda store, w: store.snapshot().alive("b"), ObjectMissing),
    "a component that one is not": (lambda store, w: store.core.done(7, 1), NotOwner),
    "a cycle in the future": (lambda store, w: store.at_cycle(store.cycle + 1).get(w), NotYet),
    "a negative cycle": (lambda store, w: store.at_cycle(-1).get(w), (OverflowError, RecordError, NotYet)),
    "another record to read": (lambda store, w: store.find("a/n", Pose), RecordError),
    "no name": (lambda store, w: store.join(""), RecordError),
    "a name with a NUL": (lambda store, w: store.find("a/n\0"), ValueError),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_clear_error_and_the_value_before_is_still_there(store, mistake):
    do, error = MISTAKES[mistake]
    writer = store.join("a").insert("n", Count, history_s=0.0)
    writer.write(Count(5))
    store.tick()
    writer.write(Count(6))
    store.tick()
    with pytest.raises(error) as raised:
        do(store, writer)
    assert str(raised.value)
    assert "\n" not in str(raised.value)
    assert not isinstance(raised.value, SystemError)
    assert [shown(store.at_cycle(c), writer) for c in (1, 2)] == [5, 6]
    store.tick()
    store.tick()
    writer.write(Count(7))
    store.tick()
    assert shown(store.snapshot(), writer) == 7


# -- stores ------------------------------------------------------------------------------------------------


def test_nothing_is_left_in_memory_after_close(unique):
    name = unique()
    with Store.create(name) as store:
        store.join("a").insert("n", Count)
        assert segment_path(name).exists()
    assert not segment_path(name).exists()
    assert not list(segment_path(name).parent.glob(segment_path(name).name + "*"))


def test_a_closed_store_says_so(store):
    writer = store.join("a").insert("n", Count)
    store.close()
    store.close()
    for call in (store.tick, lambda: writer.write(Count(1)), lambda: store.cycle, writer.latest):
        with pytest.raises(NotOwner, match="closed"):
            call()


@pytest.mark.parametrize("name", ["", "a/b", "../up", ".hidden", "x" * 49, "with blank"])
def test_a_store_name_that_is_no_file_name_is_refused(name):
    with pytest.raises(RecordError):
        Store.create(name)
    with pytest.raises(RecordError):
        Store.attach(name)


def test_a_store_without_room_for_its_own_tables_is_refused():
    with pytest.raises(RecordError):
        Store.create(size=4096)
    for wrong in ({"tick_ns": 10}, {"size": -1}, {"max_objects": -1}, {"max_components": -1}):
        with pytest.raises((RecordError, OverflowError)):
            Store.create(**wrong)


def test_a_shared_store_makes_no_image(unique):
    with Store.create(unique()) as store, pytest.raises(NotOwner):
        store.save()


# -- images ------------------------------------------------------------------------------------------------


def run_on(store, writers, cycles):
    """A run whose values depend on what the store shows; returns all that it shows."""
    seen = []
    for _ in range(cycles):
        cut = store.snapshot()
        total = sum(shown(cut, writer) or 0 for writer in writers)
        for k, writer in enumerate(writers):
            if (store.cycle + k) % 2:
                writer.write(Count((total * 31 + k) % 1009 + 1), t_data_ns=store.now_ns - k)
        store.tick()
        seen.append([store.snapshot().get(writer) for writer in writers])
    return seen


def test_a_restored_store_runs_on_as_it_did_the_first_time():
    with Store.create() as store:
        a = store.join("a")
        writers = [a.insert(f"n{every}", Count, every=every, history_s=0.2) for every in (1, 2, 5)]
        run_on(store, writers, 30)
        image = store.save()
        then = (
            store.cycle,
            store.now_ns,
            [w.head for w in writers],
            [[store.at_cycle(c).get(w) for w in writers] for c in range(20, 31)],
        )
        first = run_on(store, writers, 40)
        late = [a.insert(f"late{k}", Count) for k in range(5)]
        run_on(store, late, 20)
        store.restore(image)
        assert then == (
            store.cycle,
            store.now_ns,
            [w.head for w in writers],
            [[store.at_cycle(c).get(w) for w in writers] for c in range(20, 31)],
        )
        words = [np.frombuffer(saved, "<u8") for saved in (image, store.save())]
        assert np.count_nonzero(words[0] != words[1]) == 2, "all but the counters of lives and of changes"
        assert run_on(store, writers, 40) == first


def test_objects_inserted_after_the_save_are_gone_after_the_restore():
    with Store.create() as store:
        a = store.join("a")
        a.insert("n", Count)
        image = store.save()
        a.insert("late", Count).write(Count(5))
        assert store.find("a/late").head == 1
        store.restore(image)
        assert [obj.name for obj in store.objects()] == ["a/n"]
        with pytest.raises(ObjectMissing):
            store.find("a/late")


def test_an_object_inserted_after_a_restore_begins_empty_where_another_was():
    with Store.create() as store:
        a = store.join("a")
        image = store.save()
        old = a.insert("old", Count)
        count_to(store, old, 20)
        store.restore(image)
        new = a.insert("new", Count)
        assert (new.head, new.latest(), store.snapshot().get(new)) == (0, None, None)
        new.write(Count(77))
        store.tick()
        assert shown(store.snapshot(), new) == 77
        with pytest.raises(NotYet):
            new.read(2)


def test_what_was_begun_before_a_restore_cannot_be_committed_after_it():
    with Store.create() as store:
        writer = store.join("a").insert("n", Count)
        image = store.save()
        frame = writer.frame().__enter__()
        store.restore(image)
        with pytest.raises(NotOwner):
            frame.__exit__(None, None, None)
        assert writer.head == 0


def test_a_component_that_joined_after_the_save_is_gone_after_the_restore():
    with Store.create() as store:
        a = store.join("a")
        writer = a.insert("n", Count)
        image = store.save()
        b = store.join("b")
        late = b.insert("n", Count)
        store.restore(image)
        assert [c.name for c in store.components()] == ["a"]
        with pytest.raises((NotOwner, ObjectMissing, Deleted)):
            late.write(Count(1))
        with pytest.raises(NotOwner):
            b.insert("m", Count)
        other = store.join("c").insert("n", Count)
        assert (writer.write(Count(1)), other.write(Count(2))) == (1, 1)
        assert store.find("c/n") == other


def test_a_handle_made_after_the_save_names_nothing_after_the_restore():
    with Store.create() as store:
        a = store.join("a")
        kept = a.insert("kept", Count)
        image = store.save()
        late = a.insert("late", Count)
        late.write(Count(1))
        store.restore(image)
        other = a.insert("other", Count)
        other.write(Count(2))
        store.tick()
        for read in (late.latest, lambda: late.read(1), lambda: late.visible(1), lambda: late.write(Count(3))):
            with pytest.raises((ObjectMissing, Deleted)):
                read()
        assert (shown(store.snapshot(), other), kept.write(Count(4))) == (2, 1)


def test_an_object_deleted_after_the_save_is_there_again_after_the_restore():
    with Store.create() as store:
        a = store.join("a")
        writer = a.insert("n", Count, flags=Flag.IMMEDIATE_DELETE)
        count_to(store, writer, 3)
        image = store.save()
        writer.delete()
        a.insert("other", Count).write(Count(9))
        store.tick()
        store.restore(image)
        assert (names(store), store.cycle, writer.t_delete_ns) == (["a/n"], 3, None)
        assert [shown(store.at_cycle(c), writer) for c in range(4)] == [None, 1, 2, 3]
        count_to(store, writer, 5)
        assert shown(store.snapshot(), writer) == 5


def test_an_image_of_another_store_is_refused():
    with Store.create() as one, Store.create() as other:
        count_to(other, writer := other.join("a").insert("n", Count), 3)
        image = one.save()
        with pytest.raises(ValueError, match="restore"):
            other.restore(image)
        for damaged in (b"", b"junk", other.save()[:-1], other.save() + b"\0"):
            with pytest.raises(ValueError, match="restore"):
                other.restore(damaged)
        assert shown(other.snapshot(), writer) == 3
