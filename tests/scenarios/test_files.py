"""Scripts as components: through the file server, on the barrier of a drive."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
from live_run import LiveRun
from steady import real_time
from typer.testing import CliRunner

from autonomy.wiring import load_stack
from hal.signals import Odometry
from rtdb.recording import Recording
from rtdb.syncfs import Client
from scenarios.cli import app
from scenarios.judge import judge
from scenarios.run import Drive, DriveError, Setup, drive
from scenarios.scenario import Scenario, load_scenario

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples" / "files"
ENV = os.environ | {"PYTHONPATH": str(ROOT)}
TOKEN = "follow-token"
SHORT_S = 8.0


@pytest.fixture(scope="module")
def square() -> Scenario:
    return load_scenario("parking-lot/square")


def setup_of(scenario: Scenario, folder: Path, **how: Any) -> Setup:
    stack = load_stack(scenario.stack_path()).use("follow", "files")
    name = f"test-files-{os.getpid()}-{folder.name}"
    return Setup(
        scenario=scenario, stack=stack, db=name, listen=f"unix:{folder}/9p", tokens={"follow": TOKEN}, **how
    )  # fmt: skip


@contextmanager
def script(folder: Path, *command: str) -> Iterator["subprocess.Popen[str]"]:
    """A script that waits for the server's socket, and then is the component."""
    wait = 'while [ ! -S "$0" ]; do :; done; exec "$@"'
    process = subprocess.Popen(
        ["sh", "-c", wait, f"{folder}/9p", *command, f"unix:{folder}/9p", TOKEN],
        env=ENV, text=True, stderr=subprocess.PIPE,
    )  # fmt: skip
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def steer_py() -> list[str]:
    return [sys.executable, str(EXAMPLES / "steer.py")]


def steered(folder: Path, scenario: Scenario, *command: str, **how: Any) -> Recording:
    with script(folder, *command):
        drive(setup_of(scenario, folder, **how), folder / "run.mcap")
    return Recording(folder / "run.mcap")


@pytest.fixture(scope="module")
def by_python(square: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return steered(tmp_path_factory.mktemp("python"), square, *steer_py())


def test_a_script_steers_the_cart_around_the_square(square: Scenario, by_python: Recording) -> None:
    result = judge(by_python, square.parsed_criteria)
    assert result.verdict == "PASS", result


@pytest.mark.proof
def test_a_drive_by_a_script_is_the_same_to_the_byte_when_it_is_repeated(
    square: Scenario, tmp_path: Path, by_python: Recording
) -> None:
    again = steered(tmp_path, square, *steer_py(), placement="process")
    assert again.trace_hash() == by_python.trace_hash()


@pytest.mark.proof
def test_the_component_in_javascript_drives_as_that_in_python(
    square: Scenario, tmp_path: Path, by_python: Recording
) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed: apt-get install nodejs")
    recording = steered(tmp_path, square, node, str(EXAMPLES / "steer.js"))
    result = judge(recording, square.parsed_criteria)
    assert result.verdict == "PASS", result


@dataclass
class Seen:
    """What a drive showed: follow's health and the guard's reasons in order without repetitions, and the speeds."""

    health: list[Any] = field(default_factory=list)
    reasons: list[Any] = field(default_factory=list)
    speeds_mps: list[float] = field(default_factory=list)

    @property
    def stood_in_the_end(self) -> bool:
        return max(self.speeds_mps) > 1.0 and self.speeds_mps[-1] == 0.0


def note(kept: list[Any], said: Any) -> None:
    if not kept or kept[-1] != said:
        kept.append(said)


def seen(folder: Path, scenario: Scenario, *command: str) -> Seen:
    """Drive with a script, and look on."""
    found = Seen()
    with script(folder, *command), Drive(setup_of(scenario, folder)) as run:
        health, guard, travel = (run.cart.find(name) for name in ("follow/health", "guard/status", "odometry/travel"))
        over = False
        while not over:
            over = run.tick()
            said, reason, moved = (run.cart.snapshot().get(obj) for obj in (health, guard, travel))
            if said is not None:
                note(found.health, (said.value["state"], said.value["status"]))
            if reason is not None:
                note(found.reasons, reason.value["reason"])
            if moved is not None:
                found.speeds_mps.append(moved.value["speed_mps"])
    return found


STRAIGHT = """
import sys
from rtdb.syncfs import Client
with Client.connect(sys.argv[1], sys.argv[2]) as fs:
    for n in range(10**9):
        fs.wait("/follow/clock")
        {then}
        fs.write_json("/follow/status", {{"drive": {{"speed_mps": 2.0, "steer_rad": 0.0, "decel_mps2": 1.0}}}})
"""


def straight(then: str) -> list[str]:
    return [sys.executable, "-c", STRAIGHT.format(then=then)]


@pytest.fixture(scope="module")
def short(square: Scenario) -> Scenario:
    return square.model_copy(update={"duration_s": SHORT_S})


def test_a_script_that_dies_stops_the_cart_and_its_health_says_so(short: Scenario, tmp_path: Path) -> None:
    drove = seen(tmp_path, short, *straight("import os; n < 80 or os.kill(os.getpid(), 9)"))
    assert drove.stood_in_the_end
    state, text = drove.health[-1]
    assert state == "FAILURE"
    assert text.startswith("its connection ended in cycle ")
    assert any("s old" in reason for reason in drove.reasons), "the guard says why it does not pass anything on"


def test_a_script_that_writes_no_json_stops_the_cart_and_its_health_says_so(short: Scenario, tmp_path: Path) -> None:
    then = """if n >= 80:
            fs.rewrite('/follow/status', b'speed: 3')
            continue"""
    drove = seen(tmp_path, short, *straight(then))
    assert drove.stood_in_the_end
    assert any(state == "WARNING" and "not JSON" in text for state, text in drove.health), drove.health


def test_a_script_that_asks_for_too_much_is_not_obeyed(short: Scenario, tmp_path: Path) -> None:
    then = """if n >= 80:
            fs.write_json('/follow/status', {"drive": {"speed_mps": 99.0, "steer_rad": 0.0}})
            continue"""
    drove = seen(tmp_path, short, *straight(then))
    assert drove.stood_in_the_end
    assert any("/speed_mps" in reason and "99" in reason for reason in drove.reasons), drove.reasons


@pytest.mark.proof  # for some seconds
def test_a_script_that_sleeps_is_not_waited_for_for_ever(short: Scenario, tmp_path: Path) -> None:
    drove = seen(tmp_path, short, *straight("n < 80 or __import__('signal').pause()"))
    assert drove.stood_in_the_end
    assert any(state == "FAILURE" and "did not come back" in text for state, text in drove.health), drove.health


def test_a_script_finds_its_wiring_in_its_config_and_others_may_only_read(short: Scenario, tmp_path: Path) -> None:
    look = """if n == 5:
            assert fs.read_json('/follow/config')['inputs']['pose'] == 'localise/pose'
            with Client.connect(sys.argv[1]) as other:
                for path in ('/follow/status', '/follow/config', '/guard/config', '/localise/status'):
                    try:
                        other.write(path, b'{}')
                    except OSError as error:
                        assert error.errno == 13, (path, error)
                    else:
                        raise AssertionError(path)
            try:
                Client.connect(sys.argv[1], 'follow-guess')
            except OSError as error:
                assert error.errno == 13, error
            else:
                raise AssertionError('a wrong token')
            fs.write('/done', b'all of that')
        assert n < 60 or fs.read('/done') == b'all of that'"""
    drove = seen(tmp_path, short.model_copy(update={"duration_s": 3.0}), *straight(look))
    assert drove.speeds_mps[-1] > 1.0, drove.health


def test_what_is_wrong_with_a_server_ends_the_drive_in_one_line(short: Scenario, tmp_path: Path) -> None:
    setup = replace(setup_of(short, tmp_path), listen="tcp:192.0.2.1:5640")
    with pytest.raises(DriveError, match="the process of files ended at once"):
        Drive(setup)


# -- in real time -----------------------------------------------------------------------------------------------------

SLOWLY = """
import sys
from rtdb.syncfs import Client
with Client.connect(sys.argv[1], sys.argv[2]) as fs:
    while True:
        fs.wait("/shell/clock")
        fs.write_json("/shell/status", {"drive": {"speed_mps": 0.7, "steer_rad": 0.0, "decel_mps2": 1.0}})
"""


@real_time
@pytest.mark.proof
def test_a_running_cart_is_wired_to_a_script_and_stands_when_the_script_dies(tmp_path: Path) -> None:
    live = LiveRun(tmp_path, metres=100)
    address = f"unix:{tmp_path}/9p"
    words = ["serve", "--db", live.name, "--listen", address, "--component", "shell:4:2", "--token", f"shell={TOKEN}"]
    server = subprocess.Popen([sys.executable, "-m", "scenarios", *words], env=ENV, stdout=subprocess.DEVNULL)
    try:
        live.until_it_drives()
        with script(tmp_path, sys.executable, "-c", SLOWLY) as slowly:
            live.until(lambda: live.value("shell/status") is not None)
            done = CliRunner().invoke(app, ["wire", live.name, "guard.drive_in=shell/drive", "--yes"])
            assert done.exit_code == 0, done.output
            live.until(lambda: live.value("guard/drive")["speed_mps"] == 0.7)
            with Client.connect(address) as fs:
                fs.wait()  # a mount sees the cut of its last edge
                config = fs.read_json("/guard/config")
                assert config["inputs"]["drive_in"] == "shell/drive"
            slowly.kill()
            live.until(lambda: live.value("guard/drive")["speed_mps"] == 0.0)
        live.until(lambda: live.value("odometry/travel")["speed_mps"] == 0.0)
        assert live.value("shell/health")["state"] == "FAILURE"
    finally:
        server.terminate()
        server.wait()
        live.close()


@real_time
@pytest.mark.proof
def test_a_script_drives_in_real_time(tmp_path: Path) -> None:
    words = ["run", "parking-lot/square", "--use", "follow=files", "--listen", f"unix:{tmp_path}/9p", "--for", "12"]
    words += ["--token", f"follow={TOKEN}", "--out", str(tmp_path)]
    with script(tmp_path, *steer_py()):
        done = subprocess.run(
            [sys.executable, "-m", "scenarios", *words], env=ENV, text=True, capture_output=True, check=False
        )
    assert "ended: 12 s are over" in done.stdout, done.stderr
    moved = Recording(tmp_path / "parking-lot" / "square" / "0-real" / "run.mcap").read("odometry/travel", Odometry)
    assert max(sample.value.speed_mps for sample in moved) > 2.0
