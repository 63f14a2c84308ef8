"""Every new write of an object, through deaths of its writer and of the clock, until there can be no more."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from ..errors import AgedOut, ClockDead, Deleted
from .top import end_of

if TYPE_CHECKING:
    from ..objects import Object, Sample
    from ..store import Store

LOOK_S = 1.0  # how often we look whether the store is still there, while nothing comes


class Ended(Exception):
    """There will be no more writes; `status`: exit status of a command that waited for them."""

    def __init__(self, why: str, status: int) -> None:
        super().__init__(why)
        self.status = status


def writes(store: "Store", obj: "Object[Any]", timeout_s: float | None) -> "Iterator[tuple[Sample[Any], int]]":
    """Yield every write from now on, with the count of those lost before it; Ended says why there are no more."""
    newest, silent_s = obj.head, 0.0
    while True:
        slice_s = LOOK_S if timeout_s is None else min(LOOK_S, timeout_s - silent_s)
        try:
            for sample, lost in obj.updates(newest, slice_s):
                yield sample, lost
                newest, silent_s = sample.write, 0.0
        except AgedOut:  # overtaken while it was copied: it counts as lost before the next one
            continue
        except ClockDead:
            store.wait_cycle(store.cycle, slice_s)  # a standby may take over
        if _is_deleted(obj):
            again = "; there is a new one of that name" if _is_there(store, obj.name) else ""
            raise Ended(f"{obj.name} was deleted, after write {newest}{again}", 0)
        silent_s += slice_s
        if timeout_s is not None and silent_s >= timeout_s:
            raise Ended(f"{obj.name}: no write for {timeout_s:g} s; the newest is {newest}", 3)
        end = end_of(store)
        if end is not None:
            raise Ended(*end)


def _is_there(store: "Store", name: str) -> bool:
    return any(obj.name == name for obj in store.objects())


def _is_deleted(obj: "Object[Any]") -> bool:
    try:
        return obj.t_delete_ns is not None
    except Deleted:
        return True
