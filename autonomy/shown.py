"""Shown: what a module shows in the replay, as JSON that fits into its object. Showing never harms the module."""

import json
import math
from typing import Any


def shown(values: dict[str, Any], n_bytes: int) -> dict[str, Any]:
    """Give the values as plain JSON; what is no number, text or list of them becomes text, what does not fit is named.

    Lists of pairs are points in M.
    """
    out: dict[str, Any] = {}
    left = n_bytes - 40
    for name, value in values.items():
        plain = _plain(value, 3)
        size = len(json.dumps({str(name): plain}, ensure_ascii=False).encode())
        if size > left:
            out["left_out"] = str(name)[:20]
            continue
        out[str(name)] = plain
        left -= size
    return out


def _plain(value: Any, depth: int) -> Any:
    if hasattr(value, "tolist"):  # numpy
        value = value.tolist()
    if value is None or isinstance(value, bool | str | int):
        return value if not isinstance(value, int) or abs(value) < 1 << 53 else str(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, list | tuple) and depth:
        return [_plain(item, depth - 1) for item in value]
    return f"{value!r:.200}"
