"""The command `codegen`, as `python -m codegen` and as a script, which an interrupt ends at any time in one line."""

import gc
import sys

from codegen.errors import INTERRUPTED


def run() -> None:
    """Run the command line and exit; importing it takes a while, in which it may be interrupted already."""
    try:
        from codegen.cli import main

        main(prog_name="codegen")
    except KeyboardInterrupt:
        print(INTERRUPTED, file=sys.stderr)
        sys.exit(130)
    finally:
        gc.freeze()  # to look through all that a derivation leaves behind would take a quarter of a second at the end


if __name__ == "__main__":
    run()
