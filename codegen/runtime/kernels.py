"""Functions of generated modules that compiled code calls by their address, and the vectorisation of machine code.

A kernel reads and fills arrays through pointers to their first numbers; its other arguments are numbers. Code that is
common to all problems calls a kernel by its address. The address is an integer and does not become part of numba's
cache on disk.

`packed_operations` lets LLVM combine neighbouring operations into one vector instruction (SLP vectorisation).
Factorisations then take 15 to 30 percent less time. numba has one option for all code of a process, which is off by
default. Machine code that is already on disk stays as it is.

numba stores the module name of a function, and imports that module when it reads the machine code again. A copy of a
module, or a module imported from another folder, has another name. The import would then end in a ModuleNotFoundError.
`name_by_text` gives functions a name that is a digest of the text of their file. It does not depend on the folder or on
the import, and no other text has it. Functions of the same name in different modules are therefore never confused.
"""

import ctypes
import hashlib
import inspect
import os
import sys
from collections.abc import Iterable
from contextlib import contextmanager
from functools import cached_property, lru_cache
from importlib import import_module
from pathlib import Path
from threading import Lock
from types import FunctionType, ModuleType
from typing import Any, ClassVar

import numpy as np
from numba import cfunc, config, njit, types

from codegen.runtime.addresses import CTYPES, REALS, Reals, callback
from codegen.runtime.kept_code import add_checksums, fresh_folder, start_of, statistics_of

NUMBERS = {
    "t": types.float64, "count": types.int64, "columns": types.int64, "fraction": types.float64,
}  # fmt: skip
"""Types of those arguments of kernels that are numbers, by name; all others are pointers to floating-point numbers."""

ONLY_COMPILED: Any = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""Options for functions that only compiled functions call: numba leaves out the entry points for Python and C."""


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


def is_kept(function):
    """Return True if machine code of a Python function is on disk."""
    folder = fresh_folder(function.__code__.co_filename, identity_of(function))
    if folder is None:
        return False
    start = start_of(function)
    return any(name.startswith(start) and name.endswith(".nbi") for name in os.listdir(folder))


def problem_of(module):
    """Return the object `problem` of the generated module with the name `module`."""
    return import_module(module).problem


class Addressed:
    """A Python function that is compiled when its address is first needed.

    With `is_interpreted`, or if numba is switched off, the address belongs to a callback into the Python interpreter.
    """

    def __init__(self, function, is_interpreted=False):
        self.function, self.is_interpreted, self.__doc__ = function, is_interpreted, function.__doc__
        self.__name__, self.__module__ = function.__name__, function.__module__
        if not is_interpreted:
            name_by_text(function)

    def __reduce__(self):
        """Pickle the function as its name, by which another process finds the function."""
        return self.__name__

    @cached_property
    def address(self):
        """The address of the function, which is valid as long as `compiled` exists."""
        return self.compiled.address

    def compiled_as(self, signature, **options):
        """Return the result of `cfunc` with a numba signature and options, compiled or read from the disk."""
        name = name_by_text(self.function)  # again, for functions that the file has defined since the last call
        folder = fresh_folder(self.function.__code__.co_filename, name)
        with packed_operations():
            made = cfunc(signature, cache=True, error_model="numpy", **options)(self.function)
        if not made.cache_hits:
            add_checksums(folder, start_of(self.function))
        return made

    @property
    def stats(self):
        """The Statistics of the function: the folder of its machine code, and counts of reads and of compilations."""
        return statistics_of(self.function, self.__dict__.get("compiled"))


class Kernel(Addressed):
    """A function that fills arrays.

    Python calls a kernel with numpy arrays, and without the arguments `count` and `columns`, which follow from shapes.
    """

    returns: ClassVar[types.Type] = types.void
    options: ClassVar[dict[str, object]] = {}

    def __init__(self, function, is_interpreted=False):
        super().__init__(function, is_interpreted)
        self.names = tuple(inspect.signature(function).parameters)
        self.kinds = [NUMBERS.get(name, REALS) for name in self.names]

    @cached_property
    def compiled(self):
        """The compiled function, or the callback if the kernel is interpreted."""
        if self.is_interpreted or config.DISABLE_JIT:
            return callback(self.returns(*self.kinds), self._interpreted)
        return self.compiled_as(self.returns(*self.kinds), **self.options)

    @cached_property
    def inlined(self):
        """The function, compiled so that numba inlines it into other compiled functions of the same module."""
        return njit(error_model="numpy", forceinline=True, **ONLY_COMPILED)(self.function)

    @cached_property
    def _called(self):
        """The ctypes function for calls from Python."""
        kinds = [ctypes.c_void_p if kind is REALS else CTYPES[kind] for kind in self.kinds]
        return ctypes.CFUNCTYPE(CTYPES[self.returns], *kinds)(self.address)

    def __call__(self, *values):
        """Call the function with arrays and numbers; raise ValueError for an array that is not float64."""
        arguments, copies = with_counts(self.names, values), []
        for i, value in enumerate(arguments):
            if isinstance(value, np.ndarray):
                if value.dtype != np.float64:
                    raise ValueError(f"{self.names[i]} is an array of {value.dtype}, expected float64")
                if not value.flags.c_contiguous:
                    copies.append((value, value.copy()))
                    value = copies[-1][1]
                arguments[i] = value.ctypes.data
        result = self._called(*arguments)
        for value, copy in copies:
            value[...] = copy  # the function may have filled the copy
        return result

    def _interpreted(self, *values):
        """Call the Python function with the `values` that a callback receives.

        A function that calls `carray` itself gets the pointers. Other functions get arrays of length LONG, as the true
        length is unknown.
        """
        if "carray" in self.function.__code__.co_names:
            return self.function(*values)
        return self.function(*(np.ctypeslib.as_array(v, (LONG,)) if isinstance(v, Reals) else v for v in values))


class Value(Kernel):
    """A kernel that returns a number."""

    returns: ClassVar[types.Type] = types.float64


class Contracted(Kernel):
    """A kernel in which the compiler may combine a product and a sum without rounding the product."""

    options: ClassVar[dict[str, object]] = {"fastmath": {"contract"}}


LONG = 1 << 24
"""The length of arrays that replace pointers in interpreted kernels; only the numbers of the true length exist."""


def with_counts(names: Iterable[str], values: Iterable[Any]) -> list[Any]:
    """Return the values of all arguments of a kernel, given the values of all but `count` and `columns`.

    `names` are the names of all arguments. `count` is the last dimension but one of the array before it, and `columns`
    is the last dimension.
    """
    remaining, arguments = list(values), list[Any]()
    for name in names:
        if name in ("count", "columns"):
            arguments.append(arguments[-1].shape[-2 if name == "count" else -1])
        else:
            arguments.append(remaining.pop(0))
    return arguments


# The number of active `packed_operations`, and the option's value before the first. They are stored with the option,
# in numba's configuration, which standalone modules share although they have copies of the definitions of this file.
PACKING = vars(config).setdefault("_packing_of_codegen", {"lock": Lock(), "blocks": 0, "before": 0})


@contextmanager
def packed_operations():
    """Switch SLP vectorisation on for all code that numba compiles in a `with` block or in a decorated function.

    The first block to begin sets the option. The last block to end restores the option, unless other code has changed
    it.
    """
    with PACKING["lock"]:
        if not PACKING["blocks"]:
            PACKING["before"] = getattr(config, "SLP_VECTORIZE", 0)
            config.SLP_VECTORIZE = 1
        PACKING["blocks"] += 1
    try:
        yield
    finally:
        with PACKING["lock"]:
            PACKING["blocks"] -= 1
            if not PACKING["blocks"] and config.SLP_VECTORIZE == 1:
                config.SLP_VECTORIZE = PACKING["before"]
