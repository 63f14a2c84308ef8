"""The scenarios that ship: each is a test. The smoke-tagged ones are driven here, and pytest collects all on demand."""

import sys
import xml.etree.ElementTree as ET

import pytest

from scenarios.check import check_scenarios, select
from scenarios.goldens import golden_path, load_golden
from scenarios.scenario import LIBRARY, library, load_scenario

pytest_plugins = ["pytester"]
SMOKE = [plan.id for _, plan in select(tags=["smoke"])]


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    """The smoke set, driven once with seed 0 on two processes."""
    report = check_scenarios(tags=["smoke"], jobs=2, out=tmp_path_factory.mktemp("smoke"))
    return {outcome.result.scenario: outcome for outcome in report.outcomes}


@pytest.mark.parametrize("name", SMOKE)
def test_smoke(smoke, name):
    assert smoke[name].good, smoke[name].complaint()


@pytest.mark.parametrize("name", sorted(library()))
def test_a_scenario_has_the_id_of_its_file_a_purpose_and_golden_values(name):
    plan = load_scenario(name)
    assert plan.id == name
    assert len(plan.about) > 20
    golden = load_golden(golden_path(library()[name]))
    assert golden is not None, f"run: fairway check {name} --update-golden"
    assert 0 in golden.seeds
    assert golden.scenario == name


def test_no_golden_values_are_left_of_a_scenario_that_is_gone():
    from scenarios.goldens import GOLDEN

    kept = {str(path.relative_to(GOLDEN)).removesuffix(".json") for path in GOLDEN.rglob("*.json")}
    assert kept <= set(library())


# -- the plug-in for pytest --------------------------------------------------------------------------------------------

GOOD = """\
id: test/good
about: A short straight.
site: pad
course:
  speed_mps: 3.0
  waypoints:
    - {east_m: 8, north_m: 0, radius_m: 3}
duration_s: 20
seeds: 3
tags: [quick]
criteria:
  waypoints_missed: "== 0"
"""


def pytest_in(pytester, *arguments):
    """Run pytest in a process of its own, as a user does."""
    pytester.syspathinsert(str(LIBRARY.parent.parent))
    return pytester.run(sys.executable, "-m", "pytest", "-p", "scenarios.collect", *arguments)


def test_pytest_collects_each_seed_as_a_test_and_keeps_metrics_as_properties(pytester, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(LIBRARY.parent.parent))
    (pytester.path / "good.scenario.yaml").write_text(GOOD)
    done = pytest_in(pytester, "--scenario-seeds", "2", "--junitxml", "junit.xml", "-v")
    done.assert_outcomes(passed=2)
    done.stdout.fnmatch_lines(["good.scenario.yaml::seed-0 PASSED*", "good.scenario.yaml::seed-1 PASSED*"])
    case = ET.parse(pytester.path / "junit.xml").getroot().find(".//testcase[@name='seed-0']")
    found = {p.get("name"): p.get("value") for p in case.iter("property")}
    assert found["verdict"] == "PASS"
    assert found["criterion waypoints_missed"] == "0 == 0 PASS"
    assert float(found["finish_time_s"]) > 0


def test_pytest_tells_a_failure_an_error_and_a_wrong_file_apart(pytester, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(LIBRARY.parent.parent))
    pytester.path.joinpath("stack.json").write_text(
        (LIBRARY.parent.parent / "autonomy/stacks/reference.json")
        .read_text()
        .replace("autonomy.follow:Follow", "broken.py:Follow")
    )
    pytester.path.joinpath("broken.py").write_text(
        "from autonomy.follow import Follow as Right\n\n\nclass Follow(Right):\n"
        "    def step(self) -> None:\n        raise ZeroDivisionError('of course')\n"
    )
    good = GOOD.replace("seeds: 3", "seeds: 1").replace("duration_s: 20", "duration_s: 5")
    (pytester.path / "fails.scenario.yaml").write_text(good.replace("test/good", "test/fails").replace("== 0", "== 7"))
    (pytester.path / "breaks.scenario.yaml").write_text(
        good.replace("test/good", "test/breaks") + "stack: stack.json\n"
    )
    (pytester.path / "typo.scenario.yaml").write_text(good.replace("site: pad", "sight: pad"))
    done = pytest_in(pytester, "--continue-on-collection-errors", "-rfE")
    done.assert_outcomes(failed=1, errors=2)
    done.stdout.fnmatch_lines(
        [
            "*typo.scenario.yaml:3: sight: unknown key; did you mean site?",
            "*test/breaks seed 0: ERROR: follow: *of course*",
            "*test/fails seed 0: FAIL: waypoints_missed 0, wanted == 7*",
        ]
    )


def test_tags_are_keywords_of_pytest(pytester, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(LIBRARY.parent.parent))
    (pytester.path / "good.scenario.yaml").write_text(GOOD)
    pytest_in(pytester, "--collect-only", "-q", "-k", "quick").stdout.fnmatch_lines(["*3 tests collected*"])
    pytest_in(pytester, "--collect-only", "-q", "-k", "slow").stdout.fnmatch_lines(["*3 deselected*"])
