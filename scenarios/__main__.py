"""Entry of the `fairway` command: even while it is still being imported, Ctrl-C is one line."""

import sys


def main() -> None:
    """Run the command."""
    try:
        from .cli import main as run

        run()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
