"""All writes of an object that are still there, as a table or as CSV."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from ..errors import AgedOut, Deleted, RecordError
from ..records import Schema
from .console import table
from .values import cell, leaves, part_of, text_of, tokens_of

if TYPE_CHECKING:
    from rich.table import Table

    from ..objects import Object, Sample

Path = tuple[str, ...]
STAMPS = ("write", "t_commit_ns", "t_data_ns")
FEW = 6  # columns that have room beside each other


def written(obj: "Object[Any]", since_ns: int | None) -> tuple[list["Sample[Any]"], int]:
    """Read all writes up to the newest one, and count those that aged out, or do while we read.

    since_ns: leave out what was committed before.
    """
    after, last = _newest_before(obj, since_ns), obj.head
    samples: list[Sample[Any]] = []
    lost = 0
    while after < last:
        try:
            found = obj.next(after)
        except Deleted:  # and its storage given away while we read
            break
        if found is None:
            break
        lost, after = lost + found[1], found[0].write
        if since_ns is None or found[0].t_commit_ns >= since_ns:
            samples.append(found[0])
    return samples, lost


def _newest_before(obj: "Object[Any]", t_ns: int | None) -> int:
    """Give the number of the newest write before a time; 0 where that is not known."""
    if t_ns is None:
        return 0
    try:
        sample = obj.as_of(t_ns - 1)
    except (AgedOut, Deleted):
        return 0
    return sample.write if sample is not None else 0


def columns_of(schema: Schema, samples: "Sequence[Sample[Any]]", fields: Sequence[str]) -> list[Path]:
    """Choose the columns: the fields that are asked for, or all of them; in JSON objects, all that were ever there."""
    if not fields:
        return list({path: None for s in samples for path, _ in leaves(s.value)})
    asked = [tuple(tokens_of(field)) for field in fields]
    for path in asked:
        if samples and not any(_has(schema, s, path) for s in samples):
            part_of(schema, samples[-1].value, path)  # says what is wrong with it
    return asked


def _has(schema: Schema, sample: "Sample[Any]", path: Path) -> bool:
    try:
        part_of(schema, sample.value, path)
    except RecordError:
        return False
    return True


def _values(schema: Schema, sample: "Sample[Any]", columns: Sequence[Path]) -> list[Any]:
    return [part_of(schema, sample.value, c).value if _has(schema, sample, c) else None for c in columns]


def rows_of(schema: Schema, samples: "Sequence[Sample[Any]]", columns: Sequence[Path]) -> Iterator[list[str]]:
    """Yield the rows of CSV, with a heading; numbers with all their digits."""
    yield [*STAMPS, *(".".join(path) for path in columns)]
    for s in samples:
        yield [str(s.write), str(s.t_commit_ns), str(s.t_data_ns), *map(cell, _values(schema, s, columns))]


def table_of(schema: Schema, t0_ns: int, samples: "Sequence[Sample[Any]]", columns: Sequence[Path]) -> "Table":
    """Make a table; times are seconds since cycle 0."""
    names = [_heading(schema, samples, path) for path in columns]
    many = len(columns) > FEW
    made = table(
        ("write>", "t_commit>", "t_data>", *(["values"] if many else [f"{n}>" for n in names])), fold=["values"]
    )
    for s in samples:
        values = [text_of(value) for value in _values(schema, s, columns)]
        shown = [", ".join(f"{n} {v}" for n, v in zip(names, values, strict=True))] if many else values
        made.add_row(str(s.write), _time(s.t_commit_ns - t0_ns), _time(s.t_data_ns - t0_ns), *shown)
    return made


def _heading(schema: Schema, samples: "Sequence[Sample[Any]]", path: Path) -> str:
    unit = next((part_of(schema, s.value, path).unit for s in samples if _has(schema, s, path)), "")
    return ".".join(path) + (f" [{unit}]" if unit else "")


def _time(t_ns: int) -> str:
    return f"{t_ns * 1e-9:.3f} s"
