"""Machine code that numba keeps on disk: its folders, and the removal of code made with another runtime.

numba notices changes in the file of a function, and in no other file. Functions of the runtime are inlined into
functions of other files: of the runtime, of generated modules and of linear systems. Every folder of machine code
therefore has a stamp. The stamp identifies the runtime files and the version of numba with which the code was made.
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
from typing import NamedTuple

import numba
from numba import config, njit

STAMP = "codegen-runtime"
RUNTIME = Path(__file__).parent
PICKLES = {".nbi": 2, ".nbc": 1}
"""The numbers of pickles in an index file of numba (.nbi), and in a file of machine code (.nbc)."""
SEAL = b"\nsha256 of all before: "
SEALED = len(SEAL) + hashlib.sha256().digest_size


class Statistics(NamedTuple):
    """The folder of the machine code of a function, and counts of reads and of compilations."""

    cache_path: str | None
    cache_hits: Counter[str]
    cache_misses: Counter[str]


def statistics_of(function, compiled):
    """Return the Statistics of a Python function; `compiled` is the result of `cfunc`, None if not compiled."""
    read, made = Counter(), Counter()
    if hasattr(compiled, "cache_hits"):
        (read if compiled.cache_hits else made)[str(compiled.native_name)] += 1
    return Statistics(code_folder(function.__code__.co_filename), read, made)


@lru_cache
def fresh_folder(file, identity=""):
    """Return the folder in which numba keeps machine code of a file, or None if numba is switched off.

    Before that, remove machine code in the folder that was made with another runtime or is damaged. Also remove machine
    code of the file that does not contain the `identity`, the name from the text of the file.
    """
    folder = code_folder(file)
    if folder is not None:
        require_stamp(folder)
        remove_invalid(folder, f"{Path(file).stem}.", identity)
    return folder


def require_stamp(folder):
    """Unless a folder has the stamp of this runtime, remove all machine code in the folder and write the stamp."""
    stamp = Path(folder, STAMP)
    try:
        is_fresh = stamp.read_text(encoding="ascii") == fingerprint()
    except (OSError, UnicodeDecodeError):
        is_fresh = False
    if not is_fresh:
        for file in [*Path(folder).glob("*.nbi"), *Path(folder).glob("*.nbc")]:
            file.unlink(missing_ok=True)  # another process may have removed the file
        with suppress(OSError):  # on a full disk numba keeps no machine code either
            stamp.write_text(fingerprint(), encoding="ascii")


def remove_invalid(folder, start, identity=""):
    """Remove invalid files of machine code in a folder, of those whose names begin with `start`.

    Damaged files are removed with a note on stderr. Files of machine code without the text `identity` are removed, too.
    numba writes an index before the code. If the process is killed in between, the index may name the machine code of
    an older text.
    """
    damaged = []
    for file in sorted(Path(folder).glob("*.nb[ic]")):
        if not file.name.startswith(start):
            continue
        try:
            data = file.read_bytes()
        except FileNotFoundError:  # another process has removed the file
            continue
        if not is_whole(data, PICKLES[file.suffix]):
            damaged.append(file)
        elif file.suffix == ".nbi" or identity.encode() in data:
            continue
        file.unlink(missing_ok=True)
    if damaged:
        count = f"{len(damaged)} files, first {damaged[0]}" if len(damaged) > 1 else damaged[0]
        print(f"codegen: note: damaged machine code is made anew ({count})", file=sys.stderr)


def is_whole(data, pickles):
    """Return True if the bytes `data` of a file are complete.

    If they end with a checksum, the checksum must be right. Otherwise, as many complete pickles as `pickles` must be
    readable.
    """
    if data[-SEALED : len(SEAL) - SEALED] == SEAL:
        return is_sealed(data)
    stream = io.BytesIO(data)
    try:
        for _ in range(pickles):
            for _ in pickletools.genops(stream):
                pass
    except (ValueError, UnicodeDecodeError):
        return False
    return True


def sealed(data):
    """Return bytes with their checksum appended."""
    return data + SEAL + hashlib.sha256(data).digest()


def is_sealed(data):
    """Return True if the bytes `data` end with a checksum, and the checksum is right."""
    return data == sealed(data[:-SEALED])


def add_checksums(folder, start=""):
    """Append a checksum to files of machine code that have none and whose names begin with `start`.

    numba does not read the checksum. On a full disk no checksum is written.
    """
    for file in Path(folder).glob("*.nb[ic]"):
        if file.name.startswith(start):
            with suppress(OSError), open(file, "r+b") as stream:
                stream.seek(-min(SEALED, os.path.getsize(file)), os.SEEK_END)
                if not stream.read().startswith(SEAL):
                    stream.seek(0)
                    data = stream.read()
                    stream.seek(len(data))  # another process would write the same here
                    stream.write(sealed(data)[len(data) :])


@lru_cache
def code_folder(file):
    """Return the folder in which numba keeps machine code of functions of a file, or None if numba is switched off."""
    if config.DISABLE_JIT or not os.path.isfile(file):
        return None
    space = {}
    exec(compile("def function():\n    pass\n", file, "exec"), space)  # numba names the folder of a function only
    return njit(cache=True)(space["function"]).stats.cache_path


@lru_cache
def fingerprint():
    """Return a digest of numba's version and of the names, sizes and modification times of the runtime's files."""
    digest = hashlib.sha256(numba.__version__.encode())
    for folder, _, names in sorted(os.walk(RUNTIME)):
        for name in sorted(names):
            if name.endswith(".py"):
                status = os.stat(os.path.join(folder, name))
                part = f"{os.path.relpath(folder, RUNTIME)}/{name} {status.st_size} {status.st_mtime_ns}\n"
                digest.update(part.encode())
    return digest.hexdigest()


def start_of(function):
    """Return the beginning of the names of the files in which numba keeps machine code of a Python function."""
    code = function.__code__
    return f"{Path(code.co_filename).stem}.{function.__qualname__}-{code.co_firstlineno}."


def runtime_folders():
    """Return the folders in which numba keeps machine code of the runtime."""
    files = (next((Path(folder, n) for n in names if n.endswith(".py")), None) for folder, _, names in os.walk(RUNTIME))
    return [folder for file in files if file is not None and (folder := code_folder(str(file))) is not None]


for folder in runtime_folders():
    require_stamp(folder)
    remove_invalid(folder, "")
