"""What the tests of scenarios share."""

from pathlib import Path

import pytest

STRAIGHT = """\
id: test/straight
about: Straight on, and over.
site: pad
gps: {grade: rtk_fixed}
course: {speed_mps: 3.0, waypoints: [{east_m: 15, north_m: 0, radius_m: 1}]}
duration_s: 12
criteria: {waypoints_missed: "== 0"}
"""


@pytest.fixture
def straight(tmp_path: Path) -> str:
    """A scenario file: fifteen metres straight on."""
    path = tmp_path / "straight.scenario.yaml"
    path.write_text(STRAIGHT)
    return str(path)
