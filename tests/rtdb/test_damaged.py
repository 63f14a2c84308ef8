"""Whatever a segment holds: attaching refuses it, or reading it does, and nothing else happens."""

import os
import random
import subprocess
import sys
from pathlib import Path

import pytest
from c_programs import GUARDED, build, numbers, run
from conftest import Count, segment_path

import rtdb
from rtdb import SegmentDamaged, Store

ROUNDS = 200


@pytest.fixture(scope="module")
def fuzz(tmp_path_factory):
    return build(tmp_path_factory.mktemp("fuzz"), "fuzz_attach.c", *GUARDED)


# (7, 16): every 16th case from case 7 on; (1, 6000): seeds 1 to 6000
@pytest.mark.parametrize(
    ("mode", "args", "cases"),
    [
        pytest.param("words", (7, 16), 4000, id="every word of every table"),
        pytest.param("random", (1, 6000), 6000, id="random damage"),
        pytest.param("sizes", (), 1000, id="every length"),
        pytest.param("restore", (1, 4000), 4000, id="damaged images of a private store"),
    ],
)
def test_no_damage_leads_out_of_the_segment_or_into_an_endless_call(mode, args, cases, fuzz, unique):
    done = run(fuzz, mode, unique(), *args)
    assert done.returncode == 0, done.stdout
    assert numbers(done)["cases"] >= cases


def file_of(name: str, data: bytes) -> Path:
    path = segment_path(name)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("junk", [b"", b"FAYRTDB1", b"\0" * 8192, b"\xff" * 8192, bytes(range(256)) * 64])
def test_a_file_that_is_no_store_is_refused(junk, unique):
    name = unique()
    path = file_of(name, junk)
    with pytest.raises(SegmentDamaged, match="not a store"):
        Store.attach(name)
    path.unlink()


def test_a_store_that_lost_its_end_is_refused(unique):
    name = unique()
    with Store.create(name):
        path = segment_path(name)
        os.truncate(path, path.stat().st_size - 4096)
        with pytest.raises(SegmentDamaged):
            Store.attach(name)


def test_a_store_of_another_layout_is_refused(unique):
    name = unique()
    with Store.create(name):
        with segment_path(name).open("r+b") as file:
            file.seek(8)  # behind the magic number
            file.write((99).to_bytes(4, "little"))
        with pytest.raises(SegmentDamaged):
            Store.attach(name)


LOOK = """
import sys, traceback
from rtdb import RtdbError, Store

met = []

def attempt(call, *args):
    try:
        return call(*args)
    except RtdbError as error:
        met.append(type(error).__name__)
    except Exception:
        met.append("another error: " + " <- ".join(reversed(traceback.format_exc(limit=-2).splitlines())))

def look_at(obj, cycle):
    attempt(obj.latest)
    for c in (0, max(0, cycle - 1), cycle):
        attempt(obj.visible, c)

def look(name):
    store = attempt(Store.attach, name)
    if store is None:
        return
    with store:
        for call in (lambda: store.memory, lambda: store.clock, store.components):
            attempt(call)
        for obj in attempt(store.objects) or []:
            look_at(obj, store.cycle)
        for name in ("w/a", "w/b", "w/gone"):
            obj = attempt(store.find, name)
            if obj is not None:
                look_at(obj, store.cycle)
        attempt(store.join, "reader")

for line in sys.stdin:
    met.clear()
    look(line.strip())
    print("; ".join(sorted(set(met))) or "whole", flush=True)
"""


@pytest.fixture
def looker():
    """A process that attaches to stores and looks at everything; it says which error of the store it met."""
    paths = os.pathsep.join([str(Path(rtdb.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    process = subprocess.Popen(
        [sys.executable, "-c", LOOK],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": paths},
    )
    yield process
    process.kill()
    process.communicate()


def damaged(whole: bytes, draw: random.Random) -> bytes:
    """Some words of it replaced, mostly among those that hold something, on every page as often as on another."""
    data = bytearray(whole)
    pages = [
        [off for off in range(page, page + 4096, 8) if data[off : off + 8] != bytes(8)]
        for page in range(0, len(data), 4096)
    ]
    pages = [page for page in pages if page]
    for _ in range(draw.randint(1, 6)):
        off = draw.choice(draw.choice(pages)) if draw.random() < 0.9 else draw.randrange(0, len(data), 8)
        word = draw.choice([0, 1, 2**64 - 1, 2**63, 2**31 - 1, len(data), draw.getrandbits(64)])
        data[off : off + 8] = word.to_bytes(8, "little")
    return bytes(data)


def test_python_meets_a_damaged_segment_with_errors_of_the_store(looker, unique):
    name, draw = unique(), random.Random(1)
    with Store.create(name, size=1 << 19, max_objects=16, max_components=4) as store:
        writer = store.join("w")
        a, b, gone = (writer.insert(n, Count) for n in ("a", "b", "gone"))
        for n in range(20):
            a.write(Count(n))
            b.write(Count(n))
            store.tick()
        store.delete(store.find("w/gone"))
        del gone
        path = segment_path(name)
        whole = path.read_bytes()
        answers = []
        for _ in range(ROUNDS):
            damage = damaged(whole, draw)
            with path.open("r+b") as file:  # in place: the file that this process lives in
                file.write(damage)
            looker.stdin.write(name + "\n")
            looker.stdin.flush()
            answers.append(looker.stdout.readline().strip())
            assert answers[-1], f"it died: {looker.stderr.read()}"
        with path.open("r+b") as file:
            file.write(whole)
    others = [answer for answer in answers if "another error" in answer]
    assert not others, "\n".join(others)
    assert sum("SegmentDamaged" in answer for answer in answers) > ROUNDS // 50
    assert "ObjectMissing" in answers, "no damage was slight: the rest was not looked at"
