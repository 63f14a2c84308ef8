"""What `fairway db top` computes from two looks at a store."""

from dataclasses import replace

from conftest import Count
from hypothesis import given
from hypothesis import strategies as st
from looks import CLOCK, FIX, INFO, NOW, S

from rtdb import Flag, Store
from rtdb.db.look import ComponentLook, Look, look
from rtdb.db.top import (
    clock_words,
    component_rows,
    end_of,
    jitter_ns,
    object_rows,
    quantile_us,
    rate,
    spread,
    store_lines,
)


def earlier(*, head: int, host_s: float, store_s: float) -> Look:
    """The look before, so many seconds ago."""
    host_ns, now_ns = NOW.host_ns - int(host_s * S), NOW.now_ns - int(store_s * S)
    return replace(NOW, host_ns=host_ns, now_ns=now_ns, objects=(replace(FIX, head=head),))


def test_the_rate_is_writes_per_second_of_store_time_and_of_host_time():
    [row] = object_rows(earlier(head=10, host_s=0.5, store_s=2.0), NOW)
    assert (row.per_store_s, row.per_host_s) == (5.0, 20.0)


def test_there_is_no_rate_before_there_are_two_looks_and_none_while_the_time_stands():
    assert object_rows(None, NOW)[0].per_host_s is None
    [row] = object_rows(earlier(head=20, host_s=1.0, store_s=0.0), NOW)
    assert (row.per_store_s, row.per_host_s) == (None, 0.0)


def test_an_object_that_took_the_name_of_a_deleted_one_has_no_rate_yet():
    before = earlier(head=500, host_s=1.0, store_s=1.0)
    [row] = object_rows(before, replace(NOW, objects=(replace(FIX, oid=2, head=3),)))
    assert row.per_store_s is None
    assert row.writes == 3


def test_a_deleted_object_has_no_row():
    assert object_rows(None, replace(NOW, objects=(replace(FIX, t_delete_ns=9 * S),))) == []


def test_the_age_is_the_time_since_the_newest_write_was_true():
    assert object_rows(None, NOW)[0].age_s == 1.0
    assert object_rows(None, replace(NOW, objects=(replace(FIX, head=0, t_data_ns=None),)))[0].age_s is None


def test_jitter_is_the_longest_interval_less_the_shortest_since_the_look_before():
    commits = (1 * S, 7 * S, 8 * S, 8 * S + S // 2, 10 * S)  # the first interval is older
    [row] = object_rows(
        earlier(head=10, host_s=4.0, store_s=4.0), replace(NOW, objects=(replace(FIX, commits_ns=commits),))
    )
    assert row.jitter_ns == S
    assert jitter_ns([1, 2]) is None


def test_rates_are_not_divided_by_nothing():
    assert rate(5, 0) is None
    assert rate(None, S) is None
    assert rate(-1, S) == -1.0


@given(st.lists(st.integers(0, 1 << 19), min_size=1), st.sampled_from([0.5, 0.99]))
def test_a_quantile_of_a_histogram_is_at_most_twice_the_one_of_the_times(times_us, q):
    bins = [0] * 20
    for us in times_us:
        bins[max(0, us.bit_length() - 1)] += 1  # as fw_bin_of
    exact = sorted(times_us)[max(0, -int(-q * len(times_us) // 1) - 1)]
    upper = quantile_us(bins, q)
    assert upper is not None
    assert exact < upper <= max(2, 2 * exact)


def test_a_spread_says_median_and_99th_percentile():
    assert spread((0,) * 20) == "-"
    assert spread([0, 0, 98, 0, 0, 2]) == "<8 us <64 us"
    assert spread([0] * 19 + [1]) == "0.5 s+ 0.5 s+"


def test_a_component_that_is_dead_is_said_to_be_whatever_it_said_last():
    health = {
        "state": "RUNNING",
        "steps": 7,
        "status": "all is well",
        "run_us": [1, *[0] * 19],
        "lateness_us": [0] * 20,
    }
    [alive] = component_rows(replace(NOW, components=(ComponentLook(info=INFO, health=health),)))
    assert (alive.state, alive.steps, alive.run, alive.late) == ("running", 7, "<2 us <2 us", "-")
    [dead] = component_rows(replace(NOW, components=(ComponentLook(info=replace(INFO, alive=False), health=health),)))
    assert (dead.state, dead.status) == ("dead", "all is well")
    owner = object_rows(None, replace(NOW, components=(ComponentLook(info=replace(INFO, alive=False)),)))[0].owner
    assert owner == "gps (dead)"


def test_the_clock_is_none_alive_stalled_or_dead():
    assert clock_words(CLOCK) == "alive (process 77)"
    assert clock_words(replace(CLOCK, late_ns=3 * S)) == "stalled by 3.00 s (process 77)"
    assert clock_words(replace(CLOCK, alive=False)) == "dead (was process 77)"
    assert clock_words(replace(CLOCK, alive=False, cycle=0)) == "none yet"


def test_the_head_says_cycle_tick_memory_and_the_clock():
    assert store_lines(NOW) == (
        "cart: cycle 100, tick 10 ms, 1.0 of 4.0 MiB used",
        "real-time clock alive (process 77), late -, skipped 0, takeovers 0",
    )


# -- looks at a real store --------------------------------------------------------------------------------------------


def test_a_look_tells_what_the_store_tells(unique):
    with Store.create(unique(), t0_ns=5) as store:
        a = store.join("a", version="2")
        n = a.insert("n", Count, every=3, phase=1)
        child = a.insert("child", Count, parent=n, flags=Flag.STATIC)
        for k in range(4):
            n.write(Count(k), t_data_ns=k)
            store.tick()
        now = look(store)
        seen = {o.name: o for o in now.living}
        assert seen["a/n"].head == 4
        assert seen["a/n"].t_data_ns == 3
        assert seen["a/n"].commits_ns == tuple(store.t0_ns + k * store.tick_ns for k in range(4))
        assert (seen["a/n"].every, seen["a/n"].phase) == (3, 1)
        assert (seen["a/child"].parent, seen["a/child"].flags) == (n.oid, Flag.STATIC)
        assert (seen["a/child"].t_data_ns, now.age_s(seen["a/child"])) == (None, None)
        assert [(c.info.name, c.info.version, c.health["state"]) for c in now.components] == [("a", "2", "RUNNING")]
        child.delete()
        assert "a/child" not in [o.name for o in look(store).living]
        assert "a/child" in [o.name for o in look(store).objects]


def test_only_the_newest_writes_of_a_ring_are_looked_at(unique):
    with Store.create(unique()) as store:
        n = store.join("a").insert("n", Count, history_s=0.04)
        for k in range(50):
            n.write(Count(k))
            store.tick()
        [seen] = [o for o in look(store).living if o.name == "a/n"]
        assert len(seen.commits_ns) == n.n_slots - 2
        assert seen.commits_ns[-1] == 49 * store.tick_ns


def test_an_object_whose_schema_is_damaged_does_not_hide_the_others(unique):
    with Store.create(unique()) as store:
        a = store.join("a")
        a.insert("n", Count)
        damaged = store.core.add_schema("{no schema")
        store.core.insert("a/x", a.index, damaged, 8, 4, 1, 0, 0, 0, 0, 0, 0, 0)
        now = look(store)
        assert "a/n" in [o.name for o in now.living]
        assert len(now.unreadable) == 1
        assert "schema text is damaged" in now.unreadable[0]


def test_a_store_ends_with_its_name_when_nobody_works_in_it(unique):
    name = unique()
    store = Store.create(name)
    with Store.attach(name) as mine:
        assert end_of(mine) is None
        store.close()
        assert end_of(mine) == (f"store {name!r} has ended, after cycle 0", 0)
        with Store.create(name):
            assert end_of(mine) == (f"store {name!r} has ended, after cycle 0", 0), "another one has that name now"


def test_a_store_that_a_crash_left_ends_when_only_tools_look_at_it(unique, peer):
    name, creator, reader = unique(), peer(), peer()
    creator(f"store = Store.create({name!r})")
    reader(f"store = Store.attach({name!r})")
    with Store.attach(name) as mine:
        creator.kill()
        assert end_of(mine) is None, "somebody may take the clock"
        reader.kill()
        assert end_of(mine) == (f"store {name!r} was left by a crash in cycle 0; nobody else is attached", 3)
    with Store.create(name):
        pass
