"""The linear system of Newton's method on a grid: second derivatives, factorisation, solution, refinement.

Refinement: residuals of a solution are solved for again. Corrections one after the other need not converge where
factors are inaccurate; their best combination, by generalised conjugate residuals with the factors as preconditioner,
does. Sources: Higham (2002), Accuracy and stability of numerical algorithms, chapter 12; Eisenstat, Elman and Schultz
(1983), Variational iterative methods for nonsymmetric systems of linear equations; the measure of the residual is that
of Waechter and Biegler (2006), section 3.10.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from codegen.runtime.addresses import call_loop, call_system
from codegen.runtime.kkt.system import SINGULAR, factor_sizes, root_index
from codegen.runtime.search.grid import NONE, free_unknowns, layout_of

ACCURATE = 1e-10  # residuals up to it, relative to the right-hand side and the solution, are as good as none
LARGE_STEP = 1e6  # times the right-hand side: what is beyond does not excuse a residual
SOLVED_AGAIN = 10  # times at most, as in IPOPT
NEARLY_ACCURATE = 1e-6  # residuals up to it may be rounding of large solutions, where two corrections do not halve them


class System(NamedTuple):
    """The storage of a linear system: index tables, work space, second derivatives, scaling factors of these.

    `scaled` and `costless` are the factors of all entries with the cost and without the cost; the former
    is empty where it makes no difference. `counts` are bodies, entries of an interval, of a start and of an end, own
    linking variables, and all linking variables. `equations` is the number of multipliers.
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
    """Return the storage of the linear system on a grid."""
    problem, s = grid.problem, grid.problem.structure
    inverses = 1 if s.constant and grid.is_uniform else grid.steps
    reals, integers = factor_sizes(s.shape, s.bodies, grid.steps, inverses)
    system = System(
        problem.system, problem.hessians.address, s.tables, np.zeros(reals), np.zeros(integers, np.int64),
        np.zeros(s.entry_count(grid.steps)), NONE, NONE, inverses, s.counts, layout_of(grid).multipliers.size,
        *s.entries,
    )  # fmt: skip
    return with_entry_factors(grid, system)


def with_entry_factors(grid, system):
    """Return the same storage with the factors of entries on a grid."""
    if not grid.sizes.size:
        return system._replace(scaled=NONE, costless=grid.problem.structure.without_cost)
    return system._replace(scaled=entry_factors(grid, 1.0), costless=entry_factors(grid, 0.0))


def entry_factors(grid, weight):
    """Return what entries of an interval, of both ends, and of conditions between linking variables are multiplied by.

    These are the roots of `sizes` times `forces` of both unknowns, which have the weight of the grid in them, and
    `weight`, 0 or 1, where both unknowns are primal. The one for a multiplier that an interval lacks stays one: a shift
    of the multipliers' diagonal would turn the sign of a smaller one.
    """
    s = grid.problem.structure
    factors = np.where(s.is_of_cost, weight, 1.0)
    roots_of_all, (rows, columns), is_multiplier = np.sqrt(grid.sizes * grid.forces), s.entries, s.local_is_multiplier
    roots = roots_of_all[roots_of_all.size - s.root :]
    parts = np.concatenate([roots_of_all[: s.element], roots[s.root_indices()[0]]])
    of_elements = np.where(is_multiplier[rows] & (rows == columns), 1.0, parts[rows] * parts[columns])
    return factors * np.concatenate([of_elements, (roots[:, None] * roots).ravel()])


def factor_kkt(grid, unknowns, weight, diagonal, system, gradient=None, step=None):
    """Factor the KKT matrix and return how many more negative eigenvalues it has than there are equations.

    Zero means that the reduced Hessian is positive definite, as at a minimum. A positive number may be too low: the
    elimination stops when there are too many. None means that the matrix is singular, or that a block that is
    condensed is not positive definite. The Hessian of the cost is multiplied by `weight`, 0 or 1; then `diagonal` (n,)
    is added to the diagonal of the whole matrix. Where it was factored, `step` (n,), if given, is Newton's: the
    solution of KKT matrix . step = -gradient. Everything is scaled where the grid is.
    """
    right = unknowns if gradient is None else gradient  # anything will do where nobody asks for the solution
    excess = factor_system(
        grid, unknowns, system, weight, diagonal, right, NONE if step is None else step, step is not None
    )
    return None if excess == SINGULAR else excess


def factor_system(grid, unknowns, system, weight, diagonal, right, step, is_wanted):
    """Fill the second derivatives, factor, and solve if that `is_wanted`; return the excess of negative pivots."""
    steps, h, nodes, _, parameters, _, sizes, *_ = grid
    factors = system.scaled if weight == 1.0 else system.costless
    return factor_at(
        system.loop, system.address, unknowns, sizes, np.empty(sizes.size), factors, steps, h, nodes, parameters,
        system.tables, system.entries, right, diagonal, system.equations, system.factors, system.orders,
        system.inverses, system.counts, step, is_wanted,
    )  # fmt: skip


def is_factored(excess):
    """Return True if what `factor_kkt` gave says that the whole matrix was factored, so that there is a solution."""
    return excess is not None and excess <= 0


def solve_kkt(grid, system, gradient, step):
    """Fill the Newton step (n,) for another `gradient` (n,) with the matrix that was factored last."""
    solve_at(
        system.address, grid.steps, system.tables, gradient, system.equations, system.factors, system.orders,
        system.inverses, system.counts, step,
    )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def factor_at(
    loop, address, unknowns, sizes, scaled, factors_of_entries, steps, h, nodes, parameters, tables, entries, right,
    diagonal, equations, factors, orders, inverses, counts, step, is_wanted,
):  # fmt: skip
    """Factor the system at `address` with the second derivatives that `loop` fills; return the excess."""
    fill_entries(
        loop, unknowns, sizes, scaled, factors_of_entries, steps, h, nodes, parameters, counts, entries
    )  # fmt: skip
    return call_system(
        address, 1, counts[0], steps, inverses, tables.ctypes.data, entries.ctypes.data, right.ctypes.data,
        diagonal.ctypes.data, equations, factors.ctypes.data, orders.ctypes.data, step.ctypes.data, is_wanted,
    )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def solve_at(address, steps, tables, right, equations, factors, orders, inverses, counts, step):
    """Solve with the factors of the system at `address`."""
    at = right.ctypes.data
    call_system(
        address, 0, counts[0], steps, inverses, tables.ctypes.data, at, at, at, equations, factors.ctypes.data,
        orders.ctypes.data, step.ctypes.data, 1,
    )  # fmt: skip


@njit(error_model="numpy")
def fill_entries(loop, unknowns, sizes, scaled, factors, steps, h, nodes, parameters, counts, entries):
    """Fill all second derivatives, and multiply them by `factors` unless these are empty."""
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


@njit(error_model="numpy", forceinline=True)
def global_index(local, first, element, own, bodies, body, linking):
    """Return the index, among all unknowns, of unknown `local` of the interval that begins at `first`.

    Linking variables begin at `linking`.
    """
    return first + local if local < element else linking + root_index(own, bodies, body, local - element)


@njit(cache=True, error_model="numpy", nogil=True)
def multiply_entries(entries, rows, columns, steps, counts, vector, product, is_absolute):
    """Add the symmetric matrix of all entries times `vector` to `product`, both (n,); or absolute values of terms.

    A one for a multiplier that an interval lacks, and that an end takes back, is no term: it is left out of absolute
    values by both.
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
    """Return the storage with all second derivatives, unscaled, at `unknowns` (n,) in the problem's own units."""
    call_hessians(system.loop, unknowns, grid.steps, grid.h, grid.nodes, grid.parameters, system.counts, system.entries)
    return system.entries


@njit(cache=True, error_model="numpy", nogil=True)
def call_hessians(loop, unknowns, steps, h, nodes, parameters, counts, entries):
    """Fill all second derivatives."""
    fill_entries(
        loop, unknowns, unknowns[:0], unknowns[:0], unknowns[:0], steps, h, nodes, parameters, counts, entries
    )  # fmt: skip


def linear_residual(grid, unknowns, diagonal, gradient, step, system):
    """Return KKT matrix . step + gradient (n,), which is zero for an exact step, and its size as `inaccuracy` says.

    The matrix is as `factor_kkt` says.
    """
    s, left, vector, roots = grid.problem.structure, np.zeros(step.size), step, 1.0
    if grid.sizes.size:
        roots = np.sqrt(grid.sizes * grid.forces)
        unknowns, vector = unknowns * grid.sizes, roots * step
    entries = filled_entries(grid, unknowns, system)
    multiply_entries(entries, system.rows, system.columns, grid.steps, system.counts, vector, left, False)
    left = left * roots + diagonal * step + gradient
    if s.is_tied:
        add_tied(s, grid.steps, left)
    left[~free_unknowns(grid)] = 0.0
    return left, inaccuracy(gradient, step, left, grid.is_multiplier)


def add_tied(s, steps, values):
    """Add `values` (n,) of unknowns that equal linking variables to those of the latter."""
    chain, root = steps * s.stride + s.node, values[values.size - s.root :]
    for body, indices in enumerate(s.root_indices()):
        np.add.at(root, indices[s.start_shared], values[body * chain + s.start_tied])
        np.add.at(root, indices[s.end_shared], values[(body + 1) * chain - s.node + s.end_tied])


@njit(cache=True, error_model="numpy", nogil=True)
def inaccuracy(gradient, step, left, is_multiplier):
    """Return how large `left` (n,) is in the equations, and in all rows, relative to right-hand side and solution.

    Large multipliers, and barriers close to their bounds, take no part in the equations. NaN if `left` is not finite.
    """
    unsolved, remaining, right, slope, multiplier, primal = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(left.size):
        if not abs(left[i]) < np.inf:
            return np.nan
        if is_multiplier[i]:
            unsolved, right = max(unsolved, abs(left[i])), max(right, abs(gradient[i]))
            multiplier = max(multiplier, abs(step[i]))
        else:
            remaining, slope = max(remaining, abs(left[i])), max(slope, abs(gradient[i]))
            primal = max(primal, abs(step[i]))
    most = LARGE_STEP * max(right, slope)
    of_equations = unsolved / max(right + min(primal, most), 1e-300)
    scale = max(right, slope) + min(max(primal, multiplier), most)
    return max(of_equations, max(unsolved, remaining) / max(scale, 1e-300))


def refine(grid, unknowns, diagonal, system, gradient, step):
    """Refine `step` (n,) in place until it is accurate, or only rounding remains; return whether that lowered it.

    The system is still factored, and the matrix as `factor_kkt` says. Each time the factors make one more correction of
    the residual, and that sum of all corrections is added which leaves least.
    """
    zero, corrections, products, errors = np.zeros_like(step), [], [], []
    left, error = linear_residual(grid, unknowns, diagonal, gradient, step, system)
    for refinement in range(SOLVED_AGAIN):
        errors.append(error)
        if not ACCURATE < errors[-1] < np.inf:
            return refinement > 0
        if refinement == 2 and 0.5 * errors[0] < errors[-1] <= NEARLY_ACCURATE:
            return False
        corrections.append(np.empty_like(step))
        solve_kkt(grid, system, left / np.linalg.norm(left), corrections[-1])
        products.append(linear_residual(grid, unknowns, diagonal, zero, corrections[-1], system)[0])
        if not np.isfinite(products[-1]).all():
            return True
        parts, *_ = np.linalg.lstsq(np.array(products).T, -left, rcond=None)
        step += parts @ np.array(corrections)
        left, error = linear_residual(grid, unknowns, diagonal, gradient, step, system)
    return True
