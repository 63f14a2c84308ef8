"""The simulated end of the cart's devices: sans-I/O state machines that say what the real ones would say."""
