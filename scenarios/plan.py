"""Plan: what a scenario and a seed mean, as pure functions: start, mission, simulation, faults. Nothing runs here."""

import math
import zlib
from collections.abc import Callable

import numpy as np

from autonomy.plan import Target
from hal.bus import Fault, Level
from hal.faults import Corruption, HostSilence
from hal.signals import Course, FaultEvent, ObstacleKind, Scene
from hal.signals import Site as SiteRecord
from sim.actors import Actor
from sim.cart import Outage, PlantKind, SimSetup, Start
from sim.plant import CartParams
from sim.site import Site, scene_of
from sim.synlaser import SynLaserParams
from sim.terrain import Terrain

from .course import CourseImpossible, hidden_course
from .field import draw_field
from .randomise import Randomised
from .scenario import CanCorruptionFault, GpsOutageFault, HostSilenceFault, ObstacleSetup, Scenario

MOST_BOXES = 192  # as many as a Scene holds
Rng = Callable[[str], np.random.Generator]


def rng_of(seed: int) -> Rng:
    """Give one independent generator per name."""
    return lambda name: np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(name.encode())]))


def at(scenario: Scenario, t_s: float) -> int:
    """Turn seconds since the start into a stamp."""
    return scenario.t0_ns + round(t_s * 1e9)


def site_record(site: Site) -> SiteRecord:
    """Give the map's origin."""
    return SiteRecord(site.name, site.plane.lat_rad, site.plane.lon_rad, site.alt_m)


def course_record(scenario: Scenario, site: Site, rng: Rng) -> Course:
    """Give the course: the published way-points, and behind them the hidden ones of this seed."""
    plane, mark = site.plane, scenario.start
    points = [(*plane.to_map(lat, lon), radius) for lat, lon, radius in scenario.waypoints_geo(site)]
    if scenario.course.hidden:
        before = points[-2][:2] if len(points) > 1 else (mark.east_m, mark.north_m)
        last = points[-1]
        yaw_rad = math.atan2(last[1] - before[1], last[0] - before[0])
        drawn = hidden_course(site, last[:2], yaw_rad, scenario.course.hidden, rng("course"))
        points += [(x, y, last[2]) for x, y in drawn]
    geo = [plane.to_geo(x, y) for x, y, _ in points]
    start_lat_rad, start_lon_rad = plane.to_geo(mark.east_m, mark.north_m)
    return Course(
        tuple(lat for lat, _ in geo),
        tuple(lon for _, lon in geo),
        tuple(radius for _, _, radius in points),
        scenario.course.speed_mps,
        start_lat_rad,
        start_lon_rad,
        max(mark.position_sigma_m, 0.01),
        math.radians(mark.yaw_deg),
        math.radians(max(mark.yaw_sigma_deg, 0.1)),
    )


def obstacles(scenario: Scenario, site: Site, course: Course, rng: Rng) -> tuple[ObstacleSetup, ...]:
    """Give what stands there besides the site's own: what the scenario lists, then the field of this seed."""
    boxes, mark = scenario.obstacles, scenario.start
    if scenario.field is not None:
        geo = zip(course.lat_rad, course.lon_rad, course.radius_m, strict=True)
        waypoints = [Target(*site.plane.to_map(lat, lon), radius_m) for lat, lon, radius_m in geo]
        start = (mark.east_m, mark.north_m)
        boxes += draw_field(scenario.field, furnished(site, boxes), start, waypoints, rng("field"))
    if len(furnished(site, boxes).all_obstacles()) > MOST_BOXES:
        raise CourseImpossible(f"more than {MOST_BOXES} obstacles, those of site {site.name} included")
    return boxes


def furnished(site: Site, boxes: tuple[ObstacleSetup, ...]) -> Site:
    """Give the site with more obstacles on it."""
    return site.model_copy(update={"obstacles": (*site.obstacles, *boxes)})


def map_record(site: Site, boxes: tuple[ObstacleSetup, ...]) -> Scene:
    """Give the cart's map: what was surveyed of all that stands there."""
    seen = furnished(site, tuple(box for box in boxes if box.surveyed))
    terrain = Terrain(site.hills, 1.0)
    return scene_of(seen, {k: terrain.height_m(b.east_m, b.north_m) for k, b in enumerate(seen.all_obstacles())})


def sim_setup(scenario: Scenario, site: Site, level: Level, plant: PlantKind, rng: Rng, drawn: Randomised) -> SimSetup:
    """Give the simulated cart: it starts near its mark, as well as the crew puts it there."""
    mark, start, laser = scenario.start, rng("start").normal(size=3), scenario.laser
    return SimSetup(
        site=site.model_copy(update={"friction": site.friction * drawn.friction_factor}),
        start=Start(
            x_m=mark.east_m + mark.position_sigma_m * start[0],
            y_m=mark.north_m + mark.position_sigma_m * start[1],
            yaw_rad=math.radians(mark.yaw_deg + mark.yaw_sigma_deg * start[2]),
        ),
        t_ns=scenario.t0_ns,
        level=level,
        plant=plant,
        gps_grade=scenario.gps.grade,
        params=cart_params(drawn),
        gps_factor=drawn.gps_factor,
        compass_factor=drawn.compass_factor,
        outages=tuple(
            Outage(at(scenario, at_s), at(scenario, at_s + for_s))
            for at_s, for_s in [
                *((f.at_s, f.for_s) for f in scenario.faults if isinstance(f, GpsOutageFault)),
                *([(drawn.outage_at_s, drawn.outage_for_s)] if drawn.outage_for_s > 0.0 else []),
            ]
        ),
        compass=scenario.compass.personality,
        laser=None
        if laser is None
        else SynLaserParams(reach_m=laser.reach_m, fov_rad=math.radians(laser.fov_deg), rays=laser.rays),
        actors=tuple(
            Actor(ObstacleKind[a.kind.upper()], a.path_m, a.speed_mps, at(scenario, a.at_s), a.pauses_s)
            for a in scenario.actors
        ),
    )


def cart_params(drawn: Randomised) -> CartParams:
    """Give the cart that was drawn."""
    usual = CartParams()
    return CartParams(
        load_kg=drawn.load_kg,
        steer_lag_s=usual.steer_lag_s * drawn.steer_lag_factor,
        steer_dead_time_s=drawn.steer_dead_time_s,
        drive_lag_s=usual.drive_lag_s * drawn.drive_lag_factor,
        brake_force_n=usual.brake_force_n * drawn.brake_factor,
    )


def bus_faults(scenario: Scenario, rng: Rng) -> list[Fault]:
    """Give what stands on the CAN bus."""
    out: list[Fault] = []
    for k, fault in enumerate(scenario.faults):
        if isinstance(fault, HostSilenceFault):
            out.append(HostSilence(at(scenario, fault.at_s)))
        elif isinstance(fault, CanCorruptionFault):
            end_ns = at(scenario, fault.at_s + fault.for_s)
            out.append(Corruption(at(scenario, fault.at_s), end_ns, fault.probability, rng(f"corruption{k}")))
    return out


def fault_events(scenario: Scenario) -> list[tuple[int, FaultEvent]]:
    """Give when faults begin and end, for the recording."""
    events = []
    for fault in scenario.faults:
        events.append((at(scenario, fault.at_s), FaultEvent(fault.kind, True)))
        if not isinstance(fault, HostSilenceFault):
            events.append((at(scenario, fault.at_s + fault.for_s), FaultEvent(fault.kind, False)))
    return sorted(events, key=lambda event: event[0])
