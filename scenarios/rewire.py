"""Rewire: what the inputs of a running system are wired to, and how to change it.

The wiring in force stands in the store, as `<component>/config` of each component. Who writes there proposes; the host
of the component takes it at its next due cycle, or refuses it, puts the old one back and says why.
"""

import time
from dataclasses import dataclass, replace
from typing import Any

from autonomy.loading import load_module
from autonomy.module import Input, ModuleError
from autonomy.pointer import link
from autonomy.wiring import ACTUATORS, Stack, Wire, check_stack, wire_of
from hal.host import drive_pointer
from hal.signals import DriveCommand, ModuleState, ModuleStatus, PedalCommand
from rtdb import Object, RtdbError, Store
from rtdb.db.values import did_you_mean

from .latency import latency

ANSWER_S = 5.0  # a host looks at each due cycle
LOOK_S = 0.1
TAKEN, REFUSED = "wired anew", "wiring refused"


@dataclass(frozen=True, slots=True)
class Change:
    """An input that shall be wired to something else."""

    component: str
    name: str
    pointer: str

    @classmethod
    def parse(cls, text: str) -> "Change":
        """Read COMPONENT.INPUT=POINTER."""
        target, equals, pointer = text.partition("=")
        component, dot, name = target.partition(".")
        if not (component and dot and name and equals and pointer):
            raise ModuleError(f"{text}: expected COMPONENT.INPUT=POINTER, as in follow.pose=localise/pose")
        return cls(component, name, pointer)


def stack_of(store: Store) -> Stack:
    """Read the wiring in force from a store."""
    wires, command = [], None
    for obj in store.objects("*/config"):
        component, sample = obj.name.removesuffix("/config"), obj.latest()
        if sample is None:
            continue
        if component == ACTUATORS:
            command = drive_pointer(sample.value)
        else:
            wires.append(wire_of(obj.name, component, sample.value))
    if command is None:
        raise ModuleError(f"store {store.name!r} has no {ACTUATORS}/config: no cart is driven in it")
    return Stack(tuple(wires), command)


def changed(stack: Stack, change: Change) -> Stack:
    """Give the wiring with a change; ModuleError for what there is not."""
    known = [*(wire.component for wire in stack.wires), ACTUATORS]
    if change.component not in known:
        raise ModuleError(f"no component {change.component!r}; {did_you_mean(change.component, known, 'there are')}")
    if any(wire.component == change.component and wire.is_files for wire in stack.wires):
        raise ModuleError(
            f"{change.component} is a script, and reads its wiring itself: write it into /{change.component}/config, "
            "through the file server"
        )
    ports = ["drive"] if change.component == ACTUATORS else list(_module(stack, change.component).inputs)
    if change.name not in ports:
        raise ModuleError(
            f"{change.component} has no input {change.name!r}; {did_you_mean(change.name, ports, 'it has')}"
        )
    if change.component == ACTUATORS:
        return replace(stack, command=change.pointer)
    return replace(stack, wires=tuple(_rewired(wire, change) for wire in stack.wires))


def _rewired(wire: Wire, change: Change) -> Wire:
    if wire.component != change.component:
        return wire
    return replace(wire, inputs={**wire.inputs, change.name: change.pointer})


def check_change(store: Store, stack: Stack, change: Change) -> Stack:
    """Give the wiring with a change, or raise what its host would say of it, in one line."""
    after = changed(stack, change)
    at_hal = change.component == ACTUATORS
    port: Any = _hal_port(store, change) if at_hal else _module(stack, change.component).inputs[change.name]
    try:
        found = link(store, change.pointer, port)
    except (RtdbError, ModuleError) as error:
        raise ModuleError(f"{change.component}.{change.name} = {change.pointer}: {error}") from error
    if at_hal and found.json:
        raise ModuleError(f"{change.component}.{change.name} = {change.pointer}: it holds JSON, not a DriveCommand")
    check_stack(after)
    return after


def _hal_port(store: Store, change: Change) -> Any:
    """Give what the actuators take: a command, or that of pedals."""
    pedals = any(obj.stored.name == PedalCommand.__name__ for obj in store.objects(change.pointer))
    return Input(PedalCommand if pedals else DriveCommand)


def _module(stack: Stack, component: str) -> Any:
    return load_module(next(wire.module for wire in stack.wires if wire.component == component))


def latency_lines(stack: Stack, tick_ns: int) -> list[str]:
    """Say how long it takes from each sensor to the actuators."""
    tick_ms = tick_ns / 1e6
    return [
        f"{way.sensor} -> {stack.command} -> bus: {way.best_ticks * tick_ms:.0f} to {way.worst_ticks * tick_ms:.0f} ms"
        for way in latency(stack)
    ] or [f"no sensor -> {stack.command} -> bus: the limits will hold the cart"]


def propose(store: Store, after: Stack, change: Change) -> str:
    """Write the wiring of the component that changes, and wait for what it says; empty if it says nothing."""
    answers = _answers(store, change.component)
    before = answers.head
    obj = store.find(f"{change.component}/config")
    wire = next((wire for wire in after.wires if wire.component == change.component), None)
    payload = obj.schema.pack(_entry(after, wire))
    store.core.write(obj.handle, payload, store.core.not_before(obj.handle, store.now_ns), ())
    deadline_s, cycle = time.monotonic() + ANSWER_S, store.cycle
    told = _told(answers, before)
    while not told[1] and time.monotonic() < deadline_s:
        cycle = store.wait_cycle(cycle, LOOK_S) or cycle
        told = _told(answers, told[0])
    return told[1]


def _entry(stack: Stack, wire: Wire | None) -> Any:
    return {"inputs": {"drive": stack.command}} if wire is None else wire.entry()


def _answers(store: Store, component: str) -> Object[Any]:
    """Give the object in which a component answers; ModuleError if it cannot."""
    if not any(info.alive for info in store.components() if info.name == component):
        raise ModuleError(f"{component} is gone: nobody would take the wiring")
    if component == ACTUATORS:
        return store.find(f"{component}/health")
    status = store.find(f"{component}/status", ModuleStatus)
    newest = status.latest()
    if newest is not None and newest.value.state is ModuleState.FAULT:
        raise ModuleError(f"{component} has stopped for good: {newest.value.reason}")
    return status


def _told(answers: Object[Any], after: int) -> tuple[int, str]:
    """Look for an answer among the writes behind a number; gives the last one that was looked at, and the answer."""
    while (found := answers.next(after)) is not None:
        after, value = found[0].write, found[0].value
        text = value.reason if isinstance(value, ModuleStatus) else value["status"]
        if text.startswith((TAKEN, REFUSED)):
            return after, text
    return after, ""
