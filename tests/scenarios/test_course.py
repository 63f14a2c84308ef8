"""Hidden courses: seeded, with room, with a sharp turn; and a site that is too full."""

import math
from itertools import pairwise

import numpy as np
import pytest

from scenarios.course import CORNER_CLEAR_M, LEG_CLEAR_M, CourseImpossible, hidden_course, segment_to_box
from scenarios.plan import course_record, rng_of
from scenarios.scenario import load_scenario
from sim.site import Obstacle

SCENARIO = load_scenario("p545/field-trial")
SITE = SCENARIO.load_site()


def turns(points):
    headings = [math.atan2(b[1] - a[1], b[0] - a[0]) for a, b in pairwise(points)]
    return [abs(math.remainder(b - a, 2 * math.pi)) for a, b in pairwise(headings)]


@pytest.mark.parametrize("seed", range(20))
def test_both_courses_have_eight_way_points_and_a_turn_of_more_than_a_right_angle(seed):
    course = course_record(SCENARIO, SITE, rng_of(seed))
    points = [SITE.plane.to_map(lat, lon) for lat, lon in zip(course.lat_rad, course.lon_rad, strict=True)]
    published = len(SCENARIO.course.waypoints)
    assert published >= 8
    assert len(points) - published >= 8
    assert max(turns([(SCENARIO.start.east_m, SCENARIO.start.north_m), *points[:published]])) > math.pi / 2
    assert max(turns(points[published - 1 :])) > math.pi / 2
    assert max(course.radius_m) <= 3.0


def test_hidden_course_keeps_clear_of_obstacles_and_differs_between_seeds():
    courses = [hidden_course(SITE, (8.0, 4.0), math.pi, 9, np.random.default_rng(seed)) for seed in range(10)]
    assert len({tuple(points) for points in courses}) == 10
    for points in courses:
        for a, b in zip([(8.0, 4.0), *points], points, strict=False):
            for box in SITE.obstacles:
                assert segment_to_box(a, b, box) > LEG_CLEAR_M
                assert segment_to_box(b, b, box) > CORNER_CLEAR_M


def test_site_without_room_is_said_to_be_impossible(monkeypatch):
    monkeypatch.setattr("scenarios.course.TRIES", 5)
    boxes = [Obstacle(kind="box", east_m=x, north_m=y) for x in range(-60, 61, 8) for y in range(-40, 41, 8)]
    full = SITE.model_copy(update={"obstacles": tuple(boxes)})
    with pytest.raises(CourseImpossible, match="no course of 9 way-points fits into site p545"):
        hidden_course(full, (0.0, 0.0), 0.0, 9, np.random.default_rng(0))
