"""What the tests of the store share: unique names, peers in other processes, a look at what is left in memory."""

import os
import select
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Annotated

import pytest

import rtdb
from rtdb import Record, Store
from rtdb.records import array, i64

LONG_S = 30.0  # a wait that is never waited out when all is well

_numbers = count()
_PEER = Path(__file__).parent / "helpers" / "peer.py"


class Count(Record):
    """A counter."""

    n: Annotated[int, i64("", "number")] = 0


class Words(Record):
    """Many numbers, which a test writes all alike: where they differ, the value is torn."""

    words: Annotated[tuple[int, ...], array("i64", 64, "", "numbers")] = (0,) * 64


def count_to(store: Store, writer: rtdb.Writer[Count], last: int) -> None:
    """Write c in each cycle c - 1, so that the cut of c shows c."""
    for c in range(store.cycle + 1, last + 1):
        writer.write(Count(c))
        store.tick()


def shown(cut: rtdb.Cut, obj: rtdb.Object[Count]) -> int | None:
    """The number that a cut shows of an object, None for nothing."""
    sample = cut.get(obj)
    return None if sample is None else sample.value.n


def segment_path(name: str) -> Path:
    """Where a shared store of that name lies."""
    return Path(f"/dev/shm/fairway-{os.getuid()}-{name}")


class Peer:
    """Another process that runs statements for a test, one at a time."""

    def __init__(self) -> None:
        path = os.pathsep.join([str(Path(rtdb.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
        self.process = subprocess.Popen(
            [sys.executable, str(_PEER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": path},
        )

    def send(self, statement: str) -> None:
        """Have it start a statement; `answer` takes the result."""
        self.process.stdin.write(repr(statement) + "\n")
        self.process.stdin.flush()

    def answer(self) -> str:
        """Wait for the result: the repr of a value, or "!Kind: message" of an exception."""
        if not self.has_answered(2 * LONG_S):
            raise TimeoutError("the other process waits for ever")
        return self.process.stdout.readline().rstrip("\n")

    def has_answered(self, within_s: float = 0.0) -> bool:
        """Whether `answer` would return at once."""
        return bool(select.select([self.process.stdout], [], [], within_s)[0])

    def __call__(self, statement: str) -> str:
        self.send(statement)
        return self.answer()

    def until_it_waits(self) -> None:
        """Return when the process sleeps on a futex, as it does inside the store's wait calls (or has answered)."""
        while not self.has_answered():
            number = Path(f"/proc/{self.process.pid}/syscall").read_text().split()[0]
            if number == "202":  # futex on x86-64
                return
            os.sched_yield()

    def kill(self) -> None:
        """Kill it at once and wait until it is gone."""
        self.process.kill()
        self.process.wait()

    def interrupt(self) -> None:
        """Press its Ctrl-C."""
        self.process.send_signal(signal.SIGINT)

    def stop(self) -> None:
        """Stop it, clock and all, until `go`."""
        self.process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, self.process.pid, os.WSTOPPED)

    def go(self) -> None:
        """Let it go on."""
        self.process.send_signal(signal.SIGCONT)

    def close(self) -> None:
        """End it."""
        self.kill()
        self.process.stdin.close()
        self.process.stdout.close()


@pytest.fixture
def unique() -> Iterator[Callable[[], str]]:
    """Names of stores that nobody else uses; what is left of them after the test is an error."""
    names: list[str] = []

    def make() -> str:
        names.append(f"test-{os.getpid()}-{next(_numbers)}")
        return names[-1]

    yield make
    left = [path for name in names for path in segment_path(name).parent.glob(segment_path(name).name + "*")]
    for path in left:
        path.unlink()
    assert not left, f"left behind: {left}"


@pytest.fixture
def peer() -> Iterator[Callable[[], Peer]]:
    """Starts other processes, and ends them."""
    peers: list[Peer] = []

    def start() -> Peer:
        peers.append(Peer())
        return peers[-1]

    yield start
    for one in peers:
        one.close()


@pytest.fixture
def name(unique: Callable[[], str]) -> str:
    """The name of a store that nobody else uses."""
    return unique()


@pytest.fixture
def shared(name: str) -> Iterator[Store]:
    """A shared stepped store with ticks of 10 ms, whose clock the test holds."""
    with Store.create(name) as made:
        yield made


@pytest.fixture
def attached(peer: Callable[[], Peer], name: str) -> Callable[[], Peer]:
    """Starts processes that are attached, as `store`, to the store that the test made under `name`."""

    def start() -> Peer:
        one = peer()
        assert one(f"store = Store.attach({name!r})") == "None"
        return one

    return start


@pytest.fixture(params=["private", "shared"])
def store(request: pytest.FixtureRequest, unique: Callable[[], str]) -> Iterator[Store]:
    """A store of either sort, with ticks of 10 ms."""
    with Store.create(unique() if request.param == "shared" else None) as made:
        yield made
