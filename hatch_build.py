"""Compiles the C core into `rtdb/_core.abi3.so`, for wheels and for editable installs alike."""

import hashlib
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


def source_hash(core: Path) -> str:
    """Hash over the C sources; the core carries it, and the tests compare it with the tree."""
    digest = hashlib.sha256()
    for path in sorted([*core.glob("*.c"), *core.glob("*.h"), core.parent / "_core.c"]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def find_compiler() -> list[str]:
    """Give the command of a C compiler: CC, cc, or what the package `ziglang` brings; empty if there is none."""
    name = os.environ.get("CC", "cc")
    if shutil.which(name) is not None:
        return [name]
    return [sys.executable, "-m", "ziglang", "cc"] if importlib.util.find_spec("ziglang") is not None else []


def compile_core(root: Path) -> Path:
    """Compile the core beside its Python face and return the extension's path."""
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
    core, target = root / "rtdb" / "core", root / "rtdb" / "_core.abi3.so"
    partial = target.with_suffix(f".{os.getpid()}.tmp")
    subprocess.run(
        [*compiler, "-std=c11", "-O2", "-g", "-fwrapv", "-Wall", "-Wextra", "-fPIC", "-shared", "-pthread",
         "-fvisibility=hidden",
         f'-DFW_SOURCE_HASH="{source_hash(core)}"', f"-I{sysconfig.get_paths()['include']}",
         *map(str, sorted(core.glob("*.c"))), str(core.parent / "_core.c"), "-o", str(partial)],
        check=True,
    )  # fmt: skip
    partial.replace(target)  # a process that has the old core mapped keeps it
    return target


class CoreHook(BuildHookInterface):
    """Build the core, then tell hatchling that the wheel holds it."""

    def dependencies(self) -> list[str]:
        """Ask for a compiler from the package index, only where the machine has none (some 100 MB to download)."""
        return [] if shutil.which(os.environ.get("CC", "cc")) is not None else ["ziglang"]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile; name the wheel after CPython's stable ABI of 3.11."""
        del version
        target = compile_core(Path(self.root))
        build_data["pure_python"] = False
        build_data["tag"] = "cp311-abi3-linux_x86_64"
        build_data["force_include"][str(target)] = "rtdb/_core.abi3.so"


if __name__ == "__main__":
    print(compile_core(Path(__file__).parent))
