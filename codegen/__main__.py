"""The command `codegen`, for `python -m codegen` and for the script; an interrupt ends it with a one-line message."""

import gc
import sys

from codegen.errors import INTERRUPTED


def run() -> None:
    """Run the command line and exit; interrupts are also handled during the import of the command line."""
    try:
        from codegen.cli import main

        main(prog_name="codegen")
    except KeyboardInterrupt:
        print(INTERRUPTED, file=sys.stderr)
        sys.exit(130)
    finally:
        gc.freeze()  # garbage collection at the end of a derivation would take a quarter of a second


if __name__ == "__main__":
    run()
