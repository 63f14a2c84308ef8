"""The plant of `sim.plant`, computed by the C kernel: the same equations and interface, ten times as fast.

`sim/kernel/fw_plant.h` is the kernel's manual. The kernel gives the same bytes on every machine. The readable plant
takes sine and cosine from the machine's C library, and their last bits differ from one to the next.
"""

from dataclasses import astuple

import msgspec

from ._plant import Plant
from .plant import FLAT, STEP_S, CartParams, CartState, Demand, Ground, PlantSnapshot, coefficients


def kernel_row(params: CartParams, dt_s: float) -> tuple[float | int, ...]:
    """Return what the kernel has to know of a cart: coefficients, then dead times in steps (rounded to the nearest)."""
    dead_times_s = params.steer_dead_time_s, params.brake_dead_time_s, params.drive_dead_time_s
    return (*astuple(coefficients(params, dt_s)), *(round(dead_time_s / dt_s) for dead_time_s in dead_times_s))


class CompiledPlant:
    """One cart of the kernel. Its snapshots are those of `PythonPlant`: each continues what the other began."""

    __slots__ = ("_core", "_state", "dt_s", "params")

    def __init__(self, params: CartParams | None = None, dt_s: float = STEP_S, state: CartState | None = None) -> None:
        self.params = CartParams() if params is None else params
        self.dt_s = dt_s
        self._core = Plant((kernel_row(self.params, dt_s),))
        self._state: CartState | None = None
        self.reset(CartState() if state is None else state)

    @property
    def state(self) -> CartState:
        """The state after the last step."""
        if self._state is None:
            self._state = CartState(*self._core.cart(0))  # type: ignore[arg-type]  # the last field is the bool
        return self._state

    def step(self, demand: Demand, ground: Ground = FLAT) -> None:
        """Advance by `dt_s`. An open contactor acts at once, everything else after its dead time."""
        self._state = None
        self._core.step(
            demand.steer_rad,
            demand.brake,
            demand.drive,
            demand.contactor_open,
            ground.grade_x,
            ground.grade_y,
            ground.friction_factor,
            1,
        )

    def reset(self, state: CartState) -> None:
        """Start from `state`; until a first demand has passed its dead time, that actuator stays as it is."""
        held = Demand(steer_rad=state.steer_rad, brake=state.brake, drive=state.drive)
        self._put(state, (held,) * self._core.depth)

    def snapshot(self) -> PlantSnapshot:
        """Return what `restore` needs to continue exactly from here."""
        return PlantSnapshot(state=self.state, pending=tuple(Demand(*raw) for raw in self._core.pending(0)))

    def restore(self, snapshot: PlantSnapshot) -> None:
        """Continue from `snapshot`, taken from a plant with the same parameters and step."""
        if len(snapshot.pending) != self._core.depth:
            raise ValueError(
                f"snapshot with {len(snapshot.pending)} pending demands, expected {self._core.depth}: "
                "restore into a plant with the same dead times and step"
            )
        self._put(snapshot.state, snapshot.pending)

    def __reduce__(self) -> tuple[object, ...]:
        return _again, (self.params, self.dt_s, self.snapshot())

    def _put(self, state: CartState, pending: tuple[Demand, ...]) -> None:
        self._state = None
        self._core.put(0, msgspec.structs.astuple(state), tuple(msgspec.structs.astuple(demand) for demand in pending))


def _again(params: CartParams, dt_s: float, snapshot: PlantSnapshot) -> CompiledPlant:
    """Make the plant of a pickle."""
    plant = CompiledPlant(params, dt_s)
    plant.restore(snapshot)
    return plant
