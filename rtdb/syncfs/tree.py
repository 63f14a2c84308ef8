"""The tree: a store as files. It knows the store and its rules, not who asks, nor through which protocol.

    /clock                       edges, on the pace of the mount; a stat of it is held until the next
    /server                      how the file server does
    /<component>/status          what its objects show; of a component without a module, what it wrote
    /<component>/config          its wiring
    /<component>/health          how it says that it is
    /<component>/clock           its own edges; a stat of it says "done, waiting"
    /<component>/<image>.ppm     pictures
    /at/<cycle>/...              the same, as it was
    everything else              free files

Contents are those of a cut. Names of free files come and go at once. Nothing here reaches the host's own files.
"""

import errno
import logging
import time
from collections.abc import Callable, Iterable
from typing import Any

from ..clock import Kind
from ..components import ComponentInfo
from ..errors import AgedOut, InUse, RtdbError, TooFast
from ..json_object import is_json
from ..objects import Object
from ..store import Store
from .content import Content
from .errors import FsError
from .names import FILES, Names
from .nodes import (
    AT,
    CLOCK,
    COMPONENTS,
    SERVER,
    ClockFile,
    ComponentDir,
    ConfigFile,
    Directory,
    File,
    FreeDir,
    FreeFile,
    HealthFile,
    Node,
    PictureFile,
    ServerFile,
    StatusFile,
)
from .pace import Pace
from .past import HISTORY, AtDir, PastRoot
from .policy import Limits, Who
from .seats import Seat, SeatSpec
from .status import StatusView, pictures_of

log = logging.getLogger(__name__)


class Tree:
    """A store as files, for one file server: free files and seats are its own. Close it before the store."""

    def __init__(
        self,
        store: Store,
        *,
        pace: Pace | None = None,
        seats: Iterable[SeatSpec] = (),
        limits: Limits | None = None,
        patience_s: float = 5.0,
    ) -> None:
        self.store, self.pace, self.limits = store, pace or Pace(), limits or Limits()
        try:
            self.component = store.join(FILES)
        except InUse as error:
            pid = next(info.pid for info in store.components() if info.name == FILES)
            raise InUse(
                f"store {store.name!r} is served already, by process {pid}; give that one another --listen"
            ) from error
        self.seats = {spec.component: Seat(store, spec, patience_s) for spec in seats}
        self.report: Callable[[], dict[str, Any]] = dict
        self._version = -1
        self._infos: dict[str, ComponentInfo] = {}
        self._dirs: dict[str, ComponentDir] = {}
        self._files: dict[str, dict[str, Node]] = {}
        self._views: dict[str, StatusView] = {}
        self._objects: dict[str, list[Object[Any]]] = {}
        self._walls: dict[int, int] = {}
        self._configs: dict[int, bytes] = {}  # by object, what is written at the next edge
        self.names = Names(self)
        self.root = self.names.root
        self.root.parent = self.root
        self.clock = ClockFile(self, CLOCK, self.root, None, None)
        self._at = AtDir(self, AT, self.root)
        server = ServerFile(self, SERVER, self.root)
        self.fixed: dict[str, Node] = {"clock": self.clock, "server": server, "at": self._at}

    def close(self) -> None:
        """Leave the store: the free files wait in it for a successor."""
        for seat in self.seats.values():
            seat.close()
        self.names.edge(self.store.cycle)
        self.component.leave()

    # -- time -----------------------------------------------------------------------------------------------------

    def edge(self, cycle: int) -> None:
        """Do what a new cycle of the store asks for."""
        for seat in self.seats.values():
            seat.edge(cycle)
        for handle, payload in list(self._configs.items()):
            try:
                self.write_config(handle, payload)
            except RtdbError as error:  # its component is gone
                self.refused("a config", error)
        self.names.edge(cycle)

    def pace_of(self, component: str | None) -> Pace:
        """Give the pace of who attaches: its component's own, or that of the tree."""
        seat = self.seats.get(component) if component is not None else None
        return self.pace if seat is None else seat.pace

    def seat_of(self, component: str) -> Seat:
        """Give a component's seat."""
        seat = self.seats.get(component)
        if seat is None:
            raise FsError(errno.EACCES, f"{component} is a program of its own: nobody else writes its status")
        return seat

    def note_read(self, component: str, file: File, cycle: int) -> None:
        """Note what a component has read: its next status comes from that."""
        seat = self.seats.get(component)
        if seat is not None:
            seat.has_read(file.sources(cycle))

    def time_at(self, cycle: int, pace: Pace) -> dict[str, Any]:
        """Tell the time at an edge."""
        store, clock = self.store, self.store.clock
        real = clock.kind is Kind.REAL
        return {
            "clock": pace.count(cycle),
            "cycle": cycle,
            "interval": pace.every * store.tick_ns,
            "t_ns": store.t0_ns + cycle * store.tick_ns,
            "kind": clock.kind.name.lower(),
            "alive": clock.alive,
            "wall_ns": self._wall_ns(cycle) if real else None,
            "overruns": clock.skipped if real else None,
        }

    def _wall_ns(self, cycle: int) -> int:
        """Give the wall time of an edge, the same for all who ask for it soon."""
        known = self._walls.get(cycle)
        if known is None:
            now = self.store.now_ns
            if len(self._walls) > 64:
                self._walls.clear()
            at_ns = self.store.t0_ns + cycle * self.store.tick_ns
            known = self._walls[cycle] = time.time_ns() - (now - at_ns)
        return known

    def own_change(self, before: int) -> None:
        """Note that we changed the store's directory ourselves: no component came or went by that."""
        if self._version == before and self.store.core.version == before + 1:
            self._version = before + 1

    def past(self, cycle: int) -> PastRoot:
        """Give the tree as a cut showed it."""
        return PastRoot(self, HISTORY | (cycle & 0x7FFFFFF) << 36, self._at, cycle)

    # -- components -----------------------------------------------------------------------------------------------

    def _look(self) -> None:
        """Read the store's directory anew, if anything came or went."""
        version = self.store.core.version
        if version == self._version:
            return
        self._version = version
        self._infos = {c.name: c for c in self.store.components() if c.name != FILES}
        self._objects = {name: [] for name in self._infos}
        for obj in self.store.objects():
            self._objects.get(obj.name.partition("/")[0], []).append(obj)
        self._files.clear()
        self._views.clear()

    def component_dirs(self) -> dict[str, Node]:
        """Give the directories of all components."""
        self._look()
        return {name: node for name in self._infos if (node := self.component_dir(name)) is not None}

    def component_dir(self, name: str) -> ComponentDir | None:
        """Give a component's directory."""
        self._look()
        if name not in self._infos:
            return None
        known = self._dirs.get(name)
        if known is None:
            number = COMPONENTS + (self.store.component_index(name) << 8)
            known = self._dirs[name] = ComponentDir(self, number, self.root, name)
        return known

    def files_of(self, directory: ComponentDir) -> dict[str, Node]:
        """Give the files of a component."""
        self._look()
        name = directory.component
        known = self._files.get(name)
        if known is None:
            known = self._files[name] = self._make_files(directory)
        return known

    def _make_files(self, directory: ComponentDir) -> dict[str, Node]:
        name, number, info = directory.component, directory.path, self._infos[directory.component]
        files: dict[str, Node] = {"status": StatusFile(self, number + 1, directory, name)}
        files["clock"] = ClockFile(self, number + 2, directory, Pace(info.every, info.phase), name)
        pictures = []
        for obj in self._objects[name]:
            if obj.name == f"{name}/config" and is_json(obj.stored.fields):
                files["config"] = ConfigFile(self, number + 3, directory, name, obj)
            elif obj.name == f"{name}/health":
                files["health"] = HealthFile(self, number + 4, directory, obj)
            else:
                pictures += [(title, obj, field) for title, field in pictures_of(obj)]
        for k, (title, obj, field) in enumerate(pictures[:250]):
            files[f"{title}.ppm"] = PictureFile(self, number + 5 + k, directory, obj, field)
        return files

    def status_of(self, component: str) -> StatusView:
        """Give what stands in a component's status."""
        self._look()
        view = self._views.get(component)
        if view is None:
            view = self._views[component] = StatusView(self.store, self._objects.get(component, []))
        return view

    def write_config(self, handle: int, payload: bytes) -> None:
        """Write a component's wiring; the newest of too many in one cycle follows at the edge."""
        core = self.store.core
        self._configs.pop(handle, None)
        try:
            core.write(handle, payload, core.not_before(handle, core.now_ns), ())
        except TooFast:
            self._configs[handle] = payload

    def refused(self, what: str, error: RtdbError) -> None:
        """Say what was not taken."""
        log.warning("%s refused: %s", what, error)

    # -- free files -----------------------------------------------------------------------------------------------

    def _place(self, directory: Directory, name: str) -> FreeDir:
        """Give the directory for a new name, or raise why there can be none."""
        self.check_name(name)
        if not isinstance(directory, FreeDir):
            raise FsError(errno.EACCES, "nobody makes files here")
        if directory is self.root and (name in self.fixed or self.component_dir(name) is not None):
            raise FsError(errno.EEXIST, f"{name} is there already")
        if self.names.count >= self.limits.files:
            raise FsError(errno.ENOSPC, f"{self.names.count} files, and there may be no more")
        self._check_depth(directory, 1)
        return directory

    def _check_depth(self, directory: FreeDir, below: int) -> None:
        """Refuse what would lie too deep, or in a directory that was removed."""
        depth, at = below, directory
        while at is not self.root:
            above = at.parent
            if not isinstance(above, FreeDir) or above.children.get(at.name) is not at:
                raise FsError(errno.ENOENT, "this directory was removed")
            depth, at = depth + 1, above
        if depth > self.limits.depth:
            raise FsError(errno.ENAMETOOLONG, f"{depth} directories in each other, at most {self.limits.depth}")

    def check_name(self, name: str) -> None:
        """Refuse what is no name."""
        if not name or name in (".", "..") or "/" in name or "\0" in name:
            raise FsError(errno.EINVAL, f"{name!r} is no name")
        if any("\ud800" <= c <= "\udfff" for c in name):
            raise FsError(errno.EILSEQ, "a name is UTF-8")
        if len(name.encode()) > self.limits.name_bytes:
            raise FsError(errno.ENAMETOOLONG, f"a name has at most {self.limits.name_bytes} bytes")

    def create(self, directory: Directory, name: str, mode: int, who: Who, gid: int = 0) -> FreeFile:
        """Make a file, empty until the first edge behind its first revision."""
        parent = self._place(directory, name)
        if name in parent.children:
            raise FsError(errno.EEXIST, f"{name} is there already")
        node = FreeFile(self, self.names.number(), parent, name, Content(self.names.contents))
        self._add(node, parent, mode, who, gid)
        return node

    def mkdir(self, directory: Directory, name: str, mode: int, who: Who, gid: int = 0) -> FreeDir:
        """Make a directory."""
        parent = self._place(directory, name)
        if name in parent.children:
            raise FsError(errno.EEXIST, f"{name} is there already")
        node = FreeDir(self, self.names.number(), parent, name)
        self._add(node, parent, mode, who, gid)
        return node

    def _add(self, node: FreeFile | FreeDir, parent: FreeDir, mode: int, who: Who, gid: int) -> None:
        node.mode, node.uid, node.gid, node.mtime_ns = mode & 0o7777, who.uid, gid, self._edge_ns()
        parent.children[node.name] = node
        parent.mtime_ns = node.mtime_ns
        self.names.count += 1
        self.names.changed(node)

    def _edge_ns(self) -> int:
        return self.store.t0_ns + self.store.cycle * self.store.tick_ns

    def _own(self, directory: Directory, name: str) -> tuple[FreeDir, FreeFile | FreeDir]:
        """Give a free file with its directory, or raise why it cannot be moved or removed."""
        if directory is self.root and (name in self.fixed or self.component_dir(name) is not None):
            raise FsError(errno.EACCES, f"{name} belongs to the store")
        if not isinstance(directory, FreeDir):
            code = errno.EROFS if directory.path & HISTORY else errno.EACCES
            raise FsError(code, "what is here belongs to the store")
        node = directory.children.get(name)
        if node is None:
            raise FsError(errno.ENOENT, f"{name} is not there")
        return directory, node

    def remove(self, directory: Directory, name: str, *, want_dir: bool | None = None) -> None:
        """Remove a file, or an empty directory. want_dir: which of them it must be."""
        parent, node = self._own(directory, name)
        if want_dir is True and not node.is_dir:
            raise FsError(errno.ENOTDIR, f"{name} is a file")
        if want_dir is False and node.is_dir:
            raise FsError(errno.EISDIR, f"{name} is a directory")
        if isinstance(node, FreeDir) and node.children:
            raise FsError(errno.ENOTEMPTY, f"{name} is not empty")
        del parent.children[name]
        self._gone(node)
        parent.mtime_ns = self._edge_ns()
        self.names.removed(node)

    def _gone(self, node: FreeFile | FreeDir) -> None:
        self.names.count -= 1
        if isinstance(node, FreeFile):
            node.gone = True
            self.names.contents.busy.discard(node.data)
            node.data.drop()

    def rename(self, directory: Directory, name: str, to: Directory, new: str) -> None:
        """Move a file or directory, at once; what stood under the new name goes."""
        parent, node = self._own(directory, name)
        self.check_name(new)
        if to is self.root and (new in self.fixed or self.component_dir(new) is not None):
            raise FsError(errno.EACCES, f"{new} belongs to the store")
        if not isinstance(to, FreeDir):
            raise FsError(errno.EACCES, "nobody makes files here")
        self._check_depth(to, _height(node))
        at: Any = to
        while at is not self.root:
            if at is node:
                raise FsError(errno.EINVAL, f"{new} would lie inside itself")
            at = at.parent
        old = to.children.get(new)
        if old is node:
            return
        if old is not None:
            if old.is_dir != node.is_dir:
                raise FsError(errno.EISDIR if old.is_dir else errno.ENOTDIR, f"{new} is of another kind")
            if isinstance(old, FreeFile) and isinstance(node, FreeFile):
                node.data.follow(old.data)
            self.remove(to, new)
        del parent.children[name]
        node.name, node.parent = new, to
        to.children[new] = node
        parent.mtime_ns = to.mtime_ns = self._edge_ns()
        self.names.changed(node)

    def set_attr(self, node: Node, *, mode: int | None, uid: int | None, gid: int | None, mtime_ns: int | None) -> None:
        """Change what users see of a free file."""
        if not isinstance(node, FreeFile | FreeDir):
            if node.path & HISTORY:
                raise FsError(errno.EROFS, "the past stays as it was")
            if mode is None and uid is None and gid is None:
                return  # a touch: its time is that of the cut
            raise FsError(errno.EPERM, "it belongs to the store")
        node.mode = node.mode if mode is None else mode & 0o7777
        node.uid = node.uid if uid is None else uid
        node.gid = node.gid if gid is None else gid
        node.mtime_ns = node.mtime_ns if mtime_ns is None else mtime_ns
        self.names.changed(node)

    def room_for(self, file: File, n_bytes: int) -> None:
        """Refuse a revision for which there is no room, while somebody still listens."""
        if n_bytes > file.most_bytes:
            raise FsError(errno.EFBIG, f"{n_bytes} bytes, at most {file.most_bytes}")
        if isinstance(file, FreeFile) and not file.gone:
            rooms = file.data.rooms
            if (not rooms or n_bytes > rooms[-1]) and not self.names.contents.fits(n_bytes):
                with self.names.kept(file):
                    file.data.grow(n_bytes)  # deleted files may make room, which only an insert finds out

    def abandoned(self, file: File) -> None:
        """Take back what was kept for a revision: who wrote it has closed the file, or is gone."""
        if isinstance(file, FreeFile) and not file.gone:
            with self.names.kept(file):
                file.data.trim()

    def read(self, file: File, cycle: int, who: Who) -> bytes:
        """Give a file's content in a cut; ESTALE where the store does not reach back so far."""
        try:
            return file.content(cycle, who)
        except AgedOut as error:
            raise FsError(errno.ESTALE, "the store's history does not reach back so far") from error


def _height(node: FreeFile | FreeDir) -> int:
    """Give how many levels a node and what lies in it take."""
    return 1 + max((_height(child) for child in node.children.values()), default=0) if isinstance(node, FreeDir) else 1
