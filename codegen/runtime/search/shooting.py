"""Direct multiple shooting: stages of an explicit scheme as functions of the state and the controls of an interval.

The stages s and the multipliers m of their equations are no unknowns of a search. A kernel of the generated module
computes the stages one after the other, and the multipliers from the last to the first, so that the derivatives of the
Lagrangian with respect to s and m vanish. The gradient by all other unknowns y is then the gradient of the composition.
With the Jacobians A and B of the stage equations by s and y, and S = -inverse(A) B, the Hessian of the composition is

    H_yy + H_ys S + S' H_sy + S' H_ss S.

A is a lower triangle with ones on the diagonal. Source: Bock and Plitt (1984), A multiple shooting algorithm for direct
solution of optimal control problems, IFAC Proceedings 17.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numba import njit

from codegen.runtime.kkt.shape import count_of, place_of
from codegen.runtime.kkt.symmetric import clear, subtract_products, subtract_row
from codegen.runtime.search.point import fill
from codegen.runtime.search.scaling import quantities_of, scaled_grid

(
    COUNTS, KEPT, SLOPES, SLOPE_ROWS, SLOPE_COLUMNS, OUTER, OUTER_ROWS, OUTER_COLUMNS, CURVED, CURVED_ROWS,
    CURVED_COLUMNS, CROSS, CROSS_ROWS, CROSS_COLUMNS, PAIRS, CROSSINGS, DOUBLED,
) = range(17)  # fmt: skip
"""Numbers of the index tables of a `Reduction`.

- COUNTS: numbers of stages, of unknowns y in their equations (the reach), of unknowns y in H_ys, and of entries of the
  reduced Hessian.
- KEPT: entries of the Hessian without stages and without multipliers of their equations.
- SLOPES, OUTER, CURVED, CROSS: entries of A below the diagonal, of B, of H_ss and of H_ys. Each has tables of ROWS and
  COLUMNS, which number stages, the reach, and the unknowns of H_ys from zero.
- PAIRS: entries of the reduced Hessian for all pairs of the reach, lower triangle.
- CROSSINGS: entries of the reduced Hessian for all unknowns of H_ys with all of the reach.
- DOUBLED: indices in CROSSINGS of the entries on the diagonal, to which H_ys S and its transpose contribute.
"""


@dataclass(frozen=True, eq=False)
class Reduction:
    """The reduced Hessian of an interval: its pattern, and the tables of `reduce_hessian`.

    Attributes
    ----------
    rows, columns : array of int
        Local rows and columns of its entries, lower triangle, among the unknowns without stages.
    width : int
        Number of unknowns in the stage equations, rounded up to a multiple of four.
    tables : array of int
        Index tables: two numbers for each table, the index of its first entry and its length; then all tables.
    """

    rows: np.ndarray
    columns: np.ndarray
    width: int
    tables: np.ndarray


def reduction(node, stages, rows, columns):
    """Return the Reduction of an interval with the pattern `rows`, `columns` of its Hessian.

    `node` is the number of unknowns of a node; `stages` stages and the multipliers of their equations follow.
    """
    last = node + 2 * stages
    kind = np.where(np.arange(max(rows.max(), columns.max()) + 1) < node, 0, 3)
    kind[node : node + stages], kind[node + stages : last] = 1, 2

    def parts(high, low):
        """Return entries with one unknown of the kind `high` and one of the kind `low`, and the local indices."""
        straight = np.isin(kind[rows], high) & np.isin(kind[columns], low)
        entries = np.flatnonzero(straight | np.isin(kind[columns], high) & np.isin(kind[rows], low))
        one = np.where(straight[entries], rows[entries], columns[entries])
        other = np.where(straight[entries], columns[entries], rows[entries])
        order = np.lexsort((other, one))
        return entries[order], one[order], other[order]

    def number(local):
        """Return the number of an unknown without stages."""
        return np.where(local < node, local, local - 2 * stages)

    others = (0, 3)
    slopes, outer, curved, cross, kept = (
        parts((2,), (1,)), parts((2,), others), parts((1,), (1,)), parts(others, (1,)), parts(others, others)
    )  # fmt: skip
    below = slopes[1] - stages > slopes[2]  # the diagonal of A is one
    slopes = tuple(part[below] for part in slopes)
    reach, crossed = np.unique(outer[2]), np.unique(cross[1])
    entries = {}

    def entry(one, other):
        pair = max(one, other), min(one, other)
        return entries.setdefault(pair, len(entries))

    for one, other in zip(number(kept[1]).tolist(), number(kept[2]).tolist(), strict=True):
        entry(one, other)
    near, far = number(reach).tolist(), number(crossed).tolist()
    pairs = [entry(a, b) for i, a in enumerate(near) for b in near[: i + 1]]
    crossings = [entry(a, b) for a in far for b in near]
    doubled = [i * len(near) + j for i, a in enumerate(far) for j, b in enumerate(near) if a == b]
    tables = [
        [stages, reach.size, crossed.size, len(entries)], kept[0], slopes[0], slopes[1] - node - stages,
        slopes[2] - node, outer[0], outer[1] - node - stages, np.searchsorted(reach, outer[2]), curved[0],
        curved[1] - node, curved[2] - node, cross[0], np.searchsorted(crossed, cross[1]), cross[2] - node, pairs,
        crossings, doubled,
    ]  # fmt: skip
    arrays = [np.asarray(table, dtype=np.int64) for table in tables]
    lengths = np.array([array.size for array in arrays])
    places = 2 * len(arrays) + np.concatenate([[0], np.cumsum(lengths)[:-1]])
    pattern = np.array(list(entries), dtype=np.int64).reshape(-1, 2)
    return Reduction(
        pattern[:, 0].copy(), pattern[:, 1].copy(), -(-reach.size // 4) * 4,
        np.concatenate([np.stack([places, lengths], axis=1).ravel(), *arrays]).astype(np.int64),
    )  # fmt: skip


def reduction_rows(made):
    """Return the numbers of rows of the two work arrays of `reduce_hessian`: of stages, and of products."""
    stages, _, crossed, _ = made.tables[made.tables[2 * COUNTS] :][:4]
    return 2 * int(stages), made.width + int(crossed)


@njit(error_model="numpy", fastmath={"contract"}, forceinline=True)
def reduce_hessian(tables, width, hessian, of_stages, products, reduced):
    """Fill the `reduced` Hessian of an interval, lower triangle, from its `hessian` with stages.

    `tables` and `width` belong to the Reduction. `of_stages` and `products` (rows, width) are work space with the rows
    that `reduction_rows` counts.
    """
    counts = place_of(tables, COUNTS)
    stages, reach, crossed = tables[counts], tables[counts + 1], tables[counts + 2]
    # The rows of `of_stages` are S, then -H_ss S. The rows of `products` are S' H_ss S, then H_ys S.
    clear(of_stages)
    clear(products)
    at, rows, columns = place_of(tables, OUTER), place_of(tables, OUTER_ROWS), place_of(tables, OUTER_COLUMNS)
    for j in range(count_of(tables, OUTER)):
        of_stages[np.uint64(tables[rows + j]), np.uint64(tables[columns + j])] = -hessian[np.uint64(tables[at + j])]
    at, rows, columns = place_of(tables, SLOPES), place_of(tables, SLOPE_ROWS), place_of(tables, SLOPE_COLUMNS)
    for j in range(count_of(tables, SLOPES)):
        row, column = np.uint64(tables[rows + j]), np.uint64(tables[columns + j])
        subtract_row(hessian[np.uint64(tables[at + j])], of_stages, column, width, of_stages, row)
    at, rows, columns = place_of(tables, CURVED), place_of(tables, CURVED_ROWS), place_of(tables, CURVED_COLUMNS)
    for j in range(count_of(tables, CURVED)):
        value = hessian[np.uint64(tables[at + j])]
        row, column = tables[rows + j], tables[columns + j]
        subtract_row(value, of_stages, np.uint64(column), width, of_stages, np.uint64(stages + row))
        if row != column:
            subtract_row(value, of_stages, np.uint64(row), width, of_stages, np.uint64(stages + column))
    # The second factor is -H_ss S, and `subtract_products` subtracts: the signs cancel. The upper triangle is valid.
    subtract_products(of_stages, of_stages[stages:], stages, 0, width, width, products)
    at, rows, columns = place_of(tables, CROSS), place_of(tables, CROSS_ROWS), place_of(tables, CROSS_COLUMNS)
    for j in range(count_of(tables, CROSS)):
        row, column = np.uint64(width + tables[rows + j]), np.uint64(tables[columns + j])
        subtract_row(-hessian[np.uint64(tables[at + j])], of_stages, column, width, products, row)
    at = place_of(tables, KEPT)
    for j in range(count_of(tables, KEPT)):
        reduced[j] = hessian[np.uint64(tables[at + j])]
    for j in range(count_of(tables, KEPT), reduced.size):
        reduced[j] = 0.0
    at = place_of(tables, PAIRS)
    for a in range(reach):
        for b in range(a + 1):
            reduced[np.uint64(tables[at])] += products[b, a]
            at += 1
    at = place_of(tables, CROSSINGS)
    for i in range(width, width + crossed):
        for c in range(reach):
            reduced[np.uint64(tables[at])] += products[i, c]
            at += 1
    at, crossings = place_of(tables, DOUBLED), place_of(tables, CROSSINGS)
    for j in range(count_of(tables, DOUBLED)):
        place = tables[at + j]
        reduced[np.uint64(tables[crossings + place])] += products[width + place // reach, place % reach]


@dataclass(frozen=True, eq=False)
class Shooting:
    """The loops of a problem over intervals without stages.

    Attributes
    ----------
    reduction : Reduction
        The pattern of the reduced Hessian of an interval.
    gradient, hessians : Loop
        Fill the gradient and all second derivatives with respect to the unknowns without stages.
    stages : Loop
        Fills all unknowns, with stages and the multipliers of their equations.
    """

    reduction: Reduction
    gradient: object
    hessians: object
    stages: object

    def without_stages(self, problem):
        """Return a problem with the same solution and without stages, for a search.

        Its grids are those of `shooting_grid`. It has no sensitivities, and its tables may be read outside their
        ranges.
        """
        s, pattern = problem.structure, self.reduction
        gone = 2 * s.stages

        def moved(local):
            """Return local indices without those of stages and of the multipliers of their equations."""
            local = local[(local < s.node) | (local >= s.node + gone)]
            return np.where(local < s.node, local, local - gone)

        structure = replace(
            s, stride=s.stride - gone, stages=0, rows=pattern.rows, columns=pattern.columns,
            is_multiplier=np.delete(s.is_multiplier, np.s_[s.node : s.node + gone]),
            slacks=moved(s.slacks), slack_multipliers=moved(s.slack_multipliers), inner_lacks=moved(s.inner_lacks),
            motion_equations=moved(s.motion_equations), motion_unknowns=moved(s.motion_unknowns),
            phase_lacks=s.phase_lacks[..., gone:], switch_lacks=s.switch_lacks[..., gone:],
        )  # fmt: skip

        def bounds(grid):
            """Return the least and the greatest values (n,) of the unknowns without stages."""
            whole = grid._replace(problem=problem, is_multiplier=s.layouts(grid.steps).is_multiplier)
            return tuple(side[kept_unknowns(s, grid.steps)] for side in problem.variable_bounds(whole))

        return replace(
            problem, structure=structure, metadata=replace(problem.metadata, interval=problem.metadata.interval[gone:]),
            gradient=self.gradient, hessians=self.hessians, variable_bounds=problem.variable_bounds and bounds,
            inputs=None, data=None, shooting=None,
        )  # fmt: skip


@lru_cache(maxsize=8)
def kept_unknowns(structure, steps):
    """Return the indices, among all unknowns, of the unknowns without stages."""
    s = structure
    chain = np.arange(s.bodies * (steps * s.stride + s.node)).reshape(s.bodies, -1)
    place = np.arange(chain.shape[1]) % s.stride
    kept = chain[:, (place < s.node) | (place >= s.node + 2 * s.stages)].ravel()
    return np.concatenate([kept, chain.size + np.arange(s.root)])


@lru_cache(maxsize=8)
def like_unknowns(problem, steps):
    """Return an index among the unknowns without stages for each unknown: its own, or for a stage that of its state."""
    s, kind = problem.structure, quantities_of(problem).kind
    kept, like = kept_unknowns(s, steps), np.empty(s.size(steps), np.int64)
    like[kept] = np.arange(kept.size)
    others = np.setdiff1d(np.arange(s.stride), np.arange(s.node, s.node + 2 * s.stages))
    chain = steps * s.stride + s.node
    for local in range(s.node, s.node + 2 * s.stages):
        same = others[kind[others] == kind[local]][0]
        for first in range(0, s.bodies * chain, chain):
            places = first + s.stride * np.arange(steps)
            like[places + local] = like[places + same]
    return like


def shooting_grid(grid):
    """Return the grid of a search: without stages for an explicit scheme, otherwise `grid` itself."""
    if grid.problem.shooting is None:
        return grid
    kept = kept_unknowns(grid.problem.structure, grid.steps)
    sizes, forces = (values[kept] if values.size else values for values in (grid.sizes, grid.forces))
    bounds = tuple(side[kept] for side in grid.bounds)
    return grid._replace(
        problem=grid.problem.searched, is_multiplier=grid.is_multiplier[kept], sizes=sizes, forces=forces,
        bounds=bounds,
    )  # fmt: skip


def shooting_unknowns(grid, unknowns):
    """Return those of all `unknowns` (n,) that a search has, on a grid with stages."""
    if grid.problem.shooting is None:
        return unknowns
    return unknowns[kept_unknowns(grid.problem.structure, grid.steps)]


def scaled_shooting_grid(grid, unknowns, is_solution=False):
    """Return what `scaling.scaled_grid` returns for a `grid` with stages and the `unknowns` of a search.

    Stages have the values of states. In a composition of stages, a state and a control that influence each other only
    over several stages have tiny derivatives, so that scaling factors come from the equations with stages.
    """
    if grid.problem.shooting is not None:
        unknowns = unknowns[like_unknowns(grid.problem, grid.steps)]
    return scaled_grid(grid, unknowns, is_solution)


def whole_unknowns(grid, unknowns):
    """Return all unknowns (n,) on a grid with stages, given the `unknowns` of a search in the problem's own units."""
    if grid.problem.shooting is None:
        return unknowns
    whole, loop = np.empty(grid.is_multiplier.size), grid.problem.shooting.stages.address
    fill(loop, unknowns, grid.steps, grid.h, grid.nodes, grid.parameters, whole)
    return whole
