"""The GPS error has the statistics that theory and standing receivers give it."""

from __future__ import annotations

from math import exp, sqrt

import numpy as np
import pytest

from sim.gps_error import GPS_GRADES, RTK_FIXED, RTK_FLOAT, SBAS, GpsError, GpsGrade

SLOW_ONLY = GpsGrade(name="slow", slow_sigma_m=0.7, tau_s=200.0, white_sigma_m=0.0)


def receivers(grade: GpsGrade, count: int) -> list[GpsError]:
    return [GpsError(np.random.default_rng(seed), grade) for seed in range(count)]


@pytest.mark.parametrize("dt_s", [0.1, 30.0, 1_000.0])
@pytest.mark.parametrize("grade", GPS_GRADES.values(), ids=GPS_GRADES)
def test_variance_is_that_of_the_grade_from_the_first_fix_on(grade: GpsGrade, dt_s: float) -> None:
    """Slow plus white variance, before and after 5 steps of any length; 4,000 seeds leave 1.1 % error."""
    errors = receivers(grade, 4_000)
    expected_m = sqrt(grade.slow_sigma_m**2 + grade.white_sigma_m**2)
    for steps in (0, 5):
        for _ in range(steps):
            for error in errors:
                error.advance(dt_s)
        assert np.std([error.east_m for error in errors]) == pytest.approx(expected_m, rel=0.05)
        assert np.std([error.north_m for error in errors]) == pytest.approx(expected_m, rel=0.05)
        up_m = grade.up_factor * expected_m
        assert np.std([error.up_m for error in errors]) == pytest.approx(up_m, rel=0.05)
        assert abs(np.mean([error.east_m for error in errors])) < 0.07 * expected_m


def test_correlation_falls_to_1_over_e_after_tau_whatever_the_step() -> None:
    for steps in (1, 20):
        errors = receivers(SLOW_ONLY, 4_000)
        before = [error.east_m for error in errors]
        for error in errors:
            for _ in range(steps):
                error.advance(SLOW_ONLY.tau_s / steps)
        after = [error.east_m for error in errors]
        assert np.corrcoef(before, after)[0, 1] == pytest.approx(exp(-1.0), abs=0.05)


def test_axes_are_independent() -> None:
    errors = receivers(SBAS, 4_000)
    table = np.corrcoef([[e.east_m, e.north_m, e.up_m, *e.velocity_error()] for e in errors], rowvar=False)
    assert np.abs(table - np.eye(6)).max() < 0.07


def test_sbas_moves_centimetres_between_fixes_while_its_offset_wanders_by_decimetres() -> None:
    """At 1 Hz standing receivers moved 0.04-0.17 m from fix to fix, with a spread of 0.1-1 m."""
    error = GpsError(np.random.default_rng(1), SBAS)
    east_m = []
    for _ in range(3_600):
        error.advance(1.0)
        east_m.append(error.east_m)
    step_m = sqrt(np.mean(np.diff(east_m) ** 2))
    slow = SBAS.slow_sigma_m**2 * 2.0 * (1.0 - exp(-1.0 / SBAS.tau_s))
    assert step_m == pytest.approx(sqrt(slow + 2.0 * SBAS.white_sigma_m**2), rel=0.05)
    assert 0.04 < step_m < 0.17
    assert np.std(east_m) > 4.0 * step_m


def test_velocity_error_is_0_05_mps_per_axis_and_fresh_at_every_fix() -> None:
    error = GpsError(np.random.default_rng(2), SBAS)
    series = []
    for _ in range(4_000):
        error.advance(0.1)
        assert error.velocity_error() == error.velocity_error()
        series.append(error.velocity_error()[0])
    assert np.std(series) == pytest.approx(0.05, rel=0.05)
    assert abs(np.corrcoef(series[:-1], series[1:])[0, 1]) < 0.06


def test_losing_the_fixed_solution_enlarges_the_same_offset() -> None:
    error = GpsError(np.random.default_rng(3), RTK_FIXED)
    fixed_m = error.east_m
    error.grade = RTK_FLOAT
    assert abs(error.east_m) > abs(fixed_m)
    error.grade = RTK_FIXED
    assert error.east_m == fixed_m


def test_same_seed_same_bytes() -> None:
    def run() -> bytes:
        error = GpsError(np.random.default_rng(7), SBAS)
        rows = []
        for _ in range(200):
            error.advance(0.1)
            rows.append((error.east_m, error.north_m, error.up_m, *error.velocity_error()))
        return np.array(rows).tobytes()

    assert run() == run()


def test_a_reading_changes_nothing() -> None:
    error = GpsError(np.random.default_rng(8), SBAS)
    error.advance(0.1)
    assert (error.east_m, error.north_m, error.up_m) == (error.east_m, error.north_m, error.up_m)
