"""The road tracker of the KogMo-RTDB paper (its figure 5): wait for the camera, follow its pictures, write the lane.

python examples/roadtracker.py STORE
"""

import sys
from pathlib import Path

import numpy as np

from rtdb import Store

sys.path.insert(0, str(Path(__file__).parents[1]))
from examples.roadtracker_records import CameraFrame, Lane

WIDTH_M, DEPTH_M = 3.2, 4.8  # of road that the picture shows


def track(pixels: np.ndarray) -> Lane:
    """Find the bright stripe: the middle of each row's brightness, and the line through these middles."""
    height, width, _ = pixels.shape
    bright = pixels[:, :, 0].sum(axis=1, dtype=float)
    rows = np.flatnonzero(bright)
    columns = pixels[rows, :, 0] @ (np.arange(width) + 0.5) / bright[rows]
    ahead_m = (height - 0.5 - rows) * DEPTH_M / height
    left_m = (0.5 - columns / width) * WIDTH_M
    heading_rad, offset_m = np.polyfit(ahead_m, left_m, 1)
    return Lane(float(offset_m), float(heading_rad))


def main(store_name: str) -> None:
    """Track until the camera is deleted or silent for ten seconds."""
    with Store.attach(store_name) as store:
        lane = store.join("roadtracker").insert("lane", Lane, n_causes=1)
        camera = store.find("camera/left", CameraFrame, timeout_s=10.0)
        for picture, lost in camera.updates(after=0, timeout_s=10.0):
            if lost:
                print(f"{lost} pictures lost", file=sys.stderr)
            lane.write(track(picture.value.pixels), inputs=[picture])


if __name__ == "__main__":
    main(sys.argv[1])
