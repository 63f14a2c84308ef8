"""Wheel ticks from the node's counters to metres: nothing is lost at a wrap or with a frame."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.bus import CanBus
from hal.codecs.cartcan import WheelTicks
from hal.devices.odometry import TickNode
from hal.drivers.odometry import OdometryDriver
from hal.signals import Odometry

TICK_M = 1.40 / 128
FRAME_NS = 20_000_000


def hear(driver: OdometryDriver, *counts: tuple[int, int]) -> list[Odometry]:
    return [
        driver.hear(WheelTicks.of(left=left, right=right, dt_s=0.02), k & 15, k * FRAME_NS)
        for k, (left, right) in enumerate(counts)
    ]


def rolled(speeds_mps: list[float], lost: frozenset[int] = frozenset(), at_m: float = 0.0) -> tuple[Odometry, float]:
    """Roll a cart, one speed per frame, with some frames lost; what the driver says at the end, and the true travel."""
    bus = CanBus("wire")
    node, ear, driver = TickNode(bus, 1 / TICK_M, 1 / TICK_M), bus.port("EAR", [WheelTicks]), OdometryDriver(TICK_M)
    said = Odometry()
    metres = at_m
    for k, speed_mps in enumerate([0.0, *speeds_mps]):
        metres += speed_mps * 0.02
        node.poll(k * FRAME_NS, metres, metres)
        for received in ear.receive():
            assert isinstance(received.message, WheelTicks)
            if k not in lost:
                said = driver.hear(received.message, received.counter, received.t_ns)
    return said, metres - at_m


@pytest.mark.parametrize(
    ("counts", "ticks"),
    [
        ([65_530, 65_535, 0, 4], 10),
        ([5, 0, 65_535, 65_530], -11),
        ([65_535, 0, 65_535, 0], 1),
        ([40_000, 7_000], 32_536),
    ],
)
def test_the_counter_may_wrap_in_both_directions(counts: list[int], ticks: int) -> None:
    said = hear(OdometryDriver(TICK_M), *((c, 100) for c in counts))[-1]
    assert said.left_m == pytest.approx(ticks * TICK_M)
    assert said.right_m == 0.0


def test_the_two_wheels_are_counted_apart() -> None:
    said = hear(OdometryDriver(TICK_M), (0, 0), (10, 65_530))[-1]
    assert (said.left_m, said.right_m) == pytest.approx((10 * TICK_M, -6 * TICK_M))


def test_travel_starts_at_zero_wherever_the_counters_stand() -> None:
    said = hear(OdometryDriver(TICK_M), (54_321, 12_345))[0]
    assert said == Odometry(0.0, 0.0, 0.0, True, 0)


@given(
    st.lists(st.floats(-3.0, 6.0), min_size=1, max_size=40),
    st.sets(st.integers(1, 38), max_size=10),
    st.floats(-800.0, 800.0),
)
def test_lost_frames_cost_no_travel(speeds_mps: list[float], lost: set[int], at_m: float) -> None:
    lost -= {len(speeds_mps)}  # the last one comes
    lost = {k for k in lost if k < len(speeds_mps)}
    said, true_m = rolled(speeds_mps, frozenset(lost), at_m)
    assert said.left_m == pytest.approx(true_m, abs=2 * TICK_M)
    assert said.left_m == said.right_m
    assert said.frames_lost == len(lost)


def test_a_kilometre_across_several_wraps_is_a_kilometre() -> None:
    said, true_m = rolled([5.0] * 10_000)
    assert true_m == pytest.approx(1_000.0)
    assert said.left_m == pytest.approx(1_000.0, abs=2 * TICK_M)


@pytest.mark.parametrize("speed_mps", [0.0, 0.5, 3.0, 5.5, -1.5])
def test_speed_is_the_mean_of_100_ms_within_one_tick(speed_mps: float) -> None:
    said, _ = rolled([speed_mps] * 50)
    assert said.speed_mps == pytest.approx(speed_mps, abs=1.01 * TICK_M / 0.1)
    assert (said.left_m < 0) == (speed_mps < 0)


def test_speed_forgets_what_was_100_ms_ago() -> None:
    assert rolled([3.0] * 50 + [0.0] * 5)[0].speed_mps == 0.0
    assert rolled([3.0] * 50 + [0.0] * 4)[0].speed_mps > 0.0


def test_speed_stays_right_when_every_other_frame_is_lost() -> None:
    said, _ = rolled([2.0] * 50, frozenset(range(1, 50, 2)))
    assert said.speed_mps == pytest.approx(2.0, abs=TICK_M / 0.1)


def test_speed_of_a_turning_cart_is_that_of_its_middle() -> None:
    said = hear(OdometryDriver(TICK_M), *((2 * k, 4 * k) for k in range(10)))[-1]
    assert said.speed_mps == pytest.approx(3 * TICK_M / 0.02)


@pytest.mark.parametrize("dead", ["valid_left", "valid_right"])
def test_a_wheel_that_does_not_report_makes_the_odometry_invalid(dead: str) -> None:
    driver = OdometryDriver(TICK_M)
    assert driver.hear(WheelTicks.of(left=0, right=0, dt_s=0.02), 0, 0).valid
    message = WheelTicks.of(
        left=0, right=0, dt_s=0.02, valid_left=dead != "valid_left", valid_right=dead != "valid_right"
    )
    assert not driver.hear(message, 1, FRAME_NS).valid


def test_the_node_reports_every_20_ms_and_says_when_it_rolls_back() -> None:
    bus = CanBus("wire")
    node, ear = TickNode(bus, 100.0, 100.0), bus.port("EAR", [WheelTicks])
    for t_ms in range(0, 100, 10):
        metres = 0.1 * min(t_ms, 100 - t_ms) / 10
        node.poll(t_ms * 1_000_000, metres, metres)
    heard = ear.receive()
    assert [r.t_ns // 1_000_000 for r in heard] == [0, 20, 40, 60, 80]
    assert [r.message.reverse for r in heard if isinstance(r.message, WheelTicks)] == [0, 0, 0, 0, 1]


def test_the_node_counts_whole_edges_also_backward() -> None:
    node = TickNode(CanBus("wire"), 100.0, 100.0)
    node.poll(0, 0.019, -0.001)
    assert (node.left, node.right) == (math.floor(1.9), -1)
