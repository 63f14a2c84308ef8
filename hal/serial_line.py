"""A serial line inside one process: what the device sent by a time, the driver reads at that time."""

from typing import Any, Protocol


class SerialDevice(Protocol):
    """A simulated device at the far end: bytes at level wire, decoded messages at level direct."""

    silent: bool

    def poll(self, t_ns: int) -> Any:
        """Give what has left the device since the last poll."""


class SerialDriver(Protocol):
    """The host end."""

    def feed(self, data: bytes, t_ns: int) -> None:
        """Take bytes."""

    def hear(self, sentence: Any, t_ns: int) -> None:
        """Take a decoded message."""


def carry(device: SerialDevice, driver: SerialDriver, t_ns: int) -> None:
    """Move what has arrived by t_ns."""
    sent = device.poll(t_ns)
    if not sent:
        return  # as at most ticks
    if isinstance(sent, bytes):
        driver.feed(sent, t_ns)
    else:
        for message in sent:
            driver.hear(message, t_ns)
