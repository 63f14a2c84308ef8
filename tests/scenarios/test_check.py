"""Check: what broke, since when, what moved against the golden values; and nothing is half-written or left running."""

import io
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

import autonomy.follow
from autonomy.module import ModuleError
from scenarios import goldens, pool
from scenarios.check import check_scenarios, select, shard_of
from scenarios.cli_regression import after_drive, register, show_report
from scenarios.goldens import Golden, Tolerance, Values, compare, golden_path, load_golden, save, updated
from scenarios.judge import Result, Verdict
from scenarios.metrics import METRICS, Measured
from scenarios.scenario import LIBRARY, ScenarioError, library
from scenarios.schema import scenario_schema

app = typer.Typer()
register(app)

SHORT = """\
id: {id}
about: A short straight.
site: pad
course:
  speed_mps: 3.0
  waypoints:
    - {{east_m: {east_m}, north_m: 0, radius_m: 2}}
duration_s: {duration_s}
seeds: 2
tags: [mine, {tag}]
criteria:
  waypoints_missed: "== 0"
  course_deviation_max_m: "<= 1.0"
"""


def write_short(folder, name="short", tag="one", east_m=8, duration_s=12):
    path = folder / f"{name}.scenario.yaml"
    path.write_text(SHORT.format(id=f"test/{name}", tag=tag, east_m=east_m, duration_s=duration_s))
    return path


@pytest.fixture
def short(tmp_path):
    return write_short(tmp_path)


def check(file, out, **options):
    return check_scenarios([str(file)], out=out, jobs=0, **options)


# -- which -------------------------------------------------------------------------------------------------------------


def test_without_a_pattern_all_that_ship_are_chosen_in_the_order_of_their_ids():
    assert [plan.id for _, plan in select()] == sorted(library())


def test_a_pattern_is_an_id_a_glob_a_prefix_a_file_or_a_folder(tmp_path, short):
    assert [plan.id for _, plan in select(["parking-lot/square"])] == ["parking-lot/square"]
    assert {plan.id for _, plan in select(["*/square"])} == {"parking-lot/square"}
    assert all(plan.id.startswith("safety/") for _, plan in select(["safety"]))
    assert [plan.id for _, plan in select([str(short)])] == ["test/short"]
    assert [plan.id for _, plan in select([str(tmp_path)])] == ["test/short"]


def test_tags_choose_and_an_unknown_one_is_named_with_those_that_are_there(tmp_path, short):
    write_short(tmp_path, "other", tag="two")
    assert [plan.id for _, plan in select([str(tmp_path)], ["two"])] == ["test/other"]
    with pytest.raises(ScenarioError, match="no scenario here has the tag three; there are mine, one, two"):
        select([str(tmp_path)], ["three"])


def test_a_pattern_that_matches_nothing_is_refused_with_a_near_one():
    with pytest.raises(ScenarioError, match="did you mean parking-lot/square"):
        select(["parking-lot/sqare"])


def test_two_files_with_one_id_are_refused(tmp_path, short):
    (tmp_path / "copy.scenario.yaml").write_text(short.read_text())
    with pytest.raises(ScenarioError, match="have the same id, test/short"):
        select([str(tmp_path)])


@pytest.mark.parametrize("text", ["0/2", "3/2", "1", "a/b", "1/0", "-1/2"])
def test_a_shard_is_one_of_its_parts(text):
    assert shard_of("2/3") == (2, 3)
    with pytest.raises(ScenarioError, match="expected i/n"):
        shard_of(text)


# -- verdicts ----------------------------------------------------------------------------------------------------------


def test_a_drive_that_passes_is_good_and_leaves_recording_and_result_but_no_plots(tmp_path, short):
    report = check(short, tmp_path / "out")
    assert report.status == 0
    assert report.outcomes[0].complaint() == ""
    left = {path.name for path in (tmp_path / "out/test/short/0").iterdir()}
    assert left == {"run.mcap", "result.json"}


def test_flipping_the_followers_sign_is_found_with_criterion_and_moment(tmp_path):
    """The promise of the project: which criterion broke, when, and plots that show it."""
    source = Path(autonomy.follow.__file__).read_text()
    flipped, n = re.subn(r"\bsteer_rad=steer_rad\b", "steer_rad=-steer_rad", source)
    assert n >= 1, "the follower commands its steering in another way now; flip the sign there"
    module = tmp_path / "flipped.py"
    module.write_text(flipped)
    file = write_short(tmp_path, east_m=30)
    check(file, tmp_path / "right", update_golden=True)
    report = check(file, tmp_path / "out", uses=[f"follow={module}:Follow"])
    outcome = report.outcomes[0]
    assert report.status == 1
    assert outcome.result.verdict is Verdict.FAIL
    worst = outcome.result.metrics["course_deviation_max_m"]
    since_s = outcome.since["course_deviation_max_m"]
    assert 1.0 < since_s < worst.at_s <= 12.0
    assert re.match(
        r"test/short seed 0: FAIL: course_deviation_max_m \S+ m, wanted <= 1 m, since \d+\.\d\d s, worst at",
        outcome.complaint(),
    )
    assert {path.name for path in outcome.plots} >= {"course.png", "error.png"}
    assert "fairway replay" in outcome.complaint()


def test_the_moment_is_the_first_at_which_the_recording_breaks_the_criterion(tmp_path, short):
    from rtdb.recording import Recording
    from scenarios.judge import Criterion
    from scenarios.metrics import Evidence
    from scenarios.onset import Onset

    check(short, tmp_path / "out")
    recording = Recording(tmp_path / "out/test/short/0/run.mcap")
    worst = METRICS["decel_max_mps2"].measure(Evidence(recording))
    limit = worst.value / 2
    first = next(row for row in Evidence(recording).truth if -row.value.accel_x_mps2 > limit)
    since_s = Onset(recording).since_s(Criterion("decel_max_mps2", "<=", limit), worst.at_s)
    assert since_s == pytest.approx(recording.time_s(first.cycle))
    assert Onset(recording).since_s(Criterion("decel_max_mps2", "<=", worst.value + 1), worst.at_s) is None


@pytest.mark.parametrize(
    ("metric", "text", "stays"),
    [
        ("course_deviation_max_m", "<= 1.0", True),
        ("course_deviation_max_m", ">= 1.0", False),
        ("clearance_min_m", ">= 0.3", True),
        ("clearance_min_m", "<= 0.3", False),
        ("safety_trips", "== 0", True),
        ("final_speed_mps", "<= 0.01", False),
        ("mean_speed_mps", ">= 2.5", False),
    ],
)
def test_a_moment_is_only_given_where_what_is_broken_stays_broken(metric, text, stays):
    from scenarios.judge import Criterion
    from scenarios.onset import stays_broken

    assert stays_broken(Criterion.parse(metric, text)) is stays


def test_a_module_that_raises_is_an_error_with_its_reason_and_status_3(tmp_path, short):
    module = tmp_path / "broken.py"
    module.write_text(
        "from autonomy.follow import Follow as Right\n\n\nclass Follow(Right):\n"
        "    def step(self) -> None:\n        print('about to break')\n        raise ZeroDivisionError('of course')\n"
    )
    report = check(short, tmp_path / "out", uses=[f"follow={module}:Follow"])
    assert report.status == 3
    assert report.outcomes[0].result.verdict is Verdict.ERROR
    assert "of course" in report.outcomes[0].complaint()
    assert "about to break" in (tmp_path / "out/test/short/0/log.txt").read_text()


def test_a_scenario_that_cannot_be_done_is_invalid(tmp_path, short, monkeypatch):
    def refuse(*_, **__):
        raise ScenarioError("the start stands in a wall")

    monkeypatch.setattr("scenarios.run.drive", refuse)
    report = check(short, tmp_path / "out")
    assert report.status == 3
    assert report.outcomes[0].result.verdict is Verdict.INVALID
    assert "the start stands in a wall" in report.outcomes[0].complaint()
    assert json.loads((tmp_path / "out/test/short/0/result.json").read_text())["verdict"] == "INVALID"


def test_a_module_that_is_not_there_is_refused_before_anything_runs(tmp_path, short):
    with pytest.raises(ModuleError, match="no such component"):
        check(short, tmp_path / "out", uses=["folow=x.py:Follow"])
    with pytest.raises(ModuleError, match="no file"):
        check(short, tmp_path / "out", uses=["follow=nowhere.py:Follow"])
    assert not (tmp_path / "out").exists()


# -- golden values -----------------------------------------------------------------------------------------------------


def result(seed=0, verdict=Verdict.PASS, trace="t", **metrics):
    measured = {name: None if value is None else Measured(value) for name, value in metrics.items()}
    return Result("test/short", seed, verdict, (), measured, trace, 1.0)


def test_update_keeps_golden_values_beside_the_file_and_the_next_check_has_the_same_trace(tmp_path, short):
    first = check(short, tmp_path / "out", update_golden=True)
    assert first.updates == ("test/short seed 0: new",)
    second = check(short, tmp_path / "out")
    assert second.status == 0
    assert second.outcomes[0].golden.same_trace
    assert check(short, tmp_path / "out", update_golden=True).updates == ()


def test_direct_and_wire_have_the_same_golden_values(tmp_path, short):
    check(short, tmp_path / "out", update_golden=True)
    assert check(short, tmp_path / "out", level="direct").outcomes[0].golden.same_trace


def test_a_golden_metric_that_moved_fails_the_check_and_says_from_what_to_what(tmp_path, short):
    check(short, tmp_path / "out", update_golden=True)
    path = golden_path(short)
    text = path.read_text()
    raw = json.loads(text)
    value = raw["seeds"]["0"]["metrics"]["finish_time_s"]
    raw["seeds"]["0"]["metrics"]["finish_time_s"] = 2 * value
    path.write_text(json.dumps(raw))
    report = check(short, tmp_path / "out")
    assert report.status == 1
    assert report.outcomes[0].result.verdict is Verdict.PASS
    assert (
        f"golden finish_time_s moved: {2 * value:.4g} s -> {value:.4g} s, tolerance" in report.outcomes[0].complaint()
    )
    again = check(short, tmp_path / "out", update_golden=True)
    assert again.status == 0
    assert again.updates == (f"test/short seed 0: finish_time_s {2 * value:.6g} s -> {value:.6g} s",)
    assert path.read_text() == text


def test_a_tolerance_widened_by_hand_holds_and_survives_an_update():
    golden, _ = updated(None, [result(finish_time_s=10.0)])
    assert golden.tolerances["finish_time_s"] == Tolerance(relative=0.02, absolute=0.01)
    assert compare(golden, result(finish_time_s=11.0)).moves[0].metric == "finish_time_s"
    wide = golden.model_copy(update={"tolerances": {"finish_time_s": Tolerance(relative=0.2, absolute=0.0)}})
    assert compare(wide, result(finish_time_s=11.0)).moves == ()
    after, changes = updated(wide, [result(finish_time_s=11.0)])
    assert after.tolerances == wide.tolerances
    assert changes == ["seed 0: finish_time_s 10 s -> 11 s"]


def test_counts_are_exact_and_infinity_is_itself():
    golden, _ = updated(None, [result(waypoints_missed=0.0, finish_time_s=math.inf)])
    assert compare(golden, result(waypoints_missed=0.0, finish_time_s=math.inf)).moves == ()
    moved = compare(golden, result(waypoints_missed=1.0, finish_time_s=9.0)).moves
    assert [move.metric for move in moved] == ["finish_time_s", "waypoints_missed"]


def test_a_metric_that_is_not_measured_any_more_moved_and_a_new_one_did_not():
    golden, _ = updated(None, [result(finish_time_s=10.0)])
    comparison = compare(golden, result(finish_time_s=None, mean_speed_mps=2.0))
    assert [(move.metric, move.now) for move in comparison.moves] == [("finish_time_s", None)]
    assert comparison.new == ("mean_speed_mps",)


def test_another_trace_alone_is_only_information():
    golden, _ = updated(None, [result(trace="one")])
    comparison = compare(golden, result(trace="two"))
    assert not comparison.same_trace
    assert comparison.moves == ()
    assert updated(golden, [result(trace="two")])[1] == ["seed 0: trace only"]


def test_a_drive_that_does_not_pass_is_no_example():
    golden, _ = updated(None, [result(finish_time_s=10.0)])
    after, changes = updated(golden, [result(verdict=Verdict.FAIL, finish_time_s=99.0)])
    assert after == golden
    assert changes == ["seed 0: kept as it was: the drive is FAIL"]


def test_update_does_not_go_with_use(tmp_path, short):
    with pytest.raises(ScenarioError, match="does not go with --use"):
        check(short, tmp_path / "out", update_golden=True, uses=["follow=x.py:Follow"])


def test_golden_values_come_back_from_their_file_as_they_were(tmp_path):
    golden = Golden(
        scenario="test/short",
        tolerances={"finish_time_s": Tolerance(relative=0.02, absolute=0.01)},
        seeds={0: Values(trace="a", metrics={"finish_time_s": math.inf}), 12: Values(trace="b", metrics={"x": 0.1})},
    )
    save(tmp_path / "deep" / "short.json", golden)
    assert load_golden(tmp_path / "deep" / "short.json") == golden
    assert load_golden(tmp_path / "none.json") is None


def test_a_mistake_in_a_golden_file_is_named_with_file_and_line(tmp_path):
    path = tmp_path / "short.golden.json"
    save(path, updated(None, [result(finish_time_s=10.0)])[0])
    path.write_text(path.read_text().replace("absolute", "absolut"))
    with pytest.raises(ScenarioError, match=r"short\.golden\.json:4: tolerances\.finish_time_s"):
        load_golden(path)


def test_an_update_that_is_interrupted_leaves_the_old_file_whole(tmp_path, monkeypatch):
    path = tmp_path / "short.golden.json"
    save(path, updated(None, [result(finish_time_s=10.0)])[0])
    before = path.read_bytes()

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(goldens.Path, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        save(path, updated(None, [result(finish_time_s=20.0)])[0])
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_golden_values_of_shipped_scenarios_are_in_the_package_and_others_beside_their_file(tmp_path):
    shipped = golden_path(LIBRARY / "parking-lot" / "square.scenario.yaml")
    assert shipped == goldens.GOLDEN / "parking-lot" / "square.json"
    assert golden_path(tmp_path / "mine.scenario.yaml") == tmp_path / "mine.golden.json"


# -- processes ---------------------------------------------------------------------------------------------------------


def no_limit(_):
    return 60.0


def test_calls_come_back_from_processes_with_their_index():
    assert sorted(pool.spread(math.sqrt, [4.0, 9.0, 16.0], 2, no_limit)) == [(0, 2.0), (1, 3.0), (2, 4.0)]


def test_a_process_that_dies_takes_only_its_call_along():
    lost = dict(pool.spread(os._exit, [3, 4], 1, no_limit))
    assert [lost[k].reason for k in (0, 1)] == ["its process ended with status 3", "its process ended with status 4"]
    killed = dict(pool.spread(signal.raise_signal, [signal.SIGKILL, 0], 1, no_limit))
    assert killed[0] == pool.Lost("its process ended by signal SIGKILL")
    assert killed[1] is None


def test_a_call_that_hangs_is_given_up_and_the_next_one_is_made():
    answers = dict(pool.spread(time.sleep, [600.0, 0.0], 1, lambda seconds: 1.0 if seconds else 60.0))
    assert answers[0] == pool.Lost("no result after 1 s; its process was ended")
    assert answers[1] is None


def test_outcomes_are_in_the_order_of_scenario_and_seed_however_many_processes_ran(tmp_path):
    write_short(tmp_path, "b", duration_s=13)
    write_short(tmp_path, "a", duration_s=12)
    told = []
    report = check_scenarios(
        [str(tmp_path)],
        out=tmp_path / "out",
        seeds=2,
        jobs=2,
        progress=lambda done, total, outcome: told.append((done, total)),
    )
    assert [(o.result.scenario, o.result.seed) for o in report.outcomes] == [
        ("test/a", 0), ("test/a", 1), ("test/b", 0), ("test/b", 1)
    ]  # fmt: skip
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert report.status == 0


def test_shards_share_the_runs_out_without_rest(tmp_path):
    write_short(tmp_path, "a")
    write_short(tmp_path, "b")
    parts = [check_scenarios([str(tmp_path)], out=tmp_path / "out", jobs=0, shard=(i, 2)).outcomes for i in (1, 2)]
    assert sorted(o.result.scenario for part in parts for o in part) == ["test/a", "test/b"]
    assert all(len(part) == 1 for part in parts)


def test_a_killed_check_changes_no_golden_file_and_leaves_no_process(tmp_path):
    """The workers hold the pipes of standard error; it ends when the last of them has ended."""
    file = write_short(tmp_path)
    check(file, tmp_path / "out", update_golden=True)
    before = golden_path(file).read_bytes()
    code = (
        "import typer; from scenarios.cli_regression import register\n"
        "if __name__ == '__main__':\n    app = typer.Typer(); register(app); app()\n"
    )
    script = tmp_path / "fairway.py"
    script.write_text(code)
    running = subprocess.Popen(
        [sys.executable, str(script), "check", str(file), "--update-golden", "--seeds", "40", "--jobs", "2"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(goldens.__file__).parent.parent)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert running.stderr is not None
    assert "PASS" in running.stderr.readline()
    running.kill()
    running.communicate(timeout=60)
    assert golden_path(file).read_bytes() == before
    assert not list(tmp_path.glob("*.tmp"))


# -- what is printed ---------------------------------------------------------------------------------------------------


def run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_ls_lists_id_tags_seeds_duration_and_purpose():
    done = run("ls")
    assert done.exit_code == 0
    line = next(line for line in done.output.splitlines() if line.startswith("parking-lot/square"))
    assert re.search(r"smoke +\d+ +80 s +A square of 30 m", line)
    assert "parking-lot/square" not in run("ls", "--tag", "safety").output


def test_check_prints_a_line_for_each_run_while_it_goes_and_a_table_at_the_end(tmp_path, short):
    done = run("check", short, "--jobs", "0", "--all-seeds", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert "1/2 test/short seed 0: PASS" in done.stderr
    assert re.search(r"test/short +0-1 +PASS +none kept", done.stdout)
    assert "all 2 good" in done.stdout


def test_check_prints_what_broke_where_it_is_and_how_to_look_at_it(tmp_path, short):
    short.write_text(short.read_text().replace('"<= 1.0"', '"<= 0.0"'))
    done = run("check", short, "--jobs", "0", "--out", tmp_path / "out")
    assert done.exit_code == 1
    folder = tmp_path / "out/test/short/0"
    assert re.search(r"FAIL +none kept +course_deviation_max_m \S+ m, wanted <= 0 m, since", done.stdout)
    assert f"fairway replay {folder}" in done.stdout
    assert "course.png" in done.stdout


def test_a_report_in_a_narrow_terminal_still_names_the_criterion(tmp_path, short):
    short.write_text(short.read_text().replace('"<= 1.0"', '"<= 0.0"'))
    out = io.StringIO()
    show_report(Console(file=out, width=80), check(short, tmp_path / "out"))
    assert "course_deviation_max_m" in out.getvalue()


def test_after_a_drive_paths_and_three_commands_are_printed(tmp_path):
    folder = tmp_path / "runs/parking-lot/square/4"
    folder.mkdir(parents=True)
    (folder / "course.png").touch()
    out = io.StringIO()
    after_drive(Console(file=out, width=80), folder, "parking-lot/square", 4)
    text = out.getvalue()
    assert all(str(folder / name) in text for name in ("run.mcap", "result.json"))
    assert "course.png" in text
    assert len(re.findall(r"^  fairway ", text, re.MULTILINE)) == 3
    assert "fairway drive parking-lot/square --seed 5" in text
    other = folder.with_name("3")
    other.mkdir()
    (other / "run.mcap").touch()
    out = io.StringIO()
    after_drive(Console(file=out, width=80), folder, "parking-lot/square", 4)
    assert f"fairway diff {other} {folder}" in out.getvalue()


def test_the_schema_knows_keys_sites_and_metrics():
    schema = scenario_schema()
    assert json.loads(run("schema").stdout) == schema
    assert schema["additionalProperties"] is False
    assert {"id", "site", "course", "criteria"} <= set(schema["required"])
    assert "pad" in schema["properties"]["site"]["enum"]
    criteria = schema["properties"]["criteria"]["properties"]
    assert set(criteria) == set(METRICS)
    for _, plan in select():
        for metric, text in plan.criteria.items():
            assert re.search(criteria[metric]["pattern"], text), f"{plan.id}: {metric}: {text}"
