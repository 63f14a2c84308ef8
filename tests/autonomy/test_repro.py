"""The step that broke a module is kept, and `fairway repro` runs it again: the same inputs, memory and randomness."""

import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from autonomy import ModuleError
from autonomy.cli import register
from autonomy.host import Host
from autonomy.repro import load
from autonomy.trial import trial
from autonomy.wiring import Wire
from hal.signals import Pose, Scan
from rtdb import Store, Writer
from rtdb.json_object import json_schema

ROOT = Path(__file__).resolve().parents[2]
ENV = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "200"}
app = typer.Typer()
register(app)


@app.command()
def nothing() -> None:
    """So that the program has several commands."""


MINE = """\
import math
from autonomy import Input, Module, Output, Param
from hal.signals import DriveCommand, Pose, Scan


class Mine(Module):
    pose = Input(Pose)
    scan = Input(Scan, optional=True)
    reach_m = Input(float, unit="m", optional=True)
    wanted_mps = Input(float, unit="m/s", optional=True)
    order = Input(DriveCommand, optional=True)
    drive = Output(DriveCommand, safe=DriveCommand())
    gain = Param(2.0, unit="1")

    def reset(self):
        self.n = 0
        self._odd = lambda: None

    def step(self):
        self.n += 1
        drawn = float(self.rng.random())
        self.drive = DriveCommand(self.gain * self.pose.x_m)
        if self.pose.x_m > 2.0:
            age_s = (self.t_ns - self.samples["pose"].t_data_ns) * 1e-9
            raise ValueError(
                f"{self.n} {drawn:.9f} {self.pose.x_m} {self.scan and self.scan.range_m} {self.reach_m} "
                f"{self.wanted_mps} {self.order} {age_s:.3f} {self.dt_s}"
            )


class BadReset(Mine):
    def reset(self):
        raise RuntimeError("no map")


class Endless(Mine):
    def step(self):
        self.drive = DriveCommand()
        while self.pose.x_m > 2.0:
            pass


class Forgetful(Mine):
    def memory(self):
        raise RuntimeError("I do not know")
"""

INPUTS = {
    "pose": "source/pose",
    "scan": "source/scan",
    "reach_m": "source/scan#/max_m",
    "wanted_mps": "source/json#/speed_mps",
    "order": "source/json",
}


def break_it(folder: Path, cls: str = "Mine", text: str = MINE, **wire: Any) -> tuple[Path, str]:
    """Let a module break in its fourth step; returns the repro and the reason."""
    (folder / "mine.py").write_text(text)
    store = Store.create(tick_ns=10_000_000)
    source = store.join("source")
    pose, scan = source.insert("pose", Pose), source.insert("scan", Scan)
    document: Writer[Any] = source.insert("json", json_schema(200))
    module = f"{folder / 'mine.py'}:{cls}"
    host = Host(store, Wire("mine", module, 1, 0, INPUTS, {"gain": 1.5}, **wire), 5, faults=folder / "run")
    host.connect()
    for x_m in (0.5, 1.0, 1.5, 2.5, 3.0):
        pose.write(Pose(x_m=x_m))
        scan.write(Scan(max_m=4.0, range_m=(1.0, 2.5)))
        document.write({"speed_mps": 1.25})
        host.step(store.tick())
    assert host.fault
    store.close()
    return folder / "run" / "mine.repro", host.fault


def repro(*args: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["repro", *map(str, args)])
    if isinstance(done.exception, ModuleError):
        return 2, str(done.exception)
    return done.exit_code, done.output


def test_step_breaks_again_exactly_as_it_did(tmp_path: Path) -> None:
    file, reason = break_it(tmp_path)
    said = reason.partition("ValueError: ")[2].partition(" (mine.py")[0]
    assert said.startswith("4 0.")
    assert "2.5 (1.0, 2.5) 4.0 1.25 DriveCommand(speed_mps=1.25, steer_rad=0.0" in said
    module, document = load(file)
    with pytest.raises(ValueError, match=r"^4 0") as error:
        module.step()
    assert str(error.value).startswith(said)
    assert document["left_out"] == ["_odd"]
    assert document["component"] == "mine"
    assert document["reason"].startswith("Traceback")


def test_command_runs_the_step_and_says_whether_it_passed(tmp_path: Path) -> None:
    file, _ = break_it(tmp_path)
    code, out = repro(file, "--run")
    assert code == 1
    lines = out.splitlines()
    assert lines[0] == f"mine: step() of {tmp_path / 'mine.py'}:Mine"
    assert lines[1].startswith("broke then: ValueError: 4 0.")
    assert lines[2] == "could not be kept, and is missing now: _odd"
    (tmp_path / "mine.py").write_text(MINE.replace("self.pose.x_m > 2.0", "self.pose.x_m > 9.0"))  # mended
    code, out = repro(file, "--run")
    assert code == 0
    assert out.splitlines()[-1].startswith("the step passed: drive = DriveCommand(speed_mps=3.75, ")


def test_output_that_is_not_sound_breaks_again(tmp_path: Path) -> None:
    file, _ = break_it(tmp_path, text=MINE.replace("raise ValueError(", "self.drive = DriveCommand(math.inf) or ("))
    code, out = repro(file, "--run")
    assert code == 1
    assert out.splitlines()[1] == "broke then: autonomy.module.ModuleError: output drive is not finite: " + (
        "DriveCommand(speed_mps=inf, steer_rad=0.0, decel_mps2=1.5)"
    )


def test_reset_that_broke_is_called_again(tmp_path: Path) -> None:
    file, _ = break_it(tmp_path, "BadReset")
    code, out = repro(file, "--run")
    assert code == 1
    assert f"mine: reset() of {tmp_path / 'mine.py'}:BadReset" in out


def test_endless_loop_ends_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("autonomy.contain.HANG_CPU_S", 0.3)
    file, reason = break_it(tmp_path, "Endless", budget_ms=1.0)
    assert "StepHung" in reason
    code, _ = repro(file, "--run")
    assert code == 1


def test_module_whose_memory_cannot_be_kept_is_stopped_all_the_same(tmp_path: Path) -> None:
    file, reason = break_it(tmp_path, "Forgetful")
    assert "ValueError: 4 " in reason
    assert not file.exists()


def test_in_process_fault_costs_no_more_than_its_file(tmp_path: Path) -> None:
    """A folder that cannot be written to is no fault of the host."""
    (tmp_path / "run").write_text("a file is in the way")
    _, reason = break_it(tmp_path)
    assert "ValueError: 4 " in reason


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "No such file"),
        ("", "is no repro of this version"),
        ("{}", "is no repro of this version"),
        ("[]", "is no repro of this version"),
        ('{"fairway": "repro", "format": 99}', "its format is another one"),
        ('{"fairway": "repro", "format": 1}', "is no repro of this version"),
        ("\0\1", "is no repro of this version"),
    ],
)
def test_file_that_is_no_repro_is_one_line(tmp_path: Path, text: str | None, words: str) -> None:
    file = tmp_path / "x.repro"
    if text is not None:
        file.write_text(text)
    code, said = repro(file, "--run")
    assert code == 2
    assert words in said
    assert "\n" not in said


def test_module_that_is_gone_is_named(tmp_path: Path) -> None:
    file, _ = break_it(tmp_path)
    (tmp_path / "mine.py").unlink()
    assert repro(file, "--run") == (2, f"no file {tmp_path / 'mine.py'}; --use takes COMPONENT=FILE.py:Class")


def debug(file: Path, keys: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "scenarios.cli", "repro", str(file)]
    return subprocess.run(command, input=keys, env=ENV, capture_output=True, text=True, check=False)


def test_debugger_stops_at_the_first_line_of_the_step(tmp_path: Path) -> None:
    file, _ = break_it(tmp_path)
    left = debug(file, "p self.n, self.pose.x_m\nq\n")
    assert left.returncode == 0, left.stderr
    first = next(k for k, line in enumerate(MINE.splitlines(), 1) if "self.n += 1" in line)
    assert f"{tmp_path / 'mine.py'}({first})step()" in left.stdout
    assert "-> self.n += 1" in left.stdout
    assert "(Pdb) (3, 2.5)" in left.stdout
    went_on = debug(file, "c\n")
    assert went_on.returncode == 1
    assert "ValueError: 4 0." in went_on.stderr


# -- after a drive ----------------------------------------------------------------------------------------------------

SHORT = """\
id: test/short
about: A start and a few metres.
site: pad
course: {speed_mps: 2, waypoints: [{east_m: 40, north_m: 0}]}
duration_s: 5
criteria:
  decel_max_mps2: "<= 1.8"
"""
FOLLOWER = """\
from autonomy.follow import Follow


class Mine(Follow):
    def step(self):
        super().step()
        if self.pose.x_m > 1.0:
            raise ValueError("lost my way")
"""


def fairway(folder: Path, *args: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "scenarios.cli", *args]
    return subprocess.run(command, cwd=folder, env=ENV, capture_output=True, text=True, check=False)


def test_drive_names_the_step_that_broke_and_the_command_runs_it(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(FOLLOWER)
    (tmp_path / "short.scenario.yaml").write_text(SHORT)
    drive = ("drive", "short.scenario.yaml", "--level", "direct")
    done = fairway(tmp_path, *drive, "--use", "follow=mine.py:Mine")
    assert done.returncode == 3
    lines = done.stdout.splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("ERROR after"))
    assert "lost my way (mine.py:8)" in lines[at]
    assert lines[at + 1].split("  ")[0] == "fairway repro runs/test/short/0/follow.repro"
    again = fairway(tmp_path, "repro", "runs/test/short/0/follow.repro", "--run")
    assert again.returncode == 1
    assert "ValueError: lost my way" in again.stderr
    assert fairway(tmp_path, *drive).returncode == 0
    assert not (tmp_path / "runs/test/short/0/follow.repro").exists(), "no old step beside a new drive"


# -- the same without a file: trial -----------------------------------------------------------------------------------


@pytest.fixture
def mine(tmp_path: Path) -> Any:
    from autonomy.loading import load_module

    (tmp_path / "mine.py").write_text(MINE)
    return load_module(f"{tmp_path / 'mine.py'}:Mine")


def test_trial_calls_a_step_as_a_host_would(mine: Any) -> None:
    module = mine()
    assert trial(module, pose=Pose(x_m=0.5))["drive"].speed_mps == 1.0
    assert trial(module, t_s=0.04, pose=Pose(x_m=1.0))["drive"].speed_mps == 2.0
    assert (module.n, module.t_ns, module.dt_s) == (2, 40_000_000, 0.04)
    assert module.samples["pose"].write == 2
    assert module.samples["pose"].t_data_ns == 40_000_000


def test_trial_says_what_is_wrong(mine: Any) -> None:
    with pytest.raises(ModuleError, match="Mine has an input pose, which is not given; its inputs are pose, scan"):
        trial(mine())
    with pytest.raises(ModuleError, match="Mine has no input poes"):
        trial(mine(), pose=Pose(), poes=Pose())
    module = mine()
    module.gain = 4.0
    with pytest.raises(ModuleError, match=r"output drive speed_mps=7.6 is outside -1.5 to 5.5 m/s"):
        trial(module, pose=Pose(x_m=1.9))
    with pytest.raises(ModuleError, match="output drive is not finite"):
        trial(mine(), pose=Pose(x_m=math.nan))
    module = mine()
    module.gain = "fast"
    with pytest.raises(ModuleError, match=r"output drive speed_mps is a number \[m/s\], got 'fast'"):
        trial(module, pose=Pose(x_m=1))
