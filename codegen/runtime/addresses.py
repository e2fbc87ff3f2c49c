"""Calls of functions by their address, from compiled code.

What is common to all problems is compiled once. What is special about a problem, its loops over intervals and its
linear system, is called by address: an integer, which does not take part in numba's cache on disk. Arrays are passed by
the address of their data, `array.ctypes.data`.
"""

from llvmlite import ir
from numba import types
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

_INTEGER, _REAL = ir.IntType(64), ir.DoubleType()
_KINDS = {types.int64: _INTEGER, types.float64: _REAL}


def _calling(signature):
    """Return what an intrinsic returns to call the address that is its first argument."""

    def generate(context, builder, _, values):
        kinds = [_KINDS[kind] for kind in signature.args[1:]]
        return _call(builder, _KINDS[signature.return_type], kinds, values[0], values[1:])

    return signature, generate


def _call(builder, returned, kinds, address, values):
    """Call a function of some kinds of arguments at an address."""
    function = ir.FunctionType(returned, kinds).as_pointer()
    return builder.call(builder.inttoptr(address, function), values)


_CALL_LOOP = types.float64(*[types.int64] * 3, types.float64, *[types.int64] * 4)
_CALL_SYSTEM = types.int64(*[types.int64] * 14)


@intrinsic
def call_loop(typingctx, address, unknowns, steps, h, nodes, parameters, width, filled):
    """Call the LOOP at an address."""
    return _calling(_CALL_LOOP)


@intrinsic
def call_system(
    typingctx, address, is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, order,
    step, is_wanted,
):  # fmt: skip
    """Call the SYSTEM at an address."""
    return _calling(_CALL_SYSTEM)


@intrinsic
def call(typingctx, address, values):
    """Call the function at an address, which returns nothing, with a tuple of numbers and addresses of arrays."""
    return _calling_with_tuple(types.void, address, values)


@intrinsic
def call_value(typingctx, address, values):
    """Call the function at an address with a tuple of numbers and addresses of arrays; return its number."""
    return _calling_with_tuple(types.float64, address, values)


def _calling_with_tuple(returned, address, values):
    """Return what an intrinsic returns to call its first argument with the numbers in its second one."""
    kinds = [_REAL if isinstance(kind, types.Float) else _INTEGER for kind in values.types]
    result = _REAL if returned is types.float64 else ir.IntType(8).as_pointer()  # an empty pointer stands for nothing

    def generate(context, builder, _, given):
        found = _call(builder, result, kinds, given[0], cgutils.unpack_tuple(builder, given[1]))
        return found if returned is types.float64 else context.get_dummy_value()

    return returned(address, values), generate


@intrinsic
def data_of(typingctx, array):
    """Return the address of the first number of an array, without counting a reference."""

    def generate(context, builder, signature, values):
        data = context.make_array(signature.args[0])(context, builder, values[0]).data
        return builder.ptrtoint(data, _INTEGER)

    return types.int64(array), generate


@intrinsic
def reals_at(typingctx, address):
    """Return the pointer to floating-point numbers at an address, for `carray`."""
    return REALS(types.int64), lambda context, builder, _, values: builder.inttoptr(values[0], _REAL.as_pointer())


@intrinsic
def integers_at(typingctx, address):
    """Return the pointer to integers at an address, for `carray`."""
    return INTEGERS(types.int64), lambda context, builder, _, values: builder.inttoptr(values[0], _INTEGER.as_pointer())


@intrinsic
def ahead(typingctx, pointer, count):
    """Return the pointer to the number that is `count` entries behind another."""
    signature = pointer(pointer, types.int64)
    return signature, lambda context, builder, _, values: builder.gep(values[0], [values[1]])
