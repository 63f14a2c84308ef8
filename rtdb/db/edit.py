"""A new value made of the newest one: what `fairway db set` writes.

    edited(schema, value, ["speed_mps=1.5", "state=RUNNING", "at.x_m=2 m", "marks.0=1"])

Everything is checked against the schema that the store holds: fields, types, names of enums, bounds, and units where
one is said. A JSON object has no schema: what is replaced must be there, and keep its type.
"""

import json
import struct
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

from ..errors import RecordError
from ..json_object import JsonSchema, loads
from ..layout import KINDS, Field
from ..records import Schema
from .values import did_you_mean, part_of, text_of, tokens_of


def edited(schema: Schema, value: dict[str, Any] | None, assignments: Sequence[str]) -> dict[str, Any]:
    """Give the value with the fields of the assignments replaced; None: there is none yet, and all must be given.

    Each is `field=value`, or a JSON object with fields and values: for an object without a record, its whole new value.
    """
    made = _copy(value)
    for text in assignments:
        path, equals, said = text.partition("=")
        if text.lstrip().startswith("{"):
            made = loads(text) if isinstance(schema, JsonSchema) else _with_fields(schema, made or {}, loads(text))
        elif not equals:
            raise RecordError(f"{text!r} is no assignment; say field=value, or give a JSON object")
        elif isinstance(schema, JsonSchema) and made is None:
            raise RecordError(f"nothing is written yet, so there is no {path}; give a whole JSON object")
        else:
            made = made or {}
            _replace(schema, made, tokens_of(path.strip()), said)
    missing = [f.name for f in schema.fields if f.name not in made] if not isinstance(schema, JsonSchema) else []
    if missing:
        raise RecordError(f"{schema.name}: nothing is written yet, so give all fields; missing: {', '.join(missing)}")
    return made  # type: ignore[no-any-return]


def _with_fields(schema: Schema, value: dict[str, Any], document: dict[str, Any]) -> dict[str, Any]:
    return value | {
        name: _from_json(_field(schema, name, schema.name), item, f"{schema.name}.{name}")
        for name, item in document.items()
    }


def packable(schema: Schema, value: dict[str, Any]) -> Any:
    """Make what the schema packs, which knows no class, of a dictionary."""
    if isinstance(schema, JsonSchema):
        return value
    return SimpleNamespace(**{f.name: _packable_field(f, value[f.name]) for f in schema.fields})


def _packable_field(field: Field, value: Any) -> Any:
    if field.spec.kind == "record":
        if field.spec.shape == "one":
            return packable(field.record, value)
        return tuple(packable(field.record, item) for item in value)
    return dict(field.values).get(value, value) if field.spec.kind == "enum" else value


def _copy(value: Any) -> Any:
    """Copy what is replaced in: dictionaries and lists; tuples become lists."""
    if isinstance(value, dict):
        return {key: _copy(item) for key, item in value.items()}
    return [_copy(item) for item in value] if isinstance(value, list | tuple) else value


# -- records ----------------------------------------------------------------------------------------------------------


def _field(schema: Schema, name: str, at: str) -> Field:
    found = next((field for field in schema.fields if field.name == name), None)
    if found is None:
        raise RecordError(
            f"{at} has no field {name!r}; {did_you_mean(name, (f.name for f in schema.fields), 'it has')}"
        )
    return found


def _replace(schema: Schema, value: dict[str, Any], tokens: list[str], said: str) -> None:
    """Replace what stands at the path, in place."""
    if isinstance(schema, JsonSchema):
        _replace_json(schema, value, tokens, said)
        return
    name, rest, at = tokens[0], tokens[1:], f"{schema.name}.{'.'.join(tokens)}"
    field = _field(schema, name, schema.name)
    if not rest:
        value[name] = _from_text(field, said, at)
        return
    if name not in value:
        raise RecordError(f"{at}: nothing is written yet; give {name} as a whole")
    inner: Any = value[name]
    if field.spec.shape != "one":
        k = rest.pop(0)
        if not k.isdecimal() or int(k) >= len(inner):
            raise RecordError(f"{schema.name}.{name} has no element {k!r}; it has {len(inner)}, from 0 on")
        if not rest and field.spec.kind != "record":
            inner[int(k)] = _scalar(field, said, at)
            return
        inner = inner[int(k)]
    if field.inner is None or not rest:
        raise RecordError(
            f"{at}: a {field.inner.name if field.inner else field.spec.kind} is not set like this; " + _how(field)
        )
    _replace(field.inner, inner, rest, said)


def _how(field: Field) -> str:
    if field.inner is not None:
        return f"set its fields one by one, e.g. {field.name}.{field.inner.fields[0].name}=..."
    return f"it has no fields of its own; say {field.name}=..."


def _from_text(field: Field, said: str, at: str) -> Any:
    if field.spec.kind == "image":
        raise RecordError(f"{at} is an image; images are not set by hand")
    if field.spec.shape == "one" and field.spec.kind != "record":
        return _scalar(field, said, at)
    try:
        document = json.loads(said)
    except json.JSONDecodeError as error:
        wanted = field.spec.kind if field.inner is None else field.inner.name
        many = f"a list of {wanted}" if field.spec.shape != "one" else f"a {wanted}"
        raise RecordError(f"{at}: {many} is expected, as JSON, got {said!r:.60}; {_how(field)}") from error
    return _from_json(field, document, at)


def _from_json(field: Field, item: Any, at: str) -> Any:
    """Make the value of a field from parsed JSON."""
    if field.spec.shape != "one":
        exact = field.spec.shape == "array"
        if not isinstance(item, list) or len(item) > field.spec.n or (exact and len(item) != field.spec.n):
            count = f"exactly {field.spec.n}" if exact else f"at most {field.spec.n}"
            raise RecordError(f"{at}: a list of {count} is expected, got {text_of(item):.60}")
        return [_one_from_json(field, each, f"{at}.{k}") for k, each in enumerate(item)]
    return _one_from_json(field, item, at)


def _one_from_json(field: Field, item: Any, at: str) -> Any:
    if field.inner is not None:
        if not isinstance(item, dict):
            raise RecordError(f"{at}: a {field.inner.name} is expected, as a JSON object, got {text_of(item):.60}")
        for name in item:
            _field(field.inner, name, at)
        missing = [f.name for f in field.inner.fields if f.name not in item]
        if missing:
            raise RecordError(f"{at}: a whole {field.inner.name} is expected; missing: {', '.join(missing)}")
        return {f.name: _from_json(f, item[f.name], f"{at}.{f.name}") for f in field.inner.fields}
    if field.spec.kind == "image":
        raise RecordError(f"{at} is an image; images are not set by hand")
    if isinstance(item, bool) != (field.spec.kind == "bool") or (
        isinstance(item, str) and field.spec.kind not in ("str", "enum")
    ):
        raise RecordError(f"{at}: {_expected(field)} is expected, got {text_of(item):.60}")
    return _scalar(field, item if isinstance(item, str) else text_of(item), at)


# -- single values ----------------------------------------------------------------------------------------------------


def _expected(field: Field) -> str:
    unit = f" [{field.spec.unit}]" if field.spec.unit else ""
    kind = field.spec.kind
    if kind == "bool":
        return "true or false"
    if kind == "enum":
        return f"one of {', '.join(name for name, _ in field.values)}"
    if kind == "str":
        return f"a text of at most {field.spec.n} bytes"
    return f"a {'number' if kind in ('f8', 'f4') else 'whole number'}{unit}"


def _scalar(field: Field, said: str, at: str) -> Any:
    """Make one value of its text."""
    kind, wrong = field.spec.kind, f"{at}: {_expected(field)} is expected, got {said!r:.60}"
    if kind == "str":
        if len(said.encode()) > field.spec.n or "\0" in said:
            raise RecordError(wrong)
        return said
    said = said.strip()
    if kind == "bool":
        if said not in ("true", "false"):
            raise RecordError(wrong)
        return said == "true"
    if kind == "enum":
        return _enum(field, said, at)
    number = _without_unit(said, field.spec.unit, at)
    try:
        value = float(number) if kind in ("f8", "f4") else int(number, 0)
    except ValueError as error:
        raise RecordError(wrong) from error
    try:
        struct.pack("<" + KINDS[kind].code, value)
    except (struct.error, OverflowError) as error:
        raise RecordError(f"{at}: {number} does not fit {kind}: {error}") from error
    return value


def _enum(field: Field, said: str, at: str) -> str:
    names = dict(field.values)
    if said in names:
        return said
    by_number = {str(number): name for name, number in field.values}
    if said in by_number:
        return by_number[said]
    raise RecordError(f"{at} has no value {said!r}; {did_you_mean(said, names, 'there are')}")


def _without_unit(said: str, unit: str, at: str) -> str:
    """Take the unit off a number, if one is said: it must be that of the field."""
    number, _, named = said.strip().partition(" ")
    named = named.strip()
    if named and named != unit:
        is_in = f"is in {unit}" if unit else "has no unit"
        raise RecordError(f"{at} {is_in}, got {said!r}; convert it, and leave the unit out if in doubt")
    return number


# -- JSON objects -----------------------------------------------------------------------------------------------------


def _replace_json(schema: Schema, value: dict[str, Any], tokens: list[str], said: str) -> None:
    part = part_of(schema, value, tokens)
    owner = part_of(schema, value, tokens[:-1]).value
    key = int(tokens[-1]) if isinstance(owner, list) else tokens[-1]
    owner[key] = _json_like(part.value, part.unit, said, ".".join(tokens))


def _json_like(old: Any, unit: str, said: str, at: str) -> Any:
    """Make a JSON value of its text, of the type of the one that it replaces."""
    if isinstance(old, str):
        return said
    is_number = isinstance(old, int | float) and not isinstance(old, bool)
    try:
        new = json.loads(_without_unit(said, unit, at) if is_number else said)
    except json.JSONDecodeError as error:
        raise RecordError(f"{at} is {text_of(old):.60}; JSON of that sort is expected, got {said!r:.60}") from error
    same = isinstance(new, int | float) and not isinstance(new, bool) if is_number else type(new) is type(old)
    if not same and old is not None:
        raise RecordError(f"{at} is {text_of(old):.60}; JSON of that sort is expected, got {said!r:.60}")
    return new
