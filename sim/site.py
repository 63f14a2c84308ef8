"""Sites: where a drive takes place. A YAML file in `sim/sites`, geo-referenced."""

import math
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from hal.signals import LocalPlane

SITES = Path(__file__).with_name("sites")


class Site(BaseModel):
    """A site. `boundary_m`: corners (east, north) of the area that may be driven; none means endless."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    name: str
    lat_deg: float = Field(ge=-80, le=80)
    lon_deg: float = Field(ge=-180, le=180)
    alt_m: float
    friction: float = Field(gt=0, le=1.2)
    boundary_m: tuple[tuple[float, float], ...] = ()

    @property
    def plane(self) -> LocalPlane:
        """The map's tangent plane."""
        return LocalPlane.at(math.radians(self.lat_deg), math.radians(self.lon_deg))


def site_names() -> list[str]:
    """List the sites that ship."""
    return sorted(path.stem for path in SITES.glob("*.yaml"))
