"""Reads and writes of the same files at the same time, by processes: none sees half a revision.

A million of them, in a minute and a half: FAIRWAY_TORN=1000000 pytest -m proof tests/rtdb/syncfs/test_torn.py
"""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rtdb import Store
from rtdb.syncfs import Client

HERE = Path(__file__).parent
ROOT = HERE.parents[2]
ENV = os.environ | {"PYTHONPATH": str(ROOT)}


def client(*job: object) -> "subprocess.Popen[str]":
    command = [sys.executable, str(HERE / "torn_client.py"), *map(str, job)]
    return subprocess.Popen(command, env=ENV, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE)


def torn(tmp_path: Path, name: str, writes: int, reads: int) -> tuple[int, int]:
    """Let 4 processes write and 4 read; gives how many reads and writes there were, and how many were torn."""
    address = f"unix:{tmp_path}/9p"
    command = [sys.executable, "-m", "scenarios", "serve", "--db", name, "--listen", address, "--every", "1"]
    command += ["--component", "a", "--component", "b", "--token", "a=a", "--token", "b=b", "--size-mb", "256"]
    server = subprocess.Popen(command, env=ENV, text=True, stdout=subprocess.PIPE)
    jobs: list[subprocess.Popen[str]] = []
    try:
        assert server.stdout is not None
        assert "serving" in server.stdout.readline()
        with Store.attach(name):
            jobs = [client(address, 131072, "write", f"/{c}/status", c, writes) for c in "ab"]
            for job in jobs:
                assert job.stdout is not None
                assert job.stdout.readline() == "ready\n", "both are components now"
            with Client.connect(address) as fs:
                for path in ("/c", "/d"):
                    fs.write(path, b"")
            files = [
                client(address, msize, "write", path, "-", writes) for path, msize in (("/c", 131072), ("/d", 8192))
            ]
            paths = "/a/status,/b/status,/c,/d"
            readers = [client(address, msize, "read", paths, "-", reads) for msize in (131072, 131072, 8192, 8192)]
            for job in (*files, *readers):
                assert job.stdout is not None
                assert job.stdout.readline() == "ready\n"
            jobs += files + readers
            for job in jobs:
                assert job.stdin is not None
                job.stdin.write("\n")
                job.stdin.flush()
            found = [int(job.communicate()[0]) for job in jobs]
        return 4 * (writes + reads), sum(found)
    finally:
        for job in jobs:
            job.kill()
            job.communicate()
        server.terminate()
        server.communicate()


def test_reads_are_never_torn_whoever_writes_meanwhile(tmp_path: Path, unique: Callable[[], str]) -> None:
    assert torn(tmp_path, unique(), 500, 2500)[1] == 0


@pytest.mark.proof
def test_of_many_reads_and_writes_none_is_torn(tmp_path: Path, unique: Callable[[], str]) -> None:
    wanted = int(os.environ.get("FAIRWAY_TORN", "200000"))
    n, n_torn = torn(tmp_path, unique(), wanted // 20, wanted // 5)
    assert n == wanted
    assert n_torn == 0
