"""What must be true of the module, as sentences. `pytest test_avoider.py` checks them."""

from autonomy.starters.avoider import Avoider
from autonomy.trial import trial
from hal.signals import DriveCommand, Odometry, Scan

WANTED = DriveCommand(speed_mps=1.5)


def scan_of(*ranges_m: float) -> Scan:
    """Make a scan of rays from right to left, 0.1 rad apart; 4 m is nothing seen."""
    first_rad = -0.1 * (len(ranges_m) // 2)
    return Scan(first_rad=first_rad, step_rad=0.1, max_m=4.0, mount_x_m=1.9, range_m=ranges_m)


def test_it_does_what_is_wanted_where_nothing_is_seen() -> None:
    outputs = trial(Avoider(), drive_in=WANTED, odometry=Odometry(), scan=scan_of(4.0, 4.0, 4.0))
    assert (outputs["drive"].speed_mps, outputs["drive"].steer_rad) == (1.5, 0.0)


def test_it_steers_left_of_what_stands_on_the_right() -> None:
    outputs = trial(Avoider(), drive_in=WANTED, odometry=Odometry(), scan=scan_of(2.0, 2.0, 2.0, 4.0, 4.0))
    assert outputs["drive"].steer_rad > 0.05


def test_it_stops_before_a_wall() -> None:
    outputs = trial(Avoider(), drive_in=WANTED, odometry=Odometry(), scan=scan_of(*[0.5] * 31))
    assert outputs["drive"].speed_mps == 0.0
