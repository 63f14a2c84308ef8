"""Components: who writes. A process becomes one, owns its objects, and keeps its pace."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, TypeVar

from .errors import ClockDead, Deleted, ObjectMissing, RecordError
from .objects import Flag, Object, Writer
from .records import Record, Schema, schema_of

if TYPE_CHECKING:
    from .store import Cut, Store

R = TypeVar("R", bound=Record)
MAX_SLOTS = 1 << 24  # as in fw_insert
REPLACE = 1 << 31  # as FW_REPLACE in fw_layout.h: what a predecessor left goes, if the new object fits
MIN_SLOTS = 4  # two cuts, the newest write, the one under construction


class State(IntEnum):
    """How a component says that it is."""

    UNKNOWN = 0
    RUNNING = 1
    WAITING = 2
    WARNING = 3
    FAILURE = 4


@dataclass(frozen=True, slots=True)
class ComponentInfo:
    """A component as the directory knows it.

    `alive`: a process holds its lock; `done`: newest cycle it finished; `missed`: due cycles that a real-time clock
    ended without it.
    """

    name: str
    pid: int
    alive: bool
    done: int
    participant: bool
    missed: int
    version: str
    every: int
    phase: int


class Component:
    """A component that this process is. Leaving (or dying) lets another process take its objects over."""

    def __init__(self, store: "Store", index: int, name: str) -> None:
        self._store, self.index, self.name = store, index, name

    def insert(
        self,
        name: str,
        cls: type[R] | Schema,
        *,
        every: int = 1,
        phase: int = 0,
        history_s: float = 2.0,
        hold_s: float = 0.0,
        budget_bytes: int | None = None,
        flags: int = 0,
        n_causes: int = 0,
        parent: Object[Record] | None = None,
        min_cycle_s: float = 0.0,
        max_age_s: float = 0.0,
    ) -> Writer[R]:
        """Insert the object `<component>/<name>`, or take it over from a predecessor.

        every, phase: due at ticks c with c % every == phase. history_s: for how long reads reach back when the owner
        writes once per edge, less if budget_bytes allows less, but never less than hold_s (for frames that are looked
        at in place). An object of the same name that a predecessor left is taken over if all of this is the same; if
        not, it is deleted and a new one inserted.
        """
        full, core = f"{self.name}/{name}", self._store.core
        schema = cls if isinstance(cls, Schema) else schema_of(cls)
        if every < 1:
            raise RecordError(f"cannot insert {full}: every={every} is not a number of ticks")
        if parent is not None and parent.t_delete_ns is not None:
            raise Deleted(f"cannot insert {full}: its parent {parent.name} was deleted")
        n_slots = slots_for(full, schema.size, every * core.tick_ns * 1e-9, history_s, hold_s, budget_bytes)
        spec = (
            core.add_schema(schema.to_text()),
            schema.size,
            n_slots,
            every,
            phase % every,
            int(flags),
            n_causes,
            parent.oid if parent is not None else 0,
        )
        period_ns = every * core.tick_ns
        times = (
            round(history_s * 1e9) or n_slots * period_ns,
            round(min_cycle_s * 1e9) or period_ns,
            round(max_age_s * 1e9),
        )
        handle = self._take_over(full, (*spec, *times))
        if handle is None:
            spec = (*spec[:5], spec[5] | REPLACE, *spec[6:])
            handle = core.insert(full, self.index, *spec, *times)
        return Writer(self._store, handle, None if isinstance(cls, Schema) else cls)

    def _take_over(self, full: str, spec: tuple[int, ...]) -> int | None:
        """Give the handle of what a predecessor left, if it is the same."""
        core = self._store.core
        try:
            handle = core.find(full)
            left = core.object(handle)
        except (ObjectMissing, Deleted):
            return None
        if left[2] == self.index and left[3:11] + left[15:18] == spec:
            return handle
        return None

    def cycles(self, timeout_s: float = 1.0) -> Iterator["Cut"]:
        """Yield the cut of each cycle at which the component is due; what the body did counts as done behind it.

        A cycle that it slept through is left out. Raises ClockDead when nobody ticks for timeout_s.
        """
        core = self._store.core
        while True:
            cycle = core.step(self.index, int(timeout_s * 1e9))
            if cycle is None:
                if not core.clock_state()[1]:
                    raise ClockDead(f"no tick for {timeout_s:g} s, and nobody holds the clock; start one, or a standby")
                continue
            yield self._store.at_cycle(cycle)
            core.done(self.index, cycle)

    def done(self, cycle: int) -> None:
        """Say that this component has finished a cycle."""
        self._store.core.done(self.index, cycle)

    def status(self, text: str, state: State = State.RUNNING) -> None:
        """Say how it is going, in `<component>/health`: at most 160 bytes. Shared stores only."""
        self._store.core.status(self.index, int(state), text)

    def leave(self) -> None:
        """Stop being this component; its objects stay readable, and wait for a successor."""
        self._store.core.leave(self.index)


def slots_for(name: str, size: int, period_s: float, history_s: float, hold_s: float, budget_bytes: int | None) -> int:
    """Decide how many slots a ring needs for its history, within a budget, but for what it must hold in any case."""
    wanted = int(max(history_s, hold_s) / period_s) + MIN_SLOTS
    if not MIN_SLOTS <= wanted <= MAX_SLOTS:
        raise RecordError(f"cannot insert {name}: history_s={history_s} is {wanted} slots, at most {MAX_SLOTS}")
    if budget_bytes is None:
        return wanted
    least, room = math.ceil(hold_s / period_s) + MIN_SLOTS, budget_bytes // (size + 64)
    if room < least:
        raise RecordError(
            f"cannot insert {name}: budget_bytes={budget_bytes} is {room} slots of {size} bytes, and hold_s={hold_s} "
            f"needs {least}; raise the budget or hold for less"
        )
    return min(wanted, room)


def flag_names(flags: int) -> str:
    """Name the flags of an object."""
    return ", ".join(flag.name.lower().replace("_", " ") for flag in Flag if flags & flag and flag.name)
