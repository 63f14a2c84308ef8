"""What the road tracker's programs tell each other, in Python; `roadtracker.h` is the same in C, generated from here:

python -m rtdb.c_header examples.roadtracker_records > examples/roadtracker.h
"""

from typing import Annotated

import numpy as np

from rtdb import Record
from rtdb.records import f8, image


class CameraFrame(Record, frozen=True, eq=False):
    """A grey picture of the road ahead."""

    pixels: Annotated[np.ndarray, image(48, 64, 1, "brightness, top row first")]


class Lane(Record, frozen=True):
    """Where the lane is, as seen from the cart."""

    offset_m: Annotated[float, f8("m", "of the lane's middle to the left of the cart's")] = 0.0
    heading_rad: Annotated[float, f8("rad", "of the lane to the left of the cart's")] = 0.0
