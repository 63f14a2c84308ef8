"""How fast the gymnasium environments step, reset and start, beside other environments and bare pybullet.

    python benchmarks/gym.py [--rounds 7] [--steps 400] [--long]

Steps per second of CPU time (time.process_time), all rows in turn, round by round. The yardstick of the same run is
bare pybullet: 24 steps at 240 Hz of one free 480 kg box, without gravity or contact, count as one step of 0.1 s.
Ratios are medians of the ratios of each round. Actions are found beforehand, by driving; every block of an environment
of ours begins at the same warm image and takes the same actions. --long: memory over 10,000 resets.
"""

import argparse
import json
import math
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]
sys.path[0] = str(ROOT)  # beside this file stands rtdb.py, which is not the package

import gymnasium
import numpy as np
import pybullet

import scenarios.gym  # noqa: F401 - registers the environments
from scenarios.gym import CartEnv
from scenarios.scenario import load_scenario

SEED = 7
RAYS = "laser: {rays: 32}\n"


class Row(NamedTuple):
    """What is measured: `block` takes some steps and gives how many, and the CPU seconds that they took."""

    name: str
    wanted: str
    step_s: float  # simulated time of a step
    block: Callable[[], tuple[int, float]]


# -- ours -----------------------------------------------------------------------------------------------------------


def pursue(cart: CartEnv, observation: Any) -> np.ndarray[Any, Any]:
    """Steer to a point of the line ahead, at the line's speed."""
    numbers = (np.asarray(observation, dtype=float) + 1.0) / 2.0
    at = {f.name: sum(g.size for g in cart.features[:k]) for k, f in enumerate(cart.features)}
    x_m, y_m = (numbers[at["ahead"] + k] * 24.0 - 12.0 for k in (4, 5))
    speed_mps = numbers[at["line"] + 2] * 10.0 - 5.0
    steer_rad = math.atan(1.66 * 2.0 * y_m / max(x_m * x_m + y_m * y_m, 0.1))
    return np.array([2.0 * speed_mps / 3.0 - 1.0, steer_rad / 0.46]).clip(-1.0, 1.0)


def ours(name: str, wanted: str, steps: int, env_id: str, **kwargs: Any) -> Row:
    """Make the row of one of our environments."""
    env = gymnasium.make(env_id, **kwargs)
    cart = env.unwrapped
    assert isinstance(cart, CartEnv)
    observation, _ = env.reset(seed=SEED)
    actions: list[np.ndarray[Any, Any]] = []
    over = False
    while len(actions) < steps and not over:
        actions.append(pursue(cart, observation))
        observation, _, terminated, truncated, _ = env.step(actions[-1])
        over = terminated or truncated

    def block() -> tuple[int, float]:
        env.reset(seed=SEED)
        begun = time.process_time()
        for action in actions:
            env.step(action)
        return len(actions), time.process_time() - begun

    return Row(f"{name}, {cart.level}", wanted, cart.dt_s, block)


def with_rays(folder: Path) -> str:
    """Write the field trial with a range scanner of 32 rays; returns its path."""
    text = next((ROOT / "scenarios" / "library").glob("p545/field-trial.scenario.yaml")).read_text()
    path = folder / "rays.scenario.yaml"
    path.write_text(text.rstrip("\n") + "\n" + RAYS)
    assert load_scenario(str(path)).laser is not None
    return str(path)


# -- beside it ------------------------------------------------------------------------------------------------------


def other(name: str, steps: int, step_s: float, env: gymnasium.Env[Any, Any]) -> Row:
    """Make the row of somebody else's environment: random actions, resets included."""
    env.reset(seed=SEED)
    env.action_space.seed(SEED)
    actions = [env.action_space.sample() for _ in range(steps)]

    def block() -> tuple[int, float]:
        env.reset(seed=SEED)
        begun = time.process_time()
        for action in actions:
            *_, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return len(actions), time.process_time() - begun

    return Row(name, "", step_s, block)


def yardstick() -> Row:
    """Make the row of bare pybullet."""
    client = pybullet.connect(pybullet.DIRECT)
    shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[1.2, 0.6, 0.5], physicsClientId=client)
    pybullet.createMultiBody(480.0, shape, physicsClientId=client)
    pybullet.setTimeStep(1 / 240, physicsClientId=client)

    def block() -> tuple[int, float]:
        begun = time.process_time()
        for _ in range(24 * 1000):
            pybullet.stepSimulation(physicsClientId=client)
        return 1000, time.process_time() - begun

    return Row("bare pybullet, 24 steps of a box", "", 0.1, block)


# -- tables ---------------------------------------------------------------------------------------------------------


def speed(rows: list[Row], rounds: int) -> None:
    """Print the table of steps per second; the last row is the yardstick."""
    rates: dict[str, list[float]] = {row.name: [] for row in rows}
    for _ in range(rounds):
        for row in rows:
            steps, cpu_s = row.block()
            rates[row.name].append(steps / cpu_s)
    bare = rates[rows[-1].name]
    print("| environment | wanted steps/s | steps/s of CPU, median / best | simulated s per CPU s, median | of bare |")
    print("| --- | --- | --- | --- | --- |")
    for row in rows:
        got = rates[row.name]
        median = statistics.median(got)
        ratio = statistics.median(rate / yard for rate, yard in zip(got, bare, strict=True))
        simulated = f"{median * row.step_s:,.0f}"
        print(f"| {row.name} | {row.wanted} | {median:,.0f} / {max(got):,.0f} | {simulated} | {ratio:.2f} |")


START = """
import json, sys, time
begun, begun_cpu = time.perf_counter(), time.process_time()
import gymnasium
env = gymnasium.make("scenarios.gym:Fairway/FieldTrial-v0", agent=sys.argv[1])
env.reset(seed=0)
took = time.perf_counter() - begun, time.process_time() - begun_cpu
print(json.dumps([*took, any(name.startswith("filterpy") for name in sys.modules)]))
"""


def start(times: int) -> None:
    """Print how long `import gymnasium`, make and the first reset take in a fresh process."""
    took: dict[str, list[list[float]]] = {"driver": [], "follow": []}
    for _ in range(times):
        for agent, rows in took.items():
            out = subprocess.run(
                [sys.executable, "-c", START, agent], cwd=ROOT, capture_output=True, text=True, check=True
            )
            rows.append(json.loads(out.stdout.splitlines()[-1]))
    print("\n| import, make, first reset in a fresh process | wanted | s, min / median | CPU s, min / median |")
    print("| --- | --- | --- | --- |")
    for agent, wanted in (("driver", "0.7"), ("follow", "1.5")):
        wall, cpu, filterpy = zip(*took[agent], strict=True)
        figures = " | ".join(f"{min(x):.2f} / {statistics.median(x):.2f}" for x in (wall, cpu))
        print(f"| agent {agent}, {'with' if any(filterpy) else 'without'} filterpy | ≤ {wanted} s | {figures} |")


def resets(long: bool) -> None:
    """Print how long a warm reset takes, and what resets leave behind."""
    print("\n| warm reset | median | best | RSS growth |")
    print("| --- | --- | --- | --- |")
    for env_id, kwargs in (
        ("Fairway/FieldTrial-v0", {"agent": "driver"}),
        ("Fairway/Loop-v0", {}),
    ):
        env = gymnasium.make(f"scenarios.gym:{env_id}", **kwargs)
        times = []
        for k in range(200):
            begun = time.perf_counter()
            env.reset(seed=k % 4)
            times.append(time.perf_counter() - begun)
        growth = "not measured: --long"
        if long:
            before_kb = 0
            for k in range(15_000):
                if k == 5_000:  # until then the allocator finds its size
                    before_kb = rss_kb()
                env.reset(seed=k % 4)
                env.step(np.zeros(2))
            growth = f"{rss_kb() - before_kb:+,} KiB over 10,000 resets"
        warm = times[8:]
        print(f"| {env_id} | {statistics.median(warm) * 1e3:.2f} ms | {min(warm) * 1e3:.2f} ms | {growth} |")
        env.close()


def rss_kb() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--steps", type=int, default=400, help="of a block")
    parser.add_argument("--long", action="store_true", help="also 10,000 resets")
    args = parser.parse_args()
    trial, loop = "scenarios.gym:Fairway/FieldTrial-v0", "scenarios.gym:Fairway/Loop-v0"
    with tempfile.TemporaryDirectory() as folder:
        rows = [
            ours("field trial, driver", "≥ 3,000", args.steps, trial, agent="driver"),
            ours("field trial, driver", "≥ 1,500", args.steps, trial, agent="driver", level="wire"),
            ours(
                "field trial, follow, localiser in the loop, 32 rays",
                "≥ 1,500",
                args.steps,
                "scenarios.gym:Fairway/Scenario-v0",
                scenario=with_rays(Path(folder)),
                agent="follow",
            ),
            ours("loop, follow, localiser in the loop", "", args.steps, loop),
            other("CartPole-v1", 10 * args.steps, 0.02, gymnasium.make("CartPole-v1")),
        ]
        try:
            import highway_env  # noqa: F401 - registers its environments
        except ImportError:
            print("highway-env is not installed: its row is missing\n")
        else:
            rows.append(other("highway-v0", 20, 1.0, gymnasium.make("highway-v0")))
        rows.append(yardstick())
        speed(rows, args.rounds)
    start(5)
    resets(args.long)


if __name__ == "__main__":
    main()
