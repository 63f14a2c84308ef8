"""The codec against itself, both ways, and against bytes laid out by hand from the manual."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtdb.syncfs.codec import BY_NAME, LINUX, MESSAGES, PLAIN, TYPES, UNIX, Malformed, Qid, dialect_for

DIALECTS = {"9P2000": 1, "9P2000.u": 2, "9P2000.L": 3}  # with the column of their layouts
texts = st.binary(max_size=300).map(lambda data: data.decode("utf-8", "surrogateescape"))
qids = st.builds(Qid, st.integers(0, 255), st.integers(0, 2**32 - 1), st.integers(0, 2**64 - 1))
KINDS = {
    **{str(n): st.integers(0, 256**n - 1) for n in (1, 2, 4, 8)},
    "s": texts,
    "q": qids,
    "d": st.binary(max_size=300),
    "r": st.binary(max_size=300),
    "S": st.lists(texts, max_size=16),
    "Q": st.lists(qids, max_size=16),
}
ALL = [(name, number) for name, column in DIALECTS.items() for number, m in MESSAGES.items() if m[column] is not None]


@st.composite
def messages(draw):
    name, number = draw(st.sampled_from(ALL))
    values = tuple(draw(KINDS[kind]) for kind in MESSAGES[number][DIALECTS[name]])
    return BY_NAME[name], number, draw(st.integers(0, 0xFFFF)), values


@given(messages())
def test_what_is_encoded_decodes_to_the_same(message):
    dialect, number, tag, values = message
    data = dialect.encode[number](tag, *values)
    assert struct.unpack_from("<IBH", data) == (len(data), number, tag)
    assert dialect.decoded(data) == (number, tag, values)


@given(messages(), st.data())
def test_a_shorter_or_longer_body_is_malformed(message, data):
    dialect, number, tag, values = message
    whole = dialect.encode[number](tag, *values)
    longer = whole + data.draw(st.binary(min_size=1, max_size=40))
    with pytest.raises(Malformed):
        dialect.decoded(longer)
    if len(whole) > 7:
        with pytest.raises(Malformed):
            dialect.decoded(whole[: data.draw(st.integers(7, len(whole) - 1))])


@given(st.sampled_from(list(BY_NAME.values())), st.integers(0, 255), st.binary(max_size=200))
def test_any_bytes_decode_or_are_malformed(dialect, number, body):
    data = struct.pack("<IBH", 7 + len(body), number, 1) + body
    try:
        _, _, values = dialect.decoded(data)
    except Malformed:
        assert "malformed" in dialect.spelled(data)
    else:
        assert dialect.encode[number](1, *values) == data
        assert MESSAGES[number].name in dialect.spelled(data)


@pytest.mark.parametrize(("name", "number"), ALL)
def test_a_reply_is_numbered_one_more_than_its_request(name, number):
    said = MESSAGES[number].name
    if said.startswith("T"):
        assert MESSAGES[number + 1].name == "R" + said[1:]
        assert number + 1 in BY_NAME[name].encode
        assert number % 2 == 0


def test_each_dialect_has_its_own_messages():
    old, new = {"Topen", "Tcreate", "Tstat", "Twstat", "Rerror"}, {"Tlopen", "Tgetattr", "Treaddir", "Rlerror"}
    for name in old:
        assert TYPES[name] not in LINUX.decode
        assert TYPES[name] in PLAIN.decode
        assert TYPES[name] in UNIX.decode
    for name in new:
        assert TYPES[name] in LINUX.decode
        assert TYPES[name] not in PLAIN.decode
        assert TYPES[name] not in UNIX.decode


def by_hand(number, tag, body):
    return struct.pack("<IBH", 7 + len(body), number, tag) + body


def s(text):
    return struct.pack("<H", len(text)) + text


QID = struct.pack("<BIQ", 0x80, 7, 9)


@pytest.mark.parametrize(
    ("dialect", "name", "values", "body"),
    [
        (PLAIN, "Tversion", (8192, "9P2000"), struct.pack("<I", 8192) + s(b"9P2000")),
        (PLAIN, "Tattach", (1, 0xFFFFFFFF, "glenda", ""), struct.pack("<II", 1, 0xFFFFFFFF) + s(b"glenda") + s(b"")),
        (UNIX, "Tattach", (1, 2, "a", "b", 3), struct.pack("<II", 1, 2) + s(b"a") + s(b"b") + struct.pack("<I", 3)),
        (LINUX, "Twalk", (1, 2, ["a", "bc"]), struct.pack("<IIH", 1, 2, 2) + s(b"a") + s(b"bc")),
        (LINUX, "Rwalk", ([Qid(0x80, 7, 9)] * 2,), struct.pack("<H", 2) + QID * 2),
        (LINUX, "Tread", (1, 2, 3), struct.pack("<IQI", 1, 2, 3)),
        (LINUX, "Rread", (b"xyz",), struct.pack("<I", 3) + b"xyz"),
        (LINUX, "Twrite", (1, 2, b"xyz"), struct.pack("<IQI", 1, 2, 3) + b"xyz"),
        (PLAIN, "Rerror", ("no",), s(b"no")),
        (UNIX, "Rerror", ("no", 2), s(b"no") + struct.pack("<I", 2)),
        (LINUX, "Rlerror", (2,), struct.pack("<I", 2)),
        (
            UNIX,
            "Tcreate",
            (1, "f", 0o644, 1, ""),
            struct.pack("<I", 1) + s(b"f") + struct.pack("<IB", 0o644, 1) + s(b""),
        ),
        (LINUX, "Tlcreate", (1, "f", 2, 3, 4), struct.pack("<I", 1) + s(b"f") + struct.pack("<III", 2, 3, 4)),
        (PLAIN, "Twstat", (1, b"xx"), struct.pack("<IH", 1, 2) + b"xx"),
        (LINUX, "Trenameat", (1, "a", 2, "b"), struct.pack("<I", 1) + s(b"a") + struct.pack("<I", 2) + s(b"b")),
        (LINUX, "Tlock", (1, 2, 3, 4, 5, 6, "h"), struct.pack("<IBIQQI", 1, 2, 3, 4, 5, 6) + s(b"h")),
        (LINUX, "Rgetlock", (2, 4, 5, 6, "h"), struct.pack("<BQQI", 2, 4, 5, 6) + s(b"h")),
        (LINUX, "Rstatfs", tuple(range(9)), struct.pack("<IIQQQQQQI", *range(9))),
        (LINUX, "Tsetattr", tuple(range(10)), struct.pack("<IIIIIQQQQQ", *range(10))),
    ],
)
def test_messages_lie_as_the_manual_draws_them(dialect, name, values, body):
    data = by_hand(TYPES[name], 5, body)
    assert dialect.encode[TYPES[name]](5, *values) == data
    assert dialect.decoded(data) == (TYPES[name], 5, values)


def test_the_reply_to_a_getattr_has_160_bytes():
    assert len(LINUX.encode[TYPES["Rgetattr"]](1, 0, Qid(0, 0, 0), *[0] * 18)) == 160


def test_a_walk_has_at_most_16_names():
    body = struct.pack("<IIH", 1, 2, 17) + s(b"x") * 17
    with pytest.raises(Malformed):
        LINUX.decoded(by_hand(TYPES["Twalk"], 1, body))


def test_an_unknown_extension_gets_the_base_and_an_unknown_version_none():
    assert [dialect_for(v) for v in ("9P2000", "9P2000.u", "9P2000.L")] == [PLAIN, UNIX, LINUX]
    assert dialect_for("9P2000.x") is PLAIN
    assert [dialect_for(v) for v in ("", "9P", "9P1999", "9p2000", "9P20000", "http/1.1")] == [None] * 6
