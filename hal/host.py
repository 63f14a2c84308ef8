"""Runs the drivers on a store: what devices say becomes objects, the drive command goes out to the nodes.

Objects: gps/fix, compass/heading, odometry/travel, safety/state, actuators/state, actuators/command, counters of
each transport, and actuators/config: which command is obeyed, as JSON that anybody may write. All are visible at the
tick after the one at which they were heard.

`step` takes the time of the devices, which may differ from that of the store: a simulated world has its own. Stamps in
the store are the store's.
"""

from typing import Any

from rtdb import HOST_DEPENDENT, Flag, Object, RtdbError, Sample, State, Store, Writer
from rtdb.json_object import json_schema

from .bus import CanBus
from .drivers.cart import BURST_NS, SYSTEM_NS, CartDriver
from .drivers.compass import CompassDriver
from .drivers.gps import GpsDriver
from .errors import WiringError
from .limits import Envelope
from .serial_line import SerialDevice, carry
from .signals import (
    ActuatorCommand,
    ActuatorState,
    CompassHeading,
    DriveCommand,
    GpsFix,
    LinkCounters,
    Odometry,
    PedalCommand,
    SafetyState,
    SystemState,
)

COUNTERS_NS = 1_000_000_000
METRES_PER_TICK = 1.40 / 128  # wheel circumference over edges a turn
CONFIG_BYTES = 300


def ahead_ns(store: Store, cycle: int, t_ns: int) -> int:
    """Say how much the store's time is ahead of the devices', whose time at the edge of a cycle is t_ns.

    Not to be remembered from before the first tick: a real-time store has its t0 only then.
    """
    return store.t0_ns + cycle * store.tick_ns - t_ns


class GpsHost:
    """The GPS driver on a store."""

    def __init__(self, store: Store, driver: GpsDriver, device: SerialDevice | None = None) -> None:
        gps = store.join("gps")
        self._store, self.driver, self._device = store, driver, device
        self._fix = gps.insert("fix", GpsFix, history_s=1.0)
        self._counters = gps.insert("counters", LinkCounters, every=10, flags=HOST_DEPENDENT, history_s=2.0)

    def step(self, cycle: int, t_ns: int) -> None:
        """Read the line; commit finished epochs."""
        if self._device is not None:
            carry(self._device, self.driver, t_ns)
        for fix, t_data_ns in self.driver.poll(t_ns):
            self._fix.write(fix, t_data_ns + ahead_ns(self._store, cycle, t_ns))
        if t_ns % COUNTERS_NS == 0:
            self._counters.write(self.driver.counters, t_ns + ahead_ns(self._store, cycle, t_ns))


class CompassHost:
    """The compass driver on a store."""

    def __init__(self, store: Store, driver: CompassDriver, device: SerialDevice | None = None) -> None:
        compass = store.join("compass")
        self._store, self.driver, self._device = store, driver, device
        self._heading = compass.insert("heading", CompassHeading, history_s=1.0)
        self._counters = compass.insert("counters", LinkCounters, every=10, flags=HOST_DEPENDENT, history_s=2.0)

    def step(self, cycle: int, t_ns: int) -> None:
        """Read the line; commit readings."""
        if self._device is not None:
            carry(self._device, self.driver, t_ns)
        for heading, t_data_ns in self.driver.poll(t_ns):
            self._heading.write(heading, t_data_ns + ahead_ns(self._store, cycle, t_ns))
        if t_ns % COUNTERS_NS == 0:
            self._counters.write(self.driver.counters, t_ns + ahead_ns(self._store, cycle, t_ns))


class CartHost:
    """The cart's drivers on a store."""

    def __init__(self, store: Store, bus: CanBus, envelope: Envelope | None = None) -> None:
        self._store, self._tick_ns = store, store.tick_ns
        self.driver = CartDriver(bus, METRES_PER_TICK, envelope)
        self._travel = store.join("odometry").insert("travel", Odometry)
        self._safety = store.join("safety").insert("state", SafetyState)
        actuators = self._actuators = store.join("actuators")
        self._state = actuators.insert("state", ActuatorState)
        self._command = actuators.insert("command", ActuatorCommand, n_causes=1)
        self._counters = actuators.insert("counters", LinkCounters, every=10, flags=HOST_DEPENDENT)
        self._config: Writer[Any] = actuators.insert(
            "config", json_schema(CONFIG_BYTES), flags=Flag.PUBLIC_WRITE, history_s=0.1
        )
        self._configured = 0
        self._drive: Object[DriveCommand] | Object[PedalCommand] | None = None
        self._obeyed: Sample[Any] | None = None
        self._pointer, self._stopped = "", False

    def obey(self, pointer: str, timeout_s: float = 0.0) -> None:
        """Take commands from an object in the store. While disabled only."""
        if self._store.find(pointer, timeout_s=timeout_s).stored.name == PedalCommand.__name__:
            self._drive = self._store.find(pointer, PedalCommand)
        else:
            self._drive = self._store.find(pointer, DriveCommand)
        self._pointer, self._obeyed = pointer, None
        self._configured = self._config.write({"inputs": {"drive": pointer}})

    def stop(self) -> None:
        """Obey nobody any more: each further step brakes, and then holds the cart."""
        self._drive, self._stopped = None, True

    def step(self, cycle: int, t_ns: int) -> None:
        """Read the bus, commit what was heard, send what is due."""
        ahead = ahead_ns(self._store, cycle, t_ns)
        heard = self.driver.poll()
        for odometry, t_data_ns in heard.odometry:
            self._travel.write(odometry, t_data_ns + ahead)
        for safety, t_data_ns in heard.safety:
            self._safety.write(safety, t_data_ns + ahead)
        for actuators, t_data_ns in heard.actuators:
            self._state.write(actuators, t_data_ns + ahead)
        if not self._stopped and self._store.core.visible_write(self._config.handle, cycle) > self._configured:
            self._rewire(cycle)
        if t_ns % BURST_NS == 0 or t_ns % SYSTEM_NS == 0:
            self._send(cycle, t_ns, ahead)
        if t_ns % COUNTERS_NS == 0:
            self._counters.write(self.driver.counters, t_ns + ahead)

    def _send(self, cycle: int, t_ns: int, ahead: int) -> None:
        """Send the command that this cut shows."""
        sample = self._obeyed = self._drive.visible_since(cycle, self._obeyed) if self._drive is not None else None
        command, origin_ns = (sample.value, sample.t_data_ns) if sample is not None else (None, t_ns + ahead)
        origin_cycle = cycle + (origin_ns - ahead - t_ns) // self._tick_ns
        sent = self.driver.command(t_ns, command, origin_ns - ahead, origin_cycle)
        if sent is not None:
            self._command.write(sent, t_ns + ahead if sample is None else None, inputs=(sample,) if sample else ())

    def _rewire(self, cycle: int) -> None:
        """Obey the command that somebody names from now on, or stay with the present one; `health` says which."""
        sample = self._config.visible(cycle)
        try:
            pointer = drive_pointer(sample.value if sample is not None else None)
            if self.driver.state is SystemState.ENABLED:
                raise WiringError("the cart is enabled; which command is obeyed changes only while it is not")
            self.obey(pointer)
        except (WiringError, RtdbError) as error:
            self._configured = self._config.write({"inputs": {"drive": self._pointer}})
            self._actuators.status(f"wiring refused in cycle {cycle}: {error}", State.WARNING)
            return
        self._actuators.status(f"wired anew in cycle {cycle}")


def drive_pointer(config: object) -> str:
    """Give the name of the command in a configuration: {"inputs": {"drive": "component/object"}}."""
    inputs = config.get("inputs") if isinstance(config, dict) else None
    if not (isinstance(config, dict) and set(config) == {"inputs"} and isinstance(inputs, dict)):
        raise WiringError(f'expected {{"inputs": {{"drive": "component/object"}}}}, got {config!r:.60}')
    if set(inputs) != {"drive"} or not isinstance(inputs["drive"], str):
        raise WiringError(f"the actuators have one input, drive, which is wired to an object; got {inputs!r:.60}")
    return inputs["drive"]
