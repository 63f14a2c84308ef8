"""Be the component `follow`: steer from way-point to way-point of parking-lot/square.

python steer.py ADDRESS TOKEN
"""

import math
import sys

from rtdb.syncfs import Client

WAYPOINTS = [(15.0, -15.0), (15.0, 15.0), (-15.0, 15.0), (-15.0, -15.0)]

with Client.connect(sys.argv[1], sys.argv[2]) as fs:
    k = 0
    for _ in fs.edges("/follow/clock"):  # done with this cycle; now it is the next
        pose = fs.read_json("/localise/status")["pose"]
        if pose is None:
            continue
        if k < 4 and math.dist(WAYPOINTS[k], (pose["x_m"], pose["y_m"])) < 3.2:
            k += 1
        x_m, y_m = WAYPOINTS[min(k, 3)]
        turn_rad = math.remainder(math.atan2(y_m - pose["y_m"], x_m - pose["x_m"]) - pose["yaw_rad"], math.tau)
        steer_rad = max(-0.46, min(0.46, turn_rad))
        speed_mps = 0.0 if k == 4 else 3.0 if abs(steer_rad) < 0.2 else 2.0
        drive = {"speed_mps": speed_mps, "steer_rad": steer_rad, "decel_mps2": 1.0}
        fs.write_json("/follow/status", {"drive": drive, "state": {"finished": k == 4}})
