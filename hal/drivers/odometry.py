"""Driver of the wheel ticks: unwraps the counters, so that a lost frame costs no travel."""

from hal.codecs.cartcan import WheelTicks
from hal.signals import Odometry

SPEED_WINDOW = 5  # frames: 100 ms


class OdometryDriver:
    """Turns WHEEL_TICKS into travel and speed."""

    def __init__(self, metres_per_tick: float) -> None:
        self._metres_per_tick = metres_per_tick
        self._last: WheelTicks | None = None
        self._counter = 0
        self._left = self._right = 0
        self._lost = 0
        self._window: list[tuple[int, int]] = []  # (ticks of both wheels, time)

    def hear(self, message: WheelTicks, counter: int, t_ns: int) -> Odometry:
        """Take one frame; counters start at the first one."""
        if self._last is not None:
            self._left += (message.left - self._last.left + 0x8000) % 0x10000 - 0x8000
            self._right += (message.right - self._last.right + 0x8000) % 0x10000 - 0x8000
            self._lost += (counter - self._counter - 1) & 15
        self._last, self._counter = message, counter
        self._window.append((self._left + self._right, t_ns))
        if len(self._window) > SPEED_WINDOW + 1:
            del self._window[0]
        (n0, t0), (n1, t1) = self._window[0], self._window[-1]
        speed_mps = (n1 - n0) * 0.5 * self._metres_per_tick / ((t1 - t0) * 1e-9) if t1 > t0 else 0.0
        return Odometry(
            self._left * self._metres_per_tick,
            self._right * self._metres_per_tick,
            speed_mps,
            bool(message.valid_left and message.valid_right),
            self._lost,
        )
