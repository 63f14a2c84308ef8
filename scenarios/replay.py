"""Replay: a recording, or a drive under way, as rerun shows it. Only this module and `shown` import rerun.

A recording stays the record; the .rrd is derived from it, column by column, and can be thrown away. Both ways in, the
finished recording and the running stores, become the same tables and go through the same builders:

    Recording --protobuf--> Table --\\
                                     >-- Builder --send_columns--> rerun
    Store     --C layout--> Table --/

Builders go by the name of the record, not of the topic, so a localiser under another name is drawn as well; and every
number, flag, enum and text of every topic becomes a plot or a lane under its component, known here or not.

What a colour means, everywhere: green is the truth, orange what the cart believes, blue what was wanted, cyan what a
sensor said. Entities: `scene` (in M), `signals/<topic>/<field>`, `states/<topic>/<field>`, `summary`, and
`texts/<topic>/<name>`: what modules show themselves, see shown.py.
"""

import contextlib
import json
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from http.client import HTTPConnection, HTTPException
from importlib.util import find_spec
from operator import attrgetter
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.urdf import UrdfTree

from hal.signals import FixQuality, LocalPlane, ObstacleKind
from rtdb import Store
from rtdb.json_object import is_json
from rtdb.recording import Channel, Recording
from rtdb.records import Field, Schema

from .judge import Result
from .metrics import METRICS
from .shown import ByModules

URDF = Path(__file__).with_name("cart.urdf")
TRAIL_S = 0.2  # length of one piece of a driven line
BODY_SIZE_M, BODY_CENTRE_M = (2.40, 1.20, 1.85), (0.80, 0.0, 0.925)  # outline of the cart about C, as in cart.urdf
PERSON_M = (0.5, 0.5, 1.75)
SCAN_HEIGHT_M = 0.6
FLUSH_S = 1.0
UP_S = 20.0  # how long a viewer may take until it listens

Colour = tuple[int, int, int]
Arrays = dict[str, Any]
TRUE, BELIEVED, WANTED, MEASURED, GREY = (72, 199, 116), (255, 152, 48), (98, 148, 255), (64, 208, 224), (130, 136, 148)
ALSO_WANTED, SCANNED, RED, YELLOW = (176, 132, 255), (255, 255, 255), (238, 78, 78), (246, 208, 80)
OBSTACLE_COLOUR: dict[int, Colour] = {
    ObstacleKind.BOX: (168, 128, 88),
    ObstacleKind.CAR: (120, 134, 166),
    ObstacleKind.POST: (206, 196, 150),
    ObstacleKind.ISLAND: (86, 124, 84),
    ObstacleKind.KERB: (150, 150, 146),
    ObstacleKind.PERSON: (240, 96, 160),
    ObstacleKind.WALL: (150, 110, 96),
}
FIX_COLOUR: dict[int, Colour] = {
    FixQuality.NONE: RED,
    FixQuality.AUTONOMOUS: YELLOW,
    FixQuality.RTK_FIXED: (150, 255, 240),
}
STATE_COLOUR: dict[str, Colour] = {
    **dict.fromkeys(("ENABLED", "RUNNING", "RTK_FIXED", "DIFFERENTIAL"), TRUE),
    **dict.fromkeys(("FAULT", "ESTOP", "NOT_FINITE", "OUTSIDE", "OBSTACLE", "active"), RED),
    **dict.fromkeys(("STOPPING", "STALE", "OVERRIDE", "NO_COMMAND", "UNCERTAIN", "AUTONOMOUS", "SPEED"), YELLOW),
    **dict.fromkeys(("READY", "WAITING", "MANUAL", "RTK_FLOAT", "LATERAL", "STEER", "yes"), WANTED),
    **dict.fromkeys(("NONE", "INIT", "no", "over"), (62, 66, 76)),
}
KEY = "Green is the truth, orange what the cart believes, blue what was wanted, cyan what sensors said."
# Plots of the first tab: title, then record, field, what it is called there, its colour.
PLOTS: tuple[tuple[str, tuple[tuple[str, str, str, Colour], ...]], ...] = (
    (
        "Speed, m/s",
        (
            ("DriveCommand", "speed_mps", "wanted", WANTED),
            ("Pose", "speed_mps", "believed", BELIEVED),
            ("CartTruth", "speed_mps", "true", TRUE),
        ),
    ),
    (
        "Steering, rad",
        (
            ("ActuatorCommand", "steer_rad", "commanded", WANTED),
            ("ActuatorState", "steer_rad", "reported", MEASURED),
            ("CartTruth", "steer_rad", "true", TRUE),
        ),
    ),
    (
        "Brake effort",
        (("ActuatorCommand", "brake", "commanded", WANTED), ("CartTruth", "brake", "true", TRUE)),
    ),
    ("Beside the course line, m", (("FollowState", "lateral_error_m", "left of it, as believed", BELIEVED),)),
    (
        "Position, m",
        (("Pose", "sigma_m", "sigma claimed", BELIEVED), ("Pose", "error_m", "true error", TRUE)),
    ),
    (
        "GPS sigma, m",
        (("GpsFix", "sigma_east_m", "east", MEASURED), ("GpsFix", "sigma_north_m", "north", WANTED)),
    ),
    ("Clearance, m", (("Clearance", "distance_m", "to the nearest thing", TRUE),)),
    ("Latency of commands, s", (("ActuatorCommand", "latency_s", "since the oldest sensor data", MEASURED),)),
)
LANES = (
    ("SafetyState", "state"),
    ("ActuatorCommand", "limit"),
    ("GuardState", "hold"),
    ("ModuleStatus", "state"),
    ("GpsFix", "quality"),
    ("FaultEvent", ""),
)


ALL_TIME = rrb.TimeAxis(
    view_range=rr.TimeRange(start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite())
)


class ViewerFailed(ChildProcessError):
    """The viewer's process ended, or did not listen in time."""


# -- tables -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Table:
    """Writes of one topic by columns: arrays (n,) or (n, k), a list of n arrays for a seq, of n strings for a text."""

    topic: str
    schema: Schema
    cycle: Any
    t_data_ns: Any
    columns: Arrays

    @property
    def component(self) -> str:
        """Who wrote it."""
        return self.topic.partition("/")[0]

    def rows(self, mask: Any) -> Arrays:
        """Give the scalar columns of some rows."""
        return {name: column[mask] for name, column in self.columns.items() if isinstance(column, np.ndarray)}


def read_table(channel: Channel) -> Table:
    """Read a recorded channel by columns: each message is parsed once."""
    from google.protobuf import descriptor_pool, message_factory
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    pool = descriptor_pool.DescriptorPool()
    for file in FileDescriptorSet.FromString(channel.descriptors).file:
        pool.Add(file)
    parse = message_factory.GetMessageClass(pool.FindMessageTypeByName(f"fairway.{channel.schema.name}")).FromString
    messages = [parse(raw.data) for raw in channel.raw]
    columns: Arrays = {}
    for f in channel.schema.fields:
        values = list(map(attrgetter(f.name), messages))
        if f.spec.shape == "seq":
            columns[f.name] = [np.array(value[:]) for value in values]
        elif f.spec.shape == "array":
            columns[f.name] = np.array([value[:] for value in values]).reshape(len(values), -1)
        else:
            columns[f.name] = values if f.spec.kind == "str" else np.array(values)
    cycle = np.array([raw.cycle for raw in channel.raw], np.int64)
    return Table(channel.topic, channel.schema, cycle, np.array([r.t_data_ns for r in channel.raw], np.int64), columns)


def stack_table(topic: str, schema: Schema, rows: list[tuple[int, int, bytes]]) -> Table:
    """Make a table of (cycle, data time, payload in the C layout) rows."""
    data = np.frombuffer(b"".join(row[2] for row in rows), dtype=schema.dtype())
    columns: Arrays = {}
    for f in schema.fields:
        column = data[f.name]
        if f.spec.kind == "str":
            columns[f.name] = [text.decode() for text in column.tolist()]
        elif f.spec.shape == "seq":
            columns[f.name] = [values[:n] for values, n in zip(column, data[f"{f.name}_n"], strict=True)]
        else:
            columns[f.name] = column
    return Table(
        topic, schema, np.array([r[0] for r in rows], np.int64), np.array([r[1] for r in rows], np.int64), columns
    )


# -- builders ---------------------------------------------------------------------------------------------------------


@dataclass
class _Shown:
    """What has been sent so far, for the blueprint: paths of plots and lanes, trails, and where the scene is."""

    plots: dict[tuple[str, str], list[tuple[str, str, str]]] = field(default_factory=dict)  # topic, record: unit...
    lanes: dict[tuple[str, str], list[tuple[str, str]]] = field(default_factory=dict)  # topic, record: field, path
    trails: list[str] = field(default_factory=list)
    texts: dict[str, list[str]] = field(default_factory=dict)  # component: paths
    cart: str = ""  # what the close view follows
    low: Any = None  # corners of the rectangle around course and driven lines
    high: Any = None

    @property
    def size(self) -> int:
        """How much the blueprint has to show; changes when something comes."""
        return len(self.plots) + len(self.lanes) + len(self.trails) + len(self.texts)


class Builder:
    """Sends tables to a rerun stream. Feed it once with all rows, or again and again with what came since."""

    def __init__(self, stream: rr.RecordingStream, tick_ns: int, t0_ns: int) -> None:
        self._stream, self._tick_ns, self._t0_ns = stream, tick_ns, t0_ns
        self.shown = _Shown()
        self._modules = ByModules(stream, self._index, self._plot, self.shown.texts)
        self._plane: LocalPlane | None = None
        self._waypoints: list[tuple[float, float, float]] = []
        self._truth: Arrays | None = None  # the last rows of it, to compare estimates with
        self._last: dict[str, Any] = {}  # entity -> last state, or end of its trail
        self._cart: UrdfTree | None = None
        self._believed = "base_link"  # frame of the estimated cart; without an estimate, the cart itself
        self._draw: dict[str, tuple[Callable[[Table], None], tuple[str, ...]]] = {
            "Site": (self._site, ("lat_rad", "lon_rad")),
            "Course": (self._course, ("lat_rad", "lon_rad", "radius_m")),
            "Scene": (self._scene, ("kind", "x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "boundary_x_m")),
            "CartTruth": (self._cart_truth, ("x_m", "y_m", "yaw_rad", "steer_rad")),
            "Pose": (self._pose, ("x_m", "y_m", "yaw_rad", "covariance")),
            "GpsFix": (self._fix, ("mode", "quality", "lat_rad", "lon_rad")),
            "Scan": (self._scan, ("first_rad", "step_rad", "max_m", "mount_x_m", "range_m")),
            "ActorsTruth": (self._actors, ("kind", "x_m", "y_m", "yaw_rad")),
            "FollowState": (self._follow, ("waypoint",)),
            "ActuatorCommand": (self._latency, ("enable",)),
            "FaultEvent": (self._faults, ("kind", "active")),
        }

    def send(self, tables: Iterable[Table]) -> bool:
        """Send rows. True when something came that the blueprint does not show yet."""
        before = self.shown.size
        order = list(self._draw)
        for table in sorted(tables, key=lambda t: order.index(t.schema.name) if t.schema.name in order else len(order)):
            if not len(table.cycle):
                continue
            draw, needs = self._draw.get(table.schema.name, (None, ()))
            if draw is not None and all(name in table.columns for name in needs):
                draw(table)
            if is_json(table.schema.fields):
                self._modules.send(table)
            elif table.schema.name not in ("Site", "Course", "Scene"):  # written once: nothing to plot
                self._signals(table)
        return before != self.shown.size

    def _index(self, cycle: Any) -> list[rr.TimeColumn]:
        return [
            rr.TimeColumn("cycle", sequence=cycle),
            rr.TimeColumn("time", duration=(cycle * self._tick_ns).astype("timedelta64[ns]")),
        ]

    # -- any topic

    def _signals(self, table: Table) -> None:
        """Numbers become plots, everything else lanes."""
        index = self._index(table.cycle)
        for f in table.schema.fields:
            column = table.columns[f.name]
            if f.spec.shape != "one":
                continue
            if f.spec.kind in ("enum", "bool", "str"):
                words = _words(f, column)
                known = _path("states", table.topic, f.name) in self._last
                if table.schema.name != "FaultEvent" and (known or any(words)):
                    self._lane(table, f.name, words, f)
            elif f.spec.unit != "ns":  # a stamp is no signal
                self._plot(table, f.name, f.spec.unit, index, column)

    def _plot(self, table: Table, name: str, unit: str, index: list[rr.TimeColumn], values: Any) -> None:
        path = _path("signals", table.topic, name)
        known = self.shown.plots.setdefault((table.topic, table.schema.name), [])
        if (name, unit, path) not in known:
            known.append((name, unit, path))
        self._stream.send_columns(path, index, rr.Scalars.columns(scalars=values.astype(np.float64)))

    def _lane(self, table: Table, name: str, words: Sequence[str], f: Field | None = None) -> None:
        """Send a state where it changes."""
        path = _path("states", table.topic, name)
        known = self.shown.lanes.setdefault((table.topic, table.schema.name), [])
        if (name, path) not in known:
            known.append((name, path))
            values = [n for n, _ in f.values] if f is not None and f.values else list(dict.fromkeys(words))
            self._stream.log(
                path,
                rr.StateConfiguration(
                    values=values,
                    labels=[v.lower().replace("_", " ") for v in values],
                    colors=[STATE_COLOUR.get(v, GREY) for v in values],
                ),
                static=True,
            )
        changed = [k for k, word in enumerate(words) if word != (words[k - 1] if k else self._last.get(path))]
        self._last[path] = words[-1]
        if changed:
            index = self._index(table.cycle[changed])
            self._stream.send_columns(path, index, rr.StateChange.columns(state=[words[k] for k in changed]))

    def _faults(self, table: Table) -> None:
        """One lane for each kind of fault."""
        kinds, active = table.columns["kind"], table.columns["active"]
        for kind in dict.fromkeys(kinds):
            mine = np.array([k == kind for k in kinds])
            part = Table(table.topic, table.schema, table.cycle[mine], table.t_data_ns[mine], {})
            self._lane(part, kind, ["active" if a else "over" for a in active[mine]])

    def _latency(self, table: Table) -> None:
        """From the oldest sensor data behind a command to the frame that carried it, as the metric has it."""
        on = table.columns["enable"].astype(bool)
        if on.any():
            sent_ns = self._t0_ns + (table.cycle[on] - 1) * self._tick_ns
            self._plot(table, "latency_s", "s", self._index(table.cycle[on]), (sent_ns - table.t_data_ns[on]) * 1e-9)

    # -- the scene

    def _site(self, table: Table) -> None:
        self._plane = LocalPlane.at(float(table.columns["lat_rad"][-1]), float(table.columns["lon_rad"][-1]))
        self._stream.log("scene", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def _course(self, table: Table) -> None:
        if self._plane is None:
            return
        columns = {name: column[-1] for name, column in table.columns.items()}
        geo = zip(columns["lat_rad"], columns["lon_rad"], columns["radius_m"], strict=True)
        if table.component != "mission":  # a route that somebody planned
            line = [(*self._plane.to_map(lat, lon), 0.04) for lat, lon, _ in geo]
            self._stream.log(
                _path("scene", table.topic), rr.LineStrips3D([line], colors=WANTED, radii=0.03), static=True
            )
            return
        self._waypoints = [(*self._plane.to_map(lat, lon), float(radius)) for lat, lon, radius in geo]
        line = [(x, y, 0.03) for x, y, _ in self._waypoints]
        if columns.get("start_sigma_m", 0.0) > 0:
            line.insert(0, (*self._plane.to_map(columns["start_lat_rad"], columns["start_lon_rad"]), 0.03))
        self._stream.log("scene/course/line", rr.LineStrips3D([line], colors=WANTED, radii=0.05), static=True)
        self._stream.log(
            "scene/course/waypoints",
            rr.LineStrips3D([_circle(x, y, radius, 0.05) for x, y, radius in self._waypoints], radii=0.07),
            static=True,
        )
        self._stream.log(
            "scene/course/numbers",
            rr.Points3D(
                [(x, y, 0.3) for x, y, _ in self._waypoints],
                labels=[str(k + 1) for k in range(len(self._waypoints))],
                colors=WANTED,
                radii=0.15,
                point_shading="flat",
            ),
            static=True,
        )
        self._around(np.array(line)[:, :2])

    def _progress(self, aim: int) -> list[Colour]:
        """Colours of the way-points: reached, aimed at, still to come."""
        return [TRUE if k < aim else YELLOW if k == aim else WANTED for k in range(len(self._waypoints))]

    def _follow(self, table: Table) -> None:
        aim, path = table.columns["waypoint"], "scene/course/waypoints"
        aim = aim + table.columns.get("finished", 0)
        changed = np.flatnonzero(np.diff(aim, prepend=self._last.get(path, -1)))
        if self._waypoints and len(changed):
            self._last[path] = int(aim[-1])
            colours = [self._progress(int(k)) for k in aim[changed]]
            columns = rr.LineStrips3D.columns(colors=np.array(colours, np.uint8).reshape(-1, 3))
            self._stream.send_columns(
                path, self._index(table.cycle[changed]), columns.partition([len(self._waypoints)] * len(changed))
            )

    def _scene(self, table: Table) -> None:
        c = {name: column[-1] for name, column in table.columns.items()}
        if len(c["kind"]):
            self._stream.log(
                "scene/obstacles" if table.component == "world" else "scene/map",
                rr.Boxes3D(
                    centers=np.column_stack([c["x_m"], c["y_m"], c["z_m"]]),
                    sizes=np.column_stack([c["length_m"], c["width_m"], c["height_m"]]),
                    quaternions=_about_z(c["yaw_rad"]),
                    colors=[OBSTACLE_COLOUR.get(int(kind), GREY) for kind in c["kind"]],
                ),
                static=True,
            )
        if len(c["boundary_x_m"]):
            corners = np.column_stack([c["boundary_x_m"], c["boundary_y_m"], np.full(len(c["boundary_x_m"]), 0.02)])
            outline = rr.LineStrips3D([np.vstack([corners, corners[:1]])], colors=RED, radii=0.08)
            self._stream.log("scene/boundary", outline, static=True)

    def _cart_truth(self, table: Table) -> None:
        c = table.columns
        self._move_cart(table, c["steer_rad"])
        self._trail(table, "line", TRUE, 0.09)
        rows = {"cycle": table.cycle, "x_m": c["x_m"], "y_m": c["y_m"]}
        old = self._truth
        self._truth = rows if old is None else {n: np.concatenate([old[n][-1000:], rows[n]]) for n in rows}

    def _move_cart(self, table: Table, steer_rad: Any | None) -> None:
        """Put the cart's model where the table says."""
        path, index = _path("scene", table.topic), self._index(table.cycle)
        if self._cart is None:
            self._cart, self.shown.cart = UrdfTree.from_file_path(URDF, entity_path_prefix="scene"), path
            self._cart.log_urdf_to_recording(self._stream)
            on = rr.Transform3D(parent_frame=f"tf#{path}", child_frame="base_link")
            self._stream.log(f"{path}/model", on, static=True)
        turn = _about_z(table.columns["yaw_rad"])
        place = rr.Transform3D.columns(translation=_on_ground(table.columns), quaternion=turn)
        self._stream.send_columns(path, index, place)
        if steer_rad is not None:
            some = np.flatnonzero(np.diff(np.round(steer_rad / 0.01), prepend=np.inf))
            for name in ("front_left_steer", "front_right_steer"):
                joint = self._cart.get_joint_by_name(name)
                if joint is not None:
                    columns = joint.compute_transform_columns(np.clip(steer_rad[some], -0.6, 0.6).tolist())
                    self._stream.send_columns(f"{path}/{name}", self._index(table.cycle[some]), columns)

    def _trail(self, table: Table, name: str, colour: Colour, radius_m: float) -> None:
        """Send the driven line in pieces, so that it grows with time."""
        path, points = f"{_path('scene', table.topic)}_{name}", _on_ground(table.columns, 0.06)
        self._around(points[:, :2])
        piece = table.cycle // max(1, round(TRAIL_S * 1e9 / self._tick_ns))
        ends = np.flatnonzero(np.diff(piece, append=-1))
        if path not in self._last:
            self.shown.trails.append(path)
            self._stream.log(path, rr.LineStrips3D.from_fields(colors=colour, radii=radius_m), static=True)
            self._last[path] = points[0]
        starts = np.vstack([self._last[path], points[ends[:-1]]])
        self._last[path] = points[ends[-1]]
        strips = rr.LineStrips3D.columns(strips=list(np.stack([starts, points[ends]], axis=1)))
        self._stream.send_columns(path, self._index(table.cycle[ends]), strips)

    def _pose(self, table: Table) -> None:
        """The estimate: outline of the cart, 2-sigma ellipse, driven line; and its error where the truth is known."""
        c, path = table.columns, _path("scene", table.topic)
        if self._truth is None:
            self._move_cart(table, None)
        index, ground = self._index(table.cycle), _on_ground(c)
        if f"{path}/ellipse" not in self._last:
            self._last[f"{path}/ellipse"] = True
            self._believed = f"tf#{path}/cart"
            box = rr.Boxes3D(sizes=[BODY_SIZE_M], centers=[BODY_CENTRE_M], colors=BELIEVED, radii=0.03)
            self._stream.log(
                f"{path}/cart/outline", box, rr.Boxes3D.from_fields(fill_mode="majorwireframe"), static=True
            )
            ellipse = rr.LineStrips3D([_circle(0, 0, 1, 0)], colors=BELIEVED, radii=0.04)
            self._stream.log(f"{path}/ellipse", ellipse, static=True)
        self._stream.send_columns(
            f"{path}/cart", index, rr.Transform3D.columns(translation=ground, quaternion=_about_z(c["yaw_rad"]))
        )
        size_m2, axes = np.linalg.eigh(c["covariance"].reshape(-1, 3, 3)[:, :2, :2])
        shape = np.zeros((len(table.cycle), 3, 3))
        shape[:, :2, :2] = axes * (2.0 * np.sqrt(np.maximum(size_m2, 0.0)))[:, None, :]
        shape[:, 2, 2] = 1.0
        ground[:, 2] = 1.95  # above the roof, where it can be seen
        self._stream.send_columns(
            f"{path}/ellipse", index, rr.Transform3D.columns(translation=ground, mat3x3=shape.reshape(-1, 9))
        )
        self._trail(table, "line", BELIEVED, 0.06)
        if self._truth is not None:
            measured = (table.t_data_ns - self._t0_ns) // self._tick_ns
            k = np.searchsorted(self._truth["cycle"], measured, side="right") - 1
            good = (k >= 0) & (c["sigma_m"] < 100.0)
            dx = c["x_m"][good] - self._truth["x_m"][k[good]]
            dy = c["y_m"][good] - self._truth["y_m"][k[good]]
            self._plot(table, "error_m", "m", self._index(table.cycle[good]), np.hypot(dx, dy))

    def _fix(self, table: Table) -> None:
        c = table.columns
        good = c["mode"] >= 2
        if self._plane is None or not good.any():
            return
        path, origin = _path("scene", table.topic), self._plane
        x_m = (c["lon_rad"][good] - origin.lon_rad) * origin.east_m_per_rad
        y_m = (c["lat_rad"][good] - origin.lat_rad) * origin.north_m_per_rad
        if path not in self._last:
            self._last[path] = True
            self.shown.trails.append(path)
            self._stream.log(path, rr.Points3D.from_fields(radii=0.16, point_shading="flat"), static=True)
        columns = rr.Points3D.columns(
            positions=np.column_stack([x_m, y_m, np.full(len(x_m), 0.12)]),
            colors=np.array([FIX_COLOUR.get(int(q), MEASURED) for q in c["quality"][good]], np.uint8),
        )
        self._stream.send_columns(path, self._index(table.cycle[good]), columns)

    def _scan(self, table: Table) -> None:
        """Range points, where the cart believes them to be."""
        c, path = table.columns, _path("scene", table.topic)
        if self._last.get(path) != self._believed:
            self._last[path] = self._believed
            look = rr.Points3D.from_fields(colors=SCANNED, radii=0.12, point_shading="flat")
            rays = rr.LineStrips3D.from_fields(colors=MEASURED, radii=0.012)
            for entity, archetype in ((path, look), (f"{path}/rays", rays)):
                self._stream.log(entity, rr.CoordinateFrame(self._believed), archetype, static=True)
        points, lengths, fans = [], [], []
        for k, ranges in enumerate(c["range_m"]):
            angle = c["first_rad"][k] + c["step_rad"][k] * np.arange(len(ranges))
            seen = ranges < c["max_m"][k]
            x = c["mount_x_m"][k] + ranges * np.cos(angle)
            points.append(np.column_stack([x, ranges * np.sin(angle), np.full(len(x), SCAN_HEIGHT_M)])[seen])
            lengths.append(int(seen.sum()))
            fan = np.tile([c["mount_x_m"][k], 0.0, SCAN_HEIGHT_M], (2 * lengths[-1] + 1, 1))
            fan[1::2] = points[-1]  # out and back, ray after ray: one line
            fans.append(fan)
        columns = rr.Points3D.columns(positions=np.concatenate(points)).partition(lengths)
        self._stream.send_columns(path, self._index(table.cycle), columns)
        self._stream.send_columns(f"{path}/rays", self._index(table.cycle), rr.LineStrips3D.columns(strips=fans))

    def _actors(self, table: Table) -> None:
        c, path = table.columns, _path("scene", table.topic)
        x, y, yaw, kind = (np.concatenate(c[name]) for name in ("x_m", "y_m", "yaw_rad", "kind"))
        columns = rr.Boxes3D.columns(
            centers=np.column_stack([x, y, np.full(len(x), PERSON_M[2] / 2)]),
            half_sizes=np.tile(np.array(PERSON_M) / 2, (len(x), 1)),
            quaternions=_about_z(yaw),
            colors=np.array([OBSTACLE_COLOUR.get(int(k), GREY) for k in kind], np.uint8).reshape(-1, 3),
        )
        self._stream.send_columns(path, self._index(table.cycle), columns.partition([len(row) for row in c["kind"]]))

    def _around(self, points: Any) -> None:
        """Widen the rectangle that the camera looks at."""
        low, high = points.min(axis=0), points.max(axis=0)
        s = self.shown
        s.low = low if s.low is None else np.minimum(s.low, low)
        s.high = high if s.high is None else np.maximum(s.high, high)


def _path(root: str, topic: str, *names: str) -> str:
    return rr.new_entity_path([root, *topic.split("/"), *names])


def _words(f: Field, column: Any) -> list[str]:
    if f.spec.kind == "bool":
        return ["yes" if value else "no" for value in column.tolist()]
    if f.spec.kind == "enum":
        names = {value: name for name, value in f.values}
        return [names.get(value, str(value)) for value in column.tolist()]
    return [text or "-" for text in column] if any(column) else [""] * len(column)


def _about_z(yaw_rad: Any) -> Any:
    """Turns about z as quaternions (n, 4), x y z w."""
    half, zero = np.asarray(yaw_rad, np.float64) / 2, np.zeros(len(yaw_rad))
    return np.column_stack([zero, zero, np.sin(half), np.cos(half)])


def _on_ground(columns: Arrays, z_m: float = 0.0) -> Any:
    return np.column_stack([columns["x_m"], columns["y_m"], np.full(len(columns["x_m"]), z_m)])


def _circle(x_m: float, y_m: float, radius_m: float, z_m: float) -> Any:
    angle = np.linspace(0.0, 2.0 * math.pi, 49)
    return np.column_stack([x_m + radius_m * np.cos(angle), y_m + radius_m * np.sin(angle), np.full(49, z_m)])


# -- blueprint --------------------------------------------------------------------------------------------------------


def blueprint(shown: _Shown, *, live: bool = False) -> rrb.Blueprint:
    """Lay out the views: one tab of the drive, one tab for each component."""
    components = sorted({topic.partition("/")[0] for topic, _ in [*shown.plots, *shown.lanes]} | shown.texts.keys())
    return rrb.Blueprint(
        rrb.Tabs(_drive_tab(shown), *(_component_tab(shown, name) for name in components), active_tab=0),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="following" if live else "playing"),
        auto_views=False,
        auto_layout=False,
    )


def _drive_tab(shown: _Shown) -> rrb.Container:
    plots = [view for title, wanted in PLOTS if (view := _known_plot(shown, title, wanted)) is not None]
    lanes = [
        path
        for record, name in LANES
        for (_, of), known in shown.lanes.items()
        if of == record
        for lane, path in known
        if name in ("", lane)
    ]
    states = rrb.StateTimelineView(origin="states", contents=_these(lanes), name="States", time_view=ALL_TIME)
    return rrb.Horizontal(
        rrb.Vertical(*_scene_views(shown), row_shares=[3, 2]),
        rrb.Vertical(rrb.TextDocumentView(origin="summary", name="Summary"), states),
        rrb.Grid(*plots, grid_columns=2),
        column_shares=[8, 5, 8],
        name="Drive",
    )


def _scene_views(shown: _Shown) -> list[rrb.Spatial3DView]:
    """The whole course from the south, and the surroundings from behind the cart."""
    low, high = (np.zeros(2), np.ones(2)) if shown.low is None else (shown.low, shown.high)
    middle, (width, depth) = (low + high) / 2, (high - low).tolist()
    reach = max(0.95 * width, depth, 10.0)
    begin, now = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    history = [rrb.VisibleTimeRange(timeline, start=begin, end=now) for timeline in ("time", "cycle")]
    trails: dict[Any, Any] = {path: rrb.VisibleTimeRanges(history) for path in shown.trails}
    common: dict[str, Any] = {
        "contents": "+ /scene/**",
        "overrides": trails,
        "defaults": [rr.Boxes3D.from_fields(fill_mode="solid"), rr.Cylinders3D.from_fields(fill_mode="solid")],
        "line_grid": rrb.LineGrid3D(visible=True, spacing=5.0, color=(70, 74, 84, 255)),
        "background": (24, 26, 32),
    }
    course = rrb.Spatial3DView(
        name="Course",
        origin="scene",
        eye_controls=rrb.EyeControls3D(
            kind="orbital",
            position=(middle[0], middle[1] - 0.8 * reach, 0.85 * reach),
            look_target=(middle[0], middle[1], 0.0),
            eye_up=(0.0, 0.0, 1.0),
        ),
        **common,
    )
    # An origin that moves makes the eye ride along: all of the scene is drawn as seen from the cart.
    cart = rrb.Spatial3DView(
        name="Behind the cart",
        origin=shown.cart or "scene",
        spatial_information=rrb.SpatialInformation(target_frame=f"tf#{shown.cart}") if shown.cart else None,
        eye_controls=rrb.EyeControls3D(
            kind="orbital", position=(-7.0, 3.0, 5.5), look_target=(4.0, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0)
        ),
        **common,
    )
    return [course, cart]


def _known_plot(
    shown: _Shown, title: str, wanted: tuple[tuple[str, str, str, Colour], ...]
) -> rrb.TimeSeriesView | None:
    found = [
        (topic, path, label, colour)
        for record, name, label, colour in wanted
        for (topic, of), known in shown.plots.items()
        if of == record
        for signal_name, _, path in known
        if signal_name == name
    ]
    labels = [label for _, _, label, _ in found]
    overrides: dict[Any, Any] = {}
    for k, (topic, path, label, colour) in enumerate(found):
        several = labels.count(label) > 1
        first = labels.index(label) == k
        overrides[path] = rr.SeriesLines(
            names=f"{label} by {topic.partition('/')[0]}" if several else label,
            colors=colour if first else ALSO_WANTED,
            widths=1.6,
        )
    if not found:
        return None
    return rrb.TimeSeriesView(
        origin="signals",
        contents=_these(list(overrides)),
        overrides=overrides,
        name=title,
        axis_x=ALL_TIME,
    )


def _these(paths: list[str]) -> list[str]:
    return [f"+ {path}" for path in paths]


def _component_tab(shown: _Shown, component: str) -> rrb.Container:
    """Everything of a component: a plot for each unit, and its states."""
    by_unit: dict[str, list[str]] = {}
    for (topic, _), known in shown.plots.items():
        if topic.partition("/")[0] == component:
            for _, unit, path in known:
                by_unit.setdefault(unit, []).append(path)
    views: list[Any] = [
        rrb.TimeSeriesView(
            origin=_path("signals", component),
            contents=_these(paths),
            name=unit or "counts",
            axis_x=ALL_TIME,
        )
        for unit, paths in by_unit.items()
    ]
    if any(topic.partition("/")[0] == component for topic, _ in shown.lanes):
        views.append(rrb.StateTimelineView(origin=_path("states", component), name="states", time_view=ALL_TIME))
    if component in shown.texts:
        views.append(rrb.TextLogView(origin="texts", contents=_these(shown.texts[component]), name="what it says"))
    return rrb.Grid(*views, name=component)


# -- summary ----------------------------------------------------------------------------------------------------------


def summary(result: "dict[str, Any] | Result | None", title: str) -> str:
    """Write the verdict and the metrics as markdown."""
    if result is None:
        return f"# {title}\n\nnot judged\n\n{KEY}"
    data: dict[str, Any] = json.loads(result.to_json()) if isinstance(result, Result) else result
    reason = f": {data['reason']}" if data.get("reason") else ""
    lines = [
        f"# {data['verdict']}: {title}",
        f"{data['duration_s']:.1f} s of driving{reason}",
        "",
        KEY,
        "",
        "| criterion | measured | wanted | at | |",
        "|---|---|---|---|---|",
    ]
    for row in data["criteria"]:
        at = "" if row["at_s"] is None else f"{row['at_s']:.2f} s"
        value, limit = _number(row["value"], row["unit"]), _number(row["limit"], row["unit"])
        lines.append(f"| {row['metric']} | {value} | {row['op']} {limit} | {at} | {row['verdict']} |")
    judged = {row["metric"] for row in data["criteria"]}
    more = {name: value for name, value in data["metrics"].items() if name not in judged and value is not None}
    if more:
        lines += ["", "| other metrics | measured |", "|---|---|"]
        lines += [
            f"| {name} | {_number(v, METRICS[name].unit if name in METRICS else '')} |" for name, v in more.items()
        ]
    return "\n".join(lines)


def _number(value: float | str | None, unit: str) -> str:
    if value is None:
        return "not measured"
    return "never" if not math.isfinite(float(value)) else f"{float(value):.4g} {unit}".strip()


def _title(metadata: dict[str, str]) -> str:
    return f"{metadata.get('scenario', 'drive')}, seed {metadata.get('seed', '-')}"


def convert(recording: Recording, result: "dict[str, Any] | Result | None", out: Path) -> Path:
    """Derive a rerun file from a recording; `result` is what result.json holds, None for a drive not judged."""
    title = _title(recording.metadata)
    stream = rr.RecordingStream("fairway", recording_id=title)
    stream.save(out)
    stream.send_recording_name(title)
    builder = Builder(stream, recording.tick_ns, recording.t0_ns)
    builder.send(read_table(channel) for channel in recording.channels.values())
    stream.log("summary", rr.TextDocument(summary(result, title), media_type="text/markdown"), static=True)
    stream.send_blueprint(blueprint(builder.shown))
    stream.flush()
    stream.disconnect()
    return out


# -- viewers ----------------------------------------------------------------------------------------------------------


def has_display() -> bool:
    """Whether a window can open here: a display, and neither SSH nor WSL in between."""
    env = os.environ
    far = "SSH_CONNECTION" in env or "WSL_DISTRO_NAME" in env
    return not far and bool(env.get("DISPLAY") or env.get("WAYLAND_DISPLAY"))


class Viewer:
    """A rerun viewer in a process group of its own, on loopback only: a window, or a server for a browser.

    `address`: where to look; `tunnel`: what ssh needs to bring that elsewhere; `sink`: where a stream connects to.
    """

    def __init__(self, *files: Path, options: Sequence[str] | None = None) -> None:
        port, web_port = _free_port(), _free_port()
        self.sink = f"rerun+http://127.0.0.1:{port}/proxy"
        if options is None:
            window = has_display()
            options = ["--hide-welcome-screen"] if window else ["--serve-web", "--web-viewer-port", str(web_port)]
        page = (
            f"http://127.0.0.1:{web_port}/?url={self.sink.replace('+', '%2B').replace(':', '%3A').replace('/', '%2F')}"
        )
        self.tunnel = f"-L {web_port}:127.0.0.1:{web_port} -L {port}:127.0.0.1:{port}"
        self.address = page if "--serve-web" in options else "window"
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - closed in close()
        self._process = subprocess.Popen(
            [_program(), *map(str, files), "--bind", "127.0.0.1", "--port", str(port), *options],
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C is for us; and a script around the binary must not outlive it
        )
        try:
            self._wait_for(lambda: socket.create_connection(("127.0.0.1", port), timeout=1.0).close())
            if self.address == page:
                self._wait_for(lambda: _get("127.0.0.1", web_port))
        except BaseException:
            self.close()
            raise

    def _wait_for(self, knock: Callable[[], object]) -> None:
        deadline = time.monotonic() + UP_S
        while True:
            with contextlib.suppress(OSError, HTTPException):
                knock()
                return
            if self.ended or time.monotonic() > deadline:
                self._log.seek(0)
                lines = self._log.read().decode(errors="replace").strip().splitlines() or ["it says nothing"]
                said = next((line for line in lines if "error" in line.lower()), lines[-1])
                raise ViewerFailed(f"the viewer does not start: {said}")
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(0.05)

    @property
    def ended(self) -> bool:
        """Whether the user has closed the window, or the viewer is gone for another reason."""
        return self._process.poll() is not None

    def wait(self) -> None:
        """Wait until the window is closed or somebody interrupts; then end the viewer."""
        with contextlib.suppress(KeyboardInterrupt):
            self._process.wait()
        self.close()

    def close(self) -> None:
        """End the viewer."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            if self.ended:
                break
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(3.0)
        self._log.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _program() -> str:
    """Find the viewer: the binary itself, else the script `rerun` that starts it as its child."""
    package = find_spec("rerun_cli")
    binary = Path(package.origin).with_name("rerun") if package and package.origin else Path("rerun")
    script = Path(sys.executable).with_name("rerun")
    found = next((str(path) for path in (binary, script) if path.is_file()), None) or shutil.which("rerun")
    if found is None:
        raise ViewerFailed("the command `rerun` of the package rerun-sdk is not there")
    return found


def _get(host: str, port: int) -> None:
    with contextlib.closing(HTTPConnection(host, port, timeout=1.0)) as connection:
        connection.request("GET", "/")
        connection.getresponse().read()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def open_viewer(rrd: Path, say: Callable[[str], object] = print) -> str:
    """Show a rerun file until the window is closed or Ctrl-C; says and returns where to look."""
    with Viewer(rrd) as viewer:
        say(viewer.address)
        if "SSH_CONNECTION" in os.environ:
            say(f"from your own machine: ssh {viewer.tunnel} HOST, then open that address there")
        viewer.wait()
        return viewer.address


class LiveView:
    """Shows a drive under way: call `record` after each tick, as a recorder's; it sends one batch a second.

    with LiveView([cart, world], "parking-lot/square, seed 0") as view: ...
    """

    def __init__(self, stores: list[Store], title: str, viewer: Viewer | None = None) -> None:
        self.viewer = viewer or Viewer()
        self._stores, self._title = stores, title
        self._stream = rr.RecordingStream("fairway", recording_id=f"{title}, live {stores[0].t0_ns}")
        self._stream.connect_grpc(self.viewer.sink)
        self._stream.send_recording_name(title)
        self._builder = Builder(self._stream, stores[0].tick_ns, stores[0].t0_ns)
        self._rows: dict[str, tuple[Schema, list[tuple[int, int, bytes]]]] = {}
        self._names: list[dict[int, tuple[str, Schema]]] = [{} for _ in stores]
        self._flushed_s = time.monotonic()
        self.show(None)

    def record(self) -> None:
        """Take what the latest tick made visible; flush when a second has gone by."""
        cycle = self._stores[0].cycle
        for store, names in zip(self._stores, self._names, strict=True):
            for index, (payload, _, _, t_data_ns, _) in store.core.changed():
                if index not in names:
                    names.update({obj.handle: (obj.name, obj.schema) for obj in store.objects()})
                self.add(*names[index], cycle, t_data_ns, payload)
        if time.monotonic() - self._flushed_s >= FLUSH_S:
            self.flush()

    def add(self, topic: str, schema: Schema, cycle: int, t_data_ns: int, payload: bytes) -> None:
        """Keep one write for the next batch."""
        self._rows.setdefault(topic, (schema, []))[1].append((cycle, t_data_ns, payload))

    def flush(self) -> None:
        """Send what was kept, by columns."""
        tables = [stack_table(topic, schema, rows) for topic, (schema, rows) in self._rows.items()]
        self._rows.clear()
        self._flushed_s = time.monotonic()
        if not self.viewer.ended and self._builder.send(tables):
            self._stream.send_blueprint(blueprint(self._builder.shown, live=True))

    def show(self, result: "dict[str, Any] | Result | None") -> None:
        """Show the verdict."""
        text = rr.TextDocument(summary(result, self._title), media_type="text/markdown")
        self._stream.log("summary", text, static=True)

    def close(self) -> None:
        """Send the rest and end the viewer."""
        self.flush()
        with contextlib.suppress(Exception):  # a viewer that the user has closed takes nothing any more
            self._stream.flush(timeout_sec=3.0)
        self._stream.disconnect()
        self.viewer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
