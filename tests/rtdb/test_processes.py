"""Several processes on one store: who sees what, who may do what, and what the death of each one leaves behind."""

import ast
import fcntl
import os
import signal
import struct

import pytest
from conftest import LONG_S, Count, segment_path

from rtdb import (
    AgedOut,
    Flag,
    InUse,
    NotOwner,
    RecordError,
    SegmentDamaged,
    State,
    Store,
    StoreMissing,
    Writer,
)


@pytest.fixture
def store(shared):
    """In this file stores are shared."""
    return shared


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
    mine = Writer(store, obj.handle, Count)
    commit = lambda: store.core.commit(obj.handle, obj.size, 0, ())  # noqa: E731
    for attempt in (lambda: mine.write(Count(6)), mine.frame().__enter__, commit, mine.delete):
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
    assert writer("frame = w.frame().__enter__(); frame.memory[:4] = b'half'") == "None"
    writer.kill()
    store.tick()
    assert (obj.head, obj.latest().value.n, store.snapshot().get(obj).value.n) == (1, 5, 5)
    assert [(c.name, c.alive) for c in store.components()] == [("w", False)]
    successor = writing(attached)
    assert [(c.name, c.alive) for c in store.components()] == [("w", True)]
    assert successor("w.write(Count(6))") == "2"
    store.tick()
    assert (store.snapshot().get(obj).value.n, store.at_cycle(2).get(obj).value.n) == (6, 5)
    assert [obj.name for obj in store.objects()] == ["w/health", "w/n"]


def test_a_component_that_left_is_taken_over_while_its_process_lives(store, attached):
    writer = attached()
    writer("c = store.join('w')\nw = c.insert('n', Count)\nw.write(Count(1))")
    writer("frame = w.frame().__enter__()\nc.leave()")
    mine = store.join("w").insert("n", Count)
    assert [mine.write(Count(n)) for n in (2, 3, 4)] == [2, 3, 4]
    assert writer("w.write(Count(9))").startswith("!NotOwner")
    assert writer("frame.__exit__(None, None, None)").startswith("!NotOwner")
    assert mine.latest().value.n == 4


def test_what_was_begun_before_leaving_is_not_committed_after_coming_back(store, attached):
    """Else the object's newest write would go back in number."""
    writer = attached()
    writer("c = store.join('w')\nw = c.insert('n', Count)\nw.write(Count(1))\nframe = w.frame().__enter__()\nc.leave()")
    between = store.join("w")
    mine = between.insert("n", Count)
    assert [mine.write(Count(n)) for n in (2, 3, 4)] == [2, 3, 4]
    between.leave()
    assert writer("c = store.join('w')") == "None"
    assert writer("frame.__exit__(None, None, None)").startswith("!NotOwner")
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
    "wait",
    [
        "store.wait_cycle(0, 600)",
        "store.wait_done(1, 600)",
        "store.find('no/thing', timeout_s=600)",
        "store.find('slow/n').wait(0, 600)",
        "next(other.cycles(600))",
        "store.watch('no/*').changes(600)",
    ],
)
def test_ctrl_c_ends_a_wait(store, attached, wait):
    attached()("store.join('slow', participant=True).insert('n', Count)")
    waiting = attached()
    waiting("other = store.join('me', participant=True)")
    waiting.send(wait)
    waiting.until_it_waits()
    waiting.interrupt()
    assert waiting.answer().startswith("!KeyboardInterrupt")
    assert waiting("store.cycle") == "0"


def test_a_killed_component_is_taken_over_with_its_objects_and_its_history(store, attached):
    first = attached()
    first("c = store.join('w', version='1.0')\nw = c.insert('n', Count)\nfor k in (1, 2): w.write(Count(k))")
    store.tick()
    obj = store.find("w/n", Count)
    first.kill()
    second = attached()
    second("c = store.join('w', version='2.0')\nw = c.insert('n', Count)")
    assert second("w.oid, w.write(Count(3)), [w.read(k).value.n for k in (1, 2, 3)]") == f"({obj.oid}, 3, [1, 2, 3])"
    told = store.components()[0]
    assert (told.pid, told.version, told.alive) == (second.process.pid, "2.0", True)
    store.tick()
    assert store.snapshot().get(obj).value.n == 3


# -- components ---------------------------------------------------------------------------------------------------


def test_a_component_tells_its_process_its_version_and_its_pace(store, attached):
    other = attached()
    other("c = store.join('w', participant=True, every=5, phase=7, version='2.3 (abc)')")
    store.join("a")
    told = [(c.name, c.pid, c.version, c.participant, c.every, c.phase, c.alive) for c in store.components()]
    assert told == [
        ("w", other.process.pid, "2.3 (abc)", True, 5, 2, True),
        ("a", os.getpid(), "", False, 1, 0, True),
    ]


def test_the_health_of_a_component_is_an_object_that_says_what_it_did(store):
    component = store.join("w", version="1.2.3")
    cycles = component.cycles(LONG_S)
    for _ in range(10):
        store.tick()
        cut = next(cycles)
    component.done(cut.cycle)
    component.status("calibrating the camera", State.WARNING)
    health = store.find("w/health").latest().value
    assert (health["pid"], health["version"], health["steps"], health["missed"]) == (os.getpid(), "1.2.3", 10, 0)
    assert (health["state"], health["status"]) == ("WARNING", "calibrating the camera")
    assert (sum(health["run_us"]), sum(health["lateness_us"])) == (10, 0)  # a step is late in real time only
    store.tick()
    assert store.snapshot()["w/health"].value == health
    assert store.find("w/health").flags & Flag.HOST_DEPENDENT


def test_the_health_of_a_component_in_real_time_counts_how_late_its_steps_began(name):
    with Store.create(name, clock="real", tick_ns=1_000_000) as store:
        component = store.join("w", participant=True)
        clock = store.run_clock()
        cycles = component.cycles(LONG_S)
        for _ in range(10):
            cut = next(cycles)
        component.done(cut.cycle)
        clock.stop()
        component.status("stopped")
        health = store.find("w/health").latest().value
        told = store.components()[0]
        assert (health["steps"], sum(health["run_us"]), sum(health["lateness_us"])) == (10, 10, 10)
        assert (health["missed"], told.done) == (told.missed, cut.cycle)


def test_health_is_written_about_once_a_second_of_the_store(store):
    component = store.join("w")
    health = store.find("w/health")
    cycles = component.cycles(LONG_S)
    heads = []
    for _ in range(350):
        store.tick()
        next(cycles)
        heads.append(health.head)
    assert heads[0] == 1
    assert heads[-1] == 4
    assert sorted(heads) == heads


@pytest.mark.parametrize("text", ["", "x" * 160, "\xe4" * 80])
def test_a_status_of_160_bytes_is_read_back_whole(store, text):
    component = store.join("w")
    component.status("something longer " * 5, State.FAILURE)
    component.status(text)
    health = store.find("w/health").latest().value
    assert (health["status"], health["state"]) == (text, "RUNNING")


def test_a_status_that_is_longer_is_refused_and_the_one_before_stays(store):
    component = store.join("w")
    component.status("fine")
    for text, state in (("x" * 161, State.RUNNING), ("\xe4" * 81, State.RUNNING), ("fine", 5)):
        with pytest.raises((RecordError, ValueError)):
            component.status(text, state)
    assert store.find("w/health").latest().value["status"] == "fine"


def test_in_a_private_store_there_is_nobody_to_tell():
    with Store.create() as private:
        component = private.join("w")
        component.status("fine")
        assert private.objects() == []
        with pytest.raises(RecordError):
            component.status("x" * 161)


def test_nobody_speaks_for_a_component_that_it_is_not(store, attached):
    other = attached()
    other("c = store.join('w')\nc.leave()")
    assert other("c.status('fine')").startswith("!NotOwner")
    assert other("c.done(1)").startswith("!NotOwner")
    assert other("c.leave()").startswith("!NotOwner")
    assert other("next(c.cycles())").startswith("!NotOwner")


def test_an_old_cut_goes_on_saying_that_a_component_lived_when_it_is_dead(store, attached):
    other = attached()
    other("c = store.join('w')")
    before = store.snapshot()
    store.tick()
    lived = store.snapshot()
    other.kill()
    assert [cut.alive("w") for cut in (before, lived)] == [False, True]
    store.tick()
    died = store.snapshot()
    again = attached()
    again("c = store.join('w')")
    assert [cut.alive("w") for cut in (before, lived, died)] == [False, True, False]
    store.tick()
    assert [cut.alive("w") for cut in (before, lived, died, store.snapshot())] == [False, True, False, True]
    for reader in (attached(), other := attached()):
        assert reader("[store.at_cycle(c).alive('w') for c in range(4)]") == "[False, True, False, True]"
    assert other("store.at_cycle(4).alive('w')").startswith("!NotYet")


@pytest.mark.parametrize("kind", ["private", "shared"])
def test_an_old_cut_goes_on_saying_that_a_component_lived_when_it_has_left(kind, unique):
    with Store.create(unique() if kind == "shared" else None) as store:
        component = store.join("w")
        store.tick()
        lived = store.snapshot()
        component.leave()
        store.tick()
        assert (lived.alive("w"), store.snapshot().alive("w")) == (True, False)


def test_a_name_that_takes_the_place_of_another_has_not_its_past():
    with Store.create(max_components=1) as store:
        component = store.join("a")
        lived = store.tick()
        component.leave()
        store.tick()
        store.join("b")
        store.tick()
        assert (store.at_cycle(lived).alive("b"), store.snapshot().alive("b")) == (False, True)


def test_a_life_that_changed_too_often_ages_out_and_is_not_made_up(store):
    lives = []
    for _ in range(20):
        component = store.join("w")
        lives.append(store.tick())
        component.leave()
        store.tick()
    answers = {}
    for c in range(1, 41):
        try:
            answers[c] = store.at_cycle(c).alive("w")
        except AgedOut:
            answers[c] = None
    assert all(alive in {c in lives, None} for c, alive in answers.items())
    assert [answers[c] for c in (37, 38, 39, 40)] == [True, False, True, False]
    assert answers[1] is None


def test_who_died_together_with_the_clock_is_marked_dead_by_who_attaches(peer, name):
    creator, dies, lives = peer(), peer(), peer()
    creator(f"store = Store.create({name!r})")
    for one, who in ((dies, "dies"), (lives, "lives")):
        one(f"store = Store.attach({name!r})\nc = store.join({who!r})\nw = c.insert('n', Count)")
    creator("for _ in range(3): store.tick()")
    lives("obj = store.find('dies/n')")
    creator.kill()
    dies.kill()
    with Store.attach(name) as store:
        assert [store.snapshot().alive(who) for who in ("dies", "lives")] == [False, True]
        assert [store.at_cycle(2).alive(who) for who in ("dies", "lives")] == [True, True]
        assert lives("store.at_cycle(3).alive('dies')") == "False"
        lives.kill()
    Store.create(name).close()


def test_two_components_of_one_process_are_two(store):
    one, two = store.join("one"), store.join("two")
    mine, yours = one.insert("n", Count), two.insert("n", Count)
    one.leave()
    with pytest.raises(NotOwner, match="one/n"):
        mine.write(Count(1))
    assert yours.write(Count(2)) == 1
    assert [(c.name, c.alive) for c in store.components()] == [("one", False), ("two", True)]


def test_a_store_bears_its_name_until_its_creator_closes_it(unique):
    name = unique()
    with Store.create(name) as made, Store.attach(name) as seen:
        assert made.bears_name
        assert seen.bears_name
        made.close()
        assert not seen.bears_name
        with Store.create(name) as successor:
            assert successor.bears_name
            assert not seen.bears_name
    with Store.create() as private:
        assert not private.bears_name


# -- forks --------------------------------------------------------------------------------------------------------

FORK = """
def fork(what):
    r, w = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(r)
        os.write(w, what().encode() or b"nothing")
        os.close(w)
        raise SystemExit
    os.close(w)
    answer = os.read(r, 10000).decode()
    os.close(r)
    assert os.waitpid(pid, 0)[1] == 0
    return answer

def tried(*calls):
    answers = []
    for call in calls:
        try:
            answers.append(repr(call()))
        except RtdbError as error:
            answers.append(f"{type(error).__name__}: {error}")
    return chr(10).join(answers)
"""


def test_a_store_is_closed_for_a_forked_child(store, attached):
    writer = writing(attached)
    writer(FORK)
    writer("w.write(Count(5))\nc = store.components()")
    calls = "lambda: store.cycle, w.latest, lambda: w.write(Count(6)), lambda: store.join('x'), w.frame().__enter__"
    lines = ast.literal_eval(writer(f"fork(lambda: tried({calls}))")).split("\n")
    assert len(lines) == 5
    assert all(line.startswith("NotOwner") and "closed" in line for line in lines)


def test_what_a_parent_holds_survives_its_childs_exit(name, peer, attached):
    parent = peer()
    parent(f"store = Store.create({name!r})\nw = store.join('w').insert('n', Count)\n{FORK}")
    parent("w.write(Count(5))")
    for end in ("lambda: ''", "lambda: store.close() or ''", "lambda: tried(store.tick)"):
        parent(f"fork({end})")
    other = attached()
    assert other("store.join('w')").startswith("!InUse")
    assert other("store.take_clock()").startswith("!InUse")
    assert parent("w.write(Count(6)), store.tick(), store.snapshot().get(w).value.n") == "(2, 1, 6)"
    with pytest.raises(InUse):
        Store.create(name)
    assert parent("store.close()") == "None"
    assert not segment_path(name).exists()


def test_a_forked_child_attaches_anew_and_is_another_process(store, attached):
    parent = writing(attached)
    parent(FORK)
    parent("w.write(Count(5))")
    answer = parent(
        "def anew():\n"
        f"    with Store.attach({store.name!r}) as mine:\n"
        "        n = mine.join('child').insert('n', Count)\n"
        "        n.write(Count(7))\n"
        "        return tried(lambda: mine.join('w')) + ' ' + str(mine.find('w/n', Count).latest().value.n)\n"
        "fork(anew)"
    )
    assert "InUse: cannot join w" in answer
    assert answer.endswith(" 5'")
    assert store.find("child/n", Count).latest().value == Count(7)
    assert [(c.name, c.alive) for c in store.components()] == [("w", True), ("child", False)]


LEAVE_A_CHILD = """
r, w = os.pipe()
pid = os.fork()
if pid == 0:
    os.write(w, b"here")
    while True: signal.pause()
os.read(r, 4)
"""


def child_of(parent):
    """Leave a child of a peer alive; returns its process id."""
    parent("import signal")
    assert parent(LEAVE_A_CHILD) == "b'here'"
    return int(parent("pid"))


def test_the_locks_of_a_killed_parent_are_free_although_its_child_lives(name, peer):
    parent = peer()
    parent(f"store = Store.create({name!r})\nw = store.join('w').insert('n', Count)\nw.write(Count(5))")
    child = child_of(parent)
    try:
        with Store.attach(name) as store:
            assert (store.clock.alive, store.components()[0].alive) == (True, True)
            parent.kill()
            assert (store.clock.alive, store.components()[0].alive) == (False, False)
            store.take_clock()
            store.join("w").insert("n", Count).write(Count(6))
            store.tick()
            assert store.snapshot()["w/n"].value == {"n": 6}
        os.kill(child, 0)
        Store.create(name).close()
    finally:
        os.kill(child, signal.SIGKILL)


def test_the_clock_of_a_killed_parent_is_free_although_its_child_lives(name, peer, unique):
    with Store.create(name, clock="barrier") as store:
        me = store.join("me", participant=True)
        cycles = me.cycles(LONG_S)
        parent = peer()
        parent(f"store = Store.attach({name!r})\nclock = store.run_clock()")
        assert next(cycles).cycle == 1
        child = child_of(parent)
        try:
            parent.kill()
            assert not store.clock.alive
            store.run_clock()
            assert next(cycles).cycle == 2
        finally:
            os.kill(child, signal.SIGKILL)


def test_a_clock_ticks_on_while_children_come_and_go(name, peer):
    with Store.create(name, clock="barrier") as store:
        me = store.join("me", participant=True)
        cycles = me.cycles(LONG_S)
        parent = peer()
        parent(f"store = Store.attach({name!r})\nclock = store.run_clock()\n{FORK}")
        for c in range(1, 5):
            assert next(cycles).cycle == c
            assert parent("fork(lambda: '')") == "'nothing'"
        assert (store.clock.pid, store.clock.takeovers) == (parent.process.pid, 0)


# -- stores that are not there, not whole, or left behind --------------------------------------------------------


def test_a_store_that_is_not_there_is_missing(name):
    with pytest.raises(StoreMissing, match="there is none of that name"):
        Store.attach(name)


def test_who_attaches_early_waits_until_the_store_is_there(peer, name):
    early = peer()
    assert early(f"Store.attach({name!r}, timeout_s=0.02)").startswith("!StoreMissing")
    early.send(f"Store.attach({name!r}, timeout_s={LONG_S}).cycle")
    with Store.create(name) as store:
        assert early.answer() == "0"
        assert store.tick() == 1


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
import contextlib, random
from rtdb import RtdbError

def look(name):
    calm = lambda: contextlib.suppress(RtdbError, UnicodeDecodeError)
    with calm(), Store.attach(name) as store:
        core = store.core
        for i, handle in enumerate(core.entries()[:8]):
            for call in (core.object, core.latest, lambda h: core.visible(h, 1), lambda h: core.as_of(h, 10),
                         lambda h: core.as_of_data(h, 10), lambda h: core.next(h, 0), lambda h: core.read(h, 1),
                         lambda h: core.peek(h, 1), lambda h: core.wait_write(h, 0, core.now_ns),
                         lambda h: core.schema(i), lambda h: core.component(i), lambda h: core.alive_at(i, 1)):
                with calm():
                    call(handle)
                    counts[0] += 1
        for call in (lambda: core.find("c1/n"), core.changed, core.memory, core.clock_state):
            with calm():
                call()

def fuzz(name, path, rounds):
    whole = open(path, "rb").read()
    entries = whole.index(b"c0/n\\0")
    words = [at for at in range(4096, entries + 1600, 4) if any(whole[at - 4:at + 8])]  # what is used of the directory
    for _ in range(rounds):
        with open(path, "r+b") as file:
            for _ in range(random.choice((0, 1, 1, 2, 4))):
                file.seek(random.choice(words))
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
