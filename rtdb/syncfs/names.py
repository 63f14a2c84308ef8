"""Names of free files. They come and go at once; the store gets them as an object, for `/at` and for a successor.

[[number, number of its directory, name, mode, uid, gid, mtime_ns, [its objects] or null for a directory], ...]

Each row is spelled once and kept until it changes.
"""

import contextlib
import logging
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import msgspec

from ..errors import AgedOut, RtdbError, StoreFull
from .content import Budget, Content, Contents
from .nodes import FREE, ROOT, FreeDir, FreeFile, Root

if TYPE_CHECKING:
    from .tree import Tree

log = logging.getLogger(__name__)
KEPT = 16  # cycles whose names are kept at hand
FILES = "files"  # component that owns the free files; it has no folder of its own


class Names:
    """The free files: their directories in memory, and how these go into the store."""

    def __init__(self, tree: "Tree") -> None:
        store, component = tree.store, tree.component
        self._tree = tree
        budget = Budget(store)
        self.contents = Contents(store, component, tree.pace, "", budget, tree.own_change)
        self._spelled = Contents(store, component, tree.pace, "names-", budget, tree.own_change)
        self._text = Content(self._spelled, sorted(self._spelled.known()), overflows=False)
        self.root = Root(tree, ROOT, None, "")
        self._last, self.count = FREE, 0
        self._rows: dict[int, bytes] = {}
        self._dirty = False
        self._past: dict[int, FreeDir] = {}
        self._take_over()

    def number(self) -> int:
        """Give a new node its number."""
        self._last += 1
        return self._last

    def changed(self, *nodes: FreeFile | FreeDir) -> None:
        """Note that these came, or are not what they were."""
        for node in nodes:
            if node.parent is not None:
                numbers = node.data.numbers if isinstance(node, FreeFile) else None
                row = [node.path, node.parent.path, node.name, node.mode, node.uid, node.gid, node.mtime_ns, numbers]
                self._rows[node.path] = msgspec.json.encode(row)
        self._write()

    @contextlib.contextmanager
    def kept(self, node: FreeFile) -> Iterator[None]:
        """Note what happens to a file's row of objects."""
        before = list(node.data.numbers)
        try:
            yield
        finally:
            if node.data.numbers != before:
                self.changed(node)

    def removed(self, node: FreeFile | FreeDir) -> None:
        """Note that it is gone."""
        self._rows.pop(node.path, None)
        self._write()

    def edge(self, cycle: int) -> None:
        """Go on with what waited for the edge."""
        self.contents.edge(cycle)
        self._spelled.edge(cycle)
        self._past.clear()
        if self._dirty:
            self._write()

    def _write(self) -> None:
        self._dirty = False
        try:
            self._text.write(b"[" + b",".join(self._rows.values()) + b"]")
        except StoreFull:  # contents come first; `/at` and a successor see the names of before
            self._dirty = True

    # -- back from the store --------------------------------------------------------------------------------------

    def _take_over(self) -> None:
        """Go on with the files that a server before us left, also with what no edge has shown yet."""
        try:
            self._text.take_newest()
            nodes = self._fill(self.root, self._text.newest)
        except (RtdbError, msgspec.DecodeError, LookupError, TypeError, ValueError):  # damaged: begin anew
            self.root.children.clear()
            nodes = []
        for node in nodes:
            if isinstance(node, FreeFile):
                try:
                    node.data.take_newest()
                except RtdbError as error:  # damaged: the others are not
                    log.warning("%s is lost: %s", node.name, error)
        named = {number for node in nodes if isinstance(node, FreeFile) for number in node.data.numbers}
        for number in set(self.contents.known()) - named:
            self.contents.delete(number)
        self.count = len(nodes)
        self._last = max([self._last, *(node.path for node in nodes)])
        if nodes:
            self.changed(*nodes)

    def _fill(self, root: FreeDir, text: bytes) -> list[FreeFile | FreeDir]:
        """Make the nodes that a text tells of, below a root."""
        nodes: dict[int, Any] = {root.path: root}
        rows = msgspec.json.decode(text) if text else []
        for number, _, name, mode, uid, gid, mtime_ns, objects in rows:
            node: FreeFile | FreeDir
            if objects is None:
                node = FreeDir(self._tree, number, root, name)
            else:
                node = FreeFile(self._tree, number, root, name, Content(self.contents, objects))
            node.mode, node.uid, node.gid, node.mtime_ns = mode, uid, gid, mtime_ns
            nodes[number] = node
        for number, above, name, *_ in rows:  # a directory may stand behind what was moved into it
            nodes[number].parent = nodes[above]
            nodes[above].children[name] = nodes[number]
        return [node for number, node in nodes.items() if number != root.path]

    def root_at(self, cycle: int) -> FreeDir:
        """Give the free files by the names that a cut shows."""
        known = self._past.get(cycle)
        if known is None:
            if len(self._past) > KEPT:
                self._past.clear()
            known = self._past[cycle] = FreeDir(self._tree, ROOT, None, "")
            try:
                self._fill(known, self._text.read(cycle)[0])
            except (AgedOut, msgspec.DecodeError):
                known.children.clear()
        return known
