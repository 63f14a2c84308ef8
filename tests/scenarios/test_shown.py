"""What a module shows of itself is in the replay: numbers as plots, points as a line, the rest as a log."""

import json
from pathlib import Path
from typing import Any

import pytest
from rerun.chunk import RrdReader

from autonomy import Input, Module, Output
from autonomy.host import Host
from autonomy.wiring import Wire
from hal.signals import STOP, DriveCommand, Pose
from rtdb import Store
from rtdb.recorder import Recorder
from rtdb.recording import Recording
from scenarios.replay import Builder, convert, read_table
from scenarios.shown import sort_by_kind

CYCLES = 60


class Shows(Module):
    """Shows a number, a line that goes away and comes again, and what it thinks."""

    pose = Input(Pose)
    drive = Output(DriveCommand, safe=STOP)

    def step(self) -> None:
        x_m, n = self.pose.x_m, round(self.pose.x_m)
        self.drive = STOP
        self.show("gap_m", x_m / 2)
        self.show("near/by & far", n > 30)
        if n < 20 or n >= 40:
            self.show("aim", [(x_m, 0.0), (x_m + 1.0, 2.0)])
        self.show("why", "turning" if n % 30 > 20 else "straight on")
        self.show("candidates", {"left": n // 50})


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("shown") / "run.mcap"
    with Store.create(None) as store:
        pose = store.join("source").insert("pose", Pose)
        host = Host(store, Wire("mine", f"{__name__}:Shows", 1, 0, {"pose": "source/pose"}), 0)
        host.connect()
        with Recorder(path, [store], {"scenario": "test/shown", "seed": "0"}) as recorder:
            for k in range(CYCLES):
                pose.write(Pose(x_m=float(k)))
                cycle = store.tick()
                recorder.record()
                host.step(cycle)
    return Recording(path)


@pytest.fixture(scope="module")
def rrd(recording: Recording) -> Path:
    return convert(recording, None, recording.path.with_name("run.rrd"))


def columns(path: Path, entity: str) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    for chunk in RrdReader(str(path)).stream():
        if str(chunk.entity_path) == entity:
            for name, values in chunk.to_record_batch().to_pydict().items():
                found.setdefault(name, []).extend(values)
    return found


def entities(path: Path) -> set[str]:
    return {str(chunk.entity_path) for chunk in RrdReader(str(path)).stream()}


def test_numbers_are_plots(rrd: Path) -> None:
    values = [row[0] for row in columns(rrd, "/signals/mine/show/gap_m")["Scalars:scalars"]]
    assert values == [k / 2 for k in range(CYCLES - 1)]
    odd = next(name for name in entities(rrd) if "near" in name)
    assert [row[0] for row in columns(rrd, odd)["Scalars:scalars"]] == [float(k > 30) for k in range(CYCLES - 1)]


def test_points_are_a_line_in_the_scene_as_long_as_they_are_shown(rrd: Path) -> None:
    found = columns(rrd, "/scene/mine/show/aim")
    strips = [row for row in found["LineStrips3D:strips"] if row is not None]
    cycles = [c for c, row in zip(found["cycle"], found["LineStrips3D:strips"], strict=True) if row is not None]
    shown = dict(zip(cycles, strips, strict=True))
    assert shown[7] == [[pytest.approx([5.0, 0.0, 0.1]), pytest.approx([6.0, 2.0, 0.1])]]
    assert shown[22] == [], "it goes away"
    assert 30 not in shown, "and is not sent again and again"
    assert len(shown[42]) == 1
    assert len(strips) == 20 + 1 + (CYCLES - 1 - 40)


def test_texts_are_a_log_of_what_changed(rrd: Path) -> None:
    said = [row[0] for row in columns(rrd, "/texts/mine/show/why")["TextLog:text"]]
    assert said == [f"why: {text}" for text in ("straight on", "turning", "straight on", "turning")]
    assert [row[0] for row in columns(rrd, "/texts/mine/show/candidates")["TextLog:text"]] == [
        "candidates: {'left': 0}",
        "candidates: {'left': 1}",
    ]


def test_wiring_is_not_shown_and_no_text_becomes_a_lane_of_states(rrd: Path) -> None:
    assert not [name for name in entities(rrd) if "config" in name or name.startswith("/states/mine/show")]


def test_what_is_shown_is_in_the_tab_of_its_component(recording: Recording) -> None:
    import rerun as rr

    builder = Builder(rr.RecordingStream("test"), recording.tick_ns, recording.t0_ns)
    tables = [read_table(channel) for channel in recording.channels.values()]
    assert builder.send(tables)
    assert not builder.send(tables), "nothing new for the blueprint"
    assert ("gap_m", "m", "/signals/mine/show/gap_m") in builder.shown.plots["mine/show", "Json"]
    assert builder.shown.texts == {"mine": ["/texts/mine/show/why", "/texts/mine/show/candidates"]}


def test_what_is_no_points_is_text() -> None:
    odd: list[Any] = [[], [1.0, 2.0], [[1.0, 2.0], [3.0]], [[1.0, True]], [[1.0, "2"]], {"x": 1}, None, "text"]
    for value in odd:
        found = sort_by_kind([json.dumps({"a": value})])
        assert list(found.texts) == ["a"], value
        assert not found.lines
        assert not found.numbers


def test_text_that_is_no_json_is_left_out() -> None:
    found = sort_by_kind(["", "{", "[1]", '{"a": 1}'])
    assert found.numbers == {"a": [(3, 1.0)]}
