"""How the commands print: as wide as the terminal, or 120 columns where there is none."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

WIDTH = 120


def console() -> "Console":
    """Make the console. Texts come from other people's programs: nothing in them is markup."""
    from rich.console import Console

    made = Console(markup=False, highlight=False, emoji=False)
    if not made.is_terminal:
        made.width = WIDTH
    return made


def table(headings: Sequence[str], title: str | None = None, fold: Sequence[str] = ()) -> "Table":
    """Make a table without lines; a heading that ends in > has its column to the right, those in `fold` may wrap."""
    from rich.table import Table

    made = Table(box=None, title=title, title_justify="left", pad_edge=False, padding=(0, 2, 0, 0))
    for heading in headings:
        name = heading.rstrip(">")
        made.add_column(
            name,
            justify="right" if heading.endswith(">") else "left",
            no_wrap=name not in fold,
            overflow="fold" if name in fold else "ellipsis",
        )
    return made
