"""A pytest plugin: scenario files are test files, their seeds are tests.

`pytest -p scenarios.collect FOLDER` runs every `*.scenario.yaml` in a folder. A criterion or a golden metric that broke
is a failure; a module that broke (ERROR) or a scenario that cannot be done (INVALID) is an error: the drive did not get
as far as being judged. Criteria and metrics are properties of the test in the JUnit file.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from .check import Outcome, Task

SUFFIX = ".scenario.yaml"  # as in .scenario, which takes too long to import in a run of pytest that has no scenarios


class CriterionBroke(Exception):
    """A criterion, or the tolerance of a golden metric, does not hold."""


class NotDriven(Exception):
    """There is nothing to judge: the scenario file is wrong, a module broke, or the scenario cannot be done."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options."""
    group = parser.getgroup("fairway", "Fairway's scenarios")
    group.addoption("--scenario-seeds", type=int, metavar="N", help="at most N seeds of each scenario file")
    group.addoption("--scenario-out", type=Path, metavar="DIR", default=Path("runs/pytest"), help="folder for runs")


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """Collect scenario files."""
    return ScenarioFile.from_parent(parent, path=file_path) if file_path.name.endswith(SUFFIX) else None


class ScenarioFile(pytest.File):
    """A scenario file. Its tags are keywords: `-k smoke` chooses by them."""

    def collect(self) -> Iterator["ScenarioSeed"]:
        """Give one test for each seed."""
        from autonomy.module import ModuleError

        from .check import select, tasks_of
        from .scenario import ScenarioError

        try:
            chosen = select([str(self.path)])
            self.extra_keyword_matches.update(chosen[0][1].tags)
            wanted: int | None = self.config.getoption("--scenario-seeds")
            seeds = min(wanted, chosen[0][1].seeds) if wanted is not None else None
            tasks = tasks_of(chosen, out=self.config.getoption("--scenario-out"), seeds=seeds)
        except (ScenarioError, ModuleError) as error:
            raise self.CollectError(str(error)) from error
        for task in tasks:
            yield ScenarioSeed.from_parent(self, name=f"seed-{task.seed}", task=task)


class ScenarioSeed(pytest.Item):
    """One seed of a scenario: `setup` drives, `runtest` judges."""

    def __init__(self, *, task: "Task", **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.task = task
        self.outcome: Outcome | None = None

    def setup(self) -> None:
        """Drive; that nothing came of it is an error of the test, not a failure."""
        from .check import run_one
        from .judge import Verdict

        self.outcome = run_one(self.task)
        self.user_properties += properties(self.outcome)
        if self.outcome.result.verdict in (Verdict.ERROR, Verdict.INVALID):
            raise NotDriven(self.outcome.complaint())

    def runtest(self) -> None:
        """Say what broke."""
        assert self.outcome is not None
        if not self.outcome.good:
            raise CriterionBroke(self.outcome.complaint())

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """Say what broke without a traceback of this file."""
        if isinstance(excinfo.value, CriterionBroke | NotDriven):
            return str(excinfo.value)
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, int, str]:
        """Name the test in headings."""
        return self.path, 0, f"{self.task.scenario.id} seed {self.task.seed}"


def properties(outcome: "Outcome") -> list[tuple[str, object]]:
    """Give verdict, criteria and metrics as properties of a test."""
    result = outcome.result
    out: list[tuple[str, object]] = [("verdict", str(result.verdict)), ("trace", result.trace)]
    for f in result.findings:
        value = f"{f.measured.value:.6g}" if f.measured is not None else "not measured"
        out.append((f"criterion {f.criterion.metric}", f"{value} {f.criterion.op} {f.criterion.limit:g} {f.verdict}"))
    out += [(name, f"{m.value:.6g}") for name, m in result.metrics.items() if m is not None]
    return out
