"""Machine code that numba keeps on the disk, looked through before numba reads it.

numba trusts what it reads: a file that was cut off ends in an error of pickle, one that was altered in anything, and
an index that was written just before its process was killed may name the machine code of an older text. Such files
are removed, and numba makes them anew. A process that compiles has each file carry its digest, behind the end of the
pickle, where nothing reads on; of what a killed one leaves it is only seen whether it can be read to its end.

Python keeps the bytecode of this module as well, before it runs it: where the disk is full, Python before 3.13 keeps a
part, which would end every later import.
"""

import hashlib
import io
import marshal
import os
import pickletools
import sys
from contextlib import suppress
from pathlib import Path

SEAL = b"\nsha256 of all before: "
BYTECODE_HEADER = 16  # bytes before the code itself
PICKLES = {".nbi": 2, ".nbc": 1}  # how many stand in an index, and in a file of machine code


def remove_invalid_code(functions, identity):
    """Remove machine code that is damaged, and say so, or that an older text left; return how many are damaged."""
    damaged = []
    for file in machine_code_cache(functions):
        try:
            data = file.read_bytes()
        except FileNotFoundError:  # another process was quicker
            continue
        if not is_whole(data, PICKLES[file.suffix]):
            damaged.append(file)
        elif file.suffix == ".nbi" or identity.encode() in data:
            continue
        file.unlink(missing_ok=True)
    if damaged:
        count = f"{len(damaged)} files, first" if len(damaged) > 1 else "file"
        print(f"codegen: note: damaged machine code is made anew ({count} {damaged[0]})", file=sys.stderr)
    return len(damaged)


def remove_partial_bytecode(file):
    """Remove the bytecode that Python keeps of a module where it could not be read to its end; there may be none."""
    if file is None:
        return
    try:
        marshal.loads(Path(file).read_bytes()[BYTECODE_HEADER:])
    except (EOFError, ValueError, TypeError):
        Path(file).unlink(missing_ok=True)
    except FileNotFoundError:
        pass


def add_new_checksums(functions):
    """Seal machine code if this process has made some of it; where there is no room for that, it stays as it is."""
    if any(function.stats.cache_misses for function in functions):
        with suppress(OSError):
            add_checksums(functions)


def add_checksums(functions):
    """Write the digest of each file behind its end, if it is not there; a reader sees all of a file at any time."""
    for file in machine_code_cache(functions):
        data = file.read_bytes()
        if SEAL not in data:
            temporary = file.with_name(f".{file.name}.{os.getpid()}")
            try:
                temporary.write_bytes(data + SEAL + hashlib.sha256(data).digest())
                temporary.replace(file)
            finally:
                temporary.unlink(missing_ok=True)


def machine_code_cache(functions):
    """The files in which numba keeps compiled functions of the modules that some functions belong to."""
    statistics = [(getattr(function, "stats", None), function) for function in functions]
    places = {(s.cache_path, f.py_func.__code__.co_filename) for s, f in statistics if s and s.cache_path}
    return [
        file
        for folder, source in sorted(places)
        for file in sorted(Path(folder).glob("*.nb[ic]"))
        if file.name.startswith(f"{Path(source).stem}.")
    ]


def is_whole(data, pickles):
    """Whether the bytes of a file fit their digest, or, if they have none, can be read to their end."""
    body, seal, digest = data.rpartition(SEAL)
    if seal:
        return hashlib.sha256(body).digest() == digest
    stream = io.BytesIO(data)
    try:
        for _ in range(pickles):
            for _ in pickletools.genops(stream):
                pass
    except ValueError:
        return False
    return True
