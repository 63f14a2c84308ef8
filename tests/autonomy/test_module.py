"""The plug-in as a student's editor and type checker see it."""

import subprocess
import sys
from pathlib import Path

import pytest

from autonomy import Input, Module, ModuleError, Output, Param
from hal.signals import STOP, DriveCommand, Pose

STUDENT = '''\
"""Slow: half of what the path follower wants."""

from autonomy import Input, Module, Output, Param
from hal.signals import STOP, DriveCommand, FollowState, GpsFix, Pose


class Slow(Module):
    """Drive slowly."""

    pose = Input(Pose, max_age_s=0.5)
    gps = Input(GpsFix, optional=True)
    drive = Output(DriveCommand, safe=STOP)
    state = Output(FollowState, safe=FollowState())
    part = Param(0.5, unit="1")
    times = Param(3)

    def step(self) -> None:
        """Decide."""
        speed_mps: float = self.pose.speed_mps * self.part * self.times
        if self.gps is not None and self.gps.mode < 2:
            speed_mps = 0.0
        self.drive = DriveCommand(speed_mps=speed_mps, steer_rad=float(self.rng.normal()) * self.dt_s)
        self.state = FollowState(waypoint=1)
'''


class Cruise(Module):
    """Drive straight on."""

    pose = Input(Pose)
    drive = Output(DriveCommand, safe=STOP)
    speed_mps = Param(2.0, unit="m/s")

    def step(self) -> None:
        self.drive = DriveCommand(speed_mps=self.speed_mps)


class Sprint(Cruise):
    """The same, faster."""

    speed_mps = Param(4.0, unit="m/s")
    state = Output(Pose, safe=Pose())


@pytest.fixture(scope="module")
def mypy_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("mypy")


def mypy(file: Path, cache: Path) -> tuple[int, str]:
    """Run mypy --strict on a student's file, as its editor does."""
    root = Path(__file__).resolve().parents[2]
    run = subprocess.run(
        [
            *(sys.executable, "-m", "mypy", "--strict", "--config-file", str(root / "pyproject.toml")),
            *("--cache-dir", str(cache), "--no-error-summary", str(file)),
        ],
        capture_output=True,
        text=True,
        cwd=root,
        check=False,
    )
    return run.returncode, run.stdout + run.stderr


def test_students_file_passes_the_strict_type_checker(tmp_path: Path, mypy_cache: Path) -> None:
    file = tmp_path / "slow.py"
    file.write_text(STUDENT)
    assert mypy(file, mypy_cache) == (0, "")


def test_type_checker_finds_what_does_not_fit_the_ports(tmp_path: Path, mypy_cache: Path) -> None:
    wrong = {
        "self.state = FollowState(waypoint=1)": "self.state = DriveCommand()",  # record of another output
        "speed_mps: float = self.pose.speed_mps": "speed_mps: float = self.pose.sped_mps",  # field that Pose lacks
        "if self.gps is not None and self.gps.mode": "if self.gps.mode",  # an optional input may be None
        "* self.part * self.times": "* self.part.upper()",  # a parameter is a float
    }
    text = STUDENT
    for right, mistake in wrong.items():
        assert right in text
        text = text.replace(right, mistake)
    file = tmp_path / "wrong.py"
    file.write_text(text)
    code, said = mypy(file, mypy_cache)
    assert code == 1
    lines = text.splitlines()
    for mistake in wrong.values():
        number = next(k for k, line in enumerate(lines, 1) if mistake in line)
        assert f"wrong.py:{number}: error:" in said, (mistake, said)
    assert said.count("error:") == len(wrong), said


def test_class_knows_its_ports() -> None:
    assert list(Cruise.inputs) == ["pose"]
    assert Cruise.inputs["pose"].cls is Pose
    assert list(Cruise.outputs) == ["drive"]
    assert Cruise.outputs["drive"].safe == STOP
    assert (Cruise.params["speed_mps"].default, Cruise.params["speed_mps"].unit) == (2.0, "m/s")


def test_subclass_inherits_ports_and_may_replace_them() -> None:
    assert list(Sprint.outputs) == ["drive", "state"]
    assert Sprint.params["speed_mps"].default == 4.0
    assert Cruise.params["speed_mps"].default == 2.0


def test_parameter_reads_as_its_default() -> None:
    assert Cruise().speed_mps == 2.0


def test_input_read_before_the_first_step_says_where_inputs_are() -> None:
    with pytest.raises(ModuleError, match=r"inputs are there in step\(\), not in reset\(\)"):
        _ = Cruise().pose


def test_output_read_back_says_that_it_is_an_output() -> None:
    with pytest.raises(ModuleError, match="an output is read before it is assigned"):
        _ = Cruise().drive


def test_class_without_a_step_cannot_be_made() -> None:
    class Lazy(Module):
        """Does nothing."""

    with pytest.raises(TypeError, match="step"):
        Lazy()  # type: ignore[abstract]
