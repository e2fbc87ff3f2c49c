"""The gallery of control problems against optima by CasADi and IPOPT, published values and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from compiled_modules import compiled
from conftest import PROBLEMS
from gallery_references import BIOPTIM, REFERENCES, Reference

from codegen.solving import api
from codegen.solving.compiler import build

ON_ALL_GRIDS = ("cart_pole", "goddard_rocket", "hovercraft", "hypersensitive", "brachistochrone")
"""Problems that are solved on all their grids; the others on their coarsest one."""

COMPILED = ("goddard_rocket",)
"""Those with machine code, of which no other test has any of a free duration."""


def name_of(reference: Reference) -> str:
    """A test's name: problem and arguments."""
    return "-".join([reference.problem, *(f"{k}={v}" for k, v in reference.arguments.items())])


@pytest.mark.parametrize("reference", [r for r in REFERENCES if r.problem in ON_ALL_GRIDS], ids=name_of)
def test_optimum_and_value(interpreted, reference):
    if name_of(reference) in COMPILED:
        module = compiled(build(PROBLEMS / f"{reference.problem}.py", scheme=reference.scheme).path)
    else:
        module = interpreted(reference.problem, arguments=dict(reference.arguments), scheme=reference.scheme)
    for steps, optimum in reference.optima.items():
        result = api.solve(module, steps=steps)
        assert result.status == "solved", result.message
        assert result.residual <= 1e-9
        assert result.cost == pytest.approx(optimum, rel=2e-8, abs=1e-9)
    assert result.cost == pytest.approx(reference.value, abs=reference.error)


ON_ONE_GRID = [r for r in REFERENCES if r.problem not in ON_ALL_GRIDS and min(r.optima) <= 100]


@pytest.mark.parametrize("reference", ON_ONE_GRID, ids=name_of)
def test_optimum_on_the_coarsest_grid(interpreted, reference):
    module = interpreted(reference.problem, arguments=dict(reference.arguments), scheme=reference.scheme)
    steps = min(reference.optima)
    solution = module.solve(steps)
    assert solution.status == "solved", solution.message
    assert solution.cost == pytest.approx(reference.optima[steps], rel=2e-8, abs=1e-9)


@pytest.mark.parametrize("form", BIOPTIM)
def test_trajectory_that_bioptim_published(interpreted, form):
    arguments = {} if form == "plain" else {"form": form}
    # One of several local optima, to which the search in the problem's own units leads, as that of bioptim does.
    solution = interpreted("cart_pendulum", arguments=arguments, scheme="trapezoidal").solve(20, scaling="none")
    position, controls = BIOPTIM[form]
    np.testing.assert_allclose(solution.q[10], position, atol=1e-5)
    for interval, value in controls.items():
        assert solution.u[interval, 0] == pytest.approx(value, abs=1e-5)


def test_a_swing_up_with_corrected_steps_takes_about_as_many_iterations_as_ipopt(interpreted):
    """IPOPT 3.11.9 takes 26 on the same program from the same guess; with duals of the refused steps there were 36."""
    solution = interpreted("cart_pendulum", scheme="trapezoidal").solve(20, tolerance=1e-8)
    assert solution.status == "solved"
    assert solution.iterations <= 28
