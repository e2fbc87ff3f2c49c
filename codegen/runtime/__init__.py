"""Ordinary numerics that need no symbol, included verbatim in the generated modules that need them.

Every file here is plain, tested Python. Its functions refer to the kernels and sizes of a generated module by name;
so that they can be imported and tested by themselves, each file imports those names from `example.py`, a hand-written
stand-in. `emit.py` drops the import lines, and the generated module's own definitions take their place.
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
