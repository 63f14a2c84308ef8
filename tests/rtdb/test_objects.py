"""Which objects there are: search and watch, parents, deletion and reuse, flags, slots, versions of a record."""

import itertools
import struct
from typing import Annotated

import pytest
from conftest import LONG_S, Count, Words, count_to, segment_path, shown

from rtdb import (
    STATIC,
    Deleted,
    Flag,
    NotOwner,
    NotYet,
    ObjectMissing,
    Record,
    RecordError,
    Stale,
    Store,
    StoreFull,
    TooFast,
)
from rtdb.components import flag_names, slots_for
from rtdb.records import f8, i64

TICK_S = 0.01
ROUNDS = 10_000


class Pose(Record):
    x_m: Annotated[float, f8("m", "east")] = 0.0


def names(objects):
    """Their names, without what components write about themselves."""
    return [obj.name for obj in objects if not obj.name.endswith("/health")]


def tick(store, times):
    for _ in range(times):
        store.tick()


# -- deletion ------------------------------------------------------------------------------------------------


def test_a_deleted_object_shows_in_the_cuts_up_to_its_deletion_and_in_none_after_it(store):
    writer = store.join("a").insert("n", Count)
    count_to(store, writer, 5)
    writer.delete()
    assert shown(store.snapshot(), writer) == 5
    store.tick()
    assert [shown(store.at_cycle(c), writer) for c in range(6)] == [None, 1, 2, 3, 4, 5]
    with pytest.raises(Deleted, match="a/n"):
        store.snapshot().get(writer)
    with pytest.raises(NotYet):
        store.at_cycle(7).get(writer)


def test_the_history_of_a_deleted_object_stays_readable_for_its_time(store):
    a = store.join("a")
    writer = a.insert("n", Count, history_s=10 * TICK_S)
    count_to(store, writer, 5)
    writer.delete()
    for _ in range(9):
        store.tick()
        a.insert("other", Count, flags=Flag.IMMEDIATE_DELETE).delete()  # who inserts looks for storage to reuse
        assert [writer.read(w).value.n for w in (1, 5)] == [1, 5]
        assert writer.history(0, store.now_ns)["write"].tolist() == [1, 2, 3, 4, 5]
        assert (writer.as_of(20_000_000).write, writer.as_of_data(49_999_999).write) == (3, 5)
        assert (writer.t_delete_ns, writer.head) == (50_000_000, 5)
        for read in (writer.latest, lambda: writer.as_of(50_000_000)):
            with pytest.raises(Deleted, match="a/n"):
                read()


def test_nothing_is_left_of_a_deleted_object_once_its_storage_is_reused(store):
    a = store.join("a")
    writer = a.insert("n", Count, history_s=10 * TICK_S)
    count_to(store, writer, 5)
    writer.delete()
    tick(store, 10)
    other = a.insert("other", Count)
    other.write(Count(99))
    store.tick()
    for read in (
        lambda: writer.visible(3),
        lambda: writer.read(1),
        lambda: writer.as_of(0),
        lambda: writer.next(0),
        lambda: writer.head,
        lambda: writer.view(3),
        lambda: writer.history(0, 10**9),
    ):
        with pytest.raises(Deleted):
            read()
    assert "a/n" not in names(store.objects(at_ns=30_000_000))


def test_a_deleted_object_is_gone_when_its_time_is_over_whoever_inserts_what(store):
    a = store.join("a")
    writer = a.insert("n", Count, history_s=10 * TICK_S)
    now = a.insert("now", Count, flags=Flag.IMMEDIATE_DELETE)
    for obj in (writer, now):
        obj.write(Count(1))
    store.tick()
    for obj in (writer, now):
        obj.delete()
    with pytest.raises(Deleted):
        now.read(1)
    tick(store, 10)
    with pytest.raises(Deleted):
        writer.read(1)


def test_a_deleted_object_is_deleted_once(store):
    a = store.join("a")
    writer = a.insert("n", Count)
    other = store.find("a/n")
    writer.delete()
    for obj in (writer, other):
        with pytest.raises(Deleted, match="a/n"):
            store.delete(obj)


def test_writing_to_a_deleted_object_is_refused_and_changes_nothing(attached, shared):
    writer = attached()
    writer("w = store.join('w').insert('n', Count)\nw.write(Count(1))")
    obj = shared.find("w/n", Count)
    assert writer("w.delete()") == "None"
    assert writer("w.write(Count(2))").startswith("!Deleted: cannot write w/n")
    assert writer("w.frame().__enter__()").startswith("!Deleted: cannot write w/n")
    assert (obj.head, obj.read(1).value.n) == (1, 1)


def test_what_was_begun_before_the_deletion_is_not_committed(store):
    writer = store.join("a").insert("n", Count)
    frame = writer.frame().__enter__()
    writer.delete()
    with pytest.raises((Deleted, NotOwner), match="a/n"):
        frame.__exit__(None, None, None)
    assert writer.head == 0


def test_a_wait_for_an_object_ends_when_it_is_deleted(shared, attached):
    writer = shared.join("a").insert("n", Count)
    writer.write(Count(1))
    waiting, following = attached(), attached()
    waiting.send(f"store.find('a/n', Count).wait(1, {LONG_S})")
    following.send(f"[(s.value.n, lost) for s, lost in store.find('a/n', Count).updates(0, {LONG_S})]")
    for one in (waiting, following):
        one.until_it_waits()
    writer.delete()
    assert waiting.answer().startswith("!Deleted")
    assert following.answer() == "[(1, 0)]"


def test_the_name_of_a_deleted_object_is_free_at_once(store):
    a = store.join("a")
    old = a.insert("n", Count)
    count_to(store, old, 3)
    old.delete()
    new = a.insert("n", Count)
    assert (new.oid > old.oid, store.find("a/n", Count), new.head, new.latest()) == (True, new, 0, None)
    new.write(Count(77))
    store.tick()
    assert (shown(store.snapshot(), new), shown(store.at_cycle(2), old)) == (77, 2)
    assert store.at_cycle(2).get(new) is None
    with pytest.raises(Deleted):
        store.snapshot().get(old)


@pytest.mark.parametrize("reused", [False, True])
def test_find_gives_the_new_object_of_a_name_that_was_deleted(store, reused):
    a = store.join("a")
    flags = Flag.IMMEDIATE_DELETE if reused else 0
    old = a.insert("n", Count, flags=flags)
    for cls in (Count, None):
        assert store.find("a/n", cls) == old
    old.delete()
    with pytest.raises(ObjectMissing, match="a/n"):
        store.find("a/n", Count)
    store.tick()
    new = a.insert("n", Count, flags=flags)
    for cls in (Count, None):
        assert store.find("a/n", cls) == new


def test_nobody_but_its_owner_deletes_an_object_while_the_owner_lives(shared, attached):
    writer = attached()
    writer("c = store.join('w')\nw = c.insert('n', Count)\nw.write(Count(4))")
    obj = shared.find("w/n", Count)
    with pytest.raises(NotOwner, match="w/n"):
        shared.delete(obj)
    assert obj.latest().value.n == 4
    writer("c.leave()")
    shared.delete(obj)
    assert names(shared.objects()) == []


def test_an_object_with_another_declaration_replaces_what_a_predecessor_left(store):
    a = store.join("a")
    old = a.insert("n", Count, every=2)
    old.write(Count(1))
    assert a.insert("n", Count, every=2) == old
    for changed in ({"every": 3}, {"history_s": 9.0}, {"flags": STATIC}, {"n_causes": 2}):
        new = a.insert("n", Count, **{"every": 2} | changed)
        assert (new.oid > old.oid, new.head, store.find("a/n")) == (True, 0, new)
        assert old.read(1).value.n == 1
        old = new
        old.write(Count(1))
    assert a.insert("n", Pose).oid > old.oid


@pytest.mark.parametrize("changed", [{"max_age_s": 5.0}, {"min_cycle_s": 1.0}])
def test_an_object_with_other_times_replaces_what_a_predecessor_left(store, changed):
    a = store.join("a")
    old = a.insert("n", Count)
    new = a.insert("n", Count, **changed)
    assert (new.max_age_ns, new.min_cycle_ns) == (
        round(changed.get("max_age_s", 0) * 1e9),
        round(changed.get("min_cycle_s", TICK_S) * 1e9),
    )
    assert new.oid > old.oid


def test_a_replacement_that_does_not_fit_leaves_what_was_there(store):
    a = store.join("a")
    writer = a.insert("n", Count)
    writer.write(Count(1))
    with pytest.raises(StoreFull, match="a/n"):
        a.insert("n", Count, history_s=1e4)
    assert store.find("a/n", Count).latest().value == Count(1)


# -- object ids ----------------------------------------------------------------------------------------------


def test_a_later_store_of_the_same_name_never_gives_an_id_again(peer, name):
    seen = []
    for _ in range(3):
        creator = peer()
        creator(f"store = Store.create({name!r})\nc = store.join('w')")
        seen += eval(creator("[c.insert(f'n{k}', Count).oid for k in range(5)]"))
        creator.kill()
    with Store.create(name) as store:
        seen.append(store.join("w").insert("n", Count).oid)
    with Store.create(name) as store:
        seen.append(store.join("w").insert("n", Count).oid)
    assert seen == sorted(set(seen))


def test_a_clock_that_was_set_back_between_two_stores_gives_no_id_again(peer, name):
    """The ids begin with the time of birth; what a crash left behind says how far they went."""
    creator = peer()
    creator(f"store = Store.create({name!r})")
    creator.kill()
    ahead = 1 << 62
    with segment_path(name).open("r+b") as file:
        file.seek(4096 + 16)  # next_oid of fw_directory
        born = struct.unpack("<Q", file.read(8))[0]
        file.seek(-8, 1)
        file.write(struct.pack("<Q", ahead))
    with Store.create(name) as store:
        oid = store.join("w").insert("n", Count).oid
    assert 10**18 < born < ahead <= oid


# -- storage is reused ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("history", [True, False], ids=["after its history", "at once"])
def test_insert_and_delete_in_turn_never_fill_a_store(store, history):
    a = store.join("a")
    flags = 0 if history else Flag.IMMEDIATE_DELETE
    stale, room = [], None
    for k in range(ROUNDS):
        writer = a.insert("n", Count, history_s=5 * TICK_S, flags=flags)
        writer.write(Count(k))
        store.tick()
        assert shown(store.snapshot(), writer) == k
        writer.delete()
        if k % 100 == 0:
            stale.append((k, writer))
        if k == 50:
            room = store.memory
    assert len(store.core.entries()) <= 10
    assert store.memory == room
    for k, writer in stale[:-1]:
        for read in (store.core.latest, store.core.object):
            with pytest.raises(Deleted):
                read(writer.handle)
        with pytest.raises(Deleted):
            writer.visible(k + 1)


def test_a_stale_handle_never_reads_the_value_of_another_object(store):
    a = store.join("a")
    sizes = itertools.cycle((Count, Pose))
    made = []
    for k, cls in zip(range(400), sizes, strict=False):
        writer = a.insert(f"n{k % 7}", cls, history_s=(k % 5) * TICK_S)
        writer.write(cls(k))
        store.tick()
        made.append((cls(k), writer))
        if k % 3:
            writer.delete()
        for value, old in made[-40:]:
            try:
                assert old.read(1).value == value
            except Deleted:
                continue
    assert len(store.core.entries()) < 60


def test_a_full_directory_has_room_again_after_a_deletion():
    with Store.create(max_objects=3) as store:
        a = store.join("a")
        writers = [a.insert(f"n{k}", Count, flags=Flag.IMMEDIATE_DELETE) for k in range(3)]
        for k, writer in enumerate(writers):
            writer.write(Count(k))
        store.tick()
        with pytest.raises(StoreFull, match="a/n3"):
            a.insert("n3", Count)
        writers[1].delete()
        late = a.insert("n3", Count)
        late.write(Count(3))
        store.tick()
        assert [shown(store.snapshot(), obj) for obj in (writers[0], writers[2], late)] == [0, 2, 3]
        with pytest.raises(StoreFull, match="a/n4"):
            a.insert("n4", Count)


def test_a_full_heap_has_room_for_what_fits_into_a_hole_and_loses_nothing(store):
    a = store.join("a")
    kept = []

    def fill():
        for k in range(300):
            kept.append(a.insert(f"n{k}", Count, history_s=4.0, flags=Flag.IMMEDIATE_DELETE))

    with pytest.raises(StoreFull, match="no room is left"):
        fill()
    assert len(kept) > 10
    for k, writer in enumerate(kept):
        writer.write(Count(k))
    store.tick()
    for writer in kept[1::2]:
        writer.delete()
    store.tick()
    with pytest.raises(StoreFull):
        a.insert("large", Count, history_s=12.0)
    holes = range(len(kept) // 2)
    again = [a.insert(f"again{k}", Count, history_s=4.0) for k in holes]
    for k, writer in zip(holes, again, strict=True):
        writer.write(Count(1000 + k))
    store.tick()
    assert [shown(store.snapshot(), writer) for writer in kept[::2]] == list(range(0, len(kept), 2))
    assert [shown(store.snapshot(), writer) for writer in again] == [1000 + k for k in holes]


# -- search --------------------------------------------------------------------------------------------------


@pytest.fixture
def drive(store):
    """Objects of two components, one below the other."""
    gps, camera = store.join("gps"), store.join("camera")
    fix = gps.insert("fix", Pose)
    gps.insert("raw", Count, parent=fix)
    camera.insert("front", Count, parent=fix)
    camera.insert("rear", Count)
    return store


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ({}, "gps/fix gps/raw camera/front camera/rear"),
        ({"pattern": "gps/*"}, "gps/fix gps/raw"),
        ({"pattern": "*/r*"}, "gps/raw camera/rear"),
        ({"pattern": "???/[!r]*"}, "gps/fix"),
        ({"pattern": "gps"}, ""),
        ({"pattern": "GPS/*"}, ""),
        ({"regex": "^camera/(front|rear)$"}, "camera/front camera/rear"),
        ({"regex": "ra"}, "gps/raw camera/front camera/rear"),
        ({"record": Pose}, "gps/fix"),
        ({"record": "Count"}, "gps/raw camera/front camera/rear"),
        ({"record": "Nothing"}, ""),
        ({"creator": "camera"}, "camera/front camera/rear"),
        ({"creator": "came"}, ""),
        ({"pattern": "*r*", "regex": "w$", "record": "Count", "creator": "gps"}, "gps/raw"),
        ({"pattern": "*r*", "record": Pose}, ""),
    ],
)
def test_a_search_finds_what_fits_every_condition_in_the_order_of_insertion(drive, query, expected):
    assert names(drive.objects(**query)) == expected.split()


def test_a_search_by_parent_finds_what_stands_directly_below_it(drive):
    fix = drive.find("gps/fix")
    assert names(drive.objects(parent=fix)) == ["gps/raw", "camera/front"]
    assert names(drive.objects("camera/*", parent=fix)) == ["camera/front"]
    assert drive.objects(parent=drive.find("gps/raw")) == []


def test_a_regular_expression_that_is_none_is_an_error_that_shows_it(drive):
    with pytest.raises(RecordError, match=r"\(broken"):
        drive.objects(regex="(broken")
    with pytest.raises(RecordError, match=r"\(broken"):
        drive.watch(regex="(broken").changes()


def test_a_search_as_of_a_time_finds_what_lived_then(store):
    a = store.join("a")
    old = a.insert("n", Count)  # lives from 0 to 30 ms
    tick(store, 2)
    a.insert("late", Count)  # from 20 ms on
    store.tick()
    old.delete()
    tick(store, 1)
    new = a.insert("n", Count)  # from 40 ms on
    lived = {t_ms: store.objects("a/[nl]*", at_ns=t_ms * 1_000_000) for t_ms in (-1, 0, 19, 20, 29, 30, 39, 40, 1000)}
    assert {t_ms: names(objects) for t_ms, objects in lived.items()} == {
        -1: [],
        0: ["a/n"],
        19: ["a/n"],
        20: ["a/n", "a/late"],
        29: ["a/n", "a/late"],
        30: ["a/late"],
        39: ["a/late"],
        40: ["a/late", "a/n"],
        1000: ["a/late", "a/n"],
    }
    assert (lived[0][0].oid, lived[40][1].oid) == (old.oid, new.oid)
    assert names(store.objects()) == ["a/late", "a/n"]


def test_inserts_of_other_names_do_not_prolong_a_find(shared, attached):
    waiting = attached()
    a = shared.join("a")
    waiting.send("store.find('no/thing', timeout_s=0.1)")
    rounds = 0
    while not waiting.has_answered():
        rounds += 1
        assert rounds < 200_000, "every insert gave the find its whole time again"
        a.insert("other", Count, flags=Flag.IMMEDIATE_DELETE).delete()
        shared.tick()
    assert waiting.answer().startswith("!ObjectMissing")


# -- watch ---------------------------------------------------------------------------------------------------


def told(changes):
    added, deleted = changes
    return names(added), names(deleted)


def test_a_watch_gives_what_is_there_and_then_what_came_and_went(store):
    a = store.join("a")
    first = a.insert("first", Count)
    watch = store.watch("a/*", record=Count)
    assert told(watch.changes()) == (["a/first"], [])
    assert told(watch.changes()) == ([], [])
    a.insert("second", Count)
    a.insert("pose", Pose)
    assert told(watch.changes()) == (["a/second"], [])
    first.delete()
    a.insert("third", Count).delete()
    assert told(watch.changes()) == ([], ["a/first"])
    assert told(watch.changes(0.001)) == ([], [])


def test_a_watch_sees_that_an_object_was_replaced_by_one_of_the_same_name(store):
    a = store.join("a")
    old = a.insert("n", Count)
    watch = store.watch("a/n")
    watch.changes()
    old.delete()
    new = a.insert("n", Count)
    added, deleted = watch.changes()
    assert ([obj.oid for obj in added], [obj.oid for obj in deleted]) == ([new.oid], [old.oid])


def test_a_watch_waits_for_a_change_of_its_own_set(shared, attached):
    a = shared.join("a")
    n = a.insert("n", Count)
    watching = attached()
    watching("watch = store.watch('a/*', record='Count')")
    told_names = "[[obj.name for obj in objects] for objects in watch.changes({})]"
    assert watching(told_names.format(0)) == "[['a/n'], []]"
    watching.send(told_names.format(LONG_S))
    watching.until_it_waits()
    shared.join("b").insert("n", Count)
    a.insert("pose", Pose)
    a.insert("late", Count)
    assert watching.answer() == "[['a/late'], []]"
    watching.send(told_names.format(LONG_S))
    watching.until_it_waits()
    n.delete()
    assert watching.answer() == "[[], ['a/n']]"


# -- the tree ------------------------------------------------------------------------------------------------


def test_what_goes_with_its_parent_goes_with_it_over_two_levels_whoever_owns_it(shared, attached):
    a = shared.join("a")
    root = a.insert("root", Count)
    other = attached()
    other("root = store.find('a/root')\nw = store.join('b')")
    other("child = w.insert('child', Count, parent=root, flags=Flag.WITH_PARENT)")
    other("stays = w.insert('stays', Count, parent=root)")
    child = shared.find("b/child", Count)
    grandchild = a.insert("grandchild", Count, parent=child, flags=Flag.WITH_PARENT)
    below = a.insert("below", Count, parent=shared.find("b/stays"), flags=Flag.WITH_PARENT)
    other("child.write(Count(1)); stays.write(Count(2))")
    for writer in (root, grandchild, below):
        writer.write(Count(3))
    shared.tick()
    waiting = attached()
    waiting.send(f"store.find('b/child').wait(1, {LONG_S})")
    waiting.until_it_waits()
    root.delete()
    assert waiting.answer().startswith("!Deleted")
    assert names(shared.objects()) == ["b/stays", "a/below"]
    assert {obj.t_delete_ns for obj in (root, child, grandchild)} == {10_000_000}
    assert other("child.write(Count(5))").startswith("!Deleted")
    assert other("stays.write(Count(6))") == "2"
    assert (shown(shared.at_cycle(1), child), shown(shared.at_cycle(1), grandchild)) == (1, 3)
    shared.tick()
    for obj in (root, child, grandchild):
        with pytest.raises(Deleted):
            shared.snapshot().get(obj)
    assert shown(shared.snapshot(), below) == 3


def test_what_goes_with_its_parent_goes_with_it_wherever_its_entry_is(store):
    """The directory is walked entry by entry, and a grandchild may stand in front of its parent."""
    a = store.join("a")
    places = [a.insert(f"place{k}", Count, flags=Flag.IMMEDIATE_DELETE) for k in range(3)]
    above = root = a.insert("root", Count)
    for k in (2, 1, 0):  # each takes the entry that has just become free
        places[k].delete()
        above = a.insert(f"level{k}", Count, parent=above, flags=Flag.WITH_PARENT)
    entries = [store.object_of(handle).name for handle in store.core.entries()]
    assert [name for name in entries if not name.endswith("/health")] == ["a/level0", "a/level1", "a/level2", "a/root"]
    root.delete()
    assert names(store.objects()) == []


def test_a_child_without_the_flag_stays_and_remembers_its_parent(store):
    a = store.join("a")
    root = a.insert("root", Count)
    child = a.insert("child", Count, parent=root)
    root.delete()
    assert (names(store.objects()), store.objects(parent=root)) == (["a/child"], [child])
    assert a.insert("root", Count).oid != child.parent


def test_nothing_is_inserted_below_what_was_deleted(store):
    a = store.join("a")
    parent, other = a.insert("parent", Count), a.insert("other", Count)
    parent.delete()
    with pytest.raises(Deleted, match="a/late"):
        a.insert("late", Count, parent=parent, flags=Flag.WITH_PARENT)
    with pytest.raises(Deleted, match="a/late"):  # past the check of Python
        store.core.insert("a/late", 0, 0, 8, 8, 1, 0, int(Flag.WITH_PARENT), 0, parent.oid, 0, 0, 0)
    assert names(store.objects()) == ["a/other"]
    assert other.write(Count(1)) == 1


def test_the_deletion_of_an_object_takes_none_along_that_stands_elsewhere(store):
    a = store.join("a")
    parents = [a.insert(f"parent{k}", Count) for k in range(3)]
    for k, parent in enumerate(parents):
        a.insert(f"child{k}", Count, parent=parent, flags=Flag.WITH_PARENT)
    a.insert("alone", Count, flags=Flag.WITH_PARENT)
    parents[1].delete()
    assert names(store.objects("a/*")) == ["a/parent0", "a/parent2", "a/child0", "a/child2", "a/alone"]
    parents[0].delete()
    assert names(store.objects("a/*")) == ["a/parent2", "a/child2", "a/alone"]


# -- flags ---------------------------------------------------------------------------------------------------


def test_flags_are_kept_for_who_asks(shared, attached):
    flags = Flag.HOST_DEPENDENT | Flag.STATIC | Flag.PERSISTENT
    shared.join("a").insert("n", Count, flags=flags)
    assert attached()("store.find('a/n').flags") == repr(flags)
    assert flag_names(flags) == "host dependent, static, persistent"
    assert flag_names(0) == ""


def test_what_is_denied_to_others_is_read_by_its_owner_alone(shared, attached):
    secret = shared.join("a").insert("n", Count, flags=Flag.READ_DENY)
    count_to(shared, secret, 3)
    assert (secret.latest().value.n, shown(shared.snapshot(), secret), len(secret.history(0, 10**9))) == (3, 3, 3)
    other = attached()
    other("n = store.find('a/n', Count)")
    for read in (
        "n.visible(1)",
        "n.latest()",
        "n.read(1)",
        "n.as_of(10**9)",
        "n.as_of_data(10**9)",
        "n.next(0)",
        "n.history(0, 10**9)",
        "n.view().__enter__()",
        "store.snapshot()['a/n']",
    ):
        assert other(read).startswith("!ReadDenied: cannot read a/n"), read
    assert other("[h for h, _ in store.core.changed() if h == n.handle]") == "[]"
    assert other("n.name, n.head") == "('a/n', 3)"


PUBLIC_WRITES = 1500


def test_two_processes_that_write_a_public_object_at_once_lose_and_tear_nothing(shared, attached):
    slots_s = (2 * PUBLIC_WRITES + 10) * TICK_S
    log = shared.join("owner").insert("log", Words, history_s=slots_s, flags=Flag.PUBLIC_WRITE)
    writers = {"one": attached(), "two": attached()}
    for component, writer in writers.items():
        writer(f"me = store.join({component!r})\nlog = store.writer('owner/log', Words)")
        writer.send(
            f"store.wait_cycle(0, {LONG_S})\n"
            "k = 0\n"
            f"while k < {PUBLIC_WRITES}:\n"
            "    try: log.write(Words((k,) * 64))\n"
            "    except TooFast: continue  # the other one was stopped in mid write\n"
            "    k += 1"
        )
        writer.until_it_waits()
    shared.tick()
    for writer in writers.values():
        assert writer.answer() == "None"
    assert log.head == 2 * PUBLIC_WRITES
    seen = {"one": [], "two": []}
    for w in range(1, log.head + 1):
        sample = log.read(w)
        assert len(set(sample.value.words)) == 1, "torn"
        seen[log.writer_of(sample)].append(sample.value.words[0])
    assert seen == {"one": list(range(PUBLIC_WRITES)), "two": list(range(PUBLIC_WRITES))}


def test_a_process_killed_while_it_writes_a_public_object_stops_nobody(shared, attached):
    log = shared.join("owner").insert("log", Words, flags=Flag.PUBLIC_WRITE)
    for k in range(5):
        writer = attached()
        writer("log = store.writer('owner/log', Words)")
        writer.send("while True: log.write(Words((7,) * 64))")
        after = log.head
        while log.head < after + 100:
            assert not writer.has_answered()
            shared.wait_cycle(shared.cycle, 0.001)
        writer.kill()
        log.write(Words((k,) * 64))
        assert set(log.latest().value.words) == {k}


def test_anybody_deletes_a_public_object(shared, attached):
    log = shared.join("owner").insert("log", Count, flags=Flag.PUBLIC_WRITE)
    log.write(Count(1))
    other = attached()
    other("log = store.writer('owner/log', Count)\nlog.delete()")
    with pytest.raises(Deleted, match="owner/log"):
        log.write(Count(2))
    assert other("log.write(Count(3))").startswith("!Deleted")
    assert (names(shared.objects()), log.read(1).value.n) == ([], 1)


def test_a_public_object_is_not_written_in_place(store):
    log = store.join("owner").insert("log", Count, flags=Flag.PUBLIC_WRITE)
    with pytest.raises(NotOwner, match="owner/log"):
        log.frame().__enter__()
    assert log.write(Count(1)) == 1


def test_a_public_object_is_written_by_who_has_left_its_component(shared, attached):
    writer = attached()
    writer("c = store.join('w')\nw = c.insert('log', Count, flags=Flag.PUBLIC_WRITE)\nw.write(Count(1))\nc.leave()")
    assert writer("w.write(Count(2))") == "2"
    assert shared.find("w/log", Count).latest().value.n == 2


def test_what_a_dead_component_left_makes_room_unless_it_is_persistent():
    with Store.create(max_objects=4) as store:
        gone, living = store.join("gone"), store.join("living")
        kept = gone.insert("kept", Count, history_s=0.1, flags=Flag.PERSISTENT)
        dropped = gone.insert("dropped", Count, history_s=0.1)
        mine = living.insert("mine", Count, history_s=0.1)
        for k, writer in enumerate((kept, dropped, mine)):
            writer.write(Count(k))
        store.tick()
        gone.leave()
        tick(store, 8)
        living.insert("n3", Count)
        with pytest.raises(StoreFull):  # its history has not had its time
            living.insert("n4", Count)
        assert [shown(store.snapshot(), obj) for obj in (kept, dropped, mine)] == [0, 1, 2]
        tick(store, 2)
        living.insert("n4", Count)
        assert names(store.objects()) == ["gone/kept", "living/mine", "living/n3", "living/n4"]
        with pytest.raises(StoreFull):
            living.insert("n5", Count)
        assert [shown(store.snapshot(), obj) for obj in (kept, mine)] == [0, 2]
        with pytest.raises(Deleted):
            dropped.latest()


def test_what_a_dead_component_left_makes_room_in_the_heap():
    with Store.create() as store:
        gone, living = store.join("gone"), store.join("living")
        left = gone.insert("large", Words, history_s=50.0)
        with pytest.raises(StoreFull, match="living/large"):
            living.insert("large", Words, history_s=50.0)
        gone.leave()
        with pytest.raises(StoreFull, match="living/large"):  # its history has not had its time
            living.insert("large", Words, history_s=50.0)
        assert left.t_delete_ns is None
        tick(store, 5000)
        assert names([living.insert("large", Words, history_s=50.0), *store.objects()]) == ["living/large"] * 2


def test_what_a_living_component_has_makes_no_room_however_long_it_is_silent(name, peer):
    with Store.create(name, max_objects=4) as store:
        silent = peer()
        silent(f"store = Store.attach({name!r})\nw = store.join('silent').insert('n', Count, history_s=0.01)")
        me = store.join("me")
        me.insert("n", Count)
        assert len(store.objects()) == 4
        silent("w.write(Count(1))")
        tick(store, 1000)
        with pytest.raises(StoreFull, match="me/more"):
            me.insert("more", Count)
        assert [obj.name for obj in store.objects()] == ["silent/health", "silent/n", "me/health", "me/n"]
        assert silent("w.write(Count(2))") == "2"


def test_who_holds_no_clock_gets_the_room_of_the_dead_behind_the_next_tick(name, peer):
    """A tick that is under way may still look at what is given away."""
    with Store.create(name, max_objects=6) as store:
        gone, living = peer(), peer()
        for one in (gone, living):
            one(f"store = Store.attach({name!r})")
        gone("c = store.join('gone')\nfor k in range(4): c.insert(f'n{k}', Count, history_s=0.01)")  # and its health
        living("c = store.join('living')")
        gone.kill()
        tick(store, 200)
        if (first := living("c.insert('n', Count).name")) != "'living/n'":
            assert first.startswith("!StoreFull")
            store.tick()
            assert living("c.insert('n', Count).name") == "'living/n'"
        assert names(store.objects()) == ["living/n"]


def test_a_watched_cycle_refuses_a_write_that_comes_too_soon(store):
    writer = store.join("a").insert("n", Count, flags=Flag.CYCLE_WATCH, min_cycle_s=3 * TICK_S)
    accepted = []
    for c in range(10):
        try:
            writer.write(Count(c))
            accepted.append(c)
        except TooFast:
            with pytest.raises(TooFast, match="a/n"):
                writer.frame().__enter__()
        store.tick()
    assert (accepted, writer.refused) == ([0, 3, 6, 9], 12)
    assert writer.latest().value.n == 9


def test_a_watched_cycle_is_the_period_of_the_object_unless_it_is_said(store):
    a = store.join("a")
    writer = a.insert("n", Count, every=2, flags=Flag.CYCLE_WATCH)
    writer.write(Count(0))
    for accepted in (False, True, False):
        store.tick()
        if accepted:
            writer.write(Count(1))
        else:
            with pytest.raises(TooFast):
                writer.write(Count(1))
    a.insert("free", Count, min_cycle_s=9.0).write(Count(1))
    assert store.find("a/free").head == 1


def test_a_stale_value_is_withheld_as_of_the_cycle_that_asks(store):
    writer = store.join("a").insert("n", Count, flags=Flag.WITHHOLD_STALE, max_age_s=2 * TICK_S)
    writer.write(Count(1))
    tick(store, 5)

    def seen():
        out = []
        for c in range(store.cycle + 1):
            try:
                out.append(shown(store.at_cycle(c), writer))
            except Stale:
                out.append("stale")
        return out

    assert seen() == [None, 1, 1, "stale", "stale", "stale"]
    with pytest.raises(Stale, match="a/n"):
        writer.latest()
    with pytest.raises(Stale):
        writer.view()
    assert (writer.as_of(20_000_000).write, writer.read(1).value.n, writer.head) == (1, 1, 1)
    writer.write(Count(2))
    tick(store, 3)
    assert seen() == [None, 1, 1, "stale", "stale", "stale", 2, 2, "stale"]


def test_a_withheld_value_is_not_withheld_from_who_follows_all_writes(store):
    writer = store.join("a").insert("n", Count, flags=Flag.WITHHOLD_STALE, max_age_s=TICK_S)
    tick(store, 1)
    writer.write(Count(1))
    tick(store, 9)
    sample, lost = writer.next(0)
    assert (sample.value.n, lost) == (1, 0)


def test_a_withheld_value_is_part_of_the_history(store):
    writer = store.join("a").insert("n", Count, flags=Flag.WITHHOLD_STALE, max_age_s=TICK_S)
    for n in (1, 2):
        writer.write(Count(n))
        tick(store, 10)
    assert writer.history(90_000_000, 10**9)["value"]["n"].tolist() == [2]


def test_who_waits_for_a_write_without_notice_gets_it(shared, attached):
    writer = shared.join("a").insert("n", Count, flags=Flag.NO_NOTIFY)
    waiting = attached()
    waiting("obj = store.find('a/n')")
    for k in (1, 2, 3):
        waiting.send(f"obj.wait({k - 1}, {LONG_S})")
        waiting.until_it_waits()
        writer.write(Count(k))
        assert waiting.answer() == str(k)


def test_an_immediate_deletion_leaves_nothing_to_read(store):
    a = store.join("a")
    kept, gone = a.insert("kept", Count), a.insert("gone", Count, flags=Flag.IMMEDIATE_DELETE)
    for writer in (kept, gone):
        count_to(store, writer, store.cycle + 2)
        writer.delete()
    store.tick()
    a.insert("next", Count)
    assert (kept.read(1).write, shown(store.at_cycle(2), kept)) == (1, 2)
    for read in (lambda: gone.read(1), lambda: gone.visible(4), lambda: gone.head):
        with pytest.raises(Deleted):
            read()


# -- slots ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("history_s", "hold_s", "budget_bytes", "expected"),
    [
        (0.0, 0.0, None, 4),
        (2.0, 0.0, None, 204),
        (2.0, 5.0, None, 504),
        (2.0, 0.0, 100 * 1064, 100),
        (2.0, 0.5, 100 * 1064, 100),
        (2.0, 0.0, 10**9, 204),
        (0.0, 0.0, 4 * 1064, 4),
        (2.0, 0.96, 100 * 1064 + 1063, 100),
    ],
)
def test_slots_are_for_the_history_within_the_budget_and_for_what_is_held_in_any_case(
    history_s, hold_s, budget_bytes, expected
):
    assert slots_for("a/frame", 1000, 0.01, history_s, hold_s, budget_bytes) == expected


@pytest.mark.parametrize(("hold_s", "budget_bytes"), [(0.97, 100 * 1064), (0.0, 3 * 1064), (0.0, 0)])
def test_a_budget_that_holds_too_little_is_an_error_that_names_both(hold_s, budget_bytes):
    with pytest.raises(
        RecordError, match=rf"a/frame.*budget_bytes={budget_bytes} .*hold_s={hold_s} .*raise the budget"
    ):
        slots_for("a/frame", 1000, 0.01, 2.0, hold_s, budget_bytes)


def test_an_object_gets_the_slots_that_were_decided(store):
    a = store.join("a")
    size = a.insert("n", Count).size
    assert a.insert("small", Count, history_s=2.0, budget_bytes=20 * (size + 64)).n_slots == 20
    assert a.insert("slow", Count, every=10, history_s=2.0).n_slots == 24
    with pytest.raises(RecordError, match="a/none"):
        a.insert("none", Count, hold_s=1.0, budget_bytes=20 * (size + 64))
    assert "a/none" not in names(store.objects())


# -- versions of a record ------------------------------------------------------------------------------------


class Newer:
    class Pose(Record):
        """What became of it: a field was added in front."""

        y_m: Annotated[float, f8("m", "north")] = 2.5
        x_m: Annotated[float, f8("m", "east")] = 0.0


class Demanding:
    class Pose(Record):
        x_m: Annotated[float, f8("m", "east")]
        z_m: Annotated[float, f8("m", "up")]


class Feet:
    class Pose(Record):
        x_m: Annotated[float, f8("ft", "east")] = 0.0


class Whole:
    class Pose(Record):
        x_m: Annotated[int, i64("m", "east")] = 0


def test_a_reader_of_another_version_gets_the_fields_of_the_same_name(store):
    a = store.join("a")
    a.insert("old", Pose).write(Pose(1.5))
    a.insert("new", Newer.Pose).write(Newer.Pose(7.0, 3.5))
    store.tick()
    newer = store.find("a/old", Newer.Pose)
    assert newer.latest().value == Newer.Pose(2.5, 1.5)
    assert store.snapshot().get(newer).value == Newer.Pose(2.5, 1.5)
    assert newer.history(0, 10**9)["value"].dtype.names == ("x_m",)
    assert store.find("a/new", Pose).latest().value == Pose(3.5)


@pytest.mark.parametrize(("version", "field"), [(Demanding, "z_m"), (Feet, "x_m"), (Whole, "x_m")])
def test_a_reader_of_a_version_that_does_not_fit_is_told_which_field(store, version, field):
    store.join("a").insert("pose", Pose).write(Pose(1.5))
    with pytest.raises(RecordError, match=rf"a/pose.*{field}"):
        store.find("a/pose", version.Pose)


def test_a_successor_of_another_version_replaces_what_is_left(store):
    a = store.join("a")
    old = a.insert("pose", Pose)
    old.write(Pose(1.5))
    new = a.insert("pose", Newer.Pose)
    new.write(Newer.Pose(1.0, 2.0))
    assert store.find("a/pose", Newer.Pose).latest().value == Newer.Pose(1.0, 2.0)
    assert (old.read(1).value, new.oid > old.oid) == (Pose(1.5), True)
