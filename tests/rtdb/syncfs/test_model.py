"""The file server against a plain model: a dict of names, and of each file a shown and a newest revision."""

import contextlib
import errno

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from rtdb import Store

from .conftest import O_RDONLY, O_TRUNC, O_WRONLY, REMOVEDIR, Refused, Rig

names = st.sampled_from(["a", "b", "c"])
contents = st.binary(max_size=12)
indices = st.integers(0, 99)
sessions = st.integers(0, 1)


class File:
    """A file: what readers see, and what they will see from the next edge on."""

    def __init__(self):
        self.shown = self.newest = b""
        self.gone = self.committed = self.seen = False  # seen: an edge has shown a revision of it

    def commit(self, data):
        if not self.gone:
            self.newest, self.committed = data, True

    def edge(self):
        self.shown, self.seen = self.newest, self.committed

    def replace(self, other):
        """Take another's place: until it is seen itself, what that one showed."""
        if not self.seen:
            self.shown, self.committed = other.shown, True


class Handle:
    """An open file: for reading, with its pinned revision, or for writing, with its draft."""

    def __init__(self, session, fid, file, draft=None):
        self.session, self.fid, self.file, self.draft = session, fid, file, draft
        self.pinned = None
        self.synced = False  # a revision was finished by fsync: the next begins with a truncation
        self.dirty = True


class FilesMachine(RuleBasedStateMachine):
    def __init__(self):
        super().__init__()
        self.store = Store.create(size=8 << 20)
        self.rig = Rig(self.store)
        self.clients = [self.rig.client(), self.rig.client()]
        self.root = {}  # name -> File, or a dict for a directory
        self.handles = []
        self.past = {}

    def teardown(self):
        self.rig.service.close()
        self.store.close()

    # -- the model -------------------------------------------------------------------------------------------

    def directories(self):
        return ["", *(name for name, node in self.root.items() if isinstance(node, dict))]

    def directory(self, k):
        found = self.directories()
        path = found[k % len(found)]
        return path, self.root[path] if path else self.root

    def files(self):
        tops = [(name, node) for name, node in self.root.items() if isinstance(node, File)]
        return tops + [
            (f"{name}/{inner}", file)
            for name, node in self.root.items()
            if isinstance(node, dict)
            for inner, file in node.items()
        ]

    def pick(self, k):
        found = self.files()
        return found[k % len(found)]

    def expect(self, code, call, *values):
        """A call that must end with this error, or with none."""
        try:
            result = call(*values)
        except Refused as error:
            assert error.code == code, (error, code)  # noqa: PT017
            return None
        assert code is None
        return result

    # -- names -----------------------------------------------------------------------------------------------

    @rule(s=sessions, k=indices, name=names)
    def create(self, s, k, name):
        path, directory = self.directory(k)
        fid = self.expect(
            errno.EEXIST if name in directory else None, self.clients[s].create, f"{path}/{name}".strip("/")
        )
        if fid is not None:
            self.clients[s].clunk(fid)
            directory[name] = File()

    @rule(s=sessions, name=names)
    def mkdir(self, s, name):
        self.expect(errno.EEXIST if name in self.root else None, self.clients[s].mkdir, name)
        self.root.setdefault(name, {})

    @rule(s=sessions, k=indices, name=names, as_directory=st.booleans())
    def remove(self, s, k, name, as_directory):
        path, directory = self.directory(k)
        node, code = directory.get(name), None
        if node is None:
            code = errno.ENOENT
        elif as_directory != isinstance(node, dict):
            code = errno.ENOTDIR if as_directory else errno.EISDIR
        elif isinstance(node, dict) and node:
            code = errno.ENOTEMPTY
        self.expect(code, self.clients[s].rm, f"{path}/{name}".strip("/"), REMOVEDIR if as_directory else 0)
        if code is None:
            del directory[name]
            if isinstance(node, File):
                node.gone = True

    @rule(s=sessions, j=indices, k=indices, old=names, new=names)
    def rename(self, s, j, k, old, new):
        (path, directory), (to_path, to) = self.directory(j), self.directory(k)
        node, there, code = directory.get(old), to.get(new), None
        if node is None:
            code = errno.ENOENT
        elif isinstance(node, dict) and to_path:
            if to is not node:
                return  # the model has directories of one depth
            code = errno.EINVAL
        elif there is not None and there is not node and isinstance(there, dict) != isinstance(node, dict):
            code = errno.EISDIR if isinstance(there, dict) else errno.ENOTDIR
        elif isinstance(there, dict) and there and there is not node:
            code = errno.ENOTEMPTY
        self.expect(code, self.clients[s].mv, f"{path}/{old}".strip("/"), f"{to_path}/{new}".strip("/"))
        if code is None and there is not node:
            if isinstance(there, File):
                there.gone = True
                node.replace(there)
            del directory[old]
            to[new] = node

    # -- contents --------------------------------------------------------------------------------------------

    @precondition(lambda self: self.files())
    @rule(s=sessions, k=indices, data=contents)
    def write_whole(self, s, k, data):
        path, file = self.pick(k)
        self.clients[s].write(path, data)
        file.commit(data)

    @precondition(lambda self: self.files())
    @rule(s=sessions, k=indices, data=contents.filter(len))
    def append(self, s, k, data):
        path, file = self.pick(k)
        self.clients[s].append(path, data)
        file.commit(file.newest + data)

    @precondition(lambda self: self.files())
    @rule(s=sessions, k=indices, size=st.integers(0, 20))
    def truncate_by_name(self, s, k, size):
        path, file = self.pick(k)
        fid = self.clients[s].walk(path)
        self.clients[s].truncate(fid, size)
        self.clients[s].clunk(fid)
        file.commit(file.newest[:size].ljust(size, b"\0"))

    @precondition(lambda self: self.files() and len(self.handles) < 6)
    @rule(s=sessions, k=indices, to_write=st.booleans())
    def open(self, s, k, to_write):
        path, file = self.pick(k)
        fid = self.clients[s].open(path, O_WRONLY | O_TRUNC if to_write else O_RDONLY)
        self.handles.append(Handle(self.clients[s], fid, file, b"" if to_write else None))

    def writers(self):
        return [h for h in self.handles if h.draft is not None]

    def readers(self):
        return [h for h in self.handles if h.draft is None]

    @precondition(writers)
    @rule(k=indices, data=contents.filter(len))
    def write(self, k, data):
        handle = self.writers()[k % len(self.writers())]
        if handle.file.gone:
            with pytest.raises(Refused):
                handle.session.pwrite(handle.fid, data, len(handle.draft))
            return
        if handle.synced:
            handle.session.truncate(handle.fid, 0)
            handle.draft, handle.synced = b"", False
        handle.session.pwrite(handle.fid, data, len(handle.draft))
        handle.draft, handle.dirty = handle.draft + data, True

    @precondition(writers)
    @rule(k=indices, back=st.integers(0, 5))
    def overwrite(self, k, back):
        handle = self.writers()[k % len(self.writers())]
        at = len(handle.draft) - back
        if handle.synced or at <= 0 or handle.file.gone:
            return
        handle.session.pwrite(handle.fid, b"*", at)
        handle.draft, handle.dirty = handle.draft[:at] + b"*" + handle.draft[at + 1 :], True

    @precondition(writers)
    @rule(k=indices)
    def fsync(self, k):
        handle = self.writers()[k % len(self.writers())]
        if handle.file.gone and handle.dirty:
            with pytest.raises(Refused):
                handle.session.fsync(handle.fid)
            handle.dirty = False
            return
        handle.session.fsync(handle.fid)
        if handle.dirty:
            handle.file.commit(handle.draft)
        handle.dirty, handle.synced = False, True

    @precondition(lambda self: self.handles)
    @rule(k=indices)
    def clunk(self, k):
        handle = self.handles.pop(k % len(self.handles))
        handle.session.clunk(handle.fid)
        if handle.draft is not None and handle.dirty:
            handle.file.commit(handle.draft)

    @precondition(readers)
    @rule(k=indices, offset=st.integers(0, 8), count=st.integers(1, 20))
    def read(self, k, offset, count):
        handle = self.readers()[k % len(self.readers())]
        if handle.file.gone and (offset == 0 or handle.pinned is None):
            return  # what a removed file shows is not said
        if offset == 0 or handle.pinned is None:
            handle.pinned = handle.file.shown
        assert handle.session.pread(handle.fid, offset, count) == handle.pinned[offset : offset + count]

    @rule(s=sessions)
    def a_connection_breaks(self, s):
        lost = self.clients[s]
        lost.hang_up()
        self.handles = [h for h in self.handles if h.session is not lost]
        self.clients[s] = self.rig.client()

    # -- time ------------------------------------------------------------------------------------------------

    @rule(ticks=st.integers(1, 9))
    def tick(self, ticks):
        for _ in range(ticks):
            self.rig.tick()
            if self.store.cycle % 10 == 0:
                self.shows()

    @rule()
    def edge(self):
        self.rig.edge()
        self.shows()

    def shows(self):
        for _, file in self.files():
            file.edge()
        self.past[self.store.cycle] = {path: file.shown for path, file in self.files()}

    @precondition(lambda self: self.past)
    @rule(s=sessions, k=st.integers(1, 3))
    def the_past_is_as_it_was(self, s, k):
        cycle = sorted(self.past)[-k:][0]
        for path, content in self.past[cycle].items():
            assert self.clients[s].read(f"at/{cycle}/{path}") == content
        tops = {path.partition("/")[0] for path in self.past[cycle]}
        assert tops <= set(self.clients[s].ls(f"at/{cycle}"))

    @precondition(lambda self: self.store.cycle)
    @rule()
    def a_stat_of_the_clock_waits_for_the_edge(self):
        tags = [client.stat("clock") for client in self.clients]
        self.edge()
        for client, tag in zip(self.clients, tags, strict=True):
            assert client.told(tag)["data_version"] == self.store.cycle // 10

    # -- what is seen ----------------------------------------------------------------------------------------

    @invariant()
    def both_see_the_model(self):
        for client in self.clients:
            assert client.ls() == sorted([*self.root, "at", "clock", "server"])
        client = self.clients[self.store.cycle % 2]
        for path, file in self.files():
            assert client.read(path) == file.shown
            assert client.look(path)["size"] == len(file.shown)
        for name, node in self.root.items():
            if isinstance(node, dict):
                assert client.ls(name) == sorted(node)
        for absent in {"a", "b", "c"} - set(self.root):
            with contextlib.suppress(Refused):
                client.walk(absent)
                raise AssertionError(f"{absent} is there")


TestFilesAreTheirModel = FilesMachine.TestCase
TestFilesAreTheirModel.settings = settings(
    max_examples=100, stateful_step_count=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck)
)
