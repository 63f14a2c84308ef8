"""A `fairway run` in another process, as the tests of this folder use it: look into its store, kill its parts."""

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from rtdb import Store, StoreMissing
from rtdb.db.segments import remove, segments

ROOT = Path(__file__).resolve().parents[2]
LONG_S = 60.0  # a wait that is never waited out when all is well

SCENARIO = """\
id: test/straight
about: A start and some metres straight on.
site: pad
course: {speed_mps: 2, waypoints: [{east_m: %(metres)s, north_m: 0}]}
stack: %(stack)s
duration_s: 60
criteria:
  waypoints_missed: "== 0"
  final_speed_mps: "<= 0.01"
"""


class LiveRun:
    """A run in the folder, under a name of its own. Close it."""

    def __init__(self, folder: Path, *, metres: int, stack: str = "reference") -> None:
        self.folder, self.name = folder, f"live-{os.getpid()}-{folder.name}"[:40]
        (folder / "straight.scenario.yaml").write_text(SCENARIO % {"metres": metres, "stack": stack})
        words = ["run", "straight.scenario.yaml", "--level", "direct", "--db", self.name]
        with (folder / "out.txt").open("w") as out:  # no pipe: who outlives the supervisor would keep it open
            self.process = subprocess.Popen(
                [sys.executable, "-m", "scenarios", *words], cwd=folder, stdout=out, stderr=subprocess.STDOUT, env=ENV
            )
        try:
            self.store = self._attach()
        except BaseException:
            self.process.kill()
            raise
        self._pids: set[int] = set()

    def _attach(self) -> Store:
        deadline_s = time.monotonic() + LONG_S
        while time.monotonic() < deadline_s and self.process.poll() is None:
            with suppress(StoreMissing):
                return Store.attach(self.name, timeout_s=1.0)
        raise AssertionError(f"the run did not begin: {self.printed}")

    @property
    def printed(self) -> str:
        return (self.folder / "out.txt").read_text()

    @property
    def recording(self) -> Path:
        return self.folder / "runs/test/straight/0-real/run.mcap"

    def until(self, is_so: Callable[[], bool]) -> None:
        """Wait until something is so, looking at each tick, or each time somebody comes or goes."""
        deadline_s = time.monotonic() + LONG_S
        while not is_so():
            ended = self.process.poll() is not None and not is_so()
            assert not ended, self.printed
            assert time.monotonic() < deadline_s, self.printed
            if self.store.wait_cycle(self.store.cycle, 0.1) is None:
                self.store.core.wait_directory(self.store.core.version, 10_000_000)
        self._pids = self.pids()

    def value(self, name: str) -> Any:
        """What an object shows now, None for nothing."""
        if not self.store.objects(name):
            return None
        sample = self.store.find(name).visible(self.store.cycle)
        return None if sample is None else sample.value

    def until_it_drives(self) -> None:
        self.until(lambda: (self.value("odometry/travel") or {"speed_mps": 0.0})["speed_mps"] > 1.0)

    def pid(self, component: str) -> int:
        if component == "clock":
            return self.store.clock.pid
        return next(info.pid for info in self.store.components() if info.name == component)

    def pids(self) -> set[int]:
        """The processes of the run, but for the supervisor."""
        found = {info.pid for info in self.store.components()} | {self.store.clock.pid}
        return found - {self.process.pid, 0}

    def kill(self, component: str) -> None:
        os.kill(self.pid(component), signal.SIGKILL)

    def ended(self) -> int:
        """Wait for the supervisor's end; gives its exit status."""
        return self.process.wait(LONG_S)

    def until_all_are_gone(self) -> None:
        for pid in self._pids:
            with suppress(ProcessLookupError):
                handle = os.pidfd_open(pid)
                try:
                    assert select.select([handle], [], [], LONG_S)[0], f"process {pid} does not end: {self.printed}"
                finally:
                    os.close(handle)

    def left_behind(self) -> list[str]:
        """Names of the run's stores that are still there."""
        return [segment.name for segment in segments(f"{self.name}*")]

    def close(self) -> None:
        self.store.close()
        for pid in (self.process.pid, *self._pids):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.process.wait()
        self.until_all_are_gone()
        for segment in segments(f"{self.name}*"):
            remove(segment)


ENV = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "120", "NO_COLOR": "1"}
