"""How fast a drive runs, first to last cycle with recording, imports apart: times real time, per level.

    python benchmarks/drive.py [SCENARIO] [--rounds 5]

The yardstick of the same run is bare pybullet: 24 steps at 240 Hz of one free 480 kg box, without gravity or contact,
for every 0.1 s of drive.
"""

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path

sys.path[0] = str(Path(__file__).parents[1])  # beside this file stands rtdb.py, which is not the package

import filterpy.kalman  # noqa: F401 - imports are not what is measured
import pybullet

from rtdb.recording import Recording
from scenarios.run import Setup, drive
from scenarios.scenario import load_scenario


def yardstick(client: int, driven_s: float) -> float:
    """Seconds that bare pybullet takes for a drive of that length."""
    begun = time.perf_counter()
    for _ in range(round(driven_s * 240)):
        pybullet.stepSimulation(physicsClientId=client)
    return time.perf_counter() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario", nargs="?", default="p545/field-trial")
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    scenario = load_scenario(args.scenario)
    client = pybullet.connect(pybullet.DIRECT)
    shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[1.2, 0.6, 0.5], physicsClientId=client)
    pybullet.createMultiBody(480.0, shape, physicsClientId=client)
    pybullet.setTimeStep(1 / 240, physicsClientId=client)
    wall: dict[str, list[float]] = {"wire": [], "direct": [], "bare pybullet": []}
    cpu: dict[str, list[float]] = {"wire": [], "direct": [], "bare pybullet": []}
    driven_s = 0.0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        for _ in range(args.rounds):
            for level in ("wire", "direct"):
                begun: list[float] = []
                setup = Setup(scenario=scenario, level=level)  # type: ignore[arg-type]
                drive(setup, path, begin=lambda _, at=begun: at.extend((time.perf_counter(), time.process_time())))
                wall[level].append(time.perf_counter() - begun[0])
                cpu[level].append(time.process_time() - begun[1])
                recording = Recording(path)
                driven_s = recording.time_s(recording.last_cycle)
            begun_cpu = time.process_time()
            wall["bare pybullet"].append(yardstick(client, driven_s))
            cpu["bare pybullet"].append(time.process_time() - begun_cpu)
    print(f"{scenario.id}: {driven_s:.1f} s driven, {args.rounds} rounds, A-B-C-A-B-C")
    print("row | wall s min/median | times real time, median/best | CPU s median | CPU over bare pybullet")
    bare = statistics.median(cpu["bare pybullet"])
    for row, walls in wall.items():
        median_s, cpu_s = statistics.median(walls), statistics.median(cpu[row])
        times = f"{driven_s / median_s:.0f}/{driven_s / min(walls):.0f}"
        print(f"{row} | {min(walls):.2f}/{median_s:.2f} | {times} | {cpu_s:.2f} | {cpu_s / bare:.2f}")


if __name__ == "__main__":
    main()
