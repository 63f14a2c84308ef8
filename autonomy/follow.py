"""Follow: from way-point to way-point by pure pursuit.

Steer on the circle through the rear axle and a goal point a look-ahead ahead on the course line: curvature = 2 y / L^2
(Coulter, Implementation of the Pure Pursuit Path Tracking Algorithm, CMU-RI-TR-92-01, 1992). Speed falls before corners
and before the end so that neither lateral acceleration nor braking exceed what is comfortable.
"""

import math

from autonomy import Input, Module, Output, Param
from hal.signals import STOP, Course, DriveCommand, FollowState, LocalPlane, Pose, Site

Point = tuple[float, float]


class Follow(Module):
    """Drive the cart along the course."""

    site = Input(Site, static=True)
    course = Input(Course, static=True)
    pose = Input(Pose, max_age_s=0.25)
    drive = Output(DriveCommand, safe=STOP)
    state = Output(FollowState, safe=FollowState())

    wheelbase_m = Param(1.66, unit="m")
    max_steer_rad = Param(0.46, unit="rad")
    lookahead_s = Param(0.8, unit="s")
    min_lookahead_m = Param(2.4, unit="m")
    lateral_mps2 = Param(1.2, unit="m/s2")
    decel_mps2 = Param(0.7, unit="m/s2")

    def reset(self) -> None:
        """Forget the course."""
        self._line: list[Point] = []
        self._leg = 0

    def step(self) -> None:
        """Aim at the goal point; choose the speed."""
        if not self._line:
            self._plan()
        here = (self.pose.x_m, self.pose.y_m)
        self._advance(here)
        along, lateral_m = on_leg(self._line[self._leg], self._line[self._leg + 1], here)
        finished = (self._leg == len(self._line) - 2 and math.dist(here, self._line[-1]) < 0.5) or self._past_end(along)
        self.state = FollowState(waypoint=self._leg, finished=finished, lateral_error_m=lateral_m)
        if finished:
            self.drive = DriveCommand(0.0, 0.0)
            return
        lookahead_m = max(self.min_lookahead_m, self.lookahead_s * abs(self.pose.speed_mps))
        goal = self._goal(along, lookahead_m)
        curvature = self._curvature(goal)
        steer_rad = math.atan(self.wheelbase_m * curvature)
        steer_rad = min(max(steer_rad, -self.max_steer_rad), self.max_steer_rad)
        self.drive = DriveCommand(speed_mps=self._speed(along, curvature), steer_rad=steer_rad, decel_mps2=1.2)

    def _plan(self) -> None:
        """Turn the course into a line in M that begins where the cart stands."""
        plane = LocalPlane.at(self.site.lat_rad, self.site.lon_rad)
        points = [plane.to_map(lat, lon) for lat, lon in zip(self.course.lat_rad, self.course.lon_rad, strict=True)]
        self._line = [(self.pose.x_m, self.pose.y_m), *points]

    def _advance(self, here: Point) -> None:
        """Go on to the next leg when this one's end is passed."""
        while self._leg < len(self._line) - 2:
            start, end = self._line[self._leg], self._line[self._leg + 1]
            along, _ = on_leg(start, end, here)
            if along < math.dist(start, end) - 0.3 * self.course.radius_m[self._leg]:
                return
            self._leg += 1

    def _past_end(self, along_m: float) -> bool:
        start, end = self._line[-2], self._line[-1]
        return self._leg == len(self._line) - 2 and along_m >= math.dist(start, end)

    def _goal(self, along_m: float, lookahead_m: float) -> Point:
        """Walk the look-ahead along the line."""
        left, leg = max(along_m, 0.0) + lookahead_m, self._leg
        while True:
            start, end = self._line[leg], self._line[leg + 1]
            length = math.dist(start, end)
            if left <= length or leg == len(self._line) - 2:
                part = left / length
                return start[0] + part * (end[0] - start[0]), start[1] + part * (end[1] - start[1])
            left, leg = left - length, leg + 1

    def _curvature(self, goal: Point) -> float:
        dx, dy = goal[0] - self.pose.x_m, goal[1] - self.pose.y_m
        c, s = math.cos(self.pose.yaw_rad), math.sin(self.pose.yaw_rad)
        ahead_m, left_m = dx * c + dy * s, dy * c - dx * s
        if ahead_m < 0:  # behind: the tightest turn on that side
            left_m = math.copysign(max(abs(left_m), 1.0), left_m)
        return 2.0 * left_m / (dx * dx + dy * dy)

    def _speed(self, along_m: float, curvature: float) -> float:
        speed_mps = self.course.speed_mps
        if abs(curvature) > 1e-6:
            speed_mps = min(speed_mps, math.sqrt(self.lateral_mps2 / abs(curvature)))
        distance_m = math.dist(self._line[self._leg], self._line[self._leg + 1]) - along_m
        for k in range(self._leg + 1, len(self._line)):
            distance_m = max(distance_m, 0.0)
            corner_mps = self._corner_speed(k) if k < len(self._line) - 1 else 0.3
            speed_mps = min(speed_mps, math.sqrt(corner_mps**2 + 2.0 * self.decel_mps2 * distance_m))
            if distance_m > 20.0 or k == len(self._line) - 1:
                break
            distance_m += math.dist(self._line[k], self._line[k + 1])
        return speed_mps

    def _corner_speed(self, k: int) -> float:
        """Speed through the corner at point k: on the arc that the look-ahead cuts out of it."""
        (ax, ay), (bx, by), (cx, cy) = self._line[k - 1], self._line[k], self._line[k + 1]
        turn = abs(math.remainder(math.atan2(cy - by, cx - bx) - math.atan2(by - ay, bx - ax), 2 * math.pi))
        if turn < 0.05:
            return self.course.speed_mps
        radius_m = max(
            self.min_lookahead_m / math.tan(turn / 2) if turn < math.pi - 0.1 else 0.0,
            self.wheelbase_m / math.tan(self.max_steer_rad),
        )
        return math.sqrt(self.lateral_mps2 * radius_m)


def on_leg(start: Point, end: Point, here: Point) -> tuple[float, float]:
    """Give (distance along, signed distance to the left of) the leg from start to end."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    length = math.hypot(dx, dy)
    px, py = here[0] - start[0], here[1] - start[1]
    return (px * dx + py * dy) / length, (dx * py - dy * px) / length
