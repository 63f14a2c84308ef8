"""Judge: criteria over metrics of a recording. It knows no simulator, so it judges a field drive as well."""

import json
import math
import operator
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from hal.signals import ModuleState, ModuleStatus
from rtdb.recording import Recording

from .metrics import METRICS, Evidence, Measured

OPERATORS = {"<=": operator.le, ">=": operator.ge, "==": operator.eq, "<": operator.lt, ">": operator.gt}


class Verdict(StrEnum):
    """What came of a drive, worst last."""

    PASS = "PASS"
    UNKNOWN = "UNKNOWN"
    FAIL = "FAIL"
    ERROR = "ERROR"
    INVALID = "INVALID"


@dataclass(frozen=True, slots=True)
class Criterion:
    """A metric compared with a limit, e.g. `pose_error_max_m: "<= 2.0"`."""

    metric: str
    op: str
    limit: float

    @classmethod
    def parse(cls, metric: str, text: str) -> "Criterion":
        """Make a criterion from what a scenario file says; ValueError says what is wrong."""
        if metric not in METRICS:
            raise ValueError(f"there is no metric {metric}; there are {', '.join(sorted(METRICS))}")
        op, _, number = text.strip().partition(" ")
        try:
            limit = float(number)
            if op not in OPERATORS or not math.isfinite(limit):
                raise ValueError
            return cls(metric, op, limit)
        except ValueError as error:
            raise ValueError(
                f'{metric}: expected an operator, a blank and a number, such as "<= 2.0", got {text!r}'
            ) from error


@dataclass(frozen=True, slots=True)
class Finding:
    """One criterion, judged."""

    criterion: Criterion
    verdict: Verdict
    measured: Measured | None


@dataclass(frozen=True, slots=True)
class Result:
    """What came of one drive. `reason` tells an ERROR or INVALID one apart."""

    scenario: str
    seed: int
    verdict: Verdict
    findings: tuple[Finding, ...]
    metrics: dict[str, Measured | None]
    trace: str
    duration_s: float
    reason: str = ""
    extra: dict[str, Any] = field(default_factory=dict)

    def to_json(self) -> str:
        """Write the result as JSON; infinite values become strings."""

        def number(m: Measured | None) -> Any:
            return None if m is None else m.value if math.isfinite(m.value) else str(m.value)

        return (
            json.dumps(
                {
                    "scenario": self.scenario,
                    "seed": self.seed,
                    "verdict": self.verdict,
                    "reason": self.reason,
                    "duration_s": self.duration_s,
                    "trace": self.trace,
                    "criteria": [
                        {
                            "metric": f.criterion.metric,
                            "op": f.criterion.op,
                            "limit": f.criterion.limit,
                            "unit": METRICS[f.criterion.metric].unit,
                            "value": number(f.measured),
                            "at_s": f.measured.at_s if f.measured else None,
                            "verdict": f.verdict,
                        }
                        for f in self.findings
                    ],
                    "metrics": {name: number(m) for name, m in self.metrics.items()},
                    **self.extra,
                },
                indent=1,
            )
            + "\n"
        )

    def write(self, path: Path) -> None:
        """Write the result into a file, whole or not at all."""
        partial = path.with_suffix(".tmp")
        partial.write_text(self.to_json())
        partial.replace(path)


def find(criterion: Criterion, measured: Measured | None) -> Finding:
    """Judge one criterion; what cannot be measured is UNKNOWN, never PASS."""
    if measured is None:
        return Finding(criterion, Verdict.UNKNOWN, None)
    holds = OPERATORS[criterion.op](measured.value, criterion.limit)
    return Finding(criterion, Verdict.PASS if holds else Verdict.FAIL, measured)


def faults(recording: Recording) -> list[str]:
    """What the hosts said of modules that broke."""
    return [
        f"{topic.removesuffix('/status')}: {row.value.reason}"
        for topic, channel in sorted(recording.channels.items())
        if channel.schema.name == ModuleStatus.__name__
        for row in recording.read(topic, ModuleStatus)
        if row.value.state is ModuleState.FAULT
    ]


def judge(recording: Recording, criteria: tuple[Criterion, ...], *, reason: str = "", broken: str = "") -> Result:
    """Judge a recording. `reason`: why the drive could not be done at all: INVALID; `broken`: what was lost: ERROR."""
    evidence = Evidence(recording)
    metrics = {name: m.measure(evidence) for name, m in METRICS.items()}
    findings = tuple(find(c, metrics[c.metric]) for c in criteria)
    stopped = [*faults(recording), *([broken] if broken else [])]
    worst = max((list(Verdict).index(f.verdict) for f in findings), default=0)
    verdict = Verdict.INVALID if reason else Verdict.ERROR if stopped else list(Verdict)[worst]
    return Result(
        recording.metadata.get("scenario", ""),
        int(recording.metadata.get("seed", "0")),
        verdict,
        findings,
        metrics,
        recording.trace_hash(),
        recording.time_s(recording.last_cycle),
        reason or "; ".join(stopped),
    )
