"""Hosts: run modules on a store, and keep their faults to themselves.

Each due tick: inputs from the cut, the step, outputs checked and committed with inherited data time and lineage. A
module that raises, gives NaN or a value out of range, assigns something else than its outputs, forgets one, or does
not end is stopped for good (the fault latches). Its outputs are held for as long as their ports declare, then
the host writes their safe values.

Objects of a component: its outputs; `status`; `config` (its wiring, writable by anybody: the host takes a new one at
the next due tick or says what is wrong with it); `show` (what the module shows); `timing`, where a budget is declared.
"""

import logging
import math
import sys
import time
import traceback
import zlib
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hal.signals import ModuleState, ModuleStatus, ModuleTiming
from rtdb import HOST_DEPENDENT, Component, Flag, Kind, Record, RtdbError, Sample, Store, Writer, schema_of
from rtdb.json_object import json_schema

from .contain import HANG_CPU_S, HANG_WALL_S, StepHung, Watch, capped
from .loading import check_inputs, checked_params, inputs_of, make_module
from .module import InputPort, Module, ModuleError, OutputPort, Ranges
from .outputs import check_names, checks_of, payloads_of
from .pointer import Link, Unusable, link
from .shown import shown
from .wiring import Wire, wire_of

if TYPE_CHECKING:
    import numpy as np

log = logging.getLogger(__name__)
HISTORY_S = 2.0
CONFIG_BYTES, SHOW_BYTES = 2000, 2000
REASON_BYTES = 160  # as ModuleStatus has it
OWN_FILES = Path(__file__).parent, ("host.py", "module.py", "outputs.py")  # their lines tell a student nothing
FOREVER_NS = 1 << 62
NOT_YET = "is not there yet"
JSON_EDGES = 3  # so many of its writer's edges old may a JSON input be that has no max_age_s
watch = Watch()


def seeded(seed: int, name: str) -> "np.random.Generator":
    """Make the random generator of one named part of a run."""
    import numpy as np

    return np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(name.encode())]))


class Result:
    """What a step gave: payloads of the outputs, what they were computed from, and the cycle in which to commit it."""

    __slots__ = ("causes", "cycle", "payloads", "t_data_ns")

    def __init__(self, cycle: int, payloads: list[bytes], t_data_ns: int, causes: tuple[tuple[int, int], ...]) -> None:
        self.cycle, self.payloads, self.t_data_ns, self.causes = cycle, payloads, t_data_ns, causes


class Host:
    """Runs one module. Make all hosts of a run, then `connect` them, then `step` them at every tick."""

    def __init__(
        self, store: Store, wire: Wire, seed: int, *, participant: bool = False, faults: Path | None = None
    ) -> None:
        self.wire, self.seed, self._faults = wire, seed, faults
        self.module: Module = make_module(wire)
        cls, dt_s = type(self.module), wire.every * store.tick_ns * 1e-9
        if cls.pace_s is not None and abs(cls.pace_s - dt_s) > 1e-9:
            raise ModuleError(
                f"{wire.component}: {wire.module} was made for a step every {cls.pace_s:g} s, here it is {dt_s:g} s; "
                "change `every` in the stack, or train anew"
            )
        due = math.gcd(wire.every, wire.latency_cycles)  # whoever waits for it waits for what it commits later, too
        self.component: Component = store.join(
            wire.component, participant=participant, every=due, phase=wire.phase % due
        )
        self._store, self._real = store, participant and store.clock.kind is Kind.REAL
        edge: dict[str, Any] = {"every": wire.every, "history_s": HISTORY_S}
        edge["phase"] = (wire.phase + 1 + wire.latency_cycles) % wire.every
        self._outputs: list[tuple[OutputPort[Any], Writer[Any]]] = [
            (port, self._insert(name, port, edge)) for name, port in cls.outputs.items()
        ]
        self._checks = checks_of(cls)
        edge["phase"] = (wire.phase + 1) % wire.every
        self._status = self.component.insert("status", ModuleStatus, **edge)
        few: dict[str, Any] = {"history_s": 0.1}
        self._show: Writer[Any] = self.component.insert("show", json_schema(SHOW_BYTES), **(edge | few))
        self._config: Writer[Any] = self.component.insert(
            "config", json_schema(CONFIG_BYTES), flags=Flag.PUBLIC_WRITE | HOST_DEPENDENT, **few
        )
        self._configured = self._config.write(wire.entry(), store.now_ns)
        self._timing = (
            self.component.insert("timing", ModuleTiming, flags=HOST_DEPENDENT, **edge)
            if wire.budget_ms is not None
            else None
        )
        self._took = ModuleTiming()
        self._budget_s = wire.budget_ms * 1e-3 if wire.budget_ms is not None else None
        self._hang_s = HANG_CPU_S if self._budget_s is None else max(1.0, 20.0 * self._budget_s)
        self._deadline_ns = int(wire.budget_ms * 1e6) if wire.budget_ms is not None else wire.every * store.tick_ns
        self._inputs: list[tuple[str, InputPort[Any], Link | None, int]] = []
        self._state, self._reason = ModuleState.WAITING, ""
        self._steps = self._missed = 0
        self.module.rng = self._rng = seeded(seed, wire.component)
        self.rng_before: Mapping[str, Any] | None = None  # state of the generator before the step, for a repro
        self.module.dt_s = dt_s
        self._last: dict[str, tuple[int, Any]] = {}  # write number and value of each input
        self._pending: deque[Result] = deque()
        self._started, self._without = False, ""
        self._streams = capped(wire.component)
        self._status.write(ModuleStatus())

    def _insert(self, name: str, port: OutputPort[Any], edge: dict[str, Any]) -> Writer[Any]:
        """Insert an output; its schema tells readers the range that this module keeps to."""
        schema = narrowed(port.cls, port.ranges) if port.ranges else port.cls
        n_causes = min(8, len(type(self.module).inputs))
        self.component.insert(name, schema, n_causes=n_causes, **edge)
        return self._store.writer(f"{self.wire.component}/{name}", port.cls)

    @property
    def fault(self) -> str:
        """Why the module was stopped, empty while it runs."""
        return self._reason if self._state is ModuleState.FAULT else ""

    def connect(self, timeout_s: float = 0.0) -> None:
        """Find the objects that the inputs point at."""
        self._inputs = self._links(self.wire, timeout_s)

    def prepare(self) -> None:
        """Call the module's `reset` before the first cycle: what it loads then costs no cycle."""
        if not self._started:
            self._started, self._cycle, self._now_ns = True, self._store.cycle, self._store.now_ns
            self.module.t_ns = self._now_ns
            self._guarded(self.module.reset)

    def _links(self, wire: Wire, timeout_s: float) -> list[tuple[str, InputPort[Any], Link | None, int]]:
        out: list[tuple[str, InputPort[Any], Link | None, int]] = []
        pointers = inputs_of(type(self.module), wire.inputs)
        for name, port in type(self.module).inputs.items():
            pointer, found = pointers.get(name), None
            if pointer is not None:
                try:
                    found = link(self._store, pointer, port, 0.0 if port.optional else timeout_s)
                except (RtdbError, ModuleError) as error:
                    if not (port.optional and isinstance(error, KeyError)):  # nobody need provide what is optional
                        raise ModuleError(f"{wire.component}.{name} = {pointer}: {error}") from error
            out.append((name, port, found, self._max_age_ns(port, found)))
        return out

    def _max_age_ns(self, port: InputPort[Any], found: Link | None) -> int:
        """Give the age from which on an input counts as absent."""
        if port.max_age_s is not None:
            return int(port.max_age_s * 1e9)
        if found is not None and found.json and not port.static:  # who writes JSON says how often, and nothing else
            return JSON_EDGES * found.obj.every * self._store.tick_ns
        return FOREVER_NS

    # -- one cycle --------------------------------------------------------------------------------------------------

    def step(self, cycle: int, _t_ns: int = 0) -> None:
        """Run the module if it is due in this cycle."""
        if self.begin(cycle):
            self.finish()

    def begin(self, cycle: int) -> bool:
        """Put the inputs of this cycle into the module; False if it is not due, or cannot be called."""
        if self._pending and self._pending[0].cycle <= cycle:
            self._commit(self._pending.popleft())
        if cycle % self.wire.every != self.wire.phase:
            return False
        self._cycle = cycle
        now_ns = self._now_ns = self._store.core.now_ns
        if self._state is ModuleState.FAULT:
            self._miss(now_ns)
            return False
        if self._store.core.visible_write(self._config.handle, cycle) > self._configured:
            self._rewire(cycle)
        absent = self._read(cycle, now_ns)
        if absent:
            self._say(ModuleState.STALE if self._steps else ModuleState.WAITING, absent)
            self._miss(now_ns)
            return False
        module = self.module
        module.t_ns = self._store.t0_ns + cycle * self._store.tick_ns
        if not self._started:
            self._started = True
            return self._guarded(module.reset)
        return True

    def finish(self) -> None:
        """Call the step, and commit what it gave."""
        module = self.module
        before: dict[str, Any] = {}
        if self._faults is not None:
            before, self.rng_before = dict(module.__dict__), self._rng.bit_generator.state
        names = len(module.__dict__)
        module._out.clear()
        begun_s = time.perf_counter() if self._timing is not None else 0.0
        if not self._guarded(module.step, before):
            return
        if self._timing is not None:
            self._note_time(time.perf_counter() - begun_s)
        late_ns = self._store.core.now_ns - module.t_ns - self._deadline_ns if self._real else 0
        try:
            if len(module.__dict__) != names:
                check_names(module)
            payloads = payloads_of(module, self._checks)
        except Exception as error:  # a value may be anything
            self._fail(error, before)
            return
        self._steps += 1
        if module._shown:
            self._write_shown()
        if late_ns > 0:
            self._say(ModuleState.LATE, f"cycle {self._cycle}: {late_ns * 1e-6:.1f} ms late, its result is dropped")
            self._miss(self._now_ns)
            return
        self._missed = 0
        result = self._result(payloads)
        if self.wire.latency_cycles:
            self._pending.append(result)
        else:
            self._commit(result)
        self._say(ModuleState.RUNNING, self._without)

    def _guarded(self, call: Callable[[], None], before: dict[str, Any] | None = None) -> bool:
        """Call the module; False if that went wrong. Its prints are capped, and an endless loop is ended."""
        streams = sys.stdout, sys.stderr
        sys.stdout, sys.stderr = self._streams
        try:
            watch.begin(HANG_CPU_S if before is None else self._hang_s)  # a reset may load what it likes
            try:
                call()
            finally:
                watch.end()
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # a module may raise anything; it must not harm others
            watch.end()  # again: the first one may have been cut short
            sys.stdout, sys.stderr = streams
            self._fail(error, before or {})
            return False
        finally:
            sys.stdout, sys.stderr = streams
        return True

    def _read(self, cycle: int, now_ns: int) -> str:
        """Put the inputs of this cut into the module; returns what is absent, empty if nothing is."""
        module = self.module
        before, without = dict(module.samples), list[str]()
        module.samples.clear()
        for name, port, found, max_age_ns in self._inputs:
            absent = self._take(name, found, max_age_ns, cycle, now_ns, before.get(name))
            if absent and not port.optional:
                return f"input {name} ({inputs_of(type(module), self.wire.inputs)[name]}) {absent}"
            if absent:
                module.__dict__[name] = None
                if found is not None and absent is not NOT_YET:
                    without.append(name)
        self._without = f"without {', '.join(without)}: too old, or not usable" if without else ""
        return ""

    def _take(
        self, name: str, found: Link | None, max_age_ns: int, cycle: int, now_ns: int, before: Sample[Any] | None
    ) -> str:
        """Put one input into the module; returns why it is absent, empty if it is there."""
        if found is None:
            return NOT_YET
        try:
            sample = found.obj.visible_since(cycle, before)
        except RtdbError as error:  # aged out, or no JSON
            return f"cannot be read: {error}"
        if sample is None:
            return NOT_YET
        age_ns = now_ns - (sample.t_commit_ns if found.json else sample.t_data_ns)
        if age_ns > max_age_ns:
            return f"is {age_ns * 1e-9:.2f} s old, at most {max_age_ns * 1e-9:g} s"
        value = sample.value
        if found.value is not None:
            known = self._last.get(name)
            if known is None or known[0] != sample.write:
                try:
                    known = self._last[name] = (sample.write, found.value(sample))
                except Unusable as error:
                    return f"cannot be used: {error}"
            value = known[1]
        self.module.samples[name] = sample
        self.module.__dict__[name] = value
        return ""

    def _result(self, payloads: list[bytes]) -> Result:
        t_data_ns, causes = self._now_ns, []
        for name, port, found, _ in self._inputs:
            sample = self.module.samples.get(name)
            if sample is None or port.static or found is None:
                continue
            causes.append((found.obj.oid, sample.write))
            t_data_ns = min(t_data_ns, sample.t_data_ns)
        return Result(self._cycle + self.wire.latency_cycles, payloads, t_data_ns, tuple(causes[:8]))

    def _commit(self, result: Result) -> None:
        core = self._store.core
        for (_, writer), payload in zip(self._outputs, result.payloads, strict=True):
            core.write(writer.handle, payload, core.not_before(writer.handle, result.t_data_ns), result.causes)

    # -- what goes wrong --------------------------------------------------------------------------------------------

    def _fail(self, error: BaseException, before: dict[str, Any]) -> None:
        """Stop the module for good."""
        name, cycle = self.wire.component, self._cycle
        reason, where = self._reason_of(error), _where(error, type(self.module))
        self._say(ModuleState.FAULT, cut(f"cycle {cycle}: {reason}", REASON_BYTES - len(where.encode())) + where)
        self._pending.clear()
        self._miss(self._now_ns)
        log.warning("%s stopped at cycle %d: %s", name, cycle, reason)
        log.debug("traceback", exc_info=error)
        if self._faults is not None:
            self._keep(self._faults, before, error)
        if isinstance(error, MemoryError):
            traceback.clear_frames(error.__traceback__)
            self.module.__dict__.clear()  # what it has gathered

    def _reason_of(self, error: BaseException) -> str:
        if isinstance(error, StepHung):
            what = f"the step did not end within {self._hang_s:g} s of CPU time, or {HANG_WALL_S:g} s"
        elif isinstance(error, MemoryError) and not error.args:
            what = "there is no memory left for it; memory_mb in the wiring says how much it may take"
        else:
            try:
                what = " ".join(str(error).split())
            except Exception:  # its own class of errors, with mistakes of its own
                what = "it cannot say what"
        return f"{type(error).__name__}: {what}" if what else type(error).__name__

    def _keep(self, folder: Path, before: dict[str, Any], error: BaseException) -> None:
        """Save the step that broke; what goes wrong with that harms nobody."""
        try:
            from .repro import save

            log.info("fairway repro %s runs just this step again", save(folder, self, before, error))
        except Exception as problem:  # a full disk; memory() and pickling are the module's own code
            log.warning("the step that broke %s is not saved: %s", self.wire.component, type(problem).__name__)

    def _miss(self, now_ns: int) -> None:
        """Hold the outputs for a while, then write the safe ones."""
        if not self._outputs or not self._outputs[0][1].head:
            return  # nothing was ever said: there is nothing to take back
        self._missed += 1
        core = self._store.core
        for port, writer in self._outputs:
            if self._missed > port.hold_steps:
                writer.write(port.safe, core.not_before(writer.handle, now_ns))

    def _rewire(self, cycle: int) -> None:
        """Take the wiring that somebody wrote, or stay with the present one and say why."""
        self._configured = self._store.core.visible_write(self._config.handle, cycle)
        name = self.wire.component
        try:
            sample = self._config.visible(cycle)
            wire = wire_of(name, name, sample.value if sample is not None else None)
            fixed = ("module", "every", "phase", "latency_cycles", "budget_ms", "memory_mb")
            for key in fixed:
                if getattr(wire, key) != getattr(self.wire, key):
                    raise ModuleError(
                        f"{name}: {key} stays as it is while the system runs; inputs and params may change"
                    )
            cls = type(self.module)
            check_inputs(name, cls, wire.inputs)
            params = checked_params(name, cls, wire.params)
            links = self._links(wire, 0.0)
        except (ModuleError, RtdbError) as error:
            log.warning("%s keeps its wiring: %s", name, error)
            self._configured = self._config.write(self.wire.entry(), self._store.now_ns)  # what is in force
            self._status.write(self._told(f"wiring refused: {error}"))
            return
        self.wire, self._inputs = wire, links
        self.module.samples.clear()
        self._last.clear()
        for port in cls.params:
            self.module.__dict__.pop(port, None)
        self.module.__dict__.update(params)
        self._status.write(self._told(f"wired anew in cycle {cycle}"))

    # -- what it says -----------------------------------------------------------------------------------------------

    def _say(self, state: ModuleState, reason: str) -> None:
        if (state, reason) != (self._state, self._reason) and not (state is self._state is ModuleState.STALE):
            self._state, self._reason = state, reason
            self._status.write(self._told(reason))

    def _told(self, reason: str) -> ModuleStatus:
        return ModuleStatus(state=self._state, steps=self._steps, reason=cut(reason, REASON_BYTES))

    def _write_shown(self) -> None:
        document = shown(self.module._shown, SHOW_BYTES)
        self.module._shown.clear()
        self._show.write(document, self._now_ns)

    def _note_time(self, took_s: float) -> None:
        assert self._timing is not None
        assert self._budget_s is not None
        over = self._took.over_budget + (took_s > self._budget_s)
        self._took = ModuleTiming(self._took.steps + 1, took_s, max(self._took.longest_s, took_s), over)
        self._timing.write(self._took, self._now_ns)


def cut(text: str, n_bytes: int) -> str:
    """Cut a text so that it fits."""
    return text.replace("\0", "").encode(errors="replace")[:n_bytes].decode(errors="ignore")


def narrowed(cls: type[Record], ranges: Ranges) -> Any:
    """Give a record's schema with the ranges of a port: for readers, who find them in the store."""
    from rtdb import Schema

    wide = schema_of(cls)
    fields = [
        replace(f, spec=replace(f.spec, low=float(ranges[f.name][0]), high=float(ranges[f.name][1])))
        if f.name in ranges
        else f
        for f in wide.fields
    ]
    return Schema(wide.name, wide.doc, fields, cls)


def _where(error: BaseException, cls: type[Module]) -> str:
    """Name file and line where a student looks first: the innermost in the module's own file, else not in ours."""
    at, own = "", getattr(sys.modules.get(cls.__module__), "__file__", None)
    inside = False
    for frame, line in traceback.walk_tb(error.__traceback__):
        file = Path(frame.f_code.co_filename)
        mine = frame.f_code.co_filename == own
        if (mine or not inside) and (file.parent != OWN_FILES[0] or file.name not in OWN_FILES[1]):
            at, inside = f" ({file.name}:{line})", inside or mine
    return at
