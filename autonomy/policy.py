"""Policies: a trained network in one file, as a module that takes a seat.

The file is a zip of `policy.json` (format; the task: seat, pace, observation description, action map; its hash; the
layers) and `weights.npz` (arrays, those that scale the observation too). Whatever does not fit is refused when it is
loaded. The network is a chain of dense layers, computed in float64 with numpy.
"""

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .features import Flat, described
from .module import Module, ModuleError
from .seats import SEATS, Seat

if TYPE_CHECKING:
    import numpy as np

    Array = np.ndarray[Any, np.dtype[np.float64]]

FORMAT = 1
ACTIVATIONS = ("tanh", "relu", "identity")
CLIP = 10.0  # of a normalised observation


def task_of(seat: str, step_s: float) -> dict[str, Any]:
    """Give what a policy and the program must agree on: what the seat sees and how often, what its actions mean."""
    cls = SEATS[seat]
    meaning = (cls.act.__doc__ or "").strip()
    seen = described(cls.sees)
    return {"seat": seat, "step_s": step_s, "observation": seen, "actions": cls.n_actions, "action_map": meaning}


def task_hash(task: Mapping[str, Any]) -> str:
    """Hash a task."""
    return hashlib.sha256(json.dumps(task, sort_keys=True).encode()).hexdigest()[:16]


class Network:
    """Dense layers over a scaled observation: y = activation(W x + b), one after the other.

    mean, var: of the observations in training (m,), None where they are not normalised.
    """

    def __init__(
        self, layers: Sequence[tuple["Array", "Array", str]], mean: "Array | None" = None, var: "Array | None" = None
    ) -> None:
        self.layers, self.mean, self.var = list(layers), mean, var

    def __call__(self, observation: "np.ndarray[Any, Any]") -> "Array":
        """Give the action (n,), clipped to [-1, 1], for a flat observation (m,)."""
        import numpy as np

        x = observation.astype(np.float64)
        if self.mean is not None and self.var is not None:
            x = np.clip((x - self.mean) / np.sqrt(self.var + 1e-8), -CLIP, CLIP)
        for weight, bias, activation in self.layers:
            x = (weight * x).sum(axis=1) + bias  # no BLAS: its order of summation differs between machines
            if activation == "tanh":
                x = np.tanh(x)
            elif activation == "relu":
                x = np.maximum(x, 0.0)
        action: Array = np.clip(x, -1.0, 1.0)
        return action


def save_policy(path: Path, seat: str, step_s: float, network: Network, about: str = "") -> None:
    """Write a policy into one file. step_s: time between its steps."""
    import numpy as np

    task = task_of(seat, step_s)
    document = {
        "fairway": "policy",
        "format": FORMAT,
        "about": about,
        "task": task,
        "task_hash": task_hash(task),
        "layers": [activation for _, _, activation in network.layers],
        "normalised": network.mean is not None,
    }
    arrays: dict[str, Any] = {}
    for k, (weight, bias, _) in enumerate(network.layers):
        arrays[f"weight{k}"], arrays[f"bias{k}"] = weight, bias
    if network.mean is not None and network.var is not None:
        arrays["mean"], arrays["var"] = network.mean, network.var
    weights = io.BytesIO()
    np.savez(weights, **arrays)
    with zipfile.ZipFile(path, "w") as file:
        for name, data in (
            ("policy.json", json.dumps(document, indent=1).encode()),
            ("weights.npz", weights.getvalue()),
        ):
            file.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data)  # the same policy, the same bytes


def read_policy(path: Path) -> tuple[str, Network, dict[str, Any]]:
    """Read a policy file; returns its seat, its network and its document. ModuleError says what does not fit."""
    import numpy as np

    try:
        with zipfile.ZipFile(path) as file:
            document = json.loads(file.read("policy.json"))
            arrays = {k: v.astype(np.float64) for k, v in np.load(io.BytesIO(file.read("weights.npz"))).items()}
        if document["fairway"] != "policy" or document["format"] != FORMAT:
            raise ModuleError(f"{path} is a policy of format {document['format']}, this program reads {FORMAT}")
        task = document["task"]
        _check_task(path, task, document["task_hash"])
        layers = [(arrays[f"weight{k}"], arrays[f"bias{k}"], name) for k, name in enumerate(document["layers"])]
        scaling = (arrays["mean"], arrays["var"]) if document["normalised"] else (None, None)
    except FileNotFoundError as error:
        raise ModuleError(f"no file {path}") from error
    except (OSError, zipfile.BadZipFile, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ModuleError(f"{path} is no policy file: {error}") from error
    network = Network(layers, *scaling)
    _check_network(path, task["seat"], network)
    return task["seat"], network, document


def _check_task(path: Path, task: dict[str, Any], said_hash: object) -> None:
    """Refuse a policy for another task than ours."""
    seat = task["seat"]
    if seat not in SEATS:
        raise ModuleError(f"{path}: its seat {seat!r} is unknown; there are {', '.join(SEATS)}")
    if task_hash(task) != said_hash:
        raise ModuleError(f"{path}: its task does not agree with its own hash; the file was changed by hand")
    ours = task_of(seat, task["step_s"])
    if task["observation"] != ours["observation"]:
        theirs, here = (", ".join(f"{f['name']} {f['size']}" for f in t["observation"]) for t in (task, ours))
        raise ModuleError(f"{path}: it was trained on other observations: {theirs}; here they are {here}: train anew")
    if task != ours:
        raise ModuleError(f"{path}: its actions meant something else: {task['action_map']}; here: {ours['action_map']}")


def _check_network(path: Path, seat: str, network: Network) -> None:
    """Refuse weights that do not fit the seat, or are no numbers."""
    import numpy as np

    cls = SEATS[seat]
    size = sum(f.size for f in cls.sees)
    for array in (network.mean, network.var):
        if array is not None and array.shape != (size,):
            raise ModuleError(f"{path}: scaling statistics of shape {array.shape} do not fit {size} inputs")
    for k, (weight, bias, activation) in enumerate(network.layers):
        fits = weight.ndim == 2 and weight.shape[1] == size and bias.shape == weight.shape[:1]
        if not fits or activation not in ACTIVATIONS:
            raise ModuleError(f"{path}: layer {k}, {activation} of shape {weight.shape}, does not fit {size} inputs")
        if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            raise ModuleError(f"{path}: the weights of layer {k} are not finite")
        size = weight.shape[0]
    if not network.layers or size != cls.n_actions:
        raise ModuleError(f"{path}: it gives {size} actions, {seat} takes {cls.n_actions}")


def load_policy(path: Path) -> type[Module]:
    """Make the module that drives by a policy file."""
    seat, network, document = read_policy(path)
    return policy_module(seat, network, document["task"]["step_s"])


def policy_module(seat: str, network: Network, step_s: float) -> type[Seat]:
    """Make the module of a seat that decides by a network, which was trained with steps of step_s."""
    base = SEATS[seat]
    flat = Flat(base.sees)

    class PolicyModule(base):  # type: ignore[valid-type,misc]
        """Decides by a trained network."""

        pace_s = step_s

        def decide(self, numbers: list[float]) -> Sequence[float]:
            """Ask the network."""
            action: Sequence[float] = network(flat(numbers)).tolist()
            return action

    return PolicyModule
