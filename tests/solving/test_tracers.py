"""Points without momenta: company of landmarks, the way back, derivatives, an independent integrator, refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import PROBLEMS
from scipy.integrate import solve_ivp

from codegen.discretise.model.from_problem import load_problem
from codegen.discretise.particles import PARTICLE_SCHEMES
from codegen.errors import ExpressionError, ModuleError, NumericsError
from codegen.evidence.checks import particles
from codegen.registration import solver
from codegen.solving.compiler import build

START = np.array([[0.1, 0.2], [-0.4, 0.1], [0.3, -0.5]])
MOMENTA = np.array([[0.9, -0.4], [0.2, 0.7], [-0.6, 0.5]])
POINTS = np.array([[0.15, 0.1], [-0.3, -0.2], [0.0, 0.6], [0.29, -0.48], [-0.7, 0.3], [0.05, 0.0]])
STEPS = [name for name, scheme in PARTICLE_SCHEMES.items() if not scheme.adaptive]


@pytest.fixture
def module(interpreted):
    def made(scheme="midpoint", kernel="gauss"):
        found = interpreted("image_registration", arguments={"kernel": kernel, "passive": "True"}, scheme=scheme)
        return in_small_blocks(found)

    return made


def in_small_blocks(module):
    """A module that carries four points at once, which the interpreter does in less time."""
    module.BLOCK, module.problem = 4, replace(module.problem, block=4)
    return module


def motion(module, steps=3, start=START, momenta=MOMENTA):
    """A case, and the states and stages of a motion from given momenta."""
    case = module.make_case(start, start, steps)
    outcome, path, stages = module.trajectory(case, momenta)
    assert outcome >= 0
    return case, path, stages


# ---- The map and its inverse ----


@pytest.mark.parametrize("scheme", STEPS)
def test_points_on_landmarks_follow_them_there_and_back(module, scheme):
    made = module(scheme)
    case, path, stages = motion(made)
    np.testing.assert_allclose(made.carry(case, stages, START)[0], path[-1, 0], atol=2e-15)
    np.testing.assert_allclose(made.carry(case, stages, path[-1, 0], 3, 0)[0], START, atol=2e-15)
    np.testing.assert_allclose(made.carry(case, stages, path[1, 0], 1, 2)[0], path[2, 0], atol=2e-15)
    assert np.abs(path[-1, 0] - START).max() > 0.1


@pytest.mark.parametrize("scheme", STEPS)
def test_the_way_back_is_the_inverse(module, scheme):
    made = module(scheme)
    case, _, stages = motion(made)
    there, tangents = made.carry(case, stages, POINTS, derivative=True)
    back, inverse = made.carry(case, stages, there, 3, 0, derivative=True)
    np.testing.assert_allclose(back, POINTS, atol=1e-14)
    np.testing.assert_allclose(inverse @ tangents, np.tile(np.eye(2), (6, 1, 1)), atol=1e-13)
    between = made.carry(case, stages, POINTS, 0.0, 1.3)[0]
    np.testing.assert_allclose(made.carry(case, stages, between, 1.3, 0.0)[0], POINTS, atol=1e-14)


@pytest.mark.parametrize(("scheme", "kernel"), [("midpoint", "plate"), ("explicit-euler", "plate"), ("rk4", "gauss")])
@pytest.mark.parametrize("ends_of_map", [(0, 3), (3, 0)])
def test_tangents_are_derivatives_of_the_map(module, scheme, kernel, ends_of_map):
    made = module(scheme, kernel)
    case, _, stages = motion(made)
    tangents = made.carry(case, stages, POINTS, *ends_of_map, derivative=True)[1]

    def quotient(step):
        ends = [made.carry(case, stages, POINTS + sign * step, *ends_of_map)[0] for sign in (1, -1)]
        return (ends[0] - ends[1]) / (2 * step.max())

    for axis in range(2):
        near, far = quotient(1e-5 * np.eye(2)[axis]), quotient(2e-5 * np.eye(2)[axis])
        np.testing.assert_allclose(tangents[:, :, axis], (4 * near - far) / 3, atol=2e-10)
    assert np.linalg.det(tangents).min() > 0.0


def green(x, y):
    """Boggio's kernel of the clamped disc (Boggio 1905)."""
    s = ((x - y) ** 2).sum()
    if s == 0.0:
        return (1 - x @ x) ** 2 / 2
    ratio = (x @ x * (y @ y) - 2 * x @ y + 1) / s
    return s * ((ratio - 1) / 2 - np.log(ratio) / 2)


def exact_motion(momenta):
    """Where landmarks and points are after the time one, by DOP853 on an independent formula with differences."""

    def hamiltonian(q, p):
        return sum(p[i] @ p[j] * green(q[i], q[j]) / 2 for i in range(3) for j in range(3))

    def field(_, y):
        q, p, x = y[:6].reshape(3, 2), y[6:12].reshape(3, 2), y[12:].reshape(-1, 2)
        slope = np.empty((3, 2))
        for i, a in np.ndindex(3, 2):
            step = np.zeros((3, 2))
            step[i, a] = 1e-4
            values = [hamiltonian(q + k * step, p) for k in (-2, -1, 1, 2)]
            slope[i, a] = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / 12e-4
        rates = [sum(green(a, b) * p[j] for j, b in enumerate(q)) for a in (*q, *x)]
        return np.concatenate([*rates[:3], -slope.ravel(), *rates[3:]])

    start = np.concatenate([START.ravel(), momenta.ravel(), POINTS.ravel()])
    return solve_ivp(field, (0, 1), start, "DOP853", rtol=1e-10, atol=1e-11).y[12:, -1].reshape(-1, 2)


@pytest.fixture(scope="module")
def arrival():
    return exact_motion(MOMENTA)


@pytest.mark.parametrize(("scheme", "steps"), [("explicit-euler", 16), ("midpoint", 8)])
def test_order_against_an_adaptive_integrator(module, arrival, scheme, steps):
    made = module(scheme, "plate")
    errors = []
    for count in (steps, 2 * steps):
        case, _, stages = motion(made, count)
        errors.append(np.abs(made.carry(case, stages, POINTS)[0] - arrival).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(made.metadata.order, abs=0.3)


# ---- Where points do not move, or cannot ----


def test_nothing_moves_on_the_circle_and_beyond_or_without_momenta(module):
    made = module("midpoint", "plate")
    case, _, stages = motion(made)
    outside = np.array([[1.0, 0.0], [0.0, -1.0], [3.0, 2.0], [-1e9, 0.5], [0.8, 0.6000001]])
    with np.errstate(all="ignore"):  # what is computed there is not used
        carried, tangents = made.carry(case, stages, outside, derivative=True)
    np.testing.assert_array_equal(carried, outside)
    np.testing.assert_array_equal(tangents, np.tile(np.eye(2), (5, 1, 1)))
    case, _, stages = motion(made, momenta=0 * MOMENTA)
    np.testing.assert_array_equal(made.carry(case, stages, POINTS)[0], POINTS)


def test_points_near_the_boundary_and_near_landmarks(module):
    made = module("midpoint", "plate")
    case, _, stages = motion(made)
    angles = np.linspace(0.0, 6.0, 4)
    rim = (1 - 1e-12) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = np.concatenate([rim, START + 1e-12, START + np.array([1e-300, 0.0])])
    there, tangents = made.carry(case, stages, points, derivative=True)
    assert np.isfinite(tangents).all()
    np.testing.assert_allclose(made.carry(case, stages, there, 3, 0)[0], points, atol=1e-14)


def test_a_step_without_solution_gives_no_number(module):
    """An explicit step that folds has no inverse everywhere: such points become NaN, others do not."""
    made = module("explicit-euler")
    case = made.make_case(START, START, 1)
    stages = np.stack([START, 40 * MOMENTA])[None]
    with np.errstate(all="ignore"):
        back = made.carry(case, stages, np.concatenate([POINTS, [[500.0, 500.0]]]), 1, 0)[0]
    assert np.isnan(back).any()
    np.testing.assert_array_equal(back[-1], [500.0, 500.0])
    found = back[np.isfinite(back).all(axis=1)]
    again = made.carry(case, stages, found)[0]
    assert np.abs(again[:, None] - np.concatenate([POINTS, [[500.0, 500.0]]])).max(axis=2).min(axis=1).max() < 1e-11


def test_in_space(interpreted):
    arguments = {"dimension": "3", "passive": "True", "path": "straight"}
    made = interpreted("image_registration", arguments=arguments, scheme="explicit-euler")
    made = in_small_blocks(made)
    start = np.array([[0.1, 0.2, 0.0], [-0.3, 0.1, 0.4]])
    case, path, stages = motion(made, 2, start, np.array([[0.5, -0.4, 0.2], [0.2, 0.1, -0.3]]))
    np.testing.assert_allclose(made.carry(case, stages, start)[0], path[-1, 0], atol=2e-15)
    points = np.array([[0.2, 0.2, 0.1], [-0.3, -0.1, 0.3], [0.9, 0.1, 0.2]])
    there, tangents = made.carry(case, stages, points, derivative=True)
    np.testing.assert_allclose(made.carry(case, stages, there, 2, 0)[0], points, atol=1e-14)
    step = 1e-5 * np.eye(3)
    for axis in range(3):
        ends = [made.carry(case, stages, points + sign * step[axis])[0] for sign in (1, -1)]
        np.testing.assert_allclose(tangents[:, :, axis], (ends[0] - ends[1]) / 2e-5, atol=1e-9)


# ---- What is refused, and what is left out ----

TEXT = '''"""Particles."""
from codegen import Connect, Pairwise, particles
from sympy import exp, sqrt
def problem() -> Connect:
    i, j = particles("x", "p", "m")
    s = (i.q[0] - j.q[0])**2
    return Connect(hamiltonian=Pairwise((i, j), pair_term=PAIR, self_term=SELF), points="some.csv", passive=True)
'''


@pytest.mark.parametrize(
    ("pair", "alone", "message"),
    [
        ("exp(-s)", "i.p[0]**2/(2*i.own[0])", "without momentum, pair_term still changes with x_i"),
        ("i.p[0]*j.p[0]*exp(-s)", "i.p[0]**2/2 + i.q[0]**2", "without momentum, self_term still changes with x_i"),
        ("i.p[0]*j.p[0]*exp(-s)", "i.p[0]**2/2 + i.p[0]", "tracer points would move by themselves"),
        ("i.own[0]*j.own[0]*i.p[0]*j.p[0]*exp(-s)", "i.own[0]**2*i.p[0]**2/2", "a tracer point has no m"),
        ("i.p[0]*j.p[0]/sqrt(s)", "i.p[0]**2/2", "its velocity has no limit"),
        ("i.p[0]*j.p[0]*exp(-s)", "i.p[0]**2", "would leave the particle that it lies on"),
    ],
)
def test_systems_that_have_no_passive_points(tmp_path: Path, pair, alone, message):
    path = tmp_path / "line.py"
    path.write_text(TEXT.replace("PAIR", pair).replace("SELF", alone))
    with pytest.raises(ExpressionError, match=message):
        build(path)


def test_modules_that_carry_nothing_say_so(interpreted):
    made = interpreted("image_registration", arguments={"kernel": "gauss"}, scheme="midpoint")
    assert any("passive=True" in line for line in made.metadata.left_out)
    assert not hasattr(made, "carry")
    with pytest.raises(ModuleError, match="carries no points"):
        solver.require_tracers(made)


def test_unusable_points_and_times(module):
    made = module()
    case, path, stages = motion(made)
    with pytest.raises(ValueError, match=r"points have shape \(6, 3\)"):
        made.carry(case, stages, np.zeros((6, 3)))
    with pytest.raises(ValueError, match=r"last is 3\.5, expected a time between 0 and 3"):
        made.carry(case, stages, POINTS, 0, 3.5)
    with pytest.raises(NumericsError, match="first is -3"):
        solver.Flow(made, case, path, stages).carry(POINTS, -1.0, 1.0)


def test_no_points(module):
    made = module()
    case, _, stages = motion(made)
    carried, tangents = made.carry(case, stages, np.zeros((0, 2)), derivative=True)
    assert carried.shape == (0, 2)
    assert tangents.shape == (0, 2, 2)


def test_threads_change_nothing(module, monkeypatch):
    made = module("midpoint", "plate")
    case, path, stages = motion(made)
    np.testing.assert_array_equal(made.stages_of(case, path), stages)
    alone = solver.Flow(made, case, path, stages, threads=1).carry_with_jacobian(np.tile(POINTS, (2, 1)), 1.0, 0.25)
    monkeypatch.setattr(solver, "THREADED", 0)
    both = solver.Flow(made, case, path, stages, threads=2).carry_with_jacobian(np.tile(POINTS, (2, 1)), 1.0, 0.25)
    for one, other in zip(alone, both, strict=True):
        np.testing.assert_array_equal(one, other)


# ---- Checks ----


@pytest.fixture
def findings(module):
    made = module("midpoint", "plate")
    path = PROBLEMS / "image_registration.py"
    model = load_problem(path, {"passive": "True"})
    generator = np.random.default_rng(1)
    states = [0.4 * scale * generator.uniform(-1.0, 1.0, (2, 3, 2)) for scale in (1.0, 0.02)]

    def made_findings(**changes):
        return list(particles.tracer_findings(replace(model, **changes), made, states))

    return made_findings


def test_checks_hold(findings):
    assert [finding.detail for finding in findings() if not finding.passed] == []


def test_checks_see_another_kernel(findings):
    model = load_problem(PROBLEMS / "image_registration.py", {"passive": "True"})
    failed = {finding.subject for finding in findings(pair_term=model.pair_term * (1 + 1e-9)) if not finding.passed}
    assert len(failed) == 2


def test_checks_see_a_wrong_derivative_and_company(module, findings, monkeypatch):
    made = module("midpoint", "plate")
    right = made.tracer_gradient, made.tracer_velocity

    def wrong_gradient(*arguments):
        right[0](*arguments)
        arguments[-1][:] *= 1 + 1e-7

    def wrong_velocity(*arguments):
        right[1](*arguments)
        arguments[-1][:] *= 1 + 1e-9

    monkeypatch.setattr(made, "tracer_gradient", wrong_gradient)
    monkeypatch.setattr(made, "tracer_velocity", wrong_velocity)
    failed = {finding.subject for finding in findings() if not finding.passed}
    assert {"its derivative by position against 50 digits", "tracer points on particles"} <= failed
