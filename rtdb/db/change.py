"""`fairway db`: the commands that change something, and those that look after the machine.

Every import that costs time stands inside a command's body.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from ..objects import Object
    from ..store import Store

HEALTHY, FINDINGS, BROKEN = 0, 1, 3
LOOK_S, GIVE_UP = 0.2, 25  # a clock looks that often whether it still is one; nobody was so many times: it is broken

Db = Annotated[str, typer.Option("--db", help="Name of the store, as given to `fairway drive --db`.")]
Name = Annotated[str, typer.Argument(help="Object, such as gps/fix.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command("set", epilog=examples("fairway db set follow/drive speed_mps=0.5 'steer_rad=0.1 rad'"))(set_)
    app.command(epilog=examples("fairway db rm follow/drive", "fairway db rm follow/drive --yes"))(rm)
    app.command(epilog=examples("fairway db doctor", "fairway db doctor --clean", "fairway db doctor --db 'lesson*'"))(
        doctor
    )
    app.command(epilog=examples("fairway db clock cart", "fairway db clock cart --wait-for hal,follow --realtime"))(
        clock
    )


def examples(*lines: str) -> str:
    """Make the end of a help text."""
    return "\n\n".join(["Examples:", *lines])


# -- objects ----------------------------------------------------------------------------------------------------------


def set_(
    name: Name,
    assignments: Annotated[
        list[str], typer.Argument(metavar="FIELD=VALUE", help="at.x_m=2, or JSON: '{\"speed_mps\": 1}'.")
    ],
    db: Db = "cart",
) -> None:
    """Write a new value: the newest one, with some fields replaced.

    For objects that everybody may write, and for those whose component is gone: it is taken for the moment.
    """
    from ..errors import RecordError
    from .edit import edited, packable
    from .visit import find, visit

    with visit(db) as store:
        obj = find(store, name)
        _check_may_change(store, obj, "set")
        newest = obj.latest()
        try:
            value = edited(obj.schema, newest.value if newest is not None else None, assignments)
            payload = obj.schema.pack(packable(obj.schema, value))
        except RecordError as error:
            raise RecordError(f"cannot set {name}: {error}") from error
        with _in_place_of_its_owner(store, obj):
            write = store.core.write(obj.handle, payload, store.core.not_before(obj.handle, store.now_ns), ())
        shows = f"it shows at the next edge, every {obj.every * store.tick_ns / 1e6:g} ms"
        typer.echo(f"{name}: write {write}; {shows if store.clock.alive else 'it does not show before somebody ticks'}")


def _check_may_change(store: "Store", obj: "Object[Any]", verb: str) -> None:
    """Refuse what only the owner may do, while it lives."""
    from ..errors import NotOwner
    from ..objects import Flag
    from .visit import owner_of

    owner = owner_of(store, obj.component)
    if owner.alive and not obj.flags & Flag.PUBLIC_WRITE:
        raise NotOwner(
            f"cannot {verb} {obj.name}: component {owner.name} (process {owner.pid}) owns it and lives; end that "
            f"process, or have it insert the object with Flag.PUBLIC_WRITE"
        )


@contextmanager
def _in_place_of_its_owner(store: "Store", obj: "Object[Any]") -> Iterator[None]:
    """Be the component of an object for a moment, if it is gone and only it may write; it stays what it was."""
    from ..objects import Flag
    from .visit import owner_of

    if obj.flags & Flag.PUBLIC_WRITE:
        yield
        return
    was = owner_of(store, obj.component)
    component = store.join(was.name, participant=was.participant, every=was.every, phase=was.phase, version=was.version)
    try:
        yield
    finally:
        component.leave()


def rm(name: Name, db: Db = "cart", yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False) -> None:
    """Delete an object, and those that go with it."""
    from .visit import find, owner_of, visit

    with visit(db) as store:
        obj = find(store, name)
        _check_may_change(store, obj, "delete")
        for gone in _with_children(store, obj):
            owner = owner_of(store, gone.component)
            whose = f"{owner.name}, which " + (f"lives (process {owner.pid})" if owner.alive else "is gone")
            typer.echo(f"{gone.name}  {gone.schema.name}  newest write {gone.head}, of {whose}")
        if not yes:
            typer.confirm("delete?", abort=True)
        store.delete(obj)
        typer.echo("deleted")


def _with_children(store: "Store", obj: "Object[Any]") -> "list[Object[Any]]":
    """List an object and all that are deleted with it."""
    from ..objects import Flag

    below = [child for child in store.objects(parent=obj) if child.flags & Flag.WITH_PARENT]
    return [obj, *(gone for child in below for gone in _with_children(store, child))]


# -- the machine ------------------------------------------------------------------------------------------------------


def doctor(
    db: Annotated[str, typer.Option("--db", help="Only stores of this name, or pattern.")] = "*",
    clean: Annotated[bool, typer.Option("--clean", help="Remove what crashes left behind, never what lives.")] = False,
) -> None:
    """Find what is wrong: what, where, what to do.

    Stores that crashes left, who is attached, dead clocks and components,
    refused writes, missed cycles, files here that shadow modules.
    Exit status: 0 healthy, 1 otherwise.
    """
    from .console import console, table
    from .doctor import examine, state_of
    from .segments import remove, segments

    if clean:
        for segment in segments(db):
            if not segment.lives and remove(segment):
                typer.echo(f"removed {segment.path}")
    found, findings = examine(db, Path.cwd())
    rows = table(("segment", "state", "size>", "attached"), fold=["attached"])
    for segment in found:
        size = f"{segment.size / 2**20:.1f} MiB"
        rows.add_row(segment.path.name, state_of(segment), size, "\n".join(map(str, segment.holders)) or "-")
    if found:
        console().print(rows)
    for finding in findings:
        typer.echo(str(finding))
    typer.echo(f"{len(findings)} finding{'s' if len(findings) > 1 else ''}" if findings else "healthy")
    raise typer.Exit(FINDINGS if findings else HEALTHY)


def clock(
    name: Annotated[str, typer.Argument(help="Name of a barrier or real-time store.")],
    wait_for: Annotated[
        str, typer.Option("--wait-for", help="Components, separated by commas, without which there is no first tick.")
    ] = "",
    realtime: Annotated[
        bool, typer.Option("--realtime", help="Ask for real-time scheduling and locked memory; say what is refused.")
    ] = False,
) -> None:
    """Tick a barrier or real-time store until Ctrl-C is pressed; beside a living clock, be its standby."""
    from ..clock import Kind
    from ..errors import NotOwner
    from ..realtime import realtime as ask
    from .visit import visit

    with visit(name) as store:
        now = store.clock
        if now.kind is Kind.STEPPED:
            raise NotOwner(
                f"store {name!r} is stepped: process {now.pid}, which drives it, ticks it; `clock` is for barrier and "
                f"real-time stores"
            )
        if realtime:
            given = ask()  # before the thread begins, which inherits it
            typer.echo(f"got: {', '.join(given.got)}")
            for refused in given.refused:
                typer.echo(f"refused: {refused}", err=True)
        _run_clock(store, tuple(part.strip() for part in wait_for.split(",") if part.strip()))


def _run_clock(store: "Store", wait_for: tuple[str, ...]) -> None:
    """Tick until the store has ended, and say what this process is: waiting, ticking, a standby."""
    import os

    said, name = "", store.name or ""
    with store.run_clock(wait_for):
        looks_without = 0
        while looks_without < GIVE_UP:  # then ours ended with an error, which the end of the `with` raises
            version, now = store.core.version, store.clock
            words, mine = said, now.pid == os.getpid()
            if now.alive:
                words = f"standby: process {now.pid} ticks store {name!r}"
            if now.alive and mine:
                words = f"ticking store {name!r} every {now.tick_ns / 1e6:g} ms"
                words += f" (took over from process {said.split()[2]})" if said.startswith("standby") else ""
            if now.alive and mine and now.cycle == 0:
                words = f"waiting for {', '.join(wait_for) or 'the first tick'}"
            if words.partition(" (")[0] != said.partition(" (")[0]:
                typer.echo(words)
                said = words
            if mine and not store.bears_name and not any(c.alive for c in store.components()):
                typer.echo(f"store {name!r} has ended, after cycle {now.cycle}", err=True)
                return
            waited_out = store.core.wait_directory(version, int(LOOK_S * 1e9)) is None
            looks_without = 0 if now.alive else looks_without + waited_out
    typer.echo(f"the clock of store {name!r} ended, after cycle {store.cycle}", err=True)
    raise typer.Exit(BROKEN)
