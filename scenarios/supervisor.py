"""The supervisor: runs a scenario's stack in real time, each part in a process of its own.

    supervisor ┬─ clock      ticks, in C                       scenarios/clock_process.py
               ├─ hal        drivers, and the simulated cart   scenarios/cart_process.py
               ├─ MODULE     one each                          autonomy/process.py
               ├─ files      for scripts, if there are any     rtdb/syncfs/process.py
               └─ recorder   looks on                          scenarios/recorder_process.py

Who has ended is restarted if nobody drives by it: a module that the command does not need, the recorder. Anything else
stops the cart: a required module by the age of its outputs, the supervisor and the clock by the hal process, which
sees for itself that they are gone. Nothing here commands the cart; the supervisor can only ask hal to stop it.
"""

import json
import math
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, TypeVar

from autonomy.module import ModuleError
from autonomy.process import READY, spawn
from autonomy.wiring import Stack, Wire, required, wire_of
from hal.bus import Level
from hal.errors import HalError
from hal.signals import FollowState, GuardState, ModuleState, ModuleStatus, Odometry, SafetyState, SystemState
from rtdb import Record, RtdbError, State, Store, Writer
from rtdb.syncfs.policy import Tokens
from rtdb.syncfs.process import spawn as spawn_server

from .cart import TICK_NS, DriveError
from .cart_process import ORDERS
from .course import CourseImpossible
from .ending import asked_to_end, how_it_ended
from .plan import course_record, rng_of
from .rewire import stack_of
from .run import SETTLE_S, STORE_BYTES, Setup, is_end, metadata, seat_of
from .scenario import Scenario

R = TypeVar("R", bound=Record)
Kind = Literal["clock", "hal", "recorder", "module", "files"]
PRIORITY: dict[Kind, int | None] = {"clock": 80, "hal": 70, "module": 60, "files": 55, "recorder": None}
RESTARTS, RESTARTS_S = 3, 10.0
HANG_CYCLES = 200  # a module that finished nothing for so long hangs
TELL_S = 10.0
START_S = 90.0  # until the first tick
LOOK_S = 0.1
STAND_S = 15.0  # for the limits to bring the cart to a stand
END_S = 30.0  # for hal to stop the cart, for the recorder to finish its file
QUIT_S = 2.0  # for a process that was asked to go


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSetup:
    """What to run. db: name of the cart's store; for_s: how long at most; realtime: ask for real-time priorities;
    listen, tokens: of the file server, where a script is a component, see scenarios.run.Setup.
    """

    scenario: Scenario
    stack: Stack
    folder: Path
    db: str
    seed: int = 0
    level: Level = "wire"
    for_s: float | None = None
    realtime: bool = False
    listen: str | None = None
    tokens: Mapping[str, str] = field(default_factory=dict)

    @property
    def scripts(self) -> list[Wire]:
        """The components that are scripts."""
        return [wire for wire in self.stack.wires if wire.is_files]


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a run ended. `lost`: what went wrong, empty if nothing did; `late`: what came too late for its cycle."""

    ended: str
    lost: str = ""
    interrupted: bool = False
    late: dict[str, int] = field(default_factory=dict)


class Do(Enum):
    """What to do about a process that has ended."""

    RESTART = "is started anew"
    LEAVE = "stays away: it ended too often"
    STOP = "the cart is stopped"


def what_to_do(kind: Kind, is_required: bool, restarts_s: Sequence[float], now_s: float) -> Do:
    """Decide about a process that has ended; restarts_s: when it was restarted before."""
    if kind in ("clock", "hal") or is_required:
        return Do.STOP
    if sum(now_s - at_s < RESTARTS_S for at_s in restarts_s) < RESTARTS:
        return Do.RESTART
    return Do.STOP if kind == "recorder" else Do.LEAVE


@dataclass
class Child:
    """A process of the run."""

    kind: Kind
    name: str
    process: "subprocess.Popen[str]"
    restarts_s: list[float] = field(default_factory=list)
    gone: bool = False

    def quit(self, wait_s: float) -> None:
        """Let it go: the end of its standard input tells it to; who does not listen is ended."""
        if self.process.stdin is not None:
            with suppress(OSError):
                self.process.stdin.close()
        try:
            self.process.wait(wait_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class Supervisor:
    """A run in real time: `start` and `run` it in a `with`.

    say: where its lines go; asked: says why the run shall end, as soon as somebody asks for it.
    """

    def __init__(self, setup: RunSetup, say: Callable[[str], None], asked: Callable[[], str]) -> None:
        self.setup, self._say, self._asked = setup, say, asked
        self._required = required(setup.stack)
        self._tokens = Tokens()  # the same for a server that is started anew
        for wire in setup.scripts:
            self._tokens.give(wire.component, setup.tokens.get(wire.component))
        self._children: dict[str, Child] = {}
        self._recordings = 0
        scenario = setup.scenario
        try:
            course_record(scenario, scenario.load_site(), rng_of(setup.seed))
        except CourseImpossible as error:
            raise DriveError(str(error), invalid=True) from error
        self.cart = Store.create(setup.db, clock="real", tick_ns=TICK_NS, size=STORE_BYTES)
        self.world: Store | None = None
        try:
            # nobody's clock: hal takes it, and ticks the world as it moves it on
            self.world = Store.create(f"{setup.db}-world", clock="barrier", tick_ns=TICK_NS, t0_ns=scenario.t0_ns)
            self._me = self.cart.join("supervisor")
            self._orders: Writer[Any] = self._me.insert("orders", ORDERS, history_s=0.1)
        except BaseException:
            self.close()
            raise

    # -- processes ------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Start all processes, and wait for the first tick."""
        setup, names = self.setup, [wire.component for wire in self.setup.stack.wires]
        self._start(
            "hal",
            "hal",
            {
                "scenario": setup.scenario.model_dump_json(),
                "seed": setup.seed,
                "level": setup.level,
                "command": setup.stack.command,
            },
        )
        self._wait("hal", lambda: self._has("actuators/config"))  # what modules may be wired to
        if setup.scripts:
            self._start_files()
            self._wait(
                "scripts", lambda: all(self._has(f"{wire.component}/status") for wire in setup.scripts), math.inf
            )
        for wire in setup.stack.wires:
            if not wire.is_files:
                self._start_module(wire)
        self._start_recorder()
        modules = [wire.component for wire in setup.stack.wires if not wire.is_files]
        for name in modules:
            self._wait(name, lambda name=name: self._is_ready(name))  # type: ignore[misc]
        self._start("clock", "clock", {"wait_for": [*names, "hal", "supervisor"]})
        self._wait("the first tick", lambda: self.cart.cycle > 0)

    def _start(self, kind: Kind, name: str, job: dict[str, Any]) -> None:
        priority = PRIORITY[kind] if self.setup.realtime else None
        job = {"store": self.setup.db, "world": f"{self.setup.db}-world", "priority": priority, **job}
        module = {"clock": "clock_process", "hal": "cart_process", "recorder": "recorder_process"}[kind]
        process = subprocess.Popen(
            [sys.executable, "-m", f"scenarios.{module}"], stdin=subprocess.PIPE, text=True, process_group=0
        )
        assert process.stdin is not None
        process.stdin.write(json.dumps(job) + "\n")
        process.stdin.flush()  # it stays open: its end tells the child that we are gone
        self._adopt(Child(kind, name, process))

    def _start_module(self, wire: Wire) -> None:
        setup, priority = self.setup, PRIORITY["module"] if self.setup.realtime else None
        behind = tuple(other.component for other in setup.stack.wires)
        process = spawn(setup.db, (wire,), setup.seed, faults=setup.folder, behind=behind, priority=priority, group=0)
        self._adopt(Child("module", wire.component, process))

    def _start_files(self) -> None:
        setup = self.setup
        seats, priority = [seat_of(wire) for wire in setup.scripts], PRIORITY["files"] if setup.realtime else None
        process = spawn_server(setup.db, seats, setup.listen, self._tokens.of, group=0, priority=priority)
        self._adopt(Child("files", "files", process))

    def _start_recorder(self) -> None:
        setup, self._recordings = self.setup, self._recordings + 1
        said = metadata(Setup(scenario=setup.scenario, seed=setup.seed, level=setup.level)) | {"clock": "real"}
        name = "run.mcap" if self._recordings == 1 else f"run-{self._recordings}.mcap"
        self._start("recorder", "recorder", {"file": str(setup.folder / name), "metadata": said})

    def _adopt(self, child: Child) -> None:
        key = f"{child.kind} {child.name}"
        known = self._children.get(key)
        child.restarts_s = known.restarts_s if known is not None else []
        self._children[key] = child

    def _wait(self, what: str, is_there: Callable[[], bool], longest_s: float = START_S) -> None:
        deadline_s = time.monotonic() + longest_s
        while not is_there():
            for child in self._children.values():
                if (code := child.process.poll()) is not None:
                    raise DriveError(f"{child.name} ended at once ({how_it_ended(code)})", invalid=False)
            if self._asked():
                raise KeyboardInterrupt
            if time.monotonic() > deadline_s:
                raise DriveError(f"{what} did not come within {START_S:.0f} s", invalid=False)
            self.cart.core.wait_directory(self.cart.core.version, 20_000_000)

    def _has(self, name: str) -> bool:
        return bool(self.cart.objects(name))

    def _is_ready(self, component: str) -> bool:
        """Whether a module has loaded everything, so that its first cycles are like all others."""
        return self._has(f"{component}/health") and self._told(component) == READY

    def _told(self, component: str) -> str:
        """What a component says of itself."""
        sample = self.cart.find(f"{component}/health").latest()
        return sample.value["status"] if sample is not None else ""

    # -- the run --------------------------------------------------------------------------------------------------

    def run(self) -> Outcome:
        """Look after everybody until the drive is over, or somebody asks for its end; then stop the cart."""
        setup, settled_s, outcome = self.setup, 0.0, None
        longest_s = setup.for_s if setup.for_s is not None else setup.scenario.duration_s
        cycle, told_s = 0, 0.0
        while outcome is None:
            cycle = self.cart.wait_cycle(cycle + 9, LOOK_S) or self.cart.cycle
            now_s = cycle * TICK_NS * 1e-9
            self._note_required()
            lost = self._look_after()
            why = self._asked()
            if now_s >= told_s + TELL_S:
                told_s = now_s
                self._say(self._progress(now_s))
            settled_s = (settled_s or now_s) if self.stands and self._is_over() else 0.0
            if lost:
                outcome = Outcome(lost, lost)
            elif why:
                outcome = Outcome(why, interrupted=True)
            elif settled_s and now_s - settled_s >= SETTLE_S:
                outcome = Outcome(f"the cart stands, and nothing will move it{self._blame()}")
            elif now_s >= longest_s:
                outcome = Outcome(f"{now_s:.0f} s are over")
        late = {info.name: info.missed for info in self.cart.components() if info.missed}
        if self.cart.clock.skipped:
            late["ticks"] = self.cart.clock.skipped
        self._stop_cart(outcome)
        if self._recordings > 1 and not outcome.lost:
            outcome = replace(outcome, lost="the recorder was started anew: run.mcap is not the whole run")
        return replace(outcome, late=late)

    def _look_after(self) -> str:
        """See who has ended, and do what is to be done; gives why the cart must stop, empty if it need not."""
        order: dict[Kind, int] = {"clock": 0, "hal": 1, "files": 2, "module": 3, "recorder": 4}  # causes before effects
        for child in sorted(self._children.values(), key=lambda child: order[child.kind]):
            code = child.process.poll()
            if code is None and not child.gone and (hangs := self._hangs(child)):
                if child.name in self._required:
                    self._say(f"{hangs}; {Do.STOP.value}")
                    return hangs
                self._say(f"{hangs}; it is ended")
                child.process.kill()
                child.process.wait()
                code = child.process.poll()
            if code is None or child.gone:
                continue
            now_s = time.monotonic()
            names = [wire.component for wire in self.setup.scripts] if child.kind == "files" else [child.name]
            is_required = child.kind in ("module", "files") and not self._required.isdisjoint(names)
            do = what_to_do(child.kind, is_required, child.restarts_s, now_s)
            what = f"{child.name} ended in cycle {self.cart.cycle} ({how_it_ended(code)})"
            if child.kind == "hal":
                what += ": " + (
                    self._told("hal") if code > 0 else "on a cart the safety node stops it, here it is gone"
                )
            self._say(what if child.kind == "hal" else f"{what}; {do.value}")
            if do is Do.STOP:
                return what
            child.gone = do is Do.LEAVE
            if do is Do.RESTART:
                child.restarts_s.append(now_s)
                self._restart(child)
        return ""

    def _hangs(self, child: Child) -> str:
        """Say that a module lives, but has finished no cycle for a while; empty if it has."""
        if child.kind != "module" or not self.cart.cycle:
            return ""
        info = next((info for info in self.cart.components() if info.name == child.name), None)
        if info is None or not info.alive or not info.participant:
            return ""
        late = self.cart.cycle - info.done
        if late <= max(HANG_CYCLES, 3 * info.every):
            return ""
        return f"{child.name} hangs: the last cycle that it finished is {info.done}, {late * TICK_NS * 1e-9:.1f} s ago"

    def _blame(self) -> str:
        """Say which of the modules that the cart drives by does not run, and why; empty if all do."""
        for name in sorted(self._required):
            said = self.cart.objects(f"{name}/status", record=ModuleStatus)  # a script's is JSON
            status = self._newest(f"{name}/status", ModuleStatus) if said else None
            if status is not None and status.state is not ModuleState.RUNNING:
                return f": {name} is {status.state.name}: {status.reason}"
        return ""

    def _restart(self, child: Child) -> None:
        if child.kind == "recorder":
            self._start_recorder()
            return
        if child.kind == "files":
            self._start_files()
            return
        wire = next(wire for wire in self.setup.stack.wires if wire.component == child.name)
        with suppress(RtdbError, ModuleError):  # as it is wired now, if that can be read
            sample = self.cart.find(f"{child.name}/config").latest()
            if sample is not None:
                wire = wire_of(child.name, child.name, sample.value)
        self._start_module(wire)

    def _note_required(self) -> None:
        """Note whom the cart drives by, as it is wired now. What cannot be read, its host refuses and takes away."""
        with suppress(RtdbError, ModuleError, HalError):
            self._required = required(stack_of(self.cart))

    @property
    def stands(self) -> bool:
        """Whether the cart stands, as its odometry says."""
        travel = self._newest("odometry/travel", Odometry)
        return travel is None or travel.speed_mps == 0.0

    def _is_over(self) -> bool:
        """Whether nobody will move the cart again. A module that nobody drives by may fail."""
        safety = self._newest("safety/state", SafetyState)
        if safety is not None and safety.state is SystemState.FAULT:
            return True
        scripts = [f"{wire.component}/status" for wire in self.setup.scripts if wire.component in self._required]
        if any(sample is not None and is_end(sample.value) for sample in (self.cart.find(n).latest() for n in scripts)):
            return True
        ends: dict[str, type[Record]] = {cls.__name__: cls for cls in (FollowState, GuardState, ModuleStatus)}
        return any(
            is_end(self._newest(obj.name, ends[obj.schema.name]))
            for obj in self.cart.objects()
            if obj.schema.name in ends and obj.component in self._required
        )

    def _progress(self, now_s: float) -> str:
        """Say how far it has come."""
        travel = self._newest("odometry/travel", Odometry)
        states = [obj.name for obj in self.cart.objects("*/state") if obj.schema.name == FollowState.__name__]
        follow = self._newest(states[0], FollowState) if states else None
        speed = f", {travel.speed_mps:.1f} m/s" if travel is not None else ""
        return f"{now_s:4.0f} s{speed}" + (f", towards way-point {follow.waypoint + 1}" if follow is not None else "")

    def _newest(self, name: str, cls: type[R]) -> R | None:
        sample = self.cart.find(name, cls).latest()
        return sample.value if sample is not None else None

    # -- the end --------------------------------------------------------------------------------------------------

    def _stop_cart(self, outcome: Outcome) -> None:
        """Wait until the cart stands: by its limits if a module is gone, else hal is asked to stop it."""
        self._me.status(outcome.ended, State.WARNING)
        deadline_s = time.monotonic() + STAND_S
        hal = self._children["hal hal"].process
        cycle = self.cart.cycle
        while outcome.lost and not self._asked() and hal.poll() is None and time.monotonic() < deadline_s:
            moved = self.cart.wait_cycle(cycle, LOOK_S)
            if self.stands or (moved is None and not self.cart.clock.alive):
                break  # without a clock hal stops it by itself
            cycle = moved or cycle
        self._order_stop(outcome.ended, recorded=None if outcome.lost or outcome.interrupted else self.cart.cycle)
        try:
            hal.wait(END_S)
        except subprocess.TimeoutExpired:
            self._say(f"hal did not end within {END_S:.0f} s of being asked to stop the cart, and is ended")

    def _order_stop(self, why: str, recorded: int | None = None) -> None:
        """Ask hal to stop the cart, and to end. recorded: the last cycle that is part of the drive."""
        order: dict[str, Any] = {"stop": why.encode()[:100].decode(errors="ignore")}
        self._orders.write(order if recorded is None else order | {"recorded": recorded})

    def close(self, *, wait: bool = True) -> None:
        """Stop the cart if it is not stopped yet, end all processes, the clock last, and remove the stores' names."""
        hal = self._children.get("hal hal")
        if hal is not None and hal.process.poll() is None:
            if self.cart.cycle == 0:
                hal.process.terminate()  # it has never moved, and may still be waiting for somebody
            elif wait:
                self._order_stop("the supervisor ends")
                hal.quit(END_S)
        last: dict[Kind, int] = {"hal": 0, "recorder": 1, "module": 2, "files": 3, "clock": 4}
        children = sorted(self._children.values(), key=lambda child: last[child.kind])
        for child in children:
            if child.kind == "module":
                child.process.terminate()  # it listens to the clock only
        for child in children:
            child.quit(END_S if child.kind == "recorder" else QUIT_S)
        self._children.clear()
        self.cart.close()
        if self.world is not None:
            self.world.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(wait=kind is None or issubclass(kind, Exception))


def supervise(setup: RunSetup, say: Callable[[str], None]) -> Outcome:
    """Run a scenario in real time from its start to its end, and leave a recording in the folder."""
    with asked_to_end() as asked, Supervisor(setup, say, asked) as supervisor:
        supervisor.start()
        say(f"{setup.db}: {', '.join(wire.component for wire in setup.stack.wires)} drive; Ctrl-C stops the cart")
        return supervisor.run()
