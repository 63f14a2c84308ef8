"""The version of this program, for recordings and `--version`."""

from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as installed


def version() -> str:
    """Give the installed version, or "source" when running from a tree that is not installed."""
    try:
        return installed("fairway-cart")
    except PackageNotFoundError:
        return "source"
