"""Compiles the C programs of these tests with the core, and runs them."""

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

import rtdb

HERE = Path(__file__).parent
CORE = Path(rtdb.__file__).parent / "core"
LIMIT_S = 300  # of a program's run: none takes a tenth of it
# What the core does with numbers of a damaged segment is meant to wrap, not to be undefined.
ADDRESS = ("-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer", "-fwrapv")
# Fences are not seen by this sanitizer, and the copies of more than 256 bytes are a race that is meant.
THREAD = ("-O1", "-fsanitize=thread", "-Wno-tsan", "-DFW_WORDWISE_MAX=4294967295u")
GUARDED = ("-Wl,--wrap=mmap,--wrap=munmap",)  # fuzz_attach.c puts forbidden pages around mappings


def compiler() -> list[str]:
    """Give the compiler and the flags of every program."""
    return [os.environ.get("CC", "cc"), "-std=c11", "-g", "-Wall", "-Wextra", "-Werror"]


def build(folder: Path, source: Path | str, *flags: str, core: Path = CORE, units: bool = True) -> Path:
    """Compile a program of these tests, with the units of the core or only with its headers."""
    if not CORE.is_dir():
        pytest.skip("no C sources beside the installed core")
    source = HERE / source
    program = folder / source.stem
    sources = sorted(path for path in core.glob("*.c") if path.name != "_core.c") if units else []
    command = [*compiler(), "-O2", *flags, f"-I{core}", f"-I{HERE}", *map(str, sources), str(source)]
    subprocess.run([*command, "-lpthread", "-o", str(program)], check=True)
    return program


def run(program: Path, *args: object, before: Sequence[str] = ()) -> subprocess.CompletedProcess[str]:
    """Run a program; what it printed on stderr is shown when the test fails."""
    command = [*before, str(program), *map(str, args)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    print(done.stderr[-20_000:])
    return done


def numbers(done: subprocess.CompletedProcess[str]) -> dict[str, int]:
    """Give what the last line says: words and numbers in turn."""
    words = done.stdout.splitlines()[-1].split()
    return {key: int(value) for key, value in zip(words[::2], words[1::2], strict=True)}


def same_addresses(folder: Path, *flags: str) -> list[str] | None:
    """Give what to put before a command so that a sanitizer finds its memory free; None: it does not work here."""
    (folder / "nothing.c").write_text("int main(void) { return 0; }\n")
    program = folder / "nothing"
    command = [*compiler(), *flags, str(folder / "nothing.c"), "-o", str(program)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        return None
    fixed = [["setarch", "-R"]] if shutil.which("setarch") else []  # without it a run in some hundreds fails
    for before in [*fixed, []]:
        if subprocess.run([*before, str(program)], capture_output=True, check=False).returncode == 0:
            return before
    return None
