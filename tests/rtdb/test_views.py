"""How values are read and written: in place, one after the other, as of a time, and from what they were computed."""

from typing import Annotated

import numpy as np
import pytest
from conftest import LONG_S, Count, Words, count_to, shown

from rtdb import (
    STATIC,
    AgedOut,
    DataTimeBackward,
    Deleted,
    NotRepeatable,
    NotYet,
    ObjectMissing,
    Record,
    RecordError,
    Store,
    TooFast,
)
from rtdb.records import f8, image, u32

TICK_S = 0.01


class Picture(Record, eq=False):
    """A frame of a camera."""

    t_s: Annotated[float, f8("s", "when")] = 0.0
    pixels: Annotated[np.ndarray, image(4, 6, 3, "blue, green, red")] = None
    number: Annotated[int, u32("", "number")] = 0


def write_all(writer, numbers):
    for n in numbers:
        writer.write(Count(n))


def lives_at(array):
    """Where its bytes lie."""
    return np.asarray(array).__array_interface__["data"][0]


# -- frames: writing in place --------------------------------------------------------------------------------


def test_a_frame_is_written_where_its_readers_look_at_it(store):
    """Zero copies: what is filled is what is seen, at the same address, whatever the reader does."""
    writer = store.join("a").insert("words", Words)
    with writer.frame(t_data_ns=7) as frame:
        frame.array["words"] = np.arange(64)
        filled = lives_at(frame.array)
    store.tick()
    with writer.view() as view:
        assert lives_at(view.array) == filled
        assert view.array["words"].tolist() == list(range(64))
        assert (view.write, view.t_data_ns, view.t_commit_ns) == (frame.write, 7, 0) == (1, 7, 0)
    assert writer.latest().value.words == tuple(range(64))


def test_a_frame_shows_its_fields_by_name_even_without_numpy(store):
    writer = store.join("a").insert("n", Count)
    with writer.frame() as frame:
        frame.memory[:] = writer.schema.pack(Count(5))
    assert writer.latest().value == Count(5)
    with pytest.raises(ValueError, match="released"):
        frame.memory[0]


def test_a_frame_that_ends_with_an_exception_was_never_written(store):
    writer = store.join("a").insert("n", Count)
    writer.write(Count(1))

    def fail():
        with writer.frame() as frame:
            frame.array["n"] = 2
            raise OSError("the camera is gone")

    with pytest.raises(OSError, match="the camera is gone"):
        fail()
    store.tick()
    assert (writer.head, writer.latest().value.n, shown(store.snapshot(), writer)) == (1, 1, 1)
    assert writer.write(Count(3)) == 2
    assert writer.read(1).value.n == 1


def test_the_array_of_a_committed_frame_is_read_only(store):
    """The slot belongs to its readers then."""
    writer = store.join("a").insert("n", Count)
    with writer.frame() as frame:
        array = frame.array
        array["n"] = 5
    with pytest.raises(ValueError, match="read-only"):
        array["n"] = 6
    assert writer.latest().value.n == 5


def test_a_frame_takes_its_data_time_when_it_ends(store):
    writer = store.join("a").insert("n", Count)
    with writer.frame() as frame:
        frame.array["n"] = 1
        store.tick()
    sample = writer.latest()
    assert (sample.t_data_ns, sample.t_commit_ns) == (10_000_000, 10_000_000)
    with writer.frame(t_data_ns=10_000_001, causes=()) as frame:
        frame.array["n"] = 2
    assert writer.latest().t_data_ns == 10_000_001


def test_a_frame_carries_its_causes(store):
    a = store.join("a")
    source, sink = a.insert("in", Count), a.insert("out", Count, n_causes=1)
    cause = source.oid, source.write(Count(1))
    with sink.frame(causes=(cause,)) as frame:
        frame.array["n"] = 2
    assert sink.latest().causes == (cause,)
    with pytest.raises(RecordError, match="a/out"), sink.frame(causes=(cause, cause)):
        pass
    assert sink.head == 1


def test_a_frame_is_refused_while_both_newest_cuts_need_its_slot(store):
    writer = store.join("a").insert("n", Count, history_s=0.0)
    count_to(store, writer, 3)
    for n in (4, 5):
        with writer.frame() as frame:
            frame.array["n"] = n
    with pytest.raises(TooFast, match="a/n"):
        writer.frame().__enter__()
    assert [shown(store.at_cycle(c), writer) for c in (2, 3)] == [2, 3]


def test_an_image_is_read_as_it_was_written_in_place(store):
    writer = store.join("a").insert("picture", Picture)
    pixels = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    writer.write(Picture(1.5, pixels, 7))
    store.tick()
    sample = store.snapshot().get(writer)
    assert np.array_equal(sample.value.pixels, pixels)
    with writer.view() as view:
        assert (view.array["t_s"].item(), view.array["number"].item()) == (1.5, 7)
        assert bytes(view.memory) == writer.raw(1)


# -- views: reading in place ---------------------------------------------------------------------------------


def test_a_view_cannot_be_written(store):
    writer = store.join("a").insert("n", Count)
    count_to(store, writer, 1)
    with writer.view() as view:
        with pytest.raises(ValueError, match="read-only"):
            view.array["n"] = 2
        with pytest.raises(TypeError, match="read-only"):
            view.memory[0] = 2
    assert shown(store.snapshot(), writer) == 1


def test_a_view_of_nothing_is_an_error(store):
    writer = store.join("a").insert("n", Count)
    with pytest.raises(ObjectMissing, match="a/n shows nothing yet in cycle 0"):
        writer.view().__enter__()
    with pytest.raises(NotYet, match="a/n"):
        writer.view(1)


def test_a_view_of_a_cycle_shows_what_its_cut_shows(store):
    writer = store.join("a").insert("n", Count)
    count_to(store, writer, 9)
    for c in range(1, 10):
        with writer.view(c) as view:
            assert (view.array["n"].item(), view.t_commit_ns) == (c, (c - 1) * 10_000_000)


def test_a_view_that_the_writer_overran_says_so_where_it_ends(store):
    writer = store.join("a").insert("words", Words, history_s=2 * TICK_S)
    for k in range(3):
        writer.write(Words((k,) * 64))
        store.tick()

    def look_too_long():
        with writer.view(1) as view:
            for k in range(3, 20):
                writer.write(Words((k,) * 64))
                store.tick()
            assert view.array["words"][0] != 0, "it was not overwritten: nothing was put to the test"

    with pytest.raises(AgedOut, match="a/words"):
        look_too_long()


def test_an_error_within_a_view_is_not_hidden_by_that_it_was_overrun(store):
    writer = store.join("a").insert("n", Count, history_s=0.0)
    count_to(store, writer, 3)

    def fail():
        with writer.view(1):
            count_to(store, writer, 30)
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        fail()


def test_a_view_that_is_entered_too_late_is_aged_out(store):
    writer = store.join("a").insert("n", Count, history_s=0.0)
    count_to(store, writer, 3)
    late = writer.view()
    count_to(store, writer, 30)
    with pytest.raises(AgedOut, match="a/n"):
        late.__enter__()


@pytest.mark.parametrize("back", [0, 1])
def test_what_one_of_the_two_newest_cuts_shows_is_not_overwritten_whatever_its_writer_does(store, back):
    writer = store.join("a").insert("words", Words, history_s=0.0)
    assert writer.n_slots == 4
    for k in range(1, 8):
        writer.write(Words((k,) * 64))
        store.tick()
    with writer.view(store.cycle - back) as view:
        before = bytes(view.memory)
        refused = 0
        for k in range(100):
            try:
                if k % 2:
                    writer.write(Words((-k,) * 64))
                else:
                    writer.frame().__enter__().array["words"] = -k
            except TooFast:
                refused += 1
        assert refused > 90
        assert bytes(view.memory) == before == writer.schema.pack(Words((7 - back,) * 64))


def test_a_view_held_over_ticks_stays_whole_while_a_writer_in_another_process_races(shared, attached):
    writer = attached()
    writer("w = store.join('w').insert('words', Words, history_s=0.0)\nw.write(Words((5,) * 64))")
    obj = shared.find("w/words", Words)
    for k in range(1, 4):
        shared.tick()
        writer.send(
            "import itertools\n"
            f"for k in itertools.count():\n"
            f"    try: w.write(Words(({k} * 1000 + k,) * 64))\n"
            "    except TooFast: break"
        )
        with obj.view() as view:
            before = bytes(view.memory)
            assert writer.answer() == "None"
            assert bytes(view.memory) == before
            assert len(set(view.array["words"].tolist())) == 1


# -- one after the other -------------------------------------------------------------------------------------


@pytest.mark.parametrize("slots", [4, 5, 9])
def test_next_counts_exactly_what_was_lost(store, slots):
    writer = store.join("a").insert("n", Count, history_s=(slots - 4) * TICK_S + 1e-9)
    assert (writer.n_slots, writer.next(0)) == (slots, None)
    for n in range(1, 60):
        writer.write(Count(n))
        store.tick()
        oldest = max(1, n - slots + 2)  # one slot is for the write under construction
        for after in range(n):
            sample, lost = writer.next(after)
            assert (sample.value.n, sample.write) == (sample.write, max(after + 1, oldest))
            assert lost == sample.write - after - 1
        assert (writer.next(n), writer.next(n + 5)) == (None, None)


def test_a_follower_that_keeps_up_loses_nothing_and_one_that_does_not_knows_how_much(store):
    writer = store.join("a").insert("n", Count, history_s=6 * TICK_S)
    seen, lost, behind, missed = [], 0, 0, 0
    got = 0
    for n in range(1, 200):
        writer.write(Count(n))
        store.tick()
        while found := writer.next(seen[-1] if seen else 0):
            seen.append(found[0].value.n)
            lost += found[1]
        if n % 20 == 0:
            found = writer.next(behind)
            behind, missed, got = found[0].write, missed + found[1], got + 1
    assert (seen, lost) == (list(range(1, 200)), 0)
    assert missed + got == behind
    assert missed > 100


def test_updates_give_what_is_written_from_now_on_unless_it_is_said_from_where(shared, attached):
    writer = shared.join("a").insert("n", Count, history_s=6 * TICK_S)
    write_all(writer, range(1, 4))
    follower, late = attached(), attached()
    for one, after in ((follower, None), (late, 1)):
        one(f"updates = iter(store.find('a/n', Count).updates({after}, {LONG_S}))")
    follower.send("[(s.value.n, lost) for s, lost in (next(updates), next(updates))]")
    follower.until_it_waits()
    write_all(writer, range(4, 6))
    assert follower.answer() == "[(4, 0), (5, 0)]"
    for n in range(6, 22):
        shared.tick()
        writer.write(Count(n))
    assert writer.n_slots == 10  # 13 to 21 are left, the next one goes where 12 was
    assert late("[(s.value.n, lost) for s, lost in (next(updates), next(updates))]") == "[(13, 11), (14, 0)]"
    assert follower("[(s.value.n, lost) for s, lost in (next(updates),)]") == "[(13, 7)]"


def test_updates_end_after_their_time_in_the_store(shared, attached):
    writer = shared.join("a").insert("n", Count)
    follower = attached()
    follower.send("[s.value.n for s, _ in store.find('a/n', Count).updates(0, 0.03)]")
    follower.until_it_waits()
    shared.tick()
    shared.tick()
    writer.write(Count(1))  # after 20 ms of 30
    while not follower.has_answered():
        shared.tick()
    assert follower.answer() == "[1]"


def test_a_wait_ends_when_its_time_in_the_store_is_over(shared, attached):
    shared.join("a").insert("n", Count)
    waiting = attached()
    waiting.send("store.find('a/n').wait(0, 0.05)")
    waiting.until_it_waits()
    for _ in range(5):
        assert not waiting.has_answered()
        shared.tick()
    assert waiting.answer() == "None"


def test_a_wait_in_a_private_store_ends_at_once():
    """Nobody else can write there."""
    with Store.create() as store:
        writer = store.join("a").insert("n", Count)
        assert writer.wait(0, LONG_S) is None
        writer.write(Count(1))
        assert (writer.wait(0, LONG_S), writer.wait(1, LONG_S)) == (1, None)
        assert [s.value.n for s, _ in writer.updates(0, LONG_S)] == [1]


def test_older_and_younger_lead_through_all_writes(store):
    writer = store.join("a").insert("n", Count)
    assert writer.latest() is None
    write_all(writer, range(1, 6))
    sample = writer.latest()
    assert writer.younger(sample) is None
    back = [sample.value.n]
    while (older := writer.older(sample)) is not None:
        sample = older
        back.append(sample.value.n)
    assert back == [5, 4, 3, 2, 1]
    forth = [sample.value.n]
    while (younger := writer.younger(sample)) is not None:
        sample = younger
        forth.append(sample.value.n)
    assert forth == [1, 2, 3, 4, 5]


def test_what_is_older_than_the_history_is_aged_out(store):
    writer = store.join("a").insert("n", Count, history_s=0.0)
    count_to(store, writer, 20)
    sample = writer.latest()
    older = writer.older(sample)
    assert older.value.n == 19
    with pytest.raises(AgedOut, match="a/n"):
        writer.older(writer.older(writer.older(older)))


# -- as of a time --------------------------------------------------------------------------------------------


def test_as_of_data_gives_the_newest_write_that_was_true_by_then(store):
    writer = store.join("a").insert("n", Count, history_s=3 * TICK_S)
    assert writer.as_of_data(10**9) is None
    for n, t_data_ns in enumerate((-30, -30, 0, 5, 5, 5, 90), start=1):
        writer.write(Count(n), t_data_ns=t_data_ns)
    oldest = writer.head - writer.n_slots + 2
    assert oldest == 2
    times = (-30, -1, 0, 4, 5, 89, 90, 10**9)
    assert [writer.as_of_data(t).write for t in times] == [2, 2, 3, 3, 6, 6, 7, 7]
    with pytest.raises(AgedOut, match="a/n"):
        writer.as_of_data(-31)


def test_as_of_data_and_as_of_answer_different_questions(store):
    """A camera's frame is true when it was exposed, and there when it was decoded."""
    writer = store.join("a").insert("n", Count)
    for c in range(10):
        writer.write(Count(c), t_data_ns=store.now_ns - 25_000_000)
        store.tick()
    for t_ms in (0, 33, 50, 64):
        assert writer.as_of(t_ms * 1_000_000).value.n == t_ms // 10
        assert writer.as_of_data(t_ms * 1_000_000).value.n == (t_ms + 25) // 10


def test_the_history_of_a_time_holds_what_was_committed_in_it(store):
    writer = store.join("a").insert("n", Count)
    for c in range(10):
        writer.write(Count(2 * c), t_data_ns=store.now_ns - 1)
        writer.write(Count(2 * c + 1), t_data_ns=store.now_ns)
        store.tick()
    rows = writer.history(30_000_000, 50_000_000)
    assert rows.dtype.names == ("write", "t_commit_ns", "t_data_ns", "value")
    assert rows["value"]["n"].tolist() == [6, 7, 8, 9, 10, 11]
    assert rows["t_data_ns"].tolist() == [29999999, 30000000, 39999999, 40000000, 49999999, 50000000]
    assert rows["t_commit_ns"].tolist() == [30000000, 30000000, 40000000, 40000000, 50000000, 50000000]
    assert len(writer.history(35_000_000, 39_999_999)) == 0


# -- from what it was computed -------------------------------------------------------------------------------


def test_a_computed_value_is_as_old_as_its_oldest_input_that_is_not_static(store):
    a = store.join("a")
    gps, odometer = a.insert("gps", Count), a.insert("odometer", Count)
    site = a.insert("site", Count, flags=STATIC)
    pose = a.insert("pose", Count, n_causes=3)
    site.write(Count(1), t_data_ns=-(10**12))
    gps.write(Count(2), t_data_ns=-500)
    odometer.write(Count(3), t_data_ns=-20)
    store.tick()
    inputs = [store.snapshot().get(obj) for obj in (odometer, gps, site)]
    pose.write(Count(4), inputs=inputs)
    sample = pose.latest()
    assert sample.t_data_ns == -500
    assert sample.causes == ((odometer.oid, 1), (gps.oid, 1), (site.oid, 1))


def test_the_age_of_a_computed_value_never_goes_back_when_another_input_is_the_oldest(store):
    a = store.join("a")
    new, old = a.insert("new", Count), a.insert("old", Count)
    out = a.insert("out", Count, n_causes=2)
    new.write(Count(1), t_data_ns=900)
    old.write(Count(1), t_data_ns=100)
    out.write(Count(1), inputs=[new.latest()])
    out.write(Count(2), inputs=[new.latest(), old.latest()])
    assert [(out.read(w).t_data_ns, len(out.read(w).causes)) for w in (1, 2)] == [(900, 1), (900, 2)]
    with pytest.raises(DataTimeBackward, match="a/out"):
        out.write(Count(3), t_data_ns=100)
    assert (out.head, out.latest().value.n) == (2, 2)


def test_a_value_computed_from_static_inputs_alone_is_as_old_as_its_writing(store):
    a = store.join("a")
    site, out = a.insert("site", Count, flags=STATIC), a.insert("out", Count, n_causes=1)
    site.write(Count(1), t_data_ns=-5)
    store.tick()
    out.write(Count(2), inputs=[site.latest()])
    assert (out.latest().t_data_ns, out.latest().causes) == (10_000_000, ((site.oid, 1),))


def test_a_time_that_is_said_counts_more_than_that_of_the_inputs(store):
    a = store.join("a")
    source, out = a.insert("in", Count), a.insert("out", Count, n_causes=1)
    source.write(Count(1), t_data_ns=5)
    out.write(Count(2), t_data_ns=77, inputs=[source.latest()])
    assert (out.latest().t_data_ns, out.latest().causes) == (77, ((source.oid, 1),))


def test_more_inputs_than_there_is_room_for_are_an_error_and_write_nothing(store):
    a = store.join("a")
    source, out = a.insert("in", Count), a.insert("out", Count, n_causes=1)
    write_all(source, (1, 2))
    with pytest.raises(RecordError, match="a/out"):
        out.write(Count(1), inputs=[source.read(1), source.read(2)])
    assert (out.head, out.latest()) == (0, None)


# -- stores that repeat themselves ---------------------------------------------------------------------------


@pytest.fixture(params=["private", "shared"])
def deterministic(request, unique):
    with Store.create(unique() if request.param == "shared" else None, deterministic=True) as made:
        yield made


LUCK = {
    "latest": lambda obj: obj.latest(),
    "as_of": lambda obj: obj.as_of(10**9),
    "as_of_data": lambda obj: obj.as_of_data(10**9),
    "next": lambda obj: obj.next(0),
    "updates": lambda obj: next(iter(obj.updates(0))),
    "history": lambda obj: obj.history(0, 10**9),
}


@pytest.mark.parametrize("read", LUCK)
def test_a_component_of_a_deterministic_store_reads_cuts_only(deterministic, read):
    component = deterministic.join("a")
    writer = component.insert("n", Count)
    count_to(deterministic, writer, 3)
    with pytest.raises(NotRepeatable, match="a/n"):
        LUCK[read](writer)
    assert [shown(deterministic.at_cycle(c), writer) for c in range(4)] == [None, 1, 2, 3]
    with writer.view() as view:
        assert view.array["n"] == 3
    component.leave()
    LUCK[read](writer)


@pytest.mark.parametrize("read", ["younger", "wait"])
def test_a_component_of_a_deterministic_store_does_not_learn_what_is_newest_in_another_way(deterministic, read):
    writer = deterministic.join("a").insert("n", Count)
    count_to(deterministic, writer, 1)
    sample = deterministic.snapshot().get(writer)
    writer.write(Count(2))
    ways = {
        "younger": lambda: writer.younger(sample),
        "wait": lambda: writer.wait(1, 0.0),
    }
    with pytest.raises(NotRepeatable, match="a/n"):
        ways[read]()


@pytest.mark.parametrize("read", LUCK)
def test_who_joined_nothing_reads_what_it_likes_of_a_deterministic_store(unique, read):
    name = unique()
    with Store.create(name, deterministic=True) as store, Store.attach(name) as tool:
        writer = store.join("a").insert("n", Count)
        count_to(store, writer, 3)
        LUCK[read](tool.find("a/n", Count))
        with pytest.raises(NotRepeatable):
            LUCK[read](writer)


def test_a_deleted_object_is_deleted_for_views_too(store):
    writer = store.join("a").insert("n", Count)
    count_to(store, writer, 2)
    writer.delete()
    store.tick()
    with writer.view(2) as view:
        assert view.array["n"] == 2
    with pytest.raises(Deleted, match="a/n"):
        writer.view()
