"""A Linux kernel that tests can mount file systems with: User Mode Linux, a process of this machine.

It has busybox, the modules of 9P, and one way out: slirp, by which 10.0.2.2 is this machine's loopback. Nothing is
mounted on this machine, and nobody needs to be root.

    this process                                    the kernel
    pipe          -- "7 /mnt/2\n" -->               tty1, read by /init
    folder/7.sh   -- the script -->                 hostfs, /host: run in /mnt/2
    folder/7.out  <-- both its streams --
    pipe          <-- "7 0 130\n" --                exit code, milliseconds
"""

import contextlib
import os
import select
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

MISSING = (
    "a Linux kernel to mount with is not installed: apt-get install user-mode-linux slirp busybox-static cpio kmod"
)
TOOLS = ("linux.uml", "slirp-fullbolt", "busybox", "cpio")
MODULES = ("9pnet_fd", "9p")
MODULE_FOLDERS = Path("/usr/lib/uml/modules")
HOST = "10.0.2.2"  # what slirp calls this machine
MEMORY_MB = 192
LIMIT_S = 60.0  # of a script or of the start: none takes a tenth of it

INIT = """\
#!/bin/busybox sh
/bin/busybox --install -s /bin
export PATH=/bin HOME=/tmp
mount -t proc none /proc
mount -t sysfs none /sys
mount -t devtmpfs none /dev
mount -t tmpfs none /tmp
mkdir /etc
echo root:x:0:0::/tmp:/bin/sh >/etc/passwd
echo user:x:1000:1000::/tmp:/bin/sh >>/etc/passwd
for module in /modules/*; do insmod $module; done
ip link set lo up
until ip address add 10.0.2.15/24 dev eth0; do usleep 10000; done 2>/dev/null
ip link set eth0 up
mount -t hostfs none /host
PATH=$PATH:/host
exec </dev/tty1 >/dev/tty1
stty raw -echo
now() { read -r up idle </proc/uptime; ms=${up%.*}${up#*.}0; }
echo ready
while read -r number folder; do
    now; begun=$ms
    (cd "$folder" && . /host/$number.sh) </dev/null >/host/$number.out 2>&1
    code=$?
    now; echo $number $code $((ms - begun))
done
poweroff -f
"""


class RigError(Exception):
    """The kernel does not start, or has stopped answering."""


class Ran(NamedTuple):
    """What became of a script: both its streams, its exit code, and how long it took."""

    output: str
    code: int
    ms: int


def missing() -> str | None:
    """Say what to install, None where everything is there."""
    if any(shutil.which(tool, path=_path()) is None for tool in TOOLS):
        return MISSING
    if b"/ld-linux" in Path(_tool("busybox")).read_bytes()[:4096]:  # that of the package `busybox` needs libraries
        return MISSING
    return None if _modules() else MISSING


def _path() -> str:
    return os.environ.get("PATH", "") + ":/sbin:/usr/sbin:/bin:/usr/bin"


def _tool(name: str) -> str:
    found = shutil.which(name, path=_path())
    assert found is not None, MISSING
    return found


def _modules() -> list[Path]:
    """Give the kernel's modules for 9P in an order in which they can be loaded; none where it has no such modules.

    A line of modules.dep is a module and what it needs: what is last on the line needs nothing of what is before it.
    """
    release = subprocess.run([_tool("linux.uml"), "--version"], capture_output=True, text=True, check=True).stdout
    folder = MODULE_FOLDERS / release.strip()
    needs = {}
    if (folder / "modules.dep").is_file():
        for line in (folder / "modules.dep").read_text().splitlines():
            path, _, others = line.partition(":")
            needs[Path(path).name.partition(".")[0]] = [path, *others.split()]
    if not set(MODULES) <= needs.keys():
        return []
    order = [folder / path for name in MODULES for path in reversed(needs[name])]
    return list(dict.fromkeys(order))


def build_image(folder: Path) -> Path:
    """Build the file system that the kernel starts with; returns the archive."""
    root = folder / "root"
    for name in ("bin", "dev", "host", "mnt", "modules", "proc", "sys", "tmp"):
        (root / name).mkdir(parents=True)
    shutil.copy(_tool("busybox"), root / "bin" / "busybox")
    for k, module in enumerate(_modules()):
        shutil.copy(module, root / "modules" / f"{k:02}-{module.name}")
    (root / "init").write_text(INIT)
    (root / "init").chmod(0o755)
    names = "".join(f"{path.relative_to(root)}\n" for path in sorted(root.rglob("*")))
    packed = subprocess.run(
        [_tool("cpio"), "--quiet", "-o", "-H", "newc"], input=names.encode(), cwd=root, capture_output=True, check=True
    )
    image = folder / "image.cpio"
    image.write_bytes(packed.stdout)
    return image


def _place_for_memory(folder: Path) -> str:
    """Say where the kernel's memory goes, which is a file that it executes: into RAM if there is room."""
    shm = "/dev/shm"
    if os.path.isdir(shm) and os.access(shm, os.W_OK):
        found = os.statvfs(shm)
        if not found.f_flag & os.ST_NOEXEC and found.f_bavail * found.f_frsize > 2 * MEMORY_MB << 20:
            return shm
    return str(folder)


class Guest:
    """A running kernel. One script runs at a time. Programs in `folder` are in its path. Use it in a `with`."""

    def __init__(self, image: Path, folder: Path) -> None:
        self.folder = folder
        self._scripts = 0
        self._said = b""
        self._work = tempfile.TemporaryDirectory(prefix="uml-")  # its sockets: their paths must be short
        with open(folder / "console", "wb") as console:
            self._process = subprocess.Popen(
                [
                    _tool("linux.uml"), f"mem={MEMORY_MB}M", f"initrd={image}", "rdinit=/init", f"hostfs={folder}",
                    f"uml_dir={self._work.name}", f"eth0=slirp,,{_tool('slirp-fullbolt')}", "panic=-1", "quiet",
                    "con=null", "con0=null,fd:2", "con1=fd:0,fd:1", "ssl=null",
                ],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=console, bufsize=0,
                env=os.environ | {"TMPDIR": _place_for_memory(folder), "PATH": _path()}, start_new_session=True,
            )  # fmt: skip
        try:
            self._until("ready", time.monotonic() + LIMIT_S)
        except BaseException:
            self.close()
            raise

    @property
    def alive(self) -> bool:
        """Whether it takes scripts."""
        return self._process.poll() is None

    def run(self, script: str, at: str = "/", limit_s: float = LIMIT_S) -> Ran:
        """Run a script in one of its folders. RigError, and the end of the kernel, if that takes too long."""
        self._scripts += 1
        number = str(self._scripts)
        (self.folder / f"{number}.sh").write_text(script + "\n")
        try:
            self._process.stdin.write(f"{number} {at}\n".encode())
            words = self._until(number, time.monotonic() + limit_s)
        except (RigError, OSError) as error:
            self.close()
            raise RigError(f"{error}; the script was: {script}; until then: {self._output(number)}") from error
        return Ran(self._output(number), int(words[1]), int(words[2]))

    def _output(self, number: str) -> str:
        path = self.folder / f"{number}.out"
        return path.read_text(errors="replace") if path.exists() else ""

    def _until(self, word: str, deadline_s: float) -> list[str]:
        """Give the line that begins with a word, when it comes."""
        out = self._process.stdout.fileno()
        while True:
            line, end, rest = self._said.partition(b"\n")
            if end:
                self._said = rest
                words = line.decode(errors="replace").split()
                if words and words[0] == word:
                    return words
                continue
            if not select.select([out], [], [], max(0.0, deadline_s - time.monotonic()))[0]:
                raise RigError(f"the kernel does not answer{self._last_words()}")
            data = os.read(out, 4096)
            if not data:
                raise RigError(f"the kernel has ended{self._last_words()}")
            self._said += data

    def _last_words(self) -> str:
        text = (self.folder / "console").read_text(errors="replace").strip()
        return "; on its console: " + text[-1000:] if text else ""

    def close(self) -> None:
        """End it, with all its processes."""
        self._process.stdin.close()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._process.stdout.close()
        self._work.cleanup()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
