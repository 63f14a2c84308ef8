"""What the tests with a kernel share: the kernel, file servers that it reaches, and what is mounted in it."""

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rtdb.syncfs import Pace

from . import rig
from .hands import Kernel, Mount, Served

HERE = Path(__file__).parent
NO_COMPILER = "no C compiler that links statically: apt-get install gcc libc6-dev"


# -- the kernel -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def kernel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Kernel]:
    reason = rig.missing()
    if reason is not None:
        pytest.skip(reason)
    one = Kernel(tmp_path_factory.mktemp("kernel"))
    yield one
    one.close()


@pytest.fixture(scope="session")
def waits(kernel: Kernel, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Puts the program `waits` into the kernel's path."""
    program = tmp_path_factory.mktemp("programs") / "waits"
    command = [os.environ.get("CC", "cc"), "-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror", "-static"]
    try:
        command += [str(HERE / "waits.c"), "-o", str(program)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip(NO_COMPILER)
    if done.returncode and "-lc" in done.stderr:  # there is only the libc to link dynamically with
        pytest.skip(NO_COMPILER)
    assert done.returncode == 0, done.stderr
    kernel.programs.append(program)


@pytest.fixture
def guest(kernel: Kernel) -> rig.Guest:
    """The kernel, alive."""
    return kernel.guest()


# -- file servers -----------------------------------------------------------------------------------------------------


@pytest.fixture
def serve(unique: Callable[[], str]) -> Iterator[Callable[..., Served]]:
    """Starts file servers over new stores. The traffic with them is shown when a test fails."""
    servers: list[Served] = []

    def start(clock: str = "stepped", **options: Any) -> Served:
        servers.append(Served(unique(), clock, options))
        return servers[-1]

    yield start
    for one in servers:
        one.close()
        print(*list(one.traffic)[-100:], sep="\n")


@pytest.fixture
def stepped(serve: Callable[..., Served]) -> Served:
    """A server whose edges are the ticks of the test, and which lets a stat of the clock wait for ever."""
    return serve(pace=Pace(every=1), grace_s=1e9)


@pytest.fixture
def real(serve: Callable[..., Served]) -> Served:
    """A server with an edge every 100 ms."""
    served = serve("real")
    served.store.run_clock()
    return served


# -- what is mounted --------------------------------------------------------------------------------------------------


@pytest.fixture(params=["9p2000.L", "9p2000.u"])
def dialect(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def mount(guest: rig.Guest, dialect: str, serve: Callable[..., Served]) -> Iterator[Callable[..., Mount]]:
    """Mounts what a server serves, in the dialect of the test."""
    mounts: list[Mount] = []

    def make(served: Served, options: str = "access=any,cache=none") -> Mount:
        mounts.append(Mount(guest, served, f"version={dialect},{options}"))
        return mounts[-1]

    yield make
    for one in mounts:
        if guest.alive:
            one.unmount()


@pytest.fixture
def tree(mount: Callable[..., Mount], stepped: Served) -> Mount:
    """A mount of the stepped server."""
    return mount(stepped)
