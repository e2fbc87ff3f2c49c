"""Bounds of states hold where implicit schemes evaluate the dynamics, and explicit schemes say where they do not."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import PROBLEMS
from interpreted import of_problem

from codegen import Control, control, coordinates, solve, states
from codegen.discretise import schemes
from codegen.solving import api
from codegen.solving.results.between_nodes import stages_beyond


def bouncing(form: str) -> Control:
    """A mass that is to turn around at a wall at x = 0 with the least effort: what it feels is its control alone.

    With a control that is constant on an interval its motion there is a parabola, whatever the scheme.
    """
    ends = {"cost": 0, "duration": 1, "steps": 9}
    if form == "first-order":
        x, v = states("x v")
        u = control("u")
        dynamics = {"dynamics": {x: v, v: u}}
    else:
        (x,), (v,) = coordinates("x")
        u = control("u")
        dynamics = {"lagrangian": v**2 / 2, "force": {x: u}}
    ends["cost"] = u**2
    return Control(**dynamics, **ends, start={x: 1, v: -6}, end={x: 1, v: 6}, bounds={x: (0, None)})


CASES = [
    *(("first-order", schemes.FIRST_ORDER, name) for name in ("gauss-4", "gauss-6", "hermite-simpson")),
    *(("mechanical", "hamiltonian", name) for name in ("gauss-4", "gauss-6", "hermite-simpson", "lobatto-4")),
    *(("mechanical", "variational", name) for name in ("gauss-4", "gauss-6", "lobatto-4")),
]


@pytest.mark.parametrize(("form", "method", "scheme"), CASES, ids=lambda case: case)
def test_positions_inside_intervals_are_within_bounds(form, method, scheme):
    module = of_problem(bouncing(form), method=method, scheme=scheme)
    result = api.solve(module)
    assert result.solved, result.message
    table = schemes.find(scheme, method)
    abscissae = [p.abscissa for p in (table.points if table.variational else table.step().points)]
    abscissae += table.nodes if table.variational else []
    h, x, u = np.diff(result.t), result.q[:-1, 0], result.u[:, 0]
    v = result.q[:-1, 1] if form == "first-order" else result.p[:-1, 0]
    least = [float((x + float(c) * h * v + (float(c) * h) ** 2 * u / 2).min()) for c in abscissae]
    assert min(least) > -1e-6
    # The lowest point of a parabola lies in the middle of the motion, on an interval: bounds there are active.
    assert min(least) < 1e-6


def test_explicit_stages_beyond_a_bound_are_noted():
    """A stage of rk4 is on a tangent: half an interval from (x, v) it is at x + h v/2, below where the parabola is."""
    result = api.solve(of_problem(bouncing("first-order"), scheme="rk4"))
    assert result.solved
    h, x, v, u = np.diff(result.t), result.q[:-1, 0], result.q[:-1, 1], result.u[:, 0]
    stages = np.stack([x + h * v / 2, x + h * v / 2 + h**2 * u / 4, x + h * v + h**2 * u / 2])
    (note,) = (note for note in result.notes if "stage" in note)
    assert f"x is {stages.min():.4g} at a stage" in note
    assert f"{-stages.min():.2g} beyond its bound" in note
    assert f"t = {result.t[stages.min(axis=0).argmin()]:.4g}" in note


def test_no_note_of_stages_within_bounds():
    for scheme in ("gauss-4", "midpoint"):
        module = of_problem(bouncing("first-order"), scheme=scheme)
        result = api.solve(module)
        assert not list(stages_beyond(module, result.unknowns, result.steps, None))


def test_penicillin_is_what_is_published():
    """Without bounds at stages gauss-4 gives 179.7 with 50 intervals, from kinetics of negative substrate."""
    result = solve(PROBLEMS / "published" / "penicillin.py", scheme="gauss-4")
    assert result.solved, result.message
    # 87.99 to 88.0 in Banga et al. (2005), table 4, and in Cuthrell and Biegler (1989) 87.69 with a free duration.
    assert 0.99 * 87.99 < result.summary["maximum"] < 1.002 * 87.99
    assert result.error.states > 0.01
    assert any("estimated error" in note for note in result.notes)
