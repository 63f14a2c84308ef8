"""The compiled plant against the readable one, and its sines against arithmetic with whole numbers."""

from __future__ import annotations

import ctypes
import gc
import hashlib
import os
import random
import re
import struct
import subprocess
import sys
import tracemalloc
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from itertools import repeat
from math import inf, isnan, nan, nextafter, sin, ulp
from pathlib import Path
from unittest import mock

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

import sim.plant
from sim.plant import FLAT, CartParams, CartState, Coefficients, Demand, Ground, Plant, PlantSnapshot, PythonPlant

_plant = pytest.importorskip("sim._plant", reason="the plant's kernel is not compiled: python hatch_build.py")
from sim.compiled import CompiledPlant, kernel_row  # noqa: E402 - it needs what may be missing

KERNEL = Path(sim.plant.__file__).with_name("kernel")
NEEDED = ("-std=c11", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-fno-math-errno")
CARTS = (
    CartParams(),
    CartParams(load_kg=240.0, friction=0.4, steer_dead_time_s=0.1, drive_dead_time_s=0.02),
    CartParams(brake_force_n=8_000.0, brake_front_share=0.73, brake_dead_time_s=0.07),
    CartParams(steer_dead_time_s=0.0, front_weight_share=0.55, relaxation_m=0.4),
)


@contextmanager
def same_sines() -> Iterator[None]:
    """Let the readable plant take the kernel's sines: what is left must agree to the last bit."""
    sine, cosine = (lambda x: _plant.sincos(x)[0]), (lambda x: _plant.sincos(x)[1])
    with mock.patch.object(sim.plant, "sin", sine), mock.patch.object(sim.plant, "cos", cosine):
        yield


def weave(t_s: float, cart: CartState) -> tuple[Demand, Ground]:
    """Weave over hills at 5 m/s, brake hard now and then, and go back a little."""
    braking = t_s % 15.0 > 12.0
    back = t_s % 15.0 > 13.5
    drive = -0.4 if back else 0.0 if braking else 0.5 * (5.0 - cart.vx_mps) + 0.2
    demand = Demand(0.25 * sin(2.0 * t_s), 0.9 if braking and not back else 0.0, drive, 40.0 < t_s < 41.0)
    return demand, Ground(0.06 * sin(cart.x_m / 15.0), 0.06 * sin(cart.y_m / 11.0), 0.9)


def drive_both(one: Plant, other: Plant, seconds: float) -> Iterator[tuple[CartState, CartState]]:
    """Step two plants side by side, both with what suits the first one."""
    for number in range(round(seconds / 0.005)):
        demand, ground = weave(number * 0.005, one.state)
        one.step(demand, ground)
        other.step(demand, ground)
        yield one.state, other.state


def packed(*values: float) -> bytes:
    return struct.pack(f"{len(values)}d", *values)


# One step, from the same state

angles = st.floats(-0.47, 0.47)
efforts = st.floats(-1.0, 1.0)
states = st.builds(
    CartState,
    x_m=st.floats(-1e4, 1e4),
    y_m=st.floats(-1e4, 1e4),
    yaw_rad=st.floats(-1e4, 1e4),
    vx_mps=st.floats(-5.0, 12.0),
    vy_mps=st.floats(-6.0, 6.0),
    yaw_rate_radps=st.floats(-10.0, 10.0),
    steer_rad=angles,
    brake=st.floats(0.0, 1.0),
    drive=efforts,
    front_slip=st.floats(-0.3, 0.3),
    rear_slip=st.floats(-0.3, 0.3),
    ax_mps2=st.floats(-30.0, 30.0),
    ay_mps2=st.floats(-30.0, 30.0),
    left_travel_m=st.floats(-1e4, 1e4),
    right_travel_m=st.floats(-1e4, 1e4),
    distance_m=st.floats(0.0, 1e4),
)
demands = st.builds(
    Demand,
    steer_rad=st.one_of(angles, st.floats(allow_nan=False)),
    brake=st.floats(-0.5, 1.5),
    drive=st.floats(-1.5, 1.5),
    contactor_open=st.booleans(),
)
grades = st.floats(-0.3, 0.3)
grounds = st.builds(Ground, grade_x=grades, grade_y=grades, friction_factor=st.floats(0.0, 1.5))
steps = given(
    params=st.sampled_from(CARTS), dt_s=st.sampled_from([0.005, 0.010]), start=states, demand=demands, ground=grounds
)


def after_dead_time(plant: Plant, start: CartState, demand: Demand, ground: Ground) -> CartState:
    """Give the state one step after `start`, in which the demand has already passed its dead time."""
    pending = (demand,) * len(plant.snapshot().pending)
    plant.restore(PlantSnapshot(state=start, pending=pending))
    plant.step(demand, ground)
    return plant.state


@settings(max_examples=200)
@steps
def test_a_step_has_the_bits_of_the_readable_plant_given_the_same_sines(
    params: CartParams, dt_s: float, start: CartState, demand: Demand, ground: Ground
) -> None:
    with same_sines():
        readable = after_dead_time(PythonPlant(params, dt_s), start, demand, ground)
    assert after_dead_time(CompiledPlant(params, dt_s), start, demand, ground) == readable


@settings(max_examples=200)
@steps
def test_a_step_is_within_1e_12_of_the_readable_plant(
    params: CartParams, dt_s: float, start: CartState, demand: Demand, ground: Ground
) -> None:
    """Relative to the value, or to 1 (m, rad, m/s ...) where it is less: there it is a difference of larger ones."""
    readable = after_dead_time(PythonPlant(params, dt_s), start, demand, ground)
    compiled = after_dead_time(CompiledPlant(params, dt_s), start, demand, ground)
    for name in CartState.__struct_fields__:
        value, expected = getattr(compiled, name), getattr(readable, name)
        assert abs(value - expected) <= 1e-12 * max(abs(expected), 1.0), name
    assert compiled.rear_locked is readable.rear_locked


@pytest.mark.parametrize("value", [nan, inf, -inf])
@pytest.mark.parametrize("name", ["steer_rad", "brake", "drive", "grade_x", "grade_y", "friction_factor"])
def test_what_is_not_finite_spoils_the_same_fields_as_in_the_readable_plant(name: str, value: float) -> None:
    """Inputs must be finite. Neither form checks that; an infinite demand is clipped by both.

    Where Python cannot go on, because it refuses to divide by zero, the kernel's state is not a number.
    """
    demand, ground = Demand(0.1, 0.2, 0.3), Ground(0.01, 0.02, 0.9)
    if name in Demand.__struct_fields__:
        demand = replace(demand, **{name: value})
    else:
        ground = replace(ground, **{name: value})
    for params in CARTS:
        start = CartState(vx_mps=3.0, vy_mps=0.1)
        compiled = msgspec.structs.astuple(after_dead_time(CompiledPlant(params), start, demand, ground))
        try:
            with same_sines():
                readable = msgspec.structs.astuple(after_dead_time(PythonPlant(params), start, demand, ground))
        except ZeroDivisionError:
            assert any(isnan(x) for x in compiled)
            continue
        assert [isnan(x) for x in compiled] == [isnan(x) for x in readable]
        assert [x for x in compiled if not isnan(x)] == [x for x in readable if not isnan(x)]


@pytest.mark.parametrize("yaw_rad", [inf, -inf, 1.1e5, -1e300])
def test_a_cart_that_has_turned_too_often_is_refused_and_stays(yaw_rad: float) -> None:
    """The readable plant refuses an infinite yaw, and its sine slowly loses its meaning before."""
    plant = CompiledPlant(state=CartState(yaw_rad=yaw_rad, vx_mps=1.0))
    with pytest.raises(ValueError, match="yaw is beyond 100000 rad"):
        plant.step(Demand())
    assert plant.state == CartState(yaw_rad=yaw_rad, vx_mps=1.0)


# Drives


@pytest.mark.parametrize("params", CARTS)
def test_a_drive_has_the_bits_of_the_readable_plant_given_the_same_sines(params: CartParams) -> None:
    with same_sines():
        assert all(a == b for a, b in drive_both(PythonPlant(params), CompiledPlant(params), 20.0))


@pytest.mark.parametrize("params", CARTS)
def test_after_a_minute_the_carts_are_within_a_nanometre(params: CartParams) -> None:
    """12,000 steps with sliding, locked wheels and stops: last bits of sines do not grow."""
    farthest_m = 0.0
    for a, b in drive_both(PythonPlant(params), CompiledPlant(params), 60.0):
        farthest_m = max(farthest_m, abs(a.x_m - b.x_m), abs(a.y_m - b.y_m))
        assert a.rear_locked is b.rear_locked
    assert a.distance_m > 80.0
    assert farthest_m < 1e-9


def test_a_restored_snapshot_continues_with_the_same_bytes() -> None:
    plant, other = CompiledPlant(), CompiledPlant()
    list(drive_both(plant, other, 5.0))
    snapshot = plant.snapshot()
    assert other.snapshot() == snapshot
    first = [msgspec.msgpack.encode(a) for a, _ in drive_both(plant, other, 3.0)]
    plant.restore(snapshot)
    other.reset(CartState(x_m=5.0))
    other.restore(snapshot)
    assert [msgspec.msgpack.encode(b) for _, b in drive_both(plant, other, 3.0)] == first


@pytest.mark.parametrize("params", CARTS)
def test_each_plant_continues_the_snapshot_of_the_other(params: CartParams) -> None:
    with same_sines():
        readable, compiled = PythonPlant(params), CompiledPlant(params)
        list(drive_both(readable, compiled, 3.0))
        assert readable.snapshot() == compiled.snapshot()
        taken = compiled.snapshot()
        readable, compiled = PythonPlant(params), CompiledPlant(params)
        readable.restore(taken)
        compiled.restore(PythonPlant.snapshot(readable))
        assert all(a == b for a, b in drive_both(readable, compiled, 3.0))


def test_a_plant_can_start_from_every_snapshot_and_reset_of_its_kind() -> None:
    start = CartState(x_m=1.0, yaw_rad=0.5, vx_mps=2.0, steer_rad=0.2, brake=0.1, drive=0.3, rear_locked=True)
    assert CompiledPlant(state=start).snapshot() == PythonPlant(state=start).snapshot()
    assert CompiledPlant().snapshot() == PythonPlant().snapshot()
    with pytest.raises(ValueError, match="expected 6"):
        CompiledPlant(dt_s=0.010).restore(CompiledPlant().snapshot())


# Many carts


def random_rows(rng: random.Random, n: int) -> tuple[array[float], array[float]]:
    """Give n demands and n grounds as the kernel takes them."""
    asked, under = array("d"), array("d")
    for _ in range(n):
        brake = rng.choice([0.0, 0.0, 0.0, 0.0, 0.3, 1.0])
        asked.extend((rng.uniform(-0.6, 0.6), brake, rng.uniform(-0.3, 1.0), rng.random() < 0.1))
        under.extend((rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1), rng.uniform(0.3, 1.0)))
    return asked, under


def test_eight_carts_in_one_plant_have_the_bits_of_eight_plants() -> None:
    """Each with parameters and dead times of its own; the single ones take the steps one by one."""
    rng = random.Random(8)
    each = CARTS * 2
    singles = [CompiledPlant(params, dt_s) for params, dt_s in zip(each, [0.005] * 4 + [0.010] * 4, strict=True)]
    together = _plant.Plant(tuple(kernel_row(plant.params, plant.dt_s) for plant in singles))
    for _ in range(100):
        asked, under = random_rows(rng, 8)
        count = rng.choice([1, 2, 20, 50])
        together.step_each(asked, under, count)
        for i, plant in enumerate(singles):
            steer_rad, brake, drive, contactor_open = asked[4 * i : 4 * i + 4]
            demand = Demand(steer_rad, brake, drive, bool(contactor_open))
            for _ in range(count):
                plant.step(demand, Ground(*under[3 * i : 3 * i + 3]))
            row = packed(*msgspec.structs.astuple(plant.state))
            assert row == packed(*together.cart(i)) == bytes(memoryview(together).cast("B")[136 * i : 136 * i + 136])
            kept = tuple(Demand(*raw) for raw in together.pending(i))
            assert kept[-len(plant.snapshot().pending) :] == plant.snapshot().pending
    assert np.asarray(together)[:, CartState.__struct_fields__.index("distance_m")].sum() > 10.0


def test_a_cart_that_stands_still_does_not_hold_up_the_others() -> None:
    plant = _plant.Plant((kernel_row(CartParams(), 0.005),) * 3)
    states = np.asarray(plant)
    states[:, 3] = 2.0
    states[1, 2] = 2e5
    states[2, 2] = nan
    with pytest.raises(ValueError, match="1 carts stand still"):
        plant.step_each(array("d", [0.0] * 12), array("d", [0.0, 0.0, 1.0] * 3), 100)
    assert states[0, 0] > 0.9
    assert states[1].tolist() == [0.0, 0.0, 2e5, 2.0, *[0.0] * 13]
    assert isnan(states[2, 0])


def test_the_states_are_memory_that_numpy_reads_and_writes() -> None:
    plant = _plant.Plant((kernel_row(CartParams(), 0.005),) * 4)
    states = np.asarray(plant)
    assert states.shape == (4, 17)
    assert states.dtype == np.dtype("d")
    assert states.flags.writeable
    states[:, 3] = [0.0, 1.0, 2.0, 3.0]
    plant.step_each(np.zeros((4, 4)), np.array([[0.0, 0.0, 1.0]] * 4), 200)
    assert np.all(np.diff(states[:, 0]) > 0.5)
    assert plant.cart(2)[0] == states[2, 0]
    del plant
    gc.collect()
    assert states[3, 0] > 2.0  # the view keeps the memory


def test_an_image_brings_everything_back() -> None:
    rng = random.Random(3)
    plant = _plant.Plant(tuple(kernel_row(params, 0.005) for params in CARTS))
    plant.step_each(*random_rows(rng, 4), 37)
    image = plant.save()
    later = random_rows(rng, 4)
    plant.step_each(*later, 100)
    first = plant.save()
    other = _plant.Plant(tuple(kernel_row(params, 0.005) for params in CARTS))
    other.restore(image)
    other.step_each(*later, 100)
    assert other.save() == first


def test_what_does_not_fit_is_refused_and_changes_nothing() -> None:
    row = kernel_row(CartParams(), 0.005)
    plant = _plant.Plant((row, row))
    asked, under = random_rows(random.Random(1), 2)
    plant.step_each(asked, under, 10)
    image = plant.save()
    wrong: list[Callable[[], object]] = [
        lambda: plant.step(0.0, 0.0, 0.0, False, 0.0, 0.0, 1.0, 1),  # for one cart only
        lambda: plant.step_each(asked[:-1], under, 1),
        lambda: plant.step_each(asked, under[:-1], 1),
        lambda: plant.step_each(array("f", [0.0] * 16), under, 1),
        lambda: plant.restore(image[:-8]),
        lambda: plant.restore(b"?" + image[1:]),
        lambda: plant.restore(image[:24] + bytes([plant.depth]) + image[25:]),
        lambda: plant.put(0, plant.cart(1)[:-1], plant.pending(1)),
        lambda: plant.put(0, plant.cart(1), plant.pending(1)[:-1]),
        lambda: plant.put(0, plant.cart(1), (*plant.pending(1)[:-1], (0.0, 0.0, 0.0))),
        lambda: _plant.Plant(()),
        lambda: _plant.Plant((row[:-1],)),
        lambda: _plant.Plant(((*row[:-1], -1),)),
        lambda: _plant.Plant(((*row[:-1], 1 << 20),)),
    ]
    for call in wrong:
        with pytest.raises(ValueError, match=r"\w"):
            call()
    for call in (lambda: plant.step(1), lambda: plant.put(0, plant.cart(1), "no"), lambda: _plant.Plant(row)):
        with pytest.raises(TypeError):
            call()
    with pytest.raises(IndexError):
        plant.cart(2)
    assert plant.save() == image


def test_a_step_of_one_cart_allocates_nothing() -> None:
    plant = _plant.Plant((kernel_row(CartParams(), 0.005),))
    asked = (0.1, 0.0, 0.5, False, 0.0, 0.0, 1.0, 1)
    forever = repeat(None, 100)
    plant.step(*asked)
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        for _ in forever:
            plant.step(*asked)
        assert tracemalloc.get_traced_memory()[1] - before < 100  # the measurement's own
    finally:
        tracemalloc.stop()


# Sines. The second opinion: Taylor series in whole numbers of 2^-300.

BITS = 300
ONE = 1 << BITS


def _arc_tangent_of_inverse(n: int) -> int:
    total, k, power = 0, 1, ONE // n
    while power:
        total += power // k if k % 4 == 1 else -(power // k)
        power //= n * n
        k += 2
    return total


HALF_PI = 8 * _arc_tangent_of_inverse(5) - 2 * _arc_tangent_of_inverse(239)  # Machin


def fixed(x: float) -> int:
    numerator, denominator = x.as_integer_ratio()
    return (numerator << BITS) // denominator


def exact_sincos(angle: int) -> tuple[int, int]:
    n = (2 * angle + HALF_PI) // (2 * HALF_PI)
    rest = angle - n * HALF_PI
    parts, term, k = [0, 0, 0, 0], ONE, 0
    while term not in (0, -1):
        parts[k % 4] += term
        k += 1
        term = (term * rest >> BITS) // k
    s, c = parts[1] - parts[3], parts[0] - parts[2]
    return ((s, c), (c, -s), (-s, -c), (-c, s))[n % 4]


def off_by(value: float, exact: int) -> float:
    """Give the error in units of the last place."""
    return abs(fixed(value) - exact) / fixed(ulp(value))


@pytest.mark.parametrize("limit_rad", [0.47, 0.8, 7.0, 1e5, 102_900.0])
def test_sine_and_cosine_are_less_than_an_ulp_from_the_truth(limit_rad: float) -> None:
    rng = random.Random(1)
    worst = 0.0
    for _ in range(2_000):
        x = rng.uniform(-limit_rad, limit_rad)
        for value, exact in zip(_plant.sincos(x), exact_sincos(fixed(x)), strict=True):
            worst = max(worst, off_by(value, exact))
    assert worst < 0.77


def test_sine_and_cosine_are_as_good_next_to_every_quarter_turn() -> None:
    """Where x - n pi/2 cancels most: the doubles beside each multiple up to the limit, all 65,500 of them."""
    worst = 0.0
    for n in range(1, 65_500):
        multiple = n * HALF_PI
        near = multiple / ONE
        for x in (near, nextafter(near, 0.0)):
            s, c = _plant.sincos(x)
            small = (s, -c, -s, c)[n % 4]  # sine of what is left
            rest = fixed(x) - multiple
            worst = max(worst, off_by(small, rest - (rest**3 >> 2 * BITS) // 6))
    assert worst < 0.51


def test_small_large_and_absent_angles() -> None:
    assert packed(*_plant.sincos(-0.0)) == packed(-0.0, 1.0)
    assert _plant.sincos(1e-300) == (1e-300, 1.0)
    assert _plant.sincos(-1e-9) == (-1e-9, 1.0)
    for x in (nan, inf, -inf, 102_900.1, -1e300):
        assert all(isnan(value) for value in _plant.sincos(x))
    assert packed(_plant.atan(-0.0)) == packed(-0.0)
    assert _plant.atan(5e-324) == 5e-324
    assert (_plant.atan(inf), _plant.atan(-1e300)) == (HALF_PI / ONE, -HALF_PI / ONE)
    assert isnan(_plant.atan(nan))


@pytest.mark.parametrize(("low", "high"), [(-10.0, 0.0), (-1.5, -0.5), (-0.2, 0.2), (0.0, 1.0), (1.0, 17.0)])
def test_arc_tangent_is_less_than_an_ulp_from_the_truth(low: float, high: float) -> None:
    """For slopes from 10^low to 10^high. The truth by a step of Newton's method: tan(angle) = slope."""
    rng = random.Random(2)
    worst = 0.0
    for _ in range(500):
        slope = rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(low, high)
        exact = fixed(_plant.atan(slope))
        for _ in range(3):
            s, c = exact_sincos(exact)
            exact += (((fixed(slope) * c >> BITS) - s) << BITS) // (c + (fixed(slope) * s >> BITS))
        worst = max(worst, off_by(_plant.atan(slope), exact))
    assert worst < 0.80


# The C sources


def compile_kernel(folder: Path, *flags: str) -> Path:
    """Compile the kernel as a library, with the flags that it needs and some more."""
    if not KERNEL.is_dir():
        pytest.skip("no C sources beside the installed core")
    library = folder / ("kernel" + "".join(flags).replace("=", "-") + ".so")
    sources = map(str, sorted(KERNEL.glob("*.c")))
    compiler = os.environ.get("CC", "cc")
    subprocess.run([compiler, *NEEDED, *flags, "-fPIC", "-shared", *sources, "-o", str(library)], check=True)
    return library


@pytest.mark.parametrize(
    "flags", [("-O1",), ("-O3",), ("-O3", "-march=native"), ("-O2", "-funroll-loops", "-fno-inline")]
)
def test_every_compilation_gives_the_same_bytes(tmp_path: Path, flags: tuple[str, ...]) -> None:
    """Against the installed one: 32 carts, each 2,000 steps; sines and arc tangents."""
    library = ctypes.CDLL(str(compile_kernel(tmp_path, *flags)))
    rng = random.Random(4)
    rows = tuple(kernel_row(params, rng.choice([0.005, 0.010])) for params in CARTS * 8)
    installed = _plant.Plant(rows)
    block = ctypes.create_string_buffer(installed.save())
    params = b"".join(struct.pack("29d4I", *row, 0) for row in rows)
    library.fw_plant_step.argtypes = [ctypes.c_char_p] * 4 + [ctypes.c_uint64]
    library.fw_plant_step.restype = ctypes.c_uint64
    for _ in range(100):
        asked, under = random_rows(rng, len(rows))
        installed.step_each(asked, under, 20)
        assert library.fw_plant_step(block, params, asked.tobytes(), under.tobytes(), 20) == 0
    assert block.raw[:-1] == installed.save()
    library.fw_atan.argtypes, library.fw_atan.restype = [ctypes.c_double], ctypes.c_double
    s, c = ctypes.c_double(), ctypes.c_double()
    for _ in range(2_000):
        x = rng.uniform(-1.0, 1.0) * 10.0 ** rng.uniform(-8.0, 5.0)
        library.fw_sincos(ctypes.c_double(x), ctypes.byref(s), ctypes.byref(c))
        assert packed(s.value, c.value) == packed(*_plant.sincos(x))
        assert library.fw_atan(x) == _plant.atan(x)


def test_the_kernel_asks_nothing_of_the_mathematical_library_but_square_roots(tmp_path: Path) -> None:
    for level in ("-O0", "-O2"):
        library = compile_kernel(tmp_path, level)
        lines = subprocess.run(["nm", "-D", "-u", str(library)], capture_output=True, text=True, check=True).stdout
        names = {line.split()[-1].partition("@")[0] for line in lines.splitlines()}
        from_linker = {name for name in names if name.startswith("_")}
        assert names - from_linker <= {"memcpy", "memset", "sqrt", "__stack_chk_fail"}


def test_the_kernel_was_compiled_from_the_sources_beside_it() -> None:
    if not KERNEL.is_dir():
        pytest.skip("no C sources beside the installed core")
    digest = hashlib.sha256()
    for path in sorted([*KERNEL.glob("*.c"), *KERNEL.glob("*.h"), KERNEL.with_name("_plant.c")]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    assert digest.hexdigest()[:16] == _plant.SOURCE_HASH, (
        "sim/kernel changed since it was compiled; run: pip install -e ."
    )


def test_the_structs_have_the_fields_of_the_python_types_in_their_order() -> None:
    if not KERNEL.is_dir():
        pytest.skip("no C sources beside the installed core")
    text = re.sub(r"/\*.*?\*/", "", (KERNEL / "fw_plant.h").read_text(), flags=re.DOTALL)
    structs = {
        name: re.findall(r"\w+(?=[,;])", body)
        for body, name in re.findall(r"typedef struct \{(.*?)\} (\w+);", text, re.DOTALL)
    }
    assert tuple(structs["fw_cart"]) == CartState.__struct_fields__
    assert tuple(structs["fw_demand"]) == Demand.__struct_fields__
    assert tuple(structs["fw_ground"]) == Ground.__struct_fields__
    assert structs["fw_coefficients"] == [field.name for field in fields(Coefficients)]


def test_without_a_ground_the_cart_is_on_the_flat() -> None:
    plant, other = CompiledPlant(), CompiledPlant()
    for _ in range(100):
        plant.step(Demand(drive=1.0))
        other.step(Demand(drive=1.0), FLAT)
    assert plant.state == other.state
    assert plant.state.vx_mps > 0.2


def test_calls_that_return_none_keep_its_reference_count() -> None:
    """As that of the store's core, in `tests/rtdb/test_core_is_fresh.py`."""
    plant, before = CompiledPlant(CARTS[0]), sys.getrefcount(None)
    for _ in range(1000):
        plant.step(Demand(0.1, 0.0, 0.5))
    assert sys.getrefcount(None) > before - 500
