"""Calls of compiled functions by their address, from compiled code.

The compiled code of a search is the same for all problems. It calls the loops over intervals and the linear system of a
problem by their addresses. An address is an integer and does not become part of numba's cache on disk. Arrays are
passed by the address of their first number, `array.ctypes.data`.

If the environment variable NUMBA_DISABLE_JIT switches numba off, the functions of this module are plain Python
functions that call through ctypes.
"""

import ctypes
from typing import Any

import numpy as np
from llvmlite import ir
from numba import cfunc, config, njit, typeof, types
from numba.core import cgutils
from numba.extending import intrinsic

REALS, INTEGERS = types.CPointer(types.float64), types.CPointer(types.int64)
LOOP = types.float64(REALS, types.int64, types.float64, REALS, REALS, types.int64, REALS)
"""The signature of a compiled function that loops over all intervals and returns a number.

The arguments are the unknowns, the number of intervals, their mean length h, the nodes, the parameters of all bodies,
the number of parameters of each body, and the array to fill.
"""
SYSTEM = types.int64(
    types.int64, types.int64, types.int64, types.int64, INTEGERS, REALS, REALS, REALS, types.int64, REALS, INTEGERS,
    REALS, types.int64,
)  # fmt: skip
"""The signature of a compiled function that factors and solves the linear system of a Newton step.

The arguments are those of `kkt.system.solve_system` without the shape: is_new, bodies, steps, inverses, tables,
entries, gradient, diagonal, equations, factors, order, step, is_wanted.
"""


class Reals(ctypes.POINTER(ctypes.c_double)):  # type: ignore[misc]
    """A ctypes pointer to floating-point numbers whose items are numbers of numpy."""

    _type_ = ctypes.c_double

    def __getitem__(self, index):
        """Return the number at `index` as a float64 of numpy."""
        return np.float64(super().__getitem__(index))


CTYPES: dict[Any, Any] = {
    types.void: None, types.float64: ctypes.c_double, types.int64: ctypes.c_int64, REALS: Reals,
    INTEGERS: ctypes.POINTER(ctypes.c_int64),
}  # fmt: skip


def callback(signature, function):
    """Return a ctypes function by which compiled code calls a Python function; its attribute `address` is the address.

    `signature` is the numba signature. The Python function receives numbers of numpy, which divide by zero as numbers
    in machine code do.
    """

    def interpreted(*values):
        return function(*(np.float64(value) if isinstance(value, float) else value for value in values))

    kinds = [CTYPES[kind] for kind in signature.args]
    entry = ctypes.CFUNCTYPE(CTYPES[signature.return_type], *kinds)(interpreted)
    entry.address = ctypes.cast(entry, ctypes.c_void_p).value
    return entry


def entry_of(signature, function):
    """Return a function compiled for calls by address, or its `callback` if numba is switched off."""
    if config.DISABLE_JIT:
        return callback(signature, function)
    return cfunc(signature, cache=True, error_model="numpy")(function)


_INTEGER, _REAL = ir.IntType(64), ir.DoubleType()
_KINDS = {types.int64: _INTEGER, types.float64: _REAL}


def _calling(signature):
    """Return the signature and the code generator of an intrinsic that calls a function by its address.

    The first argument of the intrinsic is the address. The function at the address has the `signature` and receives the
    other arguments.
    """

    def generate(context, builder, _, values):
        kinds = [_KINDS[kind] for kind in signature.args]
        return _call(builder, _KINDS[signature.return_type], kinds, values[0], values[1:])

    return signature.return_type(types.int64, *signature.args), generate


def _call(builder, returned, kinds, address, values):
    """Emit the LLVM call of the function at `address` and return its result.

    `returned` and `kinds` are the LLVM types of the result and of the arguments.
    """
    function = ir.FunctionType(returned, kinds).as_pointer()
    return builder.call(builder.inttoptr(address, function), values)


_LOOP_BY_NUMBERS = types.float64(*[types.int64] * 2, types.float64, *[types.int64] * 4)
_SYSTEM_BY_NUMBERS = types.int64(*[types.int64] * 13)


def _run(signature, address, values):
    """Call the function at `address` from Python; `values` are numbers and addresses of arrays."""
    kinds = [CTYPES[kind] for kind in signature.args]
    numbers = [float(v) if kind is types.float64 else int(v) for v, kind in zip(values, signature.args, strict=True)]
    result = ctypes.CFUNCTYPE(CTYPES[signature.return_type], *kinds)(int(address))(*numbers)
    return np.float64(result) if signature.return_type is types.float64 else result


def _run_with_tuple(returned, address, values):
    """Call the function at `address` from Python; `values` are floats, and integers such as addresses of arrays."""
    kinds = [types.float64 if isinstance(value, float) else types.int64 for value in values]
    return _run(returned(*kinds), address, values)


def _ahead(pointer, count):
    """Return, in Python, a pointer moved forward by `count` numbers, or an array without its first `count` numbers."""
    if isinstance(pointer, np.ndarray):
        return pointer[count:]
    return ctypes.cast(ctypes.cast(pointer, ctypes.c_void_p).value + 8 * int(count), type(pointer))


def compiled_or(interpreted):
    """Return a decorator that makes an intrinsic, or that returns `interpreted` if numba is switched off."""
    return lambda generator: interpreted if config.DISABLE_JIT else intrinsic(generator)


@compiled_or(lambda address, *values: _run(_LOOP_BY_NUMBERS, address, values))
def call_loop(typingctx, address, unknowns, steps, h, nodes, parameters, width, filled):
    """Call the loop over intervals at `address`; the other arguments are those of LOOP, with arrays as addresses."""
    return _calling(_LOOP_BY_NUMBERS)


@compiled_or(lambda address, *values: _run(_SYSTEM_BY_NUMBERS, address, values))
def call_system(
    typingctx, address, is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, order,
    step, is_wanted,
):  # fmt: skip
    """Call the linear system at `address`; the other arguments are those of SYSTEM, with arrays as addresses."""
    return _calling(_SYSTEM_BY_NUMBERS)


@compiled_or(lambda address, values: _run_with_tuple(types.void, address, values))
def call(typingctx, address, values):
    """Call the function at `address`, which returns nothing; `values` is a tuple of numbers and addresses of arrays."""
    return _calling_with_tuple(types.void, address, values)


@compiled_or(lambda address, values: _run_with_tuple(types.float64, address, values))
def call_value(typingctx, address, values):
    """Return the number that the function at `address` returns; `values` is a tuple of numbers and array addresses."""
    return _calling_with_tuple(types.float64, address, values)


def _calling_with_tuple(returned, address, values):
    """Return the signature and the code generator of an intrinsic that calls a function by its address.

    The first argument of the intrinsic is the address. The function at the address receives the entries of the second
    argument, a tuple, as its arguments.
    """
    kinds = [_REAL if isinstance(kind, types.Float) else _INTEGER for kind in values.types]
    result = _REAL if returned is types.float64 else ir.IntType(8).as_pointer()  # an empty pointer for no result

    def generate(context, builder, _, arguments):
        value = _call(builder, result, kinds, arguments[0], cgutils.unpack_tuple(builder, arguments[1]))
        return value if returned is types.float64 else context.get_dummy_value()

    return returned(address, values), generate


def calling_compiled(returned):
    """Return a function (address, arguments) that calls a function of numba, which returns the type `returned`.

    The function must raise nothing. Its address comes from `address_of_compiled`. The types in the tuple `arguments`
    must be the types for which it is compiled.
    """

    @compiled_or(lambda function, arguments: function(*arguments))
    def calling(typingctx, address, arguments):
        kinds = tuple(arguments.types)

        def generate(context, builder, _, values):
            kind = context.call_conv.get_function_type(returned, kinds).as_pointer()
            function = builder.inttoptr(values[0], kind)
            given = cgutils.unpack_tuple(builder, values[1])
            return context.call_conv.call_function(builder, function, returned, kinds, given)[1]

        return returned(types.int64, arguments), generate

    return calling


def address_of_compiled(function, arguments):
    """Return the address of the machine code of a function of numba for the types of `arguments`.

    If numba is switched off, return the function itself.
    """
    if config.DISABLE_JIT:
        return function
    signature = tuple(typeof(argument) for argument in arguments)
    function.compile(signature)
    code = function.overloads[signature]
    return code.library.get_pointer_to_function(code.fndesc.llvm_func_name)


@compiled_or(lambda array: array.ctypes.data)
def data_of(typingctx, array):
    """Return the address of the first number of an array; the reference count of the array stays the same."""

    def generate(context, builder, signature, values):
        data = context.make_array(signature.args[0])(context, builder, values[0]).data
        return builder.ptrtoint(data, _INTEGER)

    return types.int64(array), generate


@compiled_or(lambda address: ctypes.cast(int(address), Reals))
def reals_at(typingctx, address):
    """Return a pointer to the floating-point numbers at an address, as `carray` of numba takes it."""
    return REALS(types.int64), lambda context, builder, _, values: builder.inttoptr(values[0], _REAL.as_pointer())


@compiled_or(lambda address: ctypes.cast(int(address), CTYPES[INTEGERS]))
def integers_at(typingctx, address):
    """Return a pointer to the integers at an address, as `carray` of numba takes it."""
    return INTEGERS(types.int64), lambda context, builder, _, values: builder.inttoptr(values[0], _INTEGER.as_pointer())


@compiled_or(_ahead)
def ahead(typingctx, pointer, count):
    """Return the pointer moved forward by `count` numbers."""
    signature = pointer(pointer, types.int64)
    return signature, lambda context, builder, _, values: builder.gep(values[0], [values[1]])


@njit(error_model="numpy", forceinline=True)
def moved(address, count):
    """Return the address of the number that lies `count` numbers after the number at `address`."""
    return address + 8 * count
