"""The docs are executed, and their tables are those of the code.

In docs/*.md, per document and in order, in one empty folder:

    ```python      runs, all blocks of a document in one namespace
    ```yaml, ...   a block of any language whose first line is `# NAME.EXT` is also written to that file
    ```sh          lines that begin with `fairway` run; expected exit status 0, or what `# exit N` at the end says;
                   `# leave it running` puts the line into the background until the document ends, then Ctrl-C
    ```text        behind an sh block: each line stands in what the block printed; `...` stands for anything

What stands between `<!-- generated: NAME -->` and `<!-- end -->` is made by a function of the same name below.
Rewrite it with `python tests/test_docs.py --write`. A last column "meaning" that the code does not know is kept from
the document; `?` there asks for a sentence.
"""

import inspect
import os
import re
import shlex
import signal
import subprocess
import sys
import textwrap
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin

import pytest
from steady import real_time

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))
READABLE = [*PAGES, ROOT / "README.md"]
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
GENERATED = re.compile(r"(<!-- generated: ([\w-]+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)
TIMEOUT_S = 120


# -- running -------------------------------------------------------------------------------------------------------


class Block(NamedTuple):
    """A fenced block; `line`: where its first line stands in the document."""

    language: str
    text: str
    line: int


def blocks(page: Path) -> list[Block]:
    text = page.read_text()
    return [Block(m[1], m[2], text.count("\n", 0, m.start(2)) + 1) for m in FENCE.finditer(text)]


def runs_in_real_time(page: Path) -> bool:
    return any("\nfairway run " in f"\n{block.text}" for block in blocks(page) if block.language == "sh")


class Session:
    """Runs the blocks of one document. Store names get the process id, so that test runs do not meet."""

    def __init__(self, page: Path, folder: Path, namespace: dict[str, Any]) -> None:
        self.page, self.folder, self.namespace = page, folder, namespace
        self.running: list[tuple[str, int, subprocess.Popen[str]]] = []
        self.printed = ""
        self.env = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb"}

    def run(self, block: Block) -> None:
        first = block.text.partition("\n")[0]
        if named := re.fullmatch(r"# ([\w.-]+\.\w+)", first):
            (self.folder / named[1]).write_text(block.text)
        if block.language == "python":
            code = compile("\n" * (block.line - 1) + block.text, str(self.page), "exec")
            exec(code, self.namespace)
        elif block.language == "sh":
            self.printed = ""
            for offset, line in enumerate(block.text.splitlines()):
                if line.startswith("fairway "):
                    self.command(line, block.line + offset)
        elif block.language == "text":
            self.compare(block)

    def command(self, line: str, number: int) -> None:
        text, _, comment = line.partition(" #")
        named = re.sub(r"(--db[ =]\S+|^fairway wire \S+)", rf"\1-{os.getpid()}", text)
        words = shlex.split(named)
        stated = re.search(r"exit (\d+)", comment)
        expected = int(stated[1]) if stated else 0
        argv = [sys.executable, "-m", "scenarios.cli", *words[1:]]
        if "leave it running" in comment:
            process = subprocess.Popen(
                argv, cwd=self.folder, env=self.env, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
            )
            self.running.append((f"{self.page.name}:{number}: {line}", expected, process))
            if "--db" in words:
                self.wait_for_store(words[words.index("--db") + 1], process)
            return
        done = subprocess.run(
            argv, cwd=self.folder, env=self.env, text=True, capture_output=True, timeout=TIMEOUT_S, check=False
        )
        self.printed += done.stdout + done.stderr
        assert done.returncode == expected, (
            f"{self.page.name}:{number}: {line}\nexit {done.returncode}, the document says {expected}\n"
            f"{done.stdout}{done.stderr}"
        )

    def wait_for_store(self, name: str, process: "subprocess.Popen[str]") -> None:
        """Wait until another process has made its store and ticks: there is no clock here that one could step."""
        import time

        from rtdb import Store, StoreMissing

        deadline = time.monotonic() + TIMEOUT_S
        while time.monotonic() < deadline and process.poll() is None:
            try:
                with Store.attach(name) as store:
                    if store.wait_cycle(20, 1.0):
                        return
            except StoreMissing:
                time.sleep(0.02)
        raise AssertionError(f"store {name} did not come: {process.communicate()[0] if process.poll() else ''}")

    def compare(self, block: Block) -> None:
        squeezed = [" ".join(line.split()) for line in self.printed.splitlines()]
        for offset, line in enumerate(block.text.splitlines()):
            pattern = ".*".join(re.escape(part.strip()) for part in " ".join(line.split()).split("..."))
            assert any(re.search(pattern, got) for got in squeezed), (
                f"{self.page.name}:{block.line + offset}: not printed: {line}\nprinted was:\n{self.printed}"
            )

    def stop(self) -> list[str]:
        """Press Ctrl-C in what was left running; gives what ended in another way than the document says."""
        wrong, running, self.running = [], self.running, []
        for what, expected, process in running:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            try:
                output, _ = process.communicate(timeout=TIMEOUT_S)
            finally:
                process.kill()
            if process.returncode != expected:
                wrong.append(f"{what}\nexit {process.returncode}, the document says {expected}\n{output}")
        return wrong


@real_time
@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=[pytest.mark.proof] if runs_in_real_time(page) else []) for page in PAGES],
    ids=lambda page: page.name,
)
def test_everything_in_the_document_works(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    module = types.ModuleType(f"docs_{page.stem.replace('-', '_')}")
    monkeypatch.setitem(sys.modules, module.__name__, module)  # records look their annotations up there
    monkeypatch.chdir(tmp_path)
    session = Session(page, tmp_path, vars(module))
    request.addfinalizer(session.stop)  # nothing stays behind when a block fails
    for block in blocks(page):
        session.run(block)
    assert session.stop() == []


# -- what documents point at -----------------------------------------------------------------------------------------


def anchors(page: Path) -> set[str]:
    titles = re.findall(r"^#+ (.*)$", FENCE.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", READABLE, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    dead = []
    for target in re.findall(r"\]\(([^)\s]+)\)", FENCE.sub("", page.read_text())):
        if re.match(r"\w+:", target):
            continue
        place, _, anchor = target.partition("#")
        found = (page.parent / place) if place else page
        if not found.exists() or (anchor and anchor not in anchors(found)):
            dead.append(target)
    assert not dead, f"{page.name} links to {', '.join(dead)}"


@pytest.mark.parametrize("page", READABLE, ids=lambda page: page.name)
def test_files_that_are_named_are_there(page: Path) -> None:
    named = re.findall(r"`((?:rtdb|hal|sim|autonomy|scenarios|tests|benchmarks|docs)/[\w./-]+\.\w+)`", page.read_text())
    missing = sorted({name for name in named if not (ROOT / name).is_file()})
    assert not missing, f"{page.name} names {', '.join(missing)}"


def commands() -> Iterator[tuple[str, Any]]:
    """All `fairway` commands as (what one types, the command)."""
    import typer

    from scenarios.cli import app

    def walk(name: str, command: Any) -> Iterator[tuple[str, Any]]:
        inside = getattr(command, "commands", None)
        if inside is None:
            yield name, command
        for child, inner in (inside or {}).items():
            yield from walk(f"{name} {child}", inner)

    return walk("fairway", typer.main.get_command(app))


def test_every_command_and_option_is_documented() -> None:
    text = "\n".join(page.read_text() for page in READABLE)
    missing = [name for name, _ in commands() if not re.search(rf"{re.escape(name)}(?![\w-])", text)]
    missing += [
        f"{name} {option}"
        for name, command in commands()
        for parameter in command.params
        for option in parameter.opts
        if option.startswith("--") and option != "--help" and not re.search(rf"{re.escape(option)}(?![\w-])", text)
    ]
    assert not missing, f"in no document: {', '.join(missing)}"


# -- generated tables -------------------------------------------------------------------------------------------------


def table(header: str, rows: list[tuple[str, ...]]) -> str:
    """A Markdown table; `header` has its columns separated by |."""
    columns = [column.strip() for column in header.split("|")]
    lines = [columns, ["---"] * len(columns), *(list(row) for row in rows)]
    return "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)


def meanings(old: str) -> dict[str, str]:
    """First column -> last column of a table."""
    rows = [re.split(r"(?<!\\)\|", line)[1:-1] for line in old.splitlines()[2:] if line.startswith("|")]
    return {row[0].strip(): row[-1].strip().replace("\\|", "|") for row in rows if len(row) > 1}


def code(text: object) -> str:
    return f"`{text}`"


UNITS = {
    "kg": "kg", "kgm2": "kg m²", "kgpm3": "kg/m³", "m": "m", "m2": "m²", "mps": "m/s", "mps2": "m/s²", "n": "N",
    "nprad": "N/rad", "rad": "rad", "radps": "rad/s", "s": "s", "spm": "s/m", "w": "W", "per_s": "1/s", "ns": "ns",
}  # fmt: skip


def quantity(name: str, value: float) -> str:
    """A value with the unit that the end of its name says; nanoseconds become something readable."""
    words = name.lower().split("_")
    unit = next((UNITS[end] for n in (2, 1) if (end := "_".join(words[-n:])) in UNITS), "")
    if unit == "ns":
        return f"{value / 1e9:g} s" if value >= 1e9 else f"{value / 1e6:g} ms"
    return f"{value:.6g} {unit}".strip()


def cart_parameters(old: str) -> str:
    from sim.plant import CartParams

    del old
    rows, group = [], ""
    for line in inspect.getsource(CartParams).splitlines():
        if heading := re.fullmatch(r"    # (.*)", line):
            group = heading[1]
        elif field := re.fullmatch(r"    (\w+): float = .*?(?:  # (.*))?", line):
            note = field[2] or ""
            if "assumption" in group and not note.startswith("assumption"):
                note = f"assumption: {note}" if note else "assumption"
            rows.append((code(field[1]), quantity(field[1], getattr(CartParams(), field[1])), note or "assumption"))
    return table("parameter | value | source", rows)


def can_layout(old: str) -> str:
    from hal.codecs.cartcan import MESSAGES, Signal

    del old

    def signal_text(s: Signal) -> str:
        if s.length == 1:
            return f"{s.name} {s.start}"
        if s.choices is not None:
            return f"{s.name} {s.start}:{s.length} ({', '.join(f'{c.value} {c.name}' for c in s.choices)})"
        text = f"{s.name} {s.start}:{s.length}" + (" signed" if s.signed else "")
        text += f" by {s.scale:g} {s.unit}".rstrip() if s.scale != 1.0 or s.unit else ""
        lowest = -(1 << (s.length - 1)) if s.signed else 0
        if (s.raw_minimum, s.raw_maximum) not in ((lowest, s.unavailable), (lowest, s.unavailable - 1)):
            text += f" [{s.minimum:g}, {s.maximum:g}]"
        return text

    return table(
        "id | message | period | sender | signals",
        [
            (code(f"0x{m.ID:03X}"), m.NAME, quantity("_ns", m.PERIOD_NS), m.SENDER,
             "; ".join(map(signal_text, m.SIGNALS)))
            for m in MESSAGES.values()
        ],
    )  # fmt: skip


def numbers(old: str) -> str:
    """Constants of the chain that brakes. All of these places are complete: what is new asks for its meaning."""
    import hal.devices.actuators
    import hal.devices.safety
    import hal.devices.watch
    import hal.drivers.cart
    import sim.cart
    from hal.limits import Envelope

    meaning, rows = meanings(old), []
    for place, source in (
        ("limits.Envelope", Envelope()),
        ("drivers.cart", hal.drivers.cart),
        ("safety", hal.devices.safety),
        ("safety.SafetyParams", hal.devices.safety.SafetyParams()),
        ("watch", hal.devices.watch),
        ("actuators", hal.devices.actuators),
        ("sim.cart", sim.cart),
    ):
        names = source.__dataclass_fields__ if hasattr(source, "__dataclass_fields__") else vars(source)
        for name in names:
            value = getattr(source, name)
            own = f"\n{name} = " in inspect.getsource(source) if isinstance(source, types.ModuleType) else True
            wanted = place != "sim.cart" or name.endswith("_EFFORT")
            if own and wanted and type(value) in (int, float):
                key = code(f"{place}.{name}")
                rows.append((key, quantity(name, value), meaning.get(key, "?")))
    return table("constant | value | meaning", rows)


def enum_table(enum: type[IntEnum], old: str) -> str:
    meaning = meanings(old)
    return table("code | name | meaning", [(str(e.value), e.name, meaning.get(str(e.value), "?")) for e in enum])


def fault_codes(old: str) -> str:
    from hal.devices.safety import FaultCode

    return enum_table(FaultCode, old)


def limit_reasons(old: str) -> str:
    from hal.signals import Limit

    return enum_table(Limit, old)


def gps_grades(old: str) -> str:
    from sim.gps_error import GPS_GRADES

    del old
    return table(
        "grade | slow error | its correlation time | white error | height is worse by | velocity error",
        [
            (code(g.name), f"{g.slow_sigma_m:g} m", f"{g.tau_s:g} s", f"{g.white_sigma_m:g} m", f"{g.up_factor:g}",
             f"{g.velocity_sigma_mps:g} m/s")
            for g in GPS_GRADES.values()
        ],
    )  # fmt: skip


def metrics(old: str) -> str:
    from scenarios.metrics import METRICS

    del old
    return table("metric | unit | meaning", [(code(m.name), m.unit, " ".join(m.doc.split())) for m in METRICS.values()])


def command_list(old: str) -> str:
    del old
    rows = []
    for name, command in commands():
        places = [p for p in command.params if not p.opts[0].startswith("-")]
        typed = [str(p.name).upper() if p.required else f"[{str(p.name).upper()}]" for p in places]
        rows.append((code(" ".join([name, *typed])), "", (command.help or "").splitlines()[0]))
        for p in command.params:
            if p not in places and p.name != "help":
                default = "" if p.default is None or p.default is False or callable(p.default) else code(p.default)
                rows.append(
                    ("", code(p.opts[0]), " ".join((p.help or "").split()) + (f" [{default}]" if default else ""))
                )
    return table("command | option | what it does", rows)


def library(old: str) -> str:
    from scenarios.scenario import library, load_scenario

    del old
    found = [load_scenario(name) for name in library()]
    return table(
        "scenario | site | at most | what it is", [(code(s.id), s.site, f"{s.duration_s:g} s", s.about) for s in found]
    )


def scenario_keys(old: str) -> str:
    from scenarios.scenario import Scenario

    meaning = meanings(old)
    return table(
        "key | value | default | meaning",
        [(key, kind, default, doc or meaning.get(key, "?")) for key, kind, default, doc in keys_of(Scenario, "")],
    )


def keys_of(model: Any, prefix: str) -> Iterator[tuple[str, str, str, str]]:
    """(key, value, default, description) of a pydantic model and of the models inside it."""
    for name, field in model.model_fields.items():
        inner, many = field.annotation, ""
        if get_origin(inner) in (tuple, list):
            inner, many = get_args(inner)[0], "[]"
        while get_origin(inner) is not None and hasattr(inner, "__metadata__"):
            inner = get_args(inner)[0]
        choices = [c for c in union(inner) if hasattr(c, "model_fields")]
        key = f"{prefix}{name}{many}"
        default = "required" if field.is_required() else show(field.get_default(call_default_factory=True))
        yield code(key), kind_of(inner, field.metadata, bool(many), bool(choices)), default, field.description or ""
        for choice in choices:
            tag = choice.model_fields.get("kind")
            inside = key
            if len(choices) > 1 and tag is not None:
                inside = f"{key.removesuffix('[]')}[{get_args(tag.annotation)[0]}]"
            yield from keys_of(choice, f"{inside}.")


def union(annotation: Any) -> tuple[Any, ...]:
    return get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else (annotation,)


def kind_of(inner: Any, rules: list[Any], many: bool, nested: bool) -> str:
    words = {
        "str": "text",
        "float": "number",
        "int": "whole number",
        "bool": "true or false",
        "datetime": "date and time",
    }
    if nested:
        kind = "list of mappings" if many else "mapping"
    elif get_origin(inner) is dict:
        kind = "mapping"
    elif get_origin(inner) is Literal:
        kind = ", ".join(code(value) for value in get_args(inner))
    else:
        kind = " or ".join(words.get(getattr(c, "__name__", ""), "list") for c in union(inner) if c is not type(None))
        kind = f"list of {kind}s" if many else kind
    signs = {
        "gt": ">",
        "ge": "≥",
        "lt": "<",
        "le": "≤",
        "min_length": "at least",
        "max_length": "at most",
        "pattern": "like",
    }
    said = []
    for rule in rules:
        for attribute, sign in signs.items():
            value = getattr(rule, attribute, None)
            if value is not None:
                said.append(f"{sign} {code(value) if attribute == 'pattern' else f'{value:g}'}")
    return ", ".join([kind, *said])


def show(value: Any) -> str:
    if value in (None, (), {}):
        return "none"
    if hasattr(type(value), "model_fields"):
        return "its keys' defaults"
    return code(value.isoformat() if hasattr(value, "isoformat") else value)


def objects(old: str) -> str:
    """The objects of the square's stores, which stand before the first tick."""
    from scenarios.run import Drive, Setup
    from scenarios.scenario import load_scenario

    del old
    with Drive(Setup(scenario=load_scenario("parking-lot/square"))) as run:
        of_json = {"config": "How the module is wired.", "show": "What the module shows."}
        rows = [
            (
                code(o.name),
                code(o.schema.name),
                f"{o.every * 10} ms",
                of_json.get(o.name.partition("/")[2], o.schema.doc.partition("\n")[0]),
            )
            for o in sorted(run.cart.objects(), key=lambda o: o.name)
        ]
    return table("object | record | visible every | what it holds", rows)


def environments(old: str) -> str:
    from scenarios.gym import IDS, CartEnv
    from scenarios.scenario import load_scenario

    del old
    rows = []
    for name, kwargs in IDS.items():
        if not kwargs:
            rows.append((code(name), "any", "any", "", "a scenario of your own"))
            continue
        env = CartEnv(**kwargs)
        about = load_scenario(kwargs["scenario"]).about.partition(". ")[0].removesuffix(".")
        rows.append((code(name), code(kwargs["scenario"]), code(env.agent), f"{env.dt_s * 1e3:g} ms", about))
    return table("environment | scenario | agent | step | what it is", rows)


def seats(old: str) -> str:
    from autonomy.seats import SEATS

    del old

    def said(doc: str | None) -> str:
        return " ".join((doc or "").split())

    rows = [
        (
            code(name),
            ", ".join(f.name for f in seat.sees),
            str(seat.n_actions),
            f"{said(seat.__doc__)} {said(seat.act.__doc__)}",
        )
        for name, seat in SEATS.items()
    ]
    return table("agent | sees | numbers of an action | what it does", rows)


def features(old: str) -> str:
    from autonomy.features import TRUTH
    from autonomy.seats import SEATS

    del old
    known = {f.name: f for seat in SEATS.values() for f in seat.sees} | {TRUTH.name: TRUTH}
    rows = [(code(f.name), str(f.size), f"{f.low:.4g}", f"{f.high:.4g}", f.doc) for f in known.values()]
    return table("feature | numbers | low | high | what they are", rows)


def rewards(old: str) -> str:
    from scenarios import referee

    del old
    said = dict(re.findall(r"^    (\w+) {2,}(.*)$", referee.__doc__ or "", re.MULTILINE))
    assert tuple(said) == referee.TERMS
    return table("term | in a step of dt seconds", [(code(name), text) for name, text in said.items()])


def randomisation(old: str) -> str:
    from rtdb.records import schema_of
    from scenarios.randomise import RANGES, Randomised

    del old
    rows = [
        (
            code(f.name),
            *(f"{low:g} to {high:g}" for low, high in (getattr(r, f.name) for r in RANGES.values())),
            f.spec.doc,
        )
        for f in schema_of(Randomised).fields
    ]
    return table(f"what | {' | '.join(RANGES)} | meaning", rows)


TABLES: dict[str, Callable[[str], str]] = {
    function.__name__.replace("_", "-"): function
    for function in (
        can_layout, cart_parameters, command_list, environments, fault_codes, features, gps_grades, library,
        limit_reasons, metrics, numbers, objects, randomisation, rewards, scenario_keys, seats,
    )
}  # fmt: skip


@dataclass(frozen=True)
class Table:
    page: Path
    name: str
    text: str


def written() -> list[Table]:
    return [Table(page, m[2], m[3]) for page in PAGES for m in GENERATED.finditer(page.read_text())]


@pytest.mark.parametrize("found", written(), ids=lambda found: f"{found.page.name}-{found.name}")
def test_table_agrees_with_the_code(found: Table) -> None:
    wanted = TABLES[found.name](found.text)
    assert found.text == wanted, (
        f"{found.page.name}: table {found.name} is not that of the code; "
        f"run `python tests/test_docs.py --write`, or paste:\n{wanted}"
    )
    unsaid = [key for key, meaning in meanings(found.text).items() if meaning == "?"]
    assert not unsaid, f"{found.page.name}: write what {', '.join(unsaid)} means, in place of the question mark"


def test_every_table_has_its_place() -> None:
    assert sorted(found.name for found in written()) == sorted(TABLES)


def write() -> None:
    """Rewrite the generated tables of all documents."""
    for page in PAGES:
        old = page.read_text()
        new = GENERATED.sub(lambda m: m[1] + TABLES[m[2]](m[3]) + m[4], old)
        if new != old:
            page.write_text(new)
            print(f"{page.name}: rewritten")
        for found in (m for m in GENERATED.finditer(new) if "| ? |" in m[3]):
            print(f"{page.name}: table {found[2]}: a meaning is missing")


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    if sys.argv[1:] != ["--write"]:
        sys.exit(textwrap.dedent(__doc__ or ""))
    write()
