"""The simulated world: the cart's dynamics, sensor physics, sites. It knows nothing of who drives."""
