"""A component without a module: a script that reads and writes files, in any language, is it.

In a stack its module is "files". The file server (rtdb/syncfs) lets whoever has the component's token be it; its
wiring stands in `/<component>/config`, for the script to read, and it has what inputs and parameters it likes.
"""

from .module import Module

FILES = "files"


class Files(Module):
    """Stands in a stack for such a script. Nothing hosts it."""

    def step(self) -> None:
        """Never called."""
        raise NotImplementedError("a script steps itself")
