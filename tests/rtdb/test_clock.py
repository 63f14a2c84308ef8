"""Who ends the cycles: stepped stores, barriers, real time, standbys, and what each death leaves to the others.

Nothing here measures a time. A real-time clock is asked for what must hold however late it is: its cycles are those of
its time, and what it left out is counted.
"""

import ast
import asyncio
import os
import select
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import LONG_S, Count, count_to, segment_path, shown

import rtdb
from rtdb import ClockDead, InUse, Kind, NotOwner, NotYet, RecordError, Store

MS = 1_000_000


@pytest.fixture
def barrier(name):
    with Store.create(name, clock="barrier") as made:
        yield made


@pytest.fixture
def real(name):
    with Store.create(name, clock="real", tick_ns=MS) as made:
        yield made


def participant(peer, component, *, every=1, phase=0):
    """Make a process a participant that keeps the pace of its cycles."""
    joined = f"me = store.join({component!r}, participant=True, every={every}, phase={phase})"
    assert peer(f"{joined}\ncycles = me.cycles({LONG_S})") == "None"
    return peer


def take(n):
    """Have a participant go through its next n cycles; it answers with their numbers."""
    return f"[next(cycles).cycle for _ in range({n})]"


def ticks_of(clock):
    """How often it ticked."""
    return sum(clock.lateness_us)


# -- stepped ---------------------------------------------------------------------------------------------------


def test_a_stepped_store_is_where_it_was_stepped_to(unique):
    t0_ns = 1_700_000_000_000_000_000
    for name in (None, unique()):
        with Store.create(name, t0_ns=t0_ns, tick_ns=25 * MS) as store:
            assert (store.cycle, store.now_ns, store.tick_ns, store.t0_ns) == (0, t0_ns, 25 * MS, t0_ns)
            for c in range(1, 5):
                assert store.tick() == c
                assert (store.now_ns, store.snapshot().t_ns) == (t0_ns + c * 25 * MS,) * 2
            clock = store.clock
            assert (clock.kind, clock.alive, clock.pid, clock.cycle) == (Kind.STEPPED, True, os.getpid(), 4)
            assert (clock.skipped, clock.takeovers, clock.late_ns, clock.stalled) == (0, 0, 0, False)


@pytest.mark.parametrize("tick_ns", [MS, 1000 * MS])
def test_ticks_of_a_millisecond_and_of_a_second_are_accepted(unique, tick_ns):
    with Store.create(unique(), tick_ns=tick_ns) as store:
        count_to(store, store.join("a").insert("n", Count), 3)
        assert store.now_ns == 3 * tick_ns
    with Store.create(unique(), clock="real", tick_ns=tick_ns) as store:
        store.run_clock()
        store.wait_cycle(0, LONG_S)
        assert store.at_cycle(store.cycle).t_ns - store.t0_ns == store.cycle * tick_ns > 0


@pytest.mark.parametrize("tick_ns", [100, 999, -1, 1001 * 10**9])
def test_ticks_that_make_no_sense_are_refused(name, tick_ns):
    with pytest.raises(RecordError):
        Store.create(name, tick_ns=tick_ns)


def test_a_clock_that_is_none_is_refused_with_those_there_are(name):
    with pytest.raises(RecordError, match=r"'sundial'.*stepped, barrier, real"):
        Store.create(name, clock="sundial")
    for clock in ("barrier", "real"):
        with pytest.raises(RecordError, match="needs a name"):
            Store.create(clock=clock)


def test_a_stepped_store_is_not_run_and_a_run_store_is_not_stepped(store, unique):
    with pytest.raises((NotOwner, RecordError)):
        store.run_clock()
    assert store.tick() == 1
    with Store.create(unique(), clock="barrier") as barrier:
        with pytest.raises(NotOwner, match="tick"):
            barrier.tick()
        assert barrier.cycle == 0


def test_a_cut_of_the_future_can_be_taken_and_read_when_it_is_there(store):
    writer = store.join("a").insert("n", Count)
    cut = store.at(store.now_ns + 35 * MS)
    assert cut.cycle == 3
    with pytest.raises(NotYet, match="future"):
        cut.get(writer)
    with pytest.raises(NotYet):
        cut.alive("a")
    count_to(store, writer, 3)
    assert shown(cut, writer) == 3


def test_who_waits_in_a_stepped_store_whose_clock_died_is_told(peer, name):
    creator, waiting = peer(), peer()
    creator(f"store = Store.create({name!r})\nw = store.join('w').insert('n', Count)\nstore.tick()")
    waiting(f"store = Store.attach({name!r})\nobj = store.find('w/n')\nme = store.join('me')\ncycles = me.cycles(0.05)")
    waiting.send(f"obj.wait(0, {LONG_S})")
    waiting.until_it_waits()
    creator.kill()
    assert waiting.answer().startswith("!ClockDead: cannot wait for w/n")
    assert waiting("next(cycles)").startswith("!ClockDead")
    assert waiting("store.clock.alive, store.clock.cycle") == "(False, 1)"
    assert waiting("store.take_clock()\nstore.tick()") == "2"
    assert waiting("store.clock.alive, store.clock.takeovers, store.clock.pid == os.getpid()") == "(True, 1, True)"
    waiting.kill()
    Store.create(name).close()


def test_the_clock_of_a_stepped_store_is_taken_from_the_dead_only(shared, attached):
    other = attached()
    assert other("store.take_clock()").startswith("!InUse: cannot take the clock")
    assert other("store.tick()").startswith("!NotOwner")
    assert [shared.tick() for _ in range(2)] == [1, 2]
    shared.take_clock()  # it is ours already
    assert shared.clock.takeovers == 0


# -- a tick that was interrupted -------------------------------------------------------------------------------


def leave_half_done(name, cycle, t0_ns, left_out=0):
    """Make the segment what a clock leaves that is killed behind the first step of a tick."""
    at = segment_path(name).read_bytes().index(struct.pack("<QQq", cycle, cycle, t0_ns))  # epoch, cycle, t0 of fw_clock
    with segment_path(name).open("r+b") as file:
        file.seek(at)
        file.write(struct.pack("<Q", cycle + 1 + left_out))


T0_NS = 1_234_567_890_123_456_789


@pytest.mark.parametrize("kind", ["stepped", "barrier"])
def test_a_half_done_tick_is_finished_with_what_had_been_written_when_it_began(peer, name, kind):
    clock, writer = peer(), peer()
    clock(f"store = Store.create({name!r}, clock={kind!r}, t0_ns={T0_NS})")
    writer(f"store = Store.attach({name!r})\nw = store.join('w', participant={kind != 'stepped'})")
    writer(f"n = w.insert('n', Count)\ncycles = w.cycles({LONG_S})")
    if kind == "stepped":
        clock("for _ in range(3): store.tick()")
    else:
        clock("store.run_clock()")
        assert writer(take(3)) == "[1, 2, 3]"
    clock.kill()
    writer("n.write(Count(1))")
    leave_half_done(name, 3, T0_NS)
    writer("n.write(Count(2))")
    with Store.attach(name) as store:
        obj = store.find("w/n", Count)
        assert (store.cycle, store.clock.alive) == (3, False)
        if kind == "stepped":
            store.take_clock()
            assert [store.tick(), store.tick()] == [4, 5]
        else:
            store.run_clock()
            assert writer(take(2)) == "[4, 5]"
        assert [shown(store.at_cycle(c), obj) for c in (3, 4, 5)] == [None, 1, 2]
        assert store.clock.takeovers == 1
        writer.kill()
    Store.create(name).close()


def test_a_half_done_tick_of_a_late_clock_is_finished_as_the_cycle_that_it_was(name, peer):
    """It was about to leave four cycles out; other processes may have seen parts of its cut."""
    with Store.create(name, clock="real", tick_ns=100 * MS) as store:
        writer = store.join("a").insert("n", Count)
        clock = peer()
        clock(f"store = Store.attach({name!r})\nclock = store.run_clock()")
        cycle = store.wait_cycle(0, LONG_S)
        clock.kill()
        writer.write(Count(1))
        leave_half_done(name, cycle, store.t0_ns, left_out=4)
        writer.write(Count(2))
        store.run_clock()
        assert store.wait_cycle(cycle, LONG_S) == cycle + 5
        assert [shown(store.at_cycle(c), writer) for c in (cycle, cycle + 4, cycle + 5)] == [None, None, 1]
        assert store.wait_cycle(cycle + 5, LONG_S) > cycle + 5
        assert shown(store.snapshot(), writer) == 2


# -- the barrier -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 3])
def test_every_participant_of_a_barrier_gets_every_cycle_exactly_once(barrier, attached, n):
    names = [f"p{k}" for k in range(n)]
    peers = [participant(attached(), component) for component in names]
    barrier.run_clock(tuple(names))
    for one in peers:
        one.send(take(300))
    for one in peers:
        assert one.answer() == str(list(range(1, 301)))
    assert barrier.clock.skipped == 0
    assert {c.name: (c.done, c.missed, c.participant) for c in barrier.components()} == dict.fromkeys(
        names, (299, 0, True)
    )


def test_a_barrier_waits_for_its_slowest_participant_and_not_for_the_dead(barrier, attached):
    fast, slow, bystander = participant(attached(), "fast"), participant(attached(), "slow"), attached()
    bystander("me = store.join('bystander')")
    barrier.run_clock(("fast", "slow"))
    fast.send(take(30))
    assert slow(take(20)) == str(list(range(1, 21)))
    assert barrier.wait_cycle(19, LONG_S) == 20
    assert barrier.wait_cycle(20, 0.05) is None  # `slow` is not done with 20
    slow.kill()
    assert fast.answer() == str(list(range(1, 31)))
    assert [(c.name, c.alive) for c in barrier.components()] == [("fast", True), ("slow", False), ("bystander", True)]


def test_a_barrier_goes_on_when_a_participant_is_killed_in_mid_run(barrier, attached):
    stays, also, dies = (participant(attached(), who) for who in ("stays", "also", "dies"))
    barrier.run_clock(("stays", "also", "dies"))
    dies.send("for cut in cycles: pass")
    for one in (stays, also):
        one.send(take(100))
    answers = [one.answer() for one in (stays, also)]
    dies.kill()
    for one in (stays, also):
        one.send(take(100))
    answers += [one.answer() for one in (stays, also)]
    assert answers == [str(list(range(1, 101)))] * 2 + [str(list(range(101, 201)))] * 2


def test_participants_of_other_rates_get_their_due_cycles_and_hold_up_no_other(barrier, attached):
    rates = {"each": (1, 0), "odd": (2, 1), "fifth": (5, 0), "late": (10, 7)}
    peers = {name: participant(attached(), name, every=every, phase=phase) for name, (every, phase) in rates.items()}
    barrier.run_clock(tuple(rates))
    due = {name: [c for c in range(1, 201) if c % every == phase] for name, (every, phase) in rates.items()}
    for name, one in peers.items():
        one.send(f"seen = {take(len(due[name]))}\nme.done(seen[-1])\nseen")
    assert {name: one.answer() for name, one in peers.items()} == {name: str(due[name]) for name in rates}
    told = {c.name: (c.every, c.phase) for c in barrier.components()}
    assert told == rates


def test_the_first_tick_waits_until_all_that_it_waits_for_have_joined(barrier, attached):
    early = participant(attached(), "early")
    barrier.run_clock(("early", "late"))
    early.send(take(3))
    assert barrier.wait_cycle(0, 0.05) is None
    late = participant(attached(), "late")
    assert late(take(3)) == "[1, 2, 3]"
    assert early.answer() == "[1, 2, 3]"


def test_who_joins_a_barrier_late_is_waited_for_from_then_on(barrier, attached):
    first = participant(attached(), "first")
    barrier.run_clock(("first",))
    first(take(10))
    second = participant(attached(), "second")
    first.send(take(10))
    assert second(take(5)) == str(list(range(11, 16)))
    assert barrier.wait_cycle(15, 0.05) is None
    second.kill()
    assert first.answer() == str(list(range(11, 21)))


def test_without_participants_a_barrier_stands_still(barrier):
    barrier.run_clock()
    barrier.join("bystander")
    assert barrier.wait_cycle(0, 0.05) is None
    assert (barrier.cycle, barrier.clock.alive) == (0, True)


def test_time_in_a_barrier_store_is_that_of_its_cycle(barrier, attached):
    one = participant(attached(), "one")
    barrier.run_clock(("one",))
    one(take(7))
    assert (barrier.cycle, barrier.now_ns) == (7, 70 * MS)
    assert one("store.now_ns, store.snapshot().t_ns") == f"({70 * MS}, {70 * MS})"


def test_a_component_that_slept_through_cycles_gets_the_latest_one(shared):
    component = shared.join("a", every=2, phase=1)
    cycles = component.cycles(LONG_S)
    shared.tick()
    assert next(cycles).cycle == 1
    for _ in range(7):
        shared.tick()
    assert next(cycles).cycle == 7  # 8 is not due
    assert shared.components()[0].done == 1
    shared.tick()
    assert next(cycles).cycle == 9
    assert shared.components()[0].done == 7


# -- real time -------------------------------------------------------------------------------------------------


def test_the_cycles_of_a_real_time_store_are_those_of_its_time(real):
    before_ns = real.now_ns
    real.run_clock()
    cycle = 0
    for _ in range(30):
        seen = real.wait_cycle(cycle, LONG_S)
        assert cycle < seen <= real.cycle
        assert before_ns <= real.at_cycle(0).t_ns < real.at_cycle(seen).t_ns <= real.now_ns
        cycle = seen
    assert real.at_cycle(cycle).t_ns - real.t0_ns == cycle * MS
    assert real.at(real.at_cycle(cycle).t_ns).cycle == cycle


def test_a_real_time_clock_counts_exactly_what_it_left_out(real, attached):
    """Its process is stopped for some ticks: cycle = ticks + skipped, whatever else the machine did."""
    ticking = attached()
    ticking("clock = store.run_clock()")
    assert real.wait_cycle(3, LONG_S) is not None
    ticking.stop()
    stopped_at = real.cycle
    while real.now_ns < real.at_cycle(stopped_at + 50).t_ns:
        assert real.wait_cycle(stopped_at, 0.01) is None
    ticking.go()
    while real.cycle < stopped_at + 50:
        assert real.wait_cycle(real.cycle, LONG_S) is not None
    ticking("clock.stop()")
    clock = real.clock
    assert clock.skipped >= 48  # it may have been stopped on its way to the next tick
    assert clock.cycle == ticks_of(clock) + clock.skipped
    assert (clock.alive, clock.takeovers, real.cycle) == (False, 0, clock.cycle)


def test_a_stalled_clock_is_noticed_and_is_no_longer_when_it_goes_on(real, attached):
    ticking = attached()
    ticking("clock = store.run_clock()")
    assert real.wait_cycle(3, LONG_S) is not None
    ticking.stop()
    while not real.clock.stalled:
        real.wait_cycle(real.cycle, 0.01)
    clock = real.clock
    assert (clock.alive, clock.late_ns > 2 * MS) == (True, True)
    ticking.go()
    while real.clock.stalled:
        real.wait_cycle(real.cycle, 0.01)
    assert real.clock.skipped > 0


def test_a_participant_that_does_not_report_has_missed_each_cycle_that_ended(real):
    """Joined before the clock began, it owes nothing for cycle 0; each tick after the first ends a due cycle."""
    real.join("silent", participant=True)
    real.join("bystander")
    clock = real.run_clock()
    assert real.wait_cycle(20, LONG_S) is not None
    clock.stop()
    missed = {c.name: c.missed for c in real.components()}
    assert missed == {"silent": ticks_of(real.clock) - 1, "bystander": 0}


def test_due_cycles_of_a_real_time_store_are_met_in_their_phase(real):
    component = real.join("a", every=5, phase=3)
    real.run_clock()
    cycles = component.cycles(LONG_S)
    cuts = [next(cycles) for _ in range(5)]
    assert [cut.cycle % 5 for cut in cuts] == [3] * 5
    assert [cut.cycle for cut in cuts] == sorted({cut.cycle for cut in cuts})
    assert all(cut.t_ns <= real.now_ns for cut in cuts)


def test_a_write_in_real_time_shows_at_an_edge_behind_it_and_at_none_before(real):
    writer = real.join("a").insert("n", Count)
    real.run_clock()
    assert real.wait_cycle(0, LONG_S) is not None
    for n in range(1, 20):
        writer.write(Count(n))
        sample = writer.latest()
        real.wait_cycle(real.cycle + 1, LONG_S)  # a tick may have been under way
        cut = real.snapshot()
        assert shown(cut, writer) == n
        assert sample.t_commit_ns <= real.now_ns
        assert shown(real.at(sample.t_commit_ns - 2 * MS), writer) != n


def test_a_wait_in_real_time_ends_by_its_time_or_by_a_write(real, attached):
    writer = real.join("a").insert("n", Count)
    real.run_clock()
    other = attached()
    other("obj = store.find('a/n')")
    other.send(f"obj.wait(0, {LONG_S})")
    other.until_it_waits()
    writer.write(Count(1))
    assert other.answer() == "1"
    asked_ns = real.now_ns
    assert writer.wait(1, 0.02) is None
    assert real.now_ns >= asked_ns + 20 * MS


# -- standbys --------------------------------------------------------------------------------------------------


def test_a_standby_takes_over_when_the_process_of_the_clock_is_killed(real, attached):
    first, second = attached(), attached()
    first("clock = store.run_clock()")
    assert real.wait_cycle(3, LONG_S) is not None
    second("clock = store.run_clock()")
    assert (real.clock.pid, real.clock.takeovers) == (first.process.pid, 0)
    first.kill()
    last = real.cycle
    assert real.wait_cycle(last + 5, LONG_S) > last
    clock = real.clock
    assert (clock.pid, clock.takeovers, clock.alive) == (second.process.pid, 1, True)
    assert real.at_cycle(clock.cycle).t_ns <= real.now_ns


def test_a_standby_of_a_barrier_goes_on_with_the_next_cycle(barrier, attached):
    one, first, second = participant(attached(), "one"), attached(), attached()
    first("clock = store.run_clock(('one',))")
    assert one(take(10)) == str(list(range(1, 11)))
    second("clock = store.run_clock(('one',))")
    first.kill()
    assert one(take(10)) == str(list(range(11, 21)))
    assert (barrier.clock.pid, barrier.clock.takeovers, barrier.clock.skipped) == (second.process.pid, 1, 0)


def test_a_clock_that_is_stopped_hands_over_to_its_standby(barrier, attached):
    one, other = participant(attached(), "one"), attached()
    with barrier.run_clock():
        assert one(take(5)) == "[1, 2, 3, 4, 5]"
        other("clock = store.run_clock()")
    assert one(take(5)) == "[6, 7, 8, 9, 10]"
    assert (barrier.clock.pid, barrier.clock.takeovers) == (other.process.pid, 1)


def test_a_clock_ends_with_its_store(name, peer):
    with Store.create(name, clock="real", tick_ns=MS) as store:
        with Store.attach(name) as ticking:
            ticking.run_clock()
            assert store.wait_cycle(2, LONG_S) is not None
            assert store.clock.alive
        assert not store.clock.alive


# -- cycles as a file descriptor ------------------------------------------------------------------------------------


def readable(edges, timeout_s=LONG_S):
    return bool(select.select([edges], [], [], timeout_s)[0])


def test_edges_are_readable_as_a_cycle_begins_and_no_more_when_they_were_cleared(shared, attached):
    clock = attached()
    with shared.edges() as edges:
        for cycle in range(1, 20):
            assert not readable(edges, 0)
            shared.tick()
            assert readable(edges)
            edges.clear()
            assert shared.cycle == cycle
        theirs = clock("edges = store.edges()\nselect = __import__('select').select\nselect([edges], [], [], 0)[0]")
        assert theirs == "[]"
        shared.tick()
        assert clock(f"[edges] == select([edges], [], [], {LONG_S})[0]") == "True"


def test_edges_that_nobody_clears_stay_readable_and_hold_up_nobody(shared):
    with shared.edges() as edges:
        for _ in range(70_000):  # more than fit into a pipe
            shared.tick()
        assert readable(edges)
        assert shared.cycle == 70_000


def test_edges_of_a_running_clock_wake_an_event_loop(real):
    real.run_clock()
    seen = []

    async def three():
        loop, enough = asyncio.get_running_loop(), asyncio.Event()
        with real.edges() as edges:

            def edge():
                edges.clear()
                seen.append(real.cycle)
                if len(seen) == 3:
                    loop.remove_reader(edges)
                    enough.set()

            loop.add_reader(edges, edge)
            await asyncio.wait_for(enough.wait(), LONG_S)

    asyncio.run(three())
    assert seen == sorted(set(seen))


def test_edges_that_were_closed_have_no_descriptor(shared):
    edges = shared.edges()
    descriptor = edges.fileno()
    edges.close()
    edges.close()
    assert edges.fileno() == -1
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(descriptor)
    with Store.create() as private, pytest.raises(NotOwner, match="private"):
        private.edges()


def test_who_waits_for_a_write_in_a_barrier_store_without_a_clock_is_told(barrier, attached):
    writer = barrier.join("a").insert("n", Count)
    with pytest.raises(ClockDead, match="a/n"):
        writer.wait(0, LONG_S)
    writer.write(Count(1))
    assert writer.wait(0, LONG_S) == 1
    with pytest.raises(ClockDead):
        next(barrier.join("b").cycles(0.02))


def test_the_clock_that_marks_the_dead_does_so_at_the_next_tick(barrier, attached):
    one, dies = participant(attached(), "one"), attached()
    dies("me = store.join('dies')")
    barrier.run_clock(("one",))
    assert one(take(5)) == "[1, 2, 3, 4, 5]"
    dies.kill()
    assert one(take(5)) == "[6, 7, 8, 9, 10]"
    assert [barrier.at_cycle(c).alive("dies") for c in (5, 7)] == [True, False]
    assert [barrier.at_cycle(c).alive("one") for c in (1, 7)] == [True, True]


def test_a_clock_is_not_taken_while_it_ticks(real):
    real.run_clock()
    assert real.wait_cycle(0, LONG_S) is not None
    with pytest.raises(InUse, match="clock"):
        real.take_clock()


# -- what the system gives -------------------------------------------------------------------------------------

ASK = """
import gc, os
from rtdb import realtime
told = realtime({})
print(repr((told.got, told.refused, bool(told), gc.isenabled(), gc.get_freeze_count() > 0,
            os.sched_getscheduler(0) == os.SCHED_FIFO, sorted(os.sched_getaffinity(0)))))
"""


def ask(arguments):
    path = os.pathsep.join([str(Path(rtdb.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", ASK.format(arguments)],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": path},
    )
    return ast.literal_eval(done.stdout)


def test_realtime_says_of_each_thing_whether_it_got_it_or_why_not():
    cpu = min(os.sched_getaffinity(0))
    got, refused, whole, collects, frozen, fifo, cpus = ask(f"1, {{{cpu}}}")
    asked = ("SCHED_FIFO 1", "locked memory", "awake CPUs", f"CPUs {cpu}", "frozen garbage")
    for thing in asked:
        lines = [line for line in (*got, *refused) if line.startswith(thing)]
        assert len(lines) == 1, thing
    assert len(got) + len(refused) == len(asked)
    assert all("\n" not in line and ": " in line for line in refused)
    assert (whole, collects, frozen) == (not refused, False, True)
    assert ("SCHED_FIFO 1" in got, cpus) == (fifo, [cpu])


@pytest.mark.parametrize(
    ("arguments", "refused_thing"),
    [
        ("1000, lock_memory=False", "SCHED_FIFO 1000"),
        ("1, {4095}", "CPUs 4095"),
        ("1, {-1}", "CPUs -1"),
        ("1, set()", "CPUs"),
    ],
)
def test_what_cannot_be_had_is_refused_in_one_line_and_the_rest_is_got(arguments, refused_thing):
    got, refused, whole, *_ = ask(arguments)
    assert [line for line in refused if line.startswith(refused_thing)]
    assert not whole
    assert "frozen garbage" in got
