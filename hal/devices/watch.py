"""How a node judges the frames of one command: counter, checksum, silence. Source of the rules: docs/cart.md."""

from hal.bus import Received
from hal.codecs.cartcan import Message, SystemCmd

BAD_IN_A_ROW = 3
LEAK_LIMIT = 5
GOOD_BEFORE_ENABLE = 3


class CommandWatch:
    """Watches one command id. A frame is good if its checksum holds and its counter follows the last one."""

    NEVER_NS = -(1 << 63)  # before any time
    __slots__ = (
        *("_counter", "_in_a_row", "_leak", "asks", "bad_counter", "bad_crc", "fresh_until_ns"),
        *("idle_streak", "rejected", "timeout_ns", "tripped"),
    )

    def __init__(self, timeout_ns: int) -> None:
        self.timeout_ns = timeout_ns
        self.fresh_until_ns = self.NEVER_NS  # later than that, the command is silent
        self.tripped = False  # too many bad frames to go on
        self.bad_crc = self.bad_counter = False  # what the latest bad frames had
        self.rejected = False  # a frame was refused since the last report
        self.asks = False  # the latest good frame asked to be obeyed
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
        counter, before = received.counter, self._counter
        self._counter = counter
        if t_ns <= self.fresh_until_ns and before is not None and counter != (before + 1) & 15:
            self._refuse(crc=False)
            return None
        self.fresh_until_ns = t_ns + self.timeout_ns
        if self._leak:
            self._leak -= 1
        self._in_a_row = 0
        self.tripped = self._leak >= LEAK_LIMIT
        asks = message.request_enable if isinstance(message, SystemCmd) else getattr(message, "enable", 0)
        self.asks = bool(asks)
        self.idle_streak = 0 if asks else self.idle_streak + 1
        return message

    def _refuse(self, *, crc: bool) -> None:
        self.rejected = True
        self._in_a_row += 1
        self._leak += 1
        self.tripped = self._in_a_row >= BAD_IN_A_ROW or self._leak >= LEAK_LIMIT
        self.idle_streak = 0
        self.bad_crc, self.bad_counter = self.bad_crc or crc, self.bad_counter or not crc

    def silent(self, t_ns: int) -> bool:
        """No good frame for longer than the time-out."""
        return t_ns > self.fresh_until_ns

    def forgive(self) -> None:
        """Forget what was bad."""
        self.bad_crc = self.bad_counter = self.tripped = False
        self._in_a_row = self._leak = 0
