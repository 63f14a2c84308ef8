"""A client: what a mount does, without one.

    with Client.connect(address, token=token) as fs:
        for _ in fs.edges("/follow/clock"):  # done with the last cycle; now it is the next
            pose = fs.read_json("/localise/status")["pose"]
            fs.write_json("/follow/status", {"drive": {"speed_mps": 1.5, "steer_rad": 0.0}})

Calls block; one client belongs to one thread. What goes wrong is an FsError with Linux' number. A file that is read or
written again and again stays open.
"""

import contextlib
import errno
import json
import os
import socket
import struct
from collections.abc import Iterator
from types import TracebackType
from typing import Any, NamedTuple, Self

from .addresses import MSIZE, Address
from .codec import HEADER, IO_HEADER, LINUX, MAX_WALK, NO_UID, NOFID, NOTAG, TYPES, Malformed
from .errors import FsError

ROOT = 0  # fid of what was attached
O_RDONLY, O_WRONLY, O_TRUNC = 0, 1, 0o1000
ALL = 0x3FFF
_ERROR = TYPES["Rlerror"]


class Stat(NamedTuple):
    """What a stat tells. `version` counts edges, for a clock."""

    mode: int
    size: int
    mtime_ns: int
    version: int

    @property
    def is_dir(self) -> bool:
        """Whether it is a directory."""
        return self.mode & 0o170000 == 0o040000


class Client:
    """A connection to a file server. Use it in a `with`, or close it."""

    def __init__(self, sock: socket.socket, token: str = "", msize: int = MSIZE) -> None:
        self._sock, self._buffer, self._msize = sock, b"", msize
        self._free, self._last = list[int](), ROOT
        self._open: dict[tuple[str, int], int] = {}  # fids of files that stay open
        msize, version = self._call("Tversion", msize, LINUX.name, tag=NOTAG)
        if version != LINUX.name:
            raise FsError(errno.EPROTO, f"the server speaks {version}, not {LINUX.name}")
        self._piece = msize - IO_HEADER
        try:
            self._call("Tattach", ROOT, NOFID, "", token, NO_UID)
        except FsError as error:
            if error.errno == errno.EACCES:
                raise FsError(errno.EACCES, "this server knows no such token") from error
            raise

    @classmethod
    def connect(
        cls, address: Address | str, token: str = "", timeout_s: float | None = None, msize: int = MSIZE
    ) -> Self:
        """Connect; FsError where nobody listens.

        timeout_s: for each call [a stat of a clock may take long]; msize: largest message, bytes.
        """
        where = Address.parse(address) if isinstance(address, str) else address
        sock: socket.socket | None = None
        try:
            if where.path is not None:
                sock = socket.socket(socket.AF_UNIX)
                sock.connect(str(where.path))
            else:
                sock = socket.create_connection((where.host, where.port))
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.settimeout(timeout_s)
            return cls(sock, token, msize)
        except OSError as error:
            if sock is not None:
                sock.close()
            if isinstance(error, FsError):
                raise
            raise FsError(
                error.errno or errno.EIO, f"{where}: {error.strerror or error}; is a server there?"
            ) from error

    # -- what there is --------------------------------------------------------------------------------------------

    def stat(self, path: str) -> Stat:
        """Ask about a file. A clock answers at its next edge: that is how one waits for it."""
        fid = self._walked(path)
        try:
            values = self._call("Tgetattr", fid, ALL)
        finally:
            self._clunk(fid)
        return Stat(values[2], values[7], values[12] * 1_000_000_000 + values[13], values[19])

    def wait(self, clock: str = "/clock") -> int:
        """Wait for the next edge of a clock, by a fid that stays open; returns how many there were."""
        fid = self._kept(clock, -1)
        return int(self._call("Tgetattr", fid, ALL)[19])

    def edges(self, clock: str = "/clock") -> Iterator[int]:
        """Yield the number of each edge of a clock as it comes; ends when the server does, as at the end of a drive."""
        while True:
            try:
                n = self.wait(clock)
            except FsError as error:
                if error.errno in (errno.ECONNRESET, errno.EPIPE):
                    return
                raise
            yield n

    def ls(self, path: str = "/") -> list[str]:
        """List the names in a directory."""
        fid = self._walked(path)
        try:
            self._call("Tlopen", fid, 0o200000)
            names, offset = list[str](), 0
            while data := self._call("Treaddir", fid, offset, self._piece)[0]:
                at = 0
                while at < len(data):
                    offset = int.from_bytes(data[at + 13 : at + 21], "little")
                    end = at + 24 + int.from_bytes(data[at + 22 : at + 24], "little")
                    names.append(data[at + 24 : end].decode("utf-8", "surrogateescape"))
                    at = end
        finally:
            self._clunk(fid)
        return sorted(name for name in names if name not in (".", ".."))

    # -- contents -------------------------------------------------------------------------------------------------

    def read(self, path: str) -> bytes:
        """Read a whole file: one revision of it."""
        try:
            return self._read_all(self._kept(path, O_RDONLY))
        except FsError as error:
            self._forget(path, O_RDONLY)
            if error.errno not in (errno.ENOENT, errno.EBADF):
                raise _at(path, error) from error
        try:  # it was removed, and may have been made anew
            return self._read_all(self._kept(path, O_RDONLY))
        except FsError as error:
            raise _at(path, error) from error

    def _read_all(self, fid: int) -> bytes:
        data: bytes = self._call("Tread", fid, 0, self._piece)[0]
        if len(data) < self._piece:
            return data
        pieces, size = [data], len(data)
        while piece := self._call("Tread", fid, size, self._piece)[0]:
            pieces.append(piece)
            size += len(piece)
        return b"".join(pieces)

    def read_json(self, path: str) -> Any:
        """Read a file of JSON; None while it is empty."""
        data = self.read(path)
        return json.loads(data) if data.strip() else None

    def write(self, path: str, data: bytes) -> None:
        """Write a whole file, which is made if it is not there: one revision, visible from the next edge on."""
        fid = self._found(path)
        if fid is None:
            fid = self._made(path)
        else:
            try:
                self._call("Tlopen", fid, O_WRONLY | O_TRUNC)
            except FsError as error:
                self._clunk(fid)
                raise _at(path, error) from error
        try:
            self._put(fid, data)
            self._call("Tfsync", fid, 0)  # says what is wrong with it; a close cannot
        except FsError as error:
            raise _at(path, error) from error
        finally:
            self._clunk(fid)

    def rewrite(self, path: str, data: bytes) -> None:
        """Write a file that stays open, a revision each time."""
        if (path, O_WRONLY) not in self._open:
            self._rewrite(path, data, new=True)
            return
        try:
            self._rewrite(path, data, new=False)
        except FsError as error:
            if error.errno not in (errno.ENOENT, errno.EBADF):
                raise
            self._forget(path, O_WRONLY)  # it was removed, and may have been made anew
            self._rewrite(path, data, new=True)

    def _rewrite(self, path: str, data: bytes, *, new: bool) -> None:
        fid = self._kept(path, O_WRONLY)
        if not data:
            self._call("Tsetattr", fid, 8, 0, 0, 0, 0, 0, 0, 0, 0)
            self._call("Tfsync", fid, 0)
            return
        self._put(fid, data)
        if new or len(data) >= self._piece:
            self._call("Tfsync", fid, 0)

    def write_json(self, path: str, document: Any) -> None:
        """Write an object as JSON, into a file that stays open."""
        self.rewrite(path, json.dumps(document, allow_nan=False).encode() + b"\n")

    def _put(self, fid: int, data: bytes) -> None:
        for at in range(0, len(data) or 1, self._piece):
            self._call("Twrite", fid, at, data[at : at + self._piece])

    def _made(self, path: str) -> int:
        folder, _, name = path.rstrip("/").rpartition("/")
        fid = self._walked(folder or "/")
        try:
            self._call("Tlcreate", fid, name, O_WRONLY, 0o644, 0)
        except FsError as error:
            self._clunk(fid)
            raise _at(path, error) from error
        return fid

    def remove(self, path: str) -> None:
        """Remove a file, or an empty directory."""
        fid = self._walked(path)
        self._free.append(fid)
        self._call("Tremove", fid)

    def mkdir(self, path: str) -> None:
        """Make a directory."""
        folder, _, name = path.rstrip("/").rpartition("/")
        fid = self._walked(folder or "/")
        try:
            self._call("Tmkdir", fid, name, 0o755, 0)
        finally:
            self._clunk(fid)

    def rename(self, path: str, new: str) -> None:
        """Move a file or directory, at once."""
        folder, _, name = path.rstrip("/").rpartition("/")
        to, _, new_name = new.rstrip("/").rpartition("/")
        old_fid = self._walked(folder or "/")
        new_fid = self._walked(to or "/")
        try:
            self._call("Trenameat", old_fid, name, new_fid, new_name)
        finally:
            self._clunk(old_fid)
            self._clunk(new_fid)

    # -- fids and messages ----------------------------------------------------------------------------------------

    def _new(self) -> int:
        if self._free:
            return self._free.pop()
        self._last += 1
        return self._last

    def _walked(self, path: str) -> int:
        """Give a fid for a path."""
        fid = self._found(path)
        if fid is None:
            raise FsError(errno.ENOENT, f"{path}: {os.strerror(errno.ENOENT)}")
        return fid

    def _found(self, path: str) -> int | None:
        """Give a fid for a path; None if only its last part is not there."""
        names = [name for name in path.split("/") if name]
        fid, at, done = self._new(), ROOT, 0
        try:
            while True:
                part = names[done : done + MAX_WALK]
                (qids,) = self._call("Twalk", at, fid, part)
                at, done = (fid, done + len(part)) if len(qids) == len(part) else (at, done + len(qids))
                if len(qids) < len(part):
                    raise FsError(errno.ENOENT)
                if done == len(names):
                    return fid
        except FsError as error:
            self._free.append(fid)
            if at == fid:
                self._call("Tclunk", fid)
            if error.errno == errno.ENOENT and done >= len(names) - 1:
                return None
            raise _at(path, error) from error

    def _kept(self, path: str, access: int) -> int:
        fid = self._open.get((path, access))
        if fid is None:
            fid = self._walked(path)
            if access >= 0:
                try:
                    self._call("Tlopen", fid, access)
                except FsError:
                    self._clunk(fid)
                    raise
            self._open[path, access] = fid
        return fid

    def _forget(self, path: str, access: int) -> None:
        fid = self._open.pop((path, access), None)
        if fid is not None:
            with contextlib.suppress(FsError):  # what was begun is lost with the file
                self._clunk(fid)

    def _clunk(self, fid: int) -> None:
        if self._sock.fileno() >= 0:  # else it went with the connection, and why is being said
            self._free.append(fid)
            self._call("Tclunk", fid)

    def _call(self, name: str, *values: Any, tag: int = 1) -> tuple[Any, ...]:
        number = TYPES[name]
        try:
            request = LINUX.encode[number](tag, *values)
        except struct.error as error:
            raise FsError(errno.ENAMETOOLONG, f"{name}: a text has at most 65,535 bytes") from error
        try:
            self._sock.sendall(request)
            got, answered, answer = LINUX.decoded(self._receive())
        except Malformed as error:
            self._sock.close()
            what = f"what answers is no 9P server ({error}); the connection is closed"
            raise FsError(errno.EPROTO, f"{name}: {what}") from error
        except OSError as error:  # what is under way would answer the next call
            self._sock.close()
            if isinstance(error, FsError):
                raise
            code = errno.ETIMEDOUT if isinstance(error, TimeoutError) else error.errno or errno.EIO
            raise FsError(code, f"{name}: {os.strerror(code)}; the connection is closed") from error
        if got == _ERROR:
            raise FsError(answer[0])
        if (got, answered) != (number + 1, tag):
            raise FsError(errno.EPROTO, f"message {got} {answered} is no answer to {name} {tag}")
        return answer

    def _receive(self) -> bytes:
        buffer = self._buffer
        while True:
            if len(buffer) >= HEADER.size:
                size = HEADER.unpack_from(buffer)[0]
                if not HEADER.size <= size <= self._msize:
                    raise Malformed(f"a message of {size} bytes")
                if len(buffer) >= size:
                    self._buffer = buffer[size:]
                    return buffer[:size]
            data = self._sock.recv(1 << 18)
            if not data:
                raise FsError(errno.ECONNRESET, "the file server has closed the connection")
            buffer += data

    def close(self) -> None:
        """End the connection: who was a component is none any more."""
        self._sock.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _at(path: str, error: FsError) -> FsError:
    """Say which file an error is about; where JSON is refused, also where it says why."""
    code = error.errno or errno.EIO
    folder, _, name = path.rpartition("/")
    more = f"; {folder}/health says why" if code == errno.EINVAL and name in ("status", "config") else ""
    return FsError(code, f"{path}: {os.strerror(code)}{more}")
