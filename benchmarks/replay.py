"""How long a recording takes to become a rerun file, imports apart: CPU and wall seconds, also per 60 s of drive.

    python benchmarks/replay.py [SCENARIO] [--rounds 5]

"read" is what every command that looks at a recording pays; "convert" is what the replay adds.
"""

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path

sys.path[0] = str(Path(__file__).parents[1])  # beside this file stands rtdb.py, which is not the package

from rtdb.recording import Recording
from scenarios.judge import judge
from scenarios.replay import convert
from scenarios.run import Setup, drive
from scenarios.scenario import load_scenario


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario", nargs="?", default="p545/field-trial")
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    scenario = load_scenario(args.scenario)
    cpu: dict[str, list[float]] = {"read": [], "convert": []}
    wall: dict[str, list[float]] = {"read": [], "convert": []}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        drive(Setup(scenario=scenario), path)
        recording = Recording(path)
        result = judge(recording, scenario.parsed_criteria)
        for _ in range(args.rounds):
            for name, spent in cpu.items():
                begun, begun_cpu = time.perf_counter(), time.process_time()
                if name == "read":
                    recording = Recording(path)
                else:
                    convert(recording, result, path.with_suffix(".rrd"))
                wall[name].append(time.perf_counter() - begun)
                spent.append(time.process_time() - begun_cpu)
        driven_s = recording.time_s(recording.last_cycle)
        size_mb = path.with_suffix(".rrd").stat().st_size / 1e6
    writes = sum(len(channel.raw) for channel in recording.channels.values())
    print(f"{scenario.id}: {driven_s:.1f} s driven, {writes} writes, {size_mb:.1f} MB, {args.rounds} rounds")
    print("row | CPU s min/median | wall s min/median | CPU s median per 60 s of drive")
    for name, spent in cpu.items():
        print(
            f"{name} | {min(spent):.3f}/{statistics.median(spent):.3f} | {min(wall[name]):.3f}/"
            f"{statistics.median(wall[name]):.3f} | {statistics.median(spent) * 60 / driven_s:.3f}"
        )


if __name__ == "__main__":
    main()
