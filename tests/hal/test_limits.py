"""The limits as a pure function: whatever comes in, what goes out stays inside the envelope."""

import math
from dataclasses import replace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from hal.limits import Envelope, limit
from hal.signals import STOP, DriveCommand, Limit

ENVELOPE = Envelope()
MS = 1_000_000
FRESH = 60 * MS

any_float = st.one_of(st.floats(), st.floats(-8.0, 8.0), st.floats(-0.5, 0.5))
commands = st.builds(DriveCommand, speed_mps=any_float, steer_rad=any_float, decel_mps2=any_float)
sane = st.builds(
    DriveCommand, speed_mps=st.floats(-1.5, 5.5), steer_rad=st.floats(-0.47, 0.47), decel_mps2=st.floats(0.1, 1.5)
)
ages = st.one_of(st.integers(0, 500 * MS), st.integers(0, 2**62), st.sampled_from([250 * MS, 250 * MS + 1]))
envelopes = st.builds(
    Envelope,
    max_speed_mps=st.floats(0.5, 8.0),
    max_reverse_mps=st.floats(0.0, 3.0),
    max_steer_rad=st.floats(0.05, 0.7),
    max_lateral_mps2=st.floats(0.2, 4.0),
    max_decel_mps2=st.floats(0.1, 3.0),
    wheelbase_m=st.floats(1.0, 3.0),
)


def lateral_mps2(command: DriveCommand, envelope: Envelope = ENVELOPE) -> float:
    """Second derivation: speed squared over the radius of a kinematic bicycle."""
    return abs(command.speed_mps**2 * math.tan(command.steer_rad) / envelope.wheelbase_m)


@given(st.one_of(st.none(), commands), ages, envelopes)
@example(DriveCommand(speed_mps=1.7e308, steer_rad=0.1, decel_mps2=1.7e308), FRESH, ENVELOPE)
@example(DriveCommand(speed_mps=math.inf, steer_rad=-math.inf), FRESH, ENVELOPE)
def test_nothing_leaves_the_envelope_whatever_comes(
    command: DriveCommand | None, age_ns: int, envelope: Envelope
) -> None:
    out, _ = limit(command, age_ns, envelope)
    assert math.isfinite(out.speed_mps)
    assert math.isfinite(out.steer_rad)
    assert math.isfinite(out.decel_mps2)
    assert -envelope.max_reverse_mps <= out.speed_mps <= envelope.max_speed_mps
    assert abs(out.steer_rad) <= envelope.max_steer_rad
    assert 0.0 < out.decel_mps2 <= envelope.max_decel_mps2
    assert lateral_mps2(out, envelope) <= envelope.max_lateral_mps2 * (1 + 1e-9)


@given(st.one_of(st.none(), commands), ages, envelopes)
def test_the_limits_leave_their_own_output_as_it_is(
    command: DriveCommand | None, age_ns: int, envelope: Envelope
) -> None:
    out, _ = limit(command, age_ns, envelope)
    assert limit(out, FRESH, envelope) == (out, Limit.NONE)


@given(commands, st.integers(250 * MS + 1, 2**62))
def test_an_old_command_never_moves_the_cart(command: DriveCommand, age_ns: int) -> None:
    out, why = limit(command, age_ns, ENVELOPE)
    assert out.speed_mps == 0.0
    assert why is not Limit.NONE


@given(sane, st.integers(0, 250 * MS))
def test_a_command_inside_the_envelope_passes_unchanged(command: DriveCommand, age_ns: int) -> None:
    out, why = limit(command, age_ns, ENVELOPE)
    if lateral_mps2(command) <= ENVELOPE.max_lateral_mps2 * (1 - 1e-9):
        assert (out, why) == (command, Limit.NONE)


@given(sane)
def test_a_bend_taken_too_fast_is_slowed_to_the_limit_in_the_same_direction(command: DriveCommand) -> None:
    out, why = limit(command, FRESH, ENVELOPE)
    if lateral_mps2(command) > ENVELOPE.max_lateral_mps2 * (1 + 1e-9):
        assert why is Limit.LATERAL
        assert lateral_mps2(out) == pytest.approx(ENVELOPE.max_lateral_mps2)
        assert out == replace_speed(command, math.copysign(out.speed_mps, command.speed_mps))


def replace_speed(command: DriveCommand, speed_mps: float) -> DriveCommand:
    return DriveCommand(speed_mps, command.steer_rad, command.decel_mps2)


def test_exactly_250_ms_is_young_enough_and_a_nanosecond_more_is_not() -> None:
    command = DriveCommand(speed_mps=2.0, steer_rad=0.1)
    assert limit(command, 250 * MS, ENVELOPE) == (command, Limit.NONE)
    assert limit(command, 250 * MS + 1, ENVELOPE) == (DriveCommand(speed_mps=0.0, steer_rad=0.1), Limit.STALE)


@pytest.mark.parametrize(
    ("command", "age_ns", "why"),
    [
        (None, 0, Limit.NO_COMMAND),
        (DriveCommand(speed_mps=math.nan), FRESH, Limit.NOT_FINITE),
        (DriveCommand(steer_rad=math.nan), FRESH, Limit.NOT_FINITE),
        (DriveCommand(decel_mps2=math.inf), FRESH, Limit.NOT_FINITE),
        (DriveCommand(speed_mps=-math.inf), FRESH, Limit.NOT_FINITE),
        (DriveCommand(speed_mps=1.0), 251 * MS, Limit.STALE),
        (DriveCommand(speed_mps=5.51), FRESH, Limit.SPEED),
        (DriveCommand(speed_mps=-1.51), FRESH, Limit.SPEED),
        (DriveCommand(speed_mps=1.0, steer_rad=0.471), FRESH, Limit.STEER),
        (DriveCommand(speed_mps=1.0, steer_rad=-0.471), FRESH, Limit.STEER),
        (DriveCommand(speed_mps=4.0, steer_rad=0.4), FRESH, Limit.LATERAL),
        (DriveCommand(speed_mps=5.5), FRESH, Limit.NONE),
        (DriveCommand(speed_mps=-1.5), FRESH, Limit.NONE),
        (DriveCommand(speed_mps=1.0, steer_rad=0.47), FRESH, Limit.NONE),
        (STOP, FRESH, Limit.NONE),
    ],
)
def test_the_reason_says_what_was_wrong(command: DriveCommand | None, age_ns: int, why: Limit) -> None:
    out, said = limit(command, age_ns, ENVELOPE)
    assert said is why
    assert (out == command) == (why is Limit.NONE)
    if why not in (Limit.NONE, Limit.LATERAL):
        assert out.speed_mps == 0.0


@pytest.mark.parametrize("speed_mps", [2.5, -2.5])
def test_a_bend_is_as_narrow_backward_as_forward(speed_mps: float) -> None:
    """1 m/s2 on a radius of 1.66 m / tan 0.45."""
    envelope = replace(ENVELOPE, max_reverse_mps=3.0, max_lateral_mps2=1.0)
    out, why = limit(DriveCommand(speed_mps=speed_mps, steer_rad=-0.45), FRESH, envelope)
    assert why is Limit.LATERAL
    assert out.speed_mps == pytest.approx(math.copysign(math.sqrt(1.66 / math.tan(0.45)), speed_mps))


@pytest.mark.parametrize("age_ns", [FRESH, 300 * MS])
def test_a_stop_for_age_or_speed_keeps_the_wheels_where_they_are(age_ns: int) -> None:
    fast = DriveCommand(speed_mps=5.6, steer_rad=-0.3)
    assert limit(fast, age_ns, ENVELOPE)[0] == DriveCommand(speed_mps=0.0, steer_rad=-0.3)


@pytest.mark.parametrize(("asked", "passed"), [(9.0, 1.5), (1.5, 1.5), (0.7, 0.7), (0.0, 0.1), (-3.0, 0.1)])
def test_braking_harder_than_the_rear_axle_holds_is_not_passed_on(asked: float, passed: float) -> None:
    out, why = limit(DriveCommand(speed_mps=1.0, decel_mps2=asked), FRESH, ENVELOPE)
    assert out.decel_mps2 == passed
    assert why is Limit.NONE


def test_a_narrower_envelope_narrows_what_passes() -> None:
    slow = replace(ENVELOPE, max_speed_mps=1.0)
    assert limit(DriveCommand(speed_mps=1.2), FRESH, slow)[1] is Limit.SPEED
