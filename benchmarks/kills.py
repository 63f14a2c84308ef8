"""Kill processes of a shared store, one after the other, and see that the others go on.

    python benchmarks/kills.py [KILLS] [--seed 1]

The first half of the kills (10,000 unless told otherwise) is in a real-time store, the second in a barrier store; see
tests/rtdb/kills.c for the roles and for what counts as torn, lost, frozen and leaked. Exits with 1 if anything does.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
CORE = ROOT / "rtdb" / "core"
PROGRAM = ROOT / "tests" / "rtdb" / "kills.c"
ROWS = (
    "clock writer reader waiter churner",
    "in_write between_begin_and_commit in_tick in_change asleep takeovers",
    "within_one_cycle most_cycles_real most_cycles_barrier",
    "cycles reads writes refused changes",
    "torn lost frozen leaked",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kills", nargs="?", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    units = sorted(str(path) for path in CORE.glob("*.c") if path.name != "_core.c")
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "kills"
        compiler = [os.environ.get("CC", "cc"), "-std=c11", "-O2", f"-I{CORE}", *units, str(PROGRAM), "-lpthread"]
        subprocess.run([*compiler, "-o", str(program)], check=True)
        command = [str(program), f"kills-{os.getpid()}", str(args.kills), str(args.seed), str(max(1, args.kills // 10))]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    *complaints, line = done.stdout.splitlines()
    words = line.split()
    seen = {key: int(value) for key, value in zip(words[::2], words[1::2], strict=True)}
    in_mid_write = seen["in_write"] + seen["between_begin_and_commit"]
    print(
        f"{seen['kills']} kills in {seen['milliseconds'] / 1000:.0f} s, {in_mid_write / seen['kills']:.1%} in mid-write"
    )
    for row in ROWS:
        print(" | ".join(f"{name.replace('_', ' ')} {seen[name]}" for name in row.split()))
    print(*complaints, sep="\n")
    sys.exit(done.returncode)


if __name__ == "__main__":
    main()
