"""Captures of serial receivers, as a transport: the bytes of a file with the times at which they must have come.

A plain capture holds no arrival times. They are put back from the receiver's own clock: a sentence with a new time of
day comes that much later than the one before; a time that runs backward, or leaps by more than a minute, counts as one
second. Lines that begin with `#` are notes of whoever made the capture.
"""

from collections.abc import Iterator
from pathlib import Path

from .codecs.nmea import SentenceError, parse
from .errors import HalError

LARGEST_STEP_S = 60.0


class CaptureError(HalError, ValueError):
    """A capture is missing, unreadable or empty."""


def read_capture(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield (nanoseconds since the first byte, bytes) line by line; CaptureError if there is nothing to play."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read: {error.strerror}") from error
    lines = [line for line in data.splitlines(keepends=True) if not line.startswith(b"#")]
    if not any(b"$" in line for line in lines):
        raise CaptureError(f"{path} holds no NMEA sentence; give a capture of a receiver's serial output")
    return _timed(lines)


def _timed(lines: list[bytes]) -> Iterator[tuple[int, bytes]]:
    t_ns, last_s = 0, None
    for line in lines:
        time_s = _time_of_day(line)
        if time_s is not None and time_s != last_s:
            step_s = 0.0 if last_s is None else (time_s - last_s) % 86_400.0
            t_ns += round((step_s if step_s <= LARGEST_STEP_S else 1.0) * 1e9)
            last_s = time_s
        yield t_ns, line


def _time_of_day(line: bytes) -> float | None:
    try:
        sentence = parse(line)
    except SentenceError:
        return None
    return getattr(sentence, "time_s", None)
