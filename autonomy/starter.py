"""Starters: modules that already drive, for a student to begin with. Each is a file of `starters/`, under a new name.

`autonomy.starters.follower` becomes NAME, and its class `Follower` becomes the CamelCase of NAME.
"""

import importlib.util
import keyword
import re
import sys
from dataclasses import dataclass
from pathlib import Path

from .module import ModuleError

STARTERS = Path(__file__).with_name("starters")


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of module: which component it replaces, and where to try it."""

    component: str
    scenario: str = ""  # none: it comes with one of its own


KINDS = {
    "follower": Kind("follow", "parking-lot/square"),
    "avoider": Kind("avoid", "obstacles/gate"),
    "planner": Kind("plan", "obstacles/field"),
    "localiser": Kind("localise", "parking-lot/square"),
    "driver": Kind("driver"),
}


def write(name: str, kind: str, folder: Path) -> tuple[list[Path], str]:
    """Write a starter of a kind; returns the files, and the command that drives it. ModuleError says what is wrong."""
    if kind not in KINDS:
        raise ModuleError(f"--kind {kind}: there are {', '.join(KINDS)}")
    _check_name(name, folder)
    what, camel = KINDS[kind], camel_case(name)
    sources = {f"{name}.py": f"{kind}.py", f"test_{name}.py": f"test_{kind}.py"}
    if not what.scenario:
        sources[f"{name}.scenario.yaml"] = f"{kind}.scenario.yaml"
    texts = {folder / target: (STARTERS / source).read_text() for target, source in sources.items()}
    there = [path for path in texts if path.exists() or path.is_symlink()]
    if there:
        raise ModuleError(f"{there[0]} is there already; take another name, or move it away")
    if any(re.search(rf"\b{camel}\b", text) for text in texts.values()):
        raise ModuleError(f"{name}: its class would be called {camel}, and so is something that it needs; another name")
    for path, text in texts.items():
        path.write_text(_renamed(text, kind, name, camel))
    scenario = what.scenario or f"{name}.scenario.yaml"
    return list(texts), f"fairway drive {scenario} --use {what.component}={name}.py:{camel}"


def camel_case(name: str) -> str:
    """Give a class's name: my_follower becomes MyFollower."""
    return "".join(word[:1].upper() + word[1:] for word in name.split("_"))


def _renamed(text: str, kind: str, name: str, camel: str) -> str:
    text = text.replace(f"autonomy.starters.{kind}", name).replace(f"test_{kind}.py", f"test_{name}.py")
    text = text.replace(f"id: mine/{kind}\n", f"id: mine/{re.sub('_+', '-', name.lower()).strip('-')}\n")
    return re.sub(rf"\b{kind.capitalize()}\b", camel, text)


def _check_name(name: str, folder: Path) -> None:
    """Refuse what cannot be imported, and what would hide a package."""
    if not (name.isidentifier() and name.isascii()):
        raise ModuleError(f"{name!r} is no name for a Python file: letters, digits and _, not a digit in front")
    if keyword.iskeyword(name) or not camel_case(name).isidentifier():
        raise ModuleError(f"{name!r} is a word of Python's own; take another name")
    if (folder / f"{name}.py").exists():
        raise ModuleError(f"{folder / name}.py is there already; take another name, or move it away")
    if name == "conftest" or name in sys.stdlib_module_names or _importable(name):
        raise ModuleError(f"{name!r} would hide the package of that name from your programs; take another name")


def _importable(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except (ImportError, ValueError):  # __main__ has no spec
        return True
