"""Golden metrics: what a scenario measured when somebody last looked and agreed, with the tolerance of each metric.

One JSON file per scenario: for shipped ones in `scenarios/golden`, for others beside the scenario file. Tolerances are
written once and then belong to whoever edits the file: an update leaves them alone. The hash of the trace is only
information, since it is exact on one machine class only.

    {"scenario": "parking-lot/square",
     "tolerances": {"finish_time_s": {"relative": 0.02, "absolute": 0.01}, ...},
     "seeds": {"0": {"trace": "7c0f...", "metrics": {"finish_time_s": 51.28, ...}}}}
"""

import json
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from .judge import Result, Verdict
from .metrics import METRICS
from .scenario import LIBRARY, SUFFIX, load_yaml

GOLDEN = Path(__file__).with_name("golden")
RELATIVE = 0.02
ABSOLUTE = {"": 0.0, "1": 0.02, "s": 0.01, "m": 0.05, "m/s": 0.05, "m/s2": 0.05, "rad": 0.01}  # by unit
ABSOLUTE_ELSE = 0.001


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Tolerance(_Strict):
    """How far a metric may move: relative * |golden value| + absolute."""

    relative: float = Field(ge=0)
    absolute: float = Field(ge=0)

    @classmethod
    def usual(cls, metric: str, value: float) -> "Tolerance":
        """Give the tolerance of a metric that nobody has thought about yet: counts are exact."""
        unit = METRICS[metric].unit
        if unit == "" and value.is_integer():
            return cls(relative=0.0, absolute=0.0)
        return cls(relative=RELATIVE, absolute=ABSOLUTE.get(unit, ABSOLUTE_ELSE))

    def around(self, value: float) -> float:
        """Give the width around a value; a metric that was "never" has to stay so."""
        return self.relative * abs(value) + self.absolute if math.isfinite(value) else 0.0


class Values(_Strict):
    """What one seed measured. What its recording did not allow to measure is not there."""

    trace: str
    metrics: dict[str, float]


class Golden(_Strict):
    """The golden values of one scenario."""

    scenario: str
    tolerances: dict[str, Tolerance]
    seeds: dict[int, Values]


@dataclass(frozen=True, slots=True)
class Move:
    """A metric that left its tolerance. `now` is None where it is not measured any more."""

    metric: str
    was: float
    now: float | None
    tolerance: float


@dataclass(frozen=True, slots=True)
class Comparison:
    """One run against its golden values. `new`: metrics that the file does not know yet."""

    same_trace: bool
    moves: tuple[Move, ...]
    new: tuple[str, ...]


def golden_path(scenario_file: Path) -> Path:
    """Give where the golden values of a scenario file are, whether they exist or not."""
    resolved = scenario_file.resolve()
    if resolved.is_relative_to(LIBRARY.resolve()):
        inside = str(resolved.relative_to(LIBRARY.resolve())).removesuffix(SUFFIX)
        return GOLDEN / f"{inside}.json"
    return scenario_file.with_name(scenario_file.name.removesuffix(SUFFIX) + ".golden.json")


def load_golden(path: Path) -> Golden | None:
    """Read golden values, None if there are none; ScenarioError names file, line and key."""
    try:
        return Golden.model_validate(json.loads(path.read_text()))
    except FileNotFoundError:
        return None
    except (ValueError, ValidationError):
        return load_yaml(path, Golden)  # JSON is YAML, and this reader knows the lines


def compare(golden: Golden | None, result: Result) -> Comparison | None:
    """Compare a result with the golden values of its seed; None where there are none."""
    values = golden.seeds.get(result.seed) if golden else None
    if golden is None or values is None:
        return None
    now = _values(result).metrics
    moves = []
    for metric, was in values.metrics.items():
        width = golden.tolerances[metric].around(was) if metric in golden.tolerances else 0.0
        if not _close(was, now.get(metric), width):
            moves.append(Move(metric, was, now.get(metric), width))
    new = tuple(metric for metric in now if metric not in values.metrics)
    return Comparison(values.trace == result.trace, tuple(moves), new)


def _close(was: float | None, now: float | None, width: float) -> bool:
    if was is None or now is None:
        return was is now
    return was == now or abs(now - was) <= width * (1 + 1e-9) or (math.isnan(was) and math.isnan(now))


def _values(result: Result) -> Values:
    """Give a result's metrics with six digits: more would only make the files change."""
    return Values(
        trace=result.trace,
        metrics={name: float(f"{m.value:.6g}") for name, m in sorted(result.metrics.items()) if m is not None},
    )


def updated(golden: Golden | None, results: Iterable[Result]) -> tuple[Golden, list[str]]:
    """Take over the metrics of results; returns the new golden values and what changed, as lines to print.

    Tolerances that are there stay. Seeds that did not run stay. A drive that did not pass is no example: it is refused.
    """
    results = list(results)
    assert results
    tolerances = dict(golden.tolerances) if golden else {}
    seeds = dict(golden.seeds) if golden else {}
    changes: list[str] = []
    for result in results:
        if result.verdict is not Verdict.PASS:
            changes.append(f"seed {result.seed}: kept as it was: the drive is {result.verdict}")
            continue
        values = _values(result)
        changes += [f"seed {result.seed}: {change}" for change in _changes(seeds.get(result.seed), values)]
        seeds[result.seed] = values
        for metric, value in values.metrics.items():
            tolerances.setdefault(metric, Tolerance.usual(metric, value))
    used = {metric for values in seeds.values() for metric in values.metrics}
    kept = {metric: tolerances[metric] for metric in sorted(used & set(tolerances))}
    return Golden(scenario=results[0].scenario, tolerances=kept, seeds=dict(sorted(seeds.items()))), changes


def _changes(was: Values | None, now: Values) -> list[str]:
    if was is None:
        return ["new"]
    names = [m for m in sorted({*was.metrics, *now.metrics}) if not _close(was.metrics.get(m), now.metrics.get(m), 0.0)]
    lines = [f"{m} {_say(m, was.metrics.get(m))} -> {_say(m, now.metrics.get(m))}" for m in names]
    return lines or (["trace only"] if was.trace != now.trace else [])


def _say(metric: str, value: float | None) -> str:
    unit = METRICS[metric].unit if metric in METRICS else ""
    return "not measured" if value is None else f"{value:.6g} {unit}".strip()


def save(path: Path, golden: Golden) -> None:
    """Write golden values, whole or not at all."""

    tolerances = {metric: tolerance.model_dump() for metric, tolerance in golden.tolerances.items()}
    seeds = [
        f'"{seed}": {{\n   "trace": {json.dumps(v.trace)},\n   "metrics": {_block(v.metrics, 4)}\n  }}'
        for seed, v in golden.seeds.items()
    ]
    text = (
        f'{{\n "scenario": {json.dumps(golden.scenario)},\n "tolerances": {_block(tolerances, 2)},\n'
        f' "seeds": {{\n  {f",{chr(10)}  ".join(seeds)}\n }}\n}}\n'
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        partial.write_text(text)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _block(entries: Mapping[str, object], indent: int) -> str:
    """Write an object with one entry on each line, so that an edit and a difference are one line each."""
    blank = "\n" + " " * indent
    lines = [f"{json.dumps(name)}: {json.dumps(_number(value))}" for name, value in entries.items()]
    return "{" + blank + f",{blank}".join(lines) + "\n" + " " * (indent - 1) + "}"


def _number(value: object) -> object:
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
