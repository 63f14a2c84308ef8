"""The records of a module as C structs: `python -m rtdb.c_header my_records > my_records.h`.

Beside each struct stands the text of its schema, which a C program gives to fw_schema_add.
"""

import importlib
import json
import sys

from .errors import RecordError
from .records import Record, schema_of


def header_of(module: str) -> str:
    """Write the C header of a module's records."""
    loaded = importlib.import_module(module)
    records = [cls for cls in vars(loaded).values() if isinstance(cls, type) and issubclass(cls, Record)]
    records = [cls for cls in records if cls.__module__ == module]
    if not records:
        raise RecordError(f"module {module} declares no records")
    structs: dict[str, str] = {}
    texts = []
    for cls in records:
        schema = schema_of(cls)
        structs |= schema.c_structs()
        texts.append(f"#define FW_{schema.name.upper()}_SCHEMA \\\n    {json.dumps(schema.to_text())}")
    guard = module.replace(".", "_").upper() + "_H"
    parts = [f"/* Generated from {module}: python -m rtdb.c_header {module} */", f"#ifndef {guard}\n#define {guard}"]
    parts += [
        "#include <stdbool.h>\n#include <stddef.h>\n#include <stdint.h>",
        "#ifdef __cplusplus\n#define _Alignas alignas\n#define _Static_assert static_assert\n#endif",
    ]
    parts += [*structs.values(), *texts, "#endif"]
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    sys.stdout.write("".join(header_of(name) for name in sys.argv[1:]))
