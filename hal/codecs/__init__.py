"""Bytes and text of the cart's devices, as pure functions: no clock, no transport."""


class CodecError(ValueError):
    """Raised when something is not a valid frame or sentence, or cannot be written as one."""


__all__ = ["CodecError"]
