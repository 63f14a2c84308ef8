"""The service: tree, held stats and sessions of one file server, sans I/O: told of edges and of time, it answers."""

import os
from collections.abc import Callable, Iterable
from typing import Any

from ..clock import Kind
from ..store import Store
from .pace import Pace
from .policy import Limits, Tokens
from .seats import SeatSpec
from .session import Session
from .tree import Tree
from .waiting import Waiting

BINS = 20  # bin k counts from 2^k us


class Service:
    """Serves a store to sessions. Close it before the store.

    pace: edges of `/clock`, and of free files; grace_s: a stat of `/clock` is answered when the clock stands that long;
    patience_s: so long does a barrier wait for a seat; trace: called with a line for each message.
    """

    def __init__(
        self,
        store: Store,
        *,
        pace: Pace | None = None,
        seats: Iterable[SeatSpec] = (),
        tokens: Tokens | None = None,
        limits: Limits | None = None,
        trace: Callable[[str], None] | None = None,
        grace_s: float = 1.0,
        patience_s: float = 5.0,
    ) -> None:
        self.store, self.tokens, self.waiting = store, tokens or Tokens(), Waiting()
        self.tree = Tree(store, pace=pace, seats=seats, limits=limits, patience_s=patience_s)
        self.tree.report = self.report
        self._trace, self._grace_s = trace, grace_s
        self.sessions: set[Session] = set()
        self.cycle, self._edge_s = store.cycle, 0.0
        self._real = store.clock.kind is Kind.REAL
        self._heard_us, self._answered_us = [0] * BINS, [0] * BINS
        self._edges = self._skipped = self._requests = 0

    def begin(self, send: Callable[[bytes], None]) -> Session:
        """Begin a session, whose replies go to `send`."""
        session = Session(self.tree, self.waiting, self.tokens, send, trace=self._trace)
        self.sessions.add(session)
        return session

    def end(self, session: Session) -> None:
        """A connection is over: everything that it held goes."""
        if session in self.sessions:
            self.sessions.discard(session)
            self._requests += session.requests
        session.close()

    def edge(self, now_s: float) -> None:
        """Look whether a cycle has begun: answer who waits for it, then do what can wait."""
        cycle = self.store.cycle
        if cycle == self.cycle:
            return
        self._edges, self._skipped = self._edges + 1, self._skipped + cycle - self.cycle - 1
        is_edge = self.tree.pace.last(cycle) != self.tree.pace.last(self.cycle)
        self.cycle, self._edge_s = cycle, now_s
        edge_ns, waited = self.store.t0_ns + cycle * self.store.tick_ns, len(self.waiting)
        if self._real:
            _count(self._heard_us, self.store.now_ns - edge_ns)
        self.waiting.edge(cycle)
        if self._real and len(self.waiting) < waited:
            _count(self._answered_us, self.store.now_ns - edge_ns)
        self.tree.edge(cycle)
        for session in self.sessions if is_edge else ():
            session.edge()

    def look(self, now_s: float) -> None:
        """Look at what stands still, by the host's clock."""
        clock = self.store.clock
        slow_s = 2e-9 * clock.tick_ns if self._real else 0.0
        grace_s = max(self._grace_s, slow_s)
        begun = self.store.cycle > 0 or not self._real  # a run that gathers its parts does not stand
        if begun and len(self.waiting) and now_s - self._edge_s > grace_s:
            self.waiting.stopped(self.store.cycle, now_s - grace_s, participants=self._real or not clock.alive)
        for seat in self.tree.seats.values():
            seat.idle(now_s)

    def report(self) -> dict[str, Any]:
        """Say how it does: how late it heard of edges, and how late it had answered all who waited for them."""
        return {
            "pid": os.getpid(),
            "connections": len(self.sessions),
            "requests": self._requests + sum(session.requests for session in self.sessions),
            "waiting": len(self.waiting),
            "edges": self._edges,
            "edges_skipped": self._skipped,
            "heard_us": self._heard_us,
            "answered_us": self._answered_us,
            "missed_by_connection": sorted((s.missed for s in self.sessions if s.missed), reverse=True)[:16],
            "missed": {name: seat.missed for name, seat in self.tree.seats.items()},
            "refused": {name: seat.refused for name, seat in self.tree.seats.items() if seat.refused},
        }

    def close(self) -> None:
        """Leave the store."""
        for session in list(self.sessions):
            self.end(session)
        self.tree.close()


def _count(bins: list[int], ns: int) -> None:
    bins[min(BINS - 1, max(1, ns // 1000).bit_length() - 1)] += 1
