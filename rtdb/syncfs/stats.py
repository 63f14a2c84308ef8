"""Stats as bytes: what directories are read as, and the stat record of the older dialects.

entry  qid[13] offset[8] type[1] name[s]                                               9P2000.L, Treaddir
stat   size[2] type[2] dev[4] qid[13] mode[4] atime[4] mtime[4] length[8] name[s] uid[s] gid[s] muid[s]
       and in 9P2000.u  extension[s] n_uid[4] n_gid[4] n_muid[4]
"""

import errno
import stat
import struct
from dataclasses import dataclass

from ..errors import AgedOut
from .codec import DIR, FILE, NO_UID, UNIX, Dialect, Malformed, Qid, encoded_text
from .errors import FsError
from .nodes import Attr, FreeDir, FreeFile, Node
from .past import PastRoot
from .policy import Who

DMDIR = 0x80000000
KEEP, KEEP_LENGTH = 0xFFFFFFFF, 0xFFFFFFFFFFFFFFFF  # of a wstat: leave it
_ENTRY = struct.Struct("<BIQQB")
_STAT = struct.Struct("<HIBIQIIIQ")
_U16, _IDS = struct.Struct("<H"), struct.Struct("<III")


def entry_rows(listing: list[tuple[str, Node]], first: int, version: int, most_bytes: int) -> bytes:
    """Give entries from one on, as many as have room; EINVAL if not even one has."""
    rows: list[bytes] = []
    size = 0
    for k in range(first, len(listing)):
        name, node = listing[k]
        kind, d_type = (DIR, 4) if node.is_dir else (FILE, 8)
        row = _ENTRY.pack(kind, version & 0xFFFFFFFF, node.path, k + 1, d_type) + encoded_text(name)
        size += len(row)
        if size > most_bytes:
            if not rows:
                raise FsError(errno.EINVAL, "no room for one entry")
            break
        rows.append(row)
    return b"".join(rows)


def whole_stats(listing: bytes, offset: int, most_bytes: int) -> bytes:
    """Give as many whole stats of a row of them as have room; EINVAL if not even one has, or none begins there."""
    end = 0
    while end < offset and end < len(listing):
        end += 2 + _U16.unpack_from(listing, end)[0]
    if end != offset:
        raise FsError(errno.EINVAL, "a directory is read from its beginning, or where the last read ended")
    while end < len(listing):
        size = 2 + _U16.unpack_from(listing, end)[0]
        if end + size - offset > most_bytes:
            break
        end += size
    if end == offset < len(listing):
        raise FsError(errno.EINVAL, "no room for one entry")
    return listing[offset:end]


def stat_record(dialect: Dialect, node: Node, name: str, attr: Attr) -> bytes:
    """Spell a stat, its own length in front."""
    mode = attr.mode & 0o777 | (DMDIR if stat.S_ISDIR(attr.mode) else 0)
    qid, s = qid_of(node, attr.version), (attr.mtime_ns // 1_000_000_000) & 0xFFFFFFFF
    body = _STAT.pack(0, 0, *qid, mode, s, s, 0 if node.is_dir else attr.size)
    body += encoded_text(name) + encoded_text(str(attr.uid)) + encoded_text(str(attr.gid)) + encoded_text("")
    if dialect is UNIX:
        body += encoded_text("") + _IDS.pack(attr.uid, attr.gid, NO_UID)
    return _U16.pack(len(body)) + body


def qid_of(node: Node, version: int) -> Qid:
    """Give a node's qid."""
    return Qid(DIR if node.is_dir else FILE, version & 0xFFFFFFFF, node.path)


def attr_or_aged(node: Node, cycle: int, who: Who) -> Attr:
    """Tell about an entry of a directory, also if what it holds has aged out."""
    try:
        return node.attr(cycle, who)
    except AgedOut:
        return Attr(stat.S_IFREG | 0o444, 0, 0, 0)


def name_of(node: Node) -> str:
    """Give the name of a node, "/" of a root."""
    if isinstance(node, FreeFile | FreeDir):
        return node.name or "/"
    if node.parent is None or node.parent is node:
        return "/"
    if isinstance(node, PastRoot):
        return str(node.at)
    return next((name for name, other in node.parent.entries(0) if other.path == node.path), "/")


@dataclass(frozen=True, slots=True)
class Wstat:
    """What a wstat asks for; None, or no name, where it asks for nothing."""

    mode: int | None
    uid: int | None
    gid: int | None
    mtime_ns: int | None
    length: int | None
    name: str

    @classmethod
    def parse(cls, dialect: Dialect, record: bytes) -> "Wstat":
        """Read the record; Malformed where it is none."""
        try:
            _, _, _, _, _, mode, _, mtime_s, length = _STAT.unpack_from(record, 2)
            texts, at = [], 2 + _STAT.size
            for _ in range(5 if dialect is UNIX else 4):
                (n,) = _U16.unpack_from(record, at)
                texts.append(record[at + 2 : at + 2 + n].decode("utf-8", "surrogateescape"))
                at += 2 + n
            uid, gid, _ = _IDS.unpack_from(record, at) if dialect is UNIX else (KEEP, KEEP, KEEP)
        except struct.error as error:
            raise Malformed(str(error)) from error
        return cls(
            mode=None if mode == KEEP else mode & 0o777,
            uid=None if uid == KEEP else uid,
            gid=None if gid == KEEP else gid,
            mtime_ns=None if mtime_s == KEEP else mtime_s * 1_000_000_000,
            length=None if length == KEEP_LENGTH else length,
            name=texts[0].rpartition("/")[2],
        )

    @property
    def is_empty(self) -> bool:
        """Whether it changes nothing: how the older dialects say fsync."""
        return not self.name and self.attributes_are_kept and self.length is None

    @property
    def attributes_are_kept(self) -> bool:
        """Whether it leaves mode, owner and time."""
        return self.mode is self.uid is self.gid is self.mtime_ns is None
