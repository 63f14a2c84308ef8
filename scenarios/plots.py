"""Plots: what a recording shows, as PNG files in the folder of a run. They see records, never a simulator.

Every plot draws what the recording holds and leaves out the rest: a field drive has no truth. The same recording gives
the same files on one machine class: no dates, and matplotlib's own style, whatever the user has configured.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar

from hal.signals import (
    ActorsTruth,
    ActuatorCommand,
    CartTruth,
    Clearance,
    Course,
    DriveCommand,
    FaultEvent,
    FollowState,
    GpsFix,
    LocalPlane,
    ObstacleKind,
    Odometry,
    Pose,
    Scene,
    Site,
)
from rtdb.recording import Recorded, Recording
from rtdb.records import Record

from .metrics import Evidence

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from .judge import Finding, Result

R = TypeVar("R", bound=Record)
XY = tuple[float, float]

NAMES = ("course.png", "speed.png", "error.png", "latency.png")
DPI = 110
NO_LIMITS: Mapping[str, float] = MappingProxyType({})
LEFT_IN, BOTTOM_IN, TOP_IN, LEGEND_IN = 0.75, 0.55, 0.35, 2.1
NO_POSE_M = 100.0  # a localiser that knows nothing yet says so with a sigma of this size
TRUE, ESTIMATE, WANTED, SENT, MEASURED, BAD = "#1b4f8c", "#e07b00", "#3a9b4b", "#7b3fa0", "#7a7a7a", "#c8102e"
KIND_COLOUR: dict[int, str] = {
    ObstacleKind.CAR: "#8d99ae",
    ObstacleKind.ISLAND: "#b7c9a8",
    ObstacleKind.KERB: "#c9c2b8",
    ObstacleKind.PERSON: "#c8102e",
    ObstacleKind.POST: "#5c4a3a",
    ObstacleKind.WALL: "#6b6b6b",
}


def write_plots(
    recording: Recording, folder: Path, result: "Result | None" = None, since: Mapping[str, float] | None = None
) -> list[Path]:
    """Write the plots of a recording; returns those that there was something to draw for.

    With a result, failed criteria are marked where and when they broke: at their worst, or at the time that `since`
    gives for the metric. Plots of an older run do not stay behind.
    """
    import matplotlib

    for name in NAMES:
        (folder / name).unlink(missing_ok=True)
    out = []
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        evidence = Evidence(recording)
        failed = [Mark.of(f, since or {}) for f in result.findings if f.verdict == "FAIL"] if result else []
        limits = {f.criterion.metric: f.criterion.limit for f in result.findings} if result else {}
        for name, figure in zip(
            NAMES,
            (
                course_figure(evidence, failed),
                speed_figure(evidence, failed),
                error_figure(evidence, failed, limits),
                latency_figure(evidence, failed, limits),
            ),
            strict=True,
        ):
            if figure is not None:
                figure.savefig(folder / name, dpi=DPI, metadata={"Software": None})
                out.append(folder / name)
    return out


@dataclass(frozen=True, slots=True)
class Mark:
    """A failed criterion, and when to show it."""

    metric: str
    at_s: float | None

    @classmethod
    def of(cls, finding: "Finding", since: Mapping[str, float]) -> "Mark":
        """Take the failed criterion; its place in time is where it began, else where it was worst."""
        metric = finding.criterion.metric
        return cls(metric, since.get(metric, finding.measured.at_s if finding.measured else None))


# -- the course, from above -------------------------------------------------------------------------------------------


def course_figure(e: Evidence, failed: Sequence[Mark] = ()) -> "Figure | None":
    """Draw the drive from above: course, scene, fixes, estimate with its ribbon, and the truth."""
    from matplotlib.collections import PolyCollection

    poses = _known(e)
    truth = [(row.value.x_m, row.value.y_m) for row in e.truth]
    waypoints = e.waypoints
    seen = truth + [(p.value.x_m, p.value.y_m) for p in poses] + [(x, y) for x, y, _ in waypoints]
    if not seen:
        return None
    figure, axes = _map(e, seen)
    axes.set_facecolor("#f6f6f3")
    _draw_scene(axes, e.recording)
    _draw_waypoints(axes, e, wanted=any(f.metric in ("waypoints_missed", "finish_time_s") for f in failed))
    fixes = _fixes(e.recording)
    if fixes:
        axes.plot(
            *zip(*fixes, strict=True), ".", color=MEASURED, markersize=2.2, alpha=0.7, label="GPS fixes (antenna)"
        )
    if poses:
        band = PolyCollection([_ribbon(poses)], color=ESTIMATE, alpha=0.28, linewidth=0, zorder=3)
        band.set_label("estimate, 2 sigma")
        axes.add_collection(band, autolim=False)
        axes.plot(
            [p.value.x_m for p in poses],
            [p.value.y_m for p in poses],
            color=ESTIMATE,
            linewidth=1.1,
            zorder=4,
            label="estimate",
        )
    if truth:
        axes.plot(*zip(*truth, strict=True), color=TRUE, linewidth=1.6, zorder=5, label="driven (true)")
    line = truth or [(p.value.x_m, p.value.y_m) for p in poses]
    if line:
        axes.plot(*line[0], "o", color=TRUE, markersize=6, zorder=6, label="start")
        _draw_arrows(axes, line)
    _draw_actors(axes, e.recording)
    _mark_places(axes, e, failed)
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
    axes.grid(True, color="white", linewidth=1.0, zorder=0)
    axes.set_axisbelow(True)
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0.0, fontsize=8, frameon=False)
    return figure


def _map(e: Evidence, seen: Sequence[XY]) -> "tuple[Figure, Axes]":
    """Make a figure in the shape of the drive with room around it, at the same scale in both directions."""
    from matplotlib.figure import Figure

    room_m = max([3.0, *(radius_m for *_, radius_m in e.waypoints)]) + 2.0
    low_x, high_x = min(x for x, _ in seen) - room_m, max(x for x, _ in seen) + room_m
    low_y, high_y = min(y for _, y in seen) - room_m, max(y for _, y in seen) + room_m
    wide_in = min(6.4, max(6.4 * (high_x - low_x) / (high_y - low_y), 2.6))
    high_in = min(max(wide_in * (high_y - low_y) / (high_x - low_x), 2.2), 6.4)
    scale = max((high_x - low_x) / wide_in, (high_y - low_y) / high_in)  # metres per inch
    size = (LEFT_IN + wide_in + LEGEND_IN, BOTTOM_IN + high_in + TOP_IN)
    figure = Figure(figsize=size)
    axes = figure.add_axes((LEFT_IN / size[0], BOTTOM_IN / size[1], wide_in / size[0], high_in / size[1]))
    mid_x, mid_y = (low_x + high_x) / 2, (low_y + high_y) / 2
    axes.set_xlim(mid_x - scale * wide_in / 2, mid_x + scale * wide_in / 2)
    axes.set_ylim(mid_y - scale * high_in / 2, mid_y + scale * high_in / 2)
    axes.set_title(_title(e), fontsize=10, loc="left")
    return figure, axes


def _draw_scene(axes: "Axes", recording: Recording) -> None:
    from matplotlib.collections import PolyCollection
    from matplotlib.path import Path as Path2D

    rows = recording.find("world/scene", Scene)
    if not rows:
        return
    scene = rows[0].value
    if scene.boundary_x_m:
        corners = list(zip(scene.boundary_x_m, scene.boundary_y_m, strict=True))
        seen = Path2D([*corners, corners[0]]).intersects_bbox(axes.viewLim, filled=False)
        axes.plot(
            *zip(*corners, corners[0], strict=True),
            color="#999999",
            linewidth=1.2,
            linestyle=(0, (6, 3)),
            label="edge of the area" if seen else None,
        )
    (low_x, high_x), (low_y, high_y) = axes.get_xlim(), axes.get_ylim()
    by_kind: dict[int, list[list[XY]]] = {}
    boxes = zip(scene.kind, scene.x_m, scene.y_m, scene.yaw_rad, scene.length_m, scene.width_m, strict=True)
    for kind, x_m, y_m, yaw_rad, length_m, width_m in boxes:
        half_m = math.hypot(length_m, width_m) / 2
        if low_x < x_m + half_m and x_m - half_m < high_x and low_y < y_m + half_m and y_m - half_m < high_y:
            by_kind.setdefault(kind, []).append(_box(x_m, y_m, yaw_rad, length_m, width_m))
    for number, outlines in sorted(by_kind.items()):
        axes.add_collection(
            PolyCollection(
                outlines,
                facecolors=KIND_COLOUR.get(number, "#a58f72"),
                edgecolors="#444444",
                linewidths=0.5,
                zorder=2,
                label=_kind_name(number),
            )
        )


def _box(x_m: float, y_m: float, yaw_rad: float, length_m: float, width_m: float) -> list[XY]:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    corners = ((1, 1), (1, -1), (-1, -1), (-1, 1))
    return [
        (x_m + (a * length_m * c - b * width_m * s) / 2, y_m + (a * length_m * s + b * width_m * c) / 2)
        for a, b in corners
    ]


def _kind_name(number: int) -> str:
    return next((kind.name.lower() for kind in ObstacleKind if kind == number), f"kind {number}")


def _draw_waypoints(axes: "Axes", e: Evidence, wanted: bool) -> None:
    """Draw the course with its target radii; `wanted`: a criterion asked for those that were not reached."""
    from matplotlib.patches import Circle

    plane, courses = _plane(e.recording), e.recording.find("mission/course", Course)
    if not e.waypoints or plane is None:
        return
    course = courses[0].value
    start = plane.to_map(course.start_lat_rad, course.start_lon_rad) if course.start_sigma_m > 0 else None
    line = [*([start] if start else []), *((x, y) for x, y, _ in e.waypoints)]
    axes.plot(
        *zip(*line, strict=True), color="#555555", linewidth=0.9, linestyle=(0, (4, 3)), zorder=2.5, label="course"
    )
    for k, (x, y, radius_m) in enumerate(e.waypoints):
        missed = bool(e.truth) and k >= len(e.reached_s)
        colour = WANTED if not missed else BAD if wanted else MEASURED
        first = k == (len(e.reached_s) if missed else 0)
        axes.add_patch(
            Circle(
                (x, y),
                radius_m,
                facecolor=colour,
                alpha=0.22,
                zorder=2.4,
                label=("not reached" if missed else "way-point") if first else None,
            )
        )
        axes.annotate(
            str(k + 1),
            (x + 0.75 * radius_m, y + 0.75 * radius_m),
            fontsize=8,
            color=colour,
            fontweight="bold",
            zorder=7,
        )


def _fixes(recording: Recording) -> list[XY]:
    plane = _plane(recording)
    if plane is None:
        return []
    return [
        plane.to_map(row.value.lat_rad, row.value.lon_rad)
        for row in recording.find("gps/fix", GpsFix)
        if row.value.mode >= 2
    ]


def _ribbon(poses: Sequence[Recorded[Pose]]) -> list[XY]:
    """Give the outline of the band of two standard deviations across the direction of travel."""
    left: list[XY] = []
    right: list[XY] = []
    for pose in poses:
        p, normal = pose.value, (-math.sin(pose.value.yaw_rad), math.cos(pose.value.yaw_rad))
        xx, xy, yy = p.covariance[0], p.covariance[1], p.covariance[4]
        variance = normal[0] ** 2 * xx + 2 * normal[0] * normal[1] * xy + normal[1] ** 2 * yy
        half_m = 2.0 * math.sqrt(max(variance, 0.0))
        left.append((p.x_m + half_m * normal[0], p.y_m + half_m * normal[1]))
        right.append((p.x_m - half_m * normal[0], p.y_m - half_m * normal[1]))
    return [*left, *reversed(right)]


def _draw_arrows(axes: "Axes", line: Sequence[XY]) -> None:
    """Show which way the cart went: an arrow head every so often along the line."""
    driven = [0.0]
    for a, b in pairwise(line):
        driven.append(driven[-1] + math.dist(a, b))
    heads = max(2, min(12, int(driven[-1] // 15)))
    k = 0
    for head in range(1, heads):
        while k < len(line) - 2 and driven[k] < driven[-1] * head / heads:
            k += 1
        far = next((j for j in range(k + 1, len(line)) if driven[j] - driven[k] > 0.3), None)
        if far is not None:
            axes.annotate(
                "",
                line[far],
                line[k],
                arrowprops={"arrowstyle": "-|>", "color": TRUE, "shrinkA": 0, "shrinkB": 0},
                zorder=6,
            )


def _draw_actors(axes: "Axes", recording: Recording) -> None:
    rows = recording.find("world/actors", ActorsTruth)
    for k in range(max((len(row.value.x_m) for row in rows), default=0)):
        walked = [(row.value.x_m[k], row.value.y_m[k]) for row in rows if len(row.value.x_m) > k]
        kinds = [row.value.kind[k] for row in rows if len(row.value.kind) > k]
        name = _kind_name(kinds[0]) if kinds else "actor"
        axes.plot(*zip(*walked, strict=True), ":", color=BAD, linewidth=1.5, zorder=5.5, label=f"{name} {k + 1} moves")
        axes.plot(*walked[-1], "D", color=BAD, markersize=5, zorder=5.5)


def _mark_places(axes: "Axes", e: Evidence, failed: Sequence[Mark]) -> None:
    """Put a cross where a criterion broke or the cart touched something."""
    marks = [(f.at_s, f"{f.metric}\nbroken, {f.at_s:.1f} s") for f in failed if f.at_s is not None]
    touched = next((row for row in e.recording.find("world/clearance", Clearance) if row.value.collided), None)
    if touched is not None and all(f.metric != "collisions" for f in failed):
        at_s = e.recording.time_s(touched.cycle)
        marks.append((at_s, f"contact, {at_s:.1f} s"))
    shapes = "XPsv^<>*"
    for k, (at_s, label) in enumerate(marks):
        place = _place(e, at_s)
        if place is not None:
            axes.plot(*place, shapes[k % len(shapes)], color=BAD, markersize=8, zorder=8, label=label, alpha=0.85)


def _place(e: Evidence, at_s: float) -> XY | None:
    """Give where the cart was at a time: in truth, or else as estimated."""
    rows: Sequence[Recorded[CartTruth] | Recorded[Pose]] = e.truth or _known(e)
    if not rows:
        return None
    row = min(rows, key=lambda row: abs(e.recording.time_s(row.cycle) - at_s))
    return row.value.x_m, row.value.y_m


# -- over time --------------------------------------------------------------------------------------------------------


def speed_figure(e: Evidence, failed: Sequence[Mark] = ()) -> "Figure | None":
    """Draw speeds over time: wanted, sent, measured, true."""
    styles: list[tuple[str, dict[str, Any], str, type[Record]]] = [
        ("measured by the wheels", {"color": MEASURED, "linewidth": 0.8}, "odometry/travel", Odometry),
        ("wanted by follow", {"color": WANTED, "linewidth": 1.8}, "follow/drive", DriveCommand),
        (
            "sent to the drive node",
            {"color": SENT, "linewidth": 1.0, "dashes": (4, 3)},
            "actuators/command",
            ActuatorCommand,
        ),
        ("true", {"color": TRUE, "linewidth": 1.4}, "world/cart", CartTruth),
    ]
    lines = [(label, style, _series(e.recording, topic, cls, "speed_mps")) for label, style, topic, cls in styles]
    if not any(points for *_, points in lines):
        return None
    figure, (axes,) = _over_time(f"speed: {_title(e)}", 2.4)
    for label, style, points in lines:
        if points:
            axes.plot(*zip(*points, strict=True), **style, label=label)
    axes.set_ylabel("speed [m/s]")
    speeds = ("mean_speed_mps", "final_speed_mps", "speed_at_fault_mps", "stop_distance_m", "decel_max_mps2")
    _time_axis(axes, e, [f for f in failed if f.metric in speeds])
    return figure


def error_figure(e: Evidence, failed: Sequence[Mark] = (), limits: Mapping[str, float] = NO_LIMITS) -> "Figure | None":
    """Draw errors over time: off the course as the cart believes, and of the estimate beside its sigma."""
    lateral, poses = _series(e.recording, "follow/state", FollowState, "lateral_error_m"), _known(e)
    if not lateral and not poses:
        return None
    figure, both = _over_time(f"errors: {_title(e)}", 1.9, rows=2)
    if lateral:
        both[0].axhline(0.0, color="#bbbbbb", linewidth=0.8)
        both[0].plot(
            *zip(*lateral, strict=True), color=TRUE, linewidth=1.2, label="off the course line,\nleft positive"
        )
    both[0].set_ylabel("lateral error [m]")
    _time_axis(both[0], e, [f for f in failed if "deviation" in f.metric or "lateral_rms" in f.metric])
    if poses:
        times = [e.recording.time_s(p.cycle) for p in poses]
        both[1].fill_between(
            times,
            [2 * p.value.sigma_m for p in poses],
            color=ESTIMATE,
            alpha=0.28,
            linewidth=0,
            label="2 sigma, as the\nlocaliser believes",
        )
    if e.pose_errors:
        both[1].plot(
            *zip(*e.pose_errors, strict=True), color=TRUE, linewidth=1.2, label="true distance\nfrom the estimate"
        )
    if "pose_error_max_m" in limits:
        _limit(both[1], limits["pose_error_max_m"])
    both[1].set_ylabel("position error [m]")
    both[1].set_ylim(bottom=0.0)
    _time_axis(both[1], e, [f for f in failed if f.metric.startswith("pose_error")])
    return figure


def latency_figure(
    e: Evidence, failed: Sequence[Mark] = (), limits: Mapping[str, float] = NO_LIMITS
) -> "Figure | None":
    """Draw how old the oldest sensor data behind each command was when it was sent, as `latency_max_s` counts it."""
    points = [
        (e.recording.time_s(row.cycle), (_sent_ns(e.recording, row.cycle) - row.t_data_ns) / 1e6)
        for row in e.recording.find("actuators/command", ActuatorCommand)
        if row.value.enable
    ]
    if not points:
        return None
    figure, (axes,) = _over_time(f"latency: {_title(e)}", 1.8)
    axes.plot(
        *zip(*points, strict=True),
        ".",
        color=TRUE,
        markersize=2.5,
        label="oldest sensor data\nbehind a command sent",
    )
    if "latency_max_s" in limits:
        _limit(axes, 1e3 * limits["latency_max_s"])
    axes.set_ylabel("latency [ms]")
    axes.set_ylim(bottom=0.0)
    _time_axis(axes, e, [f for f in failed if f.metric == "latency_max_s"])
    return figure


def _sent_ns(recording: Recording, cycle: int) -> int:
    return recording.t0_ns + (cycle - 1) * recording.tick_ns  # it shows one tick after it was sent


def _time_axis(axes: "Axes", e: Evidence, failed: Sequence[Mark]) -> None:
    """Label the axis of time; show the scenario's faults and when criteria broke."""
    end_s = e.recording.time_s(e.recording.last_cycle)
    begun: dict[str, float] = {}
    spans: list[tuple[str, float, float]] = []
    for row in e.recording.find("world/fault", FaultEvent):
        at_s = e.recording.time_s(row.cycle)
        if row.value.active:
            begun[row.value.kind] = at_s
        elif row.value.kind in begun:
            spans.append((row.value.kind, begun.pop(row.value.kind), at_s))
    spans += [(kind, at_s, end_s) for kind, at_s in begun.items()]
    for kind, from_s, to_s in spans:
        axes.axvspan(from_s, to_s, color=BAD, alpha=0.08, linewidth=0, label=f"fault: {kind}")
    for mark in failed:
        if mark.at_s is not None:
            axes.axvline(mark.at_s, color=BAD, linewidth=1.0, label=f"{mark.metric}\nbroken, {mark.at_s:.1f} s")
    axes.set_xlim(0.0, max(end_s, 0.1))
    axes.grid(True, color="#e6e6e6", linewidth=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0.0, fontsize=7.5, frameon=False)


def _limit(axes: "Axes", value: float) -> None:
    axes.axhline(value, color=BAD, linewidth=0.9, linestyle=(0, (5, 3)), label="limit")


# -- shared -----------------------------------------------------------------------------------------------------------


def _over_time(title: str, high_in: float, rows: int = 1) -> "tuple[Figure, list[Axes]]":
    """Make a figure with one plot over time, or several below each other."""
    from matplotlib.figure import Figure

    wide_in, gap_in = 5.6, 0.15
    size = (LEFT_IN + wide_in + LEGEND_IN, BOTTOM_IN + rows * high_in + (rows - 1) * gap_in + TOP_IN)
    figure = Figure(figsize=size)
    out = []
    for k in range(rows):
        low_in = BOTTOM_IN + (rows - 1 - k) * (high_in + gap_in)
        out.append(figure.add_axes((LEFT_IN / size[0], low_in / size[1], wide_in / size[0], high_in / size[1])))
        if k < rows - 1:
            out[k].tick_params(labelbottom=False)
    out[0].set_title(title, fontsize=10, loc="left")
    out[-1].set_xlabel("time [s]")
    return figure, out


def _title(e: Evidence) -> str:
    metadata = e.recording.metadata
    return f"{metadata.get('scenario', e.recording.path.name)}, seed {metadata.get('seed', '?')}"


def _plane(recording: Recording) -> LocalPlane | None:
    sites = recording.find("mission/site", Site)
    return LocalPlane.at(sites[0].value.lat_rad, sites[0].value.lon_rad) if sites else None


def _known(e: Evidence) -> list[Recorded[Pose]]:
    """Give the estimates of a localiser that knows where it is."""
    return [row for row in e.recording.find("localise/pose", Pose) if row.value.sigma_m < NO_POSE_M]


def _series(recording: Recording, topic: str, cls: type[R], field: str) -> list[tuple[float, float]]:
    rows: Iterable[Recorded[R]] = recording.find(topic, cls)
    return [(recording.time_s(row.cycle), getattr(row.value, field)) for row in rows]
