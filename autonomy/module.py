"""The plug-in: one class in one file.

    class Follow(Module):
        '''Follow the path by pure pursuit (Coulter 1992).'''
        pose = Input(Pose, max_age_s=0.5)
        gap_m = Input(float, unit="m", optional=True)
        drive = Output(DriveCommand, safe=STOP, narrow={"speed_mps": (0.0, 3.0)})
        lookahead_m = Param(3.0, unit="m")

        def step(self) -> None:
            self.drive = DriveCommand(speed_mps=2.0)

Ports are typed attributes. A step is called when it is due and every input is there and young enough; it reads inputs,
assigns every output, and has no other clock than `t_ns` and `dt_s` and no other randomness than `rng`.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, Self, TypeVar, overload

from rtdb import Record, Sample, schema_of

if TYPE_CHECKING:
    import numpy as np

R = TypeVar("R", bound=Record)
T = TypeVar("T")
P = TypeVar("P", bool, int, float, str)
Ranges = Mapping[str, tuple[float, float]]
HOLD_STEPS = 2  # how long an output is held, where the port does not say
NO_NUMBERS = ("bool", "enum", "str", "image", "record")


class ModuleError(Exception):
    """A module, or its wiring, is wrong."""


class InputPort(Generic[T]):
    """What a module reads: a record, or one number (`cls` is float). The host sets it before each step."""

    def __init__(
        self,
        cls: type,
        unit: str,
        ranges: Ranges,
        max_age_s: float | None,
        optional: bool,
        static: bool,
        pointer: str | None,
    ) -> None:
        self.cls, self.unit, self.ranges, self.pointer = cls, unit, ranges, pointer
        self.max_age_s, self.optional, self.static = max_age_s, optional, static

    @overload
    def __get__(self, module: None, owner: type) -> Self: ...
    @overload
    def __get__(self, module: "Module", owner: type) -> T: ...
    def __get__(self, module: "Module | None", owner: type) -> Any:
        """Reached only before the host has put a value into the instance."""
        if module is None:
            return self
        raise ModuleError("an input is read before the first step; inputs are there in step(), not in reset()")


class OutputPort(Generic[R]):
    """What a module writes. The host takes the value from the instance after each step."""

    def __init__(self, cls: type[R], safe: R, ranges: Ranges, hold_steps: int) -> None:
        self.cls, self.safe, self.ranges, self.hold_steps = cls, safe, ranges, hold_steps

    @overload
    def __get__(self, module: None, owner: type) -> Self: ...
    @overload
    def __get__(self, module: "Module", owner: type) -> R: ...
    def __get__(self, module: "Module | None", owner: type) -> Any:
        """Reached only before the step has assigned it."""
        if module is None:
            return self
        raise ModuleError("an output is read before it is assigned")

    def __set__(self, module: "Module", value: R) -> None:
        """Keep the value for the host."""
        module._out[self] = value


class ParamPort(Generic[P]):
    """A number or word that the wiring may set."""

    def __init__(self, default: P, unit: str) -> None:
        self.default: P = default
        self.unit = unit

    @overload
    def __get__(self, module: None, owner: type) -> Self: ...
    @overload
    def __get__(self, module: "Module", owner: type) -> P: ...
    def __get__(self, module: "Module | None", owner: type) -> Any:
        """Give the default; the host puts another value into the instance."""
        return self if module is None else self.default


@overload
def Input(
    cls: type[float],
    *,
    unit: str,
    low: float = ...,
    high: float = ...,
    max_age_s: float | None = None,
    optional: Literal[False] = False,
    static: bool = False,
    pointer: str | None = None,
) -> InputPort[float]: ...
@overload
def Input(
    cls: type[float],
    *,
    unit: str,
    low: float = ...,
    high: float = ...,
    max_age_s: float | None = None,
    optional: Literal[True],
    static: bool = False,
    pointer: str | None = None,
) -> InputPort[float | None]: ...
@overload
def Input(
    cls: type[R],
    *,
    narrow: Ranges | None = None,
    max_age_s: float | None = None,
    optional: Literal[False] = False,
    static: bool = False,
    pointer: str | None = None,
) -> InputPort[R]: ...
@overload
def Input(
    cls: type[R],
    *,
    narrow: Ranges | None = None,
    max_age_s: float | None = None,
    optional: Literal[True],
    static: bool = False,
    pointer: str | None = None,
) -> InputPort[R | None]: ...
def Input(
    cls: type,
    *,
    unit: str = "",
    low: float = -math.inf,
    high: float = math.inf,
    narrow: Ranges | None = None,
    max_age_s: float | None = None,
    optional: bool = False,
    static: bool = False,
    pointer: str | None = None,
) -> Any:
    """Declare an input: a record, or `float` with a unit for a number that the wiring picks out of an object.

    max_age_s: older data counts as absent; optional: the step is called without it too, and reads None; static: its
    data time does not age the outputs (maps, courses, corrections that carry a time of their own); narrow, low, high:
    values that the module can work with, by field; others count as absent, and wiring it to an output that may give
    them is an error; pointer: what it is wired to where the wiring does not say.
    """
    ranges = dict(narrow or {}) if cls is not float else {"": (low, high)}
    return InputPort(cls, unit, ranges, max_age_s, optional, static, pointer)


def Output(cls: type[R], *, safe: R, narrow: Ranges | None = None, hold_steps: int = HOLD_STEPS) -> OutputPort[R]:
    """Declare an output. `safe` is what the host writes when the module cannot be trusted any more.

    narrow: a range per field, within the record's own; a step that leaves it is a fault. hold_steps: for so many steps
    that are missed the last value stands, then comes the safe one.
    """
    return OutputPort(cls, safe, dict(narrow or {}), hold_steps)


def Param(default: P, *, unit: str = "") -> ParamPort[P]:
    """Declare a parameter with its default."""
    return ParamPort(default, unit)


class Module(ABC):
    """Base of all modules. Its subclass declares ports and implements `step`."""

    inputs: ClassVar[dict[str, InputPort[Any]]] = {}
    outputs: ClassVar[dict[str, OutputPort[Any]]] = {}
    params: ClassVar[dict[str, ParamPort[Any]]] = {}

    pace_s: ClassVar[float | None] = None
    """Time between steps that the module is made for; None for any."""
    t_ns: int = 0
    """Time of this step: the edge of its cycle, ns since 1970."""
    dt_s: float = 0.0
    """Time from one step to the next, when none is left out."""
    rng: "np.random.Generator"
    """Randomness from the run's seed, of this module alone."""
    samples: dict[str, Sample[Any]]
    """The inputs with their stamps and write numbers, by port name."""

    def __init_subclass__(cls) -> None:
        ports = [(name, value) for base in reversed(cls.__mro__) for name, value in vars(base).items()]
        cls.inputs = {name: port for name, port in ports if isinstance(port, InputPort)}
        cls.outputs = {name: port for name, port in ports if isinstance(port, OutputPort)}
        cls.params = {name: port for name, port in ports if isinstance(port, ParamPort)}
        for name, port in cls.inputs.items():
            if port.cls is float and not port.unit:
                raise ModuleError(f'{cls.__name__}.{name}: a number needs a unit: Input(float, unit="m"); "1" for none')
            if port.cls is not float:
                _check_narrow(f"{cls.__name__}.{name}", port.cls, port.ranges)
        for name, output in cls.outputs.items():
            _check_narrow(f"{cls.__name__}.{name}", output.cls, output.ranges)

    _out: dict[OutputPort[Any], Record]
    _shown: dict[str, Any]

    def __new__(cls) -> Self:
        """Make what the host needs, so that a subclass may have an `__init__` that does not call this one's."""
        module = super().__new__(cls)
        module._out, module._shown, module.samples = {}, {}, {}
        return module

    def reset(self) -> None:  # noqa: B027 - a module without memory needs none
        """Prepare for a drive; called once before the first step, with parameters and rng set."""

    @abstractmethod
    def step(self) -> None:
        """Do one cycle's work."""

    def show(self, name: str, value: object) -> None:
        """Show something in the replay: a number, a text, or points [(x_m, y_m), ...] in M, which become a line."""
        self._shown[name] = value

    def memory(self) -> dict[str, Any]:
        """Give what the module remembers, so that `restore` can go on from this moment: its own attributes."""
        hosts = {"t_ns", "dt_s", "samples", "_out", "_shown"}
        return {name: value for name, value in self.__dict__.items() if name not in hosts and name not in self.inputs}

    def restore(self, memory: dict[str, Any]) -> None:
        """Go on from what `memory` gave, in a fresh instance with the same parameters."""
        self.__dict__.update(memory)


def _check_narrow(port: str, cls: type[Record], ranges: Ranges) -> None:
    """Refuse a range that is none, of no field, or wider than the record's."""
    fields = {f.name: f.spec for f in schema_of(cls).fields if f.spec.shape == "one" and f.spec.kind not in NO_NUMBERS}
    for name, (low, high) in ranges.items():
        spec = fields.get(name)
        if spec is None:
            raise ModuleError(f"{port}: {cls.__name__} has no number {name}; it has {', '.join(fields) or 'none'}")
        if not spec.low <= low <= high <= spec.high:
            raise ModuleError(
                f"{port}: {name} from {low:g} to {high:g} is not within {cls.__name__}'s own range, "
                f"{spec.low:g} to {spec.high:g} {spec.unit}; a module may narrow it, not widen it"
            )
