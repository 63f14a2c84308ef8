"""One write of 64 bytes that wakes a reader in another Python process: the store, and what else does that.

    python benchmarks/peers.py [--rounds 4] [--pings 300]

Each through its usual Python interface: the reader sleeps until there is something, takes the 64 bytes and says when.
Writer and reader are held on two cores: a wake-up on the waker's own core takes a fifth of the time, and where the
system puts a process is chance. `rtdb.py` prints the same as rows of its table. Where a peer is not installed, a row
says so: `pip install msgq-ipc iceoryx2 pyzmq` (the `msgq` of the package index is another program).
"""

import argparse
import contextlib
import ctypes
import multiprocessing
import os
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Annotated, Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # `rtdb` is the package, not the file beside this one

from rtdb import Record, Store
from rtdb.records import array

PACE_S = 0.0002  # between two pings, as in rtdb_core.c: by then the reader sleeps
PATIENCE_NS = 2_000_000_000
FORK = multiprocessing.get_context("fork")
HEARD, STOP = range(2)  # words of a page


class Lost(Exception):
    """A reader did not hear a write."""


class Bytes64(Record):
    """Sixty-four bytes."""

    words: Annotated[tuple[int, ...], array("i64", 8, "", "anything")] = (0,) * 8


def shared_page() -> memoryview:
    """Give 64-bit words that children forked from now on share."""
    import mmap

    return memoryview(mmap.mmap(-1, mmap.PAGESIZE)).cast("q")


@contextlib.contextmanager
def on_cores(cores: set[int]) -> Iterator[None]:
    """Hold this process, and what is begun in it, on some cores."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def child(work: Callable[..., None], *args: Any) -> BaseProcess:
    """Run a function in a forked process that does not outlive this one, however this one ends."""

    def run() -> None:
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        with contextlib.suppress(KeyboardInterrupt):
            work(*args)

    process = FORK.Process(target=run, daemon=True)
    process.start()
    return process


def wait_until(ready: Callable[[], Any], what: str) -> None:
    """Look every millisecond, for five seconds."""
    deadline = time.monotonic() + 5.0
    while not ready():
        if time.monotonic() > deadline:
            raise Lost(f"{what}: nothing in 5 s")
        time.sleep(0.001)


def ping(send: Callable[[], object], page: memoryview, n: int, pace_s: float) -> list[float]:
    """Send n times to a reader that sleeps; microseconds until it says that it heard."""
    now, took = time.monotonic_ns, []
    for _ in range(n):
        time.sleep(pace_s)
        page[HEARD] = 0
        sent = now()
        send()
        while not page[HEARD]:
            time.sleep(PACE_S)
            if now() - sent > PATIENCE_NS:
                raise Lost("a ping was not heard in 2 s")
        took.append((page[HEARD] - sent) / 1000)
    return took


# -- each peer: what the reader does for ever, and what gives the writer its `send` -----------------------------------

Hear = Callable[[], None]  # notes when
Stopped = Callable[[], bool]
Send = Callable[[], object]
Reader = Callable[[str, Hear, Stopped], None]
Writer = Callable[[str], contextlib.AbstractContextManager[Send]]


def store_reader(name: str, hear: Hear, stopped: Stopped) -> None:
    with Store.attach(name, timeout_s=5.0) as store:
        obj = store.find("bench/small", timeout_s=5.0)
        core, write = store.core, obj.head
        while not stopped():
            write = obj.wait(write, 1.0) or write
            if len(core.read(obj.handle, write)[0]) == 64:
                hear()


@contextlib.contextmanager
def store_writer(name: str) -> Iterator[Send]:
    with Store.create(name) as store:
        writer = store.join("bench").insert("small", Bytes64, history_s=40.0)
        core, handle, payload = store.core, writer.handle, bytes(64)

        def send() -> None:
            core.write(handle, payload, 0, ())

        yield send


def zmq_reader(name: str, hear: Hear, stopped: Stopped) -> None:
    import zmq

    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.connect(f"ipc://{tempfile.gettempdir()}/{name}")
        socket.subscribe(b"")
        while not stopped():
            if len(socket.recv()) == 64:
                hear()


@contextlib.contextmanager
def zmq_writer(name: str) -> Iterator[Send]:
    import zmq

    path, payload = f"{tempfile.gettempdir()}/{name}", bytes(64)
    with zmq.Context() as context, context.socket(zmq.PUB) as socket:
        socket.linger = 0
        socket.bind(f"ipc://{path}")
        try:
            yield lambda: socket.send(payload)
        finally:
            Path(path).unlink(missing_ok=True)


class Words64(ctypes.Structure):
    _fields_ = [("words", ctypes.c_int64 * 8)]


def iceoryx2_services(name: str) -> tuple[Any, Any, Any]:
    import iceoryx2

    iceoryx2.set_log_level(iceoryx2.LogLevel.Error)
    node = iceoryx2.NodeBuilder.new().create(iceoryx2.ServiceType.Ipc)
    topic = node.service_builder(iceoryx2.ServiceName.new(name))
    bell = node.service_builder(iceoryx2.ServiceName.new(f"{name}-bell"))
    return node, topic.publish_subscribe(Words64).open_or_create(), bell.event().open_or_create()


def iceoryx2_reader(name: str, hear: Hear, stopped: Stopped) -> None:
    _node, topic, bell = iceoryx2_services(name)  # the node lives as long as its services
    subscriber, listener = topic.subscriber_builder().create(), bell.listener_builder().create()
    while not stopped():
        listener.blocking_wait()
        while (sample := subscriber.receive()) is not None:
            if len(bytes(sample.payload().contents)) == 64:
                hear()


@contextlib.contextmanager
def iceoryx2_writer(name: str) -> Iterator[Send]:
    _node, topic, bell = iceoryx2_services(name)  # the node lives as long as its services
    publisher, notifier = topic.publisher_builder().create(), bell.notifier_builder().create()
    payload = Words64()

    def send() -> None:
        publisher.send_copy(payload)
        notifier.notify()

    yield send


def msgq_reader(name: str, hear: Hear, stopped: Stopped) -> None:
    import msgq

    socket = msgq.sub_sock(name, conflate=False, timeout=1000)
    while not stopped():
        if len(socket.receive() or b"") == 64:
            hear()


@contextlib.contextmanager
def msgq_writer(name: str) -> Iterator[Send]:
    import msgq

    socket, payload = msgq.pub_sock(name), bytes(64)
    try:
        yield lambda: socket.send(payload)
    finally:
        for left in Path("/dev/shm").glob(f"*{name}*"):  # it leaves its queue behind
            left.unlink(missing_ok=True)


# name -> what is imported, reader, writer
PEERS: dict[str, tuple[str, Reader, Writer]] = {
    "rtdb": ("rtdb", store_reader, store_writer),
    "msgq": ("msgq", msgq_reader, msgq_writer),
    "iceoryx2": ("iceoryx2", iceoryx2_reader, iceoryx2_writer),
    "pyzmq": ("zmq", zmq_reader, zmq_writer),
}


def missing(peer: str) -> str:
    """Say why a peer cannot be tried; empty if it can."""
    import importlib

    module = PEERS[peer][0]
    try:
        found = importlib.import_module(module)
    except ImportError:
        return "not installed"
    except SyntaxError:  # the `msgq` of the package index: Python 2
        return "not installed: another program of that name is"
    return "" if peer != "msgq" or hasattr(found, "pub_sock") else "not installed: another program of that name is"


def round_of(what: str, reader: Reader, writer: Writer, n: int, pace_s: float = PACE_S) -> list[float]:
    """Ping a new reader n times; microseconds from before the write until the reader has it."""
    name, page = f"bench-{what}-{os.getpid()}", shared_page()

    def hear() -> None:
        page[HEARD] = time.monotonic_ns()

    cores = sorted(os.sched_getaffinity(0))
    with on_cores({cores[-1]}):
        process = child(reader, name, hear, lambda: page[STOP] != 0)  # before the writer: some peers start threads
    try:
        with on_cores({cores[0]}), writer(name) as send:
            wait_until(lambda: send() or page[HEARD], f"the reader of {what}")  # who joins late misses the first ones
            time.sleep(0.05)
            took = ping(send, page, n, pace_s)
            page[STOP] = 1
            send()
            process.join(3.0)
    finally:
        process.kill()
        process.join()
    return took


def round_of_peer(peer: str, n: int) -> list[float]:
    """Ping a reader of that kind n times."""
    _, reader, writer = PEERS[peer]
    return round_of(peer, reader, writer, n)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--pings", type=int, default=300)
    args = parser.parse_args()
    took: dict[str, list[float]] = {peer: [] for peer in PEERS if not missing(peer)}
    for _ in range(args.rounds):
        for peer, figures in took.items():
            figures.extend(round_of_peer(peer, args.pings))
    ours = statistics.median(took["rtdb"])
    print("64 bytes from write to reader, Python to Python | min us | median us | times rtdb")
    for peer in PEERS:
        figures = took.get(peer)
        if figures is None:
            print(f"{peer} | {missing(peer)}")
        else:
            median = statistics.median(figures)
            print(f"{peer} | {min(figures):.1f} | {median:.1f} | {median / ours:.2f}")


if __name__ == "__main__":
    main()
