"""Commands for stacks that run in real time: run, wire.

Every import that costs time stands inside a command's body.
"""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtdb.db.change import examples
from rtdb.syncfs.cli import tokens_said

if TYPE_CHECKING:
    from autonomy.wiring import Stack

    from .judge import Result
    from .scenario import Scenario
    from .supervisor import Outcome, RunSetup

PASS, FAIL, BAD_INPUT, BROKEN = 0, 1, 2, 3

Use = Annotated[
    list[str] | None,
    typer.Option(help="COMPONENT=FILE.py:Class swaps one module of the stack; COMPONENT=files: a script is it."),
]
Listen = Annotated[str | None, typer.Option(help="Where scripts find the file server, such as tcp:127.0.0.1:5640.")]
Token = Annotated[
    list[str] | None, typer.Option(metavar="COMPONENT=TOKEN", help="A script's token, instead of one by chance.")
]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command(
        epilog=examples("fairway run", "fairway run parking-lot/square --db lot", "fairway run --for 20 --realtime")
    )(run)
    app.command(
        epilog=examples("fairway wire lot follow.pose=localise/pose", "fairway wire lot actuators.drive=guard/drive")
    )(wire)


def run(
    scenario: Annotated[
        str, typer.Argument(help="Scenario id (`fairway ls` lists them), or path of a .scenario.yaml.")
    ] = "p545/field-trial",
    use: Use = None,
    listen: Listen = None,
    token: Token = None,
    seed: Annotated[int, typer.Option(help="Seed of all randomness.", min=0)] = 0,
    level: Annotated[str, typer.Option(help="direct (messages) or wire (true bytes).")] = "wire",
    db: Annotated[str | None, typer.Option("--db", help="Name of the store. Default: run-PROCESS.")] = None,
    for_s: Annotated[
        float | None, typer.Option("--for", help="Seconds; then the cart is stopped. Default: the scenario's.", min=0.1)
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for runs.")] = Path("runs"),
    realtime: Annotated[
        bool, typer.Option("--realtime", help="Ask for real-time priorities and locked memory; say what is refused.")
    ] = False,
) -> None:
    """Run a scenario's stack in real time, each part in a process of its own, and judge it.

    Exit status: 0 pass, 1 a criterion broke or could not be measured, 2 bad input, 3 something was lost and the cart
    stopped, 130 after Ctrl-C, SIGTERM or the end of the terminal, which stop the cart first.
    """
    from autonomy.wiring import stack_with

    from .scenario import load_scenario
    from .supervisor import RunSetup

    if level not in ("direct", "wire"):
        raise typer.BadParameter(f"{level!r} is not one of direct, wire", param_hint="--level")
    plan = load_scenario(scenario)
    stack = with_whole_paths(stack_with(plan.stack_path(), use or []))
    tokens = tokens_of(stack, listen, token or [])
    folder = out / plan.id / f"{seed}-real"
    folder.mkdir(parents=True, exist_ok=True)
    setup = RunSetup(
        scenario=plan, stack=stack, folder=folder, db=db or f"run-{os.getpid()}", seed=seed,
        level="direct" if level == "direct" else "wire", for_s=for_s, realtime=realtime, listen=listen,
        tokens=tokens,
    )  # fmt: skip
    raise typer.Exit(_run(setup))


def with_whole_paths(stack: "Stack") -> "Stack":
    """Name modules in files by their whole paths: `fairway wire` may look from another folder."""
    from dataclasses import replace

    def whole(module: str) -> str:
        path, colon, name = module.rpartition(":")
        return f"{Path(path).resolve()}{colon}{name}" if path.endswith(".py") else module

    return replace(stack, wires=tuple(replace(wire, module=whole(wire.module)) for wire in stack.wires))


def tokens_of(stack: "Stack", listen: str | None, said: list[str]) -> dict[str, str]:
    """Read what --token says; it and --listen are for stacks in which a component is a script."""
    scripts = [wire.component for wire in stack.wires if wire.is_files]
    if listen is not None and not scripts:
        raise typer.BadParameter("no component is a script; --use COMPONENT=files makes one", param_hint="--listen")
    return tokens_said(said, scripts)


def _run(setup: "RunSetup") -> int:
    import sys

    from rich.console import Console

    from .cart import DriveError
    from .folder import Interrupted, clear, locked
    from .report import print_files, show
    from .supervisor import supervise

    console = Console()
    with locked(setup.folder):
        clear(setup.folder)
        for old in setup.folder.glob("run*.mcap"):
            old.unlink()
        try:
            outcome = supervise(setup, lambda line: typer.echo(line, err=True))
        except DriveError as error:
            print(f"{'INVALID' if error.invalid else 'ERROR'}: {error}", file=sys.stderr)
            return BROKEN
        recording = setup.folder / "run.mcap"
        if outcome.interrupted:
            kept = f"; the recording up to there is in {recording}" if recording.exists() else ""
            raise Interrupted(f"{outcome.ended}, the cart was stopped{kept}")
        if not recording.exists():
            print(f"ERROR: {outcome.ended}, and there is no recording", file=sys.stderr)
            return BROKEN
        result = _judge(setup.scenario, recording, outcome)
    show(console, result)
    late = ", ".join(f"{name} {n}" for name, n in sorted(outcome.late.items()))
    console.print(f"ended: {outcome.ended}; cycles missed: {late or 'none'}", highlight=False, soft_wrap=True)
    print_files(console, setup.folder)
    return {"PASS": PASS, "FAIL": FAIL, "UNKNOWN": FAIL}.get(result.verdict, BROKEN)


def _judge(scenario: "Scenario", recording: Path, outcome: "Outcome") -> "Result":
    from dataclasses import replace

    from rtdb.recording import Recording

    from .judge import judge
    from .plots import write_plots

    whole, folder = Recording(recording), recording.parent
    real_time = {"ended": outcome.ended, "missed": outcome.late}
    result = replace(judge(whole, scenario.parsed_criteria, broken=outcome.lost), extra={"real_time": real_time})
    result.write(folder / "result.json")
    write_plots(whole, folder, result)
    return result


def wire(
    db: Annotated[str, typer.Argument(metavar="DB", help="Name of the running store: `run --db`, `drive --db`.")],
    change: Annotated[str, typer.Argument(metavar="MODULE.INPUT=POINTER", help="Such as follow.pose=localise/pose.")],
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Wire an input of a running system to something else: shows the latency before and after, and asks.

    Effective at the next edge of the module. Exit status: 0 it is wired anew, 2 it stays as it was.
    """
    from rtdb.db.visit import visit

    from .rewire import TAKEN, Change, check_change, latency_lines, propose, stack_of

    wanted = Change.parse(change)
    with visit(db) as store:
        before = stack_of(store)
        after = check_change(store, before, wanted)
        for when, stack in (("now", before), ("then", after)):
            for line in latency_lines(stack, store.tick_ns):
                typer.echo(f"{when:5}{line}")
        if not yes:
            typer.confirm(f"wire {change}?", abort=True)
        answer = propose(store, after, wanted)
    if not answer.startswith(TAKEN):
        typer.echo(answer or f"{wanted.component} does not say that it took the wiring", err=True)
        raise typer.Exit(BAD_INPUT)
    typer.echo(f"{wanted.component}: {answer}")
