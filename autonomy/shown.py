"""Shown: what a module shows in the replay, as JSON that fits into its object. Showing never harms the module."""

import json
import math
from typing import Any


def shown(values: dict[str, Any], n_bytes: int) -> dict[str, Any]:
    """Give the values as plain JSON; what is no number, text or list of them becomes text, what does not fit is named.

    Lists of pairs are points in M.
    """
    out: dict[str, Any] = {}
    left = n_bytes - 160  # for the name of what is left out, however its letters are written
    for name, value in values.items():
        key = _text(name) if isinstance(name, str) else f"{type(name).__name__} {len(out)}"
        try:
            plain = _plain(value, 3)
        except Exception as error:  # __repr__, tolist: the module's own code
            plain = f"cannot be shown: {type(error).__name__}"
        size = len(json.dumps({key: plain}, ensure_ascii=False).encode())
        if size > left:
            out["left_out"] = key.encode("ascii", "replace").decode()[:20]
            continue
        out[key] = plain
        left -= size
    return out


def _text(text: str) -> str:
    """Give a text that UTF-8 can say."""
    return text.encode("utf-8", "replace").decode()


def _plain(value: Any, depth: int) -> Any:
    if hasattr(value, "tolist"):  # numpy
        value = value.tolist()
    if isinstance(value, str):
        return _text(value)
    if value is None or isinstance(value, bool | int):
        return value if value is None or abs(value) < 1 << 53 else str(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, list | tuple) and depth:
        return [_plain(item, depth - 1) for item in value]
    return _text(f"{value!r:.200}")
