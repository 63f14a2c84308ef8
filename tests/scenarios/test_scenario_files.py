"""Scenario files: those that ship are sound; what is wrong in one is said with file, line and key."""

import math
from pathlib import Path

import pytest

from scenarios.scenario import Scenario, ScenarioError, library, load_scenario

GOOD = """\
id: field/there-and-back
about: A line, and back.
site: pad
start: {east_m: 1, yaw_deg: 90}
course:
  speed_mps: 2.5
  waypoints:
    - {east_m: 20, north_m: 0}
    - lat_deg: 39.1826
      lon_deg: -86.5249
      radius_m: 2
faults:
  - {kind: host-silence, at_s: 10}
  - kind: gps-outage
    at_s: 2
    for_s: 3
duration_s: 60
criteria:
  waypoints_missed: "== 0"
  final_speed_mps: "<= 0.01"
"""


def write(tmp_path: Path, text: str) -> Path:
    file = tmp_path / "mine.scenario.yaml"
    file.write_text(text)
    return file


def changed(*pairs: tuple[str, str]) -> str:
    text = GOOD
    for old, new in pairs:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


def line_of(text: str, part: str) -> int:
    return next(k for k, line in enumerate(text.splitlines(), 1) if part in line)


def error_of(tmp_path: Path, text: str) -> str:
    """Load a file that is wrong, and give what is said, which must be one line."""
    with pytest.raises(ScenarioError) as error:
        load_scenario(str(write(tmp_path, text)))
    said = str(error.value)
    assert "\n" not in said, said
    return said.removeprefix(f"{tmp_path}/")


@pytest.mark.parametrize("name", library())
def test_scenario_that_ships_is_sound(name: str) -> None:
    scenario = load_scenario(name)
    assert scenario.id == name
    assert scenario.stack_path().is_file()
    site = scenario.load_site()
    assert site.name == scenario.site
    assert len(scenario.waypoints_geo(site)) == len(scenario.course.waypoints)
    assert len(scenario.parsed_criteria) == len(scenario.criteria)


def test_good_file_is_read_with_its_defaults(tmp_path: Path) -> None:
    scenario = load_scenario(str(write(tmp_path, GOOD)))
    assert scenario.stack == "reference"
    assert scenario.course.waypoints[0].radius_m == 3.0
    assert [fault.kind for fault in scenario.faults] == ["host-silence", "gps-outage"]
    assert scenario.t0_ns % 1_000_000_000 == 0


def test_way_points_are_places_on_earth_however_they_are_given(tmp_path: Path) -> None:
    scenario = load_scenario(str(write(tmp_path, GOOD)))
    site = scenario.load_site()
    local, geo = scenario.waypoints_geo(site)
    assert site.plane.to_map(*local[:2]) == pytest.approx((20.0, 0.0))
    assert geo == pytest.approx((math.radians(39.1826), math.radians(-86.5249), 2.0))


# -- what is wrong, and where -----------------------------------------------------------------------------------------

MISSPELT = {
    "top": (("duration_s: 60", "duraton_s: 60"), "duraton_s", "duration_s"),
    "start": (("yaw_deg: 90", "yaw_degr: 90"), "start.yaw_degr", "yaw_deg"),
    "course": (("  speed_mps: 2.5", "  sped_mps: 2.5"), "course.sped_mps", "speed_mps"),
    "way-point": (("      radius_m: 2", "      radus_m: 2"), "course.waypoints.1.radus_m", "radius_m"),
    "fault": (("    for_s: 3", "    fro_s: 3"), "faults.1.fro_s", "for_s"),
    "one-line fault": (("silence, at_s: 10", "silence, at: 10"), "faults.0.at", "at_s"),
}


@pytest.mark.parametrize("case", MISSPELT)
def test_misspelt_key_is_named_with_its_line_and_the_key_that_was_meant(tmp_path: Path, case: str) -> None:
    change, key, meant = MISSPELT[case]
    text = changed(change)
    with pytest.raises(ScenarioError) as error:
        load_scenario(str(write(tmp_path, text)))
    said = str(error.value).splitlines()  # the key that was meant may be missing now as well
    line = line_of(text, change[1].strip())
    assert any(f"mine.scenario.yaml:{line}: {key}: unknown key; did you mean {meant}?" in one for one in said), said


def test_key_like_no_other_is_named_with_those_that_there_are(tmp_path: Path) -> None:
    said = error_of(tmp_path, changed(("duration_s: 60", "duration_s: 60\nweather: rain")))
    assert said.startswith("mine.scenario.yaml:18: weather: unknown key; known are id, about, site")


IMPOSSIBLE = {
    "too fast": (("speed_mps: 2.5", "speed_mps: 25"), "speed_mps: 25", ["course.speed_mps", "5.5", "25"]),
    "standing": (("speed_mps: 2.5", "speed_mps: 0"), "speed_mps: 0", ["course.speed_mps", "greater than 0"]),
    "text for a number": (("speed_mps: 2.5", "speed_mps: fast"), "fast", ["course.speed_mps", "number", "'fast'"]),
    "nan": (("east_m: 1,", "east_m: .nan,"), "nan", ["start.east_m", "finite"]),
    "infinite": (("duration_s: 60", "duration_s: .inf"), "inf", ["duration_s"]),
    "never ends": (("duration_s: 60", "duration_s: -1"), "-1", ["duration_s", "greater than 0", "-1"]),
    "beyond the pole": (("lat_deg: 39.1826", "lat_deg: 93"), "lat_deg: 93", ["course.waypoints.1.lat_deg", "90"]),
    "half a place": (("      lon_deg: -86.5249\n", ""), "lat_deg", ["course.waypoints.1", "lat_deg and lon_deg"]),
    "two places": (("{east_m: 20, north_m: 0}", "{east_m: 2, north_m: 0, lat_deg: 3, lon_deg: 4}"), "lat_deg: 3",
                   ["course.waypoints.0", "lat_deg and lon_deg, or east_m and north_m"]),
    "unknown site": (("site: pad", "site: pda"), "site: pda", ["site", "'pda'", "pad"]),
    "unknown fault": (("kind: host-silence", "kind: host-silent"), "host-silent", ["faults.0", "host-silence"]),
    "unknown metric": (("final_speed_mps:", "final_sped_mps:"), "criteria", ["final_sped_mps", "final_speed_mps"]),
    "criterion without operator": (('"<= 0.01"', '"0.01"'), "criteria", ["final_speed_mps", "'0.01'", "<= 2.0"]),
    "criterion that is nan": (('"<= 0.01"', '"<= nan"'), "criteria", ["final_speed_mps", "'<= nan'"]),
    "id with blanks": (("id: field/there-and-back", "id: There and back"), "id:", ["id", "There and back"]),
    "no criteria": (('criteria:\n  waypoints_missed: "== 0"\n  final_speed_mps: "<= 0.01"\n', "criteria: {}\n"),
                    "criteria", ["criteria", "at least 1"]),
    "half a second": (("site: pad", "site: pad\nstart_utc: 2026-11-22T15:00:00.5Z"), "start_utc", ["whole second"]),
    "list for one": (("site: pad", "site: [pad]"), "site", ["site", "string"]),
}  # fmt: skip


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_impossible_value_is_named_with_its_line_and_what_is_possible(tmp_path: Path, case: str) -> None:
    change, part, words = IMPOSSIBLE[case]
    text = changed(change)
    said = error_of(tmp_path, text)
    assert said.startswith(f"mine.scenario.yaml:{line_of(text, part)}: "), said
    for word in words:
        assert word in said


def test_missing_key_is_named_with_the_place_where_it_belongs(tmp_path: Path) -> None:
    text = changed(("  speed_mps: 2.5\n", ""))
    assert (
        error_of(tmp_path, text) == f"mine.scenario.yaml:{line_of(text, 'course:')}: course.speed_mps: Field required"
    )


def test_all_that_is_wrong_is_said_at_once(tmp_path: Path) -> None:
    text = changed(("duration_s: 60", "duration_s: 0"), ("speed_mps: 2.5", "speed_mps: 9"))
    with pytest.raises(ScenarioError) as error:
        load_scenario(str(write(tmp_path, text)))
    said = str(error.value).splitlines()
    assert len(said) == 2
    assert {line.split(": ")[1] for line in said} == {"course.speed_mps", "duration_s"}


DAMAGED = {
    "tab": ("site:\tpad\n", 1),
    "open bracket": ("id: a\ncriteria: {a: [1, 2\nabout: x\n", 3),
    "wrong indent": ("id: a\n  about: b\n", 2),
    "twice": ("id: a\nsite: pad\nid: b\n", 3),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_damaged_yaml_is_named_with_its_line(tmp_path: Path, case: str) -> None:
    text, line = DAMAGED[case]
    said = error_of(tmp_path, text)
    assert said.startswith(f"mine.scenario.yaml:{line}: not YAML: "), said


@pytest.mark.parametrize("text", ["", "just words\n", "- a\n- list\n", "42\n"])
def test_file_without_keys_says_that_keys_are_expected(tmp_path: Path, text: str) -> None:
    assert "mine.scenario.yaml: expected keys and values" in error_of(tmp_path, text)


@pytest.mark.parametrize("data", [b"\xff\xfe\x00\x81", b"id: \x00\x01\x02\n", bytes(range(128, 256))])
def test_bytes_that_are_no_text_are_named_with_their_file(tmp_path: Path, data: bytes) -> None:
    file = tmp_path / "mine.scenario.yaml"
    file.write_bytes(data)
    with pytest.raises(ScenarioError, match=r"mine\.scenario\.yaml: ") as error:
        load_scenario(str(file))
    assert "\n" not in str(error.value)


def test_missing_file_and_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="no file"):
        load_scenario(str(tmp_path / "none.scenario.yaml"))
    folder = tmp_path / "folder.yaml"
    folder.mkdir()
    with pytest.raises(ScenarioError, match="cannot be read"):
        load_scenario(str(folder))


@pytest.mark.parametrize(
    ("name", "meant"), [("parking-lot/sqare", "parking-lot/square"), ("safety/host-die", "safety/host-dies")]
)
def test_unknown_scenario_is_named_with_the_one_that_was_meant(name: str, meant: str) -> None:
    with pytest.raises(ScenarioError, match=f"no scenario '{name}'; did you mean {meant}"):
        load_scenario(name)


def test_unknown_scenario_like_no_other_is_named_with_those_that_there_are() -> None:
    with pytest.raises(ScenarioError) as error:
        load_scenario("moon")
    assert all(name in str(error.value) for name in library())


def test_scenario_cannot_be_changed_by_accident() -> None:
    scenario: Scenario = load_scenario("parking-lot/square")
    with pytest.raises(ValueError, match="frozen"):
        scenario.duration_s = 1.0  # type: ignore[misc]
