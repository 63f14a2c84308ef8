"""Terrain: heights on a grid of our own, read bilinearly. The cart asks it for slopes; nothing collides with it."""

import math

from .plant import Ground
from .site import Hill

CELL_M = 2.0
MARGIN_M = 3.0  # hill radii after which a hill is level ground


class Terrain:
    """Heights over M. Without hills it is flat everywhere."""

    def __init__(self, hills: tuple[Hill, ...], friction_factor: float) -> None:
        self.flat = None if hills else Ground(0.0, 0.0, friction_factor)
        """The ground everywhere, None where there are hills."""
        self._friction_factor = friction_factor
        self._heights: list[list[float]] = []
        if not hills:
            return
        self._west = min(h.east_m - MARGIN_M * h.radius_m for h in hills)
        self._south = min(h.north_m - MARGIN_M * h.radius_m for h in hills)
        self._columns = columns = int((max(h.east_m + MARGIN_M * h.radius_m for h in hills) - self._west) / CELL_M) + 2
        self._rows = rows = int((max(h.north_m + MARGIN_M * h.radius_m for h in hills) - self._south) / CELL_M) + 2
        self._heights = [
            [sum(_hill(h, self._west + i * CELL_M, self._south + j * CELL_M) for h in hills) for i in range(columns)]
            for j in range(rows)
        ]

    def height_m(self, x_m: float, y_m: float) -> float:
        """Give the height of the ground at a point."""
        if self.flat is not None:
            return 0.0
        a, b, c, d, u, v = self._cell(x_m, y_m)
        return (a * (1 - u) + b * u) * (1 - v) + (c * (1 - u) + d * u) * v

    def ground(self, x_m: float, y_m: float) -> Ground:
        """Give slope and friction at a point."""
        if self.flat is not None:
            return self.flat
        a, b, c, d, u, v = self._cell(x_m, y_m)
        return Ground(
            ((b - a) * (1 - v) + (d - c) * v) / CELL_M,
            ((c - a) * (1 - u) + (d - b) * u) / CELL_M,
            self._friction_factor,
        )

    def _cell(self, x_m: float, y_m: float) -> tuple[float, float, float, float, float, float]:
        """Give the heights of the cell's corners and the place in it, [0, 1]; outside, those of the nearest edge."""
        u, v = (x_m - self._west) / CELL_M, (y_m - self._south) / CELL_M
        if 0.0 <= u < self._columns - 1 and 0.0 <= v < self._rows - 1:
            i, j = int(u), int(v)
        else:
            i, j = min(max(math.floor(u), 0), self._columns - 2), min(max(math.floor(v), 0), self._rows - 2)
            u, v = min(max(u, i), i + 1.0), min(max(v, j), j + 1.0)
        low, high = self._heights[j], self._heights[j + 1]
        return low[i], low[i + 1], high[i], high[i + 1], u - i, v - j


def _hill(hill: Hill, x_m: float, y_m: float) -> float:
    d2 = (x_m - hill.east_m) ** 2 + (y_m - hill.north_m) ** 2
    return hill.height_m * math.exp(-d2 / hill.radius_m**2)
