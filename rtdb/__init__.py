"""The real-time database: typed objects with history, made visible to everybody at once at clock edges."""

from .errors import (
    AgedOut,
    InUse,
    NameTaken,
    NotOwner,
    NotYet,
    ObjectMissing,
    RecordError,
    RecordingError,
    RtdbError,
    SegmentDamaged,
    StoreFull,
    StoreMissing,
    TooFast,
)
from .records import Record, Schema, schema_of
from .store import HOST_DEPENDENT, STATIC, Component, ComponentInfo, Cut, Object, Sample, Store, Writer

__all__ = [
    "HOST_DEPENDENT",
    "STATIC",
    "AgedOut",
    "Component",
    "ComponentInfo",
    "Cut",
    "InUse",
    "NameTaken",
    "NotOwner",
    "NotYet",
    "Object",
    "ObjectMissing",
    "Record",
    "RecordError",
    "RecordingError",
    "RtdbError",
    "Sample",
    "Schema",
    "SegmentDamaged",
    "Store",
    "StoreFull",
    "StoreMissing",
    "TooFast",
    "Writer",
    "schema_of",
]
