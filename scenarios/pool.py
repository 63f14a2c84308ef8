"""Pool: calls spread over worker processes, one after the other in each. A worker that dies takes only its call along.

Workers are spawned, not forked: a simulator with threads and C libraries inside does not survive a fork. A worker ends
when its pipe does, so nothing is left when this process is killed.
"""

import contextlib
import multiprocessing
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING, Any, Generic, TypeVar

if TYPE_CHECKING:
    from multiprocessing.context import SpawnProcess

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class Lost:
    """Why a call has no result: its process died, or it took too long."""

    reason: str


@dataclass(slots=True)
class _Worker(Generic[T]):
    process: "SpawnProcess"
    pipe: Connection
    call: int | None = None
    until_s: float = 0.0

    def give(self, k: int, item: T, limit_s: float) -> None:
        with contextlib.suppress(BrokenPipeError):  # then it is dead, and its answer is the end of the pipe
            self.pipe.send(item)
        self.call, self.until_s = k, time.monotonic() + limit_s


def spread(
    call: Callable[[T], R], items: Sequence[T], jobs: int, limit_s: Callable[[T], float]
) -> Iterator[tuple[int, R | Lost]]:
    """Call with every item in at most `jobs` processes; yields (index, result or why there is none) as they come.

    `call` must be a function of a module and must not raise; `limit_s`: wall time after which a call is given up.
    """
    left = list(range(len(items)))
    workers: list[_Worker[T]] = []
    try:
        while left or workers:
            while left and len(workers) < jobs:
                worker: _Worker[T] = _start(call)
                workers.append(worker)
                k = left.pop(0)
                worker.give(k, items[k], limit_s(items[k]))
            ready = wait([w.pipe for w in workers], timeout=min(w.until_s for w in workers) - time.monotonic())
            for worker in list(workers):
                if worker.pipe not in ready and time.monotonic() < worker.until_s:
                    continue
                assert worker.call is not None
                done = worker.call
                outcome = (
                    _take(worker, limit_s(items[done]))
                    if worker.pipe in ready
                    else _give_up(worker, limit_s(items[done]))
                )
                if isinstance(outcome, Lost) or not left:
                    _end(worker)
                    workers.remove(worker)
                else:
                    k = left.pop(0)
                    worker.give(k, items[k], limit_s(items[k]))
                yield done, outcome
    finally:
        for worker in workers:
            worker.process.kill()
            _end(worker)


def _start(call: Callable[[T], R]) -> "_Worker[T]":
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs, call), daemon=True)
    process.start()
    theirs.close()
    return _Worker(process, ours)


def _serve(pipe: Connection, call: Callable[[Any], Any]) -> None:
    """Answer calls until the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ctrl-C is for the process that gives out the work
    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            pipe.send(call(pipe.recv()))


def _take(worker: "_Worker[T]", limit_s: float) -> Any:
    try:
        return worker.pipe.recv()
    except (EOFError, ConnectionResetError):
        worker.process.join(10.0)
        code = worker.process.exitcode
        how = f"by signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"with status {code}"
        return Lost(f"its process ended {how}")


def _give_up(worker: "_Worker[T]", limit_s: float) -> Lost:
    worker.process.kill()
    return Lost(f"no result after {limit_s:.0f} s; its process was ended")


def _end(worker: "_Worker[T]") -> None:
    worker.pipe.close()
    worker.process.join(5.0)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()
