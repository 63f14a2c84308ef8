"""The table in docs/rtdb.md: every capability of KogMo-RTDB has its test here; and those that have none elsewhere."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest

from rtdb import Record, State, Store, StoreMissing
from rtdb.records import i64

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "rtdb.md"
LATER = {42, 43, 44, 45, 50}  # rows that belong to later issues


class Count(Record):
    """A number."""

    n: Annotated[int, i64("", "number")] = 0


def rows():
    """Give the table's rows: number, and the ids of its tests."""
    table = re.findall(r"^\| (\d+) \|(.*)\|(.*)\|(.*)\|$", PAGE.read_text(), re.MULTILINE)
    return {
        int(number): (what.strip(), ours.strip(), re.findall(r"`([\w.]+::\w+)`", tests))
        for number, what, ours, tests in table
    }


@pytest.mark.skipif(not PAGE.is_file(), reason="no C sources beside the installed core")
def test_every_capability_of_the_table_has_a_test_that_pytest_collects():
    table = rows()
    assert sorted(table) == list(range(1, 54))
    assert {number for number, (_, _, tests) in table.items() if not tests} == LATER
    assert all(what and ours for what, ours, _ in table.values())
    command = [
        sys.executable,
        "-m",
        "pytest",
        "--collect-only",
        "-q",
        "-m",
        "",
        "-p",
        "no:cacheprovider",
        str(Path(__file__).parent),
    ]
    listing = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=True
    )
    collected = {line.split("/")[-1].split("[")[0] for line in listing.stdout.splitlines() if "::" in line}
    assert [test for _, _, tests in table.values() for test in tests if test not in collected] == []


def test_attaching_waits_for_a_store_that_is_not_there_yet(unique, peer):
    name, one = unique(), peer()
    with pytest.raises(StoreMissing):
        Store.attach(name)
    one.send(f"store = Store.attach({name!r}, timeout_s=60.0)")
    with Store.create(name):
        assert one.answer() == "None"


def test_a_component_is_an_object_with_pid_version_and_status(unique, peer):
    name, one = unique(), peer()
    with Store.create(name) as store:
        one(f"store = Store.attach({name!r})")
        one("w = store.join('w', version='2.1', participant=True)")
        health = store.find("w/health")
        told = health.latest().value
        assert (told["pid"], told["version"], told["state"], told["steps"]) == (one.process.pid, "2.1", "RUNNING", 0)
        one("w.status('cannot see the road', __import__('rtdb').State.WARNING)")
        store.tick()
        shown = store.snapshot().get(health)
        assert (shown.value["status"], shown.value["state"]) == ("cannot see the road", State.WARNING.name)
        assert store.at_cycle(0).get(health) is None, "committed like data"
        one("for c in (1, 2, 3): w.done(c)")
        for _ in range(101):
            store.tick()
        one("w.done(102)")
        told = health.latest().value
        assert told["steps"] == 4
        (info,) = store.components()
        assert (info.pid, info.version, info.done, info.alive, info.participant) == (
            one.process.pid,
            "2.1",
            102,
            True,
            True,
        )


def test_a_buffer_that_is_too_small_is_refused(unique, tmp_path):
    core = ROOT / "rtdb" / "core"
    if not core.is_dir():
        pytest.skip("no C sources beside the installed core")
    source = tmp_path / "small.c"
    source.write_text(
        '#include <errno.h>\n#include "fw_rtdb.h"\n'
        "int main(void) {\n"
        "    fw_db *db; fw_opts o = {0}; fw_info info; char small[8];\n"
        '    if (fw_create(&db, NULL, &o) < 0 || fw_join(db, "c", NULL) != 0) return 1;\n'
        '    fw_spec s = {.name = "c/n", .size = 64, .n_slots = 4, .every = 1};\n'
        '    fw_handle h = fw_insert(db, &s);\n    char value[64] = "a long value";\n'
        "    if (fw_write(db, h, value, 64, 0, NULL, 0) != 1) return 2;\n"
        "    if (fw_read(db, h, 1, small, sizeof small, &info) != -EMSGSIZE || info.size != 64) return 3;\n"
        "    const void *all;\n"
        "    if (fw_peek(db, h, 1, &all, &info) != 0 || ((const char *)all)[2] != 'l') return 4;\n"
        "    fw_close(db);\n    return 0;\n}\n"
    )
    units = map(str, core.glob("*.c"))
    subprocess.run(
        ["cc", "-std=c11", f"-I{core}", str(source), *units, "-pthread", "-o", str(tmp_path / "small")], check=True
    )
    assert subprocess.run([str(tmp_path / "small")], check=False).returncode == 0


def test_times_are_ns_since_1970_and_equal_ones_keep_their_order():
    t0_ns = int(np.datetime64("2008-05-01T12:00:00", "ns").astype(int))
    with Store.create(t0_ns=t0_ns) as store:
        writer = store.join("a").insert("n", Count)
        for n in (1, 2, 3):
            writer.write(Count(n))  # at one and the same time
        store.tick()
        assert str(np.datetime64(store.now_ns, "ns")) == "2008-05-01T12:00:00.010000000"
        assert writer.as_of(t0_ns).value.n == 3
        assert [row["n"] for row in writer.history(t0_ns, t0_ns)["value"]] == [1, 2, 3]
