"""Diff: the first field in which two traces part, and nothing else."""

from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from rtdb import HOST_DEPENDENT, Record, RecordingError, Store
from rtdb.recorder import Recorder
from rtdb.records import array, f8, i64
from scenarios.cli_regression import register
from scenarios.diff import first_difference, metadata_differences, open_recording

app = typer.Typer()
register(app)


class Where(Record, frozen=True):
    """A record to compare."""

    x_m: Annotated[float, f8("m", "east")] = 0.0
    n: Annotated[int, i64("", "number")] = 0
    p: Annotated[tuple[float, ...], array("f8", 3, "m2", "some")] = (0.0,) * 3


def record(folder, *, change=None, ticks=20, extra=False, late_ns=0, metadata=None):
    """Record `ticks` cycles of two objects; change: {(cycle, object): value} instead of what the others write."""
    folder.mkdir(parents=True, exist_ok=True)
    change = change or {}
    with Store.create(None) as store:
        if extra:
            store.join("aa").insert("first", Where)  # takes the first number in the file
        a, b = store.join("a").insert("one", Where), store.join("b").insert("two", Where, n_causes=1)
        pid = store.join("host").insert("pid", Where, flags=HOST_DEPENDENT)
        said = {"scenario": "test", "seed": "0", "level": "wire", "version": "1", **(metadata or {})}
        with Recorder(folder / "run.mcap", [store], said) as recorder:
            for k in range(1, ticks + 1):
                write = a.write(change.get((k, "a"), Where(k / 3, k, (1.0, 2.0, k))), store.now_ns + late_ns)
                if change.get((k, "b"), True):
                    b.write(change.get((k, "b"), Where(-k, k)), store.now_ns, ((a.oid, write),))
                pid.write(Where(n=id(folder) + k))
                store.tick()
                recorder.record()
    return folder


@pytest.fixture
def plain(tmp_path):
    return record(tmp_path / "plain")


def between(left, right):
    return first_difference(open_recording(left), open_recording(right))


def test_the_same_run_twice_has_the_same_trace(plain, tmp_path):
    assert between(plain, record(tmp_path / "again")) is None


def test_the_first_differing_field_is_named_with_cycle_and_both_values(plain, tmp_path):
    other = record(tmp_path / "other", change={(7, "a"): Where(7 / 3, 70, (1.0, 2.0, 7.0)), (9, "a"): Where(5.0)})
    found = between(plain, other)
    assert (found.cycle, found.topic, found.field, found.left, found.right) == (7, "a/one", "n", 7, 70)
    assert found.at_s == pytest.approx(0.07)


def test_an_element_of_an_array_is_named_with_its_index(plain, tmp_path):
    other = record(tmp_path / "other", change={(4, "a"): Where(4 / 3, 4, (1.0, 2.5, 4.0))})
    found = between(plain, other)
    assert (found.field, found.left, found.right) == ("p[1]", 2.0, 2.5)


def test_a_write_that_one_side_has_not_is_a_difference(plain, tmp_path):
    found = between(plain, record(tmp_path / "other", change={(5, "b"): None}))
    assert (found.cycle, found.topic, found.field, found.left, found.right) == (5, "b/two", "write", "number 5", None)


def test_a_run_that_ends_earlier_differs_where_it_ends(plain, tmp_path):
    found = between(plain, record(tmp_path / "other", ticks=15))
    assert (found.cycle, found.field, found.right) == (16, "write", None)


def test_data_time_alone_is_a_difference(plain, tmp_path):
    found = between(plain, record(tmp_path / "other", late_ns=5_000_000))
    assert (found.cycle, found.topic, found.field) == (1, "a/one", "data time")


def test_an_object_more_does_not_make_the_others_differ(plain, tmp_path):
    """Numbers of objects in the file shift, and causes are told by number; diff compares names."""
    assert between(plain, record(tmp_path / "other", extra=True)) is None


def test_the_other_objects_of_that_cycle_are_listed(plain, tmp_path):
    found = between(plain, record(tmp_path / "other", change={(3, "a"): Where(0.5), (3, "b"): Where(0.5)}))
    assert (found.topic, found.also) == ("a/one", ("b/two",))


def test_what_depends_on_the_host_is_no_difference(plain, tmp_path):
    """The object host/pid differs in every recording of this file."""
    assert between(plain, record(tmp_path / "a folder with another id")) is None


def test_metadata_differences_are_told(plain, tmp_path):
    other = record(tmp_path / "other", metadata={"seed": "3", "level": "direct"})
    pairs = metadata_differences(open_recording(plain), open_recording(other))
    assert ("seed", "0", "3") in pairs
    assert ("level", "wire", "direct") in pairs
    assert all(key not in ("scenario", "version") for key, *_ in pairs)


def test_the_command_exits_with_0_for_the_same_trace_and_takes_folders_and_files(plain, tmp_path):
    other = record(tmp_path / "other", metadata={"level": "direct"})
    done = CliRunner().invoke(app, ["diff", str(plain), str(other / "run.mcap")])
    assert done.exit_code == 0
    assert "same trace" in done.output
    assert "level: wire | direct" in done.output


def test_the_command_exits_with_1_and_names_the_field(plain, tmp_path):
    other = record(tmp_path / "other", change={(7, "a"): Where(2.5, 7, (1.0, 2.0, 7.0))})
    done = CliRunner().invoke(app, ["diff", str(plain), str(other)])
    assert done.exit_code == 1
    assert "cycle 7, at 0.07 s: a/one x_m" in done.output
    assert "2.5" in done.output


def test_what_is_no_recording_is_refused_with_what_was_expected(tmp_path):
    with pytest.raises(RecordingError, match="expected a run's folder"):
        open_recording(tmp_path)
