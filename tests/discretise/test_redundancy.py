"""Which couplings follow from others: polygons of hovercraft, random linear systems, contradictions."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import pytest
import sympy
from hypothesis import given, settings
from hypothesis import strategies as st
from sympy import Expr, acos, cos, pi, sin, sqrt

from codegen import Control, body_number, controls, coordinates, free_parameter, parameters, time
from codegen.discretise.conditions.linking import independent_couplings
from codegen.discretise.model.definitions import Model
from codegen.discretise.model.from_problem import normalise


def couplings_of(bodies: int, conditions: Callable[[Any, Any], list[Expr]], **changes: Any) -> Model:
    """Points in the plane with the given couplings between their coordinates x and y."""
    (x, y), (dx, dy) = coordinates("x y")
    f, g = controls("f g")
    arguments = {"start": {x: 0, y: 0}, **changes}
    if "guess" in arguments:
        arguments["guess"] = dict(zip((x, y), arguments["guess"], strict=True))
    return normalise(
        Control(
            lagrangian=(dx**2 + dy**2) / 2,
            force={x: f, y: g},
            cost=f**2 + g**2,
            duration=2,
            bodies=bodies,
            end_conditions=conditions(x, y),
            **arguments,
        )
    )


def polygon(craft: int, parts: str, error: float = 0.0) -> Model:
    """A regular polygon by some of its sides, centre, height, angles and radii, in this order.

    The guess is the polygon itself, out of shape by the given relative error.
    """
    R, Mx, My = parameters(R=1, Mx=2, My=2)
    radius = R / (2 * sin(pi / craft))

    def conditions(x: Any, y: Any) -> list[Expr]:
        corners = [(x.of(i % craft), y.of(i % craft)) for i in range(-1, craft + 1)]

        def squared(a: Any, b: Any) -> Expr:
            return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2

        def angle(a: Any, b: Any, c: Any) -> Expr:
            product = (a[0] - b[0]) * (c[0] - b[0]) + (a[1] - b[1]) * (c[1] - b[1])
            return acos(product / sqrt(squared(a, b) * squared(c, b)))

        every = {
            "sides": [squared(a, b) - R**2 for a, b in itertools.pairwise(corners[1:])],
            "centre": [
                sum(x.of(i) for i in range(craft)) - craft * Mx,
                sum(y.of(i) for i in range(craft)) - craft * My,
            ],
            "height": [y.of(0) - My],
            "angles": [angle(*corners[i : i + 3]) - pi * (craft - 2) / craft for i in range(craft)],
            "radii": [squared(corner, (Mx, My)) - radius**2 for corner in corners[1 : craft - 2]],
        }
        return [condition for part in parts.split() for condition in every[part]]

    i, t = body_number(), time()
    turn = pi + 2 * pi * i / craft
    guess = (
        t / 2 * (Mx + radius * cos(turn) * (1 + error * sin(3 * i + 1))),
        t / 2 * (My + radius * sin(turn) * (1 + error * cos(5 * i))),
    )
    return couplings_of(craft, conditions, guess=guess)


@pytest.mark.parametrize("error", [0.0, 1e-5, 0.05])
@pytest.mark.parametrize("craft", range(3, 9))
def test_hovercraft_polygon_with_all_angles_has_rank_of_its_freedom(craft: int, error: float) -> None:
    model = polygon(craft, "sides centre height angles", error)
    found = independent_couplings(model)
    assert found.consistent
    assert len(model.couplings) == 2 * craft + 3
    assert len(found.kept) == 2 * craft
    assert found.kept[: craft + 3] == tuple(range(craft + 3))
    assert all(names for _, names in found.dropped)


@pytest.mark.parametrize("error", [0.0, 0.05])
@pytest.mark.parametrize("craft", range(3, 9))
def test_minimal_hovercraft_polygon_is_independent(craft: int, error: float) -> None:
    found = independent_couplings(polygon(craft, "sides centre height radii", error))
    assert (found.kept, found.dropped, found.consistent) == (tuple(range(2 * craft)), (), True)


@pytest.mark.parametrize("craft", [4, 5, 6])
def test_the_last_angle_of_a_polygon_follows_from_the_others(craft: int) -> None:
    model = polygon(craft, "angles")
    found = independent_couplings(model)
    others = tuple(condition.name for condition in model.couplings[:-1])
    assert found.dropped == ((craft - 1, others),)


def test_order_decides_what_is_kept() -> None:
    def conditions(x: Any, y: Any) -> list[Expr]:
        a, b, c = x.of(0) - 1, x.of(1) - y.of(0), y.of(1) - 2
        return [a + b, a, 3 * b, c, a + b + c]

    found = independent_couplings(couplings_of(2, conditions))
    first, second, _, fourth, _ = (condition.name for condition in couplings_of(2, conditions).couplings)
    assert found.kept == (0, 1, 3)
    assert found.dropped == ((2, (first, second)), (4, (first, fourth)))


def test_free_parameters_count_as_unknowns() -> None:
    T = free_parameter("T", 3)
    found = independent_couplings(
        couplings_of(2, lambda x, y: [x.of(0) - T, x.of(1) - T, x.of(0) - x.of(1), x.of(0) * T - 9])
    )
    assert found.kept == (0, 1, 3)
    assert found.dropped == ((2, ("x_0 - T = 0", "x_1 - T = 0")),)


def test_a_coupling_may_follow_from_what_holds_for_each_body() -> None:
    def conditions(x: Any, y: Any) -> list[Expr]:
        return [x**2 + y**2 - 25, y.of(0) - 3, y.of(1) - 4, x.of(0) - 4, x.of(1) - y.of(0)]

    found = independent_couplings(couplings_of(2, conditions, guess=(4.1, 2.9)))
    assert (found.kept, found.consistent) == ((0, 1), True)
    circle = "x**2 + y**2 - 25 = 0 of body"
    assert found.dropped == ((2, (f"{circle} 0", "y_0 - 3 = 0")), (3, (f"{circle} 1", "y_0 - 3 = 0", "y_1 - 4 = 0")))


def test_bodies_that_are_guessed_at_one_place() -> None:
    def conditions(x: Any, y: Any) -> list[Expr]:
        return [sqrt((x.of(0) - x.of(1)) ** 2 + (y.of(0) - y.of(1)) ** 2) - 1, x.of(0) + x.of(1)]

    found = independent_couplings(couplings_of(2, conditions))
    assert (found.kept, found.consistent) == ((0, 1), True)


def test_bodies_that_are_guessed_in_one_line() -> None:
    def conditions(x: Any, y: Any) -> list[Expr]:
        pairs = [(0, 1), (1, 2), (2, 3), (3, 0)]
        return [(x.of(i) - x.of(j)) ** 2 + (y.of(i) - y.of(j)) ** 2 - 1 for i, j in pairs]

    # Corners at 0, 1, 2, 1 on a line fulfil all four, but a rhombus beside them is not special.
    i = body_number()
    found = independent_couplings(couplings_of(4, conditions, guess=(i * (-2 * i**2 + 6 * i - 1) / 3, 0)))
    assert (found.kept, found.consistent) == ((0, 1, 2, 3), True)


def test_a_gradient_that_vanishes_depends_on_nothing() -> None:
    found = independent_couplings(couplings_of(2, lambda x, y: [x.of(0) - 1, (x.of(0) - x.of(1)) ** 2, y.of(0)]))
    assert found.kept == (0, 2)
    assert found.dropped == ((1, ()),)
    assert found.consistent


@pytest.mark.parametrize(
    ("conditions", "violated"),
    [
        (lambda x, y: [y.of(0), x.of(0) - x.of(1) - 1, x.of(0) - x.of(1) - 3], "x_0 - x_1"),
        (lambda x, y: [x.of(0) ** 2 + y.of(0) ** 2 + 1, x.of(1)], "x_0**2"),
    ],
)
def test_contradictions_are_reported(conditions: Any, violated: str) -> None:
    found = independent_couplings(couplings_of(2, conditions))
    assert not found.consistent
    assert found.violated.startswith(violated)


def test_no_couplings() -> None:
    found = independent_couplings(couplings_of(2, lambda x, y: []))
    assert (found.kept, found.dropped, found.consistent) == ((), (), True)


def _line(row: list[int]) -> tuple[int, ...]:
    """The same for two rows that are multiples of each other, which might be refused as the same condition."""
    first = next(number for number in row if number)
    return tuple(sympy.Rational(number, first) for number in row)


rows = st.lists(st.integers(-3, 3), min_size=4, max_size=4).filter(any)


@settings(max_examples=30)
@given(st.lists(rows, min_size=1, max_size=7, unique_by=_line), st.integers(-8, 8))
def test_linear_couplings_are_kept_when_they_raise_the_rank(rows: list[list[int]], exponent: int) -> None:
    def conditions(x: Any, y: Any) -> list[Expr]:
        unknowns = [x.of(0), y.of(0), x.of(1), y.of(1)]
        # Units differ from one equation to the next.
        scales = [sympy.Rational(10) ** (exponent * (i % 2)) for i in range(len(rows))]
        # All hold where the unknowns are 1, 2, 3, 4.
        return [
            scale * sum(a * (u - j) for a, u, j in zip(row, unknowns, (1, 2, 3, 4), strict=True))
            for row, scale in zip(rows, scales, strict=True)
        ]

    ranks = [sympy.Matrix(rows[:i]).rank() if i else 0 for i in range(len(rows) + 1)]
    found = independent_couplings(couplings_of(2, conditions))
    assert found.kept == tuple(i for i in range(len(rows)) if ranks[i + 1] > ranks[i])
    assert found.consistent
