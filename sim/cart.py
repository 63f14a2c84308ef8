"""The simulated cart on its site: plant, world, sensors and devices, joined. One call advances it by a base tick."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from hal.bus import CanBus, Level
from hal.devices.actuators import BrakeNode, DriveNode, SteerNode
from hal.devices.compass import Compass
from hal.devices.gps import GpsReceiver
from hal.devices.odometry import TickNode
from hal.devices.safety import SafetyNode
from hal.signals import ActorsTruth, CartTruth, Clearance, FixQuality, LocalPlane, Scan, Scene

from .actors import Actor
from .compass_error import CompassError, CompassParams, declination_rad
from .compiled import CompiledPlant
from .gps_error import GPS_GRADES, GpsError, GpsGrade
from .plant import CartParams, CartState, Demand, Plant, PythonPlant
from .site import Site, scene_of
from .synlaser import SynLaser, SynLaserParams
from .terrain import Terrain
from .world import World

STEP_NS = 5_000_000
NODE_NS = 20_000_000  # cycle of the odometry and actuator nodes; the safety node runs at every tick
CLEARANCE_NS = 50_000_000  # distances are asked for this often, contacts at every tick once something is near
FAR_M = 1.0  # cart and walker together do not close this in CLEARANCE_NS
TICKS_PER_TURN = 128
STOP_EFFORT = 0.27  # 1.5 m/s2 with an empty cart: the rear axle does not lock, even at friction 0.5
PARK_EFFORT = 0.4
GPS_LATENCY_NS = 100_000_000  # from the measurement to the end of its sentences
ANTENNA_X_M, ANTENNA_Z_M = 0.60, 1.80  # G in C: on the roof, ahead of the rear axle
FULL_DRIVE_CURRENT_A = 100.0  # assumption: traction current at full drive force
CABLE_GAP_M = 0.1  # assumption: the traction current comes back in a cable this far from the other
QUALITY = {
    "autonomous": FixQuality.AUTONOMOUS,
    "sbas": FixQuality.DIFFERENTIAL,
    "rtk_float": FixQuality.RTK_FLOAT,
    "rtk_fixed": FixQuality.RTK_FIXED,
}
PlantKind = Literal["compiled", "python"]
PLANTS: dict[PlantKind, Callable[[CartParams], Plant]] = {"compiled": CompiledPlant, "python": PythonPlant}


def scaled_grade(grade: GpsGrade, factor: float) -> GpsGrade:
    """Give a class of fix with larger or smaller errors."""
    return replace(grade, slow_sigma_m=grade.slow_sigma_m * factor, white_sigma_m=grade.white_sigma_m * factor)


def scaled_compass(factor: float) -> CompassParams:
    """Give the compass with larger or smaller errors."""
    usual = CompassParams(cable_gap_m=CABLE_GAP_M)
    return replace(
        usual,
        constant_max_rad=usual.constant_max_rad * factor,
        one_cycle_max_rad=usual.one_cycle_max_rad * factor,
        two_cycle_max_rad=usual.two_cycle_max_rad * factor,
        noise_rad=usual.noise_rad * factor,
    )


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


@dataclass(frozen=True, slots=True, kw_only=True)
class SimSetup:
    """What a simulated drive is made of.

    plant: python is the readable form, ten times as slow, and equal but for the last bits of its sines; gps_factor,
    compass_factor: errors of the sensors over the usual ones; compass:
    personality of the device; None for none, as with `laser`.
    """

    site: Site
    start: Start
    t_ns: int
    level: Level = "wire"
    plant: PlantKind = "compiled"
    params: CartParams = field(default_factory=CartParams)
    gps_grade: str = "sbas"
    gps_factor: float = 1.0
    compass_factor: float = 1.0
    outages: tuple[Outage, ...] = ()
    compass: str | None = "hmr3000"
    laser: SynLaserParams | None = None
    actors: tuple[Actor, ...] = field(default=())


class SimCart:
    """A cart on a site. `rng(name)` gives the random generator of one named sensor."""

    def __init__(
        self,
        setup: SimSetup,
        rng: Callable[[str], np.random.Generator],
        make_world: Callable[[Scene], World] | None = None,
    ) -> None:
        self.setup = setup
        self.bus = CanBus(setup.level)
        params = setup.params
        self.plant: Plant = PLANTS[setup.plant](params)
        self.plant.reset(CartState(setup.start.x_m, setup.start.y_m, setup.start.yaw_rad))
        self.safety = SafetyNode(self.bus, setup.t_ns)
        self.steer = SteerNode(self.bus)
        self.brake = BrakeNode(self.bus, stop_effort=STOP_EFFORT, park_effort=PARK_EFFORT)
        self.drive = DriveNode(self.bus)
        per_m = TICKS_PER_TURN / 1.40
        left, right = (1.0 + rng("wheels").normal(0.0, 0.005, 2)).tolist()  # radii differ: tread, pressure
        self.odometry = TickNode(self.bus, per_m * left, per_m * right)
        self._plane: LocalPlane = setup.site.plane
        self.terrain = Terrain(setup.site.hills, setup.site.friction / params.friction)
        where = self._plane.lat_rad, self._plane.lon_rad, setup.site.alt_m, setup.t_ns
        self.declination_rad = declination_rad(*where)
        self.gps = GpsReceiver(
            level=setup.level,
            t0_ns=setup.t_ns,
            latency_ns=GPS_LATENCY_NS,
            sentences=("GGA", "GST", "RMC"),
            variation_rad=self.declination_rad,
        )
        self._gps_error = GpsError(rng("gps"), scaled_grade(GPS_GRADES[setup.gps_grade], setup.gps_factor))
        self.compass: Compass | None = None
        if setup.compass is not None:
            self.compass = Compass(personality=setup.compass, level=setup.level, t0_ns=setup.t_ns)  # type: ignore[arg-type]
            self._compass_error = CompassError(rng("compass"), scaled_compass(setup.compass_factor))
        boxes = setup.site.all_obstacles()
        heights = {k: self.terrain.height_m(box.east_m, box.north_m) for k, box in enumerate(boxes)}
        self.scene: Scene = scene_of(setup.site, heights)
        self._owns_world = make_world is None
        self.world = (make_world or World)(self.scene) if boxes or setup.actors or setup.laser else None
        self._laser = SynLaser(self.world, setup.laser, rng("laser")) if self.world and setup.laser else None
        self.add_actors()
        self._demand = Demand(brake=PARK_EFFORT)
        self._nearest, self._taken, self._far = Clearance(), Clearance(), False
        self.t_ns = setup.t_ns
        self.estop_button = False

    def add_actors(self) -> None:
        """Put the actors into the world."""
        for actor in self.setup.actors:
            assert self.world is not None
            self.world.add_actor(actor.kind)

    def advance(self, tick_ns: int) -> None:
        """Advance by one tick: physics under the present demand, then sensors and nodes at the new time."""
        plant, demand, terrain = self.plant, self._demand, self.terrain
        ground = terrain.flat
        if ground is None:
            s = plant.state
            ground = terrain.ground(s.x_m, s.y_m)
        for _ in range(tick_ns // STEP_NS):
            plant.step(demand, ground)
        self.t_ns = t_ns = self.t_ns + tick_ns
        nodes_due = t_ns % NODE_NS == 0
        if nodes_due:
            s = plant.state
            self.odometry.poll(t_ns, s.left_travel_m, s.right_travel_m)
        self.safety.poll(t_ns, (self.odometry.left + self.odometry.right) // 2, self.estop_button)
        if nodes_due:
            self._poll_actuators(t_ns, s)
        if self.gps.due(t_ns):
            self._measure_gps(t_ns, plant.state)
        if self.compass is not None and self.compass.due(t_ns):
            self._measure_heading(t_ns, plant.state)
        if self.world is not None and (t_ns % CLEARANCE_NS == 0 or not self._far):
            self._move_world(self.world, t_ns, plant.state)

    def _poll_actuators(self, t_ns: int, s: CartState) -> None:
        self.steer.poll(t_ns, s.steer_rad, 0.0)
        self.brake.poll(t_ns, s.brake, 0.0)
        self.drive.poll(t_ns, s.vx_mps, s.drive, 0.0)
        self._demand = Demand(self.steer.target_rad, self.brake.effort, self.drive.output, self.drive.contactor_open)

    def _move_world(self, world: World, t_ns: int, s: CartState) -> None:
        """Put cart and walkers in their places and look how near they are. Far away, only from look to look."""
        world.move_cart(s.x_m, s.y_m, self.terrain.height_m(s.x_m, s.y_m), s.yaw_rad)
        for k, actor in enumerate(self.setup.actors):
            x_m, y_m, _ = actor.at(t_ns)
            world.move_actor(k, x_m, y_m, self.terrain.height_m(x_m, y_m))
        touched = not self._far and world.touches() and not self._nearest.collided
        if touched or t_ns % CLEARANCE_NS == 0:
            now = world.clearance()
            self._far = now.distance_m > FAR_M
            if now.collided > self._nearest.collided or now.distance_m <= self._nearest.distance_m:
                self._nearest = now

    def attitude(self, s: CartState) -> tuple[float, float]:
        """Give (pitch, roll) in rad of the cart on the terrain: nose up, left side up."""
        ground = self.terrain.ground(s.x_m, s.y_m)
        c, n = math.cos(s.yaw_rad), math.sin(s.yaw_rad)
        return math.atan(ground.grade_x * c + ground.grade_y * n), math.atan(ground.grade_y * c - ground.grade_x * n)

    def _measure_gps(self, t_ns: int, s: CartState) -> None:
        error = self._gps_error
        error.advance(0.2)
        c, n = math.cos(s.yaw_rad), math.sin(s.yaw_rad)
        x_m, y_m = s.x_m + ANTENNA_X_M * c + error.east_m, s.y_m + ANTENNA_X_M * n + error.north_m
        for zone in self.setup.site.multipath:
            if math.hypot(s.x_m - zone.east_m, s.y_m - zone.north_m) < zone.radius_m:
                x_m, y_m = x_m + zone.offset_east_m, y_m + zone.offset_north_m
        lat_rad, lon_rad = self._plane.to_geo(x_m, y_m)
        ve_mps, vn_mps, _ = error.velocity_error()
        side_mps = s.vy_mps + ANTENNA_X_M * s.yaw_rate_radps
        out = any(outage.from_ns <= t_ns < outage.to_ns for outage in self.setup.outages)
        self.gps.measure(
            t_ns,
            lat_rad=lat_rad,
            lon_rad=lon_rad,
            alt_m=self.setup.site.alt_m + self.terrain.height_m(s.x_m, s.y_m) + ANTENNA_Z_M + error.up_m,
            east_mps=s.vx_mps * c - side_mps * n + ve_mps,
            north_mps=s.vx_mps * n + side_mps * c + vn_mps,
            quality=FixQuality.NONE if out else QUALITY[error.grade.name],
            satellites=0 if out else 9,
            hdop=0.9,
            sigma_m=error.grade.slow_sigma_m,
            utc_ns=t_ns,
        )

    def _measure_heading(self, t_ns: int, s: CartState) -> None:
        assert self.compass is not None
        pitch_rad, roll_rad = self.attitude(s)
        heading_rad = self._compass_error.heading(
            s.yaw_rad, self.declination_rad, pitch_rad, roll_rad, s.ax_mps2, s.ay_mps2,
            FULL_DRIVE_CURRENT_A * abs(s.drive), 0.1,
        )  # fmt: skip
        self.compass.measure(t_ns, heading_rad, self._compass_error.pitch_rad, self._compass_error.roll_rad)

    # -- what the runner takes from the world ---------------------------------------------------------------------

    def scan(self) -> Scan | None:
        """Scan, when it is time to; None in between, or without a scanner."""
        if self._laser is None or not self._laser.due(self.t_ns):
            return None
        s = self.plant.state
        return self._laser.scan(s.x_m, s.y_m, self.terrain.height_m(s.x_m, s.y_m), s.yaw_rad)

    def truth(self) -> CartTruth:
        """Where the cart is."""
        s = self.plant.state
        return CartTruth(
            s.x_m, s.y_m, s.yaw_rad, s.vx_mps, s.yaw_rate_radps,
            s.ax_mps2, s.ay_mps2, s.steer_rad, s.brake, s.distance_m,
        )  # fmt: skip

    @property
    def collided(self) -> bool:
        """Whether the cart has touched anything."""
        return self._nearest.collided

    @property
    def nearest_m(self) -> float:
        """Smallest distance to anything at the last looks, at most 5 m."""
        return min(self._nearest.distance_m, self._taken.distance_m)

    def actors(self) -> ActorsTruth:
        """Where the actors are."""
        at = [actor.at(self.t_ns) for actor in self.setup.actors]
        kinds = tuple(int(actor.kind) for actor in self.setup.actors)
        return ActorsTruth(kinds, tuple(x for x, _, _ in at), tuple(y for _, y, _ in at), tuple(yaw for *_, yaw in at))

    def take_clearance(self) -> Clearance:
        """Give the smallest clearance since the last call."""
        self._taken, self._nearest = self._nearest, Clearance(collided=self._nearest.collided)
        return self._taken

    def close(self) -> None:
        """Give the world back."""
        if self.world is not None and self._owns_world:
            self.world.close()
