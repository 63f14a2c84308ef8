"""The store as Python sees it: stores and cuts.

store = Store.create()                                  # private; Store.create("cart") is shared
localise = store.join("localise")                       # a component: the only writer of its objects
pose = localise.insert("pose", Pose, every=4, phase=2)  # visible at ticks 2, 6, 10, ...
pose.write(Pose(x_m=1.0), t_data_ns=t)
store.tick()
store.snapshot().get(pose)                              # what everybody sees in this cycle
"""

import contextlib
import os
import time
import weakref
from types import TracebackType
from typing import Any, Literal, Self, TypeVar, cast, overload

from . import _core
from .clock import ClockInfo, Edges, Kind, RunningClock
from .components import Component, ComponentInfo
from .errors import Deleted, NotOwner, ObjectMissing, RecordError, RtdbError, StoreMissing
from .objects import Object, Sample, Writer
from .records import Record, Schema
from .watch import Query, Watch, search

R = TypeVar("R", bound=Record)
_KINDS = {"stepped": Kind.STEPPED, "barrier": Kind.BARRIER, "real": Kind.REAL}


class Cut:
    """What is visible at one cycle: the same for every reader, whenever it asks."""

    def __init__(self, store: "Store", cycle: int) -> None:
        self._store, self.cycle = store, cycle

    @property
    def t_ns(self) -> int:
        """Time of the cycle's edge."""
        return self._store.t0_ns + self.cycle * self._store.tick_ns

    def get(self, obj: Object[R]) -> Sample[R] | None:
        """Read an object in this cut; None where nothing is visible yet."""
        return obj.visible(self.cycle)

    def alive(self, component: str) -> bool:
        """Whether a component lived at the tick that began this cycle."""
        return self._store.core.alive_at(self._store.component_index(component), self.cycle)

    def __getitem__(self, name: str) -> Sample[Any]:
        sample = self._store.find(name).visible(self.cycle)
        if sample is None:
            raise ObjectMissing(f"{name} shows nothing yet in cycle {self.cycle}")
        return sample


class Store:
    """A real-time database. Use it in a `with`, or close it. Not for several threads at a time: attach once in each."""

    def __init__(self, core: _core.Store, name: str | None = None) -> None:
        self.core, self.name = core, name
        self._objects: dict[tuple[str, type[Record] | None], Object[Any]] = {}
        self._by_handle: dict[int, Object[Any]] = {}
        self._schemas: dict[int, Schema] = {}
        self._version = -1
        self._standby: RunningClock | None = None
        _open_stores.add(self)

    @classmethod
    def create(
        cls,
        name: str | None = None,
        *,
        clock: Literal["stepped", "barrier", "real"] = "stepped",
        tick_ns: int = 10_000_000,
        t0_ns: int = 0,
        size: int = 4 << 20,
        max_objects: int = 256,
        max_components: int = 64,
        deterministic: bool = False,
    ) -> Self:
        """Make a store: private to this process, or under a name that others on this machine can attach to.

        clock: who ends the cycles, see rtdb.clock; barrier and real-time stores are shared ones, and tick once somebody
        has called `run_clock`. tick_ns: base tick. deterministic: components read cuts only.
        """
        kind = _KINDS.get(clock)
        if kind is None:
            raise RecordError(f"clock={clock!r}: there are {', '.join(_KINDS)}")
        if kind is not Kind.STEPPED and name is None:
            raise RecordError(f"clock={clock!r} needs a name: a private store is ticked by its only process")
        return cls(
            _core.create(name, size, max_objects, max_components, int(kind), tick_ns, t0_ns, deterministic), name
        )

    @classmethod
    def attach(cls, name: str, *, timeout_s: float = 0.0) -> Self:
        """Attach to a named store, waiting for it at most timeout_s."""
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                return cls(_core.attach(name), name)
            except StoreMissing:
                if time.monotonic() >= deadline:
                    raise
                time.sleep(0.01)  # there is nothing to wait on yet

    def close(self) -> None:
        """Give the memory back; the creator also removes the name."""
        if self._standby is not None:
            self._standby.stop()
            self._standby = None
        self._forget_handles()
        self.core.close()

    def _forget_handles(self) -> None:
        self._objects.clear()
        self._by_handle.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def memory(self) -> tuple[int, int]:
        """Bytes of the heap, and how many of them no object has."""
        return self.core.memory()

    # -- components -----------------------------------------------------------------------------------------------

    def join(
        self, name: str, *, participant: bool = False, every: int = 1, phase: int = 0, version: str = ""
    ) -> Component:
        """Become a component, and take over what a dead predecessor left.

        A participant is waited for by a barrier, and a real-time clock counts what it misses; it is due at cycles c
        with c % every == phase.
        """
        if every < 1:
            raise RecordError(f"cannot join {name}: every={every} is not a number of ticks")
        return Component(self, self.core.join(name, participant, every, phase % every, version), name)

    def components(self) -> list[ComponentInfo]:
        """List the components, living and dead."""
        return [ComponentInfo(*self.core.component(i)) for i in range(self.core.n_components())]

    def component_index(self, name: str) -> int:
        """Give the number of a component."""
        for i in range(self.core.n_components()):
            if self.core.component(i)[0] == name:
                return i
        raise ObjectMissing(f"no component {name!r}; there are {', '.join(c.name for c in self.components())}")

    # -- objects --------------------------------------------------------------------------------------------------

    def schema(self, number: int) -> Schema:
        """Give a schema that the store holds."""
        schema = self._schemas.get(number)
        if schema is None:
            schema = self._schemas[number] = Schema.from_text(self.core.schema(number))
        return schema

    def object_of(self, handle: int) -> Object[Any]:
        """Give the object of a handle of the core."""
        return self._by_handle.get(handle) or Object(self, handle)

    def entries(self) -> list[Object[Any]]:
        """List what the directory holds, the deleted objects too as long as their history is kept."""
        kept: dict[int, Object[Any]] = {}
        for handle in self.core.entries():
            with contextlib.suppress(Deleted):  # its storage was given away while we looked
                kept[handle] = self.object_of(handle)
        self._by_handle = kept
        return list(kept.values())

    def objects(
        self,
        pattern: str | None = None,
        *,
        regex: str | None = None,
        record: type[Record] | str | None = None,
        parent: Object[Any] | None = None,
        creator: str | None = None,
        at_ns: int | None = None,
    ) -> list[Object[Any]]:
        """List objects in the order of their insertion: all, or those that fit every condition.

        pattern: as in a shell; regex: somewhere in the name; record: type; creator: component; at_ns: alive then, as
        far back as the history of deleted ones is kept.
        """
        return search(self, self._query(pattern, regex, record, parent, creator, at_ns))

    def watch(
        self,
        pattern: str | None = None,
        *,
        regex: str | None = None,
        record: type[Record] | str | None = None,
        parent: Object[Any] | None = None,
        creator: str | None = None,
    ) -> Watch:
        """Watch the set of objects that fit: its `changes` says what came and went."""
        return Watch(self, self._query(pattern, regex, record, parent, creator, None))

    @staticmethod
    def _query(
        pattern: str | None,
        regex: str | None,
        record: type[Record] | str | None,
        parent: Object[Any] | None,
        creator: str | None,
        at_ns: int | None,
    ) -> Query:
        return Query(
            pattern=pattern,
            regex=regex,
            record=record.__name__ if isinstance(record, type) else record,
            parent=parent.oid if parent is not None else None,
            creator=creator,
            at_ns=at_ns,
        )

    @overload
    def find(self, name: str, cls: type[R], *, timeout_s: float = 0.0) -> Object[R]: ...
    @overload
    def find(self, name: str, cls: None = None, *, timeout_s: float = 0.0) -> Object[Any]: ...
    def find(self, name: str, cls: type[R] | None = None, *, timeout_s: float = 0.0) -> Object[R]:
        """Find an object by name, waiting for it at most timeout_s. Without its class, values come as dictionaries."""
        key = name, cls
        if self._version != self.core.version:  # something came or went: names may mean other objects
            self._version = self.core.version
            self._objects.clear()
        known = self._objects.get(key)
        if known is not None:
            return cast("Object[R]", known)
        deadline = time.monotonic() + timeout_s
        while True:
            version = self.core.version
            try:
                found: Object[R] = Object(self, self.core.find(name), cls)
                break
            except (ObjectMissing, Deleted) as error:
                left_ns = int((deadline - time.monotonic()) * 1e9)
                if left_ns <= 0 or self.core.wait_directory(version, left_ns) is None:
                    raise self._with_advice(name, error) from None
        self._objects[key] = found
        return found

    def _with_advice(self, name: str, error: RtdbError) -> RtdbError:
        """Give the error of a name that is not found, with the one that may be meant."""
        import difflib

        near = difflib.get_close_matches(name, [obj.name for obj in self.objects()], n=1)
        return type(error)(f"{error}; did you mean {near[0]}?") if near and near[0] != name else error

    def writer(self, name: str, cls: type[R]) -> Writer[R]:
        """Find an object to write: one's own, or a public one."""
        return Writer(self, self.core.find(name), cls)

    def delete(self, obj: Object[Any]) -> None:
        """Delete an object and what goes with it: for its owner; for anybody if it is public or its owner gone."""
        self.core.delete(obj.handle)

    # -- time -----------------------------------------------------------------------------------------------------

    @property
    def cycle(self) -> int:
        """Number of the current cycle."""
        return self.core.cycle

    @property
    def now_ns(self) -> int:
        """Store time, ns since 1970: the current cycle's edge; of a real-time store, the host's steady time."""
        return self.core.now_ns

    @property
    def tick_ns(self) -> int:
        """Length of the base tick."""
        return self.core.tick_ns

    @property
    def t0_ns(self) -> int:
        """Time of cycle 0."""
        return self.core.t0_ns

    @property
    def clock(self) -> ClockInfo:
        """The clock: its kind, whether it lives, what it left out."""
        kind, alive, pid, cycle, skipped, takeovers, late_ns, lateness_us = self.core.clock_state()
        return ClockInfo(Kind(kind), alive, pid, cycle, skipped, takeovers, late_ns, lateness_us, self.core.tick_ns)

    @property
    def bears_name(self) -> bool:
        """Whether its name still means this store: its creator has not closed it, and none has replaced it."""
        return self.core.bears_name()

    def run_clock(self, wait_for: tuple[str, ...] = ()) -> RunningClock:
        """Tick a barrier or real-time store from a thread of C; a standby if another process ticks it already.

        wait_for: components without which there is no tick 1. Ends with the store.
        """
        if self.name is None:
            raise NotOwner("a private store is ticked by `tick`")
        self._standby = RunningClock(self.name, wait_for)
        return self._standby

    def take_clock(self) -> None:
        """Take the clock of a stepped store whose holder is gone: from now on `tick` is ours to call."""
        self.core.take_clock()

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
        """Take the cut of the last tick at or before a time; reading one of the future raises NotYet."""
        return Cut(self, max(0, (t_ns - self.core.t0_ns) // self.core.tick_ns))

    def wait_cycle(self, after: int, timeout_s: float) -> int | None:
        """Wait until the cycle is larger than `after`; None after the timeout: `clock` says whether it lives."""
        return self.core.wait_cycle(after, int(timeout_s * 1e9))

    def edges(self) -> Edges:
        """Give cycles as a file descriptor, for programs that wait in an event loop."""
        if self.name is None:
            raise NotOwner("a private store is ticked by whoever holds it: nobody else waits for its cycles")
        return Edges(self.name, self.cycle)

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
        self._forget_handles()


# A forked child shares the parent's locks but is another process: its copies of stores let go, and it attaches anew.
_open_stores: "weakref.WeakSet[Store]" = weakref.WeakSet()


def _after_fork() -> None:
    for store in list(_open_stores):
        with contextlib.suppress(Exception):
            store.core.forget()


os.register_at_fork(after_in_child=_after_fork)
