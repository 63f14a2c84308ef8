"""Pointers: what an input is wired to. `localise/pose` is an object; `localise/pose#/x_m` is a number in it (RFC 6901).

What does not fit is said when the pointer is resolved, in one line: no such object, another record, another unit, a
range that the module cannot work with. Objects without a record (JSON) name units in their keys; what they hold is
checked at each read, and a value that does not fit counts as absent. A component that writes nothing but a JSON
`status` (a script, through the file server) says everything there: `follow/drive` is `drive` in its `follow/status`.
"""

import time
from collections.abc import Callable
from typing import Any

import msgspec

from rtdb import Object, ObjectMissing, Record, RecordError, Sample, Schema, Store, schema_of
from rtdb.json_object import is_json, number_at
from rtdb.layout import Field, Spec

from .module import NO_NUMBERS, InputPort, ModuleError, Ranges
from .ranges import range_of, sound, what_is_wrong


class Unusable(Exception):
    """What a pointer shows now cannot be used; the message says why."""


class Link:
    """An input joined to its object."""

    __slots__ = ("json", "obj", "value")

    def __init__(self, obj: Object[Any], value: Callable[[Sample[Any]], Any] | None, json: bool) -> None:
        self.obj, self.json = obj, json
        self.value = value
        """Makes the input's value of a sample, or raises Unusable; None where the sample's own value is it."""


def split(pointer: str) -> tuple[str, str | None]:
    """Give the object's name and the JSON Pointer into it, None where there is none."""
    name, sharp, path = pointer.partition("#")
    return name, path if sharp else None


def link(store: Store, pointer: str, port: InputPort[Any], timeout_s: float = 0.0) -> Link:
    """Resolve a pointer for a port. ModuleError says what does not fit; RtdbError that there is no such object."""
    name, path = split(pointer)
    if port.cls is float and path is None:
        raise ModuleError(f"a number [{port.unit}] is wired to a field: {name}#/FIELD")
    if port.cls is not float and path is not None:
        raise ModuleError(f"a {port.cls.__name__} is wired to a whole object: {name}")
    obj, key = resolve(store, name, timeout_s)
    if path is not None:
        return _number(obj, f"/{key}{path}" if key else path, port)
    if is_json(obj.stored.fields):
        return Link(obj, _record_of_json(port.cls, port.ranges, key), json=True)
    obj = store.find(name, port.cls)
    _check_ranges(port.cls.__name__, obj.stored, port.ranges)
    if not port.ranges:
        return Link(obj, None, json=False)
    is_sound, ranges = sound(port.cls, port.ranges), port.ranges

    def narrowed(sample: Sample[Any]) -> Any:
        if is_sound(sample.value):
            return sample.value
        raise Unusable(what_is_wrong(sample.value, ranges))

    return Link(obj, narrowed, json=False)


def resolve(store: Store, name: str, timeout_s: float = 0.0) -> tuple[Object[Any], str]:
    """Find an object by its name: itself, or the JSON status that has it under a key, which is given, too."""
    component, _, key = name.partition("/")
    deadline = time.monotonic() + timeout_s
    while True:
        version = store.core.version
        try:
            return store.find(name), ""
        except ObjectMissing:
            status = next(iter(store.objects(f"{component}/status")), None)
            if status is not None and is_json(status.stored.fields):
                return status, key
            left_ns = int((deadline - time.monotonic()) * 1e9)
            if left_ns <= 0 or store.core.wait_directory(version, left_ns) is None:
                raise


def _check_ranges(what: str, stored: Schema, wanted: Ranges) -> None:
    """Refuse an object whose writer declares more than the port can work with."""
    for field in stored.fields:
        low, high = range_of(field, wanted)
        if field.name in wanted and not low <= field.spec.low <= field.spec.high <= high:
            raise ModuleError(
                f"its {what} may have {field.name} from {field.spec.low:g} to {field.spec.high:g} {field.spec.unit}, "
                f"this input takes {low:g} to {high:g}; narrow the output, or widen the input"
            )


def _number(obj: Object[Any], path: str, port: InputPort[Any]) -> Link:
    low, high = port.ranges[""]
    if is_json(obj.stored.fields):
        unit, json = None, True
    else:
        spec, json = field_at(obj.stored, path), False
        unit = spec.unit or "1"
        if unit != port.unit:
            raise ModuleError(f"{path} is in {unit}, this input is in {port.unit}")
        if not low <= spec.low <= spec.high <= high:
            raise ModuleError(
                f"{path} may be {spec.low:g} to {spec.high:g} {unit}, this input takes {low:g} to {high:g}; "
                "narrow the output, or widen the input"
            )

    def value(sample: Sample[Any]) -> float:
        try:
            return number_at(sample.value, path, port.unit, low=low, high=high, unit_in_wiring=unit)
        except RecordError as error:
            raise Unusable(str(error)) from error

    return Link(obj, value, json)


def field_at(schema: Schema, path: str) -> Spec:
    """Give the declaration of the number at a JSON Pointer into a record; ModuleError where there is none."""
    fields: dict[str, Field] = {f.name: f for f in schema.fields}
    found: Field | None = None
    many = False  # the next token counts the elements of a list
    for token in path.split("/")[1:]:
        if many:
            assert found is not None
            if not token.isdigit() or (found.spec.shape == "array" and int(token) >= found.spec.n):
                raise ModuleError(f"{schema.name} has no {path}: {found.name} is a list of {found.spec.n}, from 0 on")
            many = False
            continue
        found = fields.get(token)
        if found is None:
            there = ", ".join("/" + name for name in fields) or "nothing below that"
            raise ModuleError(f"{schema.name} has no {path}; there is {there}")
        fields = {f.name: f for f in found.record.fields} if found.spec.kind == "record" else {}
        many = found.spec.shape != "one"
    if found is None or found.spec.kind in NO_NUMBERS:
        raise ModuleError(f"{path or 'the whole object'} is no number; point at one: #/FIELD")
    if many:
        raise ModuleError(f"{path} is a list of {found.spec.n}; point at one number: {path}/0")
    return found.spec


def _record_of_json(cls: type[Record], ranges: Ranges, key: str) -> Callable[[Sample[Any]], Record]:
    """Make the function that reads a record of plain numbers out of a JSON object, by the names of its fields.

    key: under which it stands in the object, empty where it is the object.
    """
    fields = schema_of(cls).fields
    required = {info.name for info in msgspec.structs.fields(cls) if info.required}
    strange = [f.name for f in fields if f.spec.kind in NO_NUMBERS or f.spec.shape != "one"]
    if strange:
        raise ModuleError(f"a {cls.__name__} cannot be read from JSON: {', '.join(strange)} is no plain number")

    def value(sample: Sample[Any]) -> Record:
        numbers: dict[str, Any] = {}
        said = sample.value.get(key) if key else sample.value
        if not isinstance(said, dict):
            raise Unusable(f"there is no object {key!r} in {sample.source.name if sample.source else 'it'}")
        try:
            for f in fields:
                if f.name in said or f.name in required:
                    low, high = range_of(f, ranges)
                    number = number_at(
                        said, f"/{f.name}", f.spec.unit or "1", low=low, high=high,
                        unit_in_wiring=f.spec.unit or "1",
                    )  # fmt: skip
                    if f.spec.kind not in ("f8", "f4") and not number.is_integer():
                        raise Unusable(f"/{f.name}: a whole number is expected, got {number!r}")
                    numbers[f.name] = number if f.spec.kind in ("f8", "f4") else int(number)
        except RecordError as error:
            raise Unusable(str(error)) from error
        return cls(**numbers)

    return value
