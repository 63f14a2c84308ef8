"""Several processes on one store: who sees what, who may do what, and what the death of each one leaves behind."""

import fcntl
import os
import signal
import struct
from typing import Annotated

import pytest
from conftest import segment_path

from rtdb import AgedOut, InUse, NotOwner, Record, SegmentDamaged, Store, StoreMissing, Writer
from rtdb.records import i64

LONG_S = 30.0  # a wait that is never waited out when all is well


class Count(Record):
    """As in helpers/peer.py."""

    n: Annotated[int, i64("", "number")] = 0


@pytest.fixture
def name(unique):
    return unique()


@pytest.fixture
def store(name):
    with Store.create(name) as made:
        yield made


@pytest.fixture
def attached(peer, name, store):
    """Starts processes that are attached to the store."""

    def start():
        one = peer()
        assert one(f"store = Store.attach({name!r})") == "None"
        return one

    return start


def writing(attached):
    """A process that is component `w` with the object `w/n`."""
    writer = attached()
    assert writer("w = store.join('w').insert('n', Count)") == "None"
    return writer


# -- reading and writing ----------------------------------------------------------------------------------------


def test_all_processes_see_the_same_cuts(store, attached):
    a = store.join("a")
    writers = [a.insert(f"n{e}", Count, every=e) for e in (1, 3)]
    readers = [attached(), attached()]
    for c in range(1, 20):
        for writer in writers:
            writer.write(Count(c), t_data_ns=c)
        store.tick()
    cuts = [[store.at_cycle(c).get(w) for w in writers] for c in range(20)]
    told = [[[s and (s.value.n, s.write, s.t_commit_ns, s.t_data_ns) for s in row] for row in cuts]]
    for reader in readers:
        reader("objects = [store.find('a/n1', Count), store.find('a/n3', Count)]")
        told.append(
            eval(
                reader(
                    "[[(s := store.at_cycle(c).get(o)) and (s.value.n, s.write, s.t_commit_ns, s.t_data_ns)"
                    " for o in objects] for c in range(20)]"
                )
            )
        )
    assert told[0][19] == [(19, 19, 180_000_000, 19), (18, 18, 170_000_000, 18)]
    assert told[1] == told[0]
    assert told[2] == told[0]


def test_what_another_process_writes_shows_at_the_tick(store, attached):
    writer = writing(attached)
    obj = store.find("w/n", Count)
    writer("w.write(Count(5))")
    assert store.snapshot().get(obj) is None
    store.tick()
    assert store.snapshot().get(obj).value == Count(5)


def test_find_returns_when_another_process_inserts(store, attached):
    waiting = attached()
    waiting.send(f"store.find('a/late', Count, timeout_s={LONG_S}).name")
    waiting.until_it_waits()
    a = store.join("a")
    a.insert("other", Count)
    a.insert("late", Count)
    assert waiting.answer() == "'a/late'"


def test_a_wait_for_the_cycle_ends_with_the_tick(store, attached):
    waiting = attached()
    waiting.send(f"store.wait_cycle(0, {LONG_S})")
    waiting.until_it_waits()
    store.tick()
    assert waiting.answer() == "1"


def test_a_wait_without_a_tick_ends_with_none(store):
    assert store.wait_cycle(0, 0.0) is None
    assert store.wait_cycle(0, 0.01) is None
    store.tick()
    assert store.wait_cycle(0, 0.0) == 1


def test_a_reader_that_the_writer_overtook_is_told(store, attached):
    writer = writing(attached)
    obj = store.find("w/n", Count)
    writer("w.write(Count(1))")
    store.tick()
    for n in range(2, 300):
        writer(f"w.write(Count({n}))")
        store.tick()
    with pytest.raises(AgedOut):
        store.at_cycle(1).get(obj)


# -- who may do what ---------------------------------------------------------------------------------------------


def test_a_second_process_cannot_be_the_same_component(store, attached):
    writing(attached)
    answer = attached()("store.join('w')")
    assert answer.startswith("!InUse: cannot join w")


def test_a_reader_that_tries_to_write_is_refused(store, attached):
    writing(attached)("w.write(Count(5))")
    store.tick()
    obj = store.find("w/n", Count)
    mine = Writer(store, obj.index, Count)
    for attempt in (lambda: mine.write(Count(6)), mine.begin, lambda: mine.commit(0)):
        with pytest.raises(NotOwner, match="w/n"):
            attempt()
    assert (obj.latest().value.n, obj.head) == (5, 1)


def test_only_the_clock_holder_ticks(store, attached):
    assert attached()("store.tick()").startswith("!NotOwner: cannot tick")
    assert attached()("store.core.take_clock()").startswith("!InUse")
    assert store.cycle == 0


def test_a_reader_that_pokes_into_the_memory_of_another_dies_of_it(name, store, attached):
    """Two readers: one proves that the address is right by reading it, the other writes there."""
    store.join("a").insert("n", Count).write(Count(0x0123456789ABCDEF))
    poke = (
        "import ctypes, re\n"
        f"maps = [re.split('[- ]', l)[:3] for l in open('/proc/self/maps') if {name!r} in l]\n"
        "spans = [(int(a, 16), int(b, 16), mode) for a, b, mode in maps]\n"
        "data = b''.join(ctypes.string_at(a, b - a) for a, b, _ in spans)\n"
        "address = spans[0][0] + data.index((0x0123456789ABCDEF).to_bytes(8, 'little'))\n"
    )
    reader, vandal = attached(), attached()
    assert reader(poke + "ctypes.c_uint64.from_address(address).value") == str(0x0123456789ABCDEF)
    assert vandal(poke + "ctypes.c_uint64.from_address(address).value = 1\nNone") == ""
    assert vandal.process.wait() == -signal.SIGSEGV
    assert store.find("a/n", Count).latest().value.n == 0x0123456789ABCDEF


def test_an_owner_maps_only_its_own_rings_writable(name, store, attached):
    store.join("a").insert("n", Count)
    writer = writing(attached)
    modes = writer(
        f"[(int(l.split('-')[1].split()[0], 16) - int(l.split('-')[0], 16), l.split()[1])"
        f" for l in open('/proc/self/maps') if {name!r} in l]"
    )
    writable = sum(size for size, mode in eval(modes) if "w" in mode)
    ring = 64 + 64 * (200 + 4)
    assert ring <= writable <= ring + 5 * 4096


# -- deaths ------------------------------------------------------------------------------------------------------


def test_a_writer_killed_in_mid_write_leaves_the_value_before_and_a_successor_goes_on(store, attached):
    writer = writing(attached)
    obj = store.find("w/n", Count)
    writer("w.write(Count(5))")
    store.tick()
    assert writer("view = w.begin(); view[:4] = b'half'") == "None"
    writer.kill()
    store.tick()
    assert (obj.head, obj.latest().value.n, store.snapshot().get(obj).value.n) == (1, 5, 5)
    assert [(c.name, c.alive) for c in store.components()] == [("w", False)]
    successor = writing(attached)
    assert [(c.name, c.alive) for c in store.components()] == [("w", True)]
    assert successor("w.write(Count(6))") == "2"
    store.tick()
    assert (store.snapshot().get(obj).value.n, store.at_cycle(2).get(obj).value.n) == (6, 5)
    assert store.core.n_objects() == 1


def test_a_component_that_left_is_taken_over_while_its_process_lives(store, attached):
    writer = attached()
    writer("c = store.join('w')\nw = c.insert('n', Count)\nw.write(Count(1))")
    writer("view = w.begin()\nc.leave()")
    mine = store.join("w").insert("n", Count)
    assert [mine.write(Count(n)) for n in (2, 3, 4)] == [2, 3, 4]
    assert writer("w.write(Count(9))").startswith("!NotOwner")
    assert writer("w.commit(0)").startswith("!NotOwner")
    assert mine.latest().value.n == 4


def test_what_was_begun_before_leaving_is_not_committed_after_coming_back(store, attached):
    """Else the object's newest write would go back in number."""
    writer = attached()
    writer("c = store.join('w')\nw = c.insert('n', Count)\nw.write(Count(1))\nview = w.begin()\nc.leave()")
    between = store.join("w")
    mine = between.insert("n", Count)
    assert [mine.write(Count(n)) for n in (2, 3, 4)] == [2, 3, 4]
    between.leave()
    assert writer("c = store.join('w')") == "None"
    assert writer("w.commit(0)").startswith("!NotOwner")
    assert (mine.head, mine.latest().value.n) == (4, 4)


def test_another_process_takes_the_clock_of_a_dead_one(peer, name):
    creator, standby, reader = peer(), peer(), peer()
    creator(f"store = Store.create({name!r})\nw = store.join('w').insert('n', Count)")
    creator("for c in range(1, 6): w.write(Count(c)); store.tick()")
    for one in (standby, reader):
        one(f"store = Store.attach({name!r})\nobj = store.find('w/n', Count)")
    assert standby("store.core.take_clock()").startswith("!InUse: cannot take the clock")
    creator.kill()
    assert standby("store.core.take_clock()") == "None"
    standby("w = store.join('w').insert('n', Count)\nw.write(Count(6))")
    reader.send(f"store.wait_cycle(5, {LONG_S})")
    assert standby("store.tick()") == "6"
    assert reader.answer() == "6"
    assert reader("[store.at_cycle(c).get(obj).value.n for c in range(1, 7)]") == "[1, 2, 3, 4, 5, 6]"
    for one in (standby, reader):
        one.kill()
    with Store.create(name):
        pass


def test_the_barrier_waits_for_the_living_and_not_for_the_dead(store, attached):
    first, second, bystander = attached(), attached(), attached()
    for one, who in ((first, "a"), (second, "b")):
        one(f"me = store.join({who!r}, participant=True)")
    bystander("me = store.join('c')")
    store.tick()
    first("me.done(1)")
    assert not store.wait_done(1, 0.0)
    second.send(f"me.done(store.wait_cycle(0, {LONG_S}))")
    assert store.wait_done(1, LONG_S)
    assert second.answer() == "None"
    store.tick()
    first("me.done(2)")
    assert not store.wait_done(2, 0.0)
    second.kill()
    assert store.wait_done(2, LONG_S)
    assert [(c.name, c.alive, c.participant, c.done) for c in store.components()] == [
        ("a", True, True, 2),
        ("b", False, True, 1),
        ("c", True, False, 0),
    ]


def test_who_joins_late_owes_nothing_for_the_cycles_before(store, attached):
    for _ in range(5):
        store.tick()
    late = attached()
    late("me = store.join('late', participant=True)")
    assert store.wait_done(5, 0.0)
    store.tick()
    assert not store.wait_done(6, 0.0)


def test_a_killed_waiter_holds_nobody_up(store, attached):
    waiting = attached()
    waiting.send(f"store.wait_cycle(0, {LONG_S})")
    waiting.until_it_waits()
    waiting.kill()
    assert [store.tick() for _ in range(3)] == [1, 2, 3]
    again = attached()
    again.send(f"store.wait_cycle(3, {LONG_S})")
    again.until_it_waits()
    store.tick()
    assert again.answer() == "4"


@pytest.mark.parametrize(
    "wait", ["store.wait_cycle(0, 600)", "store.wait_done(1, 600)", "store.find('no/thing', timeout_s=600)"]
)
def test_ctrl_c_ends_a_wait(store, attached, wait):
    attached()("store.join('slow', participant=True)")
    waiting = attached()
    waiting("other = store.join('me', participant=True)")
    waiting.send(wait)
    waiting.until_it_waits()
    waiting.interrupt()
    assert waiting.answer().startswith("!KeyboardInterrupt")
    assert waiting("store.cycle") == "0"


# -- stores that are not there, not whole, or left behind --------------------------------------------------------


def test_a_store_that_is_not_there_is_missing(name):
    with pytest.raises(StoreMissing, match="there is none of that name"):
        Store.attach(name)


def test_the_name_of_a_living_store_is_in_use(name, store, attached):
    with pytest.raises(InUse, match=name):
        Store.create(name)
    assert attached()(f"Store.create({name!r})").startswith("!InUse")
    store.tick()
    assert attached()("store.cycle") == "1"


def test_a_store_whose_creator_was_killed_is_dead_and_its_name_is_free(peer, name):
    creator = peer()
    creator(f"store = Store.create({name!r})\nstore.join('w').insert('n', Count)\nstore.tick()")
    creator.kill()
    with pytest.raises(StoreMissing, match="what a crash left"):
        Store.attach(name)
    with Store.create(name) as fresh:
        assert (fresh.cycle, fresh.objects()) == (0, [])
        assert peer()(f"Store.attach({name!r}).cycle") == "0"


def test_a_store_lives_on_while_somebody_is_attached(peer, name):
    creator, other = peer(), peer()
    creator(f"store = Store.create({name!r})\nstore.join('w').insert('n', Count).write(Count(4))\nstore.tick()")
    other(f"store = Store.attach({name!r})")
    creator.kill()
    with pytest.raises(InUse):
        Store.create(name)
    with Store.attach(name) as store:
        assert store.snapshot()["w/n"].value == {"n": 4}
    other.kill()
    with Store.create(name):
        pass


def test_attached_stores_do_not_take_the_name_away(name, store):
    with Store.attach(name):
        pass
    with Store.attach(name) as again:
        assert again.core.id == store.core.id


def damaged(name, store, change):
    """A file under another name that holds the store's memory after `change`."""
    data = bytearray(segment_path(name).read_bytes())
    store.close()
    segment_path(name).write_bytes(change(data) or data)


def overwrite(offset, code, value):
    return lambda data: struct.pack_into(code, data, offset, value)


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda data: b"junk", id="junk"),
        pytest.param(lambda data: b"\0" * len(data), id="zeros"),
        pytest.param(lambda data: os.urandom(len(data)), id="noise"),
        pytest.param(lambda data: data[: len(data) // 2], id="half"),
        pytest.param(lambda data: data[:-1], id="a byte short"),
        pytest.param(lambda data: data[:20], id="half a header"),
        pytest.param(lambda data: data + bytes(4096), id="too long"),
        pytest.param(overwrite(8, "<I", 999), id="another layout"),
        pytest.param(overwrite(12, "<I", 0xFFFFFFFF), id="too many objects"),
        pytest.param(overwrite(16, "<I", 0), id="no components"),
        pytest.param(overwrite(24, "<Q", 1 << 63), id="too large"),
    ],
)
def test_a_file_that_is_no_whole_store_is_refused_in_one_line(name, store, change):
    damaged(name, store, change)
    try:
        with pytest.raises(SegmentDamaged) as refused:
            Store.attach(name)
        assert "\n" not in str(refused.value)
        assert name in str(refused.value)
    finally:
        segment_path(name).unlink()


LOOK = """
import contextlib, random, sys
from rtdb import RtdbError

def look(name):
    calm = lambda: contextlib.suppress(RtdbError, UnicodeDecodeError)
    with calm(), Store.attach(name) as store:
        for i in range(min(store.core.n_objects(), 8)):
            for call in (store.core.object, store.core.latest, lambda i: store.core.visible(i, 1),
                         lambda i: store.core.as_of(i, 10), lambda i: store.core.read(i, 1),
                         store.core.schema, store.core.component):
                with calm():
                    call(i)
                    counts[0] += 1
        with calm():
            store.core.find("c1/n")

def fuzz(name, path, rounds):
    whole = open(path, "rb").read()
    entries = whole.index(b"c0/n\\0")
    for _ in range(rounds):
        with open(path, "r+b") as file:
            for _ in range(random.choice((0, 1, 1, 2, 4))):
                first, words = random.choice(((4096, 10), (4096 + 128, 20), (entries, 160), (entries, 160)))
                file.seek(first + 4 * random.randrange(words))
                file.write(random.choice((0, 1, 7, 2**31 - 1, 2**32 - 1, random.getrandbits(32),
                                          random.getrandbits(16))).to_bytes(4, "little"))
        look(name)
        with open(path, "r+b") as file:
            file.write(whole[:entries + 4096])

counts = [0]
random.seed(4)
"""


def test_a_directory_that_lies_about_its_objects_crashes_no_reader(name, store, peer):
    """Random words over the directory: each attach and read gives a value or an error of the store."""
    for k in range(4):
        store.join(f"c{k}").insert("n", Count).write(Count(k))
    store.tick()
    damaged(name, store, lambda data: None)
    reader = peer()
    assert reader(LOOK) == "None"
    with segment_path(name).open("r+b") as file:
        fcntl.fcntl(file, fcntl.F_OFD_SETLK, struct.pack("hhqqi4x", fcntl.F_RDLCK, 0, 0, 1, 0))  # looks alive
        answer = reader(f"fuzz({name!r}, {str(segment_path(name))!r}, 3000); counts[0]")
    segment_path(name).unlink()
    assert answer.isdigit(), "it crashed" if answer == "" else answer
    assert int(answer) > 3000
