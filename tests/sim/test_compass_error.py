"""The compass error is that of the formulas for small angles, and of the World Magnetic Model."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from math import asin, atan, cos, degrees, pi, radians, sin, tan, tau
from typing import Any

import numpy as np
import pytest

from hal.signals import wrap
from sim.compass_error import (
    CompassError,
    CompassParams,
    Deviation,
    NoMagneticModel,
    declination_rad,
    magnetic_field,
)

QUIET: dict[str, float] = {
    "constant_max_rad": 0.0,
    "one_cycle_max_rad": 0.0,
    "two_cycle_max_rad": 0.0,
    "noise_rad": 0.0,
}
"""A compass without deviation and noise."""
GRAVITY = 9.81
TURN = [k * tau / 72 for k in range(72)]
BLOOMINGTON = radians(39.165), radians(-86.526), 0.0


def compass(seed: int = 1, **changed: Any) -> CompassError:
    return CompassError(np.random.default_rng(seed), CompassParams(**(QUIET | changed)))


def shown(error: CompassError, heading_rad: float, **changed: float) -> float:
    """What is shown too much at a magnetic heading; still, level and without current unless told."""
    pitch_rad, roll_rad = changed.get("pitch_rad", 0.0), changed.get("roll_rad", 0.0)
    given = {
        "pitch_rad": 0.0,
        "roll_rad": 0.0,
        "ax_mps2": GRAVITY * sin(pitch_rad),
        "ay_mps2": GRAVITY * cos(pitch_rad) * sin(roll_rad),
        "current_a": 0.0,
        "dt_s": 0.1,
    }
    return wrap(error.heading(pi / 2 - heading_rad, 0.0, **(given | changed)) - heading_rad)


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


# ---- nothing wrong -----------------------------------------------------------------------------------


@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0), (5.0, 0.0), (0.0, -8.0), (12.0, 20.0)])
def test_a_standing_compass_without_errors_shows_the_heading_at_any_tilt(tilt_deg: tuple[float, float]) -> None:
    pitch_rad, roll_rad = map(radians, tilt_deg)
    error = compass()
    for heading_rad in TURN:
        assert shown(error, heading_rad, pitch_rad=pitch_rad, roll_rad=roll_rad) == pytest.approx(0.0, abs=1e-12)
        assert (error.pitch_rad, error.roll_rad) == pytest.approx((pitch_rad, roll_rad), abs=1e-12)


def test_the_magnetic_heading_is_the_true_one_less_the_declination() -> None:
    """4.71 degrees west: a cart that heads to true north shows 4.71."""
    heading_rad = compass().heading(pi / 2, radians(-4.71), 0.0, 0.0, 0.0, 0.0, 0.0, 0.1)
    assert degrees(heading_rad) == pytest.approx(4.71)
    assert isinstance(heading_rad, float)


# ---- deviation ---------------------------------------------------------------------------------------


def test_hard_iron_gives_one_cycle_a_turn_and_soft_iron_two() -> None:
    def cycles(deviation: Deviation) -> list[float]:
        """Amplitudes of 0, 1, 2... cycles a turn."""
        error = compass()
        error.deviation = deviation
        spectrum = np.abs(np.fft.rfft([shown(error, heading_rad) for heading_rad in TURN])) / len(TURN)
        return [spectrum[0], *(2.0 * spectrum[1:]).tolist()]

    assert cycles(Deviation(a_rad=0.01))[:4] == pytest.approx([0.01, 0.0, 0.0, 0.0], abs=1e-12)
    assert cycles(Deviation(b_rad=0.03, c_rad=0.04))[:4] == pytest.approx([0.0, 0.05, 0.0, 0.0], abs=1e-12)
    assert cycles(Deviation(d_rad=0.03, e_rad=-0.04))[:4] == pytest.approx([0.0, 0.0, 0.05, 0.0], abs=1e-12)
    drawn = cycles(CompassError(np.random.default_rng(5)).deviation)
    assert max(drawn[3:]) < 1e-12 < min(drawn[:3])


def test_deviation_of_an_adjusted_compass_stays_below_1_5_degrees_and_differs_by_seed() -> None:
    worst = []
    for seed in range(300):
        deviation = CompassError(np.random.default_rng(seed)).deviation
        worst.append(max(abs(deviation.at(heading_rad)) for heading_rad in TURN))
    assert max(worst) < radians(1.5)
    assert np.median(worst) > radians(0.4)
    assert len(set(worst)) == 300


def test_1_microtesla_across_gives_2_8_degrees_with_one_cycle_a_turn() -> None:
    error = compass(stray_ut=(0.0, 1.0, 0.0))
    curve = [shown(error, heading_rad) for heading_rad in TURN]
    assert degrees(shown(error, 0.0)) == pytest.approx(degrees(atan(1.0 / 20.67)))
    assert degrees(max(curve)) == pytest.approx(degrees(asin(1.0 / 20.67)), abs=0.01)
    assert degrees(max(curve)) == pytest.approx(2.8, abs=0.05)
    assert all(curve[k] == pytest.approx(1.0 / 20.67 * cos(h), abs=0.0025) for k, h in enumerate(TURN))


# ---- tilt and acceleration ---------------------------------------------------------------------------


def test_1_degree_of_tilt_gives_2_27_degrees_without_compensation() -> None:
    error = compass(tilt_compensated=False)
    assert degrees(shown(error, 0.0, roll_rad=radians(1.0))) == pytest.approx(-2.27, abs=0.005)
    assert degrees(shown(error, pi / 2, pitch_rad=radians(1.0))) == pytest.approx(2.27, abs=0.005)
    assert shown(error, 0.0, pitch_rad=radians(1.0)) == pytest.approx(0.0, abs=1e-12)
    for heading_rad in TURN:
        small = tan(radians(66.2)) * radians(0.01)
        roll, pitch = -small * cos(heading_rad), small * sin(heading_rad)
        assert shown(error, heading_rad, roll_rad=radians(0.01)) == pytest.approx(roll, rel=2e-3, abs=1e-6)
        assert shown(error, heading_rad, pitch_rad=radians(0.01)) == pytest.approx(pitch, rel=2e-3, abs=1e-6)


def test_1_mps2_looks_like_5_8_degrees_of_tilt() -> None:
    error = compass()
    assert degrees(shown(error, 0.0, ay_mps2=1.0)) == pytest.approx(13.0, abs=0.1)  # atan(tan 66.2 sin 5.82)
    assert degrees(error.roll_rad) == pytest.approx(5.82, abs=0.005)
    error = compass()
    shown(error, 0.0, ax_mps2=-1.0)
    assert degrees(error.pitch_rad) == pytest.approx(-5.82, abs=0.005)


def test_an_acceleration_turns_the_heading_as_the_opposite_tilt_would_uncompensated() -> None:
    for heading_rad in TURN:
        believed_rad = atan(0.01 / GRAVITY)
        expected = tan(radians(66.2)) * believed_rad
        assert shown(compass(), heading_rad, ay_mps2=0.01) == pytest.approx(expected * cos(heading_rad), abs=1e-5)
        assert shown(compass(), heading_rad, ax_mps2=0.01) == pytest.approx(-expected * sin(heading_rad), abs=1e-5)


@pytest.mark.parametrize("dt_s", [0.01, 0.1, 0.2])
def test_the_tilt_follows_an_acceleration_with_0_2_s(dt_s: float) -> None:
    error = compass()
    assert shown(error, 0.0) == 0.0
    for _ in range(round(0.2 / dt_s)):
        shown(error, 0.0, ay_mps2=1.0, dt_s=dt_s)
    assert tan(error.roll_rad) == pytest.approx((1.0 - np.exp(-1.0)) / GRAVITY)


def test_without_a_field_filter_the_heading_follows_a_turn_at_once_and_with_one_it_lags() -> None:
    for lag_s, late_rad in [(0.0, 0.0), (0.2, 0.5 * 0.2)]:
        error = compass(field_lag_s=lag_s)
        for k in range(200):
            late = -shown(error, 0.5 * 0.01 * k, dt_s=0.01)
        assert late == pytest.approx(late_rad, abs=0.004)


# ---- traction current --------------------------------------------------------------------------------


def test_100_a_at_half_a_metre_give_40_microtesla() -> None:
    """Twice the horizontal field: across it, the needle turns by atan(40 / 20.67) = 62.7 degrees."""
    error = compass(cable_distance_m=0.5)
    assert degrees(shown(error, 0.0, current_a=100.0)) == pytest.approx(-degrees(atan(40.0 / 20.67)))


def test_the_effect_of_the_traction_current_grows_with_it_and_turns_with_its_sign() -> None:
    error = compass()
    effects = [shown(error, 0.0, current_a=current_a) for current_a in (-30.0, 0.0, 30.0, 60.0)]
    assert effects == pytest.approx([-atan(0.2 * i / 1.6 / 20.67) for i in (-30.0, 0.0, 30.0, 60.0)])
    assert abs(shown(error, pi / 2, current_a=30.0)) < 1e-12  # along the needle it only shortens it


def test_a_returning_cable_close_by_takes_most_of_the_field_away() -> None:
    alone = shown(compass(), 0.0, current_a=50.0)
    pair = shown(compass(cable_gap_m=0.1), 0.0, current_a=50.0)
    assert 0.04 < pair / alone < 0.08


# ---- noise and repeatability -------------------------------------------------------------------------


def test_noise_is_0_3_degrees_and_white() -> None:
    error = compass(noise_rad=radians(0.3))
    series = [shown(error, 1.0) for _ in range(4000)]
    assert degrees(rms(series)) == pytest.approx(0.3, rel=0.05)
    assert abs(np.corrcoef(series[:-1], series[1:])[0, 1]) < 0.06


def test_same_seed_same_bytes() -> None:
    def run(seed: int) -> bytes:
        error = CompassError(np.random.default_rng(seed))
        rows = []
        for k in range(200):
            rows.append(error.heading(0.01 * k, -0.08, 0.01, -0.02, sin(k), cos(k), 10.0 * k, 0.1))
        return np.array(rows).tobytes()

    assert run(7) == run(7) != run(8)


def test_headings_lie_within_one_turn() -> None:
    error = CompassError(np.random.default_rng(3))
    for k in range(2000):
        assert 0.0 <= error.heading(pi / 2 + 1e-4 * (k % 40 - 20), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1) < tau


# ---- the Earth's field -------------------------------------------------------------------------------


def t_ns_of(year: float) -> int:
    whole = int(year)
    start, end = datetime(whole, 1, 1, tzinfo=UTC), datetime(whole + 1, 1, 1, tzinfo=UTC)
    since = start + (year - whole) * (end - start) - datetime(1970, 1, 1, tzinfo=UTC)
    return since // timedelta(microseconds=1) * 1000


@pytest.mark.parametrize(("year", "declination_deg"), [(2026.9, -4.71), (2012.5, -4.04)])
def test_declination_at_bloomington(year: float, declination_deg: float) -> None:
    pytest.importorskip("pygeomag", reason="pygeomag brings the World Magnetic Model")
    assert degrees(declination_rad(*BLOOMINGTON, t_ns_of(year))) == pytest.approx(declination_deg, abs=0.005)


def test_the_defaults_are_the_field_at_bloomington() -> None:
    pytest.importorskip("pygeomag", reason="pygeomag brings the World Magnetic Model")
    field, params = magnetic_field(*BLOOMINGTON, t_ns_of(2026.9)), CompassParams()
    assert degrees(field.inclination_rad) == pytest.approx(degrees(params.inclination_rad), abs=0.05)
    assert field.horizontal_ut == pytest.approx(params.horizontal_ut, abs=0.01)


def test_models_follow_each_other_without_a_jump() -> None:
    """Every fifth year a new model: the old one's forecast is off by tenths of a degree at most."""
    pytest.importorskip("pygeomag", reason="pygeomag brings the World Magnetic Model")
    for year in (2010, 2015, 2020, 2025, 2029.99):
        after = degrees(declination_rad(*BLOOMINGTON, t_ns_of(year)))
        assert -5.1 < after < -3.8
        if 2010 < year < 2029:
            assert degrees(declination_rad(*BLOOMINGTON, t_ns_of(year - 0.01))) == pytest.approx(after, abs=0.2)


@pytest.mark.parametrize("year", [1970.0, 2009.99, 2030.0])
def test_a_date_without_a_model_is_refused_with_the_years_that_have_one(year: float) -> None:
    with pytest.raises(NoMagneticModel, match="expected one from 2010 to 2029"):
        declination_rad(*BLOOMINGTON, t_ns_of(year))


def test_the_same_day_and_place_is_computed_once() -> None:
    pytest.importorskip("pygeomag", reason="pygeomag brings the World Magnetic Model")
    lat_rad, lon_rad, alt_m = BLOOMINGTON
    one = magnetic_field(lat_rad, lon_rad, alt_m, t_ns_of(2026.5))
    assert magnetic_field(lat_rad + 1e-7, lon_rad - 1e-7, alt_m + 20.0, t_ns_of(2026.5) + 10**9) is one
