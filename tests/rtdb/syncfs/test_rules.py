"""The rules of syncfs and cartfs, one test each: what may be relied on by whoever reads and writes files.

The rules are those of Indiana's syncfs and cartfs (2008), as docs/syncfs.md tells them.
"""

import contextlib
import errno
import json
import math
import threading
import time
from typing import Annotated

import numpy as np
import pytest

from rtdb import STATIC, Record, Store
from rtdb.json_object import json_schema
from rtdb.objects import Flag
from rtdb.recorder import Recorder
from rtdb.recording import Recording
from rtdb.records import f8, image
from rtdb.syncfs import OPERATOR, FsError, Limits, SeatSpec, Tokens

from .conftest import (
    EVERY,
    LOOK,
    O_APPEND,
    O_RDWR,
    O_TRUNC,
    O_WRONLY,
    REMOVEDIR,
    ROOT,
    Attributes,
    Refused,
    Rig,
)

OLD = ("9P2000", "9P2000.u")
DIALECTS = (*OLD, "9P2000.L")


class Pose(Record):
    """Where a cart is."""

    x_m: Annotated[float, f8("m", "east")] = 0.0
    y_m: Annotated[float, f8("m", "north")] = 0.0


class Frame(Record, eq=False):
    """What a camera sees."""

    pixels: Annotated[np.ndarray, image(2, 3, 3, "BGR")]


def refused(call, *values, **options):
    """Give the error of a call."""
    with pytest.raises(Refused) as caught:
        call(*values, **options)
    return caught.value.code


@pytest.fixture
def seated(make_rig):
    """A shared store with two components for scripts, which begins at an edge."""
    tokens = Tokens()
    for component in ("follow", "look"):
        tokens.give(component, f"token-of-{component}")
    tokens.give(OPERATOR, "token-of-operator")
    seats = [SeatSpec(component="follow", config={"inputs": {}}), SeatSpec(component="look")]
    rig = make_rig(shared=True, tokens=tokens, seats=seats)
    rig.edge()
    return rig


def keep_everything():
    """A wstat that leaves everything as it is: how the older dialects say fsync."""
    record = b"\xff" * (2 + 4 + 13 + 4 + 4 + 4 + 8) + b"\0\0" * 5 + b"\xff" * 12
    return len(record).to_bytes(2, "little") + record


# -- 1: a snapshot per edge ----------------------------------------------------------------------------------------


def test_all_commits_of_a_cycle_become_visible_at_its_edge_together(rig, fs):
    other = rig.client()
    names = ["a", "b", "c"]
    for turn in range(3):
        before = [other.read(name) if turn else b"" for name in names]
        for name in reversed(names):
            fs.write(name, b"%s%d" % (name.encode(), turn))
            assert [other.read(n) for n in names if n in other.ls()] == (
                before if turn else [b""] * len(other.ls()[3:])
            )
            rig.tick()
        rig.edge()
        assert [other.read(name) for name in names] == [b"%s%d" % (name.encode(), turn) for name in names]


def test_what_a_component_writes_between_edges_shows_at_the_next_edge_and_not_before(rig, fs):
    component = rig.store.join("localise")
    pose = component.insert("pose", Pose)
    rig.edge()
    for k in range(2 * EVERY):
        pose.write(Pose(x_m=float(k)), rig.store.now_ns)
        shown = fs.json("localise/status")["pose"]
        edge = (rig.store.cycle // EVERY - 1) * EVERY
        assert (shown or {}).get("x_m") == (edge - 1 if edge else None)
        rig.tick()


# -- 2: reads are never torn ---------------------------------------------------------------------------------------


def test_a_read_in_pieces_stays_with_the_revision_of_its_first_piece(rig, fs):
    fs.write("f", b"a" * 100)
    rig.edge()
    fid = fs.open("f")
    assert fs.pread(fid, 0, 10) == b"a" * 10
    fs.write("f", b"b" * 50)
    rig.edge()
    assert fs.pread(fid, 10, 1000) == b"a" * 90
    assert fs.pread(fid, 100, 1000) == b""
    assert fs.pread(fid, 0, 1000) == b"b" * 50
    assert fs.pread(fid, 50, 1000) == b""


def test_each_open_file_has_its_own_pinned_revision(rig, fs):
    fs.write("f", b"first")
    rig.edge()
    one, two = fs.open("f"), fs.open("f")
    assert fs.pread(one, 0, 1) == b"f"
    fs.write("f", b"SECOND")
    rig.edge()
    assert fs.pread(two, 0, 1) == b"S"
    assert (fs.pread(one, 1), fs.pread(two, 1)) == (b"irst", b"ECOND")


def test_a_pinned_revision_outlives_its_file_and_the_stores_history(rig, fs):
    fs.write("f", b"a" * 10_000)
    rig.edge()
    fid = fs.open("f")
    assert fs.pread(fid, 0, 1) == b"a"
    fs.rm("f")
    rig.edge(200)
    assert fs.pread(fid, 1, 20_000) == b"a" * 9_999


# -- 3: writes are never torn --------------------------------------------------------------------------------------


def test_truncation_writes_and_close_are_one_revision(rig):
    fs, reader = rig.client(msize=4096), rig.client()
    fs.write("f", b"old" * 3000)
    rig.edge()
    new = bytes(range(256)) * 100
    fid = fs.open("f", O_WRONLY | O_TRUNC)
    for at in range(0, len(new), 4000):
        fs.pwrite(fid, new[at : at + 4000], at)
        rig.edge()
        assert reader.read("f") == b"old" * 3000
    fs.clunk(fid)
    assert reader.read("f") == b"old" * 3000
    rig.edge()
    assert reader.read("f") == new


def test_an_unfinished_revision_waits_over_an_edge(rig, fs):
    fs.write("f", b"old")
    rig.edge()
    fid = fs.open("f", O_WRONLY | O_TRUNC)
    rig.edge(3)
    assert fs.read("f") == b"old"
    fs.pwrite(fid, b"ne")
    rig.edge(3)
    assert fs.read("f") == b"old"
    fs.pwrite(fid, b"w", 2)
    fs.clunk(fid)
    rig.edge()
    assert fs.read("f") == b"new"


def test_a_new_file_shows_nothing_until_it_is_closed(rig, fs):
    """`cp` of something large takes several cycles."""
    fid = fs.create("f")
    fs.pwrite(fid, b"half")
    rig.edge(3)
    seen = fs.read("f")
    fs.pwrite(fid, b" and half", 4)
    fs.clunk(fid)
    rig.edge()
    assert (seen, fs.read("f")) == (b"", b"half and half")


@pytest.mark.parametrize("dialect", OLD)
def test_an_open_with_truncation_waits_for_its_close_in_the_older_dialects_too(rig, dialect):
    fs = rig.client(dialect)
    fid = fs.create("f")
    fs.pwrite(fid, b"old")
    fs.clunk(fid)
    rig.edge()
    fid = fs.open("f", O_WRONLY | O_TRUNC)
    fs.pwrite(fid, b"n")
    rig.edge(3)
    assert fs.read("f") == b"old"
    fs.pwrite(fid, b"ew", 1)
    fs.clunk(fid)
    rig.edge()
    assert fs.read("f") == b"new"


def test_a_shorter_rewrite_leaves_no_tail(rig, fs):
    for text in (b"a long first revision", b"short", b"", b"longer again"):
        fs.write("f", text)
        rig.edge()
        assert fs.read("f") == text


def test_a_descriptor_kept_open_and_rewritten_from_offset_0_replaces_the_whole_content(rig, fs):
    fid = fs.create("f")
    texts = [b"the first and longest", b"second", b"3", b"fourth"]
    for text in texts:
        fs.pwrite(fid, text)
        rig.edge()
        assert fs.read("f") in (b"", *texts)
    fs.clunk(fid)
    rig.edge()
    assert fs.read("f") == texts[-1]


def test_a_write_at_offset_0_finishes_the_revision_before(rig, fs):
    rig.tick(EVERY - 1)
    fid = fs.create("f")
    fs.pwrite(fid, b"one")
    fs.pwrite(fid, b" and two", 3)
    fs.pwrite(fid, b"th")
    rig.tick()
    assert fs.read("f") == b"one and two"


def test_a_file_of_many_messages_kept_open_is_never_seen_half_written(rig):
    """Each revision arrives over several ticks of the store, one over many, and the next follows from offset 0."""
    fs, reader = rig.client(msize=4096), rig.client()
    fid = fs.create("f")
    for letter in b"abcde":
        for piece in range(4):
            fs.pwrite(fid, bytes([letter]) * 4072, piece * 4072)
            rig.tick(3)  # and a machine may stand still between two of them
            rig.edge(2 if letter == ord("c") else 0)
            seen = reader.read("f")
            assert len(seen) in (0, 4 * 4072)
            assert len(set(seen)) <= 1
    rig.edge()


def test_each_write_is_a_revision_once_those_before_were_one_write_each(rig, fs):
    fid = fs.create("f")
    for text in (b"111", b"222", b"333"):
        fs.pwrite(fid, text)
    rig.edge()
    assert fs.read("f") == b"333"


def test_a_status_that_is_kept_open_is_never_torn_however_it_is_written(seated):
    rig, fs = seated, seated.client(token="token-of-look")
    fid = fs.open("look/status", O_WRONLY)
    for k in range(3):
        fs.pwrite(fid, b'{"a": %d}' % k)
        rig.edge()
    fs.pwrite(fid, b'{"a":')
    rig.edge()
    assert fs.json("look/status") == {"a": 2}
    fs.pwrite(fid, b" 3}", 5)
    rig.edge()
    assert fs.json("look/status") == {"a": 3}


def test_a_descriptor_kept_open_truncated_and_rewritten_shows_each_revision(rig, fs):
    """`f.seek(0); f.truncate(); f.write(...); f.flush()` in each cycle."""
    fid = fs.create("f")
    seen = []
    for k in range(5):
        fs.truncate(fid, 0)
        fs.pwrite(fid, b"%d" % k)
        rig.edge()
        seen.append(fs.read("f"))
    assert seen[1:] in ([b"1", b"2", b"3", b"4"], [b"0", b"1", b"2", b"3"])


def test_fsync_finishes_a_revision(rig, fs):
    fs.write("f", b"old")
    rig.edge()
    fid = fs.open("f", O_WRONLY | O_TRUNC)
    fs.pwrite(fid, b"new")
    fs.fsync(fid)
    assert fs.read("f") == b"old"
    rig.edge()
    assert fs.read("f") == b"new"
    rig.edge()
    fs.clunk(fid)


def test_a_wstat_that_changes_nothing_is_the_fsync_of_unix_dialect(rig):
    """stat(5) of Plan 9, and what Linux sends for fsync(2) there."""
    fs = rig.client("9P2000.u")
    fid = fs.create("f")
    fs.pwrite(fid, b"old")
    fs.clunk(fid)
    rig.edge()
    fid = fs.open("f", O_WRONLY | O_TRUNC)
    fs.pwrite(fid, b"new")
    fs.call("Twstat", fid, keep_everything())
    rig.edge()
    assert fs.read("f") == b"new"


def test_a_long_write_of_which_a_piece_is_refused_leaves_the_revision_before(make_rig):
    rig = make_rig(limits=Limits(file_bytes=20_000))
    fs = rig.client(msize=4096)
    fs.write("f", b"before")
    rig.edge()
    for flags, content in (
        (O_WRONLY, b"x" * 30_000),
        (O_WRONLY | O_TRUNC, b"y" * 30_000),
        (O_WRONLY | O_APPEND, b"z" * 30_000),
    ):
        fid = fs.open("f", flags)
        assert refused(fs.pwrite, fid, content) == errno.EFBIG
        if not flags & O_APPEND:
            assert refused(fs.pwrite, fid, b"more", 10) == errno.EFBIG, "it goes on from what is not there"
        fs.clunk(fid)
        rig.edge(2)
        assert fs.read("f") == b"before"
    fid = fs.open("f", O_WRONLY)
    assert refused(fs.pwrite, fid, b"x" * 30_000) == errno.EFBIG
    fs.pwrite(fid, b"begun anew")
    fs.clunk(fid)
    rig.edge()
    assert fs.read("f") == b"begun anew"


def test_a_stat_of_the_own_clock_leaves_a_long_write_that_is_under_way_alone(seated):
    script, piece = seated.client(token="token-of-follow", msize=4096), 4096 - 24
    script.write("f", b"before")
    seated.edge()
    long, short = script.open("f", O_WRONLY), script.create("short")
    script.pwrite(long, b"x" * piece)
    script.pwrite(short, b"first")
    script.pwrite(short, b"done")  # a descriptor that is kept open and written again
    tag = script.stat("follow/clock")
    seated.edge()
    script.told(tag)
    assert (script.read("f"), script.read("short")) == (b"before", b"done")
    script.pwrite(long, b"yy", piece)
    script.clunk(long)
    seated.edge()
    assert script.read("f") == b"x" * piece + b"yy"


def test_an_empty_revision_does_not_hold_up_the_next(rig, fs):
    fs.write("f", b"")
    fid = fs.open("f", O_WRONLY)
    fs.pwrite(fid, b"zero")
    for content in (b"one", b"", b"two", b"three"):
        if content:
            fs.pwrite(fid, content)
        else:
            fs.truncate(fid, 0)
            fs.fsync(fid)
        rig.edge()
        assert fs.read("f") == content


def test_truncate_by_name_is_a_revision_of_its_own(rig, fs):
    fs.write("f", b"0123456789")
    rig.edge()
    fid = fs.walk("f")
    fs.truncate(fid, 4)
    assert fs.read("f") == b"0123456789"
    rig.edge()
    assert fs.read("f") == b"0123"
    fs.truncate(fid, 6)
    rig.edge()
    assert fs.read("f") == b"0123\0\0"


def test_linux_truncation_by_another_fid_begins_the_revision_of_the_open_one(rig, fs):
    """Linux opens a clone and truncates by the fid of the name: an edge between shows no empty file."""
    fs.write("f", b"old")
    rig.edge()
    name, clone = fs.walk("f"), fs.walk("f")
    fs.call("Tlopen", clone, O_WRONLY)
    fs.truncate(name, 0)
    rig.edge(2)
    assert fs.read("f") == b"old"
    fs.pwrite(clone, b"new")
    fs.clunk(clone)
    rig.edge()
    assert fs.read("f") == b"new"


def test_a_revision_of_a_connection_that_broke_is_never_seen(rig, fs):
    fs.write("f", b"old")
    rig.edge()
    dead = rig.client()
    dead.pwrite(dead.open("f", O_WRONLY | O_TRUNC), b"half a rev")
    dead.hang_up()
    rig.edge(3)
    assert fs.read("f") == b"old"


def test_two_writers_of_one_cycle_leave_the_revision_that_was_finished_last(rig, fs):
    other = rig.client()
    fs.write("f", b"")
    one, two = fs.open("f", O_WRONLY | O_TRUNC), other.open("f", O_WRONLY | O_TRUNC)
    fs.pwrite(one, b"one " * 5)
    other.pwrite(two, b"two")
    other.clunk(two)
    fs.clunk(one)
    rig.edge()
    assert fs.read("f") == b"one " * 5


def test_more_revisions_in_a_cycle_than_a_ring_holds_leave_the_last(rig, fs):
    for k in range(300):
        fs.write("f", b"%d" % k)
    rig.edge(2)
    assert fs.read("f") == b"299"


def test_a_large_file_written_often_in_a_cycle_shows_its_last_revision_at_the_edge(rig, fs):
    fs.write("f", b"0" * 20_000)
    rig.edge(2)
    for k in b"123456789":
        fs.write("f", bytes([k]) * 20_000)
    rig.edge()
    assert fs.read("f") == b"9" * 20_000


def test_a_clone_of_an_open_fid_under_its_own_number_loses_nothing_that_was_written(rig, fs):
    """walk(5): the fid of a walk has not been opened; so such a walk is refused, or what is open stays it."""
    fid = fs.create("f")
    fs.pwrite(fid, b"new")
    with contextlib.suppress(Refused):
        fs.call("Twalk", fid, fid, [])
    fs.clunk(fid)
    rig.edge()
    assert fs.read("f") == b"new"


@pytest.mark.parametrize("dialect", OLD)
def test_who_opened_for_reading_with_truncation_does_not_write(rig, fs, dialect):
    fs.write("f", b"old")
    old = rig.client(dialect)
    fid = old.walk("f")
    old.call("Topen", fid, 0x10)
    with pytest.raises(Refused):
        old.call("Twrite", fid, 0, b"new")


# -- appends -------------------------------------------------------------------------------------------------------


def test_two_appends_in_one_cycle_are_both_kept(rig, fs):
    other = rig.client()
    fs.write("log", b"0")
    rig.edge()
    fs.append("log", b"a")
    other.append("log", b"b")
    fs.append("log", b"c")
    rig.edge()
    assert fs.read("log") == b"0abc"


def test_two_appends_that_overlap_are_both_kept(rig, fs):
    """`echo a >> log & echo b >> log`: both open before either has closed."""
    other = rig.client()
    fs.write("log", b"0")
    rig.edge()
    one, two = fs.open("log", O_WRONLY | O_APPEND), other.open("log", O_WRONLY | O_APPEND)
    fs.pwrite(one, b"a", 1)
    other.pwrite(two, b"b", 1)
    fs.clunk(one)
    other.clunk(two)
    rig.edge()
    assert sorted(fs.read("log").decode()) == ["0", "a", "b"]


def test_a_log_that_stays_open_shows_the_lines_of_the_cycles_before(rig, fs):
    """`exec 3>>log; while stat clock; do echo x >&3; done`: it never pauses for a cycle."""
    fid = fs.create("log", O_WRONLY | O_APPEND)
    for k in range(5 * EVERY):
        fs.pwrite(fid, b"x", k)
        rig.tick()
    assert len(fs.read("log")) >= 3 * EVERY


# -- 4, and cartfs: JSON -------------------------------------------------------------------------------------------


def test_invalid_json_is_not_committed_and_the_last_good_status_stays(seated):
    script, reader = seated.client(token="token-of-follow"), seated.client()
    script.write("follow/status", b'{"speed_mps": 1.5}')
    seated.edge()
    for bad in (b"{", b"[1]", b"", b'{"a": NaN}', b'{"a": 1e999}', b"\xff", b"{} {}"):
        assert refused(script.write, "follow/status", bad, sync=True) == errno.EINVAL
        seated.edge()
        assert json.loads(reader.read("follow/status")) == {"speed_mps": 1.5}


def test_invalid_json_in_a_status_that_is_kept_open_shows_in_the_health_when_it_was_left_alone(seated):
    script, reader = seated.client(token="token-of-follow"), seated.client()
    fid = script.open("follow/status", O_WRONLY)
    script.pwrite(fid, b'{"speed_mps": 1.5}')
    script.pwrite(fid, b'{"speed_mps": ')
    seated.edge(3)
    assert json.loads(reader.read("follow/status")) == {"speed_mps": 1.5}
    assert "refused" in reader.json("follow/health")["status"]


def test_invalid_json_shows_in_the_components_health_and_in_the_servers_count(seated):
    script, reader = seated.client(token="token-of-follow"), seated.client()
    script.write("follow/status", b'{"speed_mps": 1.5}')
    seated.edge()
    assert refused(script.write, "follow/status", b'{"speed_mps": ', sync=True) == errno.EINVAL
    seated.edge()
    health = reader.json("follow/health")
    assert health["state"] == "WARNING"
    assert "refused" in health["status"]
    assert reader.json("server")["refused"] == {"follow": 1}
    script.write("follow/status", b'{"speed_mps": 1.5}')
    seated.edge()
    assert reader.json("follow/health")["state"] == "RUNNING"


def test_invalid_json_through_a_descriptor_kept_open_fails_no_stat_of_the_clock(seated):
    """The loop of a script is `while stat clock`: it would end there."""
    script = seated.client(token="token-of-follow")
    fid = script.open("follow/status", O_WRONLY)
    script.pwrite(fid, b'{"speed_mps": ')
    tag = script.stat("follow/clock")
    seated.edge()
    assert script.told(tag)["data_version"] == 2
    assert "refused" in script.json("follow/health")["status"]


def test_a_silent_script_shows_in_its_components_health(seated):
    script, reader = seated.client(token="token-of-follow"), seated.client()
    script.write("follow/status", b"{}")
    seated.edge(6)
    health = reader.json("follow/health")
    assert "silent" in health["status"]
    assert health["state"] == "WARNING"


def test_a_script_that_died_shows_in_its_components_health(seated):
    script, reader = seated.client(token="token-of-follow"), seated.client()
    script.write("follow/status", b"{}")
    seated.edge()
    assert [c.alive for c in seated.store.components() if c.name == "follow"] == [True]
    script.hang_up()
    seated.edge()
    assert reader.json("follow/health")["state"] == "FAILURE"
    assert [c.alive for c in seated.store.components() if c.name == "follow"] == [False]
    assert reader.json("follow/status") == {}


def test_a_status_names_what_its_script_had_read_as_its_causes(seated):
    store = seated.store
    eyes = store.join("eyes")
    far, still = eyes.insert("far", json_schema(100)), eyes.insert("still", json_schema(100), flags=STATIC)
    far.write({"gap_m": 9.0})
    still.write({"size_m": 1.0})
    seated.edge()
    script, other, reader = (seated.client(token=f"token-of-{name}") for name in ("follow", "look", "operator"))
    status = store.find("follow/status")

    def causes():
        seated.edge()
        return status.visible(store.cycle).causes

    script.write("follow/status", b"{}")
    assert causes() == ()
    script.read("eyes/status")
    other.read("look/status")
    script.write("follow/status", b"{}")
    assert causes() == ((far.oid, 1),), "what is written once is nobody's cause, nor is what others read"
    script.write("follow/status", b"{}")
    assert causes() == ((far.oid, 1),), "it knows still what it had read"
    far.write({"gap_m": 8.0})
    seated.edge()
    other.write("look/status", b"{}")
    far.write({"gap_m": 7.0})
    seated.edge()
    script.read("look/status")
    script.read("eyes/status")
    reader.read("eyes/status")
    script.write("follow/status", b"{}")
    look = store.find("look/status")
    assert causes() == ((look.oid, 1), (far.oid, 3))
    script.read("look/status")
    script.write("follow/status", b"{}")
    assert causes() == ((look.oid, 1),), "what was read before the last status is the cause of that one"


def test_a_status_names_the_8_writes_that_were_read_last(seated):
    eyes = seated.store.join("eyes")
    seen = [eyes.insert(f"see{k}", json_schema(100)) for k in range(10)]
    for one in seen:
        one.write({})
    seated.edge()
    script = seated.client(token="token-of-follow")
    script.read("eyes/status")
    script.write("follow/status", b"{}")
    seated.edge()
    assert seated.store.find("follow/status").visible(seated.store.cycle).causes == tuple((o.oid, 1) for o in seen[2:])


def test_what_a_script_writes_is_read_by_others_as_it_was_written(seated):
    text = b'{"drive":  {"speed_mps": 1.5,\n "steer_rad": -0.1}}\n'
    seated.client(token="token-of-follow").write("follow/status", text)
    seated.edge()
    assert seated.client().read("follow/status") == text
    assert seated.store.find("follow/status").visible(seated.store.cycle).value == json.loads(text)


# -- 5: what blocks ------------------------------------------------------------------------------------------------


def test_a_stat_of_the_clock_is_answered_at_the_next_edge_all_waiters_together(rig):
    clients = [rig.client() for _ in range(5)]
    tags = [client.stat("clock") for client in clients]
    rig.tick(EVERY - 1)
    assert not any(client.replies for client in clients)
    rig.tick()
    assert [client.told(tag)["data_version"] for client, tag in zip(clients, tags, strict=True)] == [1] * 5


def test_a_lookup_of_the_clock_never_waits(fs):
    for mask in (LOOK, 0x7FF, 0x200, 0x2000, 0x1FFF):
        assert Attributes(fs.call("Tgetattr", fs.walk("clock"), mask))["mode"] & 0o777 == 0o444


def test_no_other_stat_waits(rig, fs):
    rig.store.join("localise").insert("pose", Pose)
    fs.write("f", b"1")
    for path in ("", "f", "server", "at", "localise", "localise/status", "at/0/clock"):
        fs.told(fs.stat(path))


@pytest.mark.parametrize("dialect", OLD)
def test_each_stat_of_the_clock_waits_in_the_older_dialects(rig, dialect):
    fs = rig.client(dialect)
    tags = [fs.stat("clock") for _ in range(2)]
    assert fs.reply(fs.stat("server")) is not None
    assert fs.reply(fs.stat("")) is not None
    rig.tick(EVERY - 1)
    assert [fs.reply(tag) for tag in tags] == [None, None]
    rig.tick()
    for tag in tags:
        (record,) = fs.reply(tag)
        size, _, _, qid_type, version = record[0:2], record[2:4], record[4:8], record[8], record[9:13]
        assert int.from_bytes(size, "little") == len(record) - 2
        assert (qid_type, int.from_bytes(version, "little")) == (0, 1)


def test_a_flushed_stat_is_never_answered(rig, fs):
    tag = fs.stat("clock")
    assert fs.call("Tflush", tag) == ()
    rig.edge(2)
    assert fs.reply(tag) is None
    again = fs.send("Tgetattr", fs.walk("clock"), 0x3FFF, tag=tag)
    rig.edge()
    assert fs.told(again)["data_version"] == 3


def test_a_flush_of_an_unknown_or_answered_tag_is_no_error(rig, fs):
    assert fs.call("Tflush", 999) == ()
    tag = fs.stat("clock")
    rig.edge()
    fs.told(tag)
    assert fs.call("Tflush", tag) == ()


def test_a_connection_that_ends_takes_its_stats_along(rig, fs):
    dead = rig.client()
    tag = dead.stat("clock")
    dead.hang_up()
    rig.edge()
    assert dead.reply(tag) is None
    assert fs.json("server")["waiting"] == 0


def test_a_clock_that_stands_answers_after_a_grace_with_its_number_unchanged(rig, fs):
    rig.edge(3)
    rig.tick(4)
    tag = fs.stat("clock")
    rig.stand(0.5)
    assert fs.reply(tag) is None
    rig.stand(1.5)
    assert fs.told(tag)["data_version"] == 3
    tag = fs.stat("clock")
    rig.edge()
    assert fs.told(tag)["data_version"] == 4


def test_a_stat_that_waits_delays_no_other_request(rig, fs):
    tag = fs.stat("clock")
    fs.write("f", b"x")
    assert fs.call("Tstatfs", ROOT)[0] == 0x01021997
    rig.edge()
    assert fs.order.index(tag) > 5
    assert fs.told(tag)["data_version"] == 1


def test_a_stat_answered_by_an_edge_sees_what_was_committed_before_it(rig, fs):
    fs.write("f", b"new")
    tag, seen = fs.stat("clock"), []
    taken = fs._taken

    def look_at_once(data):
        taken(data)
        seen.append(other.read("f"))

    other = rig.client()
    fs.session._send = look_at_once
    rig.edge()
    assert seen == [b"new"]
    assert fs.told(tag)["data_version"] == 1


# -- 6: the clock --------------------------------------------------------------------------------------------------


def test_the_clock_has_a_constant_size_and_a_stat_alone_tells_its_number_and_time(rig, fs):
    sizes = set()
    for n in range(1, 120):
        tag = fs.stat("clock")
        rig.edge()
        attr, content = fs.told(tag), fs.read("clock")
        sizes |= {attr["size"], len(content)}
        assert attr["data_version"] == attr["qid"].version == n
        assert attr.t_ns == rig.store.t0_ns + n * EVERY * rig.store.tick_ns
        said = json.loads(content)
        assert (said["clock"], said["interval"]) == (n, EVERY * rig.store.tick_ns)
        assert said["t_ns"] == attr.t_ns
        assert "overruns" in said
        assert "wall_ns" in said
    assert len(sizes) == 1


def test_the_qid_of_a_walk_tells_the_clocks_number_too(rig, fs):
    rig.edge(3)
    (qids,) = fs.call("Twalk", ROOT, fs.new(), ["clock"])
    assert qids[0].version == 3


def test_a_clock_tells_the_same_number_by_stat_and_by_content_to_a_component(make_rig):
    """Its mount has the component's own pace: `/clock` counts those edges, in both."""
    tokens = Tokens()
    tokens.give("quick", "token")
    seat = SeatSpec(component="quick", every=5, latency_cycles=4)
    rig = make_rig(shared=True, tokens=tokens, seats=[seat])
    fs = rig.client(token="token")
    rig.tick(20)
    tag = fs.stat("clock")
    rig.tick(5)
    assert fs.told(tag)["data_version"] == fs.json("clock")["clock"] == 5


def test_the_clock_of_a_component_counts_its_own_edges(rig, fs):
    rig.store.join("quick", every=1)
    rig.store.join("slow", every=20)
    rig.tick(20)
    for n in (21, 22, 23):
        tag = fs.stat("quick/clock")
        rig.tick()
        attr = fs.told(tag)
        assert (attr["data_version"], attr.t_ns) == (n, n * rig.store.tick_ns)
    tag = fs.stat("slow/clock")
    rig.tick(16)
    assert fs.reply(tag) is None
    rig.tick()
    assert fs.told(tag)["data_version"] == 2


# -- 7: missed edges -----------------------------------------------------------------------------------------------


def test_missed_edges_show_as_a_jump_of_the_number_and_are_counted(seated):
    script = seated.client(token="token-of-follow")
    tag = script.stat("follow/clock")
    seated.edge()
    first = script.told(tag)["data_version"]
    seated.edge(3)
    tag = script.stat("follow/clock")
    seated.edge()
    assert script.told(tag)["data_version"] == first + 4
    assert script.json("server")["missed"]["follow"] == 3


def test_in_real_time_missed_edges_are_counted_and_the_next_edge_is_on_the_grid(unique):
    """No time is measured: the store's own number says which edges went by."""
    tokens = Tokens()
    tokens.give("follow", "token")
    with Store.create(unique(), clock="real", tick_ns=2_000_000, size=8 << 20) as store:
        rig = Rig(store, tokens=tokens, seats=[SeatSpec(component="follow")])
        try:
            script = rig.client(token="token")
            store.run_clock()

            def told():
                tag = script.stat("follow/clock")
                while tag not in script.replies:
                    store.wait_cycle(store.cycle, 30.0)
                    rig.service.edge(0.0)
                return script.told(tag)

            first = told()
            while store.cycle < (first["data_version"] + 4) * EVERY:
                store.wait_cycle(store.cycle, 30.0)
            then = told()
            passed = then["data_version"] - first["data_version"]
            assert passed >= 5
            rig.service.edge(0.0)
            assert Attributes(script.call("Tgetattr", script.walk("clock"), LOOK))["size"] > 0
            assert then.t_ns == store.t0_ns + then["data_version"] * EVERY * store.tick_ns
            report = rig.service.report()
            assert report["missed"]["follow"] == passed - 1
        finally:
            rig.service.close()


# -- 9: a barrier --------------------------------------------------------------------------------------------------


def test_a_barrier_has_its_edge_when_all_components_wait_in_a_stat_again(unique):
    tokens = Tokens()
    names = ("one", "two")
    for component in names:
        tokens.give(component, f"token-{component}")
    with Store.create(unique(), clock="barrier", size=8 << 20) as store:
        rig = Rig(store, tokens=tokens, seats=[SeatSpec(component=c, every=1, latency_cycles=0) for c in names])
        try:
            scripts = [rig.client(token=f"token-{c}") for c in names]
            store.run_clock(names)
            tags = [script.stat(f"{c}/clock") for script, c in zip(scripts, names, strict=True)]
            cycles = []
            for k in range(20):
                while any(tag not in script.replies for script, tag in zip(scripts, tags, strict=True)):
                    assert store.wait_cycle(rig.service.cycle, 30.0) is not None
                    rig.service.edge(0.0)
                told = [script.told(tag)["data_version"] for script, tag in zip(scripts, tags, strict=True)]
                assert told[0] == told[1]
                cycles.append(told[0])
                late, early = scripts[k % 2], scripts[1 - k % 2]
                first = early.stat(f"{names[1 - k % 2]}/clock")
                assert store.wait_cycle(told[0], 0.0) is None, "it did not wait for the other"
                second = late.stat(f"{names[k % 2]}/clock")
                tags = [second, first] if k % 2 == 0 else [first, second]
            assert cycles == list(range(cycles[0], cycles[0] + 20))
        finally:
            rig.service.close()


def test_a_stat_of_a_components_clock_by_the_component_says_that_it_is_done(seated):
    script, reader = seated.client(token="token-of-follow"), seated.client()

    def done():
        return next(c.done for c in seated.store.components() if c.name == "follow")

    before = done()
    tag = reader.stat("follow/clock")
    assert done() == before, "another's stat does not count"
    own = script.stat("follow/clock")
    assert done() == seated.store.cycle
    seated.edge()
    script.told(own)
    reader.told(tag)
    assert done() == seated.store.cycle - EVERY
    script.stat("follow/clock")
    assert done() == seated.store.cycle


# -- 10: names -----------------------------------------------------------------------------------------------------


def test_names_come_at_once_and_files_are_empty_until_the_edge(rig, fs):
    other = rig.client()
    fs.mkdir("d")
    fs.write("d/f", b"content")
    assert "d" in other.ls()
    assert other.ls("d") == ["f"]
    assert other.read("d/f") == b""
    assert other.look("d/f")["size"] == 0
    rig.edge()
    assert other.read("d/f") == b"content"
    assert other.look("d/f")["size"] == 7


def test_names_go_at_once(rig, fs):
    other = rig.client()
    fs.mkdir("d")
    fs.write("d/f", b"content")
    rig.edge()
    assert refused(fs.rm, "d", REMOVEDIR) == errno.ENOTEMPTY
    assert refused(fs.rm, "d") == errno.EISDIR
    assert refused(fs.rm, "d/f", REMOVEDIR) == errno.ENOTDIR
    fs.rm("d/f")
    assert other.ls("d") == []
    assert refused(other.open, "d/f") == errno.ENOENT
    fs.rm("d", REMOVEDIR)
    assert "d" not in other.ls()


def test_names_move_at_once_and_replace_what_was_there(rig, fs):
    other = rig.client()
    fs.write("a", b"A")
    fs.write("b", b"B")
    rig.edge()
    fs.mv("a", "b")
    assert "a" not in other.ls()
    assert other.read("b") == b"A"
    rig.edge()
    assert other.read("b") == b"A"


def test_a_name_made_anew_is_another_file(rig, fs):
    fs.write("f", b"old")
    rig.edge()
    number, fid = fs.look("f")["qid"].path, fs.open("f", O_WRONLY)
    fs.rm("f")
    fs.write("f", b"new")
    assert fs.look("f")["qid"].path != number
    assert refused(fs.pwrite, fid, b"to the old one") == errno.ENOENT
    fs.clunk(fid)
    rig.edge()
    assert fs.read("f") == b"new"


def test_nothing_moves_into_a_directory_that_was_removed(rig, fs):
    fs.mkdir("d")
    fs.write("f", b"content")
    gone = fs.walk("d")
    fs.rm("d", REMOVEDIR)
    assert refused(fs.call, "Trenameat", ROOT, "f", gone, "f") == errno.ENOENT
    assert refused(fs.call, "Tmkdir", gone, "e", 0o755, 0) == errno.ENOENT
    assert refused(fs.call, "Tlcreate", gone, "e", O_WRONLY, 0o644, 0) == errno.ENOENT
    assert "f" in fs.ls()


def test_a_directory_does_not_move_into_itself(fs):
    fs.mkdir("a")
    fs.mkdir("a/b")
    assert refused(fs.mv, "a", "a/b/c") == errno.EINVAL
    assert refused(fs.mv, "a", "a/c") == errno.EINVAL


def test_names_of_the_store_are_neither_moved_nor_removed_nor_taken(seated):
    fs = seated.client()
    seated.client(token="token-of-follow")
    fs.write("f", b"1")
    for name in ("clock", "server", "at", "follow"):
        assert refused(fs.mv, name, "x") == errno.EACCES
        assert refused(fs.mv, "f", name) in (errno.EACCES, errno.EEXIST)
        assert refused(fs.rm, name) in (errno.EACCES, errno.EISDIR)
        assert refused(fs.mkdir, name) == errno.EEXIST
    assert refused(fs.create, "follow/new") == errno.EACCES


def test_a_name_that_is_no_utf8_harms_nobody(rig, fs):
    """9P's texts are UTF-8; a client may send any bytes, and Linux' does."""
    try:
        fs.create("bad\udcff")
    except Refused as error:
        assert error.code in (errno.EINVAL, errno.EILSEQ)  # noqa: PT017
    other = rig.client()
    rig.edge()
    other.write("good", b"1")
    other.write("better", b"2")
    rig.edge()
    assert (other.read("good"), other.read("better")) == (b"1", b"2")


def test_a_directory_read_with_too_little_room_is_refused_not_ended(fs):
    """An empty reply says that the directory has ended."""
    fs.mkdir("long" * 50)
    fid = fs.walk("")
    fs.call("Tlopen", fid, 0)
    assert refused(fs.call, "Treaddir", fid, 0, 10) == errno.EINVAL


@pytest.mark.parametrize("dialect", ["9P2000", "9P2000.u"])
def test_a_directory_is_read_from_where_the_last_read_ended(make_rig, dialect):
    fs = make_rig().client(dialect)
    fid = fs.open("")
    first = fs.pread(fid, 0, 100)
    for offset in (1, len(first) - 1, len(first) + 1, 1 << 40):
        with pytest.raises(Refused) as caught:
            fs.pread(fid, offset)
        assert caught.value.code == (errno.EINVAL if dialect == "9P2000.u" else 0)
    pieces = [first]
    while pieces[-1]:
        pieces.append(fs.pread(fid, sum(map(len, pieces)), 100))
    assert b"".join(pieces) == fs.pread(fid, 0)


@pytest.mark.parametrize("dialect", ["9P2000", "9P2000.u"])
def test_nothing_is_removed_by_a_close_and_who_asks_for_that_is_refused(make_rig, dialect):
    rig = make_rig()
    fs, reader = rig.client(dialect), rig.client()
    reader.write("f", b"precious")
    rig.edge()
    orclose = 0x40
    more = ("",) if dialect == "9P2000.u" else ()
    for name, values in (("Topen", (fs.walk("f"), orclose)), ("Tcreate", (fs.walk(""), "g", 0o644, orclose, *more))):
        with pytest.raises(Refused) as caught:
            fs.call(name, *values)
        assert caught.value.code == (errno.EOPNOTSUPP if dialect == "9P2000.u" else 0)
    rig.edge()
    assert (reader.read("f"), "g" in reader.ls()) == (b"precious", False)


def test_a_create_that_finds_the_file_truncates_it_if_it_says_so(rig, fs):
    fs.write("f", b"a long content")
    rig.edge()
    kept = fs.create("f", O_WRONLY)
    fs.pwrite(kept, b"LONG", 2)
    fs.clunk(kept)
    rig.edge()
    assert fs.read("f") == b"a LONG content"
    cut = fs.create("f", O_WRONLY | O_TRUNC)
    fs.pwrite(cut, b"short", 2)
    rig.edge()
    assert fs.read("f") == b"a LONG content", "until its close"
    fs.clunk(cut)
    rig.edge()
    assert fs.read("f") == b"\0\0short"


def test_a_directory_that_changes_while_it_is_read_repeats_and_loses_no_name(fs):
    for k in range(20):
        fs.mkdir(f"d{k}")
    fid = fs.walk("")
    fs.call("Tlopen", fid, 0)
    names, offset = [], 0
    while data := fs.call("Treaddir", fid, offset, 60)[0]:
        at = 0
        while at < len(data):
            end = at + 24 + int.from_bytes(data[at + 22 : at + 24], "little")
            offset = int.from_bytes(data[at + 13 : at + 21], "little")
            names.append(data[at + 24 : end].decode())
            at = end
        if names[-1].startswith("d") and names[-1] in fs.ls():
            fs.rm(names[-1], REMOVEDIR)
    assert {f"d{k}" for k in range(20)} <= set(names)
    assert len(names) == len(set(names))


# -- 11: cartfs ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dialect", DIALECTS)
def test_only_the_owner_writes_a_status(seated, dialect):
    seated.client(token="token-of-follow")
    reader = seated.client("9P2000.u")
    text = "Permission denied"
    for token in ("", "token-of-look", "token-of-operator"):
        other = seated.client(dialect, token)
        for flags in (O_WRONLY, O_RDWR, O_WRONLY | O_TRUNC, O_WRONLY | O_APPEND):
            with pytest.raises(Refused) as caught:
                other.open("follow/status", flags)
            assert caught.value.code == (0 if dialect == "9P2000" else errno.EACCES)
            assert caught.value.text in ("", text)
    for uid in (0, 1000):  # root's mount too
        reader.attach(900 + uid, uname="root", n_uname=uid)
        fid = reader.walk("follow/status", at=900 + uid)
        assert refused(reader.call, "Topen", fid, 1) == errno.EACCES


def test_a_truncation_by_name_asks_for_the_owner_too(seated):
    seated.client(token="token-of-follow").write("follow/status", b'{"a": 1}')
    seated.edge()
    other = seated.client()
    assert refused(other.truncate, other.walk("follow/status"), 0) == errno.EACCES
    seated.edge()
    assert other.json("follow/status") == {"a": 1}


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize("where", ["uname", "aname"])
def test_a_token_makes_its_bearer_the_writer(seated, dialect, where):
    script = seated.client(dialect)
    script.attach(900, **{where: "token-of-follow"})
    fid = script.walk("follow/status", at=900)
    script.call(*(("Tlopen", fid, O_WRONLY) if script.linux else ("Topen", fid, 1)))
    script.pwrite(fid, b'{"a": 1}')
    script.clunk(fid)
    seated.edge()
    assert seated.client().json("follow/status") == {"a": 1}


def test_a_wrong_aname_is_refused_and_a_wrong_uname_is_nobody(seated):
    fs = seated.client()
    for wrong in ("nonsense", "token-of-follo", "token-of-follow ", "TOKEN-OF-FOLLOW", "follow"):
        assert refused(fs.attach, 901, aname=wrong) == errno.EACCES
    seated.client(token="token-of-look")
    fs.attach(902, uname="nonsense")
    fid = fs.walk("look/status", at=902)
    assert refused(fs.call, "Tlopen", fid, O_WRONLY) == errno.EACCES


def test_an_attach_that_fails_takes_no_seat(seated):
    fs = seated.client()
    assert refused(fs.attach, ROOT, aname="token-of-follow") == errno.EBADF
    assert not any(c.name == "follow" and c.alive for c in seated.store.components())


def test_a_config_is_written_by_its_component_and_the_operator_and_shows_at_the_next_edge(seated):
    script, operator = seated.client(token="token-of-follow"), seated.client(token="token-of-operator")
    seated.edge()
    assert script.json("follow/config") == {"inputs": {}}
    for k, writer in enumerate((script, operator)):
        before, wiring = script.json("follow/config"), {"inputs": {"pose": f"localise{k}#/x_m"}}
        writer.write("follow/config", json.dumps(wiring).encode(), sync=True)
        assert script.json("follow/config") == before
        seated.edge()
        assert script.json("follow/config") == seated.client().json("follow/config") == wiring
    for token in ("", "token-of-look"):
        assert refused(seated.client(token=token).open, "follow/config", O_WRONLY) == errno.EACCES


def test_a_config_written_very_often_in_a_cycle_shows_its_last_value(seated):
    script = seated.client(token="token-of-follow")
    seated.edge()
    for k in range(40):
        script.write("follow/config", b'{"inputs": {}, "n": %d}' % k, sync=True)
    seated.edge(2)
    assert script.json("follow/config")["n"] == 39


def test_an_invalid_config_is_refused_and_the_last_good_one_stays(seated):
    seated.client(token="token-of-follow")
    operator = seated.client(token="token-of-operator")
    seated.edge()
    for bad in (b"{", b"[]", b"\xff\xfe", b'{"a": Infinity}'):
        assert refused(operator.write, "follow/config", bad, sync=True) == errno.EINVAL
        seated.edge()
        assert operator.json("follow/config") == {"inputs": {}}


def test_a_native_components_config_is_rewired_through_its_file(seated):
    component = seated.store.join("native")
    config = component.insert("config", json_schema(500), flags=Flag.PUBLIC_WRITE)
    config.write({"period": 1}, seated.store.now_ns)
    seated.edge()
    operator = seated.client(token="token-of-operator")
    operator.write("native/config", b'{"period": 2}', sync=True)
    seated.edge()
    assert seated.store.snapshot().get(seated.store.find("native/config")).value == {"period": 2}


# -- a native component's status -----------------------------------------------------------------------------------


def test_a_native_status_is_json_of_a_constant_size_equal_to_what_the_objects_show(rig, fs):
    component = rig.store.join("localise")
    pose, aim = component.insert("pose", Pose), component.insert("aim", Pose)
    sizes = set()
    values = [0.0, -1.5, 1e300, 5e-324, -1.7976931348623157e308, 0.1, math.pi * 1e-7]
    rig.edge()
    for k, value in enumerate(values):
        pose.write(Pose(x_m=value, y_m=-value), rig.store.now_ns)
        if k % 2:
            aim.write(Pose(x_m=value), rig.store.now_ns)
        sizes.add(fs.look("localise/status")["size"])
        rig.edge()
        content = fs.read("localise/status")
        sizes.add(len(content))
        said, cut = json.loads(content), rig.store.snapshot()
        assert said["pose"] == {"x_m": cut.get(pose).value.x_m, "y_m": cut.get(pose).value.y_m}
        assert said["aim"] == (None if k == 0 else {"x_m": cut.get(aim).value.x_m, "y_m": 0.0})
        assert content.endswith(b"\n")
    assert len(sizes) == 1


def test_what_is_not_finite_is_null_in_a_status(rig, fs):
    pose = rig.store.join("localise").insert("pose", Pose)
    rig.edge()
    size = len(fs.read("localise/status"))
    for value in (math.nan, math.inf, -math.inf):
        pose.write(Pose(x_m=value, y_m=2.0), rig.store.now_ns)
        rig.edge()
        content = fs.read("localise/status")
        assert json.loads(content) == {"pose": {"x_m": None, "y_m": 2.0}}
        assert len(content) == size


def test_a_native_status_is_written_by_nobody_through_files(make_rig):
    tokens = Tokens()
    tokens.give("localise", "token")
    rig = make_rig(shared=True, tokens=tokens)
    rig.store.join("localise").insert("pose", Pose)
    assert refused(rig.client().open, "localise/status", O_WRONLY) == errno.EACCES
    with pytest.raises((Refused, FsError)) as caught:
        rig.client(token="token").write("localise/status", b"{}", sync=True)
    assert caught.value.code == errno.EACCES


def test_an_image_is_a_ppm_of_constant_size_with_red_first(rig, fs):
    camera = rig.store.join("camera")
    frames = camera.insert("front", Frame)
    rig.edge()
    assert [name for name in fs.ls("camera") if name.endswith(".ppm")] == ["front.ppm"]
    size = fs.look("camera/front.ppm")["size"]
    bgr = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    frames.write(Frame(pixels=bgr), rig.store.now_ns)
    rig.edge()
    data = fs.read("camera/front.ppm")
    assert len(data) == size == fs.look("camera/front.ppm")["size"]
    magic, width, height, depth = data.split(maxsplit=4)[:4]
    assert (magic, int(width), int(height), int(depth)) == (b"P6", 3, 2, 255)
    assert data[-18:] == bgr[:, :, ::-1].tobytes()
    assert "front" not in (fs.json("camera/status") or {})


# -- history -------------------------------------------------------------------------------------------------------


def test_the_past_is_read_by_its_cycle_with_free_files_by_their_former_names(rig, fs):
    pose = rig.store.join("localise").insert("pose", Pose)
    fs.mkdir("d")
    fs.write("d/f", b"first")
    pose.write(Pose(x_m=1.0), rig.store.now_ns)
    rig.edge(2)
    then = rig.store.cycle
    pose.write(Pose(x_m=2.0), rig.store.now_ns)
    fs.mv("d/f", "moved")
    fs.write("moved", b"second")
    rig.edge(2)
    fs.rm("moved")
    rig.edge(2)
    assert fs.read(f"at/{then}/d/f") == b"first"
    assert fs.ls(f"at/{then}/d") == ["f"]
    assert fs.json(f"at/{then}/localise/status")["pose"]["x_m"] == 1.0
    assert fs.json(f"at/{then}/clock")["cycle"] == then
    later = then + 2 * EVERY
    assert fs.read(f"at/{later}/moved") == b"second"
    assert refused(fs.read, f"at/{later}/d/f") == errno.ENOENT
    assert fs.json(f"at/{later}/localise/status")["pose"]["x_m"] == 2.0
    assert refused(fs.read, f"at/{rig.store.cycle + 1}/clock") == errno.ENOENT


def test_the_past_knows_all_names_that_there_were_at_its_edge(rig, fs):
    rig.edge()
    rig.tick(EVERY - 1)
    for name in "abc":
        fs.write(name, name.encode())
    rig.tick()
    at = rig.store.cycle
    rig.edge()
    assert set("abc") <= set(fs.ls(f"at/{at}"))
    assert [fs.read(f"at/{at}/{name}") for name in "abc"] == [b"a", b"b", b"c"]


def test_the_past_is_read_only(rig, fs):
    fs.mkdir("d")
    fs.write("d/f", b"first")
    rig.edge(2)
    at = f"at/{rig.store.cycle}"
    read_only = (errno.EROFS, errno.EACCES)
    assert refused(fs.open, f"{at}/d/f", O_WRONLY) in read_only
    assert refused(fs.create, f"{at}/d/g") in read_only
    assert refused(fs.create, f"{at}/g") in read_only
    assert refused(fs.create, "at/g") in read_only
    assert refused(fs.mkdir, f"{at}/d/g") in read_only
    assert refused(fs.rm, f"{at}/d/f") in read_only
    assert refused(fs.mv, f"{at}/d/f", "g") in read_only
    assert refused(fs.mv, "d/f", f"{at}/d/g") in read_only
    fid = fs.walk(f"{at}/d/f")
    assert refused(fs.truncate, fid, 0) in read_only
    assert refused(fs.call, "Tsetattr", fid, 1, 0o600, 0, 0, 0, 0, 0, 0, 0) in read_only
    assert refused(fs.call, "Tremove", fid) in read_only
    assert fs.look(f"{at}/d/f")["mode"] & 0o222 == 0
    assert fs.read(f"{at}/d/f") == b"first"


def test_what_is_above_a_directory_of_the_past_is_the_past_root(rig, fs):
    rig.store.join("localise")
    fs.mkdir("d")
    rig.edge(2)
    (qids,) = fs.call("Twalk", ROOT, fs.new(), ["at", str(rig.store.cycle), "d", "..", "clock"])
    assert len(qids) == 5


def test_a_removed_file_whose_history_is_over_takes_no_other_file_of_the_past_along(rig, fs):
    fs.write("large", b"x" * 40_000)
    fs.write("small", b"s")
    rig.edge(2)
    then = rig.store.cycle
    fs.rm("large")
    rig.edge(3)
    for k in range(4):
        fs.write(f"other{k}", b"y" * 40_000)
        rig.edge()
        assert fs.read(f"at/{then}/small") == b"s"
        assert fs.ls("at")


# -- successors ----------------------------------------------------------------------------------------------------


def test_a_second_server_goes_on_with_the_free_files_of_the_first(rig, fs):
    fs.mkdir("d")
    fs.write("d/f", b"content" * 1000)
    fs.write("g", b"before")
    rig.edge()
    fs.write("g", b"after")
    rig.edge()
    numbers = {path: fs.look(path)["qid"].path for path in ("d", "d/f", "g")}
    rig.again()
    fs = rig.client()
    assert fs.ls() == ["at", "clock", "d", "g", "server"]
    assert (fs.read("d/f"), fs.read("g")) == (b"content" * 1000, b"after")
    assert {path: fs.look(path)["qid"].path for path in numbers} == numbers
    fs.write("new", b"new")
    fs.append("g", b"wards")
    assert fs.look("new")["qid"].path not in numbers.values()
    rig.edge()
    assert (fs.read("new"), fs.read("g")) == (b"new", b"afterwards")


def test_what_a_server_took_before_it_ended_is_not_lost_to_its_successor(rig, fs):
    """A finished revision and a new name stand at the edge, whoever serves by then."""
    fs.write("old", b"old")
    rig.edge()
    fs.write("old", b"newer")
    fs.write("f", b"content")
    fs.mkdir("d")
    rig.again()
    rig.edge()
    fs = rig.client()
    assert {"f", "d", "old"} <= set(fs.ls())
    assert (fs.read("f"), fs.read("old")) == (b"content", b"newer")


def nearly_full(make_rig):
    """A store whose memory is taken by what was removed: only an insert finds out that its history is over."""
    rig = make_rig(size=1 << 20)
    fs = rig.client(msize=8192)
    fs.write("kept", b"small")
    fs.write("other", b"precious")
    rig.edge(2)
    for _ in range(3):
        fs.write("removed", b"x" * 30_000)
        fs.rm("removed")
        rig.edge()
    for k in range(40):
        if rig.store.memory[1] < 7000:
            break
        fs.write(f"removed{k}", b"x")
        fs.rm(f"removed{k}")
    rig.edge(60)
    return rig, fs


def test_a_file_that_grows_in_a_full_store_is_not_lost_to_the_successor(make_rig):
    rig, fs = nearly_full(make_rig)
    grown = b"y" * 400
    assert not rig.service.tree.names.contents.fits(len(grown))
    fs.write("kept", grown)
    rig.edge(3)
    assert fs.read("kept") == fs.read(f"at/{rig.store.cycle}/kept") == grown
    rig.again()
    fs = rig.client()
    assert (fs.read("kept"), fs.read("other")) == (grown, b"precious")


def test_room_for_a_revision_that_never_came_is_given_back(make_rig):
    rig, fs = nearly_full(make_rig)
    names = rig.service.tree.names
    numbers, used = list(rig.service.tree.root.child("kept", 0).data.numbers), names.contents._budget.used
    other = rig.client(msize=8192)
    fid = other.open("kept", O_WRONLY)
    assert not names.contents.fits(400)
    other.call("Twrite", fid, 0, b"y" * 400)
    assert names.contents._budget.used > used
    other.hang_up()
    rig.edge(2)
    assert (rig.service.tree.root.child("kept", 0).data.numbers, names.contents._budget.used) == (numbers, used)
    assert fs.read("kept") == b"small"


def test_one_damaged_file_takes_no_other_along_to_the_successor(rig, fs):
    for name in ("whole", "damaged"):
        fs.write(name, name.encode())
    rig.edge()
    node = rig.service.tree.root.child("damaged", 0)
    node.data.numbers.append(999)  # an object that is not there
    rig.service.tree.names.changed(node)
    rig.edge()
    rig.again()
    fs = rig.client()
    assert fs.read("whole") == b"whole"
    fs.write("damaged", b"mended")
    rig.edge(3)
    assert fs.read("damaged") == b"mended"


def test_a_successor_does_not_bring_removed_files_back(rig, fs):
    fs.write("f", b"content")
    rig.edge()
    fs.rm("f")
    rig.again()
    fs = rig.client()
    rig.edge()
    assert "f" not in fs.ls()


def test_the_server_says_how_it_does_however_many_scripts_there_are(make_rig):
    seats = [SeatSpec(component=f"component-with-a-name-{k:02}") for k in range(60)]
    fs = make_rig(size=16 << 20, seats=seats).client()
    assert len(fs.json("server")["missed"]) == 60


def test_no_answer_needs_another_thread(rig, fs):
    assert fs.read("clock")
    assert [t.name for t in threading.enumerate() if t.name == "edges"] == []


# -- what a review found ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["flush", "hang up"])
def test_who_gives_up_waiting_is_not_waited_for_for_ever(seated, how):
    rig, fs, other = seated, seated.client(token="token-of-look"), seated.client(token="token-of-look")
    tag = fs.stat("look/clock")
    rig.edge()
    fs.told(tag)
    tag = other.stat("look/clock")
    rig.stand(60.0)
    assert alive(rig, "look"), "who waits is waited for"
    if how == "flush":
        other.call("Tflush", tag)
    else:
        other.hang_up()
    rig.stand(60.0)
    assert not alive(rig, "look")


def alive(rig, component):
    return next(info.alive for info in rig.store.components() if info.name == component)


def test_who_comes_back_by_a_write_is_not_waited_for_for_ever_either(unique):
    with Store.create(unique(), clock="barrier") as store:
        tokens = Tokens({"follow": "token"})
        rig = Rig(store, seats=[SeatSpec(component="follow", every=1, latency_cycles=0)], tokens=tokens)
        script = rig.client(token="token")
        script.stat("follow/clock")
        rig.service.tree.seats["follow"].wake(0)  # an edge; it does not come back
        for _ in range(2):
            rig.service.look(time.monotonic() + 100.0)
            assert not alive(rig, "follow")
            script.write("follow/status", b"{}")
            assert alive(rig, "follow")
        rig.service.look(time.monotonic() + 100.0)
        assert not alive(rig, "follow")
        rig.service.close()


def test_what_was_held_back_is_not_said_by_a_successor(seated):
    rig, fs = seated, seated.client(token="token-of-look")
    fid = fs.open("look/status", O_WRONLY)
    for n in range(100):  # more than the ring holds
        fs.pwrite(fid, b'{"n": %d}' % n)
    fs.hang_up()
    rig.edge(2)
    before = rig.store.find("look/status").head
    again = rig.client(token="token-of-look")
    rig.edge(3)
    assert rig.store.find("look/status").head == before
    again.hang_up()


def test_a_file_moved_onto_another_shows_the_old_content_until_the_edge(rig, fs):
    fs.write("f", b"old")
    rig.edge()
    fs.write("g", b"new")
    fs.mv("g", "f")
    assert fs.read("f") == b"old"
    rig.edge()
    assert fs.read("f") == b"new"
    rig.edge()
    fs.write("empty", b"")
    fs.mv("empty", "f")
    rig.edge()
    assert fs.read("f") == b""


def test_free_files_are_in_the_recording(make_rig, tmp_path):
    rig = make_rig(shared=True)
    fs, sizes = rig.client(), (0, 1, 255, 256, 257, 300, 100_000)
    with Recorder(tmp_path / "run.mcap", [rig.store], {}) as recorder:
        for n in sizes:
            fs.write(f"f{n}", bytes(n))
        for _ in range(20):
            rig.tick()
            recorder.record()
    found = Recording(tmp_path / "run.mcap")
    assert found.last_cycle == EVERY, "they showed at the edge"


def test_a_script_that_follows_a_module_is_not_taken_for_it(seated):
    rig = seated
    was = rig.store.join("follow")
    was.insert("pose", Pose).write(Pose())
    rig.edge()
    was.leave()
    rig.client(token="token-of-follow")
    rig.edge()
    assert [obj.name for obj in rig.store.objects("follow/*")] == ["follow/health", "follow/config", "follow/status"]
