"""Have numba write little intermediate code for an entry of an array, which a solver is mostly made of.

For each `a[i, j]`, numba takes the whole array apart, on the stack: references, sizes, strides of all axes. LLVM has to
clear most of that away. Here sizes and the address are taken out, and no more. An index below zero counts from the end,
as it does in numba.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any


def short_entries(own: Callable[..., Any]) -> Callable[..., Any]:
    """The code of an entry of an array in rows; numba's own for whatever else is asked for."""
    from numba.core import types as numba_types

    types: Any = numba_types
    numbers = {types.float64, types.int64, types.uint64}

    def index_types(context: Any, signature: Any) -> tuple[Any, ...]:
        """The types of the indices of a single number, one for each axis; none where it is not as simple as that."""
        array, index, *value = signature.args
        plain = type(array) is types.Array and array.layout == "C" and array.aligned and array.dtype in numbers
        if not plain or any(kind != array.dtype for kind in value) or context.enable_boundscheck:
            return ()
        kinds = index.types if isinstance(index, types.BaseTuple) else (index,)
        simple = all(isinstance(kind, types.Integer) and kind.bitwidth == types.intp.bitwidth for kind in kinds)
        return tuple(kinds) if simple and len(kinds) == array.ndim else ()

    def get_function(self: Any, fn: Any, sig: Any, _firstcall: bool = True) -> Any:
        key = fn.typing_key if isinstance(fn, types.Function) else None
        if key is not operator.getitem and key is not operator.setitem:
            return own(self, fn, sig, _firstcall)
        kinds = index_types(self, sig)
        if not kinds:
            return own(self, fn, sig, _firstcall)
        fields = self.data_model_manager[sig.args[0]]
        data, shape = fields.get_field_position("data"), fields.get_field_position("shape")
        is_tuple = isinstance(sig.args[1], types.BaseTuple)

        def access(builder: Any, args: Any, loc: Any = None) -> Any:
            array, index, *value = args
            places = [builder.extract_value(index, axis) for axis in range(len(kinds))] if is_tuple else [index]
            sizes = [builder.extract_value(array, (shape, axis)) for axis in range(len(kinds))]
            offset = None
            for kind, place, size in zip(kinds, places, sizes, strict=True):
                if kind.signed:
                    place = _from_the_start(builder, place, size)
                offset = place if offset is None else builder.add(builder.mul(offset, size), place)
            pointer = builder.gep(builder.extract_value(array, data), [offset])
            return builder.store(*value, pointer) if value else builder.load(pointer)

        return access

    return get_function


def _from_the_start(builder: Any, place: Any, size: Any) -> Any:
    """An index that may count from the end, as one from the start."""
    from llvmlite import ir  # type: ignore[import-untyped]

    if isinstance(place, ir.Constant) and place.constant >= 0:
        return place
    is_negative = builder.icmp_signed("<", place, place.type(0))
    return builder.select(is_negative, builder.add(place, size), place)
