"""What a host costs: time of one cycle of a module beyond its own step, in process, against an empty Python function.

    python benchmarks/host.py [--rounds 7]

The module does nothing but give its output, one or three inputs, each new in every cycle. Part of the cost is the
reading of new records; the row without a new input has none of that.
"""

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path[0] = str(Path(__file__).parents[1])  # beside this file stands rtdb.py, which is not the package

from autonomy import Input, Module, Output
from autonomy.host import Host
from autonomy.wiring import Wire
from hal.signals import STOP, DriveCommand, Odometry, Pose, Site
from rtdb import STATIC, Store

CYCLES = 5000


class One(Module):
    site = Input(Site, static=True)
    pose = Input(Pose, max_age_s=0.25)
    drive = Output(DriveCommand, safe=STOP)

    def step(self) -> None:
        self.drive = STOP


class Three(One):
    odometry = Input(Odometry, max_age_s=0.25)
    drive_in = Input(DriveCommand, max_age_s=0.25)


class Still(One):
    pose = Input(Pose)


class Number(Module):
    speed_mps = Input(float, unit="m/s", max_age_s=0.25)
    drive = Output(DriveCommand, safe=STOP)

    def step(self) -> None:
        self.drive = STOP


THREE = {"pose": "source/pose", "odometry": "source/odometry", "drive_in": "source/drive"}
ROWS: dict[str, tuple[type[Module], dict[str, str], bool, dict[str, Any]]] = {
    "one new record": (One, {"pose": "source/pose"}, True, {}),
    "three new records": (Three, THREE, True, {}),
    "nothing new": (Still, {"pose": "source/pose"}, False, {}),
    "a number of a record": (Number, {"speed_mps": "source/pose#/speed_mps"}, True, {}),
    "one, its step kept for a repro": (One, {"pose": "source/pose"}, True, {"faults": True}),
    "one, with a budget": (One, {"pose": "source/pose"}, True, {"budget_ms": 10.0}),
}  # fmt: skip


def empty() -> None:
    pass


def empty_call_us() -> float:
    """Microseconds of a call of an empty Python function, the loop around it included."""
    begun = time.perf_counter()
    for _ in range(100_000):
        empty()
    return (time.perf_counter() - begun) * 1e6 / 100_000


def step_us(row: str, folder: Path) -> float:
    """Microseconds of a cycle of a module, median over the cycles; ticks and writers are not in it."""
    cls, inputs, new, how = ROWS[row]
    with Store.create(None, deterministic=True) as store:
        mission, source = store.join("mission"), store.join("source")
        mission.insert("site", Site, flags=STATIC).write(Site())
        values = {"pose": Pose(), "odometry": Odometry(), "drive": DriveCommand()}
        writers = [source.insert(name, type(value)) for name, value in values.items()]
        wired = inputs | ({"site": "mission/site"} if "site" in cls.inputs else {})
        wire = Wire("mine", f"{__name__}:{cls.__name__}", 1, 0, wired, budget_ms=how.get("budget_ms"))
        host = Host(store, wire, 0, faults=folder if how.get("faults") else None)
        host.connect()
        step: Callable[[int], None] = host.step
        took = []
        for k in range(CYCLES):
            if new or k == 0:
                for writer, value in zip(writers, values.values(), strict=True):
                    writer.write(value)
            cycle = store.tick()
            begun = time.perf_counter()
            step(cycle)
            took.append(time.perf_counter() - begun)
        assert not host.fault, host.fault
        assert host._steps == CYCLES
    return statistics.median(took) * 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=7)
    args = parser.parse_args()
    calls: list[float] = []
    steps: dict[str, list[float]] = {row: [] for row in ROWS}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(args.rounds):
            calls.append(empty_call_us())
            for row, measured in steps.items():
                measured.append(step_us(row, Path(folder)))
    call_us = statistics.median(calls)
    print(f"an empty Python function: {call_us:.3f} us a call; {CYCLES} cycles, {args.rounds} rounds, A-B-C-A-B-C")
    print("row | us per step, min/median | in calls of an empty function")
    for row, measured in steps.items():
        median_us = statistics.median(measured)
        print(f"{row} | {min(measured):.1f}/{median_us:.1f} | {median_us / call_us:.0f}")


if __name__ == "__main__":
    main()
