"""A process that runs modules on a shared store: `python -m autonomy.process`, its job as JSON on standard input.

It attaches to the cart's store alone. It is a participant: the clock waits for it, as long as it lives.
"""

import json
import logging
import random
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from rtdb import RtdbError, Store

from .contain import limit_memory
from .host import Host
from .module import ModuleError
from .wiring import Wire, wire_of

CONNECT_S = 30.0
MEMORY_MB = 4096  # of a module that does not say
MAX_DELAY_S = 0.0005  # of a shuffled run


def spawn(
    store_name: str,
    wires: tuple[Wire, ...],
    seed: int,
    delay_seed: int | None = None,
    faults: Path | None = None,
) -> "subprocess.Popen[str]":
    """Start a process for some modules of a stack. It ends by itself when the store is closed."""
    job = {
        "store": store_name,
        "seed": seed,
        "delay_seed": delay_seed,
        "faults": str(faults) if faults is not None else None,
        "wires": {wire.component: wire.entry() for wire in wires},
    }
    child = subprocess.Popen([sys.executable, "-m", "autonomy.process"], stdin=subprocess.PIPE, text=True)
    assert child.stdin is not None
    child.stdin.write(json.dumps(job) + "\n")
    child.stdin.flush()  # it stays open: its end tells the child that we are gone
    return child


def run(job: dict[str, Any]) -> None:
    """Host the modules of a job until the clock stops for good."""
    with Store.attach(job["store"]) as store:
        cycle = store.cycle  # before the clock can see us: no cycle that it waits for is left out
        wires = [wire_of(name, name, entry) for name, entry in job["wires"].items()]
        limit_memory(sum(wire.memory_mb or MEMORY_MB for wire in wires))
        faults = Path(job["faults"]) if job.get("faults") else None
        hosts = [Host(store, wire, job["seed"], participant=True, faults=faults) for wire in wires]
        for host in hosts:
            host.connect(CONNECT_S)
        delays = random.Random(job["delay_seed"]) if job.get("delay_seed") is not None else None
        for host in hosts:
            host.component.done(cycle)
        while True:
            now = store.wait_cycle(cycle, 1.0)
            if now is None:
                if not store.clock.alive:
                    return
                continue
            for due in range(cycle + 1, now + 1):
                for host in hosts:
                    if delays is not None:
                        time.sleep(delays.random() * MAX_DELAY_S)
                    host.step(due)
                    host.component.done(due)
            cycle = now


def main() -> int:
    """Read the job and run it; exit 1 with one line for a module that cannot run."""
    logging.basicConfig(format="%(message)s", level=logging.ERROR)
    try:
        run(json.loads(sys.stdin.readline()))
    except (ModuleError, RtdbError) as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
