"""Randomisation: what differs from one seed to the next beside sensors' noise, by name: none, mild, wide.

Every draw comes from the seed alone and stands in the recording (`world/randomised`). The ranges of `wide` are those
that `sim/plant.py` gives beside its assumptions. Layouts (obstacle fields, hidden courses, where the cart stands at the
start) are drawn from the seed by the scenario itself, under every name.
"""

from dataclasses import dataclass, fields
from typing import Annotated, Literal, get_args

import numpy as np

from rtdb.records import Record, f8

Kind = Literal["none", "mild", "wide"]
KINDS: tuple[str, ...] = get_args(Kind)


class Randomised(Record, frozen=True):
    """What was drawn for a drive."""

    friction_factor: Annotated[float, f8("1", "the ground's friction over that of the site")] = 1.0
    load_kg: Annotated[float, f8("kg", "people and bags")] = 0.0
    steer_lag_factor: Annotated[float, f8("1", "lag of the steering over the usual one")] = 1.0
    steer_dead_time_s: Annotated[float, f8("s", "dead time of the steering")] = 0.05
    drive_lag_factor: Annotated[float, f8("1", "lag of the drive over the usual one")] = 1.0
    brake_factor: Annotated[float, f8("1", "brake force over the usual one")] = 1.0
    gps_factor: Annotated[float, f8("1", "errors of the GPS receiver over those of its grade")] = 1.0
    compass_factor: Annotated[float, f8("1", "errors of the compass over the usual ones")] = 1.0
    outage_at_s: Annotated[float, f8("s", "when the GPS has no fix, from the start of the drive")] = 0.0
    outage_for_s: Annotated[float, f8("s", "and for how long; 0 for no such fault")] = 0.0


@dataclass(frozen=True, slots=True)
class _Ranges:
    """Lowest and highest of each number, evenly drawn."""

    friction_factor: tuple[float, float]
    load_kg: tuple[float, float]
    steer_lag_factor: tuple[float, float]
    steer_dead_time_s: tuple[float, float]
    drive_lag_factor: tuple[float, float]
    brake_factor: tuple[float, float]
    gps_factor: tuple[float, float]
    compass_factor: tuple[float, float]
    outage_at_s: tuple[float, float]
    outage_for_s: tuple[float, float]


RANGES = {
    "mild": _Ranges(
        (0.85, 1.1), (0.0, 120.0), (0.9, 1.3), (0.05, 0.08), (0.9, 1.3), (0.9, 1.1), (0.7, 1.3), (0.7, 1.3),
        (5.0, 60.0), (0.0, 1.5),
    ),
    "wide": _Ranges(
        (0.5, 1.2), (0.0, 240.0), (0.8, 2.5), (0.05, 0.15), (0.8, 2.0), (0.7, 1.2), (0.4, 2.0), (0.4, 2.0),
        (5.0, 60.0), (0.0, 5.0),
    ),
}  # fmt: skip


def draw(kind: str, rng: np.random.Generator) -> Randomised:
    """Draw for a drive; each number takes one draw, whatever the others are."""
    if kind == "none":
        return Randomised()
    ranges = RANGES[kind]
    return Randomised(*(float(rng.uniform(*getattr(ranges, field.name))) for field in fields(ranges)))
