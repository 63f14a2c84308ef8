"""Commands for whoever changes something: ls, check, diff, schema; and what to try after a drive.

Every import that costs time stands inside a command's body.
"""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from .check import Outcome, Report

SAME, DIFFERENT = 0, 1


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command("ls")(ls)
    app.command()(check)
    app.command()(diff)
    app.command()(schema)


def ls(
    patterns: Annotated[
        list[str] | None, typer.Argument(help="Ids, patterns such as 'safety/*', files or folders.")
    ] = None,
    tag: Annotated[list[str] | None, typer.Option(help="Only scenarios with this tag.")] = None,
) -> None:
    """List scenarios."""
    from rich.table import Table

    from .check import select

    table = Table(box=None, pad_edge=False)
    for heading in ("scenario", "tags", "seeds", "at most", "about"):
        right = heading in ("seeds", "at most")
        table.add_column(heading, justify="right" if right else "left", no_wrap=heading == "scenario", overflow="fold")
    for _, plan in select(patterns or [], tag or []):
        about = plan.about.strip().partition(". ")[0].rstrip(".")
        table.add_row(plan.id, " ".join(plan.tags), str(plan.seeds), f"{plan.duration_s:g} s", about)
    _console().print(table)


def check(
    patterns: Annotated[
        list[str] | None, typer.Argument(help="Ids, patterns such as 'safety/*', files or folders. Default: all.")
    ] = None,
    tag: Annotated[list[str] | None, typer.Option(help="Only scenarios with this tag, e.g. smoke.")] = None,
    jobs: Annotated[
        int | None, typer.Option(help="Processes; 0 runs in this one. Default: one per core.", min=0)
    ] = None,
    seeds: Annotated[int, typer.Option(help="Seeds 0 to N-1 of each scenario.", min=1)] = 1,
    all_seeds: Annotated[bool, typer.Option("--all-seeds", help="As many seeds as each scenario asks for.")] = False,
    use: Annotated[
        list[str] | None, typer.Option(help="COMPONENT=FILE.py:Class swaps one module of every stack.")
    ] = None,
    level: Annotated[str, typer.Option(help="direct (messages) or wire (true bytes).")] = "wire",
    shard: Annotated[str, typer.Option(help="i/n: only the i-th of n parts, for several machines.")] = "1/1",
    out: Annotated[Path, typer.Option(help="Folder for runs.")] = Path("runs/check"),
    update_golden: Annotated[
        bool,
        typer.Option("--update-golden", help="Take the metrics of drives that pass as golden; print what changed."),
    ] = False,
) -> None:
    """Run scenarios, judge them, compare them with golden metrics.

    Exit status: 0 all pass, 1 a criterion or a golden metric broke, 2 bad input, 3 ERROR or INVALID.
    """
    from .check import check_scenarios, shard_of

    if level not in ("direct", "wire"):
        raise typer.BadParameter(f"{level!r} is not one of direct, wire", param_hint="--level")
    with _Progress() as progress:
        report = check_scenarios(
            patterns or [],
            tags=tag or [],
            seeds=None if all_seeds else seeds,
            uses=use or [],
            level="direct" if level == "direct" else "wire",
            jobs=jobs,
            out=out,
            shard=shard_of(shard),
            update_golden=update_golden,
            progress=progress.tell,
        )
    show_report(_console(), report)
    raise typer.Exit(report.status)


def _console() -> "Console":
    """Give standard output; in a log or a pipe lines are wide, so that nothing is folded that somebody may search."""
    from rich.console import Console

    return Console() if sys.stdout.isatty() else Console(width=180)


class _Progress:
    """What has been done, on standard error: a bar on a terminal, else one line for each run."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        self._console = Console(stderr=True)
        self._bar = Progress(
            TextColumn("check"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.description}"),
            console=self._console,
            transient=True,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task("", total=None)

    def tell(self, done: int, total: int, outcome: "Outcome") -> None:
        what = f"{outcome.result.scenario} seed {outcome.result.seed}: {outcome.result.verdict}"
        if self._console.is_terminal:
            self._bar.update(self._task, completed=done, total=total, description=what)
        else:
            print(f"{done}/{total} {what}, {outcome.wall_s:.1f} s", file=sys.stderr, flush=True)

    def __enter__(self) -> "_Progress":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()


def show_report(console: "Console", report: "Report") -> None:
    """Print a check: a table with a line for each scenario and each thing that broke, then where to look."""
    from rich.markup import escape
    from rich.table import Table

    from .report import COLOUR, print_line

    table = Table(box=None, pad_edge=False)
    for heading in ("scenario", "seed", "verdict", "golden", "what broke"):
        table.add_column(heading, no_wrap=heading in ("scenario", "verdict"), overflow="fold")
    for outcomes in _grouped(report.outcomes):
        result, colour = outcomes[0].result, COLOUR[outcomes[0].result.verdict]
        broke = [escape(result.reason)] if result.reason else []
        broke += outcomes[0].say_broken()
        verdict = f"[{colour}]{result.verdict}[/{colour}]"
        first, *others = broke or [""]
        table.add_row(result.scenario, _seeds(outcomes), verdict, _golden(outcomes[0]), first)
        for text in others:
            table.add_row("", "", "", "", text)
    console.print(table)
    bad = [o for o in report.outcomes if not o.good]
    for outcome in report.outcomes:
        head = f"{outcome.result.scenario} seed {outcome.result.seed}"
        for text in outcome.say_moves():
            print_line(console, f"{head}: {text}")
        if not outcome.good:
            plots = f" and {', '.join(path.name for path in outcome.plots)} there" if outcome.plots else ""
            print_line(console, f"{head}: look at it: fairway replay {outcome.task.folder}{plots}")
    for text in report.updates:
        print_line(console, f"golden: {text}")
    total = len(report.outcomes)
    said = f"all {total} good" if not bad else f"{len(bad)} of {total} to look at"
    print_line(console, f"{said}, {report.wall_s:.1f} s")


def _grouped(outcomes: "tuple[Outcome, ...]") -> "list[list[Outcome]]":
    """Put seeds of one scenario that went well the same way on one line."""
    groups: list[list[Outcome]] = []
    for outcome in outcomes:
        last = groups[-1][0] if groups else None
        if (
            last is not None
            and outcome.good
            and last.good
            and last.result.scenario == outcome.result.scenario
            and _golden(last) == _golden(outcome)
        ):
            groups[-1].append(outcome)
        else:
            groups.append([outcome])
    return groups


def _seeds(outcomes: "list[Outcome]") -> str:
    first, last = outcomes[0].task.seed, outcomes[-1].task.seed
    return str(first) if first == last else f"{first}-{last}"


def _golden(outcome: "Outcome") -> str:
    found = outcome.golden
    if found is None:
        return "none kept"
    if found.moves:
        return f"{len(found.moves)} moved"
    return "same trace" if found.same_trace else "in tolerance"


def diff(
    left: Annotated[Path, typer.Argument(help="A run's folder, or an .mcap file.")],
    right: Annotated[Path, typer.Argument(help="Another one.")],
) -> None:
    """Name the first field in which the traces of two runs differ.

    Exit status: 0 same trace, 1 they differ, 2 bad input.
    """
    from .diff import first_difference, metadata_differences, open_recording

    a, b = open_recording(left), open_recording(right)
    for key, x, y in metadata_differences(a, b):
        typer.echo(f"{key}: {x} | {y}")
    for recording in (a, b):
        if not recording.complete:
            typer.echo(f"{recording.path} ends early: its process was stopped")
    found = first_difference(a, b)
    if found is None:
        numbers = "" if a.trace_hash() == b.trace_hash() else "; the files number their objects differently"
        typer.echo(f"same trace: {a.trace_hash()[:16]}, {a.time_s(a.last_cycle):.2f} s{numbers}")
        raise typer.Exit(SAME)
    typer.echo(f"first difference in cycle {found.cycle}, at {found.at_s:.2f} s: {found.topic} {found.field}")
    typer.echo(f"  {left}: {_value(found.left)}")
    typer.echo(f"  {right}: {_value(found.right)}")
    if found.also:
        typer.echo(f"in the same cycle also: {', '.join(found.also)}")
    raise typer.Exit(DIFFERENT)


def _value(value: object) -> str:
    return "nothing" if value is None else repr(value) if isinstance(value, float) else str(value)


def schema() -> None:
    """Print the JSON Schema of scenario files, for editors.

    Save it, `fairway schema > scenario.schema.json`, and begin a scenario file with the line
    `# yaml-language-server: $schema=scenario.schema.json`.
    """
    import json

    from .schema import scenario_schema

    typer.echo(json.dumps(scenario_schema(), indent=1))


def after_drive(console: "Console", folder: Path, scenario: str, seed: int, same: str = "") -> None:
    """Print where a drive's files are, and the three commands worth trying next.

    scenario: as the user named it; same: the options that another drive of the same kind needs.
    """
    from .report import print_files, print_line

    print_files(console, folder)
    runs = (path.parent for path in sorted(folder.parent.glob("*/run.mcap")))
    other = next((run for run in runs if run != folder and not run.name.endswith("-real")), None)
    commands = [
        (f"fairway replay {folder}", "see what the cart saw, believed and did"),
        (f"fairway drive {scenario}{same} --seed {seed + 1}", "drive with other randomness"),
        (f"fairway diff {other} {folder}", "see where this drive and another part")
        if other
        else ("fairway check --tag smoke", "drive a set and compare with golden metrics"),
    ]
    wide = max(len(command) for command, _ in commands)
    print_line(console, "try next")
    for command, purpose in commands:
        print_line(console, f"  {command:{wide}}  {purpose}")
