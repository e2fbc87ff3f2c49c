"""The search for a shift of the Hessian: which shifts are tried, for matrices of which the inertia is known."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from codegen.runtime.optimise import newton_steps, unbounded
from codegen.runtime.optimise.newton_steps import regularised_step
from codegen.runtime.optimise.unbounded import SMALL_DELTA_W, InertiaCorrection

GRID = SimpleNamespace(is_multiplier=np.array([False, True]), steps=1)
POINT = SimpleNamespace(unknowns=np.zeros(2), gradient=np.array([1.0, 0.0]))


@pytest.fixture
def tried(monkeypatch):
    """The shifts tried since the list was emptied; the system, a number, is the least curvature, or None."""
    shifts: list[float] = []

    def factor_kkt(grid, unknowns, weight, diagonal, curvature, gradient, step):
        shifts.append(float(diagonal[0]))
        step[:] = -gradient
        if curvature is None:  # singular unless the multipliers' diagonal is shifted, too
            return 0 if diagonal[1] < 0.0 else None
        return 0 if curvature + diagonal[0] > 0.0 else 1

    monkeypatch.setattr(newton_steps, "factor_kkt", factor_kkt)
    monkeypatch.setattr(newton_steps, "INEQUALITIES", 0)
    for name in ("corrected_inertia", "newton_system", "first_delta_w", "step_along"):
        monkeypatch.setattr(newton_steps, name, getattr(unbounded, name))
    monkeypatch.setattr(unbounded, "primal_ones", lambda steps: np.array([1.0, 0.0]))
    return shifts


def follow(tried, curvatures, shift=InertiaCorrection()):  # noqa: B008  a constant
    """The shift at every iterate, and the shifts that were tried there."""
    for curvature in curvatures:
        tried.clear()
        search = unbounded.Search(GRID, curvature, np.array([1]))
        step = regularised_step(search, unbounded.Iterate(POINT), shift, 0.0, False)
        assert step.slope < 0.0
        shift = step.inertia
        yield shift, list(tried)


def test_where_the_hessian_is_convex_nothing_else_is_tried(tried):
    assert [tries for _, tries in follow(tried, [1.0] * 3)] == [[0.0]] * 3


def test_a_shift_is_always_enough_and_the_step_is_one_of_descent(tried):
    curvatures = [-3.0, -50.0, -700.0, -2.0, 1.0, -1e-3, 5.0]
    for curvature, (shift, _) in zip(curvatures, follow(tried, curvatures), strict=True):
        assert curvature + shift.delta_w > 0.0


def test_lower_shifts_are_tried_at_once_until_they_are_small(tried):
    """From the first shift down to none, with one factorisation at each iterate; ever faster."""
    rows = list(follow(tried, [-500.0, *[1e-9] * 6]))
    values = [shift.delta_w for shift, _ in rows]
    first_zero = values.index(0.0)
    assert all(len(tries) == 1 for _, tries in rows[1:])
    assert all(value > SMALL_DELTA_W for value in values[:first_zero])
    assert values[first_zero:] == [0.0] * len(values[first_zero:])
    ratios = [a / b for a, b in pairwise(values[:first_zero])]
    assert len(ratios) >= 3
    assert ratios == pytest.approx([3.0 ** (i + 1) for i in range(len(ratios))])


def test_small_shifts_give_way_to_none(tried):
    ((shift, tries),) = follow(tried, [1.0], InertiaCorrection(SMALL_DELTA_W, SMALL_DELTA_W, 0))
    assert (shift.delta_w, tries) == (0.0, [0.0])


def test_where_equations_depend_on_each_other_none_is_tried_first(tried):
    """What rounding calls the inertia of a singular matrix says nothing about curvatures, now and later."""
    rows = list(follow(tried, [None, -500.0, 1.0, 1.0]))
    assert all(shift.singular for shift, _ in rows)
    assert all(tries[0] == 0.0 for _, tries in rows)


@pytest.mark.parametrize("lowered", [False, True])
def test_what_a_step_promises_is_measured_after_its_refinement(tried, monkeypatch, lowered):
    """Lengths of a step before its corrections led beyond bounds, by a hundredth of them."""

    def refine(grid, unknowns, diagonal, system, gradient, step):
        step *= 3.0
        return lowered

    monkeypatch.setattr(newton_steps, "refine", refine)
    search, iterate = SimpleNamespace(grid=GRID, system=1.0), SimpleNamespace(point=POINT)
    step = regularised_step(search, iterate, InertiaCorrection(), 0.0, True)
    assert (step.primal == -3.0 * POINT.gradient).all()
    assert step.slope == POINT.gradient @ step.primal
    assert step.refined is lowered
