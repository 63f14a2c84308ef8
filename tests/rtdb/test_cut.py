"""The protocol under two searches for a violation: two processes that race, and one thread that plays all parts.

What these runs do not see is not proved to be absent. That they would see what the naive pass and other small
mistakes get wrong is shown by making the mistakes.
"""

import os
import subprocess
from pathlib import Path

import pytest

import rtdb

CORE = Path(rtdb.__file__).parent / "core"
RACE = Path(__file__).with_name("cut_race.c")
STEPS = Path(__file__).with_name("protocol_steps.c")
UNITS = tuple(sorted(path.name for path in CORE.glob("*.c") if path.name != "_core.c"))
TICKS = 300_000
MUTANT_TICKS = 3_000_000
MUTANT_ROUNDS = 4


def build(folder, source, *flags, core=CORE, units=()):
    program = folder / source.stem
    compiler = [os.environ.get("CC", "cc"), "-std=c11", "-O2", "-Wall", "-Wextra", *flags, f"-I{core}"]
    sources = [str(core / unit) for unit in units]
    subprocess.run([*compiler, *sources, str(source), "-o", str(program)], check=True)
    return program


def run(program, what, name, times):
    """Give the exit status and the numbers that the program printed, by name."""
    done = subprocess.run(
        [str(program), what, name, str(times)], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode in {0, 1}, done.stderr
    words = done.stdout.split()
    return done.returncode, {key: int(value) for key, value in zip(words[::2], words[1::2], strict=True)}


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    return build(tmp_path_factory.mktemp("real"), RACE, "-Werror", units=UNITS)


@pytest.fixture(scope="module")
def mutant(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mutant")
    return build(folder, RACE, "-Werror", "-DFW_MUTANT_NAIVE_PASS", units=UNITS)


def test_no_cut_shows_an_effect_without_its_cause(real, unique):
    status, seen = run(real, "cut", unique(), TICKS)
    assert status == 0, seen
    assert seen["compared"] > TICKS // 2
    assert seen["advanced"] > 20, "the writer stood still: nothing was put to the test"


def test_a_plain_pass_over_the_heads_is_caught(mutant, unique):
    """The same program finds the violation when the protocol is replaced by the obvious one."""
    caught = (run(mutant, "cut", unique(), MUTANT_TICKS) for _ in range(MUTANT_ROUNDS))
    assert any(status == 1 and seen["b"] > seen["a"] for status, seen in caught)


def test_a_reader_of_four_slots_never_takes_half_a_write_for_a_whole_one(real, unique):
    status, seen = run(real, "torn", unique(), 300_000)
    assert status == 0, seen
    assert seen["torn"] == 0
    assert seen["whole"] > 1000
    assert seen["prevented"] > 0, "no write overtook a reader: nothing was put to the test"


def steps(program):
    done = subprocess.run([str(program)], capture_output=True, text=True, timeout=120, check=False)
    return done.returncode, done.stdout


def test_no_single_interruption_breaks_the_protocol(tmp_path):
    assert steps(build(tmp_path, STEPS, "-Werror")) == (0, "whole\n")


# what is wrong, its text in protocol.h, and the mistake
MUTANTS = {
    "a plain pass": ("#ifndef FW_MUTANT_NAIVE_PASS", "#if 0"),
    "base is the write itself": ("FW_STORE(ring->base, w - 1, relaxed)", "FW_STORE(ring->base, w, relaxed)"),
    "the epoch of this tick counts as before it": (
        "FW_LOAD(ring->ep, acquire) >= c",
        "FW_LOAD(ring->ep, acquire) > c",
    ),
    "one slot too many is free": ("w < keep + n", "w <= keep + n"),
    "no slot is kept": ("return !keep || w < keep + n;", "(void)n; (void)w; return 1;"),
    "no mark of a write in progress": ("FW_STORE(slot->seq, 2 * w - 1, relaxed);", "(void)w, (void)slot;"),
    "no second look at the slot": (
        "FW_LOAD(slot->seq, relaxed) == 2 * w ? 0 : -ESTALE",
        "(void)slot, (void)w, 0",
    ),
    "the tail stays": ("if (k >= n) FW_STORE(cuts->tail, k - n + 1, relaxed);", ""),
    "no second look at the tail": ("if (lo && lo - 1 < tail_now) return -ESTALE;", ""),
}


@pytest.mark.parametrize("mistake", MUTANTS)
def test_a_mistake_in_the_protocol_is_caught(mistake, tmp_path):
    right, wrong = MUTANTS[mistake]
    text = (CORE / "protocol.h").read_text()
    assert text.count(right) == 1, f"protocol.h has changed: {right!r}"
    (tmp_path / "protocol.h").write_text(text.replace(right, wrong))
    status, output = steps(build(tmp_path, STEPS, "-w", core=tmp_path))
    assert status == 1, output
