"""Numerics without symbols, which generated modules import: numpy, numba and the standard library only.

`search` solves problems of optimal control, `kkt` their linear systems, `stepping` follows motions, `particles` connects
and moves particles. Compiled functions call what is special about a problem by address (`addresses`, `kernels`).
"""

from contextlib import suppress
from pathlib import Path


def remove_stale_code(folder):
    """Remove machine code that is older than the newest source file in a folder.

    numba looks at the file of a function alone, and not at those of the functions that become part of it.
    """
    newest = max(file.stat().st_mtime_ns for file in folder.rglob("*.py"))
    for file in folder.rglob("*.nbi"):
        with suppress(FileNotFoundError):  # another process was quicker
            if file.stat().st_mtime_ns < newest:
                file.unlink()


with suppress(OSError):  # where nothing may be removed, nothing was written either
    remove_stale_code(Path(__file__).parent)
