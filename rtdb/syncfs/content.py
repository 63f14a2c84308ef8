"""Contents of files as objects of the store: any number of bytes, a revision per write, seen through cuts.

An object has slots of one size, and so many; a file grows, and may be written often. So a file's content is a row of
objects, `files/1`, `files/2`, ...: what a cut shows is that of the youngest that shows anything. A larger revision, or
one more in a cycle than a ring holds, begins a new one, and an older one goes when the one behind it is seen.
"""

import contextlib
import functools
import struct
from collections.abc import Callable

from ..components import Component
from ..errors import AgedOut, Deleted, ObjectMissing, StoreFull, TooFast
from ..layout import Field, Spec
from ..objects import HOST_DEPENDENT, Writer
from ..records import Record, Schema
from ..store import Store
from .pace import Pace

RING_BYTES = 8 << 10  # of a file's slots, as long as that is enough for a few
LEAST_SLOTS, MOST_SLOTS = 6, 24
LEAST_BYTES = 256
SHARE = 0.5  # of the store's memory is for free files, at most: components need the rest
KEPT = 1000  # so many handles of deleted objects are not looked through
_COUNT = struct.Struct("<I")


@functools.cache
def schema_for(n_bytes: int) -> Schema:
    """Give the schema of contents of at most n bytes."""
    return Schema("File", "A revision of a file.", [Field("data", Spec("u8", "", "its content", n_bytes, "seq"), 1)])


def room_for(n_bytes: int) -> int:
    """Give the size of the slots in which a content goes: the next power of two."""
    return max(LEAST_BYTES, 1 << (n_bytes - 1).bit_length()) if n_bytes else LEAST_BYTES


def slots_for(room: int) -> int:
    """Give how many revisions a file's ring holds."""
    return min(MOST_SLOTS, max(LEAST_SLOTS, RING_BYTES // (room + 64)))


class Content:
    """What one file holds. Revisions are written to the store at once; each shows from the next edge on."""

    __slots__ = ("_files", "_overflows", "_seen", "_slots", "held", "newest", "numbers", "rooms")

    def __init__(self, files: "Contents", numbers: list[int] | None = None, *, overflows: bool = True) -> None:
        self._files, self._overflows = files, overflows  # into another object, when the ring is full for a cycle
        self.numbers: list[int] = numbers or []  # of its objects, oldest first
        self.rooms = [files.room(k) for k in self.numbers]
        self._slots = 0  # of the youngest
        self._seen: tuple[int, int, bytes, int] = (0, 0, b"", 0)  # the revision that was looked at last
        self.newest = b""  # the newest revision, whether it shows already or not
        self.held = False  # it is not in the store yet: there were more revisions in this cycle than a ring holds

    def write(self, data: bytes) -> None:
        """Write a revision. StoreFull where there is no room; the one before stands then."""
        if not self.numbers or len(data) > self.rooms[-1]:
            self.grow(len(data))
        self.newest = data
        self.held = not self._written(data) and not self._written_anew(data)
        if self.held:
            self._files.busy.add(self)

    def grow(self, n_bytes: int, slots: int = 0) -> None:
        """Begin an object with room for a revision. StoreFull where there is none."""
        self.trim()
        room = room_for(n_bytes)
        slots = max(slots, slots_for(room))
        self.numbers.append(self._files.insert(room, slots))
        self.rooms.append(schema_for(room).size - _COUNT.size)  # a record ends at a multiple of 8
        self._slots = slots
        self._files.busy.add(self)

    def trim(self) -> None:
        """Give back the youngest object, if nothing was ever written to it: room for a revision that did not come."""
        with contextlib.suppress(Deleted, ObjectMissing):
            if len(self.numbers) > 1 and not self._files.store.core.object(self._files.handle(self.numbers[-1]))[11]:
                self._files.delete(self.numbers.pop())
                self.rooms.pop()

    def _written_anew(self, data: bytes) -> bool:
        """Write into a new object, with more slots: the ring is full for this cycle."""
        if not self._overflows:
            return False
        try:
            self.grow(len(data), 2 * self._slots)
        except StoreFull:
            return False
        return self._written(data)

    def _written(self, data: bytes) -> bool:
        core, handle = self._files.store.core, self._files.handle(self.numbers[-1])
        payload = _COUNT.pack(len(data)) + data.ljust(self.rooms[-1], b"\0")
        try:
            core.write(handle, payload, core.not_before(handle, core.now_ns), ())
        except TooFast:
            return False
        return True

    def read(self, cycle: int) -> tuple[bytes, int]:
        """Give what a cut shows, and the time of its writing; empty and 0 before the first revision."""
        core, gone = self._files.store.core, False
        for number in reversed(self.numbers):
            try:
                handle = self._files.handle(number)
                write = core.visible_write(handle, cycle)
                if write and (number, write) != self._seen[:2]:
                    raw = core.read(handle, write)
                    (count,) = _COUNT.unpack_from(raw[0])
                    self._seen = number, write, raw[0][_COUNT.size : _COUNT.size + count], raw[2]
            except (Deleted, ObjectMissing):
                gone = True
                continue
            if write:
                return self._seen[2:]
        if gone:
            raise AgedOut("the history of this file does not reach back so far")
        return b"", 0

    def follow(self, before: "Content") -> None:
        """Take another file's place: what that one held shows until an edge shows what is here."""
        if not self.numbers:
            self.write(b"")
        before.trim()
        self.numbers[:0], self.rooms[:0] = before.numbers, before.rooms
        before.numbers, before.rooms, before.held = [], [], False
        self._files.busy.discard(before)
        self._files.busy.add(self)

    def take_newest(self) -> None:
        """Take up the newest revision that a server before us wrote, seen or not."""
        core = self._files.store.core
        for number in reversed(self.numbers):
            with contextlib.suppress(Deleted, ObjectMissing):
                handle = self._files.handle(number)
                head = core.object(handle)[11]
                if head:
                    data = core.read(handle, head)[0]
                    (count,) = _COUNT.unpack_from(data)
                    self.newest = data[_COUNT.size : _COUNT.size + count]
                    return

    def edge(self, cycle: int) -> bool:
        """Write what is held, and drop objects that have been followed by a larger one; False when all is done."""
        if self.held:
            self.held = not self._written(self.newest)
        seen = next((k for k in range(len(self.numbers) - 1, 0, -1) if self._shows(self.numbers[k], cycle)), 0)
        for number in self.numbers[:seen]:
            self._files.delete(number)
        del self.numbers[:seen], self.rooms[:seen]
        return self.held or len(self.numbers) > 1

    def _shows(self, number: int, cycle: int) -> bool:
        with contextlib.suppress(Deleted, ObjectMissing):
            return bool(self._files.store.core.visible_write(self._files.handle(number), cycle))
        return False

    def drop(self) -> None:
        """Delete the file's objects; what they held stays readable for a while, for `/at`."""
        for number in self.numbers:
            self._files.delete(number)
        self.numbers.clear()
        self.rooms.clear()
        self.held = False


class Budget:
    """How much of a store's memory free files take, and may."""

    def __init__(self, store: Store) -> None:
        self.used, self.most = 0, int(store.memory[0] * SHARE)


def ring_bytes(room: int, slots: int) -> int:
    """Give the bytes that an object takes, about."""
    return slots * (room + 128)


class Contents:
    """The objects that hold contents, all of one component; numbered, and never again under the same number."""

    def __init__(
        self,
        store: Store,
        component: Component,
        pace: Pace,
        prefix: str,
        budget: Budget,
        changed: Callable[[int], None],
    ) -> None:
        self._budget = budget
        self.store, self._component, self._pace, self._prefix = store, component, pace, f"{component.name}/{prefix}"
        self._changed = changed  # called with the version of the directory before each change
        self.busy: set[Content] = set()  # those for which the next edge has work
        there = {int(o.name[len(self._prefix) :]): o for o in store.objects(f"{self._prefix}[0-9]*")}
        self._handles = {number: obj.handle for number, obj in there.items()}
        self._sizes = {number: ring_bytes(obj.size, obj.n_slots) for number, obj in there.items()}  # of those that live
        budget.used += sum(self._sizes.values())
        self.last = max(self._handles, default=0)

    def handle(self, number: int) -> int:
        """Give the handle of an object, of a deleted one too as long as its history may be there."""
        handle = self._handles.get(number)
        if handle is None:
            raise ObjectMissing(f"{self._prefix}{number} is not kept any more")
        return handle

    def room(self, number: int) -> int:
        """Give the bytes that an object's slots hold; 0 for one that is gone."""
        with contextlib.suppress(Deleted, ObjectMissing):
            return self.store.core.object(self.handle(number))[4] - _COUNT.size
        return 0

    def insert(self, room: int, slots: int) -> int:
        """Insert an object; returns its number."""
        number, period_s, before = self.last + 1, self._pace.every * self.store.tick_ns * 1e-9, self.store.core.version
        size = ring_bytes(room, slots)
        if self._budget.used + size > self._budget.most:
            raise StoreFull(f"free files take at most {SHARE:.0%} of the store")
        writer: Writer[Record] = self._component.insert(
            f"{self._prefix.partition('/')[2]}{number}",
            schema_for(room),
            every=self._pace.every,
            phase=self._pace.phase,
            history_s=slots * period_s,
            budget_bytes=size,
            flags=HOST_DEPENDENT,
        )
        self.last, self._handles[number] = number, writer.handle
        self._sizes[number] = size
        self._budget.used += size
        self._changed(before)
        return number

    def delete(self, number: int) -> None:
        """Delete an object; its history stays for a while."""
        before = self.store.core.version
        self._budget.used -= self._sizes.pop(number, 0)
        with contextlib.suppress(Deleted, ObjectMissing):
            self.store.core.delete(self.handle(number))
            self._changed(before)
        if len(self._handles) > 2 * len(self._sizes) + KEPT:
            self._forget_gone()

    def _forget_gone(self) -> None:
        """Drop the handles of objects whose history is over, too."""
        for number, handle in list(self._handles.items()):
            try:
                self.store.core.object(handle)
            except Deleted:
                del self._handles[number]

    def edge(self, cycle: int) -> None:
        """Do what waited for an edge."""
        for content in list(self.busy):
            if not content.edge(cycle):
                self.busy.discard(content)

    def fits(self, n_bytes: int) -> bool:
        """Say whether a first revision of that size finds room for sure."""
        room = room_for(n_bytes)
        size = ring_bytes(room, slots_for(room))
        return self._budget.used + size <= self._budget.most and size < self.store.memory[1]

    def known(self) -> list[int]:
        """Give the numbers of the objects that are there."""
        return list(self._handles)
