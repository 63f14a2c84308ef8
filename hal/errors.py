"""Errors of the hardware abstraction."""


class HalError(Exception):
    """Base of everything that drivers, transports and profiles raise."""


class ProfileError(HalError, ValueError):
    """A profile, level or fault asks for what cannot be."""


class WiringError(HalError, ValueError):
    """The actuators are wired to what cannot be, or at a time at which they cannot be."""
