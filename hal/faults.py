"""Faults that a scenario puts on the wire."""

from dataclasses import dataclass

from .bus import Frame


@dataclass(frozen=True, slots=True)
class HostSilence:
    """The host's frames stop at a time, as when its process or its adapter dies."""

    from_ns: int

    def __call__(self, frame: Frame) -> Frame | None:
        """Swallow what the host sends from then on."""
        return None if frame.sender == "HOST" and frame.t_ns >= self.from_ns else frame
