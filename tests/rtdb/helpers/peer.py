"""A process that runs the statements that a test sends it, one per line, and answers each with one line."""

import ast
import os
import resource
import signal
import sys
from typing import Annotated, Any

import rtdb
from rtdb import Record
from rtdb.records import array, i64


class Count(Record):
    """A counter."""

    n: Annotated[int, i64("", "number")] = 0


class Words(Record):
    """Many numbers, which a test writes all alike: where they differ, the value is torn."""

    words: Annotated[tuple[int, ...], array("i64", 64, "", "numbers")] = (0,) * 64


def run(statement: str, scope: dict[str, Any]) -> str:
    """Give the repr of the last expression's value, or the exception."""
    tree = ast.parse(statement)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    try:
        exec(compile(tree, "test", "exec"), scope)
        if last is None:
            return "None"
        return repr(eval(compile(ast.Expression(last.value), "test", "eval"), scope))
    except (Exception, KeyboardInterrupt) as error:
        return f"!{type(error).__name__}: {error}".replace("\n", "\\n")


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # some of these processes are meant to crash
    signal.signal(signal.SIGINT, signal.default_int_handler)
    names: dict[str, Any] = {name: getattr(rtdb, name) for name in rtdb.__all__}
    names |= {"Count": Count, "Words": Words, "os": os}
    for line in sys.stdin:
        print(run(ast.literal_eval(line), names), flush=True)
