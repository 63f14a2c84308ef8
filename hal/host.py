"""Runs the drivers on a store: what devices say becomes objects, the drive command goes out to the nodes.

Objects: gps/fix, compass/heading, odometry/travel, safety/state, actuators/state, actuators/command, and counters of
each transport. All are visible at the tick after the one at which they were heard.
"""

from rtdb import HOST_DEPENDENT, Object, Sample, Store

from .bus import CanBus
from .drivers.cart import BURST_NS, SYSTEM_NS, CartDriver
from .drivers.compass import CompassDriver
from .drivers.gps import GpsDriver
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
    SafetyState,
)

COUNTERS_NS = 1_000_000_000
METRES_PER_TICK = 1.40 / 128  # wheel circumference over edges a turn


class GpsHost:
    """The GPS driver on a store."""

    def __init__(self, store: Store, driver: GpsDriver, device: SerialDevice | None = None) -> None:
        gps = store.join("gps")
        self.driver, self._device = driver, device
        self._fix = gps.insert("fix", GpsFix, history_s=1.0)
        self._counters = gps.insert("counters", LinkCounters, every=10, flags=HOST_DEPENDENT, history_s=2.0)

    def step(self, _cycle: int, t_ns: int) -> None:
        """Read the line; commit finished epochs."""
        if self._device is not None:
            carry(self._device, self.driver, t_ns)
        for fix, t_data_ns in self.driver.poll(t_ns):
            self._fix.write(fix, t_data_ns)
        if t_ns % COUNTERS_NS == 0:
            self._counters.write(self.driver.counters, t_ns)


class CompassHost:
    """The compass driver on a store."""

    def __init__(self, store: Store, driver: CompassDriver, device: SerialDevice | None = None) -> None:
        compass = store.join("compass")
        self.driver, self._device = driver, device
        self._heading = compass.insert("heading", CompassHeading, history_s=1.0)
        self._counters = compass.insert("counters", LinkCounters, every=10, flags=HOST_DEPENDENT, history_s=2.0)

    def step(self, _cycle: int, t_ns: int) -> None:
        """Read the line; commit readings."""
        if self._device is not None:
            carry(self._device, self.driver, t_ns)
        for heading, t_data_ns in self.driver.poll(t_ns):
            self._heading.write(heading, t_data_ns)
        if t_ns % COUNTERS_NS == 0:
            self._counters.write(self.driver.counters, t_ns)


class CartHost:
    """The cart's drivers on a store."""

    def __init__(self, store: Store, bus: CanBus, envelope: Envelope | None = None) -> None:
        self._t0_ns, self._tick_ns = store.t0_ns, store.tick_ns
        self.driver = CartDriver(bus, METRES_PER_TICK, envelope)
        self._travel = store.join("odometry").insert("travel", Odometry)
        self._safety = store.join("safety").insert("state", SafetyState)
        actuators = store.join("actuators")
        self._state = actuators.insert("state", ActuatorState)
        self._command = actuators.insert("command", ActuatorCommand, n_causes=1)
        self._counters = actuators.insert("counters", LinkCounters, every=10, flags=HOST_DEPENDENT)
        self._drive: Object[DriveCommand] | None = None
        self._obeyed: Sample[DriveCommand] | None = None

    def obey(self, drive: Object[DriveCommand]) -> None:
        """Take commands from an object. Call it while disabled only."""
        self._drive, self._obeyed = drive, None

    def step(self, cycle: int, t_ns: int) -> None:
        """Read the bus, commit what was heard, send what is due."""
        heard = self.driver.poll()
        for odometry, t_data_ns in heard.odometry:
            self._travel.write(odometry, t_data_ns)
        for safety, t_data_ns in heard.safety:
            self._safety.write(safety, t_data_ns)
        for actuators, t_data_ns in heard.actuators:
            self._state.write(actuators, t_data_ns)
        if t_ns % BURST_NS == 0 or t_ns % SYSTEM_NS == 0:
            self._send(cycle, t_ns)
        if t_ns % COUNTERS_NS == 0:
            self._counters.write(self.driver.counters, t_ns)

    def _send(self, cycle: int, t_ns: int) -> None:
        """Send the command that this cut shows."""
        sample = self._obeyed = self._drive.visible_since(cycle, self._obeyed) if self._drive is not None else None
        command, origin_ns = (sample.value, sample.t_data_ns) if sample is not None else (None, t_ns)
        origin_cycle = (origin_ns - self._t0_ns) // self._tick_ns
        sent = self.driver.command(t_ns, command, origin_ns, origin_cycle)
        if sent is not None:
            self._command.write(sent, inputs=(sample,) if sample is not None else ())
