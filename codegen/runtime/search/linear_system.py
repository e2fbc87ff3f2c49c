"""The linear system of Newton's method on a grid: second derivatives, factorisation, solution."""

from typing import NamedTuple

import numpy as np
from numba import njit

from codegen.runtime.addresses import call_loop, call_system
from codegen.runtime.kkt.system import SINGULAR, factor_sizes, root_index
from codegen.runtime.search.grid import NONE, layout_of


class System(NamedTuple):
    """The storage of the linear system on a grid: index tables, work space, second derivatives, scaling factors.

    Attributes
    ----------
    address, loop : int
        Addresses of the compiled linear system, and of the loop that fills all second derivatives.
    tables : array of int
        Index tables, see `kkt.shape`.
    factors, orders : array
        Work space of the factorisation.
    entries : array
        All second derivatives.
    scaled, costless : array
        Scaling factors of the second derivatives with and without the cost. `scaled` is empty if all factors are one.
    inverses : int
        The number of condensed blocks that are stored for each body.
    counts : array of int
        Eight numbers. Bodies; entries of an interval, of a start, and of an end. Then linking variables of one body
        alone, and of all bodies with the multipliers of their conditions. Last the unknowns of an element and of a
        stride.
    equations : int
        The number of imposed equations.
    rows, columns : array of int
        Local rows and columns of the entries, see `Structure.entries`.
    """

    address: int
    loop: int
    tables: np.ndarray
    factors: np.ndarray
    orders: np.ndarray
    entries: np.ndarray
    scaled: np.ndarray
    costless: np.ndarray
    inverses: int
    counts: np.ndarray
    equations: int
    rows: np.ndarray
    columns: np.ndarray


def allocate_system(grid):
    """Return the System on a grid, with new storage."""
    problem, s = grid.problem, grid.problem.structure
    inverses = 1 if s.constant and grid.is_uniform else grid.steps
    reals, integers = factor_sizes(s.shape, s.staged.size, s.bodies, grid.steps, inverses)
    system = System(
        problem.system, problem.hessians.address, s.tables, np.zeros(reals), np.zeros(integers, np.int64),
        np.zeros(s.entry_count(grid.steps)), NONE, NONE, inverses, s.counts, layout_of(grid).multipliers.size,
        *s.entries,
    )  # fmt: skip
    return with_entry_factors(grid, system)


def with_entry_factors(grid, system):
    """Return `system` with the scaling factors of the second derivatives on a grid."""
    s = grid.problem.structure
    if not grid.sizes.size:
        return system._replace(scaled=NONE, costless=s.without_cost)
    factors = np.empty((2, s.without_cost.size))
    fill_entry_factors(
        grid.sizes, grid.forces, system.rows, system.columns, s.local_is_multiplier, s.without_cost, system.counts,
        factors,
    )  # fmt: skip
    return system._replace(scaled=factors[0], costless=factors[1])


@njit(error_model="numpy", forceinline=True)
def global_index(local, first, element, own, bodies, body, linking):
    """Return the index, among all unknowns, of the local unknown `local` of an interval.

    `first` is the index of the first unknown of the interval, and `linking` the index of the first linking variable.
    """
    return first + local if local < element else linking + root_index(own, bodies, body, local - element)


@njit(cache=True, error_model="numpy")
def fill_entry_factors(sizes, forces, rows, columns, is_multiplier, without_cost, counts, factors):
    """Fill the scaling factors of the second derivatives of an interval, of both ends, and of coupling conditions.

    A factor is the square root of the product of `sizes` and `forces` of both unknowns, which include the weight of the
    cost. The first row of `factors` (2, entries) is with the cost. The second row is without the cost: its factors are
    zero for two primal unknowns. The diagonal entry of a multiplier has the factor one. Intervals that lack the
    equation have a one there. A smaller entry would change its sign if the diagonal of the multipliers is shifted.
    """
    bodies, own, root, element = counts[0], counts[4], counts[5], counts[6]
    linking = sizes.size - root
    for j in range(rows.size):
        if is_multiplier[rows[j]] and rows[j] == columns[j]:
            factors[0, j] = 1.0
        else:
            row = global_index(rows[j], 0, element, own, bodies, 0, linking)
            column = global_index(columns[j], 0, element, own, bodies, 0, linking)
            factors[0, j] = np.sqrt(sizes[row] * forces[row]) * np.sqrt(sizes[column] * forces[column])
    for i in range(root):
        for j in range(root):
            row, column = linking + i, linking + j
            place = rows.size + i * root + j
            factors[0, place] = np.sqrt(sizes[row] * forces[row]) * np.sqrt(sizes[column] * forces[column])
    for j in range(without_cost.size):
        factors[1, j] = without_cost[j] * factors[0, j]


def factor_kkt(grid, unknowns, weight, diagonal, system, gradient=None, step=None):
    """Factor the KKT matrix; return its excess of negative eigenvalues over the number of equations, or None.

    Zero means that the reduced Hessian is positive definite, as at a minimum. A positive number may be too low, since
    the elimination stops early. None means that the matrix is singular, or that a condensed block is not positive
    definite. The Hessian of the cost is multiplied by `weight`, 0 or 1. Then `diagonal` (n,) is added to the diagonal
    of the matrix. If `step` (n,) is given, it is filled with Newton's step, the solution of KKT matrix . step =
    -gradient. On a grid with scaling factors, all arguments are scaled.
    """
    steps, h, nodes, _, parameters, _, sizes, *_ = grid
    factors = system.scaled if weight == 1.0 else system.costless
    right = unknowns if gradient is None else gradient  # without a step, the right-hand side is not read
    excess = factor_at(
        system.loop, system.address, unknowns, sizes, np.empty(sizes.size), factors, steps, h, nodes, parameters,
        system.tables, system.entries, right, diagonal, system.equations, system.factors, system.orders,
        system.inverses, system.counts, NONE if step is None else step, step is not None, True,
    )  # fmt: skip
    return None if excess == SINGULAR else excess


def is_factored(excess):
    """Return True if `excess`, from `factor_kkt`, means that the matrix is factored and that there is a solution."""
    return excess is not None and excess <= 0


def solve_kkt(grid, system, gradient, step):
    """Fill the Newton `step` (n,) for another `gradient` (n,), with the latest factors of the KKT matrix."""
    solve_at(
        system.address, grid.steps, system.tables, gradient, system.equations, system.factors, system.orders,
        system.inverses, system.counts, step,
    )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def factor_at(
    loop, address, unknowns, sizes, scaled, factors_of_entries, steps, h, nodes, parameters, tables, entries, right,
    diagonal, equations, factors, orders, inverses, counts, step, is_wanted, is_new,
):  # fmt: skip
    """Factor the linear system at `address` with the second derivatives from `loop`; return the excess or SINGULAR.

    The excess is the number of negative eigenvalues minus the number of equations, see `factor_kkt`.
    `factors_of_entries` are the scaling factors of the second derivatives. If `is_wanted`, `step` (n,) is filled with
    the solution for the right-hand side -`right` (n,). If not `is_new`, `entries` has these second derivatives already.
    The other arguments come from a Grid and a System.
    """
    if is_new:
        fill_entries(loop, unknowns, sizes, scaled, factors_of_entries, steps, h, nodes, parameters, counts, entries)
    return call_system(
        address, 1, counts[0], steps, inverses, tables.ctypes.data, entries.ctypes.data, right.ctypes.data,
        diagonal.ctypes.data, equations, factors.ctypes.data, orders.ctypes.data, step.ctypes.data, is_wanted,
    )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def solve_at(address, steps, tables, right, equations, factors, orders, inverses, counts, step):
    """Fill `step` (n,) with the solution for -`right` (n,), with the latest factors of the system at `address`."""
    at = right.ctypes.data
    call_system(
        address, 0, counts[0], steps, inverses, tables.ctypes.data, at, at, at, equations, factors.ctypes.data,
        orders.ctypes.data, step.ctypes.data, 1,
    )  # fmt: skip


@njit(error_model="numpy")
def fill_entries(loop, unknowns, sizes, scaled, factors, steps, h, nodes, parameters, counts, entries):
    """Fill all second derivatives at `unknowns`, and multiply them by `factors` unless these are empty.

    `sizes` are the scaling factors of the unknowns, `scaled` is work space of the same length.
    """
    at = unknowns.ctypes.data
    if sizes.size:
        for i in range(sizes.size):
            scaled[i] = unknowns[i] * sizes[i]
        at = scaled.ctypes.data
    call_loop(
        loop, at, steps, h, nodes.ctypes.data, parameters.ctypes.data, parameters.shape[1], entries.ctypes.data
    )  # fmt: skip
    if factors.size:
        first, place = 0, 0
        for kind in range(3):
            size, repeated = counts[1 + kind], counts[0] * (steps if kind == 0 else 1)
            for _ in range(repeated):
                for j in range(size):
                    entries[place + j] *= factors[first + j]
                place += size
            first += size
        for j in range(counts[5] * counts[5]):
            entries[place + j] *= factors[first + j]


@njit(cache=True, error_model="numpy", nogil=True)
def multiply_entries(entries, rows, columns, steps, counts, vector, product, is_absolute):
    """Add the product of the KKT matrix and `vector` (n,) to `product` (n,).

    `entries` are all second derivatives, in one triangle. With `is_absolute`, add the absolute values of all terms. The
    ones that intervals put on the diagonal are then included, even if an end subtracts them; `optimality.terms`
    corrects the sums.
    """
    size, place, first_local = vector.size, 0, 0
    bodies, own, root, element, stride = counts[0], counts[4], counts[5], counts[6], counts[7]
    chain, linking = steps * stride + element - stride, size - root
    for kind in range(3):
        count = counts[1 + kind]
        for body in range(bodies):
            for k in range(steps if kind == 0 else 1):
                first = body * chain + k * stride
                if kind == 2:
                    first += (steps - 1) * stride
                for j in range(count):
                    row = global_index(rows[first_local + j], first, element, own, bodies, body, linking)
                    column = global_index(columns[first_local + j], first, element, own, bodies, body, linking)
                    value = entries[place + j]
                    if is_absolute:
                        product[row] += abs(value * vector[column])
                        if row != column:
                            product[column] += abs(value * vector[row])
                    else:
                        product[row] += value * vector[column]
                        if row != column:
                            product[column] += value * vector[row]
                place += count
        first_local += count
    for i in range(root):
        for j in range(root):
            value = entries[place + i * root + j] * vector[linking + j]
            product[linking + i] += abs(value) if is_absolute else value


def filled_entries(grid, unknowns, system):
    """Return all second derivatives, unscaled, at `unknowns` (n,) in the problem's own units.

    The array is part of the storage `system`.
    """
    call_hessians(system.loop, unknowns, grid.steps, grid.h, grid.nodes, grid.parameters, system.counts, system.entries)
    return system.entries


@njit(cache=True, error_model="numpy", nogil=True)
def call_hessians(loop, unknowns, steps, h, nodes, parameters, counts, entries):
    """Fill `entries` with all second derivatives at `unknowns` (n,), without scaling factors."""
    fill_entries(
        loop, unknowns, unknowns[:0], unknowns[:0], unknowns[:0], steps, h, nodes, parameters, counts, entries
    )  # fmt: skip
