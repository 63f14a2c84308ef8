"""Visiting a store by name, as the commands do: what is not there is answered with what was probably meant."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from ..errors import Deleted, ObjectMissing, StoreMissing
from .values import did_you_mean

if TYPE_CHECKING:
    from ..components import ComponentInfo
    from ..objects import Object
    from ..store import Store


@contextmanager
def visit(db: str) -> "Iterator[Store]":
    """Attach to a store, and let go of it in the end."""
    from ..store import Store

    try:
        store = Store.attach(db)
    except StoreMissing as error:
        from .segments import segments

        living = [s.name for s in segments() if s.lives and not s.half_made]
        raise StoreMissing(f"{error}" + (f"; {did_you_mean(db, living, 'there are')}" if living else "")) from error
    with store:
        yield store


def find(store: "Store", name: str, *, wait_s: float = 0.0, or_deleted: bool = False) -> "Object[Any]":
    """Find an object, waiting for it; or_deleted: also one that was deleted, as long as it is kept."""
    try:
        return store.find(name, timeout_s=wait_s)
    except (ObjectMissing, Deleted) as error:
        gone = deleted(store, name)
        if gone and or_deleted:
            return gone[-1]
        if gone:
            raise ObjectMissing(
                f"object {name!r} of store {store.name!r} was deleted; `fairway db history {name}` shows what it was, "
                f"`fairway db get {name} --at SECONDS` what it showed"
            ) from error
        known = [obj.name for obj in store.objects()]
        raise ObjectMissing(
            f"no object {name!r} in store {store.name!r}; {did_you_mean(name, known, 'it has')}"
        ) from error


def deleted(store: "Store", name: str) -> "list[Object[Any]]":
    """List the deleted objects of a name that are still kept, in the order of their insertion."""
    found = []
    for handle in store.core.entries():
        try:
            obj = store.object_of(handle)
            if obj.name == name and obj.t_delete_ns is not None:
                found.append(obj)
        except Deleted:
            continue
    return sorted(found, key=lambda obj: obj.oid)


def name_of(store: "Store", oid: int) -> str:
    """Give the name of an object by its id."""
    for handle in store.core.entries():
        try:
            obj = store.object_of(handle)
        except Deleted:
            continue
        if obj.oid == oid:
            return obj.name
    return f"object {oid}, which is gone"


def oldest_of(store: "Store", obj: "Object[Any]") -> str:
    """Say from when on there is data of an object."""
    found = obj.next(0)
    if found is None:
        return "nothing is there"
    t_s = (found[0].t_commit_ns - store.t0_ns) * 1e-9
    return f"the oldest that is there is write {found[0].write}, of {t_s:.3f} s"


def owner_of(store: "Store", component: str) -> "ComponentInfo":
    """Give the component of that name, living or dead."""
    return next(info for info in store.components() if info.name == component)
