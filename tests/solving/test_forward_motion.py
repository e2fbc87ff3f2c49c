"""Where the start gives all states and the end none, slow searches begin anew at the motion under guessed controls."""

from __future__ import annotations

import numpy as np
import pytest
from interpreted import of_problem
from scipy.integrate import solve_ivp

from codegen import Control, control, controls, states
from codegen.runtime.search import solve
from codegen.runtime.search.solve import forward_motion


def tuberculosis(steps: int = 100) -> Control:
    """Two strains of tuberculosis and two treatments, for five years.

    Source: Jung, Lenhart and Feng (2002), Optimal control of treatments in a two-strain tuberculosis model. The optimum
    is 5152.07312 by gauss-4 with controls at stages, on 200 and on 400 intervals.
    """
    s, t, l1, l2, i1, i2 = states("S T L1 L2 I1 I2")
    u1, u2 = controls("u1 u2")
    n, infection, resistant, death = 30000, 13, 0.029, 0.0143
    treated = (1 - (1 - u2) * 0.5) * i1
    return Control(
        dynamics={
            s: death * n - infection * s * i1 / n - resistant * s * i2 / n - death * s,
            t: 2 * u1 * l1 - death * t + treated - infection * t * i1 / n - resistant * t * i2 / n,
            l1: infection * (s + t) * i1 / n
            - (death + 0.5 + 2 * u1) * l1
            + 0.4 * (1 - u2) * i1
            - resistant * l1 * i2 / n,
            l2: 0.1 * (1 - u2) * i1 - (death + 1) * l2 + resistant * (s + l1 + t) * i2 / n,
            i1: 0.5 * l1 - (death + 1) * i1,
            i2: l2 - death * i2,
        },
        cost=l2 + i2 + 25 * u1**2 + 250 * u2**2,
        duration=5,
        start={s: 19000, t: 250, l1: 9000, l2: 500, i1: 1000, i2: 250},
        bounds={u1: (0.05, 0.95), u2: (0.05, 0.95)},
        steps=steps,
    )


def vaccination(limit: float, duration: float = 60.0) -> Control:
    """An epidemic that vaccination slows, with a limit of those who are ill and one of all doses."""
    s, i = states("S I")
    u = control("u")
    return Control(
        dynamics={s: -0.4 * s * i - u * s, i: 0.4 * s * i - 0.1 * i},
        cost=i + u**2,
        duration=duration,
        start={s: 0.999, i: 0.001},
        bounds={u: (0.002, 0.05)},
        path=[i <= limit],
        integral=[u * s <= 0.4],
        steps=60,
    )


def explosion() -> Control:
    """A state that grows beyond all limits in finite time without the control that holds it."""
    x = states("x y")[0]
    u = control("u")
    return Control(dynamics={x: x**2 - u}, cost=(x - 1) ** 2 + u**2, duration=5, start={x: 1}, steps=40)


@pytest.mark.parametrize("scheme", ["midpoint", "trapezoidal", "gauss-4", "hermite-simpson", "implicit-euler"])
def test_the_motion_obeys_the_equations(scheme):
    module = of_problem(vaccination(1.0), scheme=scheme)
    grid = module.make_grid(60)
    motion = forward_motion(grid, module.initial_guess(grid))
    residual = module.evaluate(grid, motion).gradient[grid.is_multiplier]
    assert np.abs(residual[:-1]).max() <= 1e-9, "all but the integral, which has no slack yet"
    _, q, _, u, _ = module.unpack(grid, motion)
    assert (u >= 0.002).all(), "controls are inside their bounds"

    def rates(_, x):
        return [-0.4 * x[0] * x[1] - 0.002 * x[0], 0.4 * x[0] * x[1] - 0.1 * x[1]]

    exact = solve_ivp(rates, (0, 60), [0.999, 0.001], rtol=1e-10, atol=1e-12).y[:, -1]
    assert np.abs(q[-1] - exact).max() <= (2e-1 if scheme == "implicit-euler" else 2e-2)


def test_a_search_that_takes_long_begins_anew_at_a_motion(monkeypatch):
    """On 100 intervals it takes 169 iterations for 1142; here the first search may take ten."""
    module = of_problem(tuberculosis(20))
    monkeypatch.setattr(solve, "SLOW", 10)
    result = module.solve()
    assert result.status == "solved", result.message
    assert result.cost == pytest.approx(5152.0731, rel=2e-3)
    assert result.iterations <= 50
    assert [row[4] for row in result.log].count(0.0) == 2, "two searches, each with a beginning"


def test_where_there_is_no_motion_the_first_search_goes_on(monkeypatch):
    """From its beginning, and as far as it would have gone without the attempt: iterates are the same."""
    module = of_problem(vaccination(1.0))
    monkeypatch.setattr(solve, "forward_motion", lambda grid, unknowns: None)
    monkeypatch.setattr(solve, "SLOW", 3000)
    own = module.solve(20)
    monkeypatch.setattr(solve, "SLOW", 3)
    result = module.solve(20)
    assert (own.status, result.status) == ("solved", "solved")
    assert result.cost == own.cost
    assert result.iterations == own.iterations + 3


@pytest.mark.parametrize(("ended", "expected"), [("stalled", 2980), ("iteration limit", 300)])
def test_after_a_failure_the_search_from_the_motion_has_all_iterations(monkeypatch, ended, expected):
    """Where the first search may still get there, the one from the motion leaves iterations for it."""
    module, limits = of_problem(vaccination(1.0)), []
    minimise = solve.minimise

    def fails_at_first(grid, unknowns, tolerance, limit, *others):
        limits.append(limit)
        if len(limits) == 1:
            return ended, module.evaluate(grid, unknowns), 20
        return minimise(grid, unknowns, tolerance, limit, *others)

    monkeypatch.setattr(solve, "minimise", fails_at_first)
    assert module.solve(20, max_iterations=3000).status == "solved"
    assert limits == [solve.SLOW, expected]


def test_motions_that_run_away_are_none():
    module = of_problem(explosion())
    grid = module.make_grid(40)
    assert forward_motion(grid, module.initial_guess(grid)) is None
    assert module.solve().status == "solved"


@pytest.mark.parametrize("ends", [{"end": True}, {"start": False}])
def test_what_ends_prescribe_leaves_it_out(ends):
    x, v = states("x v")
    u = control("u")
    start = {x: 0, v: 0} if ends.get("start", True) else {x: 0}
    end = {x: 1} if ends.get("end") else {}
    problem = Control(dynamics={x: v, v: u - v**3}, cost=u**2 + x**2, duration=1, start=start, end=end, steps=10)
    assert not of_problem(problem).problem.structure.forward
    assert of_problem(explosion()).problem.structure.forward
