"""A gymnasium environment is a scenario made steppable: the same drive, to the byte, and what the checkers ask for."""

import math
import resource
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from autonomy.policy import Network, save_policy
from autonomy.wiring import load_stack
from rtdb.recording import Recording
from scenarios.gym import IDS, CartEnv, run_module
from scenarios.randomise import RANGES, Randomised
from scenarios.referee import TERMS, Reward
from scenarios.run import Setup, drive
from scenarios.scenario import load_scenario

NAMED = [name for name in IDS if name != "Fairway/Scenario-v0"]
REASON = "the extra 'learn' is not installed: stable-baselines3, torch, jupytext"
WALL = """\
id: test/wall
about: A wall across the way.
site: pad
course: {speed_mps: 2.0, waypoints: [{east_m: 40, north_m: 0, radius_m: 1}]}
obstacles: [{kind: wall, east_m: 12, north_m: 0, yaw_deg: 90}]
duration_s: 30
criteria: {waypoints_missed: "== 0"}
"""


@pytest.fixture
def loop() -> Iterator[CartEnv]:
    env = CartEnv("campus/loop")
    yield env
    env.close()


def pursue(env: CartEnv, observation: Any) -> np.ndarray[Any, Any]:
    """Drive by hand: steer to a point of the line ahead, at the line's speed."""
    numbers = (np.asarray(observation, dtype=float) + 1.0) / 2.0
    names = [f.name for f in env.features]
    at = {name: sum(f.size for f in env.features[:k]) for k, name in enumerate(names)}
    x_m, y_m = (numbers[at["ahead"] + k] * 24.0 - 12.0 for k in (4, 5))
    speed_mps = numbers[at["line"] + 2] * 10.0 - 5.0
    steer_rad = math.atan(1.66 * 2.0 * y_m / max(x_m * x_m + y_m * y_m, 0.1))
    return np.array([2.0 * speed_mps / 3.0 - 1.0, steer_rad / 0.46]).clip(-1.0, 1.0)


# -- what the checkers ask for --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMED)
def test_gymnasiums_checker_passes_without_a_warning(name: str) -> None:
    env = gymnasium.make(f"scenarios.gym:{name}")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize("name", NAMED)
def test_stable_baselines_checker_passes_without_a_warning(name: str) -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason=REASON)
    env = gymnasium.make(name)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize("agent", ["driver", "pedals", "localise", "follow"])
@pytest.mark.parametrize("observation", ["flat", "dict"])
@pytest.mark.parametrize("tier", ["sensors", "truth"])
def test_checker_passes_for_each_agent_form_and_tier(agent: str, observation: str, tier: str, straight: str) -> None:
    env = gymnasium.make(
        "Fairway/Scenario-v0", scenario=straight, agent=agent, observation=observation, tier=tier, randomise="wide"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)
    env.close()


@pytest.mark.parametrize("agent", ["plan", "follow", "localise", "avoid"])
def test_every_module_of_the_stack_with_obstacles_can_be_the_agent(agent: str) -> None:
    env = CartEnv("obstacles/field", agent)
    observation, _ = env.reset(seed=1)
    assert env.observation_space.contains(observation)
    for _ in range(5):
        observation, _, terminated, _, _ = env.step(np.zeros(env.seat.n_actions))
        assert env.observation_space.contains(observation)
        assert not terminated
    env.close()


@pytest.mark.parametrize("mode", ["sync", "async"])
@pytest.mark.parametrize("autoreset", list(AutoresetMode))
def test_vector_environments_work_in_every_autoreset_mode(mode: str, autoreset: AutoresetMode, straight: str) -> None:
    envs = gymnasium.make_vec(
        "Fairway/Scenario-v0",
        num_envs=2,
        vectorization_mode=mode,
        vector_kwargs={"autoreset_mode": autoreset},
        scenario=straight,
        agent="driver",
    )
    first, _ = envs.reset(seed=3)
    assert first.shape == (2, envs.single_observation_space.shape[0])
    ended = 0
    action = np.tile([[1.0, 1.0]], (2, 1))  # at full speed in a circle: off the course
    for _ in range(60):
        _, _, terminated, truncated, _ = envs.step(action)
        done = terminated | truncated
        ended += int(done.sum())
        if done.any() and autoreset is AutoresetMode.DISABLED:
            envs.reset(options={"reset_mask": done})
    assert ended >= 2
    envs.close()


def test_environment_is_made_again_from_its_spec(straight: str) -> None:
    env = gymnasium.make("Fairway/Scenario-v0", scenario=straight, agent="driver", tier="truth")
    assert env.spec is not None
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    a, b = env.reset(seed=4)[0], again.reset(seed=4)[0]
    assert np.array_equal(a, b)
    assert again.unwrapped.tier == "truth"  # type: ignore[attr-defined]
    env.close()
    again.close()


def test_step_gives_fresh_arrays_and_plain_python_values(loop: CartEnv) -> None:
    a, info = loop.reset(seed=1)
    kept = np.array(a)
    b, reward, terminated, truncated, second = loop.step(loop.action_space.sample())
    assert a is not b
    assert np.array_equal(a, kept)
    assert info is not second
    assert (type(reward), type(terminated), type(truncated)) == (float, bool, bool)


# -- the same drive ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("placement", ["inline", "process"])
def test_episode_with_a_module_is_the_scenario_with_it_in_the_stack(
    placement: Any, straight: str, tmp_path: Path
) -> None:
    env = gymnasium.make("Fairway/Scenario-v0", scenario=straight, agent="follow")
    mine = run_module(env, "autonomy.follow:Follow", 7, tmp_path / "env.mcap", placement)
    env.close()
    drive(Setup(scenario=load_scenario(straight), seed=7, level="direct"), tmp_path / "drive.mcap")
    theirs = Recording(tmp_path / "drive.mcap")
    assert theirs.last_cycle > 400
    assert mine == theirs.trace_hash()


def test_module_leaves_no_recording_but_its_own_and_ends_the_episode_under_way(straight: str, tmp_path: Path) -> None:
    env = CartEnv(straight, record=str(tmp_path / "episodes"))
    env.reset(seed=1)
    env.step(np.zeros(2))
    run_module(env, "autonomy.follow:Follow", 7, tmp_path / "module.mcap")
    assert [path.stem for path in (tmp_path / "episodes").iterdir()] == ["test-straight-1-1"]
    assert Recording(env.recording).last_cycle > 0
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2))
    env.close()


@pytest.mark.parametrize("recorded", [True, False])
def test_reset_that_fails_leaves_no_episode(
    recorded: bool, straight: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = CartEnv(straight, seeds=1, record=str(tmp_path) if recorded else None)
    env.reset(seed=1)
    with monkeypatch.context() as patch:
        patch.setattr(env, "setup_of", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            env.reset(seed=2)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2))
    env.reset(seed=2)
    env.step(np.zeros(2))
    env.close()


@pytest.mark.parametrize("level", ["direct", "wire"])
def test_policys_episode_is_the_drive_with_the_policy_in_the_stack(level: Any, straight: str, tmp_path: Path) -> None:
    weight = np.random.default_rng(1).normal(0.0, 0.02, (2, 28))
    weight[1, 15] = 4.0  # y of the fifth point ahead
    network = Network([(weight, np.array([0.3, 0.0]), "tanh")])
    save_policy(tmp_path / "some.policy", "follow", 0.04, network)
    env = CartEnv(straight, "follow", level=level, randomise="mild", record=str(tmp_path))
    observation, _ = env.reset(seed=2)
    over = False
    while not over:
        observation, _, terminated, over, _ = env.step(network(observation))
        assert not terminated
    env.close()
    plan = load_scenario(straight)
    stack = load_stack(plan.stack_path()).use("follow", str(tmp_path / "some.policy"))
    drive(Setup(scenario=plan, seed=2, level=level, stack=stack, randomise="mild"), tmp_path / "drive.mcap")
    a, b = Recording(env.recording), Recording(tmp_path / "drive.mcap")
    assert a.last_cycle == b.last_cycle
    assert a.trace_hash() == b.trace_hash()


def test_both_levels_give_the_same_observations(straight: str) -> None:
    seen = []
    for level in ("direct", "wire"):
        env = CartEnv(straight, "driver", level=level)  # type: ignore[arg-type]
        rows = [env.reset(seed=5)[0]]
        for k in range(40):
            observation, reward, *_ = env.step(np.array([0.5, 0.2 * math.sin(k)]))
            rows += [observation, np.array([reward])]
        seen.append(np.concatenate(rows))  # type: ignore[arg-type]
        env.close()
    assert np.array_equal(seen[0], seen[1])


def episode(env: CartEnv, seed: int, steps: int) -> list[Any]:
    """Give all that an episode shows."""
    observation, info = env.reset(seed=seed)
    out: list[Any] = [np.array(observation), info]
    for _ in range(steps):
        observation, reward, terminated, truncated, info = env.step(pursue(env, observation))
        out += [np.array(observation), reward, terminated, truncated, info]
    return out


def same(a: list[Any], b: list[Any]) -> bool:
    return all(np.array_equal(x, y) if isinstance(x, np.ndarray) else x == y for x, y in zip(a, b, strict=True))


def test_warm_episode_is_the_cold_one(loop: CartEnv) -> None:
    cold = episode(loop, 3, 80)
    episode(loop, 4, 20)
    assert same(episode(loop, 3, 80), cold)  # warm
    fresh = CartEnv("campus/loop")
    assert same(episode(fresh, 3, 80), cold)
    fresh.close()


def test_episode_begins_with_an_enabled_cart_and_a_fix(loop: CartEnv) -> None:
    _, info = loop.reset(seed=0)
    assert 0.2 < info["time_s"] < 1.0
    for _ in range(30):
        _, _, _, _, info = loop.step(np.array([1.0, 0.0]))
    assert loop._drive is not None
    assert loop._drive.sim.plant.state.vx_mps > 0.5


def test_reset_without_a_seed_draws_from_so_many_episodes(straight: str) -> None:
    env = CartEnv(straight, "driver", seeds=3)
    env.reset(seed=100)
    drawn = {env.reset()[1]["seed"] for _ in range(30)}
    assert drawn == {0, 1, 2}
    env.close()


def test_memory_does_not_grow_from_episode_to_episode(straight: str) -> None:
    env = CartEnv(straight, "driver", seeds=4)
    for k in range(60):
        env.reset(seed=k % 4)
        env.step(np.zeros(2))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for k in range(600):
        env.reset(seed=k % 4)
        env.step(np.zeros(2))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 4000  # kB
    env.close()


# -- rewards and ends -------------------------------------------------------------------------------------------------


def test_reward_is_the_sum_of_named_terms_and_stands_in_the_recording(straight: str, tmp_path: Path) -> None:
    env = CartEnv(straight, "follow", record=str(tmp_path))
    observation, info = env.reset(seed=1)
    assert tuple(info["reward_terms"]) == TERMS
    rewards, over = [], False
    while not over:
        observation, reward, terminated, over, info = env.step(pursue(env, observation))
        rewards.append(reward)
        assert not terminated
        assert reward == pytest.approx(sum(info["reward_terms"].values()))
    env.close()
    assert info["arrived"]
    told = Recording(env.recording).find("referee/reward", Reward)
    assert [row.value.total for row in told] == rewards[: len(told)]
    assert len(told) >= len(rewards) - 1
    assert sum(row.value.progress for row in told) == pytest.approx(15.0, abs=1.0)


def ended(env: CartEnv, action: list[float]) -> tuple[bool, bool, dict[str, Any]]:
    env.reset(seed=0)
    while True:
        _, _, terminated, truncated, info = env.step(np.array(action))
        if terminated or truncated:
            return terminated, truncated, info


def test_leaving_the_course_terminates(straight: str) -> None:
    env = CartEnv(straight, "follow")
    terminated, truncated, info = ended(env, [1.0, 0.8])
    env.close()
    assert (terminated, truncated, info["end"]) == (True, False, "off course")
    assert info["reward_terms"]["ended"] == -10.0


def test_time_truncates(straight: str) -> None:
    env = CartEnv(straight, "follow")
    terminated, truncated, info = ended(env, [-1.0, 0.0])
    env.close()
    assert (terminated, truncated, info["end"]) == (False, True, "")
    assert info["time_s"] == pytest.approx(12.0)


def test_collision_terminates(tmp_path: Path) -> None:
    (tmp_path / "wall.scenario.yaml").write_text(WALL)
    env = CartEnv(str(tmp_path / "wall.scenario.yaml"), "driver")
    terminated, truncated, info = ended(env, [1.0, 0.0])
    env.close()
    assert (terminated, truncated, info["end"]) == (True, False, "collision")


# -- randomisation, observations, pictures ----------------------------------------------------------------------------


def randomised(straight: str, folder: Path, kind: Any, seed: int) -> Randomised:
    env = CartEnv(straight, "driver", randomise=kind, record=str(folder))
    env.reset(seed=seed)
    env.close()
    value: Randomised = Recording(env.recording).find("world/randomised", Randomised)[0].value
    return value


@pytest.mark.parametrize("kind", ["mild", "wide"])
def test_randomisation_comes_from_the_seed_and_stands_in_the_recording(
    kind: str, straight: str, tmp_path: Path
) -> None:
    drawn = [randomised(straight, tmp_path, kind, seed) for seed in (1, 1, 2)]
    assert drawn[0] == drawn[1] != drawn[2]
    for name in Randomised.__struct_fields__:
        low, high = getattr(RANGES[kind], name)
        assert low <= getattr(drawn[0], name) <= high


def test_randomisation_changes_how_the_cart_drives(straight: str) -> None:
    ends = []
    for kind in ("none", "wide"):
        env = CartEnv(straight, "driver", randomise=kind)  # type: ignore[arg-type]
        env.reset(seed=1)
        for _ in range(30):
            env.step(np.array([1.0, 0.1]))
        assert env._drive is not None
        ends.append(env._drive.sim.plant.state.x_m)
        env.close()
    assert abs(ends[0] - ends[1]) > 0.01


def test_dict_observation_is_the_flat_one_in_units(straight: str) -> None:
    flat, named = CartEnv(straight, "driver"), CartEnv(straight, "driver", observation="dict")
    a, b = flat.reset(seed=2)[0], named.reset(seed=2)[0]
    assert isinstance(b, dict)
    assert [f["name"] for f in named.description] == list(b)
    scaled = [2.0 * (b[f.name] - f.low) / (f.high - f.low) - 1.0 for f in named.features]
    assert np.allclose(a, np.concatenate(scaled), atol=1e-6)  # type: ignore[arg-type]
    flat.close()
    named.close()


def test_picture_shows_the_cart_and_its_line(loop: CartEnv) -> None:
    env = CartEnv("campus/loop", render_mode="rgb_array")
    env.reset(seed=0)
    image = env.render()
    assert image.shape == (480, 640, 3)
    assert image.dtype == np.uint8
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 5
    env.close()


def test_mode_rerun_leaves_a_file_of_each_episode(straight: str, tmp_path: Path) -> None:
    env = CartEnv(straight, "driver", render_mode="rerun", record=str(tmp_path))
    for seed in (1, 2):
        env.reset(seed=seed)
        for _ in range(5):
            env.step(np.zeros(2))
    assert env.render() is None
    env.close()
    assert len(list(tmp_path.glob("*.rrd"))) == 2


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"agent": "pilot"}, "agent='pilot': there are driver"),
        ({"agent": "avoid"}, "the stack of campus/loop has localise, follow, guard"),
        ({"level": "os"}, "level='os'"),
        ({"tier": "all"}, "tier='all'"),
        ({"randomise": "wild"}, "randomise='wild'"),
        ({"scenario": "campus/lop"}, "did you mean campus/loop"),
    ],
)
def test_wrong_arguments_are_named_in_one_line(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=r".") as error:
        CartEnv(**wrong)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_wrong_action_is_refused_and_harms_nothing(loop: CartEnv) -> None:
    loop.reset(seed=1)
    for action in ([math.nan, 0.0], [0.0], [[0.0, 0.0]]):
        with pytest.raises(ValueError, match="2 finite numbers"):
            loop.step(np.array(action))
    loop.step(np.array([0.0, 0.0]))


def test_step_before_reset_is_an_error(loop: CartEnv) -> None:
    with pytest.raises(gymnasium.error.ResetNeeded):
        loop.step(np.zeros(2))
