"""The session against whatever bytes come: it raises nothing, answers each request once, and harms no other session."""

import contextlib
import struct
from itertools import chain
from typing import Annotated

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rtdb import Record, Store
from rtdb.records import f8
from rtdb.syncfs import OPERATOR, Limits, SeatSpec, Tokens
from rtdb.syncfs.codec import BY_NAME, LINUX, MESSAGES, NOFID, NOTAG, TYPES, Malformed

from .conftest import ROOT, Refused, Rig

FLUSH, VERSION = TYPES["Tflush"], TYPES["Tversion"]
COLUMN = {"9P2000": 1, "9P2000.u": 2, "9P2000.L": 3}
pytestmark = pytest.mark.proof  # half a minute
fuzzed = settings(deadline=None, derandomize=True, suppress_health_check=list(HealthCheck), max_examples=150)


class Pose(Record):
    x_m: Annotated[float, f8("m", "east")] = 0.0


class Raw:
    """A client that checks of each reply that it belongs to a request, and is the only one."""

    def __init__(self, rig, dialect="9P2000.L"):
        self.dialect, self.open, self.answered = BY_NAME[dialect], {}, 0
        self.flushes = {}  # flushed tags, by the tags of the flushes
        self.session = rig.service.begin(self._taken)
        self.feed(LINUX.encode[VERSION](NOTAG, 8192, dialect))
        token = ("", "follow-token")
        values = (ROOT, NOFID, *token) if dialect == "9P2000" else (ROOT, NOFID, *token, 0)
        self.send("Tattach", *values)
        assert not self.open

    def _taken(self, data):
        size, number, tag = struct.unpack_from("<IBH", data)
        assert size == len(data)
        assert size <= 8192
        asked = self.open.pop(tag, None)
        assert asked is not None, f"{MESSAGES[number].name} answers nothing that was asked under tag {tag}"
        if asked != VERSION:
            self.dialect.decoded(data)
        assert number in (asked + 1, TYPES["Rlerror"], TYPES["Rerror"])
        if asked == FLUSH:
            self.open.pop(self.flushes.pop(tag), None)
        self.answered += 1

    def feed(self, data):
        """Take bytes that begin with a whole message, and note what it asks."""
        _, number, tag = struct.unpack_from("<IBH", data)
        if number == VERSION:
            self.open.clear()
            self.flushes = {}
        if tag not in self.open:
            self.open[tag] = number
        if number == FLUSH:
            self.flushes[tag] = struct.unpack_from("<H", data, 7)[0] if len(data) >= 9 else -1
        self.session.feed(data)

    def send(self, name, *values, tag=1):
        self.feed(self.dialect.encode[TYPES[name]](tag, *values))


@pytest.fixture(scope="module")
def make():
    """Rigs for examples: each with a native component, a script's seat, and a few files."""

    @contextlib.contextmanager
    def one(**limits):
        with Store.create(size=4 << 20) as store:
            tokens = Tokens()
            tokens.give("follow", "follow-token")
            tokens.give(OPERATOR, "operator-token")
            rig = Rig(store, tokens=tokens, seats=[SeatSpec(component="follow")], limits=Limits(**limits))
            try:
                pose = store.join("localise").insert("pose", Pose)
                pose.write(Pose(), store.now_ns)
                honest = rig.client()
                honest.mkdir("d")
                honest.write("d/f", b"content")
                rig.edge()
                yield rig, honest
                still_serves(rig, honest)
            finally:
                rig.service.close()

    return one


def still_serves(rig, honest):
    """Who behaves notices nothing."""
    tag = honest.stat("clock")
    with contextlib.suppress(Refused):
        honest.mkdir("witness")
    honest.write("witness/f", b"%d" % rig.store.cycle)
    expected = b"%d" % rig.store.cycle
    rig.edge()
    assert honest.told(tag)["data_version"] == rig.store.cycle // 10
    assert honest.read("witness/f") == expected
    assert honest.json("localise/status") == {"pose": {"x_m": 0.0}}
    assert honest.json("server")["waiting"] == len(rig.service.waiting)


numbers = {
    "1": st.sampled_from([0, 1, 2, 3, 0x10, 0x40, 0x80, 0xFF]),
    "2": st.integers(0, 6) | st.sampled_from([NOTAG, 0x7FFF]),
    "4": st.integers(0, 8)
    | st.sampled_from([0x41, 0x68, 0x200, 0o200000, 0o1000, 0o100, 0x80000000, 2**31, 2**32 - 1]),
    "8": st.integers(0, 8) | st.sampled_from([0x17FF, 0x3FFF, 4096, 2**31, 2**32, 2**63 - 1, 2**63, 2**64 - 1]),
}
words = st.sampled_from(
    ["f", "d", "g", "clock", "server", "at", "10", "0", "localise", "follow", "status", "config", "..", "health"]
)
odd = st.sampled_from(
    [
        "",
        ".",
        "/",
        "a/b",
        "\0",
        "a\0b",
        "x" * 255,
        "x" * 256,
        "ä" * 128,
        "\udcff",
        "x" * 3000,
        "99999999999999999",
        "-1",
        "٣",
    ]
)
texts = st.one_of(words, words, words, odd, st.text(max_size=5))
kinds = {
    **numbers,
    "s": texts,
    "d": st.binary(max_size=60) | st.sampled_from([b"{}", b'{"a": 1}', b"{", b"x" * 5000]),
    "r": st.binary(max_size=90)
    | st.builds(lambda n: b"\x3a\0" + b"\xff" * 39 + n * 5 + b"\xff" * 12, st.just(b"\0\0")),
    "S": st.lists(texts, max_size=16),
    "q": st.just((0, 0, 0)),
    "Q": st.just([]),
}


@st.composite
def any_request(draw, dialect):
    """A well-formed request with any values."""
    column = COLUMN[dialect]
    asked = [n for n, m in MESSAGES.items() if m.name.startswith("T") and m[column] is not None and n != VERSION]
    number = draw(st.sampled_from(asked))
    return number, [draw(kinds[kind]) for kind in MESSAGES[number][column]]


fids = st.integers(1, 4)
paths = st.sampled_from(
    [[], ["d"], ["d", "f"], ["f"], ["clock"], ["server"], ["follow"], ["follow", "status"], ["follow", "config"],
     ["follow", "clock"], ["localise", "status"], ["localise", "clock"], ["at"], ["at", "10"], ["at", "0", "d", "f"],
     ["d", "..", "d"], ["at", "10", "clock"], ["follow", "health"], ["witness", "f"]]
)  # fmt: skip
small = st.integers(0, 10)
data = kinds["d"]
LIVELY = {
    "Twalk": (st.sampled_from([0, 0, 0, 0, 1, 2]), fids, paths),
    "Tread": (fids, small | kinds["8"], st.sampled_from([0, 1, 30, 4096, 2**32 - 1])),
    "Twrite": (fids, small | kinds["8"], data),
    "Tclunk": (fids,),
    "Tremove": (fids,),
    "Tflush": (st.integers(0, 60),),
}
OLD = {
    "Topen": (fids, st.sampled_from([0, 1, 2, 3, 0x10, 0x11, 0x12, 0x81])),
    "Tstat": (fids,),
    "Twstat": (fids, kinds["r"]),
}
OF = {
    "9P2000": {**LIVELY, **OLD, "Tcreate": (fids, texts, st.sampled_from([0o644, 0x80000000]), numbers["1"])},
    "9P2000.u": {**LIVELY, **OLD, "Tcreate": (fids, texts, st.sampled_from([0o644, 0x80000000]), numbers["1"], texts)},
    "9P2000.L": {
        **LIVELY,
        "Tlopen": (fids, st.sampled_from([0, 0, 1, 1, 2, 0o1001, 0o2001, 0o200000])),
        "Tlcreate": (fids, texts, st.sampled_from([0, 1, 2, 0o201, 0o2001]), st.just(0o644), st.just(0)),
        "Tgetattr": (fids, st.sampled_from([0x17FF, 0x3FFF])),
        "Tsetattr": (fids, st.integers(0, 0x1FF), *[small | numbers["4"]] * 3, small, *[small | numbers["8"]] * 4),
        "Treaddir": (fids, small, st.sampled_from([0, 30, 100, 4096])),
        "Tmkdir": (fids, texts, st.just(0o755), st.just(0)),
        "Tunlinkat": (st.integers(0, 4), words, st.sampled_from([0, 0x200])),
        "Trenameat": (st.integers(0, 4), words, st.integers(0, 4), texts),
        "Trename": (fids, st.integers(0, 4), texts),
        "Tfsync": (fids, st.just(0)),
        "Tstatfs": (fids,),
    },
}


def requests(dialect):
    """Requests on few fids, names and values, so that many of them meet; now and then one with any."""
    lively = st.one_of([st.tuples(st.just(TYPES[n]), st.tuples(*v).map(list)) for n, v in OF[dialect].items()])
    return st.integers(0, 9).flatmap(lambda k: lively if k else any_request(dialect))


@st.composite
def arrivals(draw, dialect):
    """A fid is taken somewhere else, and most times opened there: three requests."""
    fid, path, flags = draw(fids), draw(paths), draw(st.sampled_from([None, 0, 0, 1, 2, 1 | 0o1000, 1 | 0o2000]))
    script = [(TYPES["Tclunk"], [fid]), (TYPES["Twalk"], [ROOT, fid, path])]
    if flags is not None and dialect == "9P2000.L":
        script.append((TYPES["Tlopen"], [fid, flags]))
    elif flags is not None:
        script.append((TYPES["Topen"], [fid, flags & 3 | (0x10 if flags & 0o1000 else 0)]))
    return script


def scripts(dialect, *others, most=40):
    """Steps of one client after the other."""
    one = requests(dialect).map(lambda request: [request])
    rest = st.sampled_from(["edge", "tick", "stand", *others]).map(lambda step: [step])
    arrival = arrivals(dialect)
    step = st.integers(0, 7).flatmap(lambda k: arrival if k < 2 else rest if k == 2 else one)
    return st.lists(step, min_size=10, max_size=most).map(
        lambda steps: [*opening(dialect), *chain.from_iterable(steps)]
    )


def opening(dialect):
    """A clock, a free file and a status to read and write, and a directory to make files in."""
    places = ["clock"], ["d", "f"], ["follow", "status"], ["d"]
    walks = [(TYPES["Twalk"], [ROOT, fid, path]) for fid, path in enumerate(places, start=1)]
    return [*walks, *[(TYPES["Tlopen" if dialect == "9P2000.L" else "Topen"], [fid, 2]) for fid in (2, 3)]]


mutations = st.lists(st.tuples(st.integers(0, 80), st.integers(0, 255)), max_size=3)
steps = st.sampled_from(["edge", "tick", "stand"])


@pytest.mark.parametrize("dialect", list(COLUMN))
def test_each_well_formed_request_is_answered_once_at_once_or_at_an_edge(make, dialect, caplog):
    @fuzzed
    @given(scripts(dialect))
    def run(script):
        with make(file_bytes=1 << 16) as (rig, _):
            client, tag = Raw(rig, dialect), 0
            for step in script:
                if isinstance(step, str):
                    {"edge": rig.edge, "tick": rig.tick, "stand": lambda: rig.stand(2.0)}[step]()
                    continue
                number, values = step
                tag += 1
                message = client.dialect.encode[number](tag, *values)
                if len(message) <= 8192:
                    client.feed(message)
                    assert not client.session.over
                    assert tag not in client.open or number in (TYPES["Tgetattr"], TYPES.get("Tstat"))
            rig.edge()
            assert client.open == {}
            assert not [r for r in caplog.records if r.exc_info], "a handler raised what no handler should"

    run()


@pytest.mark.parametrize("dialect", list(COLUMN))
def test_mutated_messages_harm_nobody(make, dialect):
    @fuzzed
    @given(scripts(dialect, most=25), st.lists(mutations, min_size=80, max_size=80))
    def run(script, changes):
        with make(file_bytes=1 << 16) as (rig, _):
            client = Raw(rig, dialect)
            client.session._send = lambda data: None
            for tag, (step, changed) in enumerate(zip(script, changes, strict=False)):
                if isinstance(step, str):
                    rig.tick()
                    continue
                number, values = step
                message = bytearray(client.dialect.encode[number](tag, *values))
                for at, byte in changed:
                    message[at % len(message)] = byte
                client.session.feed(bytes(message))
            rig.edge()

    run()


@fuzzed
@given(st.lists(st.binary(max_size=200), max_size=20), st.booleans(), st.lists(steps, max_size=5))
def test_random_bytes_harm_nobody(make, pieces, begun, then):
    with make() as (rig, _):
        session = Raw(rig).session if begun else rig.service.begin(lambda data: None)
        session._send = lambda data: None
        for piece in pieces:
            session.feed(piece)
        for step in then:
            {"edge": rig.edge, "tick": rig.tick, "stand": lambda: rig.stand(2.0)}[step]()
        rig.service.end(session)


@fuzzed
@given(st.data())
def test_a_message_may_arrive_in_any_pieces(make, drawn):
    with make() as (rig, _):
        whole, replies = Raw(rig), []
        stream = b"".join(
            LINUX.encode[number](tag, *values)
            for tag, (number, values) in enumerate(drawn.draw(st.lists(requests("9P2000.L"), max_size=6)))
            if number not in (FLUSH, TYPES["Tgetattr"])
        )
        cuts = sorted(drawn.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
        whole.session._send = replies.append
        for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True):
            whole.session.feed(stream[a:b])
        n, at = 0, 0
        while at < len(stream):
            size = struct.unpack_from("<I", stream, at)[0]
            if size > 8192:
                break
            n, at = n + 1, at + size
        assert len(replies) == n


@fuzzed
@given(scripts("9P2000.L", "break"), st.lists(st.integers(0, 2), min_size=120, max_size=120))
def test_sessions_that_interleave_are_each_answered(make, script, turns):
    with make(file_bytes=1 << 16) as (rig, _):
        clients, tag = [Raw(rig) for _ in range(3)], 0
        for who, step in zip(turns, script, strict=False):
            if step == "break":
                rig.service.end(clients[0].session)
                clients[0] = Raw(rig)
            elif isinstance(step, str):
                {"edge": rig.edge, "tick": rig.tick, "stand": lambda: rig.stand(2.0)}[step]()
            else:
                number, values = step
                tag += 1
                message = LINUX.encode[number](tag, *values)
                if len(message) <= 8192:
                    clients[who].feed(message)
        rig.edge()
        assert [client.open for client in clients] == [{}, {}, {}]


@pytest.mark.parametrize("size", [0, 1, 4, 6, 8193, 1 << 20, (1 << 20) + 1, 2**31, 2**32 - 1])
def test_an_absurd_size_ends_the_connection_and_keeps_no_memory(make, size):
    with make() as (rig, _):
        client = Raw(rig)
        client.session.feed(struct.pack("<IBH", size, TYPES["Tclunk"], 1))
        assert client.session.over
        client.session.feed(b"x" * 1000)
        assert client.answered == 2


def test_nothing_but_a_version_is_answered_before_the_version(make):
    with make() as (rig, _):
        replies = []
        session = rig.service.begin(replies.append)
        session.feed(BY_NAME["9P2000"].encode[TYPES["Tattach"]](1, 0, NOFID, "", ""))
        assert [r[4] for r in replies] == [TYPES["Rerror"]]


@pytest.mark.parametrize(
    "names", [["x"] * 16, [".."] * 16, ["a/b"], ["/"], [""], ["."], ["a\0b"], ["x" * 256], ["ä" * 128], ["d", "", "f"]]
)
def test_a_walk_to_what_is_no_name_makes_no_fid(make, names):
    with make() as (_, honest):
        fid = honest.new()
        if names == [".."] * 16:
            (qids,) = honest.call("Twalk", ROOT, fid, names)
            assert {q.path for q in qids} == {honest.look("")["qid"].path}
            return
        try:
            (qids,) = honest.call("Twalk", ROOT, fid, names)
            assert len(qids) < len(names)
        except Refused as error:
            assert error.code in (2, 22, 36)  # noqa: PT017
        with pytest.raises(Refused):
            honest.call("Tclunk", fid)


def test_17_names_are_malformed_and_the_session_goes_on_or_ends(make):
    with make() as (rig, honest):
        body = struct.pack("<IIH", 0, 7, 17) + b"\1\0x" * 17
        client = Raw(rig)
        client.feed(struct.pack("<IBH", 7 + len(body), TYPES["Twalk"], 5) + body)
        assert client.session.over or client.answered == 3
        assert honest.ls("d") == ["f"]


def test_a_tag_in_use_is_never_answered_twice(make):
    with make() as (rig, _):
        client = Raw(rig)
        client.send("Twalk", ROOT, 1, ["clock"], tag=5)
        client.send("Tgetattr", 1, 0x3FFF, tag=6)
        client.send("Tgetattr", 1, 0x3FFF, tag=6)
        client.send("Tclunk", 1, tag=6)
        rig.edge(2)
        assert client.answered <= 4  # the checks are those of Raw


def test_a_flush_of_everything_is_answered_and_nothing_after_it(make):
    with make() as (rig, _):
        client = Raw(rig)
        client.send("Twalk", ROOT, 1, ["clock"], tag=5)
        for tag in range(100, 200):
            client.send("Tgetattr", 1, 0x3FFF, tag=tag)
        for tag in range(300):
            client.send("Tflush", tag, tag=1000 + tag)
        client.send("Tflush", 2000, tag=2000)  # itself
        assert client.open == {}
        n = client.answered
        rig.edge()
        assert client.answered == n


def test_a_version_in_mid_session_forgets_fids_stats_and_drafts(make):
    with make() as (rig, honest):
        client = Raw(rig)
        client.send("Twalk", ROOT, 1, ["d", "f"])
        client.send("Tlopen", 1, 1 | 0o1000)
        client.send("Twrite", 1, 0, b"half")
        client.send("Twalk", ROOT, 2, ["clock"])
        client.send("Tgetattr", 2, 0x3FFF, tag=9)
        client.feed(LINUX.encode[VERSION](NOTAG, 8192, "9P2000.L"))
        rig.edge()
        assert client.open == {}
        replies = []
        client.session._send = replies.append
        for fid in (0, 1, 2):
            client.session.feed(LINUX.encode[TYPES["Tclunk"]](fid, fid))
        assert [LINUX.decoded(r)[2] for r in replies] == [(9,)] * 3
        rig.edge()
        assert honest.read("d/f") == b"content"


@fuzzed
@given(
    st.integers(0, 2**32 - 1), st.text(max_size=12) | st.sampled_from(["9P2000.L", "9P2000.u", "9P2000", "9P2000.L2"])
)
def test_a_version_is_answered_with_no_more_than_was_offered(make, msize, version):
    with make() as (rig, _):
        replies = []
        session = rig.service.begin(replies.append)
        session.feed(LINUX.encode[VERSION](NOTAG, msize, version)[:8192])
        if not replies:
            return
        _, tag, (agreed, said) = LINUX.decoded(replies[0])
        assert tag == NOTAG
        assert agreed <= msize
        assert said in ("unknown", version, "9P2000")
        assert (said == "unknown") == (msize < 4096 or not (version == "9P2000" or version.startswith("9P2000.")))


@fuzzed
@given(st.sampled_from(list(COLUMN)), st.integers(0, 255), st.binary(max_size=100))
def test_a_message_of_any_type_gets_one_reply_of_the_dialect(make, dialect, number, body):
    with make() as (rig, _):
        client, replies = Raw(rig, dialect), []
        client.session._send = replies.append
        client.session.feed(struct.pack("<IBH", 7 + len(body), number, 77) + body)
        rig.edge()
        assert len(replies) == 1 or client.session.over
        for reply in replies:
            with contextlib.suppress(Malformed):
                BY_NAME["9P2000"].decoded(reply)
            assert reply[5:7] == b"\x4d\0"
