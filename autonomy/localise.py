"""Localise: an extended Kalman filter over wheel travel and GPS.

State: x, y, yaw of C in M; the slow error of the GPS receiver east and north (a Gauss-Markov process, so that the
filter knows that averaging fixes does not remove it); scale errors of the left and right wheel; the slow error of the
compass. Prediction by the travel of the rear wheels, correction by GPS fixes and, while nothing pulls at the compass's
idea of down, by compass headings. A fix is applied at the time at which it was measured: the filter goes back there and
repeats the travel since.

Sources: Thrun, Burgard, Fox, Probabilistic Robotics, 2005, chapters 5 and 7; Gelb, Applied Optimal Estimation, 1974,
for the Gauss-Markov state.
"""

import math
from collections import deque
from typing import TYPE_CHECKING, Any, NamedTuple

from autonomy import Input, Module, Output, Param
from hal.signals import CompassHeading, Course, FixQuality, GpsFix, LocalPlane, Odometry, Pose, Site, wrap

if TYPE_CHECKING:
    import numpy as np

N = 8
X, Y, YAW, EAST, NORTH, LEFT, RIGHT, COMPASS = range(N)

# Receiver errors by kind of fix, as its data sheet gives them: slow sigma m, correlation time s, white sigma m.
RECEIVER = {
    FixQuality.AUTONOMOUS: (2.0, 300.0, 0.1),
    FixQuality.DIFFERENTIAL: (0.7, 200.0, 0.05),
    FixQuality.RTK_FLOAT: (0.2, 60.0, 0.03),
    FixQuality.RTK_FIXED: (0.01, 30.0, 0.01),
}
UNKNOWN_RECEIVER = (5.0, 300.0, 0.5)
HISTORY_S = 0.6  # how far back a late fix may lie
HEADING_EVERY_NS = 300_000_000
GATE = 30.0  # squared Mahalanobis distance; a good fix exceeds it once in three million
COMPASS_SIGMA_RAD, COMPASS_TAU_S, COMPASS_WHITE_RAD = 0.06, 15.0, 0.02  # deviation and currents, on a steel cart
REFUSE_AT_MOST = 10  # then it is the filter that is wrong


class Travelled(NamedTuple):
    """A state of the filter and the wheel travel that leads from it to the next."""

    t_ns: int
    x: "np.ndarray[Any, Any]"
    P: "np.ndarray[Any, Any]"
    left_m: float
    right_m: float


class Localise(Module):
    """Estimate the pose of the cart."""

    site = Input(Site, static=True)
    course = Input(Course, static=True, optional=True)
    gps = Input(GpsFix, static=True, optional=True)
    odometry = Input(Odometry, optional=True, max_age_s=0.5)
    compass = Input(CompassHeading, static=True, optional=True, max_age_s=0.5)
    pose = Output(Pose, safe=Pose(sigma_m=1e3))

    track_m = Param(0.90, unit="m")
    antenna_x_m = Param(0.60, unit="m")
    # Creep of the rear tyres: 0.05 m sideways on a course of 120 m with four corners, for slip angles of 2 degrees.
    slip = Param(0.005, unit="m/sqrt(m)")
    yaw_slip = Param(0.0005, unit="rad/sqrt(m)")
    # Two counters, each right to a tick of 10.9 mm, evenly: sqrt(2) * 0.0109 / sqrt(12) / track_m.
    yaw_floor_rad = Param(0.005, unit="rad")
    wheel_sigma = Param(0.005, unit="1")
    drift_mps = Param(0.5, unit="m/sqrt(s)")
    drift_radps = Param(0.3, unit="rad/sqrt(s)")
    quiet_mps2 = Param(0.25, unit="m/s2")

    def reset(self) -> None:
        """Start knowing nothing."""
        import numpy as np
        from filterpy.kalman import ExtendedKalmanFilter

        self._np, self._F, self._Q = np, np.eye(N), np.zeros((N, N))
        self._kf = ExtendedKalmanFilter(dim_x=N, dim_z=2)
        self._kf.x = np.zeros(N)
        self._kf.P = np.diag(
            [1e8, 1e8, math.pi**2, 0.0, 0.0, self.wheel_sigma**2, self.wheel_sigma**2, COMPASS_SIGMA_RAD**2]
        )
        self._past: deque[Travelled] = deque(maxlen=max(2, int(HISTORY_S / self.dt_s)))
        self._last: Odometry | None = None
        self._fix_write = self._heading_ns = 0
        self._speed_mps = 0.0
        self._fix_ns: int | None = None
        self._refused = 0
        self._begun = False
        self._quality = FixQuality.NONE
        self._receiver = UNKNOWN_RECEIVER

    def step(self) -> None:
        """Predict to the newest wheel travel, then apply a new fix."""
        if not self._begun:
            self._begin()
        travel = self.samples.get("odometry")
        t_ns = travel.t_data_ns if travel is not None else self.t_ns
        left_m = right_m = 0.0
        if self.odometry is not None:
            if self._last is not None:  # counters run on through a gap, and so does what they tell
                left_m, right_m = self.odometry.left_m - self._last.left_m, self.odometry.right_m - self._last.right_m
            self._last = self.odometry
        dt_s = (t_ns - self._now_ns) * 1e-9
        if dt_s > 0:
            self._travel(t_ns, left_m, right_m)
        self._take_fix()
        self._take_heading(left_m, right_m, dt_s)
        self.pose = self._estimate(left_m, right_m, dt_s)

    def _begin(self) -> None:
        """Use the start mark, if there is one."""
        self._begun, self._now_ns = True, self.t_ns
        self._plane = LocalPlane.at(self.site.lat_rad, self.site.lon_rad)
        course = self.course
        if course is not None and course.start_sigma_m > 0:
            x_m, y_m = self._plane.to_map(course.start_lat_rad, course.start_lon_rad)
            self._kf.x[:3] = x_m, y_m, course.start_yaw_rad
            self._kf.P[X, X] = self._kf.P[Y, Y] = course.start_sigma_m**2
            self._kf.P[YAW, YAW] = course.start_yaw_sigma_rad**2

    def _predict(self, dt_s: float, left_m: float, right_m: float) -> None:
        kf = self._kf
        _, tau_s, _ = self._receiver
        x_m, y_m, yaw, east_m, north_m, left_scale, right_scale, compass = kf.x.tolist()
        left, right = left_m * (1.0 + left_scale), right_m * (1.0 + right_scale)
        ds, dyaw = (left + right) / 2, (right - left) / self.track_m
        c, s = math.cos(yaw + dyaw / 2), math.sin(yaw + dyaw / 2)
        keep = math.exp(-dt_s / tau_s)
        F, Q = self._F, self._Q  # kept from call to call: only what changes is written
        F[X, YAW], F[Y, YAW] = -ds * s, ds * c
        for wheel, m, sign in ((LEFT, left_m, -1.0), (RIGHT, right_m, 1.0)):
            turn = sign * m / self.track_m
            F[X, wheel] = m * c / 2 - ds * s * turn / 2
            F[Y, wheel] = m * s / 2 + ds * c * turn / 2
            F[YAW, wheel] = turn
        F[EAST, EAST] = F[NORTH, NORTH] = keep
        F[COMPASS, COMPASS] = keep_compass = math.exp(-dt_s / COMPASS_TAU_S)
        slow = self._receiver[0] ** 2 * (1.0 - keep * keep) if self._quality else 0.0
        along, turn = self.slip**2 * abs(ds), self.yaw_slip**2 * abs(ds)
        if self.odometry is None:  # no wheels: the cart may be anywhere that it could have walked to
            along, turn = self.drift_mps**2 * dt_s, self.drift_radps**2 * dt_s
        kf.x = self._np.array(
            [
                x_m + ds * c,
                y_m + ds * s,
                yaw + dyaw,
                east_m * keep,
                north_m * keep,
                left_scale,
                right_scale,
                compass * keep_compass,
            ]
        )
        Q[X, X] = Q[Y, Y] = along
        Q[YAW, YAW] = turn
        Q[EAST, EAST] = Q[NORTH, NORTH] = slow
        Q[COMPASS, COMPASS] = COMPASS_SIGMA_RAD**2 * (1.0 - keep_compass**2)
        kf.P = F @ kf.P @ F.T + Q

    def _take_fix(self) -> None:
        sample = self.samples.get("gps")
        if sample is None or self.gps is None or sample.write == self._fix_write or self.gps.mode < 2:
            return
        self._fix_write = sample.write
        self._apply_at(sample.t_data_ns)

    def _change_receiver(self, quality: FixQuality) -> None:
        """Another kind of fix has another slow error, of which nothing is known yet; nothing older can come."""
        kf = self._kf
        self._quality, self._receiver = quality, RECEIVER.get(quality, UNKNOWN_RECEIVER)
        for k in (EAST, NORTH):
            kf.P[k, :] = kf.P[:, k] = 0.0
            kf.P[k, k] = self._receiver[0] ** 2
            kf.x[k] = 0.0
        self._past.clear()

    def _apply_at(self, t_ns: int) -> None:
        """Go back to before the measurement, apply it there, and travel forward again."""
        kf, again = self._kf, []
        while self._past and self._now_ns > t_ns:
            step, end_ns = self._past.pop(), self._now_ns
            again.append((end_ns, step.left_m, step.right_m))
            self._now_ns, kf.x, kf.P = step.t_ns, step.x, step.P
        if again and t_ns > self._now_ns:
            end_ns, left_m, right_m = again.pop()
            part = (t_ns - self._now_ns) / (end_ns - self._now_ns)
            self._travel(t_ns, part * left_m, part * right_m)
            again.append((end_ns, (1.0 - part) * left_m, (1.0 - part) * right_m))
        assert self.gps is not None
        if self.gps.quality != self._quality:
            self._change_receiver(self.gps.quality)
        if self._correct():
            self._fix_ns = t_ns
        for end_ns, left_m, right_m in reversed(again):
            self._travel(end_ns, left_m, right_m)

    def _travel(self, t_ns: int, left_m: float, right_m: float) -> None:
        """Predict to t_ns and remember how."""
        self._past.append(Travelled(self._now_ns, self._kf.x, self._kf.P, left_m, right_m))
        self._predict((t_ns - self._now_ns) * 1e-9, left_m, right_m)
        self._now_ns = t_ns

    def _correct(self) -> bool:
        """Correct by the position of the antenna; False if it is too far off to be believed."""
        np, kf, gps = self._np, self._kf, self.gps
        assert gps is not None
        z = np.array(self._plane.to_map(gps.lat_rad, gps.lon_rad))
        c, s = math.cos(kf.x[YAW]) * self.antenna_x_m, math.sin(kf.x[YAW]) * self.antenna_x_m
        H = np.zeros((2, N))
        H[0, X] = H[1, Y] = H[0, EAST] = H[1, NORTH] = 1.0
        H[0, YAW], H[1, YAW] = -s, c
        expected = np.array([kf.x[X] + kf.x[EAST] + c, kf.x[Y] + kf.x[NORTH] + s])
        R = np.eye(2) * self._receiver[2] ** 2
        miss = z - expected
        if miss @ np.linalg.solve(H @ kf.P @ H.T + R, miss) > GATE:
            if self._refused < REFUSE_AT_MOST:
                self._refused += 1
                return False
            kf.P[: Y + 1, :] = kf.P[:, : Y + 1] = 0.0  # the position is wrong by that much; the yaw need not be
            kf.P[X, X] = kf.P[Y, Y] = miss @ miss
        self._refused = 0
        kf.update(z, HJacobian=lambda _: H, Hx=lambda _: expected, R=R)
        return True

    def _take_heading(self, left_m: float, right_m: float, dt_s: float) -> None:
        """Correct by a new compass heading, if the cart neither turns nor brakes: a tilted compass shows anything."""
        sample, speed_before_mps = self.samples.get("compass"), self._speed_mps
        if self.odometry is None or dt_s <= 0:
            return
        self._speed_mps += 0.2 * (self.odometry.speed_mps - self._speed_mps)  # ticks are coarse: about five steps
        along_mps2 = (self._speed_mps - speed_before_mps) / dt_s
        aside_mps2 = self._speed_mps * (right_m - left_m) / self.track_m / dt_s
        if sample is None or self.compass is None or not self.compass.valid:
            return
        if sample.t_data_ns < self._heading_ns + HEADING_EVERY_NS:
            return  # its slow error makes ten readings a second little better than three
        self._heading_ns = sample.t_data_ns
        if math.hypot(along_mps2, aside_mps2) > self.quiet_mps2:
            return
        np, kf = self._np, self._kf
        H = np.zeros((1, N))
        H[0, YAW] = H[0, COMPASS] = 1.0
        expected = kf.x[YAW] + kf.x[COMPASS]
        miss = wrap(self.compass.yaw_rad - expected)
        kf.update(np.array([miss]), HJacobian=lambda _: H, Hx=lambda _: np.zeros(1), R=np.eye(1) * COMPASS_WHITE_RAD**2)

    def _estimate(self, left_m: float, right_m: float, dt_s: float) -> Pose:
        x, P = self._kf.x, self._kf.P
        left, right = left_m * (1.0 + x[LEFT]), right_m * (1.0 + x[RIGHT])
        cov = P[:3, :3].ravel().tolist()
        cov[8] += self.yaw_floor_rad**2  # what the wheel counters cannot resolve; it does not add up
        half, off = (cov[0] + cov[4]) / 2, (cov[0] - cov[4]) / 2
        largest = half + math.sqrt(off * off + cov[1] * cov[3])
        return Pose(
            x_m=float(x[X]),
            y_m=float(x[Y]),
            yaw_rad=wrap(float(x[YAW])),
            speed_mps=self.odometry.speed_mps if self.odometry is not None else 0.0,
            yaw_rate_radps=float((right - left) / self.track_m / dt_s) if dt_s > 0 else 0.0,
            covariance=tuple(cov),
            sigma_m=math.sqrt(max(largest, 0.0)),
            fix_age_s=(self.t_ns - self._fix_ns) * 1e-9 if self._fix_ns is not None else 1e3,
        )
