"""Compiles the C extensions, the store's core and the plant's kernel, for wheels and for editable installs alike."""

import hashlib
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


@dataclass(frozen=True)
class Extension:
    """A folder of C sources, and the Python face beside it: `rtdb/_core.c` becomes `rtdb/_core.abi3.so`."""

    sources: str
    face: str
    flags: tuple[str, ...]

    @property
    def target(self) -> str:
        """The compiled extension, relative to the root."""
        return f"{self.face}.abi3.so"


EXTENSIONS = (
    Extension("rtdb/core", "rtdb/_core", ("-pthread", "-fwrapv")),
    # The plant gives the same bits everywhere: no multiply-and-add in one rounding; sqrt is an instruction.
    Extension("sim/kernel", "sim/_plant", ("-ffp-contract=off", "-fno-math-errno")),
)


def source_hash(sources: Path, face: Path) -> str:
    """Hash over the C sources; the extension carries it, and the tests compare it with the tree."""
    digest = hashlib.sha256()
    for path in sorted([*sources.glob("*.c"), *sources.glob("*.h"), face]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def find_compiler() -> list[str]:
    """Give the command of a C compiler: CC, cc, or what the package `ziglang` brings; empty if there is none."""
    name = os.environ.get("CC", "cc")
    if shutil.which(name) is not None:
        return [name]
    return [sys.executable, "-m", "ziglang", "cc"] if importlib.util.find_spec("ziglang") is not None else []


def compile_all(root: Path) -> list[Path]:
    """Compile each extension beside its Python face and return their paths."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        raise SystemExit(
            f"fairway-cart runs on Linux x86-64 (WSL2 on Windows, a Linux virtual machine or container on a Mac); "
            f"this is {sys.platform} {platform.machine()}"
        )
    compiler = find_compiler()
    if not compiler:
        raise SystemExit(
            "fairway-cart needs a C compiler and found none: apt-get install gcc libc6-dev, or pip install ziglang"
        )
    return [compile_one(root, compiler, extension) for extension in EXTENSIONS]


def compile_one(root: Path, compiler: list[str], extension: Extension) -> Path:
    """Compile one extension and return its path."""
    sources, face, target = root / extension.sources, root / f"{extension.face}.c", root / extension.target
    partial = target.with_suffix(f".{os.getpid()}.tmp")
    subprocess.run(
        [*compiler, "-std=c11", "-O2", "-g", "-Wall", "-Wextra", "-fPIC", "-shared", "-fvisibility=hidden",
         *extension.flags, f'-DFW_SOURCE_HASH="{source_hash(sources, face)}"', f"-I{sysconfig.get_paths()['include']}",
         *map(str, sorted(sources.glob("*.c"))), str(face), "-o", str(partial)],
        check=True,
    )  # fmt: skip
    partial.replace(target)  # a process that has the old one mapped keeps it
    return target


class CoreHook(BuildHookInterface):
    """Build the extensions, then tell hatchling that the wheel holds them."""

    def dependencies(self) -> list[str]:
        """Ask for a compiler from the package index, only where the machine has none (some 100 MB to download)."""
        return [] if shutil.which(os.environ.get("CC", "cc")) is not None else ["ziglang"]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile; name the wheel after CPython's stable ABI of 3.11."""
        del version
        targets = compile_all(Path(self.root))
        build_data["pure_python"] = False
        build_data["tag"] = "cp311-abi3-linux_x86_64"
        for extension, target in zip(EXTENSIONS, targets, strict=True):
            build_data["force_include"][str(target)] = extension.target


if __name__ == "__main__":
    print(*compile_all(Path(__file__).parent), sep="\n")
