"""Run: a scenario, a seed and a stack become a recording.

Each tick: the world moves on to the edge, the edge, then recorder, drivers and modules on the new cut. Two stores
tick together: `cart` is all that modules can know, `world` is the truth and stays private to this process.
"""

import gc
import logging
import os
import random
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Protocol, Self

from autonomy.host import Host
from autonomy.process import spawn
from autonomy.wiring import Stack, Wire, load_stack
from hal.bus import Level
from hal.signals import FollowState, GuardState, Hold, ModuleState, ModuleStatus, Scene, SystemState
from rtdb import Object, Record, Store
from rtdb.recorder import Recorder
from rtdb.syncfs.process import spawn as spawn_server
from rtdb.syncfs.seats import SeatSpec
from sim.cart import PlantKind
from sim.world import World

from .by_hand import HandHost, by_hand
from .cart import TICK_NS, CartSetup, DriveError, SimulatedCart
from .ending import asked_to_end, how_it_ended
from .randomise import Kind
from .scenario import Scenario
from .version import version

__all__ = ["TICK_NS", "Drive", "DriveError", "Setup", "drive"]

if TYPE_CHECKING:
    import subprocess

log = logging.getLogger(__name__)
STORE_BYTES = 8 << 20
SETTLE_S = 1.0  # how long a finished cart stands before the drive ends
PARTICIPANT_S = 60.0  # for a process to come
ASK_S = 0.25  # between looks whether somebody asks for the end
HANG_S = 75.0  # for the modules of a process to finish a cycle: longer than their own watch takes
COLLECT_CYCLES = 3000
Placement = Literal["inline", "process"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """How to run a scenario.

    plant: python is the readable form of the cart's dynamics; db: name of a shared store, None for a private one;
    placement: modules in this process, or each in its own; by_hand: the keyboard drives; shuffle: seed that permutes
    order, placement and delays, none of which may change the trace; faults: folder for the steps that broke a module;
    randomise: what else the seed changes, see scenarios/randomise.py; truth: the truth is written, False where nobody
    records it;
    agent: component that the caller of `tick` asks and answers (`Drive.agent`), as a gymnasium environment does;
    make_world: gives the world of a scene, which stays its caller's, instead of one that ends with the drive;
    listen: where the file server of components without modules does [the store's own socket]; tokens: theirs, by
    component, where they shall not be made by chance.
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
    faults: Path | None = None
    randomise: Kind = "none"
    truth: bool = True
    agent: str | None = None
    make_world: Callable[[Scene], World] | None = None
    listen: str | None = None
    tokens: Mapping[str, str] = field(default_factory=dict)


class Drive:
    """A drive under way: `tick` until it says that it is over. Use it in a `with`."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        scenario = setup.scenario
        self.stack = setup.stack or load_stack(scenario.stack_path())
        if setup.by_hand:
            self.stack = by_hand(self.stack)
        self._children: dict[str, subprocess.Popen[str]] = {}  # by component
        self._hand: HandHost | None = None
        self.lost = ""
        self.asked: Callable[[], str] = str  # whether somebody asks for the end; nobody
        self._order = random.Random(setup.shuffle) if setup.shuffle is not None else None  # not part of the drive
        self._hosts: list[Host] = []
        self.simulated: SimulatedCart | None = None
        self.agent: Host | None = None
        self._scripts = {wire.component: wire for wire in self.stack.wires if wire.is_files}
        apart = setup.placement == "process" or setup.shuffle is not None or bool(self._scripts)
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
        setup = self.setup
        self.simulated = SimulatedCart(
            CartSetup(
                scenario=setup.scenario,
                seed=setup.seed,
                level=setup.level,
                plant=setup.plant,
                randomise=setup.randomise,
                truth=setup.truth,
                make_world=setup.make_world,
            ),
            self.cart,
            self.world,
        )
        self.sim, self.hal = self.simulated.sim, self.simulated.hal
        if setup.by_hand:
            self._hand = HandHost(self.cart).__enter__()
        self._start_modules(name)
        self.simulated.obey(self.stack.command)
        self._list_work()
        self._ended_s = 0.0
        self._last_cycle = int(setup.scenario.duration_s * 1e9) // TICK_NS  # from here on the time is looked at
        objects = {obj.name: obj.schema.name for obj in self.cart.objects()}
        ends: dict[str, type[Record]] = {cls.__name__: cls for cls in (FollowState, GuardState)}
        self._ends = [self.cart.find(n, ends[record]) for n, record in objects.items() if record in ends]
        self._statuses = [self.cart.find(n, ModuleStatus) for n, record in objects.items() if record == "ModuleStatus"]
        self._statuses += [self.cart.find(f"{component}/status") for component in self._scripts]

    def _list_work(self) -> None:
        assert self.simulated is not None
        self._work: list[Callable[[int, int], None]] = [
            *self.simulated.work,
            *([self._hand.step] if self._hand else []),
            *(host.step for host in self._hosts),
        ]

    def _start_modules(self, name: str | None) -> None:
        here: list[Wire] = []
        if self._scripts and name is not None:
            seats = [seat_of(wire) for wire in self._scripts.values()]
            self._children["files"] = spawn_server(name, seats, self.setup.listen, self.setup.tokens)
        for wire in self.stack.wires:
            if wire.is_files:
                continue
            apart = self._order.random() < 0.5 if self._order else self.setup.placement == "process"
            if apart and name is not None and wire.component != self.setup.agent:
                delay_seed = None if self._order is None else self._order.randrange(1 << 32)
                child = spawn(name, (wire,), self.setup.seed, delay_seed, self.setup.faults)
                self._children[wire.component] = child
            else:
                here.append(wire)
        self._hosts = [Host(self.cart, wire, self.setup.seed, faults=self.setup.faults) for wire in here]
        self._wait_for_stack()
        for host in self._hosts:
            host.connect()
        asked = [host for host in self._hosts if host.wire.component == self.setup.agent]
        self._hosts = [host for host in self._hosts if host not in asked]
        self.agent = asked[0] if asked else None

    def _wait_for_stack(self) -> None:
        """Tick 1 waits for every component that the stack names; for whoever is a script, as long as it takes."""
        wanted = {wire.component for wire in self.stack.wires}
        deadline = time.monotonic() + PARTICIPANT_S
        while True:
            version = self.cart.core.version
            missing = wanted - {obj.name.removesuffix("/status") for obj in self.cart.objects("*/status")}
            if not missing:
                return
            for component, child in self._children.items():
                if child.poll() is not None:
                    raise DriveError(f"the process of {component} ended at once", invalid=False)
            if missing <= set(self._scripts):
                deadline = time.monotonic() + PARTICIPANT_S
            if time.monotonic() > deadline:
                names = ", ".join(sorted(missing))
                raise DriveError(f"{names} did not come within {PARTICIPANT_S:.0f} s", invalid=False)
            self.cart.core.wait_directory(version, 100_000_000)

    # -- running --------------------------------------------------------------------------------------------------

    @property
    def time_s(self) -> float:
        """Seconds since the start."""
        return (self.cart.now_ns - self.cart.t0_ns) * 1e-9

    def tick(self, recorder: Recorder | None = None) -> bool:
        """Do one cycle; True when the drive is over."""
        cart, world = self.cart, self.world
        assert self.simulated is not None
        self.simulated.before_edge(cart.cycle + 1)
        cycle = cart.tick()
        if self.setup.truth:
            world.tick()
        t_ns = cart.now_ns
        if recorder is not None:
            recorder.record()
        work = self._work
        if self._order is not None:
            self._order.shuffle(work)  # all of them read this cut and write for later ones: the order cannot matter
        for step in work:
            step(cycle, t_ns)
        if self.setup.truth:
            self.simulated.tell_faults(t_ns)
        if self._children:
            self._wait_for_processes(cycle)
        return self._over(cycle)

    def _wait_for_processes(self, cycle: int) -> None:
        """Wait until all modules are done with a cycle; one that hangs is ended. The cart's limits stop the cart.

        How long a script is waited for is up to the file server.
        """
        until_s = time.monotonic() + HANG_S
        while not self.cart.wait_done(cycle, ASK_S):
            if self.asked():
                raise KeyboardInterrupt
            for info in self.cart.components() if time.monotonic() > until_s else ():
                process = self._children.get(info.name)
                if process is not None and info.participant and info.alive and info.done < cycle:
                    self.lost = self.lost or f"the process of {info.name} hung in cycle {cycle}, and was ended"
                    process.kill()
                    process.wait()
        for component, child in self._children.items():
            if not self.lost and child.poll() is not None:
                self.lost = f"the process of {component} ended in cycle {cycle} ({how_it_ended(child.returncode)})"

    def _over(self, cycle: int) -> bool:
        """Say whether the drive ends: by time, by hand, or because the cart stands and will not go on."""
        if self._hand is not None and self._hand.hand.quit:
            return True
        if cycle % 10 and not self._ended_s and cycle < self._last_cycle:
            return False
        now_s = self.time_s
        if cycle % 10 == 0:
            standing = abs(self.sim.plant.state.vx_mps) < 0.01
            self._ended_s = (self._ended_s or now_s) if standing and self._ended(cycle) else 0.0
        settled = self._ended_s > 0 and now_s - self._ended_s >= SETTLE_S
        return settled or now_s >= self.setup.scenario.duration_s

    def _ended(self, cycle: int) -> bool:
        """Say whether nobody will move the cart again: it has arrived, is far astray, or something failed for good."""
        if self.hal.driver.state is SystemState.FAULT:
            return True
        shown: list[Object[Any]] = [*self._ends, *self._statuses]
        return bool(self.lost) or any(is_end(self._value(obj, cycle)) for obj in shown)

    @staticmethod
    def _value(obj: Object[Any], cycle: int) -> Any:
        sample = obj.visible(cycle)
        return None if sample is None else sample.value

    def close(self) -> None:
        """End the processes of this drive and give the stores back."""
        for child in self._children.values():
            if child.stdin is not None:
                child.stdin.close()
            child.terminate()
        for child in self._children.values():
            child.wait()
        self._children.clear()
        if self._hand is not None:
            self._hand.__exit__(None, None, None)
        if self.simulated is not None:  # not assembled to the end
            self.simulated.close()
        self.cart.close()
        self.world.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def seat_of(wire: Wire) -> SeatSpec:
    """Give the seat that the file server keeps for a component without a module."""
    return SeatSpec(
        component=wire.component,
        every=wire.every,
        phase=wire.phase,
        latency_cycles=wire.latency_cycles,
        config=wire.entry(),
    )


def is_end(shown: object) -> bool:
    """Say whether somebody will not go on: it has arrived, is far astray, or failed for good."""
    if isinstance(shown, FollowState):
        return shown.finished
    if isinstance(shown, GuardState):
        return shown.hold is Hold.OUTSIDE
    if isinstance(shown, dict):  # a script's status: FollowState as JSON
        state = shown.get("state")
        return isinstance(state, dict) and state.get("finished") is True
    return isinstance(shown, ModuleStatus) and shown.state is ModuleState.FAULT


def metadata(setup: Setup) -> dict[str, str]:
    """Say what a recording is of."""
    return {
        "scenario": setup.scenario.id,
        "seed": str(setup.seed),
        "level": setup.level,
        "plant": setup.plant,
        "randomise": setup.randomise,
        "site": setup.scenario.site,
        "version": version(),
    }


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
    with Drive(setup) as run, asked_to_end() as asked, ExitStack() as stack:
        run.asked = asked
        recorder = stack.enter_context(Recorder(recording, [run.cart, run.world], metadata(setup)))
        observer = begin([run.cart, run.world]) if begin is not None else None
        begun_s = time.monotonic()
        gc.freeze()  # what the libraries made once is not looked through again and again,
        gc.disable()  # and what a cycle makes holds no rings; a module's own go every COLLECT_CYCLES
        stack.callback(gc.unfreeze)
        stack.callback(gc.enable)
        while not run.tick(recorder):
            if run.cart.cycle % COLLECT_CYCLES == 0:
                gc.collect()
            if asked():
                raise KeyboardInterrupt
            if observer is not None:
                observer.record()
            if pace is not None:
                time.sleep(max(0.0, begun_s + run.time_s / pace - time.monotonic()))
            if progress is not None and run.cart.cycle % 50 == 0:
                progress(run.time_s)
        return run.lost
