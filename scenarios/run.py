"""Run: the only place where a cart is put together. A scenario, a seed and a stack become a recording.

Each tick: the world moves on to the edge, the edge, then recorder, drivers and modules on the new cut. Two stores
tick together: `cart` is all that modules can know, `world` is the truth and stays private to this process.
"""

import gc
import logging
import os
import random
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Protocol, Self

from autonomy.host import Host
from autonomy.process import spawn
from autonomy.wiring import Stack, Wire, load_stack
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
    GuardState,
    Hold,
    ModuleState,
    ModuleStatus,
    Scan,
    Scene,
    SystemState,
)
from hal.signals import Site as SiteRecord
from rtdb import STATIC, Object, Record, Store
from rtdb.recorder import Recorder
from sim.cart import GPS_LATENCY_NS, PlantKind, SimCart

from . import plan
from .by_hand import HandHost, by_hand
from .course import CourseImpossible
from .scenario import Scenario
from .version import version

if TYPE_CHECKING:
    import subprocess

log = logging.getLogger(__name__)
TICK_NS = 10_000_000
STORE_BYTES = 8 << 20
SETTLE_S = 1.0  # how long a finished cart stands before the drive ends
PARTICIPANT_S = 60.0
COLLECT_CYCLES = 3000
Placement = Literal["inline", "process"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """How to run a scenario.

    plant: python is the readable form of the cart's dynamics; db: name of a shared store, None for a private one;
    placement: where modules run; by_hand: the keyboard drives; shuffle: seed that permutes order, placement over
    processes and delays, none of which may change the trace.
    """

    scenario: Scenario
    seed: int = 0
    level: Level = "wire"
    plant: PlantKind = "compiled"
    stack: Stack | None = None
    db: str | None = None
    placement: Placement = "inline"
    by_hand: bool = False
    shuffle: int | None = None


class DriveError(Exception):
    """A drive cannot be done, or a part of it is gone. `invalid`: the scenario is to blame, not a module."""

    def __init__(self, message: str, *, invalid: bool) -> None:
        super().__init__(message)
        self.invalid = invalid


class Drive:
    """A drive under way: `tick` until it says that it is over. Use it in a `with`."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        scenario = setup.scenario
        self.stack = setup.stack or load_stack(scenario.stack_path())
        if setup.by_hand:
            self.stack = by_hand(self.stack)
        self._children: list[subprocess.Popen[str]] = []
        self._hand: HandHost | None = None
        self.lost = ""
        self._order = random.Random(setup.shuffle) if setup.shuffle is not None else None  # not part of the drive
        self._hosts: list[Host] = []
        self.sim: SimCart = None  # type: ignore[assignment]  # until assembled
        apart = setup.placement == "process" or setup.shuffle is not None
        name = setup.db if setup.db is not None else f"drive-{os.getpid()}" if apart else None
        self.cart = Store.create(name, tick_ns=TICK_NS, t0_ns=scenario.t0_ns, size=STORE_BYTES, deterministic=True)
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
        try:
            course = plan.course_record(scenario, site, rng)
            boxes = plan.obstacles(scenario, site, course, rng)
        except CourseImpossible as error:
            raise DriveError(str(error), invalid=True) from error
        self._write_mission(plan.site_record(site), course, plan.map_record(site, boxes) if boxes else None)
        site = plan.furnished(site, boxes)
        self.sim = SimCart(plan.sim_setup(scenario, site, self.setup.level, self.setup.plant, rng), rng)
        self.sim.bus.faults += plan.bus_faults(scenario, rng)
        self._events = plan.fault_events(scenario)
        self._write_world()
        self._drivers: list[GpsHost | CompassHost] = [GpsHost(self.cart, GpsDriver(GPS_LATENCY_NS), self.sim.gps)]
        if self.sim.compass is not None:
            self._drivers.append(CompassHost(self.cart, CompassDriver(self.sim.declination_rad), self.sim.compass))
        self._scan = self.cart.join("synlaser").insert("scan", Scan, history_s=0.5) if scenario.laser else None
        self.hal = CartHost(self.cart, self.sim.bus)
        if self.setup.by_hand:
            self._hand = HandHost(self.cart).__enter__()
        self._start_modules(name)
        self.hal.obey(self.cart.find(self.stack.command, DriveCommand))
        self._work: list[Callable[[int, int], None]] = [
            *(driver.step for driver in self._drivers),
            self.hal.step,
            *([self._write_scan] if self._scan else []),
            *([self._hand.step] if self._hand else []),
            *(host.step for host in self._hosts),
        ]
        self._ended_s = 0.0
        objects = {obj.name: obj.schema.name for obj in self.cart.objects()}
        ends: list[tuple[str, type[Record]]] = [("follow/state", FollowState), ("guard/state", GuardState)]
        self._ends = [self.cart.find(n, cls) for n, cls in ends if objects.get(n) == cls.__name__]
        self._statuses = [self.cart.find(n, ModuleStatus) for n, record in objects.items() if record == "ModuleStatus"]

    def _start_modules(self, name: str | None) -> None:
        groups: list[list[Wire]] = [[], [], []]  # the first one here, each other in a process of its own
        for wire in self.stack.wires:
            k = self._order.randrange(3) if self._order else int(self.setup.placement == "process")
            groups[k].append(wire)
        for k, group in enumerate(groups[1:]):
            if group and name is not None:
                delay_seed = None if self.setup.shuffle is None else self.setup.shuffle * 2 + k
                self._children.append(spawn(name, tuple(group), self.setup.seed, delay_seed))
        self._hosts = [Host(self.cart, wire, self.setup.seed) for wire in groups[0]]
        self._wait_for_stack()
        for host in self._hosts:
            host.connect()

    def _wait_for_stack(self) -> None:
        """Tick 1 waits for every component that the stack names."""
        wanted = {wire.component for wire in self.stack.wires}
        deadline = time.monotonic() + PARTICIPANT_S
        while True:
            version = self.cart.core.version
            missing = wanted - {obj.name.removesuffix("/status") for obj in self.cart.objects("*/status")}
            if not missing:
                return
            for child in self._children:
                if child.poll() is not None:
                    raise DriveError(f"the process of {', '.join(sorted(missing))} ended at once", invalid=False)
            if time.monotonic() > deadline:
                names = ", ".join(sorted(missing))
                raise DriveError(f"{names} did not come within {PARTICIPANT_S:.0f} s", invalid=False)
            self.cart.core.wait_directory(version, 100_000_000)

    def _write_mission(self, site: SiteRecord, course: Course, surveyed: Scene | None) -> None:
        mission, t0_ns = self.cart.join("mission"), self.cart.t0_ns
        mission.insert("site", SiteRecord, history_s=0.05, flags=STATIC).write(site, t0_ns)
        mission.insert("course", Course, history_s=0.05, flags=STATIC).write(course, t0_ns)
        if surveyed is not None:
            mission.insert("map", Scene, history_s=0.05, flags=STATIC).write(surveyed, t0_ns)

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
        work = self._work
        if self._order is not None:
            self._order.shuffle(work)  # all of them read this cut and write for later ones: the order cannot matter
        for step in work:
            step(cycle, t_ns)
        while self._events and self._events[0][0] <= t_ns:
            self._fault.write(self._events.pop(0)[1], t_ns)
        if self._children and not cart.wait_done(cycle, PARTICIPANT_S):
            raise DriveError(f"a module did not finish cycle {cycle} within {PARTICIPANT_S:.0f} s", invalid=False)
        if not self.lost and any(child.poll() is not None for child in self._children):
            self.lost = f"a process of modules ended in cycle {cycle}"  # the cart goes on, and its limits stop it
        return self._over(cycle)

    def _write_scan(self, _cycle: int, t_ns: int) -> None:
        scan = self.sim.scan()
        if scan is not None and self._scan is not None:
            self._scan.write(scan, t_ns)

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
        """Say whether the drive ends: by time, by hand, or because the cart stands and will not go on."""
        now_s = self.time_s
        if self._hand is not None and self._hand.hand.quit:
            return True
        if cycle % 10 == 0:
            standing = abs(self.sim.plant.state.vx_mps) < 0.01
            self._ended_s = (self._ended_s or now_s) if standing and self._ended(cycle) else 0.0
        settled = self._ended_s > 0 and now_s - self._ended_s >= SETTLE_S
        return settled or now_s >= self.setup.scenario.duration_s

    def _ended(self, cycle: int) -> bool:
        """Say whether nobody will move the cart again: it has arrived, is far astray, or something failed for good."""
        if self.hal.driver.state is SystemState.FAULT:
            return True
        shown = {type(v): v for v in (self._value(obj, cycle) for obj in self._ends) if v is not None}
        follow, guard = shown.get(FollowState), shown.get(GuardState)
        broken = any(
            isinstance(v := self._value(obj, cycle), ModuleStatus) and v.state is ModuleState.FAULT
            for obj in self._statuses
        )
        arrived = isinstance(follow, FollowState) and follow.finished
        return arrived or broken or (isinstance(guard, GuardState) and guard.hold is Hold.OUTSIDE)

    @staticmethod
    def _value(obj: Object[Any], cycle: int) -> Any:
        sample = obj.visible(cycle)
        return None if sample is None else sample.value

    def close(self) -> None:
        """End the processes of this drive and give the stores back."""
        for child in self._children:
            if child.stdin is not None:
                child.stdin.close()
            child.terminate()
            child.wait()
        self._children.clear()
        if self._hand is not None:
            self._hand.__exit__(None, None, None)
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


@contextmanager
def ctrl_c_between_cycles() -> Iterator[Callable[[], bool]]:
    """Keep the first Ctrl-C until it is asked for; a second one does not wait."""
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False  # signals go to the main thread
        return
    pressed: list[int] = []

    def note(number: int, _frame: object) -> None:
        if pressed:
            raise KeyboardInterrupt
        pressed.append(number)

    before = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(pressed)
    finally:
        signal.signal(signal.SIGINT, before)


class Observer(Protocol):
    """Looks on while a drive is under way: a live view."""

    def record(self) -> None:
        """Take what the latest tick made visible."""


def drive(
    setup: Setup,
    recording: Path,
    *,
    pace: float | None = None,
    progress: Callable[[float], None] | None = None,
    begin: Callable[[list[Store]], Observer | None] | None = None,
) -> str:
    """Drive a scenario from start to end into a recording; returns what was lost on the way, empty if nothing was.

    pace: times real time, None for as fast as it goes; progress: called with the time driven, twice a second of it;
    begin: called once the cart stands assembled, with its stores; may give somebody who looks on. Ctrl-C raises
    KeyboardInterrupt between two cycles, so that the recording is whole up to there.
    """
    scenario = setup.scenario
    metadata = {
        "scenario": scenario.id,
        "seed": str(setup.seed),
        "level": setup.level,
        "plant": setup.plant,
        "site": scenario.site,
        "version": version(),
    }
    with ctrl_c_between_cycles() as pressed, Drive(setup) as run, ExitStack() as stack:
        recorder = stack.enter_context(Recorder(recording, [run.cart, run.world], metadata))
        observer = begin([run.cart, run.world]) if begin is not None else None
        begun_s = time.monotonic()
        gc.freeze()  # what the libraries made once is not looked through again and again,
        gc.disable()  # and what a cycle makes holds no rings; a module's own go every COLLECT_CYCLES
        stack.callback(gc.unfreeze)
        stack.callback(gc.enable)
        while not run.tick(recorder):
            if run.cart.cycle % COLLECT_CYCLES == 0:
                gc.collect()
            if pressed():
                raise KeyboardInterrupt
            if observer is not None:
                observer.record()
            if pace is not None:
                time.sleep(max(0.0, begun_s + run.time_s / pace - time.monotonic()))
            if progress is not None and run.cart.cycle % 50 == 0:
                progress(run.time_s)
        return run.lost
