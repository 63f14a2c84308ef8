"""synlaser: a synthetic planar range scanner on the cart's nose, over rays in the world.

As in P545, its reach is 4 m by default.
"""

import math
from dataclasses import dataclass

import numpy as np

from hal.signals import Scan

from .world import World

MOUNT_X_M, MOUNT_Z_M = 2.0, 0.45  # just ahead of the body
PERIOD_NS = 100_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class SynLaserParams:
    """The scanner. Noise as of small triangulating scanners (assumption)."""

    reach_m: float = 4.0
    fov_rad: float = math.radians(120.0)
    rays: int = 61
    sigma_m: float = 0.02


class SynLaser:
    """Scans ten times a second."""

    def __init__(self, world: World, params: SynLaserParams, rng: np.random.Generator) -> None:
        self._world, self.params, self._rng = world, params, rng
        step = params.fov_rad / (params.rays - 1)
        self._angles = [-params.fov_rad / 2 + k * step for k in range(params.rays)]
        self._step_rad = step

    def due(self, t_ns: int) -> bool:
        """Say whether a sweep is measured at this time."""
        return t_ns % PERIOD_NS == 0

    def scan(self, x_m: float, y_m: float, z_m: float, yaw_rad: float) -> Scan:
        """Scan from where C stands."""
        p = self.params
        ox, oy, oz = x_m + MOUNT_X_M * math.cos(yaw_rad), y_m + MOUNT_X_M * math.sin(yaw_rad), z_m + MOUNT_Z_M
        ends = [
            (ox + p.reach_m * math.cos(yaw_rad + a), oy + p.reach_m * math.sin(yaw_rad + a), oz) for a in self._angles
        ]
        hits = self._world.rays([(ox, oy, oz)] * len(ends), ends)
        noise = self._rng.normal(0.0, p.sigma_m, len(hits)).tolist()
        ranges = tuple(
            p.reach_m if hit >= 1.0 else min(max(hit * p.reach_m + n, 0.0), p.reach_m)
            for hit, n in zip(hits, noise, strict=True)
        )
        return Scan(self._angles[0], self._step_rad, p.reach_m, MOUNT_X_M, ranges)
