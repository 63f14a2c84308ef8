"""Rewiring a system that runs: its latency is shown first, it is effective at the next edge, a broken one refused."""

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from live_run import LiveRun
from steady import real_time
from typer.testing import CliRunner

from autonomy.module import ModuleError
from rtdb import Store, StoreMissing
from scenarios.cli import app
from scenarios.latency import latency
from scenarios.rewire import Change, changed, check_change, propose, stack_of

STACKS = Path(__file__).resolve().parents[2] / "autonomy" / "stacks"
pytestmark = [pytest.mark.proof, real_time]


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[], LiveRun]]:
    """Gives a drive with a second localiser, which runs a tick earlier, and which nobody is wired to."""
    stack = json.loads((STACKS / "reference.json").read_text())
    stack["second"] = {**stack["localise"], "phase": 0}
    drives: list[LiveRun] = []

    def one_that_runs() -> LiveRun:
        if not drives or drives[-1].process.poll() is not None:
            folder = tmp_path_factory.mktemp("wire")
            (folder / "stack.json").write_text(json.dumps(stack))
            drives.append(LiveRun(folder, metres=100, stack="stack.json"))
        return drives[-1]

    yield one_that_runs
    for live in drives:
        live.close()


@pytest.fixture
def run(begun: Callable[[], LiveRun]) -> LiveRun:
    return begun()


@pytest.fixture
def driving(run: LiveRun) -> Store:
    run.until_it_drives()
    return run.store


def wire(name: str, *words: str, answer: str = "") -> tuple[int, str, str]:
    """Run the command; gives exit status, what it printed, and the error that the real command prints in one line."""
    done = CliRunner().invoke(app, ["wire", name, *words], input=answer)
    error = done.exception
    return done.exit_code, done.output, "" if error is None or isinstance(error, SystemExit) else str(error)


def cause_of_drive(store: Store) -> str:
    """Which component's pose the newest command of follow was computed from."""
    drive = store.find("follow/drive").visible(store.cycle)
    names = {obj.oid: obj.component for obj in store.objects("*/pose")}
    return next(names[oid] for oid, _ in drive.causes if oid in names)


def test_latency_is_shown_and_without_a_yes_nothing_changes(run, driving):
    status, printed, _ = wire(run.name, "follow.pose=second/pose", answer="n\n")
    assert status == 1
    shown = re.findall(r"^(now|then) +odometry/travel -> guard/drive -> bus: (\d+) to (\d+) ms$", printed, re.MULTILINE)
    assert [when for when, *_ in shown] == ["now", "then"]
    assert stack_of(driving).wires == tuple(sorted_like(driving, "localise/pose"))
    assert cause_of_drive(driving) == "localise"


def sorted_like(store: Store, pose: str) -> list[object]:
    """The wiring in force, with the pose that follow shall have."""
    return [
        replace(w, inputs={**w.inputs, "pose": pose}) if w.component == "follow" else w for w in stack_of(store).wires
    ]


def test_shown_latency_is_that_of_the_stack_file(run, driving):
    now = latency(stack_of(driving))
    then = latency(changed(stack_of(driving), Change("follow", "pose", "second/pose")))
    assert (now[0].best_ticks, now[0].worst_ticks) != (then[0].best_ticks, then[0].worst_ticks)
    printed = wire(run.name, "follow.pose=second/pose", answer="n\n")[1]
    for when, ways in (("now", now), ("then", then)):
        assert re.search(rf"{when} .*bus: {ways[0].best_ticks * 10} to {ways[0].worst_ticks * 10} ms", printed)


def test_new_wiring_is_effective_at_the_next_edge_of_a_running_drive(run, driving):
    try:
        status, printed, _ = wire(run.name, "follow.pose=second/pose", "--yes")
        assert status == 0, printed
        cycle = int(re.search(r"follow: wired anew in cycle (\d+)", printed)[1])
        run.until(lambda: driving.cycle >= cycle + 8)
        assert cause_of_drive(driving) == "second"
        assert run.process.poll() is None
    finally:
        assert wire(run.name, "follow.pose=localise/pose", "--yes")[0] == 0
    run.until(lambda: cause_of_drive(driving) == "localise")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("folow.pose=localise/pose", "no component 'folow'; did you mean follow?"),
        ("follow.pse=localise/pose", "follow has no input 'pse'; did you mean pose?"),
        ("follow.pose=localise/pos", "follow.pose = localise/pos: "),
        ("follow.pose=gps/fix", "follow.pose = gps/fix: object gps/fix holds a GpsFix, not a Pose"),
        ("follow.pose=localise/pose#/x_m", "a Pose is wired to a whole object: localise/pose"),
        ("actuators.drive=localise/pose", "object localise/pose holds a Pose, not a DriveCommand"),
        ("actuators.drive=follow/config", "it holds JSON, not a DriveCommand"),
        ("actuators.steer=follow/drive", "actuators has no input 'steer'; it has drive"),
        ("localise.odometry=guard/drive", "localise.odometry = guard/drive: object guard/drive holds a DriveCommand"),
        ("guard.drive_in=guard/drive", "guard needs guard: nobody can begin; make one of these inputs optional"),
        ("follow", "expected COMPONENT.INPUT=POINTER"),
    ],
)
def test_what_cannot_be_wired_is_one_line_and_the_old_wiring_stays(run, driving, change, said):
    before = stack_of(driving)
    status, _, error = wire(run.name, change, "--yes")
    assert status != 0
    assert said in error
    assert "\n" not in error
    assert stack_of(driving) == before


def test_a_store_that_is_not_there_is_one_line(run, driving):
    with pytest.raises(StoreMissing, match=f"did you mean {run.name}"):
        CliRunner().invoke(app, ["wire", run.name[:-1], "follow.pose=localise/pose"], catch_exceptions=False)


def test_what_the_host_refuses_is_said_and_the_old_wiring_is_put_back(run, driving):
    """Past the checks of the command, as a program that writes the configuration itself would."""
    before = stack_of(driving)
    bad = Change("follow", "pose", "gps/fix")
    with pytest.raises(ModuleError):
        check_change(driving, before, bad)
    answer = propose(driving, changed(before, bad), bad)
    assert answer.startswith("wiring refused: follow.pose = gps/fix")
    run.until(lambda: stack_of(driving) == before)
    assert cause_of_drive(driving) == "localise"


def test_hal_is_not_rewired_while_the_cart_is_enabled(run, driving):
    status, printed, _ = wire(run.name, "actuators.drive=follow/drive", "--yes")
    assert status == 2
    assert "the cart is enabled" in printed
    run.until(lambda: stack_of(driving).command == "guard/drive")
