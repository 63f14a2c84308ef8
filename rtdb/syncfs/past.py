"""The past: `/at/<cycle>/...`, the tree as a cut showed it, read-only, for as long as the store keeps its history."""

from typing import TYPE_CHECKING

from .nodes import Attr, Directory, File, Node
from .policy import Who

if TYPE_CHECKING:
    from .tree import Tree

HISTORY = 1 << 63
LISTED = 10  # so many of the last edges are listed in /at


class AtDir(Directory):
    """`/at`: the cycles. The last edges are listed; any other that is still kept is there too."""

    __slots__ = ()

    def child(self, name: str, cycle: int) -> Node | None:
        if not (name.isascii() and name.isdecimal()) or len(name) > 15 or (name != "0" and name.startswith("0")):
            return None
        at = int(name)
        return self.tree.past(at) if at <= self.tree.store.cycle else None

    def entries(self, cycle: int) -> list[tuple[str, Node]]:
        every, last = self.tree.pace.every, self.tree.pace.last(self.tree.store.cycle)
        return [(str(c), self.tree.past(c)) for c in range(last, -1, -every)[:LISTED]]


class PastFile(File):
    """A file as it was."""

    __slots__ = ("_at", "_file")

    def __init__(self, tree: "Tree", path: int, parent: Directory, file: File, at: int) -> None:
        super().__init__(tree, path, parent)
        self._file, self._at = file, at

    def attr(self, cycle: int, who: Who) -> Attr:
        attr = self._file.attr(self._at, Who())
        return attr._replace(mode=attr.mode & ~0o222)

    def content(self, cycle: int, who: Who) -> bytes:
        return self._file.content(self._at, Who())


class PastDir(Directory):
    """A directory as it was."""

    __slots__ = ("_at", "_dir")

    def __init__(self, tree: "Tree", path: int, parent: Directory, directory: Directory, at: int) -> None:
        super().__init__(tree, path, parent)
        self._dir, self._at = directory, at

    def attr(self, cycle: int, who: Who) -> Attr:
        attr = self._dir.attr(self._at, Who())
        return attr._replace(mode=attr.mode & ~0o222)

    def child(self, name: str, cycle: int) -> Node | None:
        found = self._dir.child(name, self._at)
        return None if found is None else past_of(found, self._at, self)

    def entries(self, cycle: int) -> list[tuple[str, Node]]:
        return [(name, past_of(node, self._at, self)) for name, node in self._dir.entries(self._at)]


def past_of(node: Node, at: int, parent: Directory) -> Node:
    """Give a node as it was."""
    number = HISTORY | (at & 0x7FFFFFF) << 36 | (node.path & 0xFFFFFFFFF)
    if isinstance(node, Directory):
        return PastDir(node.tree, number, parent, node, at)
    assert isinstance(node, File)
    return PastFile(node.tree, number, parent, node, at)


class PastRoot(Directory):
    """The root as it was: components with what they showed, free files by the names that they had."""

    __slots__ = ("at",)

    def __init__(self, tree: "Tree", path: int, parent: Directory, at: int) -> None:
        super().__init__(tree, path, parent)
        self.at = at

    @property
    def free_root(self) -> Directory:
        """The free files of that time."""
        return self.tree.names.root_at(self.at)

    def child(self, name: str, cycle: int) -> Node | None:
        found: Node | None = self.tree.clock if name == "clock" else self.tree.component_dir(name)
        found = found or self.free_root.child(name, self.at)
        return None if found is None else past_of(found, self.at, self)

    def entries(self, cycle: int) -> list[tuple[str, Node]]:
        there: dict[str, Node] = {**dict(self.free_root.entries(self.at)), "clock": self.tree.clock}
        there |= self.tree.component_dirs()
        return [(name, past_of(node, self.at, self)) for name, node in there.items()]
