"""Trial: one step of a module without a store, for tests of modules and for `fairway repro`.

mine = Mine()
outputs = trial(mine, pose=Pose(x_m=1.0), course=course, site=site)
assert outputs["drive"].speed_mps > 0.0
"""

from typing import Any

from rtdb import Sample

from .host import seeded
from .module import Module, ModuleError
from .outputs import outputs_of


def trial(module: Module, *, t_s: float = 0.0, dt_s: float = 0.04, seed: int = 0, **inputs: Any) -> dict[str, Any]:
    """Call one step with these inputs at a time, as a host would; returns the outputs by name.

    Before the first step of a module it is reset. Optional inputs that are not given read None. What a host takes for a
    fault is an exception here.
    """
    cls = type(module)
    unknown = [name for name in inputs if name not in cls.inputs]
    missing = [name for name, port in cls.inputs.items() if not port.optional and inputs.get(name) is None]
    if unknown or missing:
        what = f"no input {unknown[0]}" if unknown else f"an input {missing[0]}, which is not given"
        raise ModuleError(f"{cls.__name__} has {what}; its inputs are {', '.join(cls.inputs)}")
    module.t_ns, module.dt_s = round(t_s * 1e9), dt_s
    if "rng" not in module.__dict__:
        module.rng = seeded(seed, cls.__name__)
        module.reset()
    before = dict(module.samples)
    module.samples.clear()
    for name in cls.inputs:
        value = module.__dict__[name] = inputs.get(name)
        if value is not None:
            old = before.get(name)
            write = 1 if old is None else old.write + (old.value != value)
            stamp_ns = module.t_ns if old is None or old.value != value else old.t_data_ns
            module.samples[name] = Sample(value, write, stamp_ns, stamp_ns, ())
    return checked_step(module)


def checked_step(module: Module) -> dict[str, Any]:
    """Call the step of a module whose inputs stand in it; returns sound outputs, or raises what is wrong."""
    module._out.clear()
    module.step()
    return outputs_of(module)
