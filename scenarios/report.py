"""What a drive prints: a table of criteria, and where things are."""

import math
from pathlib import Path

from rich.console import Console
from rich.table import Table

from .judge import Finding, Result, Verdict
from .metrics import METRICS

COLOUR = {
    Verdict.PASS: "green",
    Verdict.FAIL: "red",
    Verdict.UNKNOWN: "yellow",
    Verdict.ERROR: "red",
    Verdict.INVALID: "yellow",
}


def number(value: float, unit: str) -> str:
    """Print a value with its unit."""
    text = "never" if math.isinf(value) else f"{value:.4g}"
    return f"{text} {unit}".strip() if not math.isinf(value) else text


def row(finding: Finding) -> tuple[str, ...]:
    """Make one line of the table."""
    c, unit = finding.criterion, METRICS[finding.criterion.metric].unit
    value = number(finding.measured.value, unit) if finding.measured else "not measured"
    at = f"{finding.measured.at_s:.2f} s" if finding.measured and finding.measured.at_s is not None else ""
    colour = COLOUR[finding.verdict]
    return c.metric, value, f"{c.op} {number(c.limit, unit)}", at, f"[{colour}]{finding.verdict}[/{colour}]"


def show(console: Console, result: Result) -> None:
    """Print the result of one drive."""
    table = Table(title=f"{result.scenario}, seed {result.seed}", title_justify="left")
    for heading, justify in (
        ("criterion", "left"),
        ("measured", "right"),
        ("wanted", "right"),
        ("at", "right"),
        ("", "left"),
    ):
        table.add_column(heading, justify=justify)  # type: ignore[arg-type]
    for finding in result.findings:
        table.add_row(*row(finding))
    console.print(table)
    colour = COLOUR[result.verdict]
    reason = f": {result.reason}" if result.reason else ""
    console.print(
        f"[bold {colour}]{result.verdict}[/] after {result.duration_s:.1f} s of driving{reason}", highlight=False
    )


def print_files(console: Console, folder: Path) -> None:
    """Print where a drive's files are, and how to run a step again that broke a module."""
    for kept in sorted(folder.glob("*.repro")):
        print_line(console, f"fairway repro {kept}  runs just the step that broke again")
    plots = sorted(path.name for path in folder.glob("*.png"))
    print_line(console, f"recording  {folder / 'run.mcap'}")
    print_line(console, f"result     {folder / 'result.json'}")
    if plots:
        print_line(console, f"plots      {folder}: {', '.join(plots)}")


def print_line(console: Console, text: str) -> None:
    """Print a line as it is: no markup, no colours, no wrapping."""
    console.print(text, highlight=False, soft_wrap=True, markup=False)
