"""Wiring: which module runs where in a cycle, what its inputs point at, and its parameters.

A stack is a JSON file, one entry per component:

    {"follow": {"module": "autonomy.follow:Follow", "every": 4, "phase": 2,
                "inputs": {"pose": "localise/pose"}, "params": {"lookahead_m": 3.0}}}

The entry "actuators" has no module: it names the command that the HAL obeys. Where the module is "files", a script is
the component. Each entry also stands in the store, as
the JSON object `<component>/config`; writing it there rewires a running system.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from rtdb.syncfs.policy import RESERVED

from .files import FILES
from .loading import inputs_of, load_module, make_module
from .module import ModuleError
from .pointer import split

ACTUATORS = "actuators"
MAX_LATENCY_CYCLES = 100
KEYS = ("module", "every", "phase", "inputs", "params", "latency_cycles", "budget_ms", "memory_mb")


@dataclass(frozen=True, slots=True)
class Wire:
    """Wiring of one component. Due at ticks c with c % every == phase; its outputs show at the tick after.

    latency_cycles: so many ticks later, as if the step took that long. budget_ms: what a step may take; in real time a
    later result is dropped [until it is due again], in simulation it is only counted. memory_mb: of a process of its
    own.
    """

    component: str
    module: str
    every: int
    phase: int
    inputs: dict[str, str]
    params: dict[str, Any] = field(default_factory=dict)
    latency_cycles: int = 0
    budget_ms: float | None = None
    memory_mb: float | None = None

    @property
    def is_files(self) -> bool:
        """Whether a script is it, through the file server."""
        return self.module == FILES

    def entry(self) -> dict[str, Any]:
        """Give the entry of a stack file that says the same."""
        said = {key: getattr(self, key) for key in KEYS}
        return {key: value for key, value in said.items() if key in KEYS[:5] or value not in (None, 0)}

    def objects(self) -> dict[str, str]:
        """Give the name of the object behind each wired input."""
        return {name: split(pointer)[0] for name, pointer in inputs_of(load_module(self.module), self.inputs).items()}


@dataclass(frozen=True, slots=True)
class Stack:
    """The wiring of a whole stack. `command` points at the drive command that the HAL obeys."""

    wires: tuple[Wire, ...]
    command: str

    def use(self, component: str, module: str) -> "Stack":
        """Swap the module of one component; it inherits the wiring."""
        if all(wire.component != component for wire in self.wires):
            raise ModuleError(
                f"--use {component}: the stack has no such component; it has "
                f"{', '.join(wire.component for wire in self.wires)}"
            )
        return replace(
            self,
            wires=tuple(replace(w, module=module, params={}) if w.component == component else w for w in self.wires),
        )


def load_stack(path: Path) -> Stack:
    """Read a stack file; ModuleError names what is wrong in it."""
    try:
        raw = json.loads(path.read_text())
    except FileNotFoundError as error:
        raise ModuleError(f"no stack file at {path}") from error
    except ValueError as error:
        raise ModuleError(f"{path}: not JSON: {error}") from error
    if not isinstance(raw, dict) or not isinstance(raw.get(ACTUATORS), dict):
        raise ModuleError(f'{path}: a stack is one object with an entry "{ACTUATORS}" that names the command to obey')
    pointers = raw[ACTUATORS].get("inputs")
    command = pointers.get("drive") if isinstance(pointers, dict) else None
    if not isinstance(command, str):
        raise ModuleError(f'{path}: {ACTUATORS}: expected {{"inputs": {{"drive": "component/object"}}}}')
    return Stack(tuple(wire_of(f"{path}: {name}", name, raw[name]) for name in raw if name != ACTUATORS), command)


def stack_with(path: Path, uses: Sequence[str]) -> Stack:
    """Read a stack file, swap modules (COMPONENT=FILE.py:Class), and refuse what cannot run: before anything starts."""
    stack = load_stack(path)
    for use in uses:
        component, separator, module = use.partition("=")
        if not separator:
            raise ModuleError(f"--use {use}: expected COMPONENT=FILE.py:Class")
        stack = stack.use(component, module)
    for wire in stack.wires:
        make_module(wire)
    check_stack(stack)
    return stack


def wire_of(where: str, component: str, entry: Any) -> Wire:
    """Read the wiring of one component; ModuleError says where and what is wrong."""
    if not isinstance(entry, dict):
        raise ModuleError(f"{where}: an entry is an object with module, every, phase and inputs, got {entry!r:.60}")
    unknown = set(entry) - set(KEYS)
    if unknown:
        raise ModuleError(f"{where}: unknown key {', '.join(sorted(unknown))}; an entry has {', '.join(KEYS)}")
    missing = [key for key in KEYS[:4] if key not in entry]
    if missing:
        raise ModuleError(f"{where}: the key {missing[0]!r} is missing")
    if component in RESERVED:
        raise ModuleError(f"{where}: no component is called {component}: {', '.join(RESERVED)} mean something else")
    wire = Wire(component, **entry)
    if not isinstance(wire.module, str):
        raise ModuleError(f"{where}: module is package.module:Class or FILE.py:Class, got {wire.module!r:.60}")
    if not (isinstance(wire.inputs, dict) and all(isinstance(pointer, str) for pointer in wire.inputs.values())):
        raise ModuleError(f'{where}: inputs are {{"input": "component/object"}}, got {wire.inputs!r:.60}')
    if not isinstance(wire.params, dict):
        raise ModuleError(f'{where}: params are {{"parameter": value}}, got {wire.params!r:.60}')
    if not (type(wire.every) is type(wire.phase) is int and 0 <= wire.phase < wire.every):
        raise ModuleError(
            f"{where}: every and phase are whole ticks with 0 <= phase < every, "
            f"got every={wire.every!r} phase={wire.phase!r}"
        )
    if type(wire.latency_cycles) is not int or not 0 <= wire.latency_cycles <= MAX_LATENCY_CYCLES:
        raise ModuleError(f"{where}: latency_cycles is 0 to {MAX_LATENCY_CYCLES} ticks, got {wire.latency_cycles!r}")
    for key, value in (("budget_ms", wire.budget_ms), ("memory_mb", wire.memory_mb)):
        if value is not None and not (type(value) in (int, float) and value > 0):
            raise ModuleError(f"{where}: {key} is a number above 0, got {value!r}")
    return wire


def check_stack(stack: Stack) -> None:
    """Refuse a stack in which modules wait for each other: each needs an output of the next before it can begin."""
    needs = {wire.component: [] if wire.is_files else needed(wire) for wire in stack.wires}  # a script just begins
    for start in needs:
        path = _loop(start, needs, [start])
        if path:
            waits = ", ".join(f"{a} needs {b}" for a, b in pairwise(path))
            raise ModuleError(f"{waits}: nobody can begin; make one of these inputs optional")


def _loop(start: str, needs: dict[str, list[str]], path: list[str]) -> list[str]:
    for component in needs[path[-1]]:
        if component == start:
            return [*path, start]
        if component in needs and component not in path:
            found = _loop(start, needs, [*path, component])
            if found:
                return found
    return []


def needed(wire: Wire) -> list[str]:
    """Name the components without whose outputs a module is not called; of a script, all that it is wired to."""
    if wire.is_files:
        return [pointer.partition("/")[0] for pointer in wire.inputs.values()]
    ports = load_module(wire.module).inputs
    wired = wire.objects().items()
    return [name.partition("/")[0] for port, name in wired if port in ports and not ports[port].optional]


def required(stack: Stack) -> set[str]:
    """Name the components without which the actuators get no command."""
    wires = {wire.component: wire for wire in stack.wires}
    found, ahead = set[str](), [split(stack.command)[0].partition("/")[0]]
    while ahead:
        component = ahead.pop()
        if component in wires and component not in found:
            found.add(component)
            ahead += needed(wires[component])
    return found
