"""Compiles the C core into `rtdb/_core.abi3.so`, for wheels and for editable installs alike."""

import hashlib
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

UNITS = ("segment.c", "objects.c", "wait_linux.c", "_core.c")


def source_hash(core: Path) -> str:
    """Hash over the C sources; the core carries it, and the tests compare it with the tree."""
    digest = hashlib.sha256()
    for path in sorted([*core.glob("*.c"), *core.glob("*.h")]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def compile_core(root: Path) -> Path:
    """Compile the core beside its Python face and return the extension's path."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        raise SystemExit(
            f"fairway-cart runs on Linux x86-64 (WSL2 on Windows, a Linux virtual machine or container on a Mac); "
            f"this is {sys.platform} {platform.machine()}"
        )
    compiler = os.environ.get("CC", "cc")
    if shutil.which(compiler) is None:
        raise SystemExit(f"fairway-cart needs a C compiler and found no {compiler!r}: apt-get install gcc libc6-dev")
    core, target = root / "rtdb" / "core", root / "rtdb" / "_core.abi3.so"
    partial = target.with_suffix(f".{os.getpid()}.tmp")
    subprocess.run(
        [compiler, "-std=c11", "-O2", "-g", "-Wall", "-Wextra", "-fPIC", "-shared", "-fvisibility=hidden",
         f'-DFW_SOURCE_HASH="{source_hash(core)}"', f"-I{sysconfig.get_paths()['include']}",
         *(str(core / unit) for unit in UNITS), "-o", str(partial)],
        check=True,
    )  # fmt: skip
    partial.replace(target)  # a process that has the old core mapped keeps it
    return target


class CoreHook(BuildHookInterface):
    """Build the core, then tell hatchling that the wheel holds it."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile; name the wheel after CPython's stable ABI of 3.11."""
        del version
        target = compile_core(Path(self.root))
        build_data["pure_python"] = False
        build_data["tag"] = "cp311-abi3-linux_x86_64"
        build_data["force_include"][str(target)] = "rtdb/_core.abi3.so"


if __name__ == "__main__":
    print(compile_core(Path(__file__).parent))
