"""Compile ahead, while a module is still being derived, what all modules have in common.

Some functions of the runtime read no size of a problem, and are therefore the same in every module: the elimination of
rows, the substitutions. Making and clearing arrays is the same everywhere as well. A process that waits for its module
compiles them, one after the other, until the module comes; the module's own functions then take over what is ready, if
they are the same to the letter.

What is compiled ahead has no machine code and no environment of its own: it is linked into what calls it, and neither
raises errors nor touches Python objects. So nothing on the disk tells the difference.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from numba import boolean, float64, int64, uint64

from codegen.machine_code.linking import forget_constants
from codegen.machine_code.shortcuts import quick_numba

MATRIX, VECTOR, ORDER, MASK = float64[:, ::1], float64[::1], uint64[::1], boolean[::1]
SUMS: dict[str, Any] = {"fastmath": {"reassoc", "contract"}}
"""How the factorisation and the substitution are compiled: their sums may be taken in any order."""
PARTS: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""Options of functions that Python does not call."""
FUNCTIONS: tuple[tuple[str, str, tuple[Any, ...], dict[str, Any]], ...] = (
    ("symmetric", "eliminate_rows", (MATRIX, int64, int64, MATRIX, MATRIX, ORDER), SUMS),
    ("symmetric", "subtract_products", (MATRIX, MATRIX, int64, int64, int64, int64, MATRIX), SUMS),
    ("symmetric", "solve_backward", (MATRIX, ORDER, int64, int64, VECTOR), SUMS),
    ("symmetric", "solve_forward", (MATRIX, ORDER, int64, int64, VECTOR), SUMS),
    ("symmetric", "solve_pivots", (MATRIX, ORDER, int64, VECTOR), SUMS),
    ("arrays", "zero_vector", (int64,), {}),
    ("arrays", "zero_matrix", (int64, int64), {}),
    ("arrays", "clear", (MATRIX,), {}),
    ("symmetric", "subtract_row", (float64, MATRIX, int64, int64, MATRIX, uint64), SUMS),
    ("inverse", "invert_positive_definite", (MATRIX, int64), SUMS),
    ("norms", "measure", (VECTOR, MASK), {}),
)
"""Files and functions of the runtime with the types of their arguments, those first that take longest.

The last column is what a function without options of its own inherits, in numba, from the one that calls it.
"""

_READY: dict[str, Any] = {}
"""Functions of the runtime by name, of which some have been compiled."""
_MODULES: list[ModuleType] = []
"""The modules by whose names numba tells them from all other code."""


def compile_ahead(has_come: Callable[[], bool]) -> None:
    """Compile what all modules have in common until the module that is waited for has come."""
    with quick_numba():
        for function, types, inherited in _functions():
            if has_come():
                return
            own = dict(function.targetoptions)
            function.targetoptions |= {**inherited, **own}
            function.compile(types)
            function.targetoptions = own


def take_over(functions: list[Any]) -> None:
    """Give the functions of a module what has been compiled ahead of those that are the same."""
    for nameless in _MODULES:
        vars(nameless).pop("__name__", None)  # numba keeps no environment that it could not find by this name
    for function in functions:
        twin = _READY.get(function.py_func.__name__)
        if twin is not None and _are_same(function, twin):
            for compiled in twin.overloads.values():
                function.add_overload(compiled)


def _functions() -> Iterator[tuple[Any, Any, dict[str, Any]]]:
    for file, name, types, inherited in FUNCTIONS:
        runtime = import_module(f"codegen.runtime.kkt.{file}")
        if name not in _READY:
            _prepare(runtime)
        yield _READY[name], types, inherited


def _prepare(runtime: Any) -> None:
    """Have the functions of a file compiled as parts of others, under names that no other code has."""
    text = Path(runtime.__file__).read_bytes()
    name = f"codegen_common_{hashlib.sha256(text).hexdigest()[:16]}"
    _MODULES.append(sys.modules.setdefault(name, ModuleType(name)))
    for function in vars(runtime).values():
        if hasattr(function, "targetoptions") and function.stats.cache_path is None:
            function.py_func.__module__ = name
            function.targetoptions |= PARTS
            forget_constants(function)
            _READY[function.py_func.__name__] = function


def _are_same(function: Any, twin: Any) -> bool:
    """Whether two functions, with all that they read, are compiled to the same."""
    # Code objects are compared with the types of their constants; lines and how annotations are read do not matter.
    first, second = (
        f.py_func.__code__.replace(co_firstlineno=1, co_linetable=b"", co_flags=0) for f in (function, twin)
    )
    return (
        first == second
        and function.targetoptions == twin.targetoptions
        and all(
            _mean_same(function.py_func.__globals__.get(name), twin.py_func.__globals__.get(name))
            for name in first.co_names
        )
    )


def _mean_same(value: Any, other: Any) -> bool:
    """Whether two global values are the same to a compiled function."""
    if hasattr(value, "py_func") and hasattr(other, "py_func"):
        return _are_same(value, other)
    return value is other or (type(value) is type(other) and isinstance(value, (int, float)) and value == other)
