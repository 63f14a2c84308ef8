"""Scripts in a mount steer the cart around the square, in a passing scenario, on the barrier of the drive."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from . import rig
from .conftest import NO_COMPILER
from .hands import Mount

pytestmark = pytest.mark.kernel
ROOT = Path(__file__).resolve().parents[4]
EXAMPLES = ROOT / "examples" / "files"


@pytest.fixture
def drive(tmp_path: Path, guest: rig.Guest) -> Iterator[Callable[[str], dict[str, object]]]:
    """Drives the square with a component that a command in a mount is; returns the result.

    The follower is due every 100 ms, as everything was in 2008: a kernel in a process takes long to start programs.
    """
    stack = json.loads((ROOT / "autonomy" / "stacks" / "reference.json").read_text())
    stack["follow"] |= {"module": "files", "every": 10, "params": {}}
    (tmp_path / "stack.json").write_text(json.dumps(stack))
    scenario = (ROOT / "scenarios" / "library" / "parking-lot" / "square.scenario.yaml").read_text()
    scenario = scenario.replace('latency_max_s: "<= 0.060"', 'latency_max_s: "<= 0.120"')  # of a follower every 40 ms
    (tmp_path / "square.scenario.yaml").write_text(scenario + f"stack: {tmp_path}/stack.json\n")
    command = [sys.executable, "-m", "scenarios", "drive", str(tmp_path / "square.scenario.yaml")]
    command += ["--listen", "tcp:127.0.0.1:0", "--token", "follow=square", "--out", str(tmp_path)]
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip

    def run(script: str) -> dict[str, object]:
        assert process.stderr is not None
        line = next(line for line in process.stderr if "port=" in line)
        address = SimpleNamespace(port=int(line.partition("port=")[2].partition(",")[0]))
        mount = Mount(guest, SimpleNamespace(address=address), "version=9p2000.L,cache=none,access=any,aname=square")
        try:
            mount.begin(f"exec {script} {mount.where}")
            said = process.communicate()[1]
        finally:
            mount.unmount()
        assert process.returncode == 0, said
        return json.loads((tmp_path / "parking-lot" / "square" / "0" / "result.json").read_text())

    yield run
    process.kill()
    process.wait()
    process.stderr.close()
    guest.close()  # whatever the script may still be doing there


def test_a_shell_script_steers_the_cart_around_the_square(
    drive: Callable[[str], dict[str, object]], guest: rig.Guest
) -> None:
    shutil.copy(EXAMPLES / "steer.sh", guest.folder)
    assert drive("sh /host/steer.sh")["verdict"] == "PASS"


def test_a_c_program_steers_the_cart_around_the_square(
    drive: Callable[[str], dict[str, object]], guest: rig.Guest, tmp_path: Path
) -> None:
    command = [os.environ.get("CC", "cc"), "-O2", "-Wall", "-Wextra", "-Werror", "-static"]
    try:
        done = subprocess.run(
            [*command, str(EXAMPLES / "steer.c"), "-o", str(tmp_path / "steer"), "-lm"],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
    except FileNotFoundError:
        pytest.skip(NO_COMPILER)
    if done.returncode and "-l" in done.stderr:
        pytest.skip(NO_COMPILER)
    assert done.returncode == 0, done.stderr
    shutil.copy(tmp_path / "steer", guest.folder)
    assert drive("/host/steer")["verdict"] == "PASS"
