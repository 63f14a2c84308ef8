"""Names of free files. They come and go at once; the store gets them as an object, for `/at` and for a successor.

[[path, number, mode, uid, gid, mtime_ns, [objects of its content] or null for a directory], ...]
"""

from typing import TYPE_CHECKING, Any

import msgspec

from ..errors import AgedOut, RtdbError, StoreFull
from .content import Content, Contents
from .nodes import FREE, ROOT, FreeDir, FreeFile, Root

if TYPE_CHECKING:
    from .tree import Tree

FILES = "files"  # component that owns the free files; it has no folder of its own


class Names:
    """The free files: their directories in memory, and how these go into the store."""

    def __init__(self, tree: "Tree") -> None:
        store, component = tree.store, tree.component
        self._tree = tree
        self.contents = Contents(store, component, tree.pace, "", tree.own_change)
        self._spelled = Contents(store, component, tree.pace, "names-", tree.own_change)
        self._text = Content(self._spelled, sorted(self._spelled.numbers()))
        self.root = Root(tree, ROOT, None, "")
        self._last, self.count = FREE, 0
        self._dirty, self._written_in = False, -1
        self._past: dict[int, FreeDir] = {}
        self._take_over()

    def number(self) -> int:
        """Give a new node its number."""
        self._last += 1
        return self._last

    def changed(self) -> None:
        """Note that names or contents changed: the store hears of it in this cycle or the next."""
        self._dirty = True
        if self._written_in != self._tree.store.cycle:
            self._write()

    def edge(self, cycle: int) -> None:
        """Write what has changed since; go on with contents that waited for the edge."""
        self.contents.edge(cycle)
        self._spelled.edge(cycle)
        self._past.clear()
        if self._dirty:
            self._write()

    def _write(self) -> None:
        self._dirty, self._written_in = False, self._tree.store.cycle
        rows: list[Any] = []
        self._list(self.root, "", rows)
        try:
            self._text.write(msgspec.json.encode(rows))
        except StoreFull:  # contents come first; `/at` and a successor see the names of before
            self._dirty = True

    def _list(self, directory: FreeDir, path: str, rows: list[Any]) -> None:
        for name, node in directory.children.items():
            numbers = node.data.numbers if isinstance(node, FreeFile) else None
            rows.append([path + name, node.path, node.mode, node.uid, node.gid, node.mtime_ns, numbers])
            if isinstance(node, FreeDir):
                self._list(node, f"{path}{name}/", rows)

    # -- back from the store --------------------------------------------------------------------------------------

    def _take_over(self) -> None:
        """Go on with the files that a server before us left."""
        try:
            text, _ = self._text.read(self._tree.store.cycle)
            self._fill(self.root, text)
        except (RtdbError, msgspec.DecodeError):  # damaged, or too old to be there: begin anew
            self.root.children.clear()
        self.count = self._numbered(self.root)

    def _numbered(self, directory: FreeDir) -> int:
        count = 0
        for node in directory.children.values():
            self._last = max(self._last, node.path)
            count += 1 + (self._numbered(node) if isinstance(node, FreeDir) else 0)
        return count

    def _fill(self, root: FreeDir, text: bytes) -> None:
        for path, number, mode, uid, gid, mtime_ns, objects in msgspec.json.decode(text) if text else ():
            directory: Any = root
            *above, name = path.split("/")
            for part in above:
                directory = directory.children[part]
            node: FreeFile | FreeDir
            if objects is None:
                node = FreeDir(self._tree, number, directory, name)
            else:
                node = FreeFile(self._tree, number, directory, name, Content(self.contents, objects))
                node.data.newest = node.data.read(self._tree.store.cycle)[0]
            node.mode, node.uid, node.gid, node.mtime_ns = mode, uid, gid, mtime_ns
            directory.children[name] = node

    def root_at(self, cycle: int) -> FreeDir:
        """Give the free files by the names that a cut shows."""
        known = self._past.get(cycle)
        if known is None:
            known = self._past[cycle] = FreeDir(self._tree, ROOT, None, "")
            try:
                self._fill(known, self._text.read(cycle)[0])
            except (AgedOut, msgspec.DecodeError):
                known.children.clear()
        return known
