"""Recordings, read back: samples by topic, the trace and its hash.

The trace is the sorted sequence of (cycle, object name, write number, data time, payload) of all objects that do not
depend on the host. The same scenario, seed and modules give the same trace, in any layout, order or load.
"""

import hashlib
import logging
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import msgspec

from .errors import ObjectMissing, RecordingError
from .json_object import JsonSchema, loads
from .recorder import FORMAT
from .records import Field, Record, Schema, causes_to_proto, schema_of

if TYPE_CHECKING:
    import numpy as np

R = TypeVar("R", bound=Record)
_CAUSES = causes_to_proto([0])[:2]  # its tag
log = logging.getLogger(__name__)


class Recorded(msgspec.Struct, Generic[R], frozen=True, gc=False):
    """One recorded write. `causes`: (topic, write number) of what it was computed from."""

    value: R
    cycle: int
    write: int
    t_data_ns: int
    causes: tuple[tuple[str, int], ...]


class _Raw(msgspec.Struct, frozen=True, gc=False):
    cycle: int
    write: int
    t_data_ns: int
    data: bytes


@dataclass
class Channel:
    """All writes of one object."""

    topic: str
    schema: Schema
    descriptors: bytes
    in_trace: bool
    raw: list[_Raw] = field(default_factory=list)
    parse: Callable[[bytes], Any] | None = None


class Recording:
    """A recording in memory. `complete` is False for one whose process was stopped: it holds what had been written."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.channels: dict[str, Channel] = {}
        self.metadata: dict[str, str] = {}
        self.complete = True
        self.topics: dict[int, str] = {}
        self._load()
        self.tick_ns = int(self.metadata["tick_ns"])
        self.t0_ns = int(self.metadata["t0_ns"])

    def _load(self) -> None:
        from mcap.exceptions import McapError
        from mcap.records import Channel as McapChannel
        from mcap.records import Message, Metadata
        from mcap.records import Schema as McapSchema
        from mcap.stream_reader import StreamReader

        schemas: dict[int, McapSchema] = {}
        by_id: dict[int, Channel] = {}
        tick_ns = t0_ns = 0
        try:
            with self.path.open("rb") as file:
                for record in StreamReader(file).records:
                    if isinstance(record, Message):
                        cycle = (record.log_time - t0_ns) // tick_ns
                        by_id[record.channel_id].raw.append(
                            _Raw(cycle, record.sequence, record.publish_time, record.data)
                        )
                    elif isinstance(record, McapChannel) and record.id not in by_id:
                        schema = Schema.from_text(record.metadata["schema"])
                        channel = Channel(
                            record.topic, schema, schemas[record.schema_id].data, record.metadata["trace"] == "1"
                        )
                        if record.topic in self.channels:  # the same name with another schema, or of the other store
                            channel.topic = f"{record.topic}@{record.id}"
                        by_id[record.id] = self.channels[channel.topic] = channel
                        self.topics[record.id] = channel.topic
                    elif isinstance(record, McapSchema):
                        schemas[record.id] = record
                    elif isinstance(record, Metadata) and record.name == "fairway":
                        self.metadata = record.metadata
                        tick_ns, t0_ns = int(record.metadata["tick_ns"]), int(record.metadata["t0_ns"])
        except OSError as error:
            raise RecordingError(f"no recording at {self.path}: {error.strerror}") from error
        except (McapError, struct.error, EOFError, KeyError, ValueError) as error:
            self.complete = False  # a process that was killed leaves an open chunk; what came before it is whole
            log.info("%s ends early: %s", self.path, error)
        if not self.metadata:
            raise RecordingError(f"{self.path} is not a recording of Fairway, or not one second of it was written")
        if int(self.metadata["format"]) > FORMAT:
            raise RecordingError(f"{self.path} has format {self.metadata['format']}; this version reads up to {FORMAT}")

    @property
    def last_cycle(self) -> int:
        """Number of the last cycle in which anything was recorded."""
        return max((c.raw[-1].cycle for c in self.channels.values() if c.raw), default=0)

    def time_s(self, cycle: int) -> float:
        """Seconds from cycle 0 to a cycle's edge."""
        return cycle * self.tick_ns * 1e-9

    def _channel(self, topic: str) -> Channel:
        channel = self.channels.get(topic)
        if channel is None:
            raise ObjectMissing(f"{self.path} holds no {topic}; it holds {', '.join(sorted(self.channels))}")
        return channel

    def _rows(self, channel: Channel, make: Callable[[Any], Any]) -> list[Recorded[Any]]:
        parse, out = parser_of(channel), []
        for raw in channel.raw:
            message = parse(raw.data)
            pairs = message.causes
            causes = tuple((self.topics[pairs[i]], pairs[i + 1]) for i in range(0, len(pairs), 2)) if pairs else ()
            out.append(Recorded(make(message), raw.cycle, raw.write, raw.t_data_ns, causes))
        return out

    def read(self, topic: str, cls: type[R]) -> list[Recorded[R]]:
        """Read all writes of an object, by field names: what was added since takes its default."""
        channel = self._channel(topic)
        if isinstance(channel.schema, JsonSchema):
            raise RecordingError(f"{self.path}: {topic} is JSON without a record; use read_json")
        schema_of(cls).check_fits(channel.schema, str(self.path))
        return self._rows(channel, _maker(channel.schema, cls))

    def read_json(self, topic: str) -> list[Recorded[Any]]:
        """Read all writes of a JSON object, as dictionaries."""
        channel = self._channel(topic)
        if not isinstance(channel.schema, JsonSchema):
            raise RecordingError(f"{self.path}: {topic} holds the record {channel.schema.name}, not JSON; use read")
        return self._rows(channel, lambda message: loads(message.json))

    def find(self, topic: str, cls: type[R]) -> list[Recorded[R]]:
        """Read an object, or give an empty list where the recording has none."""
        return self.read(topic, cls) if topic in self.channels else []

    def _by_topic(self, channel: Channel, data: bytes) -> bytes:
        """Name causes by topic: channel ids depend on what else was recorded."""
        if _CAUSES not in data:
            return data
        message = parser_of(channel)(data)
        pairs = list(message.causes)
        names = " ".join(f"{self.topics[pairs[i]]} {pairs[i + 1]}" for i in range(0, len(pairs), 2))
        message.ClearField("causes")
        return bytes(message.SerializeToString(deterministic=True)) + names.encode()

    def trace_hash(self) -> str:
        """Hash of the trace."""
        digest = hashlib.sha256()
        rows = [(raw.cycle, c.topic, raw) for c in self.channels.values() if c.in_trace for raw in c.raw]
        for cycle, topic, raw in sorted(rows, key=lambda row: (row[0], row[1], row[2].write)):
            digest.update(b"%d %s %d %d " % (cycle, topic.encode(), raw.write, raw.t_data_ns))
            digest.update(self._by_topic(self.channels[topic], raw.data))
        return digest.hexdigest()


def parser_of(channel: Channel) -> Callable[[bytes], Any]:
    """Make the function that parses a channel's messages, once per channel."""
    if channel.parse is None:
        channel.parse = _make_parser(channel)
    return channel.parse


def _make_parser(channel: Channel) -> Callable[[bytes], Any]:
    from google.protobuf import descriptor_pool, message_factory
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    pool = descriptor_pool.DescriptorPool()
    for file in FileDescriptorSet.FromString(channel.descriptors).file:
        pool.Add(file)
    message = pool.FindMessageTypeByName(f"fairway.{channel.schema.name}")
    return message_factory.GetMessageClass(message).FromString


def _maker(recorded: Schema, cls: type[R]) -> Callable[[Any], R]:
    """Build records from parsed messages by field name."""
    old = {f.name: f for f in recorded.fields}
    scope: dict[str, Any] = {"cls": cls, "pixels": _pixels}
    terms = []
    for f in schema_of(cls).fields:
        term = f"m.{f.name}"
        if f.name not in old:
            continue
        if f.spec.kind == "record":
            scope[f"make_{f.name}"] = _maker(old[f.name].record, _class_of(f))
            term = f"make_{f.name}({term})" if f.spec.shape == "one" else f"tuple(map(make_{f.name}, {term}))"
        elif f.spec.kind == "image":
            term = f"pixels({term})"
        elif f.spec.shape != "one":
            term = f"tuple({term})"
        elif f.enum is not None:
            scope[f"e_{f.name}"] = {e.value: e for e in f.enum}
            term = f"e_{f.name}.get({term}, {term})"
        terms.append(f"{f.name}={term}")
    return eval(f"lambda m: cls({', '.join(terms)})", scope)  # type: ignore[no-any-return]


def _class_of(f: Field) -> type[Record]:
    assert f.record.cls is not None  # the schema was made from a class
    return f.record.cls


def _pixels(message: Any) -> "np.ndarray[Any, np.dtype[np.uint8]]":
    """View the data of a recorded image as an array (h, w, c), read-only."""
    import numpy as np

    extent = message.height, message.width, message.channels
    if len(message.data) != extent[0] * extent[1] * extent[2]:
        raise RecordingError(f"a recorded image of extent {extent} has {len(message.data)} bytes")
    return np.frombuffer(message.data, np.uint8).reshape(extent)
