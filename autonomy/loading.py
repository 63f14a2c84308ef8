"""Loading: a module's class from a name or a file, and an instance whose parameters and inputs fit the wiring."""

import importlib
import importlib.util
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .files import FILES, Files
from .module import Module, ModuleError
from .ranges import sound, what_is_wrong

if TYPE_CHECKING:
    from .wiring import Wire

POLICY = ".policy"


def load_module(spec: str) -> type[Module]:
    """Load `package.module:Class`, `file.py:Class`, a learned `file.policy`, or "files": a script is it."""
    if spec == FILES:
        return Files
    if spec.endswith(POLICY):
        from .policy import load_policy

        return load_policy(Path(spec))
    place, _, name = spec.rpartition(":")
    if not place:
        raise ModuleError(f"{spec!r}: name a module as FILE.py:Class or package.module:Class; files means a script")
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
    known = sys.modules.get(name)
    place = os.path.abspath(path)  # as the import system writes it
    if known is not None and (known.__file__, getattr(known, "fairway_mtime_ns", 0)) == (place, _mtime_ns(path)):
        return known  # the same file: one class, however often it is loaded
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ModuleError(f"{path} is not a Python file")
    loaded = importlib.util.module_from_spec(spec)
    loaded.fairway_mtime_ns = _mtime_ns(path)  # type: ignore[attr-defined]
    sys.modules[name] = loaded
    try:
        spec.loader.exec_module(loaded)
    except BaseException:
        del sys.modules[name]
        raise
    return loaded


def _mtime_ns(path: Path) -> int:
    return path.stat().st_mtime_ns


def make_module(wire: "Wire") -> Module:
    """Make a module with its parameters set and its wiring checked; ModuleError names what does not fit."""
    component, spec = wire.component, wire.module
    cls = load_module(spec)
    try:
        module = cls()
    except (Exception, SystemExit) as error:  # no step(), or an __init__ that raises
        raise ModuleError(f"{component}: {spec}: {type(error).__name__}: {error}") from error
    module.__dict__.update(checked_params(component, cls, wire.params))
    check_inputs(component, cls, wire.inputs)
    _check_safe_values(component, cls)
    return module


def _check_safe_values(component: str, cls: type[Module]) -> None:
    """Refuse safe values that the module itself would not be allowed to give."""
    for name, port in cls.outputs.items():
        if type(port.safe) is not port.cls:
            raise ModuleError(f"{component}: the safe value of {name} is a {port.cls.__name__}, got {port.safe!r:.60}")
        if not sound(port.cls, port.ranges)(port.safe):
            raise ModuleError(f"{component}: the safe value of {name} {what_is_wrong(port.safe, port.ranges)}")


def checked_params(component: str, cls: type[Module], params: dict[str, Any]) -> dict[str, Any]:
    """Give the parameters in the types that the module declares."""
    if cls is Files:
        return {}  # for its script to read
    out = {}
    for name, value in params.items():
        port = cls.params.get(name)
        if port is None:
            raise ModuleError(
                f"{component}: {cls.__name__} has no parameter {name}; it has {', '.join(cls.params) or 'none'}"
            )
        wanted = type(port.default)
        if type(value) is not wanted and not (wanted is float and type(value) is int):
            raise ModuleError(f"{component}: parameter {name} is a {wanted.__name__} [{port.unit}], got {value!r}")
        out[name] = wanted(value)
    return out


def check_inputs(component: str, cls: type[Module], inputs: dict[str, str]) -> None:
    """Refuse wiring of inputs that there are not, and required inputs that are not wired."""
    if cls is Files:
        return
    for name in inputs:
        if name not in cls.inputs:
            raise ModuleError(
                f"{component}: {cls.__name__} has no input {name}; it has {', '.join(cls.inputs) or 'none'}"
            )
    wired = inputs_of(cls, inputs)
    for name, port in cls.inputs.items():
        if name not in wired and not port.optional:
            raise ModuleError(
                f"{component}: input {name} of {cls.__name__} is not wired; wire it in the stack file, or say "
                f"pointer=... in the port"
            )


def inputs_of(cls: type[Module], wired: dict[str, str]) -> dict[str, str]:
    """Give the pointer of each input: what the wiring says, else the port's own, if it has one."""
    own = {name: port.pointer for name, port in cls.inputs.items() if port.pointer is not None}
    return {**own, **wired}
