"""What `fairway db doctor` finds, and what it removes."""

import ast
import signal
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import Count, segment_path
from looks import CLOCK, FIX, INFO, NOW

from rtdb import Flag, Kind, Store
from rtdb.db.doctor import examine, of_folder, of_segments, of_store, owes, span, state_of
from rtdb.db.look import ComponentLook
from rtdb.db.segments import layout_of, remove, segments

ROOT = Path(__file__).parents[2]


def whats(findings) -> list[str]:
    return [finding.what for finding in findings]


# -- stores, from looks -----------------------------------------------------------------------------------------------


def test_a_healthy_store_has_no_findings():
    assert list(of_store(NOW)) == []


def test_a_store_without_a_clock_is_told_how_to_get_one():
    [found] = of_store(replace(NOW, clock=replace(CLOCK, alive=False)))
    assert str(found) == "store without a clock, store cart, cycle 100, start one: `fairway db clock cart`"
    [found] = of_store(replace(NOW, clock=replace(CLOCK, alive=False, kind=Kind.STEPPED)))
    assert "process 77 is gone" in found.todo
    assert "take_clock" in found.todo


def test_a_stalled_clock_is_named_with_its_process():
    [found] = of_store(replace(NOW, clock=replace(CLOCK, late_ns=1_500_000_000)))
    assert found.what == "stalled clock, 1.50 s late"
    assert "process 77" in found.todo


def test_a_clock_that_waits_for_components_has_not_begun():
    [found] = of_store(replace(NOW, cycle=0))
    assert found.what == "clock that has not begun"


def component(**changes) -> tuple[ComponentLook, ...]:
    return (ComponentLook(info=replace(INFO, **changes)),)


def test_a_barrier_that_does_not_open_names_who_owes():
    barrier = replace(NOW, clock=replace(CLOCK, kind=Kind.BARRIER))
    waiting = replace(barrier, components=component(participant=True, done=99))
    assert list(of_store(waiting)) == []
    [found] = of_store(waiting, stands_still=True)
    assert found.what == "barrier that does not open"
    assert "gps (process 4242)" in found.todo
    assert "done with 99" in found.todo


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"done": 99}, True),
        ({"done": 100}, False),
        ({"done": 99, "participant": False}, False),
        ({"done": 99, "alive": False}, False),
        ({"done": 97, "every": 4, "phase": 1}, False),
        ({"done": 96, "every": 4, "phase": 1}, True),
        ({"done": 0, "every": 1000, "phase": 500}, False),
    ],
)
def test_a_participant_owes_the_latest_cycle_at_which_it_was_due(changes, expected):
    assert owes(replace(INFO, **({"participant": True} | changes)), 100) is expected


def test_a_dead_component_that_holds_objects_is_found_with_them():
    [found] = of_store(replace(NOW, components=component(alive=False)))
    assert found.what == "dead component that holds 1 object"
    assert found.where == "gps in store cart (was process 4242; gps/fix)"


@pytest.mark.parametrize("flag", [Flag.STATIC, Flag.PERSISTENT, Flag.PUBLIC_WRITE])
def test_a_component_that_left_what_is_meant_to_stay_is_well(flag):
    now = replace(NOW, components=component(alive=False), objects=(replace(FIX, flags=flag),))
    assert list(of_store(now)) == []


def test_the_health_of_a_dead_component_is_no_object_that_it_holds():
    health = replace(FIX, name="gps/health", record="Health")
    assert list(of_store(replace(NOW, components=component(alive=False), objects=(health,)))) == []


def test_missed_cycles_and_refused_writes_are_findings():
    [found] = of_store(replace(NOW, components=component(missed=3)))
    assert found.what == "3 missed cycles"
    [found] = of_store(replace(NOW, objects=(replace(FIX, refused=5),)))
    assert found.what == "5 refused writes of 25"
    assert "100 ms" in found.todo


def test_memory_that_is_nearly_full_is_a_finding():
    [found] = of_store(replace(NOW, memory=(10 << 20, 1 << 19)))
    assert (found.what, found.where) == ("memory nearly full", "store cart: 9.5 of 10.0 MiB")


def test_an_unreadable_object_is_a_finding():
    assert whats(of_store(replace(NOW, unreadable=("schema text is damaged",)))) == ["object that cannot be read"]


def test_a_time_span_is_said_in_the_unit_that_suits_it():
    assert [span(seconds) for seconds in (-1, 119, 120, 7199, 7200)] == ["0 s", "119 s", "2 min", "120 min", "2 h"]


# -- segments ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def left(unique, peer) -> Iterator[str]:
    """The name of a store whose creator was killed."""
    name, creator = unique(), peer()
    creator(f"store = Store.create({name!r})")
    creator.kill()
    yield name
    segment_path(name).unlink(missing_ok=True)


def test_a_living_store_is_found_with_who_is_attached(unique, peer):
    name, reader = unique(), peer()
    with Store.create(name):
        reader(f"store = Store.attach({name!r})")
        [segment] = segments(name)
        assert (state_of(segment), segment.size) == ("living", 4 << 20)
        [process] = segment.holders  # this process is not among them
        assert process.pid == reader.process.pid
        assert "peer.py" in process.command
        assert not remove(segment)
        assert list(of_segments([segment])) == []


def test_what_a_crash_left_is_stale_and_can_be_removed(left):
    [segment] = segments(left)
    assert (state_of(segment), segment.holders) == ("stale", ())
    [found] = of_segments([segment])
    assert found.what == "stale store that a crash left"
    assert f"{segment_path(left)} (4.0 MiB, made " in found.where
    assert found.todo == f"remove it: `fairway db doctor --db {left} --clean`"
    assert remove(segment)
    assert not segment_path(left).exists()
    assert not remove(segment), "it is gone already"


def test_a_store_that_came_to_life_since_it_was_looked_at_is_not_removed(left):
    [segment] = segments(left)
    with Store.create(left) as store:
        assert not remove(segment)
        assert store.bears_name


@pytest.mark.parametrize("data", [b"", b"junk", b"\xff" * 10_000], ids=["empty", "short", "ones"])
def test_junk_is_no_store_and_can_be_removed(unique, data):
    name = unique()
    segment_path(name).write_bytes(data)
    [segment] = segments(name)
    assert (state_of(segment), segment.layout, segment.lives) == ("no store", None, False)
    assert whats(of_segments([segment])) == ["damaged store, or none"]
    assert remove(segment)


def test_half_made_stores_of_killed_processes_are_found(unique):
    name = unique()
    path = segment_path(f"{name}.4242.new")
    path.write_bytes(bytes(100))
    [segment] = segments(name)
    assert (segment.name, state_of(segment)) == (name, "half made")
    assert whats(of_segments([segment])) == ["half-made store of a killed process"]
    with path.open("rb") as held:
        assert held
        assert remove(segment), "it is open in this process only, which does not count"


def test_a_store_that_is_being_made_is_left_alone(unique, peer):
    name, maker = unique(), peer()
    path = segment_path(f"{name}.4242.new")
    maker(f"file = open({str(path)!r}, 'w')")  # as between its creation and its lock
    [segment] = segments(name)
    assert state_of(segment) == "being made"
    assert list(of_segments([segment])) == []
    assert not remove(segment)
    assert not remove(replace(segment, lives=False, holders=())), "nor if that was looked at before it was opened"
    maker.kill()
    assert remove(segment)


def test_a_living_store_of_another_layout_is_told_apart_and_never_removed(unique, peer):
    name, holder = unique(), peer()
    holder(f"store = Store.create({name!r})")
    with segment_path(name).open("r+b") as file:
        file.seek(8)
        file.write((99).to_bytes(4, "little"))
    assert layout_of(segment_path(name)) == 99
    _, [found] = examine(name, segment_path(name).parent / "none")
    assert found.what == "store of another version of Fairway (layout 99), or damaged"
    assert str(holder.process.pid) in found.where
    [segment] = segments(name)
    assert not remove(segment)
    holder.kill()
    assert remove(segment)


def test_segments_of_others_are_not_looked_at(unique):
    with Store.create(unique()):
        assert segments("no-such-store-*") == []


# -- everything -------------------------------------------------------------------------------------------------------


def test_a_store_that_runs_is_healthy(unique, tmp_path):
    name = unique()
    with Store.create(name) as store:
        store.join("a").insert("n", Count).write(Count(1))
        store.tick()
        found, findings = examine(name, tmp_path)
        assert [state_of(segment) for segment in found] == ["living"]
        assert findings == []


def test_a_killed_component_and_a_killed_clock_are_found_in_a_store_that_others_hold(unique, peer, tmp_path):
    name, creator, writer = unique(), peer(), peer()
    creator(f"store = Store.create({name!r})")
    writer(f"store = Store.attach({name!r})")
    writer("w = store.join('w').insert('n', Count)")
    with Store.attach(name):
        writer.kill()
        assert whats(examine(name, tmp_path)[1]) == ["dead component that holds 1 object"]
        creator.kill()
        assert whats(examine(name, tmp_path)[1]) == ["store without a clock", "dead component that holds 1 object"]
    assert whats(examine(name, tmp_path)[1]) == ["stale store that a crash left"]
    assert remove(segments(name)[0])


def test_a_barrier_that_a_stopped_participant_holds_up_is_found(unique, peer, tmp_path):
    name, slow = unique(), peer()
    with Store.create(name, clock="barrier") as store, store.run_clock(("slow",)):
        slow(f"store = Store.attach({name!r})")
        slow("slow = store.join('slow', participant=True)")
        assert store.wait_cycle(0, 30.0) is not None
        slow.process.send_signal(signal.SIGSTOP)
        _, [found] = examine(name, tmp_path)
        assert found.what == "barrier that does not open"
        assert f"component slow (process {slow.process.pid})" in found.todo


# -- files in the current folder --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["numpy", "queue", "random", "rtdb", "hal", "google", "statistics", "typer"])
def test_a_file_that_shadows_a_module_is_found_with_what_to_rename(tmp_path, name):
    (tmp_path / f"{name}.py").touch()
    (tmp_path / "mine.py").touch()
    [found] = of_folder(tmp_path)
    assert found.what.startswith("file that shadows ")
    assert found.what.endswith(f" {name}")
    assert found.where == str(tmp_path / f"{name}.py")
    assert found.todo == f"rename it: mv {name}.py my_{name}.py"


@pytest.mark.parametrize("name", ["mine", "follow", "gps", "sys", "time", "tests"])
def test_a_file_that_shadows_nothing_is_well(tmp_path, name):
    (tmp_path / f"{name}.py").touch()
    (tmp_path / "numpy.txt").touch()
    assert list(of_folder(tmp_path)) == []


def test_every_module_that_our_packages_import_is_known_to_the_doctor(tmp_path):
    imported = set()
    for package in ("rtdb", "hal", "sim", "autonomy", "scenarios"):
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Import):
                    imported |= {alias.name.partition(".")[0] for alias in node.names}
                elif isinstance(node, ast.ImportFrom) and node.level == 0:
                    imported.add(str(node.module).partition(".")[0])
    for name in imported:
        (tmp_path / f"{name}.py").touch()
    known = {Path(found.where).stem for found in of_folder(tmp_path)}
    assert imported - known <= {"__future__", *sys.stdlib_module_names} - {"queue", "random", "json"}
