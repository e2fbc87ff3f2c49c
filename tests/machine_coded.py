"""What generated modules have alike, such as the elimination of dense rows, as machine code where the rest is not.

More than half of the time of interpreted solves is spent in it. It is the text of the module itself that is compiled,
once for all modules and all processes of a run; a module in which it reads otherwise keeps its own, interpreted.
"""

from __future__ import annotations

import fcntl
import hashlib
import importlib.util
import sys
import types
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import numpy as np

from codegen.cache import cache_folder
from codegen.emit import runtime_source, write

FILES = {
    "symmetric": (
        "eliminate_rows", "subtract_row", "subtract_products", "solve_forward", "solve_pivots", "solve_backward",
    ),
    "arrays": ("clear", "copy_part"),
    "norms": ("measure",),
    "barrier": ("measure_optimality", "add_barrier", "move"),
    "pair_algebra": ("symmetric_product", "cholesky", "solve_cholesky"),
    "packed_logarithms": ("packed_log1p", "packed_x_minus_log1p", "packed_log1p_minus_ratio"),
}  # fmt: skip
"""Files of the runtime whose text depends on no problem, and those of their functions that others call the most."""


class Switch:
    """Whether anything is compiled: not by `pytest -m fast`."""

    on = True


def for_module(text: str) -> Mapping[str, Callable[..., Any]]:
    """Functions by name that may stand for those of a module with such a text."""
    if not Switch.on:
        return {}
    return {name: function for part in FILES if source(part) in text for name, function in functions(part).items()}


@cache
def source(part: str) -> str:
    """The text that a module includes."""
    return runtime_source((part,))


@cache
def functions(part: str) -> dict[str, Callable[..., Any]]:
    """Those of one file, which the first process that calls them compiles."""
    head = "from typing import NamedTuple\n\nimport numpy as np\nfrom numba import njit\n\n\n"
    digest = hashlib.sha256(source(part).encode()).hexdigest()[:16]
    path = cache_folder() / f"{part}_{digest}" / f"{part}.py"
    write(path, f"{head}{source(part)}\n")
    spec = importlib.util.spec_from_file_location(f"{part}_{digest}", path)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)  # where numba looks for it
    spec.loader.exec_module(module)
    return {name: one_at_a_time(module, name) for name in FILES[part]}


def one_at_a_time(module: types.ModuleType, name: str) -> Callable[..., Any]:
    """A compiled function, kept on the disk, so that of several processes the first one compiles it."""
    function = getattr(module, name)
    function.enable_caching()

    def called(*arguments: Any) -> Any:
        if function.overloads:
            return of_numpy(function(*arguments))
        with (cache_folder() / f"{module.__name__}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            return of_numpy(function(*arguments))

    return called


def of_numpy(found: Any) -> Any:
    """Numbers as interpreted functions return them: where one of them is zero, Python's own raise errors."""
    if isinstance(found, tuple):
        return tuple(map(of_numpy, found))
    return np.float64(found) if isinstance(found, float) else found
