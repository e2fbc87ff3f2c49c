"""The generated solver against drivers of scipy on every control problem of the gallery, on a small mesh.

The drivers share the generated callbacks with the solver, but neither its linear algebra nor its way of choosing steps.
They start from the problem's guess, or, where that leads them to another local optimum or nowhere, from the solution
with every unknown changed at random by up to one percent.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from conftest import PROBLEMS
from golden import text_of
from interpreted import without_compilation

from codegen.runtime.search.grid import free_unknowns
from codegen.solving import api

STEPS = {"pendulum_swing_up": 12, "two_stage_rocket": 4}
"""Intervals, where six are too few for a solution to exist; of each phase, where there are several."""


@dataclass(frozen=True)
class Case:
    """A problem, a driver, whether to start near the solution, and the relative difference that costs may have."""

    problem: str
    driver: str
    near: bool = False
    difference: float = 1e-9


PLAIN = (
    "betts_10_7 delayed_oscillator double_integrator_effort four_bar hovercraft hypersensitive "
    "linear_pendulum n_link_pendulum orbital_transfer orbital_transfer_hamiltonian snakeboard spherical_pendulum"
).split()
BOUNDED = (
    "acrobot bouncing_ball brachistochrone bryson_denham cart_pendulum cart_pole cart_pole_balance convoy crane "
    "double_integrator drone_gates drone_in_space goddard_rocket low_thrust pendulum_swing_up quadrotor quadrotor_path "
    "robot_arm two_link_arm two_stage_rocket van_der_pol"
).split()

ELSEWHERE = {
    ("hovercraft", "fsolve"),  # stalls on six intervals, and on ten
    ("hovercraft", "slsqp"),  # another local optimum
    ("hovercraft", "trust-constr"),  # another local optimum: which one depends on rounding
    *(("n_link_pendulum", driver) for driver in ("fsolve", "slsqp", "trust-constr")),  # another optimum
    *(("acrobot", driver) for driver in ("slsqp", "trust-constr")),  # which of two optima is found depends on rounding
    ("four_bar", "trust-constr"),  # another local optimum
    ("cart_pendulum", "slsqp"),  # another local optimum
    ("cart_pendulum", "trust-constr"),  # another local optimum
    ("pendulum_swing_up", "trust-constr"),  # an infeasible point
    ("low_thrust", "slsqp"),  # a singular subproblem at the guess
    ("drone_gates", "slsqp"),  # stops where it is not stationary
    ("drone_gates", "trust-constr"),  # the limit of iterations, far from the equations
}
"""Problems and drivers that have to start near the solution, and what happens otherwise."""

CONTACT = {"hopper", "pushed_block", "shove"}
"""Problems with contact forces: other drivers have no continuation; `test_contact.py` has IPOPT's optimum."""

LOOSE = {"double_integrator": 5e-6, "robot_arm": 5e-6, "crane": 5e-7, "goddard_rocket": 5e-7}
"""What the barrier of trust-constr, which it does not lower to zero, leaves of the cost where bounds are active."""

CASES = [
    *(Case(p, d, (p, d) in ELSEWHERE) for p in PLAIN for d in ("fsolve", "slsqp", "trust-constr")),
    *(Case(p, "slsqp", (p, "slsqp") in ELSEWHERE) for p in BOUNDED),
    *(
        Case(p, "trust-constr", (p, "trust-constr") in ELSEWHERE, LOOSE.get(p, 2e-6))
        for p in BOUNDED
        if p not in ("bryson_denham", "two_stage_rocket")  # there it ends at an infeasible point
    ),
]


@cache
def solved(problem: str):
    """The uncompiled module and what `newton` finds."""
    module = without_compilation(text_of(f"{problem}.py"), problem)
    with np.errstate(all="ignore"):
        return module, api.solve(module, steps=STEPS.get(problem, 6))


def beside(module, result):
    """The solution with every unknown changed by up to one percent, or a thousandth where it is small."""
    grid = module.make_grid(result.steps)
    generator = np.random.default_rng(zlib.crc32(result.problem.encode()))
    noise = 1e-2 * np.maximum(np.abs(result.unknowns), 0.1) * generator.uniform(-1, 1, result.unknowns.size)
    return module.with_pinned_values(grid, result.unknowns + np.where(free_unknowns(grid), noise, 0.0))


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.problem}-{case.driver}")
def test_same_optimum(case: Case):
    module, reference = solved(case.problem)
    assert reference.status == "solved", reference.message
    start = beside(module, reference) if case.near else None
    with np.errstate(all="ignore"):
        result = api.solve(module, case.driver, steps=reference.steps, warm=start)
    assert result.status == "solved", result.message
    assert result.cost == pytest.approx(reference.cost, rel=case.difference)
    assert result.residual <= 1e-8
    # The cost is flat at an optimum, and controls are known to the root of its accuracy only.
    scale = max(1.0, np.abs(reference.u).max())
    np.testing.assert_allclose(result.u, reference.u, atol=max(1e-4, np.sqrt(case.difference)) * scale)


def test_every_control_problem_is_compared():
    names = {path.stem for path in PROBLEMS.glob("*.py") if "Control(" in path.read_text()}
    compared = {case.problem for case in CASES}
    assert names <= compared | CONTACT
