"""The store as a synchronous file system: `/clock`, `/<component>/status`, free files, served over 9P.

After syncfs and cartfs of Indiana University (2008); docs/syncfs.md tells what is the same and what differs. Names are
loaded when they are used: a client needs no server.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .addresses import Address, default_address
    from .client import Client
    from .errors import FsError
    from .pace import Pace
    from .policy import OPERATOR, Limits, Tokens
    from .seats import SeatSpec
    from .server import FileServer, run
    from .service import Service

__all__ = [
    "OPERATOR",
    "Address",
    "Client",
    "FileServer",
    "FsError",
    "Limits",
    "Pace",
    "SeatSpec",
    "Service",
    "Tokens",
    "default_address",
    "run",
]

_HOME = {
    "addresses": ("Address", "default_address"),
    "client": ("Client",),
    "errors": ("FsError",),
    "pace": ("Pace",),
    "policy": ("OPERATOR", "Limits", "Tokens"),
    "seats": ("SeatSpec",),
    "server": ("FileServer", "run"),
    "service": ("Service",),
}


def __getattr__(name: str) -> Any:
    for module, names in _HOME.items():
        if name in names:
            return getattr(importlib.import_module(f".{module}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
