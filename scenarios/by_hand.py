"""Driving by hand: arrow keys in the terminal become drive commands, behind guard and limits like any other.

Up and down change the speed wanted, left and right the steering. The dead-man rule: some key must come at least every
DEADMAN_NS (hold one down, or press the space bar), else the cart is told to stop.
"""

import os
import select
import sys
import termios
import tty
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Self

from autonomy.wiring import Stack
from hal.signals import DriveCommand
from rtdb import Store

DEADMAN_NS = 800_000_000
SPEED_STEP_MPS, MAX_SPEED_MPS = 0.25, 3.0
STEER_STEP_RAD, MAX_STEER_RAD = 0.04, 0.44
POINTER = "hand/drive"
KEYS = {"\x1b[A": "up", "\x1b[B": "down", "\x1b[C": "right", "\x1b[D": "left", " ": "hold", "q": "quit"}


@dataclass(frozen=True, slots=True)
class Hand:
    """What the keys have asked for so far."""

    speed_mps: float = 0.0
    steer_rad: float = 0.0
    last_key_ns: int = -DEADMAN_NS
    quit: bool = False

    def press(self, key: str, t_ns: int) -> "Hand":
        """Give what is asked for after a key."""
        speed, steer = self.speed_mps, self.steer_rad
        if t_ns - self.last_key_ns > DEADMAN_NS:
            speed = steer = 0.0  # after a stop by the dead-man rule everything begins anew
        speed += {"up": SPEED_STEP_MPS, "down": -SPEED_STEP_MPS}.get(key, 0.0)
        steer += {"left": STEER_STEP_RAD, "right": -STEER_STEP_RAD}.get(key, 0.0)
        return Hand(
            min(max(speed, 0.0), MAX_SPEED_MPS), min(max(steer, -MAX_STEER_RAD), MAX_STEER_RAD), t_ns, key == "quit"
        )

    def command(self, t_ns: int) -> DriveCommand:
        """Give the command at a time: a stop once no key has come for too long."""
        if t_ns - self.last_key_ns > DEADMAN_NS:
            return DriveCommand(0.0, self.steer_rad)
        return DriveCommand(self.speed_mps, self.steer_rad)


def split_keys(text: str) -> list[str]:
    """Name the keys in what a terminal sent; unknown ones are left out."""
    keys, rest = [], text
    while rest:
        code = next((c for c in KEYS if rest.startswith(c)), None)
        if code is not None:
            keys.append(KEYS[code])
        rest = rest[len(code) if code else 1 :]
    return keys


class HandHost:
    """The keyboard as a device: commits `hand/drive` every 40 ms. Use it in a `with`: the terminal is put back."""

    def __init__(self, store: Store) -> None:
        self._drive = store.join("hand").insert("drive", DriveCommand, every=4, phase=3)
        self.hand = Hand()
        self._kept = termios.tcgetattr(sys.stdin)

    def __enter__(self) -> Self:
        tty.setcbreak(sys.stdin)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._kept)

    def step(self, _cycle: int, t_ns: int) -> None:
        """Read the keys that have come; commit when due."""
        while select.select([sys.stdin], [], [], 0.0)[0]:
            data = os.read(sys.stdin.fileno(), 64)
            if not data:
                self.hand = replace(self.hand, quit=True)  # the terminal is gone
                break
            for key in split_keys(data.decode(errors="ignore")):
                self.hand = self.hand.press(key, t_ns)
        if t_ns % 40_000_000 == 20_000_000:
            self._drive.write(self.hand.command(t_ns), t_ns)


def by_hand(stack: Stack) -> Stack:
    """Put the hand where the follower was: whoever listened to the follower's drive listens to the hand."""
    wires = tuple(
        replace(
            w, inputs={port: POINTER if pointer == "follow/drive" else pointer for port, pointer in w.inputs.items()}
        )
        for w in stack.wires
        if w.component != "follow"
    )
    return Stack(wires, POINTER if stack.command == "follow/drive" else stack.command)
