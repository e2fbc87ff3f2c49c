"""Module names of functions of generated modules, under which numba stores and links their machine code.

numba uses the name of the module that a function states, and imports that module when it reads the code back. A copy of
a module, or a module imported from another folder, has another name and would end in a ModuleNotFoundError. The name
from this module is a digest of the text of the file. It does not depend on the folder or on the import, and no other
module has it. Functions of the same name in different modules are therefore never confused.
"""

import hashlib
import os
import sys
from functools import lru_cache
from pathlib import Path
from types import FunctionType, ModuleType

PREFIX = "codegen_text_"


def name_by_text(function):
    """Give a function of Python, and all compiled functions in its file, the name of their text; return the name.

    The name is empty if there is no file.
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
    """Return the name that a function has from its text, or ""."""
    name = function.__module__ or ""
    return name if name.startswith(PREFIX) else ""


@lru_cache
def digest_of(file, _changed):
    """Return the name of the text of a file."""
    digest = hashlib.sha256(Path(file).read_bytes()).hexdigest()
    return f"{PREFIX}{digest[:24]}"
