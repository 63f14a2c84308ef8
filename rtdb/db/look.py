"""A look at a whole store: what its directory, its components and its clock say at one moment.

Tools compute from looks, and `top` from two of them; only `look` touches the store. It works on objects whose class
this process never saw, and goes on where single ones cannot be read.
"""

import contextlib
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..clock import ClockInfo
from ..components import ComponentInfo
from ..errors import Deleted, RtdbError
from ..objects import Flag, Object

if TYPE_CHECKING:
    from ..store import Store

COMMITS = 64  # so many of the newest writes of an object are looked at
HEALTH = "Health"  # record of <component>/health, written by the core


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectLook:
    """One object. `t_data_ns`: of the newest write, None before the first; `commits_ns`: of the newest, in order."""

    oid: int
    name: str
    record: str
    component: str
    parent: int
    flags: Flag
    every: int
    phase: int
    head: int
    refused: int
    t_data_ns: int | None
    t_delete_ns: int | None
    commits_ns: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class ComponentLook:
    """One component, and what it wrote into its health object: None if it has none."""

    info: ComponentInfo
    health: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """A store at one moment. `objects`: deleted ones too, while they are kept; `unreadable`: why some are missing."""

    name: str
    host_ns: int
    now_ns: int
    t0_ns: int
    cycle: int
    tick_ns: int
    clock: ClockInfo
    memory: tuple[int, int]
    components: tuple[ComponentLook, ...]
    objects: tuple[ObjectLook, ...]
    unreadable: tuple[str, ...] = ()

    @property
    def living(self) -> tuple[ObjectLook, ...]:
        """The objects that are not deleted, by name."""
        return tuple(sorted((o for o in self.objects if o.t_delete_ns is None), key=lambda o: o.name))

    @property
    def alive(self) -> frozenset[str]:
        """Names of the components that live."""
        return frozenset(c.info.name for c in self.components if c.info.alive)

    def age_s(self, obj: ObjectLook) -> float | None:
        """Give how long ago the newest write of an object was true; None before the first."""
        return None if obj.t_data_ns is None else (self.now_ns - obj.t_data_ns) * 1e-9


def look(store: "Store") -> Look:
    """Look at a store now."""
    handles, unreadable = _objects(store)
    health = {obj.name: obj for obj in handles if obj.stored.name == HEALTH}
    components = tuple(
        ComponentLook(info=info, health=_health(health.get(f"{info.name}/health"))) for info in store.components()
    )
    objects = tuple(seen for obj in handles if (seen := _object(store, obj)) is not None)
    return Look(  # the time is read behind the writes: none of them is younger
        name=store.name or "private",
        host_ns=time.monotonic_ns(),
        now_ns=store.now_ns,
        t0_ns=store.t0_ns,
        cycle=store.cycle,
        tick_ns=store.tick_ns,
        clock=store.clock,
        memory=store.memory,
        components=components,
        objects=objects,
        unreadable=tuple(unreadable),
    )


def _objects(store: "Store") -> tuple[list[Object[Any]], list[str]]:
    """List the handles of all objects, deleted ones too, and why there is none of some."""
    found, unreadable = [], []
    for handle in store.core.entries():
        try:
            found.append(store.object_of(handle))
        except Deleted:  # its storage was given away while we looked
            continue
        except RtdbError as error:  # whoever inserted it is not of this version, or is wrong
            unreadable.append(str(error))
    return found, unreadable


def _object(store: "Store", obj: Object[Any]) -> ObjectLook | None:
    try:
        raw = store.core.object(obj.handle)
    except Deleted:
        return None
    head = raw[11]
    return ObjectLook(
        oid=obj.oid,
        name=obj.name,
        record=obj.stored.name,
        component=obj.component,
        parent=obj.parent,
        flags=obj.flags,
        every=obj.every,
        phase=obj.phase,
        head=head,
        refused=raw[12],
        t_data_ns=raw[18] if head else None,
        t_delete_ns=obj.t_delete_ns,
        commits_ns=_commits(store, obj, head),
    )


def _commits(store: "Store", obj: Object[Any], head: int) -> tuple[int, ...]:
    """Give the commit stamps of the newest writes, without reading what they say."""
    stamps = []
    for write in range(max(1, head - min(COMMITS, obj.n_slots - 2) + 1), head + 1):
        with contextlib.suppress(RtdbError):  # overwritten meanwhile, or not for us to read
            stamps.append(store.core.peek(obj.handle, write)[1])
    return tuple(stamps)


def _health(obj: Object[Any] | None) -> dict[str, Any] | None:
    with contextlib.suppress(RtdbError):  # its storage was given away while we looked
        sample = obj.latest() if obj is not None else None
        return sample.value if sample is not None else None
    return None
