"""How late a process wakes up that sleeps until a time: a plain one, and what `rtdb.realtime` makes of it.

    python benchmarks/wakeup.py [--seconds 10] [--period-ms 10]

The first row is the yardstick. "stolen" is time that a hypervisor gave to others meanwhile (/proc/stat): what is late
because of it, nothing in here can help.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

sys.path[0] = str(Path(__file__).parents[1])  # beside this file stands rtdb.py, which is not the package

from rtdb import realtime

WAYS: dict[str, dict[str, bool] | None] = {
    "any process": None,
    "SCHED_FIFO, locked memory": {"keep_awake": False},
    "the same, CPUs kept awake": {"keep_awake": True},
}


def stolen_s() -> float:
    """Time that a hypervisor gave to others, of all CPUs together."""
    return int(Path("/proc/stat").read_text().split()[8]) / os.sysconf("SC_CLK_TCK")


def sleep(way: dict[str, bool] | None, seconds: float, period_s: float) -> None:
    """Sleep again and again; tells how late each time, in us, sorted, and what the system refused."""
    refused = () if way is None else realtime(**way).refused
    late_us, next_s = [], time.monotonic() + period_s
    end_s = next_s + seconds
    while next_s < end_s:
        time.sleep(max(0.0, next_s - time.monotonic()))
        late_us.append(1e6 * (time.monotonic() - next_s))
        next_s = max(next_s, time.monotonic()) + period_s
    print(json.dumps({"late_us": sorted(late_us), "refused": refused}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--period-ms", type=float, default=10.0)
    parser.add_argument("--job", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.job:
        sleep(json.loads(args.job), args.seconds, 1e-3 * args.period_ms)
        return
    print(
        f"{os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}; a sleep every {args.period_ms:g} ms, {args.seconds:g} s"
    )
    yardstick = None
    for text, way in WAYS.items():
        before_s = stolen_s()
        command = [sys.executable, __file__, "--job", json.dumps(way), "--seconds", str(args.seconds)]
        done = subprocess.run([*command, "--period-ms", str(args.period_ms)], stdout=subprocess.PIPE, check=True)
        told = json.loads(done.stdout)
        late = told["late_us"]
        median, p99, worst = late[len(late) // 2], late[len(late) * 99 // 100], late[-1]
        yardstick = yardstick or p99
        print(
            f"  {text:26} late by: median {median:6.0f} us, p99 {p99:6.0f} us ({p99 / yardstick:.2f}), "
            f"max {worst:6.0f} us; stolen {1e3 * (stolen_s() - before_s):.0f} ms"
            + "".join(f"\n    refused: {line}" for line in told["refused"]),
            flush=True,
        )


if __name__ == "__main__":
    main()
