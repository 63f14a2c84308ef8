"""The process `hal` of a real-time run: `python -m scenarios.cart_process`, its job as JSON on standard input.

It sees a tick, moves the simulated world on to that tick's time, and lets the drivers work on the new cut. It trusts
neither the supervisor nor the clock: without them it obeys nobody, brakes on its own steady time until the cart stands,
says why, and ends.
"""

import gc
import json
import sys
import time
from dataclasses import dataclass
from typing import Any

from hal.errors import HalError
from hal.signals import Odometry
from rtdb import RtdbError, State, Store, realtime
from rtdb.json_object import json_schema

from .cart import TICK_NS, CartSetup, DriveError, SimulatedCart
from .scenario import Scenario

CONNECT_S = 60.0
LOOK_S = 0.02
NO_TICK_S = 0.1  # without a clock
STALLED_S = 0.25  # with one that does not tick, as long as the limits take a command for young
MAKE_UP_TICKS = 8  # what is longer would be silence for the safety node
STOP_S, HOLD_S = 20.0, 0.6
COLLECT_CYCLES = 3000
STOPPED, CANNOT, STOPPED_ALONE = 0, 1, 3
ORDERS = json_schema(200)


@dataclass(frozen=True, slots=True)
class Seen:
    """What the process sees of those whom it depends on. `order`: why it shall stop, if somebody said so."""

    supervisor_lives: bool
    clock_lives: bool
    silent_s: float
    order: str = ""


def why_stop(seen: Seen) -> str:
    """Decide whether the cart is to be stopped, and say why; empty if not."""
    if not seen.clock_lives and seen.silent_s > NO_TICK_S:
        return "the clock is gone"
    if seen.silent_s > STALLED_S:
        return "the clock stands"
    if not seen.supervisor_lives:
        return "the supervisor is gone"
    return seen.order


def ticks_to_work(last: int, now: int) -> range:
    """Say for which of the ticks after the last one the drivers work: all, or only the newest after a long pause."""
    return range(last + 1 if now - last <= MAKE_UP_TICKS else now, now + 1)


class CartProcess:
    """The cart on the shared stores, kept to the clock."""

    def __init__(self, job: dict[str, Any], cart: Store, world: Store) -> None:
        self._cart, self._world = cart, world
        world.take_clock()
        scenario = Scenario.model_validate_json(job["scenario"])
        self.simulated = SimulatedCart(CartSetup(scenario=scenario, seed=job["seed"], level=job["level"]), cart, world)
        self._travel = cart.find("odometry/travel", Odometry)
        self._orders = cart.find("supervisor/orders")
        self._supervisor = cart.component_index("supervisor")
        self.simulated.obey(job["command"], CONNECT_S)
        self.hal = cart.join("hal", participant=True)  # the clock waits for it: now there is everything
        self._cycle = cart.cycle

    def run(self) -> str:
        """Keep to the clock until something says stop; gives what."""
        core, heard_s = self._cart.core, time.monotonic()
        while True:
            cycle = core.step(self.hal.index, int(LOOK_S * 1e9))
            now_s = time.monotonic()
            if cycle is not None:
                heard_s = now_s
                self._follow(cycle)
                self.hal.done(cycle)
            if not self._cycle:  # before the first tick nothing moves
                if not self._cart.components()[self._supervisor].alive or self._order():
                    return self._order() or "the supervisor is gone"
                continue
            why = why_stop(
                Seen(
                    supervisor_lives=core.alive_at(self._supervisor, self._cart.cycle),
                    clock_lives=now_s - heard_s <= NO_TICK_S or self._cart.clock.alive,
                    silent_s=now_s - heard_s,
                    order=self._order(),
                )
            )
            if why:
                return why

    def _order(self) -> str:
        sample = self._orders.latest()
        return str(sample.value.get("stop", "")) if sample is not None else ""

    def _follow(self, now: int) -> None:
        """Bring the world to the time of a tick; the drivers work on each cut on the way, or after a pause on this."""
        before, work = self._cycle, ticks_to_work(self._cycle, now)
        for cycle in range(before + 1, now + 1):
            self._tick(cycle, work=cycle in work)
        if not gc.isenabled() and now // COLLECT_CYCLES > before // COLLECT_CYCLES:
            gc.collect()

    def _tick(self, cycle: int, *, work: bool = True) -> None:
        simulated = self.simulated
        simulated.before_edge(cycle)
        self._world.tick()
        t_ns = simulated.sim.t_ns
        if work:
            for step in simulated.work:
                step(cycle, t_ns)
        simulated.tell_faults(t_ns)
        self._cycle = cycle

    def stop(self) -> bool:
        """Brake on our own steady time until the cart stands, and hold it for a moment; False if it does not stop."""
        self.simulated.hal.stop()
        if not self._cycle:
            return True  # it has never moved
        held = 0
        for _ in range(int(STOP_S * 1e9) // TICK_NS):
            edge_ns = self._cart.t0_ns + (self._cycle + 1) * TICK_NS
            time.sleep(max(0, edge_ns - self._cart.now_ns) * 1e-9)
            self._tick(self._cycle + 1)
            held = held + 1 if self.stands else 0
            if held * TICK_NS >= HOLD_S * 1e9:
                return True
        return False

    @property
    def stands(self) -> bool:
        """Whether the wheels stand, as the odometry saw them for 0.1 s."""
        travel = self._travel.latest()
        return travel is None or travel.value.speed_mps == 0.0


def run(job: dict[str, Any]) -> int:
    """Drive until told to stop, or until nobody is there who could tell."""
    with Store.attach(job["store"]) as cart, Store.attach(job["world"]) as world:
        process = CartProcess(job, cart, world)
        try:
            if job["priority"] is not None:
                given = realtime(job["priority"])
                if given.refused:
                    _say(f"no real time: {'; '.join(given.refused)}")
            why = process.run()
            asked = why == process._order()
            process.hal.status(f"stopping the cart: {why}", State.RUNNING if asked else State.FAILURE)
            if not asked:
                _say(f"stopping the cart: {why}")
            stands = process.stop()
            said = f"the cart {'stands' if stands else 'does not stop'}: {why}"
            process.hal.status(said, State.RUNNING if asked and stands else State.FAILURE)
            if not (asked and stands):
                _say(said)
            return STOPPED if asked and stands else STOPPED_ALONE
        finally:
            process.simulated.close()


def _say(text: str) -> None:
    print(f"hal: {text}", file=sys.stderr, flush=True)


def main() -> int:
    """Read the job and run it; exit 1 with one line for a cart that cannot be made."""
    try:
        return run(json.loads(sys.stdin.readline()))
    except (RtdbError, HalError, DriveError) as error:
        _say(str(error))
        return CANNOT


if __name__ == "__main__":
    sys.exit(main())
