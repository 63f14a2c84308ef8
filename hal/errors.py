"""Errors of the hardware abstraction."""


class HalError(Exception):
    """Base of everything that drivers, transports and profiles raise."""


class ProfileError(HalError, ValueError):
    """A profile, level or fault asks for what cannot be."""
