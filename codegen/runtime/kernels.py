"""Functions of generated modules that compiled code calls by their address.

A kernel reads and fills arrays by pointers to their first entries; its other arguments are numbers. What is common to
all problems calls it by an integer, the address, which does not take part in numba's cache on disk.
"""

import ctypes
import inspect
from functools import cached_property
from importlib import import_module
from typing import Any, ClassVar

import numpy as np
from numba import cfunc, config, njit, types

from codegen.runtime.addresses import CTYPES, REALS, Reals, callback
from codegen.runtime.arguments import with_counts
from codegen.runtime.identity import name_by_text
from codegen.runtime.kept_code import add_checksums, fresh_folder, start_of, statistics_of
from codegen.runtime.packing import packed_operations

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
        """Return what `cfunc` makes of the function, or reads from the disk."""
        name = name_by_text(self.function)  # others in its file were defined since
        folder = fresh_folder(self.function.__code__.co_filename, name)
        with packed_operations():
            made = cfunc(signature, cache=True, error_model="numpy", **options)(self.function)
        if not made.cache_hits:
            add_checksums(folder, start_of(self.function))
        return made

    @property
    def stats(self):
        """Where numba keeps machine code of the function, and how often it was read from there or made."""
        return statistics_of(self.function, self.__dict__.get("compiled"))


class Kernel(Addressed):
    """A function that fills arrays.

    Called from Python, a kernel takes arrays of numpy, and no numbers of particles and of columns.
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
        """The function for compiled functions of the same module, which it becomes part of."""
        return njit(error_model="numpy", forceinline=True, **ONLY_COMPILED)(self.function)

    @cached_property
    def _called(self):
        """The function for calls from Python."""
        kinds = [ctypes.c_void_p if kind is REALS else CTYPES[kind] for kind in self.kinds]
        return ctypes.CFUNCTYPE(CTYPES[self.returns], *kinds)(self.address)

    def __call__(self, *values):
        """Call the function with arrays and numbers; ValueError for an array of other than floating-point numbers."""
        given, copies = with_counts(self.names, values), []
        for i, value in enumerate(given):
            if isinstance(value, np.ndarray):
                if value.dtype != np.float64:
                    raise ValueError(f"{self.names[i]} is an array of {value.dtype}, expected float64")
                if not value.flags.c_contiguous:
                    copies.append((value, value.copy()))
                    value = copies[-1][1]
                given[i] = value.ctypes.data
        result = self._called(*given)
        for value, copy in copies:
            value[...] = copy  # which it may have filled
        return result

    def _interpreted(self, *values):
        """Call the function of Python.

        A function that does not make arrays of its pointers gets arrays, whose length is not known here.
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
"""Entries of an array of which only the beginning is there."""
