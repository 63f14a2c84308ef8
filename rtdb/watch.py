"""Searching the directory, and watching a set of objects change."""

import contextlib
import fnmatch
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from .errors import Deleted, RecordError
from .objects import Object

if TYPE_CHECKING:
    from .store import Store


@dataclass(frozen=True, slots=True, kw_only=True)
class Query:
    """Which objects: all conditions that are given must hold."""

    pattern: str | None = None  # as in a shell: "gps/*"
    regex: str | None = None  # somewhere in the name
    record: str | None = None  # name of the record type
    parent: int | None = None  # object id
    creator: str | None = None  # component
    at_ns: int | None = None  # alive at that time of the store; None: now

    def compiled(self) -> Callable[[Object[Any]], bool]:
        """Make the test of one object."""
        glob = re.compile(fnmatch.translate(self.pattern)) if self.pattern is not None else None
        try:
            regex = re.compile(self.regex) if self.regex is not None else None
        except re.error as error:
            raise RecordError(f"cannot search for {self.regex!r}: {error}") from error

        def fits(obj: Object[Any]) -> bool:
            t_delete_ns = obj.t_delete_ns
            if self.at_ns is None:
                alive = t_delete_ns is None
            else:
                alive = obj.t_insert_ns <= self.at_ns and (t_delete_ns is None or self.at_ns < t_delete_ns)
            return (
                alive
                and (glob is None or glob.match(obj.name) is not None)
                and (regex is None or regex.search(obj.name) is not None)
                and (self.record is None or obj.schema.name == self.record)
                and (self.parent is None or obj.parent == self.parent)
                and (self.creator is None or obj.component == self.creator)
            )

        return fits


def search(store: "Store", query: Query) -> list[Object[Any]]:
    """Find the objects of a query, in the order of their insertion."""
    fits, found = query.compiled(), []
    for obj in store.entries():
        with contextlib.suppress(Deleted):  # its storage was given away while we looked
            if fits(obj):
                found.append(obj)
    return sorted(found, key=lambda obj: obj.oid)


class Watch:
    """A set of objects that is looked at again and again: `changes` says what came and went since the last call."""

    def __init__(self, store: "Store", query: Query) -> None:
        self._store, self._query = store, query
        self._known: dict[int, Object[Any]] = {}

    def changes(self, timeout_s: float = 0.0) -> tuple[list[Object[Any]], list[Object[Any]]]:
        """Give what was added and what was deleted since the last call, waiting for a change at most timeout_s.

        The first call gives what is there.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            version = self._store.core.version
            now = {obj.oid: obj for obj in search(self._store, self._query)}
            added = [obj for oid, obj in now.items() if oid not in self._known]
            deleted = [obj for oid, obj in self._known.items() if oid not in now]
            left_ns = int((deadline - time.monotonic()) * 1e9)
            if added or deleted or left_ns <= 0 or self._store.core.wait_directory(version, left_ns) is None:
                self._known = now
                return added, deleted
