"""Play: a capture of a real GPS receiver through transport, driver, database and the localiser of the reference stack.

The localiser is the one that drives the cart, unchanged; it has no wheels and no course here, so it follows the fixes.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from autonomy.host import Host
from autonomy.wiring import load_stack
from hal.capture import read_capture
from hal.drivers.gps import GpsDriver
from hal.host import GpsHost
from hal.signals import GpsFix, Pose, Site
from rtdb import STATIC, Object, Store

from .scenario import STACKS

TICK_NS = 10_000_000
AFTER_NS = 1_000_000_000  # what still comes out after the last byte


def play(capture: Path, pace: float | None) -> Iterator[str]:
    """Play a capture; yields lines to print, one a fix and a summary."""
    arrivals = list(read_capture(capture))
    wire = next(w for w in load_stack(STACKS / "reference.json").wires if w.component == "localise")
    with Store.create(None, tick_ns=TICK_NS) as store:
        gps = GpsHost(store, GpsDriver())
        fix, site = (
            store.find("gps/fix", GpsFix),
            store.join("mission").insert("site", Site, flags=STATIC, history_s=0.1),
        )
        host = Host(store, replace(wire, inputs={"site": "mission/site", "gps": "gps/fix"}), seed=0)
        host.connect()
        pose = store.find("localise/pose", Pose)
        begun_s, end_ns, seen = time.monotonic(), arrivals[-1][0] + AFTER_NS, 0
        while store.now_ns < end_ns:
            cycle, t_ns = store.tick(), store.now_ns
            while arrivals and arrivals[0][0] <= t_ns:
                gps.driver.feed(arrivals.pop(0)[1], t_ns)
            gps.step(cycle, t_ns)
            host.step(cycle)
            sample = fix.visible(cycle)
            if sample is not None and sample.write > seen:
                seen = sample.write
                if sample.value.mode >= 2 and not site.head:
                    site.write(Site(capture.stem, sample.value.lat_rad, sample.value.lon_rad, sample.value.alt_m))
                yield _line(sample.value, pose, cycle)
            if pace is not None:
                time.sleep(max(0.0, begun_s + t_ns * 1e-9 / pace - time.monotonic()))
        yield from _summary(gps, store, pose)


def _line(fix: GpsFix, pose: Object[Pose], cycle: int) -> str:
    hours, rest = divmod(max(fix.time_of_day_s, 0.0), 3600)
    clock = f"{hours:02.0f}:{rest // 60:02.0f}:{rest % 60:06.3f}" if fix.time_of_day_s >= 0 else "time unknown"
    if fix.mode < 2:
        return f"{clock}  no fix"
    estimate = pose.visible(cycle)
    where = ""
    if estimate is not None:
        x_m, y_m, sigma_m = estimate.value.x_m, estimate.value.y_m, estimate.value.sigma_m
        where = f"  estimate east {x_m:.2f} m, north {y_m:.2f} m, sigma {sigma_m:.2f} m"
    altitude = f" {fix.alt_m:.1f} m" if fix.mode == 3 else ""
    return f"{clock}  {fix.mode}D {math.degrees(fix.lat_rad):.7f} {math.degrees(fix.lon_rad):.7f}{altitude}{where}"


def _summary(gps: GpsHost, store: Store, pose: Object[Pose]) -> Iterator[str]:
    counters = gps.driver.counters
    yield (
        f"{gps.driver.epochs} epochs from {counters.received} good sentences; {counters.damaged} damaged, not decoded; "
        f"{gps.driver.late} late"
    )
    last = pose.visible(store.cycle)
    if last is None:
        yield "the localiser never had a fix to begin with"
    else:
        yield (
            f"localiser, relative to the first fix: east {last.value.x_m:.2f} m, north {last.value.y_m:.2f} m, "
            f"sigma {last.value.sigma_m:.2f} m"
        )
