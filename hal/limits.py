"""Limits: the last look at a command before it leaves the host. One pure function, inside the actuator driver.

It trusts nobody: not the planner, not the guard. A command that is old, not finite or outside the envelope stops the
cart; one that would corner too hard is slowed down.
"""

import math
from dataclasses import dataclass

from .signals import DriveCommand, Limit

WITHIN = Limit.NONE  # looked up once, being what most commands are


@dataclass(frozen=True, slots=True, kw_only=True)
class Envelope:
    """What the cart may be asked for. Source: docs/cart.md."""

    max_speed_mps: float = 5.5
    max_reverse_mps: float = 1.5
    max_steer_rad: float = 0.47
    max_lateral_mps2: float = 2.0
    max_decel_mps2: float = 1.5  # a harder stop may lock the rear axle on a wet road
    max_origin_age_ns: int = 250_000_000
    wheelbase_m: float = 1.66


def limit(command: DriveCommand | None, origin_age_ns: int, envelope: Envelope) -> tuple[DriveCommand, Limit]:
    """Pass a command, change it, or replace it by a stop; says which and why.

    origin_age_ns: time since the oldest sensor data behind the command was true.
    """
    if command is None:
        return _stop(0.0, envelope), Limit.NO_COMMAND
    speed_mps, steer_rad = command.speed_mps, command.steer_rad
    if not math.isfinite(speed_mps + steer_rad + command.decel_mps2):
        return _stop(0.0, envelope), Limit.NOT_FINITE
    if abs(steer_rad) > envelope.max_steer_rad:
        return _stop(0.0, envelope), Limit.STEER
    if origin_age_ns > envelope.max_origin_age_ns:
        return _stop(steer_rad, envelope), Limit.STALE
    if not -envelope.max_reverse_mps <= speed_mps <= envelope.max_speed_mps:
        return _stop(steer_rad, envelope), Limit.SPEED
    curvature = abs(math.tan(steer_rad)) / envelope.wheelbase_m
    cornering_mps = math.sqrt(envelope.max_lateral_mps2 / curvature) if curvature > 1e-9 else math.inf
    decel_mps2 = min(max(command.decel_mps2, 0.1), envelope.max_decel_mps2)
    if abs(speed_mps) > cornering_mps:
        slower = math.copysign(cornering_mps, speed_mps)
        return DriveCommand(speed_mps=slower, steer_rad=steer_rad, decel_mps2=decel_mps2), Limit.LATERAL
    return DriveCommand(speed_mps, steer_rad, decel_mps2), WITHIN


def _stop(steer_rad: float, envelope: Envelope) -> DriveCommand:
    return DriveCommand(speed_mps=0.0, steer_rad=steer_rad, decel_mps2=envelope.max_decel_mps2)
