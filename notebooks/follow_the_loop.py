# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Follow the loop
#
# A golf cart is to drive once round a campus path, between kerbs. First you drive it by a rule of three lines, then a
# network learns to do it. Both are judged on drives that nobody has trained on. In the end the network is a file that
# takes the follower's place in the cart.
#
# The first half needs nothing beside Fairway. The second half needs `pip install 'fairway-cart[learn]'`; the CPU build
# of torch is enough. Open this file in Jupyter (with jupytext it is a notebook), or run it:
#
#     python notebooks/follow_the_loop.py
#
# `FAIRWAY_NOTEBOOK_STEPS=2000` makes it a matter of a minute. Then nothing is learned, but everything is run.

# %%
import os
import re
import sys
import time
from pathlib import Path

import gymnasium
import numpy as np
from PIL import Image

from scenarios.learn import MISSING, evaluate, export, summary

FULL = 150_000
STEPS = int(os.environ.get("FAIRWAY_NOTEBOOK_STEPS", FULL))
LOOP = "scenarios.gym:Fairway/Loop-v0"
HELD_OUT = range(1000, 1010) if STEPS >= FULL else range(1000, 1001)
FOLDER = Path("runs") / "learn"
FOLDER.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## The task
#
# The environment is a scenario, `campus/loop`. The stack of the cart is in it: a localiser that estimates the pose from
# GPS, wheels and compass, a guard that may stop the cart, and between them the follower. The follower is you. 25 times
# a second you see numbers and choose an action. The seed of a drive says where the cart really stands at the start, and
# how wrong its sensors are.

# %%
env = gymnasium.make(LOOP, render_mode="rgb_array")
cart = env.unwrapped
observation, info = env.reset(seed=1000)
for feature in cart.features:
    print(f"{feature.name:8} {feature.size:3} numbers from {feature.low:g} to {feature.high:g}: {feature.doc}")
print(f"a step is {cart.dt_s * 1000:.0f} ms; the observation has {observation.size} numbers, scaled to [-1, 1]")
print(f"an action: {cart.action_space}: {cart.seat._command.__doc__}")

# %%
picture = Image.fromarray(env.render())
picture.save(FOLDER / "start.png")
picture

# %% [markdown]
# ## A rule
#
# Pure pursuit: steer on the circle that leads through a point of the line some metres ahead. The points ahead are in
# the observation, seen from the cart: x ahead, y to the left. So is the speed that the line allows here.

# %%
WHERE = {f.name: (sum(g.size for g in cart.features[:k]), f) for k, f in enumerate(cart.features)}
WHEELBASE_M, FULL_LOCK_RAD, FULL_SPEED_MPS = 1.66, 0.46, 3.0


def group(observation, name):
    """Give the numbers of one feature, in their units."""
    first, feature = WHERE[name]
    scaled = np.asarray(observation[first : first + feature.size], dtype=float)
    return feature.low + (scaled + 1) / 2 * (feature.high - feature.low)


def pursue(observation):
    """Choose speed and steering, both in [-1, 1]."""
    x_m, y_m = group(observation, "ahead").reshape(-1, 2)[2]  # three metres on
    _, _, allowed_mps = group(observation, "line")
    steer_rad = np.arctan(WHEELBASE_M * 2 * y_m / max(x_m**2 + y_m**2, 0.1))
    return np.clip([2 * allowed_mps / FULL_SPEED_MPS - 1, steer_rad / FULL_LOCK_RAD], -1, 1)


# %% [markdown]
# An episode is a drive. The reward of a step is a sum of terms; metres gained along the line are the largest. Aside of
# the line, restless steering and jerks cost a little; a kerb ends the episode and costs 10.

# %%
terms = dict.fromkeys(info["reward_terms"], 0.0)
over = False
while not over:
    observation, reward, terminated, truncated, info = env.step(pursue(observation))
    terms = {name: terms[name] + value for name, value in info["reward_terms"].items()}
    over = terminated or truncated
    if STEPS < FULL and info["time_s"] > 20:
        break
print(f"after {info['time_s']:.1f} s: arrived {info['arrived']}, return {sum(terms.values()):.1f}")
print({name: round(value, 1) for name, value in terms.items()})

# %% [markdown]
# ## Learning
#
# PPO tries actions beside those that its network thinks best, and makes those likelier that brought more than expected.
# Two carts drive in turn. Their seeds are 0 to 31.
#
# What is worth knowing about the numbers:
#
# - `gamma=0.98`: the next 50 steps count, two seconds. To follow a line nobody has to look further.
# - Observations and rewards are scaled by their running statistics. Half a metre aside is 0.1 otherwise, and unseen.
# - `log_std_init=-1.5`: it tries steering angles some 6 degrees around the best one. With more, the cart shakes.
# - Short rollouts: the policy is improved after 1,024 steps already.

# %%
try:
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize
except ImportError:
    sys.exit(MISSING)

torch.set_num_threads(1)
carts = VecNormalize(make_vec_env(LOOP, n_envs=2, seed=0), gamma=0.98)
model = PPO(
    "MlpPolicy",
    carts,
    n_steps=512,
    batch_size=128,
    n_epochs=10,
    gamma=0.98,
    learning_rate=lambda left: 1e-4 + 1e-3 * left,
    policy_kwargs={"net_arch": [64, 64], "log_std_init": -1.5},
    seed=0,
    device="cpu",
)
returns = []


def note(here, _):
    """Keep the return of each episode that is over, and say every tenth."""
    for episode in (i["episode"] for i in here["infos"] if "episode" in i):
        returns.append(episode["r"])
        if len(returns) % 10 == 1:
            step, driven_s = here["self"].num_timesteps, episode["l"] * cart.dt_s
            print(f"step {step:7,}: an episode of {driven_s:3.0f} s, return {returns[-1]:.1f}")
    return True


begun = time.perf_counter()
model.learn(STEPS, callback=note)
minutes = (time.perf_counter() - begun) / 60
print(f"{len(returns)} episodes, {minutes:.1f} minutes")

# %% [markdown]
# ## Into a file
#
# A policy file holds the network, what the observation means, its scaling, and what an action means. Without torch it
# is a chain of small matrix products. Whoever loads it checks that all of this fits.

# %%
policy = FOLDER / "loop.policy"
export(model, carts, policy, about=f"PPO, {STEPS} steps on campus/loop")
print(f"{policy}: {policy.stat().st_size} bytes")

# %% [markdown]
# ## Who drives better?
#
# All drive the same seeds, which were not among those of the training. The distance from the line is the true one. The
# cart knows its place to half a metre or so; hence nobody comes near zero.

# %%
table = summary(
    {
        "reference follower": evaluate("autonomy.follow:Follow", LOOP, HELD_OUT),
        "the rule above": evaluate(pursue, LOOP, HELD_OUT),
        f"learned, {STEPS:,} steps": evaluate(policy, LOOP, HELD_OUT),
    }
)
print(table)

# %% [markdown]
# ## In the cart
#
# `fairway drive campus/loop --use follow=runs/learn/loop.policy` puts the file into the stack. That is not a replay:
# the network is a module there, in the place of the follower. Yet the drive of a seed is the same as the episode of
# that seed, to the last byte of what is recorded.

# %%
from autonomy.policy import read_policy
from autonomy.wiring import load_stack
from rtdb.recording import Recording
from scenarios.diff import first_difference
from scenarios.run import Setup, drive
from scenarios.scenario import load_scenario

_, network, _ = read_policy(policy)
recorded = gymnasium.make(LOOP, record=str(FOLDER))
observation, _ = recorded.reset(seed=1000)
over = False
while not over:
    observation, _, terminated, truncated, _ = recorded.step(network(observation))
    over = terminated or truncated
episode = Recording(recorded.unwrapped.recording)
recorded.close()

scenario = load_scenario("campus/loop")
stack = load_stack(scenario.stack_path()).use("follow", str(policy))
drive(Setup(scenario=scenario, seed=1000, level="direct", stack=stack), FOLDER / "drive.mcap")
driven = Recording(FOLDER / "drive.mcap")

print(f"episode {episode.trace_hash()}\ndrive   {driven.trace_hash()}")
if terminated:  # a drive goes on where the referee ends an episode; up to there they agree
    difference = first_difference(episode, driven)
    assert difference is None or difference.cycle > episode.last_cycle
else:
    assert episode.trace_hash() == driven.trace_hash()

# %% [markdown]
# ## Go on
#
# - Another task: `Fairway/Obstacles-v0`, `Fairway/GpsOutage-v0`, or a scenario of your own as `Fairway/Scenario-v0`.
# - `randomise="wide"`: other friction, loads, delays from seed to seed. Does the network that you have still arrive?
# - Change a weight in `scenarios/referee.py`. What does the cart do then, and did you mean that?

# %%
if "--write" in sys.argv:  # puts the table into the docs
    page = Path(__file__).parents[1] / "docs" / "learning.md"
    text = f"Training took {minutes:.1f} minutes; held-out seeds {HELD_OUT[0]} to {HELD_OUT[-1]}.\n\n{table}"
    place = re.compile(r"(<!-- measured -->\n).*?(<!-- end -->)", re.DOTALL)
    page.write_text(place.sub(lambda found: found[1] + text + found[2], page.read_text()))
env.close()
carts.close()
