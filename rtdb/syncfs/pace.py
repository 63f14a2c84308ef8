"""Pace: at which cycles somebody is woken, and so the cut that is shown to it meanwhile."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Pace:
    """Due at cycles c with c % every == phase: syncfs' 100 ms are every=10, phase=0 at a tick of 10 ms."""

    every: int = 10
    phase: int = 0

    def last(self, cycle: int) -> int:
        """Give the last due cycle up to this one; 0 before the first."""
        return max(0, cycle - (cycle - self.phase) % self.every)

    def count(self, cycle: int) -> int:
        """Give how many edges there were up to a cycle."""
        return max(0, (cycle - self.phase) // self.every + (1 if self.phase else 0))
