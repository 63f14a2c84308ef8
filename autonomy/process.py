"""A process that runs modules on a shared store: `python -m autonomy.process`, its job as JSON on standard input.

It attaches to the cart's store alone. It is a participant: a barrier waits for it as long as it lives, a real-time
clock counts the cycles that it misses. On a real-time store it keeps its own pace, and skips what it slept through.
"""

import gc
import json
import logging
import os
import random
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from rtdb import ClockDead, Kind, RtdbError, Store, realtime

from .contain import limit_memory
from .host import Host
from .module import ModuleError
from .wiring import Wire, wire_of

CONNECT_S = 30.0
MEMORY_MB = 4096  # of a module that does not say
MAX_DELAY_S = 0.0005  # of a shuffled run
READY = "ready"  # what `health` says in real time once everything is loaded
PARENT = os.getppid()
COLLECT_STEPS = 500  # of a process with real-time priority, whose garbage is not collected by itself


def spawn(
    store_name: str,
    wires: tuple[Wire, ...],
    seed: int,
    delay_seed: int | None = None,
    faults: Path | None = None,
    *,
    behind: tuple[str, ...] = (),
    priority: int | None = None,
    group: int | None = None,
) -> "subprocess.Popen[str]":
    """Start a process for some modules of a stack. It ends by itself when the store is closed.

    behind: components that must have said something first; priority: asked of the system, None for an ordinary one;
    group: process group, 0 for one of its own, so that a terminal's Ctrl-C does not reach it.
    """
    job = {
        "behind": behind,
        "priority": priority,
        "store": store_name,
        "seed": seed,
        "delay_seed": delay_seed,
        "faults": str(faults) if faults is not None else None,
        "wires": {wire.component: wire.entry() for wire in wires},
    }
    command = [sys.executable, "-m", "autonomy.process"]
    child = subprocess.Popen(command, stdin=subprocess.PIPE, text=True, process_group=group)
    assert child.stdin is not None
    child.stdin.write(json.dumps(job) + "\n")
    child.stdin.flush()  # it stays open: its end tells the child that we are gone
    return child


def run(job: dict[str, Any]) -> None:
    """Host the modules of a job until the clock stops for good."""
    with Store.attach(job["store"]) as store:
        cycle = store.cycle  # before the clock can see us: no cycle that it waits for is left out
        wires = [wire_of(name, name, entry) for name, entry in job["wires"].items()]
        limit_memory(int(sum(wire.memory_mb or MEMORY_MB for wire in wires)))
        faults = Path(job["faults"]) if job.get("faults") else None
        hosts = [Host(store, wire, job["seed"], participant=True, faults=faults) for wire in wires]
        for component in job.get("behind", ()):
            store.find(f"{component}/status", timeout_s=CONNECT_S)  # behind its outputs: what is optional is there too
        for host in hosts:
            host.connect(CONNECT_S)
        if store.clock.kind is Kind.REAL:
            get_ready(hosts, job.get("priority"))
            if len(hosts) == 1 and not wires[0].latency_cycles:
                keep_pace(store, hosts[0])
                return
        follow(store, cycle, hosts, job.get("delay_seed"))


def follow(store: Store, cycle: int, hosts: list[Host], delay_seed: int | None) -> None:
    """Step modules at each tick, until nobody ticks any more: also where a result shows some ticks after its step."""
    delays = random.Random(delay_seed) if delay_seed is not None else None
    for host in hosts:
        host.component.done(cycle)
    while True:
        now = store.wait_cycle(cycle, 1.0)
        if now is None:
            if is_over(store):
                return
            continue
        for due in range(cycle + 1, now + 1):
            for host in hosts:
                if delays is not None:
                    time.sleep(delays.random() * MAX_DELAY_S)
                host.step(due)
                host.component.done(due)
        cycle = now
        if not gc.isenabled() and cycle % COLLECT_STEPS == 0:
            gc.collect()


def get_ready(hosts: list[Host], priority: int | None) -> None:
    """Load what can be loaded before the first tick, and ask for a real-time priority."""
    for host in hosts:
        host.prepare()
    if priority is not None:
        ask(priority, ", ".join(host.wire.component for host in hosts))
    for host in hosts:
        host.component.status(READY)


def keep_pace(store: Store, host: Host) -> None:
    """Step a module at each due cycle that it is awake for, until the clock is gone; its `health` says how it did."""
    while True:
        try:
            for k, cut in enumerate(host.component.cycles()):
                host.step(cut.cycle)
                if not gc.isenabled() and k % COLLECT_STEPS == 0:
                    gc.collect()
        except ClockDead:
            if is_over(store):
                return


def is_over(store: Store) -> bool:
    """Say whether nobody ticks any more; before the first tick, whether nobody will."""
    return not store.clock.alive and (store.cycle > 0 or os.getppid() != PARENT)


def ask(priority: int, who: str) -> None:
    """Ask for a real-time priority; what the system refuses is said in one line, and the work goes on."""
    given = realtime(priority)
    if given.refused:
        print(f"{who}: no real time: {'; '.join(given.refused)}", file=sys.stderr, flush=True)


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
