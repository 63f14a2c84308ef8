"""What a module does wrong harms only itself: every way to misbehave, in process, in a process of its own, in a drive.

The modules of MISBEHAVING really do it, after `after` good steps. In each place the host says why in one line and
writes the safe values; in a drive the cart stands.
"""

import dataclasses
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from steady import real_time

from autonomy import contain
from autonomy.host import Host
from autonomy.module import HOLD_STEPS
from autonomy.process import spawn
from autonomy.wiring import Stack, Wire, load_stack
from hal.signals import CartTruth, DriveCommand, FollowState, ModuleState, ModuleStatus, ModuleTiming, Pose
from rtdb import Store
from rtdb.recorder import Recorder
from rtdb.recording import Recording
from scenarios import run
from scenarios.judge import Verdict, judge
from scenarios.run import Drive, Setup, drive
from scenarios.scenario import STACKS, Scenario, load_scenario

ROOT = Path(__file__).resolve().parents[2]
ENV = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "200"}
TICK_NS = 10_000_000
SAFE = DriveCommand(speed_mps=0.0, steer_rad=0.125)
MANY = 1_000_000  # steps: never

MISBEHAVING = '''\
"""Modules that misbehave after some good steps."""

import math
import os
import signal
import time

from autonomy import Input, Module, Output, Param
from autonomy.localise import Localise
from hal.signals import Course, DriveCommand, FollowState, Pose, Site


class Good(Module):
    """Drives straight on."""

    site = Input(Site, static=True, optional=True)
    course = Input(Course, static=True, optional=True)
    pose = Input(Pose, max_age_s=0.25)
    drive = Output(DriveCommand, safe=DriveCommand(steer_rad=0.125))
    state = Output(FollowState, safe=FollowState(waypoint=99))
    after = Param(75)

    def reset(self):
        self.n = 0
        self.hoard = []

    def step(self):
        self.n += 1
        self.drive = DriveCommand(speed_mps=2.0)
        self.state = FollowState(waypoint=self.n)
        if self.n > self.after:
            self.misbehave()

    def misbehave(self):
        pass


class Raises(Good):
    def misbehave(self):
        raise ValueError("lost my way")


class RaisesTwice(Good):
    def misbehave(self):
        class Mine(Exception):
            def __str__(self):
                raise RuntimeError("and this is wrong, too")

        raise Mine


class RaisesNoException(Good):
    def misbehave(self):
        class Mine(BaseException):
            pass

        raise Mine("in two\\nlines")


class Exits(Good):
    def misbehave(self):
        raise SystemExit(0)


class Nan(Good):
    def misbehave(self):
        self.drive = DriveCommand(speed_mps=math.nan)


class OutOfRange(Good):
    def misbehave(self):
        self.drive = DriveCommand(speed_mps=9.0)


class OutOfItsOwnRange(Good):
    drive = Output(DriveCommand, safe=DriveCommand(steer_rad=0.125), narrow={"speed_mps": (0.0, 2.0)})

    def misbehave(self):
        self.drive = DriveCommand(speed_mps=2.5)


class WrongShape(Good):
    guess = Output(Pose, safe=Pose())

    def step(self):
        self.guess = Pose()
        super().step()

    def misbehave(self):
        self.guess = Pose(covariance=(0.0,) * 4)


class NanInAnArray(WrongShape):
    def misbehave(self):
        self.guess = Pose(covariance=(0.0,) * 8 + (math.nan,))


class WrongRecord(Good):
    def misbehave(self):
        self.drive = FollowState()


class Forgets(Good):
    def step(self):
        super().step()
        if self.n > self.after:
            self._out.clear()


class Misspells(Good):
    def misbehave(self):
        self.drvie = DriveCommand()


class Recurses(Good):
    def misbehave(self):
        self.misbehave()


class Loops(Good):
    def misbehave(self):
        while True:
            try:
                sum(range(1000))
            except Exception:
                pass


class Sleeps(Good):
    def misbehave(self):
        time.sleep(1e9)


class Crashes(Good):
    def misbehave(self):
        os.kill(os.getpid(), signal.SIGSEGV)


class Leaves(Good):
    def misbehave(self):
        os._exit(7)


class Gathers(Good):
    def misbehave(self):
        self.hoard.append(bytearray(8 << 20))


class WantsAllAtOnce(Good):
    def misbehave(self):
        self.hoard = [0.0] * (1 << 40)


class Chatters(Good):
    def misbehave(self):
        if self.n <= self.after + 50:
            print("x" * 99_999)


class Shows(Good):
    """Shows what nobody can show, and is none the worse for it."""

    def misbehave(self):
        class Shy:
            tolist = property(lambda self: 1 / 0)

            def __repr__(self):
                raise RuntimeError("not me")

        ring = []
        ring.append(ring)
        for name, value in {
            "shy": Shy(), "half": "\\ud800", "\\ud800": 1, "much": "ä" * 5000, "ring": ring, '"' * 30: "y" * 3000,
            "nan": math.nan, "large": 1 << 80, "class": Shy, "speed": 2.0,
        }.items():
            self.show(name, value)
        self.show(7, 1)


class Random(Good):
    """Weaves as its random numbers say, and shows where."""

    def step(self):
        self.n += 1
        steer_rad = 0.02 * float(self.rng.normal())
        self.show("steer_rad", steer_rad)
        self.show("ahead", [(self.pose.x_m, self.pose.y_m), (self.pose.x_m + 5.0, self.pose.y_m)])
        self.drive = DriveCommand(2.0, steer_rad)
        self.state = FollowState(waypoint=self.n)


class Vanishes(Localise):
    """Its process ends after a while."""

    def step(self):
        super().step()
        self._n = getattr(self, "_n", 0) + 1
        if self._n > 75:
            os._exit(7)


class Slow(Good):
    def misbehave(self):
        time.sleep(0.06)
'''

REASONS = {
    "Raises": r"ValueError: lost my way \(bad\.py:\d+\)",
    "RaisesTwice": "Mine: it cannot say what",
    "RaisesNoException": "Mine: in two lines",
    "Exits": "SystemExit: 0",
    "Nan": r"output drive is not finite: DriveCommand\(speed_mps=nan",
    "OutOfRange": "output drive speed_mps=9 is outside -1.5 to 5.5 m/s",
    "OutOfItsOwnRange": "output drive speed_mps=2.5 is outside 0 to 2 m/s",
    "WrongShape": "covariance",
    "NanInAnArray": r"output guess is not finite: covariance = \(0.0, ",
    "WrongRecord": "output drive is a DriveCommand, got FollowState",
    "Forgets": "output drive was not assigned in this step",
    "Misspells": "self.drvie is not an output; Misspells declares drive, state",
    "Recurses": r"RecursionError: maximum recursion depth exceeded \(bad\.py:\d+\)",
    "Loops": r"StepHung: the step did not end within 1 s of CPU time, or 60 s \(bad\.py:\d+\)",
}


@pytest.fixture(scope="module")
def bad(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("modules") / "bad.py"
    file.write_text(MISBEHAVING)
    return file


def name_of(purpose: str) -> str:
    return f"test-contain-{os.getpid()}-{purpose}"


def good_line(reason: str) -> None:
    assert reason
    assert "\n" not in reason
    assert len(reason.encode()) <= 160


# -- on a store that the test ticks ----------------------------------------------------------------------------------


class Rig:
    """A module and its input on a store, in this process or in one of its own. Use it in a `with`."""

    def __init__(self, file: Path, cls: str, *, apart: bool, after: int = 3, faults: Path | None = None, **wire: Any):
        self.wire = Wire("bad", f"{file}:{cls}", 1, 0, {"pose": "source/pose"}, {"after": after}, **wire)
        self.store = Store.create(name_of(cls) if apart else None, tick_ns=TICK_NS, deterministic=True)
        self.pose = self.store.join("source").insert("pose", Pose)
        self.child: subprocess.Popen[str] | None = None
        self.host: Host | None = None
        if apart:
            assert self.store.name is not None
            self.child = spawn(self.store.name, (self.wire,), 0, None, faults)
            self.store.find("bad/status", timeout_s=60.0)
        else:
            self.host = Host(self.store, self.wire, 0, faults=faults)
            self.host.connect()

    def tick(self, pose: bool = True) -> int:
        if pose:
            self.pose.write(Pose(x_m=1.0))
        cycle = self.store.tick()
        if self.host is not None:
            self.host.step(cycle)
        else:
            assert self.store.wait_done(cycle, 60.0), "it hangs"
        return cycle

    def ticks(self, n: int) -> None:
        for _ in range(n):
            self.tick()

    def value(self, name: str, cls: type[Any]) -> Any:
        sample = self.store.find(f"bad/{name}", cls).visible(self.store.cycle)
        return None if sample is None else sample.value

    @property
    def status(self) -> ModuleStatus:
        found: ModuleStatus = self.value("status", ModuleStatus)
        return found

    def __enter__(self) -> "Rig":
        return self

    def __exit__(self, *_: object) -> None:
        if self.child is not None:
            assert self.child.stdin is not None
            self.child.stdin.close()
            self.child.kill()
            self.child.wait()
        self.store.close()


@pytest.mark.parametrize("apart", [False, True], ids=["in process", "as process"])
@pytest.mark.parametrize("cls", REASONS)
def test_module_that_misbehaves_is_stopped_and_safe_values_are_written(bad: Path, cls: str, apart: bool) -> None:
    budget = {"budget_ms": 10.0} if cls == "Loops" else {}
    with Rig(bad, cls, apart=apart, **budget) as rig:
        rig.ticks(5)
        assert rig.value("drive", DriveCommand) == DriveCommand(speed_mps=2.0), "held"
        assert rig.value("state", FollowState).waypoint == 3, "nothing of the step that went wrong is written"
        rig.ticks(HOLD_STEPS + 1)
        assert rig.status.state is ModuleState.FAULT
        good_line(rig.status.reason)
        assert re.match(rf"cycle 4: .*{REASONS[cls]}", rig.status.reason), rig.status.reason
        assert rig.value("drive", DriveCommand) == SAFE
        assert rig.value("state", FollowState).waypoint == 99
        rig.ticks(3)
        assert rig.status.steps == 3, "it is not called again"


@pytest.mark.parametrize("apart", [False, True], ids=["in process", "as process"])
def test_stale_input_is_said_and_the_module_goes_on_with_a_fresh_one(bad: Path, apart: bool) -> None:
    with Rig(bad, "Good", apart=apart, after=MANY) as rig:
        rig.ticks(3)
        for _ in range(30):
            rig.tick(pose=False)
        assert rig.status.state is ModuleState.STALE
        assert re.match(r"input pose \(source/pose\) is 0\.2\d s old, at most 0\.25 s", rig.status.reason)
        assert rig.value("drive", DriveCommand) == SAFE
        rig.ticks(2)
        assert rig.status.state is ModuleState.RUNNING
        assert rig.value("drive", DriveCommand) == DriveCommand(speed_mps=2.0)


def test_what_a_module_shows_never_harms_it(bad: Path) -> None:
    with Rig(bad, "Shows", apart=False) as rig:
        rig.ticks(6)
        assert rig.status.state is ModuleState.RUNNING
        shown = rig.store.find("bad/show").visible(rig.store.cycle)
        assert shown is not None
        assert shown.value["speed"] == 2.0
        assert 1 in shown.value.values(), "a number as a name"
        assert shown.value["shy"] == "cannot be shown: ZeroDivisionError"
        assert shown.value["half"] == "?"
        assert shown.value["nan"] == "nan"
        assert shown.value["left_out"]


@pytest.mark.parametrize("apart", [False, True], ids=["in process", "as process"])
def test_flood_of_prints_ends_after_a_megabyte(bad: Path, capfd: pytest.CaptureFixture[str], apart: bool) -> None:
    with Rig(bad, "Chatters", apart=apart) as rig:
        rig.ticks(60)
        print("others print on")
        assert rig.status.state is ModuleState.RUNNING
    out = capfd.readouterr().out
    buffered = 100_000 if apart else 0  # what the process had not yet flushed when it was ended
    assert contain.PRINTS_BYTES - buffered <= len(out) < contain.PRINTS_BYTES + 1000
    assert "others print on\n" in out
    assert apart or "[bad has printed 1 MB: what else it prints is dropped]" in out


@pytest.mark.parametrize(("cls", "steps"), [("Gathers", 60), ("WantsAllAtOnce", 8)])
def test_hunger_for_memory_is_a_fault_of_its_process_alone(bad: Path, tmp_path: Path, cls: str, steps: int) -> None:
    with Rig(bad, cls, apart=True, memory_mb=200, faults=tmp_path) as rig:
        rig.ticks(steps)
        assert rig.status.state is ModuleState.FAULT
        good_line(rig.status.reason)
        assert "MemoryError" in rig.status.reason
        assert "bad.py:" in rig.status.reason
        assert rig.value("drive", DriveCommand) == SAFE
        assert rig.child is not None
        assert rig.child.poll() is None, "the host lives"


@pytest.mark.parametrize(("cls", "code"), [("Crashes", -11), ("Leaves", 7)])
def test_crash_ends_its_process_and_the_clock_goes_on(bad: Path, cls: str, code: int) -> None:
    with Rig(bad, cls, apart=True) as rig:
        rig.ticks(8)
        assert rig.child is not None
        assert rig.child.wait(10) == code
        assert rig.value("state", FollowState).waypoint == 3


@pytest.fixture
def lively_threads() -> Iterator[None]:
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(before)


@pytest.mark.usefixtures("lively_threads")
def test_watch_ends_no_other_step_than_the_one_that_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps that end just as they are to be ended: nothing is raised behind them."""
    monkeypatch.setattr(contain, "LOOK_S", 0.0001)
    watch, hung = contain.Watch(), 0
    for k in range(150):
        try:
            watch.begin(0.0005 + k * 1e-5)
            try:
                end_s = time.thread_time() + 0.0015
                while time.thread_time() < end_s:
                    pass
            finally:
                watch.end()
        except contain.StepHung:
            watch.end()
            hung += 1
        for _ in range(300):  # outside: if it comes here, this test breaks
            pass
    assert hung


def test_long_reason_keeps_the_place_in_the_file(tmp_path: Path) -> None:
    file = tmp_path / "long.py"
    file.write_text(MISBEHAVING.replace("lost my way", "ä" * 300))
    with Rig(file, "Raises", apart=False) as rig:
        rig.ticks(5)
        good_line(rig.status.reason)
        assert re.fullmatch(r"cycle 4: ValueError: ä+ \(long\.py:\d+\)", rig.status.reason)


def test_reset_may_take_longer_than_a_step(bad: Path, tmp_path: Path) -> None:
    file = tmp_path / "thorough.py"
    busy = "end_s = time.thread_time() + 1.3\n        while time.thread_time() < end_s:\n            pass"
    file.write_text(MISBEHAVING.replace("self.hoard = []\n", f"{busy}\n        self.hoard = []\n"))
    with Rig(file, "Good", apart=False, budget_ms=5.0) as rig:
        rig.ticks(3)
        assert rig.status.state is ModuleState.RUNNING


# -- latency, budget, deadline ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("latency", [0, 1, 3, 7])
def test_outputs_show_so_many_ticks_later(bad: Path, latency: int) -> None:
    with Rig(bad, "Good", apart=False, after=MANY, latency_cycles=latency) as rig:
        first: dict[int, int] = {}
        for _ in range(20):
            cycle = rig.tick()
            state = rig.value("state", FollowState)
            if state is not None:
                first.setdefault(state.waypoint, cycle)
    assert first == {step: step + 1 + latency for step in range(1, 20 - latency)}


def test_outputs_of_a_slow_module_keep_the_time_of_what_they_were_computed_from(bad: Path) -> None:
    with Rig(bad, "Good", apart=False, after=MANY, latency_cycles=5) as rig:
        rig.ticks(10)
        sample = rig.store.find("bad/drive", DriveCommand).visible(rig.store.cycle)
        assert sample is not None
        assert sample.t_data_ns == (10 - 1 - 5 - 1) * TICK_NS, "shown in 10, of the cut of 4, written before"
        assert sample.causes == ((rig.pose.oid, 4),)


def test_results_that_were_under_way_are_not_written_once_the_module_is_broken(bad: Path) -> None:
    with Rig(bad, "Raises", apart=False, latency_cycles=5) as rig:
        rig.ticks(20)
        assert rig.store.find("bad/state", FollowState).head == 0, "nothing was said, there is nothing to take back"


def test_budget_is_counted_and_nothing_else_changes(bad: Path) -> None:
    with Rig(bad, "Slow", apart=False, budget_ms=30.0) as rig:
        rig.ticks(8)
        timing: ModuleTiming = rig.value("timing", ModuleTiming)
        assert rig.status.state is ModuleState.RUNNING
    assert timing.steps == 7
    assert 4 <= timing.over_budget <= 7, "the slow ones, and on a busy machine others"
    assert 0.06 <= timing.last_s <= timing.longest_s


@real_time
def test_result_behind_the_deadline_is_dropped_in_real_time(bad: Path) -> None:
    """The only clock that does not wait: ticks of 50 ms, a budget of 20 ms, steps of 60 ms after the third."""
    store = Store.create(name_of("real"), clock="real", tick_ns=50_000_000)
    with store:
        pose = store.join("source").insert("pose", Pose)
        wire = Wire("bad", f"{bad}:Slow", 4, 0, {"pose": "source/pose"}, {"after": 3}, budget_ms=20.0)
        host = Host(store, wire, 0, participant=True)
        host.connect()
        store.run_clock(("bad",))
        host.component.done(0)
        found = store.find("bad/status", ModuleStatus)
        cycle, status = 0, None
        while cycle < 1000 and host.fault == "":
            pose.write(Pose())
            now = store.wait_cycle(cycle, 10.0)
            assert now is not None
            for due in range(cycle + 1, now + 1):
                if due == now or due % 4:  # what was slept through is over
                    host.step(due)
                host.component.done(due)
            cycle, status = now, found.latest()
            if status is not None and status.value.state is ModuleState.LATE:
                break  # sooner or later: a machine that stands still meanwhile makes the pose stale first
        state = store.find("bad/state", FollowState).latest()
    assert status is not None
    assert status.value.state is ModuleState.LATE, status.value
    assert re.match(r"cycle \d+: \d+\.\d ms late, its result is dropped", status.value.reason)
    if state is not None:  # on a very busy machine even the first ones are late
        assert state.value.waypoint in (1, 2, 3, 99), "no late one: the last in time, or by now the safe one"


# -- in a drive -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def straight() -> Scenario:
    """Forty metres straight on."""
    plan = load_scenario("safety/host-dies")
    return plan.model_copy(update={"faults": (), "duration_s": 9.0, "id": "test/straight"})


def stack_with(file: Path, cls: str, **wire: Any) -> Stack:
    """The reference stack with another follower, and other keys of its wiring."""
    stack = load_stack(STACKS / "reference.json").use("follow", f"{file}:{cls}")
    wires = tuple(dataclasses.replace(w, **wire) if w.component == "follow" else w for w in stack.wires)
    return dataclasses.replace(stack, wires=wires)


def driven(path: Path, scenario: Scenario, stack: Stack, **how: Any) -> tuple[str, Recording]:
    lost = drive(Setup(scenario=scenario, level="direct", stack=stack, **how), path)
    return lost, Recording(path)


def stands_after_driving(recording: Recording) -> None:
    truth = recording.read("world/cart", CartTruth)
    assert max(row.value.speed_mps for row in truth) > 1.5, "it drove"
    assert abs(truth[-1].value.speed_mps) < 0.01, "it stands"
    assert min(row.value.accel_x_mps2 for row in truth) > -2.2, "and stopped gently"


def reason_of(recording: Recording, component: str = "follow") -> str:
    last = recording.read(f"{component}/status", ModuleStatus)[-1].value
    assert last.state is ModuleState.FAULT
    good_line(last.reason)
    return last.reason


@pytest.mark.parametrize("cls", [c for c in REASONS if c != "OutOfItsOwnRange"])
def test_cart_stands_and_the_reason_is_readable(bad: Path, straight: Scenario, tmp_path: Path, cls: str) -> None:
    stack = stack_with(bad, cls, **({"budget_ms": 10.0} if cls == "Loops" else {}))
    lost, recording = driven(tmp_path / "run.mcap", straight, stack, faults=tmp_path)
    assert lost == ""
    stands_after_driving(recording)
    assert re.search(REASONS[cls], reason_of(recording))
    result = judge(recording, straight.parsed_criteria)
    assert result.verdict is Verdict.ERROR
    assert result.reason.startswith("follow: cycle ")
    assert (tmp_path / "follow.repro").is_file()


def test_narrowed_output_of_a_drive_reads_as_the_record(bad: Path, straight: Scenario, tmp_path: Path) -> None:
    _, recording = driven(tmp_path / "run.mcap", straight, stack_with(bad, "OutOfItsOwnRange"))
    stands_after_driving(recording)
    assert max(row.value.speed_mps for row in recording.read("follow/drive", DriveCommand)) == 2.0
    assert "2.5 is outside 0 to 2 m/s" in reason_of(recording)


def test_input_that_grows_stale_stops_the_cart_and_is_named(bad: Path, straight: Scenario, tmp_path: Path) -> None:
    """The localiser's process is gone: its last pose ages."""
    stack = load_stack(STACKS / "reference.json").use("localise", f"{bad}:Vanishes")
    lost, recording = driven(tmp_path / "run.mcap", straight, stack, placement="process", db=name_of("stale"))
    assert re.fullmatch(r"the process of localise ended in cycle \d+ \(exit status 7\)", lost)
    stands_after_driving(recording)
    last = recording.read("follow/status", ModuleStatus)[-1].value
    assert last.state is ModuleState.STALE
    assert re.fullmatch(r"input pose \(localise/pose\) is 0\.2\d s old, at most 0\.25 s", last.reason)


@pytest.mark.parametrize(("cls", "how"), [("Crashes", "SIGSEGV"), ("Leaves", "exit status 7")])
def test_process_that_dies_is_named_and_the_cart_stands(
    bad: Path, straight: Scenario, tmp_path: Path, cls: str, how: str
) -> None:
    stack = stack_with(bad, cls)
    lost, recording = driven(tmp_path / "run.mcap", straight, stack, placement="process", db=name_of("dies"))
    assert re.fullmatch(rf"the process of follow ended in cycle \d+ \({how}\)", lost)
    stands_after_driving(recording)
    assert judge(recording, straight.parsed_criteria, broken=lost).verdict is Verdict.ERROR


def test_process_that_takes_too_much_memory_breaks_alone(bad: Path, straight: Scenario, tmp_path: Path) -> None:
    stack = stack_with(bad, "Gathers", memory_mb=200)
    lost, recording = driven(tmp_path / "run.mcap", straight, stack, placement="process", db=name_of("memory"))
    assert lost == ""
    stands_after_driving(recording)
    assert "MemoryError: there is no memory left for it; memory_mb" in reason_of(recording)


@pytest.mark.proof  # for some seconds
def test_process_that_sleeps_is_ended_and_the_cart_stands(
    bad: Path, straight: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    setup = Setup(scenario=straight, level="direct", stack=stack_with(bad, "Sleeps"), placement="process")
    with Drive(setup) as under_way, Recorder(tmp_path / "run.mcap", [under_way.cart, under_way.world], {}) as recorder:
        while not under_way.tick(recorder):
            if under_way.cart.cycle == 100:
                monkeypatch.setattr(run, "HANG_S", 2.0)  # all have long been imported and begun
        lost = under_way.lost
    assert re.fullmatch(r"the process of follow hung in cycle \d+, and was ended", lost)
    stands_after_driving(Recording(tmp_path / "run.mcap"))


SHORT = """\
id: test/{name}
about: A start and a few metres.
site: pad
course: {{speed_mps: 2, waypoints: [{{east_m: 40, north_m: 0}}]}}
stack: {stack}
duration_s: 5
criteria:
  decel_max_mps2: "<= 1.8"
"""


def write_short(folder: Path, name: str, stack: str) -> Path:
    path = folder / f"{name}.scenario.yaml"
    path.write_text(SHORT.format(name=name, stack=stack))
    return path


def write_stack(folder: Path, module: str) -> Path:
    stack = json.loads((STACKS / "reference.json").read_text())
    stack["follow"]["module"] = module
    path = folder / "mine.json"
    path.write_text(json.dumps(stack))
    return path


def fairway(*args: object) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "scenarios.cli", *map(str, args)]
    return subprocess.run(command, env=ENV, capture_output=True, text=True, check=False)


def test_module_that_crashes_its_drive_is_an_error_of_that_scenario_alone(bad: Path, tmp_path: Path) -> None:
    files = [
        write_short(tmp_path, "crashes", str(write_stack(tmp_path, f"{bad}:Crashes"))),
        write_short(tmp_path, "drives", "reference"),
    ]
    done = fairway("check", *files, "--jobs", 1, "--level", "direct", "--out", tmp_path / "runs")
    assert done.returncode == 3, done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    assert re.search(r"test/crashes +0 +ERROR .*its process ended by signal SIGSEGV", done.stdout)
    assert re.search(r"test/drives +0 +PASS", done.stdout)


def test_drive_goes_on_and_passes_while_a_module_floods_the_terminal(bad: Path, tmp_path: Path) -> None:
    file = write_short(tmp_path, "floods", str(write_stack(tmp_path, f"{bad}:Chatters")))
    done = fairway("drive", file, "--level", "direct", "--out", tmp_path / "runs")
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr
    assert "PASS after" in done.stdout
    assert contain.PRINTS_BYTES < len(done.stdout) < contain.PRINTS_BYTES + 10_000
    assert done.stdout.count("has printed 1 MB") == 1


# -- one trace --------------------------------------------------------------------------------------------------------


@pytest.fixture
def hash_of(straight: Scenario, tmp_path: Path) -> Callable[..., str]:
    brief = straight.model_copy(update={"duration_s": 4.0})
    n = 0

    def of(stack: Stack, **how: Any) -> str:
        nonlocal n
        n += 1
        lost, recording = driven(tmp_path / f"{n}.mcap", brief, stack, **how)
        assert lost == ""
        return recording.trace_hash()

    return of


def test_trace_of_a_module_that_draws_and_shows_is_the_same_everywhere(
    bad: Path, tmp_path: Path, hash_of: Callable[..., str]
) -> None:
    stack = stack_with(bad, "Random")
    here = hash_of(stack)
    assert hash_of(stack, placement="process", db=name_of("apart")) == here
    for shuffle in (1, 4):
        assert hash_of(stack, shuffle=shuffle, db=name_of("shuffle")) == here
    assert hash_of(stack, seed=1) != here
    elsewhere = tmp_path / "else" / "bad.py"
    elsewhere.parent.mkdir()
    elsewhere.write_text(MISBEHAVING)
    assert hash_of(stack_with(elsewhere, "Random")) == here, "where the file is does not matter"


def test_latency_in_cycles_is_repeatable_and_changes_the_drive(bad: Path, hash_of: Callable[..., str]) -> None:
    late = stack_with(bad, "Random", latency_cycles=3)
    here = hash_of(late)
    assert hash_of(late, placement="process", db=name_of("late")) == here
    assert hash_of(stack_with(bad, "Random")) != here


def test_budget_is_no_part_of_the_trace(bad: Path, hash_of: Callable[..., str]) -> None:
    assert hash_of(stack_with(bad, "Random", budget_ms=20.0)) == hash_of(stack_with(bad, "Random"))
