"""Module names of functions of generated modules, under which numba stores and links their machine code.

numba stores the module name of a function, and imports that module when it reads the machine code again. A copy of a
module, or a module imported from another folder, has another name. The import would then end in a ModuleNotFoundError.
The name from this module is a digest of the text of the file. It does not depend on the folder or on the import, and no
other text has it. Functions of the same name in different modules are therefore never confused.
"""

import hashlib
import os
import sys
from functools import lru_cache
from pathlib import Path
from types import FunctionType, ModuleType

PREFIX = "codegen_text_"


def name_by_text(function):
    """Set `__module__` of a Python function, and of all compiled functions in its file, to a name from the file's text.

    Return the name. The name is empty, and nothing is set, if there is no file.
    """
    name = identity_of(function)
    if not name and os.path.isfile(file := function.__code__.co_filename):
        name = digest_of(file, os.stat(file).st_mtime_ns)
    if not name:
        return ""
    sys.modules.setdefault(name, ModuleType(name))
    space = function.__globals__
    values = list(space.values())
    compiled = [getattr(value, name, None) for value in values for name in ("py_func", "function", "caller")]
    for other in (function, *compiled):
        if isinstance(other, FunctionType) and other.__globals__ is space and not identity_of(other):
            other.__module__ = name
    return name


def identity_of(function):
    """Return the name that `name_by_text` has given to a function, or "" if there is no such name."""
    name = function.__module__ or ""
    return name if name.startswith(PREFIX) else ""


@lru_cache
def digest_of(file, _changed):
    """Return the name that follows from the text of a file; `_changed`, its time of change, is a key of the cache."""
    digest = hashlib.sha256(Path(file).read_bytes()).hexdigest()
    return f"{PREFIX}{digest[:24]}"
