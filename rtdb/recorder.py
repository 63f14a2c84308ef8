"""Recorder: every commit that became visible, written to an MCAP file with protobuf payloads.

Whoever ticks the stores calls `record` after each tick. Who looks on while others tick calls `catch_up` now and then:
cuts are kept, so that nothing is left out as long as it comes again within the histories of the objects.

One channel per object: topic = object name, log_time = the edge at which the write became visible, publish_time = its
data time, sequence = its write number. Payload: message `fairway.<Record>` with the causes of the write behind it.
Metadata "fairway" holds the format version, tick and t0. Chunks are small, and the file is flushed once a second of
store time, so that a recording is readable up to the point at which its process was killed.
"""

import io
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from .errors import AgedOut, Deleted, ReadDenied, Stale
from .objects import HOST_DEPENDENT, Object
from .records import causes_to_proto
from .store import Store

if TYPE_CHECKING:
    from . import _core
    from .chunks import ChunkWriter

FORMAT = 1
REACH = 10  # cycles: how far back one looks who begins late; all histories are as long


class Recorder:
    """Records stores that tick together: cycle c of one is cycle c of the others. `lost`: writes that aged out."""

    def __init__(self, path: Path, stores: list[Store], metadata: Mapping[str, str]) -> None:
        from .chunks import ChunkWriter

        self._file: io.BufferedWriter = path.open("wb")
        self._mcap = ChunkWriter(self._file, library="fairway")
        self._mcap.add_metadata(
            "fairway",
            {"format": str(FORMAT), "tick_ns": str(stores[0].tick_ns), "t0_ns": str(stores[0].t0_ns), **metadata},
        )
        self._stores = stores
        self._channels: list[dict[int, tuple[int, Object[Any]]]] = [{} for _ in stores]  # by handle
        self._by_oid: list[dict[int, int]] = [{} for _ in stores]
        self._by_name: dict[tuple[int, str, str], int] = {}  # by store, object and schema
        self._flush_every = max(1, 1_000_000_000 // stores[0].tick_ns)
        self._caught_up = max(0, max(store.cycle for store in stores) - REACH)
        self._written: list[dict[int, int]] = [{} for _ in stores]  # by handle: the newest write that is in the file
        self.lost = 0
        self._register()

    def _register(self) -> None:
        """Give channels to new objects, in the order of their names: ids do not depend on who came first."""
        new = [
            (obj, channels, by_oid)
            for store, channels, by_oid in zip(self._stores, self._channels, self._by_oid, strict=True)
            for obj in store.entries()
            if obj.handle not in channels
        ]
        for obj, channels, by_oid in sorted(new, key=lambda item: item[0].name):
            known = id(channels), obj.name, obj.schema.hash
            channel = self._by_name.get(known)  # of one that was deleted
            if channel is None:
                channel = self._by_name[known] = add_channel(self._mcap, obj)
            channels[obj.handle] = channel, obj
            by_oid[obj.oid] = channel

    def record(self) -> None:
        """Write what the latest tick made visible."""
        for store, channels, by_oid in zip(self._stores, self._channels, self._by_oid, strict=True):
            now_ns = store.core.now_ns
            for index, (payload, write, _, t_data_ns, causes) in store.core.changed():
                if index not in channels:
                    self._register()
                channel, obj = channels[index]
                data = obj.schema.to_proto(payload)
                if causes:
                    if any(oid not in by_oid for oid, _ in causes):
                        self._register()
                    data += causes_to_proto([n for oid, w in causes if oid in by_oid for n in (by_oid[oid], w)])
                self._mcap.add_message(channel, now_ns, data, max(0, t_data_ns), write & 0xFFFFFFFF)
        if self._stores[0].cycle % self._flush_every == 0:
            self._mcap.flush()

    def catch_up(self, until: int) -> None:
        """Write what became visible up to a cycle, for stores that others tick. Times are those of the first store."""
        first = self._stores[0]
        self._register()
        for cycle in range(self._caught_up + 1, until + 1):
            t_ns = first.t0_ns + cycle * first.tick_ns
            for k, store in enumerate(self._stores):
                if cycle > store.cycle:
                    continue  # it stands, and the others go on
                for handle, (channel, obj) in self._channels[k].items():
                    raw = self._new_at(k, store, handle, cycle)
                    if raw is None:
                        continue
                    by_oid, causes = self._by_oid[k], raw[4]
                    data = obj.schema.to_proto(raw[0])
                    if causes:
                        data += causes_to_proto([n for oid, w in causes if oid in by_oid for n in (by_oid[oid], w)])
                    t_data_ns = raw[3] + first.t0_ns - store.t0_ns
                    self._mcap.add_message(channel, t_ns, data, max(0, t_data_ns), raw[1] & 0xFFFFFFFF)
            if cycle % self._flush_every == 0:
                self._mcap.flush()
        self._caught_up = max(self._caught_up, until)

    def _new_at(self, k: int, store: Store, handle: int, cycle: int) -> "_core.RawSample | None":
        """Read what an object shows in a cycle, if it is not in the file yet."""
        try:
            write = store.core.visible_write(handle, cycle)
            if not write or write == self._written[k].get(handle):
                return None
            raw = store.core.read(handle, write)
        except AgedOut:
            self.lost += 1
            return None
        except (Deleted, ReadDenied, Stale):
            return None
        self._written[k][handle] = write
        return raw

    def close(self) -> None:
        """Finish the file with its index."""
        if not self._file.closed:
            self._mcap.finish()
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def add_channel(mcap: "ChunkWriter", obj: Object[Any]) -> int:
    """Register an object's schema and channel; returns the channel id."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    descriptors = FileDescriptorSet(file=[obj.schema.file_descriptor()])
    schema = mcap.register_schema(f"fairway.{obj.schema.name}", "protobuf", descriptors.SerializeToString())
    return mcap.register_channel(
        obj.name,
        "protobuf",
        schema,
        {
            "schema": obj.schema.to_text(),
            "every": str(obj.every),
            "phase": str(obj.phase),
            "trace": "0" if obj.flags & HOST_DEPENDENT else "1",
        },
    )
