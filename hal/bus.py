"""The cart's CAN bus inside one process: ports send and receive, faults sit on the wire.

Level `wire` carries true frames (8 bytes with counter and checksum), which faults can damage before they are decoded.
Level `direct` hands the same quantised messages over and leaves only the encoding out.
"""

from collections.abc import Callable, Iterable
from typing import Literal

import msgspec

from .codecs.cartcan import FrameError, Message, decode, encode
from .errors import ProfileError

Level = Literal["direct", "wire"]


class Frame(msgspec.Struct, frozen=True, gc=False):
    """What is on the wire: `data` is bytes at level wire, the message itself at level direct."""

    t_ns: int
    sender: str
    frame_id: int
    data: bytes | Message
    counter: int


class Received(msgspec.Struct, frozen=True, gc=False):
    """What a port hears. `message` is None for a frame that its checksum, length or id refuses."""

    t_ns: int
    frame_id: int
    message: Message | None
    counter: int


Fault = Callable[[Frame], Frame | None]
"""Stands on the wire: passes a frame on, changes it, or swallows it (None)."""


class Sent:
    """What a port knows of one id that it sends: the next counter, and the ports that hear it."""

    __slots__ = ("counter", "heard_by")

    def __init__(self) -> None:
        self.counter = 0
        self.heard_by: tuple[CanPort, ...] | None = None  # None: to be looked up


class CanPort:
    """One node's connection: sends, and queues what passes its acceptance filter."""

    __slots__ = ("_bus", "_queue", "accept", "damaged", "hear", "name", "sent")

    def __init__(self, bus: "CanBus", name: str, accept: frozenset[int]) -> None:
        self._bus, self.name, self.accept = bus, name, accept
        self.sent: dict[int, Sent] = {}
        self._queue: list[Received] = []
        self.hear = self._queue.append
        self.damaged = 0

    def send(self, message: Message, t_ns: int) -> None:
        """Put a message on the bus, with the next counter of its id."""
        bus, frame_id = self._bus, message.ID
        sent = self.sent.get(frame_id)
        if sent is None:
            sent = self.sent[frame_id] = Sent()
        counter = sent.counter
        sent.counter = (counter + 1) & 15
        data = encode(message, counter) if bus.level == "wire" else None
        if bus.faults:
            bus.carry(Frame(t_ns, self.name, frame_id, message if data is None else data, counter))
            return
        if data is not None:
            message, counter = decode(frame_id, data)
        bus.frames += 1
        if sent.heard_by is None:
            sent.heard_by = bus.listeners(self.name, frame_id)
        received = Received(t_ns, frame_id, message, counter)
        for port in sent.heard_by:
            port.hear(received)

    def receive(self) -> list[Received]:
        """Take everything that has come since the last call, in order."""
        queue = self._queue
        if not queue:
            return []
        heard = queue.copy()
        queue.clear()
        return heard


def read(frame: Frame) -> Received:
    """Read a frame off the wire, as the controller of every node that hears it does: all of them see the same bytes."""
    if isinstance(frame.data, Message):
        return Received(frame.t_ns, frame.frame_id, frame.data, frame.counter)
    try:
        message, counter = decode(frame.frame_id, frame.data)
    except FrameError:
        return Received(frame.t_ns, frame.frame_id, None, -1)
    return Received(frame.t_ns, frame.frame_id, message, counter)


class CanBus:
    """Connects ports. Every frame reaches all other ports whose filter accepts its id, at once and in order."""

    def __init__(self, level: Level) -> None:
        if level not in ("direct", "wire"):
            raise ProfileError(f"level {level!r} is not one of direct, wire")
        self.level = level
        self.faults: list[Fault] = []
        self.frames = 0
        self._ports: list[CanPort] = []

    def port(self, name: str, accept: Iterable[type[Message]]) -> CanPort:
        """Connect a node that hears the given messages."""
        port = CanPort(self, name, frozenset(message.ID for message in accept))
        self._ports.append(port)
        for sender in self._ports:
            for sent in sender.sent.values():
                sent.heard_by = None
        return port

    def listeners(self, sender: str, frame_id: int) -> tuple[CanPort, ...]:
        """List the ports that hear a frame."""
        return tuple(p for p in self._ports if frame_id in p.accept and p.name != sender)

    def carry(self, frame: Frame) -> None:
        """Deliver one frame through the faults."""
        self.frames += 1
        for fault in self.faults:
            passed = fault(frame)
            if passed is None:
                return
            frame = passed
        received = read(frame)
        for port in self.listeners(frame.sender, frame.frame_id):
            port.hear(received)
            port.damaged += received.message is None
