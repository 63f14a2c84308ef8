"""The simulated cart on stores that keep another time than its world: stamps are the store's."""

from hal.signals import Odometry, Scan
from rtdb import Store
from scenarios.cart import TICK_NS, CartSetup, SimulatedCart
from scenarios.scenario import load_scenario


def test_every_sensor_is_stamped_in_the_stores_time() -> None:
    """In a real-time run the store's time is the host's and the world's is the scenario's: no scan may look old."""
    scenario = load_scenario("obstacles/gate")
    t0_ns = scenario.t0_ns + 12_345_678_900_000_000
    with Store.create(t0_ns=t0_ns, size=8 << 20) as cart, Store.create(t0_ns=scenario.t0_ns) as world:
        simulated = SimulatedCart(CartSetup(scenario=scenario), cart, world)
        for _ in range(60):
            simulated.before_edge(cart.cycle + 1)
            cycle = cart.tick()
            world.tick()
            for step in simulated.work:
                step(cycle, simulated.sim.t_ns)
        cart.tick()
        for name, cls, most_s in (("synlaser/scan", Scan, 0.11), ("odometry/travel", Odometry, 0.03)):
            sample = cart.find(name, cls).visible(cart.cycle)  # type: ignore[type-var]
            assert sample is not None
            assert 0 < cart.now_ns - sample.t_data_ns <= most_s * 1e9, name
        assert simulated.sim.t_ns - scenario.t0_ns == 60 * TICK_NS
        simulated.close()
