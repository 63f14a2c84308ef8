"""How processes end, and how commands are asked to: by Ctrl-C, SIGTERM or the end of their terminal, all alike."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

ASKING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def end_as_by_ctrl_c() -> None:
    """Have the others raise KeyboardInterrupt too, so that neither a store nor a process stays behind."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        if not _is_nohup(number):
            signal.signal(number, signal.default_int_handler)


def _is_nohup(number: signal.Signals) -> bool:
    """Whether nohup said that the end of the terminal is none of ours."""
    return number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN


def how_it_ended(code: int) -> str:
    """Say how a process ended, by its exit code."""
    return f"exit status {code}" if code >= 0 else signal.Signals(-code).name


@contextmanager
def asked_to_end() -> Iterator[Callable[[], str]]:
    """Keep the first of them until it is asked for, empty before; a second one raises KeyboardInterrupt."""
    if threading.current_thread() is not threading.main_thread():
        yield lambda: ""  # signals go to the main thread
        return
    came: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        if came:
            raise KeyboardInterrupt
        came.append(number)

    before = {number: signal.signal(number, note) for number in ASKING if not _is_nohup(number)}
    try:
        yield lambda: f"{signal.Signals(came[0]).name} came" if came else ""
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
