"""Moving actors: people who walk along a path at a constant speed, from a given time on."""

import math
from dataclasses import dataclass

from hal.signals import ObstacleKind


@dataclass(frozen=True, slots=True)
class Actor:
    """A person who stands at the first point until `start_ns`, walks, and stays at the last one."""

    kind: ObstacleKind
    path_m: tuple[tuple[float, float], ...]
    speed_mps: float
    start_ns: int

    def at(self, t_ns: int) -> tuple[float, float, float]:
        """Give (x_m, y_m, yaw_rad) at a time."""
        left = max(0.0, (t_ns - self.start_ns) * 1e-9 * self.speed_mps)
        yaw_rad = 0.0
        for (ax, ay), (bx, by) in zip(self.path_m, self.path_m[1:], strict=False):
            length = math.hypot(bx - ax, by - ay)
            yaw_rad = math.atan2(by - ay, bx - ax)
            if left <= length:
                return ax + left / length * (bx - ax), ay + left / length * (by - ay), yaw_rad
            left -= length
        return (*self.path_m[-1], yaw_rad)
