"""`fairway new`: what it writes drives, passes its own test and the strict type checker; names that would do harm are
refused."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from autonomy.cli import register
from autonomy.module import ModuleError
from autonomy.starter import KINDS, STARTERS, camel_case, write

ROOT = Path(__file__).resolve().parents[2]
ENV = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "200"}
app = typer.Typer()
register(app)


def new(*args: str) -> tuple[int, str, BaseException | None]:
    done = CliRunner().invoke(app, ["new", *args])
    return done.exit_code, done.output, done.exception


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A student's folder with one module of each kind."""
    place = tmp_path_factory.mktemp("student")
    for kind in KINDS:
        write(f"my_{kind}", kind, place)
    return place


def mypy(folder: Path, cache: Path) -> tuple[int, str]:
    """Run mypy --strict on the files of a folder."""
    command = [sys.executable, "-m", "mypy", "--strict", "--config-file", str(ROOT / "pyproject.toml")]
    command += ["--cache-dir", str(cache), "--no-error-summary", *(str(path) for path in sorted(folder.glob("*.py")))]
    env = ENV | {"MYPYPATH": str(folder)}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


# -- what it writes ---------------------------------------------------------------------------------------------------


def test_command_writes_module_and_test_and_says_what_to_try(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert new("dodge") == (
        0,
        "wrote  dodge.py\n"
        "wrote  test_dodge.py\n"
        "drive  fairway drive parking-lot/square --use follow=dodge.py:Dodge\n"
        "test   pytest test_dodge.py\n",
        None,
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dodge.py", "test_dodge.py"]
    for name in ("dodge.py", "test_dodge.py"):
        text = (tmp_path / name).read_text()
        assert not re.search("follower|starters", text, re.IGNORECASE), text
        assert text.startswith('"""')
    assert "class Dodge(Module):" in (tmp_path / "dodge.py").read_text()


def test_each_kind_has_a_starter_and_each_starter_a_kind() -> None:
    modules = {path.stem for path in STARTERS.glob("*.py")} - {"__init__"}
    assert modules == {name for kind in KINDS for name in (kind, f"test_{kind}")}


def test_starters_are_in_the_wheel() -> None:
    """Hatch takes what is in the packages; nothing but the store's build folder is left out."""
    import tomllib

    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert "autonomy" in wheel["packages"]
    assert wheel["exclude"] == ["rtdb/core/build"]


def test_starters_pass_their_own_tests(folder: Path) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-W", "error", "--rootdir", str(folder)]
    env = ENV | {"PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    passed = re.search(r"(\d+) passed", done.stdout)
    assert passed is not None
    assert int(passed[1]) >= 2 * len(KINDS)


def test_type_checker_passes_each_starter_and_catches_a_wrong_record(
    folder: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    cache = tmp_path_factory.mktemp("mypy")
    assert mypy(folder, cache) == (0, "")
    wanted = []
    for kind in KINDS:
        text = (folder / f"my_{kind}.py").read_text()
        wrong, n = re.subn(r"self\.(drive|pose|route) = .*", r"self.\1 = Site()", text, count=1)
        assert n == 1
        wrong = wrong.replace("from autonomy import", "from hal.signals import Site\nfrom autonomy import", 1)
        wrong = re.sub(r"Site\(\)\n(?= {12}[\w*]| {8}\))(.*\n)*? {8}\)", "Site()", wrong)  # the rest of a long call
        (tmp_path / f"wrong_{kind}.py").write_text(wrong)
        line = next(k for k, text in enumerate(wrong.splitlines(), 1) if "= Site()" in text)
        wanted.append(f"wrong_{kind}.py:{line}: error: Incompatible types in assignment")
    code, said = mypy(tmp_path, cache)
    assert code == 1
    for line in wanted:
        assert line in said, said
    assert said.count("error:") == len(KINDS), said


@pytest.mark.parametrize("kind", KINDS)
def test_starter_drives_with_the_command_that_was_printed(folder: Path, kind: str, tmp_path: Path) -> None:
    name = f"my_{kind}"
    scenario = KINDS[kind].scenario or f"{name}.scenario.yaml"
    use = f"{KINDS[kind].component}={name}.py:{camel_case(name)}"
    command = [sys.executable, "-m", "scenarios.cli", "drive", scenario, "--use", use]
    command += ["--level", "direct", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=folder, env=ENV, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "PASS after" in done.stdout


# -- what it refuses --------------------------------------------------------------------------------------------------

REFUSED = {
    "random": "would hide the package",
    "test": "would hide the package",
    "numpy": "would hide the package",
    "rtdb": "would hide the package",
    "hal": "would hide the package",
    "sim": "would hide the package",
    "autonomy": "would hide the package",
    "scenarios": "would hide the package",
    "pytest": "would hide the package",
    "conftest": "would hide the package",
    "sys": "would hide the package",
    "__main__": "would hide the package",
    "class": "is a word of Python's own",
    "_": "is a word of Python's own",
    "__": "is a word of Python's own",
    "2fast": "is no name",
    "my-module": "is no name",
    "mine.py": "is no name",
    "../mine": "is no name",
    "": "is no name",
    "löwe": "is no name",
    "pose": "would be called Pose, and so is something that it needs",
    "module": "would be called Module",
    "drive_command": "would be called DriveCommand",
}


@pytest.mark.parametrize("name", REFUSED)
def test_name_that_would_do_harm_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, error = new(name)
    assert code != 0
    assert isinstance(error, ModuleError), error
    assert REFUSED[name] in str(error)
    assert "\n" not in str(error)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("there", ["mine.py", "test_mine.py", "mine.scenario.yaml"])
def test_nothing_is_overwritten(tmp_path: Path, there: str) -> None:
    (tmp_path / there).write_text("my work")
    with pytest.raises(ModuleError, match=re.escape(f"{there} is there already")):
        write("mine", "driver", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [there]
    assert (tmp_path / there).read_text() == "my work"


def test_unknown_kind_names_those_that_there_are(tmp_path: Path) -> None:
    with pytest.raises(ModuleError, match="--kind folower: there are follower, avoider, planner, localiser, driver"):
        write("mine", "folower", tmp_path)


def test_command_of_the_program_says_it_in_one_line_with_exit_status_two(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "scenarios.cli", "new", "random"]
    done = subprocess.run(command, cwd=tmp_path, env=ENV, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "'random' would hide the package of that name from your programs; take another name\n"
