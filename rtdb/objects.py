"""Objects: handles to read one, and to write one that is one's own.

A read says which write: what a cut shows (`visible`: repeatable, what modules get), the newest (`latest`), the newest
as of a time (`as_of`, `as_of_data`), a number (`read`), the one after another (`next`, which counts what was lost). A
value that is no longer there is an AgedOut error, never another value.
"""

import enum
import struct
from collections.abc import Callable, Iterable, Iterator
from types import TracebackType
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import msgspec

from .errors import AgedOut, Deleted, ObjectMissing, RecordError, Stale
from .records import Record, schema_of

if TYPE_CHECKING:
    import numpy as np

    from . import _core
    from .store import Store

R = TypeVar("R", bound=Record)
Causes = tuple[tuple[int, int], ...]


class Flag(enum.IntFlag):
    """What is special about an object; the meanings stand in rtdb/core/fw_rtdb.h."""

    HOST_DEPENDENT = 1
    STATIC = 2
    READ_DENY = 4
    PUBLIC_WRITE = 8
    PERSISTENT = 16
    IMMEDIATE_DELETE = 32
    CYCLE_WATCH = 64
    WITHHOLD_STALE = 128
    NO_NOTIFY = 256
    WITH_PARENT = 512


HOST_DEPENDENT = int(Flag.HOST_DEPENDENT)  # differs from run to run (process ids, timings); not part of the trace
STATIC = int(Flag.STATIC)  # written once; its age says nothing


class Sample(msgspec.Struct, Generic[R], frozen=True, gc=False):
    """One write of an object, as read back.

    `t_data_ns`: when what it tells was true; `t_commit_ns`: when it was written; `causes`: (object id, write number)
    of what it was computed from; `source`: the object, None for a sample made by hand.
    """

    value: R
    write: int
    t_commit_ns: int
    t_data_ns: int
    causes: Causes
    source: "Object[Any] | None" = None


class Object(Generic[R]):
    """A handle to read one object. Stays good until the store is closed; after a deletion its reads say so."""

    def __init__(self, store: "Store", handle: int, cls: type[R] | None = None) -> None:
        self._store, self.handle = store, handle
        raw = store.core.object(handle)
        self.name, self.oid, self._component, schema, self.size, self.n_slots, self.every, self.phase = raw[:8]
        self.flags, self.n_causes, self.parent = Flag(raw[8]), raw[9], raw[10]
        self.static = bool(raw[8] & STATIC)  # asked of every input of every write
        self.t_insert_ns, self.t_history_ns, self.min_cycle_ns, self.max_age_ns = raw[13], raw[15], raw[16], raw[17]
        stored = store.schema(schema)
        if stored.size != self.size:
            raise RecordError(f"object {self.name} has {self.size} bytes, its record {stored.name} {stored.size}")
        self.schema = schema_of(cls) if cls is not None else stored
        self.stored = stored
        self._unpack: Callable[[bytes], R] = self.schema.unpack
        if cls is not None and self.schema.hash != stored.hash:
            self._unpack = stored.reader(cls, f"object {self.name}")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Object) and (self._store, self.oid) == (other._store, other.oid)

    def __hash__(self) -> int:
        return hash(self.oid)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name}: {self.schema.name}>"

    @property
    def component(self) -> str:
        """Name of the owner."""
        return self._store.core.component(self._component)[0]

    @property
    def head(self) -> int:
        """Number of the newest write, 0 before the first."""
        return self._store.core.object(self.handle)[11]

    @property
    def refused(self) -> int:
        """How many writes were refused as too fast."""
        return self._store.core.object(self.handle)[12]

    @property
    def t_delete_ns(self) -> int | None:
        """When it was deleted; None while it lives."""
        t_ns = self._store.core.object(self.handle)[14]
        return None if t_ns == 0x7FFFFFFFFFFFFFFF else t_ns

    def sample(self, raw: "_core.RawSample") -> Sample[R]:
        """Give a raw sample of the core its type."""
        try:
            return Sample(self._unpack(raw[0]), raw[1], raw[2], raw[3], raw[4], self)
        except struct.error as error:  # written by a program that says it writes this record, and does not
            raise RecordError(
                f"write {raw[1]} of {self.name} has {len(raw[0])} bytes, a {self.stored.name} has {self.stored.size}"
            ) from error

    # -- one write ------------------------------------------------------------------------------------------------

    def visible(self, cycle: int) -> Sample[R] | None:
        """Read what the cut of a cycle shows; None before the first write became visible. Repeatable."""
        raw = self._store.core.visible(self.handle, cycle)
        return None if raw is None else self.sample(raw)

    def visible_since(self, cycle: int, last: Sample[R] | None) -> Sample[R] | None:
        """Read as `visible` does, but give `last` back if it is still what shows, without unpacking it again."""
        raw = self._store.core.visible(self.handle, cycle)
        if raw is None:
            return None
        return last if last is not None and raw[1] == last.write else self.sample(raw)

    def latest(self) -> Sample[R] | None:
        """Read the newest write, visible or not. For tools: two calls may differ."""
        raw = self._store.core.latest(self.handle)
        return None if raw is None else self.sample(raw)

    def read(self, write: int) -> Sample[R]:
        """Read a write by its number; AgedOut or NotYet where it is not there."""
        return self.sample(self._store.core.read(self.handle, write))

    def as_of(self, t_ns: int) -> Sample[R] | None:
        """Read the newest write committed at or before a time. Not repeatable while its writer runs."""
        write = self._store.core.as_of(self.handle, t_ns)
        return self.read(write) if write else None

    def as_of_data(self, t_ns: int) -> Sample[R] | None:
        """Read the newest write that was true at or before a time. Not repeatable while its writer runs."""
        write = self._store.core.as_of_data(self.handle, t_ns)
        return self.read(write) if write else None

    def older(self, sample: Sample[R]) -> Sample[R] | None:
        """Read the write before a sample; None before the first."""
        return self.read(sample.write - 1) if sample.write > 1 else None

    def younger(self, sample: Sample[R]) -> Sample[R] | None:
        """Read the write after a sample; None while there is none."""
        found = self.next(sample.write)
        return None if found is None else self.read(sample.write + 1)

    def writer_of(self, sample: Sample[R]) -> str:
        """Name the component that wrote a sample: of interest where anybody may write."""
        return self._store.core.component(self._store.core.writer(self.handle, sample.write))[0]

    def raw(self, write: int) -> bytes:
        """Read the bytes of a write."""
        return self._store.core.read(self.handle, write)[0]

    # -- one after the other --------------------------------------------------------------------------------------

    def next(self, after: int) -> tuple[Sample[R], int] | None:
        """Read the write after a number (0: the first one there) and how many in between are lost; None: none yet."""
        found = self._store.core.next(self.handle, after)
        return None if found is None else (self.sample(found[0]), found[1])

    def wait(self, after: int, timeout_s: float) -> int | None:
        """Wait until there is a write after a number; returns the newest one's, None after the timeout.

        The timeout is store time. A deletion ends the wait (Deleted), and so does a clock that is dead (ClockDead).
        """
        core = self._store.core
        return core.wait_write(self.handle, after, core.now_ns + int(timeout_s * 1e9))

    def updates(self, after: int | None = None, timeout_s: float = 1.0) -> Iterator[tuple[Sample[R], int]]:
        """Yield every write after a number [default: what comes from now on], with the count of those lost before it.

        Blocks without polling; ends when there is none for timeout_s of store time, or when the object is deleted.
        """
        write = self.head if after is None else after
        while True:
            try:
                found = self.next(write)
                if found is None:
                    if self.wait(write, timeout_s) is None:
                        return
                    continue
            except Deleted:
                return
            yield found
            write = found[0].write

    def history(self, t0_ns: int, t1_ns: int) -> "np.ndarray[Any, Any]":
        """Read all writes committed in [t0_ns, t1_ns] that are still there.

        Returns a structured array (n,) with fields write, t_commit_ns, t_data_ns and value (the record's own dtype).
        """
        import numpy as np

        core, oldest = self._store.core, max(1, self.head - self.n_slots + 2)
        try:
            first = core.as_of(self.handle, t0_ns - 1) + 1
        except (AgedOut, Stale):
            first = oldest
        except Deleted:  # before t0
            first = self.head + 1
        rows: list[_core.RawSample] = []
        for write in range(max(first, oldest), self.head + 1):
            try:
                raw = core.read(self.handle, write)
            except AgedOut:  # overtaken by the writer while reading: start behind it
                rows.clear()
                continue
            if raw[2] > t1_ns:
                break
            if raw[2] >= t0_ns:
                rows.append(raw)
        out = np.empty(
            len(rows),
            dtype=[("write", "<u8"), ("t_commit_ns", "<i8"), ("t_data_ns", "<i8"), ("value", self.stored.dtype())],
        )
        for k, name in ((1, "write"), (2, "t_commit_ns"), (3, "t_data_ns")):
            out[name] = [row[k] for row in rows]
        out["value"] = np.frombuffer(b"".join(row[0] for row in rows), dtype=self.stored.dtype())
        return out

    def view(self, cycle: int | None = None) -> "View":
        """Look at what a cut shows [default: the current one] without a copy, in a `with`; see View."""
        core = self._store.core
        return View(self, core.visible_write(self.handle, core.cycle if cycle is None else cycle))


class View:
    """One write in place: `memory` (read-only), `array` (a structured array of shape ()), `write`, `t_data_ns`.

    Good inside its `with`: copy what is to be kept. The end of the block raises AgedOut if the writer came around
    meanwhile, so that nothing computed from half a frame is used. What one of the two newest cuts shows is never
    overwritten.
    """

    __slots__ = ("_obj", "memory", "t_commit_ns", "t_data_ns", "write")

    def __init__(self, obj: Object[Any], write: int) -> None:
        self._obj, self.write = obj, write

    def __enter__(self) -> "View":
        obj = self._obj
        if not self.write:
            raise ObjectMissing(f"{obj.name} shows nothing yet in cycle {obj._store.cycle}")
        self.memory, self.t_commit_ns, self.t_data_ns = obj._store.core.peek(obj.handle, self.write)
        return self

    @property
    def array(self) -> "np.ndarray[Any, Any]":
        """The record's fields as numpy sees them, in place."""
        import numpy as np

        return np.ndarray((), self._obj.stored.dtype(), self.memory)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self._obj._store.core.check(self._obj.handle, self.write)


class Writer(Object[R]):
    """A handle to read and write an object of one's own component (or a public one)."""

    def write(
        self,
        record: R,
        t_data_ns: int | None = None,
        causes: Causes = (),
        inputs: Iterable[Sample[Any]] = (),
    ) -> int:
        """Write a value; returns its number. It shows at the object's next edge.

        inputs: the samples that it was computed from. They become its causes, and the oldest of their data times (those
        of static objects apart) becomes its own. t_data_ns: when it was true, if not that of the inputs [now].
        """
        core = self._store.core
        if inputs:
            t_ns, causes = inherited(inputs)
            if t_data_ns is None:
                t_data_ns = core.not_before(self.handle, core.now_ns if t_ns is None else t_ns)
        elif t_data_ns is None:
            t_data_ns = core.now_ns
        return core.write(self.handle, self.schema.pack(record), t_data_ns, causes)

    def frame(self, t_data_ns: int | None = None, causes: Causes = ()) -> "Frame":
        """Write in place, in a `with`; see Frame."""
        return Frame(self, t_data_ns, causes)

    def delete(self) -> None:
        """Delete the object; its history stays readable for its time, and its name is free."""
        self._store.delete(self)


class Frame:
    """The next write in place: `memory` (writable), and `array`, a structured array of shape ().

    It is committed where the `with` ends, and abandoned where it ends with an exception. Afterwards `array` is
    read-only: the slot belongs to its readers.
    """

    __slots__ = ("_array", "_causes", "_t_data_ns", "_writer", "memory", "write")

    def __init__(self, writer: Writer[Any], t_data_ns: int | None, causes: Causes) -> None:
        self._writer, self._t_data_ns, self._causes, self.write = writer, t_data_ns, causes, 0
        self._array: np.ndarray[Any, Any] | None = None

    def __enter__(self) -> "Frame":
        self.memory = self._writer._store.core.begin(self._writer.handle)
        return self

    @property
    def array(self) -> "np.ndarray[Any, Any]":
        """The record's fields as numpy sees them, in place."""
        import numpy as np

        if self._array is None:
            self._array = np.ndarray((), self._writer.schema.dtype(), self.memory)
        return self._array

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._array is not None:
            self._array.flags.writeable = False
        else:
            self.memory.release()
        if kind is None:
            core = self._writer._store.core
            t_ns = core.now_ns if self._t_data_ns is None else self._t_data_ns
            self.write = core.commit(self._writer.handle, self._writer.size, t_ns, self._causes)


def inherited(inputs: Iterable[Sample[Any]]) -> tuple[int | None, Causes]:
    """Give the oldest data time of inputs that are not static (None: all are), and the inputs as causes."""
    t_ns, causes = None, []
    for sample in inputs:
        if sample.source is None:
            raise RecordError(f"a sample made by hand is no input: {sample.value!r:.80}; read it from the store")
        causes.append((sample.source.oid, sample.write))
        if not sample.source.static and (t_ns is None or sample.t_data_ns < t_ns):
            t_ns = sample.t_data_ns
    return t_ns, tuple(causes)
