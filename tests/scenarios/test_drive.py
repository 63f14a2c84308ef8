"""Whole drives: the same trace in any layout and under load, verdicts, and nothing of the truth for modules."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from steady import real_time

from autonomy import ModuleError
from autonomy.wiring import load_stack
from hal.signals import CartTruth, Pose
from rtdb import Store, StoreMissing
from rtdb.recording import Recording
from scenarios.judge import Verdict, judge
from scenarios.run import Drive, Setup, drive
from scenarios.scenario import Scenario, load_scenario

ROOT = Path(__file__).resolve().parents[2]
ENV = os.environ | {"PYTHONPATH": str(ROOT)}
SHORT_S = 6.0


def name_of(purpose: str) -> str:
    """Name a shared store of this test run."""
    return f"test-drive-{os.getpid()}-{purpose}"


def segments() -> set[str]:
    """List the shared stores of this user."""
    return {path.name for path in Path("/dev/shm").glob(f"fairway-{os.getuid()}-*")}


@pytest.fixture(scope="module")
def short() -> Scenario:
    """The square, as far as its first corner's approach."""
    return load_scenario("parking-lot/square").model_copy(update={"duration_s": SHORT_S})


def record(path: Path, scenario: Scenario, **how: Any) -> Recording:
    drive(Setup(scenario=scenario, **how), path)
    return Recording(path)


@pytest.fixture(scope="module")
def first(short: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The drive that others are compared with: seed 0, through wire bytes, modules in this process."""
    return record(tmp_path_factory.mktemp("first") / "run.mcap", short)


# -- one trace --------------------------------------------------------------------------------------------------------


def test_drive_that_is_compared_is_one(first: Recording) -> None:
    truth = first.read("world/cart", CartTruth)
    assert first.complete
    assert first.time_s(first.last_cycle) == pytest.approx(SHORT_S)
    assert truth[-1].value.distance_m > 2.0, "it moves"
    assert len(first.read("localise/pose", Pose)) > 100


def test_trace_is_the_same_twice_in_one_process(first: Recording, short: Scenario, tmp_path: Path) -> None:
    assert record(tmp_path / "run.mcap", short).trace_hash() == first.trace_hash()


def test_trace_is_the_same_through_bytes_and_through_messages(
    first: Recording, short: Scenario, tmp_path: Path
) -> None:
    assert record(tmp_path / "run.mcap", short, level="direct").trace_hash() == first.trace_hash()


def test_trace_is_the_same_with_modules_in_a_process_of_their_own(
    first: Recording, short: Scenario, tmp_path: Path
) -> None:
    apart = record(tmp_path / "run.mcap", short, placement="process", db=name_of("apart"))
    assert apart.trace_hash() == first.trace_hash()


@contextmanager
def busy(n: int) -> Iterator[None]:
    """Have n processes take what they get of the processors."""
    loops = [
        subprocess.Popen([sys.executable, "-c", "print(flush=True)\nwhile True: pass"], stdout=-1) for _ in range(n)
    ]
    try:
        for loop in loops:
            assert loop.stdout is not None
            loop.stdout.readline()  # it runs
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.communicate()


def test_trace_is_the_same_while_the_processors_are_busy(first: Recording, short: Scenario, tmp_path: Path) -> None:
    with busy(2):
        apart = record(tmp_path / "run.mcap", short, placement="process", db=name_of("busy"))
    assert apart.trace_hash() == first.trace_hash()


def test_trace_differs_with_another_seed(first: Recording, short: Scenario, tmp_path: Path) -> None:
    assert record(tmp_path / "run.mcap", short, seed=1, level="direct").trace_hash() != first.trace_hash()


def test_trace_of_the_command_in_another_process_is_the_same_and_stands_in_its_result(
    first: Recording, tmp_path: Path
) -> None:
    text = (ROOT / "scenarios" / "library" / "parking-lot" / "square.scenario.yaml").read_text()
    file = tmp_path / "short.scenario.yaml"
    file.write_text(text.replace("duration_s: 80", f"duration_s: {SHORT_S}"))
    run = subprocess.run(
        [sys.executable, "-m", "scenarios.cli", "drive", str(file), "--out", str(tmp_path / "runs")],
        env=ENV | {"PYTHONHASHSEED": "77"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 1, f"it does not get round in {SHORT_S} s: {run.stdout}{run.stderr}"
    folder = tmp_path / "runs" / "parking-lot" / "square" / "0"
    assert json.loads((folder / "result.json").read_text())["trace"] == first.trace_hash()
    assert Recording(folder / "run.mcap").trace_hash() == first.trace_hash()


# -- verdicts ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scenario", ["parking-lot/square", "safety/host-dies"])
def test_scenario_passes(scenario: str, tmp_path: Path) -> None:
    plan = load_scenario(scenario)
    result = judge(record(tmp_path / "run.mcap", plan, level="direct"), plan.parsed_criteria)
    assert [f"{f.criterion.metric}: {f.measured}" for f in result.findings if f.verdict is not Verdict.PASS] == []
    assert result.verdict is Verdict.PASS
    assert len(result.findings) == len(plan.criteria) > 3


# -- the truth --------------------------------------------------------------------------------------------------------

SPY = '''\
"""Attach to all that can be attached to; print components and records that there are to be found."""
import json, os, sys
from pathlib import Path
from rtdb import RtdbError, Store

found = {}
prefix = f"fairway-{os.getuid()}-"
for path in Path("/dev/shm").iterdir():
    try:
        with Store.attach(path.name.removeprefix(prefix)) as store:
            found[path.name] = {
                "components": [c.name for c in store.components()],
                "records": sorted({o.schema.name for o in store.objects()}),
                "text": [word for word in ("CartTruth", "world/") if word.encode() in path.read_bytes()],
            }
    except (RtdbError, OSError) as error:
        found[path.name] = {"components": [], "records": [], "text": [], "error": str(error)}
print(json.dumps(found))
'''


def spy() -> dict[str, dict[str, list[str]]]:
    """Let a process that knows nothing but what any module's process can know look for the truth."""
    run = subprocess.run([sys.executable, "-c", SPY], env=ENV, capture_output=True, text=True, check=True)
    found: dict[str, dict[str, list[str]]] = json.loads(run.stdout)
    return found


def test_spy_would_find_the_truth_if_it_were_shared() -> None:
    with Store.create(name_of("leak")) as leak:
        leak.join("world").insert("cart", CartTruth)
        seen = spy()[f"fairway-{os.getuid()}-{name_of('leak')}"]
    assert seen["components"] == ["world"]
    assert seen["records"] == ["CartTruth", "Health"]
    assert seen["text"] == ["CartTruth", "world/"]


def test_process_of_modules_cannot_find_the_truth(short: Scenario) -> None:
    name = name_of("two-stores")
    others = set(spy())  # a run in real time on this machine may share its truth
    with Drive(Setup(scenario=short, placement="process", db=name)) as run:
        while run.cart.cycle < 50:
            run.tick()
        assert run.world.find("world/cart", CartTruth).visible(run.world.cycle) is not None, "it is there, for us"
        seen = spy()
        children = run._children.values()
        assert len(children) == 3
        mapped = [word for child in children for word in Path(f"/proc/{child.pid}/maps").read_text().split()]
        opened = [os.readlink(link) for child in children for link in Path(f"/proc/{child.pid}/fd").iterdir()]
    mine = seen[f"fairway-{os.getuid()}-{name}"]
    assert {"localise", "follow", "guard", "gps"} <= set(mine["components"])
    assert "Pose" in mine["records"]
    for segment in seen.keys() - others:
        what = seen[segment]
        assert "world" not in what["components"], segment
        assert "CartTruth" not in what["records"], segment
        assert what["text"] == [], segment
    shared = {word for word in (*mapped, *opened) if word.startswith("/dev/shm/fairway-")}
    assert shared == {f"/dev/shm/fairway-{os.getuid()}-{name}"}, "nothing else of the drive is in its memory"


def test_hosts_of_modules_hold_the_carts_store_alone(short: Scenario) -> None:
    with Drive(Setup(scenario=short, level="direct")) as run:
        run.tick()
        hosts = run._hosts
        assert [host.wire.component for host in hosts] == ["localise", "follow", "guard"]
        for host in hosts:
            assert host._store is run.cart
            assert not any(isinstance(value, Store | Drive) for value in vars(host.module).values())
        assert all(obj.schema.name != "CartTruth" for obj in run.cart.objects())
        assert all(component.name != "world" for component in run.cart.components())


# -- what is left -----------------------------------------------------------------------------------------------------


def test_drive_leaves_neither_segment_nor_process(short: Scenario) -> None:
    name = name_of("left")
    with Drive(Setup(scenario=short, placement="process", db=name)) as run:
        run.tick()
        children = list(run._children.values())
        assert f"fairway-{os.getuid()}-{name}" in segments()
    assert [child.returncode is not None for child in children] == [True] * 3
    assert f"fairway-{os.getuid()}-{name}" not in segments()


def test_drive_that_cannot_begin_leaves_no_segment(short: Scenario) -> None:
    name = name_of("unbegun")
    stack = load_stack(short.stack_path()).use("follow", "autonomy.guard:Guard")  # which has other inputs
    with pytest.raises(ModuleError, match="input drive_in of Guard is not wired"):
        Drive(Setup(scenario=short, stack=stack, db=name))
    assert f"fairway-{os.getuid()}-{name}" not in segments()


def attach(name: str, process: "subprocess.Popen[str]") -> Store:
    """Attach to the store of a process once it is there."""
    while True:
        try:
            return Store.attach(name)
        except StoreMissing:
            with suppress(subprocess.TimeoutExpired):
                process.wait(0.02)
                pytest.fail(f"it ended: {process.communicate()}")


@real_time
def test_recording_of_a_killed_drive_is_readable_up_to_its_last_second(tmp_path: Path) -> None:
    name = name_of("killed")
    command = [sys.executable, "-m", "scenarios.cli", "drive", "parking-lot/square", "--level", "direct"]
    process = subprocess.Popen(
        [*command, "--db", name, "--pace", "4", "--out", str(tmp_path)],
        env=ENV,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        with attach(name, process) as store:
            cycle = 0
            while cycle < 320:
                new = store.wait_cycle(cycle, 10.0)
                assert new is not None, f"the clock stands at {cycle}"
                cycle = new
            process.kill()
            process.communicate()
            last = store.cycle
        assert process.returncode == -signal.SIGKILL
        recording = Recording(tmp_path / "parking-lot" / "square" / "0" / "run.mcap")
        assert not recording.complete
        assert last - 200 <= recording.last_cycle <= last, "a second, and what the file had not taken yet"
        poses = recording.read("localise/pose", Pose)
        assert [pose.write for pose in poses] == list(range(1, len(poses) + 1))
        result = judge(recording, load_scenario("parking-lot/square").parsed_criteria)
        assert result.verdict is Verdict.FAIL
        # what the crash left does not stand in the way of the next drive
        with Store.create(name) as again:
            assert again.objects() == []
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()
        Path(f"/dev/shm/fairway-{os.getuid()}-{name}").unlink(missing_ok=True)
