"""Gymnasium environments: a scenario, made steppable. Importing this module registers them.

    env = gymnasium.make("scenarios.gym:Fairway/Loop-v0")                          # the agent is the follower
    env = gymnasium.make("scenarios.gym:Fairway/Scenario-v0", scenario="my.scenario.yaml", agent="driver")

One component of the stack, the agent, is asked from outside. A step is one of its steps: its action is committed as a
module's outputs are, and the rest of the cart goes on until it is due again. An episode is a drive of the scenario with
the episode's seed; it begins where the cart is enabled and has a first fix. `run_module` puts a module there instead,
and gives the trace of `fairway drive` with that module in the stack.
"""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, SupportsFloat

import gymnasium
import numpy as np

from autonomy.features import TRUTH, Feature, Flat, described
from autonomy.loading import make_module
from autonomy.module import ModuleError
from autonomy.seats import SEATS, Seat
from autonomy.wiring import Stack, stack_with
from hal.bus import Level
from hal.signals import Site as SiteRecord
from rtdb import HOST_DEPENDENT, Writer
from rtdb.recorder import Recorder
from sim.world import World

from .randomise import KINDS, Kind
from .referee import TERMS, End, Referee, Reward
from .run import TICK_NS, Drive, Setup, metadata
from .scenario import STACKS, load_scenario
from .warm import Image

if TYPE_CHECKING:
    from hal.signals import Scene

Observation = np.ndarray[Any, Any] | dict[str, np.ndarray[Any, Any]]
Action = np.ndarray[Any, Any]
READY_S = 5.0  # an episode begins by then, ready or not
OFF_COURSE_M = {"plan": 12.0, "avoid": 12.0}  # where going around something is the task
WHOLE = {"driver": "bare.json", "pedals": "pedals.json"}  # agents that replace the whole stack


class CartEnv(gymnasium.Env[Observation, Action]):
    """One scenario as an environment.

    scenario: id or path; agent: component to be replaced: follow, localise, plan, avoid, or for the whole stack driver
    (speed and steering) or pedals (throttle, brake, steering); level: direct or wire, with the same observations;
    observation: flat (one array in [-1, 1]) or dict (by name, in units); tier: sensors (what a module can know) or
    truth; randomise: none, mild, wide; seeds: how many different episodes `reset` without a seed draws from, each warm
    after its first time, 0 for a new one each time; use: swaps of other modules, COMPONENT=FILE.py:Class; record:
    folder for recordings, which begin cold.
    """

    metadata = {"render_modes": ["rgb_array", "rerun"], "render_fps": 25}  # noqa: RUF012 - as gymnasium has it

    def __init__(
        self,
        scenario: str = "campus/loop",
        agent: str = "follow",
        level: Level = "direct",
        observation: Literal["flat", "dict"] = "flat",
        tier: Literal["sensors", "truth"] = "sensors",
        randomise: Kind = "none",
        seeds: int = 32,
        use: Sequence[str] = (),
        record: str | None = None,
        render_mode: str | None = None,
    ) -> None:
        for name, value, known in (
            ("agent", agent, tuple(SEATS)),
            ("level", level, ("direct", "wire")),
            ("observation", observation, ("flat", "dict")),
            ("tier", tier, ("sensors", "truth")),
            ("randomise", randomise, KINDS),
            ("render_mode", render_mode, (None, *self.metadata["render_modes"])),
        ):
            if value not in known:
                raise ValueError(f"{name}={value!r}: there are {', '.join(map(str, known))}")
        self.render_mode, self.level, self.randomise, self.seeds = render_mode, level, randomise, seeds
        self.scenario, self.agent, self.tier = load_scenario(scenario), agent, tier
        path = STACKS / WHOLE[agent] if agent in WHOLE else self.scenario.stack_path()
        use = [use] if isinstance(use, str) else list(use)
        if any(swap.partition("=")[0] == agent for swap in use):
            raise ValueError(f"use={use!r}: {agent} is the agent, who is asked from outside; see run_module")
        self.stack = stack_with(path, use)
        wire = next((w for w in self.stack.wires if w.component == agent), None)
        if wire is None:
            names = ", ".join(w.component for w in self.stack.wires)
            raise ValueError(f"agent={agent!r}: the stack of {self.scenario.id} has {names}, or driver for all of it")
        self.stack = self.stack.use(agent, f"autonomy.seats:{SEATS[agent].__name__}")
        make_module(next(w for w in self.stack.wires if w.component == agent))
        self.dt_s = wire.every * TICK_NS * 1e-9
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / self.dt_s))}
        self.seat = SEATS[agent]
        self.features: tuple[Feature, ...] = (*self.seat.sees, *((TRUTH,) if tier == "truth" else ()))
        self.description = described(self.features)
        self._flat = Flat(self.features) if observation == "flat" else None
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.seat.n_actions,), np.float32)
        self.observation_space = self._space()
        self._record = Path(record) if record is not None else None
        self._world: World | None = None
        self._warm: OrderedDict[int, Image] = OrderedDict()
        self._drive: Drive | None = None
        self._recorder: Recorder | None = None
        self._episode = 0

    def _space(self) -> gymnasium.Space[Any]:
        if self._flat is not None:
            return gymnasium.spaces.Box(-1.0, 1.0, (self._flat.size,), np.float32)
        return gymnasium.spaces.Dict(
            {f.name: gymnasium.spaces.Box(f.low, f.high, (f.size,), np.float32) for f in self.features}
        )

    # -- gymnasium's side -------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode: that of `seed`, or one that is drawn. options: {"randomise": kind} for this episode on."""
        super().reset(seed=seed)
        for name, value in (options or {}).items():
            if name != "randomise" or value not in KINDS:
                raise ValueError(f"options: there is randomise, with {', '.join(KINDS)}; got {name}={value!r}")
            if value != self.randomise:
                self.randomise = value
                self.forget()
        if seed is None:
            seed = int(self.np_random.integers(0, self.seeds or 1 << 31))
        self._begin(seed)
        return self._observe(), self._info(Reward(), End.NONE)

    def step(self, action: Action) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Act, and go on until the agent is due again."""
        drive, seat = self._running()
        chosen = np.asarray(action, dtype=np.float64)
        if chosen.shape != (self.seat.n_actions,) or not np.isfinite(chosen).all():
            raise ValueError(
                f"an action is {self.seat.n_actions} finite numbers, clipped to [-1, 1]; got {action!r:.80}"
            )
        seat.chosen = tuple(np.clip(chosen, -1.0, 1.0).tolist())
        assert drive.agent is not None
        drive.agent.finish()
        over = go_on(drive, self._recorder)
        reward, end = self._judge(drive, seat)
        if over or end is not End.NONE:
            self._stop_recording()
        return self._observe(), reward.total, end is not End.NONE, over, self._info(reward, end)

    def render(self) -> Any:
        """Give a picture of the scene from above, uint8 (480, 640, 3); in mode rerun nothing: an episode is a file."""
        if self.render_mode != "rgb_array":
            return None
        from .picture import picture

        drive, _ = self._running()
        return picture(drive.sim, self.referee.line)

    def close(self) -> None:
        """Give everything back."""
        self.forget()
        if self._world is not None:
            self._world.close()
            self._world = None

    # -- episodes ---------------------------------------------------------------------------------------------------

    def _begin(self, seed: int) -> None:
        """Bring the cart to where the agent is asked first and the cart is ready."""
        self._stop_recording()
        self._seed = seed
        self._episode += 1
        image = self._warm.get(seed) if not self._recording else None
        if image is not None:
            self._warm.move_to_end(seed)
            self._drive, self.referee = image.drive, image.restore()
        else:
            self._drive = self._cold(seed)

    @property
    def _recording(self) -> bool:
        return self._record is not None or self.render_mode == "rerun"

    def _cold(self, seed: int) -> Drive:
        """Assemble a drive, and go on until the cart is enabled and has a fix; keep an image of it."""
        while len(self._warm) >= max(1, self.seeds) or (self._recording and self._warm):
            self._warm.popitem(last=False)[1].drive.close()
        if self._recording and self._drive is not None:
            self._drive.close()
        self._drive = None  # it is closed, or its world is another's from here on
        drive = Drive(self.setup_of(seed, self.stack, self._recording))
        if self._recording:
            self._start_recording(drive)
        try:
            while not go_on(drive, self._recorder):
                assert drive.agent is not None
                seat = drive.agent.module
                assert isinstance(seat, Seat)
                seat.look()
                if seat.ready or drive.time_s > READY_S:
                    break
                drive.agent.finish()
        except BaseException:
            drive.close()
            raise
        self.referee = self.make_referee(drive)
        if not self._recording:
            self._warm[seed] = Image(drive, self.referee)
        return drive

    def setup_of(self, seed: int, stack: Stack, truth: bool = True) -> Setup:
        """Give the drive of an episode. truth: it will be recorded."""
        return Setup(
            scenario=self.scenario,
            seed=seed,
            level=self.level,
            stack=stack,
            randomise=self.randomise,
            truth=truth,
            agent=self.agent,
            make_world=self._furnished,
        )

    def _furnished(self, scene: "Scene") -> World:
        """Give the one world of this environment, with what stands in a scene."""
        if self._world is None:
            self._world = World(scene)
        else:
            self._world.furnish(scene)
        return self._world

    def _running(self) -> tuple[Drive, Seat]:
        if self._drive is None or self._drive.agent is None:
            raise gymnasium.error.ResetNeeded("call reset() first")
        seat = self._drive.agent.module
        assert isinstance(seat, Seat)
        return self._drive, seat

    def make_referee(self, drive: Drive) -> Referee:
        """Give the referee of a drive of this environment."""
        assert drive.simulated is not None
        site = drive.cart.find("mission/site", SiteRecord).visible(drive.cart.cycle)
        assert site is not None
        return Referee(drive.sim, site.value, drive.simulated.course, OFF_COURSE_M.get(self.agent, 3.0))

    def _judge(self, drive: Drive, seat: Seat) -> tuple[Reward, End]:
        reward, end = self.referee.judge(self.dt_s, seat.steering, seat.estimate)
        if self._recorder is not None:
            self._reward.write(reward, drive.world.now_ns)
        return reward, end

    def _observe(self) -> Observation:
        _, seat = self._running()
        numbers = list(seat.look())
        if self.tier == "truth":
            numbers += self.referee.truth()
        if self._flat is not None:
            return self._flat(numbers)
        out, at = {}, 0
        for f in self.features:
            group = np.array(numbers[at : at + f.size], dtype=np.float32)
            out[f.name] = np.minimum(np.maximum(group, np.float32(f.low)), np.float32(f.high))
            at += f.size
        return out

    def _info(self, reward: Reward, end: End) -> dict[str, Any]:
        assert self._drive is not None
        return {
            "seed": self._seed,
            "time_s": self._drive.time_s,
            "reward_terms": {name: getattr(reward, name) for name in TERMS},
            "end": str(end),
            "arrived": self.referee.arrived,
        }

    def forget(self) -> None:
        """Close the drives of all episodes, and the recording of one under way; `reset` makes new ones."""
        self._stop_recording()
        drives = {id(image.drive): image.drive for image in self._warm.values()}
        if self._drive is not None:
            drives[id(self._drive)] = self._drive
        for drive in drives.values():
            drive.close()
        self._warm.clear()
        self._drive = None

    # -- recordings -------------------------------------------------------------------------------------------------

    def _start_recording(self, drive: Drive) -> None:
        folder = self._record or Path("runs") / "gym"
        folder.mkdir(parents=True, exist_ok=True)
        self.recording = folder / f"{self.scenario.id.replace('/', '-')}-{self._seed}-{self._episode}.mcap"
        referee = drive.world.join("referee")
        self._reward: Writer[Reward] = referee.insert("reward", Reward, flags=HOST_DEPENDENT)
        self._recorder = Recorder(self.recording, [drive.cart, drive.world], metadata(drive.setup))

    def _stop_recording(self) -> None:
        if self._recorder is None:
            return
        self._recorder.close()
        self._recorder = None
        if self.render_mode == "rerun":
            from rtdb.recording import Recording

            from .replay import convert

            convert(Recording(self.recording), None, self.recording.with_suffix(".rrd"))


def run_module(
    env: gymnasium.Env[Any, Any],
    module: str,
    seed: int,
    recording: str | Path,
    placement: Literal["inline", "process"] = "inline",
) -> str:
    """Drive one episode of an environment with a module (FILE.py:Class) as its agent; returns the hash of the trace.

    The whole drive, from its first cycle on, goes into the recording: its trace is that of `fairway drive` with the
    module in the stack. placement: the other modules here, or each in a process of its own. ModuleError if the module
    broke; the step that broke it is saved beside the recording.
    """
    from rtdb.recording import Recording

    cart = env.unwrapped
    assert isinstance(cart, CartEnv)
    recording = Path(recording)
    cart.forget()  # there is one world: this drive takes it from their episodes
    setup = replace(
        cart.setup_of(seed, cart.stack.use(cart.agent, module), True), placement=placement, faults=recording.parent
    )
    with Drive(setup) as drive, Recorder(recording, [drive.cart, drive.world], metadata(setup)) as recorder:
        while not go_on(drive, recorder):
            assert drive.agent is not None
            drive.agent.finish()
        fault = drive.agent.fault if drive.agent is not None else ""
    if fault:
        raise ModuleError(f"{cart.agent} = {module} broke: {fault}; the recording up to the end is in {recording}")
    return Recording(recording).trace_hash()


def go_on(drive: Drive, recorder: Recorder | None = None) -> bool:
    """Tick until the agent is asked (False) or the drive is over (True)."""
    agent = drive.agent
    assert agent is not None
    while True:
        over = drive.tick(recorder)
        asked = agent.begin(drive.cart.cycle)
        if over or asked:
            return over


IDS = {
    "Fairway/FieldTrial-v0": {"scenario": "p545/field-trial", "agent": "follow"},
    "Fairway/Loop-v0": {"scenario": "campus/loop", "agent": "follow"},
    "Fairway/Obstacles-v0": {"scenario": "obstacles/field", "agent": "avoid"},
    "Fairway/GpsOutage-v0": {"scenario": "safety/gps-outage", "agent": "follow"},
    "Fairway/Scenario-v0": {},
}
for _name, _kwargs in IDS.items():
    gymnasium.register(_name, entry_point="scenarios.gym:CartEnv", kwargs=_kwargs)
