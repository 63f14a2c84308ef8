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


class CanPort:
    """One node's connection: sends, and queues what passes its acceptance filter."""

    def __init__(self, bus: "CanBus", name: str, accept: frozenset[int]) -> None:
        self._bus, self.name, self.accept = bus, name, accept
        self._counters: dict[int, int] = {}
        self._queue: list[Received] = []
        self.damaged = 0

    def send(self, message: Message, t_ns: int) -> None:
        """Put a message on the bus, with the next counter of its id."""
        counter = self._counters.get(message.ID, 0)
        self._counters[message.ID] = (counter + 1) & 15
        data = encode(message, counter) if self._bus.level == "wire" else message
        self._bus.carry(Frame(t_ns, self.name, message.ID, data, counter))

    def hear(self, received: Received) -> None:
        """Queue what came from the bus."""
        self._queue.append(received)

    def receive(self) -> list[Received]:
        """Take everything that has come since the last call, in order."""
        if not self._queue:
            return []
        heard, self._queue = self._queue, []
        for received in heard:
            if received.message is None:
                self.damaged += 1
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
        self._routes: dict[tuple[str, int], tuple[CanPort, ...]] = {}

    def port(self, name: str, accept: Iterable[type[Message]]) -> CanPort:
        """Connect a node that hears the given messages."""
        port = CanPort(self, name, frozenset(message.ID for message in accept))
        self._ports.append(port)
        self._routes.clear()
        return port

    def carry(self, frame: Frame) -> None:
        """Deliver one frame through the faults."""
        self.frames += 1
        for fault in self.faults:
            passed = fault(frame)
            if passed is None:
                return
            frame = passed
        key = (frame.sender, frame.frame_id)
        route = self._routes.get(key)
        if route is None:
            route = self._routes[key] = tuple(
                p for p in self._ports if frame.frame_id in p.accept and p.name != frame.sender
            )
        received = read(frame)
        for port in route:
            port.hear(received)
