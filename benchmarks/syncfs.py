"""How quick the file server is, each client a process: small operations, barrier, and edges in real time.

    python benchmarks/syncfs.py [ops] [barrier] [100ms] [100ms-any] [10ms] [1ms] [--seconds 30] [--load] [--python]

ops: reads of 100 bytes, against a bare asyncio server that answers as many bytes. The others: N components, each stats
its clock, reads the status of four others and writes its own; 100ms, 10ms and 1ms with SCHED_FIFO and CPUs kept awake,
where the system grants it (`rtdb.realtime`), the others as any process. Components are syncfs_client.c, so that it is
the server that is measured; --python, or without a C compiler: `component` below. --load: two busy loops beside it.
The 10 minutes of issue 6: `100ms --seconds 600`.

What no program can help is in two yardsticks of the same run: the time that a hypervisor gave to others ("stolen"), and
how late the clock itself woke up for its edges.
"""

import argparse
import asyncio
import contextlib
import json
import logging
import os
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path[0] = str(Path(__file__).parents[1])  # beside this file stands rtdb.py, which is not the package

from benchmarks.wakeup import stolen_s
from rtdb import Store, realtime
from rtdb.syncfs import Address, Client, FileServer, Pace, SeatSpec, Tokens, run
from rtdb.syncfs.codec import LINUX, TYPES
from rtdb.syncfs.server import new_loop

BYTES = 100
TREAD = LINUX.encode[TYPES["Tread"]]
OPS_S, ROUNDS = 2.0, 3
MOST_VALUES = 20_000  # that a component tells


# -- processes --------------------------------------------------------------------------------------------------------


def child(*job: object) -> "subprocess.Popen[str]":
    command = [sys.executable, __file__, "--job", json.dumps(job)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def said(process: "subprocess.Popen[str]") -> Any:
    assert process.stdout is not None
    return json.loads(process.stdout.readline())


def tell(value: Any) -> None:
    print(json.dumps(value), flush=True)


@contextlib.contextmanager
def server(*job: object) -> Iterator["subprocess.Popen[str]"]:
    process = child(*job)
    said(process)
    try:
        yield process
    finally:
        process.terminate()
        process.wait()


def together(clients: list["subprocess.Popen[str]"]) -> list[Any]:
    """Let clients that are ready begin at the same time, and gather what they found."""
    for process in clients:
        said(process)
    for process in clients:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    found = [said(process) for process in clients]
    for process in clients:
        process.wait()
    return found


# -- small operations -------------------------------------------------------------------------------------------------


def serve_ops(address: str, plain: bool) -> None:
    with Store.create(f"bench-{os.getpid()}", clock="real", size=64 << 20) as store:
        store.run_clock()
        assert store.name is not None
        run(FileServer(store.name), [Address.parse(address)], ready=lambda _: tell("up"), plain=plain)


class Echo(asyncio.Protocol):
    """Answers each request of 23 bytes with as many bytes as a read has: the yardstick."""

    def connection_made(self, transport: Any) -> None:
        self.write, self.reply = transport.write, bytes(11 + BYTES)

    def data_received(self, data: bytes) -> None:
        for _ in range(len(data) // 23):
            self.write(self.reply)


def serve_echo(address: str, plain: bool) -> None:
    async def serve() -> None:
        where, loop = Address.parse(address), asyncio.get_running_loop()
        if where.path is not None:
            await loop.create_unix_server(Echo, str(where.path))
        else:
            await loop.create_server(Echo, where.host, where.port)
        tell("up")
        await asyncio.Event().wait()

    with asyncio.Runner(loop_factory=asyncio.new_event_loop if plain else new_loop) as runner:
        runner.run(serve())


def ask(address: str, window: int, echo: bool) -> None:
    """Keep `window` reads under way for a while; tells how many were answered in a second."""
    if echo:
        where = Address.parse(address)
        sock = socket.socket(socket.AF_UNIX if where.path is not None else socket.AF_INET)
        sock.connect(str(where.path) if where.path is not None else (where.host, where.port))
        fid = 0
    else:
        client = Client.connect(address)
        fid, sock = client._kept("/notes", 0), client._sock
    requests, n_bytes = b"".join(TREAD(tag, fid, 0, 4096) for tag in range(window)), window * (11 + BYTES)
    tell("ready")
    sys.stdin.readline()
    begun, count = time.perf_counter(), 0
    while time.perf_counter() - begun < OPS_S:
        sock.sendall(requests)
        got = 0
        while got < n_bytes:
            got += len(sock.recv(1 << 16))
        count += window
    tell(count / (time.perf_counter() - begun))


def ops(folder: Path) -> None:
    print(f"small operations: reads of {BYTES} bytes, per second; median of {ROUNDS} (bare asyncio; ratio)")
    for plain in (True, False):
        for kind in ("unix", "tcp"):
            with socket.socket() as free:
                free.bind(("127.0.0.1", 0))
                port = free.getsockname()[1]
            mine = f"unix:{folder}/s{plain}" if kind == "unix" else f"tcp:127.0.0.1:{port}"
            theirs = f"unix:{folder}/e{plain}" if kind == "unix" else f"tcp:127.0.0.1:{port + 1}"
            with server("serve_ops", mine, plain), server("serve_echo", theirs, plain):
                with Client.connect(mine) as client:
                    client.write("/notes", bytes(BYTES))
                    for _ in range(2):
                        client.wait()
                for clients, window in ((4, 1), (2, 16)):
                    found: dict[bool, list[float]] = {True: [], False: []}
                    for _ in range(ROUNDS):
                        for echo, address in ((False, mine), (True, theirs)):
                            asked = [child("ask", address, window, echo) for _ in range(clients)]
                            found[echo].append(sum(together(asked)))
                    got, bare = (statistics.median(found[echo]) for echo in (False, True))
                    print(
                        f"  {'asyncio' if plain else 'uvloop '} {kind:4} {clients} clients, {window:2} under way: "
                        f"{got:7,.0f}/s ({bare:7,.0f}/s; {got / bare:.2f})",
                        flush=True,
                    )


# -- edges ------------------------------------------------------------------------------------------------------------


def serve_edges(address: str, clock: str, tick_ns: int, every: int, names: list[str], fifo: bool) -> None:
    logging.disable(logging.WARNING)  # clients that have ended
    got = realtime() if fifo else None  # before the clock's thread begins, so that it is one of them
    with Store.create(f"bench-{os.getppid()}", clock=clock, tick_ns=tick_ns, size=64 << 20) as store:
        seats = [SeatSpec(component=n, every=every, phase=0, latency_cycles=every - 1) for n in names]
        tokens = Tokens(dict(zip(names, names, strict=True)))
        assert store.name is not None
        files = FileServer(store.name, pace=Pace(every), seats=seats, tokens=tokens)
        store.run_clock(tuple(names) if clock == "barrier" else ())
        run(files, [Address.parse(address)], ready=lambda _: tell(list(got.refused) if got is not None else []))


def compiled(folder: Path) -> Path | None:
    """Compile syncfs_client.c; None where there is no C compiler."""
    compiler = (os.environ.get("CC") or "cc").split()
    if shutil.which(compiler[0]) is None:
        print(f"no C compiler ({compiler[0]}; $CC names another): the components are Python processes")
        return None
    source, program = Path(__file__).with_name("syncfs_client.c"), folder / "syncfs_client"
    subprocess.run([*compiler, "-std=c11", "-O2", "-Wall", "-Wextra", str(source), "-o", str(program)], check=True)
    return program


def component(address: str, name: str, others: list[str], seconds: float, fifo: bool) -> None:
    """Be a component: tells edges, missed ones, and how late it was woken: the host's steady time less store time."""
    if fifo:
        realtime(40)
    with Client.connect(address, name) as client:
        clock, status = f"/{name}/clock", f"/{name}/status"
        client.rewrite(status, b'{"n": 0}\n')
        tell("ready")
        sys.stdin.readline()
        fid = client._kept(clock, -1)
        late_ns, missed, last, end = [], 0, None, time.monotonic() + seconds
        while time.monotonic() < end:
            values = client._call("Tgetattr", fid, 0x3FFF)
            late_ns.append(time.monotonic_ns() - values[12] * 1_000_000_000 - values[13])
            if last is not None and values[19] > last + 1:
                missed += values[19] - last - 1
            last = values[19]
            for other in others:
                client.read(f"/{other}/status")
            client.rewrite(status, b'{"n": %d}\n' % last)
    late_ns.sort()
    edges, n = len(late_ns), min(len(late_ns), MOST_VALUES)
    shown = [late_ns[k * (edges - 1) // max(1, n - 1)] for k in range(n)]  # the least and the greatest among them
    tell({"edges": edges, "missed": missed, "fifo": os.sched_getscheduler(0) == os.SCHED_FIFO, "late_ns": shown})


def client(
    program: Path | None, address: str, name: str, others: list[str], seconds: float, fifo: bool
) -> "subprocess.Popen[str]":
    if program is None:
        return child("component", address, name, others, seconds, fifo)
    command = [str(program), address.removeprefix("unix:"), name, str(seconds), str(int(fifo)), *others]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def edges(
    folder: Path,
    program: Path | None,
    what: str,
    clock: str,
    tick_ns: int,
    every: int,
    n: int,
    seconds: float,
    fifo: bool,
) -> None:
    """Run components as clients, and say what they saw. program: the C client, None for Python."""
    address, names = f"unix:{folder}/edges", [f"c{k}" for k in range(n)]
    job = ("serve_edges", address, clock, tick_ns, every, names, fifo)
    before_s, process = stolen_s(), child(*job)
    try:
        refused = said(process)
        with Store.attach(f"bench-{os.getpid()}") as store:  # whoever is interrupted between the clocks sees too little
            offset_ns = max(store.now_ns - time.monotonic_ns() for _ in range(100))
        clients = [
            client(program, address, name, [names[(k + j) % n] for j in range(1, 5)], seconds, fifo)
            for k, name in enumerate(names)
        ]
        found = together(clients)
        with Store.attach(f"bench-{os.getpid()}") as store:
            lateness_us = store.clock.lateness_us
        with Client.connect(address) as watcher:
            report = watcher.read_json("/server")
    finally:
        process.terminate()
        process.wait()
    late = sorted((ns + offset_ns) / 1000 for one in found for ns in one["late_ns"])
    seen, missed = sum(one["edges"] for one in found), sum(one["missed"] for one in found)
    scheduling = "any process" if not fifo else "SCHED_FIFO"
    scheduling += f" (refused: {'; '.join(refused)})" if refused else ""
    if fifo and not all(one["fifo"] for one in found):
        scheduling += ", components without it"
    print(f"{what}: {n} components in {'C' if program else 'Python'}, {seconds:g} s, {scheduling}")
    if clock == "barrier":
        print(f"  {max(one['edges'] for one in found) / seconds:.0f} edges/s")
        return
    print(
        f"  missed {missed} of {seen + missed} edges ({100 * missed / (seen + missed):.3f} %); edge to woken: "
        f"median {late[len(late) // 2]:.0f} us, p99 {late[len(late) * 99 // 100]:.0f} us, max {late[-1]:.0f} us"
    )
    for bins, text in (
        (lateness_us, f"stolen {1e3 * (stolen_s() - before_s):.0f} ms; clock woke up"),
        (report["heard_us"], "server heard of the edge"),
        (report["answered_us"], "had answered all who waited"),
    ):
        print(f"  {text}: " + ", ".join(f"<{2 << k} us {count}" for k, count in enumerate(bins) if count))


# -- which ------------------------------------------------------------------------------------------------------------


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="*", help="ops, barrier, 100ms, 100ms-any, 10ms, 1ms [all]")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--load", action="store_true")
    parser.add_argument("--python", action="store_true", help="components are Python processes, not syncfs_client.c")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.job:
        name, *values = json.loads(args.job)
        {f.__name__: f for f in (serve_ops, serve_echo, ask, serve_edges, component)}[name](*values)
        return
    wanted = args.what or ["ops", "barrier", "100ms", "100ms-any", "10ms", "1ms"]
    beside = "two busy loops" if args.load else "nothing"
    print(f"{os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}, {beside} beside it")
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2 if args.load else 0)]
    try:
        with tempfile.TemporaryDirectory() as place:
            folder, s = Path(place), args.seconds
            program = compiled(folder) if set(wanted) - {"ops"} and not args.python else None
            rows = {
                "ops": lambda: ops(folder),
                "barrier": lambda: edges(folder, program, "barrier", "barrier", 10_000_000, 1, 32, min(s, 10.0), False),
                "100ms": lambda: edges(folder, program, "100 ms", "real", 10_000_000, 10, 32, s, True),
                "100ms-any": lambda: edges(folder, program, "100 ms", "real", 10_000_000, 10, 32, s, False),
                "10ms": lambda: edges(folder, program, "10 ms", "real", 10_000_000, 1, 16, s, True),
                "1ms": lambda: edges(folder, program, "1 ms", "real", 1_000_000, 1, 4, min(s, 10.0), True),
            }
            for row in wanted:
                rows[row]()
    finally:
        for process in busy:
            process.kill()
            process.wait()


if __name__ == "__main__":
    main()
