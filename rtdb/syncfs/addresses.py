"""Addresses: where a file server listens, and the command that mounts it there.

unix:PATH         a socket that only its owner and root reach
tcp:HOST:PORT     loopback, unless it is said that others may come
"""

import ipaddress
import os
import stat
import tempfile
from dataclasses import dataclass
from pathlib import Path

from .errors import FsError

PORT = 5640  # 564 is the registered one, for which one must be root
MSIZE = 131_072


@dataclass(frozen=True, slots=True)
class Address:
    """A Unix socket's path, or a host and port."""

    path: Path | None = None
    host: str = ""
    port: int = 0

    @classmethod
    def parse(cls, text: str) -> "Address":
        """Read an address; FsError says what is wrong with it."""
        kind, colon, rest = text.partition(":")
        if kind == "unix" and rest:
            return cls(path=Path(rest))
        if kind == "tcp" and colon:
            host, _, port = rest.rpartition(":")
            if port.isdecimal() and int(port) < 65_536:
                return cls(host=host.strip("[]") or "127.0.0.1", port=int(port))
        raise FsError(22, f"{text}: an address is unix:PATH or tcp:HOST:PORT, as in tcp:127.0.0.1:{PORT}")

    @property
    def is_local(self) -> bool:
        """Whether only this machine reaches it."""
        if self.path is not None or self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    def __str__(self) -> str:
        return f"unix:{self.path}" if self.path is not None else f"tcp:{self.host}:{self.port}"

    def mount_command(self, token: str = "", where: str = "/mnt/fairway") -> str:
        """Give the command that mounts it with Linux' own client."""
        options = "version=9p2000.L,cache=none,access=any" + (f",aname={token}" if token else "")
        if self.path is not None:
            return f"sudo mount -t 9p -o trans=unix,msize={MSIZE},{options} {self.path} {where}"
        return f"sudo mount -t 9p -o trans=tcp,port={self.port},msize={MSIZE},{options} {self.host} {where}"


def folder() -> Path:
    """Give the folder for sockets, which only this user enters."""
    place = os.environ.get("XDG_RUNTIME_DIR")
    path = Path(place) / "fairway" if place else Path(tempfile.gettempdir()) / f"fairway-{os.getuid()}"
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    found = path.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise FsError(1, f"{path} is not a folder of this user alone; remove it, or use --listen")
    return path


def default_address(db: str) -> Address:
    """Give the socket of a store's file server."""
    return Address(path=folder() / f"{db}.9p")
