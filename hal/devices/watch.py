"""How a node judges the frames of one command: counter, checksum, silence. Source of the rules: docs/cart.md."""

from hal.bus import Received
from hal.codecs.cartcan import Message

BAD_IN_A_ROW = 3
LEAK_LIMIT = 5
GOOD_BEFORE_ENABLE = 3


class CommandWatch:
    """Watches one command id. A frame is good if its checksum holds and its counter follows the last one."""

    def __init__(self, timeout_ns: int) -> None:
        self.timeout_ns = timeout_ns
        self.last_good_ns: int | None = None
        self.bad_crc = self.bad_counter = False  # what the latest bad frames had
        self.rejected = False  # a frame was refused since the last report
        self.idle_streak = 0  # good frames in a row that did not ask to be obeyed
        self._counter: int | None = None
        self._in_a_row = self._leak = 0

    def judge(self, received: Received) -> Message | None:
        """Return the message of a good frame, None for one that is not to be obeyed."""
        t_ns, message = received.t_ns, received.message
        if message is None:
            if self._counter is not None:
                self._counter = (self._counter + 1) & 15  # it was one frame: the next good one follows it
            self._refuse(crc=True)
            return None
        silent = self.last_good_ns is None or t_ns - self.last_good_ns > self.timeout_ns
        expected = received.counter if silent or self._counter is None else (self._counter + 1) & 15
        self._counter = received.counter
        if received.counter != expected:
            self._refuse(crc=False)
            return None
        self.last_good_ns = t_ns
        self._in_a_row = 0
        self._leak = max(0, self._leak - 1)
        self.idle_streak = (
            0 if getattr(message, "enable", 0) or getattr(message, "request_enable", 0) else self.idle_streak + 1
        )
        return message

    def _refuse(self, *, crc: bool) -> None:
        self.rejected = True
        self._in_a_row += 1
        self._leak += 1
        self.idle_streak = 0
        self.bad_crc, self.bad_counter = self.bad_crc or crc, self.bad_counter or not crc

    @property
    def tripped(self) -> bool:
        """Too many bad frames to go on."""
        return self._in_a_row >= BAD_IN_A_ROW or self._leak >= LEAK_LIMIT

    def silent(self, t_ns: int) -> bool:
        """No good frame for longer than the time-out."""
        return self.last_good_ns is None or t_ns - self.last_good_ns > self.timeout_ns

    def forgive(self) -> None:
        """Forget what was bad."""
        self.bad_crc = self.bad_counter = False
        self._in_a_row = self._leak = 0
