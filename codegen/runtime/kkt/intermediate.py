"""The linear system for all shapes, translated by numba into LLVM's intermediate code.

The sizes of a Shape are arguments of this code, and `specialised` makes them constants. The program `python -m
codegen.runtime.kkt.intermediate` prints the code. It is a program, because numba gives no machine code to functions
that are linked into their callers, and Python could no longer call them.
"""

import re
import sys

from numba import njit

from codegen.runtime.addresses import SYSTEM
from codegen.runtime.kkt import elimination, shape, stages, symmetric, system
from codegen.runtime.kkt.shape import SHAPE, Shape, place_of
from codegen.runtime.kkt.system import solve_system
from codegen.runtime.linking import link_inner_functions


@njit(error_model="numpy")
def solve_any_shape(
    is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, orders, step, is_wanted
):
    """Call `solve_system` with the Shape in the index tables."""
    p = place_of(tables, SHAPE)
    sizes = Shape(
        tables[p], tables[p + 1], tables[p + 2], tables[p + 3], tables[p + 4], tables[p + 5], tables[p + 6],
        tables[p + 7], tables[p + 8], tables[p + 9], tables[p + 10], tables[p + 11], tables[p + 12], tables[p + 13],
    )  # fmt: skip
    return solve_system(
        sizes, is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, orders, step,
        is_wanted,
    )  # fmt: skip


def translated():
    """Return the intermediate code of `solve_any_shape` and of all functions that it calls."""
    files = shape, symmetric, stages, elimination, system
    link_inner_functions(value for file in files for value in vars(file).values() if hasattr(value, "py_func"))
    link_inner_functions([solve_any_shape])
    solve_any_shape.compile(SYSTEM.args)
    # numba counts references to arrays. The linear system works on the memory of its caller, where there are none.
    code = solve_any_shape.inspect_llvm(SYSTEM.args)
    return re.sub(r"^.*\bcall\b.*@NRT_(incref|decref)\(.*\n", "", code, flags=re.MULTILINE)


if __name__ == "__main__":
    sys.stdout.write(translated())
