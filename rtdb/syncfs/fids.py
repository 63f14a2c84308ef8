"""Fids: what a client calls nodes by, and what it holds open through them, bounded in number and in bytes."""

import contextlib
import errno
import logging

from ..errors import RtdbError
from .codec import NOFID
from .draft import Draft
from .errors import FsError
from .nodes import File, FreeFile, Node, StatusFile
from .pace import Pace
from .policy import Who
from .tree import Tree

log = logging.getLogger(__name__)
SMALL_BYTES = 1 << 16  # drafts up to this size are not counted


class Fid:
    """What a client calls a node by, and what it does with it."""

    __slots__ = ("draft", "n_kept", "node", "opened", "pace", "reading", "who")

    def __init__(self, node: Node, who: Who, pace: Pace) -> None:
        self.node, self.who, self.pace = node, who, pace
        self.opened: int | None = None  # O_RDONLY, O_WRONLY or O_RDWR
        self.reading: bytes | list[tuple[str, Node]] | None = None  # the revision, or the listing, that is being read
        self.n_kept = 0  # about so many bytes it takes
        self.draft: Draft | None = None


def is_gone(node: Node) -> bool:
    """Whether a file was removed while somebody has it open."""
    return isinstance(node, FreeFile) and node.gone


class Fids:
    """Those of one connection."""

    def __init__(self, tree: Tree) -> None:
        self._tree, self._limits = tree, tree.limits
        self._of: dict[int, Fid] = {}
        self._writing: dict[Fid, None] = {}  # in the order of their opening
        self._kept_bytes = 0  # of all that is being read

    def __contains__(self, number: int) -> bool:
        return number in self._of

    def __getitem__(self, number: int) -> Fid:
        """EBADF where there is none."""
        fid = self._of.get(number)
        if fid is None:
            raise FsError(errno.EBADF, f"no fid {number}")
        return fid

    def add(self, number: int, fid: Fid) -> None:
        """Take a new one."""
        if number in self._of or number == NOFID:
            raise FsError(errno.EBADF, f"fid {number} is in use")
        if len(self._of) >= self._limits.fids:
            raise FsError(errno.EMFILE, f"{self._limits.fids} fids")
        self._of[number] = fid

    def replace(self, number: int, fid: Fid) -> None:
        """Let a number, of a fid that is not open, mean another."""
        self._of[number] = fid

    def forget(self, number: int) -> None:
        """Let go of a fid that was never opened."""
        del self._of[number]

    def drop(self, number: int) -> None:
        """Clunk: the draft is finished, the fid is gone whatever comes of it."""
        fid = self._of.pop(number, None)
        if fid is None:
            raise FsError(errno.EBADF, f"no fid {number}")
        self._writing.pop(fid, None)
        self._kept_bytes -= fid.n_kept
        if fid.draft is not None and not is_gone(fid.node):  # what was written goes with it
            assert isinstance(fid.node, File)
            try:
                fid.draft.finish()
            finally:
                self._tree.abandoned(fid.node)

    def clear(self) -> None:
        """Let go of all, and of revisions that are not finished."""
        self._of.clear()
        self._kept_bytes = 0
        for fid in self._writing:
            if isinstance(fid.node, File):
                self._tree.abandoned(fid.node)
        self._writing.clear()

    # -- reading --------------------------------------------------------------------------------------------------

    def keep(self, fid: Fid, reading: bytes | list[tuple[str, Node]] | None, n_bytes: int) -> None:
        """Pin what is being read, until its next beginning or the clunk."""
        self._kept_bytes -= fid.n_kept
        fid.reading, fid.n_kept = None, 0
        if self._kept_bytes + n_bytes > self._limits.reading_bytes:
            raise FsError(errno.ENOMEM, f"open for reading may be {self._limits.reading_bytes} bytes together")
        self._kept_bytes += n_bytes
        fid.reading, fid.n_kept = reading, n_bytes

    # -- writing --------------------------------------------------------------------------------------------------

    def check_one_more(self) -> None:
        """Refuse one more file that is open for writing."""
        if len(self._writing) >= self._limits.writing:
            raise FsError(errno.EMFILE, f"{self._limits.writing} files are open for writing")

    def check_room(self, n_bytes: int, before: int = 0) -> None:
        """Refuse a revision of that size, if the unfinished ones of this connection became too large together."""
        if n_bytes <= SMALL_BYTES:
            return
        drafted = sum(fid.draft.n_bytes for fid in self._writing if fid.draft is not None)
        if drafted + n_bytes - before > self._limits.draft_bytes:
            raise FsError(errno.ENOSPC, f"unfinished revisions may take {self._limits.draft_bytes} bytes together")

    def begin(self, fid: Fid, draft: Draft) -> None:
        """Have a file open for writing."""
        fid.draft = draft
        self._writing[fid] = None

    def pristine(self, node: Node) -> Draft | None:
        """Give the newest draft of a file, if nothing has become of it yet."""
        for fid in reversed(self._writing):
            if fid.node is node and fid.draft is not None and fid.draft.pristine:
                return fid.draft
        return None

    def edge(self) -> None:
        """Commit what was left alone for a cycle."""
        for fid in list(self._writing):
            if fid.draft is not None and fid.draft.dirty:
                try:
                    fid.draft.edge()
                except RtdbError as error:
                    log.debug("not committed: %s", error)

    def finish(self) -> None:
        """Make revisions of what a component keeps open, as it says that it is done; not of half a long write."""
        for fid in self._writing:
            draft = fid.draft
            if draft is None or draft.truncated or (draft.is_under_way and not isinstance(fid.node, StatusFile)):
                continue
            with contextlib.suppress(RtdbError):  # the component's health says so
                draft.finish()
