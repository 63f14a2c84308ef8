"""Limits, each with its error; very many fids and stats; and clients that are slow, dead or greedy delay nobody."""

import asyncio
import contextlib
import errno
import gc
import socket
import subprocess
import sys
import threading
import time
import tracemalloc
import weakref

import pytest

from rtdb import Store
from rtdb.json_object import json_schema
from rtdb.syncfs import Address, Client, FileServer, FsError, Limits, SeatSpec, Tokens
from rtdb.syncfs.codec import LINUX, NOFID, NOTAG, TYPES
from rtdb.syncfs.server import JOINED_BYTES, Outgoing

from .conftest import O_APPEND, O_TRUNC, O_WRONLY, ROOT, Refused

MANY = 10_000
LONG_S = 30.0  # a wait that is never waited out when all is well


def refused(call, *values):
    with pytest.raises(Refused) as caught:
        call(*values)
    return caught.value.code


def test_connections_and_revisions_leave_no_rings_for_the_garbage_collector(make_rig):
    """In real time nothing collects them."""
    rig, gone = make_rig(), []
    gc.collect()
    gc.disable()
    try:
        for k in range(3):
            fs = rig.client()
            fid = fs.create(f"f{k}")
            fs.pwrite(fid, b"x" * 10_000)
            gone += [weakref.ref(fs.session), weakref.ref(fs.session._fids[fid].draft._commit)]
            fs.clunk(fid)
            fs.hang_up()
            fs.session = None  # which holds this client
        assert [ref() for ref in gone] == [None] * 6
    finally:
        gc.enable()


def test_one_answer_that_fails_takes_no_other_along(make_rig):
    rig = make_rig()
    first, second = rig.client(), rig.client()
    tags = [fs.stat("clock") for fs in (first, second)]

    def broken(_):
        raise OSError("nobody reads it")

    first.session._send = broken
    rig.edge()
    assert second.reply(tags[1]) is not None


# -- each limit ----------------------------------------------------------------------------------------------------


def test_too_many_fids_of_a_connection_are_emfile_and_others_have_their_own(make_rig):
    rig = make_rig(limits=Limits(fids=10))
    fs, other = rig.client(), rig.client()
    fids = [fs.walk("clock") for _ in range(9)]
    assert refused(fs.walk, "clock") == errno.EMFILE
    assert refused(fs.attach, 99) == errno.EMFILE
    other.walk("clock")
    fs.clunk(fids[0])
    fs.walk("clock")


def test_a_walk_of_a_fid_onto_itself_needs_no_room(make_rig):
    fs = make_rig(limits=Limits(fids=2)).client()
    fid = fs.walk("")
    assert len(fs.call("Twalk", fid, fid, ["clock"])[0]) == 1


def test_too_many_blocked_stats_of_a_connection_are_eagain(make_rig):
    rig = make_rig(limits=Limits(waiting=3))
    fs = rig.client()
    fid = fs.walk("clock")
    tags = [fs.send("Tgetattr", fid, 0x3FFF) for _ in range(3)]
    assert refused(fs.reply, fs.send("Tgetattr", fid, 0x3FFF)) == errno.EAGAIN
    fs.call("Tflush", tags.pop())
    tags.append(fs.send("Tgetattr", fid, 0x3FFF))
    rig.edge()
    assert [fs.told(tag)["data_version"] for tag in tags] == [1] * 3


def test_too_much_open_for_reading_is_enomem_until_some_is_closed(make_rig):
    rig = make_rig(limits=Limits(reading_bytes=2500))
    fs, other = rig.client(), rig.client()
    fs.write("f", b"x" * 1000)
    rig.edge()
    first, second, third = (fs.open("f") for _ in range(3))
    assert len(fs.pread(first, 0)) == len(fs.pread(second, 0)) == len(fs.pread(first, 0)) == 1000
    assert refused(fs.pread, third, 0) == errno.ENOMEM
    assert len(other.read("f")) == 1000, "another connection has its own room"
    fs.write("f", b"y" * 2000)
    rig.edge()
    assert refused(fs.pread, first, 0) == errno.ENOMEM, "it began again, and what it had is gone"
    fs.clunk(second)
    assert fs.pread(third, 0) == b"y" * 2000
    fs.call("Tversion", fs.msize, "9P2000.L", tag=0xFFFF)
    fs.attach(ROOT)
    assert fs.read("f") == b"y" * 2000, "a new beginning holds nothing"


@pytest.mark.parametrize("dialect", ["9P2000.u", "9P2000.L"])
def test_too_many_open_listings_are_enomem_until_they_are_read(make_rig, dialect):
    rig = make_rig(limits=Limits(reading_bytes=3000))
    rig.client().mkdir("d")
    for k in range(10):
        rig.client().write(f"d/{k}", b"")
    rig.edge()
    fs = rig.client(dialect)

    def begin():
        fid = fs.open("d")
        fs.call("Treaddir" if fs.linux else "Tread", fid, 0, 200)
        return fid

    def begin_all():
        while len(begun) < 100:
            begun.append(begin())

    begun = [begin()]
    assert refused(begin_all) == errno.ENOMEM
    fs.clunk(begun[0])
    begin()


@pytest.mark.parametrize("dialect", ["9P2000.u", "9P2000.L"])
def test_too_large_a_file_is_efbig_and_what_was_there_stays(make_rig, dialect):
    rig = make_rig(limits=Limits(file_bytes=1000))
    fs = rig.client(dialect)
    fid = fs.create("f")
    fs.pwrite(fid, b"x" * 1000)
    for offset, n in ((0, 1001), (1000, 1), (2**40, 1), (2**63, 1), (2**64 - 1, 1)):
        assert refused(fs.call, "Twrite", fid, offset, b"y" * n) == errno.EFBIG
    fs.clunk(fid)
    rig.edge()
    assert fs.read("f") == b"x" * 1000
    if fs.linux:
        fid = fs.walk("f")
        for size in (1001, 2**63, 2**64 - 1):
            assert refused(fs.truncate, fid, size) == errno.EFBIG
        fid = fs.open("f", O_WRONLY | O_APPEND)
        assert refused(fs.call, "Twrite", fid, 0, b"y") == errno.EFBIG
        rig.edge()
        assert fs.read("f") == b"x" * 1000


def test_too_large_a_status_is_efbig(make_rig):
    tokens = Tokens()
    tokens.give("follow", "token")
    rig = make_rig(
        tokens=tokens, seats=[SeatSpec(component="follow", status_bytes=200)], limits=Limits(status_bytes=200)
    )
    fs = rig.client(token="token")
    fid = fs.open("follow/status", O_WRONLY | O_TRUNC)
    assert refused(fs.call, "Twrite", fid, 0, b'{"a": "' + b"x" * 200 + b'"}') == errno.EFBIG


def test_too_large_a_status_is_efbig_where_only_the_seat_says_how_large(make_rig):
    tokens = Tokens()
    tokens.give("follow", "token")
    rig = make_rig(tokens=tokens, seats=[SeatSpec(component="follow", status_bytes=200)])
    fs = rig.client(token="token")
    fid = fs.open("follow/status", O_WRONLY | O_TRUNC)

    def say():
        fs.pwrite(fid, b'{"a": "' + b"x" * 200 + b'"}')
        fs.fsync(fid)

    assert refused(say) == errno.EFBIG


def test_unfinished_appends_count_as_unfinished_revisions(make_rig):
    rig = make_rig(limits=Limits(draft_bytes=300_000))
    fs = rig.client(msize=4096)
    for k in range(5):
        fs.clunk(fs.create(f"f{k}"))
    fids = [fs.open(f"f{k}", O_WRONLY | O_APPEND) for k in range(5)]

    def append_all():
        for fid in fids:
            for _ in range(30):
                fs.call("Twrite", fid, 0, b"x" * (4096 - 24))  # a longer one is under way

    assert refused(append_all) == errno.ENOSPC


def test_too_many_files_are_enospc(make_rig):
    fs = make_rig(limits=Limits(files=5)).client()
    for k in range(3):
        fs.clunk(fs.create(f"f{k}"))
    fs.mkdir("d")
    fs.mkdir("d/e")
    for call, path in ((fs.create, "f3"), (fs.mkdir, "d/f"), (fs.create, "d/e/f")):
        assert refused(call, path) == errno.ENOSPC
    fs.rm("f0")
    fs.clunk(fs.create("f3"))
    fs.mv("f3", "f1")  # replaces one
    fs.clunk(fs.create("f4"))
    assert refused(fs.create, "f5") == errno.ENOSPC


def test_a_full_store_is_enospc_and_nothing_that_was_there_suffers(make_rig):
    rig = make_rig(size=2 << 20)
    fs = rig.client()
    fs.write("kept", b"kept")
    rig.edge()
    codes = []
    for k in range(60):
        try:
            fs.write(f"f{k}", b"x" * 100_000, sync=True)
        except Refused as error:
            codes.append(error.code)
    assert set(codes) == {errno.ENOSPC}
    rig.edge(2)
    assert fs.read("kept") == b"kept"
    for k in range(60):
        fs.rm(f"f{k}")
    rig.edge(300)
    fs.write("after", b"y" * 100_000, sync=True)
    rig.edge()
    assert fs.read("after") == b"y" * 100_000


def test_too_long_a_name_is_enametoolong(rig, fs):
    for name in ("x" * 255, "ä" * 127):
        fs.clunk(fs.create(name))
        fs.rm(name)
    fs.write("f", b"")
    for name in ("x" * 256, "ä" * 128):
        assert refused(fs.create, name) == errno.ENAMETOOLONG
        assert refused(fs.mkdir, name) == errno.ENAMETOOLONG
        assert refused(fs.mv, "f", name) == errno.ENAMETOOLONG
        assert refused(fs.walk, name) in (errno.ENAMETOOLONG, errno.ENOENT)


def test_too_deep_a_directory_is_enametoolong(make_rig):
    fs = make_rig(limits=Limits(depth=4)).client()
    path = "d"
    fs.mkdir(path)
    for _ in range(3):
        path += "/d"
        fs.mkdir(path)
    assert refused(fs.mkdir, path + "/d") == errno.ENAMETOOLONG


def test_no_rename_makes_directories_deeper_than_allowed(make_rig):
    rig = make_rig(limits=Limits(depth=4))
    fs = rig.client()
    for path in ("a", "a/b", "a/b/c", "x", "x/y", "x/y/z"):
        fs.mkdir(path)
    assert refused(fs.mv, "x", "a/b/c/x") == errno.ENAMETOOLONG
    assert "x" in fs.ls()
    rig.edge()


def test_a_message_size_is_the_smaller_of_both(make_rig):
    rig = make_rig(limits=Limits(msize=10_000))
    assert rig.client(msize=1 << 20).msize == 10_000
    assert rig.client(msize=5000).msize == 5000
    with pytest.raises(Refused):
        rig.client(msize=4095)


@pytest.mark.parametrize("dialect", ["9P2000", "9P2000.u", "9P2000.L"])
def test_no_reply_exceeds_the_message_size_nor_what_was_asked_for(make_rig, dialect):
    rig = make_rig()
    maker = rig.client()
    for k in range(40):
        maker.mkdir(f"{k:02}" + "x" * 200)
    maker.write("f", b"x" * 20_000)
    rig.edge()
    fs, sizes = rig.client(dialect, msize=4096), []
    taken = fs._taken
    fs.session._send = lambda data: (sizes.append(len(data)), taken(data))
    fid = fs.open("f")
    for count in (0, 1, 4072, 4096, 2**31, 2**32 - 1):
        assert len(fs.call("Tread", fid, 0, count)[0]) == min(count, 4072)
    fid = fs.walk("")
    fs.call(*(("Tlopen", fid, 0) if fs.linux else ("Topen", fid, 0)))
    for count in (300, 1000, 4096, 2**32 - 1):
        assert 0 < len(fs.call("Treaddir" if fs.linux else "Tread", fid, 0, count)[0]) <= min(count, 4072)
    assert max(sizes) <= 4096


# -- very many -----------------------------------------------------------------------------------------------------


def test_10_000_fids_and_10_000_blocked_stats_are_all_released_by_one_edge(rig, fs):
    fids = [fs.walk("clock") for _ in range(MANY)]
    tags = [fs.send("Tgetattr", fid, 0x3FFF) for fid in fids]
    assert fs.json("server")["waiting"] == MANY
    rig.tick(9)
    assert not fs.replies
    rig.tick()
    assert [fs.told(tag)["data_version"] for tag in tags] == [1] * MANY
    assert fs.order[-MANY:] == tags, "first come, first served"
    for fid in fids:
        fs.clunk(fid)
    assert fs.json("server")["waiting"] == 0


def test_10_000_blocked_stats_go_with_their_connection(rig, fs):
    crowd = rig.client()
    fid = crowd.walk("clock")
    for _ in range(MANY):
        crowd.send("Tgetattr", fid, 0x3FFF)
    crowd.hang_up()
    assert fs.json("server")["waiting"] == 0


def test_10_000_flushed_stats_leave_nothing_behind(rig, fs):
    fid = fs.walk("clock")
    for tag in [fs.send("Tgetattr", fid, 0x3FFF) for _ in range(MANY)]:
        assert fs.call("Tflush", tag) == ()
    rig.edge()
    assert not fs.replies
    assert fs.json("server")["waiting"] == 0


def test_a_file_made_and_removed_10_000_times_costs_no_room(rig, fs):
    for k in range(MANY // 4):
        fs.clunk(fs.create("f"))
        fs.rm("f")
        if k % 100 == 0:
            rig.edge()
    fs.write("f", b"last")
    rig.edge()
    assert fs.read("f") == b"last"


# -- sockets -------------------------------------------------------------------------------------------------------


class Served:
    """A file server in a thread, over a stepped store that the test ticks; it gives up on nobody who is slow."""

    def __init__(self, name, path, **options):
        self.store = Store.create(name, size=16 << 20)
        self.address, self._ready = Address(path=path), threading.Event()
        self._options = {"grace_s": 1e9, "patience_s": 1e9, **options}
        self._name, self.failed = name, []
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        assert self._ready.wait(LONG_S)
        if self.failed:
            raise self.failed[0]

    def _run(self):
        async def serve():
            self.loop, self._over = asyncio.get_running_loop(), asyncio.Event()
            self.loop.set_exception_handler(lambda _, context: self.failed.append(context))
            self.server = FileServer(self._name, **self._options)
            (self.address,) = await self.server.start([self.address])
            self._ready.set()
            await self._over.wait()
            await self.server.close()

        try:
            asyncio.run(serve())
        except BaseException as error:
            self.failed.append(error)
            self._ready.set()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.loop.call_soon_threadsafe(self._over.set)
        self._thread.join(LONG_S)
        self.store.close()
        assert not self._thread.is_alive()
        assert self.failed == []

    def client(self, token=""):
        return Client.connect(self.address, token, timeout_s=LONG_S)

    def socket(self):
        """Connect and attach by hand; for who does not behave."""
        sock = socket.socket(socket.AF_UNIX)
        sock.settimeout(LONG_S)
        sock.connect(str(self.address.path))
        for name, *values in (("Tversion", 1 << 17, "9P2000.L"), ("Tattach", ROOT, NOFID, "", "", 0)):
            sock.sendall(LINUX.encode[TYPES[name]](NOTAG if name == "Tversion" else 1, *values))
            assert take(sock)[0] == TYPES[name] + 1
        return sock

    def until(self, condition):
        """Wait for something to come true in the server's loop."""
        deadline = time.monotonic() + LONG_S
        while not self.ask(condition):
            assert time.monotonic() < deadline, "it never came true"

    @property
    def service(self):
        return self.server.service

    def ask(self, function):
        """Have something done in the server's loop."""

        async def done():
            return function()

        return asyncio.run_coroutine_threadsafe(done(), self.loop).result(LONG_S)


def take(sock):
    """Take one reply."""
    data = b""
    while len(data) < 4 or len(data) < int.from_bytes(data[:4], "little"):
        piece = sock.recv(
            (int.from_bytes(data[:4], "little") or 1 << 20) - len(data) if len(data) >= 4 else 4 - len(data)
        )
        if not piece:
            raise EOFError
        data += piece
    return LINUX.decoded(data)


def put(sock, name, *values, tag=1):
    sock.sendall(LINUX.encode[TYPES[name]](tag, *values))
    return take(sock)


def fill(served, sock, request):
    """Ask, and take no reply, until the server does not listen any more; gives the bytes sent."""
    sock.setblocking(False)
    sent = 0

    def is_full():
        nonlocal sent
        try:
            sent += sock.send(request * 1000)
        except BlockingIOError:
            return any(session.paused for session in served.service.sessions)
        return False

    served.until(is_full)
    return sent


@pytest.fixture
def serve(unique, tmp_path):
    """Starts servers."""
    return lambda **options: Served(unique(), tmp_path / "s", **options)


def works(served, client, rounds=3):
    """A client makes progress: reads, writes, and is woken by edges."""
    for k in range(rounds):
        client.write("/witness", b"%d" % k)
        version = client.stat("/server").version
        woken = []
        waiter = threading.Thread(target=lambda woken=woken: woken.append(client.wait()))
        waiter.start()
        served.until(lambda: len(served.service.waiting) == 1)
        for _ in range(10 - served.store.cycle % 10):
            served.store.tick()
        waiter.join(LONG_S)
        assert woken == [served.store.cycle // 10]
        assert version <= served.store.cycle
        assert client.read("/witness") == b"%d" % k


def test_who_never_takes_its_replies_delays_nobody_and_costs_bounded_memory(serve):
    with serve() as served, served.client() as honest:
        honest.write("/large", b"x" * (1 << 20))
        for _ in range(10):
            served.store.tick()
        served.until(lambda: served.service.cycle == served.store.cycle)
        slow = served.socket()
        put(slow, "Twalk", ROOT, 1, ["large"])
        put(slow, "Tlopen", 1, 0)
        request = LINUX.encode[TYPES["Tread"]](2, 1, 0, 1 << 16)
        asked = fill(served, slow, request) // len(request) << 16
        limit = served.service.tree.limits.unsent_bytes

        def unsent():
            return [c._transport.get_write_buffer_size() for c in served.server.connections]

        assert asked > 100 * limit
        assert max(served.ask(unsent)) <= limit + (1 << 17)
        works(served, honest)
        assert max(served.ask(unsent)) <= limit + (1 << 17)
        slow.setblocking(True)
        for _ in range(200):  # and when it takes them, it gets them all
            assert take(slow)[0] == TYPES["Rread"]
        slow.close()
        works(served, honest)


def test_the_stats_of_who_takes_no_replies_cost_bounded_memory(serve):
    """They wait for the edge already when the buffer is full: they are answered, and that is the end of it."""
    with serve() as served, served.client() as honest:
        slow = served.socket()
        put(slow, "Twalk", ROOT, 1, ["clock"])
        for tag in range(2, 5000):
            slow.sendall(LINUX.encode[TYPES["Tgetattr"]](tag, 1, 0x3FFF))
        served.until(lambda: len(served.service.waiting) == 4998)
        tracemalloc.start()
        try:
            for _ in range(10):
                served.store.tick()
            served.until(lambda: not len(served.service.waiting))
            assert tracemalloc.get_traced_memory()[1] < 20 << 20
        finally:
            tracemalloc.stop()
        works(served, honest)
        slow.close()


def test_the_server_ends_though_one_takes_no_replies(serve):
    with serve() as served:
        slow = served.socket()
        fill(served, slow, LINUX.encode[TYPES["Tgetattr"]](2, ROOT, 0x7FF))
        service = served.service
    assert service.sessions == set()
    slow.close()


def test_half_a_message_and_half_a_connection_delay_nobody(serve):
    with serve() as served, served.client() as honest:
        halves = []
        for n in (1, 4, 6, 7, 10):
            half = served.socket()
            half.sendall(LINUX.encode[TYPES["Tread"]](2, 1, 0, 100)[:n])
            halves.append(half)
        silent = socket.socket(socket.AF_UNIX)
        silent.connect(str(served.address.path))
        closed = served.socket()
        closed.shutdown(socket.SHUT_WR)
        works(served, honest)
        for sock in (*halves, silent, closed):
            sock.close()
        works(served, honest)
        served.until(lambda: len(served.server.connections) == 1)


FLOOD = """
import socket, sys
path, hello, request, n_bytes = sys.argv[1], *map(bytes.fromhex, sys.argv[2:4]), int(sys.argv[4])
flood = socket.socket(socket.AF_UNIX)
flood.connect(path)
flood.sendall(hello)
flood.recv(4096)
print(flush=True)
flood.setblocking(n_bytes > 0)
while True:
    try:
        flood.send(request)
        left = n_bytes or 1
        while left > 0:
            left -= len(flood.recv(1 << 20))
    except BlockingIOError:
        pass
"""


@contextlib.contextmanager
def flooded(served, request, n_bytes):
    """Have another process send as fast as it can. n_bytes: of replies, that it takes before it goes on; 0: any."""
    encode = LINUX.encode
    hello = encode[TYPES["Tversion"]](NOTAG, 1 << 17, "9P2000.L") + encode[TYPES["Tattach"]](1, ROOT, NOFID, "", "", 0)
    words = [str(served.address.path), hello.hex(), request.hex(), str(n_bytes)]
    with subprocess.Popen([sys.executable, "-S", "-c", FLOOD, *words], stdout=subprocess.PIPE) as child:
        try:
            child.stdout.readline()
            before = served.ask(lambda: served.service.report()["requests"])
            yield
            assert served.ask(lambda: served.service.report()["requests"]) > before + 1000, "it was no flood"
        finally:
            child.kill()


def test_a_flood_of_requests_starves_nobody(serve):
    """While one sends as fast as it can, another is woken by each edge."""
    request = LINUX.encode[TYPES["Tgetattr"]](2, ROOT, 0x7FF)
    with serve() as served, served.client() as honest, served.socket() as other:
        other.sendall(request)
        n_bytes = len(other.recv(4096))
        with flooded(served, request * 50, 50 * n_bytes):
            works(served, honest, rounds=5)


def test_a_flood_that_does_not_wait_for_replies_starves_nobody(serve):
    with serve() as served, served.client() as honest:
        with flooded(served, LINUX.encode[TYPES["Tclunk"]](2, 99) * 1000, 0):
            works(served, honest)
        served.until(lambda: len(served.server.connections) == 1)


def test_a_connection_that_has_ended_leaves_nothing_for_the_collector(serve):
    """There is none in real time."""
    with serve() as served, served.client() as honest:
        gc.disable()
        try:
            other = served.socket()
            sessions = served.ask(lambda: [weakref.ref(session) for session in served.service.sessions])
            connections = served.ask(lambda: [weakref.ref(connection) for connection in served.server.connections])
            other.close()
            served.until(lambda: len(served.server.connections) == 1)
            works(served, honest, rounds=1)
            assert [sum(ref() is not None for ref in refs) for refs in (sessions, connections)] == [1, 1]
        finally:
            gc.enable()


class Sink:
    """Stands for a connection: keeps what is written."""

    def __init__(self):
        self.writes = []
        self.write = self.writes.append


def test_replies_to_one_client_in_a_row_are_one_write_up_to_a_size():
    outgoing, one, other = Outgoing(), Sink(), Sink()
    for to, reply in ((one, b"1"), (one, b"2"), (other, b"3"), (one, b"4")):
        outgoing.add(to, reply)
    outgoing.flush()
    outgoing.flush()
    assert (one.writes, other.writes) == ([b"12", b"4"], [b"3"])
    for _ in range(10):
        outgoing.add(other, bytes(JOINED_BYTES))
    outgoing.flush()
    assert [len(data) for data in other.writes[1:]] == [2 * JOINED_BYTES] * 5


def test_who_goes_in_the_middle_of_a_flood_leaves_no_complaint(serve, caplog, monkeypatch):
    monkeypatch.setattr("rtdb.syncfs.server.JOINED_BYTES", 0)  # a write per reply
    with serve() as served, served.client() as honest:
        for _ in range(20):
            flood = served.socket()
            flood.sendall(LINUX.encode[TYPES["Tclunk"]](2, 99) * 2000)
            flood.close()
        served.until(lambda: len(served.server.connections) == 1)
        works(served, honest, rounds=1)
    assert caplog.text == ""


def test_one_connection_too_many_is_closed_at_once_and_the_others_stay(serve):
    with serve(limits=Limits(connections=3)) as served, served.client() as honest:
        more = [served.client(), served.client()]
        with pytest.raises((FsError, ConnectionError)):
            served.client()
        works(served, honest, rounds=1)
        more.pop().close()
        served.until(lambda: len(served.server.connections) == 2)
        with served.client() as again:
            assert "clock" in again.ls()
        more.pop().close()


def test_a_connection_that_does_not_attach_in_time_is_closed_and_who_has_attached_stays(serve, monkeypatch):
    monkeypatch.setattr("rtdb.syncfs.server.ATTACH_S", 0.0)
    monkeypatch.setattr("rtdb.syncfs.server.LOOK_S", 0.0)
    with serve() as served:
        silent = socket.socket(socket.AF_UNIX)
        silent.settimeout(LONG_S)
        silent.connect(str(served.address.path))
        assert silent.recv(1) == b""
        silent.close()
        monkeypatch.setattr("rtdb.syncfs.server.ATTACH_S", 1e9)
        with served.client() as honest:
            monkeypatch.setattr("rtdb.syncfs.server.ATTACH_S", 0.0)
            works(served, honest, rounds=1)


def test_a_connection_that_sends_nonsense_is_closed_alone(serve):
    with serve() as served, served.client() as honest:
        bad = served.socket()
        bad.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert bad.recv(100) == b""
        bad.close()
        works(served, honest, rounds=1)


def test_a_connection_that_dies_with_its_stats_and_drafts_leaves_nothing(serve):
    with serve() as served, served.client() as honest:
        honest.write("/f", b"old")
        for _ in range(10):
            served.store.tick()
        dead = served.socket()
        put(dead, "Twalk", ROOT, 1, ["f"])
        put(dead, "Tlopen", 1, O_WRONLY)
        put(dead, "Tsetattr", 1, 0x68, 0, 0, 0, 0, 0, 0, 0, 0)
        put(dead, "Twrite", 1, 0, b"half")
        put(dead, "Twalk", ROOT, 2, ["clock"])
        dead.sendall(LINUX.encode[TYPES["Tgetattr"]](3, 2, 0x3FFF))
        served.until(lambda: len(served.service.waiting) == 1)
        dead.close()
        served.until(lambda: not len(served.service.waiting))
        works(served, honest, rounds=1)
        assert honest.read("/f") == b"old"


def test_a_file_kept_open_by_the_client_is_emptied_by_a_rewrite_of_nothing(serve):
    with serve() as served, served.client() as honest:
        for text in (b"old", b""):
            if text:
                honest.write("/f", text)
            else:
                honest.rewrite("/f", text)
            works(served, honest, rounds=1)
            assert honest.read("/f") == text


def test_the_socket_is_for_its_owner_only_and_goes_with_the_server(serve):
    with serve() as served:
        assert served.address.path.stat().st_mode & 0o777 == 0o600
        path = served.address.path
    assert not path.exists()


def test_free_files_leave_half_of_the_store_to_the_components(make_rig):
    rig = make_rig(size=4 << 20)
    fs, n = rig.client(), 0
    with contextlib.suppress(Refused):
        for n in range(200):
            fs.write(f"f{n}", bytes(100_000), sync=True)
    assert 0 < n < 199
    with pytest.raises(Refused) as caught:
        fs.write("one more", bytes(100_000))
    assert caught.value.code == errno.ENOSPC
    size, unused = rig.store.memory
    assert unused > 0.4 * size
    late = rig.store.join("late")
    late.insert("object", json_schema(4000), history_s=1.0)
    fs.rm("f0")
    fs.write("after", b"there is room again", sync=True)
    rig.edge()
    assert fs.read("after") == b"there is room again"
