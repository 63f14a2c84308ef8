"""Faults that a scenario puts on the wire."""

from dataclasses import dataclass

import numpy as np

from .bus import Frame
from .errors import ProfileError


@dataclass(frozen=True, slots=True)
class HostSilence:
    """The host's frames stop at a time, as when its process or its adapter dies."""

    from_ns: int

    def __call__(self, frame: Frame) -> Frame | None:
        """Swallow what the host sends from then on."""
        return None if frame.sender == "HOST" and frame.t_ns >= self.from_ns else frame


@dataclass(frozen=True, slots=True)
class Corruption:
    """Flips one bit of some frames, as a bad contact does. True bytes only."""

    from_ns: int
    to_ns: int
    probability: float
    rng: np.random.Generator

    def __call__(self, frame: Frame) -> Frame | None:
        """Damage the frame, or pass it on."""
        if not self.from_ns <= frame.t_ns < self.to_ns or self.rng.random() >= self.probability:
            return frame
        if not isinstance(frame.data, bytes):
            raise ProfileError("can-corruption flips bits of true bytes; drive with --level wire")
        bit = int(self.rng.integers(0, 64))
        data = (int.from_bytes(frame.data, "little") ^ (1 << bit)).to_bytes(8, "little")
        return Frame(frame.t_ns, frame.sender, frame.frame_id, data, frame.counter)
