"""What a test with a kernel holds in its hands: the kernel, a file server, what is mounted, and what runs there."""

import asyncio
import shutil
import threading
from collections import deque
from itertools import count
from pathlib import Path
from typing import Any

from rtdb import Store
from rtdb.syncfs import Address, FileServer, Service

from . import rig

LONG_S = 30.0  # a wait that is never waited out when all is well


class Kernel:
    """One kernel for all tests; a new one after it has ended."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._boots = folder, count()
        self._image = rig.build_image(folder)
        self._guest: rig.Guest | None = None
        self.programs: list[Path] = []

    def guest(self) -> rig.Guest:
        if self._guest is None or not self._guest.alive:
            folder = self._folder / f"boot-{next(self._boots)}"
            folder.mkdir()
            self._guest = rig.Guest(self._image, folder)
        for program in self.programs:
            if not (self._guest.folder / program.name).exists():
                shutil.copy(program, self._guest.folder)
        return self._guest

    def close(self) -> None:
        if self._guest is not None:
            self._guest.close()


class Served:
    """A store and its file server, in a thread of this process."""

    def __init__(self, name: str, clock: str, options: dict[str, Any]) -> None:
        self.store = Store.create(name, clock=clock, size=64 << 20, max_objects=4096)
        self._stepped = clock == "stepped"
        self.traffic: deque[str] = deque(maxlen=50_000)
        self._options = {"trace": self.traffic.append, **options}
        self._ready = threading.Event()
        self._error: BaseException | None = None
        self._loop: asyncio.AbstractEventLoop
        self._over: asyncio.Event
        self.address: Address
        self.service: Service
        self._thread = threading.Thread(target=self._run, name="server")
        self._thread.start()
        assert self._ready.wait(LONG_S), "the file server does not start"
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except BaseException as error:
            self._error = error
        self._ready.set()

    async def _serve(self) -> None:
        self._loop, self._over = asyncio.get_running_loop(), asyncio.Event()
        server = FileServer(self.store.name, **self._options)
        self.service = server.service
        try:
            (self.address,) = await server.start([Address.parse("tcp:127.0.0.1:0")])
            self._ready.set()
            await self._over.wait()
        finally:
            await server.close()

    def tick(self) -> None:
        """End a cycle of a stepped store."""
        self.store.tick()

    def sent(self, message: str) -> list[str]:
        """Give the traffic that holds a text, `Tflush` for instance."""
        return [line for line in list(self.traffic) if message in line]

    def stop(self, *, ticks: bool = True) -> None:
        """End the server; the store stays. ticks: a stepped one may tick meanwhile, then it goes quicker."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._over.set)
            while ticks and self._stepped and self._thread.is_alive():  # its look-out for edges ends with the next one
                self.store.tick()
                self._thread.join(0.01)
            self._thread.join(LONG_S)

    def close(self) -> None:
        self.stop()
        self.store.close()
        if self._error is not None:
            raise self._error


class Job:
    """A script that runs in a mount while others do. If it ends in an `exec`, its number is that of the program."""

    def __init__(self, mount: "Mount", number: int, script: str) -> None:
        self._mount, self.stem = mount, f"/tmp/job-{number}"
        (mount.guest.folder / f"job-{number}.sh").write_text(f"echo $$ >{self.stem}.pid\n{script}\n")
        run = f"sh /host/job-{number}.sh >{self.stem}.out 2>{self.stem}.err; echo $? >{self.stem}.code"
        mount(f"({run}) </dev/null & until [ -s {self.stem}.pid ]; do usleep 1000; done")

    def _sh(self, script: str) -> rig.Ran:
        """Run a script that knows the job's outputs and number."""
        known = f"err={self.stem}.err out={self.stem}.out; read -r pid <{self.stem}.pid"
        return self._mount.ran(f"{known}; {script}", at="/")

    def until(self, condition: str) -> None:
        """Wait in the kernel until a command succeeds, as in `grep -q x $out`."""
        done = self._sh(f"until {condition}; do usleep 1000; done")
        assert done.code == 0, done.output

    def until_blocked(self) -> None:
        """Wait until it waits for an answer of the server."""
        self.until('{ read -r number name state rest </proc/$pid/stat; [ "$state" = D ]; }')

    def signal(self, name: str) -> None:
        """Send it a signal."""
        self._sh(f"kill -{name} $pid")

    def end(self) -> rig.Ran:
        """Wait until it has ended."""
        code = f"{self.stem}.code"
        return self._sh(f"until [ -s {code} ]; do usleep 1000; done; cat $out $err; exit $(cat {code})")

    def kill(self) -> None:
        """End it if it runs still, as it does when a test fails."""
        self._sh(f"[ -s {self.stem}.code ] || kill -KILL $pid")


class Mount:
    """What is mounted in the kernel."""

    _numbers = count()

    def __init__(self, guest: rig.Guest, served: Served, options: str) -> None:
        self.guest, self.where = guest, f"/mnt/{next(self._numbers)}"
        command = f"mount -t 9p -o trans=tcp,port={served.address.port},{options} {rig.HOST} {self.where}"
        self.jobs: list[Job] = []
        made = guest.run(f"mkdir -p {self.where}; {command}")
        assert made.code == 0, f"{command}: {made.output}"

    def ran(self, script: str, at: str | None = None) -> rig.Ran:
        """Run a script in it."""
        return self.guest.run(script, at or self.where)

    def __call__(self, script: str, at: str | None = None) -> str:
        """Run a script in it that must succeed; returns what it says."""
        done = self.ran(script, at)
        assert done.code == 0, f"exit code 0 was expected of {script!r}, not {done.code}: {done.output}"
        return done.output

    def names(self, folder: str = ".") -> list[str]:
        """List without stats: busybox' ls makes one of each file, and that of a clock takes until the edge."""
        return self(f"cd {folder}; printf '%s\\n' *").split()

    def refused(self, script: str) -> str:
        """Run a script in it that must fail; returns what it says."""
        done = self.ran(script)
        assert done.code != 0, f"{script!r} was expected to fail: {done.output}"
        return done.output

    def begin(self, script: str) -> Job:
        """Begin a script that others do not wait for."""
        self.jobs.append(Job(self, next(self._numbers), script))
        return self.jobs[-1]

    def unmount(self) -> None:
        """Take it away, whoever still uses it."""
        for job in self.jobs:
            job.kill()
        self.guest.run(f"umount -l {self.where}")
