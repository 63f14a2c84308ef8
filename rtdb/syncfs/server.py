"""The server: sessions on sockets, in one asyncio loop, which hears of the store's edges through a file descriptor.

A client that reads slowly is not listened to until it has taken what was sent; one that is dead costs its buffers.
Neither delays an edge: replies go into the sockets' buffers, and the store's clock is not ours.
"""

import asyncio
import errno
import logging
import os
import socket
import stat
import struct
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, cast

from ..clock import Edges
from ..store import Store
from .addresses import Address
from .errors import FsError
from .service import Service
from .session import Session

log = logging.getLogger(__name__)
LOOK_S = 0.25  # between looks at what stands still
BATCH, TURN_S = 64, 0.002  # so many messages of one client are answered in a row, for so long at most
JOINED_BYTES = 1 << 16  # replies are joined up to this size
STORE_S = 2.0  # between looks whether the store is still there
ATTACH_S = 10.0  # for a connection to say who it is
_CREDENTIALS = struct.Struct("3i")


class Outgoing:
    """Replies on their way: those to one connection in a row are one write.

    Many small writes to a client that does not take them are slow: since Python 3.12 a transport adds up the lengths of
    all that it holds at each of them.
    """

    def __init__(self) -> None:
        self._to: Connection | None = None
        self._replies: list[bytes] = []
        self._n_bytes = 0

    def add(self, to: "Connection", reply: bytes) -> None:
        """Take a reply; whoever began what led to it calls `flush` in the end."""
        if self._to is not to or self._n_bytes > JOINED_BYTES:
            self.flush()
            self._to = to
        self._replies.append(reply)
        self._n_bytes += len(reply)

    def flush(self) -> None:
        """Write what is left."""
        to, replies = self._to, self._replies
        self._to, self._replies, self._n_bytes = None, [], 0
        if to is not None:
            to.write(replies[0] if len(replies) == 1 else b"".join(replies))


class FileServer:
    """Serves a named store as files; options are those of Service. Use `run`, or `start` and `close` inside a loop."""

    def __init__(self, db: str, **options: Any) -> None:
        self.store = Store.attach(db)
        try:
            self.service = Service(self.store, **options)
        except BaseException:
            self.store.close()
            raise
        self.connections: set[Connection] = set()
        self.outgoing = Outgoing()
        self._servers: list[asyncio.AbstractServer] = []
        self._sockets: list[Path] = []
        self._edges: Edges | None = None
        self._look: asyncio.TimerHandle | None = None
        self._looked_s = time.monotonic()
        self.over = asyncio.Event()  # the store has ended

    # -- beginning and end ----------------------------------------------------------------------------------------

    async def start(self, addresses: Iterable[Address], *, anywhere: bool = False) -> list[Address]:
        """Listen; returns the addresses with their real ports. anywhere: others than this machine may come."""
        self._loop = asyncio.get_running_loop()
        bound = [await self._listen(address, anywhere) for address in addresses]
        self._edges = self.store.edges()
        self._loop.add_reader(self._edges.fileno(), self._edge)
        self._look_around()
        return bound

    async def _listen(self, address: Address, anywhere: bool) -> Address:
        if not address.is_local and not anywhere:
            raise FsError(errno.EPERM, f"{address} can be reached from other machines; say --anywhere if that is meant")
        try:
            return await self._bound(address)
        except OSError as error:
            if isinstance(error, FsError):
                raise
            raise FsError(error.errno or errno.EIO, f"{address}: {error.strerror or error}") from error

    async def _bound(self, address: Address) -> Address:
        if address.path is not None:
            _clear(address)
            before = os.umask(0o177)
            try:
                server: asyncio.AbstractServer = await self._loop.create_unix_server(
                    lambda: Connection(self, unix=True), str(address.path), backlog=512
                )
            finally:
                os.umask(before)
            self._sockets.append(address.path)
        else:
            server = await self._loop.create_server(
                lambda: Connection(self, unix=False), address.host, address.port, backlog=512
            )
            address = Address(host=address.host, port=server.sockets[0].getsockname()[1])
        self._servers.append(server)
        return address

    async def close(self) -> None:
        """End all connections, and leave the store."""
        if self._edges is not None:
            self._loop.remove_reader(self._edges.fileno())
        if self._look is not None:
            self._look.cancel()
        for server in self._servers:
            server.close()
        for connection in list(self.connections):
            connection.abort()
        for path in self._sockets:
            path.unlink(missing_ok=True)
        if self._edges is not None:
            self._edges.close()
        self.service.close()
        self.store.close()

    # -- edges ----------------------------------------------------------------------------------------------------

    def _look_for_store(self) -> None:
        """End when the store has: its maker closed it, and another may have its name."""
        if not self.store.bears_name and not self.over.is_set():
            log.warning("store %r has ended, and so does its file server", self.store.name)
            self.over.set()

    def soon(self, call: Callable[[], None]) -> None:
        """Have something done in the loop's next round."""
        self._loop.call_soon(call)

    def _edge(self) -> None:
        assert self._edges is not None
        self._edges.clear()
        self.service.edge(time.monotonic())
        self.outgoing.flush()

    def _look_around(self) -> None:
        now_s = time.monotonic()
        self.service.look(now_s)
        self.outgoing.flush()
        if now_s - self._looked_s > STORE_S:
            self._looked_s = now_s
            self._look_for_store()
        for connection in list(self.connections):
            session = connection.session
            if session is not None and not session.attached and now_s - connection.made_s > ATTACH_S:
                log.warning("a connection is closed: it did not attach for %g s", ATTACH_S)
                connection.abort()
        self._look = self._loop.call_later(LOOK_S, self._look_around)


class Connection(asyncio.Protocol):
    """One connection: moves bytes between a socket and a session."""

    def __init__(self, server: FileServer, *, unix: bool) -> None:
        self._server, self._unix = server, unix
        self._transport: asyncio.Transport | None = None
        self.session: Session | None = None  # of a connection that is let in
        self._turn = False  # it goes on in the loop's next round
        self.made_s = time.monotonic()
        self._quick: Callable[[int, int, int], None] | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Set the socket up, or close it at once where there is no place for it."""
        transport = cast("asyncio.Transport", transport)  # uvloop's is none
        server, sock = self._server, transport.get_extra_info("socket")
        self._transport = transport
        limits = server.service.tree.limits
        if self._unix and not _is_friend(sock):
            log.warning("a connection of another user is closed")
            transport.abort()
            return
        if len(server.connections) >= limits.connections:
            log.warning("a connection is closed: there are %d", len(server.connections))
            transport.abort()
            return
        server.connections.add(self)
        self.session = server.service.begin(lambda reply: server.outgoing.add(self, reply))
        transport.set_write_buffer_limits(high=limits.unsent_bytes)
        if not self._unix:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for option, value in ((socket.TCP_KEEPIDLE, 10), (socket.TCP_KEEPINTVL, 5), (socket.TCP_KEEPCNT, 3)):
                sock.setsockopt(socket.IPPROTO_TCP, option, value)
            self._quick = sock.setsockopt

    def write(self, data: bytes) -> None:
        """Send replies, unless the client went in the middle of a batch."""
        assert self._transport is not None
        if not self._transport.is_closing():
            self._transport.write(data)

    def data_received(self, data: bytes) -> None:
        """Answer what came. Linux' client has no TCP_NODELAY: without quick acknowledgement its next request waits."""
        if self._quick is not None:
            self._quick(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        if self.session is not None:
            self._after(self.session.feed(data, BATCH, TURN_S))

    def _go_on(self) -> None:
        self._turn = False
        if self.session is not None and not self.session.over:
            self._after(self.session.go_on(BATCH, TURN_S))

    def _after(self, more: bool) -> None:
        """Let others have their turn before this client's next batch; it is not listened to meanwhile."""
        self._server.outgoing.flush()
        session, transport = self.session, self._transport
        if session is None or transport is None:
            return
        if session.over or transport.is_closing():
            self.close()
        elif more:
            transport.pause_reading()
            self._take_turn()
        elif not session.paused:
            transport.resume_reading()

    def _take_turn(self) -> None:
        if not self._turn:
            self._turn = True
            self._server.soon(self._go_on)

    def pause_writing(self) -> None:
        """The client does not take its replies: it is not listened to until it does."""
        if self.session is not None and self._transport is not None:
            self.session.paused = True
            self._transport.pause_reading()

    def resume_writing(self) -> None:
        """It takes them again."""
        if self.session is not None and self._transport is not None:
            self.session.paused = False
            self._take_turn()

    def connection_lost(self, exc: Exception | None) -> None:
        """Everything that the connection held goes, and the ring of it and its session."""
        self._server.connections.discard(self)
        session, self.session = self.session, None
        if session is not None:
            self._server.service.end(session)
            self._server.outgoing.flush()

    def close(self) -> None:
        """End it, once it has taken what was sent."""
        if self._transport is not None:
            self._transport.close()

    def abort(self) -> None:
        """End it now: who takes no replies would never let it end."""
        if self._transport is not None:
            self._transport.abort()


def _is_friend(sock: socket.socket) -> bool:
    """Whether the process at the other end belongs to this user, or to root."""
    _, uid, _ = _CREDENTIALS.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    return uid in (0, os.getuid())


def _clear(address: Address) -> None:
    """Remove a socket that a dead server left; FsError where a living one listens."""
    path = str(address.path)
    if len(path.encode()) > 107:
        raise FsError(errno.ENAMETOOLONG, f"{path}: a socket's path has at most 107 bytes")
    if not os.path.lexists(path):
        return
    if not stat.S_ISSOCK(os.lstat(path).st_mode):
        raise FsError(errno.EEXIST, f"{path}: there is a file, and it is no socket")
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(path)
        except ConnectionRefusedError:
            os.unlink(path)
        except OSError as error:
            raise FsError(error.errno or errno.EIO, f"{path}: {error.strerror}") from error
        else:
            raise FsError(errno.EADDRINUSE, f"{path}: a server listens there already")


def new_loop() -> asyncio.AbstractEventLoop:
    """Make an event loop: uvloop's, if it is installed."""
    try:
        import uvloop
    except ImportError:
        return asyncio.new_event_loop()
    loop: asyncio.AbstractEventLoop = uvloop.new_event_loop()
    return loop


def run(
    server: FileServer,
    addresses: list[Address],
    *,
    anywhere: bool = False,
    ready: Callable[[list[Address]], None],
    until: Callable[[], "asyncio.Future[Any]"] | None = None,
    plain: bool = False,
) -> None:
    """Serve until SIGINT, SIGTERM or SIGHUP, or until a future is done. plain: without uvloop."""
    import signal

    async def serve() -> None:
        loop = asyncio.get_running_loop()
        over = server.over
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:  # as nohup does
                loop.add_signal_handler(number, over.set)
        try:
            ready(await server.start(addresses, anywhere=anywhere))
            if until is not None:
                until().add_done_callback(lambda _: over.set())
            await over.wait()
        finally:
            await server.close()

    with asyncio.Runner(loop_factory=asyncio.new_event_loop if plain else new_loop) as runner:
        runner.run(serve())
