"""Run: the only place where a cart is put together. A scenario, a seed and a stack become a recording.

Each tick: the world moves on to the edge, the edge, then recorder, drivers and modules on the new cut. Two stores
tick together: `cart` is all that modules can know, `world` is the truth and stays private to this process.
"""

import gc
import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Literal, Self

from autonomy.host import Host
from autonomy.process import spawn
from autonomy.wiring import Stack, load_stack
from hal.bus import Level
from hal.drivers.compass import CompassDriver
from hal.drivers.gps import GpsDriver
from hal.host import CartHost, CompassHost, GpsHost
from hal.signals import (
    ActorsTruth,
    CartTruth,
    Clearance,
    Course,
    DriveCommand,
    FaultEvent,
    FollowState,
    Scan,
    Scene,
    SystemState,
)
from hal.signals import Site as SiteRecord
from rtdb import STATIC, Store
from rtdb.recorder import Recorder
from sim.cart import GPS_LATENCY_NS, SimCart

from . import plan
from .scenario import Scenario
from .version import version

if TYPE_CHECKING:
    import subprocess

log = logging.getLogger(__name__)
TICK_NS = 10_000_000
STORE_BYTES = 8 << 20
SETTLE_S = 1.0  # how long a finished cart stands before the drive ends
PARTICIPANT_S = 60.0
Placement = Literal["inline", "process"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """How to run a scenario. `db`: name of a shared store, None for a private one; placement: where modules run."""

    scenario: Scenario
    seed: int = 0
    level: Level = "wire"
    stack: Stack | None = None
    db: str | None = None
    placement: Placement = "inline"


class Drive:
    """A drive under way: `tick` until it says that it is over. Use it in a `with`."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        scenario = setup.scenario
        self.stack = setup.stack or load_stack(scenario.stack_path())
        self._children: list[subprocess.Popen[str]] = []
        self._hosts: list[Host] = []
        self.sim: SimCart = None  # type: ignore[assignment]  # until assembled
        name = setup.db or (f"drive-{os.getpid()}" if setup.placement == "process" else None)
        self.cart = Store.create(name, tick_ns=TICK_NS, t0_ns=scenario.t0_ns, size=STORE_BYTES)
        self.world = Store.create(None, tick_ns=TICK_NS, t0_ns=scenario.t0_ns)
        try:
            self._assemble(name)
        except BaseException:
            self.close()
            raise

    # -- assembly -------------------------------------------------------------------------------------------------

    def _assemble(self, name: str | None) -> None:
        scenario, rng = self.setup.scenario, plan.rng_of(self.setup.seed)
        site = scenario.load_site()
        self.cart.join("clock")
        self._write_mission(plan.site_record(site), plan.course_record(scenario, site, rng))
        self.sim = SimCart(plan.sim_setup(scenario, site, self.setup.level, rng), rng)
        self.sim.bus.faults += plan.bus_faults(scenario, rng)
        self._events = plan.fault_events(scenario)
        self._write_world()
        self._drivers: list[GpsHost | CompassHost] = [GpsHost(self.cart, GpsDriver(GPS_LATENCY_NS), self.sim.gps)]
        if self.sim.compass is not None:
            self._drivers.append(CompassHost(self.cart, CompassDriver(self.sim.declination_rad), self.sim.compass))
        self._scan = self.cart.join("laser").insert("scan", Scan, history_s=0.5) if scenario.laser else None
        self.hal = CartHost(self.cart, self.sim.bus)
        self._start_modules(name)
        self.hal.obey(self.cart.find(self.stack.command, DriveCommand))
        self._finished_s = 0.0
        self._follow = self.cart.find("follow/state", FollowState) if self._has("follow/state", FollowState) else None

    def _start_modules(self, name: str | None) -> None:
        if self.setup.placement == "inline":
            self._hosts = [Host(self.cart, wire, self.setup.seed) for wire in self.stack.wires]
            for host in self._hosts:
                host.connect()
        else:
            assert name is not None
            self._children.append(spawn(name, self.stack.wires, self.setup.seed))
        self._wait_for_stack()

    def _has(self, name: str, cls: type[FollowState]) -> bool:
        return any(obj.name == name and obj.schema.name == cls.__name__ for obj in self.cart.objects())

    def _wait_for_stack(self) -> None:
        """Tick 1 waits for every component that the stack names."""
        wanted = {wire.component for wire in self.stack.wires}
        deadline = time.monotonic() + PARTICIPANT_S
        while missing := wanted - {
            obj.name.removesuffix("/status") for obj in self.cart.objects() if obj.name.endswith("/status")
        }:
            for child in self._children:
                if child.poll() is not None:
                    raise RuntimeError(f"the process of {', '.join(sorted(missing))} ended before the drive began")
            if time.monotonic() > deadline:
                raise RuntimeError(f"{', '.join(sorted(missing))} did not come within {PARTICIPANT_S:.0f} s")
            self.cart.core.wait_object(self.cart.core.n_objects(), 100_000_000)

    def _write_mission(self, site: SiteRecord, course: Course) -> None:
        mission, t0_ns = self.cart.join("mission"), self.cart.t0_ns
        mission.insert("site", SiteRecord, history_s=0.05, flags=STATIC).write(site, t0_ns)
        mission.insert("course", Course, history_s=0.05, flags=STATIC).write(course, t0_ns)

    def _write_world(self) -> None:
        world = self.world.join("world")
        self._truth = world.insert("cart", CartTruth, every=2)
        self._fault = world.insert("fault", FaultEvent, history_s=0.1)
        self._clearance = world.insert("clearance", Clearance, every=10) if self.sim.world else None
        self._actors = world.insert("actors", ActorsTruth, every=10) if self.sim.setup.actors else None
        if self.sim.world:
            world.insert("scene", Scene, history_s=0.05, flags=STATIC).write(self.sim.scene, self.world.t0_ns)

    # -- running --------------------------------------------------------------------------------------------------

    @property
    def time_s(self) -> float:
        """Seconds since the start."""
        return (self.cart.now_ns - self.cart.t0_ns) * 1e-9

    def tick(self, recorder: Recorder | None = None) -> bool:
        """Do one cycle; True when the drive is over."""
        cart, world = self.cart, self.world
        self.sim.advance(TICK_NS)
        self._tell_truth(cart.cycle + 1)
        cycle = cart.tick()
        world.tick()
        t_ns = cart.now_ns
        if recorder is not None:
            recorder.record()
        for driver in self._drivers:
            driver.step(t_ns)
        self.hal.step(cycle, t_ns)
        scan = self.sim.scan() if self._scan is not None else None
        if scan is not None and self._scan is not None:
            self._scan.write(scan, t_ns)
        for host in self._hosts:
            host.step(cycle)
        while self._events and self._events[0][0] <= t_ns:
            self._fault.write(self._events.pop(0)[1], t_ns)
        if self._children and not cart.wait_done(cycle, PARTICIPANT_S):
            raise RuntimeError(f"a module did not finish cycle {cycle} within {PARTICIPANT_S:.0f} s")
        return self._over(cycle)

    def _tell_truth(self, next_cycle: int) -> None:
        """Write what shows at the coming edge: the truth of that very edge."""
        if next_cycle % 2 == 0:
            self._truth.write(self.sim.truth(), self.sim.t_ns)
        if next_cycle % 10 == 0:
            if self._clearance is not None:
                self._clearance.write(self.sim.take_clearance(), self.sim.t_ns)
            if self._actors is not None:
                self._actors.write(self.sim.actors(), self.sim.t_ns)

    def _over(self, cycle: int) -> bool:
        now_s = self.time_s
        standing = abs(self.sim.plant.state.vx_mps) < 0.01
        state = self._follow.visible(cycle) if self._follow is not None and cycle % 10 == 0 else None
        if cycle % 10 == 0:
            finished = standing and (
                (state is not None and state.value.finished) or self.hal.driver.state is SystemState.FAULT
            )
            self._finished_s = (self._finished_s or now_s) if finished else 0.0
        return now_s >= self.setup.scenario.duration_s or (
            self._finished_s > 0 and now_s - self._finished_s >= SETTLE_S
        )

    def close(self) -> None:
        """End the processes of this drive and give the stores back."""
        for child in self._children:
            if child.stdin is not None:
                child.stdin.close()
            child.terminate()
            child.wait()
        self._children.clear()
        if self.sim is not None:  # not assembled to the end
            self.sim.close()
        self.cart.close()
        self.world.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def drive(
    setup: Setup, recording: Path, *, pace: float | None = None, progress: Callable[[float], None] | None = None
) -> None:
    """Drive a scenario from start to end into a recording.

    pace: times real time, None for as fast as it goes; progress: called with the time driven, twice a second of it.
    """
    scenario = setup.scenario
    metadata = {
        "scenario": scenario.id,
        "seed": str(setup.seed),
        "level": setup.level,
        "site": scenario.site,
        "version": version(),
    }
    with Drive(setup) as run, Recorder(recording, [run.cart, run.world], metadata) as recorder:
        begun_s = time.monotonic()
        gc.freeze()  # what the libraries made once is not looked through again and again
        while not run.tick(recorder):
            if pace is not None:
                time.sleep(max(0.0, begun_s + run.time_s / pace - time.monotonic()))
            if progress is not None and run.cart.cycle % 50 == 0:
                progress(run.time_s)
