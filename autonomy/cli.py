"""Commands for whoever writes a module: `fairway new` writes a starter, `fairway repro` runs a broken step again.

Every import that costs time stands inside a command's body.
"""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from .module import Module

PASSED, BROKE = 0, 1


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command()(new)
    app.command()(repro)


def new(
    name: Annotated[str, typer.Argument(help="Name of the file, without .py; the class gets it in CamelCase.")],
    kind: Annotated[
        str, typer.Option(help="What to write: follower, avoider, planner, localiser, or driver: the whole stack.")
    ] = "follower",
) -> None:
    """Write a module that already drives, and its test, into this folder."""
    from .starter import write

    written, command = write(name, kind, Path())
    for path in written:
        typer.echo(f"wrote  {path}")
    typer.echo(f"drive  {command}")
    typer.echo(f"test   pytest test_{name}.py")


def repro(
    file: Annotated[
        Path, typer.Argument(help="The .repro file of a drive. It holds pickled data: only one you trust.")
    ],
    run: Annotated[bool, typer.Option("--run", help="Only run the step, without the debugger.")] = False,
) -> None:
    """Run the step that broke a module once more, on the inputs that broke it, in the debugger.

    Exit status: 0 the step passed or the debugger was left, 1 it broke again, 2 bad input.
    """
    from .module import ModuleError
    from .repro import SUFFIX, load

    if file.is_dir():
        kept = ", ".join(str(path) for path in sorted(file.glob(f"*{SUFFIX}")))
        raise ModuleError(f"{file} is a folder; " + (f"it holds {kept}" if kept else f"it holds no {SUFFIX} file"))
    module, document = load(file)
    call = str(document["call"])
    typer.echo(f"{document['component']}: {call}() of {document['wire']['module']}")
    typer.echo(f"broke then: {document['reason'].strip().splitlines()[-1]}")
    if document["left_out"]:
        typer.echo(f"could not be kept, and is missing now: {', '.join(document['left_out'])}")
    raise typer.Exit(_run(module, call) if run else _debug(module, call))


def _run(module: "Module", call: str) -> int:
    """Run the step, with an end for one that has none."""
    import traceback

    from .contain import HANG_CPU_S
    from .host import watch

    try:
        watch.begin(HANG_CPU_S)
        try:
            said = _call(module, call)
        finally:
            watch.end()
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a module may raise anything
        traceback.print_exception(error)
        return BROKE
    typer.echo(f"the {call} passed: {said}")
    return PASSED


def _debug(module: "Module", call: str) -> int:
    """Stop at the first line of the step."""
    import pdb
    import traceback

    from .outputs import outputs_of

    class Debugger(pdb.Pdb):
        """Knows whether somebody left it, which `runcall` does not tell."""

        left = False

        def set_quit(self) -> None:
            self.left = True
            super().set_quit()

    typer.echo("n: next line, s: step into, p NAME: print, c: go on, q: leave")
    module._out.clear()
    debugger = Debugger()
    try:
        debugger.runcall(getattr(module, call))
        if debugger.left:
            return PASSED
        if call == "step":
            outputs_of(module)
    except BaseException as error:
        traceback.print_exception(error)
        return BROKE
    typer.echo(f"the {call} passed")
    return PASSED


def _call(module: "Module", call: str) -> str:
    from .trial import checked_step

    if call == "reset":
        module.reset()
        return "nothing to look at"
    return ", ".join(f"{name} = {value!r}" for name, value in checked_step(module).items())


if __name__ == "__main__":
    app = typer.Typer()
    register(app)
    sys.exit(app())
