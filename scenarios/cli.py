"""The `fairway` command. Every import that costs time stands inside a command's body."""

import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from autonomy.cli import register as register_modules
from rtdb.cli import app as db_app
from rtdb.syncfs.cli import register as register_files

from .cli_regression import register as register_regression
from .cli_running import Listen, Token, Use, tokens_of
from .cli_running import register as register_running
from .ending import end_as_by_ctrl_c
from .folder import Interrupted

if TYPE_CHECKING:
    from rich.console import Console

    from rtdb import Store

    from .judge import Result
    from .replay import LiveView
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
register_regression(app)
register_running(app)
register_modules(app)
register_files(app)


@app.command()
def drive(
    scenario: Annotated[
        str, typer.Argument(help="Scenario id (`fairway ls` lists them), or path of a .scenario.yaml.")
    ] = "p545/field-trial",
    seed: Annotated[int, typer.Option(help="Seed of all randomness.", min=0)] = 0,
    level: Annotated[str, typer.Option(help="direct (messages) or wire (true bytes).")] = "wire",
    plant: Annotated[str, typer.Option(help="compiled, or python: the readable form, for reading along.")] = "compiled",
    randomise: Annotated[
        str, typer.Option(help="none, mild or wide: friction, load, lags, sensor errors from the seed.")
    ] = "none",
    out: Annotated[Path, typer.Option(help="Folder for runs.")] = Path("runs"),
    use: Use = None,
    listen: Listen = None,
    token: Token = None,
    db: Annotated[
        str | None, typer.Option(help="Put the store where `fairway db` in another terminal sees it.")
    ] = None,
    pace: Annotated[
        float | None, typer.Option(help="Times real time; 1 is real time. Default: as fast as it goes.", min=0.01)
    ] = None,
    view: Annotated[
        bool, typer.Option("--view", help="Show the running drive in rerun, at 4 times real time.")
    ] = False,
    by_hand: Annotated[
        bool, typer.Option("--by-hand", help="Drive with the arrow keys, in real time; q ends the drive.")
    ] = False,
    placement: Annotated[str, typer.Option(help="inline, or process: each module in one of its own.")] = "inline",
    shuffle: Annotated[
        int | None, typer.Option(help="Permute order, processes and delays by this seed; the trace stays the same.")
    ] = None,
) -> None:
    """Drive a scenario and judge it."""
    from rich.console import Console

    from autonomy.module import ModuleError
    from autonomy.wiring import stack_with

    from .cli_regression import after_drive
    from .randomise import KINDS
    from .report import show
    from .run import Setup
    from .scenario import load_scenario

    if level not in ("direct", "wire"):
        raise typer.BadParameter(f"{level!r} is not one of direct, wire", param_hint="--level")
    if plant not in ("compiled", "python"):
        raise typer.BadParameter(f"{plant!r} is not one of compiled, python", param_hint="--plant")
    if randomise not in KINDS:
        raise typer.BadParameter(f"{randomise!r} is not one of {', '.join(KINDS)}", param_hint="--randomise")
    if placement not in ("inline", "process"):
        raise typer.BadParameter(f"{placement!r} is not one of inline, process", param_hint="--placement")
    if by_hand and not sys.stdin.isatty():
        raise typer.BadParameter("the keyboard is needed: standard input is not a terminal", param_hint="--by-hand")
    if scenario.partition(":")[0].endswith(".py"):
        raise ModuleError(f"{scenario} is a module; put it into a stack with --use COMPONENT=FILE.py:Class")
    plan = load_scenario(scenario)
    stack = stack_with(plan.stack_path(), use or [])
    tokens = tokens_of(stack, listen, token or [])
    folder = out / plan.id / str(seed)
    folder.mkdir(parents=True, exist_ok=True)
    setup = Setup(
        scenario=plan, seed=seed, stack=stack, db=db, by_hand=by_hand, shuffle=shuffle, faults=folder,
        level=level, plant=plant, randomise=randomise, placement=placement, listen=listen,  # type: ignore[arg-type]
        tokens=tokens,
    )  # fmt: skip
    console = Console()
    if by_hand:
        console.print(
            "arrow keys: speed and steering; hold a key or press the space bar to keep going; q ends the drive"
        )
        pace = 1.0
    result = _drive(setup, folder, pace or (4.0 if view else None), console, view)
    show(console, result)
    same = "".join(f" --use {swap}" for swap in use or ()) + (f" --level {level}" if level != "wire" else "")
    after_drive(console, folder, scenario, seed, same)
    raise typer.Exit({"PASS": PASS, "FAIL": FAIL, "UNKNOWN": FAIL}.get(result.verdict, BROKEN))


def _drive(setup: "Setup", folder: Path, pace: float | None, console: "Console", view: bool) -> "Result":
    from rtdb.recording import Recording

    from .folder import clear, locked
    from .judge import judge
    from .plots import write_plots

    recording = folder / "run.mcap"
    with ExitStack() as held:
        lives: list[LiveView] = []
        held.enter_context(locked(folder))

        def begin(stores: "list[Store]") -> "LiveView | None":
            clear(folder)
            if not view:
                return None
            from .replay import LiveView

            lives.append(held.enter_context(LiveView(stores, f"{setup.scenario.id}, seed {setup.seed}")))
            print(f"open in a browser: {lives[0].viewer.address}", flush=True)
            return lives[0]

        lost = _run_drive(setup, recording, pace, console, begin)
        whole = Recording(recording)
        result = judge(whole, setup.scenario.parsed_criteria, broken=lost)
        result.write(folder / "result.json")
        write_plots(whole, folder, result)
        for live in lives:
            live.show(result)
            if not console.is_terminal:
                console.print(f"{result.verdict}: this is no terminal, so the viewer ends here; see fairway replay")
                continue
            console.print(f"{result.verdict}: look around in the browser; close the viewer or press Ctrl-C to go on")
            live.viewer.wait()
    return result


def _run_drive(
    setup: "Setup",
    recording: Path,
    pace: float | None,
    console: "Console",
    begin: "Callable[[list[Store]], LiveView | None]",
) -> str:
    """Drive under a progress bar; what cannot be done, and Ctrl-C, end the command."""
    from rich.progress import BarColumn, Progress, TextColumn

    from .run import DriveError, drive

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f} of at most {task.total:.0f} s"),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(setup.scenario.id, total=setup.scenario.duration_s)
        try:
            return drive(setup, recording, pace=pace, progress=lambda t_s: bar.update(task, completed=t_s), begin=begin)
        except KeyboardInterrupt:
            bar.stop()
            kept = f"; the recording up to there is in {recording}" if recording.exists() else ""
            raise Interrupted(f"interrupted{kept}") from None
        except DriveError as error:
            bar.stop()
            print(f"{'INVALID' if error.invalid else 'ERROR'}: {error}", file=sys.stderr)
            raise typer.Exit(BROKEN) from None


@app.command()
def replay(
    run: Annotated[
        Path | None, typer.Argument(help="Folder of a run, or a .mcap file. Default: the last run in --out.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for runs.")] = Path("runs"),
    open_it: Annotated[bool, typer.Option("--open/--no-open", help="Open the viewer, or only write run.rrd.")] = True,
) -> None:
    """Look at a run in rerun: what the cart saw, believed and did."""
    import json

    from rtdb.errors import RecordingError
    from rtdb.recording import Recording

    from .replay import convert, open_viewer

    if run is None:
        runs = sorted(out.glob("**/run.mcap"), key=lambda p: p.stat().st_mtime)
        if not runs:
            raise RecordingError(f"no run in {out}: `fairway drive` makes one")
        run = runs[-1]
    mcap = run / "run.mcap" if run.is_dir() else run
    result = mcap.with_name("result.json")
    verdict = json.loads(result.read_text()) if result.is_file() else None
    rrd = convert(Recording(mcap), verdict, mcap.with_suffix(".rrd"))
    typer.echo(f"{rrd}")
    if open_it:
        open_viewer(rrd, typer.echo)


@app.command()
def latency(
    stack: Annotated[str, typer.Argument(help="Name of a shipped stack, or path of a .json.")] = "reference",
) -> None:
    """Compute the latency from sensors to actuators from a stack's wiring."""
    from autonomy.module import ModuleError
    from autonomy.wiring import load_stack

    from .latency import latency as compute
    from .run import TICK_NS
    from .scenario import STACKS

    path = Path(stack) if stack.endswith(".json") else STACKS / f"{stack}.json"
    if not path.is_file():
        shipped = ", ".join(sorted(known.stem for known in STACKS.glob("*.json")))
        raise ModuleError(f"no stack file {path.name} for {stack!r}; there are {shipped}, or give the path of a .json")
    wiring = load_stack(path)
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
    end_as_by_ctrl_c()
    try:
        _run()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)


def _run() -> None:
    from autonomy.module import ModuleError
    from hal.errors import HalError
    from rtdb.errors import RtdbError

    try:
        app(standalone_mode=True)
    except SystemExit as done:
        if done.code == INTERRUPTED:  # typer's way to say that Ctrl-C was pressed outside of a drive
            raise KeyboardInterrupt from None
        raise
    except Interrupted as interrupted:
        print(interrupted, file=sys.stderr)
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
