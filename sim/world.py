"""The world in pybullet: what the cart can touch and what rays can hit. One client, owned by one World.

The cart's body is driven by its pose; contacts never push it. Static obstacles form compound bodies of up to 16 boxes,
which cost next to nothing (measured in docs/performance.md).
"""

import importlib
import math
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType, TracebackType
from typing import Any, Self

from hal.signals import Clearance, ObstacleKind, Scene

BODY_LENGTH_M, BODY_WIDTH_M, BODY_HEIGHT_M = 2.40, 1.20, 1.75
BODY_REAR_M = 0.45  # the body begins this far behind C
BODY_FLOOR_M = 0.06  # low enough to meet a kerb
NEAR_M = 5.0
PERSON_RADIUS_M, PERSON_HEIGHT_M = 0.30, 1.75
COMPOUND = 16  # pybullet leaves out what is beyond, without a word


class World:
    """Collision and rays. Use it in a `with`, or close it."""

    def __init__(self, scene: Scene) -> None:
        self._bullet = load_bullet()
        self._client: int = self._bullet.connect(self._bullet.DIRECT)
        self._scene = scene
        self._statics = [
            self._compound(range(k, min(k + COMPOUND, len(scene.kind)))) for k in range(0, len(scene.kind), COMPOUND)
        ]
        half = [BODY_LENGTH_M / 2, BODY_WIDTH_M / 2, BODY_HEIGHT_M / 2]
        self._cart = self._body(self._shape(half), mass_kg=1.0)  # two bodies without mass never touch
        self._actors: list[tuple[int, ObstacleKind]] = []
        self._collided = False

    def _shape(self, half: list[float]) -> int:
        return int(
            self._bullet.createCollisionShape(self._bullet.GEOM_BOX, halfExtents=half, physicsClientId=self._client)
        )

    def _body(self, shape: int, mass_kg: float = 0.0) -> int:
        return int(self._bullet.createMultiBody(mass_kg, shape, physicsClientId=self._client))

    def _compound(self, indices: range) -> int:
        s, b = self._scene, self._bullet
        shape = b.createCollisionShapeArray(
            shapeTypes=[b.GEOM_BOX] * len(indices),
            halfExtents=[[s.length_m[k] / 2, s.width_m[k] / 2, s.height_m[k] / 2] for k in indices],
            collisionFramePositions=[[s.x_m[k], s.y_m[k], s.z_m[k]] for k in indices],
            collisionFrameOrientations=[b.getQuaternionFromEuler([0, 0, s.yaw_rad[k]]) for k in indices],
            physicsClientId=self._client,
        )
        return self._body(int(shape))

    def furnish(self, scene: Scene) -> None:
        """Put up another scene; actors go. The cart has touched nothing yet."""
        b = self._bullet
        if scene != self._scene:
            for body in self._statics:
                b.removeBody(body, physicsClientId=self._client)
            self._scene = scene
            n = len(scene.kind)
            self._statics = [self._compound(range(k, min(k + COMPOUND, n))) for k in range(0, n, COMPOUND)]
        for body, _ in self._actors:
            b.removeBody(body, physicsClientId=self._client)
        self._actors.clear()
        self._collided = False

    def add_actor(self, kind: ObstacleKind) -> int:
        """Add a person; `move_actor` says where it is."""
        b = self._bullet
        shape = b.createCollisionShape(
            b.GEOM_CYLINDER, radius=PERSON_RADIUS_M, height=PERSON_HEIGHT_M, physicsClientId=self._client
        )
        self._actors.append((self._body(int(shape)), kind))
        return len(self._actors) - 1

    def move_actor(self, index: int, x_m: float, y_m: float, z_m: float) -> None:
        """Put an actor's feet at a point of M."""
        self._place(self._actors[index][0], (x_m, y_m, z_m + PERSON_HEIGHT_M / 2), 0.0)

    def move_cart(self, x_m: float, y_m: float, z_m: float, yaw_rad: float) -> None:
        """Put C at a point of M."""
        ahead_m = BODY_LENGTH_M / 2 - BODY_REAR_M
        centre = (
            x_m + ahead_m * math.cos(yaw_rad),
            y_m + ahead_m * math.sin(yaw_rad),
            z_m + BODY_FLOOR_M + BODY_HEIGHT_M / 2,
        )
        self._place(self._cart, centre, yaw_rad)

    def _place(self, body: int, centre: tuple[float, float, float], yaw_rad: float) -> None:
        quaternion = (0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))
        self._bullet.resetBasePositionAndOrientation(body, centre, quaternion, physicsClientId=self._client)

    def touches(self) -> bool:
        """Say whether the cart touches anything now; cheap, for every tick."""
        self._bullet.performCollisionDetection(physicsClientId=self._client)
        hits = self._bullet.getContactPoints(bodyA=self._cart, physicsClientId=self._client)
        self._collided = self._collided or any(hit[8] < 0.0 for hit in hits)
        return self._collided

    def clearance(self) -> Clearance:
        """Say how close the cart is to the nearest thing."""
        nearest_m, kind = NEAR_M, ObstacleKind.BOX
        for body, what in [*((body, None) for body in self._statics), *self._actors]:
            points: Any = self._bullet.getClosestPoints(self._cart, body, nearest_m, physicsClientId=self._client)
            for point in points:
                if point[8] < nearest_m:
                    nearest_m = point[8]
                    kind = what if what is not None else self._kind_at(point[6])
        self._collided = self._collided or nearest_m < 0.0
        return Clearance(nearest_m, self._collided, kind)

    def _kind_at(self, at_m: tuple[float, float, float]) -> ObstacleKind:
        """Tell which box of the scene a point on a compound belongs to: the one whose surface is nearest."""
        s = self._scene

        def outside_m(k: int) -> float:
            c, n = math.cos(s.yaw_rad[k]), math.sin(s.yaw_rad[k])
            dx, dy = at_m[0] - s.x_m[k], at_m[1] - s.y_m[k]
            along, across = abs(dx * c + dy * n) - s.length_m[k] / 2, abs(dy * c - dx * n) - s.width_m[k] / 2
            return max(along, across, abs(at_m[2] - s.z_m[k]) - s.height_m[k] / 2)

        return ObstacleKind(s.kind[min(range(len(s.kind)), key=outside_m)])

    def rays(self, starts: list[tuple[float, float, float]], ends: list[tuple[float, float, float]]) -> list[float]:
        """Cast rays; gives for each the fraction of its length at which it hits, 1 for none. Not the cart."""
        hits = self._bullet.rayTestBatch(starts, ends, physicsClientId=self._client)
        return [1.0 if hit[0] in (-1, self._cart) else float(hit[2]) for hit in hits]

    def close(self) -> None:
        """Give the client back."""
        if self._client >= 0:
            self._bullet.disconnect(physicsClientId=self._client)
            self._client = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def load_bullet() -> ModuleType:
    """Import pybullet without the line that it prints from C while it is imported."""
    if "pybullet" not in sys.modules:
        with _silent():
            importlib.import_module("pybullet")
    return sys.modules["pybullet"]


@contextmanager
def _silent() -> Iterator[None]:
    kept, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(null)
