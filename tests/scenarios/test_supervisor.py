"""Real-time runs with real processes: who is killed, and what that does to the cart."""

import json
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from live_run import LiveRun
from steady import real_time

from hal.signals import CartTruth
from rtdb.recording import Recording
from scenarios.cart_process import MAKE_UP_TICKS, Seen, ticks_to_work, why_stop
from scenarios.supervisor import RESTARTS, RESTARTS_S, Do, what_to_do

WATCHER = '''\
from autonomy import Input, Module, Output
from hal.signals import GuardState, Pose


class Watcher(Module):
    """Looks on; nobody drives by it."""

    pose = Input(Pose)
    seen = Output(GuardState, safe=GuardState())

    def step(self):
        self.seen = GuardState()
'''
HANGS = '''\
import time

from autonomy.follow import Follow


class Hangs(Follow):
    """Hangs where Python cannot end it."""

    def step(self):
        if self.pose.x_m > 2.0:
            time.sleep(1e9)
        super().step()
'''
STACKS = Path(__file__).resolve().parents[2] / "autonomy" / "stacks"


@pytest.fixture
def live(tmp_path: Path) -> Iterator[Callable[..., LiveRun]]:
    runs = []

    def begin(**how: object) -> LiveRun:
        runs.append(LiveRun(tmp_path, **how))
        return runs[-1]

    yield begin
    for run in runs:
        run.close()


def it_drove_and_stands(run: LiveRun, faster_than_mps: float = 1.0) -> None:
    """In truth, the cart was faster than that, and stands at the end of the recording."""
    truth = [row.value.speed_mps for row in Recording(run.recording).read("world/cart", CartTruth)]
    assert max(truth) > faster_than_mps
    assert abs(truth[-1]) < 0.01


def ends_well(run: LiveRun) -> None:
    """The cart drove and stands, and nothing of the run is left."""
    it_drove_and_stands(run)
    run.until_all_are_gone()
    assert run.left_behind() == []


# -- decisions ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["clock", "hal", "module"])
def test_whom_the_cart_needs_is_never_restarted(kind):
    assert what_to_do(kind, kind == "module", [], 100.0) is Do.STOP


def test_who_ends_too_often_is_left_alone_and_without_a_recorder_there_is_no_run():
    often = [95.0 + k for k in range(RESTARTS)]
    assert what_to_do("module", False, often[1:], 100.0) is Do.RESTART
    assert what_to_do("module", False, often, 100.0) is Do.LEAVE
    assert what_to_do("recorder", False, often, 100.0) is Do.STOP
    assert what_to_do("recorder", False, often, often[0] + RESTARTS_S) is Do.RESTART


def test_hal_stops_the_cart_without_supervisor_or_clock_and_on_order():
    fine = Seen(supervisor_lives=True, clock_lives=True, silent_s=0.01)
    assert why_stop(fine) == ""
    assert why_stop(Seen(supervisor_lives=True, clock_lives=False, silent_s=0.05)) == "", "a standby may take over"
    assert why_stop(Seen(supervisor_lives=True, clock_lives=False, silent_s=0.11)) == "the clock is gone"
    assert why_stop(Seen(supervisor_lives=True, clock_lives=True, silent_s=0.3)) == "the clock stands"
    assert why_stop(Seen(supervisor_lives=False, clock_lives=True, silent_s=0.0)) == "the supervisor is gone"
    assert why_stop(Seen(supervisor_lives=True, clock_lives=True, silent_s=0.0, order="enough")) == "enough"


def test_ticks_that_were_slept_through_are_made_up_for_unless_the_safety_node_would_have_noticed():
    assert list(ticks_to_work(4, 5)) == [5]
    assert list(ticks_to_work(4, 4 + MAKE_UP_TICKS)) == list(range(5, 5 + MAKE_UP_TICKS))
    assert list(ticks_to_work(4, 5 + MAKE_UP_TICKS)) == [5 + MAKE_UP_TICKS]


# -- processes ------------------------------------------------------------------------------------------------------


@real_time
@pytest.mark.proof
def test_a_drive_arrives_in_real_time_restarts_who_is_not_needed_and_leaves_nothing_behind(live, tmp_path):
    stack = json.loads((STACKS / "reference.json").read_text())
    stack["watcher"] = {
        "module": "watcher.py:Watcher", "every": 4, "phase": 3, "inputs": {"pose": "localise/pose"}
    }  # fmt: skip
    (tmp_path / "watcher.py").write_text(WATCHER)
    (tmp_path / "stack.json").write_text(json.dumps(stack))
    run = live(metres=8, stack="stack.json")
    run.until(lambda: run.value("watcher/seen") is not None)
    killed, writes = run.pid("watcher"), run.store.find("watcher/seen").head
    run.kill("watcher")
    run.until(lambda: run.pid("watcher") != killed and run.store.find("watcher/seen").head > writes)
    run.until_it_drives()
    assert sum(run.value("follow/health")["run_us"]) > 0, "a module in a process of its own keeps its own pace"
    assert run.ended() == 0, run.printed
    assert "watcher ended in cycle" in run.printed
    assert "is started anew" in run.printed
    result = json.loads(run.recording.with_name("result.json").read_text())
    assert (result["verdict"], result["metrics"]["waypoints_missed"]) == ("PASS", 0)
    ends_well(run)


@real_time
@pytest.mark.proof
def test_without_a_required_module_the_limits_stop_the_cart_and_it_is_not_restarted(live):
    run = live(metres=100)
    run.until_it_drives()
    run.kill("follow")
    assert run.ended() == 3, run.printed
    assert "follow ended in cycle" in run.printed
    assert "SIGKILL" in run.printed
    result = json.loads(run.recording.with_name("result.json").read_text())
    assert result["verdict"] == "ERROR"
    assert "follow ended in cycle" in result["reason"]
    ends_well(run)


@real_time
@pytest.mark.proof
def test_without_the_supervisor_hal_stops_the_cart_and_all_processes_end(live):
    run = live(metres=100)
    run.until_it_drives()
    run.process.kill()
    run.until_all_are_gone()
    assert "hal: stopping the cart: the supervisor is gone" in run.printed
    assert "hal: the cart stands: the supervisor is gone" in run.printed
    it_drove_and_stands(run)


@real_time
@pytest.mark.proof
def test_without_the_clock_hal_stops_the_cart_on_its_own_time(live):
    run = live(metres=100)
    run.until_it_drives()
    run.kill("clock")
    assert run.ended() == 3, run.printed
    assert "hal: the cart stands: the clock is gone" in run.printed
    assert "clock ended in cycle" in run.printed
    ends_well(run)


@real_time
@pytest.mark.proof
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_who_ends_the_run_stops_the_cart_first(live, number):
    """docs/running.md, which is executed, does it by Ctrl-C. SIGHUP: the terminal is gone, such as that of an ssh."""
    run = live(metres=100)
    run.until_it_drives()
    os.kill(run.process.pid, number)
    assert run.ended() == 130, run.printed
    assert f"{number.name} came, the cart was stopped; the recording up to there is in " in run.printed
    assert "Traceback" not in run.printed
    ends_well(run)


@real_time
@pytest.mark.proof
def test_required_module_that_hangs_is_named_and_the_cart_stands(live, tmp_path):
    stack = json.loads((STACKS / "reference.json").read_text())
    stack["follow"]["module"] = "hangs.py:Hangs"
    (tmp_path / "hangs.py").write_text(HANGS)
    (tmp_path / "stack.json").write_text(json.dumps(stack))
    run = live(metres=30, stack="stack.json")
    assert run.ended() == 3, run.printed
    result = json.loads(run.recording.with_name("result.json").read_text())
    assert result["verdict"] == "ERROR"
    assert "follow hangs: the last cycle that it finished is" in result["reason"]
    it_drove_and_stands(run, faster_than_mps=0.5)
    run.until_all_are_gone()
