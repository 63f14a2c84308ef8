"""The plug-in: one class in one file.

    class Follow(Module):
        '''Follow the path by pure pursuit (Coulter 1992).'''
        pose = Input(Pose, max_age_s=0.5)
        drive = Output(DriveCommand, safe=STOP)
        lookahead_m = Param(3.0, unit="m")

        def step(self) -> None:
            self.drive = DriveCommand(speed_mps=2.0)

Ports are typed attributes. A step is called when it is due and every input is there and young enough; it reads inputs,
assigns every output, and has no other clock than `t_ns` and `dt_s` and no other randomness than `rng`.
"""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, Self, TypeVar, overload

from rtdb import Record, Sample

if TYPE_CHECKING:
    import numpy as np

R = TypeVar("R", bound=Record)
T = TypeVar("T")
P = TypeVar("P", bool, int, float, str)


class ModuleError(Exception):
    """A module, or its wiring, is wrong."""


class InputPort(Generic[T]):
    """What a module reads. The host puts the value into the instance before each step."""

    def __init__(self, cls: type[Record], max_age_s: float | None, optional: bool, static: bool) -> None:
        self.cls, self.max_age_s, self.optional, self.static = cls, max_age_s, optional, static

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

    def __init__(self, cls: type[R], safe: R) -> None:
        self.cls, self.safe = cls, safe

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
    cls: type[R], *, max_age_s: float | None = None, optional: Literal[False] = False, static: bool = False
) -> InputPort[R]: ...
@overload
def Input(
    cls: type[R], *, max_age_s: float | None = None, optional: Literal[True], static: bool = False
) -> InputPort[R | None]: ...
def Input(cls: type[Record], *, max_age_s: float | None = None, optional: bool = False, static: bool = False) -> Any:
    """Declare an input.

    max_age_s: older data counts as absent; optional: the step is called without it too, and reads None; static: its
    data time does not age the outputs (maps, courses, corrections that carry a time of their own).
    """
    return InputPort(cls, max_age_s, optional, static)


def Output(cls: type[R], *, safe: R) -> OutputPort[R]:
    """Declare an output. `safe` is what the host writes when the module cannot be trusted any more."""
    return OutputPort(cls, safe)


def Param(default: P, *, unit: str = "") -> ParamPort[P]:
    """Declare a parameter with its default."""
    return ParamPort(default, unit)


class Module(ABC):
    """Base of all modules. Its subclass declares ports and implements `step`."""

    inputs: ClassVar[dict[str, InputPort[Any]]] = {}
    outputs: ClassVar[dict[str, OutputPort[Any]]] = {}
    params: ClassVar[dict[str, ParamPort[Any]]] = {}

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

    _out: dict[OutputPort[Any], Record]

    def __new__(cls) -> Self:
        """Make what the host needs, so that a subclass may have an `__init__` that does not call this one's."""
        module = super().__new__(cls)
        module._out, module.samples = {}, {}
        return module

    def reset(self) -> None:  # noqa: B027 - a module without memory needs none
        """Prepare for a drive; called once before the first step, with parameters and rng set."""

    @abstractmethod
    def step(self) -> None:
        """Do one cycle's work."""
