"""The process that records a real-time run: `python -m scenarios.recorder_process`, its job as JSON on standard input.

It looks on: nobody waits for it. Every few ticks it writes the cuts that came since. It ends when its standard input
does, but not before the process `hal` is gone: the stop of the cart belongs to the recording.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

from rtdb import Object, RtdbError, Store
from rtdb.recorder import Recorder

from .clock_process import ended, lives

TICKS = 5  # from one look to the next: shorter than any history
BEHIND = 30  # cycles: a store that is so far behind the other stands, and is waited for no longer
LOOK_S = 0.1
FOREVER = 1 << 62


def run(job: dict[str, Any]) -> int:
    """Record until everything has come to its end."""
    with Store.attach(job["store"]) as cart, Store.attach(job["world"]) as world:
        while cart.wait_cycle(0, LOOK_S) is None:
            if ended():
                return 0  # nothing ever happened
        told_to_end = False
        cart.join("recorder")  # so that tools see it
        orders = cart.find("supervisor/orders")
        with Recorder(Path(job["file"]), [cart, world], job["metadata"]) as recorder:
            while not (told_to_end and not lives(cart, "hal")):
                if cart.wait_cycle(cart.cycle + TICKS - 1, LOOK_S) is None and not cart.clock.alive:
                    time.sleep(LOOK_S)  # nobody ticks: the world may go on by itself
                recorder.catch_up(min(_until(cart.cycle, world.cycle), _last(orders)))
                told_to_end = told_to_end or ended()
            recorder.catch_up(min(max(cart.cycle, world.cycle), _last(orders)))
            if recorder.lost:
                print(f"recorder: came too late for {recorder.lost} writes", file=sys.stderr, flush=True)
    return 0


def _until(cart: int, world: int) -> int:
    """Say up to which cycle both stores are known, or will not be."""
    return max(min(cart, world), max(cart, world) - BEHIND)


def _last(orders: Object[Any]) -> int:
    """Give the last cycle of the drive: how the supervisor stops the cart after it is no part of it."""
    sample = orders.latest()
    return int(sample.value.get("recorded", FOREVER)) if sample is not None else FOREVER


def main() -> int:
    """Read the job and run it."""
    try:
        return run(json.loads(sys.stdin.readline()))
    except (RtdbError, OSError) as error:
        print(f"recorder: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
