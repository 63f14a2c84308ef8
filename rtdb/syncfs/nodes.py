"""Nodes: what paths name. A file is made of something in the store, which decides what it shows and who may write it.

Contents are those of a cut, `cycle`. Numbers (`path`) are unique for as long as a node lives.
"""

import errno
import stat
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from ..errors import RecordError
from ..json_object import json_payload
from ..layout import Field
from ..objects import Object
from .content import Content
from .errors import FsError
from .pace import Pace
from .policy import Who
from .status import padded, picture, picture_size, source_of

if TYPE_CHECKING:
    from .tree import Tree

_OBJECT = msgspec.json.Decoder(dict)
RW, R, X = 0o666, 0o444, 0o755
ROOT, CLOCK, SERVER, AT = 1, 2, 3, 4  # numbers of nodes that are always there
FREE = 16  # free files count from here
COMPONENTS = 1 << 32  # those of components
CLOCK_BYTES, SERVER_BYTES, HEALTH_BYTES = 320, 8000, 2400


class Attr(NamedTuple):
    """What a stat tells: mode with its type bits, size in bytes, time of the content, number that changes with it."""

    mode: int
    size: int
    mtime_ns: int
    version: int
    uid: int = 0
    gid: int = 0


class Node:
    """Something that a path names. `path` is its number, for as long as it lives."""

    __slots__ = ("parent", "path", "tree")
    is_dir = False

    def __init__(self, tree: "Tree", path: int, parent: "Directory | None") -> None:
        self.tree, self.path, self.parent = tree, path, parent

    def attr(self, cycle: int, who: Who) -> Attr:
        """Tell about it, as a cut shows it."""
        raise NotImplementedError


class File(Node):
    """A file. What it is made of decides who may write it."""

    __slots__ = ()

    def content(self, cycle: int, who: Who) -> bytes:
        """Give what a cut shows."""
        raise NotImplementedError

    def sources(self, cycle: int) -> list[tuple[int, int]]:
        """Give the writes (object id, number) behind what a cut shows."""
        return []

    def check_write(self, who: Who) -> None:
        """Raise FsError for whoever may not write it."""
        raise FsError(errno.EACCES, "it is read-only")

    def base(self) -> bytes:
        """Give the newest revision, which an appended one goes on from."""
        return b""

    def commit(self, data: bytes, who: Who) -> None:
        """Make this the next revision: it shows from the next edge on."""
        raise FsError(errno.EACCES, "it is read-only")

    def is_whole(self, data: bytes | bytearray) -> bool | None:
        """Whether a content can be told to be complete; None where nothing tells."""
        return None

    @property
    def most_bytes(self) -> int:
        """How large a revision may be."""
        return self.tree.limits.file_bytes

    def _attr(self, mode: int, size: int, cycle: int, mtime_ns: int | None = None, version: int | None = None) -> Attr:
        at_ns = self.tree.store.t0_ns + cycle * self.tree.store.tick_ns
        return Attr(stat.S_IFREG | mode, size, at_ns if mtime_ns is None else mtime_ns,
                    cycle if version is None else version)  # fmt: skip


class Directory(Node):
    """A directory."""

    __slots__ = ()
    is_dir = True

    def child(self, name: str, cycle: int) -> Node | None:
        """Find what a name means here."""
        raise NotImplementedError

    def entries(self, cycle: int) -> list[tuple[str, Node]]:
        """List what is here."""
        raise NotImplementedError

    def attr(self, cycle: int, who: Who) -> Attr:
        store = self.tree.store
        return Attr(stat.S_IFDIR | X, 0, store.t0_ns + cycle * store.tick_ns, cycle)


# -- clocks -----------------------------------------------------------------------------------------------------------


class ClockFile(File):
    """Counts edges: those of a component, or, without one, those of who asks."""

    __slots__ = ("_pace", "component")

    def __init__(self, tree: "Tree", path: int, parent: Directory, pace: Pace | None, component: str | None) -> None:
        super().__init__(tree, path, parent)
        self._pace, self.component = pace, component

    def attr(self, cycle: int, who: Who) -> Attr:
        return self._attr(R, CLOCK_BYTES, cycle, version=self.pace_of(who).count(cycle))

    def pace_of(self, who: Who) -> Pace:
        """Give the pace that it keeps for who asks."""
        return self._pace or self.tree.pace_of(who.component)

    def content(self, cycle: int, who: Who) -> bytes:
        return padded(self.tree.time_at(cycle, self.pace_of(who)), CLOCK_BYTES)


# -- components -------------------------------------------------------------------------------------------------------


class StatusFile(File):
    """`/<component>/status`."""

    __slots__ = ("component",)

    def __init__(self, tree: "Tree", path: int, parent: Directory, component: str) -> None:
        super().__init__(tree, path, parent)
        self.component = component

    def attr(self, cycle: int, who: Who) -> Attr:
        view, mode = self.tree.status_of(self.component), RW if who.may_write(self.component) else R
        if view.written is not None:
            text, written_ns = view.said(cycle)
            return self._attr(mode, len(text), cycle, written_ns or None)
        return self._attr(mode, view.size, cycle)

    def content(self, cycle: int, who: Who) -> bytes:
        return self.tree.status_of(self.component).text(cycle)

    def sources(self, cycle: int) -> list[tuple[int, int]]:
        return self.tree.status_of(self.component).sources(cycle)

    def check_write(self, who: Who) -> None:
        if not who.may_write(self.component):
            raise FsError(errno.EACCES, f"only {self.component} writes its status: attach with its token")

    def commit(self, data: bytes, who: Who) -> None:
        self.check_write(who)
        self.tree.seat_of(self.component).commit(data)

    def is_whole(self, data: bytes | bytearray) -> bool | None:
        return is_json_object(data)

    @property
    def most_bytes(self) -> int:
        seat = self.tree.seats.get(self.component)
        return self.tree.limits.status_bytes if seat is None else seat.spec.status_bytes


class ConfigFile(File):
    """`/<component>/config`."""

    __slots__ = ("component", "obj")

    def __init__(self, tree: "Tree", path: int, parent: Directory, component: str, obj: Object[Any]) -> None:
        super().__init__(tree, path, parent)
        self.component, self.obj = component, obj

    def attr(self, cycle: int, who: Who) -> Attr:
        mode = RW if who.may_wire(self.component) else R
        return self._attr(mode, len(self.content(cycle, who)), cycle)

    def content(self, cycle: int, who: Who) -> bytes:
        raw = self.tree.store.core.visible(self.obj.handle, cycle)
        return b"" if raw is None else raw[0].rstrip(b"\0") + b"\n"

    def check_write(self, who: Who) -> None:
        if not who.may_wire(self.component):
            raise FsError(errno.EACCES, f"{self.component} is wired by itself and the operator: attach with a token")

    def commit(self, data: bytes, who: Who) -> None:
        self.check_write(who)
        try:
            payload = json_payload(data, self.obj.size)
        except RecordError as error:
            self.tree.refused(f"{self.component}/config", error)
            raise FsError(errno.EINVAL, str(error)) from error
        self.tree.write_config(self.obj.handle, payload)

    def is_whole(self, data: bytes | bytearray) -> bool | None:
        return is_json_object(data)

    @property
    def most_bytes(self) -> int:
        return self.obj.size


def is_json_object(data: bytes | bytearray) -> bool:
    """Whether a text ends as a JSON object does; whether the store takes it is another matter."""
    try:
        _OBJECT.decode(data)
    except (msgspec.MsgspecError, RecursionError):
        return False
    return True


class HealthFile(File):
    """`/<component>/health`."""

    __slots__ = ("obj",)

    def __init__(self, tree: "Tree", path: int, parent: Directory, obj: Object[Any]) -> None:
        super().__init__(tree, path, parent)
        self.obj = obj

    def attr(self, cycle: int, who: Who) -> Attr:
        return self._attr(R, HEALTH_BYTES, cycle)

    def content(self, cycle: int, who: Who) -> bytes:
        sample = self.obj.visible(cycle)
        return padded({} if sample is None else sample.value, HEALTH_BYTES)


class PictureFile(File):
    """`/<component>/<image>.ppm`."""

    __slots__ = ("field", "obj")

    def __init__(self, tree: "Tree", path: int, parent: Directory, obj: Object[Any], field: Field) -> None:
        super().__init__(tree, path, parent)
        self.obj, self.field = obj, field

    def attr(self, cycle: int, who: Who) -> Attr:
        return self._attr(R, picture_size(self.field), cycle)

    def content(self, cycle: int, who: Who) -> bytes:
        return picture(self.obj, self.field, cycle)

    def sources(self, cycle: int) -> list[tuple[int, int]]:
        source = source_of(self.obj, cycle)
        return [] if source is None else [source]


class ServerFile(File):
    """`/server`."""

    __slots__ = ()

    def attr(self, cycle: int, who: Who) -> Attr:
        return self._attr(R, SERVER_BYTES, cycle)

    def content(self, cycle: int, who: Who) -> bytes:
        return padded(self.tree.report(), SERVER_BYTES)


class ComponentDir(Directory):
    """`/<component>`."""

    __slots__ = ("component",)

    def __init__(self, tree: "Tree", path: int, parent: Directory, component: str) -> None:
        super().__init__(tree, path, parent)
        self.component = component

    def child(self, name: str, cycle: int) -> Node | None:
        return self.tree.files_of(self).get(name)

    def entries(self, cycle: int) -> list[tuple[str, Node]]:
        return list(self.tree.files_of(self).items())


# -- free files -------------------------------------------------------------------------------------------------------


class Free:
    """What free files and directories have: a name, a place, and what users put there for show."""

    __slots__ = ()
    name: str
    mode: int
    uid: int
    gid: int
    mtime_ns: int


class FreeFile(File, Free):
    """A file that somebody made."""

    __slots__ = ("data", "gid", "gone", "mode", "mtime_ns", "name", "uid")

    def __init__(self, tree: "Tree", path: int, parent: "FreeDir", name: str, data: Content) -> None:
        super().__init__(tree, path, parent)
        self.name, self.data, self.gone = name, data, False
        self.mode, self.uid, self.gid, self.mtime_ns = 0o644, 0, 0, 0

    def attr(self, cycle: int, who: Who) -> Attr:
        data, written_ns = self.data.read(cycle)
        return Attr(stat.S_IFREG | self.mode, len(data), max(self.mtime_ns, written_ns), cycle, self.uid, self.gid)

    def content(self, cycle: int, who: Who) -> bytes:
        if self.gone:
            raise FsError(errno.ENOENT, "it was removed")
        return self.data.read(cycle)[0]

    def check_write(self, who: Who) -> None:
        """Anybody may."""

    def base(self) -> bytes:
        return self.data.newest

    def commit(self, data: bytes, who: Who) -> None:
        if self.gone:
            raise FsError(errno.ENOENT, "it was removed")
        with self.tree.names.kept(self):
            self.data.write(data)


class FreeDir(Directory, Free):
    """A directory that somebody made, or the root."""

    __slots__ = ("children", "gid", "mode", "mtime_ns", "name", "uid")

    def __init__(self, tree: "Tree", path: int, parent: Directory | None, name: str) -> None:
        super().__init__(tree, path, parent)
        self.name = name
        self.children: dict[str, FreeFile | FreeDir] = {}
        self.mode, self.uid, self.gid, self.mtime_ns = 0o755, 0, 0, 0

    def attr(self, cycle: int, who: Who) -> Attr:
        return super().attr(cycle, who)._replace(mode=stat.S_IFDIR | self.mode, uid=self.uid, gid=self.gid)

    def child(self, name: str, cycle: int) -> Node | None:
        return self.children.get(name)

    def entries(self, cycle: int) -> list[tuple[str, Node]]:
        return list(self.children.items())


class Root(FreeDir):
    """`/`: clock, server, at, components, and free files."""

    __slots__ = ()

    def child(self, name: str, cycle: int) -> Node | None:
        return self.tree.fixed.get(name) or self.tree.component_dir(name) or self.children.get(name)

    def entries(self, cycle: int) -> list[tuple[str, Node]]:
        fixed = {**self.tree.fixed, **self.tree.component_dirs()}
        return [*fixed.items(), *((name, node) for name, node in self.children.items() if name not in fixed)]
