"""Run: the only place where a cart is put together. A scenario, a seed and a stack become a recording.

Each tick: the world moves on to the edge, the edge, then recorder, drivers and modules on the new cut. Two stores
tick together: `cart` is all that modules can know, `world` is the truth and stays private to this process.
"""

import logging
import math
import os
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Literal, Self

import numpy as np

from autonomy.host import Host
from autonomy.process import spawn
from autonomy.wiring import Stack, load_stack
from hal.bus import Level
from hal.drivers.gps import GpsDriver
from hal.faults import HostSilence
from hal.host import CartHost, GpsHost
from hal.signals import CartTruth, Course, DriveCommand, FaultEvent, FollowState, SystemState
from hal.signals import Site as SiteRecord
from rtdb import STATIC, Store
from rtdb.recorder import Recorder
from sim.cart import GPS_LATENCY_NS, Outage, SimCart
from sim.cart import Start as TrueStart

from .scenario import GpsOutageFault, HostSilenceFault, Scenario
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
        name = setup.db or (f"drive-{os.getpid()}" if setup.placement == "process" else None)
        self.cart = Store.create(name, tick_ns=TICK_NS, t0_ns=scenario.t0_ns, size=STORE_BYTES)
        self.world = Store.create(None, tick_ns=TICK_NS, t0_ns=scenario.t0_ns)
        try:
            self._assemble(name)
        except BaseException:
            self.close()
            raise

    # -- assembly -------------------------------------------------------------------------------------------------

    def _rng(self, name: str) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence([self.setup.seed, zlib.crc32(name.encode())]))

    def _assemble(self, name: str | None) -> None:
        scenario, site = self.setup.scenario, self.setup.scenario.load_site()
        self.cart.join("clock")
        world = self.world.join("world")
        self._truth = world.insert("cart", CartTruth, every=2)
        self._fault = world.insert("fault", FaultEvent, history_s=0.1)
        self._events = self._plan_faults()
        self._write_mission()
        t0_ns, mark = scenario.t0_ns, scenario.start
        drawn = self._rng("start").normal(size=3)
        start = TrueStart(
            x_m=mark.east_m + mark.position_sigma_m * drawn[0],
            y_m=mark.north_m + mark.position_sigma_m * drawn[1],
            yaw_rad=math.radians(mark.yaw_deg + mark.yaw_sigma_deg * drawn[2]),
        )
        outages = tuple(
            Outage(_at(t0_ns, f.at_s), _at(t0_ns, f.at_s + f.for_s))
            for f in scenario.faults
            if isinstance(f, GpsOutageFault)
        )
        self.sim = SimCart(
            level=self.setup.level,
            t_ns=t0_ns,
            start=start,
            plane=site.plane,
            alt_m=site.alt_m,
            friction=site.friction,
            gps_grade=scenario.gps.grade,
            gps_rng=self._rng("gps"),
            wheel_rng=self._rng("wheels"),
            outages=outages,
        )
        self.sim.bus.faults += [
            HostSilence(_at(t0_ns, f.at_s)) for f in scenario.faults if isinstance(f, HostSilenceFault)
        ]
        self.gps = GpsHost(self.cart, GpsDriver(GPS_LATENCY_NS), self.sim.gps)
        self.hal = CartHost(self.cart, self.sim.bus)
        if self.setup.placement == "inline":
            self._hosts = [Host(self.cart, wire, self.setup.seed) for wire in self.stack.wires]
            for host in self._hosts:
                host.connect()
        else:
            assert name is not None
            self._children.append(spawn(name, self.stack.wires, self.setup.seed))
        self._wait_for_stack()
        self.hal.obey(self.cart.find(self.stack.command, DriveCommand))
        self._finished_s = 0.0
        self._follow = self.cart.find("follow/state", FollowState) if self._has("follow/state", FollowState) else None

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

    def _write_mission(self) -> None:
        scenario, site = self.setup.scenario, self.setup.scenario.load_site()
        mission, plane, mark = self.cart.join("mission"), site.plane, scenario.start
        points = scenario.waypoints_geo(site)
        start_lat_rad, start_lon_rad = plane.to_geo(mark.east_m, mark.north_m)
        course = Course(
            tuple(p[0] for p in points),
            tuple(p[1] for p in points),
            tuple(p[2] for p in points),
            scenario.course.speed_mps,
            start_lat_rad,
            start_lon_rad,
            max(mark.position_sigma_m, 0.01),
            math.radians(mark.yaw_deg),
            math.radians(max(mark.yaw_sigma_deg, 0.1)),
        )
        mission.insert("site", SiteRecord, history_s=0.05, flags=STATIC).write(
            SiteRecord(site.name, plane.lat_rad, plane.lon_rad, site.alt_m), scenario.t0_ns
        )
        mission.insert("course", Course, history_s=0.05, flags=STATIC).write(course, scenario.t0_ns)

    def _plan_faults(self) -> list[tuple[int, FaultEvent]]:
        t0_ns, events = self.setup.scenario.t0_ns, []
        for fault in self.setup.scenario.faults:
            events.append((_at(t0_ns, fault.at_s), FaultEvent(fault.kind, True)))
            if isinstance(fault, GpsOutageFault):
                events.append((_at(t0_ns, fault.at_s + fault.for_s), FaultEvent(fault.kind, False)))
        return sorted(events, key=lambda event: event[0])

    # -- running --------------------------------------------------------------------------------------------------

    @property
    def time_s(self) -> float:
        """Seconds since the start."""
        return (self.cart.now_ns - self.cart.t0_ns) * 1e-9

    def tick(self, recorder: Recorder | None = None) -> bool:
        """Do one cycle; True when the drive is over."""
        cart, world = self.cart, self.world
        self.sim.advance(TICK_NS)
        if cart.cycle % 2:  # shows at the next, even tick: the truth of that very edge
            self._truth.write(self.sim.truth(), self.sim.t_ns)
        cycle = cart.tick()
        world.tick()
        t_ns = cart.now_ns
        if recorder is not None:
            recorder.record()
        self.gps.step(t_ns)
        self.hal.step(cycle, t_ns)
        for host in self._hosts:
            host.step(cycle)
        while self._events and self._events[0][0] <= t_ns:
            self._fault.write(self._events.pop(0)[1], t_ns)
        if self._children and not cart.wait_done(cycle, PARTICIPANT_S):
            raise RuntimeError(f"a module did not finish cycle {cycle} within {PARTICIPANT_S:.0f} s")
        return self._over(cycle)

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
        self.cart.close()
        self.world.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _at(t0_ns: int, t_s: float) -> int:
    return t0_ns + round(t_s * 1e9)


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
        while not run.tick(recorder):
            if pace is not None:
                time.sleep(max(0.0, begun_s + run.time_s / pace - time.monotonic()))
            if progress is not None and run.cart.cycle % 50 == 0:
                progress(run.time_s)
