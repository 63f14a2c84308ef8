"""Sites: where a drive takes place. A YAML file in `sim/sites`, geo-referenced, with what stands there."""

import math
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from hal.signals import LocalPlane, ObstacleKind, Scene

SITES = Path(__file__).with_name("sites")
Kind = Literal["box", "car", "post", "island", "kerb", "wall"]

# Usual sizes, length x width x height in metres; a file may give others. Sizes of cars and kerbs are everyday ones.
SIZES: dict[str, tuple[float, float, float]] = {
    "box": (1.0, 1.0, 1.0),
    "car": (4.5, 1.8, 1.5),
    "post": (0.3, 0.3, 5.0),
    "island": (6.0, 2.0, 0.15),
    "kerb": (4.0, 0.2, 0.12),
    "wall": (10.0, 0.3, 2.5),
}


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Obstacle(_Strict):
    """Something that stands about: a box on the ground, by its centre."""

    kind: Kind
    east_m: float
    north_m: float
    yaw_deg: float = 0.0
    length_m: float | None = Field(default=None, gt=0)
    width_m: float | None = Field(default=None, gt=0)
    height_m: float | None = Field(default=None, gt=0)

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Length, width and height."""
        length, width, height = SIZES[self.kind]
        return self.length_m or length, self.width_m or width, self.height_m or height


class Hill(_Strict):
    """A smooth hill: height * exp(-(d / radius)^2)."""

    east_m: float
    north_m: float
    radius_m: float = Field(gt=5.0)
    height_m: float


class Lane(_Strict):
    """A closed path with kerbs on both sides, through its corner points."""

    points_m: tuple[tuple[float, float], ...] = Field(min_length=3)
    half_width_m: float = Field(gt=1.0)


class MultipathZone(_Strict):
    """A place where reflections push the GPS position aside, e.g. beside a building."""

    east_m: float
    north_m: float
    radius_m: float = Field(gt=0)
    offset_east_m: float
    offset_north_m: float


class Site(_Strict):
    """A site. `boundary_m`: corners (east, north) of the area that may be driven; none means endless."""

    name: str
    lat_deg: float = Field(ge=-80, le=80)
    lon_deg: float = Field(ge=-180, le=180)
    alt_m: float
    friction: float = Field(gt=0, le=1.2)
    boundary_m: tuple[tuple[float, float], ...] = ()
    obstacles: tuple[Obstacle, ...] = ()
    hills: tuple[Hill, ...] = ()
    lane: Lane | None = None
    multipath: tuple[MultipathZone, ...] = ()

    @property
    def plane(self) -> LocalPlane:
        """The map's tangent plane."""
        return LocalPlane.at(math.radians(self.lat_deg), math.radians(self.lon_deg))

    def all_obstacles(self) -> tuple[Obstacle, ...]:
        """What the file lists, and the kerbs of the lane."""
        return self.obstacles + (kerbs(self.lane) if self.lane else ())


def kerbs(lane: Lane) -> tuple[Obstacle, ...]:
    """Lay kerb stones along both sides of a lane, leaving out those that would stand inside it at corners."""
    out = []
    points = lane.points_m
    for k, (ax, ay) in enumerate(points):
        bx, by = points[(k + 1) % len(points)]
        length, yaw = math.hypot(bx - ax, by - ay), math.atan2(by - ay, bx - ax)
        n = max(1, int(length / 4.0))
        for i in range(n):
            along = (i + 0.5) * length / n
            for side in (-1.0, 1.0):
                x = ax + along * math.cos(yaw) - side * lane.half_width_m * math.sin(yaw)
                y = ay + along * math.sin(yaw) + side * lane.half_width_m * math.cos(yaw)
                if _to_lane(x, y, points) > lane.half_width_m - 0.05:
                    out.append(
                        Obstacle(kind="kerb", east_m=x, north_m=y, yaw_deg=math.degrees(yaw), length_m=length / n - 0.5)
                    )
    return tuple(out)


def _to_lane(x: float, y: float, points: tuple[tuple[float, float], ...]) -> float:
    """Distance from a point to the lane's middle line."""
    best = math.inf
    for k, (ax, ay) in enumerate(points):
        bx, by = points[(k + 1) % len(points)]
        dx, dy = bx - ax, by - ay
        part = min(max(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy), 0.0), 1.0)
        best = min(best, math.hypot(x - ax - part * dx, y - ay - part * dy))
    return best


def scene_of(site: Site, height_m: "dict[int, float] | None" = None) -> Scene:
    """Give the static world as a record; height_m: ground height under each obstacle, by index."""
    boxes = site.all_obstacles()
    sizes = [box.size_m for box in boxes]
    ground = [(height_m or {}).get(k, 0.0) for k in range(len(boxes))]
    return Scene(
        kind=tuple(int(ObstacleKind[box.kind.upper()]) for box in boxes),
        x_m=tuple(box.east_m for box in boxes),
        y_m=tuple(box.north_m for box in boxes),
        z_m=tuple(z + size[2] / 2 for z, size in zip(ground, sizes, strict=True)),
        yaw_rad=tuple(math.radians(box.yaw_deg) for box in boxes),
        length_m=tuple(size[0] for size in sizes),
        width_m=tuple(size[1] for size in sizes),
        height_m=tuple(size[2] for size in sizes),
        boundary_x_m=tuple(x for x, _ in site.boundary_m),
        boundary_y_m=tuple(y for _, y in site.boundary_m),
    )


def site_names() -> list[str]:
    """List the sites that ship."""
    return sorted(path.stem for path in SITES.glob("*.yaml"))
