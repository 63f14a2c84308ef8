"""What devices on a serial line share: they measure at fixed times and say it in sentences, paced by the baud rate."""

import copy
from collections import deque
from typing import Any, Literal

from hal.codecs import nmea
from hal.codecs.nmea import Sentence

_BYTE_TIME_BAUD_NS = 10 * 1_000_000_000  # a byte is ten bits; divided by the baud rate, its time in ns


class Talker:
    """Measures every `period_ns` from `t0_ns` on; the burst of a measurement ends `latency_ns` after it.

    In each tick: measure if it is `due`, then `poll`. Set `silent` for an outage: nothing is measured or sent then, and
    a burst under way is cut off for good.
    """

    _STATE = ("silent", "_bytes", "_sentences")

    def __init__(
        self, *, period_ns: int, latency_ns: int, baud: int, level: Literal["wire", "direct"], t0_ns: int
    ) -> None:
        if level not in ("wire", "direct"):
            raise ValueError(f"level {level!r}, expected 'wire' or 'direct'")
        if period_ns <= 0 or latency_ns < 0 or baud <= 0:
            raise ValueError(f"period {period_ns} ns, latency {latency_ns} ns, {baud} baud: expected positive ones")
        self.silent = False
        """Nothing is measured or sent while it is true."""
        self._period_ns = period_ns
        self._latency_ns = latency_ns
        self._baud = baud
        self._direct = level == "direct"
        self._t0_ns = t0_ns
        self._bytes: deque[tuple[int, bytes]] = deque()  # when the last one leaves, those that have not left
        self._sentences: deque[tuple[int, Sentence]] = deque()  # when it is complete

    def due(self, t_ns: int) -> bool:
        """Say whether the device measures at `t_ns`."""
        return t_ns >= self._t0_ns and (t_ns - self._t0_ns) % self._period_ns == 0

    def say(self, t_ns: int, sentences: list[Sentence]) -> None:
        """Put what was measured at t_ns on the line; ValueError if it does not fit."""
        # Level direct needs the text too, for its length: a sentence is as late as on the wire.
        lines = [nmea.format(sentence) for sentence in sentences]
        self.refuse_if_too_long(sum(map(len, lines)))
        end_ns = t_ns + self._latency_ns
        if not self._direct:
            self._bytes.append((end_ns, b"".join(lines)))
            return
        behind = sum(map(len, lines))
        for sentence, line in zip(sentences, lines, strict=True):
            behind -= len(line)
            # A listener knows a line with its CR; the LF is one of the bytes behind.
            complete_ns = end_ns - (behind + 1) * _BYTE_TIME_BAUD_NS // self._baud
            self._sentences.append((complete_ns, nmea.quantise(sentence)))

    def poll(self, t_ns: int) -> bytes | list[Sentence]:
        """Return what left the line by `t_ns`, once: bytes or, in level direct, sentences."""
        if self.silent:
            self._bytes.clear()
            self._sentences.clear()
        if self._direct:
            complete: list[Sentence] = []
            while self._sentences and self._sentences[0][0] <= t_ns:
                complete.append(self._sentences.popleft()[1])
            return complete
        left = b""
        while self._bytes:
            end_ns, data = self._bytes.popleft()
            # Rounded up: a byte leaves as a whole.
            keep = -((t_ns - end_ns) * self._baud // _BYTE_TIME_BAUD_NS)
            if keep <= 0:
                left += data
                continue
            at = max(len(data) - keep, 0)
            left += data[:at]
            self._bytes.appendleft((end_ns, data[at:]))
            break
        return left

    def snapshot(self) -> tuple[Any, ...]:
        """Return what `restore` needs to continue exactly from here; it can be pickled."""
        return copy.deepcopy(tuple(getattr(self, name) for name in self._STATE))

    def restore(self, snapshot: tuple[Any, ...]) -> None:
        """Continue from `snapshot`, taken from a device with the same parameters."""
        for name, value in zip(self._STATE, copy.deepcopy(snapshot), strict=True):
            setattr(self, name, value)

    def refuse_if_too_long(self, length: int) -> None:
        """Refuse a burst that the line cannot carry within period and latency."""
        room_ns = min(self._period_ns, self._latency_ns)
        if length * _BYTE_TIME_BAUD_NS > room_ns * self._baud:
            raise ValueError(
                f"{length} bytes take {length * 10_000 / self._baud:.1f} ms at {self._baud} baud, "
                f"expected at most {room_ns / 1e6:.1f} ms in period and latency: "
                "raise the baud rate or drop sentences"
            )
