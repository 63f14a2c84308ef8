"""What `fairway db top` shows: rates, ages and deaths, computed from two looks at a store."""

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..clock import ClockInfo, Kind
from .console import table
from .look import HEALTH, ComponentLook, Look, ObjectLook, look
from .segments import holders, segment_path

if TYPE_CHECKING:
    from rich.console import RenderableType

    from ..store import Store

_KINDS = {Kind.STEPPED: "stepped", Kind.BARRIER: "barrier", Kind.REAL: "real-time"}


@dataclass(frozen=True, slots=True)
class ComponentRow:
    """One component; `run` and `late`: median and 99th percentile of its steps, since it joined."""

    name: str
    pid: int
    state: str
    version: str
    steps: int | None
    missed: int
    run: str
    late: str
    status: str


@dataclass(frozen=True, slots=True)
class ObjectRow:
    """One object; `per_store_s`, `per_host_s`: writes per second since the earlier look; None where there is none."""

    name: str
    record: str
    edge: str
    writes: int
    per_store_s: float | None
    per_host_s: float | None
    jitter_ns: int | None
    age_s: float | None
    refused: int
    owner: str


# -- pure -------------------------------------------------------------------------------------------------------------


def component_rows(now: Look) -> list[ComponentRow]:
    """Give a row for each component, by name."""
    return [_component_row(c) for c in sorted(now.components, key=lambda c: c.info.name)]


def _component_row(seen: ComponentLook) -> ComponentRow:
    info, health = seen.info, seen.health or {}
    state = str(health.get("state", "UNKNOWN")).lower() if info.alive else "dead"
    return ComponentRow(
        name=info.name,
        pid=info.pid,
        state="alive" if state == "unknown" else state,
        version=info.version,
        steps=health.get("steps"),
        missed=info.missed,
        run=spread(health.get("run_us", ())),
        late=spread(health.get("lateness_us", ())),
        status=health.get("status", ""),
    )


def object_rows(before: Look | None, now: Look) -> list[ObjectRow]:
    """Give a row for each object that is not deleted, by name; what health says stands with the components."""
    earlier = {o.oid: o for o in before.objects} if before is not None else {}
    return [_object_row(earlier.get(o.oid), o, before, now) for o in now.living if o.record != HEALTH]


def _object_row(old: ObjectLook | None, obj: ObjectLook, before: Look | None, now: Look) -> ObjectRow:
    n = obj.head - old.head if old is not None else None
    return ObjectRow(
        name=obj.name,
        record=obj.record,
        edge=f"{obj.every}/{obj.phase}",
        writes=obj.head,
        per_store_s=rate(n, now.now_ns - before.now_ns) if before is not None else None,
        per_host_s=rate(n, now.host_ns - before.host_ns) if before is not None else None,
        jitter_ns=jitter_ns([t for t in obj.commits_ns if before is not None and t > before.now_ns]),
        age_s=now.age_s(obj),
        refused=obj.refused,
        owner=obj.component + ("" if obj.component in now.alive else " (dead)"),
    )


def rate(n: int | None, span_ns: int) -> float | None:
    """Give events per second; None where nothing is known, or no time has passed."""
    return None if n is None or span_ns <= 0 else n / (span_ns * 1e-9)


def jitter_ns(stamps: Sequence[int]) -> int | None:
    """Give the longest interval less the shortest; None where there are not two of them."""
    intervals = [later - earlier for earlier, later in itertools.pairwise(stamps)]
    return max(intervals) - min(intervals) if len(intervals) > 1 else None


def quantile_us(bins: Sequence[int], q: float) -> int | None:
    """Give the upper end of the bin in which a quantile lies: bin k counts from 2^k us; None without any count."""
    wanted, so_far = q * sum(bins), 0
    for k, n in enumerate(bins):
        so_far += n
        if n and so_far >= wanted:
            return int(2 ** (k + 1))
    return None


def spread(bins: Sequence[int]) -> str:
    """Spell out median and 99th percentile of a histogram, as upper ends."""
    median, high = quantile_us(bins, 0.5), quantile_us(bins, 0.99)
    return "-" if median is None or high is None else f"{_us(median)} {_us(high)}"


def _us(us: int) -> str:
    return f"<{us} us" if us < 1024 else f"<{us / 1000:.0f} ms" if us < 1 << 20 else "0.5 s+"


def clock_words(clock: ClockInfo) -> str:
    """Say how the clock is."""
    if not clock.alive:
        return f"dead (was process {clock.pid})" if clock.cycle else "none yet"
    late = f" by {clock.late_ns * 1e-9:.2f} s" if clock.stalled else ""
    return f"{'stalled' if clock.stalled else 'alive'}{late} (process {clock.pid})"


def store_lines(now: Look) -> tuple[str, str]:
    """Say how a store and its clock are."""
    size, unused = now.memory
    used = f"{(size - unused) / 2**20:.1f} of {size / 2**20:.1f} MiB used"
    clock = [f"{_KINDS[now.clock.kind]} clock {clock_words(now.clock)}"]
    if now.clock.kind is Kind.REAL:
        clock += [f"late {spread(now.clock.lateness_us)}", f"skipped {now.clock.skipped}"]
    clock += [f"takeovers {now.clock.takeovers}"]
    return f"{now.name}: cycle {now.cycle}, tick {now.tick_ns / 1e6:g} ms, {used}", ", ".join(clock)


# -- shown ------------------------------------------------------------------------------------------------------------


def end_of(store: "Store") -> tuple[str, int] | None:
    """Say that a store has come to its end, and give the exit status for that; None while it goes on.

    Tools that look do not keep it alive: it ends when nobody ticks it, no component lives, and its name is gone. Where
    its creator was killed the name stays, and it ends when only tools have it open: they would keep the name taken.
    """
    name = store.name or ""
    if store.clock.alive or any(info.alive for info in store.components()):
        return None
    if not store.bears_name:
        return f"store {name!r} has ended, after cycle {store.cycle}", 0
    stat = segment_path(name).stat()
    if not all(process.only_looks for process in holders().get((stat.st_dev, stat.st_ino), ())):
        return None
    return f"store {name!r} was left by a crash in cycle {store.cycle}; nobody else is attached", 3


def looks(store: "Store", period_s: float, rounds: int | None) -> Iterator[tuple[Look, Look]]:
    """Look at a store again and again, with a period of the host's time; yields the look before and the new one."""
    before, k = look(store), 0
    while rounds is None or k < rounds:
        time.sleep(period_s)  # of the host: the store's own time may stand still, which is what one wants to see
        if not store.clock.alive:
            store.core.mark_dead()  # nobody else does, without a clock
        now = look(store)
        yield before, now
        before, k = now, k + 1


def shown(before: Look | None, now: Look) -> "RenderableType":
    """Make the tables of one round."""
    from rich.console import Group
    from rich.text import Text

    dead = "bold red"
    style = {"dead": dead, "failure": dead, "warning": "yellow"}
    well = now.clock.alive and not now.clock.stalled
    components = table(
        ("component", "pid>", "state", "steps>", "missed>", "run p50 p99", "late p50 p99", "version", "status")
    )
    for c in component_rows(now):
        components.add_row(
            c.name, str(c.pid), c.state, "-" if c.steps is None else str(c.steps), str(c.missed), c.run, c.late,
            c.version, c.status, style=style.get(c.state, ""),
        )  # fmt: skip
    objects = table(
        ("object", "record", "edge", "writes>", "1/s>", "1/s host>", "jitter>", "age>", "refused>", "owner")
    )
    for o in object_rows(before, now):
        objects.add_row(
            o.name, o.record, o.edge, str(o.writes), _number(o.per_store_s), _number(o.per_host_s),
            "-" if o.jitter_ns is None else f"{o.jitter_ns / 1e6:.1f} ms",
            "-" if o.age_s is None else f"{o.age_s:.2f} s", str(o.refused), o.owner,
            style=dead if o.owner.endswith("(dead)") else "",
        )  # fmt: skip
    unreadable = [Text(f"unreadable: {why}", style=dead) for why in now.unreadable]
    store, clock = store_lines(now)
    lines = Text(store, style="bold"), Text(clock, style="" if well else dead), Text()
    return Group(*lines, components, Text(), objects, *unreadable)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"
