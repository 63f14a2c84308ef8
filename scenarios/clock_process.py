"""The process that ticks a real-time run: `python -m scenarios.clock_process`, its job as JSON on standard input.

The ticks are made by a thread in C. It ends when its standard input does (the supervisor's end, or its wish), but not
before the process `hal` is gone: that still needs ticks to be seen stopping the cart.
"""

import json
import os
import select
import sys

from rtdb import RtdbError, Store, realtime

LOOK_S = 0.1


def run(job: dict[str, object]) -> int:
    """Tick until nobody needs it."""
    wait_for = job["wait_for"]
    assert isinstance(wait_for, list)
    if isinstance(job["priority"], int):  # before the thread begins, which inherits it
        given = realtime(job["priority"])
        if given.refused:
            print(f"clock: no real time: {'; '.join(given.refused)}", file=sys.stderr, flush=True)
    with Store.attach(str(job["store"])) as store, store.run_clock(tuple(wait_for)):
        while not (ended(LOOK_S) and not lives(store, "hal")):
            pass
    return 0


def ended(wait_s: float = 0.0) -> bool:
    """Say whether standard input has ended, or ends within a time."""
    if not select.select([sys.stdin], [], [], wait_s)[0]:
        return False
    return not os.read(sys.stdin.fileno(), 1)


def lives(store: Store, component: str) -> bool:
    """Say whether a process is that component."""
    return any(info.alive for info in store.components() if info.name == component)


def main() -> int:
    """Read the job and run it."""
    try:
        return run(json.loads(sys.stdin.readline()))
    except RtdbError as error:
        print(f"clock: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
