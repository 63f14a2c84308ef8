"""Drafts against plain bytes: what a file holds when it is closed, and that nothing unfinished is ever committed."""

import errno

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtdb.syncfs import FsError
from rtdb.syncfs.draft import SHOWN_AT_ONCE_BYTES, Draft

PIECE, MOST = 4, 40


def draft(base=b"base", *, append=False):
    commits = []
    return Draft(lambda: commits[-1] if commits else base, commits.append,
                 append=append, most_bytes=MOST, piece_bytes=PIECE), commits  # fmt: skip


pieces = st.binary(max_size=PIECE)
operations = st.lists(
    st.one_of(
        st.tuples(st.just("write"), st.integers(0, 50), pieces),
        st.tuples(st.just("truncate"), st.integers(0, 50)),
        st.tuples(st.just("edge")),
        st.tuples(st.just("finish")),
    ),
    max_size=25,
)


@given(base=st.binary(max_size=10), steps=operations)
def test_a_closed_file_holds_what_plain_bytes_would(base, steps):
    """A write at offset 0 replaces everything; the others patch; what is refused for its size changes nothing."""
    one, commits = draft(base)
    content, touched = base, False
    for what, *values in steps:
        too_large = (what == "truncate" and values[0] > MOST) or (what == "write" and values[0] + len(values[1]) > MOST)
        if too_large:
            with pytest.raises(FsError) as caught:
                getattr(one, what)(*values)
            assert caught.value.errno == errno.EFBIG
            continue
        getattr(one, what)(*values)
        if what == "truncate":
            content, touched = content[: values[0]].ljust(values[0], b"\0"), True
        elif what == "write" and values[1]:
            offset, piece = values
            content = (
                piece if offset == 0 else content[:offset].ljust(offset, b"\0") + piece + content[offset + len(piece) :]
            )
            touched = True
    one.finish()
    if touched:
        assert commits[-1] == content
    elif commits:  # writes of nothing
        assert set(commits) == {base}
    n = len(commits)
    one.finish()
    one.edge()
    one.edge()
    assert len(commits) == n, "nothing new, no revision"


@given(
    steps=st.lists(pieces.filter(len), min_size=1, max_size=9),
    edges=st.lists(st.integers(0, 3), min_size=9, max_size=9),
)
def test_what_began_with_a_truncation_is_one_revision_at_its_close(steps, edges):
    one, commits = draft()
    one.truncate(0)
    at = 0
    for piece, n_edges in zip(steps, edges, strict=False):
        one.write(at, piece)
        at += len(piece)
        for _ in range(n_edges):
            one.edge()
    assert commits == []
    one.finish()
    assert commits == [b"".join(steps)]


@given(
    documents=st.lists(st.integers(1, 30), min_size=1, max_size=8),
    edges=st.lists(st.booleans(), min_size=8, max_size=8),
    truncates=st.booleans(),
)
def test_a_file_kept_open_and_rewritten_commits_whole_documents_in_their_order(documents, edges, truncates):
    """Split into pieces as a client splits them; an edge may come behind each document."""
    one, commits = draft()
    if truncates:
        one.truncate(0)
    texts = [bytes([65 + k]) * size for k, size in enumerate(documents)]
    for text, edge in zip(texts, edges, strict=False):
        for at in range(0, len(text), PIECE):
            one.write(at, text[at : at + PIECE])
        if edge:
            one.edge()
    one.finish()
    order = [texts.index(commit) for commit in commits]
    assert order == sorted(set(order))
    assert commits[-1] == texts[-1]


@given(
    documents=st.lists(st.integers(1, 30), min_size=1, max_size=8),
    edges=st.lists(st.integers(0, 3), max_size=70),
)
def test_a_file_kept_open_is_not_committed_in_the_middle_of_a_document(documents, edges):
    """However long its writer rests between the pieces of one write."""
    one, commits = draft()
    texts, left = [bytes([65 + k]) * size for k, size in enumerate(documents)], list(edges)
    for text in texts:
        for at in range(0, len(text), PIECE):
            one.write(at, text[at : at + PIECE])
            for _ in range(left.pop() if left else 0):
                one.edge()
    one.finish()
    assert set(commits) <= set(texts)
    assert commits[-1] == texts[-1]


@given(
    documents=st.lists(st.lists(st.integers(1, PIECE - 1), min_size=2, max_size=5), min_size=3, max_size=6),
    edges=st.lists(st.integers(0, 3), min_size=30, max_size=30),
)
def test_a_file_that_is_rewritten_in_several_writes_shows_no_part_of_a_document(documents, edges):
    """Each beginning ends the one before, and the close the last, however long its writer rests between two writes."""
    one, commits = draft()
    one.truncate(0)
    texts = [bytes([65 + k]) * sum(sizes) for k, sizes in enumerate(documents)]
    for text, sizes in zip(texts, documents, strict=True):
        at = 0
        for size in sizes:
            one.write(at, text[at : at + size])
            at += size
            for _ in range(edges.pop()):
                one.edge()
    one.finish()
    assert commits == texts


@given(appended=st.lists(st.tuples(st.integers(1, 9), st.integers(0, 3)), min_size=1, max_size=4))
def test_of_a_long_write_that_appends_no_part_is_committed(appended):
    one, commits = draft(b"", append=True)
    ends = [sum(size for size, _ in appended[: k + 1]) for k in range(len(appended))]
    for size, n_edges in appended:
        for at in range(0, size, PIECE):
            one.write(0, b"x" * min(PIECE, size - at))
            for _ in range(n_edges):
                one.edge()
    one.finish()
    assert {len(commit) for commit in commits} <= set(ends)
    assert len(commits[-1]) == ends[-1]


def test_a_large_file_that_is_appended_to_without_a_pause_shows_at_each_edge():
    commits = [bytes(SHOWN_AT_ONCE_BYTES)]
    one = Draft(lambda: commits[-1], commits.append, append=True, most_bytes=1 << 20, piece_bytes=PIECE)
    for n in (1, 2, 3):
        one.write(0, b"x")
        one.write(0, b"y")
        assert len(commits) == n
        one.edge()
        assert commits[-1].endswith(b"xy" * n)


def test_what_is_patched_shows_when_it_was_left_alone_for_a_cycle():
    one, commits = draft()
    one.write(1, b"ol")
    one.edge()
    assert commits == []
    one.edge()
    assert commits == [b"bole"]


@given(base=st.binary(max_size=5), steps=st.lists(st.tuples(st.integers(0, 60), pieces, st.booleans()), max_size=6))
def test_an_append_goes_behind_the_newest_revision_wherever_the_client_aims(base, steps):
    one, commits = draft(base, append=True)
    for offset, piece, edge in steps:
        one.write(offset, piece)
        if edge:
            one.edge()
    one.finish()
    whole = base + b"".join(piece for _, piece, _ in steps)
    assert (commits[-1] if commits else base) == whole
    assert all(whole.startswith(commit) for commit in commits)


def test_nothing_written_is_nothing_committed():
    one, commits = draft()
    one.edge()
    one.finish()
    assert one.pristine
    assert commits == []


def test_a_write_of_nothing_takes_no_older_revision_up_again():
    newest = [b"old"]
    one = Draft(lambda: newest[-1], newest.append, append=False, most_bytes=MOST, piece_bytes=PIECE)
    one.write(0, b"")
    newest.append(b"of somebody else")
    one.finish()
    assert newest[-1] == b"of somebody else"


def test_an_invalid_revision_is_refused_once():
    def commit(data):
        raise FsError(errno.EINVAL, "no JSON")

    one = Draft(lambda: b"", commit, append=False, most_bytes=MOST, piece_bytes=PIECE)
    one.write(0, b"{")
    with pytest.raises(FsError):
        one.finish()
    one.finish()
