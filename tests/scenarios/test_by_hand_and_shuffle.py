"""Driving by hand through a real terminal; and shuffled runs, whose trace must not change."""

import os
import pty
import select
import subprocess
import sys

import pytest

from hal.bus import Frame
from hal.codecs.cartcan import SteerCmd, encode
from hal.errors import ProfileError
from hal.faults import Corruption
from hal.signals import DriveCommand
from rtdb.recording import Recording
from scenarios.by_hand import DEADMAN_NS, Hand, split_keys
from scenarios.plan import rng_of
from scenarios.run import Setup, drive
from scenarios.scenario import load_scenario

SECOND_NS = 1_000_000_000


def test_arrow_keys_change_speed_and_steering_within_their_range():
    hand = Hand()
    for k in range(40):
        hand = hand.press("up", k * 100_000_000)
    assert hand.command(4 * SECOND_NS).speed_mps == 3.0
    hand = hand.press("left", 4 * SECOND_NS)
    assert hand.command(4 * SECOND_NS) == DriveCommand(3.0, 0.04)


def test_cart_is_told_to_stop_when_no_key_comes():
    hand = Hand().press("up", SECOND_NS)
    assert hand.command(SECOND_NS + DEADMAN_NS).speed_mps > 0
    assert hand.command(SECOND_NS + DEADMAN_NS + 1).speed_mps == 0
    again = hand.press("hold", SECOND_NS + 2 * DEADMAN_NS)
    assert again.command(SECOND_NS + 2 * DEADMAN_NS).speed_mps == 0, "after a stop everything begins anew"


def test_keys_are_named_and_unknown_ones_left_out():
    assert split_keys("\x1b[A\x1b[Dx q\x1b[C") == ["up", "left", "hold", "quit", "right"]


@pytest.mark.proof  # at the pace of a hand
def test_drive_by_hand_through_a_terminal_moves_the_cart_and_is_recorded(tmp_path):
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "scenarios", "drive", "safety/host-dies", "--by-hand", "--out", str(tmp_path)]
    child = subprocess.Popen(command, stdin=theirs, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    os.close(theirs)
    assert child.stdout is not None
    mcap = tmp_path / "safety/host-dies/0/run.mcap"
    pressed = 0
    while child.poll() is None and pressed < 60:  # a key every 0.1 s, as a keyboard repeats
        select.select([], [], [], 0.1)
        if mcap.exists():
            pressed += 1
            os.write(ours, b"\x1b[A" if pressed < 50 else b"q")
    out, _ = child.communicate(timeout=60)
    os.close(ours)
    assert "Traceback" not in out, out
    assert child.returncode in (0, 1)
    drives = Recording(mcap).read("hand/drive", DriveCommand)
    assert max(row.value.speed_mps for row in drives) >= 0.5


@pytest.mark.parametrize("shuffle", [1, 2])
def test_order_placement_and_delays_do_not_change_the_trace(tmp_path, shuffle):
    scenario = load_scenario("safety/person-steps-out").model_copy(update={"duration_s": 6.0})
    hashes = []
    for k, seed in enumerate((None, shuffle)):
        path = tmp_path / f"{k}.mcap"
        drive(Setup(scenario=scenario, shuffle=seed), path)
        hashes.append(Recording(path).trace_hash())
    assert hashes[0] == hashes[1]


def test_corruption_flips_one_bit_of_some_frames_within_its_time():
    fault = Corruption(SECOND_NS, 2 * SECOND_NS, 0.5, rng_of(0)("x"))
    data = encode(SteerCmd.of(angle_rad=0.1), 3)
    early = Frame(0, "HOST", SteerCmd.ID, data, 3)
    assert all(fault(early) is early for _ in range(50))
    hit = [fault(Frame(SECOND_NS, "HOST", SteerCmd.ID, data, 3)) for _ in range(400)]
    changed = [bin(int.from_bytes(f.data, "little") ^ int.from_bytes(data, "little")).count("1") for f in hit]
    assert set(changed) == {0, 1}
    assert 150 < sum(changed) < 250


def test_byte_faults_are_refused_at_level_direct(tmp_path):
    with pytest.raises(ProfileError, match="--level wire"):
        drive(Setup(scenario=load_scenario("safety/can-corruption"), level="direct"), tmp_path / "x.mcap")
