"""Solutions that leap over a pole of their equations between two nodes, and those that only pass by."""

from pathlib import Path

import numpy as np
import pytest
from interpreted import of_problem, without_compilation

from codegen import Control, control, coordinates, solve, states
from codegen.solving.compiler import build
from codegen.solving.results.between_nodes import poles

PROBLEMS = Path(__file__).parents[2] / "problems"


def burning(duration: float) -> Control:
    """A thrust over a mass that is gone at t = 1: from there on the discrete equations go on, and no rocket does."""
    x, m = states("x m")
    u = control("u")
    return Control(dynamics={x: u / m, m: -1}, cost=u**2, duration=duration, start={x: 0, m: 1}, end={x: 1})


def wall(height: float, width: float = 0.0) -> Control:
    """A point that is pushed from 0 to 1 across a wall at 0.53, which has no top where it has no width."""
    (q,), (v,) = coordinates("q")
    u = control("u")
    potential = height * (q - 0.53) / ((q - 0.53) ** 2 + width**2)
    return Control(
        lagrangian=v**2 / 2 - potential,
        force={q: u},
        cost=u**2,
        duration=1,
        start={q: 0, v: 0},
        end={q: 1, v: 0},
    )


def found(problem: Control, steps: int, scheme: str | None = None):
    module = of_problem(problem, **({"scheme": scheme} if scheme else {}))
    with np.errstate(all="ignore"):
        solution = module.solve(steps=steps)
        assert solution.status == "solved"
        return poles(module, solution.unknowns, steps, None)


@pytest.mark.parametrize("scheme", ["midpoint", "trapezoidal", "gauss-4", "rk4"])
@pytest.mark.parametrize("steps", [10, 13, 27])
def test_a_mass_that_falls_through_zero(scheme, steps):
    (pole,) = found(burning(2.1), steps, scheme)
    assert pole.state == "x"
    assert pole.time == pytest.approx(1.0, abs=1e-3)
    assert "leaps over a pole" in pole.note


@pytest.mark.parametrize("scheme", ["midpoint", "gauss-4"])
@pytest.mark.parametrize("steps", [10, 27])
def test_a_mass_that_stays(scheme, steps):
    assert found(burning(0.95), steps, scheme) == []


def test_a_wall_without_top():
    (pole,) = found(wall(1.0), 11)
    assert pole.state == "q"
    assert 0.4 < pole.time < 0.6


def test_a_wall_that_the_grid_resolves():
    assert found(wall(0.1, width=0.3), 20) == []
    assert found(wall(0.0), 11) == []


@pytest.mark.parametrize(("name", "steps"), [("bouncing_ball", 20), ("orbital_transfer", 30), ("goddard_rocket", 20)])
def test_the_gallery_has_none(name, steps):
    """A ball that jumps at a switch, a centre of attraction, a rocket whose mass is divided by."""
    module = without_compilation(build(PROBLEMS / f"{name}.py").path.read_text(encoding="utf-8"))
    with np.errstate(all="ignore"):
        solution = module.solve(steps=steps)
        assert solution.status == "solved"
        assert poles(module, solution.unknowns, steps, None) == []


@pytest.mark.parametrize("least", [1e-6, 1e-9])
def test_short_intervals_are_no_obstacle(least):
    """Grids that --accuracy refines; the shortest that a module takes are not cut any more, and nothing is said."""
    module = of_problem(burning(2.1))
    fractions = np.array([*[(1.0 - 4 * least) / 10] * 5, *[least] * 4, *[(1.0 - 4 * least) / 10] * 5])
    with np.errstate(all="ignore"):
        solution = module.solve(steps=14, grid=fractions)
        assert solution.status == "solved"
        assert len(poles(module, solution.unknowns, 14, fractions)) == (1 if least > 1e-8 else 0)


def test_what_is_solved_says_so(uncompiled):
    result = solve(burning(2.1), steps=10)
    assert result.solved
    assert any("leaps over a pole" in note for note in result.notes)
