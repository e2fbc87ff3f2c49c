"""Machine code that numba keeps on disk: where it is, and how none is left that was made with another runtime.

numba notices that the file of a function has changed, and looks at no other file. Functions of the runtime become part
of functions in other files: of the runtime, of generated modules, of linear systems. A stamp in every folder of machine
code therefore says with which files of the runtime, and by which numba, the code was made.
"""

import hashlib
import io
import os
import pickletools
import sys
from collections import Counter
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numba
from numba import config, njit

STAMP = "codegen-runtime"
RUNTIME = Path(__file__).parent
PICKLES = {".nbi": 2, ".nbc": 1}
"""How many pickles stand in an index of numba, and in a file of machine code."""


class Statistics(NamedTuple):
    """Where numba keeps machine code of a function, and how often it was read from there or made, by signature."""

    cache_path: str | None
    cache_hits: Counter[Any]
    cache_misses: Counter[Any]


def statistics_of(function, compiled):
    """Return the statistics of a function and of what `cfunc` has made of it, or None if it was not compiled."""
    read, made = Counter(), Counter()
    if hasattr(compiled, "cache_hits"):
        (read if compiled.cache_hits else made)[str(compiled.native_name)] += 1
    return Statistics(code_folder(function.__code__.co_filename), read, made)


@lru_cache
def fresh_folder(file):
    """Return the folder in which numba keeps machine code of a file, None if numba is switched off.

    Machine code in it that was made with another runtime, or was cut off, is removed.
    """
    folder = code_folder(file)
    if folder is None:
        return None
    stamp = Path(folder, STAMP)
    try:
        is_fresh = stamp.read_text(encoding="ascii") == fingerprint()
    except (OSError, UnicodeDecodeError):
        is_fresh = False
    remove_cut_off(folder)
    if not is_fresh:
        for index in Path(folder).glob("*.nbi"):
            index.unlink(missing_ok=True)  # another process may be quicker
        with suppress(OSError):  # on a full disk machine code is not kept either
            stamp.write_text(fingerprint(), encoding="ascii")
    return folder


def remove_cut_off(folder):
    """Remove files of machine code in a folder that were cut off, which numba would fail to read, and say so."""
    for suffix, pickles in PICKLES.items():
        for file in Path(folder).glob(f"*{suffix}"):
            with suppress(FileNotFoundError):  # another process may be quicker
                stream = io.BytesIO(file.read_bytes())
                try:
                    for _ in range(pickles):
                        for _ in pickletools.genops(stream):
                            pass
                except ValueError:
                    file.unlink(missing_ok=True)
                    print(f"codegen: note: damaged machine code is made anew ({file})", file=sys.stderr)


@lru_cache
def code_folder(file):
    """Return the folder in which numba keeps machine code of functions of a file; None if numba is switched off."""
    if config.DISABLE_JIT or not os.path.isfile(file):
        return None
    space = {}
    exec(compile("def function():\n    pass\n", file, "exec"), space)  # numba tells only of functions
    return njit(cache=True)(space["function"]).stats.cache_path


@lru_cache
def fingerprint():
    """Return a digest of names, sizes and times of change of the runtime's files, and of numba's version."""
    digest = hashlib.sha256(numba.__version__.encode())
    for folder, _, names in sorted(os.walk(RUNTIME)):
        for name in sorted(names):
            if name.endswith(".py"):
                status = os.stat(os.path.join(folder, name))
                part = f"{os.path.relpath(folder, RUNTIME)}/{name} {status.st_size} {status.st_mtime_ns}\n"
                digest.update(part.encode())
    return digest.hexdigest()


def is_kept(function):
    """Return True if numba keeps machine code of a function of Python in a file."""
    code = function.__code__
    folder = fresh_folder(code.co_filename)
    if folder is None:
        return False
    start = f"{Path(code.co_filename).stem}.{function.__qualname__}-{code.co_firstlineno}."
    return any(name.startswith(start) and name.endswith(".nbi") for name in os.listdir(folder))


for folder, _, names in os.walk(RUNTIME):
    first = next((name for name in names if name.endswith(".py")), None)
    if first is not None:
        fresh_folder(os.path.join(folder, first))
