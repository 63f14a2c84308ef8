"""What was trained is exported as it acts; what does not fit is refused; everybody is evaluated by the same referee."""

import json
import math
import zipfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from autonomy.module import ModuleError
from autonomy.policy import Network, read_policy, save_policy, task_hash
from autonomy.seats import SEATS
from autonomy.wiring import load_stack
from scenarios.gym import CartEnv
from scenarios.learn import Episode, LearnError, evaluate, export, summary
from scenarios.run import Setup, drive
from scenarios.scenario import load_scenario

REASON = "the extra 'learn' is not installed: stable-baselines3, torch, jupytext"
SCENARIO = "scenarios.gym:Fairway/Scenario-v0"
N_FOLLOW = sum(f.size for f in SEATS["follow"].sees)


def rule() -> Network:
    """Steers to the third point ahead by its y alone, at full speed: a linear network."""
    weight, bias = np.zeros((2, N_FOLLOW)), np.array([1.0, 0.0])
    weight[1, 6 + 5] = 12.0 * 2.0 * 1.66 / 9.0 / 0.46
    return Network([(weight, bias, "identity")])


# -- export ---------------------------------------------------------------------------------------------------------


class Blank(gymnasium.Env[np.ndarray[Any, Any], np.ndarray[Any, Any]]):
    """Looks like a cart's environment from outside: export asks for no more, and a step costs nothing."""

    agent, dt_s = "follow", 0.04

    def __init__(self, size: int = N_FOLLOW) -> None:
        env = CartEnv("campus/loop")
        self.description = env.description
        self.observation_space = gymnasium.spaces.Box(-1.0, 1.0, (size,), np.float32)
        self.action_space = env.action_space

    def reset(self, **kwargs: Any) -> Any:
        super().reset(**kwargs)
        return self._look(), {}

    def step(self, action: Any) -> Any:
        return self._look(), float(-abs(action).sum()), bool(self.np_random.random() < 0.02), False, {}

    def _look(self) -> np.ndarray[Any, Any]:
        shape = self.observation_space.shape
        return (0.3 * self.np_random.standard_normal(shape)).clip(-1.0, 1.0).astype(np.float32)


@pytest.fixture(scope="module")
def sb3() -> Any:
    pytest.importorskip("torch", reason=REASON).set_num_threads(1)
    return pytest.importorskip("stable_baselines3", reason=REASON)


def trained(sb3: Any, *, normalised: bool = True, sde: bool = False, **policy: Any) -> tuple[Any, Any]:
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    carts: Any = DummyVecEnv([Blank, Blank])
    if normalised:
        carts = VecNormalize(carts)
    model = sb3.PPO(
        "MlpPolicy",
        carts,
        n_steps=128,
        batch_size=64,
        learning_rate=1e-2,
        use_sde=sde,
        policy_kwargs=policy,
        seed=1,
        device="cpu",
    )
    return model.learn(512), carts


@pytest.mark.parametrize(
    ("normalised", "sde", "activation"), [(True, True, "Tanh"), (True, False, "ReLU"), (False, False, "Tanh")]
)
def test_exported_policy_acts_as_the_model_does(
    sb3: Any, tmp_path: Path, normalised: bool, sde: bool, activation: str
) -> None:
    import torch

    function = getattr(torch.nn, activation)
    model, carts = trained(sb3, normalised=normalised, sde=sde, net_arch=[64, 64], activation_fn=function)
    path = tmp_path / "a.policy"
    export(model, carts, path, about="a test")
    seat, network, document = read_policy(path)
    assert (seat, document["about"], document["task"]["step_s"]) == ("follow", "a test", 0.04)
    env = Blank()
    observation, _ = env.reset(seed=3)
    acted = []
    for _ in range(200):
        scaled = carts.normalize_obs(observation) if normalised else observation
        action, _ = model.predict(scaled, deterministic=True)
        assert network(observation) == pytest.approx(action, abs=1e-6)
        acted.append(action)
        observation, *_ = env.step(action)
    assert np.ptp(acted) > 0.1  # it does something


def test_same_policy_gives_the_same_file(sb3: Any, tmp_path: Path) -> None:
    model, carts = trained(sb3)
    for name in ("a.policy", "b.policy"):
        export(model, carts, tmp_path / name)
    assert (tmp_path / "a.policy").read_bytes() == (tmp_path / "b.policy").read_bytes()


def test_what_a_policy_file_cannot_hold_is_not_exported(sb3: Any, tmp_path: Path) -> None:
    import torch
    from stable_baselines3.common.vec_env import VecNormalize

    path = tmp_path / "a.policy"
    model, carts = trained(sb3, activation_fn=torch.nn.ELU)
    with pytest.raises(LearnError, match="has layers Linear, Tanh, ReLU; this model has ELU"):
        export(model, carts, path)
    model, carts = trained(sb3, normalised=False)
    with pytest.raises(LearnError, match="clip_obs=10"):
        export(model, VecNormalize(carts, clip_obs=5.0), path)
    with pytest.raises(LearnError, match="only PPO with an MlpPolicy"):
        export(sb3.SAC("MlpPolicy", Blank()), carts, path)
    with pytest.raises(LearnError, match="observation='flat', tier='sensors'"):
        export(model, CartEnv("campus/loop", tier="truth"), path)
    with torch.no_grad():
        model.policy.action_net.bias[0] = math.nan
    with pytest.raises(ModuleError, match="not finite"):
        export(model, carts, path)
    assert not path.exists()


# -- misfits --------------------------------------------------------------------------------------------------------


def refused(path: Path, straight: str, component: str = "follow") -> str:
    """Give the one line with which a drive refuses a policy."""
    scenario = load_scenario(straight)
    stack = load_stack(scenario.stack_path()).use(component, str(path))
    with pytest.raises(ModuleError) as error:
        drive(Setup(scenario=scenario, stack=stack), path.with_suffix(".mcap"))
    line = str(error.value)
    assert "\n" not in line
    assert len(line) < 400
    return line


def edited(path: Path, **changes: Any) -> None:
    """Change the task of a policy file, with a hash that agrees."""
    with zipfile.ZipFile(path) as file:
        document, weights = json.loads(file.read("policy.json")), file.read("weights.npz")
    document["task"] |= changes
    document["task_hash"] = task_hash(document["task"])
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("policy.json", json.dumps(document))
        file.writestr("weights.npz", weights)


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    path = tmp_path / "a.policy"
    save_policy(path, "follow", 0.04, rule())
    return path


def test_policy_of_other_observations_is_refused(policy: Path, straight: str) -> None:
    sees = [{"name": f.name, "size": f.size, "low": f.low, "high": f.high, "doc": f.doc} for f in SEATS["follow"].sees]
    edited(policy, observation=[*sees[:-1], {**sees[-1], "high": 2.0}])
    assert "it was trained on other observations" in refused(policy, straight)


def test_policy_whose_actions_meant_something_else_is_refused(policy: Path, straight: str) -> None:
    edited(policy, action_map="Throttle and steering.")
    assert "its actions meant something else: Throttle" in refused(policy, straight)


def test_policy_of_another_seat_is_refused(policy: Path, straight: str) -> None:
    assert "cannot find localise/pose" in refused(policy, straight, "localise")  # which the follower's seat looks for


def test_policy_of_a_seat_that_there_is_not_is_refused(policy: Path, straight: str) -> None:
    edited(policy, seat="bonnet")
    assert "its seat 'bonnet' is unknown" in refused(policy, straight)


def test_policy_of_another_pace_is_refused(tmp_path: Path, straight: str) -> None:
    path = tmp_path / "slow.policy"
    save_policy(path, "follow", 0.1, rule())
    scenario = load_scenario(straight)
    stack = load_stack(scenario.stack_path()).use("follow", str(path))
    with pytest.raises(ModuleError, match=r"slow.policy was made for a step every 0.1 s, here it is 0.04 s"):
        drive(Setup(scenario=scenario, stack=stack), tmp_path / "slow.mcap")
    with pytest.raises(LearnError, match=r"trained as follow, a step every 0.1 s; here it is follow, every 0.04 s"):
        evaluate(path, SCENARIO, [0], scenario=straight)


def test_damaged_file_is_refused(policy: Path, straight: str) -> None:
    whole = policy.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"no zip at all"):
        policy.write_bytes(damaged)
        assert "is no policy file" in refused(policy, straight)


def test_weights_that_are_no_numbers_are_refused(policy: Path, straight: str) -> None:
    network = rule()
    network.layers[0][0][0, 0] = math.nan
    save_policy(policy, "follow", 0.04, network)
    assert "the weights of layer 0 are not finite" in refused(policy, straight)


# -- evaluation -----------------------------------------------------------------------------------------------------


def test_policy_file_and_its_network_get_the_same_marks_by_step(policy: Path, straight: str) -> None:
    by_file = evaluate(policy, SCENARIO, [5], scenario=straight)
    assert by_file == evaluate(rule(), SCENARIO, [5], scenario=straight)
    (episode,) = by_file
    assert episode.arrived
    assert episode.end == ""
    assert 5.0 < episode.time_s < 12.0
    assert episode.reward > 15.0


def test_reference_follower_is_marked_by_the_same_referee(straight: str) -> None:
    follower = evaluate("autonomy.follow:Follow", SCENARIO, [5, 6], scenario=straight)
    seat = evaluate(rule(), SCENARIO, [5, 6], scenario=straight)
    assert [episode.seed for episode in follower] == [5, 6]
    for one, other in zip(follower, seat, strict=True):
        assert one.arrived
        assert one.reward == pytest.approx(other.reward, abs=2.0)
        assert one.aside_rms_m < 0.5


def test_progress_is_what_was_driven_in_each_step_and_arriving_is_coming_near_the_end(straight: str) -> None:
    env = CartEnv(straight)
    env.reset(seed=5)
    told, over = [], False
    while not over:
        _, _, _, over, info = env.step(np.array([1.0, 0.0]))
        told.append(info["reward_terms"] | {"left_m": 15.0 - env.referee._along_m})
    env.close()
    progress = np.array([terms["progress"] for terms in told])
    assert progress[50:100].min() > 0.02  # not in steps of the line's stations, half a metre apart
    assert progress.max() < 1.1 * 3.0 * 0.04
    assert 14.0 < progress.sum() < 15.6  # who rolls on behind the end of the line gains nothing
    (arrival,) = [terms for terms in told if terms["arrived"]]
    assert arrival["left_m"] == pytest.approx(1.0, abs=0.5)  # the way-point's radius


def test_who_stands_does_not_arrive(straight: str) -> None:
    (episode,) = evaluate(lambda _: np.array([-1.0, 0.0]), SCENARIO, [5], scenario=straight)
    assert (episode.arrived, episode.end, episode.time_s) == (False, "", pytest.approx(12.0))


def test_summary_is_a_table_of_means() -> None:
    episodes = [Episode(1, 10.0, True, "", 3.0, 20.0), Episode(2, 0.0, False, "collision", 4.0, 5.0)]
    assert summary({"me": episodes, "nobody": episodes[1:]}).splitlines()[2:] == [
        "| me | 1 of 2 | 5.0 | 3.54 m | 20.0 s |",
        "| nobody | 0 of 1 | 0.0 | 4.00 m | - |",
    ]


@pytest.fixture(autouse=True)
def _nothing_lies_about(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
