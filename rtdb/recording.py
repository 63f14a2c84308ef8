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
from typing import Any, Generic, TypeVar

import msgspec

from .errors import ObjectMissing, RecordingError
from .recorder import FORMAT
from .records import Record, Schema, causes_to_proto, schema_of

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
                        by_id[record.id] = self.channels[record.topic] = channel
                        self.topics[record.id] = record.topic
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

    def read(self, topic: str, cls: type[R]) -> list[Recorded[R]]:
        """Read all writes of an object, by field names: what was added since takes its default."""
        channel = self.channels.get(topic)
        if channel is None:
            raise ObjectMissing(f"{self.path} holds no {topic}; it holds {', '.join(sorted(self.channels))}")
        schema_of(cls).check_fits(channel.schema, str(self.path))
        parse, make = parser_of(channel), _maker(channel, cls)
        out = []
        for raw in channel.raw:
            message = parse(raw.data)
            pairs = message.causes
            causes = tuple((self.topics[pairs[i]], pairs[i + 1]) for i in range(0, len(pairs), 2)) if pairs else ()
            out.append(Recorded(make(message), raw.cycle, raw.write, raw.t_data_ns, causes))
        return out

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


def _maker(channel: Channel, cls: type[R]) -> Callable[[Any], R]:
    """Build records from parsed messages by field name."""
    recorded = {f.name for f in channel.schema.fields}
    fields = [f for f in schema_of(cls).fields if f.name in recorded]
    missing = [f.name for f in schema_of(cls).fields if f.name not in recorded]
    required = {
        info.name
        for info in msgspec.structs.fields(cls)
        if info.default is msgspec.NODEFAULT and info.default_factory is msgspec.NODEFAULT
    }
    if required & set(missing):
        raise RecordingError(
            f"recorded {channel.topic} has no {', '.join(sorted(required & set(missing)))}, "
            f"and {cls.__name__} gives no default for it"
        )
    scope: dict[str, Any] = {"cls": cls}
    terms = []
    for f in fields:
        if f.spec.shape != "one":
            terms.append(f"{f.name}=tuple(m.{f.name})")
        elif f.spec.kind == "enum":
            import typing

            enum = typing.get_args(typing.get_type_hints(cls, include_extras=True)[f.name])[0]
            scope[f"e_{f.name}"] = {e.value: e for e in enum}
            terms.append(f"{f.name}=e_{f.name}.get(m.{f.name}, m.{f.name})")
        else:
            terms.append(f"{f.name}=m.{f.name}")
    return eval(f"lambda m: cls({', '.join(terms)})", scope)  # type: ignore[no-any-return]
