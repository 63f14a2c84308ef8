"""Errors of the store. One base; a leaf also inherits the standard class that fits."""

import errno
import os


class RtdbError(Exception):
    """Base of everything that the store raises."""

    def __str__(self) -> str:  # KeyError would put quotes around a whole sentence
        return " ".join(str(arg) for arg in self.args)


class StoreMissing(RtdbError, FileNotFoundError):
    """No store of that name is there."""


class ObjectMissing(RtdbError, KeyError):
    """No object or component of that name is in the store."""


class NameTaken(RtdbError, ValueError):
    """An object of that name is there already."""


class InUse(RtdbError, PermissionError):
    """A living process holds the store's name, the component or the clock."""


class NotOwner(RtdbError, PermissionError):
    """Only the component that owns an object writes it, and only the clock's holder ticks."""


class TooFast(RtdbError, RuntimeError):
    """The next slot is still named by one of the two newest cuts: more writes in a cycle than the ring has room for."""


class AgedOut(RtdbError, LookupError):
    """The value was there once; the history no longer reaches back to it."""


class Deleted(RtdbError, LookupError):
    """The object was deleted, and what is asked for came later or is no longer kept."""


class Stale(RtdbError, LookupError):
    """The value is older than its object allows, and so withheld."""


class ReadDenied(RtdbError, PermissionError):
    """Only the object's owner reads it."""


class NotRepeatable(RtdbError, RuntimeError):
    """A component of a deterministic store asked for what depends on who is faster; cuts do not."""


class ClockDead(RtdbError, TimeoutError):
    """Nobody ticks the store: who did is gone, and nobody took over."""


class DataTimeBackward(RtdbError, ValueError):
    """A write says that it was true before the one before it."""


class NotYet(RtdbError, LookupError):
    """The cycle lies in the future, or that write has not happened."""


class SegmentDamaged(RtdbError, ValueError):
    """The file is not a store, is damaged, or was made by another version."""


class StoreFull(RtdbError, MemoryError):
    """The segment, or one of its tables, has no room left."""


class RecordError(RtdbError, ValueError):
    """A record's declaration, or a value for one of its fields, is wrong."""


class RecordingError(RtdbError, ValueError):
    """A recording cannot be read, or does not fit the records of this version."""


_BY_ERRNO: dict[int, tuple[type[RtdbError], str]] = {
    errno.EAGAIN: (NotYet, "nothing is written there yet"),
    errno.ESTALE: (AgedOut, "it aged out of the history; ask for a younger cycle or insert with a longer history"),
    errno.EDOM: (NotYet, "that cycle lies in the future"),
    errno.EPERM: (NotOwner, "this process does not own it; join the component that does, or take the clock"),
    errno.ENOENT: (ObjectMissing, "it is not there; `fairway db ls` lists what is"),
    errno.EEXIST: (NameTaken, "the name is taken; names are unique in a store"),
    errno.EPROTO: (SegmentDamaged, "not a store, damaged, or made by another version; remove it or use another name"),
    errno.EMSGSIZE: (RecordError, "larger than the object's slots"),
    errno.ENOSPC: (StoreFull, "no room is left; create the store with a larger size or with more objects"),
    errno.ENAMETOOLONG: (RecordError, "a name has at most 63 bytes"),
    errno.EBADF: (NotOwner, "it is closed"),
    errno.EIDRM: (Deleted, "it was deleted; find it again by name, or ask for a cycle before its deletion"),
    errno.ETIME: (
        Stale,
        "its value is older than the object allows; see whether its writer lives: `fairway db top`",
    ),
    errno.EACCES: (ReadDenied, "only its owner reads it (flag READ_DENY)"),
    errno.EOPNOTSUPP: (
        NotRepeatable,
        "components of a deterministic store read cuts (`snapshot`, `at_cycle`): what is newest depends on luck",
    ),
    errno.EHOSTDOWN: (ClockDead, "nobody ticks the store; start a clock, or take the clock of this store"),
    errno.ERANGE: (DataTimeBackward, "its data time lies before that of the write before; data time never decreases"),
    errno.EINVAL: (RecordError, "an argument is out of range (names: printable, no blank, no '#'; at least 4 slots)"),
}


def of(code: int, call: str, subject: str) -> RtdbError:
    """Make the exception for an errno of the core; `call` and `subject` say what was tried on what."""
    if code == errno.EBUSY and call == "write":
        return TooFast(
            f"cannot write {subject}: its ring is full of what the two newest cuts still show (or min_cycle_s has not "
            f"passed); write less often, give it more slots, or see whether the clock still ticks"
        )
    if code == errno.EBUSY:
        return InUse(f"cannot {call} {subject}: a living process holds it; end that process or use another name")
    if call == "attach" and code in (errno.ENOENT, errno.EOWNERDEAD):
        left = "what a crash left of it is dead" if code == errno.EOWNERDEAD else "there is none of that name"
        return StoreMissing(
            f"cannot attach to store {subject!r}: {left}; start it, e.g. `fairway drive --db {subject}`"
        )
    kind, text = _BY_ERRNO.get(code, (RtdbError, os.strerror(code)))
    return kind(f"cannot {call} {subject}: {text}")
