"""Repro: the step that broke a module, in a file, to be run again under a debugger.

The file is JSON: the wiring, the cycle, the inputs as the module read them (with their schemas), why it broke, and what
the module remembered before that step (pickled; what cannot be pickled is named). Randomness and what
the step assigned anew are as before it; what it changed in place (a list, an array) is as the failing step left it.
"""

import base64
import json
import pickle
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from rtdb import Object, Record, RtdbError, Sample
from rtdb.records import Schema

from .loading import POLICY, make_module
from .module import Module, ModuleError
from .wiring import wire_of

if TYPE_CHECKING:
    from .host import Host

FORMAT = 1
SUFFIX = ".repro"
MOST_BYTES = 16 << 20  # of one attribute, pickled


def save(folder: Path, host: "Host", before: dict[str, Any], error: BaseException) -> Path:
    """Write the failing step of a host's module into a file; returns its path."""
    module, wire = host.module, host.wire
    now = module.__dict__
    module.__dict__ = {**before}
    try:
        state, left_out = _pickled(module.memory() if before else {})
    finally:
        module.__dict__ = now
    document = {
        "fairway": "repro",
        "format": FORMAT,
        "component": wire.component,
        "wire": wire.entry() | {"module": _absolute(wire.module)},
        "seed": host.seed,
        "call": "step" if before else "reset",
        "rng": host.rng_before,
        "t_ns": module.t_ns,
        "dt_s": module.dt_s,
        "inputs": {name: _input(sample, module, name) for name, sample in module.samples.items()},
        "state": state,
        "left_out": left_out,
        "reason": "".join(traceback.format_exception(error)),
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{wire.component}{SUFFIX}"
    path.write_text(json.dumps(document, indent=1) + "\n")
    return path


def _absolute(spec: str) -> str:
    if spec.endswith(POLICY):
        return str(Path(spec).resolve())
    place, _, name = spec.rpartition(":")
    return f"{Path(place).resolve()}:{name}" if place.endswith(".py") else spec


def _input(sample: Sample[Any], module: Module, name: str) -> dict[str, Any]:
    source: Object[Any] | None = sample.source
    assert source is not None
    value = sample.value
    said: dict[str, Any] = {"write": sample.write, "t_commit_ns": sample.t_commit_ns, "t_data_ns": sample.t_data_ns}
    said |= {"object": source.name, "schema": source.stored.to_text()}
    if isinstance(value, Record):
        said["payload"] = base64.b64encode(source.raw(sample.write)).decode()
    else:
        said["value"], said["json"] = module.__dict__[name], value
        if isinstance(said["value"], Record):
            said["value"] = msgspec.to_builtins(said["value"])
    return said


def _pickled(state: dict[str, Any]) -> tuple[str, list[str]]:
    kept, left_out = {}, []
    for name, value in state.items():
        try:
            data = pickle.dumps(value)
        except Exception:  # locks, files, lambdas: anything
            data = b""
        if 0 < len(data) <= MOST_BYTES:
            kept[name] = data
        else:
            left_out.append(name)
    return base64.b64encode(pickle.dumps(kept)).decode(), left_out


def load(path: Path) -> tuple[Module, dict[str, Any]]:
    """Make the module as it was before the step; returns it and the document. ModuleError says what is wrong."""
    try:
        document = json.loads(path.read_text())
        if document["fairway"] != "repro" or document["format"] != FORMAT:
            raise ValueError("its format is another one")
        return _module_of(path, document), document
    except OSError as error:
        raise ModuleError(f"{path}: {error.strerror}") from error
    except (ModuleError, RtdbError):  # the module has changed meanwhile
        raise
    except Exception as error:  # JSON, pickles, and restore() of the module
        raise ModuleError(f"{path} is no repro of this version: {type(error).__name__}: {error}") from error


def _module_of(path: Path, document: dict[str, Any]) -> Module:
    wire = wire_of(str(path), document["component"], document["wire"])
    module = make_module(wire)
    from .host import seeded

    module.rng = seeded(document["seed"], document["component"])
    module.t_ns, module.dt_s = document["t_ns"], document["dt_s"]
    state = pickle.loads(base64.b64decode(document["state"]))
    module.restore({name: pickle.loads(value) for name, value in state.items()})
    if document["rng"] is not None and hasattr(module.rng, "bit_generator"):
        module.rng.bit_generator.state = document["rng"]
    ports = type(module).inputs
    for name, port in ports.items():
        module.__dict__[name] = None
        if name in document["inputs"]:
            raw = document["inputs"][name]
            value = module.__dict__[name] = _value(raw, port.cls)
            stamps = raw["write"], raw["t_commit_ns"], raw["t_data_ns"]
            module.samples[name] = Sample(raw.get("json", value), *stamps, ())
    return module


def _value(raw: dict[str, Any], cls: type) -> Any:
    if "payload" in raw:
        return Schema.from_text(raw["schema"]).reader(cls, raw["object"])(base64.b64decode(raw["payload"]))
    return msgspec.convert(raw["value"], cls, strict=False)
