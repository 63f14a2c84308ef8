"""The `fairway` command. Every import that costs time stands inside a command's body."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtdb.cli import app as db_app

if TYPE_CHECKING:
    from autonomy.wiring import Stack

    from .judge import Result
    from .run import Setup

PASS, FAIL, BAD_INPUT, BROKEN, INTERRUPTED = 0, 1, 2, 3, 130

app = typer.Typer(
    help="Fairway: drive a simulated golf cart, look at it, judge it.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
hal_app = typer.Typer(help="Devices and captures.", no_args_is_help=True)
app.add_typer(db_app, name="db")
app.add_typer(hal_app, name="hal")


@app.command()
def drive(
    scenario: Annotated[str, typer.Argument(help="Scenario id, or path of a .scenario.yaml.")] = "parking-lot/square",
    seed: Annotated[int, typer.Option(help="Seed of all randomness.", min=0)] = 0,
    level: Annotated[str, typer.Option(help="direct (messages) or wire (true bytes).")] = "wire",
    out: Annotated[Path, typer.Option(help="Folder for runs.")] = Path("runs"),
    use: Annotated[
        list[str] | None, typer.Option(help="COMPONENT=FILE.py:Class swaps one module of the stack.")
    ] = None,
    db: Annotated[
        str | None, typer.Option(help="Put the store where `fairway db` in another terminal sees it.")
    ] = None,
    pace: Annotated[
        float | None, typer.Option(help="Times real time; 1 is real time. Default: as fast as it goes.", min=0.01)
    ] = None,
) -> None:
    """Drive a scenario and judge it."""
    from rich.console import Console

    from .report import show
    from .run import Setup
    from .scenario import load_scenario

    if level not in ("direct", "wire"):
        raise typer.BadParameter(f"{level!r} is not one of direct, wire", param_hint="--level")
    plan = load_scenario(scenario)
    stack = _stack(plan.stack_path(), use or [])
    folder = out / plan.id / str(seed)
    folder.mkdir(parents=True, exist_ok=True)
    setup = Setup(scenario=plan, seed=seed, level=level, stack=stack, db=db)  # type: ignore[arg-type]
    console = Console()
    result = _drive(setup, folder, pace, console)
    show(console, result, folder)
    raise typer.Exit({"PASS": PASS, "FAIL": FAIL, "UNKNOWN": FAIL}.get(result.verdict, BROKEN))


def _drive(setup: "Setup", folder: Path, pace: float | None, console: object) -> "Result":
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    from rtdb.recording import Recording

    from .judge import judge
    from .run import drive as run_drive

    recording = folder / "run.mcap"
    (folder / "result.json").unlink(missing_ok=True)  # an old verdict must not stand beside a new recording
    assert isinstance(console, Console)
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f} of at most {task.total:.0f} s"),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    ) as bar:
        task = bar.add_task(setup.scenario.id, total=setup.scenario.duration_s)
        try:
            run_drive(setup, recording, pace=pace, progress=lambda t_s: bar.update(task, completed=t_s))
        except KeyboardInterrupt:
            bar.stop()
            kept = f"; the recording up to there is in {recording}" if recording.exists() else ""
            print(f"interrupted{kept}", file=sys.stderr)
            raise typer.Exit(INTERRUPTED) from None
    result = judge(Recording(recording), setup.scenario.parsed_criteria)
    result.write(folder / "result.json")
    return result


def _stack(path: Path, uses: list[str]) -> "Stack":
    from autonomy.module import ModuleError
    from autonomy.wiring import load_stack, make_module

    stack = load_stack(path)
    for use in uses:
        component, separator, module = use.partition("=")
        if not separator:
            raise ModuleError(f"--use {use}: expected COMPONENT=FILE.py:Class")
        stack = stack.use(component, module)
    for wire in stack.wires:
        make_module(wire)  # what is wrong with a student's file is said before anything starts
    return stack


@app.command()
def latency(
    stack: Annotated[str, typer.Argument(help="Name of a shipped stack, or path of a .json.")] = "reference",
) -> None:
    """Compute the latency from sensors to actuators from a stack's wiring."""
    from autonomy.wiring import load_stack

    from .latency import latency as compute
    from .run import TICK_NS
    from .scenario import STACKS

    wiring = load_stack(Path(stack) if stack.endswith(".json") else STACKS / f"{stack}.json")
    tick_ms = TICK_NS / 1e6
    for found in compute(wiring):
        typer.echo(
            f"{found.sensor} -> {wiring.command} -> bus: "
            f"{found.best_ticks * tick_ms:.0f} to {found.worst_ticks * tick_ms:.0f} ms"
        )
    for wire in wiring.wires:
        typer.echo(f"  {wire.component}: every {wire.every * tick_ms:.0f} ms at {wire.phase * tick_ms:.0f} ms")


@hal_app.command()
def play(
    capture: Annotated[Path, typer.Argument(help="Capture of a receiver's bytes, e.g. a gpsd .log.")],
    pace: Annotated[float | None, typer.Option(help="Times real time. Default: as fast as it goes.", min=0.01)] = None,
) -> None:
    """Put a capture of a real GPS receiver through transport, driver, database and localiser."""
    from .play import play as run_play

    for line in run_play(capture, pace):
        typer.echo(line)


def main() -> None:
    """Run the command; what a user can mend is one line on standard error."""
    from autonomy.module import ModuleError
    from hal.errors import HalError
    from rtdb.errors import RtdbError

    try:
        app(standalone_mode=True)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except (RtdbError, HalError, ModuleError) as error:
        print(error, file=sys.stderr)
        sys.exit(BAD_INPUT)
    except OSError as error:
        print(f"{error.filename or ''}: {error.strerror or error}".lstrip(": "), file=sys.stderr)
        sys.exit(BAD_INPUT)
    except ValueError as error:
        from .scenario import ScenarioError

        if not isinstance(error, ScenarioError):
            raise
        print(error, file=sys.stderr)
        sys.exit(BAD_INPUT)


if __name__ == "__main__":
    main()
