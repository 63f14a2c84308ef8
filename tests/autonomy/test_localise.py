"""The localiser: errors as large as it says (it does not cheat), late fixes, outages, bad fixes.

Consistency: e' P^-1 e, the normalised estimation error squared (NEES), of a correct filter is chi-square distributed
with as many degrees of freedom as the state has; so is its sum over runs (Bar-Shalom, Li, Kirubarajan, Estimation with
Applications to Tracking and Navigation, 2001, section 5.4).
"""

import math
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import numpy as np
import pytest

from autonomy.host import Host
from autonomy.localise import REFUSE_AT_MOST, Localise
from autonomy.wiring import Wire
from hal.signals import CartTruth, Course, FixQuality, GpsFix, LocalPlane, Odometry, Pose, Site, wrap
from rtdb import Store
from scenarios.run import Drive, Setup
from scenarios.scenario import GpsOutageFault, load_scenario

TICK_NS = 10_000_000
T0_NS = 1_700_000_000_000_000_000
SITE = Site("field", math.radians(39.18), math.radians(-86.52), 200.0)
PLANE = LocalPlane.at(SITE.lat_rad, SITE.lon_rad)
TRACK_M, ANTENNA_M = Localise.params["track_m"].default, Localise.params["antenna_x_m"].default


# -- in the loop ------------------------------------------------------------------------------------------------------

Errors = np.ndarray[Any, Any]
"""One drive, a row for each pose: data time s, error x m, y m, yaw rad, NEES, sigma_m, fix_age_s, true speed m/s."""


SQUARE, FIELD_TRIAL = "parking-lot/square", "p545/field-trial"


def drive(name: str, seed: int, outage_at_s: float | None = None, until_s: float = math.inf) -> Errors:
    """Drive without a recording, and compare each pose with the truth at its data time."""
    scenario = load_scenario(name)
    if outage_at_s is not None:
        outage = GpsOutageFault(kind="gps-outage", at_s=outage_at_s, for_s=3.0)
        scenario = scenario.model_copy(update={"faults": (outage,)})
    rows: list[list[float]] = []
    with Drive(Setup(scenario=scenario, seed=seed, level="direct")) as run:
        poses, truths = run.cart.find("localise/pose", Pose), run.world.find("world/cart", CartTruth)
        last = 0
        while not run.tick() and run.time_s < until_s:
            pose = poses.visible(run.cart.cycle)
            if pose is None or pose.write == last:
                continue
            last = pose.write
            cycle = (pose.t_data_ns - run.cart.t0_ns) // run.cart.tick_ns
            truth = truths.visible(cycle)
            if truth is None:
                continue
            assert truth.t_data_ns == pose.t_data_ns, "the truth of that very time"
            error = np.array(
                [
                    pose.value.x_m - truth.value.x_m,
                    pose.value.y_m - truth.value.y_m,
                    wrap(pose.value.yaw_rad - truth.value.yaw_rad),
                ]
            )
            nees = float(error @ np.linalg.solve(np.reshape(pose.value.covariance, (3, 3)), error))
            t_s = (pose.t_data_ns - run.cart.t0_ns) * 1e-9
            rows.append([t_s, *error, nees, pose.value.sigma_m, pose.value.fix_age_s, truth.value.speed_mps])
    return np.array(rows)


def in_parallel(jobs: list[tuple[Any, ...]]) -> list[Errors]:
    """Drive several times, in a process for each core."""
    with ProcessPoolExecutor(os.cpu_count() or 1, mp_context=get_context("forkserver")) as pool:
        return list(pool.map(drive, *zip(*jobs, strict=True)))


SEEDS = range(20)


@pytest.fixture(scope="session")
def drives() -> np.ndarray[Any, Any]:
    """Drives of the seeds, as far as all of them go: (seed, pose, column)."""
    runs = in_parallel([(FIELD_TRIAL, seed) for seed in SEEDS])
    n = min(len(run) for run in runs)
    return np.stack([run[:n] for run in runs])


def chi_square(degrees: int, z: float) -> float:
    """Give the quantile that the normal quantile z stands for (Wilson and Hilferty, PNAS 17, 1931)."""
    part = 2.0 / (9.0 * degrees)
    return degrees * float((1.0 - part + z * math.sqrt(part)) ** 3)


def test_chi_square_quantiles_equal_those_of_the_tables() -> None:
    """Abramowitz and Stegun, Handbook of Mathematical Functions, 1964, table 26.8: 2.5 % and 97.5 %."""
    for degrees, low, high in ((30, 16.7908, 46.9792), (60, 40.4817, 83.2976), (100, 74.2219, 129.561)):
        assert chi_square(degrees, -1.959964) == pytest.approx(low, rel=1e-3)
        assert chi_square(degrees, 1.959964) == pytest.approx(high, rel=1e-3)


def inside(nees: np.ndarray[Any, Any], degrees: int) -> float:
    """Give the part of the steps in which the mean over runs lies in its 95 % band. nees: (run, step)."""
    runs = len(nees)
    low, high = (chi_square(degrees * runs, z) / runs for z in (-1.959964, 1.959964))
    mean = nees.mean(axis=0)
    return float(np.mean((mean >= low) & (mean <= high)))


def test_pose_errors_are_as_large_as_the_covariance_says(drives: np.ndarray[Any, Any]) -> None:
    """Average NEES of (x, y, yaw) inside its 95 % band in at least 90 % of the steps.

    Start mark and slow GPS error hardly change within a minute, so that the steps of a short drive are far from
    independent: on the square, 20 seeds may miss the 90 % by chance, on either side. Hence the longest drive.
    """
    part = inside(drives[:, :, 4], 3)
    assert part >= 0.90, f"{part:.1%}; mean NEES {drives[:, :, 4].mean():.2f}"
    assert 2.4 < drives[:, :, 4].mean() < 3.6


def test_twice_the_sigma_or_half_of_it_would_not_pass_for_consistent(drives: np.ndarray[Any, Any]) -> None:
    for factor in (0.5, 2.0):
        assert inside(drives[:, :, 4] / factor**2, 3) < 0.10


def test_errors_of_all_seeds_stay_within_two_metres(drives: np.ndarray[Any, Any]) -> None:
    error_m = np.hypot(drives[:, :, 1], drives[:, :, 2])
    assert error_m.max() < 2.0
    assert error_m.max() > 0.2, "an SBAS receiver is not better than that: the truth leaks"


def test_estimate_is_no_better_than_the_slow_error_of_the_receiver_allows(drives: np.ndarray[Any, Any]) -> None:
    """Averaging does not remove it: 0.7 m an axis, and 0.2 m that the start mark is known to. Less would be a leak."""
    best_m = 1.0 / math.sqrt(1.0 / 0.7**2 + 1.0 / 0.2**2)
    end = drives[:, -1]
    assert np.sqrt(np.mean(end[:, 1:3] ** 2)) > 0.8 * best_m


def test_three_seconds_without_gps_while_driving_cost_less_than_one_and_a_half_metres() -> None:
    at_s = 7.0  # on the first side
    for run in in_parallel([(SQUARE, seed, at_s, 12.0) for seed in range(4)]):
        t_s, error_m, age_s, speed_mps = run[:, 0], np.hypot(run[:, 1], run[:, 2]), run[:, 6], run[:, 7]
        out = (t_s >= at_s) & (t_s <= at_s + 3.2)
        assert 3.0 <= age_s[out].max() < 3.5, "there was no fix for three seconds, and then there was"
        assert age_s[t_s > at_s + 3.6].max() < 0.5
        assert speed_mps[out].min() > 1.0, "it drove"
        assert error_m[out].max() < 1.5
        assert error_m[out].max() - error_m[t_s < at_s][-1] < 0.5, "growth"
        assert run[out, 5].max() < 1.5, "the guard goes on"


# -- alone ------------------------------------------------------------------------------------------------------------


class Rig:
    """A localiser on a private store, with the motion and fixes that a test tells. Due every 40 ms as on the cart."""

    def __init__(self, *, start: Course | None = None, wheels: bool = True) -> None:
        self.store = Store.create(tick_ns=TICK_NS, t0_ns=T0_NS)
        mission = self.store.join("mission")
        mission.insert("site", Site).write(SITE, T0_NS)
        mission.insert("course", Course).write(start or Course(), T0_NS)
        self._gps = self.store.join("gps").insert("fix", GpsFix)
        self._travel = self.store.join("odometry").insert("travel", Odometry)
        inputs = {"site": "mission/site", "course": "mission/course", "gps": "gps/fix"}
        if wheels:
            inputs["odometry"] = "odometry/travel"
        self._host = Host(self.store, Wire("localise", "autonomy.localise:Localise", 4, 1, inputs), 0)
        self._host.connect()
        self._pose = self.store.find("localise/pose", Pose)

    def tick(self, odometry: Odometry | None = None, fix: tuple[GpsFix, int] | None = None) -> None:
        """Write what is true at the coming edge, tick, let the localiser work."""
        if odometry is not None:
            self._travel.write(odometry, self.store.now_ns + TICK_NS)
        if fix is not None:
            self._gps.write(*fix)
        self._host.step(self.store.tick())
        assert self._host.fault == ""

    @property
    def pose(self) -> Pose:
        sample = self._pose.visible(self.store.cycle)
        assert sample is not None
        return sample.value


def mark(x_m: float = 0.0, y_m: float = 0.0, yaw_rad: float = 0.0, *, sigma_m: float = 0.05) -> Course:
    lat_rad, lon_rad = PLANE.to_geo(x_m, y_m)
    return Course(
        start_lat_rad=lat_rad,
        start_lon_rad=lon_rad,
        start_sigma_m=sigma_m,
        start_yaw_rad=yaw_rad,
        start_yaw_sigma_rad=0.01,
    )


def fix_at(x_m: float, y_m: float, quality: FixQuality = FixQuality.RTK_FIXED) -> GpsFix:
    """Give a fix of an antenna that is at a point of M."""
    lat_rad, lon_rad = PLANE.to_geo(x_m, y_m)
    return GpsFix(mode=3, quality=quality, lat_rad=lat_rad, lon_rad=lon_rad)


SPEED_MPS, TURN_RADPS, STANDS_S = 3.0, 0.2, 0.1


def on_circle(t_s: float) -> tuple[float, float, float]:
    """Give (x, y, yaw) on a circle to the left that begins in the origin, eastward, after it stood for a while."""
    radius_m, yaw = SPEED_MPS / TURN_RADPS, TURN_RADPS * max(0.0, t_s - STANDS_S)
    return radius_m * math.sin(yaw), radius_m * (1.0 - math.cos(yaw)), yaw


def antenna(t_s: float) -> tuple[float, float]:
    x_m, y_m, yaw = on_circle(t_s)
    return x_m + ANTENNA_M * math.cos(yaw), y_m + ANTENNA_M * math.sin(yaw)


def wheels(t_s: float) -> Odometry:
    half, moved_s = TURN_RADPS * TRACK_M / 2, max(0.0, t_s - STANDS_S)
    return Odometry((SPEED_MPS - half) * moved_s, (SPEED_MPS + half) * moved_s, SPEED_MPS, True)


def circle_error_m(*, late_ticks: int, stamp_late: bool, quality_from: int = 0, seconds: float = 6.0) -> float:
    """Drive the circle with a fix every 200 ms that comes late; largest error of the second half.

    stamp_late: the fix says when it was measured, else when it came; quality_from: the tick at which fixes of 0.7 m
    become fixes of centimetres.
    """
    rig, worst = Rig(start=mark()), 0.0
    for tick in range(1, int(seconds * 100) + 1):
        t_s, fix = tick / 100, None
        if tick % 20 == 0 and tick > late_ticks:
            quality = FixQuality.RTK_FIXED if tick >= quality_from else FixQuality.DIFFERENTIAL
            measured_ns = T0_NS + (tick - (late_ticks if stamp_late else 0)) * TICK_NS
            fix = fix_at(*antenna((tick - late_ticks) / 100), quality), measured_ns
        rig.tick(wheels(t_s) if tick % 2 == 0 else None, fix)
        if tick % 4 == 2 and t_s > seconds / 2:  # the pose that shows now was made at the tick before, from its travel
            data = rig._pose.visible(rig.store.cycle)
            assert data is not None
            x_m, y_m, _ = on_circle((data.t_data_ns - T0_NS) * 1e-9)
            worst = max(worst, math.hypot(data.value.x_m - x_m, data.value.y_m - y_m))
    return worst


def test_fix_that_comes_late_is_applied_when_it_was_measured() -> None:
    assert circle_error_m(late_ticks=0, stamp_late=True) < 0.03
    assert circle_error_m(late_ticks=25, stamp_late=True) < 0.03


def test_the_same_fixes_applied_when_they_come_would_be_worse() -> None:
    """250 ms at 3 m/s are 0.75 m."""
    assert circle_error_m(late_ticks=25, stamp_late=False) > 0.3


def test_late_fix_of_a_better_kind_is_applied_when_it_was_measured_too() -> None:
    """The first fix of centimetres comes in the last second: no later one could mend what it spoils."""
    assert circle_error_m(late_ticks=25, stamp_late=True, quality_from=580) < 0.05


def stand(rig: Rig, seconds: float, at: tuple[float, float] | None, **how: Any) -> None:
    for tick in range(1, int(seconds * 100) + 1):
        new = at is not None and tick % 20 == 0
        still = Odometry(valid=True) if tick % 2 == 0 and how.get("wheels", True) else None
        rig.tick(
            still, (fix_at(*at, how.get("quality", FixQuality.RTK_FIXED)), rig.store.now_ns) if new and at else None
        )


def test_without_wheels_and_start_mark_it_follows_a_standing_receiver() -> None:
    rig = Rig(wheels=False)
    stand(rig, 2.0, (40.0, -25.0), wheels=False)
    assert math.hypot(rig.pose.x_m - 40.0, rig.pose.y_m + 25.0) < ANTENNA_M + 0.05
    assert ANTENNA_M < rig.pose.sigma_m < 2.0, "where C is around G is not known"
    assert rig.pose.fix_age_s < 0.3
    stand(rig, 5.0, None, wheels=False)
    assert rig.pose.sigma_m > 1.0, "it may have been carried off"
    stand(rig, 4.0, (43.0, -25.0), wheels=False)
    assert math.hypot(rig.pose.x_m - 43.0, rig.pose.y_m + 25.0) < ANTENNA_M + 0.2


def test_without_any_fix_it_stays_at_the_start_mark_and_says_how_old_the_last_fix_is() -> None:
    rig = Rig(start=mark(7.0, 8.0, 0.3, sigma_m=0.2))
    stand(rig, 1.0, None)
    assert (rig.pose.x_m, rig.pose.y_m, rig.pose.yaw_rad) == pytest.approx((7.0, 8.0, 0.3))
    assert rig.pose.sigma_m == pytest.approx(0.2, rel=0.01)
    assert rig.pose.fix_age_s > 100.0


def test_without_start_mark_and_fix_it_knows_nothing() -> None:
    rig = Rig()
    stand(rig, 1.0, None)
    assert rig.pose.sigma_m > 100.0


def test_fix_fifty_metres_off_is_refused() -> None:
    rig = Rig(start=mark())
    stand(rig, 3.0, (ANTENNA_M, 0.0))
    before = rig.pose
    for _ in range(REFUSE_AT_MOST):
        rig.tick(fix=(fix_at(30.0, 40.0), rig.store.now_ns))
        stand(rig, 0.19, None)
    assert math.hypot(rig.pose.x_m - before.x_m, rig.pose.y_m - before.y_m) < 0.01
    assert rig.pose.fix_age_s > 0.19 * REFUSE_AT_MOST, "a fix that was refused was not used"


def test_place_that_fix_after_fix_insists_on_is_believed_in_the_end() -> None:
    rig = Rig(start=mark())
    stand(rig, 3.0, (ANTENNA_M, 0.0))
    stand(rig, 0.2 * (REFUSE_AT_MOST + 5) + 3.0, (30.0, 40.0))
    assert math.hypot(rig.pose.x_m - 30.0, rig.pose.y_m - 40.0) < 1.0
    assert abs(rig.pose.yaw_rad) < 0.05, "the yaw was not wrong"
    assert rig.pose.fix_age_s < 0.3


def test_fix_without_a_position_is_not_used() -> None:
    rig = Rig(start=mark())
    stand(rig, 1.0, (ANTENNA_M, 0.0))
    before = rig.pose
    for _ in range(5):
        rig.tick(fix=(GpsFix(mode=1), rig.store.now_ns))
        stand(rig, 0.19, None)
    assert (rig.pose.x_m, rig.pose.y_m) == pytest.approx((before.x_m, before.y_m), abs=1e-6)
    assert rig.pose.fix_age_s > 0.9


def test_dead_reckoning_follows_the_circle() -> None:
    rig = Rig(start=mark())
    for tick in range(1, 501):
        rig.tick(wheels(tick / 100) if tick % 2 == 0 else None)
    sample = rig._pose.visible(rig.store.cycle)
    assert sample is not None
    x_m, y_m, yaw = on_circle((sample.t_data_ns - T0_NS) * 1e-9)
    assert (sample.value.x_m, sample.value.y_m) == pytest.approx((x_m, y_m), abs=0.02)
    assert sample.value.yaw_rad == pytest.approx(yaw, abs=0.002)
    assert yaw > 0.9
    assert sample.value.speed_mps == SPEED_MPS
    assert sample.value.yaw_rate_radps == pytest.approx(TURN_RADPS, rel=0.01)


def test_yaw_is_wrapped() -> None:
    rig = Rig(start=mark())
    for tick in range(1, int(100 * 4.0 / TURN_RADPS) + 1):  # 4 rad
        rig.tick(wheels(tick / 100) if tick % 2 == 0 else None)
    assert rig.pose.yaw_rad == pytest.approx(4.0 - 2 * math.pi, abs=0.05)
