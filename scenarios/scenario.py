"""Scenario files: YAML that people write, checked by pydantic; an error names file, line and key."""

import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from sim.site import SITES, Obstacle, Site, site_names

from .judge import Criterion

LIBRARY = Path(__file__).with_name("library")
STACKS = Path(__file__).parent.parent / "autonomy" / "stacks"
SUFFIX = ".scenario.yaml"
M = TypeVar("M", bound=BaseModel)


class ScenarioError(ValueError):
    """A scenario, or a file that it needs, is missing or wrong."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class StartPoint(_Strict):
    """Start mark of C, and how well the crew puts the cart there."""

    east_m: float = 0.0
    north_m: float = 0.0
    yaw_deg: float = 0.0
    position_sigma_m: float = Field(default=0.2, ge=0.0, le=2.0)
    yaw_sigma_deg: float = Field(default=2.0, ge=0.0, le=45.0)


class Waypoint(_Strict):
    """A GPS coordinate with a target radius; for sites without a survey, metres from the site's origin."""

    lat_deg: float | None = Field(None, ge=-90, le=90)
    lon_deg: float | None = Field(None, ge=-180, le=180)
    east_m: float | None = None
    north_m: float | None = None
    radius_m: float = Field(3.0, gt=0.0, le=20.0)

    @model_validator(mode="after")
    def _one_way(self) -> "Waypoint":
        geo, local = (self.lat_deg, self.lon_deg), (self.east_m, self.north_m)
        if not ((None not in geo and local == (None, None)) or (None not in local and geo == (None, None))):
            raise ValueError("a way-point has lat_deg and lon_deg, or east_m and north_m")
        return self


class CoursePlan(_Strict):
    """What to drive."""

    speed_mps: float = Field(gt=0.0, le=5.5)
    waypoints: tuple[Waypoint, ...] = Field(min_length=1, max_length=64)
    hidden: int = Field(default=0, ge=0, le=32, description="way-points drawn from the seed, behind the published ones")


class GpsSetup(_Strict):
    """The GPS receiver of this drive."""

    grade: Literal["autonomous", "sbas", "rtk_float", "rtk_fixed"] = "sbas"


class CompassSetup(_Strict):
    """The compass of this drive."""

    personality: Literal["hmr3000", "os5000"] = "hmr3000"


class LaserSetup(_Strict):
    """A range scanner on the nose."""

    reach_m: float = Field(default=4.0, gt=0.5, le=30.0)
    fov_deg: float = Field(default=120.0, gt=10.0, le=270.0)
    rays: int = Field(default=61, ge=3, le=181)


class ActorSetup(_Strict):
    """Somebody who walks along a path from a time on."""

    kind: Literal["person"] = "person"
    path_m: tuple[tuple[float, float], ...] = Field(min_length=2, max_length=16)
    speed_mps: float = Field(default=1.4, gt=0.0, le=4.0)
    at_s: float = Field(ge=0.0)
    pauses_s: tuple[float, ...] = Field(default=(), description="how long to stand at each inner point of the path")


class ObstacleSetup(Obstacle):
    """Something that stands about in this drive."""

    model_config = ConfigDict(allow_inf_nan=False)

    surveyed: bool = Field(default=True, description="it stands on the cart's map; else only a sensor can find it")


Range = tuple[float, float]


class FieldSetup(_Strict):
    """Boxes drawn from the seed; there is always a way from the start to the finish."""

    count: int = Field(ge=1, le=48, description="how many boxes")
    unsurveyed: int = Field(default=0, ge=0, description="how many of them are not on the cart's map")
    east_m: Range = Field(description="from, to: where their centres are")
    north_m: Range = Field(description="from, to")
    size_m: Range = Field(default=(0.8, 2.0), description="from, to: length and width; all are 1 m high")
    min_gap_m: float = Field(
        default=3.5, ge=0.0, le=20.0, description="between any two of them, and to what stands there"
    )

    @model_validator(mode="after")
    def _ranges(self) -> "FieldSetup":
        for name in ("east_m", "north_m", "size_m"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name} is [from, to], got {low:g} before {high:g}")
        if self.size_m[0] <= 0:
            raise ValueError("size_m is larger than 0")
        if self.unsurveyed > self.count:
            raise ValueError(f"unsurveyed is at most count, {self.count}")
        return self


class HostSilenceFault(_Strict):
    """The host's CAN frames stop."""

    kind: Literal["host-silence"]
    at_s: float = Field(gt=0.0)


class GpsOutageFault(_Strict):
    """The receiver has no fix for a while."""

    kind: Literal["gps-outage"]
    at_s: float = Field(ge=0.0)
    for_s: float = Field(gt=0.0)


class CanCorruptionFault(_Strict):
    """Some frames on the bus have a flipped bit. Level wire only."""

    kind: Literal["can-corruption"]
    at_s: float = Field(ge=0.0)
    for_s: float = Field(gt=0.0)
    probability: float = Field(gt=0.0, le=1.0)


FaultSetup = Annotated[HostSilenceFault | GpsOutageFault | CanCorruptionFault, Field(discriminator="kind")]


class Scenario(_Strict):
    """A drive: world, start, stack, faults, criteria."""

    id: str = Field(pattern=r"^[a-z0-9]+(-[a-z0-9]+)*(/[a-z0-9]+(-[a-z0-9]+)*)*$")
    about: str
    site: str
    start_utc: datetime = datetime(2026, 11, 22, 15, 0, tzinfo=UTC)
    start: StartPoint = StartPoint()
    course: CoursePlan
    stack: str = "reference"
    gps: GpsSetup = GpsSetup()
    compass: CompassSetup = CompassSetup()
    laser: LaserSetup | None = None
    obstacles: tuple[ObstacleSetup, ...] = Field(
        default=(), max_length=48, description="what stands there, besides the site's own"
    )
    field: FieldSetup | None = Field(default=None, description="boxes drawn from the seed")
    actors: tuple[ActorSetup, ...] = Field(default=(), max_length=8)
    faults: tuple[FaultSetup, ...] = ()
    duration_s: float = Field(gt=0.0, le=3600.0)
    seeds: int = Field(1, ge=1, le=10_000)
    tags: tuple[str, ...] = ()
    criteria: dict[str, str] = Field(min_length=1)

    @field_validator("site")
    @classmethod
    def _known_site(cls, name: str) -> str:
        if name not in site_names():
            raise ValueError(f"there is no site {name!r}; there are {', '.join(site_names())}")
        return name

    @field_validator("start_utc")
    @classmethod
    def _whole_second(cls, t: datetime) -> datetime:
        if t.tzinfo is None:
            t = t.replace(tzinfo=UTC)
        if t.microsecond or t.year < 1980:
            raise ValueError("start_utc is a whole second, not before 1980")
        return t

    @field_validator("criteria")
    @classmethod
    def _criteria(cls, raw: dict[str, str]) -> dict[str, str]:
        for metric, text in raw.items():
            Criterion.parse(metric, text)
        return raw

    @property
    def parsed_criteria(self) -> tuple[Criterion, ...]:
        """The criteria, ready to judge."""
        return tuple(Criterion.parse(metric, text) for metric, text in self.criteria.items())

    @property
    def t0_ns(self) -> int:
        """Start time, ns since 1970."""
        return int(self.start_utc.timestamp()) * 1_000_000_000

    def load_site(self) -> Site:
        """Read the site file."""
        return load_yaml(SITES / f"{self.site}.yaml", Site)

    def stack_path(self) -> Path:
        """Where the stack's wiring is: a name of a shipped one, or a path."""
        return Path(self.stack) if self.stack.endswith(".json") else STACKS / f"{self.stack}.json"

    def waypoints_geo(self, site: Site) -> list[tuple[float, float, float]]:
        """Way-points as (lat_rad, lon_rad, radius_m)."""
        out = []
        for w in self.course.waypoints:
            if w.lat_deg is not None and w.lon_deg is not None:
                out.append((math.radians(w.lat_deg), math.radians(w.lon_deg), w.radius_m))
            else:
                out.append((*site.plane.to_geo(w.east_m or 0.0, w.north_m or 0.0), w.radius_m))
        return out


def library() -> dict[str, Path]:
    """List the scenarios that ship, by id."""
    return {str(p.relative_to(LIBRARY)).removesuffix(SUFFIX): p for p in sorted(LIBRARY.rglob(f"*{SUFFIX}"))}


def load_scenario(name: str) -> Scenario:
    """Load a scenario by id from the library, or by path."""
    path = Path(name) if name.endswith((".yaml", ".yml")) else library().get(name)
    if path is None:
        import difflib

        near = difflib.get_close_matches(name, library(), n=1)
        hint = f"; did you mean {near[0]}?" if near else f"; there are {', '.join(library())}"
        raise ScenarioError(f"no scenario {name!r}{hint}")
    return load_yaml(path, Scenario)


def load_yaml(path: Path, model: type[M]) -> M:
    """Read a YAML file into a model; ScenarioError names file, line and key."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    try:
        data = YAML(typ="rt").load(path)
    except FileNotFoundError as error:
        raise ScenarioError(f"no file {path}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path}: cannot be read: {error}") from error
    except MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 0
        raise ScenarioError(f"{path}:{line}: not YAML: {error.problem}") from error
    except YAMLError as error:
        raise ScenarioError(f"{path}: not YAML: {str(error).splitlines()[0]}") from error
    if not isinstance(data, dict):
        raise ScenarioError(f"{path}: expected keys and values, got {type(data).__name__}")
    try:
        return model.model_validate(data)
    except ValidationError as error:
        lines = [
            f"{path}:{_line(data, e['loc'])}: {'.'.join(str(k) for k in e['loc'] if not _is_tag(k))}: {_say(e, model)}"
            for e in error.errors()
        ]
        raise ScenarioError("\n".join(lines)) from error


def _is_tag(key: int | str) -> bool:
    return key in ("host-silence", "gps-outage", "can-corruption")


def _line(data: Any, loc: tuple[int | str, ...]) -> int:
    """Line of the innermost key of an error's place that the file has."""
    line = 1
    for key in loc:
        if isinstance(data, dict) and key in data:
            line, data = data.lc.key(key)[0] + 1, data[key]  # type: ignore[attr-defined]
        elif isinstance(data, list) and isinstance(key, int) and key < len(data):
            line, data = data.lc.item(key)[0] + 1, data[key]  # type: ignore[attr-defined]
    return line


def _model_at(model: type[BaseModel], loc: tuple[int | str, ...]) -> type[BaseModel] | None:
    """Give the model that describes the place `loc` in a file, if there is one."""
    found = [model]
    for key in loc:
        info = model.model_fields.get(str(key))
        if info is not None:
            found = _models_in(info.annotation)
        elif _is_tag(key):
            found = [m for m in found if key in get_args(m.model_fields["kind"].annotation)]
        if not found:
            return None
        model = found[0]
    return model


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """List the models in a type such as tuple[Waypoint, ...] or Laser | None."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models_in(part)]


def _say(error: Any, model: type[BaseModel]) -> str:
    if error["type"] == "extra_forbidden":
        import difflib

        owner = _model_at(model, error["loc"][:-1])
        fields = list(owner.model_fields) if owner else []
        near = difflib.get_close_matches(str(error["loc"][-1]), fields, n=1)
        return "unknown key" + (
            f"; did you mean {near[0]}?" if near else f"; known are {', '.join(fields)}" if fields else ""
        )
    message = error["msg"].removeprefix("Value error, ")
    value = error.get("input")
    return f"{message} (got {value!r:.40})" if not isinstance(value, dict | list) else message
