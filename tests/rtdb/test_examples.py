"""The road tracker in C and in Python, each in a process of its own, against a camera here; and the header in C++."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import rtdb
from rtdb import Store
from rtdb.c_header import header_of

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
CORE = Path(rtdb.__file__).parent / "core"
FRAMES = 40
pytestmark = pytest.mark.skipif(
    not EXAMPLES.is_dir() or not CORE.is_dir(), reason="no C sources beside the installed core"
)
sys.path.insert(0, str(ROOT))


def compiled(folder, source, *flags):
    program = folder / source.stem
    compiler = [os.environ.get("CC", "cc"), "-std=c11"] if source.suffix == ".c" else ["c++", "-std=c++17"]
    objects = []
    for unit in sorted(CORE.glob("*.c")):  # the core is C, also for a C++ program
        objects.append(folder / f"{unit.stem}.o")
        subprocess.run(
            ["cc", "-std=c11", "-O2", "-Wall", "-Wextra", "-Werror", "-c", str(unit), "-o", str(objects[-1])],
            check=True,
        )
    command = [*compiler, "-O2", "-Wall", "-Wextra", "-Werror", *flags, f"-I{CORE}", f"-I{EXAMPLES}", str(source)]
    subprocess.run([*command, *map(str, objects), "-pthread", "-o", str(program)], check=True)
    return program


def picture(offset_m, heading_rad):
    """A road with a bright stripe where it is said to be."""
    from examples.roadtracker import DEPTH_M, WIDTH_M

    pixels = np.zeros((48, 64, 1), np.uint8)
    for row in range(48):
        left_m = offset_m + heading_rad * (47.5 - row) * DEPTH_M / 48
        column = (0.5 - left_m / WIDTH_M) * 64
        pixels[row, round(column - 4) : round(column + 4), 0] = 200
    return pixels


def follow(command, name):
    """Show a tracker 40 pictures; give what it wrote about them, and the offsets and headings that were shown."""
    from examples.roadtracker_records import CameraFrame, Lane

    shown = [(0.6 * np.sin(k / 5), 0.1 * np.cos(k / 7)) for k in range(FRAMES)]
    with Store.create(name) as store:
        process = subprocess.Popen([*map(str, command), name], env=os.environ | {"PYTHONPATH": str(ROOT)})
        try:
            lane = store.find("roadtracker/lane", Lane, timeout_s=30.0)
            camera = store.join("camera").insert("left", CameraFrame, history_s=1.0)
            found = []
            for k, (offset_m, heading_rad) in enumerate(shown):
                camera.write(CameraFrame(picture(offset_m, heading_rad)), t_data_ns=k)
                assert lane.wait(k, timeout_s=30.0) == k + 1
                found.append(lane.read(k + 1))
                store.tick()
            oid = camera.oid
            camera.delete()
            assert process.wait(30) == 0, "it ends when its camera is gone"
        finally:
            process.kill()
            process.wait()
    return found, shown, oid


def assert_followed(found, shown, oid):
    for k, (sample, (offset_m, heading_rad)) in enumerate(zip(found, shown, strict=True)):
        assert sample.value.offset_m == pytest.approx(offset_m, abs=0.06)
        assert sample.value.heading_rad == pytest.approx(heading_rad, abs=0.03)
        assert sample.t_data_ns == k, "true when the picture was taken"
        assert sample.causes == ((oid, k + 1),)


def test_the_road_tracker_in_c_follows_a_camera_in_python(unique, tmp_path):
    assert_followed(*follow([compiled(tmp_path, EXAMPLES / "roadtracker.c")], unique()))


def test_the_road_tracker_in_python_follows_it_as_well(unique):
    assert_followed(*follow([sys.executable, EXAMPLES / "roadtracker.py"], unique()))


def test_the_header_of_the_example_is_the_one_that_its_records_give():
    assert (EXAMPLES / "roadtracker.h").read_text() == header_of("examples.roadtracker_records")


def test_cpp_includes_the_header_and_writes_what_python_reads(unique, tmp_path):
    from examples.roadtracker_records import Lane

    name = unique()
    with Store.create(name) as store:
        program = compiled(tmp_path, Path(__file__).with_name("include.cpp"))
        subprocess.run([str(program), name], check=True, timeout=60)
        lane = store.find("cpp/lane", Lane)
        assert lane.read(1).value == Lane(1.5, -0.25)
        assert lane.head == 1
        assert [c.version for c in store.components() if c.name == "cpp"] == ["c++"]


def test_the_listing_in_the_docs_is_the_program():
    page = (ROOT / "docs" / "rtdb.md").read_text()
    listing = page.split("```py\n", 1)[1].split("```", 1)[0]
    program = " ".join((EXAMPLES / "roadtracker.py").read_text().split())
    assert " ".join(listing.split()) in program
    command = page.split("```bash\n", 1)[1].split("```", 1)[0]
    assert command.startswith("cc -std=c11 -O2 -Irtdb/core examples/roadtracker.c rtdb/core/*.c")
