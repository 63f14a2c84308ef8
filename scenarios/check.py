"""Check: run scenarios, judge them, compare them with golden metrics. The regression test of a change.

Runs are spread over processes, longest first; the outcomes are in the order of scenario and seed. Criteria decide
PASS or FAIL; a golden metric that left its tolerance is reported beside the verdict and fails the check as well, except
where a module was swapped with `uses`: then it only says what the module changed.
"""

import contextlib
import difflib
import fnmatch
import math
import os
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from autonomy.wiring import stack_with
from hal.bus import Level
from rtdb.recording import Recording

from .goldens import Comparison, Golden, compare, golden_path, load_golden, save, updated
from .judge import Criterion, Finding, Result, Verdict, judge
from .metrics import METRICS, Measured
from .onset import Onset
from .pool import Lost, spread
from .scenario import SUFFIX, Scenario, ScenarioError, library, load_scenario

ALL_GOOD, FAILED, BROKEN = 0, 1, 3  # exit status, as of `fairway drive`
MOVES_OF_FAILED = 3


@dataclass(frozen=True, slots=True)
class Task:
    """One seed of one scenario, to run into a folder. `strict`: a golden metric that moved is a failure."""

    file: Path
    scenario: Scenario
    seed: int
    folder: Path
    uses: tuple[str, ...] = ()
    level: Level = "wire"
    golden: Golden | None = None
    strict: bool = True

    @property
    def limit_s(self) -> float:
        """Wall time after which a hanging run is given up; far more than a run takes, so that load decides nothing."""
        return 120.0 + 2.0 * self.scenario.duration_s


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of one task. `golden` is None where no golden values are kept for this seed.

    since: when a criterion, or a golden metric's tolerance, was first broken, by metric, as far as that can be said.
    """

    task: Task
    result: Result
    golden: Comparison | None
    plots: tuple[Path, ...] = ()
    wall_s: float = 0.0
    since: dict[str, float] = field(default_factory=dict)

    @property
    def moved(self) -> bool:
        """Whether a golden metric left its tolerance."""
        return self.golden is not None and bool(self.golden.moves)

    @property
    def good(self) -> bool:
        """Whether there is nothing to look at."""
        return self.result.verdict is Verdict.PASS and not (self.moved and self.task.strict)

    def complaint(self) -> str:
        """Say in lines what is wrong; empty if nothing is."""
        if self.good:
            return ""
        result = self.result
        what = [*([result.reason] if result.reason else []), *self.say_broken(), *self.say_moves()]
        first, *others = what or ["no reason given"]
        head = f"{result.scenario} seed {result.seed}: {result.verdict}: {first}"
        return "\n  ".join([head, *others, f"look at it: fairway replay {self.task.folder}"])

    def say_broken(self) -> list[str]:
        """Say which criteria broke: value, limit, when. What broke first comes first."""
        broken = [f for f in self.result.findings if f.verdict is not Verdict.PASS]
        return [
            self._say_finding(f) for f in sorted(broken, key=lambda f: self.since.get(f.criterion.metric, math.inf))
        ]

    def _say_finding(self, finding: Finding) -> str:
        c, m = finding.criterion, finding.measured
        when = "" if m is None else f", at {m.at_s:.2f} s" if m.at_s is not None else ", at the end"
        since = f", since {self.since[c.metric]:.2f} s" if c.metric in self.since else ""
        worst = f", worst{when[1:]}" if since and when else when
        return (
            f"{c.metric} {say(c.metric, m.value if m else None)}, wanted {c.op} {say(c.metric, c.limit)}{since}{worst}"
        )

    def say_moves(self) -> list[str]:
        """Say which golden metrics moved: from, to, tolerance, since when. Of a drive that failed, the first few."""
        moves = sorted(self.golden.moves if self.golden else (), key=lambda m: self.since.get(m.metric, math.inf))
        shown = moves if self.result.verdict is Verdict.PASS else moves[:MOVES_OF_FAILED]
        lines = [
            f"golden {m.metric} moved: {say(m.metric, m.was)} -> {say(m.metric, m.now)}, tolerance "
            f"{say(m.metric, m.tolerance)}"
            + (f", since {self.since[m.metric]:.2f} s" if m.metric in self.since else "")
            for m in shown
        ]
        return lines + ([f"golden: {len(moves) - len(shown)} more moved"] if len(moves) > len(shown) else [])


@dataclass(frozen=True, slots=True)
class Report:
    """What came of a check. `updates`: what an update of golden values changed, as lines."""

    outcomes: tuple[Outcome, ...]
    updates: tuple[str, ...]
    wall_s: float

    @property
    def status(self) -> int:
        """Exit status: 0 all pass and nothing moved, 1 a criterion or golden metric broke, 3 an ERROR or INVALID."""
        if any(o.result.verdict in (Verdict.ERROR, Verdict.INVALID) for o in self.outcomes):
            return BROKEN
        return ALL_GOOD if all(o.good for o in self.outcomes) else FAILED


def say(metric: str, value: float | None) -> str:
    """Print a metric's value with its unit."""
    unit = METRICS[metric].unit if metric in METRICS else ""
    if value is None or math.isinf(value):
        return "not measured" if value is None else "never"
    return f"{value:.4g} {unit}".strip()


# -- what to run ------------------------------------------------------------------------------------------------------


def select(patterns: Sequence[str] = (), tags: Sequence[str] = ()) -> list[tuple[Path, Scenario]]:
    """Choose scenarios by id, pattern of ids, file or folder, and by tag; all that ship where no pattern is given."""
    files: dict[Path, None] = dict.fromkeys(library().values()) if not patterns else {}
    for pattern in patterns:
        files.update(dict.fromkeys(_matching(pattern)))
    loaded = sorted(((path, load_scenario(str(path))) for path in files), key=lambda item: item[1].id)
    for (a, first), (b, second) in pairwise(loaded):
        if first.id == second.id:
            raise ScenarioError(f"{a} and {b} have the same id, {first.id}")
    chosen = [(path, plan) for path, plan in loaded if not tags or set(tags) & set(plan.tags)]
    if not chosen:
        there = sorted({tag for _, plan in loaded for tag in plan.tags})
        raise ScenarioError(f"no scenario here has the tag {', '.join(tags)}; there are {', '.join(there) or 'none'}")
    return chosen


def _matching(pattern: str) -> list[Path]:
    if pattern.endswith((".yaml", ".yml")):
        return [Path(pattern)]
    ids = library()
    if pattern in ids:
        return [ids[pattern]]
    found = [path for name, path in ids.items() if fnmatch.fnmatch(name, pattern) or name.startswith(f"{pattern}/")]
    if not found and Path(pattern).is_dir():
        found = sorted(Path(pattern).rglob(f"*{SUFFIX}"))
    if not found:
        near = difflib.get_close_matches(pattern, ids, n=1)
        raise ScenarioError(
            f"no scenario {pattern!r}" + (f"; did you mean {near[0]}?" if near else f"; there are {', '.join(ids)}")
        )
    return found


def shard_of(text: str) -> tuple[int, int]:
    """Read "i/n", the i-th of n parts, 1 <= i <= n."""
    i, _, n = text.partition("/")
    if not (i.isdecimal() and n.isdecimal() and 1 <= int(i) <= int(n)):
        raise ScenarioError(f"--shard {text}: expected i/n with 1 <= i <= n, such as 1/4")
    return int(i), int(n)


# -- one run ----------------------------------------------------------------------------------------------------------


def run_one(task: Task) -> Outcome:
    """Run, judge and compare one seed; whatever goes wrong is in the outcome. What modules print goes to log.txt."""
    begun_s = time.monotonic()
    task.folder.mkdir(parents=True, exist_ok=True)
    (task.folder / "result.json").unlink(missing_ok=True)  # an old verdict must not stand beside a new recording
    log_file = task.folder / "log.txt"
    with log_file.open("w") as log, contextlib.redirect_stdout(log), contextlib.redirect_stderr(log):
        result = _drive_and_judge(task)
        golden = compare(task.golden, result)
        since: dict[str, float] = {}
        plots: tuple[Path, ...] = ()
        if not Outcome(task, result, golden).good and (task.folder / "run.mcap").exists():
            since, plots = _explain(task, result, golden)
    if not log_file.stat().st_size:
        log_file.unlink()
    result.write(task.folder / "result.json")
    return Outcome(task, result, golden, plots, time.monotonic() - begun_s, since)


def _drive_and_judge(task: Task) -> Result:
    from .run import Setup, drive

    recording = task.folder / "run.mcap"
    recording.unlink(missing_ok=True)
    try:
        setup = Setup(
            scenario=task.scenario,
            seed=task.seed,
            level=task.level,
            stack=stack_with(task.scenario.stack_path(), task.uses),
            faults=task.folder,
        )
        drive(setup, recording)
        return judge(Recording(recording), task.scenario.parsed_criteria)
    except ScenarioError as error:
        return failed(task, Verdict.INVALID, str(error))
    except Exception as error:  # a broken run is an outcome, not the end of the check
        traceback.print_exc()
        return failed(task, Verdict.ERROR, f"{type(error).__name__}: {error}")


def _explain(task: Task, result: Result, golden: Comparison | None) -> tuple[dict[str, float], tuple[Path, ...]]:
    """Find out since when things have been broken, and draw the plots."""
    from .plots import write_plots

    since: dict[str, float] = {}
    try:
        recording = Recording(task.folder / "run.mcap")
        onset = Onset(recording)
        for criterion, measured in _broken(result, golden):
            at_s = onset.since_s(criterion, measured.at_s if measured else None)
            if at_s is not None:
                since[criterion.metric] = at_s
        return since, tuple(write_plots(recording, task.folder, result, since))
    except Exception:  # this explains a verdict; it must not replace it
        traceback.print_exc()
        return since, ()


def _broken(result: Result, golden: Comparison | None) -> Iterable[tuple[Criterion, Measured | None]]:
    """Give failed criteria, and golden metrics that moved as the criterion of staying within the tolerance."""
    failed = [f for f in result.findings if f.verdict is Verdict.FAIL]
    yield from ((f.criterion, f.measured) for f in failed)
    for move in golden.moves if golden else ():
        if move.now is not None and all(f.criterion.metric != move.metric for f in failed):
            op, limit = ("<=", move.was + move.tolerance) if move.now > move.was else (">=", move.was - move.tolerance)
            yield Criterion(move.metric, op, limit), result.metrics.get(move.metric)


def failed(task: Task, verdict: Verdict, reason: str) -> Result:
    """Make the result of a run that gave no recording to judge."""
    return Result(task.scenario.id, task.seed, verdict, (), {}, "", 0.0, reason)


# -- all runs ---------------------------------------------------------------------------------------------------------


def tasks_of(
    chosen: Iterable[tuple[Path, Scenario]],
    *,
    out: Path,
    seeds: int | None = 1,
    uses: Sequence[str] = (),
    level: Level = "wire",
    strict: bool = True,
) -> list[Task]:
    """List what to run: the first `seeds` seeds of each scenario, or with None as many as each file asks for."""
    tasks = []
    for file, scenario in chosen:
        stack_with(
            scenario.stack_path(), uses
        )  # what is wrong with a stack or a student's file is said before anything starts
        golden = load_golden(golden_path(file))
        tasks += [
            Task(file, scenario, seed, out / scenario.id / str(seed), tuple(uses), level, golden, strict)
            for seed in range(seeds if seeds is not None else scenario.seeds)
        ]
    return tasks


def check_scenarios(
    patterns: Sequence[str] = (),
    *,
    tags: Sequence[str] = (),
    seeds: int | None = 1,
    uses: Sequence[str] = (),
    level: Level = "wire",
    jobs: int | None = None,
    out: Path = Path("runs/check"),
    shard: tuple[int, int] = (1, 1),
    update_golden: bool = False,
    progress: Callable[[int, int, Outcome], None] = lambda done, total, outcome: None,
) -> Report:
    """Run scenarios and say which criterion broke and which golden metric moved.

    seeds: how many of each, None for as many as its file asks for; uses: COMPONENT=FILE.py:Class swaps; jobs: worker
    processes, None for one per core, 0 for this process; progress: called after each run with (done, total, outcome).
    """
    if update_golden and uses:
        raise ScenarioError("golden values come from the shipped stack: --update-golden does not go with --use")
    begun_s = time.monotonic()
    strict = not uses and not update_golden
    tasks = tasks_of(select(patterns, tags), out=out, seeds=seeds, uses=uses, level=level, strict=strict)
    tasks.sort(key=lambda task: (-task.scenario.duration_s, task.scenario.id, task.seed))
    tasks = tasks[shard[0] - 1 :: shard[1]]
    outcomes = []
    for outcome in _run_all(tasks, jobs):
        outcomes.append(outcome)
        progress(len(outcomes), len(tasks), outcome)
    outcomes.sort(key=lambda o: (o.task.scenario.id, o.task.seed))
    updates = _update(outcomes) if update_golden else ()
    return Report(tuple(outcomes), updates, time.monotonic() - begun_s)


def _run_all(tasks: list[Task], jobs: int | None) -> Iterable[Outcome]:
    workers = len(os.sched_getaffinity(0)) if jobs is None else jobs
    if not workers:
        yield from map(run_one, tasks)
        return
    for k, outcome in spread(run_one, tasks, workers, lambda task: task.limit_s):
        if isinstance(outcome, Lost):
            result = failed(tasks[k], Verdict.ERROR, outcome.reason)
            tasks[k].folder.mkdir(parents=True, exist_ok=True)
            result.write(tasks[k].folder / "result.json")
            yield Outcome(tasks[k], result, None)
        else:
            yield outcome


def _update(outcomes: Sequence[Outcome]) -> tuple[str, ...]:
    """Write golden values, one file after the other and each whole: a killed update leaves old or new files."""
    lines = []
    for file in dict.fromkeys(o.task.file for o in outcomes):
        of_file = [o for o in outcomes if o.task.file == file]
        old = of_file[0].task.golden
        golden, changes = updated(old, [o.result for o in of_file])
        if golden.seeds and golden != old:
            save(golden_path(file), golden)
        lines += [f"{of_file[0].task.scenario.id} {change}" for change in changes]
    return tuple(lines)
