"""The store as a synchronous file system: `/clock`, `/<component>/status`, free files, served over 9P.

After syncfs and cartfs of Indiana University (2008); docs/syncfs.md tells what is the same and what differs.
"""

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
