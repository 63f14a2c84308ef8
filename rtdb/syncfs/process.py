"""A file server in a process of its own, for a run that has components without modules: its job is JSON on stdin.

It says on standard error how to be each of them, and ends when its standard input does.
"""

import asyncio
import json
import logging
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from ..errors import RtdbError
from ..realtime import realtime
from .addresses import Address, default_address
from .cli import invitation
from .policy import Tokens
from .seats import SeatSpec
from .server import FileServer, run


def spawn(
    store_name: str,
    seats: Sequence[SeatSpec],
    listen: str | None,
    tokens: Mapping[str, str],
    *,
    group: int | None = None,
    priority: int | None = None,
) -> "subprocess.Popen[str]":
    """Start a file server for some components of a store. It ends with its standard input.

    listen: an address, None for the store's own socket; tokens: of those that shall not have one by chance;
    group: process group, 0 for one of its own; priority: of SCHED_FIFO, None for none.
    """
    job = {
        "store": store_name, "listen": listen, "seats": [asdict(seat) for seat in seats], "tokens": dict(tokens),
        "priority": priority,
    }  # fmt: skip
    child = subprocess.Popen(
        [sys.executable, "-m", "rtdb.syncfs.process"], stdin=subprocess.PIPE, text=True, process_group=group
    )
    assert child.stdin is not None
    child.stdin.write(json.dumps(job) + "\n")
    child.stdin.flush()
    return child


def main() -> int:
    """Read the job and serve; exit 1 with one line for what cannot be."""
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    try:
        job = json.loads(sys.stdin.readline())
        seats, tokens = [SeatSpec(**seat) for seat in job["seats"]], Tokens()
        for seat in seats:
            tokens.give(seat.component, job["tokens"].get(seat.component))
        address = Address.parse(job["listen"]) if job["listen"] else default_address(job["store"])
        server = FileServer(job["store"], seats=seats, tokens=tokens)

        if job["priority"] is not None and (refused := realtime(job["priority"]).refused):
            print(f"files: no real time: {'; '.join(refused)}", file=sys.stderr)

        def ready(bound: list[Address]) -> None:
            names = ", ".join(seat.component for seat in seats)
            print(f"waiting for {names}, to be taken through files", file=sys.stderr)
            print(*invitation(bound, tokens), sep="\n", file=sys.stderr, flush=True)

        run(server, [address], ready=ready, until=_end_of_input)
    except (RtdbError, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def _end_of_input() -> "asyncio.Future[Any]":
    """Give a future that is done when standard input has ended."""
    loop = asyncio.get_running_loop()
    over: asyncio.Future[Any] = loop.create_future()

    def look() -> None:
        if not os.read(sys.stdin.fileno(), 1):
            loop.remove_reader(sys.stdin)
            if not over.done():
                over.set_result(None)

    loop.add_reader(sys.stdin, look)
    return over


if __name__ == "__main__":
    sys.exit(main())
