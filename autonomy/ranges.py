"""Ranges: whether a record holds only finite numbers, each within its field's range or the narrower one of a port.

The tests are compiled from the record's declaration: they are called for every output of every step.
"""

import math
from collections.abc import Callable
from typing import Any

from rtdb import Record, Schema, schema_of
from rtdb.layout import Field

from .module import NO_NUMBERS, Ranges


def sound(cls: type[Record], ranges: Ranges) -> Callable[[Any], bool]:
    """Make the test of a record: every number finite and in its range. Ranges are by the names of its fields."""
    free: list[str] = []
    terms = _terms(schema_of(cls), "r", ranges, free)
    if free:  # a sum is finite if each term is
        terms.append(f"isfinite({' + '.join(free)})")
    made: Callable[[Any], bool] = eval(f"lambda r: {' and '.join(terms) or 'True'}", {"isfinite": math.isfinite})
    return made


def _terms(schema: Schema, at: str, ranges: Ranges, free: list[str]) -> list[str]:
    """Give the conditions on a record that `at` names; numbers without a range are appended to `free`."""
    terms = []
    for f in schema.fields:
        name, many = f"{at}.{f.name}", f.spec.shape != "one"
        if f.spec.kind == "record":
            inner_free: list[str] = []
            inner = _terms(f.record, "i" if many else name, {}, inner_free if many else free)
            inner += [f"isfinite({' + '.join(inner_free)})"] if inner_free else []
            if inner and many:
                terms.append(f"all({' and '.join(inner)} for i in {name})")
            elif not many:
                terms += inner
            continue
        low, high = range_of(f, ranges)
        if f.spec.kind in NO_NUMBERS:
            continue
        if math.isfinite(low) and math.isfinite(high) and not many:
            terms.append(f"{low!r} <= {name} <= {high!r}")
            continue
        if math.isfinite(low) and not many:
            terms.append(f"{low!r} <= {name}")
        if math.isfinite(high) and not many:
            terms.append(f"{name} <= {high!r}")
        if f.spec.kind in ("f8", "f4"):
            free.append(f"sum({name})" if many else name)
    return terms


def range_of(field: Field, ranges: Ranges) -> tuple[float, float]:
    """Give the range of a field: its own, or the narrower one of a port."""
    return ranges.get(field.name, (field.spec.low, field.spec.high))


def what_is_wrong(value: Record, ranges: Ranges) -> str:
    """Say which field of an unsound record is to blame."""
    for f in schema_of(type(value)).fields:
        low, high = range_of(f, ranges)
        number = getattr(value, f.name)
        if f.spec.kind not in NO_NUMBERS and f.spec.shape == "one" and not isinstance(number, int | float):
            return f"{f.name} is a number [{f.spec.unit or '1'}], got {number!r:.60}"
        if f.spec.kind not in NO_NUMBERS and f.spec.shape != "one" and not math.isfinite(sum(number)):
            return f"is not finite: {f.name} = {number!r:.100}"
        if f.spec.kind in NO_NUMBERS or f.spec.shape != "one" or not math.isfinite(number):
            continue
        if not low <= number <= high:
            return f"{f.name}={number:g} is outside {low:g} to {high:g} {f.spec.unit}".rstrip()
    return f"is not finite: {value!r:.100}"
