"""9P messages and their bytes: 9P2000, 9P2000.u and 9P2000.L (Plan 9 manual, section 5; diod's protocol.md).

size[4] type[1] tag[2] body          little-endian; size counts itself; a reply's type is its request's plus one

s    text: len[2], then UTF-8              q   qid: type[1] version[4] path[8]
1 2 4 8  integers of so many bytes         d   data: count[4], then bytes
S    texts: n[2], then n times s           Q   qids: n[2], then n times q
r    a record of its own length: n[2], then bytes
"""

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

HEADER = struct.Struct("<IBH")
NOTAG, NOFID, NO_UID = 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF
MAX_WALK = 16
READ_HEADER = 11  # bytes of a reply in front of its data
IO_HEADER = 24  # what a client leaves room for, whichever it is

DIR, FILE = 0x80, 0x00  # of a qid


class Malformed(ValueError):
    """Bytes that are no message of the dialect."""


class Qid(NamedTuple):
    """What a server knows a file by: path is unique for the file's life, version changes with its content."""

    type: int
    version: int
    path: int


class Message(NamedTuple):
    """How a message is laid out in each dialect; `plain`, `u`, `linux` are formats, None where there is none."""

    name: str
    plain: str | None
    u: str | None
    linux: str | None


def _same(name: str, layout: str) -> Message:
    return Message(name, layout, layout, layout)


def _linux(name: str, layout: str) -> Message:
    return Message(name, None, None, layout)


def _old(name: str, layout: str, u: str | None = None) -> Message:
    return Message(name, layout, layout if u is None else u, None)


MESSAGES: dict[int, Message] = {
    7: _linux("Rlerror", "4"),
    8: _linux("Tstatfs", "4"),
    9: _linux("Rstatfs", "448888884"),
    12: _linux("Tlopen", "44"),
    13: _linux("Rlopen", "q4"),
    14: _linux("Tlcreate", "4s444"),
    15: _linux("Rlcreate", "q4"),
    16: _linux("Tsymlink", "4ss4"),
    17: _linux("Rsymlink", "q"),
    18: _linux("Tmknod", "4s4444"),
    19: _linux("Rmknod", "q"),
    20: _linux("Trename", "44s"),
    21: _linux("Rrename", ""),
    22: _linux("Treadlink", "4"),
    23: _linux("Rreadlink", "s"),
    24: _linux("Tgetattr", "48"),
    25: _linux("Rgetattr", "8q444888888888888888"),
    26: _linux("Tsetattr", "4444488888"),
    27: _linux("Rsetattr", ""),
    30: _linux("Txattrwalk", "44s"),
    31: _linux("Rxattrwalk", "8"),
    32: _linux("Txattrcreate", "4s84"),
    33: _linux("Rxattrcreate", ""),
    40: _linux("Treaddir", "484"),
    41: _linux("Rreaddir", "d"),
    50: _linux("Tfsync", "44"),
    51: _linux("Rfsync", ""),
    52: _linux("Tlock", "414884s"),
    53: _linux("Rlock", "1"),
    54: _linux("Tgetlock", "41884s"),
    55: _linux("Rgetlock", "1884s"),
    70: _linux("Tlink", "44s"),
    71: _linux("Rlink", ""),
    72: _linux("Tmkdir", "4s44"),
    73: _linux("Rmkdir", "q"),
    74: _linux("Trenameat", "4s4s"),
    75: _linux("Rrenameat", ""),
    76: _linux("Tunlinkat", "4s4"),
    77: _linux("Runlinkat", ""),
    100: _same("Tversion", "4s"),
    101: _same("Rversion", "4s"),
    102: Message("Tauth", "4ss", "4ss4", "4ss4"),
    103: _same("Rauth", "q"),
    104: Message("Tattach", "44ss", "44ss4", "44ss4"),
    105: _same("Rattach", "q"),
    107: _old("Rerror", "s", "s4"),
    108: _same("Tflush", "2"),
    109: _same("Rflush", ""),
    110: _same("Twalk", "44S"),
    111: _same("Rwalk", "Q"),
    112: _old("Topen", "41"),
    113: _old("Ropen", "q4"),
    114: _old("Tcreate", "4s41", "4s41s"),
    115: _old("Rcreate", "q4"),
    116: _same("Tread", "484"),
    117: _same("Rread", "d"),
    118: _same("Twrite", "48d"),
    119: _same("Rwrite", "4"),
    120: _same("Tclunk", "4"),
    121: _same("Rclunk", ""),
    122: _same("Tremove", "4"),
    123: _same("Rremove", ""),
    124: _old("Tstat", "4"),
    125: _old("Rstat", "r"),
    126: _old("Twstat", "4r"),
    127: _old("Rwstat", ""),
}
TYPES = {message.name: number for number, message in MESSAGES.items()}
DIALECTS = ("9P2000", "9P2000.u", "9P2000.L")

_NUMBERS = {"1": "B", "2": "H", "4": "I", "8": "Q", "q": "BIQ"}
_U16, _U32, _QID = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<BIQ")
Decode = Callable[[bytes], tuple[Any, ...]]
Encode = Callable[..., bytes]


def _decoder(layout: str) -> Decode:
    """Make the function that gives the values of a whole message, header included in its bytes."""
    if not set(layout) - set("1248"):  # nothing but integers: one call
        whole = struct.Struct("<7x" + "".join(_NUMBERS[c] for c in layout))

        def decode_numbers(message: bytes) -> tuple[Any, ...]:
            if len(message) != whole.size:
                raise Malformed(f"{len(message)} bytes, expected {whole.size}")
            return whole.unpack(message)

        return decode_numbers

    def decode(message: bytes) -> tuple[Any, ...]:
        values: list[Any] = []
        at = HEADER.size
        for kind in layout:
            value, at = _READERS[kind](message, at)
            values.append(value)
        if at != len(message):
            raise Malformed(f"{len(message) - at} bytes too many")
        return tuple(values)

    return decode


def _read_number(kind: str) -> Callable[[bytes, int], tuple[int, int]]:
    number = struct.Struct("<" + _NUMBERS[kind])

    def read(message: bytes, at: int) -> tuple[int, int]:
        return number.unpack_from(message, at)[0], at + number.size

    return read


def _read_bytes(message: bytes, at: int, count: int) -> tuple[bytes, int]:
    if at + count > len(message):
        raise Malformed(f"{at + count - len(message)} bytes are missing")
    return message[at : at + count], at + count


def _read_text(message: bytes, at: int) -> tuple[str, int]:
    (count,) = _U16.unpack_from(message, at)
    data, at = _read_bytes(message, at + 2, count)
    return data.decode("utf-8", "surrogateescape"), at


def _read_data(message: bytes, at: int) -> tuple[bytes, int]:
    (count,) = _U32.unpack_from(message, at)
    return _read_bytes(message, at + 4, count)


def _read_record(message: bytes, at: int) -> tuple[bytes, int]:
    (count,) = _U16.unpack_from(message, at)
    return _read_bytes(message, at + 2, count)


def _read_qid(message: bytes, at: int) -> tuple[Qid, int]:
    return Qid(*_QID.unpack_from(message, at)), at + _QID.size


def _read_texts(message: bytes, at: int) -> tuple[list[str], int]:
    return _read_many(message, at, _read_text)


def _read_qids(message: bytes, at: int) -> tuple[list[Qid], int]:
    return _read_many(message, at, _read_qid)


def _read_many(message: bytes, at: int, read: Callable[[bytes, int], tuple[Any, int]]) -> tuple[list[Any], int]:
    (count,) = _U16.unpack_from(message, at)
    if count > MAX_WALK:
        raise Malformed(f"{count} elements, at most {MAX_WALK}")
    at += 2
    found = []
    for _ in range(count):
        value, at = read(message, at)
        found.append(value)
    return found, at


_READERS: dict[str, Callable[[bytes, int], tuple[Any, int]]] = {
    **{kind: _read_number(kind) for kind in "1248"},
    "s": _read_text,
    "d": _read_data,
    "r": _read_record,
    "q": _read_qid,
    "S": _read_texts,
    "Q": _read_qids,
}


def encoded_text(text: str) -> bytes:
    """Spell a text as `s`."""
    data = text.encode("utf-8", "surrogateescape")
    return _U16.pack(len(data)) + data


_WRITERS: dict[str, Callable[[Any], bytes]] = {
    **{kind: struct.Struct("<" + _NUMBERS[kind]).pack for kind in "1248"},
    "s": encoded_text,
    "d": lambda data: _U32.pack(len(data)) + data,
    "r": lambda data: _U16.pack(len(data)) + data,
    "q": lambda qid: _QID.pack(*qid),
    "S": lambda texts: _U16.pack(len(texts)) + b"".join(map(encoded_text, texts)),
    "Q": lambda qids: _U16.pack(len(qids)) + b"".join(_QID.pack(*qid) for qid in qids),
}


def _encoder(number: int, layout: str) -> Encode:
    """Make the function `(tag, *values) -> bytes` of a whole message."""
    if layout == "d":  # a read's reply: no copy but the one into the message
        head = struct.Struct("<IBHI")

        def encode_data(tag: int, data: bytes) -> bytes:
            return head.pack(READ_HEADER + len(data), number, tag, len(data)) + data

        return encode_data
    if not set(layout) - set("1248"):
        whole = struct.Struct("<IBH" + "".join(_NUMBERS[c] for c in layout))

        def encode_numbers(tag: int, *values: int) -> bytes:
            return whole.pack(whole.size, number, tag, *values)

        return encode_numbers
    if not set(layout) - set("1248q"):
        fixed = struct.Struct("<IBH" + "".join(_NUMBERS[c] for c in layout))
        at = layout.index("q")

        def encode_qid(tag: int, *values: Any) -> bytes:
            return fixed.pack(fixed.size, number, tag, *values[:at], *values[at], *values[at + 1 :])

        return encode_qid
    writers = [_WRITERS[kind] for kind in layout]

    def encode(tag: int, *values: Any) -> bytes:
        body = b"".join([write(value) for write, value in zip(writers, values, strict=True)])
        return HEADER.pack(HEADER.size + len(body), number, tag) + body

    return encode


class Dialect:
    """One dialect: `decode[type]` and `encode[type]` for the messages that it has."""

    def __init__(self, name: str) -> None:
        self.name = name
        column = 1 + DIALECTS.index(name)
        layouts = {number: message[column] for number, message in MESSAGES.items()}
        self.decode: dict[int, Decode] = {n: _decoder(layout) for n, layout in layouts.items() if layout is not None}
        self.encode: dict[int, Encode] = {n: _encoder(n, layout) for n, layout in layouts.items() if layout is not None}

    def decoded(self, message: bytes) -> tuple[int, int, tuple[Any, ...]]:
        """Give type, tag and values of a message; Malformed if it is none of this dialect."""
        number, tag = message[4], _U16.unpack_from(message, 5)[0]
        decode = self.decode.get(number)
        if decode is None:
            raise Malformed(f"message type {number} is none of {self.name}")
        try:
            return number, tag, decode(message)
        except (struct.error, Malformed) as error:
            raise Malformed(f"{MESSAGES[number].name}: {error}") from error

    def spelled(self, message: bytes) -> str:
        """Spell a message out, for people who look at traffic."""
        try:
            number, tag, values = self.decoded(message)
        except Malformed as error:
            return f"malformed: {error}: {message[:40]!r}"
        shown = ", ".join(f"{len(v)} bytes {v[:40]!r}" if isinstance(v, bytes) else f"{v!r}" for v in values)
        return f"{MESSAGES[number].name} {tag} ({shown})"


PLAIN, UNIX, LINUX = (Dialect(name) for name in DIALECTS)
BY_NAME = {dialect.name: dialect for dialect in (PLAIN, UNIX, LINUX)}


def dialect_for(version: str) -> Dialect | None:
    """Choose the dialect for what a client proposes; None: there is none."""
    if version in BY_NAME:
        return BY_NAME[version]
    return PLAIN if version.startswith("9P2000.") else None  # an extension that is not known: its base
