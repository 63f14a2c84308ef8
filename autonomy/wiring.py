"""Wiring: which module runs where in a cycle, what its inputs point at, and its parameters.

A stack is a JSON file, one entry per component:

    {"follow": {"module": "autonomy.follow:Follow", "every": 4, "phase": 2,
                "inputs": {"pose": "localise/pose"}, "params": {"lookahead_m": 3.0}}}

The entry "actuators" has no module: it names the command that the HAL obeys.
"""

import importlib
import importlib.util
import json
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from .module import Module, ModuleError

ACTUATORS = "actuators"


@dataclass(frozen=True, slots=True)
class Wire:
    """Wiring of one component. Due at ticks c with c % every == phase; its outputs show at the tick after."""

    component: str
    module: str
    every: int
    phase: int
    inputs: dict[str, str]
    params: dict[str, Any] = field(default_factory=dict)


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
    return Stack(tuple(_wire(path, name, entry) for name, entry in raw.items() if name != ACTUATORS), command)


def _wire(path: Path, name: str, entry: Any) -> Wire:
    if not isinstance(entry, dict):
        raise ModuleError(
            f"{path}: {name}: an entry is an object with module, every, phase and inputs, got {entry!r:.60}"
        )
    unknown = set(entry) - {"module", "every", "phase", "inputs", "params"}
    if unknown:
        raise ModuleError(
            f"{path}: {name}: unknown key {', '.join(sorted(unknown))}; "
            "an entry has module, every, phase, inputs and params"
        )
    try:
        wire = Wire(name, entry["module"], entry["every"], entry["phase"], entry["inputs"], entry.get("params", {}))
    except KeyError as error:
        raise ModuleError(f"{path}: {name}: the key {error} is missing") from error
    if not isinstance(wire.module, str):
        raise ModuleError(f"{path}: {name}: module is package.module:Class or FILE.py:Class, got {wire.module!r:.60}")
    if not (isinstance(wire.inputs, dict) and all(isinstance(pointer, str) for pointer in wire.inputs.values())):
        raise ModuleError(f'{path}: {name}: inputs are {{"input": "component/object"}}, got {wire.inputs!r:.60}')
    if not isinstance(wire.params, dict):
        raise ModuleError(f'{path}: {name}: params are {{"parameter": value}}, got {wire.params!r:.60}')
    if not (type(wire.every) is type(wire.phase) is int and 0 <= wire.phase < wire.every):
        raise ModuleError(
            f"{path}: {name}: every and phase are whole ticks with 0 <= phase < every, "
            f"got every={wire.every!r} phase={wire.phase!r}"
        )
    return wire


def load_module(spec: str) -> type[Module]:
    """Load `package.module:Class` or `file.py:Class`."""
    place, _, name = spec.rpartition(":")
    if not place:
        raise ModuleError(f"{spec!r}: name a module as FILE.py:Class or package.module:Class")
    try:
        loaded = _from_file(Path(place)) if place.endswith(".py") else importlib.import_module(place)
    except ModuleError:
        raise
    except (Exception, SystemExit) as error:  # a student's file may raise anything while it is imported
        raise ModuleError(f"{spec}: {type(error).__name__} while loading it: {error}") from error
    cls = getattr(loaded, name, None)
    if not (isinstance(cls, type) and issubclass(cls, Module)) or cls is Module:
        found = [
            n for n, v in vars(loaded).items() if isinstance(v, type) and issubclass(v, Module) and v is not Module
        ]
        raise ModuleError(f"{spec}: {place} has no Module named {name}; it has {', '.join(found) or 'none'}")
    return cls


def _from_file(path: Path) -> Any:
    if not path.is_file():
        raise ModuleError(f"no file {path}; --use takes COMPONENT=FILE.py:Class")
    name = f"fairway_student_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ModuleError(f"{path} is not a Python file")
    loaded = importlib.util.module_from_spec(spec)
    sys.modules[name] = loaded
    spec.loader.exec_module(loaded)
    return loaded


def make_module(wire: Wire) -> Module:
    """Make a module with its parameters set and its wiring checked; ModuleError names what does not fit."""
    cls = load_module(wire.module)
    try:
        module = cls()
    except (Exception, SystemExit) as error:  # no step(), or an __init__ that raises
        raise ModuleError(f"{wire.component}: {wire.module}: {type(error).__name__}: {error}") from error
    for name, value in wire.params.items():
        port = cls.params.get(name)
        if port is None:
            raise ModuleError(
                f"{wire.component}: {cls.__name__} has no parameter {name}; it has {', '.join(cls.params) or 'none'}"
            )
        wanted = type(port.default)
        if type(value) is not wanted and not (wanted is float and type(value) is int):
            raise ModuleError(f"{wire.component}: parameter {name} is a {wanted.__name__} [{port.unit}], got {value!r}")
        module.__dict__[name] = wanted(value)
    for name in wire.inputs:
        if name not in cls.inputs:
            raise ModuleError(
                f"{wire.component}: {cls.__name__} has no input {name}; it has {', '.join(cls.inputs) or 'none'}"
            )
    for name, input_port in cls.inputs.items():
        if name not in wire.inputs and not input_port.optional:
            raise ModuleError(f"{wire.component}: input {name} of {cls.__name__} is not wired")
    return module
