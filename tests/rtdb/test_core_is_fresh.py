"""The compiled core must be the one of these sources."""

import sys
from pathlib import Path

import pytest

from rtdb import Store, _core

ROOT = Path(__file__).parents[2]


def test_the_core_was_compiled_from_the_sources_beside_it():
    sources = Path(_core.__file__).parent / "core"
    if not sources.is_dir():
        sources = ROOT / "rtdb" / "core"
    if not sources.is_dir():
        pytest.skip("no C sources beside the installed core")
    import hashlib

    digest = hashlib.sha256()
    for path in sorted([*sources.glob("*.c"), *sources.glob("*.h"), sources.parent / "_core.c"]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    assert digest.hexdigest()[:16] == _core.SOURCE_HASH, (
        "rtdb/core changed since it was compiled; run: pip install -e ."
    )


def test_calls_that_return_none_keep_its_reference_count():
    """In Python 3.11 None is counted like anything else: headers of later ones, which do not count it, wear it out."""
    before = sys.getrefcount(None)
    with Store.create() as store:
        component = store.join("a")
        for _ in range(1000):
            component.status("fine")
    assert sys.getrefcount(None) > before - 500
