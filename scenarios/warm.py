"""Warm images: the whole of a drive at one moment, so that an episode begins there without driving up to it again.

The two stores are saved as bytes. The objects around them (devices, drivers, hosts, modules, their random generators)
are pickled as one graph. What never changes, or has no copy (stores, handles, records, the world of pybullet), is kept
by reference, so an image belongs to the drive that it was taken of.
"""

import io
import logging
import pickle
import types
from typing import Any

from autonomy.contain import Prints
from autonomy.follow import Station
from autonomy.module import InputPort, OutputPort
from hal.signals import LocalPlane
from rtdb import Component, Object, Record, Sample, Schema, Store
from sim.cart import SimSetup
from sim.plant import CartParams
from sim.terrain import Terrain
from sim.world import World

from .cart import CartSetup
from .run import Drive
from .scenario import Scenario

KEPT = (
    CartParams,
    CartSetup,
    Component,
    InputPort,
    LocalPlane,
    Object,
    OutputPort,
    Prints,
    Record,
    Sample,
    Scenario,
    Schema,
    SimSetup,
    Station,
    Store,
    Terrain,
    World,
    io.TextIOBase,
    logging.Logger,
    type,
    types.FunctionType,
    types.ModuleType,
)


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self.kept: list[Any] = []
        self._index: dict[int, int] = {}

    def persistent_id(self, obj: Any) -> int | None:
        """Name what is kept by reference."""
        if not isinstance(obj, KEPT):
            return None
        index = self._index.get(id(obj))
        if index is None:
            index = self._index[id(obj)] = len(self.kept)
            self.kept.append(obj)
        return index


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: bytes, kept: list[Any]) -> None:
        super().__init__(io.BytesIO(data))
        self._kept = kept

    def persistent_load(self, index: int) -> Any:
        """Give back what was kept by reference."""
        return self._kept[index]


class Image:
    """A drive at one moment. It must run its modules in its own process, and have no hand at the keyboard.

    beside: something that refers to the drive's parts and is to come back with them.
    """

    def __init__(self, drive: Drive, beside: object = None) -> None:
        assert drive.simulated is not None
        self.drive = drive
        self._cart, self._world = drive.cart.save(), drive.world.save()
        file = io.BytesIO()
        pickler = _Pickler(file)
        pickler.dump((drive.simulated, drive._hosts, drive.agent, drive._ended_s, beside))
        self._graph, self._kept = file.getvalue(), pickler.kept

    @property
    def size(self) -> int:
        """Bytes that the image takes."""
        return len(self._cart) + len(self._world) + len(self._graph)

    def restore(self) -> Any:
        """Make the drive what it was; returns what was beside it."""
        drive = self.drive
        drive.cart.restore(self._cart)
        drive.world.restore(self._world)
        graph = _Unpickler(self._graph, self._kept).load()
        drive.simulated, drive._hosts, drive.agent, drive._ended_s, beside = graph
        assert drive.simulated is not None
        if drive.simulated.sim.world is not None:  # one world for all drives of an environment
            drive.simulated.sim.world.furnish(drive.simulated.sim.scene)
            drive.simulated.sim.add_actors()
        drive.sim, drive.hal = drive.simulated.sim, drive.simulated.hal
        drive._list_work()
        return beside
