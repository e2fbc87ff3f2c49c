"""Inertia by symmetric elimination against the eigenvalues of the dense matrix."""

from __future__ import annotations

import numpy as np
import pytest
from control_variants import VARIANTS, dense_kkt, eliminated_blocks_are_positive, shifts, trial_point
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from codegen.runtime.kkt.shape import last_width, padded, row_width
from codegen.runtime.kkt.symmetric import eliminate_rows, solve_backward, solve_forward, solve_pivots, subtract_products
from codegen.runtime.search import point
from codegen.runtime.search.grid import free_unknowns
from codegen.runtime.search.linear_system import allocate_system, factor_kkt, solve_kkt

ROUNDING = 1e-9

# Small whole numbers make zero diagonals, equal pivots and singular minors frequent.
entries = st.one_of(st.integers(-3, 3).map(float), st.floats(-1e3, 1e3).filter(lambda x: abs(x) > 1e-6))


@st.composite
def symmetric(draw):
    size = draw(st.integers(1, 7))
    matrix = draw(arrays(float, (size, size), elements=entries))
    matrix = np.tril(matrix) + np.tril(matrix, -1).T
    if draw(st.booleans()):
        np.fill_diagonal(matrix, 0.0)
    return matrix


def eliminated(matrix: np.ndarray, count: int):
    """Number of negative pivots, Schur complement, and the factors."""
    size = len(matrix)
    width = padded(count + padded(size - count))
    rows, upper = np.zeros((count, width)), np.full((count, width), np.nan)
    rest = np.zeros((size - count, padded(size - count)))
    rows[:, :size], rest[:, : size - count] = matrix[:count], matrix[count:, count:]
    inverse, order = np.full((count, 2), np.nan), np.zeros(count, np.int64)
    negative = eliminate_rows(rows, 0, count, width, upper, inverse, order)
    subtract_products.py_func(upper, rows, count, count, size - count, padded(size - count), rest)
    rest = np.triu(rest[:, : size - count])
    return negative, rest + np.triu(rest, 1).T, (upper, inverse, order)


def eigenvalues(matrix: np.ndarray) -> np.ndarray:
    """Eigenvalues, for matrices of which rounding errors do not decide the signs."""
    values = np.linalg.eigvalsh(matrix)
    assume(np.abs(values).min() > ROUNDING * np.abs(values).max())
    return values


@given(matrix=symmetric())
def test_negative_pivots_are_negative_eigenvalues(matrix):
    assert eliminated(matrix, len(matrix))[0] == np.count_nonzero(eigenvalues(matrix) < 0.0)


@given(matrix=symmetric(), part=st.floats(0.0, 1.0))
def test_inertia_of_a_part_and_of_its_schur_complement_add_up(matrix, part):
    """Haynsworth (1968)."""
    count = 1 + int(part * (len(matrix) - 1))
    values = eigenvalues(matrix)
    eigenvalues(matrix[:count, :count])
    negative, rest, _ = eliminated(matrix, count)
    expected = matrix[count:, count:] - matrix[count:, :count] @ np.linalg.solve(
        matrix[:count, :count], matrix[:count, count:]
    )
    scale = np.abs(expected).max(initial=0.0) + np.abs(matrix).max()
    np.testing.assert_allclose(rest, expected, atol=1e-6 * scale)
    assert negative + np.count_nonzero(np.linalg.eigvalsh(expected) < 0.0) == np.count_nonzero(values < 0.0)


@given(matrix=symmetric(), seed=st.integers(0, 10**6))
def test_factors_solve_linear_systems(matrix, seed):
    eigenvalues(matrix)
    count = len(matrix)
    right = np.random.default_rng(seed).normal(size=count)
    _, _, (upper, inverse, order) = eliminated(matrix, count)
    values = np.zeros(padded(count))
    values[:count] = right
    solve_forward.py_func(upper, order, count, padded(count), values)
    solve_pivots.py_func(inverse, order, count, values)
    solve_backward.py_func(upper, order, count, padded(count), values)
    solution = values[:count]
    size = np.abs(matrix).max() * np.abs(solution).max() + 1.0
    np.testing.assert_allclose(matrix @ solution, right, atol=1e-9 * size)


def test_singular_and_infinite_matrices_are_told():
    for matrix in (np.zeros((3, 3)), np.diag([1.0, 0.0]), np.array([[np.inf]]), np.ones((2, 2))):
        assert eliminated(matrix, len(matrix))[0] == -1


@pytest.mark.parametrize("scale", [1e-320, 1e-310])
def test_pivots_without_a_reciprocal_count_as_zero(scale):
    assert eliminated(scale * np.eye(2), 2)[0] == -1


def test_lower_triangle_of_the_rest_is_not_read():
    matrix = np.array([[0.0, 2.0, 1.0, 3.0], [2.0, 1.0, 4.0, 1.0], [1.0, 4.0, 5.0, 2.0], [3.0, 1.0, 2.0, 7.0]])
    poisoned = matrix.copy()
    poisoned[2, 0] = poisoned[3, 1] = poisoned[2, 1] = poisoned[3, 0] = np.nan
    for one, other in zip(eliminated(matrix, 2)[:2], eliminated(poisoned, 2)[:2], strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(("name", "text", "choices"), VARIANTS)
@settings(max_examples=8)
@given(
    steps=st.integers(2, 5),
    seed=st.integers(0, 10**6),
    shift=st.sampled_from([0.0, 0.3, 30.0]),
    delta_c=st.sampled_from([0.0, 1e-3]),
)
def test_excess_of_negative_eigenvalues(interpreted, name, text, choices, steps, seed, shift, delta_c):
    """`factor_kkt` counts far from any minimum too: exactly, or too low where there are too many."""
    module = interpreted(name, text, **choices)
    # Barrier terms shift the Hessian wherever there are bounds; one interval between shared ends has no inner node.
    assume(shift > 0.0 or not module.metadata.inequalities)
    grid = module.make_grid(steps)
    assume(steps > 1 or not grid.structure.shared)
    unknowns = trial_point(module, grid, seed, 0.2)
    diagonal = shifts(module, grid, shift, delta_c)
    keep = np.flatnonzero(free_unknowns(grid))
    matrix = dense_kkt(module, grid, unknowns) + np.diag(diagonal)
    found = factor_kkt(grid, unknowns, 1.0, diagonal, allocate_system(grid))
    values = np.linalg.eigvalsh(matrix[np.ix_(keep, keep)])
    regular = np.abs(values).min() > ROUNDING * np.abs(values).max()
    if found is None:
        assert not regular or not eliminated_blocks_are_positive(module, grid, matrix)
    elif regular:
        excess = np.count_nonzero(values < 0.0) - module.multiplier_unknowns(grid).size
        assert found == excess or 0 < found < excess


@pytest.mark.parametrize(("primal", "multipliers"), [(1.0, 1e-6), (1e3, 1e-4), (1e-2, 1e3)])
@pytest.mark.parametrize(("name", "text", "choices"), VARIANTS)
def test_multipliers_that_a_node_lacks_are_not_counted(interpreted, name, text, choices, primal, multipliers):
    """With a shift of the multipliers' diagonal, and whatever the sizes in which they are measured."""
    module = interpreted(name, text, **choices)
    grid = module.make_grid(4)
    sizes = np.where(grid.is_multiplier, multipliers, primal)
    unknowns = np.where(grid.is_multiplier, 0.0, trial_point(module, grid, 1, 0.2)) / sizes
    scaled, diagonal = grid._replace(sizes=sizes, forces=sizes), np.where(grid.is_multiplier, -1e-8, 1.0)
    assert factor_kkt(scaled, unknowns, 0.0, diagonal, allocate_system(grid)) == 0


@pytest.mark.parametrize(("name", "text", "choices"), VARIANTS)
def test_shortest_step_onto_the_linearised_equations(interpreted, name, text, choices):
    """Without the cost the matrix is regular even with multipliers that only the ends of a motion have.

    Restoration and the first multipliers begin with it. The step must satisfy A d = -c, with A as drivers get it.
    """
    module = interpreted(name, text, **choices)
    grid = module.make_grid(4)
    unknowns = np.where(grid.is_multiplier, 0.0, trial_point(module, grid, 1, 0.2))
    system, step = allocate_system(grid), np.empty_like(unknowns)
    assert factor_kkt(grid, unknowns, 0.0, np.where(grid.is_multiplier, -1e-12, 1.0), system) == 0
    gradient = module.evaluate(grid, unknowns).gradient
    solve_kkt(grid, system, np.where(grid.is_multiplier, gradient, 0.0), step)
    equations, primal = module.multiplier_unknowns(grid), module.primal_unknowns(grid)
    rows, columns, slopes = point.jacobian(grid, unknowns)
    change = np.bincount(rows, slopes * step[primal][columns], equations.size)
    np.testing.assert_allclose(change, -gradient[equations], atol=1e-6 * np.abs(gradient).max())


@pytest.mark.parametrize(("name", "text", "choices"), VARIANTS)
def test_rows_have_room_for_what_is_carried_along(interpreted, name, text, choices):
    """A column for the right-hand side, exactly where rows without the border, in fours, have one to spare."""
    shape = interpreted(name, text, **choices).problem.structure.shape
    block, last = shape.stride - shape.condensed - 2 * shape.stages, shape.node + shape.border
    spare = [size % 4 > 0 for size in (block + shape.node + shape.shared, shape.node + shape.shared)]
    assert int(all(spare)) == shape.carried
    assert last + shape.shared + shape.carried <= last_width(shape) <= row_width(shape)
