"""The store as Python sees it: stores, components, objects, cuts.

store = Store.create()                                  # private; Store.create("cart") is shared
localise = store.join("localise")                       # a component: the only writer of its objects
pose = localise.insert("pose", Pose, every=4, phase=2)  # visible at ticks 2, 6, 10, ...
pose.write(Pose(x_m=1.0), t_data_ns=t)
store.tick()
store.snapshot().get(pose)                              # what everybody sees in this cycle
"""

from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Any, Generic, Self, TypeVar, cast, overload

import msgspec

from . import _core
from .errors import AgedOut, ObjectMissing, RecordError
from .records import Record, Schema, schema_of

if TYPE_CHECKING:
    import numpy as np

R = TypeVar("R", bound=Record)
Causes = tuple[tuple[int, int], ...]

HOST_DEPENDENT = 1  # flag: differs from run to run (process ids, timings); not part of the trace
MAX_SLOTS = 1 << 24  # as in fw_insert
STATIC = 2  # flag: written once; its age says nothing


class Sample(msgspec.Struct, Generic[R], frozen=True, gc=False):
    """One write of an object, as read back.

    `t_data_ns`: when what it tells was true; `t_commit_ns`: when it was written; `causes`: (object id, write number)
    of what it was computed from.
    """

    value: R
    write: int
    t_commit_ns: int
    t_data_ns: int
    causes: Causes


@dataclass(frozen=True, slots=True)
class ComponentInfo:
    """A component as the directory knows it. `alive`: a process holds its lock; `done`: newest cycle it finished."""

    name: str
    pid: int
    alive: bool
    done: int
    participant: bool


class Object(Generic[R]):
    """A handle to read one object. Stays good until the store is closed."""

    def __init__(self, store: "Store", index: int, cls: type[R] | None = None) -> None:
        (
            self.name,
            self.oid,
            self._component,
            schema,
            self.size,
            self.n_slots,
            self.every,
            self.phase,
            self.flags,
            self.n_causes,
            self.parent,
            _,
            _,
        ) = store.core.object(index)
        self._store, self.index = store, index
        stored = Schema.from_text(store.core.schema(schema))
        self.schema = schema_of(cls) if cls is not None else stored
        if cls is not None and self.schema.hash != stored.hash:
            self.schema.check_fits(stored, f"object {self.name}")
            raise RecordError(
                f"object {self.name} holds {stored.name} {stored.hash}, this program has {self.schema.name} "
                f"{self.schema.hash}: run the same version on both sides"
            )

    @property
    def component(self) -> str:
        """Name of the owner."""
        return self._store.core.component(self._component)[0]

    @property
    def refused(self) -> int:
        """How many writes were refused as too fast."""
        return self._store.core.object(self.index)[12]

    @property
    def head(self) -> int:
        """Number of the newest write, 0 before the first."""
        return self._store.core.object(self.index)[11]

    def sample(self, raw: "_core.RawSample") -> Sample[R]:
        """Give a raw sample of the core its type."""
        return Sample(self.schema.unpack(raw[0]), *raw[1:])

    def visible(self, cycle: int) -> Sample[R] | None:
        """Read what the cut of a cycle shows; None before the first write became visible. Repeatable."""
        raw = self._store.core.visible(self.index, cycle)
        return None if raw is None else self.sample(raw)

    def visible_since(self, cycle: int, last: Sample[R] | None) -> Sample[R] | None:
        """Read as `visible` does, but give `last` back if it is still what shows, without unpacking it again."""
        raw = self._store.core.visible(self.index, cycle)
        if raw is None:
            return None
        return last if last is not None and raw[1] == last.write else self.sample(raw)

    def latest(self) -> Sample[R] | None:
        """Read the newest write, visible or not. For tools: two calls may differ."""
        raw = self._store.core.latest(self.index)
        return None if raw is None else self.sample(raw)

    def read(self, write: int) -> Sample[R]:
        """Read a write by its number; AgedOut or NotYet where it is not there."""
        return self.sample(self._store.core.read(self.index, write))

    def history(self, t0_ns: int, t1_ns: int) -> "np.ndarray[Any, Any]":
        """Read all writes committed in [t0_ns, t1_ns] that are still there.

        Returns a structured array (n,) with fields write, t_commit_ns, t_data_ns and value (the record's own dtype).
        """
        import numpy as np

        core, oldest = self._store.core, max(1, self.head - self.n_slots + 2)
        try:
            first = core.as_of(self.index, t0_ns - 1) + 1
        except AgedOut:
            first = oldest
        rows: list[_core.RawSample] = []
        for write in range(max(first, oldest), self.head + 1):
            try:
                raw = core.read(self.index, write)
            except AgedOut:  # overtaken by the writer while reading: start behind it
                rows.clear()
                continue
            if raw[2] > t1_ns:
                break
            rows.append(raw)
        out = np.empty(
            len(rows),
            dtype=[("write", "<u8"), ("t_commit_ns", "<i8"), ("t_data_ns", "<i8"), ("value", self.schema.dtype())],
        )
        for k, name in ((1, "write"), (2, "t_commit_ns"), (3, "t_data_ns")):
            out[name] = [row[k] for row in rows]
        out["value"] = np.frombuffer(b"".join(row[0] for row in rows), dtype=self.schema.dtype())
        return out


class Writer(Object[R]):
    """A handle to read and write an object of one's own component."""

    def write(self, record: R, t_data_ns: int | None = None, causes: Causes = ()) -> int:
        """Write a value; returns its number. It shows at the object's next edge.

        t_data_ns: when it was true [default: now]; raised to that of the write before if it is older.
        """
        core = self._store.core
        return core.write(self.index, self.schema.pack(record), core.now_ns if t_data_ns is None else t_data_ns, causes)

    def begin(self) -> memoryview:
        """Open the next slot for writing in place; nothing shows before `commit`. The view ends with the commit."""
        return self._store.core.begin(self.index)

    def commit(self, t_data_ns: int) -> int:
        """Publish the slot that `begin` opened."""
        return self._store.core.commit(self.index, self.schema.size, t_data_ns)


class Component:
    """A component that this process is. Leaving (or dying) lets another process take its objects over."""

    def __init__(self, store: "Store", index: int, name: str) -> None:
        self._store, self.index, self.name = store, index, name

    def insert(
        self,
        name: str,
        cls: type[R],
        *,
        every: int = 1,
        phase: int = 0,
        history_s: float = 2.0,
        flags: int = 0,
        n_causes: int = 0,
    ) -> Writer[R]:
        """Insert the object `<component>/<name>`, or take it over from a predecessor.

        every, phase: due at ticks c with c % every == phase; history_s: for how long reads reach back when the owner
        writes once per edge.
        """
        full, core, schema = f"{self.name}/{name}", self._store.core, schema_of(cls)
        if every < 1:
            raise RecordError(f"cannot insert {full}: every={every} is not a number of ticks")
        n_slots = int(history_s * 1e9 / (every * core.tick_ns)) + 4
        if not 4 <= n_slots <= MAX_SLOTS:
            raise RecordError(f"cannot insert {full}: history_s={history_s} is {n_slots} slots, at most {MAX_SLOTS}")
        try:
            index = core.find(full)
        except ObjectMissing:
            index = core.insert(
                full,
                self.index,
                core.add_schema(schema.to_text()),
                schema.size,
                n_slots,
                every,
                phase % every,
                flags,
                n_causes,
                0,
            )
        return Writer(self._store, index, cls)

    def done(self, cycle: int) -> None:
        """Say that this component has finished a cycle."""
        self._store.core.done(self.index, cycle)

    def leave(self) -> None:
        """Stop being this component; its objects stay readable."""
        self._store.core.leave(self.index)


class Cut:
    """What is visible at one cycle: the same for every reader, whenever it asks."""

    def __init__(self, store: "Store", cycle: int) -> None:
        self._store, self.cycle = store, cycle

    def get(self, obj: Object[R]) -> Sample[R] | None:
        """Read an object in this cut; None where nothing is visible yet."""
        return obj.visible(self.cycle)

    def __getitem__(self, name: str) -> Sample[Any]:
        sample = self._store.find(name).visible(self.cycle)
        if sample is None:
            raise ObjectMissing(f"{name} shows nothing yet in cycle {self.cycle}")
        return sample


class Store:
    """A real-time database. Use it in a `with`, or close it."""

    def __init__(self, core: _core.Store) -> None:
        self.core = core
        self._objects: dict[tuple[str, type[Record] | None], Object[Any]] = {}

    @classmethod
    def create(
        cls,
        name: str | None = None,
        *,
        tick_ns: int = 10_000_000,
        t0_ns: int = 0,
        size: int = 4 << 20,
        max_objects: int = 256,
    ) -> Self:
        """Make a store: private to this process, or under a name that others on this machine can attach to."""
        return cls(_core.create(name, size, max_objects, tick_ns, t0_ns))

    @classmethod
    def attach(cls, name: str) -> Self:
        """Attach to a named store."""
        return cls(_core.attach(name))

    def close(self) -> None:
        """Give the memory back; the creator also removes the name."""
        self._objects.clear()
        self.core.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # -- components and objects -----------------------------------------------------------------------------------

    def join(self, name: str, *, participant: bool = False) -> Component:
        """Become a component. A participant is waited for by `wait_done`."""
        return Component(self, self.core.join(name, participant), name)

    def components(self) -> list[ComponentInfo]:
        """List the components, living and dead."""
        raw = (self.core.component(i) for i in range(self.core.n_components()))
        return [
            ComponentInfo(name, pid, bool(alive), done, bool(participant))
            for name, pid, alive, done, participant in raw
        ]

    def objects(self) -> list[Object[Any]]:
        """List the objects in the order of their insertion."""
        return [Object(self, i) for i in range(self.core.n_objects())]

    @overload
    def find(self, name: str, cls: type[R], *, timeout_s: float = 0.0) -> Object[R]: ...
    @overload
    def find(self, name: str, cls: None = None, *, timeout_s: float = 0.0) -> Object[Any]: ...
    def find(self, name: str, cls: type[R] | None = None, *, timeout_s: float = 0.0) -> Object[R]:
        """Find an object by name, waiting for it at most timeout_s. Without its class, values come as dictionaries."""
        key = name, cls
        known = self._objects.get(key)
        if known is not None:
            return cast("Object[R]", known)
        while True:
            n_objects = self.core.n_objects()
            try:
                found: Object[R] = Object(self, self.core.find(name), cls)
                break
            except ObjectMissing:
                if timeout_s <= 0 or self.core.wait_object(n_objects, int(timeout_s * 1e9)) is None:
                    raise
        self._objects[key] = found
        return found

    # -- time -----------------------------------------------------------------------------------------------------

    @property
    def cycle(self) -> int:
        """Number of the current cycle."""
        return self.core.cycle

    @property
    def now_ns(self) -> int:
        """Edge time of the current cycle, ns since 1970."""
        return self.core.now_ns

    @property
    def tick_ns(self) -> int:
        """Length of the base tick."""
        return self.core.tick_ns

    @property
    def t0_ns(self) -> int:
        """Time of cycle 0."""
        return self.core.t0_ns

    def tick(self) -> int:
        """End the cycle: what was written becomes visible, for all objects that are due, at once."""
        return self.core.tick()

    def snapshot(self) -> Cut:
        """Take the cut of the current cycle."""
        return Cut(self, self.core.cycle)

    def at_cycle(self, cycle: int) -> Cut:
        """Take the cut of a cycle."""
        return Cut(self, cycle)

    def at(self, t_ns: int) -> Cut:
        """Take the cut of the last tick at or before a time."""
        return Cut(self, max(0, min((t_ns - self.core.t0_ns) // self.core.tick_ns, self.core.cycle)))

    def wait_cycle(self, after: int, timeout_s: float) -> int | None:
        """Wait until the cycle is larger than `after`; None after the timeout (the clock stalls or is dead)."""
        return self.core.wait_cycle(after, int(timeout_s * 1e9))

    def wait_done(self, cycle: int, timeout_s: float) -> bool:
        """Wait until all living participants have finished a cycle; False after the timeout."""
        return self.core.wait_done(cycle, int(timeout_s * 1e9)) is not None

    # -- images ---------------------------------------------------------------------------------------------------

    def save(self) -> bytes:
        """Copy a private store, with its history and time."""
        return self.core.save()

    def restore(self, image: bytes) -> None:
        """Make a private store what it was when `image` was saved from it. Handles made before the save stay good."""
        self.core.restore(image)
        self._objects.clear()
