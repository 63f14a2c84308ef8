"""What modules show (`self.show`), and other JSON objects: numbers become plots, points a line in the scene, the rest a
log.

Every write names what was shown in that step; a name that is missing in a write is not shown any more.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr

from rtdb.json_object import unit_of_key

if TYPE_CHECKING:
    from .replay import Table

COLOUR, RADIUS_M, HEIGHT_M = (176, 132, 255), 0.06, 0.1
HIDDEN = ("config",)  # how a module is wired is nothing to look at
Points = list[tuple[float, float]]


@dataclass(slots=True)
class Shown:
    """The rows of one topic by name: (row, value)."""

    numbers: dict[str, list[tuple[int, float]]] = field(default_factory=dict)
    lines: dict[str, list[tuple[int, Points]]] = field(default_factory=dict)
    texts: dict[str, list[tuple[int, str]]] = field(default_factory=dict)


class ByModules:
    """Sends what modules show to a rerun stream. `texts`: by component, paths of its logs, for the blueprint."""

    def __init__(
        self,
        stream: rr.RecordingStream,
        index: Callable[[Any], list[rr.TimeColumn]],
        plot: Callable[["Table", str, str, list[rr.TimeColumn], Any], None],
        texts: dict[str, list[str]],
    ) -> None:
        self._stream, self._index, self._plot, self._texts = stream, index, plot, texts
        self._lines: dict[str, dict[str, bool]] = {}  # topic -> lines that were shown, and whether they still are

    def send(self, table: "Table") -> None:
        """Send the rows of a JSON object."""
        if table.topic.rpartition("/")[2] in HIDDEN:
            return
        found = sort_by_kind(table.columns["json"])
        for name, numbers in found.numbers.items():
            index = self._index(table.cycle[[row for row, _ in numbers]])
            self._plot(table, name or "-", unit_of_key(name) or "", index, np.array([value for _, value in numbers]))
        for name in sorted(found.lines.keys() | self._lines.get(table.topic, {}).keys()):
            self._line(table, name, dict(found.lines.get(name, [])))
        for name, texts in found.texts.items():
            path = rr.new_entity_path(["texts", *table.topic.split("/"), name or "-"])
            known = self._texts.setdefault(table.component, [])
            if path not in known:
                known.append(path)
            index = self._index(table.cycle[[row for row, _ in texts]])
            self._stream.send_columns(path, index, rr.TextLog.columns(text=[f"{name}: {text}" for _, text in texts]))

    def _line(self, table: "Table", name: str, lines: dict[int, Points]) -> None:
        """Send a line where it is shown, and nothing where it is not any more."""
        path = rr.new_entity_path(["scene", *table.topic.split("/"), name or "-"])
        known = self._lines.setdefault(table.topic, {})
        if name not in known:
            self._stream.log(path, rr.LineStrips3D.from_fields(colors=COLOUR, radii=RADIUS_M), static=True)
        rows, was = [], known.get(name, False)
        for row in range(len(table.cycle)):
            if row in lines or was:
                rows.append(row)
            was = row in lines
        known[name] = was
        if rows:
            strips = [np.column_stack([line, np.full(len(line), HEIGHT_M)]) for _, line in sorted(lines.items())]
            columns = rr.LineStrips3D.columns(strips=strips).partition([int(row in lines) for row in rows])
            self._stream.send_columns(path, self._index(table.cycle[rows]), columns)


def sort_by_kind(documents: list[str]) -> Shown:
    """Sort what was shown. Points are a list of pairs; what is neither number nor points is text, where it changes."""
    shown = Shown()
    last: dict[str, str] = {}
    for row, text in enumerate(documents):
        for name, value in _loaded(text).items():
            if isinstance(value, int | float):
                shown.numbers.setdefault(name, []).append((row, float(value)))
                continue
            points = points_of(value)
            if points:
                shown.lines.setdefault(name, []).append((row, points))
                continue
            said = value if isinstance(value, str) else json.dumps(value)
            if last.get(name) != said:
                last[name] = said
                shown.texts.setdefault(name, []).append((row, said))
    return shown


def points_of(value: Any) -> Points:
    """Give the points in a value; none where it is not a list of pairs of numbers."""
    if not isinstance(value, list):
        return []
    for pair in value:
        if not (isinstance(pair, list) and len(pair) == 2 and all(type(x) in (int, float) for x in pair)):
            return []
    return [(float(x), float(y)) for x, y in value]


def _loaded(text: str) -> dict[str, Any]:
    try:
        document = json.loads(text)
    except ValueError:  # a program wrote it that says it writes JSON, and does not
        return {}
    return document if isinstance(document, dict) else {}
