"""Drafts: what is written through one open file, until it is a revision.

A revision is whole: truncation, writes and close make one. A file that is kept open and written anew from offset 0
gets a revision each time, without a tail of the one before; when it is finished shows only in the next write at 0, in
fsync or in the close, unless the revision before was a single write: then each write is one.
"""

import errno
from collections.abc import Callable

from .errors import FsError


class Draft:
    """Sans I/O: `commit` is called with each finished revision.

    base: gives the newest revision; most_bytes: of a revision; piece_bytes: a client splits its writes into pieces of
    this size, so that a shorter one ends a write.
    """

    __slots__ = (
        "_base",
        "_commit",
        "_data",
        "_ended",
        "_most",
        "_piece",
        "append",
        "dirty",
        "idle",
        "single",
        "truncated",
    )

    def __init__(
        self,
        base: Callable[[], bytes],
        commit: Callable[[bytes], None],
        *,
        append: bool,
        most_bytes: int,
        piece_bytes: int,
    ) -> None:
        self._base, self._commit, self.append = base, commit, append
        self._most, self._piece = most_bytes, piece_bytes
        self._data: bytearray | None = None
        self._ended = 0  # writes of this revision that have come to their end
        self.single = False  # the revision before was one write
        self.truncated = False  # this one began with a truncation: the close ends it
        self.dirty = False
        self.idle = False  # an edge has passed since the last write

    def truncate(self, n_bytes: int) -> None:
        """Begin a revision that holds what was there up to a size, zeros beyond its end."""
        if n_bytes > self._most:
            raise FsError(errno.EFBIG, f"{n_bytes} bytes, at most {self._most}")
        data = self._begun() if n_bytes else bytearray()
        del data[n_bytes:]
        data.extend(bytes(n_bytes - len(data)))
        self._data, self.truncated, self.dirty, self._ended = data, True, True, 0

    def write(self, offset: int, piece: bytes) -> None:
        """Take a piece. At offset 0 a new revision begins, unless one has just begun, or the file appends."""
        if self.append:
            offset = len(self._begun())
        elif offset == 0 and piece:
            self._begin_anew()
        data = self._begun()
        if offset + len(piece) > self._most:
            raise FsError(errno.EFBIG, f"{offset + len(piece)} bytes, at most {self._most}")
        if offset > len(data):
            data.extend(bytes(offset - len(data)))
        data[offset : offset + len(piece)] = piece
        self._data, self.dirty, self.idle = data, True, False
        if len(piece) < self._piece:
            self._ended += 1
            if self.single and not self.truncated:
                self.finish()

    def _begin_anew(self) -> None:
        if self._data is not None and not (self.truncated and not self._data):
            self.single = self._ended == 1
            self.finish()
            self.truncated = False
        if self._data is None or not self.truncated:
            self._data, self._ended = bytearray(), 0

    def _begun(self) -> bytearray:
        return self._data if self._data is not None else bytearray(self._base())

    def finish(self) -> None:
        """Make what there is a revision, if there is anything new."""
        if self.dirty and self._data is not None:
            self.dirty = False
            self._commit(bytes(self._data))

    def edge(self) -> None:
        """Note an edge: what was begun without a truncation, and left alone for a whole cycle, counts as finished."""
        if self.dirty and not self.truncated:
            if self.idle:
                self.finish()
            self.idle = True

    @property
    def pristine(self) -> bool:
        """Whether nothing was begun."""
        return self._data is None
