"""Names of functions of generated modules, under which numba files and links their machine code.

numba uses the name of the module that a function says it belongs to, and imports that module when it reads the code
back: an import by another name, as of a copy or from another folder, would end in a ModuleNotFoundError. The name that
is given here comes from the text of the file. It is the same wherever the file lies and however it is imported, and no
other module has it, so that functions of the same name are never mistaken for each other.
"""

import hashlib
import os
import sys
from functools import lru_cache
from pathlib import Path
from types import FunctionType, ModuleType

PREFIX = "codegen_text_"


def name_by_text(function):
    """Give a function of Python, and all compiled ones in its file, the name of their text; return it.

    The name is empty where there is no file.
    """
    name = identity_of(function)
    if not name and os.path.isfile(file := function.__code__.co_filename):
        name = digest_of(file, os.stat(file).st_mtime_ns)
    if not name:
        return ""
    sys.modules.setdefault(name, ModuleType(name))
    space = function.__globals__
    compiled = [getattr(value, "py_func", None) or getattr(value, "function", None) for value in list(space.values())]
    for other in (function, *compiled):
        if isinstance(other, FunctionType) and other.__globals__ is space and not identity_of(other):
            other.__module__ = name
    return name


def identity_of(function):
    """Return the name that a function was given by its text, empty if none was."""
    name = function.__module__ or ""
    return name if name.startswith(PREFIX) else ""


@lru_cache
def digest_of(file, _changed):
    """Return the name of the text of a file."""
    digest = hashlib.sha256(Path(file).read_bytes()).hexdigest()
    return f"{PREFIX}{digest[:24]}"
