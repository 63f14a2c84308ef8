"""Segments: the files in /dev/shm that shared stores of this user live in, and which processes hold them.

Who holds a segment is read from /proc, and whether anybody lives in it from the kernel's file locks: both also work for
segments that are damaged, or that another version of Fairway made.
"""

import contextlib
import fcntl
import fnmatch
import os
import re
import struct
import textwrap
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path("/dev/shm")
LOCK_ALIVE = 0  # byte that everybody who lives in a store has locked; as in core/fw_layout.h
_MAGIC = b"FAYRTDB1"
_HEADER = struct.Struct("<8sI")  # magic, layout: the first of fw_header
_FLOCK = struct.Struct("hhqqi4x")  # type, whence, start, length, pid: as in fcntl(2)


@dataclass(frozen=True, slots=True)
class Process:
    """A process that has a segment open; `command`: its command line."""

    pid: int
    command: str

    @property
    def only_looks(self) -> bool:
        """Whether it is a command that waits for what others do: it keeps nothing going."""
        return re.search(r" db (top|watch)( |$)", self.command) is not None

    def __str__(self) -> str:
        return f"{self.pid} ({self.command})" if self.command else str(self.pid)


@dataclass(frozen=True, slots=True, kw_only=True)
class Segment:
    """A file of a store as it was when it was looked at.

    `half_made`: a store that is being made, or whose creator was killed meanwhile; `layout`: None where it is no store;
    `lives`: somebody holds it.
    """

    path: Path
    name: str
    half_made: bool
    layout: int | None
    size: int
    t_made_s: float
    lives: bool
    holders: tuple[Process, ...]


def prefix() -> str:
    """Give what the names of this user's segments begin with."""
    return f"fairway-{os.getuid()}-"


def segment_path(store: str) -> Path:
    """Give the path of the segment of a store."""
    return FOLDER / f"{prefix()}{store}"


def segments(pattern: str = "*") -> list[Segment]:
    """Look at the segments whose store's name fits a pattern, sorted by name."""
    held = holders()
    found = []
    for path in sorted(FOLDER.glob(f"{prefix()}*")):
        half_made = re.fullmatch(r"(.+)\.\d+\.new", path.name)
        name = (half_made[1] if half_made else path.name).removeprefix(prefix())
        if not fnmatch.fnmatchcase(name, pattern):
            continue
        with contextlib.suppress(FileNotFoundError):  # it went while we looked
            stat = path.stat()
            by = held.get((stat.st_dev, stat.st_ino), ())
            found.append(
                Segment(
                    path=path,
                    name=name,
                    half_made=half_made is not None,
                    layout=layout_of(path),
                    size=stat.st_size,
                    t_made_s=stat.st_mtime,
                    lives=bool(by) or is_locked(path),
                    holders=by,
                )
            )
    return found


def layout_of(path: Path) -> int | None:
    """Read the number of the layout that a segment was made with; None where it is no store."""
    with path.open("rb") as file:
        data = file.read(_HEADER.size)
    if len(data) < _HEADER.size or not data.startswith(_MAGIC):
        return None
    _, layout = _HEADER.unpack(data)
    return int(layout)


def is_locked(path: Path) -> bool:
    """Tell whether anybody says that it lives in a segment."""
    with path.open("rb") as file:
        lock = fcntl.fcntl(file.fileno(), fcntl.F_OFD_GETLK, _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, LOCK_ALIVE, 1, 0))
    return bool(_FLOCK.unpack(lock)[0] != fcntl.F_UNLCK)


def remove(segment: Segment) -> bool:
    """Remove a segment in which nobody lives; False, and nothing is changed, if somebody does.

    The lock keeps everybody out meanwhile, and the file must still be the one that was looked at.
    """
    try:
        file = segment.path.open("r+b")
    except FileNotFoundError:
        return False
    with file:
        try:
            fcntl.fcntl(file.fileno(), fcntl.F_OFD_SETLK, _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, LOCK_ALIVE, 1, 0))
        except BlockingIOError:
            return False
        mine = os.fstat(file.fileno())
        try:
            there = segment.path.stat()
        except FileNotFoundError:
            return False
        if (mine.st_dev, mine.st_ino) != (there.st_dev, there.st_ino):
            return False
        if holders().get((mine.st_dev, mine.st_ino)):  # open, but not locked yet: it is just being made
            return False
        segment.path.unlink()
        return True


def holders() -> dict[tuple[int, int], tuple[Process, ...]]:
    """Find the processes that have segments open, by (device, inode) of the file; this process is left out."""
    found: dict[tuple[int, int], tuple[Process, ...]] = {}
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit() or int(folder.name) == os.getpid():
            continue
        for file in _open_segments(folder):
            found[file] = (*found.get(file, ()), Process(int(folder.name), _command(folder)))
    return found


def _open_segments(process: Path) -> set[tuple[int, int]]:
    files = set()
    with contextlib.suppress(OSError):  # it ended, or is somebody else's
        for link in (process / "fd").iterdir():
            with contextlib.suppress(OSError):
                if link.readlink().name.startswith(prefix()):
                    stat = link.stat()
                    files.add((stat.st_dev, stat.st_ino))
    return files


def _command(process: Path) -> str:
    try:
        words = (process / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return ""
    return textwrap.shorten(words, 100, placeholder=" ...")
