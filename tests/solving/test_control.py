"""Generated solvers of control problems against closed forms, published values and dense linear algebra."""

import numpy as np
import pytest
from conftest import PROBLEMS
from control_variants import (
    DOUBLE_PENDULUM,
    DRIVEN,
    VARIANTS,
    dense_kkt,
    eliminated_blocks_are_positive,
    shifts,
    trial_point,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from sympy import lambdify

from codegen.discretise.model.from_problem import load_problem
from codegen.discretise.schemes import METHODS
from codegen.discretise.transcribe import MOST_PARTS
from codegen.evidence.analysis.maximum_principle import exact_optimum, reference_optimum
from codegen.runtime.search import point
from codegen.runtime.search.grid import free_unknowns
from codegen.runtime.search.linear_system import allocate_system, factor_kkt, solve_kkt

EXACT = 4.530760981081599  # of the linear pendulum, from the maximum principle


@pytest.fixture(scope="session")
def linear_pendulum(interpreted):
    return interpreted("linear_pendulum")


@pytest.mark.parametrize(("steps", "cost"), [(10, 4.546929903), (200, 4.530801094)])
def test_linear_pendulum_reproduces_reference_costs(linear_pendulum, steps, cost):
    solution = linear_pendulum.solve(steps)
    assert solution.status == "solved"
    assert solution.cost == pytest.approx(cost, abs=1e-9)
    assert solution.residual < 1e-11


def test_linear_pendulum_converges_at_order_two_over_the_whole_sweep(linear_pendulum):
    errors = {n: linear_pendulum.solve(n).cost - EXACT for n in range(10, 201, 5)}
    assert all(errors[2 * n] > 0 and abs(errors[n] / errors[2 * n] - 4) < 0.1 for n in range(10, 101, 5))


@pytest.mark.parametrize("steps", [10, 55])
def test_variational_and_hamiltonian_midpoint_are_the_same_discretisation(linear_pendulum, interpreted, steps):
    other = interpreted("linear_pendulum", method="hamiltonian").solve(steps)
    one = linear_pendulum.solve(steps)
    assert other.cost == pytest.approx(one.cost, rel=1e-11)
    np.testing.assert_allclose(other.q, one.q, atol=1e-9)
    np.testing.assert_allclose(other.p, one.p, atol=1e-9)


def test_explicit_euler_is_of_order_one(interpreted):
    module = interpreted("linear_pendulum", method="hamiltonian", scheme="explicit-euler")
    errors = [module.solve(n).cost - EXACT for n in (50, 100, 200)]
    assert [errors[0] / errors[1], errors[1] / errors[2]] == pytest.approx([2, 2], abs=0.12)


@pytest.mark.parametrize(("revolutions", "steps", "cost"), [(1.0, 50, 0.0487567009), (2.0, 300, 0.0244340488530)])
def test_orbital_transfer_reproduces_reference_costs(orbital_transfer, revolutions, steps, cost):
    solution = orbital_transfer.solve(steps, revolutions=revolutions)
    assert solution.status == "solved"
    assert solution.cost == pytest.approx(cost, abs=1e-10)
    assert solution.residual < 1e-9
    assert solution.iterations <= 8


def test_orbital_transfer_solves_thirty_thousand_intervals(orbital_transfer):
    solution = orbital_transfer.solve(30000, revolutions=2.0)
    assert solution.status == "solved"
    # The continuous optimum, by shooting from scipy's collocation at 1e-10 (tests/evidence).
    assert solution.cost == pytest.approx(0.0244339769446, abs=1e-10)
    assert solution.residual < 5e-9


@pytest.fixture(scope="session")
def exact_motion():
    """Exact optimal (q, p) of the linear pendulum as a function of time, derived from the maximum principle."""
    model = load_problem(PROBLEMS / "linear_pendulum.py")
    return lambdify(model.time, exact_optimum(model).states, "numpy")


LONG = {
    *("blanes-moan-4", "suzuki-4", "mclachlan-4", "gauss-6", "gauss-8"),
    *("blanes-moan-6", "yoshida-6", "kahan-li-6", "yoshida-8"),
}
"""Schemes whose control problems take long to derive; yoshida-4 and gauss-4 stand for them."""
SCHEMES = [
    (method, name)
    for method, table in METHODS.items()
    for name, scheme in table.items()
    if name not in LONG and len(scheme.parts) <= MOST_PARTS
]


@pytest.mark.parametrize(("method", "scheme"), SCHEMES)
def test_every_scheme_converges_to_the_exact_motion_at_its_order(interpreted, exact_motion, method, scheme):
    module = interpreted("linear_pendulum", method=method, scheme=scheme)
    errors = []
    for steps in (40, 80):
        solution = module.solve(steps)
        assert solution.status == "solved"
        q, p = exact_motion(solution.t)
        errors.append(max(np.abs(solution.q[:, 0] - q).max(), np.abs(solution.p[:, 0] - p).max()))
    # One control on each interval: the best piecewise constant control is of order 2, whatever the scheme.
    assert np.log2(errors[0] / errors[1]) == pytest.approx(min(2, METHODS[method][scheme].order), abs=0.1)


@pytest.mark.parametrize(
    ("method", "scheme"),
    [(m, s) for m, s in SCHEMES if METHODS[m][s].order <= 2]
    + [("variational", "gauss-4"), ("hamiltonian", "lobatto-4")],
)
def test_every_scheme_solves_the_nonlinear_transfer(interpreted, method, scheme):
    solution = interpreted("orbital_transfer", method=method, scheme=scheme).solve(60)
    assert solution.status == "solved"
    # The continuous optimum is 0.0487491711595 (collocation of the maximum principle, tests/evidence).
    assert solution.cost == pytest.approx(0.0487491711595, rel=3e-3 if METHODS[method][scheme].order >= 2 else 8e-2)
    assert solution.residual < 1e-9


@pytest.mark.parametrize("scheme", ["midpoint", "trapezoidal"])
def test_partly_free_velocities_agree_between_the_methods(interpreted, scheme):
    steps = 40
    variational = interpreted("double", DOUBLE_PENDULUM, scheme=scheme).solve(steps)
    assert variational.status == "solved"
    if scheme == "midpoint":
        phase = interpreted("double", DOUBLE_PENDULUM, method="hamiltonian").solve(steps)
        assert phase.cost == pytest.approx(variational.cost, rel=1e-10)
    # The prescribed velocities follow from the momenta: M(q) v = p with the mass matrix of the text's Lagrangian.
    for node, which in ((0, 0), (-1, 1)):
        a, b = variational.q[node]
        mass = np.array([[2, np.cos(a - b)], [np.cos(a - b), 1]])
        assert np.linalg.solve(mass, variational.p[node])[which] == pytest.approx(0, abs=1e-9)


def test_explicit_time_is_seen_everywhere(interpreted, tmp_path):
    path = tmp_path / "driven.py"
    path.write_text(DRIVEN)
    exact = reference_optimum(load_problem(path)).cost  # scipy's collocation of the maximum principle
    errors = []
    for steps in (20, 40):
        solution = interpreted("driven", DRIVEN).solve(steps)
        assert solution.status == "solved"
        errors.append(solution.cost - exact)
    assert errors[0] / errors[1] == pytest.approx(4, abs=0.1)


@pytest.mark.parametrize(("name", "text", "choices"), VARIANTS)
@settings(max_examples=8, deadline=None)
@given(steps=st.integers(2, 5), seed=st.integers(0, 10**6), shift=st.sampled_from([0.0, 0.3]))
def test_structured_step_solves_the_dense_system(interpreted, name, text, choices, steps, seed, shift):
    module = interpreted(name, text, **choices)
    grid = module.make_grid(steps)
    unknowns = trial_point(module, grid, seed, 0.2)
    keep = np.flatnonzero(free_unknowns(grid))
    gradient = module.evaluate(grid, unknowns).gradient
    system, excess = allocate_system(grid), 1
    step, carried = np.empty_like(unknowns), np.empty_like(unknowns)
    while excess is not None and excess > 0:  # the elimination stops early where the Hessian is not convex
        diagonal = shifts(module, grid, shift, 1e-3)
        excess = factor_kkt(grid, unknowns, 1.0, diagonal, system, gradient, carried)
        shift = max(1e-2, 10.0 * shift)
    matrix = dense_kkt(module, grid, unknowns) + np.diag(diagonal)
    if excess is None:
        assert np.linalg.cond(matrix[np.ix_(keep, keep)]) > 1e8 or not eliminated_blocks_are_positive(
            module, grid, matrix
        )
        return
    solve_kkt(grid, system, gradient, step)
    np.testing.assert_allclose(carried, step, rtol=1e-9, atol=1e-9 * np.abs(step).max())
    scale = np.abs(matrix).max() * np.abs(step).max() + np.abs(gradient).max()
    assert np.abs((matrix @ step + gradient)[keep]).max() <= 1e-8 * scale
    # What is given stays, and what equals a shared unknown follows it.
    moved = module.with_pinned_values(grid, unknowns + step)
    np.testing.assert_allclose(moved, unknowns + step, rtol=1e-12, atol=1e-12 * (1 + np.abs(step).max()))


@pytest.mark.parametrize(("name", "text", "choices"), VARIANTS)
def test_callbacks_are_each_others_derivatives(interpreted, name, text, choices):
    module = interpreted(name, text, **choices)
    grid = module.make_grid(4)
    free = free_unknowns(grid)
    unknowns = trial_point(module, grid, 3, 0.1)
    direction = np.where(free, np.random.default_rng(4).normal(size=free.size), 0.0)
    step = 1e-6
    ahead, behind = (module.with_pinned_values(grid, unknowns + sign * step * direction) for sign in (1, -1))
    primal, multipliers = module.primal_unknowns(grid), module.multiplier_unknowns(grid)

    slope = (point.cost(grid, ahead) - point.cost(grid, behind)) / (2 * step)
    assert point.cost_gradient(grid, unknowns) @ direction[primal] == pytest.approx(slope, rel=1e-6, abs=1e-7)
    matrix = dense_kkt(module, grid, unknowns)
    change = (module.evaluate(grid, ahead).gradient - module.evaluate(grid, behind).gradient) / (2 * step)
    np.testing.assert_allclose((matrix @ direction)[free], change[free], rtol=1e-6, atol=1e-5 * np.abs(change).max())
    assert point.constraints(grid, unknowns).size == multipliers.size


def test_layouts_are_shared_by_grids_and_cannot_be_changed(interpreted):
    module = interpreted("linear_pendulum")
    grid = module.make_grid(5)
    free = free_unknowns(grid)
    with pytest.raises(ValueError, match="read-only"):
        free[0] = True
    grid.is_multiplier[:] = True  # a grid's own
    assert module.make_grid(5).is_multiplier.tolist() == [False, True, False] * 5 + [False, True]
    assert free.tolist() == [False, True, True] + [True] * 12 + [False, True]
    assert free_unknowns(module.make_grid(6)).size == 20


def test_boundary_values_stay_arguments(linear_pendulum):
    solution = linear_pendulum.solve(50, start={"q": 0.3, "dq": 0.1}, end={"q": -0.2}, duration=1.0)
    assert solution.q[0, 0] == 0.3
    assert solution.q[-1, 0] == -0.2
    assert solution.p[0, 0] == pytest.approx(0.1, abs=1e-12)
    with pytest.raises(ValueError, match="'v' is not prescribed at the end; prescribed: q, dq"):
        linear_pendulum.solve(50, end={"v": 1.0})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"steps": 0}, "steps is 0"),
        ({"steps": 2.5}, "steps is 2.5"),
        ({"duration": -1.0}, "duration is -1.0"),
        ({"m": float("nan")}, "finite"),
        ({"guess": np.zeros(3)}, "guess has shape"),
    ],
)
def test_unusable_arguments_are_refused(orbital_transfer, arguments, message):
    with pytest.raises(ValueError, match=message):
        orbital_transfer.solve(**{"steps": 10, **arguments})


def test_iteration_limit_is_named(orbital_transfer):
    solution = orbital_transfer.solve(50, max_iterations=2)
    assert solution.status == "iteration limit"
    assert "raise max_iterations" in solution.message


def test_non_finite_start_is_named_with_its_node(orbital_transfer):
    grid = orbital_transfer.make_grid(20)
    guess = orbital_transfer.initial_guess(grid)
    orbital_transfer.views(grid, guess)[0][0, 7, 0] = np.inf
    solution = orbital_transfer.solve(20, guess=guess)
    assert solution.status == "non-finite"
    assert "node" in solution.message


def test_a_cost_without_minimum_is_not_called_solved(interpreted):
    text = (PROBLEMS / "linear_pendulum.py").read_text().replace("cost=f**2", "cost=-(f**2)")
    solution = interpreted("unbounded", text).solve(50)
    assert solution.status in ("unbounded", "rank-deficient")


def test_nodal_controls_reproduce_the_false_freedom(interpreted):
    """The alternating control acts on the motion and costs nothing: the solver has to pick one of many optima."""
    module = interpreted("linear_pendulum", controls="nodal")
    solution = module.solve(50)
    assert solution.status == "solved"
    assert solution.u.shape == (51, 1)
    alternating = solution.u[:, 0] + 0.7 * (-1.0) ** np.arange(51)
    mean = (alternating[1:] + alternating[:-1]) / 2
    assert np.sum(mean**2) * (np.pi / 2 / 50) == pytest.approx(solution.cost, rel=1e-12)


@pytest.mark.parametrize(
    ("potential", "cost", "word"),
    [("0", "u**2 - 1000*q**2", "unbounded"), ("cos(q)", "u**2 + 1000*cos(q)", "solved")],
)
def test_a_stationary_start_that_is_no_minimum_is_left(interpreted, potential, cost, word):
    """All ends are zero, so the guess is stationary; the cost has no minimum there (by hand: try any small bump).

    At rest upside down the second cost is 10000; hanging most of the time it is nearly -10000.
    """
    text = '''"""Stay at zero."""
from sympy import cos
from codegen import Control, control, coordinate
def problem() -> Control:
    q, dq = coordinate("q")
    u = control("u")
    return Control(lagrangian=dq**2/2 + POTENTIAL, force={q: u}, cost=COST, duration=10,
                   start={q: 0, dq: 0}, end={q: 0, dq: 0}, steps=40)
'''
    text = text.replace("POTENTIAL", potential).replace("COST", cost)
    solution = interpreted(f"stay_{word[:3]}", text).solve(40)
    assert solution.status == word
    if word == "solved":
        assert -10000.0 < solution.cost < -7000.0


@pytest.mark.parametrize("mass", [1e-11, 1e-6, 1e-3, 1.0, 1e3, 1e6])
def test_an_unusual_unit_of_mass_gives_no_wrong_answer(interpreted, mass):
    """The cost of the transfer is proportional to the squared mass (thrust is mass times acceleration)."""
    solution = interpreted("orbital_transfer").solve(30, m=mass, max_iterations=40)
    if not 1e-3 <= mass <= 1e3 and solution.status != "solved":
        return  # such units are not solved yet, and that is said
    assert solution.status == "solved"
    assert solution.cost / mass**2 == pytest.approx(interpreted("orbital_transfer").solve(30).cost / 1e4, rel=1e-6)
