"""Drafts: what is written through one open file, until it is a revision.

A revision is whole: truncation, writes and close make one. If a piece of a long write is refused, none of it shows. A
file that is kept open and written anew from offset 0 gets a revision each time, without a tail of the one before. When
such a one is finished can be seen in a JSON file: when it is JSON. Elsewhere it shows in the next beginning, in fsync
or the close; while revisions are one write each, in the end of that write. What only patches a file is finished when it
is left alone for a whole cycle. Appended writes are revisions, each one.
"""

import contextlib
import errno
from collections.abc import Callable

from ..errors import RtdbError
from .errors import FsError

SHOWN_AT_ONCE_BYTES = 1 << 16  # larger files that are appended to become a revision at edges only


class Draft:
    """Sans I/O: `commit` is called with each finished revision.

    base: gives the newest revision; is_whole: says whether a content is complete, None where that cannot be seen;
    most_bytes: of a revision; piece_bytes: a client splits its writes into pieces of this size, so that a shorter one
    ends a write. created: the file was made for this, and nothing of it shows before the close.
    """

    __slots__ = (
        "_base", "_commit", "_data", "_end", "_ended", "_is_whole", "_kept", "_most", "_piece", "_refused", "_single",
        "_synced", "_tail", "append", "dirty", "idle", "truncated",
    )  # fmt: skip

    def __init__(
        self,
        base: Callable[[], bytes],
        commit: Callable[[bytes], None],
        *,
        append: bool,
        most_bytes: int,
        piece_bytes: int,
        is_whole: Callable[[bytes | bytearray], bool | None] = lambda _: None,
        created: bool = False,
    ) -> None:
        self._base, self._commit, self._is_whole, self.append = base, commit, is_whole, append
        self._most, self._piece = most_bytes, piece_bytes
        self._data: bytearray | None = bytearray() if created and not append else None
        self._tail = bytearray()  # what is appended to the newest revision, whatever that is by then
        self._end: int | None = None  # of the write that is under way: its next piece begins there
        self._refused: RtdbError | None = None  # a piece of this revision
        self._ended = 0  # writes of this revision that have come to their end
        self._single = self._kept = False  # the revision before, through this descriptor, was one write; there was one
        self._synced = False  # its user says by fsync what is whole
        self.truncated = created and not append  # this one began with a truncation: the close ends it
        self.dirty = False
        self.idle = False  # an edge has passed since the last write

    def truncate(self, n_bytes: int) -> None:
        """Begin a revision that holds what was there up to a size, zeros beyond its end."""
        if n_bytes > self._most:
            raise FsError(errno.EFBIG, f"{n_bytes} bytes, at most {self._most}")
        if self._tail:
            self.finish()
        if n_bytes == 0 and self._ended:
            self._end_before()
        data = self._begun() if n_bytes else bytearray()
        del data[n_bytes:]
        data.extend(bytes(n_bytes - len(data)))
        self._data, self.truncated, self.dirty, self.idle, self._ended = data, True, True, False, 0
        self._end = self._refused = None

    def write(self, offset: int, piece: bytes) -> None:
        """Take a piece. At offset 0 a new revision begins, unless one has just begun, or the file appends."""
        if self._refused is not None and offset:
            raise self._refused
        if not self.append:
            self._check(offset + len(piece))
        if not piece:
            return
        self._refused = None
        if self.append and self._data is None:
            self._append(piece)
            return
        if self.append:
            offset = len(self._begun())
        elif offset == 0 and self._data is not None and not (self.truncated and not self._data):
            self._end_before()
        data = self._begun() if offset or self._data is not None else bytearray()
        if self.append:
            self._check(offset + len(piece))
        if offset > len(data):
            data.extend(bytes(offset - len(data)))
        data[offset : offset + len(piece)] = piece
        self._data, self.dirty, self.idle = data, True, False
        self._end = offset + len(piece) if len(piece) == self._piece else None
        if len(piece) < self._piece:
            self._ended += 1
            self._show(data)

    def _append(self, piece: bytes) -> None:
        size = len(self._base()) + len(self._tail) + len(piece)
        self._check(size)
        self._tail += piece
        self.dirty, self.idle = True, False
        self._end = size if len(piece) == self._piece else None
        if len(piece) < self._piece and size <= SHOWN_AT_ONCE_BYTES:
            self.finish()

    def refused(self, offset: int, error: RtdbError) -> None:
        """Note that a piece was refused. As part of a longer write it takes all of the revision along."""
        if self._end is not None and (self.append or offset == self._end):
            self._data, self._tail, self._end, self.dirty = None, bytearray(), None, False
            self._refused = None if self.append else error

    @property
    def is_under_way(self) -> bool:
        """Whether the next piece of a long write is to come."""
        return self._end is not None

    def _check(self, n_bytes: int) -> None:
        if n_bytes > self._most:
            raise FsError(errno.EFBIG, f"{n_bytes} bytes, at most {self._most}")

    def _show(self, data: bytearray) -> None:
        """Make a write that has ended a revision, if it is one."""
        if self._waits_for_close:
            return
        whole = self._is_whole(data)
        if whole or (whole is None and self._single):
            self.finish()

    @property
    def _waits_for_close(self) -> bool:
        """Whether only fsync and the close end this revision: it began with a truncation, by one who does not keep the
        file open to write it again and again, or who says by fsync what is whole."""
        return self.truncated and (self._synced or not self._kept)

    def _end_before(self) -> None:
        """A new revision begins: the one before is finished. What was wrong with it is not the new one's fault."""
        if self._ended or self._data:  # an empty revision says nothing about how its user writes
            self._single = self._ended == 1
        self._kept, self.truncated, self._end = True, False, None
        with contextlib.suppress(RtdbError):
            self.finish()
        self._data, self._ended = bytearray(), 0

    def _begun(self) -> bytearray:
        return self._data if self._data is not None else bytearray(self._base())

    def finish(self) -> None:
        """Make what there is a revision, if there is anything new."""
        if not self.dirty:
            return
        self.dirty = False
        if self._tail:
            data, self._tail = self._base() + bytes(self._tail), bytearray()
            self._commit(data)
        elif self._data is not None:
            self._commit(bytes(self._data))

    def sync(self) -> None:
        """Make what there is a revision, and go on: a later close adds nothing by itself."""
        self.truncated, self._synced = False, True
        self.finish()

    def edge(self) -> None:
        """Note an edge: what was appended is finished, and what patches a file and was left alone for a whole cycle.

        Nothing is in the middle of a write, nor in a file that is written again and again, however long the next piece
        takes: the machine may be slow.
        """
        if not self.dirty or self.is_under_way or self._waits_for_close:
            return
        rewritten = self._kept and self._is_whole(b"") is None  # only the next beginning tells that this one is whole
        if self._tail or (self.idle and not rewritten):
            self.finish()
        self.idle = True

    @property
    def n_bytes(self) -> int:
        """How large it is."""
        return len(self._tail) + (len(self._data) if self._data is not None else 0)

    @property
    def pristine(self) -> bool:
        """Whether the file was opened just now: nothing was begun, nor finished."""
        return not (self.dirty or self._ended or self._data or self._synced)
