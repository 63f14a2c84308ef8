"""What the tests of all packages share."""

import os
import signal
from pathlib import Path

import pytest
from hypothesis import settings
from steady import STEADY

# No test is timed, and the same tree gives the same examples.
settings.register_profile("fairway", deadline=None, derandomize=True)
settings.load_profile("fairway")

_BESIDE_CHECKOUT = Path(__file__).resolve().parents[2] / "shared" / "data"


def pytest_configure() -> None:
    """Let the programs that are tested hear Ctrl-C: what a shell starts with `&` ignores it, and its children do."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Watch the machine during tests in real time; called for each attempt."""
    if item.get_closest_marker("flaky"):
        STEADY.begin()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder with captures and maps from outside, which are not part of the repository."""
    named = os.environ.get("FAIRWAY_SHARED_DATA")
    for folder in ([Path(named)] if named else []) + [_BESIDE_CHECKOUT]:
        if folder.is_dir():
            return folder
    pytest.skip("shared/data is not beside the checkout")
