"""Latency of a stack, computed from its wiring before anybody drives.

The schedule is periodic, so following every sensor's samples through it over one hyperperiod is exact: at each tick a
component that is due takes the oldest data time of its inputs, and its outputs show it from the next tick on.
"""

import math
from dataclasses import dataclass

from autonomy.loading import check_inputs, load_module
from autonomy.wiring import Stack

BURST_TICKS = 2  # the HAL sends commands every 20 ms
SENSOR_TICKS = {"odometry/travel": 2}  # sensors that age the outputs: period of their frames


@dataclass(frozen=True, slots=True)
class Latency:
    """From the instant at which a sensor measured to the frame on the bus that acts on it, in ticks."""

    sensor: str
    best_ticks: int
    worst_ticks: int


def latency(stack: Stack) -> list[Latency]:
    """Compute the latency from each sensor to the actuator command."""
    period = math.lcm(BURST_TICKS, *SENSOR_TICKS.values(), *(wire.every for wire in stack.wires))
    out = []
    for sensor, sensor_ticks in SENSOR_TICKS.items():
        ages = _follow(stack, sensor, sensor_ticks, period)
        if ages:
            out.append(Latency(sensor, min(ages), max(ages)))
    return out


def _follow(stack: Stack, sensor: str, sensor_ticks: int, period: int) -> list[int]:
    """Ages of the sensor's data at each command burst of the last hyperperiod."""
    shown: dict[str, int] = {}  # object -> measuring tick of the data that it shows
    pending: dict[int, dict[str, int]] = {}  # by the tick from which it shows
    modules = {wire.component: load_module(wire.module) for wire in stack.wires}
    for wire in stack.wires:
        check_inputs(wire.component, modules[wire.component], wire.inputs)
    wired = {wire.component: wire.objects() for wire in stack.wires}
    ages = []
    for tick in range(20 * period):
        shown |= pending.pop(tick, {})
        if tick % sensor_ticks == 0:
            pending.setdefault(tick + 1, {})[sensor] = tick
        for wire in stack.wires:
            if tick % wire.every != wire.phase:
                continue
            cls = modules[wire.component]
            objects = wired[wire.component]
            origins = [shown[o] for name, o in objects.items() if o in shown and not cls.inputs[name].static]
            if origins:
                outputs = {f"{wire.component}/{name}": min(origins) for name in cls.outputs}
                pending.setdefault(tick + 1 + wire.latency_cycles, {}).update(outputs)
        if tick % BURST_TICKS == 0 and stack.command in shown and tick >= 19 * period:
            ages.append(tick - shown[stack.command])
    return ages
