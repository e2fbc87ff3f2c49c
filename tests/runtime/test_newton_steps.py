"""The inertia correction: which shifts of the Hessian are tried, for matrices of which the inertia is known."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from dense_problem import assert_optimal, dense_grid, guess_of, solve
from known_optima import HOCK_SCHITTKOWSKI

from codegen.runtime.kkt.specialised import compiled_system
from codegen.runtime.search.direction import SMALL_DELTA_W
from codegen.runtime.search.grid import Grid
from codegen.runtime.search.iterates import FROM_GUESS, begin, search_on
from codegen.runtime.search.newton import descend
from codegen.runtime.search.solution import Log

INTEGER, ADDRESS = ctypes.c_int64, ctypes.c_void_p
KINDS = (*[INTEGER] * 4, *[ADDRESS] * 4, INTEGER, *[ADDRESS] * 3, INTEGER)
SYSTEM = ctypes.CFUNCTYPE(INTEGER, *KINDS)
IS_NEW, DIAGONAL, STEP, IS_WANTED = 0, 7, 11, 12
"""Places of arguments in those of `addresses.SYSTEM`."""


def with_system(grid: Grid, system: Callable[..., int]) -> tuple[Grid, Any]:
    """The grid whose linear system is a callback, which is handed the arguments and the compiled system."""
    compiled, problem = SYSTEM(compiled_system(None).address), replace(grid.problem)
    callback = SYSTEM(lambda *arguments: system(compiled, arguments))
    vars(problem)["system"] = ctypes.cast(callback, ADDRESS).value
    return grid._replace(problem=problem), callback  # which has to be kept as long as it is called


def numbers_at(address: int, count: int) -> np.ndarray:
    return np.ctypeslib.as_array(ctypes.cast(address, ctypes.POINTER(ctypes.c_double)), (count,))


def shifts_tried(curvatures: list[float | None]) -> list[list[float]]:
    """The shifts that are tried at iterates where the cost x has so much curvature along x.

    The equation is y = 0, or one without a slope where the curvature is None.
    """
    iterates = dict[bytes, int]()
    tried: list[list[float]] = [[] for _ in curvatures]

    def hessian(unknowns: np.ndarray) -> np.ndarray:
        number = iterates.setdefault(unknowns.tobytes(), len(iterates))
        curvature = curvatures[min(number, len(curvatures) - 1)]
        if curvature is None:
            return np.diag([1.0, 0.0, 1.0])
        return np.array([[curvature, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])

    def system(compiled: Any, arguments: tuple[int, ...]) -> int:
        if arguments[IS_NEW] and arguments[IS_WANTED] and len(iterates) <= len(curvatures):
            tried[len(iterates) - 1].append(float(numbers_at(arguments[DIAGONAL], 2)[1]))
        return compiled(*arguments)

    free = np.full(3, np.inf)
    grid = dense_grid(
        np.array([False, True, False]), -free, free, np.zeros(3),
        lambda u: (u[0], np.array([1.0, u[2], u[1]])), hessian,
    )  # fmt: skip
    grid, _callback = with_system(grid, system)
    search = search_on(grid)
    descend(search, begin(search, guess_of(grid), FROM_GUESS), FROM_GUESS, 1e-10, len(curvatures), Log())
    return [tried[0][1:], *tried[1:]]  # the first matrix was that of the multipliers at the start


def test_where_the_hessian_is_convex_nothing_else_is_tried():
    assert shifts_tried([1.0] * 3) == [[0.0]] * 3


def test_a_shift_is_always_enough_and_the_step_is_one_of_descent():
    curvatures = [-3.0, -50.0, -700.0, -2.0, 1.0, -1e-3, 5.0]
    for curvature, tries in zip(curvatures, shifts_tried(curvatures), strict=True):
        assert curvature + tries[-1] > 0.0


def test_lower_shifts_are_tried_at_once_until_they_are_small():
    """From the first shift down to none, with one factorisation at each iterate; ever faster."""
    rows = shifts_tried([-500.0, *[1e-3] * 6])
    values = [tries[-1] for tries in rows]
    first_zero = values.index(0.0)
    assert all(len(tries) == 1 for tries in rows[1:])
    assert all(value > SMALL_DELTA_W for value in values[:first_zero])
    assert values[first_zero:] == [0.0] * len(values[first_zero:])
    ratios = [a / b for a, b in pairwise(values[:first_zero])]
    assert len(ratios) >= 3
    assert ratios == pytest.approx([3.0 ** (i + 1) for i in range(len(ratios))])


def test_small_shifts_give_way_to_none():
    first, second = shifts_tried([-0.005, 1.0])
    assert 0.0 < first[-1] <= 3.0 * SMALL_DELTA_W
    assert second == [0.0]


def test_where_equations_depend_on_each_other_none_is_tried_first():
    """What rounding calls the inertia of a singular matrix says nothing about curvatures, now and later."""
    rows = shifts_tried([None, -500.0, 1.0, 1.0])
    assert rows[0] == [0.0, 0.0]  # then with a shift of the multipliers' diagonal
    assert all(tries[0] == 0.0 for tries in rows)


@pytest.mark.parametrize("name", ["43", "71", "76"])
def test_steps_of_an_inaccurate_factorisation_are_refined(name):
    """Unknowns of all steps are off by parts of them, each in its own way; without bounds and with them."""
    _, _, problem = HOCK_SCHITTKOWSKI[name]
    exact, grid = problem(), problem()
    errors = 0.2 * np.sin(np.arange(grid.is_multiplier.size))

    def system(compiled: Any, arguments: tuple[int, ...]) -> int:
        excess = compiled(*arguments)
        if arguments[IS_WANTED] and excess == 0:
            step = numbers_at(arguments[STEP], errors.size)
            step += errors * step
        return excess

    grid, _callback = with_system(grid, system)
    (_, expected, iterations), (status, found, others) = solve(exact), solve(grid)
    assert status == "solved"
    assert found.cost == pytest.approx(expected.cost, rel=1e-9)
    assert others <= 1.5 * iterations
    assert_optimal(exact, found)
