"""The folder of a run: one drive at a time writes into it, and what is kept of one that was interrupted."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class Interrupted(Exception):
    """Ctrl-C during a drive; the message says what is kept of it."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep a second drive out of the folder; the kernel gives the lock back, however this process ends."""
    import fcntl

    from rtdb.errors import InUse

    with (folder / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InUse(f"another drive writes into {folder}; wait for it, or give another --out") from None
        yield


def clear(folder: Path) -> None:
    """Remove what was derived from an old recording: it must not stand beside a new one."""
    for old in (folder / "result.json", *folder.glob("*.png"), *folder.glob("*.repro"), folder / "run.rrd"):
        old.unlink(missing_ok=True)
