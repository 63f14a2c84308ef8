"""The simulated cart: plant, sensors and the device models, joined. One call advances it by one base tick."""

import math
from dataclasses import dataclass

import numpy as np

from hal.bus import CanBus, Level
from hal.devices.actuators import BrakeNode, DriveNode, SteerNode
from hal.devices.gps import GpsReceiver
from hal.devices.odometry import TickNode
from hal.devices.safety import SafetyNode
from hal.signals import CartTruth, FixQuality, LocalPlane

from .gps_error import GPS_GRADES, GpsError
from .plant import CartParams, CartState, Demand, Ground, Plant, PythonPlant

STEP_NS = 5_000_000
TICKS_PER_TURN = 128
STOP_EFFORT = 0.27  # 1.5 m/s2 with an empty cart: the rear axle does not lock, even at friction 0.5
PARK_EFFORT = 0.4
GPS_LATENCY_NS = 100_000_000  # from the measurement to the end of its sentences
ANTENNA_X_M, ANTENNA_Z_M = 0.60, 1.80  # G in C: on the roof, ahead of the rear axle
QUALITY = {
    "autonomous": FixQuality.AUTONOMOUS,
    "sbas": FixQuality.DIFFERENTIAL,
    "rtk_float": FixQuality.RTK_FLOAT,
    "rtk_fixed": FixQuality.RTK_FIXED,
}


@dataclass(frozen=True, slots=True)
class Outage:
    """The GPS receiver has no fix in [from_ns, to_ns)."""

    from_ns: int
    to_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """Where C really stands at the start, in M."""

    x_m: float
    y_m: float
    yaw_rad: float


class SimCart:
    """A cart on a site. Randomness comes in through one generator per sensor."""

    def __init__(
        self,
        *,
        level: Level,
        t_ns: int,
        start: Start,
        plane: LocalPlane,
        alt_m: float,
        friction: float,
        gps_grade: str,
        gps_rng: np.random.Generator,
        wheel_rng: np.random.Generator,
        outages: tuple[Outage, ...] = (),
        plant: Plant | None = None,
    ) -> None:
        self.bus = CanBus(level)
        params = CartParams()
        self.plant: Plant = plant or PythonPlant(params)
        self.plant.reset(CartState(start.x_m, start.y_m, start.yaw_rad))
        self.safety = SafetyNode(self.bus, t_ns)
        self.steer = SteerNode(self.bus)
        self.brake = BrakeNode(self.bus, stop_effort=STOP_EFFORT, park_effort=PARK_EFFORT)
        self.drive = DriveNode(self.bus)
        ticks_per_m = TICKS_PER_TURN / 1.40
        left, right = (1.0 + wheel_rng.normal(0.0, 0.005, 2)).tolist()  # radii differ from the nominal: tread, pressure
        self.odometry = TickNode(self.bus, ticks_per_m * left, ticks_per_m * right)
        self.gps = GpsReceiver(level=level, t0_ns=t_ns, latency_ns=GPS_LATENCY_NS)
        self._gps_error = GpsError(gps_rng, GPS_GRADES[gps_grade])
        self._plane, self._alt_m, self._outages = plane, alt_m, outages
        self._ground = Ground(0.0, 0.0, friction / params.friction)
        self._demand = Demand(brake=PARK_EFFORT)
        self.t_ns = t_ns
        self.estop_button = False

    def advance(self, tick_ns: int) -> None:
        """Advance by one tick: physics under the present demand, then sensors and nodes at the new time."""
        for _ in range(tick_ns // STEP_NS):
            self.plant.step(self._demand, self._ground)
        self.t_ns += tick_ns
        t_ns, s = self.t_ns, self.plant.state
        self.odometry.poll(t_ns, s.left_travel_m, s.right_travel_m)
        self.safety.poll(t_ns, (self.odometry.left + self.odometry.right) // 2, self.estop_button)
        self.steer.poll(t_ns, s.steer_rad, 0.0)
        self.brake.poll(t_ns, s.brake, 0.0)
        self.drive.poll(t_ns, s.vx_mps, s.drive, 0.0)
        self._demand = Demand(self.steer.target_rad, self.brake.effort, self.drive.output, self.drive.contactor_open)
        if self.gps.due(t_ns):
            self._measure_gps(t_ns, s)

    def _measure_gps(self, t_ns: int, s: CartState) -> None:
        error = self._gps_error
        error.advance(0.2)
        c, n = math.cos(s.yaw_rad), math.sin(s.yaw_rad)
        lat_rad, lon_rad = self._plane.to_geo(
            s.x_m + ANTENNA_X_M * c + error.east_m, s.y_m + ANTENNA_X_M * n + error.north_m
        )
        ve_mps, vn_mps, _ = error.velocity_error()
        side_mps = s.vy_mps + ANTENNA_X_M * s.yaw_rate_radps
        out = any(outage.from_ns <= t_ns < outage.to_ns for outage in self._outages)
        self.gps.measure(
            t_ns,
            lat_rad=lat_rad,
            lon_rad=lon_rad,
            alt_m=self._alt_m + ANTENNA_Z_M + error.up_m,
            east_mps=s.vx_mps * c - side_mps * n + ve_mps,
            north_mps=s.vx_mps * n + side_mps * c + vn_mps,
            quality=FixQuality.NONE if out else QUALITY[error.grade.name],
            satellites=0 if out else 9,
            hdop=0.9,
            sigma_m=error.grade.slow_sigma_m,
            utc_ns=t_ns,
        )

    def truth(self) -> CartTruth:
        """What the world store tells."""
        s = self.plant.state
        return CartTruth(
            s.x_m,
            s.y_m,
            s.yaw_rad,
            s.vx_mps,
            s.yaw_rate_radps,
            s.ax_mps2,
            s.ay_mps2,
            s.steer_rad,
            s.brake,
            s.distance_m,
        )
