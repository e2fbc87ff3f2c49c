"""Values at the ends agree with conditions and bounds to the rounding of their terms, whatever is left of these."""

from __future__ import annotations

from math import cos, pi, radians, sin

import pytest
from sympy import Eq, sqrt

from codegen import Control, Phases, controls, states
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.transcribe import transcribe
from codegen.errors import BoundaryError

R = 6378145.0
A, B = R * cos(radians(28.5)), R * sin(radians(28.5))
x, y, v, w = states("x y v w")
a, b = controls("a b")


def flight(path=(), start_x=A, start_y=B, **given) -> Control:
    """A flight from a point of the Earth's surface, in metres."""
    return Control(
        dynamics={x: v, y: w, v: a, w: b},
        cost=a**2 + b**2,
        path=list(path),
        duration=100,
        start={x: start_x, y: start_y, v: 0, w: 0},
        steps=8,
        **given,
    )


SURFACES = (x**2 + y**2 >= R**2, sqrt(x**2 + y**2) >= R, (x**2 + y**2) ** 2 >= R**4, x**2 / R + y**2 / R >= R)


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("surface", SURFACES)
def test_a_start_on_the_surface_is_no_violation(surface, sign):
    """x^2 + y^2 - R^2 is -0.018 m^2 in decimals of 15 digits, one rounding error of 4e13 m^2."""
    program = transcribe(normalise(flight([surface], sign * A, sign * B)), "midpoint")
    assert len(program.model.path) == 1  # it is not left out for that


@pytest.mark.parametrize("surface", SURFACES)
def test_a_start_metres_below_the_surface_is_one(surface):
    with pytest.raises(BoundaryError, match="start violates"):
        normalise(flight([surface], A - 1.0, B))


def test_equations_that_decide_an_end_round_too():
    """The end is given by an equation; of its value in the limit only the rounding is left."""
    ending = {"end_conditions": [Eq(x - 1e-3 * v, A)], "end": {y: B, v: 0}}
    with pytest.raises(BoundaryError, match="the end violates"):
        transcribe(normalise(flight([x**2 + y**2 >= (R + 1.0) ** 2], 2 * A, 2 * B, **ending)), "midpoint")
    transcribe(normalise(flight([x**2 + y**2 >= R**2], 2 * A, 2 * B, **ending)), "midpoint")


def test_an_end_condition_between_given_values_and_bounds_of_rounded_zeros():
    """sin(pi) is 1.2e-16 in a computer."""
    normalise(flight(start_x=sin(pi), start_y=0, bounds={x: (None, 0)}))
    with pytest.raises(BoundaryError, match="above its upper bound 0"):
        normalise(flight(start_x=1e-6, start_y=0, bounds={x: (None, 0)}))


def test_a_small_violation_of_small_terms_is_one():
    """1e-10 is no rounding of 1e-10; until now it was of one."""
    with pytest.raises(BoundaryError, match=r"start violates x >= 2\.0e-10"):
        normalise(flight([x >= 2e-10], 1e-10, 0))


def test_a_value_at_a_switch_on_its_bound_up_to_rounding():
    def one(**more) -> Control:
        return Control(dynamics={x: v, v: a}, cost=a**2, duration=1, steps=4, **more)

    def both(given: float) -> Phases:
        return Phases(one(start={x: 0, v: 0}, end={x: given}), one(end={v: 0}, bounds={x: (0.3, None)}))

    normalise(both(0.1 * 3 - 1e-16))
    with pytest.raises(BoundaryError, match="outside its bounds"):
        normalise(both(0.2999))
