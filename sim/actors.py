"""Moving actors: people who walk along a path at a constant speed, from a given time on."""

import math
from dataclasses import dataclass
from itertools import pairwise

from hal.signals import ObstacleKind


@dataclass(frozen=True, slots=True)
class Actor:
    """A person who stands at the first point until `start_ns`, walks, and stays at the last one.

    pauses_s: how long to stand at each inner point of the path; none given, no pauses.
    """

    kind: ObstacleKind
    path_m: tuple[tuple[float, float], ...]
    speed_mps: float
    start_ns: int
    pauses_s: tuple[float, ...] = ()

    def at(self, t_ns: int) -> tuple[float, float, float]:
        """Give (x_m, y_m, yaw_rad) at a time."""
        left = max(0.0, (t_ns - self.start_ns) * 1e-9 * self.speed_mps)
        yaw_rad = 0.0
        for k, ((ax, ay), (bx, by)) in enumerate(pairwise(self.path_m)):
            if k and k <= len(self.pauses_s):
                left = max(0.0, left - self.pauses_s[k - 1] * self.speed_mps)
            length = math.hypot(bx - ax, by - ay)
            yaw_rad = math.atan2(by - ay, bx - ax)
            if left <= length:
                return ax + left / length * (bx - ax), ay + left / length * (by - ay), yaw_rad
            left -= length
        return (*self.path_m[-1], yaw_rad)
