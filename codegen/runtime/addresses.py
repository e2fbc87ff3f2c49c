"""Calls of functions by their address, from compiled code.

Code that is common to all problems is compiled once. It calls the loops over intervals and the linear system of a
problem by address. An address is an integer, which does not take part in numba's cache on disk. Arrays are passed by
the address of their data, `array.ctypes.data`.

If numba is switched off by NUMBA_DISABLE_JIT, the same names are functions of Python, which call by ctypes.
"""

import ctypes
from typing import Any

import numpy as np
from llvmlite import ir
from numba import cfunc, config, types
from numba.core import cgutils
from numba.extending import intrinsic

REALS, INTEGERS = types.CPointer(types.float64), types.CPointer(types.int64)
LOOP = types.float64(REALS, types.int64, types.float64, REALS, REALS, types.int64, REALS)
"""A loop over intervals: unknowns, steps, h, nodes, parameters, parameters of each body, the array to fill."""
SYSTEM = types.int64(
    types.int64, types.int64, types.int64, types.int64, INTEGERS, REALS, REALS, REALS, types.int64, REALS, INTEGERS,
    REALS, types.int64,
)  # fmt: skip
"""A linear system, as `kkt.system.solve_system`: is_new, bodies, steps, inverses, tables, entries, gradient, diagonal,
equations, factors, order, step, is_wanted."""


class Reals(ctypes.POINTER(ctypes.c_double)):  # type: ignore[misc]
    """A pointer to numbers, which the interpreter reads as numbers of numpy's type."""

    _type_ = ctypes.c_double

    def __getitem__(self, index):
        """Return a number."""
        return np.float64(super().__getitem__(index))


CTYPES: dict[Any, Any] = {
    types.void: None, types.float64: ctypes.c_double, types.int64: ctypes.c_int64, REALS: Reals,
    INTEGERS: ctypes.POINTER(ctypes.c_int64),
}  # fmt: skip


def callback(signature, function):
    """Return the entry by which compiled code calls a function of Python; `address` is its address.

    The function gets numbers of numpy's type, which divide by zero as numbers in machine code do.
    """

    def interpreted(*values):
        return function(*(np.float64(value) if isinstance(value, float) else value for value in values))

    kinds = [CTYPES[kind] for kind in signature.args]
    entry = ctypes.CFUNCTYPE(CTYPES[signature.return_type], *kinds)(interpreted)
    entry.address = ctypes.cast(entry, ctypes.c_void_p).value
    return entry


def entry_of(signature, function):
    """Return a function compiled for calls by address, or a callback if numba is switched off."""
    if config.DISABLE_JIT:
        return callback(signature, function)
    return cfunc(signature, cache=True, error_model="numpy")(function)


_INTEGER, _REAL = ir.IntType(64), ir.DoubleType()
_KINDS = {types.int64: _INTEGER, types.float64: _REAL}


def _calling(signature):
    """Return signature and generator of an intrinsic that calls the address in its first argument with the others."""

    def generate(context, builder, _, values):
        kinds = [_KINDS[kind] for kind in signature.args]
        return _call(builder, _KINDS[signature.return_type], kinds, values[0], values[1:])

    return signature.return_type(types.int64, *signature.args), generate


def _call(builder, returned, kinds, address, values):
    """Call a function of some kinds of arguments at an address."""
    function = ir.FunctionType(returned, kinds).as_pointer()
    return builder.call(builder.inttoptr(address, function), values)


_LOOP_BY_NUMBERS = types.float64(*[types.int64] * 2, types.float64, *[types.int64] * 4)
_SYSTEM_BY_NUMBERS = types.int64(*[types.int64] * 13)


def _run(signature, address, values):
    """Call the function at an address from Python, with numbers and addresses of arrays."""
    kinds = [CTYPES[kind] for kind in signature.args]
    numbers = [float(v) if kind is types.float64 else int(v) for v, kind in zip(values, signature.args, strict=True)]
    result = ctypes.CFUNCTYPE(CTYPES[signature.return_type], *kinds)(int(address))(*numbers)
    return np.float64(result) if signature.return_type is types.float64 else result


def _run_with_tuple(returned, address, values):
    """Call the function at an address from Python, with a tuple of numbers and addresses of arrays."""
    kinds = [types.float64 if isinstance(value, float) else types.int64 for value in values]
    return _run(returned(*kinds), address, values)


def _ahead(pointer, count):
    """Return the pointer, or the rest of the array, `count` entries behind another one, in Python."""
    if isinstance(pointer, np.ndarray):
        return pointer[count:]
    return ctypes.cast(ctypes.cast(pointer, ctypes.c_void_p).value + 8 * int(count), type(pointer))


def compiled_or(interpreted):
    """Return a decorator that makes an intrinsic, or returns `interpreted` if numba is switched off."""
    return lambda generator: interpreted if config.DISABLE_JIT else intrinsic(generator)


@compiled_or(lambda address, *values: _run(_LOOP_BY_NUMBERS, address, values))
def call_loop(typingctx, address, unknowns, steps, h, nodes, parameters, width, filled):
    """Call the LOOP at an address."""
    return _calling(_LOOP_BY_NUMBERS)


@compiled_or(lambda address, *values: _run(_SYSTEM_BY_NUMBERS, address, values))
def call_system(
    typingctx, address, is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, order,
    step, is_wanted,
):  # fmt: skip
    """Call the SYSTEM at an address."""
    return _calling(_SYSTEM_BY_NUMBERS)


@compiled_or(lambda address, values: _run_with_tuple(types.void, address, values))
def call(typingctx, address, values):
    """Call the function at an address, which returns nothing, with a tuple of numbers and addresses of arrays."""
    return _calling_with_tuple(types.void, address, values)


@compiled_or(lambda address, values: _run_with_tuple(types.float64, address, values))
def call_value(typingctx, address, values):
    """Call the function at an address with a tuple of numbers and addresses of arrays; return its number."""
    return _calling_with_tuple(types.float64, address, values)


def _calling_with_tuple(returned, address, values):
    """Return what `_calling` does for an intrinsic whose second argument is a tuple of numbers."""
    kinds = [_REAL if isinstance(kind, types.Float) else _INTEGER for kind in values.types]
    result = _REAL if returned is types.float64 else ir.IntType(8).as_pointer()  # an empty pointer for no result

    def generate(context, builder, _, arguments):
        value = _call(builder, result, kinds, arguments[0], cgutils.unpack_tuple(builder, arguments[1]))
        return value if returned is types.float64 else context.get_dummy_value()

    return returned(address, values), generate


@compiled_or(lambda array: array.ctypes.data)
def data_of(typingctx, array):
    """Return the address of the first number of an array, without counting a reference."""

    def generate(context, builder, signature, values):
        data = context.make_array(signature.args[0])(context, builder, values[0]).data
        return builder.ptrtoint(data, _INTEGER)

    return types.int64(array), generate


@compiled_or(lambda address: ctypes.cast(int(address), Reals))
def reals_at(typingctx, address):
    """Return the pointer to floating-point numbers at an address, for `carray`."""
    return REALS(types.int64), lambda context, builder, _, values: builder.inttoptr(values[0], _REAL.as_pointer())


@compiled_or(lambda address: ctypes.cast(int(address), CTYPES[INTEGERS]))
def integers_at(typingctx, address):
    """Return the pointer to integers at an address, for `carray`."""
    return INTEGERS(types.int64), lambda context, builder, _, values: builder.inttoptr(values[0], _INTEGER.as_pointer())


@compiled_or(_ahead)
def ahead(typingctx, pointer, count):
    """Return the pointer to the number that is `count` entries behind another."""
    signature = pointer(pointer, types.int64)
    return signature, lambda context, builder, _, values: builder.gep(values[0], [values[1]])
