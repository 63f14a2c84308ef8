"""The world: what the cart touches, how far it is from things, what rays hit."""

import math

import numpy as np
import pytest

from hal.signals import ObstacleKind
from sim.actors import Actor
from sim.plant import CartParams, CartState, Demand, PythonPlant
from sim.site import Hill, Lane, Obstacle, Site, kerbs, scene_of
from sim.synlaser import MOUNT_X_M, SynLaser, SynLaserParams
from sim.terrain import Terrain
from sim.world import BODY_LENGTH_M, BODY_REAR_M, PERSON_RADIUS_M, SCENES, World

NOSE_M = BODY_LENGTH_M - BODY_REAR_M


def site(*obstacles, **more):
    return Site(name="t", lat_deg=39, lon_deg=-86, alt_m=0, friction=0.8, obstacles=obstacles, **more)


@pytest.fixture
def lamp():
    with World(scene_of(site(Obstacle(kind="post", east_m=10.0, north_m=0.0)))) as world:
        yield world


def test_clearance_is_the_distance_from_the_nose_to_the_obstacle(lamp):
    lamp.move_cart(5.0, 0.0, 0.0, 0.0)
    near = lamp.clearance()
    assert near.distance_m == pytest.approx(10.0 - 0.15 - 5.0 - NOSE_M, abs=0.01)
    assert near.kind is ObstacleKind.POST
    assert not near.collided


def test_touching_is_seen_and_remembered(lamp):
    lamp.move_cart(0.0, 0.0, 0.0, 0.0)
    assert not lamp.touches()
    lamp.move_cart(9.0, 0.0, 0.0, 0.0)
    assert lamp.touches()
    lamp.move_cart(0.0, 0.0, 0.0, 0.0)
    assert lamp.touches(), "a collision does not go away by driving on"


def test_more_boxes_than_one_compound_body_holds_are_all_there():
    row = [Obstacle(kind="post", east_m=6.0 * k, north_m=20.0) for k in range(150)]
    with World(scene_of(site(*row))) as world:
        for k in range(150):
            world.move_cart(6.0 * k - 0.5, 18.0, 0.0, 0.0)
            assert world.clearance().distance_m == pytest.approx(20.0 - 18.0 - 0.6 - 0.15, abs=0.02), k


def test_a_kerb_is_low_and_still_in_the_way():
    stone = Obstacle(kind="kerb", east_m=0.0, north_m=2.0)
    with World(scene_of(site(stone))) as world:
        world.move_cart(0.0, 1.5, 0.0, 0.0)
        assert world.touches()
        assert world.clearance().kind is ObstacleKind.KERB


def test_kerbs_stand_along_the_lane_and_never_inside_it():
    lane = Lane(points_m=((0, 0), (40, 0), (40, 30), (0, 30)), half_width_m=3.0)
    stones = kerbs(lane)
    assert len(stones) > 30
    for stone in stones:
        inner = max(abs(stone.east_m - 20.0) - 20.0, abs(stone.north_m - 15.0) - 15.0)
        assert abs(abs(inner) - 3.0) < 0.1


def test_synlaser_sees_a_person_where_it_is_and_nothing_else():
    with World(scene_of(site())) as world:
        world.add_actor(ObstacleKind.PERSON)
        world.move_actor(0, 5.0, 0.0, 0.0)
        world.move_cart(0.0, 0.0, 0.0, 0.0)
        laser = SynLaser(world, SynLaserParams(reach_m=4.0, sigma_m=0.0), np.random.default_rng(0))
        scan = laser.scan(0.0, 0.0, 0.0, 0.0)
        ahead = round(-scan.first_rad / scan.step_rad)
        assert scan.range_m[ahead] == pytest.approx(5.0 - 0.3 - MOUNT_X_M, abs=0.02)
        assert scan.range_m[0] == scan.range_m[-1] == pytest.approx(4.0)
        assert laser.scan(0.0, 0.0, 0.0, math.pi).range_m == (4.0,) * 61, "nothing behind, and not the cart itself"


def test_an_actor_walks_its_path_and_stands_where_it_pauses():
    person = Actor(ObstacleKind.PERSON, ((0.0, 0.0), (2.0, 0.0), (2.0, 3.0)), 1.0, 1_000_000_000, (4.0,))
    assert [person.at(t * 1_000_000_000)[:2] for t in (0, 1, 2, 3, 5, 7, 8, 10, 99)] == [
        (0, 0), (0, 0), (1, 0), (2, 0), (2, 0), (2, 0), (2, 1), (2, 3), (2, 3),
    ]  # fmt: skip


def test_slope_is_the_gradient_of_the_height():
    terrain = Terrain((Hill(east_m=0, north_m=0, radius_m=20, height_m=3),), 1.0)
    for x, y in ((5.3, 1.7), (-8.1, 12.2), (0.4, -15.9)):
        ground, step = terrain.ground(x, y), 1e-4
        assert ground.grade_x == pytest.approx((terrain.height_m(x + step, y) - terrain.height_m(x - step, y)) / 2e-4)
        assert ground.grade_y == pytest.approx((terrain.height_m(x, y + step) - terrain.height_m(x, y - step)) / 2e-4)
    assert terrain.height_m(0, 0) == pytest.approx(3.0, abs=0.05)
    assert terrain.height_m(500, 500) == pytest.approx(0.0, abs=0.01)


def test_cart_without_brakes_rolls_off_a_hill():
    terrain = Terrain((Hill(east_m=0, north_m=0, radius_m=20, height_m=3),), 1.0)
    plant = PythonPlant(CartParams(), state=CartState(x_m=8.0))
    for _ in range(2000):
        plant.step(Demand(), terrain.ground(plant.state.x_m, plant.state.y_m))
    assert plant.state.x_m > 12.0


def test_a_scene_that_is_put_up_again_is_what_it_was_before():
    """More scenes than are kept, forth and back: each touches, and stops rays, where it stands and nowhere else."""
    scenes = [scene_of(site(Obstacle(kind="post", east_m=10.0 + k, north_m=0.0))) for k in range(SCENES + 8)]
    with World(scenes[0]) as world:
        for k in [*range(1, len(scenes)), 0, *reversed(range(len(scenes)))]:
            world.furnish(scenes[k])
            world.add_actor(ObstacleKind.PERSON)
            world.move_actor(0, 5.0, 8.0, 0.0)
            world.move_cart(5.0 + k, 0.0, 0.0, 0.0)
            assert world.clearance().distance_m == pytest.approx(10.0 - 0.15 - 5.0 - NOSE_M, abs=0.01), k
            ahead, aside = world.rays([(0.0, 2.0, 1.0), (5.0, 2.0, 1.0)], [(100.0, 2.0, 1.0), (5.0, 18.0, 1.0)])
            assert ahead == 1.0, "nothing stands aside"
            assert aside == pytest.approx((6.0 - PERSON_RADIUS_M) / 16.0, abs=1e-3), "an actor that came back"


def test_a_world_keeps_no_more_bodies_than_the_scenes_that_it_keeps():
    many = [Obstacle(kind="post", east_m=6.0 * k, north_m=20.0) for k in range(40)]
    scenes = [scene_of(site(*many, Obstacle(kind="post", east_m=float(k), north_m=0.0))) for k in range(SCENES + 40)]
    with World(scenes[0]) as world:
        counts = []
        for scene in scenes * 2:
            world.furnish(scene)
            world.add_actor(ObstacleKind.PERSON)
            counts.append(world.bodies)
        assert max(counts) == counts[-1] == 1 + 3 * SCENES + 1
