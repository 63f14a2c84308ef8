"""`fairway db` as a user meets it: what is printed, what is refused, and how it goes on when others are killed.

What is about one process runs in this one. The rest are terminals: processes whose output is read line by line.
"""

import csv
import json
import os
import pty
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from enum import IntEnum
from pathlib import Path
from threading import Timer
from typing import Annotated

import numpy as np
import pytest
from conftest import Count, segment_path
from typer.testing import CliRunner

from rtdb import (
    AgedOut,
    ClockDead,
    Flag,
    NotOwner,
    NotYet,
    ObjectMissing,
    Record,
    RecordError,
    RtdbError,
    State,
    Store,
    StoreMissing,
)
from rtdb.cli import app
from rtdb.db.tail import Ended, writes
from rtdb.json_object import json_schema
from rtdb.records import enum8, f8, image, nested, seq

ROOT = Path(__file__).resolve().parents[2]
ENV = os.environ | {"PYTHONPATH": str(ROOT)}
HANGS_S = 200.0  # never waited out when all is well


class Gear(IntEnum):
    PARK = 0
    DRIVE = 1


class Point(Record):
    """A point."""

    x_m: Annotated[float, f8("m", "east")] = 0.0
    y_m: Annotated[float, f8("m", "north")] = 0.0


class Pose(Record):
    """Where the cart is."""

    at: Annotated[Point, nested("rear axle")] = Point()
    speed_mps: Annotated[float, f8("m/s", "speed")] = 0.0
    gear: Annotated[Gear, enum8("gear")] = Gear.PARK
    marks: Annotated[tuple[float, ...], seq("f8", 4, "m", "marks")] = ()


class Frame(Record, eq=False):
    """A picture."""

    pixels: Annotated[np.ndarray, image(4, 6, 3, "BGR")]


class Cart:
    """A store with a bit of everything, in this process."""

    def __init__(self, store: Store) -> None:
        assert store.name is not None
        self.store, self.name = store, store.name
        self.localise = store.join("localise", version="1.2")
        self.camera = store.join("camera")
        self.frame = self.camera.insert("frame", Frame, every=10)
        self.pose = self.localise.insert("pose", Pose, every=2, phase=1, n_causes=1)
        self.plan = self.localise.insert(
            "plan", json_schema(200), parent=self.pose, flags=Flag.PUBLIC_WRITE | Flag.WITH_PARENT
        )
        self.frame.write(Frame(pixels=np.zeros((2, 3, 3), np.uint8)))
        self.plan.write({"speed_mps": 1.5, "who": "fred"})
        for k in range(1, 11):
            self.pose.write(Pose(at=Point(k, 0.5), gear=Gear.DRIVE, marks=(1.0, 2.0)), causes=((self.frame.oid, 1),))
            store.tick()


@pytest.fixture
def cart(unique: Callable[[], str]) -> Iterator[Cart]:
    with Store.create(unique()) as store:
        yield Cart(store)


def run(*args: object, says: str | None = None, status: int = 0) -> str:
    """Run a command in this process; returns standard output, checks exit status and what is said on standard error."""
    result = CliRunner().invoke(app, [str(arg) for arg in args])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == status, result.output
    assert re.search(says, result.stderr) if says else result.stderr == ""
    return result.stdout


def lines(text: str) -> list[str]:
    """The lines, with runs of blanks made one."""
    return [" ".join(line.split()) for line in text.splitlines()]


# -- ls, tree ---------------------------------------------------------------------------------------------------------


def test_ls_lists_objects_with_their_flags(cart):
    out = lines(run("ls", "--db", cart.name))
    assert out[0] == f"{cart.name}: cycle 10, tick 10 ms"
    assert out[1] == "object record every phase writes age owner flags"
    assert out[2:] == [
        "camera/frame Frame 10 0 1 0.10 s camera",
        "camera/health Health 1 0 1 0.10 s camera host dependent",
        "localise/health Health 1 0 1 0.10 s localise host dependent",
        "localise/plan Json 1 0 1 0.10 s localise public write, with parent",
        "localise/pose Pose 2 1 10 0.01 s localise",
    ]


def test_ls_takes_a_pattern(cart):
    out = run("ls", "*/p*", "--db", cart.name)
    assert re.findall(r"^\w+/\w+", out, re.MULTILINE) == ["localise/plan", "localise/pose"]


def test_ls_lists_the_deleted_ones_when_asked(cart):
    cart.pose.delete()
    assert "localise/p" not in run("ls", "--db", cart.name)
    out = run("ls", "--deleted", "--db", cart.name)
    assert re.findall(r"^\w+/\w+", out, re.MULTILINE) == ["localise/plan", "localise/pose"], "the child went with it"


def test_ls_marks_what_dead_components_left(cart):
    cart.camera.leave()
    assert "camera/frame Frame 10 0 1 0.10 s camera (dead)" in lines(run("ls", "--db", cart.name))


def test_ls_shows_the_others_where_one_object_has_a_damaged_schema(cart):
    damaged = cart.store.core.add_schema("{no schema")
    cart.store.core.insert("camera/x", cart.camera.index, damaged, 8, 4, 1, 0, 0, 0, 0, 0, 0, 0)
    assert "localise/pose" in run("ls", "--db", cart.name, says="unreadable: schema text is damaged")


def test_tree_shows_components_objects_and_children(cart):
    cart.camera.leave()
    assert (
        run("tree", "--db", cart.name).rstrip()
        == f"""\
{cart.name}: cycle 10, tick 10 ms
├── camera  (dead, was process {os.getpid()})
│   ├── camera/frame  Frame  every 10 phase 0  write 1  0.10 s
│   └── camera/health  Health  every 1 phase 0  write 1  0.10 s  host dependent
└── localise  (process {os.getpid()}, 1.2)
    ├── localise/health  Health  every 1 phase 0  write 1  0.10 s  host dependent
    └── localise/pose  Pose  every 2 phase 1  write 10  0.01 s
        └── localise/plan  Json  every 1 phase 0  write 1  0.10 s  public write, with parent"""
    )


# -- get --------------------------------------------------------------------------------------------------------------


def test_get_shows_what_is_visible_with_units_causes_and_writer(cart):
    assert run("get", "localise/pose", "--db", cart.name).splitlines() == [
        "localise/pose  Pose  write 9, 0.02 s old, cycle 10",
        "  at:",
        "    x_m = 9.0 m",
        "    y_m = 0.5 m",
        "  speed_mps = 0.0 m/s",
        '  gear = "DRIVE"',
        "  marks = [1.0, 2.0] m",
        "  written by localise, from camera/frame write 1",
    ]


def test_get_shows_images_by_their_extent_and_json_as_json(cart):
    assert "\n  pixels = 2x3x3 uint8\n" in run("get", "camera/frame", "--db", cart.name)
    out = run("get", "localise/plan", "--db", cart.name)
    assert '\n  speed_mps = 1.5 m/s\n  who = "fred"\n' in out


def test_get_shows_a_part_by_a_pointer(cart):
    assert "\n  /at/x_m = 9.0 m\n" in run("get", "localise/pose#/at/x_m", "--db", cart.name)
    assert "\n  /marks/1 = 2.0 m\n" in run("get", "localise/pose#/marks/1", "--db", cart.name)
    assert "\n  /speed_mps = 1.5 m/s\n" in run("get", "localise/plan#/speed_mps", "--db", cart.name)
    with pytest.raises(RecordError, match=r"Pose\.at has no field 'x'; it has x_m, y_m"):
        run("get", "localise/pose#/at/x", "--db", cart.name)


def test_get_reads_the_past_by_cycle_time_and_write(cart):
    get = "get", "localise/pose#/at/x_m", "--db", cart.name
    assert run(*get, "--cycle", 4).startswith("localise/pose  Pose  write 3, 0.08 s old, cycle 4\n  /at/x_m = 3.0 m\n")
    assert run(*get, "--at", 0.04) == run(*get, "--cycle", 4)
    assert run(*get, "--at", -0.06) == run(*get, "--cycle", 4)
    assert run(*get, "--write", 10).startswith("localise/pose  Pose  write 10, 0.01 s old, newest 10\n")
    with pytest.raises(NotYet):
        run(*get, "--cycle", 11)
    run(*get, "--cycle", 1, "--write", 1, status=2, says="say one of --at, --cycle, --write")


def test_get_of_what_aged_out_says_from_when_on_there_is_data(cart):
    for _ in range(600):
        cart.pose.write(Pose())
        cart.store.tick()
    oldest = cart.pose.next(0)[0]
    with pytest.raises(AgedOut, match=rf"the oldest that is there is write {oldest.write}, of \d\.\d\d0 s"):
        run("get", "localise/pose", "--cycle", 3, "--db", cart.name)


def test_get_before_the_first_edge_is_status_3(cart):
    cart.localise.insert("late", Count)
    run("get", "localise/late", "--db", cart.name, status=3, says="nothing is visible yet in cycle 10")


def test_get_as_json_is_one_object_for_programs(cart):
    cart.pose.write(Pose(speed_mps=float("nan")))
    said = json.loads(run("get", "localise/pose", "--write", 11, "--json", "--db", cart.name))
    assert said["value"] == {"at": {"x_m": 0.0, "y_m": 0.0}, "speed_mps": None, "gear": "PARK", "marks": []}
    assert (said["object"], said["record"], said["write"], said["writer"]) == ("localise/pose", "Pose", 11, "localise")
    said = json.loads(run("get", "localise/pose#/at/y_m", "--json", "--db", cart.name))
    assert (said["value"], said["unit"], said["age_s"]) == (0.5, "m", pytest.approx(0.02))
    assert said["causes"] == [{"object": "camera/frame", "write": 1}]


def test_get_of_a_deleted_object_says_how_to_read_its_past(cart):
    cart.pose.delete()
    with pytest.raises(ObjectMissing, match=r"was deleted; .*--at SECONDS"):
        run("get", "localise/pose", "--db", cart.name)
    assert "write 3," in run("get", "localise/pose", "--cycle", 4, "--db", cart.name)


@pytest.mark.parametrize("command", ["get", "watch", "history", "rm", "set"])
def test_a_name_that_is_near_is_proposed(cart, command):
    rest = ["x=1"] if command == "set" else []
    with pytest.raises(ObjectMissing, match=r"no object 'localise/pos' in store .*; did you mean localise/pose\?"):
        run(command, "localise/pos", *rest, "--db", cart.name)


@pytest.mark.parametrize(
    "command", [["ls"], ["tree"], ["get", "x"], ["watch", "x"], ["top", "--once"], ["history", "x"]]
)
def test_a_store_that_is_near_is_proposed(cart, command):
    with pytest.raises(StoreMissing, match=rf"fairway drive --db {cart.name[:-1]}x`; did you mean {cart.name}\?"):
        run(*command, "--db", f"{cart.name[:-1]}x")


# -- history ----------------------------------------------------------------------------------------------------------


def test_history_is_a_table_of_all_writes_with_units(cart):
    out = lines(run("history", "localise/pose", "--field", "at.x_m", "--field", "marks.0", "--db", cart.name))
    assert out[0] == "write t_commit t_data at.x_m [m] marks.0 [m]"
    assert out[1:-1] == [f"{k} {(k - 1) / 100:.3f} s {(k - 1) / 100:.3f} s {k}.0 1.0" for k in range(1, 11)]
    assert out[-1] == "localise/pose: 10 writes"


def test_history_goes_back_as_far_as_asked(cart):
    out = lines(run("history", "localise/pose", "--last", 0.035, "--db", cart.name))
    assert [line.split()[0] for line in out[1:-1]] == ["8", "9", "10"]
    assert lines(run("history", "localise/pose", "--last", 0, "--db", cart.name))[-1] == "localise/pose: 0 writes"


def test_history_counts_what_aged_out(cart):
    for _ in range(600):
        cart.pose.write(Pose())
        cart.store.tick()
    kept = cart.pose.n_slots - 2 + 1
    assert lines(run("history", "localise/pose", "--db", cart.name))[-1].startswith(f"localise/pose: {kept} writes, ")
    assert f"{610 - kept} aged out" in run("history", "localise/pose", "--db", cart.name)


def test_history_as_csv_is_exact_and_readable_by_programs(cart, tmp_path):
    exact = 0.1 + 0.2
    cart.pose.write(Pose(speed_mps=exact, at=Point(1e-300, -0.0)), t_data_ns=95_000_123)
    file = tmp_path / "pose.csv"
    assert run("history", "localise/pose", "--csv", file, "--db", cart.name) == ""
    assert run("history", "localise/pose", "--csv", "-", "--db", cart.name) == file.read_text()
    *_, last = rows = list(csv.DictReader(file.read_text().splitlines()))
    assert len(rows) == 11
    assert (float(last["speed_mps"]), float(last["at.x_m"]), last["at.y_m"]) == (exact, 1e-300, "-0.0")
    assert (last["write"], last["t_data_ns"], last["gear"], last["marks"]) == ("11", "95000123", "PARK", "[]")


def test_history_of_a_json_object_has_the_keys_that_were_ever_there(cart):
    cart.plan.write({"why": {"a": 1}, "who": "x, y"})
    out = run("history", "localise/plan", "--csv", "-", "--db", cart.name)
    assert list(csv.reader(out.splitlines())) == [
        ["write", "t_commit_ns", "t_data_ns", "speed_mps", "who", "why.a"],
        ["1", "0", "0", "1.5", "fred", "null"],
        ["2", "100000000", "100000000", "null", "x, y", "1"],
    ]


def test_history_of_a_deleted_object_is_still_there(cart):
    cart.pose.delete()
    for _ in range(5):
        cart.store.tick()
    assert "localise/pose: 10 writes" in run("history", "localise/pose", "--db", cart.name)
    assert "localise/pose: 0 writes" in run("history", "localise/pose", "--last", 0.04, "--db", cart.name)


def test_history_of_a_field_that_is_not_there_is_refused(cart):
    with pytest.raises(RecordError, match=r"Pose has no field 'sped_mps'; did you mean speed_mps\?"):
        run("history", "localise/pose", "--field", "sped_mps", "--db", cart.name)


# -- set --------------------------------------------------------------------------------------------------------------


def test_set_writes_what_everybody_may_write(cart):
    out = run("set", "localise/plan", "speed_mps=2", "--db", cart.name)
    assert out == "localise/plan: write 2; it shows at the next edge, every 10 ms\n"
    assert cart.plan.latest().value == {"speed_mps": 2, "who": "fred"}


def test_set_is_refused_while_the_owner_lives_by_name_and_process(cart):
    with pytest.raises(NotOwner, match=rf"component localise \(process {os.getpid()}\) owns it and lives"):
        run("set", "localise/pose", "speed_mps=2", "--db", cart.name)
    assert cart.pose.head == 10


def test_set_stands_in_for_a_component_that_is_gone(cart):
    cart.localise.leave()
    run("set", "localise/pose", "speed_mps=2 m/s", "gear=PARK", "at.y_m=7", "--db", cart.name)
    newest = cart.pose.latest()
    assert newest.value == Pose(at=Point(10.0, 7.0), speed_mps=2.0, gear=Gear.PARK, marks=(1.0, 2.0))
    assert (newest.write, newest.t_commit_ns) == (11, cart.store.now_ns)
    [info] = [c for c in cart.store.components() if c.name == "localise"]
    assert (info.alive, info.version) == (False, "1.2"), (
        "it left again, and the version is that of the one that is gone"
    )
    again = cart.store.join("localise").insert("pose", Pose, every=2, phase=1, n_causes=1)
    assert again.write(Pose()) == 12, "a successor takes it over"


@pytest.mark.parametrize("assignment", ["speed_mps=fast", "speed_mps=1 km/h", "gear=DRIV", "sped_mps=1"])
def test_set_of_what_does_not_fit_changes_nothing(cart, assignment):
    cart.localise.leave()
    with pytest.raises(RecordError, match=r"cannot set localise/pose: Pose"):
        run("set", "localise/pose", assignment, "--db", cart.name)
    assert cart.pose.head == 10


def test_set_of_a_value_from_the_future_does_not_go_back(cart):
    cart.plan.write({"n": 1}, t_data_ns=cart.store.now_ns + 10**9)
    run("set", "localise/plan", "n=2", "--db", cart.name)
    assert cart.plan.latest().t_data_ns == cart.store.now_ns + 10**9


# -- rm ---------------------------------------------------------------------------------------------------------------


def test_rm_is_refused_while_the_owner_lives(cart):
    with pytest.raises(NotOwner, match=rf"cannot delete localise/pose: .*\(process {os.getpid()}\) owns it and lives"):
        run("rm", "localise/pose", "--yes", "--db", cart.name)


def test_rm_shows_what_goes_with_it_and_asks(cart):
    cart.localise.leave()
    result = CliRunner().invoke(app, ["rm", "localise/pose", "--db", cart.name], input="n\n")
    assert result.exit_code == 1
    assert re.findall(r"^localise/\w+", result.stdout, re.MULTILINE) == ["localise/pose", "localise/plan"]
    assert cart.pose.t_delete_ns is None
    result = CliRunner().invoke(app, ["rm", "localise/pose", "--db", cart.name], input="y\n")
    assert (result.exit_code, result.stdout.splitlines()[-1]) == (0, "deleted")
    assert cart.pose.t_delete_ns is not None
    assert cart.plan.t_delete_ns is not None


# -- top --------------------------------------------------------------------------------------------------------------


def test_top_shows_one_round(cart):
    cart.localise.status("turning left", State.WARNING)
    cart.store.tick()
    out = lines(run("top", "--once", "--period", 0, "--db", cart.name))
    assert out[:4] == [
        f"{cart.name}: cycle 11, tick 10 ms, 0.1 of 3.7 MiB used",
        f"stepped clock alive (process {os.getpid()}), takeovers 0",
        "",
        "component pid state steps missed run p50 p99 late p50 p99 version status",
    ]
    assert f"localise {os.getpid()} warning 0 0 - - 1.2 turning left" in out
    assert "object record edge writes 1/s 1/s host jitter age refused owner" in out
    assert any(re.fullmatch(r"localise/pose Pose 2/1 10 - 0\.0 - 0\.02 s 0 localise", line) for line in out)


def test_top_is_as_wide_as_it_is_without_a_terminal(cart):
    for _ in range(2):
        out = run("top", "--n", 2, "--period", 0, "--db", cart.name)
        assert out.count("component ") == 2
        assert max(map(len, out.splitlines())) <= 120


def test_texts_of_others_are_no_markup(cart):
    cart.localise.status("[red]x[/red] [bold")
    assert "[red]x[/red] [bold" in run("top", "--once", "--period", 0, "--db", cart.name)


def test_help_of_every_command_has_examples():
    for command in ("ls", "tree", "get", "watch", "history", "top", "set", "rm", "doctor", "clock"):
        assert f"fairway db {command}" in run(command, "--help")


# -- terminals --------------------------------------------------------------------------------------------------------


class Terminal:
    """A command in a process of its own, whose output is read as it comes. One that hangs is ended."""

    def __init__(self, *args: object) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "scenarios", "db", *map(str, args)],
            env=ENV, cwd="/", stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        self.guard = Timer(HANGS_S, self.process.kill)
        self.guard.start()

    def until(self, pattern: str) -> re.Match[str]:
        """Read up to the first line in which a pattern is found."""
        read = []
        for line in self.process.stdout:
            read.append(line)
            if found := re.search(pattern, line):
                return found
        pytest.fail(f"it ended with {self.process.wait()}; {pattern!r} is not in\n{''.join(read[-50:])}")

    def ended(self) -> tuple[int, list[str]]:
        """Wait for the end; returns exit status and the rest of the output."""
        rest = self.process.stdout.read()
        return self.process.wait(), rest.splitlines()

    def signal(self, number: int) -> None:
        self.process.send_signal(number)

    def close(self) -> None:
        self.guard.cancel()
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()


@pytest.fixture
def terminal() -> Iterator[Callable[..., Terminal]]:
    """Starts commands, and ends them."""
    started: list[Terminal] = []

    def start(*args: object) -> Terminal:
        started.append(Terminal(*args))
        return started[-1]

    yield start
    for one in started:
        one.close()


WRITER = """
w = Store.attach({name!r}).join('writer', participant=True)
n = w.insert('n', Count, history_s=60.0)
for cut in w.cycles(60.0):
    n.write(Count(n.head + 1))
    if n.head >= {last}:
        break
"""


def test_a_writer_that_is_killed_and_restarted_stops_neither_reader_nor_top(unique, peer, terminal):
    """Three terminals: a writer, a reader in another process, and top."""
    name = unique()
    with Store.create(name, clock="real", tick_ns=2_000_000) as store, store.run_clock():
        first = peer()
        first.send(WRITER.format(name=name, last=10**9))
        reader = terminal("watch", "writer/n", "--wait", 60, "--db", name)
        top = terminal("top", "--period", 0.05, "--db", name)
        newest = int(reader.until(r"write (\d+) .* n=\1\b")[1])
        top.until(rf"^writer +{first.process.pid} +running ")
        first.kill()
        top.until(rf"^writer +{first.process.pid} +dead ")
        top.until(r"^writer/n .* writer \(dead\)")

        second = peer()
        second.send(WRITER.format(name=name, last=10**9))
        top.until(rf"^writer +{second.process.pid} +running ")
        top.until(r"^writer/n .* writer *$")
        killed_at = store.find("writer/n").head
        seen = newest
        while seen <= killed_at:
            write, n = map(int, reader.until(r"write (\d+) .* n=(\d+)").groups())
            assert (write, n) == (seen + 1, seen + 1), "nothing is lost, and nothing comes twice"
            seen = write
        assert reader.process.poll() is None
        assert top.process.poll() is None
        second.kill()


@pytest.mark.parametrize("kind", ["real", "barrier"])
def test_reader_and_top_go_on_when_the_clock_is_killed_and_another_takes_over(unique, peer, terminal, kind):
    name, creator = unique(), peer()
    creator(f"store = Store.create({name!r}, clock={kind!r})")
    clock = terminal("clock", name, "--wait-for", "writer")
    clock.until("^waiting for writer$")
    writer = peer()
    writer.send(WRITER.format(name=name, last=10**9))
    clock.until(rf"^ticking store '{name}' every 10 ms$")
    standby = terminal("clock", name)
    standby.until(rf"^standby: process {clock.process.pid} ticks store '{name}'$")
    top = terminal("top", "--period", 0.05, "--db", name)
    top.until(rf"clock alive \(process {clock.process.pid}\), .*takeovers 0")
    reader = terminal("watch", "writer/n", "--db", name)
    before = int(reader.until(r"write (\d+)")[1])

    clock.signal(signal.SIGKILL)
    standby.until(rf"^ticking store '{name}' every 10 ms \(took over from process {clock.process.pid}\)$")
    killed_at = creator("store.find('writer/n').head")
    top.until(rf"clock alive \(process {standby.process.pid}\), .*takeovers 1")
    while before <= int(killed_at):
        before = int(reader.until(r"write (\d+)")[1])
    reader.close()

    standby.signal(signal.SIGINT)
    assert standby.ended() == (130, ["interrupted"])
    top.until(rf"clock dead \(was process {standby.process.pid}\)")
    writer.kill()
    creator.kill()
    status, rest = top.ended()
    assert status == 3
    assert re.fullmatch(rf"store '{name}' was left by a crash in cycle \d+; nobody else is attached", rest[-1])
    segment_path(name).unlink()


def test_tools_do_not_keep_each_other_in_a_store_that_a_crash_left(unique, peer, terminal):
    name, creator = unique(), peer()
    creator(f"store = Store.create({name!r})")
    creator("n = store.join('w').insert('n', Count)")
    top, reader = terminal("top", "--period", 0.05, "--db", name), terminal("watch", "w/n", "--db", name)
    top.until("^stepped clock alive")
    wait_until_attached(name, reader)
    creator.kill()
    for tool in (top, reader):
        status, rest = tool.ended()
        assert (status, rest[-1]) == (3, f"store '{name}' was left by a crash in cycle 0; nobody else is attached")
    with Store.create(name):
        pass  # the name is free


def test_top_ends_with_the_store(unique, terminal):
    name = unique()
    with Store.create(name):
        top = terminal("top", "--period", 0.05, "--db", name)
        top.until("^stepped clock alive")
    status, rest = top.ended()
    assert (status, rest[-1]) == (0, f"store '{name}' has ended, after cycle 0")


def test_top_on_a_terminal_is_live_and_ends_with_ctrl_c(unique):
    name = unique()
    with Store.create(name) as store:
        store.join("gps")
        pid, screen = pty.fork()
        if pid == 0:
            environ = ENV | {"TERM": "xterm", "COLUMNS": "100", "LINES": "40"}
            command = [sys.executable, "-m", "scenarios", "db", "top", "--period", "0.05", "--db", name]
            os.execve(sys.executable, command, environ)
        seen = b""
        while seen.count(b"stepped clock") < 3:
            seen += os.read(screen, 4096)
        os.write(screen, b"\x03")
        while True:
            try:
                seen += os.read(screen, 4096)
            except OSError:  # the other end is closed
                break
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 130
        os.close(screen)
        assert b"\x1b[" in seen, "lines are written over"
        assert b"gps" in seen
        assert b"Traceback" not in seen


def test_watch_prints_each_write_and_how_many_were_lost(cart, terminal):
    watch = terminal("watch", "localise/plan", "--n", 2, "--db", cart.name)
    wait_until_attached(cart.name, watch)
    watch.signal(signal.SIGSTOP)  # while it is stopped, the ring comes around
    for k in range(cart.plan.n_slots * 3):
        cart.plan.write({"k": k})
        cart.store.tick()
    watch.signal(signal.SIGCONT)
    first, second = (watch.until(r"write (\d+)  \d+\.\d+ s  k=(\d+)(?:  \((\d+) lost before\))?$") for _ in range(2))
    assert [int(found[1]) - int(found[2]) for found in (first, second)] == [2, 2]
    assert int(first[1]) - 1 - int(first[3]) == 1, "write 1 was there before"
    assert second[3] is None
    assert watch.ended() == (0, [])


def wait_until_attached(name: str, terminal: Terminal) -> None:
    """Return when a process sleeps in a wait of the store."""
    path = Path(f"/proc/{terminal.process.pid}")
    while name not in (path / "maps").read_text() or (path / "syscall").read_text().split()[0] != "202":  # futex
        os.sched_yield()
        assert terminal.process.poll() is None, terminal.ended()


@pytest.mark.parametrize("again", [False, True])
def test_watch_ends_when_the_object_is_deleted(cart, terminal, again):
    watch = terminal("watch", "localise/plan", "--db", cart.name)
    wait_until_attached(cart.name, watch)
    watch.signal(signal.SIGSTOP)
    cart.plan.delete()
    if again:
        cart.localise.insert("plan", Count)
    watch.signal(signal.SIGCONT)
    end = "; there is a new one of that name" if again else ""
    assert watch.ended() == (0, [f"localise/plan was deleted, after write 1{end}"])


def test_watch_ends_after_a_timeout_of_the_store(cart, terminal):
    watch = terminal("watch", "localise/plan", "--timeout", 0.5, "--db", cart.name)
    wait_until_attached(cart.name, watch)
    while watch.process.poll() is None:
        cart.store.tick()
    assert watch.ended() == (3, ["localise/plan: no write for 0.5 s; the newest is 1"])


def test_watch_ends_with_ctrl_c_and_with_the_store(cart, terminal):
    first, second = (terminal("watch", "localise/plan", "--db", cart.name) for _ in range(2))
    wait_until_attached(cart.name, first)
    wait_until_attached(cart.name, second)
    first.signal(signal.SIGINT)
    while first.process.poll() is None:
        cart.store.tick()
    assert first.ended() == (130, ["interrupted"])
    cycle = cart.store.cycle
    cart.store.close()
    assert second.ended() == (0, [f"store '{cart.name}' has ended, after cycle {cycle}"])


def test_clock_of_a_stepped_store_is_refused(cart):
    with pytest.raises(NotOwner, match=rf"is stepped: process {os.getpid()}, which drives it, ticks it"):
        run("clock", cart.name)


def test_clock_ticks_a_barrier_and_ends_with_the_store(unique, terminal):
    name = unique()
    with Store.create(name, clock="barrier") as store:
        clock = terminal("clock", name, "--wait-for", "a, b")
        clock.until("^waiting for a, b$")
        a, b = store.join("a", participant=True), store.join("b", participant=True)
        assert store.wait_cycle(0, 60.0) == 1
        for cycle in (1, 2):
            a.done(cycle)
            assert store.cycle == cycle, "b is not done"
            b.done(cycle)
            assert store.wait_cycle(cycle, 60.0) == cycle + 1
        clock.until("^ticking ")
    assert clock.ended() == (0, [f"store '{name}' has ended, after cycle 3"])


def test_clock_says_what_it_got_of_real_time_and_what_not(unique, terminal):
    name = unique()
    with Store.create(name, clock="real"):
        clock = terminal("clock", name, "--realtime")
        clock.until("^got: .*frozen garbage")
        clock.until("^(refused: .*|ticking .*)$")


# -- doctor -----------------------------------------------------------------------------------------------------------


def test_doctor_of_a_healthy_store_is_status_0(cart, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    out = lines(run("doctor", "--db", cart.name))
    assert out == [
        "segment state size attached",
        f"{segment_path(cart.name).name} living 4.0 MiB -",
        "healthy",
    ]


def test_doctor_lists_what_is_wrong_and_cleans_up_what_nobody_holds(cart, unique, peer, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "queue.py").touch()
    creator, name = peer(), f"{cart.name}-left"
    creator(f"store = Store.create({name!r})")
    creator.kill()
    cart.localise.leave()
    out = run("doctor", "--db", f"{cart.name}*", status=1).splitlines()
    assert out[-1] == "3 findings"
    assert [line.partition(",")[0] for line in out[-4:-1]] == [
        "stale store that a crash left",
        "dead component that holds 2 objects",
        "file that shadows Python's module queue",
    ]
    out = run("doctor", "--db", f"{cart.name}*", "--clean", status=1).splitlines()
    assert out[0] == f"removed {segment_path(name)}"
    assert out[-1] == "2 findings"
    assert not segment_path(name).exists()
    assert segment_path(cart.name).exists()
    assert cart.store.tick() == 11


@pytest.mark.parametrize("command", [["ls"], ["top", "--once"], ["doctor", "--clean"], ["clock"]])
def test_what_is_wrong_is_one_line_with_status_2(unique, terminal, command):
    where = [unique()] if command == ["clock"] else ["--db", unique()]
    status, said = terminal(*command, *where).ended()
    if command[0] == "doctor":
        assert (status, said) == (0, ["healthy"])
    else:
        assert status == 2
        assert len(said) == 1
        assert where[-1] in said[0]


def test_every_error_of_a_command_is_an_error_of_the_store(cart):
    for command in (["get", "a b"], ["set", "localise/plan", "x"], ["history", "localise/pose", "--field", "x"]):
        with pytest.raises(RtdbError):
            run(*command, "--db", cart.name)


@pytest.mark.parametrize("error", [AgedOut("overtaken"), ClockDead("nobody ticks")])
def test_a_reader_goes_on_when_it_is_overtaken_while_it_copies_and_when_the_clock_changes(cart, monkeypatch, error):
    asked = []

    def updates(after, timeout_s):
        asked.append(after)
        if len(asked) == 1:
            yield cart.pose.read(9), 3
            raise error
        yield cart.pose.read(10), 0
        cart.pose.delete()

    monkeypatch.setattr(cart.pose, "updates", updates)
    read = writes(cart.store, cart.pose, None)
    assert [(sample.write, lost) for sample, lost in (next(read), next(read))] == [(9, 3), (10, 0)]
    assert asked == [10, 9], "it asks for what comes after the newest that it has seen"
    with pytest.raises(Ended, match="localise/pose was deleted, after write 10"):
        next(read)
