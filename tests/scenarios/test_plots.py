"""Plots: they show what a recording holds, leave out what it does not hold, and are the same each time."""

import pytest

from hal.signals import ActorsTruth, CartTruth, Clearance, Scene
from rtdb import Store
from rtdb.recorder import Recorder
from rtdb.recording import Recording
from scenarios.check import Task, run_one
from scenarios.judge import Criterion, judge
from scenarios.metrics import Evidence
from scenarios.plots import NAMES, course_figure, error_figure, latency_figure, speed_figure, write_plots
from scenarios.scenario import Scenario

SHORT = {
    "id": "test/short",
    "about": "A short straight.",
    "site": "pad",
    "course": {
        "speed_mps": 3.0,
        "waypoints": [{"east_m": 8, "north_m": 0}, {"east_m": 14, "north_m": 3}],
    },
    "duration_s": 20,
    "criteria": {"waypoints_missed": "== 0"},
}


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """The recording of a short drive."""
    folder = tmp_path_factory.mktemp("short")
    outcome = run_one(Task(folder / "short.scenario.yaml", Scenario.model_validate(SHORT), 0, folder))
    assert outcome.good, outcome.complaint()
    return folder / "run.mcap"


@pytest.fixture
def recording(driven):
    return Recording(driven)


def labels(figure):
    return {label for axes in figure.axes for label in axes.get_legend_handles_labels()[1]}


def test_a_drive_has_all_four_plots_as_png(recording, tmp_path):
    paths = write_plots(recording, tmp_path)
    assert [path.name for path in paths] == list(NAMES)
    assert all(path.read_bytes().startswith(b"\x89PNG\r\n") for path in paths)


def test_plots_of_the_same_recording_are_the_same_bytes_and_carry_no_date(recording, tmp_path):
    first = {path.name: path.read_bytes() for path in write_plots(recording, tmp_path)}
    second = {path.name: path.read_bytes() for path in write_plots(recording, tmp_path)}
    assert first == second
    assert not any(word in data for data in first.values() for word in (b"tEXt", b"tIME", b"iTXt"))


def test_a_users_matplotlib_style_changes_nothing_and_stays(recording, tmp_path):
    import matplotlib

    plain = write_plots(recording, tmp_path)[0].read_bytes()
    with matplotlib.rc_context({"lines.linewidth": 9.0, "font.size": 20.0, "axes.facecolor": "black"}):
        styled = write_plots(recording, tmp_path)[0].read_bytes()
        assert matplotlib.rcParams["font.size"] == 20.0
    assert styled == plain


def test_the_course_shows_truth_estimate_ribbon_and_way_points(recording):
    found = labels(course_figure(Evidence(recording)))
    assert {"driven (true)", "estimate", "estimate, 2 sigma", "way-point", "course", "start"} <= found
    assert "not reached" not in found


def test_the_ribbon_is_two_sigma_wide_across_the_direction_of_travel(recording):
    from scenarios.plots import _known, _ribbon

    poses = _known(Evidence(recording))
    outline = _ribbon(poses)
    left, right = outline[: len(poses)], outline[len(poses) :][::-1]
    for pose, a, b in zip(poses, left, right, strict=True):
        width = ((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2) ** 0.5
        assert 0 < width <= 4 * pose.value.sigma_m * (1 + 1e-9)


def test_a_field_drive_without_truth_leaves_out_what_needs_it(recording, tmp_path):
    for topic in [topic for topic in recording.channels if topic.startswith("world/")]:
        del recording.channels[topic]
    assert len(write_plots(recording, tmp_path)) == len(NAMES)
    evidence = Evidence(recording)
    assert "driven (true)" not in labels(course_figure(evidence))
    assert "true" not in labels(speed_figure(evidence))
    assert "true distance\nfrom the estimate" not in labels(error_figure(evidence))


def test_latency_is_drawn_as_the_metric_counts_it(recording):
    evidence = Evidence(recording)
    drawn_ms = max(latency_figure(evidence).axes[0].lines[0].get_ydata())
    assert drawn_ms == pytest.approx(1e3 * judge(recording, ()).metrics["latency_max_s"].value)


def test_a_recording_with_nothing_to_draw_leaves_no_plot_of_an_older_run(recording, tmp_path):
    write_plots(recording, tmp_path)
    recording.channels.clear()
    assert write_plots(recording, tmp_path) == []
    assert list(tmp_path.glob("*.png")) == []


def test_a_failed_criterion_is_marked_where_it_broke(recording, tmp_path):
    result = judge(recording, (Criterion.parse("lateral_accel_max_mps2", "<= 0.0"),))
    write_plots(recording, tmp_path)
    plain = (tmp_path / "course.png").read_bytes()
    write_plots(recording, tmp_path, result, {"lateral_accel_max_mps2": 2.0})
    assert (tmp_path / "course.png").read_bytes() != plain


def test_scene_actors_and_contact_are_drawn(tmp_path):
    path = tmp_path / "run.mcap"
    with Store.create(None) as cart, Store.create(None) as world:
        part = world.join("world")
        truth, actors = part.insert("cart", CartTruth), part.insert("actors", ActorsTruth)
        scene, clearance = part.insert("scene", Scene), part.insert("clearance", Clearance)
        with Recorder(path, [cart, world], {"scenario": "test", "seed": "0"}) as recorder:
            scene.write(
                Scene(
                    kind=(1, 3, 5, 99),
                    x_m=(2.0, 1.0, 1e4, 3.0),
                    y_m=(1.0, 2.0, 0.0, 1.0),
                    z_m=(0.0,) * 4,
                    yaw_rad=(0.5,) * 4,
                    length_m=(4.0,) * 4,
                    width_m=(2.0,) * 4,
                    height_m=(1.0,) * 4,
                )
            )
            for k in range(1, 20):
                truth.write(CartTruth(x_m=k * 0.1, distance_m=k * 0.1))
                actors.write(ActorsTruth(kind=(5,), x_m=(1.0,), y_m=(2.0 - k * 0.1,), yaw_rad=(0.0,)))
                clearance.write(Clearance(distance_m=1.0 - k * 0.1, collided=k > 10))
                cart.tick()
                world.tick()
                recorder.record()
    figure = course_figure(Evidence(Recording(path)))
    assert {"car", "island", "kind 99", "person 1 moves", "contact, 0.1 s"} <= labels(figure)
    assert "person" not in labels(figure), "what stands far outside of the picture needs no line in the legend"
    assert [p.name for p in write_plots(Recording(path), tmp_path)] == ["course.png", "speed.png"]
