"""The linear system for problems of any shape, whose numbers are read at run time.

A factorisation takes twice as long as with constants, and nothing is compiled for a new shape: where problems are many
and small, as in tests, that is quicker.
"""

from functools import lru_cache

from codegen.runtime.addresses import SYSTEM, entry_of
from codegen.runtime.kkt.shape import Shape
from codegen.runtime.kkt.system import solve_system
from codegen.runtime.kkt.tables import SHAPE, place_of


@lru_cache(maxsize=1)
def compiled_system():
    """Return the compiled function, which has the address."""

    def system(
        is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, orders, step,
        is_wanted,
    ):  # fmt: skip
        """Factor the KKT matrix if it `is_new`, and solve for the step if it `is_wanted`; see `solve_system`."""
        p = place_of(tables, SHAPE)
        shape = Shape(
            tables[p], tables[p + 1], tables[p + 2], tables[p + 3], tables[p + 4], tables[p + 5], tables[p + 6],
            tables[p + 7], tables[p + 8], tables[p + 9], tables[p + 10], tables[p + 11], tables[p + 12], tables[p + 13],
        )  # fmt: skip
        return solve_system(
            shape, is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, orders,
            step, is_wanted,
        )  # fmt: skip

    return entry_of(SYSTEM, system)


def any_shape_address():
    """Return the address of the linear system of any shape."""
    return compiled_system().address
