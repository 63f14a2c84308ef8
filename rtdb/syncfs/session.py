"""A session: one connection's messages and the answers to them. Sans I/O: bytes come in by `feed`, go out by `send`.

One handler per message, guards first. A handler returns the reply, raises what is wrong (errors.py has the numbers),
or returns None for a stat of a clock, which is answered at the next edge. Replies may overtake each other.
"""

import errno
import logging
import math
import os
import struct
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from ..errors import RtdbError
from .codec import (
    HEADER,
    IO_HEADER,
    LINUX,
    NO_UID,
    PLAIN,
    TYPES,
    UNIX,
    Malformed,
    Qid,
    dialect_for,
)
from .draft import Draft
from .errors import FsError, errno_of
from .fids import Fid, Fids, is_gone
from .nodes import ClockFile, Directory, File, FreeDir, FreeFile, Node
from .pace import Pace
from .policy import Tokens
from .seats import Seat
from .stats import DMDIR, Wstat, attr_or_aged, entry_rows, name_of, qid_of, stat_record, whole_stats
from .tree import Tree
from .waiting import Waiter, Waiting

log = logging.getLogger(__name__)
ALL = 0x3FFF  # mask of getattr in a stat(2); a look while walking asks for less
O_ACCESS, O_EXCL, O_TRUNC, O_APPEND, O_DIRECTORY = 0o3, 0o200, 0o1000, 0o2000, 0o200000
OREAD, OWRITE, ORDWR, OEXEC, OTRUNC, ORCLOSE, OAPPEND = 0, 1, 2, 3, 0x10, 0x40, 0x80
DMAPPEND = 0x40000000
SPECIAL = 0x02000000 | 0x01000000 | 0x00800000 | 0x00200000 | 0x00100000  # symlink, link, device, fifo, socket
SET_MODE, SET_UID, SET_GID, SET_SIZE, SET_MTIME, SET_MTIME_TO = 0x1, 0x2, 0x4, 0x8, 0x20, 0x100
ENTRY_BYTES = 128  # of memory for an entry of a listing
V9FS_MAGIC, BLOCK, AT_REMOVEDIR = 0x01021997, 4096, 0x200


class How(NamedTuple):
    """How a file is opened."""

    access: int  # O_RDONLY, O_WRONLY or O_RDWR
    append: bool
    truncate: bool = False


class Session:
    """One connection."""

    def __init__(
        self,
        tree: Tree,
        waiting: Waiting,
        tokens: Tokens,
        send: Callable[[bytes], None],
        *,
        trace: Callable[[str], None] | None = None,
    ) -> None:
        self._tree, self._waiting, self._tokens, self._send, self._trace = tree, waiting, tokens, send, trace
        self._limits, self._core = tree.limits, tree.store.core
        self._buffer = bytearray()
        self._fids = Fids(tree)
        self._held: dict[int, None] = {}  # tags of stats that wait
        self._dialect, self._msize = PLAIN, tree.limits.min_msize
        self._begun = False
        self.attached = False  # it has said who it is
        self.over = False  # the connection is to be closed
        self.paused = False  # the client does not take its replies: nothing more is answered
        self.requests = 0
        self.missed = 0  # edges at which nobody waited who had waited for one before
        self._woken: dict[Pace, int] = {}
        self._handlers = self._make_handlers()

    # -- bytes ----------------------------------------------------------------------------------------------------

    def feed(self, data: bytes, at_most: int = 1 << 30, for_s: float = math.inf) -> bool:
        """Take bytes as they came, and answer; see go_on."""
        self._buffer += data
        return self.go_on(at_most, for_s)

    def go_on(self, at_most: int = 1 << 30, for_s: float = math.inf) -> bool:
        """Answer so many messages, and so long, as long as replies are taken; says whether there may be more."""
        buffer, at, last, until_s = self._buffer, 0, self.requests + at_most, time.monotonic() + for_s
        more = False
        while not self.paused and not self.over and len(buffer) - at >= HEADER.size:
            more = self.requests >= last or time.monotonic() > until_s
            if more:
                break
            size = HEADER.unpack_from(buffer, at)[0]
            if size < HEADER.size or size > self._msize:
                self._end(f"a message of {size} bytes, {HEADER.size} to {self._msize} are agreed upon")
                break
            if len(buffer) - at < size:
                break
            self._answer(bytes(buffer[at : at + size]))
            at += size
        if at:
            del buffer[:at]
        return more

    def _end(self, why: str) -> None:
        log.warning("a connection is closed: %s", why)
        self.over = True

    def _answer(self, message: bytes) -> None:
        number, tag = message[4], message[5] | message[6] << 8
        self.requests += 1
        if self._trace is not None:
            self._trace(f"-> {self._dialect.spelled(message)}")
        handler = self._handlers.get(number)
        try:
            if tag in self._held:
                self._end(f"tag {tag} is in use")
                return
            if handler is None or number not in self._dialect.decode:
                raise FsError(errno.EOPNOTSUPP)
            if not self._begun and number != TYPES["Tversion"]:
                raise FsError(errno.EPROTO, "the version comes first")
            reply = handler(tag, *self._dialect.decode[number](message))
        except RtdbError as error:
            reply = self._error(tag, errno_of(error))
        except (Malformed, struct.error) as error:
            log.debug("malformed: %s", error)
            reply = self._error(tag, errno.EPROTO)
        except Exception:  # ours, not the client's: it must harm nobody else
            log.exception("message %d", number)
            reply = self._error(tag, errno.EIO)
        if reply is not None:
            self._out(reply)

    def _out(self, reply: bytes) -> None:
        if self._trace is not None:
            self._trace(f"<- {self._dialect.spelled(reply)}")
        self._send(reply)

    def _error(self, tag: int, code: int) -> bytes:
        if self._dialect is LINUX:
            return LINUX.encode[TYPES["Rlerror"]](tag, code)
        values = (os.strerror(code), code) if self._dialect is UNIX else (os.strerror(code),)
        return self._dialect.encode[TYPES["Rerror"]](tag, *values)

    def _reply(self, name: str, tag: int, *values: Any) -> bytes:
        return self._dialect.encode[TYPES[name]](tag, *values)

    def edge(self) -> None:
        """An edge of the tree's pace has come."""
        self._fids.edge()

    def close(self) -> None:
        """The connection is over: fids and held stats go with it, and revisions that are not finished."""
        self.over = True
        self._reset()
        self._handlers.clear()  # they hold this session, and nothing collects rings in real time

    def _reset(self) -> None:
        for tag in self._held:
            self._waiting.cancel((self, tag))
        self._held.clear()
        self._fids.clear()
        for seat in self._tree.seats.values():
            seat.rise(self)

    # -- fids -----------------------------------------------------------------------------------------------------

    def _cycle(self, fid: Fid) -> int:
        """Give the cut that a mount sees: that of its last edge."""
        return fid.pace.last(self._core.cycle)

    def _shown(self, fid: Fid) -> int:
        """Give the cut that a file shows: a clock's own edge, else that of the mount."""
        pace = fid.node.pace_of(fid.who) if isinstance(fid.node, ClockFile) else fid.pace
        return pace.last(self._core.cycle)

    def _qid(self, node: Node, fid: Fid) -> Qid:
        cycle = self._core.cycle
        if isinstance(node, ClockFile):
            pace = node.pace_of(fid.who)
            version = pace.count(pace.last(cycle))
        else:
            version = fid.pace.last(cycle)
        return qid_of(node, version)

    # -- messages of all dialects ---------------------------------------------------------------------------------

    def _version(self, tag: int, msize: int, version: str) -> bytes:
        self._reset()
        dialect = dialect_for(version)
        if dialect is None or msize < self._limits.min_msize:
            self._begun = False
            return PLAIN.encode[TYPES["Rversion"]](tag, min(msize, self._limits.msize), "unknown")
        self._dialect, self._msize, self._begun = dialect, min(msize, self._limits.msize), True
        return self._reply("Rversion", tag, self._msize, dialect.name)

    def _auth(self, _tag: int, _afid: int, _uname: str, _aname: str, _uid: int = NO_UID) -> bytes:
        raise FsError(errno.ENOENT, "no authentication is needed")

    def _attach(self, tag: int, fid: int, _afid: int, uname: str, aname: str, n_uname: int = NO_UID) -> bytes:
        who = self._tokens.who((aname, uname), 0 if n_uname == NO_UID else n_uname)
        if aname not in ("", "/") and who.component is None and not who.operator:
            raise FsError(errno.EACCES, "aname is no token of this server")
        tree = self._tree
        new = Fid(tree.root, who, tree.pace_of(who.component))
        self._fids.add(fid, new)
        if who.component is not None:
            try:
                tree.seat_of(who.component).sit(self)
            except RtdbError:
                self._fids.forget(fid)
                raise
        self.attached = True
        return self._reply("Rattach", tag, self._qid(tree.root, new))

    def _flush(self, tag: int, oldtag: int) -> bytes:
        if oldtag in self._held:
            del self._held[oldtag]
            self._waiting.cancel((self, oldtag))
        return self._reply("Rflush", tag)

    def _walk(self, tag: int, number: int, newfid: int, names: list[str]) -> bytes:
        fid = self._fids[number]
        if newfid != number and newfid in self._fids:
            raise FsError(errno.EBADF, f"fid {newfid} is in use")
        if (names or newfid == number) and fid.opened is not None:
            raise FsError(errno.EINVAL, "this fid is open")
        node, cycle = fid.node, self._cycle(fid)
        qids: list[Qid] = []
        for name in names:
            try:
                node = self._step(node, name, cycle)
            except FsError:
                if not qids:
                    raise
                return self._reply("Rwalk", tag, qids)
            qids.append(self._qid(node, fid))
        new = Fid(node, fid.who, fid.pace)
        if newfid == number:
            self._fids.replace(number, new)
        else:
            self._fids.add(newfid, new)
        return self._reply("Rwalk", tag, qids)

    def _step(self, node: Node, name: str, cycle: int) -> Node:
        if not isinstance(node, Directory):
            raise FsError(errno.ENOTDIR)
        if name == "..":
            return node.parent or node
        self._tree.check_name(name)
        found = node.child(name, cycle)
        if found is None:
            raise FsError(errno.ENOENT)
        return found

    def _read(self, tag: int, number: int, offset: int, count: int) -> bytes:
        fid = self._fids[number]
        if fid.opened is None or fid.opened == OWRITE:
            raise FsError(errno.EBADF, "this fid is not open for reading")
        count = min(count, self._msize - IO_HEADER)
        node = fid.node
        if isinstance(node, Directory):
            if self._dialect is LINUX:
                raise FsError(errno.EISDIR)
            return self._reply("Rread", tag, self._stats_of(fid, node, offset, count))
        data = fid.reading
        if offset == 0 or not isinstance(data, bytes):
            assert isinstance(node, File)
            data = self._tree.read(node, self._shown(fid), fid.who)
            self._fids.keep(fid, data, len(data))
            if fid.who.component is not None:
                self._tree.note_read(fid.who.component, node, self._shown(fid))
        return self._reply("Rread", tag, data[offset : offset + count])

    def _write(self, tag: int, number: int, offset: int, data: bytes) -> bytes:
        fid = self._fids[number]
        if fid.draft is None or fid.opened == OREAD:
            raise FsError(errno.EBADF, "this fid is not open for writing")
        assert isinstance(fid.node, File)
        if is_gone(fid.node):
            raise FsError(errno.ENOENT, "it was removed")
        draft = fid.draft
        end = draft.n_bytes + len(data) if draft.append else offset + len(data)
        try:
            self._tree.room_for(fid.node, end)
            self._fids.check_room(end, draft.n_bytes)
            draft.write(offset, data)
        except RtdbError as error:
            draft.refused(offset, error)
            raise
        return self._reply("Rwrite", tag, len(data))

    def _clunk(self, tag: int, number: int) -> bytes:
        self._fids.drop(number)
        return self._reply("Rclunk", tag)

    def _remove(self, tag: int, number: int) -> bytes:
        fid = self._fids[number]
        self._fids.drop(number)
        self._remove_node(fid.node)
        return self._reply("Rremove", tag)

    def _remove_node(self, node: Node) -> None:
        if node.parent is None or node.parent is node:
            raise FsError(errno.EBUSY, "this is the root")
        if not isinstance(node, FreeFile | FreeDir):
            raise FsError(errno.EROFS if node.path >> 63 else errno.EACCES, "it belongs to the store")
        if node.parent.child(node.name, 0) is not node:
            raise FsError(errno.ENOENT)
        self._tree.remove(node.parent, node.name)

    # -- opening and creating -------------------------------------------------------------------------------------

    def _open_fid(self, fid: Fid, access: int, *, append: bool, truncate: bool, created: bool = False) -> None:
        if fid.opened is not None:
            raise FsError(errno.EBADF, "this fid is open")
        node = fid.node
        if access != OREAD or truncate:
            if isinstance(node, Directory):
                raise FsError(errno.EISDIR)
            assert isinstance(node, File)
            node.check_write(fid.who)
            self._fids.check_one_more()
            who = fid.who
            draft = Draft(
                node.base,
                lambda data: node.commit(data, who),  # not the fid, which holds the draft
                append=append,
                most_bytes=node.most_bytes,
                piece_bytes=self._msize - IO_HEADER,
                is_whole=node.is_whole,
                created=created,
            )
            self._fids.begin(fid, draft)
            if truncate:
                draft.truncate(0)
        fid.opened = access

    def _create(self, fid: Fid, name: str, mode: int, gid: int, how: How, *, exclusive: bool) -> Node:
        if not isinstance(fid.node, Directory):
            raise FsError(errno.ENOTDIR)
        if fid.opened is not None:
            raise FsError(errno.EBADF, "this fid is open")
        found = None if exclusive else fid.node.child(name, self._cycle(fid))
        fresh = found or self._tree.create(fid.node, name, mode, fid.who, gid)
        directory, fid.node = fid.node, fresh
        try:
            truncate = found is not None and how.truncate
            self._open_fid(fid, how.access, append=how.append, truncate=truncate, created=found is None)
        except RtdbError:
            fid.node = directory
            raise
        return fresh

    def _lopen(self, tag: int, number: int, flags: int) -> bytes:
        fid = self._fids[number]
        if flags & O_DIRECTORY and not fid.node.is_dir:
            raise FsError(errno.ENOTDIR)
        truncate = bool(flags & O_TRUNC) and flags & O_ACCESS != OREAD
        self._open_fid(fid, flags & O_ACCESS, append=bool(flags & O_APPEND), truncate=truncate)
        return self._reply("Rlopen", tag, self._qid(fid.node, fid), 0)

    def _lcreate(self, tag: int, number: int, name: str, flags: int, mode: int, gid: int) -> bytes:
        fid = self._fids[number]
        truncate = bool(flags & O_TRUNC) and flags & O_ACCESS != OREAD
        how = How(flags & O_ACCESS, bool(flags & O_APPEND), truncate)
        node = self._create(fid, name, mode, gid, how, exclusive=bool(flags & O_EXCL))
        return self._reply("Rlcreate", tag, self._qid(node, fid), 0)

    def _open(self, tag: int, number: int, mode: int) -> bytes:
        fid = self._fids[number]
        if mode & ORCLOSE:
            raise FsError(errno.EOPNOTSUPP, "nothing is removed by a close")
        access = OREAD if mode & 3 == OEXEC else mode & 3
        truncate = bool(mode & OTRUNC) and not fid.node.is_dir
        self._open_fid(fid, access, append=bool(mode & OAPPEND), truncate=truncate)
        return self._reply("Ropen", tag, self._qid(fid.node, fid), 0)

    def _tcreate(self, tag: int, number: int, name: str, perm: int, mode: int, _extension: str = "") -> bytes:
        fid = self._fids[number]
        if perm & SPECIAL:
            raise FsError(errno.EOPNOTSUPP, "there are files and directories")
        if mode & ORCLOSE:
            raise FsError(errno.EOPNOTSUPP, "nothing is removed by a close")
        if fid.opened is not None:
            raise FsError(errno.EBADF, "this fid is open")
        if perm & DMDIR:
            if not isinstance(fid.node, Directory):
                raise FsError(errno.ENOTDIR)
            fid.node = self._tree.mkdir(fid.node, name, perm, fid.who)
            fid.opened = OREAD
            node: Node = fid.node
        else:
            access = OREAD if mode & 3 == OEXEC else mode & 3
            append = bool(mode & OAPPEND or perm & DMAPPEND)
            node = self._create(fid, name, perm, 0, How(access, append), exclusive=True)
        return self._reply("Rcreate", tag, self._qid(node, fid), 0)

    # -- what a stat tells ----------------------------------------------------------------------------------------

    def _getattr(self, tag: int, number: int, mask: int) -> bytes | None:
        fid = self._fids[number]
        if mask & ALL == ALL and isinstance(fid.node, ClockFile):
            self._hold(tag, fid, fid.node, lambda: self._attributes(tag, fid))
            return None
        return self._attributes(tag, fid)

    def _attributes(self, tag: int, fid: Fid) -> bytes:
        attr = fid.node.attr(self._shown(fid), fid.who)
        s, ns = divmod(attr.mtime_ns, 1_000_000_000)
        blocks = (attr.size + 511) // 512
        return self._reply(
            "Rgetattr", tag, ALL, qid_of(fid.node, attr.version), attr.mode, attr.uid, attr.gid,
            2 if fid.node.is_dir else 1, 0, attr.size, BLOCK, blocks, s, ns, s, ns, s, ns, 0, 0, 0, attr.version,
        )  # fmt: skip

    def _hold(self, tag: int, fid: Fid, clock: ClockFile, made: Callable[[], bytes]) -> None:
        """Hold a stat of a clock until the next edge: of the clock's own pace, or that of the mount."""
        if len(self._held) >= self._limits.waiting:
            raise FsError(errno.EAGAIN, f"{self._limits.waiting} stats wait already")
        pace = clock.pace_of(fid.who)
        seat: Seat | None = None
        if clock.component is not None and fid.who.may_write(clock.component):
            seat = self._tree.seat_of(clock.component)
            self._fids.finish()
        asked = pace.last(self._core.cycle)
        woken = self._woken.get(pace)
        if woken is not None and asked > woken:
            self.missed += (asked - woken) // pace.every

        def answer() -> None:
            del self._held[tag]
            self._woken[pace] = pace.last(self._core.cycle)
            try:
                reply = made()
            except RtdbError as error:
                reply = self._error(tag, errno_of(error))
            self._out(reply)

        if seat is not None:
            seat.stat()  # behind `asked`: a barrier may tick at once
        self._held[tag] = None
        self._waiting.add((self, tag), pace, Waiter(asked, seat, time.monotonic(), answer))

    def _setattr(
        self, tag: int, number: int, valid: int, mode: int, uid: int, gid: int, size: int,
        _at_s: int, _at_ns: int, mt_s: int, mt_ns: int,
    ) -> bytes:  # fmt: skip
        fid = self._fids[number]
        if valid & SET_SIZE:
            self._truncate(fid, size)
        mtime_ns = None
        if valid & SET_MTIME:
            now_ns = self._tree.store.now_ns
            mtime_ns = (mt_s * 1_000_000_000 + mt_ns if valid & SET_MTIME_TO else now_ns) & 0x7FFFFFFFFFFFFFFF
        changes = valid & (SET_MODE | SET_UID | SET_GID) or (valid & SET_MTIME and not valid & SET_SIZE)
        if changes:
            self._tree.set_attr(
                fid.node,
                mode=mode if valid & SET_MODE else None,
                uid=uid if valid & SET_UID else None,
                gid=gid if valid & SET_GID else None,
                mtime_ns=mtime_ns,
            )
        return self._reply("Rsetattr", tag)

    def _truncate(self, fid: Fid, size: int) -> None:
        """Truncate: of a file that is open for writing it begins a revision, else it is one."""
        node = fid.node
        if not isinstance(node, File):
            raise FsError(errno.EISDIR)
        node.check_write(fid.who)
        self._tree.room_for(node, size)
        self._fids.check_room(size)
        if fid.draft is not None:
            fid.draft.truncate(size)
            return
        draft = self._fids.pristine(node)  # Linux asks for it by another fid than the one that it has opened
        if draft is not None:
            draft.truncate(size)
            return
        data = node.base()[:size]
        node.commit(data + bytes(size - len(data)), fid.who)

    # -- directories ----------------------------------------------------------------------------------------------

    def _readdir(self, tag: int, number: int, offset: int, count: int) -> bytes:
        fid = self._fids[number]
        node = fid.node
        if not isinstance(node, Directory):
            raise FsError(errno.ENOTDIR)
        if fid.opened is None:
            raise FsError(errno.EBADF, "this fid is not open")
        cycle = self._cycle(fid)
        listing = fid.reading
        if offset == 0 or not isinstance(listing, list):
            listing = [(".", node), ("..", node.parent or node), *node.entries(cycle)]
            self._fids.keep(fid, listing, ENTRY_BYTES * len(listing))
        rows = entry_rows(listing, offset, cycle, min(count, self._msize - IO_HEADER))
        if not rows:
            self._fids.keep(fid, None, 0)  # it was read to its end
        return self._reply("Rreaddir", tag, rows)

    def _stats_of(self, fid: Fid, node: Directory, offset: int, count: int) -> bytes:
        """Give whole stats of a directory's entries, as the older dialects read them."""
        stats = fid.reading
        if offset == 0 or not isinstance(stats, bytes):
            cycle = self._cycle(fid)
            stats = b"".join(
                stat_record(self._dialect, entry, name, attr_or_aged(entry, cycle, fid.who))
                for name, entry in node.entries(cycle)
            )
            self._fids.keep(fid, stats, len(stats))
        return whole_stats(stats, offset, count)

    def _stat(self, tag: int, number: int) -> bytes | None:
        fid = self._fids[number]

        def made() -> bytes:
            attr = fid.node.attr(self._shown(fid), fid.who)
            return self._reply("Rstat", tag, stat_record(self._dialect, fid.node, name_of(fid.node), attr))

        if isinstance(fid.node, ClockFile):
            self._hold(tag, fid, fid.node, made)
            return None
        return made()

    def _wstat(self, tag: int, number: int, record: bytes) -> bytes:
        fid = self._fids[number]
        asked = Wstat.parse(self._dialect, record)
        if asked.length is not None:
            self._truncate(fid, asked.length)
        if not asked.attributes_are_kept:
            mtime_ns = asked.mtime_ns if asked.length is None else None
            self._tree.set_attr(fid.node, mode=asked.mode, uid=asked.uid, gid=asked.gid, mtime_ns=mtime_ns)
        if fid.draft is not None and asked.is_empty:
            fid.draft.sync()
        if asked.name and asked.name != name_of(fid.node):
            self._rename_node(fid.node, fid.node.parent, asked.name)
        return self._reply("Rwstat", tag)

    def _rename_node(self, node: Node, to: Node | None, name: str) -> None:
        if not isinstance(node, FreeFile | FreeDir) or node.parent is None or node.parent is node:
            raise FsError(errno.EACCES, "it belongs to the store")
        if not isinstance(to, Directory):
            raise FsError(errno.ENOTDIR)
        if node.parent.child(node.name, 0) is not node:
            raise FsError(errno.ENOENT)
        self._tree.rename(node.parent, node.name, to, name)

    # -- messages of Linux' dialect -------------------------------------------------------------------------------

    def _statfs(self, tag: int, number: int) -> bytes:
        self._fids[number]
        size, unused = self._tree.store.memory
        limits, names = self._limits, self._tree.names
        free = unused // BLOCK
        return self._reply(
            "Rstatfs", tag, V9FS_MAGIC, BLOCK, size // BLOCK, free, free, limits.files, limits.files - names.count,
            self._tree.store.core.id & 0xFFFFFFFFFFFFFFFF, limits.name_bytes,
        )  # fmt: skip

    def _mkdir(self, tag: int, number: int, name: str, mode: int, gid: int) -> bytes:
        fid = self._fids[number]
        if not isinstance(fid.node, Directory):
            raise FsError(errno.ENOTDIR)
        node = self._tree.mkdir(fid.node, name, mode, fid.who, gid)
        return self._reply("Rmkdir", tag, self._qid(node, fid))

    def _unlinkat(self, tag: int, number: int, name: str, flags: int) -> bytes:
        fid = self._fids[number]
        if not isinstance(fid.node, Directory):
            raise FsError(errno.ENOTDIR)
        self._tree.remove(fid.node, name, want_dir=bool(flags & AT_REMOVEDIR))
        return self._reply("Runlinkat", tag)

    def _renameat(self, tag: int, number: int, name: str, to: int, new: str) -> bytes:
        old_dir, new_dir = self._fids[number].node, self._fids[to].node
        if not isinstance(old_dir, Directory) or not isinstance(new_dir, Directory):
            raise FsError(errno.ENOTDIR)
        self._tree.rename(old_dir, name, new_dir, new)
        return self._reply("Rrenameat", tag)

    def _rename(self, tag: int, number: int, to: int, name: str) -> bytes:
        self._rename_node(self._fids[number].node, self._fids[to].node, name)
        return self._reply("Rrename", tag)

    def _fsync(self, tag: int, number: int, _datasync: int) -> bytes:
        fid = self._fids[number]
        if fid.draft is not None:
            fid.draft.sync()
        return self._reply("Rfsync", tag)

    def _lock(self, tag: int, number: int, *_what: Any) -> bytes:
        self._fids[number]
        return self._reply("Rlock", tag, 0)  # granted: a single writer per file needs none

    def _getlock(self, tag: int, number: int, _type: int, start: int, length: int, pid: int, client: str) -> bytes:
        self._fids[number]
        return self._reply("Rgetlock", tag, 2, start, length, pid, client)  # F_UNLCK

    def _readlink(self, _tag: int, number: int) -> bytes:
        self._fids[number]
        raise FsError(errno.EINVAL, "there are no links")

    def _refuse(self, _tag: int, *_values: Any) -> bytes:
        raise FsError(errno.EOPNOTSUPP)

    def _make_handlers(self) -> dict[int, Callable[..., bytes | None]]:
        handlers: dict[str, Callable[..., bytes | None]] = {
            "Tversion": self._version, "Tauth": self._auth, "Tattach": self._attach, "Tflush": self._flush,
            "Twalk": self._walk, "Tread": self._read, "Twrite": self._write, "Tclunk": self._clunk,
            "Tremove": self._remove, "Topen": self._open, "Tcreate": self._tcreate, "Tstat": self._stat,
            "Twstat": self._wstat, "Tstatfs": self._statfs, "Tlopen": self._lopen, "Tlcreate": self._lcreate,
            "Trename": self._rename, "Treadlink": self._readlink, "Tgetattr": self._getattr,
            "Tsetattr": self._setattr, "Treaddir": self._readdir, "Tfsync": self._fsync, "Tlock": self._lock,
            "Tgetlock": self._getlock, "Tmkdir": self._mkdir, "Trenameat": self._renameat,
            "Tunlinkat": self._unlinkat, "Tsymlink": self._refuse, "Tmknod": self._refuse, "Tlink": self._refuse,
            "Txattrwalk": self._refuse, "Txattrcreate": self._refuse,
        }  # fmt: skip
        return {TYPES[name]: handler for name, handler in handlers.items()}
