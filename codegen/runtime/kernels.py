"""Functions of generated modules that compiled code calls by their address, and packed operations of machine code.

A kernel reads and fills arrays by pointers to their first entries; its other arguments are numbers. Code that is common
to all problems calls a kernel by its address, an integer, which does not take part in numba's cache on disk.

Packed operations let LLVM put neighbouring operations into one instruction. With them, factorisations take 15 to 30
percent less time. numba has one option for all code of a process and leaves it off. Machine code that is on the disk
already stays as it was compiled.
"""

import ctypes
import inspect
from collections.abc import Iterable
from contextlib import contextmanager
from functools import cached_property
from importlib import import_module
from threading import Lock
from typing import Any, ClassVar

import numpy as np
from numba import cfunc, config, njit, types

from codegen.runtime.addresses import CTYPES, REALS, Reals, callback
from codegen.runtime.identity import name_by_text
from codegen.runtime.kept_code import add_checksums, fresh_folder, start_of, statistics_of

NUMBERS = {
    "t": types.float64, "count": types.int64, "columns": types.int64, "fraction": types.float64,
}  # fmt: skip
"""Arguments that are numbers, by name; all others are pointers to floating-point numbers."""

ONLY_COMPILED: Any = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""Options of functions that only compiled functions call: numba leaves out entries by which Python and C call them."""


def problem_of(module):
    """Return the problem of a generated module, by the name of the module."""
    return import_module(module).problem


class Addressed:
    """A function that is compiled when its address is first asked for.

    With `is_interpreted`, or where numba is switched off, the address is that of a callback into the interpreter.
    """

    def __init__(self, function, is_interpreted=False):
        self.function, self.is_interpreted, self.__doc__ = function, is_interpreted, function.__doc__
        self.__name__, self.__module__ = function.__name__, function.__module__
        if not is_interpreted:
            name_by_text(function)

    def __reduce__(self):
        """Pickle the function as its name, by which another process finds it."""
        return self.__name__

    @cached_property
    def address(self):
        """The address of the function; `compiled` has to be kept with it."""
        return self.compiled.address

    def compiled_as(self, signature, **options):
        """Return the result of `cfunc` for the function, compiled or read from the disk."""
        name = name_by_text(self.function)  # for functions defined in its file since the last call, too
        folder = fresh_folder(self.function.__code__.co_filename, name)
        with packed_operations():
            made = cfunc(signature, cache=True, error_model="numpy", **options)(self.function)
        if not made.cache_hits:
            add_checksums(folder, start_of(self.function))
        return made

    @property
    def stats(self):
        """The folder of the machine code of the function, and how often it was read from there or compiled."""
        return statistics_of(self.function, self.__dict__.get("compiled"))


class Kernel(Addressed):
    """A function that fills arrays.

    Called from Python, a kernel takes arrays of numpy, without numbers of particles and of columns.
    """

    returns: ClassVar[Any] = types.void
    options: ClassVar[dict[str, Any]] = {}

    def __init__(self, function, is_interpreted=False):
        super().__init__(function, is_interpreted)
        self.names = tuple(inspect.signature(function).parameters)
        self.kinds = [NUMBERS.get(name, REALS) for name in self.names]

    @cached_property
    def compiled(self):
        """The compiled function, or the callback."""
        if self.is_interpreted or config.DISABLE_JIT:
            return callback(self.returns(*self.kinds), self._interpreted)
        return self.compiled_as(self.returns(*self.kinds), **self.options)

    @cached_property
    def inlined(self):
        """The function that becomes part of compiled functions of the same module."""
        return njit(error_model="numpy", forceinline=True, **ONLY_COMPILED)(self.function)

    @cached_property
    def _called(self):
        """The function for calls from Python."""
        kinds = [ctypes.c_void_p if kind is REALS else CTYPES[kind] for kind in self.kinds]
        return ctypes.CFUNCTYPE(CTYPES[self.returns], *kinds)(self.address)

    def __call__(self, *values):
        """Call the function with arrays and numbers; ValueError for an array of other than floating-point numbers."""
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
            value[...] = copy  # the function may have filled it
        return result

    def _interpreted(self, *values):
        """Call the function of Python.

        A function that does not make arrays of its pointers gets arrays, whose true length is unknown.
        """
        if "carray" in self.function.__code__.co_names:
            return self.function(*values)
        return self.function(*(np.ctypeslib.as_array(v, (LONG,)) if isinstance(v, Reals) else v for v in values))


class Value(Kernel):
    """A function that returns a number."""

    returns: ClassVar[Any] = types.float64


class Contracted(Kernel):
    """A function in which products may be added without being rounded before."""

    options: ClassVar[dict[str, Any]] = {"fastmath": {"contract"}}


LONG = 1 << 24
"""Length of the array at a pointer; the memory behind the true length must not be read."""


def with_counts(names: Iterable[str], values: Iterable[Any]) -> list[Any]:
    """Return the values of all arguments of a kernel, including those called `count` and `columns`.

    `count` is the last dimension but one of the array before it, `columns` the last dimension.
    """
    remaining, arguments = list(values), list[Any]()
    for name in names:
        if name in ("count", "columns"):
            arguments.append(arguments[-1].shape[-2 if name == "count" else -1])
        else:
            arguments.append(remaining.pop(0))
    return arguments


# Shared by all modules, and therefore kept beside the option: the number of open blocks, and the value before them.
PACKING = vars(config).setdefault("_packing_of_codegen", {"lock": Lock(), "blocks": 0, "before": 0})


@contextmanager
def packed_operations():
    """Pack operations in all code that numba compiles while the block, or a function that it decorates, runs.

    The first block to begin sets the option. The last one to end restores it, unless it was changed in between.
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
