"""Processes of every role are killed, at random moments and at every step; who survives goes on."""

import subprocess

import pytest
from c_programs import CORE, build, numbers, run

pytestmark = pytest.mark.proof

KILLS = 320
MISTAKES = {
    "nobody finishes what the dead one began": (
        "if (FW_LOAD(db->dir->intent.kind, relaxed) != FW_NOTHING) carry_out(db);",
        "",
    ),
    "an insert is carried out before it is decided": (
        "    FW_STORE(db->dir->intent.kind, kind, release);\n    carry_out(db);",
        "    if (kind == FW_INSERT) { do_insert(db, &db->dir->intent); return; }\n"
        "    FW_STORE(db->dir->intent.kind, kind, release);\n    carry_out(db);",
    ),
    "what was begun counts as finished too early": (
        "    if (kind == FW_FREE) do_free(db, t);\n",
        "    FW_STORE(t->kind, FW_NOTHING, release);\n    if (kind == FW_FREE) do_free(db, t);\n",
    ),
}


@pytest.fixture(scope="module")
def kills(tmp_path_factory):
    return build(tmp_path_factory.mktemp("kills"), "kills.c")


@pytest.fixture(scope="module")
def steps(tmp_path_factory):
    return build(tmp_path_factory.mktemp("steps"), "kill_steps.c", "-DFW_TEST_KILLS")


def kills_per_operation(done: subprocess.CompletedProcess[str]) -> dict[str, int]:
    """Give how many kills each operation took, of the lines `operation: 7 kills, 0 failures`."""
    parts = [line.rsplit(": ", 1) for line in done.stdout.splitlines() if " kills, " in line]
    return {operation: int(told.split()[0]) for operation, told in parts}


def test_who_survives_a_kill_at_a_random_moment_goes_on_and_nothing_is_torn_or_lost(kills, unique):
    done = run(kills, unique(), KILLS, 1)
    assert done.returncode == 0, done.stdout
    seen = numbers(done)
    assert seen["kills"] == KILLS
    in_mid_write = seen["in_write"] + seen["between_begin_and_commit"]
    assert in_mid_write >= KILLS // 10, seen
    assert all(seen[role] > 0 for role in ("clock", "writer", "reader", "waiter", "churner")), seen
    assert seen["takeovers"] > 0, "no standby took a dead clock over: nothing was put to the test"
    assert seen["torn"] == seen["lost"] == seen["frozen"] == seen["leaked"] == 0


def test_a_change_of_the_directory_that_is_killed_at_any_step_has_happened_or_has_not(steps, unique):
    done = run(steps, "steps", unique())
    assert done.returncode == 0, done.stdout
    at = kills_per_operation(done)
    assert at["insert"] > 10
    assert at["delete"] > 4
    assert at["cascade delete"] > at["delete"]
    assert at["free"] > 4
    assert at["join"] > 4
    assert at["schema_add"] > 0


def test_a_process_may_be_killed_behind_every_store_to_the_segment(steps, unique):
    done = run(steps, "stores", unique())
    if done.returncode == 3:
        pytest.skip("this machine forbids a process to trace its child")
    assert done.returncode == 0, done.stdout
    at = kills_per_operation(done)
    assert all(at.values()), at
    assert sum(at.values()) > 500


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_in_carrying_changes_out_is_caught(mistake, tmp_path, unique):
    right, wrong = MISTAKES[mistake]
    core = tmp_path / "core"
    core.mkdir()
    for path in CORE.glob("*.[ch]"):
        (core / path.name).write_bytes(path.read_bytes())
    text = (core / "directory.c").read_text()
    assert text.count(right) == 1, f"directory.c has changed: {right!r}"
    (core / "directory.c").write_text(text.replace(right, wrong))
    done = run(build(tmp_path, "kill_steps.c", "-DFW_TEST_KILLS", "-w", core=core), "steps", unique())
    assert done.returncode == 1, done.stdout
