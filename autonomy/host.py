"""Hosts: run modules on a store, and keep their faults to themselves.

Each due tick: inputs from the cut, the step, outputs checked and committed with inherited data time and lineage. A
module that raises, gives NaN, assigns something else than its outputs or forgets one is stopped for good (the fault
latches). Its outputs are held for HOLD_STEPS, then the host writes their safe values.
"""

import logging
import math
import traceback
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hal.signals import ModuleState, ModuleStatus
from rtdb import Component, Object, Record, RtdbError, Sample, Store, Writer, schema_of

from .module import InputPort, Module, ModuleError, OutputPort
from .wiring import Wire, make_module

if TYPE_CHECKING:
    import numpy as np

log = logging.getLogger(__name__)
HOLD_STEPS = 2
HISTORY_S = 2.0
OWN_FILES = ("host.py", "module.py")  # their lines tell a student nothing


def seeded(seed: int, name: str) -> "np.random.Generator":
    """Make the random generator of one named part of a run."""
    import numpy as np

    return np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(name.encode())]))


class Host:
    """Runs one module. Make all hosts of a run, then `connect` them, then `step` them at every tick."""

    def __init__(self, store: Store, wire: Wire, seed: int, *, participant: bool = False) -> None:
        self.wire = wire
        self.module: Module = make_module(wire)
        self.component: Component = store.join(wire.component, participant=participant)
        self._store = store
        edge: dict[str, Any] = {"every": wire.every, "phase": (wire.phase + 1) % wire.every, "history_s": HISTORY_S}
        cls = type(self.module)
        self._outputs: list[tuple[str, OutputPort[Any], Writer[Any], Callable[[Any], bool]]] = [
            (
                name,
                port,
                self.component.insert(name, port.cls, n_causes=min(8, len(cls.inputs)), **edge),
                finite(port.cls),
            )
            for name, port in cls.outputs.items()
        ]
        self._status = self.component.insert("status", ModuleStatus, **edge)
        self._inputs: list[tuple[str, InputPort[Any], Object[Any] | None, int]] = []
        self._state, self._reason = ModuleState.WAITING, ""
        self._steps = self._missed = 0
        self.module.rng = seeded(seed, wire.component)
        self.module.dt_s = wire.every * store.tick_ns * 1e-9
        self._last: dict[str, Sample[Any]] = {}
        self._started = False
        self._status.write(ModuleStatus())

    @property
    def fault(self) -> str:
        """Why the module was stopped, empty while it runs."""
        return self._reason if self._state is ModuleState.FAULT else ""

    def connect(self, timeout_s: float = 0.0) -> None:
        """Find the objects that the inputs point at."""
        for name, port in type(self.module).inputs.items():
            pointer, found = self.wire.inputs.get(name), None
            if pointer is not None:
                try:
                    found = self._store.find(pointer, port.cls, timeout_s=0.0 if port.optional else timeout_s)
                except RtdbError as error:
                    if not port.optional:
                        raise ModuleError(f"{self.wire.component}.{name} = {pointer}: {error}") from error
            max_age_ns = int(port.max_age_s * 1e9) if port.max_age_s is not None else 1 << 62
            self._inputs.append((name, port, found, max_age_ns))

    def step(self, cycle: int, _t_ns: int = 0) -> None:
        """Run the module if it is due in this cycle."""
        if cycle % self.wire.every != self.wire.phase:
            return
        now_ns = self._store.core.now_ns
        if self._state is ModuleState.FAULT:
            self._miss(now_ns)
            return
        absent = self._read(cycle, now_ns)
        if absent:
            self._say(ModuleState.STALE if self._steps else ModuleState.WAITING, absent)
            self._miss(now_ns)
            return
        try:
            payloads = self._call(now_ns)
        except (Exception, SystemExit) as error:  # a module may raise anything; it must not harm others
            log.warning("%s stopped at cycle %d: %s: %s", self.wire.component, cycle, type(error).__name__, error)
            log.debug("traceback", exc_info=True)
            self._say(ModuleState.FAULT, f"cycle {cycle}: {type(error).__name__}: {error}{_where(error)}")
            self._miss(now_ns)
            return
        self._steps += 1
        self._missed = 0
        self._commit(payloads, now_ns)
        self._say(ModuleState.RUNNING, "")

    def _read(self, cycle: int, now_ns: int) -> str:
        """Put the inputs of this cut into the module; returns what is absent, empty if nothing is."""
        module, values, last = self.module, self.module.__dict__, self._last
        module.samples.clear()
        for name, port, found, max_age_ns in self._inputs:
            sample = found.visible_since(cycle, last.get(name)) if found is not None else None
            if sample is not None and now_ns - sample.t_data_ns <= max_age_ns:
                module.samples[name] = last[name] = sample
                values[name] = sample.value
            elif port.optional:
                values[name] = None
            elif sample is None:
                return f"input {name} ({self.wire.inputs[name]}) is not there yet"
            else:
                return (
                    f"input {name} ({self.wire.inputs[name]}) is {(now_ns - sample.t_data_ns) * 1e-9:.2f} s old, "
                    f"at most {port.max_age_s} s"
                )
        return ""

    def _call(self, now_ns: int) -> list[bytes]:
        """Call the step; returns the payload of each output, or raises what is wrong."""
        module = self.module
        module.t_ns = now_ns
        if not self._started:
            module.reset()
            self._started = True
        names = len(module.__dict__)
        module._out.clear()
        module.step()
        if len(module.__dict__) != names:
            for name, value in module.__dict__.items():
                if isinstance(value, Record) and name not in module.inputs and not name.startswith("_"):
                    raise ModuleError(
                        f"self.{name} is not an output; {type(module).__name__} declares "
                        f"{', '.join(module.outputs)} (start names of your own records with _)"
                    )
        payloads = []
        for name, port, writer, is_finite in self._outputs:
            value = module._out.get(port)
            if value is None:
                raise ModuleError(f"output {name} was not assigned in this step")
            if type(value) is not port.cls:
                raise ModuleError(f"output {name} is a {port.cls.__name__}, got {value!r:.60}")
            if not is_finite(value):
                raise ModuleError(f"output {name} is not finite: {value!r:.100}")
            payloads.append(writer.schema.pack(value))
        return payloads

    def _commit(self, payloads: list[bytes], now_ns: int) -> None:
        t_data_ns, causes = now_ns, []
        for name, port, found, _ in self._inputs:
            sample: Sample[Any] | None = self.module.samples.get(name)
            if sample is None or port.static or found is None:
                continue
            causes.append((found.oid, sample.write))
            t_data_ns = min(t_data_ns, sample.t_data_ns)
        lineage = tuple(causes[:8])
        core = self._store.core
        for (_, _, writer, _), payload in zip(self._outputs, payloads, strict=True):
            core.write(writer.handle, payload, core.not_before(writer.handle, t_data_ns), lineage)

    def _miss(self, now_ns: int) -> None:
        """Hold the outputs for a while, then write the safe ones."""
        if not self._started:
            return  # nothing was ever said: there is nothing to take back
        self._missed += 1
        if self._missed > HOLD_STEPS:
            for _, port, writer, _ in self._outputs:
                writer.write(port.safe, now_ns)

    def _say(self, state: ModuleState, reason: str) -> None:
        if (state, reason) != (self._state, self._reason) and not (state is self._state is ModuleState.STALE):
            self._state, self._reason = state, reason
            cut = reason.encode()[:160].decode(errors="ignore").replace("\0", "")
            self._status.write(ModuleStatus(state=state, steps=self._steps, reason=cut))


def _where(error: BaseException) -> str:
    """Name file and line of the innermost frame that is not ours: where a student looks first."""
    at = ""
    for frame in traceback.extract_tb(error.__traceback__):
        if Path(frame.filename).parent != Path(__file__).parent or Path(frame.filename).name not in OWN_FILES:
            at = f" ({Path(frame.filename).name}:{frame.lineno})"
    return at


def finite(cls: type[Record]) -> Callable[[Any], bool]:
    """Make a test of whether all floats of a record are finite: their sum is, exactly if each of them is."""
    terms = [
        f"sum(r.{f.name})" if f.spec.shape != "one" else f"r.{f.name}"
        for f in schema_of(cls).fields
        if f.spec.kind in ("f8", "f4")
    ]
    return eval(f"lambda r: isfinite({' + '.join(terms) or '0.0'})", {"isfinite": math.isfinite, "sum": sum})  # type: ignore[no-any-return]
