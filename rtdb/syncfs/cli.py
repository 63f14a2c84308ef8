"""Commands of the file system: `fairway serve`, `fairway fs`. Imports stay inside, so that `--help` is quick."""

import contextlib
import sys
from typing import TYPE_CHECKING, Annotated

import typer

from ..db.change import examples

if TYPE_CHECKING:
    from ..store import Store
    from .addresses import Address
    from .client import Client
    from .policy import Tokens
    from .seats import SeatSpec

app = typer.Typer(help="Files of a served store, without a mount.", no_args_is_help=True)

Db = Annotated[str, typer.Option("--db", help="Name of the store.")]
At = Annotated[str | None, typer.Option("--at", help="Address of its server. Default: the store's own socket.")]
TokenOption = Annotated[
    str, typer.Option("--token", envvar="FAIRWAY_TOKEN", help="To be a component, or the operator.")
]
Wait = Annotated[float, typer.Option("--wait", help="Seconds to wait for the server.", min=0.0)]
FilePath = Annotated[str, typer.Argument(metavar="PATH", help="Such as /localise/status.")]


def register(root: typer.Typer) -> None:
    """Add the commands."""
    root.command(
        epilog=examples(
            "fairway serve", "fairway serve --db lot --component shell", "fairway serve --listen tcp:127.0.0.1:5640"
        )
    )(serve)
    root.add_typer(app, name="fs")


def serve(
    db: Db = "cart",
    listen: Annotated[
        list[str] | None, typer.Option(help="unix:PATH or tcp:HOST:PORT; several may be given. Default: a Unix socket.")
    ] = None,
    component: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME[:EVERY[:PHASE]]", help="Let whoever has its token be this component, due so often."),
    ] = None,
    token: Annotated[
        list[str] | None, typer.Option(metavar="NAME=TOKEN", help="Its token, instead of one by chance.")
    ] = None,
    operator: Annotated[bool, typer.Option("--operator", help="Give out a token that may write every config.")] = False,
    every: Annotated[int, typer.Option(help="Ticks from one edge of /clock to the next.", min=1)] = 10,
    clock: Annotated[str, typer.Option(help="real or barrier: of a store that is made.")] = "real",
    tick_ms: Annotated[float, typer.Option(help="Base tick of a store that is made.", min=0.1)] = 10.0,
    size_mb: Annotated[
        int, typer.Option(help="Size of a store that is made; memory is taken as it is used.", min=4)
    ] = 128,
    patience: Annotated[float, typer.Option(help="Seconds that a barrier waits for a component.", min=0.1)] = 5.0,
    realtime: Annotated[
        bool, typer.Option("--realtime", help="Ask for real-time scheduling; say what is refused.")
    ] = False,
    anywhere: Annotated[
        bool, typer.Option("--anywhere", help="Let other machines come: whoever reaches it may read.")
    ] = False,
    trace: Annotated[bool, typer.Option("--trace", help="Print every message.")] = False,
    plain: Annotated[
        bool, typer.Option("--plain", help="Python's own event loop, also where uvloop is installed.")
    ] = False,
) -> None:
    """Serve a store as files over 9P until Ctrl-C is pressed; makes the store if there is none of that name.

    Prints the command that mounts it, and one for each component.
    """
    import logging

    from ..realtime import realtime as ask
    from .addresses import Address, default_address
    from .pace import Pace
    from .server import FileServer, run

    if clock not in ("real", "barrier"):
        raise typer.BadParameter(f"{clock!r} is not one of real, barrier", param_hint="--clock")
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    seats, tokens = seats_of(component or [], token or [], every, operator=operator)
    addresses = [Address.parse(text) for text in listen or []] or [default_address(db)]
    if realtime:
        for refused in ask().refused:
            typer.echo(f"refused: {refused}", err=True)
    made = _made_if_absent(db, clock, tick_ms, size_mb, [seat.component for seat in seats])
    try:
        server = FileServer(
            db, pace=Pace(every), seats=seats, tokens=tokens, patience_s=patience, trace=_print if trace else None
        )

        def ready(bound: "list[Address]") -> None:
            typer.echo(f"serving store {db!r}, {'made' if made else 'found'}; Ctrl-C ends it")
            for line in invitation(bound, tokens):
                typer.echo(line)
            sys.stdout.flush()

        run(server, addresses, anywhere=anywhere, ready=ready, plain=plain)
    finally:
        if made is not None:
            made.close()


def _print(line: str) -> None:
    with contextlib.suppress(OSError):  # nobody reads it any more
        print(line, file=sys.stderr, flush=True)


def _made_if_absent(db: str, clock: str, tick_ms: float, size_mb: int, wait_for: list[str]) -> "Store | None":
    """Make the store and start its clock, if there is none of that name."""
    from ..errors import StoreMissing
    from ..store import Store

    try:
        Store.attach(db).close()
    except StoreMissing:
        store = Store.create(
            db, clock="real" if clock == "real" else "barrier", tick_ns=round(tick_ms * 1e6), size=size_mb << 20,
            max_objects=4096,
        )  # fmt: skip
        store.run_clock(tuple(wait_for) if clock == "barrier" else ())
        return store
    return None


def seats_of(components: list[str], given: list[str], every: int, *, operator: bool) -> "tuple[list[SeatSpec], Tokens]":
    """Read what --component and --token say."""
    from .policy import OPERATOR, RESERVED, Tokens
    from .seats import SeatSpec

    seats, tokens = [], Tokens()
    texts = tokens_said(given, [said.partition(":")[0] for said in components] + [OPERATOR] * operator)
    for said in components:
        name, *numbers = said.split(":")
        if "/" in name or name in RESERVED:
            raise typer.BadParameter(f"{said!r}: no component is called that", param_hint="--component")
        if not name or len(numbers) > 2 or not all(number.isdecimal() for number in numbers):
            raise typer.BadParameter(
                f"{said!r}: expected NAME, NAME:EVERY or NAME:EVERY:PHASE", param_hint="--component"
            )
        ticks = [int(number) for number in numbers]
        due, phase = (ticks + [every, 0][len(ticks) :])[:2]
        if not 0 <= phase < due:
            raise typer.BadParameter(f"{said!r}: EVERY is at least 1, and PHASE below it", param_hint="--component")
        wiring = {"module": "files", "every": due, "phase": phase, "inputs": {}, "latency_cycles": due - 1}
        seats.append(SeatSpec(component=name, every=due, phase=phase, latency_cycles=due - 1, config=wiring))
        tokens.give(name, texts.pop(name, None))
    if operator:
        tokens.give(OPERATOR, texts.pop(OPERATOR, None))
    return seats, tokens


def tokens_said(given: list[str], known: list[str]) -> dict[str, str]:
    """Read NAME=TOKEN of components that are known."""
    texts: dict[str, str] = {}
    for said in given:
        name, _, text = said.partition("=")
        if name not in known:
            there = ", ".join(known) or "none"
            raise typer.BadParameter(f"{said}: {name!r} is no script here; there is {there}", param_hint="--token")
        if not text or "," in text or text in texts.values():
            raise typer.BadParameter(f"{said}: NAME=TOKEN, each another, without a comma", param_hint="--token")
        texts[name] = text
    return texts


def invitation(addresses: "list[Address]", tokens: "Tokens") -> list[str]:
    """Say how to mount a server: for everybody, and as each component."""
    lines = []
    for address in addresses:
        lines.append(
            f"mount it over {'a Unix socket' if address.path is not None else 'TCP'}, to read and for free files:"
        )
        lines.append(f"  {address.mount_command()}")
        for name, token in tokens.of.items():
            lines.append(f"as {name}:")
            lines.append(f"  {address.mount_command(token)}")
    lines.append("without a mount, as the same user:")
    lines.append(f"  fairway fs ls / --at {addresses[0]}")
    for name, token in tokens.of.items():
        lines.append(f"  fairway fs ls / --at {addresses[0]} --token {token}    (as {name})")
    return lines


# -- without a mount --------------------------------------------------------------------------------------------------


def _client(db: str, at: str | None, token: str, wait_s: float) -> "Client":
    import errno
    import time

    from .addresses import default_address
    from .client import Client
    from .errors import FsError

    deadline_s = time.monotonic() + wait_s
    while True:
        try:
            return Client.connect(at if at is not None else default_address(db), token)
        except FsError as error:
            if error.errno not in (errno.ENOENT, errno.ECONNREFUSED):
                raise
            if time.monotonic() > deadline_s:
                if at is not None:
                    raise
                why = f"store {db!r} is not served here: `fairway serve --db {db}` does, or --at says where ({error})"
                raise FsError(error.errno, why) from error
            time.sleep(0.05)  # there is nothing to wait on yet


@app.command(
    epilog=examples(
        "fairway fs stat /clock          (waits for the next edge)", "fairway fs stat /follow/clock --token TOKEN"
    )
)
def stat(path: FilePath, db: Db = "cart", at: At = None, token: TokenOption = "", wait: Wait = 0.0) -> None:
    """Show what a file is; a clock is shown at its next edge."""
    with _client(db, at, token, wait) as client:
        typer.echo(stat_line(path, client))


def stat_line(path: str, client: "Client") -> str:
    """Tell about a file in one line."""
    found = client.stat(path)
    s, ns = divmod(found.mtime_ns, 1_000_000_000)
    kind = "directory" if found.is_dir else f"{found.size} bytes"
    return f"{path} {kind} mode {found.mode & 0o777:o} mtime {s}.{ns:09d} version {found.version}"


@app.command(epilog=examples("fairway fs cat /localise/status", "fairway fs cat /at/1200/localise/status"))
def cat(
    paths: Annotated[list[str], typer.Argument(metavar="PATH...")],
    db: Db = "cart",
    at: At = None,
    token: TokenOption = "",
    wait: Wait = 0.0,
) -> None:
    """Print files: one revision of each."""
    with _client(db, at, token, wait) as client:
        for path in paths:
            sys.stdout.buffer.write(client.read(path))
            sys.stdout.buffer.flush()


@app.command(epilog=examples("fairway fs ls", "fairway fs ls -l /follow"))
def ls(
    path: Annotated[str, typer.Argument(metavar="PATH")] = "/",
    db: Db = "cart",
    at: At = None,
    token: TokenOption = "",
    wait: Wait = 0.0,
    long: Annotated[bool, typer.Option("-l", help="With sizes. Clocks are left out: asking them would wait.")] = False,
) -> None:
    """List a directory."""
    with _client(db, at, token, wait) as client:
        for name in client.ls(path):
            if long and name != "clock":
                typer.echo(stat_line(f"{path.rstrip('/')}/{name}", client))
            else:
                typer.echo(name)


@app.command(
    epilog=examples(
        "fairway fs write /shell/status '{\"speed_mps\": 1}' --token TOKEN", "fairway fs write /notes.txt < notes.txt"
    )
)
def write(
    path: FilePath,
    text: Annotated[str | None, typer.Argument(help="What to write. Default: standard input.")] = None,
    db: Db = "cart",
    at: At = None,
    token: TokenOption = "",
    wait: Wait = 0.0,
) -> None:
    """Write a whole file, as one revision; it shows from the next edge on."""
    data = sys.stdin.buffer.read() if text is None else (text + "\n").encode()
    with _client(db, at, token, wait) as client:
        client.write(path, data)


@app.command(
    epilog=examples("coproc FS { fairway fs lines --token TOKEN; }     (in bash; then: echo wait /clock >&${FS[1]})")
)
def lines(db: Db = "cart", at: At = None, token: TokenOption = "", wait: Wait = 0.0) -> None:
    """Do what each line of standard input says, and answer with one line: for scripts that have no mount.

    wait CLOCK: number of its next edge; cat PATH: the file, as one line; write PATH TEXT: ok; ls PATH: names; bye.
    What goes wrong is answered with `error:` and why.
    """
    from ..errors import RtdbError

    with _client(db, at, token, wait) as client:
        for line in sys.stdin:
            verb, _, rest = line.strip().partition(" ")
            if verb == "bye":
                break
            try:
                print(answer(client, verb, rest), flush=True)
            except RtdbError as error:
                print(f"error: {error}", flush=True)


def answer(client: "Client", verb: str, rest: str) -> str:
    """Do what a line says; returns the answer."""
    import errno

    from .errors import FsError

    path, _, text = rest.partition(" ")
    if verb == "wait" and path.rpartition("/")[2] != "clock":
        return f"error: {path or 'nothing'} is no clock; wait /clock, or /COMPONENT/clock"
    if verb in ("cat", "write") and not path:
        return f"error: {verb} PATH"
    if verb == "wait":
        return str(client.wait(path))
    if verb == "cat":
        return client.read(path).decode(errors="replace").replace("\n", " ").strip()
    if verb == "ls":
        return " ".join(client.ls(path or "/"))
    if verb == "write":
        data = text.encode() + b"\n"
        try:
            client.rewrite(path, data)
        except FsError as error:
            if error.errno != errno.ENOENT:
                raise
            client.write(path, data)
        return "ok"
    return f"error: {verb} is none of wait, cat, ls, write, bye"
