"""The cart's drivers on a store: whose time stamps carry, and when they may be wired to another command."""

import pytest

from hal.bus import CanBus
from hal.devices.odometry import TickNode
from hal.errors import WiringError
from hal.host import CartHost, drive_pointer
from hal.signals import ActuatorCommand, DriveCommand, Limit, Odometry, Pose, SystemState
from rtdb import Store

TICK_NS = 10_000_000
SECOND_NS = 1_000_000_000


@pytest.fixture
def store():
    with Store.create(t0_ns=5 * SECOND_NS, tick_ns=TICK_NS) as store:
        yield store


def turn(store: Store, host: CartHost, ticks: int, devices_ns: int = 0) -> None:
    """Let the host work; devices_ns: how much their time is ahead of the store's."""
    for _ in range(ticks):
        cycle = store.tick()
        host.step(cycle, store.now_ns + devices_ns)


def test_stamps_are_the_stores_whatever_time_the_devices_keep(store):
    bus = CanBus("direct")
    host, wheels = CartHost(store, bus), TickNode(bus, 91.0, 91.0)
    ahead_ns = 100 * SECOND_NS
    turn(store, host, 1, ahead_ns)
    wheels.poll(store.now_ns + TICK_NS + ahead_ns, 0.0, 0.0)
    turn(store, host, 2, ahead_ns)
    assert store.find("odometry/travel", Odometry).visible(3).t_data_ns == 5 * SECOND_NS + 2 * TICK_NS


def test_age_of_a_command_is_counted_in_the_stores_time(store):
    host = CartHost(store, CanBus("direct"))
    drive = store.join("guard").insert("drive", DriveCommand)
    drive.write(DriveCommand(speed_mps=1.0), t_data_ns=store.now_ns)
    host.obey("guard/drive")
    sent = store.find("actuators/command", ActuatorCommand)
    turn(store, host, 21, 77 * SECOND_NS)
    assert sent.latest().value.limit is Limit.NONE
    turn(store, host, 10, 77 * SECOND_NS)
    assert sent.latest().value.limit is Limit.STALE


def test_hal_is_wired_anew_while_disabled_only(store):
    host = CartHost(store, CanBus("direct"))
    guard = store.join("guard")
    for name, speed_mps in (("drive", 1.0), ("other", 2.0)):
        guard.insert(name, DriveCommand).write(DriveCommand(speed_mps=speed_mps))
    host.obey("guard/drive")
    sent, config = store.find("actuators/command", ActuatorCommand), store.find("actuators/config")
    turn(store, host, 4)
    assert sent.latest().value.speed_mps == 1.0
    writer = store.core.write
    payload = config.schema.pack({"inputs": {"drive": "guard/other"}})
    host.driver.state = SystemState.ENABLED
    writer(config.handle, payload, store.now_ns, ())
    turn(store, host, 4)
    assert config.visible(store.cycle).value == {"inputs": {"drive": "guard/drive"}}, "what is in force"
    assert sent.latest().value.speed_mps == 1.0
    host.driver.state = SystemState.READY
    writer(config.handle, payload, store.now_ns, ())
    turn(store, host, 4)
    assert config.visible(store.cycle).value == {"inputs": {"drive": "guard/other"}}
    assert sent.latest().value.speed_mps == 2.0


def test_hal_refuses_what_is_no_command_and_keeps_its_own(store):
    host = CartHost(store, CanBus("direct"))
    drive = store.join("guard").insert("drive", DriveCommand)
    drive.write(DriveCommand(speed_mps=1.0))
    store.join("localise").insert("pose", Pose).write(Pose(speed_mps=3.0))
    host.obey("guard/drive")
    config = store.find("actuators/config")
    for pointer in ("localise/pose", "guard/driv"):
        store.core.write(config.handle, config.schema.pack({"inputs": {"drive": pointer}}), store.now_ns, ())
        turn(store, host, 4)
        assert config.latest().value == {"inputs": {"drive": "guard/drive"}}
    assert store.find("actuators/command", ActuatorCommand).latest().value.speed_mps == 1.0


def test_who_is_told_to_stop_obeys_nobody(store):
    host = CartHost(store, CanBus("direct"))
    store.join("guard").insert("drive", DriveCommand).write(DriveCommand(speed_mps=1.0))
    host.obey("guard/drive")
    turn(store, host, 4)
    host.stop()
    turn(store, host, 4)
    sent = store.find("actuators/command", ActuatorCommand).latest().value
    assert (sent.speed_mps, sent.limit) == (0.0, Limit.NO_COMMAND)
    assert sent.brake > 0.0


@pytest.mark.parametrize(
    "config", [None, {}, {"inputs": "guard/drive"}, {"inputs": {"steer": "a/b"}}, {"inputs": {"drive": 1}}, {"x": 1}]
)
def test_a_configuration_without_a_command_is_an_error(config):
    with pytest.raises(WiringError):
        drive_pointer(config)
