"""Errors of the file server: one exception, one table from the store's errors to Linux' numbers."""

import errno
import os

from ..errors import (
    AgedOut,
    ClockDead,
    Deleted,
    InUse,
    NameTaken,
    NotOwner,
    NotYet,
    ObjectMissing,
    ReadDenied,
    RecordError,
    RtdbError,
    StoreFull,
    TooFast,
)


class FsError(RtdbError, OSError):
    """An operation on a file that cannot be done; `errno` is Linux' number."""

    def __init__(self, code: int, why: str = "") -> None:
        super().__init__(code, why or os.strerror(code))
        self.why = why or os.strerror(code)

    def __str__(self) -> str:
        return self.why


OF_STORE: dict[type[RtdbError], int] = {
    AgedOut: errno.ESTALE,
    ClockDead: errno.ETIMEDOUT,
    Deleted: errno.ENOENT,
    InUse: errno.EBUSY,
    NameTaken: errno.EEXIST,
    NotOwner: errno.EACCES,
    NotYet: errno.ENOENT,
    ObjectMissing: errno.ENOENT,
    ReadDenied: errno.EACCES,
    RecordError: errno.EINVAL,
    StoreFull: errno.ENOSPC,
    TooFast: errno.EAGAIN,
}


def errno_of(error: RtdbError) -> int:
    """Give Linux' number for what went wrong."""
    if isinstance(error, FsError):
        return error.errno or errno.EIO
    return next((OF_STORE[cls] for cls in type(error).__mro__ if cls in OF_STORE), errno.EIO)
