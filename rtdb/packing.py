"""Records to bytes and back: one call of `struct` for a whole record, nested ones included.

The functions are spelled out as Python source, once per record. For one with a nested point, a mode and up to four
numbers:

    lambda r: pack(r.at.x_m, r.at.y_m, k0[r.mode], len(r.some), *full(r.some, 4, 'some')) if type(r.at) is k1 else ...
    lambda b: (lambda v: make(k0(v[0], v[1]), k1.get(v[2], v[2]), v[4:4+v[3]]))(unpack(b))

What `struct` would only copy, images and tuples of records, is read from the bytes themselves.
"""

import struct
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NoReturn

from .errors import RecordError
from .layout import KINDS, Extent, Field, struct_format

if TYPE_CHECKING:
    import numpy as np

    from .records import Schema

Scope = dict[str, Any]  # the names that generated code uses; a plain dict, where Python looks names up fastest


def named(scope: Scope, value: Any) -> str:
    """Give a value a name in generated code."""
    key = f"k{len(scope)}"
    scope[key] = value
    return key


# -- pack -------------------------------------------------------------------------------------------------------------


def compile_pack(schema: "Schema") -> Callable[[Any], bytes]:
    """Make `pack(record) -> bytes`."""
    scope: Scope = {"pack": struct.Struct(struct_format(schema, "s")).pack}
    scope |= {"full": _full, "encoded": _encoded, "joined": _joined, "pixels": _pixels, "alien": _alien}
    call = f"pack({', '.join(_pack_terms(schema, 'r', scope))})"
    tests = _class_tests(schema, "r", scope)
    packed = eval(f"lambda r: {call}" + (f" if {' and '.join(tests)} else alien(r)" if tests else ""), scope)
    name, cls = schema.name, schema.cls

    def pack(record: Any) -> bytes:
        if cls is not None and type(record) is not cls:
            raise RecordError(f"expected a {name}, got {type(record).__name__}: {record!r:.80}")
        try:
            return packed(record)  # type: ignore[no-any-return]
        except (struct.error, TypeError, OverflowError, AttributeError, KeyError, UnicodeError) as error:
            raise RecordError(f"{name}: {_misfit(schema, record) or 'a value does not fit'} ({error})") from error

    return pack


def _pack_terms(schema: "Schema", path: str, scope: Scope) -> list[str]:
    """Spell out the arguments of `struct.pack` for the record that stands at a path."""
    terms: list[str] = []
    for f in schema.fields:
        at = f"{path}.{f.name}"
        name = at.removeprefix("r.")
        if f.spec.shape == "seq":
            terms.append(f"len({at})")
        if f.spec.kind == "record" and f.spec.shape == "one":
            terms += _pack_terms(f.record, at, scope)
        elif f.spec.kind == "record":
            exact = f.spec.shape == "array"
            terms.append(f"joined({at}, {f.spec.n}, {name!r}, {exact}, {named(scope, f.record.pack)})")
        elif f.spec.kind == "image":
            terms.append(f"*pixels({at}, {f.extent}, {name!r})")
        elif f.spec.shape == "seq":
            terms.append(f"*full({at}, {f.spec.n}, {name!r})")
        elif f.spec.shape == "array":
            terms.append(f"*full({at}, {f.spec.n}, {name!r}, True)")
        elif f.spec.kind == "str":
            terms.append(f"encoded({at}, {f.spec.n}, {name!r})")
        elif f.spec.kind == "enum":
            terms.append(f"{named(scope, {value: value for _, value in f.values})}[{at}]")
        else:
            terms.append(at)
    return terms


def _class_tests(schema: "Schema", path: str, scope: Scope) -> list[str]:
    """Spell out what must hold of nested records: one of another class may have the same names in other units."""
    tests: list[str] = []
    for f in schema.fields:
        if f.spec.kind == "record" and f.spec.shape == "one" and f.record.cls is not None:
            tests.append(f"type({path}.{f.name}) is {named(scope, f.record.cls)}")
            tests += _class_tests(f.record, f"{path}.{f.name}", scope)
    return tests


def _alien(record: Any) -> NoReturn:
    raise TypeError("a record in it is of another class")


def _check_count(values: Any, n: int, name: str, exact: bool) -> None:
    if len(values) > n or (exact and len(values) != n):
        raise RecordError(f"field {name} holds {'exactly' if exact else 'at most'} {n} values, got {len(values)}")


def _full(values: tuple[Any, ...], n: int, name: str, exact: bool = False) -> tuple[Any, ...]:
    if len(values) == n:
        return values
    _check_count(values, n, name, exact)
    return (*values, *(0,) * (n - len(values)))


def _joined(records: tuple[Any, ...], n: int, name: str, exact: bool, pack: Callable[[Any], bytes]) -> bytes:
    _check_count(records, n, name, exact)
    try:
        return b"".join(map(pack, records))
    except RecordError as error:
        raise RecordError(f"field {name}: {error}") from error


def _encoded(value: str, n: int, name: str) -> bytes:
    data = value.encode()
    if len(data) > n or "\0" in value:
        raise RecordError(f"field {name} holds at most {n} bytes of text without NUL, got {value!r:.60}")
    return data


def _pixels(image: Any, extent: Extent, name: str) -> tuple[int, int, int, bytes]:
    import numpy as np

    if (
        not isinstance(image, np.ndarray)
        or image.dtype != np.uint8
        or image.ndim != 3
        or any(used > most for used, most in zip(image.shape, extent, strict=True))
    ):
        got = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else f"{image!r:.60}"
        raise RecordError(f"field {name} holds a uint8 array (h, w, c) of at most {extent}, got {got}")
    h, w, c = image.shape
    if image.shape == extent:
        return h, w, c, image.tobytes()
    whole = np.zeros(extent, np.uint8)
    whole[:h, :w, :c] = image
    return h, w, c, whole.tobytes()


def _misfit(schema: "Schema", record: Any, path: str = "") -> str:
    """Name the first field whose value its kind cannot hold; "" if there is none."""
    for f in schema.fields:
        value: Any = getattr(record, f.name, None)
        many = f.spec.shape != "one" and isinstance(value, tuple | list)
        for item in value if many else (value,):
            said = _misfit_of(f, item, path + f.name)
            if said:
                return said if f.spec.kind == "record" else f"{path}{f.name}={value!r:.60} does not fit {f.spec.kind}"
    return ""


def _misfit_of(f: Field, item: Any, name: str) -> str:
    if f.spec.kind == "record":
        if f.record.cls is not None and type(item) is not f.record.cls:
            return f"{name} holds a {f.record.name}, got {type(item).__name__}: {item!r:.60}"
        return _misfit(f.record, item, f"{name}.")
    if f.spec.kind == "image":
        return ""  # refused with its name already
    try:
        if f.spec.kind == "enum" and item not in dict(f.values).values():
            raise OverflowError
        struct.pack("<" + KINDS[f.spec.kind].code, item if f.spec.kind != "str" else item.encode())
    except (struct.error, OverflowError, AttributeError, UnicodeError) as error:
        return str(error) or "no value of the enum"
    return ""


# -- unpack -----------------------------------------------------------------------------------------------------------


def compile_unpack(schema: "Schema", wanted: "Schema | None" = None) -> Callable[[bytes], Any]:
    """Make `unpack(bytes) -> record`, or -> dict where the class is not known.

    wanted: another version of the record, of which records are made; fields are linked by name.
    """
    wanted = wanted or schema
    scope: Scope = {"unpack": struct.Struct(struct_format(schema, "x")).unpack, "make": wanted.cls}
    scope |= {"overfull": _overfull, "split": split, "view": image_view, "fits": _fits}
    if wanted is schema and schema.cls is not None and all(_is_plain(f) for f in schema.fields):
        return eval("lambda b: make(*unpack(b))", scope)  # type: ignore[no-any-return]
    made = _made(schema, wanted, 0, 0, scope)
    return eval(f"lambda b: (lambda v: {made})(unpack(b))", scope)  # type: ignore[no-any-return]


def _is_plain(f: Field) -> bool:
    return f.spec.shape == "one" and f.spec.kind not in ("str", "enum", "image", "record")


def _made(schema: "Schema", wanted: "Schema", at: int, base: int, scope: Scope) -> str:
    """Spell out the record whose first value is v[at] and whose bytes begin at b[base]."""
    new = {f.name: f for f in wanted.fields}
    terms: dict[str, str] = {}
    for f in schema.fields:
        if f.name in new:
            terms[f.name] = _value(f, new[f.name], at, base, scope)
        at += f.n_values
    if wanted.cls is None:
        return "{" + ", ".join(f"{name!r}: {term}" for name, term in terms.items()) + "}"
    arguments = terms.values() if wanted is schema else (f"{name}={term}" for name, term in terms.items())
    return f"{named(scope, wanted.cls)}({', '.join(arguments)})"


def _value(f: Field, new: Field, at: int, base: int, scope: Scope) -> str:
    n, data = f.spec.n, base + f.data_offset
    if f.spec.kind == "record" and f.spec.shape == "one":
        return _made(f.record, new.record, at, base + f.offset, scope)
    if f.spec.kind == "image":
        return f"view(b, {data}, {f.extent}, fits({f.name!r}, {f.extent}, v[{at}:{at + 3}]))"
    if f.spec.kind == "record":
        unpack = f.record.unpack if new is f else compile_unpack(f.record, new.record)
        count = f"v[{at}]" if f.counts else str(n)
        many = f"tuple(map({named(scope, unpack)}, split(b, {data}, {f.record.size}, {count})))"
    elif f.spec.shape != "one":
        first = at + len(f.counts)
        many = f"v[{first}:{first}+v[{at}]]" if f.counts else f"v[{first}:{first + n}]"
    elif f.spec.kind == "str":
        return f"v[{at}].rstrip(b'\\0').decode('utf-8', 'replace')"
    elif f.spec.kind == "enum":
        known = named(scope, {e.value: e for e in new.enum} if new.enum else {value: name for name, value in f.values})
        return f"{known}.get(v[{at}], v[{at}])"
    else:
        return f"v[{at}]"
    return f"({many} if v[{at}] <= {n} else overfull({f.name!r}, v[{at}], {n}))" if f.counts else many


def _overfull(name: str, count: int, n: int) -> NoReturn:
    raise RecordError(f"field {name} holds at most {n} values, its count says {count}: whoever wrote it is wrong")


def split(buffer: bytes, offset: int, size: int, count: int) -> list[memoryview]:
    """Cut `count` records of a size out of a buffer."""
    data = memoryview(buffer)
    return [data[k : k + size] for k in range(offset, offset + count * size, size)]


def _fits(name: str, extent: Extent, used: Extent) -> Extent:
    if any(n > most for n, most in zip(used, extent, strict=True)):
        raise RecordError(f"field {name} holds an image of at most {extent}, its header says {used}")
    return used


def image_view(buffer: bytes, offset: int, extent: Extent, used: Extent) -> "np.ndarray[Any, np.dtype[np.uint8]]":
    """View the used corner of an image in a buffer, read-only and without a copy; it keeps the buffer alive."""
    import numpy as np

    whole = np.frombuffer(buffer, np.uint8, extent[0] * extent[1] * extent[2], offset).reshape(extent)
    whole.flags.writeable = False
    return whole[: used[0], : used[1], : used[2]]
