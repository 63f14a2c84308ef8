"""The `fairway` command as a user meets it: exit codes, one clear line for what is wrong, Ctrl-C, what is left."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from steady import real_time

from hal.signals import Odometry
from rtdb import Store, StoreMissing
from rtdb.recording import Recording
from rtdb.syncfs import Client
from scenarios import cli
from scenarios.judge import Verdict

ROOT = Path(__file__).resolve().parents[2]
ENV = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "120"}

SHORT = """\
id: test/short
about: A start and a few metres.
site: pad
course: {speed_mps: 2, waypoints: [{east_m: 40, north_m: 0}]}
duration_s: 3
criteria:
  decel_max_mps2: "<= 1.8"
"""

MODULES = '''\
from autonomy import Input, Module, Output
from hal.signals import STOP, Course, DriveCommand, FollowState, Pose, Site


class Gentle(Module):
    """Straight on, slowly."""

    site = Input(Site, static=True)
    course = Input(Course, static=True)
    pose = Input(Pose, max_age_s=0.25)
    drive = Output(DriveCommand, safe=STOP)
    state = Output(FollowState, safe=FollowState())

    def step(self):
        self.drive = DriveCommand(speed_mps=0.5)
        self.state = FollowState()


class Broken(Gentle):
    """Breaks on the way."""

    def step(self):
        super().step()
        if self.t_ns % 1_000_000_000 > 500_000_000:
            raise ValueError("lost my way")


class Quitter(Gentle):
    """Tries to end the program as if all were well."""

    def step(self):
        raise SystemExit(0)


class Mute(Module):
    """Has not the outputs that the guard needs."""

    site = Input(Site, static=True)
    course = Input(Course, static=True)
    pose = Input(Pose)
    speech = Output(FollowState, safe=FollowState())

    def step(self):
        self.speech = FollowState()


class Unfinished(Gentle):
    def step(self):
        return self.reset(1)


class NoStep(Module):
    pose = Input(Pose)
'''


def fairway(*args: object) -> "subprocess.CompletedProcess[str]":
    """Run the command in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "scenarios.cli", *map(str, args)], env=ENV, capture_output=True, text=True, check=False
    )


Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    """Run the command in this process, which is quicker; returns exit code, standard output, standard error."""

    def run(*args: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["fairway", *map(str, args)])
        monkeypatch.setenv("COLUMNS", "120")
        monkeypatch.chdir(tmp_path)
        capfd.readouterr()
        with pytest.raises(SystemExit) as done:
            cli.main()
        code = done.value.code
        assert code is None or isinstance(code, int)
        return (code or 0, *capfd.readouterr())

    return run


@pytest.fixture
def short(tmp_path: Path) -> Path:
    file = tmp_path / "short.scenario.yaml"
    file.write_text(SHORT)
    return file


@pytest.fixture
def modules(tmp_path: Path) -> Path:
    file = tmp_path / "modules.py"
    file.write_text(MODULES)
    return file


def name_of(purpose: str) -> str:
    return f"test-cli-{os.getpid()}-{purpose}"


def segment(name: str) -> Path:
    return Path(f"/dev/shm/fairway-{os.getuid()}-{name}")


def one_line(code: int, err: str, *words: str) -> None:
    """Bad input: exit code 2 and one line that holds the words."""
    assert code == 2, err
    assert err.endswith("\n")
    assert err.count("\n") == 1, err
    assert "Traceback" not in err
    for word in words:
        assert word in err


# -- exit codes -------------------------------------------------------------------------------------------------------


def test_drive_that_passes_exits_with_zero_and_a_table(short: Path, tmp_path: Path) -> None:
    run = fairway("drive", short, "--out", tmp_path / "runs", "--level", "direct")
    assert (run.returncode, run.stderr) == (0, "")
    assert re.search(r"decel_max_mps2 .* <= 1\.8 m/s2 .* PASS", run.stdout)
    assert "PASS after 3.0 s of driving" in run.stdout
    folder = tmp_path / "runs" / "test" / "short" / "0"
    assert json.loads((folder / "result.json").read_text())["verdict"] == Verdict.PASS
    assert Recording(folder / "run.mcap").complete


def test_drive_that_fails_exits_with_one_and_says_by_how_much(here: Run, short: Path, tmp_path: Path) -> None:
    short.write_text(SHORT + '  final_speed_mps: "<= 0.001"\n')
    code, out, err = here("drive", short, "--level", "direct")
    assert (code, err) == (1, "")
    assert re.search(r"final_speed_mps .* <= 0\.001 m/s .* 3\.00 s .* FAIL", out)
    assert "FAIL after 3.0 s" in out


def test_criterion_that_cannot_be_measured_does_not_pass(here: Run, short: Path) -> None:
    short.write_text(SHORT + '  brake_delay_s: "<= 1"\n')
    code, out, _ = here("drive", short, "--level", "direct")
    assert code == 1
    assert re.search(r"brake_delay_s .* not measured .* UNKNOWN", out)


def test_runs_of_different_seeds_stand_beside_each_other(here: Run, short: Path, tmp_path: Path) -> None:
    for seed in (3, 4):
        assert here("drive", short, "--level", "direct", "--seed", seed)[0] == 0
    traces = {
        json.loads((tmp_path / "runs" / "test" / "short" / str(seed) / "result.json").read_text())["trace"]
        for seed in (3, 4)
    }
    assert len(traces) == 2


# -- bad input --------------------------------------------------------------------------------------------------------


def test_unknown_scenario_is_one_line_with_the_one_that_was_meant() -> None:
    run = fairway("drive", "parking-lot/sqare")
    one_line(run.returncode, run.stderr, "no scenario 'parking-lot/sqare'", "did you mean parking-lot/square?")
    assert run.stdout == ""


def test_misspelt_key_is_one_line_with_file_line_key_and_suggestion(here: Run, short: Path) -> None:
    short.write_text(SHORT.replace("duration_s: 3", "duration_s: 3\nstrat: {east_m: 1}"))
    code, _, err = here("drive", short)
    one_line(code, err, f"{short}:6: strat: unknown key; did you mean start?")


def test_impossible_value_is_one_line_with_file_line_and_key(here: Run, short: Path) -> None:
    short.write_text(SHORT.replace("speed_mps: 2", "speed_mps: -2"))
    code, _, err = here("drive", short)
    one_line(code, err, f"{short}:4: course.speed_mps: ", "greater than 0", "-2")


def test_damaged_yaml_is_one_line_with_file_and_line(here: Run, short: Path) -> None:
    short.write_text(SHORT.replace("course: {", "course: [{"))
    code, _, err = here("drive", short)
    one_line(code, err, str(short), "not YAML")
    assert re.search(r"\.yaml:[45]: ", err)


def test_missing_file_is_one_line(here: Run, tmp_path: Path) -> None:
    code, _, err = here("drive", tmp_path / "none.scenario.yaml")
    one_line(code, err, f"no file {tmp_path / 'none.scenario.yaml'}")


def test_missing_stack_is_one_line(here: Run, short: Path) -> None:
    short.write_text(SHORT + "stack: refrence\n")
    code, _, err = here("drive", short)
    one_line(code, err, "no stack file", "refrence.json")


@pytest.mark.parametrize(
    ("option", "value", "word"),
    [
        ("--level", "os", "direct, wire"),
        ("--plant", "c", "compiled, python"),
        ("--seed", "-1", "--seed"),
        ("--seed", "x", "--seed"),
        ("--pace", "0", "--pace"),
    ],
)
def test_bad_option_is_refused_with_its_name(here: Run, short: Path, option: str, value: str, word: str) -> None:
    code, _, err = here("drive", short, option, value)
    assert code == 2
    assert "Traceback" not in err
    assert option in err
    assert word in err


@pytest.mark.parametrize(
    ("use", "words"),
    [
        ("follow=nowhere.py:Follow", ["no file nowhere.py", "COMPONENT=FILE.py:Class"]),
        ("follow={modules}:Genle", ["modules.py has no Module named Genle", "Gentle, Broken"]),
        ("folow={modules}:Gentle", ["--use folow", "localise, follow, guard"]),
        ("{modules}", ["COMPONENT=FILE.py:Class"]),
        ("follow={modules}", ["FILE.py:Class"]),
        ("follow={modules}:NoStep", ["NoStep", "step"]),
        ("follow={modules}:Mute", ["guard.drive_in = follow/drive"]),
        ("guard={modules}:Gentle", ["guard: Gentle has no input drive_in"]),
    ],
)
def test_bad_use_is_one_line(here: Run, short: Path, modules: Path, use: str, words: list[str]) -> None:
    code, _, err = here("drive", short, "--use", use.format(modules=modules))
    one_line(code, err, *words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 / 0\n", ["ZeroDivisionError", "division by zero"]),
        ("import nowhere\n", ["No module named 'nowhere'"]),
        ("class Follow(\n", ["SyntaxError", "line 1"]),
        ("raise SystemExit(0)\n", ["SystemExit"]),
    ],
)
def test_module_that_cannot_be_imported_is_one_line_with_the_cause(
    here: Run, short: Path, tmp_path: Path, text: str, words: list[str]
) -> None:
    file = tmp_path / "student.py"
    file.write_text(text)
    code, _, err = here("drive", short, "--use", f"follow={file}:Follow")
    one_line(code, err, str(file), *words)


def test_out_in_a_place_that_cannot_be_written_is_one_line(here: Run, short: Path) -> None:
    code, _, err = here("drive", short, "--out", short / "runs")  # a file is in the way, for root as well
    one_line(code, err, str(short), "Not a directory")


# -- modules that break -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cls", "reason"), [("Broken", "ValueError: lost my way"), ("Quitter", "SystemExit"), ("Unfinished", "TypeError")]
)
def test_module_that_breaks_in_a_step_is_an_error_with_its_reason(
    short: Path, modules: Path, tmp_path: Path, cls: str, reason: str
) -> None:
    run = fairway("drive", short, "--level", "direct", "--use", f"follow={modules}:{cls}", "--out", tmp_path / "runs")
    assert run.returncode == 3
    assert "ERROR after" in run.stdout
    assert f"{reason}" in run.stdout
    assert re.search(r"follow: cycle \d+: ", run.stdout)
    assert "Traceback" not in run.stdout + run.stderr
    written = json.loads((tmp_path / "runs" / "test" / "short" / "0" / "result.json").read_text())
    assert written["verdict"] == Verdict.ERROR
    assert reason in written["reason"]


def test_swapped_module_drives(here: Run, short: Path, modules: Path, tmp_path: Path) -> None:
    assert here("drive", short, "--level", "direct")[0] == 0
    result = tmp_path / "runs" / "test" / "short" / "0" / "result.json"
    before = json.loads(result.read_text())["trace"]
    assert here("drive", short, "--level", "direct", "--use", f"follow={modules}:Gentle")[0] == 0
    assert json.loads(result.read_text())["trace"] != before


# -- a running drive --------------------------------------------------------------------------------------------------


class Running:
    """A drive in another process, on a store that can be attached to."""

    def __init__(self, name: str, out: Path, *args: object, scenario: object = "parking-lot/square") -> None:
        self.name, self.folder = name, out / "parking-lot" / "square" / "0"
        command = [sys.executable, "-m", "scenarios.cli", "drive", str(scenario), "--level", "direct"]
        self.process = subprocess.Popen(
            [*command, "--out", str(out), "--db", name, *map(str, args)],
            env=ENV,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def until(self, reached: Callable[[], bool]) -> None:
        """Return once something is so; fail if the drive ends before."""
        while not reached():
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(0.005)
                pytest.fail(f"it ended: {self.process.communicate()}")

    def maps(self, part: str) -> bool:
        """Say whether the process has a file mapped."""
        with suppress(FileNotFoundError, ProcessLookupError):
            return part in Path(f"/proc/{self.process.pid}/maps").read_text()
        return False

    def attach(self) -> Store:
        found: list[Store] = []

        def there() -> bool:
            with suppress(StoreMissing):
                found.append(Store.attach(self.name))
            return bool(found)

        self.until(there)
        return found[0]

    def until_cycle(self, cycle: int) -> None:
        with self.attach() as store:
            now = 0
            while now < cycle:
                new = store.wait_cycle(now, 10.0)
                assert new is not None, f"the clock stands at {now}"
                now = new

    def interrupt(self, number: int = signal.SIGINT) -> tuple[int, str, str]:
        """Press Ctrl-C, whose signal goes to the whole group, or send another. Returns exit code and what was said."""
        if number == signal.SIGINT:
            os.killpg(self.process.pid, number)
        else:
            self.process.send_signal(number)
        out, err = self.process.communicate(timeout=60)
        return self.process.returncode, out, err

    def end(self) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.communicate()
        segment(self.name).unlink(missing_ok=True)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Callable[..., Running]]:
    started: list[Running] = []

    def start(purpose: str, *args: object, **how: object) -> Running:
        started.append(Running(name_of(purpose), tmp_path / "runs", *args, **how))
        return started[-1]

    yield start
    for drive in started:
        drive.end()


@real_time
def test_store_of_a_running_drive_can_be_looked_into_and_is_not_given_twice(
    running: Callable[..., Running], here: Run, tmp_path: Path
) -> None:
    drive = running("look", "--pace", 1)
    drive.until_cycle(20)

    code, out, err = here("db", "ls", "--db", drive.name)
    assert (code, err) == (0, "")
    assert re.search(r"^ *odometry/travel +Odometry +1 +0 +\d+ +\d\.\d\d s +odometry *$", out, re.MULTILINE)
    assert "CartTruth" not in out
    assert "world" not in out

    code, out, err = here("db", "get", "odometry/travel", "--db", drive.name)
    assert (code, err) == (0, "")
    assert re.match(r"odometry/travel  Odometry  write \d+, \d\.\d\d s old, cycle \d+\n", out)
    for field in Odometry.__struct_fields__:
        assert f"\n  {field} = " in out
    assert re.search(r"speed_mps = \S+ m/s\n", out)

    code, _, err = here("db", "get", "odometry/travl", "--db", drive.name)
    one_line(code, err, "no object 'odometry/travl'", drive.name, "did you mean odometry/travel?")

    code, _, err = here("db", "get", "zzz", "--db", drive.name)
    one_line(code, err, "no object 'zzz'", "it has actuators/command, ")

    second = fairway("drive", "parking-lot/square", "--db", drive.name, "--out", tmp_path / "second")
    one_line(second.returncode, second.stderr, drive.name, "a living process holds it", "use another name")
    assert drive.process.poll() is None, "the first one drives on"
    with Store.attach(drive.name) as store:
        assert store.wait_cycle(store.cycle, 10.0) is not None


def test_store_that_is_not_there_is_one_line_with_how_to_start_it(here: Run) -> None:
    for command in (["ls"], ["get", "gps/fix"]):
        code, _, err = here("db", *command, "--db", name_of("none"))
        one_line(code, err, name_of("none"), f"fairway drive --db {name_of('none')}")


@pytest.fixture
def junk() -> Iterator[str]:
    name = name_of("junk")
    yield name
    segment(name).unlink(missing_ok=True)


@pytest.mark.parametrize("data", [b"", b"junk", bytes(4096), b"\xff" * 100_000], ids=["empty", "short", "zero", "ones"])
def test_junk_in_place_of_a_store_is_one_line(here: Run, junk: str, data: bytes) -> None:
    segment(junk).write_bytes(data)
    for command in (["ls"], ["get", "gps/fix"]):
        code, _, err = here("db", *command, "--db", junk)
        one_line(code, err, junk)
    assert segment(junk).read_bytes() == data, "looking changes nothing"


def test_drive_replaces_junk_that_nobody_holds(here: Run, short: Path, junk: str) -> None:
    segment(junk).write_bytes(b"junk" * 5000)
    assert here("drive", short, "--level", "direct", "--db", junk)[0] == 0
    assert not segment(junk).exists()


@pytest.mark.parametrize("name", ["a b", "../up", "a/b", "x" * 300])
def test_name_that_no_store_can_have_is_one_line(here: Run, short: Path, name: str) -> None:
    code, _, err = here("drive", short, "--db", name)
    one_line(code, err)


# -- Ctrl-C -----------------------------------------------------------------------------------------------------------


def nothing_left(drive: Running) -> None:
    assert not segment(drive.name).exists()
    with pytest.raises(ProcessLookupError):
        os.killpg(drive.process.pid, 0)  # nobody is left in its session


@real_time
@pytest.mark.parametrize("library", ["_pydantic_core", "numpy/_core/_multiarray_umath", "pybullet"])
def test_ctrl_c_during_start_up_is_one_line(running: Callable[..., Running], library: str) -> None:
    drive = running("start", "--pace", 1)
    drive.until(lambda: drive.maps(library))
    code, out, err = drive.interrupt()
    assert code == 130, err
    assert re.fullmatch(r"interrupted.*\n", err)
    assert out == ""
    assert not (drive.folder / "result.json").exists()
    nothing_left(drive)


@real_time
def test_ctrl_c_as_the_store_appears_is_one_line(running: Callable[..., Running]) -> None:
    drive = running("appear", "--pace", 1)
    drive.until(segment(drive.name).exists)
    code, _, err = drive.interrupt()
    assert code == 130, err
    assert re.fullmatch(r"interrupted.*\n", err)
    nothing_left(drive)


@real_time
@pytest.mark.parametrize(("cycle", "number"), [(1, signal.SIGINT), (33, signal.SIGTERM), (150, signal.SIGINT)])
def test_ctrl_c_in_mid_drive_is_one_line_and_keeps_the_recording(
    running: Callable[..., Running], cycle: int, number: int
) -> None:
    drive = running("mid", "--pace", 4)
    drive.until_cycle(cycle)
    code, out, err = drive.interrupt(number)
    assert code == 130, err
    assert err == f"interrupted; the recording up to there is in {drive.folder / 'run.mcap'}\n"
    assert out == ""
    recording = Recording(drive.folder / "run.mcap")
    assert recording.complete
    assert recording.last_cycle >= cycle - 1
    if cycle > 110:
        assert recording.read("odometry/travel", Odometry)
    assert not (drive.folder / "result.json").exists(), "no verdict on half a drive"
    nothing_left(drive)


@real_time
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_drive_that_waits_for_a_script_leaves_nothing_when_it_is_ended(
    running: Callable[..., Running], tmp_path: Path, number: int
) -> None:
    drive = running("waits", "--use", "follow=files", "--listen", f"unix:{tmp_path}/files")
    drive.until((tmp_path / "files").exists)
    code, _, err = drive.interrupt(number)
    assert code == 130, err
    assert err.endswith("interrupted\n")
    nothing_left(drive)
    assert not (tmp_path / "files").exists()


@real_time
def test_a_drive_whose_script_looks_around_first_ends_when_it_is_asked_to(
    running: Callable[..., Running], tmp_path: Path
) -> None:
    """The script has attached, so the first cycle is due, and the barrier waits for it."""
    address = f"unix:{tmp_path}/files"
    drive = running("looks", "--use", "follow=files", "--listen", address, "--token", "follow=me")
    drive.until((tmp_path / "files").exists)
    with Client.connect(address, "me") as script:
        drive.until_cycle(2)
        assert "status" in script.ls("/follow")
        code, _, err = drive.interrupt(signal.SIGTERM)
    assert code == 130, err
    assert f"interrupted; the recording up to there is in {drive.folder / 'run.mcap'}\n" in err
    nothing_left(drive)


@real_time
def test_ctrl_c_ends_the_processes_of_a_shuffled_drive(running: Callable[..., Running]) -> None:
    drive = running("shuffled", "--pace", 2, "--shuffle", 3)
    drive.until_cycle(30)
    children = Path(f"/proc/{drive.process.pid}/task/{drive.process.pid}/children").read_text().split()
    assert children, "modules are in processes of their own"
    code, _, err = drive.interrupt()
    assert code == 130, err
    assert err.startswith("interrupted; ")
    assert err.count("\n") == 1
    nothing_left(drive)


@real_time
def test_old_verdict_does_not_stand_beside_the_recording_of_an_interrupted_drive(
    running: Callable[..., Running],
) -> None:
    drive = running("old", "--pace", 4)
    drive.folder.mkdir(parents=True, exist_ok=True)
    (drive.folder / "result.json").write_text("{}")
    drive.until_cycle(50)
    assert drive.interrupt()[0] == 130
    assert not (drive.folder / "result.json").exists()


# -- the other commands -----------------------------------------------------------------------------------------------


def test_help_loads_nothing_that_costs_time() -> None:
    code = (
        "import sys; from scenarios.cli import app\n"
        "try: app(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = ('numpy', 'pybullet', 'cv2', 'rerun', 'gymnasium', 'filterpy', 'scipy', 'pydantic', 'mcap')\n"
        "print('LOADED', [name for name in heavy if name in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], env=ENV, capture_output=True, text=True, check=True)
    assert "drive" in run.stdout
    assert run.stdout.splitlines()[-1] == "LOADED []"


def test_every_command_has_help(here: Run) -> None:
    for command in ([], ["drive"], ["latency"], ["db"], ["db", "ls"], ["db", "get"], ["hal"], ["hal", "play"]):
        code, out, _ = here(*command, "--help")
        assert code == 0
        assert "Usage:" in out


def test_latency_of_the_reference_stack_is_at_most_sixty_milliseconds(here: Run) -> None:
    code, out, _ = here("latency")
    assert code == 0
    best_ms, worst_ms = map(int, re.search(r"odometry/travel -> guard/drive -> bus: (\d+) to (\d+) ms", out).groups())  # type: ignore[union-attr]
    assert 0 < best_ms <= worst_ms <= 60
    for component in ("localise", "follow", "guard"):
        assert re.search(rf"  {component}: every 40 ms at \d+ ms", out)


def test_latency_of_a_stack_of_ones_own(here: Run, tmp_path: Path) -> None:
    stack = json.loads((ROOT / "autonomy" / "stacks" / "reference.json").read_text())
    stack["guard"]["phase"] = 2  # together with follow: it sees what follow said a round before
    (tmp_path / "mine.json").write_text(json.dumps(stack))
    code, out, _ = here("latency", tmp_path / "mine.json")
    assert code == 0
    assert "80 to 100 ms" in out


@pytest.mark.parametrize(
    ("stack", "words"),
    [("refrence", ["no stack file", "refrence.json"]), ("none.json", ["no stack file", "none.json"])],
)
def test_latency_of_a_stack_that_is_not_there_is_one_line(here: Run, stack: str, words: list[str]) -> None:
    code, _, err = here("latency", stack)
    one_line(code, err, *words)


def test_capture_that_is_not_there_is_one_line(here: Run) -> None:
    code, _, err = here("hal", "play", "none.log")
    one_line(code, err, "none.log")
