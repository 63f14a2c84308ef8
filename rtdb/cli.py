"""`fairway db`: look into a running store. Imports stay inside the commands, so that `--help` is quick."""

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from .store import Sample, Store

app = typer.Typer(help="Look into the real-time database of a running drive.", no_args_is_help=True)

Db = Annotated[str, typer.Option("--db", help="Name of the store, as given to `fairway drive --db`.")]
Wait = Annotated[float, typer.Option("--wait", help="Seconds to wait for the object.", min=0.0)]


@app.command()
def ls(db: Db = "cart") -> None:
    """List objects and components."""
    from rich.console import Console
    from rich.table import Table

    from .store import Store

    with Store.attach(db) as store:
        table = Table(
            box=None, title=f"{db}: cycle {store.cycle}, tick {store.tick_ns / 1e6:g} ms", title_justify="left"
        )
        for heading in ("object", "record", "every", "phase", "writes", "age", "owner"):
            table.add_column(heading, justify="right" if heading in ("every", "phase", "writes", "age") else "left")
        alive = {c.name: c.alive for c in store.components()}
        for obj in sorted(store.objects(), key=lambda o: o.name):
            sample = obj.visible(store.cycle)
            table.add_row(
                obj.name,
                obj.schema.name,
                str(obj.every),
                str(obj.phase),
                str(obj.head),
                _age(store, sample),
                obj.component + ("" if alive.get(obj.component) else " (dead)"),
            )
        Console(width=None if Console().is_terminal else 120).print(table)


@app.command()
def get(name: str, db: Db = "cart", wait: Wait = 0.0) -> None:
    """Show what an object shows now, as JSON with units."""
    import json

    from .errors import ObjectMissing
    from .store import Store

    with Store.attach(db) as store:
        try:
            obj = store.find(name, timeout_s=wait)
        except ObjectMissing as error:
            import difflib

            names = [o.name for o in store.objects()]
            near = difflib.get_close_matches(name, names, n=1)
            raise ObjectMissing(
                f"no object {name!r} in store {db!r}; "
                + (f"did you mean {near[0]}?" if near else f"it has {', '.join(sorted(names))}")
            ) from error
        sample = obj.visible(store.cycle)
        if sample is None:
            typer.echo(f"{name}: nothing is visible yet in cycle {store.cycle}", err=True)
            raise typer.Exit(3)
        units = {f.name: f.spec.unit for f in obj.schema.fields}
        typer.echo(f"{name}  {obj.schema.name}  write {sample.write}, {_age(store, sample)} old, cycle {store.cycle}")
        for key, value in sample.value.items():
            typer.echo(f"  {key} = {json.dumps(value)}" + (f" {units[key]}" if units[key] else ""))


def _age(store: "Store", sample: "Sample | None") -> str:  # type: ignore[type-arg]
    return "-" if sample is None else f"{(store.now_ns - sample.t_data_ns) * 1e-9:.2f} s"
