"""Policy of the file server: who may write what, and how much of everything there may be.

A token makes who attaches with it the writer of one component: of its `status`, its `config`, its own files. The
operator's token may write every `config`. Without a token what is under components is read-only, free files are for
everybody. Nothing here trusts what a client says about users: permission bits are kept for show.
"""

import hmac
import secrets
from dataclasses import dataclass, field

OPERATOR = "operator"
RESERVED = ("files", "clock", "server", "at", OPERATOR)  # names that no component has


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """How much there may be; beyond it stands the error that a client gets."""

    connections: int = 1024  # then the connection is closed at once
    fids: int = 16_384  # of a connection: EMFILE
    writing: int = 1024  # of these open for writing: EMFILE
    draft_bytes: int = 32 << 20  # of a connection's unfinished revisions, the small ones apart: ENOSPC
    reading_bytes: int = 64 << 20  # of revisions and listings that a connection has not finished reading: ENOMEM
    waiting: int = 16_384  # blocked stats of a connection: EAGAIN
    file_bytes: int = 4 << 20  # EFBIG
    files: int = 4096  # files and directories that clients made: ENOSPC
    name_bytes: int = 255  # ENAMETOOLONG
    depth: int = 16  # directories in each other: ENAMETOOLONG
    msize: int = 1 << 20  # bytes of a message: a larger offer is answered with this
    min_msize: int = 4096  # a smaller offer is refused
    status_bytes: int = 4000  # of the status of a component that writes JSON: EFBIG
    unsent_bytes: int = 1 << 20  # replies that a client does not take: it is not listened to until it does


@dataclass(frozen=True, slots=True)
class Who:
    """Who attached: the component that it may write for, whether it is the operator, and the user that it claims."""

    component: str | None = None
    operator: bool = False
    uid: int = 0

    def may_write(self, component: str) -> bool:
        """Whether it may write a component's status and files."""
        return self.component == component

    def may_wire(self, component: str) -> bool:
        """Whether it may write a component's config."""
        return self.operator or self.component == component


@dataclass(slots=True)
class Tokens:
    """The tokens that are good: of components, by name, and of the operator."""

    of: dict[str, str] = field(default_factory=dict)

    def give(self, component: str, token: str | None = None) -> str:
        """Make a token for a component, or take the given one; returns it."""
        self.of[component] = token or f"{component}-{secrets.token_hex(6)}"
        return self.of[component]

    def who(self, names: tuple[str, ...], uid: int) -> Who:
        """Say who attaches with these texts (uname, aname). An unknown one is nobody in particular."""
        for text in names:
            for component, token in self.of.items():
                if text and hmac.compare_digest(text.encode(errors="replace"), token.encode()):
                    operator = component == OPERATOR
                    return Who(None if operator else component, operator, uid)
        return Who(uid=uid)
