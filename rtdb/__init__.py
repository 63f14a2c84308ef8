"""The real-time database: typed objects with history, made visible to everybody at once at clock edges."""

from .clock import ClockInfo, Kind, RunningClock
from .components import Component, ComponentInfo, State
from .errors import (
    AgedOut,
    ClockDead,
    DataTimeBackward,
    Deleted,
    InUse,
    NameTaken,
    NotOwner,
    NotRepeatable,
    NotYet,
    ObjectMissing,
    ReadDenied,
    RecordError,
    RecordingError,
    RtdbError,
    SegmentDamaged,
    Stale,
    StoreFull,
    StoreMissing,
    TooFast,
)
from .objects import HOST_DEPENDENT, STATIC, Flag, Frame, Object, Sample, View, Writer
from .realtime import RealTime, realtime
from .records import Record, Schema, schema_of
from .store import Cut, Store
from .watch import Watch

__all__ = [
    "HOST_DEPENDENT",
    "STATIC",
    "AgedOut",
    "ClockDead",
    "ClockInfo",
    "Component",
    "ComponentInfo",
    "Cut",
    "DataTimeBackward",
    "Deleted",
    "Flag",
    "Frame",
    "InUse",
    "Kind",
    "NameTaken",
    "NotOwner",
    "NotRepeatable",
    "NotYet",
    "Object",
    "ObjectMissing",
    "ReadDenied",
    "RealTime",
    "Record",
    "RecordError",
    "RecordingError",
    "RtdbError",
    "RunningClock",
    "Sample",
    "Schema",
    "SegmentDamaged",
    "Stale",
    "State",
    "Store",
    "StoreFull",
    "StoreMissing",
    "TooFast",
    "View",
    "Watch",
    "Writer",
    "realtime",
    "schema_of",
]
