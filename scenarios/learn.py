"""Learning: from a policy of stable-baselines3 to a policy file, and how well somebody drives on held-out seeds.

Training itself is stable-baselines3's (extra `learn`); `notebooks/follow_the_loop.py` shows it. What drives needs
neither it nor torch: `evaluate` takes a policy file, a function of observations, or a module of the stack.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numpy as np

from autonomy.features import described
from autonomy.loading import POLICY
from autonomy.policy import CLIP, Network, read_policy, save_policy
from autonomy.seats import MAX_STEER_RAD, SEATS
from hal.signals import DriveCommand, Pose

from .gym import CartEnv, go_on
from .referee import End
from .run import Drive

if TYPE_CHECKING:
    from stable_baselines3 import PPO

MISSING = (
    "stable-baselines3 is not installed; install the extra: pip install 'fairway-cart[learn]'; the CPU build of torch "
    "is enough, and much smaller"
)
EPSILON = 1e-8  # of the variance, in Network
Act = Callable[[np.ndarray[Any, Any]], Any]


class LearnError(RuntimeError):
    """What was trained cannot be exported, or nothing can be trained here."""


# -- export ---------------------------------------------------------------------------------------------------------


def export(model: "PPO", env: Any, path: Path, about: str = "") -> None:
    """Write what a model has learned in an environment (or a vector of them, normalised or not) into a policy file.

    It acts as the model does when asked for its best action. The file is read back: what is written can be driven.
    """
    agent, dt_s, description = (_of(env, name) for name in ("agent", "dt_s", "description"))
    if description != described(SEATS[agent].sees) or len(model.observation_space.shape or ()) != 1:
        raise LearnError(
            f"a policy file sees what the seat {agent} sees; train it with observation='flat', tier='sensors'"
        )
    save_policy(path, agent, dt_s, network_of(model, env), about)
    try:
        read_policy(path)
    except Exception:
        path.unlink()
        raise


def network_of(model: "PPO", env: Any = None) -> Network:
    """Give the network that chooses a model's best action; env: the one whose normalisation it was trained behind."""
    try:
        from stable_baselines3.common.vec_env import unwrap_vec_normalize
        from torch import nn
    except ImportError as error:
        raise LearnError(MISSING) from error

    activations = {nn.Tanh: "tanh", nn.ReLU: "relu"}
    policy: Any = model.policy
    if type(policy).__name__ != "ActorCriticPolicy" or policy.squash_output:
        raise LearnError(f"only PPO with an MlpPolicy, not squashed, can be exported; got {type(policy).__name__}")
    layers: list[tuple[Any, Any, str]] = []
    for part in [*policy.mlp_extractor.policy_net, policy.action_net]:
        if isinstance(part, nn.Linear):
            weight, bias = (p.detach().cpu().double().numpy() for p in (part.weight, part.bias))
            layers.append((weight, bias, "identity"))
        elif type(part) in activations:
            weight, bias, _ = layers.pop()
            layers.append((weight, bias, activations[type(part)]))
        else:
            raise LearnError(f"a policy file has layers Linear, Tanh, ReLU; this model has {type(part).__name__}")
    scaling: Any = unwrap_vec_normalize(env) if hasattr(env, "num_envs") else None
    if scaling is None or not scaling.norm_obs:
        return Network(layers)
    if scaling.clip_obs != CLIP or scaling.epsilon != EPSILON:
        raise LearnError(f"VecNormalize with clip_obs={CLIP:g} and epsilon={EPSILON:g} can be exported, no other")
    return Network(layers, scaling.obs_rms.mean.astype(np.float64), scaling.obs_rms.var.astype(np.float64))


def _of(env: Any, name: str) -> Any:
    """Give an attribute of the environment, or of the first one of a vector."""
    return env.get_attr(name)[0] if hasattr(env, "num_envs") else getattr(env.unwrapped, name)


# -- evaluation -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Episode:
    """How one episode went."""

    seed: int
    reward: float  # its sum
    arrived: bool
    end: str  # why it was terminated, empty if it was not
    aside_rms_m: float  # true distance from the line
    time_s: float  # of the drive, until the cart arrived or the episode was over


def evaluate(agent: str | Path | Act, env_id: str, seeds: Iterable[int], **kwargs: Any) -> list[Episode]:
    """Let somebody drive the episodes of some seeds, each cold, as in a drive.

    agent: a policy file, a function from observation to action, or a module that takes the agent's place in the stack
    (FILE.py:Class), which is judged from its first step on; kwargs: of `gymnasium.make`.
    """
    env = gymnasium.make(env_id, **kwargs)
    cart = env.unwrapped
    assert isinstance(cart, CartEnv)
    try:
        if isinstance(agent, str | Path) and not str(agent).endswith(POLICY):
            return [_sum_up(seed, _driven(cart, str(agent), seed)) for seed in seeds]
        act = agent if callable(agent) else _policy(Path(agent), cart)
        return [_sum_up(seed, _stepped(env, act, seed)) for seed in seeds]
    finally:
        env.close()


def _policy(path: Path, cart: CartEnv) -> Act:
    seat, network, document = read_policy(path)
    step_s = document["task"]["step_s"]
    if (seat, step_s) != (cart.agent, cart.dt_s):
        raise LearnError(
            f"{path} was trained as {seat}, a step every {step_s:g} s; here it is {cart.agent}, every {cart.dt_s:g} s"
        )
    return network


class _Judged(NamedTuple):
    """What the referee said after a step."""

    reward: float
    aside_m: float
    arrived: bool
    end: str
    time_s: float


def _stepped(env: gymnasium.Env[Any, Any], act: Act, seed: int) -> Iterator[_Judged]:
    """Drive by `env.step`."""
    cart = env.unwrapped
    assert isinstance(cart, CartEnv)
    observation, _ = env.reset(seed=seed)
    over = False
    while not over:
        observation, reward, terminated, truncated, info = env.step(act(observation))
        over = terminated or truncated
        yield _Judged(float(reward), cart.referee.aside_m, info["arrived"], info["end"], info["time_s"])


def _driven(cart: CartEnv, module: str, seed: int) -> Iterator[_Judged]:
    """Drive with a module, and a referee beside it."""
    cart.forget()  # there is one world: this drive takes it from their episodes
    with Drive(cart.setup_of(seed, cart.stack.use(cart.agent, module))) as drive:
        assert drive.agent is not None
        over, end = go_on(drive), End.NONE
        referee = cart.make_referee(drive)
        while not (over or end is not End.NONE):
            drive.agent.finish()
            over = go_on(drive)
            steering, pose = _given(drive)
            reward, end = referee.judge(cart.dt_s, steering, pose if cart.agent == "localise" else None)
            yield _Judged(reward.total, referee.aside_m, referee.arrived, str(end), drive.time_s)


def _given(drive: Drive) -> tuple[float, Pose | None]:
    """Give what the agent's last step asked of the steering, as an action, and its pose, if it gives one."""
    assert drive.agent is not None
    given = drive.agent.module._out.values()
    steering = next((out.steer_rad / MAX_STEER_RAD for out in given if isinstance(out, DriveCommand)), 0.0)
    return steering, next((out for out in given if isinstance(out, Pose)), None)


def _sum_up(seed: int, steps: Iterable[_Judged]) -> Episode:
    all_steps = list(steps)
    arrival = next((step for step in all_steps if step.arrived), all_steps[-1])
    return Episode(
        seed=seed,
        reward=sum(step.reward for step in all_steps),
        arrived=arrival.arrived,
        end=all_steps[-1].end,
        aside_rms_m=math.sqrt(sum(step.aside_m**2 for step in all_steps) / len(all_steps)),
        time_s=arrival.time_s,
    )


def summary(rows: Mapping[str, Sequence[Episode]]) -> str:
    """Give a Markdown table: who drove, and the mean over the episodes."""
    lines = [
        "| who | arrived | return | distance from the line, RMS | time to arrive |",
        "| --- | --- | --- | --- | --- |",
    ]
    for who, episodes in rows.items():
        arrived = [episode for episode in episodes if episode.arrived]
        time = f"{_mean([episode.time_s for episode in arrived]):.1f} s" if arrived else "-"
        aside_m = math.sqrt(_mean([episode.aside_rms_m**2 for episode in episodes]))
        reward = _mean([episode.reward for episode in episodes])
        lines.append(f"| {who} | {len(arrived)} of {len(episodes)} | {reward:.1f} | {aside_m:.2f} m | {time} |")
    return "\n".join(lines) + "\n"


def _mean(numbers: Sequence[float]) -> float:
    return sum(numbers) / len(numbers)
