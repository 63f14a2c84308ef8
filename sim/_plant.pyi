"""The plant's C kernel (sim/kernel); see fw_plant.h and trig.h for what each call does and how it fails."""

from typing_extensions import Buffer

SOURCE_HASH: str

RawDemand = tuple[float, float, float, bool]
RawState = tuple[float | bool, ...]  # the fields of CartState, in their order

class Plant:
    """N carts. `memoryview(plant)` is their states, (n, 17) writable doubles, and keeps the plant alive."""

    def __init__(self, rows: tuple[tuple[float | int, ...], ...], /) -> None:
        """Take a row per cart: the coefficients in their order, then the dead times in steps: steer, brake, drive."""
    @property
    def n(self) -> int: ...
    @property
    def depth(self) -> int:
        """Demands under way per cart: 1 + the longest dead time of any."""
    def step(
        self,
        steer_rad: float,
        brake: float,
        drive: float,
        contactor_open: bool,
        grade_x: float,
        grade_y: float,
        friction_factor: float,
        n_steps: int,
        /,
    ) -> None:
        """Advance a plant of one cart. ValueError: it has more, or its yaw is beyond 1e5 rad."""
    def step_each(self, demands: Buffer, grounds: Buffer, n_steps: int, /) -> None:
        """Advance all carts: demands (n, 4) and grounds (n, 3) are C-contiguous doubles."""
    def cart(self, cart: int, /) -> RawState: ...
    def pending(self, cart: int, /) -> tuple[RawDemand, ...]:
        """Give the demands under way, oldest first."""
    def put(self, cart: int, state: RawState, pending: tuple[RawDemand, ...], /) -> None: ...
    def save(self) -> bytes: ...
    def restore(self, image: bytes, /) -> None: ...
    def __buffer__(self, flags: int, /) -> memoryview: ...

def sincos(x: float, /) -> tuple[float, float]: ...
def atan(x: float, /) -> float: ...
