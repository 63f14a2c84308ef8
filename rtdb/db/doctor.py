"""What `fairway db doctor` finds: segments that nobody needs, stores that do not go on, files that shadow others.

A finding says what, where, and what to do. Everything but the last two functions is computed from looks.
"""

import importlib.machinery
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..clock import Kind
from ..components import ComponentInfo
from ..errors import RtdbError
from ..objects import Flag
from .look import HEALTH, Look, look
from .segments import FOLDER, Segment, segments

if TYPE_CHECKING:
    from ..store import Store

NEARLY_FULL = 0.9  # of a store's memory
SCARCE_BYTES = 16 << 20  # of /dev/shm: a store takes all of its memory when it is created
PATIENCE_S = 1.0  # of the host's time, in which a barrier's cycle should have ended


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that is not as it should be."""

    what: str
    where: str
    todo: str

    def __str__(self) -> str:
        return f"{self.what}, {self.where}, {self.todo}"


# -- segments ---------------------------------------------------------------------------------------------------------


def state_of(segment: Segment) -> str:
    """Say in a word or two what a segment is."""
    if segment.half_made:
        return "being made" if segment.lives else "half made"
    if segment.layout is None:
        return "no store"
    return "living" if segment.lives else "stale"


def of_segments(found: Sequence[Segment]) -> Iterator[Finding]:
    """Find what crashes left behind, and what is no store."""
    for segment in found:
        size, age = f"{segment.size / 2**20:.1f} MiB", f"made {span(time.time() - segment.t_made_s)} ago"
        held = ", ".join(map(str, segment.holders))
        clean = f"remove it: `fairway db doctor --db {segment.name} --clean`"
        state = state_of(segment)
        if state == "half made":
            yield Finding("half-made store of a killed process", f"{segment.path} ({size}, {age})", clean)
        elif state == "stale":
            yield Finding("stale store that a crash left", f"{segment.path} ({size}, {age})", clean)
        elif state == "no store" and segment.lives:
            yield Finding("damaged store, or none", f"{segment.path} (held by {held})", "end these processes")
        elif state == "no store":
            yield Finding("damaged store, or none", f"{segment.path} ({size}, {age})", clean)


def unattachable(segment: Segment, why: RtdbError) -> Finding:
    """Make the finding of a store that lives and cannot be attached to."""
    held = ", ".join(map(str, segment.holders)) or "a process of somebody else"
    return Finding(
        f"store of another version of Fairway (layout {segment.layout}), or damaged",
        f"{segment.path} (held by {held}; {why})",
        "end these processes and start them anew, all from one installation",
    )


def span(seconds: float) -> str:
    """Spell out a time span in the unit that suits it."""
    for unit, length in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{max(0.0, seconds):.0f} s"


# -- stores -----------------------------------------------------------------------------------------------------------


def of_store(now: Look, *, stands_still: bool = False) -> Iterator[Finding]:
    """Find what is wrong in a store that one can attach to. stands_still: a barrier's cycle did not end for long."""
    yield from _of_clock(now, stands_still)
    yield from _of_components(now)
    yield from _of_objects(now)
    size, unused = now.memory
    if size - unused > NEARLY_FULL * size:
        yield Finding(
            "memory nearly full",
            f"store {now.name}: {(size - unused) / 2**20:.1f} of {size / 2**20:.1f} MiB",
            "create the store with a larger size, or insert with a shorter history_s",
        )


def _of_clock(now: Look, stands_still: bool) -> Iterator[Finding]:
    clock, where = now.clock, f"store {now.name}, cycle {now.cycle}"
    if not clock.alive and clock.kind is Kind.STEPPED:
        todo = f"its process {clock.pid} is gone; start it anew, or call `take_clock` in the process that shall tick"
        yield Finding("store without a clock", where, todo)
    elif not clock.alive:
        yield Finding("store without a clock", where, f"start one: `fairway db clock {now.name}`")
    elif clock.stalled:
        yield Finding(
            f"stalled clock, {clock.late_ns * 1e-9:.2f} s late",
            where,
            f"see what stopped process {clock.pid} (Ctrl-Z? a debugger?), or end it: a standby takes over",
        )
    elif clock.kind is not Kind.STEPPED and now.cycle == 0:
        yield Finding("clock that has not begun", where, f"start the components that process {clock.pid} waits for")
    elif stands_still:
        for info in (c.info for c in now.components if owes(c.info, now.cycle)):
            yield Finding(
                "barrier that does not open",
                where,
                f"see why component {info.name} (process {info.pid}) does not finish: it is done with {info.done}",
            )


def owes(info: ComponentInfo, cycle: int) -> bool:
    """Tell whether a barrier waits for a component: it was due up to this cycle, and is not done with it."""
    every = max(1, info.every)
    due = cycle - (cycle - info.phase) % every  # the latest cycle at which it was due
    return info.participant and info.alive and info.done < due


def _of_components(now: Look) -> Iterator[Finding]:
    for c in now.components:
        info = c.info
        held = [o.name for o in now.living if o.component == info.name and o.record != HEALTH]
        forsaken = [
            o.name
            for o in now.living
            if o.name in held and not o.flags & (Flag.STATIC | Flag.PERSISTENT | Flag.PUBLIC_WRITE)
        ]
        if not info.alive and forsaken:
            yield Finding(
                f"dead component that holds {len(held)} object{'s' if len(held) > 1 else ''}",
                f"{info.name} in store {now.name} (was process {info.pid}; {_some(held)})",
                "start it anew, it takes them over; or delete them: `fairway db rm`",
            )
        if info.alive and info.missed:
            yield Finding(
                f"{info.missed} missed cycles",
                f"{info.name} in store {now.name} (process {info.pid}, due every {info.every} ticks)",
                "do less in a step, or make it due less often; `fairway db top` shows how long its steps take",
            )


def _of_objects(now: Look) -> Iterator[Finding]:
    for obj in now.living:
        if obj.refused:
            yield Finding(
                f"{obj.refused} refused writes of {obj.head + obj.refused}",
                f"{obj.name} in store {now.name}",
                f"write it at most once in {obj.every * now.tick_ns / 1e6:g} ms, or insert it with a longer history_s",
            )
    for why in now.unreadable:
        yield Finding("object that cannot be read", f"store {now.name} ({why})", "mend the program that inserts it")


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


# -- files in the current folder --------------------------------------------------------------------------------------

OWN = ("rtdb", "hal", "sim", "autonomy", "scenarios")
OTHERS = (  # what our imports, and theirs, are called; tests/rtdb/test_doctor.py compares it with the imports
    "PIL", "attr", "attrs", "click", "cloudpickle", "contourpy", "cv2", "cycler", "dateutil", "farama_notifications",
    "filterpy", "fontTools", "google", "gymnasium", "kiwisolver", "lz4", "matplotlib", "mcap", "msgspec", "numpy",
    "packaging", "pyarrow", "pybullet", "pybullet_data", "pydantic", "pydantic_core", "pygeomag", "pygments",
    "pyparsing", "pytest", "rerun", "rich", "ruamel", "scipy", "shellingham", "six", "stable_baselines3", "torch",
    "typer", "typing_extensions", "typing_inspection", "annotated_types", "uvloop", "zstandard",
)  # fmt: skip


def of_folder(folder: Path) -> Iterator[Finding]:
    """Find Python files that are imported in place of what Fairway needs, where programs start from this folder."""
    for path in sorted(folder.glob("*.py")):
        name = path.stem
        if name in OWN:
            whose = "Fairway's own package"
        elif name in OTHERS:
            whose = "the package"
        elif name in sys.stdlib_module_names and not _is_there_first(name):
            whose = "Python's module"
        else:
            continue
        todo = f"rename it: mv {path.name} my_{path.name}"
        yield Finding(f"file that shadows {whose} {name}", str(path), todo)


def _is_there_first(module: str) -> bool:
    """Tell whether a module is part of the interpreter, so that no file is taken in its place."""
    return module in sys.builtin_module_names or importlib.machinery.FrozenImporter.find_spec(module) is not None


# -- everything -------------------------------------------------------------------------------------------------------


def examine(pattern: str, folder: Path) -> tuple[list[Segment], list[Finding]]:
    """Examine the segments whose stores fit a pattern, and a folder."""
    from ..store import Store

    found = segments(pattern)
    findings = list(of_segments(found))
    for segment in found:
        if state_of(segment) != "living":
            continue
        try:
            with Store.attach(segment.name) as store:
                findings += of_store(look(store), stands_still=_stands_still(store))
        except FileNotFoundError:  # it ended while we looked
            continue
        except RtdbError as error:
            findings.append(unattachable(segment, error))
    free = shutil.disk_usage(FOLDER).free
    if free < SCARCE_BYTES:
        findings.append(
            Finding(f"only {free / 2**20:.1f} MiB left for stores", str(FOLDER), "end stores, or make it larger")
        )
    return found, [*findings, *of_folder(folder)]


def _stands_still(store: "Store") -> bool:
    clock = store.clock
    waits = clock.kind is Kind.BARRIER and clock.alive and clock.cycle > 0
    return waits and store.wait_cycle(clock.cycle, PATIENCE_S) is None
