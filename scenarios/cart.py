"""The simulated cart on its two stores: mission, drivers and HAL on `cart`, the truth on `world`.

Who runs it says what time it is: `before_edge` moves the world on to the coming edge, then come the edges of both
stores, then `work`, in any order. `run.py` steps it; the process of a real-time run keeps it to the clock.
"""

from collections.abc import Callable
from dataclasses import dataclass

from hal.bus import Level
from hal.drivers.compass import CompassDriver
from hal.drivers.gps import GpsDriver
from hal.host import CartHost, CompassHost, GpsHost, ahead_ns
from hal.signals import (
    ActorsTruth,
    CartTruth,
    Clearance,
    Course,
    FaultEvent,
    Scan,
    Scene,
)
from hal.signals import Site as SiteRecord
from rtdb import STATIC, Store
from sim.cart import GPS_LATENCY_NS, PlantKind, SimCart
from sim.world import World

from . import plan
from .course import CourseImpossible
from .randomise import Kind, Randomised, draw
from .scenario import Scenario

TICK_NS = 10_000_000


class DriveError(Exception):
    """A drive cannot be done, or a part of it is gone. `invalid`: the scenario is to blame, not a module."""

    def __init__(self, message: str, *, invalid: bool) -> None:
        super().__init__(message)
        self.invalid = invalid


@dataclass(frozen=True, slots=True, kw_only=True)
class CartSetup:
    """Which cart, where: a scenario with its seed, how much of the wire, which form of the plant, what is randomised.

    truth, make_world: see scenarios.run.Setup.
    """

    scenario: Scenario
    seed: int = 0
    level: Level = "wire"
    plant: PlantKind = "compiled"
    randomise: Kind = "none"
    truth: bool = True
    make_world: Callable[[Scene], World] | None = None


class SimulatedCart:
    """A cart that stands at its start. Close it."""

    def __init__(self, setup: CartSetup, cart: Store, world: Store) -> None:
        self.setup, self.cart, self.world = setup, cart, world
        scenario, rng = setup.scenario, plan.rng_of(setup.seed)
        site = scenario.load_site()
        try:
            course = plan.course_record(scenario, site, rng)
            boxes = plan.obstacles(scenario, site, course, rng)
        except CourseImpossible as error:
            raise DriveError(str(error), invalid=True) from error
        self.course = course
        self._write_mission(plan.site_record(site), course, plan.map_record(site, boxes) if boxes else None)
        site = plan.furnished(site, boxes)
        drawn = draw(setup.randomise, rng("randomise"))
        sim_setup = plan.sim_setup(scenario, site, setup.level, setup.plant, rng, drawn)
        self.sim = SimCart(sim_setup, rng, setup.make_world)
        self.sim.bus.faults += plan.bus_faults(scenario, rng)
        self._events = plan.fault_events(scenario)
        self._write_world(drawn)
        drivers: list[GpsHost | CompassHost] = [GpsHost(cart, GpsDriver(GPS_LATENCY_NS), self.sim.gps)]
        if self.sim.compass is not None:
            drivers.append(CompassHost(cart, CompassDriver(self.sim.declination_rad), self.sim.compass))
        self._scan = cart.join("synlaser").insert("scan", Scan, history_s=0.5) if scenario.laser else None
        self.hal = CartHost(cart, self.sim.bus)
        self.work: list[Callable[[int, int], None]] = [
            *(driver.step for driver in drivers),
            self.hal.step,
            *([self._write_scan] if self._scan else []),
        ]

    def _write_mission(self, site: SiteRecord, course: Course, surveyed: Scene | None) -> None:
        mission, now_ns = self.cart.join("mission"), self.cart.now_ns
        mission.insert("site", SiteRecord, history_s=0.05, flags=STATIC).write(site, now_ns)
        mission.insert("course", Course, history_s=0.05, flags=STATIC).write(course, now_ns)
        if surveyed is not None:
            mission.insert("map", Scene, history_s=0.05, flags=STATIC).write(surveyed, now_ns)

    def _write_world(self, drawn: Randomised) -> None:
        world = self.world.join("world")
        if self.setup.randomise != "none":
            world.insert("randomised", Randomised, history_s=0.05, flags=STATIC).write(drawn, self.world.t0_ns)
        self._truth = world.insert("cart", CartTruth, every=2)
        self._fault = world.insert("fault", FaultEvent, history_s=0.1)
        self._clearance = world.insert("clearance", Clearance, every=10) if self.sim.world else None
        self._actors = world.insert("actors", ActorsTruth, every=10) if self.sim.setup.actors else None
        if self.sim.world:
            world.insert("scene", Scene, history_s=0.05, flags=STATIC).write(self.sim.scene, self.world.t0_ns)

    def obey(self, pointer: str, timeout_s: float = 0.0) -> None:
        """Let the HAL obey a command in the store. While disabled only."""
        self.hal.obey(pointer, timeout_s)

    def before_edge(self, next_cycle: int) -> None:
        """Move the world on by a tick, and write what shows at the coming edge: the truth of that very edge."""
        self.sim.advance(TICK_NS)
        if next_cycle % 2:
            return
        if self.setup.truth:
            self._truth.write(self.sim.truth(), self.sim.t_ns)
        if next_cycle % 10 == 0:
            clearance = self.sim.take_clearance()
            if self._clearance is not None and self.setup.truth:
                self._clearance.write(clearance, self.sim.t_ns)
            if self._actors is not None and self.setup.truth:
                self._actors.write(self.sim.actors(), self.sim.t_ns)

    def tell_faults(self, t_ns: int) -> None:
        """Write which of the scenario's faults have begun or ended, for the recording."""
        while self._events and self._events[0][0] <= t_ns:
            self._fault.write(self._events.pop(0)[1], t_ns)

    def _write_scan(self, cycle: int, t_ns: int) -> None:
        scan = self.sim.scan()
        if scan is not None and self._scan is not None:
            self._scan.write(scan, t_ns + ahead_ns(self.cart, cycle, t_ns))

    def close(self) -> None:
        """Give the world back."""
        self.sim.close()
