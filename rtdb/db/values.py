"""Values as text, by the schema that the store holds: no class is needed.

localise/pose#/x_m        a pointer: object, then a JSON pointer (RFC 6901) into it
at.x_m                    a path: for typing, and for columns
"""

import difflib
import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from ..errors import RecordError
from ..json_object import JsonSchema, unit_of_key
from ..layout import Field
from ..records import Schema


@dataclass(frozen=True, slots=True)
class Part:
    """A value inside a record: with its field where the schema says one, with its unit where one is known."""

    value: Any
    unit: str = ""
    field: Field | None = None  # of a single element of a tuple, that of the tuple
    schema: Schema | None = None  # of a value that is a record


def tokens_of_pointer(pointer: str) -> list[str]:
    """Split a JSON pointer."""
    if pointer and not pointer.startswith("/"):
        raise RecordError(f"pointer {pointer!r} begins with no /; try {'/' + pointer!r}")
    return [token.replace("~1", "/").replace("~0", "~") for token in pointer.split("/")[1:]]


def tokens_of(path: str) -> list[str]:
    """Split a path: at.x_m; or a pointer, for keys with dots in them: /at/x_m."""
    return tokens_of_pointer(path) if path.startswith("/") else path.split(".")


def part_of(schema: Schema, value: Any, tokens: Sequence[str]) -> Part:
    """Follow the tokens of a pointer or a path into a value; RecordError where there is nothing of that name."""
    part, at = Part(value, schema=schema), schema.name
    for token in tokens:
        part = _element(part, token, at) if isinstance(part.value, tuple | list) else _field(part, token, at)
        at = f"{at}.{token}"
    return part


def _element(part: Part, token: str, at: str) -> Part:
    if not token.isdecimal() or int(token) >= len(part.value):
        raise RecordError(f"{at} has no element {token!r}; it has {len(part.value)}, from 0 on")
    inner = part.field.inner if part.field is not None else None
    return Part(part.value[int(token)], part.unit, part.field, inner)


def _field(part: Part, token: str, at: str) -> Part:
    if not isinstance(part.value, dict):
        raise RecordError(f"{at} has no fields, so none called {token!r}; it is {text_of(part.value):.60}")
    if token not in part.value:
        raise RecordError(f"{at} has no field {token!r}; {did_you_mean(token, part.value, 'it has')}")
    field = field_of(part.schema, token)
    unit = field.spec.unit if field is not None else unit_of_key(token) or ""
    inner = field.inner if field is not None and field.spec.shape == "one" else None
    return Part(part.value[token], unit, field, inner)


def field_of(schema: Schema | None, name: str) -> Field | None:
    """Give the field of that name; None where there is none, as in JSON."""
    if schema is None or isinstance(schema, JsonSchema):
        return None
    return next((field for field in schema.fields if field.name == name), None)


def did_you_mean(name: str, known: Iterable[str], otherwise: str) -> str:
    """Say which of the known names is near, or list them."""
    names = list(known)
    near = difflib.get_close_matches(name, names, n=1)
    if near:
        return f"did you mean {near[0]}?"
    return f"{otherwise} {', '.join(sorted(names))}" if names else f"{otherwise} none"


# -- for people -------------------------------------------------------------------------------------------------------


def is_image(value: Any) -> bool:
    """Tell whether a value is an image: the only arrays in records."""
    return hasattr(value, "shape") and hasattr(value, "dtype")


def text_of(value: Any) -> str:
    """Spell out a value in one line: JSON, but for images, of which the extent is said."""
    if is_image(value):
        return f"{'x'.join(map(str, value.shape))} {value.dtype}"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k, ensure_ascii=False)}: {text_of(v)}" for k, v in value.items()) + "}"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(text_of, value)) + "]"
    return json.dumps(value, ensure_ascii=False)


def lines_of(part: Part, name: str = "", indent: str = "  ") -> Iterator[str]:
    """Spell out a part in lines: fields with their units, records in records below their names."""
    value, inner = part.value, part.field.inner if part.field is not None else None
    if isinstance(value, dict) and part.schema is not None:
        if name:
            yield f"{indent}{name}:"
            indent += "  "
        for key in value:
            yield from lines_of(part_of_field(part, key), key, indent)
    elif inner is not None and isinstance(value, tuple):
        yield f"{indent}{name}: {len(value)} {inner.name}"
        for k, item in enumerate(value):
            yield from lines_of(Part(item, schema=inner), str(k), f"{indent}  ")
    else:
        yield f"{indent}{name} = {text_of(value)}" + (f" {part.unit}" if part.unit else "")


def part_of_field(part: Part, name: str) -> Part:
    """Give one field of a part that is a record or a JSON object."""
    return _field(part, name, name)


def one_line(schema: Schema, value: dict[str, Any]) -> str:
    """Spell out a value in one line, with units."""
    shown = []
    for tokens, item in leaves(value):
        unit = part_of(schema, value, tokens).unit
        shown.append(f"{'.'.join(tokens)}={text_of(item)}" + (f" {unit}" if unit else ""))
    return ", ".join(shown) or "{}"


# -- for programs -----------------------------------------------------------------------------------------------------


def leaves(value: dict[str, Any], at: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield what stands at the ends of the paths through records in records; tuples stay whole."""
    for key, item in value.items():
        if isinstance(item, dict) and item:
            yield from leaves(item, (*at, key))
        else:
            yield (*at, key), item


def cell(value: Any) -> str:
    """Spell out a value for a column of CSV: text as it is, everything else as JSON."""
    return value if isinstance(value, str) else text_of(value)


def to_json(value: Any) -> Any:
    """Make a value JSON: images become their extent, and what is not finite, which JSON cannot say, null."""
    if is_image(value):
        return text_of(value)
    if isinstance(value, dict):
        return {key: to_json(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_json(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
