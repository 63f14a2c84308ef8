"""Device model of the wheel-tick node: free-running 16-bit counts of both rear wheels, every 20 ms."""

import math

from hal.bus import CanBus
from hal.codecs.cartcan import WheelTicks

REPORT_NS = 20_000_000


class TickNode:
    """Counts `ticks_per_m` edges of each wheel's travel; backward counts down."""

    def __init__(self, bus: CanBus, left_ticks_per_m: float, right_ticks_per_m: float) -> None:
        self.port = bus.port("ODOM", [])
        self._left_per_m, self._right_per_m = left_ticks_per_m, right_ticks_per_m
        self.left = self.right = 0
        self._before = 0

    def poll(self, t_ns: int, left_m: float, right_m: float) -> None:
        """Count; report when due."""
        self.left, self.right = math.floor(left_m * self._left_per_m), math.floor(right_m * self._right_per_m)
        if t_ns % REPORT_NS == 0:
            total = self.left + self.right
            self.port.send(
                WheelTicks.of(left=self.left, right=self.right, dt_s=REPORT_NS * 1e-9, reverse=total < self._before),
                t_ns,
            )
            self._before = total
