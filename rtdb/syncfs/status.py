"""A component's status as JSON: what its objects show in a cut, without the component knowing.

`localise/pose#/x_m` is `pose.x_m` in `/localise/status`. The text is padded with spaces to a size that follows from the
records alone, so that a stat need not render it. A component whose only object is a JSON `status` (a script's) wrote
that text itself: it is shown as it was written.
"""

from typing import Any

import msgspec

from ..errors import AgedOut, Deleted, ReadDenied, RecordError, Stale
from ..json_object import is_json
from ..layout import Field
from ..objects import Flag, Object
from ..records import Schema
from ..store import Store

OWN = ("config", "health")  # objects with a file of their own
SCALAR_BYTES = {
    "f8": 25, "f4": 25, "i64": 20, "u64": 20, "i32": 11, "u32": 10, "i16": 6, "u16": 5, "i8": 4, "u8": 3, "bool": 5,
}  # fmt: skip
UNREADABLE = (AgedOut, Deleted, ReadDenied, RecordError, Stale)


def has_image(schema: Schema) -> bool:
    """Whether a record has pictures, which are files of their own."""
    return any(f.spec.kind == "image" for f in schema.fields)


def most_bytes(schema: Schema) -> int:
    """Give the most bytes of JSON that a value of this schema takes."""
    if is_json(schema.fields):
        return schema.size
    return 2 + sum(len(f.name) + 4 + _field_bytes(f) for f in schema.fields)


def _field_bytes(f: Field) -> int:
    if f.spec.kind == "str":
        return 2 + 6 * f.spec.n  # each byte may be a control character: \u0001
    if f.spec.kind == "enum":
        return 2 + max([3, *(len(name) for name, _ in f.values)])
    one = most_bytes(f.record) if f.spec.kind == "record" else SCALAR_BYTES[f.spec.kind]
    return one if f.spec.shape == "one" else 2 + f.spec.n * (one + 1)


class StatusView:
    """What stands in the status file of one component. Made anew when the store's directory changes."""

    def __init__(self, store: Store, objects: list[Object[Any]]) -> None:
        self._store = store
        self._objects = [obj for obj in objects if self._is_shown(obj)]
        said = [obj for obj in self._objects if obj.name.endswith("/status")]
        self.written = said[0] if said == self._objects and said and is_json(said[0].stored.fields) else None
        self.size = 2 + sum(len(_key(obj)) + 4 + max(4, most_bytes(obj.stored)) for obj in self._objects) + 1
        self._cycle, self._text = -1, b""  # of the last cut that was asked for
        self._write, self._written = 0, (b"", 0)  # of the last write that was looked at

    @staticmethod
    def _is_shown(obj: Object[Any]) -> bool:
        return _key(obj) not in OWN and not has_image(obj.stored) and not obj.flags & Flag.READ_DENY

    def text(self, cycle: int) -> bytes:
        """Give the file's content in a cut."""
        if self.written is not None:
            return self.said(cycle)[0]
        if self._cycle != cycle:
            self._cycle, self._text = cycle, padded({_key(o): self._value(o, cycle) for o in self._objects}, self.size)
        return self._text

    def said(self, cycle: int) -> tuple[bytes, int]:
        """Give the text that a script wrote, and when; empty and 0 before the first."""
        assert self.written is not None
        core, handle = self._store.core, self.written.handle
        write = core.visible_write(handle, cycle)
        if write != self._write:
            raw = core.read(handle, write) if write else None
            self._write, self._written = write, (b"", 0) if raw is None else (raw[0].partition(b"\0")[0], raw[2])
        return self._written

    def sources(self, cycle: int) -> list[tuple[int, int]]:
        """Give the writes (object id, number) that a cut shows here: causes of what a reader makes of them."""
        return [source for obj in self._objects if (source := source_of(obj, cycle)) is not None]

    @staticmethod
    def _value(obj: Object[Any], cycle: int) -> Any:
        try:
            if is_json(obj.stored.fields):
                raw = obj._store.core.visible(obj.handle, cycle)
                return None if raw is None else msgspec.Raw(raw[0].partition(b"\0")[0])
            sample = obj.visible(cycle)
        except UNREADABLE:
            return None
        return None if sample is None else sample.value


def source_of(obj: Object[Any], cycle: int) -> tuple[int, int] | None:
    """Give the write of an object that a cut shows; None where there is none, and for what is written only once."""
    if obj.static:
        return None
    try:
        write = obj._store.core.visible_write(obj.handle, cycle)
    except UNREADABLE:
        return None
    return (obj.oid, write) if write else None


def padded(document: dict[str, Any], size: int) -> bytes:
    """Spell a document as one line of JSON of a constant size. What is not finite becomes null."""
    text = msgspec.json.encode(document)
    if len(text) >= size:
        raise RecordError(f"this takes {len(text)} bytes of JSON, there is room for {size - 1}")
    return text.ljust(size - 1) + b"\n"


def _key(obj: Object[Any]) -> str:
    return obj.name.partition("/")[2]


# -- pictures ---------------------------------------------------------------------------------------------------------


def pictures_of(obj: Object[Any]) -> list[tuple[str, Field]]:
    """Give the names of an object's picture files, without the ending, and the fields that they show."""
    fields = [f for f in obj.stored.fields if f.spec.kind == "image"]
    return [(_key(obj) if len(fields) == 1 else f"{_key(obj)}.{f.name}", f) for f in fields]


def picture_size(field: Field) -> int:
    """Give the size of a picture file: that of the largest picture."""
    h, w, _ = field.extent
    return len(_header(w, h)) + 3 * h * w


def picture(obj: Object[Any], field: Field, cycle: int) -> bytes:
    """Give what a picture shows in a cut as PPM (P6), padded to its constant size; black before there is one."""
    import numpy as np

    sample = obj.visible(cycle)
    h, w, channels = field.extent
    pixels = np.zeros((h, w, channels), np.uint8) if sample is None else sample.value[field.name]
    h, w, channels = pixels.shape
    if channels == 1:
        pixels = np.repeat(pixels, 3, axis=2)
    elif "BGR" in field.spec.doc:
        pixels = pixels[:, :, 2::-1]
    return (_header(w, h) + np.ascontiguousarray(pixels[:, :, :3]).tobytes()).ljust(picture_size(field), b"\0")


def _header(width: int, height: int) -> bytes:
    return b"P6\n%5d %5d\n255\n" % (width, height)
