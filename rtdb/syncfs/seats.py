"""Seats: components without a module. Whoever attaches with its token is the component, in whatever language.

A seat joins the store with the first attach and leaves with the last connection, or when a barrier has waited for it
too long. What it writes is the JSON object `<component>/status`, which names what it had read as its causes; JSON that
is none stays out, the last good one stands, and the component's health says so. Readers apply their own rules of age
and range.
"""

import errno
import logging
import time
from dataclasses import dataclass, field
from typing import Any

from ..clock import Kind
from ..components import Component, State
from ..errors import RecordError, TooFast
from ..json_object import json_payload, json_schema
from ..objects import HOST_DEPENDENT, Flag, Writer
from ..store import Store
from .errors import FsError
from .pace import Pace

Causes = tuple[tuple[int, int], ...]
log = logging.getLogger(__name__)
HISTORY_S = 2.0
CONFIG_BYTES = 2000
CAUSES = 8  # that a status names, at most: what was read last
SLOWEST_S = 0.5  # between its edges: it sees the cut of its last one, and histories are short
SILENT_EDGES = 3  # without a status, before its health says so
OWN = ("config", "status", "health")  # its objects


@dataclass(frozen=True, slots=True, kw_only=True)
class SeatSpec:
    """A component that may be taken through files.

    every, phase: when it is due; latency_cycles: so many ticks after the next one does its status show, every - 1 for
    the next edge of its own clock; config: its wiring as a script finds it, if nobody wrote another.
    """

    component: str
    every: int = 10
    phase: int = 0
    latency_cycles: int = 9
    status_bytes: int = 4000
    config: dict[str, Any] = field(default_factory=dict)


class Seat:
    """One such component."""

    def __init__(self, store: Store, spec: SeatSpec, patience_s: float) -> None:
        period_s = spec.every * store.tick_ns * 1e-9
        if period_s > SLOWEST_S:
            raise FsError(
                errno.EINVAL,
                f"{spec.component}: an edge every {period_s:g} s is too seldom: what others show is not kept so long; "
                f"at most every {int(SLOWEST_S * 1e9) // store.tick_ns} ticks, {SLOWEST_S:g} s",
            )
        self._store, self.spec, self._patience_s = store, spec, patience_s
        self.pace = Pace(spec.every, spec.phase)
        self._component: Component | None = None
        self._status: Writer[Any] | None = None
        self._users: set[object] = set()
        self._said = (State.UNKNOWN, "")
        self._begun: int | None = None  # the cycle for which it was woken
        self._came = False  # it has waited for its clock, so it knows how
        self._waiting = 0  # stats of its clock that are held
        self._since_s = 0.0  # when it was woken, by the host's clock
        self._wrote, self.refused, self.missed = 0, 0, 0
        self._held: tuple[bytes, Causes] | None = None
        self._read: dict[int, int] = {}  # what it read last: the writes by object
        self._told = False  # a status came from that

    def sit(self, user: object) -> None:
        """A connection attaches as this component. InUse if a process of its own is it."""
        self._users.add(user)
        try:
            self._join()
        except BaseException:
            self._users.discard(user)
            raise

    def _join(self) -> None:
        if self._component is not None:
            return
        spec, store = self.spec, self._store
        component = store.join(spec.component, participant=True, every=spec.every, phase=spec.phase, version="files")
        try:
            config: Writer[Any] = component.insert(
                "config", json_schema(CONFIG_BYTES), flags=Flag.PUBLIC_WRITE | HOST_DEPENDENT, history_s=0.1
            )
            if not config.head:
                config.write(spec.config, store.now_ns)
            self._status = component.insert(
                "status",
                json_schema(spec.status_bytes),
                n_causes=CAUSES,
                every=spec.every,
                phase=(spec.phase + 1 + spec.latency_cycles) % spec.every,
                history_s=HISTORY_S,
            )
        except BaseException:
            component.leave()
            raise
        for obj in store.objects(f"{spec.component}/*"):  # what a module left that was it before
            if obj.name.partition("/")[2] not in OWN:
                store.delete(obj)
        self._component, self._begun, self._waiting = component, None, 0
        self._read.clear()
        self._since_s, self._wrote = time.monotonic(), store.cycle
        self._said = (State.UNKNOWN, "")
        self._say(State.RUNNING, "attached")

    def rise(self, user: object) -> None:
        """A connection is over."""
        if user in self._users:
            self._users.discard(user)
            if not self._users:
                self._came = False
                log.warning("%s left: its connection ended in cycle %d", self.spec.component, self._store.cycle)
                self._leave(f"its connection ended in cycle {self._store.cycle}")

    def _leave(self, why: str) -> None:
        if self._component is not None:
            if self._held is not None:
                self._write(*self._held)
            was, text = self._said
            self._say(State.FAILURE, f"{why}; {text}" if was is State.WARNING else why)
            self._component.leave()
            self._component = self._status = self._held = None

    # -- what it does ---------------------------------------------------------------------------------------------

    def has_read(self, sources: list[tuple[int, int]]) -> None:
        """Note what it read: its status comes from what it read before it, since the status before that."""
        if self._told:
            self._read.clear()
            self._told = False
        for oid, write in sources:
            self._read.pop(oid, None)  # the last of them stand last
            self._read[oid] = write

    def commit(self, data: bytes) -> None:
        """Take what it wrote as its status; RecordError if that is no JSON object."""
        self._join()
        assert self._status is not None
        try:
            payload = json_payload(data, self._status.size)
        except RecordError as error:
            self.refused += 1
            self._say(State.WARNING, f"status refused ({self.refused} so far): {error}")
            raise
        self._write(payload, tuple(self._read.items())[-CAUSES:])
        self._told, self._wrote = True, self._store.cycle
        self._say(State.RUNNING, "")

    def _write(self, payload: bytes, causes: Causes) -> None:
        assert self._status is not None
        core, handle = self._store.core, self._status.handle
        try:
            core.write(handle, payload, core.not_before(handle, core.now_ns), causes)
            self._held = None
        except TooFast:  # more in this cycle than the ring holds: the newest follows at the edge
            self._held = payload, causes

    def stat(self) -> None:
        """It waits in a stat of its clock: it has done what it was woken for."""
        self._join()
        assert self._component is not None
        due = self.pace.last(self._store.cycle)
        if self._begun is not None and due > self._begun:
            self.missed += (due - self._begun) // self.spec.every
        self._component.done(due if self._begun is None else self._begun)
        self._came, self._waiting = True, self._waiting + 1

    def wake(self, cycle: int) -> None:
        """Its stat is answered."""
        self._begun = self.pace.last(cycle)
        self.give_up()

    def give_up(self) -> None:
        """A stat of it is held no longer: whatever it is doing now, it does not wait."""
        self._waiting, self._since_s = max(0, self._waiting - 1), time.monotonic()

    # -- what is seen of it ---------------------------------------------------------------------------------------

    def edge(self, cycle: int) -> None:
        """Look at it once per cycle of the store."""
        if self._component is None:
            return
        if self._held is not None:
            self._write(*self._held)
        if cycle - self._wrote > SILENT_EDGES * self.spec.every and self._said[0] is not State.WARNING:
            self._say(State.WARNING, f"silent since cycle {self._wrote}")

    def idle(self, now_s: float) -> None:
        """Look at it by the host's clock: a barrier does not wait for ever."""
        if self._component is None or not self._came or self._waiting or self._store.clock.kind is Kind.REAL:
            return  # who has not begun is waited for: people type slowly
        if now_s - self._since_s > self._patience_s:
            cycle = self._store.cycle
            log.warning("%s did not come back for %g s in cycle %d", self.spec.component, self._patience_s, cycle)
            self._leave(f"did not come back for {self._patience_s:g} s in cycle {cycle}")

    def _say(self, state: State, text: str) -> None:
        if (state, text) != self._said and self._component is not None:
            self._said = state, text
            self._component.status(text.encode()[:160].decode(errors="ignore"), state)

    def close(self) -> None:
        """The server ends."""
        self._leave(f"the file server ended in cycle {self._store.cycle}")
