"""Outputs: whether a step assigned each output that its module declares, sound and of the right record, and no other.

Hosts check every step that they run, `trial` and `fairway repro` the one that they call.
"""

from collections.abc import Callable
from typing import Any

from rtdb import Record, schema_of

from .module import Module, ModuleError, OutputPort
from .ranges import sound, what_is_wrong

Check = tuple[str, OutputPort[Any], Callable[[Any], bool], Callable[[Any], bytes]]  # name, port, is it sound, pack


def checks_of(cls: type[Module]) -> list[Check]:
    """Make the checks of a module's outputs, in their order. They are compiled: make them once."""
    checks: list[Check] = []
    for name, port in cls.outputs.items():
        record: type[Record] = port.cls
        checks.append((name, port, sound(record, port.ranges), schema_of(record).pack))
    return checks


def payloads_of(module: Module, checks: list[Check]) -> list[bytes]:
    """Give the payload of each output of the step that is over, or raise what is wrong with them."""
    out, payloads = module._out, []
    for name, port, is_sound, pack in checks:
        value = out.get(port)
        if value is None:
            raise ModuleError(f"output {name} was not assigned in this step")
        if type(value) is not port.cls:
            raise ModuleError(f"output {name} is a {port.cls.__name__}, got {value!r:.60}")
        try:
            fits = is_sound(value)
        except TypeError:  # a field holds something else than its number
            fits = False
        if not fits:
            raise ModuleError(f"output {name} {what_is_wrong(value, port.ranges)}")
        payloads.append(pack(value))
    return payloads


def outputs_of(module: Module) -> dict[str, Any]:
    """Give the outputs of the step that is over by name, or raise what is wrong with them."""
    check_names(module)
    checks = checks_of(type(module))
    payloads_of(module, checks)
    return {name: module._out[port] for name, port, _, _ in checks}


def check_names(module: Module) -> None:
    """Refuse a record under a name that is no port: an output with a spelling mistake."""
    for name, value in module.__dict__.items():
        if isinstance(value, Record) and name not in module.inputs and not name.startswith("_"):
            raise ModuleError(
                f"self.{name} is not an output; {type(module).__name__} declares "
                f"{', '.join(module.outputs)} (start names of your own records with _)"
            )
