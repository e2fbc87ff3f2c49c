"""Numerics without symbols, which generated modules import.

What is common to all problems is compiled once on a machine. What is special about a problem, its loops and kernels, is
called by address (`addresses`, `kernels`), and linear systems are compiled for each shape (`kkt`). `search` solves
optimal control problems, `stepping` follows motions, `particles` is about points that interact in pairs. Kernels call
`inner_number`, `special` and `tabulated`.
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
