"""How fast the store is: minima, medians and ratios of one run, beside what the machine itself takes for the same.

    python benchmarks/rtdb.py [--fifo] [--only ROW,...] [--quick]     the rows
    python benchmarks/rtdb.py --table [--fifo] [--quick]              Table II of the KogMo-RTDB paper
    python benchmarks/rtdb.py --write                                 everything, into docs/rtdb-speed.md

--fifo measures once more under SCHED_FIFO. Table II is taken idle and under stress-ng.
Peers of the store are measured where they are installed, see peers.py. Nothing here asserts a time.
"""

import argparse
import contextlib
import os
import platform
import re
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import timeit
from collections.abc import Callable, Iterator
from dataclasses import KW_ONLY, dataclass
from functools import partial
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from typing import Annotated, Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # `rtdb` is the package, not this file

from benchmarks.peers import (
    FORK,
    PEERS,
    STOP,
    Bytes64,
    Hear,
    Lost,
    Send,
    Stopped,
    child,
    missing,
    on_cores,
    round_of,
    round_of_peer,
    shared_page,
    store_writer,
    wait_until,
)
from rtdb import Record, Store, View
from rtdb.realtime import LATENCY
from rtdb.records import f8, image, u32

ROOT = Path(__file__).parents[1]
HEIGHT, WIDTH = 480, 640  # 300 KiB of bytes
FRAME_PACE_S = 0.005  # between two frames: faster than any camera, slow enough that nothing is left in a cache
PRIORITY = 50
PAGE = ROOT / "docs" / "rtdb-speed.md"


@dataclass(frozen=True)
class Figure:
    """What was measured: times in ns or us, or a rate; `yardstick`: median of what stands beside it in the same run."""

    best: float
    median: float
    yardstick: float = 0.0
    ratio: float = 0.0  # of medians, to the yardstick


@dataclass(frozen=True)
class Row:
    """One line of the table. `target` is for the figure, `at_most` for its ratio to what stands beside it."""

    name: str
    what: str
    unit: str
    _: KW_ONLY
    target: float = 0.0
    beside: str = ""
    at_most: float = 0.0

    @property
    def is_rate(self) -> bool:
        """Whether more is better."""
        return self.unit.endswith("/s")

    def met(self, figure: Figure) -> str:
        """Judge by the median; where only the best figure meets the target, say so."""
        if self.at_most:
            return "yes" if figure.ratio <= self.at_most else "no"
        if not self.target:
            return ""
        sign = -1 if self.is_rate else 1
        meets = [sign * value <= sign * self.target for value in (figure.median, figure.best)]
        return "yes" if meets[0] else "at best" if meets[1] else "no"

    @property
    def goal(self) -> str:
        """Say what is wanted."""
        if self.at_most:
            return f"≤ {self.at_most:g} times"
        return f"{'≥' if self.is_rate else '≤'} {self.target:,g} {self.unit}" if self.target else ""


@dataclass(frozen=True)
class Effort:
    """How long to measure."""

    repeats: int = 200  # of a batch of 1000 Python calls
    rounds: int = 6  # of pings, in turn with their yardsticks
    pings: int = 300
    frames: int = 100
    windows: int = 12  # of a quarter of a second, for rates
    singles: int = 5000  # calls of each operation of Table II


QUICK = Effort(repeats=30, rounds=2, pings=100, frames=30, windows=3, singles=500)
Group = Callable[[Effort, "Core"], dict[str, Figure]]


def figure(values: list[float], beside: list[float] | None = None) -> Figure:
    """Sum values up, beside the yardstick's; both in the same unit."""
    median = statistics.median(values)
    if not beside:
        return Figure(min(values), median)
    yardstick = statistics.median(beside)
    return Figure(min(values), median, yardstick, median / yardstick)


def in_turn(rounds: list[tuple[list[float], list[float]]]) -> Figure:
    """Sum up rounds of (values, yardstick's values); the ratio is the median of the rounds' own ratios."""
    every = [value for values, _ in rounds for value in values]
    beside = [value for _, values in rounds for value in values]
    ratios = [statistics.median(values) / statistics.median(others) for values, others in rounds]
    return Figure(min(every), statistics.median(every), statistics.median(beside), statistics.median(ratios))


# -- the C interface -------------------------------------------------------------------------------------------------


class Core:
    """The compiled rtdb_core.c."""

    def __init__(self, folder: Path) -> None:
        self.program = folder / "rtdb_core"
        core = ROOT / "rtdb" / "core"
        subprocess.run(
            [*os.environ.get("CC", "cc").split(), "-std=c11", "-O2", "-Wall", "-Wextra", "-pthread", f"-I{core}",
             str(ROOT / "benchmarks" / "rtdb_core.c"), *map(str, sorted(core.glob("*.c"))), "-o", str(self.program)],
            check=True,
        )  # fmt: skip

    def run(self, *args: str | int) -> dict[str, list[float]]:
        """Run it in a store of its own; gives the numbers of each line."""
        command, *rest = map(str, args)
        done = subprocess.run(
            [str(self.program), command, f"bench-c-{os.getpid()}", *rest],
            check=True, stdout=subprocess.PIPE, text=True, timeout=300,
        )  # fmt: skip
        return {words[0]: [float(word) for word in words[1:]] for words in map(str.split, done.stdout.splitlines())}


def c_rows(effort: Effort, core: Core) -> dict[str, Figure]:
    del effort
    ns = core.run("speed")

    def us(name: str) -> Figure:
        return Figure(ns[name][0] / 1000, ns[name][1] / 1000)

    def beside(name: str, other: str, unit: float = 1.0) -> Figure:
        (best, median), yardstick = ns[name], ns[other][1]
        return Figure(best / unit, median / unit, yardstick / unit, median / yardstick)

    return {
        "c-write": beside("write_64_at_10", "clock_read"),
        "c-write-real": beside("write_64_real", "clock_read"),
        "c-read": beside("read_64_at_10", "clock_read"),
        "c-write-900": beside("write_64_at_900", "write_64_at_10"),
        "c-read-900": beside("read_64_at_900", "read_64_at_10"),
        "c-as-of": beside("as_of_10000", "read_64_at_10"),
        "c-insert": us("insert_at_900"),
        "c-delete": us("delete_at_900"),
        "c-tick-64": us("tick_64"),
        "c-tick-1000": us("tick_1000"),
        "c-frame-write": beside("frame_write", "frame_memcpy_to_a_ring", 1000),
        "c-frame-read": beside("frame_read", "frame_memcpy", 1000),
        "c-view": beside("frame_view", "clock_read"),
    }


# -- one Python process ----------------------------------------------------------------------------------------------


class Twelve(Record):
    """A record of twelve fields, as a GPS receiver fills it."""

    t_s: Annotated[float, f8("s", "when")] = 0.0
    east_m: Annotated[float, f8("m", "where")] = 1.0
    north_m: Annotated[float, f8("m", "where")] = 2.0
    up_m: Annotated[float, f8("m", "where")] = 3.0
    speed_mps: Annotated[float, f8("m/s", "how fast")] = 4.0
    course_rad: Annotated[float, f8("rad", "whereto")] = 0.5
    std_east_m: Annotated[float, f8("m", "how sure")] = 0.1
    std_north_m: Annotated[float, f8("m", "how sure")] = 0.1
    std_up_m: Annotated[float, f8("m", "how sure")] = 0.2
    quality: Annotated[int, u32("", "of the fix")] = 4
    satellites: Annotated[int, u32("", "in use")] = 12
    station: Annotated[int, u32("", "of the corrections")] = 7


class Picture(Record, eq=False):
    """A frame of 300 KiB."""

    pixels: Annotated[np.ndarray, image(HEIGHT, WIDTH, 1, "grey")]


def set_extent(array: "np.ndarray[Any, Any]") -> None:
    array["pixels_h"], array["pixels_w"], array["pixels_c"] = HEIGHT, WIDTH, 1


def python_rows(effort: Effort, core: Core) -> dict[str, Figure]:
    del core
    with Store.create(f"bench-py-{os.getpid()}", size=16 << 20) as store:
        component = store.join("bench")
        raw = component.insert("raw", Bytes64, history_s=40.0)
        record = component.insert("record", Twelve, history_s=40.0)
        deep = component.insert("deep", Twelve, history_s=101.0)
        frame = component.insert("frame", Picture, history_s=0.0)
        for _ in range(10_000):
            deep.write(Twelve())
            store.tick()
        with frame.frame() as opened:
            opened.array["pixels"][:] = 1
            set_extent(opened.array)
        raw.write(Bytes64(), t_data_ns=0)
        record.write(Twelve())
        store.tick()
        t_ns = [store.now_ns - i * 7919 % 9990 * store.tick_ns for i in range(1000)]
        known = {
            "core": store.core, "h": raw.handle, "payload": bytes(64), "raw": raw, "record": record, "value": Twelve(),
            "deep": deep, "frame": frame, "store": store, "tick": store.tick, "now": time.monotonic_ns, "t_ns": t_ns,
        }  # fmt: skip

        def timed(statement: str, before: str = "pass") -> list[float]:
            """Microseconds a call, of each batch of 1000."""
            batches = timeit.Timer(statement, before, globals=known).repeat(effort.repeats, 1000)
            return [batch * 1000 for batch in batches]

        again = "tick(); tick()"  # so that the ring's slots are free
        now = "tick(); cycle = store.cycle"
        clock = timed("now()")
        each_time = "times = iter(t_ns).__next__"
        return {
            "py-write": figure(timed("core.write(h, payload, 0, ())", again), clock),
            "py-read": figure(timed("core.visible(h, cycle)", now), clock),
            "py-latest": figure(timed("core.latest(h)"), clock),
            "py-record-write": figure(timed("record.write(value)", again), clock),
            "py-record-read": figure(timed("record.visible(cycle)", now), clock),
            "py-as-of": figure(timed("core.as_of(deep.handle, times())", each_time), clock),
            "py-record-as-of": figure(timed("deep.as_of(times())", each_time), clock),
            "py-view": figure(timed("with frame.view() as v: v.memory"), clock),
            "py-view-array": figure(timed("with frame.view() as v: v.array"), clock),
        }


# -- two Python processes --------------------------------------------------------------------------------------------


def waiter(name: str, hear: Hear, stopped: Stopped) -> None:
    with Store.attach(name, timeout_s=5.0) as store:
        obj = store.find("bench/small", timeout_s=5.0)
        write = obj.head
        while not stopped():
            write = obj.wait(write, 1.0) or write
            hear()


def notify_rows(effort: Effort, core: Core) -> dict[str, Figure]:
    in_c, in_python, bare = [], [], []
    for _ in range(effort.rounds):
        us = {name: [ns / 1000 for ns in every] for name, every in core.run("ping", effort.pings).items()}
        bare += us["futex_ping"]
        in_c.append((us["notify_c"], us["futex_ping"]))
        in_python.append((round_of("notify", waiter, store_writer, effort.pings), us["futex_ping"]))
    return {"futex": figure(bare), "c-notify": in_turn(in_c), "py-notify": in_turn(in_python)}


def use(pixels: "np.ndarray[Any, Any]") -> int:
    """Touch every cache line."""
    return int(pixels[::64].sum(dtype=np.int64))


def frame_reader(name: str, hear: Hear, stopped: Stopped, as_image: bool = False) -> None:
    with Store.attach(name, timeout_s=5.0) as store:
        obj = store.find("bench/frame", Picture, timeout_s=5.0)
        write = obj.head
        while not stopped():
            write = obj.wait(write, 1.0) or write
            with View(obj, write) as view:
                pixels = view.array["pixels"].reshape(-1) if as_image else np.frombuffer(view.memory, np.uint8)
                used = use(pixels)
            if used:
                hear()


@contextlib.contextmanager
def frame_writer(name: str, as_image: bool = False) -> Iterator[Send]:
    picture = np.ones((HEIGHT, WIDTH, 1), np.uint8)
    raw = picture.reshape(-1).data
    with Store.create(name, size=8 << 20) as store:
        writer = store.join("bench").insert("frame", Picture, history_s=0.0)

        def send() -> None:
            with writer.frame() as frame:
                if as_image:
                    frame.array["pixels"][:] = picture
                    set_extent(frame.array)
                else:
                    frame.memory[: raw.nbytes] = raw
            store.tick()  # behind the write, so that the next one finds a free slot

        yield send


def shared_memory_round(n: int) -> list[float]:
    """Do the same with what the standard library has: a block of shared memory and a condition."""
    picture, condition, count = np.ones(HEIGHT * WIDTH, np.uint8), FORK.Condition(), shared_page()
    block = SharedMemory(create=True, size=picture.nbytes)

    def reader(name: str, hear: Hear, stopped: Stopped) -> None:
        del name
        pixels, seen = np.frombuffer(block.buf, np.uint8, picture.nbytes), 0
        while not stopped():
            with condition:
                while count[0] == seen and not stopped():
                    condition.wait(1.0)
                seen, used = count[0], use(pixels)
            if used:
                hear()
        os._exit(0)  # the block is its creator's

    @contextlib.contextmanager
    def writer(name: str) -> Iterator[Send]:
        del name
        pixels = np.frombuffer(block.buf, np.uint8, picture.nbytes)

        def send() -> None:
            with condition:
                pixels[:] = picture
                count[0] += 1
                condition.notify()

        yield send

    try:
        return round_of("shared", reader, writer, n, FRAME_PACE_S)
    finally:
        block.unlink()
        with contextlib.suppress(BufferError):  # the writer's array may still be there; the memory goes with it
            block.close()


def frame_rows(effort: Effort, core: Core) -> dict[str, Figure]:
    del core
    raw, images = [], []
    for _ in range(effort.rounds):
        beside = shared_memory_round(effort.frames)
        raw.append((round_of("frame", frame_reader, frame_writer, effort.frames, FRAME_PACE_S), beside))
        reader, writer = partial(frame_reader, as_image=True), partial(frame_writer, as_image=True)
        images.append((round_of("image", reader, writer, effort.frames, FRAME_PACE_S), beside))
    return {"publish": in_turn(raw), "publish-image": in_turn(images)}


def peer_rows(effort: Effort, core: Core) -> dict[str, Figure]:
    del core
    rounds: dict[str, list[list[float]]] = {peer: [] for peer in PEERS if not missing(peer)}
    for _ in range(effort.rounds):
        for peer in list(rounds):
            try:
                rounds[peer].append(round_of_peer(peer, effort.pings))
            except Lost as error:
                print(f"{peer}: {error}", file=sys.stderr)
                del rounds[peer]
    return {f"peer-{peer}": in_turn(list(zip(every, rounds["rtdb"], strict=True))) for peer, every in rounds.items()}


# -- lockstep --------------------------------------------------------------------------------------------------------


def participant(store_name: str, name: str, page: memoryview) -> None:
    with Store.attach(store_name, timeout_s=5.0) as store:
        component = store.join(name, participant=True)
        writer, value = component.insert("out", Twelve), Twelve()
        for _ in component.cycles():
            writer.write(value)
            if page[STOP]:
                break
        component.leave()


@contextlib.contextmanager
def lockstep(n: int, clock: Any, cores: tuple[set[int], set[int]]) -> Iterator[Store]:
    """A store whose n participants each are a Python process that writes a record in every cycle.

    cores: those of the clock, and those of the participants.
    """
    names, page = tuple(f"part{k}" for k in range(n)), shared_page()
    with on_cores(cores[0]), Store.create(f"bench-lock-{os.getpid()}", clock=clock) as store:
        with on_cores(cores[1]):
            children = [child(participant, store.name, name, page) for name in names]
        try:
            if clock == "barrier":
                store.run_clock(wait_for=names)
            wait_until(lambda: sum(c.alive for c in store.components()) == n, "the participants")
            yield store
            page[STOP] = 1
            if clock == "stepped":
                store.tick()
            for process in children:
                process.join(3.0)
        finally:
            for process in children:
                process.kill()
                process.join()


def rates(n: int, clock: str, windows: int, cores: tuple[set[int], set[int]]) -> list[float]:
    """Ticks a second, of windows of 0.25 s: by C as soon as all are done, or by Python that waits for them."""
    found = []
    with lockstep(n, clock, cores) as store:
        for window in range(windows + 1):
            begun, cycle = time.perf_counter(), store.cycle
            if clock == "barrier":
                time.sleep(0.25)
            while clock == "stepped" and time.perf_counter() - begun < 0.25:
                if not store.wait_done(store.tick(), 5.0):
                    raise Lost("a participant did not finish its cycle in 5 s")
            if window:  # the first one warms up
                found.append((store.cycle - cycle) / (time.perf_counter() - begun))
    return found


def lockstep_rows(effort: Effort, core: Core) -> dict[str, Figure]:
    cores = sorted(os.sched_getaffinity(0))
    anywhere, first, last = set(cores), {cores[0]}, {cores[-1]}
    rows = {}
    for name, n, clock, places in (
        ("barrier-1", 1, "barrier", (anywhere, anywhere)),
        ("barrier-1-two", 1, "barrier", (first, last)),
        ("barrier-1-one", 1, "barrier", (last, last)),
        ("barrier-8", 8, "barrier", (anywhere, anywhere)),
        ("stepped-1", 1, "stepped", (anywhere, anywhere)),
        ("stepped-8", 8, "stepped", (anywhere, anywhere)),
    ):
        bare = 0.0
        if n == 1 and places[0] != anywhere:
            with on_cores(places[0] | places[1]):
                bare = statistics.median(core.run("pong", effort.windows)["pong"])
        found = rates(n, clock, effort.windows, places)
        median = statistics.median(found)
        rows[name] = Figure(max(found), median, bare, median / bare if bare else 0.0)
    return rows


# -- the table -------------------------------------------------------------------------------------------------------

SAME = 1.05  # "no slower", as well as it can be told
CLOCK = "monotonic_ns()"
STDLIB = "SharedMemory and Condition"
RATE = "ticks/s"
GROUPS: list[tuple[Group, list[Row]]] = [
    (c_rows, [
        Row("c-write", "C: write 64 B", "ns", target=300, beside="clock read"),
        Row("c-write-real", "C: the same in a real-time store", "ns", target=300, beside="clock read"),
        Row("c-read", "C: read the newest 64 B", "ns", target=120, beside="clock read"),
        Row("c-write-900", "C: write with 900 objects", "ns", beside="with 10 objects", at_most=SAME),
        Row("c-read-900", "C: read with 900 objects", "ns", beside="with 10 objects", at_most=SAME),
        Row("c-as-of", "C: as-of read, 10,000 deep", "ns", target=1000, beside="read the newest"),
        Row("c-insert", "C: insert with 900 objects alive", "us", target=20),
        Row("c-delete", "C: delete with 900 objects alive", "us"),
        Row("c-tick-64", "C: tick, 64 objects due, all written", "us", target=1),
        Row("c-tick-1000", "C: tick, 1,000 objects due, all written", "us", target=10),
        Row("c-frame-write", "C: write 300 KiB", "us", beside="memcpy to a ring"),
        Row("c-frame-read", "C: read 300 KiB", "us", beside="memcpy"),
        Row("c-view", "C: view of 300 KiB", "ns", target=1500, beside="clock read"),
    ]),
    (python_rows, [
        Row("py-write", "Python: write 64 B, raw", "us", target=0.4, beside=CLOCK),
        Row("py-read", "Python: read 64 B of a cut, raw", "us", target=0.3, beside=CLOCK),
        Row("py-latest", "Python: read the newest 64 B, raw", "us", target=0.3, beside=CLOCK),
        Row("py-record-write", "Python: write a record of 12 fields", "us", target=1.2, beside=CLOCK),
        Row("py-record-read", "Python: read it", "us", target=1.0, beside=CLOCK),
        Row("py-as-of", "Python: as-of, 10,000 deep: which write", "us", target=1.0, beside=CLOCK),
        Row("py-record-as-of", "Python: as-of, 10,000 deep: the record", "us", beside=CLOCK),
        Row("py-view", "Python: view of 300 KiB, its memory", "us", target=1.5, beside=CLOCK),
        Row("py-view-array", "Python: view of 300 KiB, its array", "us", target=1.5, beside=CLOCK),
    ]),
    (notify_rows, [
        Row("futex", "bare futex ping, C to C", "us"),
        Row("c-notify", "notify, C to C", "us", beside="futex ping"),
        Row("py-notify", "notify, Python to Python", "us", beside="futex ping", at_most=1.3),
    ]),
    (frame_rows, [
        Row("publish", "300 KiB from publish to used, Python to Python", "us", beside=STDLIB, at_most=0.65),
        Row("publish-image", "the same as a record with an image", "us", beside=STDLIB),
    ]),
    (lockstep_rows, [
        Row("barrier-1", "lockstep, one Python participant", RATE, target=30_000),
        Row("barrier-1-two", "lockstep, one, not on the clock's core", RATE, beside="futex ping-pong, two cores"),
        Row("barrier-1-one", "lockstep, one, on the clock's core", RATE, beside="futex ping-pong, one core"),
        Row("barrier-8", "lockstep, eight", RATE, target=4_000),
        Row("stepped-1", "lockstep ticked from Python, one", RATE),
        Row("stepped-8", "lockstep ticked from Python, eight", RATE),
    ]),
    (peer_rows, [
        Row(f"peer-{peer}", f"64 B from write to reader, Python to Python: {peer}", "us",
            beside="" if peer == "rtdb" else "rtdb")
        for peer in PEERS
    ]),
]  # fmt: skip
ROWS = [row for _, rows in GROUPS for row in rows]
Figures = dict[str, dict[str, Figure]]  # policy, row


@contextlib.contextmanager
def scheduling(policy: str) -> Iterator[None]:
    """Run what is begun in it, children too, under SCHED_FIFO with CPUs that stay awake, or as usual."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    with contextlib.ExitStack() as stack:
        if policy == "FIFO":
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
            stack.callback(os.sched_setscheduler, 0, *before)
            with contextlib.suppress(OSError):
                latency = os.open(LATENCY, os.O_WRONLY)
                stack.callback(os.close, latency)
                os.write(latency, bytes(4))
        yield


def may_fifo() -> str:
    """Say why there is no SCHED_FIFO here; empty if there is."""
    try:
        with scheduling("FIFO"):
            return ""
    except PermissionError as error:
        return f"SCHED_FIFO: {error.strerror}; run as root, or allow it: `ulimit -r {PRIORITY}`"


def measure(wanted: set[str], policies: list[str], effort: Effort, core: Core) -> Figures:
    """Measure the groups of the wanted rows; each under all policies before the next."""
    figures: Figures = {policy: {} for policy in policies}
    for group, rows in GROUPS:
        for policy in policies if wanted & {row.name for row in rows} else ():
            print(f"{group.__name__} {policy} ...", file=sys.stderr)
            with scheduling(policy):
                figures[policy] |= group(effort, core)
    return figures


# -- Table II --------------------------------------------------------------------------------------------------------

OPERATIONS = ("insert", "delete", "read", "write", "notify")
Table = dict[str, dict[str, dict[str, list[float]]]]  # policy, load, operation -> average, minimum, maximum in us


@contextlib.contextmanager
def stress() -> Iterator[bool]:
    """Load the machine: every core, and its memory. False where there is no stress-ng."""
    if shutil.which("stress-ng") is None:
        yield False
        return
    command = ["stress-ng", "--cpu", str(os.cpu_count()), "--vm", "1", "--vm-bytes", "256M", "--timeout", "120", "-q"]
    process = subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        time.sleep(1.0)
        yield True
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGTERM)
        try:
            process.wait(10.0)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def table_ii(policies: list[str], effort: Effort, core: Core) -> Table:
    """Time single calls of the C interface as the paper does."""
    table: Table = {policy: {} for policy in policies}
    for load, context in (("idle", contextlib.nullcontext(True)), ("loaded", stress())):
        with context as there:
            if not there:
                print("stress-ng is not installed; apt-get install stress-ng", file=sys.stderr)
                continue
            for policy in policies:
                print(f"Table II {load} {policy} ...", file=sys.stderr)
                with scheduling(policy):
                    table[policy][load] = core.run("table", effort.singles)
    return table


# -- what is printed -------------------------------------------------------------------------------------------------


def number(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def speed_table(wanted: set[str], figures: Figures) -> list[list[str]]:
    """Give the header and a line for each wanted row."""
    policies = list(figures)
    header = ["quantity", "wanted"]
    header += [f"{policy} {column}" for policy in policies for column in ("best", "median", "met")]
    lines = [[*header, "beside it, median: times that"]]
    for row in ROWS:
        found = [figures[policy].get(row.name) for policy in policies]
        if row.name not in wanted:
            continue
        why = missing(row.name.removeprefix("peer-")) if row.name.startswith("peer-") else ""
        line = [f"{row.what} [{row.unit}]", row.goal]
        for one in found:
            line += [why or "lost", "", ""] if one is None else [number(one.best), number(one.median), row.met(one)]
        beside = [f"{number(one.yardstick)}: {one.ratio:.2f}" for one in found if one is not None and one.ratio]
        lines.append([*line, f"{row.beside} {' / '.join(beside)}" if beside and row.beside else ""])
    return lines


def paper_table(loads: dict[str, dict[str, list[float]]]) -> list[list[str]]:
    """Give the header and a line for each operation."""
    lines = [["us", *(f"{load} {column}" for load in loads for column in ("average", "minimum", "maximum"))]]
    for name in OPERATIONS:
        lines.append([name, *(number(us) for load in loads.values() for us in load[name])])
    return lines


def aligned(lines: list[list[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(map(str.ljust, line, widths)).rstrip() for line in lines)


def markdown(lines: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in [lines[0], ["---"] * len(lines[0]), *lines[1:]])


def machine() -> str:
    """Say what kind of machine this is, and nothing that names it."""
    info = Path("/proc/cpuinfo").read_text()
    model = re.search(r"model name\s*: (.*)", info)
    kind = "virtual " if re.search(r"^flags.*\bhypervisor\b", info, re.MULTILINE) else ""
    return (
        f"{os.cpu_count()} {kind}cores, {model[1].strip() if model else platform.machine()}; "
        f"Linux {platform.release().partition('-')[0]}; Python {platform.python_version()}; "
        f"load average {os.getloadavg()[0]:.1f} when the run began"
    )


def document(where: str, figures: Figures, table: Table, refused: str) -> str:
    """Make docs/rtdb-speed.md."""
    judged = [(row, row.met(figures["plain"][row.name])) for row in ROWS if row.name in figures["plain"]]
    missed = "; ".join(row.what for row, met in judged if met not in {"", "yes"})
    papers = "\n\n".join(
        f"{'SCHED_FIFO' if policy == 'FIFO' else 'As any process'}:\n\n{markdown(paper_table(loads))}"
        for policy, loads in table.items()
        if loads
    )
    return f"""# How fast the store is

This page is generated; change `benchmarks/rtdb.py`, then run

    python benchmarks/rtdb.py --write

Measured on: {where}.{f" {refused}." if refused else ""}

How to read it: minima, medians and ratios are figures of the program; they were taken in one run, what is compared in
turn, round by round. Maxima are figures of the machine, and those of a virtual machine say nothing about a cart: it
loses its processors to others for milliseconds, SCHED_FIFO or not. "best" is the minimum of a time and the maximum of a
rate; "met" judges the median, and says "at best" where only the best figure meets what is wanted. Ratios are of
medians. "FIFO" is SCHED_FIFO at priority {PRIORITY}, with CPUs that stay awake.

## Speed

{markdown(speed_table({row.name for row in ROWS}, figures))}

{f"Not met as any process, by the median: {missed}." if missed else "All that is wanted is met."}

C calls of less than a microsecond are timed in batches of 1,000, Python calls too. A ping is a write of 64 bytes every
0.4 ms to a reader in another process, which sleeps by then. Both are held on cores of their own, here and for all that
pings are compared with: a wake-up on the waker's core takes a fifth of the time, and where the system puts a process is
chance. That chance is in the figures of lockstep that name no core. Frames are published every 5 ms, and "used" when
the reader has touched each of their cache lines. Eight participants on fewer cores take turns.

## Table II of the KogMo-RTDB paper

Single calls of the C interface, 64 bytes, each timed by itself, with the clock's own 25 ns; notify is from before the
write until the reader in another process runs. Loaded: `stress-ng` with a worker for every core and one that fills
memory.

{papers}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer rounds: to see whether it works")
    parser.add_argument("--fifo", action="store_true", help="measure once more under SCHED_FIFO")
    parser.add_argument("--only", metavar="ROW,...", help=f"of {', '.join(row.name for row in ROWS)}")
    parser.add_argument("--table", action="store_true", help="Table II of the paper, idle and under stress-ng")
    parser.add_argument("--write", action="store_true", help=f"all of it, into {PAGE.relative_to(ROOT)}")
    args = parser.parse_args()
    names = {row.name for row in ROWS}
    wanted = set(args.only.split(",")) if args.only else set() if args.table and not args.write else names
    if not wanted <= names or (args.write and args.only):
        parser.error(f"no row {', '.join(wanted - names)}" if not args.write else "--write writes all rows")
    effort, where, refused = QUICK if args.quick else Effort(), machine(), ""
    policies = ["plain"]
    if args.fifo or args.write:
        refused = may_fifo()
        policies += [] if refused else ["FIFO"]
        print(refused, end="\n" if refused else "", file=sys.stderr)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that everything is given back
    try:
        with tempfile.TemporaryDirectory() as folder:
            core = Core(Path(folder))
            figures = measure(wanted, policies, effort, core)
            table = table_ii(policies, effort, core) if args.table or args.write else {}
    finally:
        for left in Path("/dev/shm").glob(f"fairway-*-bench-*-{os.getpid()}*"):  # of what was killed
            left.unlink(missing_ok=True)
    print(where)
    print(aligned(speed_table(wanted, figures)) if wanted else "")
    for policy, loads in table.items():
        print(f"\nTable II, {policy}\n{aligned(paper_table(loads))}" if loads else "")
    if args.write:
        PAGE.write_text(document(where, figures, table, refused))


if __name__ == "__main__":
    main()
