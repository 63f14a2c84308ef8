"""Diff: the first field in which the traces of two recordings differ. Where runs part, there is the cause.

The traces are compared as `Recording.trace_hash` reads them: in the order of cycle, object and write. Causes are
compared by the names of objects, not by the numbers that a file gives them, so that a recording with an object more or
less still tells where the others part.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtdb.errors import RecordingError
from rtdb.recording import Recording, parser_of
from rtdb.records import Field

METADATA = ("scenario", "site", "seed", "level", "plant", "version", "format", "tick_ns", "t0_ns")
Key = tuple[int, str, int]  # cycle, object, write number
Row = tuple[Key, int, bytes]  # data time since the start, payload
Decode = Callable[[str, bytes], dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Difference:
    """The first difference. `field` names what differs, with an index for arrays; None: there is nothing on that side.

    `also`: other objects that differ in the same cycle.
    """

    cycle: int
    at_s: float
    topic: str
    field: str
    left: Any
    right: Any
    also: tuple[str, ...] = ()


def open_recording(path: Path) -> Recording:
    """Open the recording of a run's folder, or an .mcap file; RecordingError says what is missing."""
    file = path / "run.mcap" if path.is_dir() else path
    if not file.is_file():
        raise RecordingError(f"no recording at {file}; expected a run's folder or an .mcap file")
    return Recording(file)


def metadata_differences(left: Recording, right: Recording) -> list[tuple[str, str, str]]:
    """List what the recordings say of themselves and do not agree on: (key, left, right)."""
    keys = [*METADATA, *sorted({*left.metadata, *right.metadata} - set(METADATA))]
    pairs = [(key, left.metadata.get(key, "not said"), right.metadata.get(key, "not said")) for key in keys]
    return [pair for pair in pairs if pair[1] != pair[2]]


def first_difference(left: Recording, right: Recording) -> Difference | None:
    """Find the first field that differs between two traces; None if the traces are the same."""
    if (left.tick_ns, left.trace_hash()) == (right.tick_ns, right.trace_hash()):
        return None
    decode = _decoder(left), _decoder(right)
    first: Difference | None = None
    also: dict[str, None] = {}
    for key, a, b in _pairs(left, right):
        if first is not None and key[0] > first.cycle:
            break
        if first is not None and key[1] == first.topic:
            continue
        found = _field(key, a, b, decode)
        if found is None:
            continue
        if first is None:
            first = Difference(key[0], left.time_s(key[0]), key[1], *found)
        else:
            also[key[1]] = None
    if first is None:
        return None
    return Difference(first.cycle, first.at_s, first.topic, first.field, first.left, first.right, tuple(also))


def _rows(recording: Recording) -> list[Row]:
    """List the trace: key, data time since the start, payload."""
    return sorted(
        (
            ((raw.cycle, channel.topic, raw.write), raw.t_data_ns - recording.t0_ns, raw.data)
            for channel in recording.channels.values()
            if channel.in_trace
            for raw in channel.raw
        ),
        key=lambda row: row[0],
    )


def _pairs(left: Recording, right: Recording) -> Iterator[tuple[Key, Row | None, Row | None]]:
    """Walk through both traces at once; None where one side has no such write."""
    a, b = _rows(left), _rows(right)
    i = j = 0
    while i < len(a) or j < len(b):
        if j == len(b) or (i < len(a) and a[i][0] < b[j][0]):
            yield a[i][0], a[i], None
            i += 1
        elif i == len(a) or b[j][0] < a[i][0]:
            yield b[j][0], None, b[j]
            j += 1
        else:
            yield a[i][0], a[i], b[j]
            i, j = i + 1, j + 1


def _field(key: Key, a: Row | None, b: Row | None, decode: tuple[Decode, Decode]) -> tuple[str, Any, Any] | None:
    """Name the first field that differs between two writes."""
    if a is None or b is None:
        return "write", None if a is None else f"number {key[2]}", None if b is None else f"number {key[2]}"
    if a[1] == b[1] and a[2] == b[2]:
        return None
    left, right = decode[0](key[1], a[2]), decode[1](key[1], b[2])
    for name in [*left, *(name for name in right if name not in left)]:
        x, y = left.get(name), right.get(name)
        if isinstance(x, tuple) and isinstance(y, tuple):
            for k in range(max(len(x), len(y))):
                xk, yk = (v[k] if k < len(v) else None for v in (x, y))
                if not _same(xk, yk):
                    return f"{name}[{k}]", xk, yk
        elif not _same(x, y):
            return name, x, y
    return ("data time", f"{a[1] / 1e9:.3f} s", f"{b[1] / 1e9:.3f} s") if a[1] != b[1] else None


def _same(x: Any, y: Any) -> bool:
    return bool(x == y) or repr(x) == repr(y)  # a NaN is the same as a NaN


def _decoder(recording: Recording) -> Decode:
    """Make a reader of payloads: fields by name in the order of the record, then the causes of the write."""
    parsers: dict[str, Callable[[bytes], Any]] = {}

    def decode(topic: str, data: bytes) -> dict[str, Any]:
        channel = recording.channels[topic]
        if topic not in parsers:
            parsers[topic] = parser_of(channel)
        message = parsers[topic](data)
        pairs, topics = list(message.causes), recording.topics
        return {field.name: _plain(getattr(message, field.name), field) for field in channel.schema.fields} | {
            "causes": tuple(
                f"{topics.get(pairs[k], 'unknown object')} write {pairs[k + 1]}" for k in range(0, len(pairs), 2)
            )
        }

    return decode


def _plain(value: Any, field: Field) -> Any:
    """Turn a protobuf value into one to compare and to print."""
    if field.spec.shape != "one":
        return tuple(value)
    return next((name for name, number in field.values if number == value), value)
