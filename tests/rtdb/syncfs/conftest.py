"""What the tests of the file server share: a stepped store behind a service, and clients without sockets."""

import errno
import json
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from rtdb import Store
from rtdb.syncfs import Service
from rtdb.syncfs.codec import BY_NAME, MESSAGES, NO_UID, NOFID, NOTAG, TYPES

ROOT = 0  # fid of what was attached
O_RDONLY, O_WRONLY, O_RDWR, O_EXCL, O_TRUNC, O_APPEND = 0, 1, 2, 0o200, 0o1000, 0o2000
LOOK, STAT = 0x17FF, 0x3FFF  # masks of getattr: Linux' lookup, and stat(2)
SET_SIZE, REMOVEDIR = 0x68, 0x200  # as Linux truncates, and as it removes a directory
EVERY = 10  # ticks from one edge of `/clock` to the next


class Refused(Exception):
    """A request was answered with an error; `code` is Linux' number, 0 in the dialect that has none."""

    def __init__(self, code: int, text: str = "") -> None:
        super().__init__(f"{errno.errorcode.get(code, code)} {text}")
        self.code, self.text = code, text


class Attributes(dict[str, Any]):
    """What a getattr tells, by name."""

    NAMES = (
        "valid", "qid", "mode", "uid", "gid", "nlink", "rdev", "size", "blksize", "blocks", "atime_s", "atime_ns",
        "mtime_s", "mtime_ns", "ctime_s", "ctime_ns", "btime_s", "btime_ns", "gen", "data_version",
    )  # fmt: skip

    def __init__(self, values: tuple[Any, ...]) -> None:
        super().__init__(zip(self.NAMES, values, strict=True))

    @property
    def t_ns(self) -> int:
        return self["mtime_s"] * 1_000_000_000 + self["mtime_ns"]


class P9:
    """A client of a service: encodes requests, keeps the replies by their tags."""

    def __init__(self, service: Service, dialect: str = "9P2000.L", token: str = "", msize: int = 1 << 17) -> None:
        self.dialect, self.replies = BY_NAME[dialect], dict[int, list[tuple[int, tuple[Any, ...]]]]()
        self.order: list[int] = []  # tags in the order of their replies
        self.session = service.begin(self._taken)
        self._service, self._tag, self._fid = service, 0, ROOT
        self.msize, self.version = self.call("Tversion", msize, dialect, tag=NOTAG)
        if self.version != dialect:
            raise Refused(errno.EPROTO, f"the server speaks {self.version}")
        self.attach(ROOT, aname=token)

    def _taken(self, data: bytes) -> None:
        number, tag, values = self.dialect.decoded(data)
        self.replies.setdefault(tag, []).append((number, values))
        self.order.append(tag)

    def attach(self, fid: int, uname: str = "", aname: str = "", n_uname: int = NO_UID) -> Any:
        values = (fid, NOFID, uname, aname) if self.version == "9P2000" else (fid, NOFID, uname, aname, n_uname)
        return self.call("Tattach", *values)

    def send(self, name: str, *values: Any, tag: int | None = None) -> int:
        """Send a request, returns its tag."""
        if tag is None:
            self._tag = tag = self._tag % 0xFFF0 + 1
        self.session.feed(self.dialect.encode[TYPES[name]](tag, *values))
        return tag

    def reply(self, tag: int) -> tuple[Any, ...] | None:
        """Take the reply to a request, if it is there; there is never a second one."""
        found = self.replies.pop(tag, None)
        if found is None:
            return None
        assert len(found) == 1, f"tag {tag} was answered {len(found)} times"
        number, values = found[0]
        if MESSAGES[number].name == "Rlerror":
            raise Refused(values[0])
        if MESSAGES[number].name == "Rerror":
            raise Refused(values[1] if len(values) > 1 else 0, values[0])
        return values

    def call(self, name: str, *values: Any, tag: int | None = None) -> tuple[Any, ...]:
        """Send a request that is answered at once."""
        reply = self.reply(self.send(name, *values, tag=tag))
        assert reply is not None, f"{name} waits"
        return reply

    def hang_up(self) -> None:
        self._service.end(self.session)

    # -- files ----------------------------------------------------------------------------------------------------

    @property
    def linux(self) -> bool:
        return self.version == "9P2000.L"

    def new(self) -> int:
        self._fid += 1
        return self._fid

    def walk(self, path: str, at: int = ROOT) -> int:
        """Give a fid for a path."""
        names, fid = [name for name in path.split("/") if name], self.new()
        (qids,) = self.call("Twalk", at, fid, names)
        if len(qids) < len(names):
            raise Refused(errno.ENOENT, "a short walk")
        return fid

    def open(self, path: str, flags: int = O_RDONLY) -> int:
        """Open a file. Linux sends a truncation as a setattr behind the open."""
        fid = self.walk(path)
        try:
            if self.linux:
                self.call("Tlopen", fid, flags & ~O_TRUNC)
                if flags & O_TRUNC:
                    self.truncate(fid, 0)
            else:
                mode = (flags & 3) | (0x10 if flags & O_TRUNC else 0) | (0x80 if flags & O_APPEND else 0)
                self.call("Topen", fid, mode)
        except Refused:
            self.clunk(fid)
            raise
        return fid

    def create(self, path: str, flags: int = O_WRONLY | O_EXCL) -> int:
        """Make a file and open it."""
        folder, _, name = path.rpartition("/")
        fid = self.walk(folder)
        try:
            if self.linux:
                self.call("Tlcreate", fid, name, flags, 0o644, 0)
            else:
                more = ("",) if self.version == "9P2000.u" else ()
                self.call("Tcreate", fid, name, 0o644, flags & 3, *more)
        except Refused:
            self.clunk(fid)
            raise
        return fid

    def clunk(self, fid: int) -> None:
        self.call("Tclunk", fid)

    def truncate(self, fid: int, size: int) -> None:
        self.call("Tsetattr", fid, SET_SIZE, 0, 0, 0, size, 0, 0, 0, 0)

    def pread(self, fid: int, offset: int, count: int = 1 << 20) -> bytes:
        return self.call("Tread", fid, offset, min(count, self.msize - 24))[0]

    def pwrite(self, fid: int, data: bytes, offset: int = 0) -> None:
        """Write, in pieces of the message size as Linux does."""
        for at in range(0, len(data) or 1, self.msize - 24):
            piece = data[at : at + self.msize - 24]
            assert self.call("Twrite", fid, offset + at, piece) == (len(piece),)

    def fsync(self, fid: int) -> None:
        self.call("Tfsync", fid, 0)

    def read(self, path: str) -> bytes:
        """Read a file as `cat` does: until a reply is empty."""
        fid = self.open(path)
        try:
            pieces = [self.pread(fid, 0)]
            while pieces[-1]:
                pieces.append(self.pread(fid, sum(map(len, pieces))))
        finally:
            self.clunk(fid)
        return b"".join(pieces)

    def json(self, path: str) -> Any:
        return json.loads(self.read(path))

    def write(self, path: str, data: bytes, *, sync: bool = False) -> None:
        """Write a file as `echo > path` does: make or truncate, write, close."""
        try:
            fid = self.open(path, O_WRONLY | O_TRUNC)
        except Refused as error:
            if error.code != errno.ENOENT:
                raise
            fid = self.create(path)
        try:
            self.pwrite(fid, data)
            if sync:
                self.fsync(fid)
        finally:
            self.clunk(fid)

    def append(self, path: str, data: bytes) -> None:
        """Append as `echo >> path` does: at the offset that the client believes to be the end."""
        fid = self.open(path, O_WRONLY | O_APPEND)
        self.pwrite(fid, data, self.look(path)["size"])
        self.clunk(fid)

    def ls(self, path: str = "") -> list[str]:
        """List a directory, in Linux' dialect."""
        fid = self.walk(path)
        self.call("Tlopen", fid, 0o200000)
        names, offset = list[str](), 0
        while data := self.call("Treaddir", fid, offset, self.msize - 24)[0]:
            at = 0
            while at < len(data):
                end = at + 24 + int.from_bytes(data[at + 22 : at + 24], "little")
                offset = int.from_bytes(data[at + 13 : at + 21], "little")
                names.append(data[at + 24 : end].decode())
                at = end
        self.clunk(fid)
        assert names[:2] == [".", ".."]
        return sorted(names[2:])

    def look(self, path: str) -> Attributes:
        """Look at a file as a lookup does, which never waits."""
        fid = self.walk(path)
        try:
            return Attributes(self.call("Tgetattr", fid, LOOK))
        finally:
            self.clunk(fid)

    def stat(self, path: str = "clock") -> int:
        """Begin a stat(2) of a file; returns its tag."""
        fid = self.walk(path)
        return self.send("Tgetattr", fid, STAT) if self.linux else self.send("Tstat", fid)

    def told(self, tag: int) -> Attributes:
        """Take the answer of a stat."""
        values = self.reply(tag)
        assert values is not None, "the stat still waits"
        return Attributes(values)

    def mkdir(self, path: str) -> None:
        folder, _, name = path.rpartition("/")
        fid = self.walk(folder)
        try:
            self.call("Tmkdir", fid, name, 0o755, 0)
        finally:
            self.clunk(fid)

    def rm(self, path: str, flags: int = 0) -> None:
        folder, _, name = path.rpartition("/")
        fid = self.walk(folder)
        try:
            self.call("Tunlinkat", fid, name, flags)
        finally:
            self.clunk(fid)

    def mv(self, path: str, new: str) -> None:
        (folder, _, name), (to, _, new_name) = path.rpartition("/"), new.rpartition("/")
        old_fid = self.walk(folder)
        try:
            new_fid = self.walk(to)
            try:
                self.call("Trenameat", old_fid, name, new_fid, new_name)
            finally:
                self.clunk(new_fid)
        finally:
            self.clunk(old_fid)


class Rig:
    """A stepped store, its file server without sockets, and its clients."""

    def __init__(self, store: Store, **options: Any) -> None:
        self.store, self.options = store, options
        self.service = Service(store, **options)

    def client(self, dialect: str = "9P2000.L", token: str = "", msize: int = 1 << 17) -> P9:
        return P9(self.service, dialect, token, msize)

    def tick(self, times: int = 1) -> None:
        for _ in range(times):
            self.store.tick()
            self.service.edge(time.monotonic())

    def edge(self, times: int = 1) -> None:
        """Go on to the next edge of `/clock`."""
        for _ in range(times):
            self.tick(EVERY - self.store.cycle % EVERY)

    def stand(self, for_s: float) -> None:
        """Let the host's time go on, and the store's stand."""
        self.service.look(time.monotonic() + for_s)

    def again(self) -> None:
        """Begin anew with another server, behind one that ended."""
        self.service.close()
        self.service = Service(self.store, **self.options)


@pytest.fixture
def make_rig(unique: Callable[[], str]) -> Iterator[Callable[..., Rig]]:
    """Makes rigs: `shared` ones have a named store, in which components have health."""
    rigs: list[Rig] = []

    def make(*, shared: bool = False, size: int = 8 << 20, **options: Any) -> Rig:
        store = Store.create(unique() if shared else None, size=size)
        try:
            rigs.append(Rig(store, **options))
        except BaseException:
            store.close()
            raise
        return rigs[-1]

    yield make
    for rig in rigs:
        rig.service.close()
        rig.store.close()


@pytest.fixture
def rig(make_rig: Callable[..., Rig]) -> Rig:
    """A private store behind a server."""
    return make_rig()


@pytest.fixture
def fs(rig: Rig) -> P9:
    """A client of it, of Linux' dialect."""
    return rig.client()
