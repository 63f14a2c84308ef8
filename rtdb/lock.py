"""Appends field numbers to a module's lock file: `python -m rtdb.lock hal.signals`. Numbers never change."""

import importlib
import json
import sys

from .errors import RecordError
from .records import Record, forget_locks, lock_path


def extend_lock(module: str) -> list[str]:
    """Number the fields of a module's records that have no number yet; return what was added.

    A record that is nested in others has its own entry, in the lock file of its own module.
    """
    loaded = importlib.import_module(module)
    path = lock_path(module)
    if path is None:
        raise RecordError(f"module {module} has no file")
    lock: dict[str, dict[str, int]] = json.loads(path.read_text()) if path.is_file() else {}
    added = []
    for name, cls in vars(loaded).items():
        if not (isinstance(cls, type) and issubclass(cls, Record) and cls.__module__ == module):
            continue
        numbers = lock.setdefault(name, {})
        for field in cls.__struct_fields__:
            if field not in numbers:
                numbers[field] = max(numbers.values(), default=0) + 1
                added.append(f"{name}.{field} = {numbers[field]}")
    path.write_text(json.dumps(lock, indent=1) + "\n")
    forget_locks()
    return added


if __name__ == "__main__":
    for line in [line for name in sys.argv[1:] for line in extend_lock(name)]:
        print(line)
