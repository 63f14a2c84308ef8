"""Latency: computed from the wiring before anybody drives, and found again in the lineage of a recording."""

from collections import deque
from pathlib import Path
from typing import Any

import pytest

from autonomy.wiring import Stack, Wire, load_stack
from hal.signals import ActuatorCommand, DriveCommand, Odometry, Pose
from rtdb.recording import Recorded, Recording
from scenarios.latency import Latency, latency
from scenarios.run import Setup, drive
from scenarios.scenario import STACKS, load_scenario

MODULES = {
    "localise": ("autonomy.localise:Localise", {"site": "mission/site", "odometry": "odometry/travel"}),
    "follow": ("autonomy.follow:Follow", {"site": "m/site", "course": "m/course", "pose": "localise/pose"}),
    "guard": ("autonomy.guard:Guard", {"drive_in": "follow/drive", "pose": "localise/pose"}),
}


def chain(every: int, phases: dict[str, int]) -> Stack:
    """Make the reference chain with other phases."""
    wires = tuple(Wire(name, MODULES[name][0], every, phase, MODULES[name][1]) for name, phase in phases.items())
    return Stack(wires, "guard/drive")


def test_reference_stack_is_within_sixty_milliseconds() -> None:
    (found,) = latency(load_stack(STACKS / "reference.json"))
    assert found.sensor == "odometry/travel"
    assert found.worst_ticks <= 6
    assert 0 < found.best_ticks <= found.worst_ticks


def test_successive_phases_are_computed_as_by_hand() -> None:
    """Travel of tick 0 shows at 1; modules work at 1, 2, 3; what the guard says goes out at 4 and, once more, at 6."""
    assert latency(chain(4, {"localise": 1, "follow": 2, "guard": 3})) == [Latency("odometry/travel", 4, 6)]


def test_modules_in_the_wrong_order_wait_for_each_other() -> None:
    """The guard works on what the follower said a round before, and the follower on the pose before that."""
    # localise at 3: data of tick 2; follow at 2 of the next round, tick 6; guard at 1 after that, tick 9: burst at 10
    assert latency(chain(4, {"localise": 3, "follow": 2, "guard": 1})) == [Latency("odometry/travel", 8, 10)]


def test_slower_stack_is_later() -> None:
    (quick,) = latency(chain(4, {"localise": 1, "follow": 2, "guard": 3}))
    (slow,) = latency(chain(10, {"localise": 1, "follow": 2, "guard": 3}))
    assert slow.best_ticks == quick.best_ticks
    assert slow.worst_ticks == quick.worst_ticks + 6


def test_order_of_the_entries_in_the_file_does_not_matter() -> None:
    orders = [("localise", "follow", "guard"), ("guard", "follow", "localise"), ("follow", "localise", "guard")]
    phases = {"localise": 1, "follow": 2, "guard": 3}
    assert len({tuple(latency(chain(4, {name: phases[name] for name in order}))) for order in orders}) == 1


def test_stack_that_obeys_no_sensor_has_no_latency() -> None:
    assert latency(Stack(chain(4, {"localise": 1}).wires, "remote/drive")) == []


RECORDS: dict[str, type[Any]] = {
    "actuators/command": ActuatorCommand,
    "guard/drive": DriveCommand,
    "follow/drive": DriveCommand,
    "localise/pose": Pose,
    "odometry/travel": Odometry,
}


def sources(rows: dict[str, dict[int, Recorded[Any]]], command: Recorded[Any], sensor: str) -> set[int]:
    """Follow causes from a command back; returns the data times of the sensor's writes that are behind it."""
    found, left = set(), deque(command.causes)
    while left:
        topic, write = left.popleft()
        if topic == sensor:
            found.add(rows[topic][write].t_data_ns)
        elif topic in rows:
            left += rows[topic][write].causes
    return found


def test_lineage_of_a_drive_shows_exactly_the_latency_that_was_computed(tmp_path: Path) -> None:
    scenario = load_scenario("parking-lot/square").model_copy(update={"duration_s": 6.0})
    drive(Setup(scenario=scenario, level="direct"), tmp_path / "run.mcap")
    recording = Recording(tmp_path / "run.mcap")
    rows = {topic: {row.write: row for row in recording.read(topic, cls)} for topic, cls in RECORDS.items()}
    ages: set[int] = set()
    commands = [row for row in rows["actuators/command"].values() if row.causes]
    assert len(commands) > 250, "all bursts but those before the chain had run for the first time"
    for row in commands:
        behind = sources(rows, row, "odometry/travel")
        if row.cycle > 20:
            assert behind, f"command {row.write} is of no travel"
        sent_ns = recording.t0_ns + (row.cycle - 1) * recording.tick_ns  # it shows one tick after it was sent
        ages |= {(sent_ns - t_ns) // recording.tick_ns for t_ns in behind}
        if behind:
            assert row.t_data_ns == min(behind), "the data time of a command is that of the oldest travel behind it"
    (computed,) = latency(scenario_stack := load_stack(scenario.stack_path()))
    assert scenario_stack.command == "guard/drive"
    assert (min(ages), max(ages)) == (computed.best_ticks, computed.worst_ticks)


@pytest.mark.parametrize("phase", [0, 3])
def test_computed_latency_follows_the_wiring(phase: int) -> None:
    """The guard one or two ticks before the burst that sends what it says, or one tick too late for it."""
    (found,) = latency(chain(4, {"localise": 1, "follow": 2, "guard": phase}))
    assert found.best_ticks == {3: 4, 0: 6}[phase]
