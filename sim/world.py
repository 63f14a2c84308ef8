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
from dataclasses import dataclass
from types import ModuleType, TracebackType
from typing import Any, Self

from hal.signals import Clearance, ObstacleKind, Scene

BODY_LENGTH_M, BODY_WIDTH_M, BODY_HEIGHT_M = 2.40, 1.20, 1.75
BODY_REAR_M = 0.45  # the body begins this far behind C
BODY_FLOOR_M = 0.06  # low enough to meet a kerb
NEAR_M = 5.0
LOOK_M = 2.0  # what is near enough to be asked about is looked up again when the cart has moved this far
CART_REACH_M = math.hypot(BODY_LENGTH_M, BODY_WIDTH_M) / 2  # from the middle of the body to its corners
PERSON_RADIUS_M, PERSON_HEIGHT_M = 0.30, 1.75
PARKED = (0.0, 0.0, -1000.0)  # out of the way of everything
SCENES = 64  # kept, so that they can be put up again
COMPOUND = 16  # pybullet leaves out what is beyond, without a word


@dataclass(frozen=True, slots=True)
class Box:
    """One box of the scene, as seen from above, and the compound body that it is part of."""

    index: int
    body: int
    x_m: float
    y_m: float
    reach_m: float  # from the middle to the corners


class World:
    """Collision and rays. Use it in a `with`, or close it."""

    def __init__(self, scene: Scene) -> None:
        self._bullet = load_bullet()
        self._client: int = self._bullet.connect(self._bullet.DIRECT)
        self._boxes: list[Box] = []
        self._built: dict[Scene, list[Box]] = {}  # scenes that were put up, also those that are out of the way
        self._shapes: dict[int, int] = {}  # of the bodies of scenes
        self._parked: list[int] = []  # bodies of actors that nobody needs now
        self._put_up(scene)
        self._near: list[int] = []  # boxes that the cart can be near to, and their bodies,
        self._near_bodies: list[int] = []
        self._near_kind: ObstacleKind | None = None  # what they are, if all are the same
        self._looked_x_m = self._looked_y_m = math.inf  # when it stood here, or has not moved far from it
        self._x_m = self._y_m = self._z_m = self._yaw_rad = 0.0  # middle of the cart's body
        self._moved = False  # pybullet does not know yet
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
        body = self._body(int(shape))
        self._shapes[body] = int(shape)
        return body

    def furnish(self, scene: Scene) -> None:
        """Put up a scene in place of the one before; actors go. The cart has touched nothing yet.

        Nothing is built twice: what goes is moved out of the way, and comes back from there.
        """
        if scene is not self._scene and scene != self._scene:
            for body in self._bodies():
                self._place(body, PARKED, 0.0)
            self._put_up(scene)
        self._parked += [body for body, _ in self._actors]
        for body, _ in self._actors:
            self._place(body, PARKED, 0.0)
        self._actors.clear()
        self._collided = False
        self._looked_x_m = self._looked_y_m = math.inf

    @property
    def bodies(self) -> int:
        """How many bodies pybullet holds, those that are out of the way too."""
        return int(self._bullet.getNumBodies(physicsClientId=self._client))

    def _bodies(self) -> set[int]:
        return {box.body for box in self._boxes}

    def _put_up(self, scene: Scene) -> None:
        self._scene = scene
        known = self._built.pop(scene, None)
        if known is not None:
            self._boxes = known
            for body in self._bodies():
                self._place(body, (0.0, 0.0, 0.0), 0.0)
        else:
            self._boxes = []
            for first in range(0, len(scene.kind), COMPOUND):
                indices = range(first, min(first + COMPOUND, len(scene.kind)))
                body = self._compound(indices)
                self._boxes += [self._box(k, body) for k in indices]
        self._built[scene] = self._boxes  # the latest stands last
        if len(self._built) > SCENES:
            oldest = next(iter(self._built))
            for body in {box.body for box in self._built.pop(oldest)}:
                self._remove(body)

    def _remove(self, body: int) -> None:
        """Take a body away, and its shape, which pybullet would keep."""
        self._bullet.removeBody(body, physicsClientId=self._client)
        self._bullet.removeCollisionShape(self._shapes.pop(body), physicsClientId=self._client)

    def _box(self, k: int, body: int) -> Box:
        s = self._scene
        return Box(k, body, s.x_m[k], s.y_m[k], math.hypot(s.length_m[k], s.width_m[k]) / 2)

    def add_actor(self, kind: ObstacleKind) -> int:
        """Add a person; `move_actor` says where it is."""
        self._actors.append((self._parked.pop() if self._parked else self._person(), kind))
        return len(self._actors) - 1

    def _person(self) -> int:
        b = self._bullet
        shape = b.createCollisionShape(
            b.GEOM_CYLINDER, radius=PERSON_RADIUS_M, height=PERSON_HEIGHT_M, physicsClientId=self._client
        )
        return self._body(int(shape))

    def move_actor(self, index: int, x_m: float, y_m: float, z_m: float) -> None:
        """Put an actor's feet at a point of M."""
        self._place(self._actors[index][0], (x_m, y_m, z_m + PERSON_HEIGHT_M / 2), 0.0)

    def move_cart(self, x_m: float, y_m: float, z_m: float, yaw_rad: float) -> None:
        """Put C at a point of M."""
        ahead_m = BODY_LENGTH_M / 2 - BODY_REAR_M
        self._x_m = x_m + ahead_m * math.cos(yaw_rad)
        self._y_m = y_m + ahead_m * math.sin(yaw_rad)
        self._z_m, self._yaw_rad = z_m + BODY_FLOOR_M + BODY_HEIGHT_M / 2, yaw_rad
        self._moved = True

    def _settle(self) -> None:
        """Tell pybullet where the cart is, before it is asked for anything."""
        if self._moved:
            self._moved = False
            self._place(self._cart, (self._x_m, self._y_m, self._z_m), self._yaw_rad)

    def _place(self, body: int, centre: tuple[float, float, float], yaw_rad: float) -> None:
        quaternion = (0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))
        self._bullet.resetBasePositionAndOrientation(body, centre, quaternion, physicsClientId=self._client)

    def touches(self) -> bool:
        """Say whether the cart touches anything now; cheap, for every tick."""
        self._settle()
        self._bullet.performCollisionDetection(physicsClientId=self._client)
        hits = self._bullet.getContactPoints(bodyA=self._cart, physicsClientId=self._client)
        self._collided = self._collided or any(hit[8] < 0.0 for hit in hits)
        return self._collided

    def clearance(self) -> Clearance:
        """Say how close the cart is to the nearest thing."""
        if math.hypot(self._x_m - self._looked_x_m, self._y_m - self._looked_y_m) > LOOK_M:
            self._look_around()
        if self._near_bodies or self._actors:
            self._settle()
        nearest_m, kind, at_m = NEAR_M, None, None
        for body in self._near_bodies:
            for point in self._closest(body, nearest_m):
                if point[8] < nearest_m:
                    nearest_m, at_m = point[8], point[6]
        for body, what in self._actors:
            for point in self._closest(body, nearest_m):
                if point[8] < nearest_m:
                    nearest_m, kind = point[8], what
        if kind is None:
            kind = ObstacleKind.BOX if at_m is None else self._near_kind or self._kind_at(at_m)
        self._collided = self._collided or nearest_m < 0.0
        return Clearance(nearest_m, self._collided, kind)

    def _closest(self, body: int, within_m: float) -> Any:
        return self._bullet.getClosestPoints(self._cart, body, within_m, physicsClientId=self._client)

    def _look_around(self) -> None:
        """Note which boxes can come nearer than NEAR_M before the cart has moved by LOOK_M."""
        self._looked_x_m, self._looked_y_m = self._x_m, self._y_m
        far_m = NEAR_M + LOOK_M + CART_REACH_M + 0.1  # pybullet's distances are good to millimetres
        near = [
            box for box in self._boxes if math.hypot(box.x_m - self._x_m, box.y_m - self._y_m) - box.reach_m <= far_m
        ]
        self._near = [box.index for box in near]
        self._near_bodies = list(dict.fromkeys(box.body for box in near))
        kinds = {self._scene.kind[k] for k in self._near}
        self._near_kind = ObstacleKind(kinds.pop()) if len(kinds) == 1 else None

    def _kind_at(self, at_m: tuple[float, float, float]) -> ObstacleKind:
        """Tell which box of the scene a point on a compound belongs to: the one whose surface is nearest."""
        s = self._scene

        def outside_m(k: int) -> float:
            c, n = math.cos(s.yaw_rad[k]), math.sin(s.yaw_rad[k])
            dx, dy = at_m[0] - s.x_m[k], at_m[1] - s.y_m[k]
            along, across = abs(dx * c + dy * n) - s.length_m[k] / 2, abs(dy * c - dx * n) - s.width_m[k] / 2
            return max(along, across, abs(at_m[2] - s.z_m[k]) - s.height_m[k] / 2)

        return ObstacleKind(s.kind[min(self._near, key=outside_m)])

    def rays(self, starts: list[tuple[float, float, float]], ends: list[tuple[float, float, float]]) -> list[float]:
        """Cast rays; gives for each the fraction of its length at which it hits, 1 for none. Not the cart."""
        self._settle()
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
