"""A picture of a drive from above, for environments: the line, what stands about, and the cart."""

import math
from typing import Any

import cv2
import numpy as np

from autonomy.features import Line
from hal.signals import ObstacleKind
from sim.cart import SimCart
from sim.world import BODY_LENGTH_M, BODY_REAR_M, BODY_WIDTH_M

HEIGHT, WIDTH = 480, 640
SPAN_M = 40.0  # shown from left to right, around the cart
GROUND, LINE, THING, PERSON, CART, NOSE = (
    (236, 238, 236), (160, 190, 120), (120, 110, 105), (200, 90, 40), (40, 90, 170), (230, 170, 40),
)  # fmt: skip
Image = np.ndarray[Any, np.dtype[np.uint8]]


def picture(sim: SimCart, line: Line) -> Image:
    """Draw what is around the cart, RGB, uint8 (480, 640, 3); north is up."""
    s, scale = sim.plant.state, WIDTH / SPAN_M
    image: Image = np.full((HEIGHT, WIDTH, 3), GROUND, dtype=np.uint8)

    def at(x_m: float, y_m: float) -> tuple[int, int]:
        return round(WIDTH / 2 + (x_m - s.x_m) * scale), round(HEIGHT / 2 - (y_m - s.y_m) * scale)

    def box(x_m: float, y_m: float, yaw_rad: float, length_m: float, width_m: float) -> Any:
        c, n = math.cos(yaw_rad), math.sin(yaw_rad)
        corners = [(a * length_m / 2, b * width_m / 2) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
        return np.array([at(x_m + a * c - b * n, y_m + a * n + b * c) for a, b in corners], dtype=np.int32)

    if len(line.stations) > 1:
        points = np.array([at(station.x_m, station.y_m) for station in line.stations], dtype=np.int32)
        cv2.polylines(image, [points], False, LINE, 2, cv2.LINE_AA)
    scene = sim.scene
    for k in range(len(scene.kind)):
        outline = box(scene.x_m[k], scene.y_m[k], scene.yaw_rad[k], scene.length_m[k], scene.width_m[k])
        cv2.fillPoly(image, [outline], THING, cv2.LINE_AA)
    actors = sim.actors()
    for kind, x_m, y_m in zip(actors.kind, actors.x_m, actors.y_m, strict=True):
        if kind == ObstacleKind.PERSON:
            cv2.circle(image, at(x_m, y_m), max(2, round(0.3 * scale)), PERSON, -1, cv2.LINE_AA)
    ahead_m = BODY_LENGTH_M / 2 - BODY_REAR_M
    c, n = math.cos(s.yaw_rad), math.sin(s.yaw_rad)
    cart = box(s.x_m + ahead_m * c, s.y_m + ahead_m * n, s.yaw_rad, BODY_LENGTH_M, BODY_WIDTH_M)
    cv2.fillPoly(image, [cart], CART, cv2.LINE_AA)
    tip_m = BODY_LENGTH_M - BODY_REAR_M
    cv2.circle(image, at(s.x_m + tip_m * c, s.y_m + tip_m * n), 4, NOSE, -1, cv2.LINE_AA)
    text = f"{s.vx_mps:.1f} m/s  {math.degrees(s.steer_rad):+.0f} deg"
    cv2.putText(image, text, (12, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (60, 60, 60), 1, cv2.LINE_AA)
    return image
