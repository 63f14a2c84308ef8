"""The host's end of the cart's devices: state machines from what a link delivers to signals."""
