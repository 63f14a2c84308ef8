"""`fairway db`: look into a running store. Imports stay inside the commands, so that `--help` is quick.

Everything is shown by the schema that the store holds, so no class is needed. What changes a store is in db/change.py.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .db.change import Db, Name, examples, register

if TYPE_CHECKING:
    from rich.tree import Tree

    from .db.look import Look, ObjectLook
    from .store import Store

NOTHING = 3  # exit status where nothing is there yet

app = typer.Typer(help="Look into the real-time database of a running drive.", no_args_is_help=True)

Wait = Annotated[float, typer.Option("--wait", help="Seconds to wait for the object.", min=0.0)]


# -- what there is ----------------------------------------------------------------------------------------------------


@app.command(epilog=examples("fairway db ls", "fairway db ls 'gps/*' --db lesson", "fairway db ls --deleted"))
def ls(
    pattern: Annotated[str | None, typer.Argument(help="Only these objects, as in a shell: 'gps/*'.")] = None,
    db: Db = "cart",
    deleted: Annotated[bool, typer.Option("--deleted", help="List the deleted ones that are still kept.")] = False,
) -> None:
    """List objects and components."""
    import fnmatch

    from .components import flag_names
    from .db.console import console, table
    from .db.look import look
    from .db.visit import visit

    with visit(db) as store:
        now = look(store)
        rows = table(
            ("object", "record", "every>", "phase>", "writes>", "age>", "owner", "flags"),
            title=f"{db}: cycle {now.cycle}, tick {now.tick_ns / 1e6:g} ms",
        )
        objects = sorted((o for o in now.objects if o.t_delete_ns is not None), key=lambda o: (o.name, o.oid))
        for obj in objects if deleted else now.living:
            if pattern is None or fnmatch.fnmatchcase(obj.name, pattern):
                owner = obj.component + ("" if obj.component in now.alive else " (dead)")
                rows.add_row(
                    obj.name, obj.record, str(obj.every), str(obj.phase), str(obj.head), _age(now.age_s(obj)),
                    owner, flag_names(obj.flags),
                )  # fmt: skip
        console().print(rows)
        for why in now.unreadable:
            typer.echo(f"unreadable: {why}", err=True)


@app.command(epilog=examples("fairway db tree", "fairway db tree --db lesson"))
def tree(db: Db = "cart") -> None:
    """Show components, their objects, and the objects below these."""
    from rich.tree import Tree

    from .db.console import console
    from .db.look import look
    from .db.visit import visit

    with visit(db) as store:
        now = look(store)
        root = Tree(f"{db}: cycle {now.cycle}, tick {now.tick_ns / 1e6:g} ms")
        known = {obj.oid for obj in now.living}
        for seen in sorted(now.components, key=lambda c: c.info.name):
            info = seen.info
            words = [f"process {info.pid}" if info.alive else f"dead, was process {info.pid}"]
            words += [info.version] if info.version else []
            words += [f"participant, every {info.every} phase {info.phase}"] if info.participant else []
            branch = root.add(f"{info.name}  ({', '.join(words)})", style="" if info.alive else "bold red")
            for obj in now.living:
                if obj.component == info.name and obj.parent not in known:
                    _add(branch, now, obj)
        console().print(root)


def _add(branch: "Tree", now: "Look", obj: "ObjectLook") -> None:
    from .components import flag_names

    words = [obj.name, obj.record, f"every {obj.every} phase {obj.phase}", f"write {obj.head}", _age(now.age_s(obj))]
    words += [flag_names(obj.flags)] if obj.flags else []
    twig = branch.add("  ".join(words))
    for child in now.living:
        if child.parent == obj.oid:
            _add(twig, now, child)


def _age(age_s: float | None) -> str:
    return "-" if age_s is None else f"{age_s:.2f} s"


# -- one value --------------------------------------------------------------------------------------------------------


@app.command(
    epilog=examples(
        "fairway db get localise/pose",
        "fairway db get localise/pose#/x_m --json",
        "fairway db get localise/pose --at -0.5     (half a second ago)",
        "fairway db get localise/pose --cycle 120",
    )
)
def get(
    name: Annotated[str, typer.Argument(help="Object, such as gps/fix, or a part of it: gps/fix#/x_m.")],
    db: Db = "cart",
    wait: Wait = 0.0,
    at: Annotated[
        float | None, typer.Option("--at", help="What showed then, in seconds since cycle 0; negative: before now.")
    ] = None,
    cycle: Annotated[int | None, typer.Option("--cycle", help="What showed in that cycle.", min=0)] = None,
    write: Annotated[int | None, typer.Option("--write", help="The write of that number.", min=1)] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for programs.")] = False,
) -> None:
    """Show what an object shows now, with units; or what it showed."""
    import json

    from .db.values import lines_of, part_of, to_json, tokens_of_pointer
    from .db.visit import find, name_of, oldest_of, visit
    from .errors import AgedOut

    if sum(choice is not None for choice in (at, cycle, write)) > 1:
        raise typer.BadParameter("say one of --at, --cycle, --write")
    name, _, pointer = name.partition("#")
    tokens = tokens_of_pointer(pointer)
    with visit(db) as store:
        obj = find(store, name, wait_s=wait, or_deleted=(at, cycle, write) != (None, None, None))
        shown = _cycle_at(store, at) if at is not None else cycle if cycle is not None else store.cycle
        try:
            sample = obj.read(write) if write is not None else obj.visible(shown)
        except AgedOut as error:
            raise AgedOut(f"{error}; {oldest_of(store, obj)}") from error
        if sample is None:
            typer.echo(f"{name}: nothing is visible yet in cycle {shown}", err=True)
            raise typer.Exit(NOTHING)
        part = part_of(obj.schema, sample.value, tokens)
        age_s, writer = (store.now_ns - sample.t_data_ns) * 1e-9, obj.writer_of(sample)
        causes = [(name_of(store, oid), number) for oid, number in sample.causes]
        if as_json:
            said = {
                "object": name, "record": obj.schema.name, "write": sample.write, "writer": writer,
                "t_commit_ns": sample.t_commit_ns, "t_data_ns": sample.t_data_ns, "age_s": age_s, "cycle": shown,
                "causes": [{"object": cause, "write": number} for cause, number in causes],
                "pointer": pointer, "unit": part.unit, "value": to_json(part.value),
            }  # fmt: skip
            typer.echo(json.dumps(said, ensure_ascii=False))
            return
        where = f"cycle {shown}" if write is None else f"newest {obj.head}"
        typer.echo(f"{name}  {obj.schema.name}  write {sample.write}, {_age(age_s)} old, {where}")
        for line in lines_of(part, pointer):
            typer.echo(line)
        typer.echo(f"  written by {writer}" + "".join(f", from {cause} write {n}" for cause, n in causes))


def _cycle_at(store: "Store", at_s: float) -> int:
    t_ns = round(at_s * 1e9) + (store.t0_ns if at_s >= 0 else store.now_ns)
    return store.at(t_ns).cycle


# -- one after the other ----------------------------------------------------------------------------------------------


@app.command(epilog=examples("fairway db watch gps/fix", "fairway db watch gps/fix --n 10 --timeout 5"))
def watch(
    name: Name,
    db: Db = "cart",
    wait: Wait = 0.0,
    n: Annotated[int | None, typer.Option("--n", help="End after so many writes.", min=1)] = None,
    timeout: Annotated[
        float | None, typer.Option("--timeout", help="End when none comes for so many seconds of store time.", min=0.0)
    ] = None,
) -> None:
    """Print each new write of an object, until it is deleted or Ctrl-C is pressed."""
    from .db.tail import Ended, writes
    from .db.values import one_line
    from .db.visit import find, visit

    left = n
    with visit(db) as store:
        obj = find(store, name, wait_s=wait)
        try:
            for sample, lost in writes(store, obj, timeout):
                t_s = (sample.t_commit_ns - store.t0_ns) * 1e-9
                gap = f"  ({lost} lost before)" if lost else ""
                typer.echo(f"{name}  write {sample.write}  {t_s:.3f} s  {one_line(obj.schema, sample.value)}{gap}")
                left = left - 1 if left is not None else None
                if left == 0:
                    return
        except Ended as end:
            typer.echo(str(end), err=True)
            raise typer.Exit(end.status) from None


@app.command(
    epilog=examples(
        "fairway db history follow/drive --last 0.5",
        "fairway db history follow/drive --field speed_mps",
        "fairway db history follow/drive --csv drive.csv",
    )
)
def history(
    name: Name,
    db: Db = "cart",
    last: Annotated[float | None, typer.Option("--last", help="Only so many seconds back.", min=0.0)] = None,
    csv: Annotated[
        Path | None,
        typer.Option("--csv", help="Write CSV to this file, or - for standard output: every value exactly."),
    ] = None,
    field: Annotated[list[str] | None, typer.Option("--field", help="Only this field, such as at.x_m.")] = None,
) -> None:
    """Show all writes of an object that are still there."""
    import csv as csv_writer
    import sys
    from contextlib import nullcontext

    from .db.console import console
    from .db.history import columns_of, rows_of, table_of, written
    from .db.visit import find, visit

    with visit(db) as store:
        obj = find(store, name, or_deleted=True)
        since_ns = None if last is None else store.now_ns - round(last * 1e9)
        samples, lost = written(obj, since_ns)
        columns = columns_of(obj.schema, samples, field or [])
        if csv is None:
            console().print(table_of(obj.schema, store.t0_ns, samples, columns))
            typer.echo(
                f"{name}: {len(samples)} write{'s' if len(samples) != 1 else ''}"
                + (f", {lost} aged out" if lost else "")
            )
            return
        with nullcontext(sys.stdout) if str(csv) == "-" else csv.open("w", newline="") as file:
            csv_writer.writer(file, lineterminator="\n").writerows(rows_of(obj.schema, samples, columns))


# -- all at once ------------------------------------------------------------------------------------------------------


@app.command(epilog=examples("fairway db top", "fairway db top --once", "fairway db top --n 10 --period 0.5"))
def top(
    db: Db = "cart",
    once: Annotated[bool, typer.Option("--once", help="Show one round and end.")] = False,
    n: Annotated[int | None, typer.Option("--n", help="End after so many rounds.", min=1)] = None,
    period: Annotated[float, typer.Option("--period", help="Seconds from round to round.", min=0.0)] = 1.0,
) -> None:
    """Show rates, ages, jitter, steps, missed cycles and deaths, live.

    It goes on when writers and the clock die and come back, and ends with the store.
    """
    from contextlib import ExitStack

    from .db.console import console
    from .db.top import end_of, looks, shown
    from .db.visit import visit

    screen = console()
    with visit(db) as store, ExitStack() as open_things:
        live = None
        if screen.is_terminal and not once:
            from rich.live import Live

            live = open_things.enter_context(Live(console=screen, auto_refresh=False))
        end = None
        for before, now in looks(store, period, 1 if once else n):
            picture = shown(before, now)
            if live is not None:
                live.update(picture, refresh=True)
            else:
                screen.print(picture, "", sep="\n")
                screen.file.flush()
            end = end_of(store)
            if end is not None:
                break
    if end is not None:
        typer.echo(end[0], err=True)
        raise typer.Exit(end[1])


register(app)
