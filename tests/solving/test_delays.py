"""Problems with values of the past against the method of steps by scipy, closed forms, and one long chain by numpy."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from interpreted import Interpreted, text_of, without_compilation
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from sympy import Eq, cos, sin

from codegen import Control, canonical_pair, control, controls, coordinate, coordinates, state, states, time
from codegen.discretise.model.from_problem import normalise
from codegen.show.figures.quantities import quantities_of_segments
from codegen.solving import api
from codegen.solving.api import outcome_of
from codegen.solving.drivers import find as find_driver
from codegen.solving.request import Request
from codegen.solving.results.control import control_result
from codegen.solving.results.output import save
from codegen.solving.results.result import Run
from codegen.solving.results.segments import put_together, segments_of

PUBLISHED = 2.79685770
"""Betts, example 10.90."""
CALMED = {50: 0.907099151997, 100: 0.907148992344}
"""The optimum of problems/delayed_oscillator.py on so many intervals by CasADi and IPOPT, as one chain of intervals."""


def solved(problem: Control, steps: int, **choices: str):
    """The author's result on so many steps, of an uncompiled module."""
    return result_of(without_compilation(text_of(problem, **choices)), steps)


def result_of(module, steps: int):
    segments = segments_of(module.metadata)
    run = Run(segments.steps(steps) if segments else steps)
    attempt = find_driver("newton").function("control")(module, run)
    result = put_together(control_result(module, "newton", run, attempt), module.metadata)
    assert result.solved, result.message
    return result


def late_oscillator(form: str) -> Control:
    """q'' = -2 q - 0.3 q'(t - 1/2) - q(t - 1) + sin 3t, with q = cos t before; nothing is left to be chosen."""
    t = time()
    if form == "dynamics":
        q, v = states("q v")
        late = -0.3 * v.delayed(0.5) - q.delayed(1) + sin(3 * t)
        return Control(dynamics={q: v, v: late - 2 * q}, duration=3, history={q: cos(t), v: -sin(t)})
    q, v = coordinate("q") if form == "lagrangian" else canonical_pair("q", "v")
    late = -0.3 * v.delayed(0.5) - q.delayed(1) + sin(3 * t)
    motion = {"lagrangian": v**2 / 2 - q**2} if form == "lagrangian" else {"hamiltonian": v**2 / 2 + q**2}
    history = {q: cos(t)} if form == "lagrangian" else {q: cos(t), v: -sin(t)}
    return Control(**motion, force={q: late}, duration=3, history=history)


@pytest.fixture(scope="module")
def followed():
    """The same motion by the method of steps: q and v at a time."""
    pieces = []

    def at(t: float) -> np.ndarray:
        if t <= 0.0:
            return np.array([math.cos(t), -math.sin(t)])
        return pieces[min(len(pieces), math.ceil(2 * t - 1e-9)) - 1](t)

    def rates(t, y):
        return [y[1], -2 * y[0] - 0.3 * at(t - 0.5)[1] - at(t - 1)[0] + math.sin(3 * t)]

    y = at(0.0)
    for n in range(6):
        piece = solve_ivp(rates, (n / 2, (n + 1) / 2), y, "DOP853", rtol=1e-12, atol=1e-13, dense_output=True)
        pieces.append(piece.sol)
        y = piece.y[:, -1]
    return at


CASES = (
    ("lagrangian", "midpoint", "variational", 2),
    pytest.param("lagrangian", "gauss-4", "hamiltonian", 4, marks=pytest.mark.slow),
    ("hamiltonian", "midpoint", "variational", 2),
    pytest.param("dynamics", "gauss-6", None, 6, marks=pytest.mark.slow),
    pytest.param("dynamics", "rk4", None, 4, marks=pytest.mark.slow),
)


@pytest.mark.parametrize(("form", "scheme", "method", "order"), CASES)
def test_schemes_keep_their_order(followed, form, scheme, method, order):
    module = without_compilation(text_of(late_oscillator(form), scheme=scheme, method=method))
    errors = []
    for steps in (12, 24):
        result = result_of(module, steps)
        assert result.t.shape == (steps + 1,)
        np.testing.assert_allclose(result.t, np.linspace(0, 3, steps + 1), atol=1e-14)
        second = result.q[:, 1] if form == "dynamics" else result.p[:, 0]
        exact = np.array([followed(t) for t in result.t])
        errors.append(np.abs(np.column_stack([result.q[:, 0], second]) - exact).max())
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.15)


@pytest.mark.slow
def test_published_value(interpreted: Interpreted):
    result = result_of(interpreted("published/delayed_feedback"), 400)
    assert result.cost == pytest.approx(PUBLISHED, rel=1e-5)
    assert result.names == {"q": ("x",), "p": (), "u": ("u",)}
    assert (result.steps, result.q.shape, result.u.shape) == (400, (401, 1), (400, 1))
    assert result.q.min() == pytest.approx(0.7, abs=1e-7)


def optimal_calm(m: float = 1.0, k: float = 1.0, w: float = 0.1, tau: float = 1.0, number: int = 5):
    """The optimum of problems/delayed_oscillator.py in closed form: its cost, and q where segments end.

    The maximum principle for q_i'' = (-k q_{i-1} + u_i)/m, i = 1, ..., 5, with q_0 = 1, is a linear flow on [0, tau] of
    (q, v, psi, chi, 1) with u = -chi/(2 w m), closed by continuity and psi = chi = 0 at the end.
    """
    n = number
    q, v, psi, chi = range(4)

    def block(part: int) -> slice:
        return slice(part * n, (part + 1) * n)

    flow, eye, before = np.zeros((4 * n + 1, 4 * n + 1)), np.eye(n), np.eye(n, k=-1)
    flow[block(q), block(v)] = eye
    flow[block(v), block(q)] = -k / m * before
    flow[block(v), block(chi)] = -eye / (2 * w * m**2)
    flow[n, 4 * n] = -k / m
    flow[block(psi), block(q)] = -2 * eye
    flow[block(psi), block(chi)] = k / m * before.T
    flow[block(chi), block(psi)] = -eye
    whole = expm(tau * flow)
    rows, right = np.zeros((4 * n, 4 * n)), np.zeros(4 * n)
    row = 0
    for part in (q, v, psi, chi):
        for i in range(n - 1):  # what ends in segment i begins in segment i + 1
            rows[row] = whole[part * n + i, : 4 * n]
            rows[row, part * n + i + 1] -= 1.0
            right[row] = -whole[part * n + i, 4 * n]
            row += 1
    for part, value in ((q, 1.0), (v, 0.0)):
        rows[row, part * n], right[row] = 1.0, value
        row += 1
    for part in (psi, chi):
        rows[row], right[row] = whole[part * n + n - 1, : 4 * n], -whole[part * n + n - 1, 4 * n]
        row += 1
    start = np.append(np.linalg.solve(rows, right), 1.0)
    nodes, weights = np.polynomial.legendre.leggauss(30)
    cost = 0.0
    for node, weight in zip(nodes, weights, strict=True):
        z = expm((node + 1) / 2 * tau * flow) @ start
        u = -z[block(chi)] / (2 * w * m)
        cost += weight * tau / 2 * (z[block(q)] @ z[block(q)] + w * u @ u)
    return cost, (whole @ start)[block(q)]


def test_the_oscillator_is_calmed_as_the_maximum_principle_says(interpreted: Interpreted):
    cost, places = optimal_calm()
    module = interpreted("delayed_oscillator")
    coarse, fine = (result_of(module, steps) for steps in (50, 100))
    assert [coarse.cost, fine.cost] == pytest.approx([*CALMED.values()], rel=1e-10)
    errors = [abs(result.cost - cost) for result in (coarse, fine)]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.05)
    assert (4 * fine.cost - coarse.cost) / 3 == pytest.approx(cost, rel=1e-6)
    np.testing.assert_allclose((4 * fine.q[20::20, 0] - coarse.q[10::10, 0]) / 3, places, atol=1e-5)


def test_a_solve_is_of_the_whole_motion(interpreted: Interpreted, folder: Path):
    """Steps are those of all segments, and what is saved is a start."""
    module = interpreted("delayed_oscillator")
    outcome = outcome_of(Request(module, steps=98))
    result = outcome.result
    assert outcome.notices == [
        "codegen: note: 100 steps instead of 98, as many in each of the 5 segments between multiples of the delay"
    ]
    assert result.cost == pytest.approx(CALMED[100], rel=1e-10)
    assert result.intervals == "100 steps"
    assert (result.summary["duration"], result.t[-1]) == pytest.approx((5.0, 5.0))
    assert result.multipliers.shape == result.p.shape == (101, 1)
    save(result, outcome.record, folder / "calm.npz")
    with np.load(folder / "calm.npz") as archive:
        assert archive["q"].shape == (101, 1)
        assert archive["u_times"] == pytest.approx(np.linspace(0.025, 4.975, 100))
        assert list(archive["q_names"]) == ["q"]
    again = api.solve(module, steps=50, warm=folder / "calm.npz", doublings=1)
    assert [level.steps for level in again.levels] == [50, 100]
    assert again.cost == pytest.approx(CALMED[100], rel=1e-10)


def test_figures_show_the_whole_motion(interpreted: Interpreted):
    result = result_of(interpreted("published/delayed_feedback"), 40)
    groups = quantities_of_segments(interpreted("published/delayed_feedback"), result)
    assert {kind: [quantity.name for quantity in group] for kind, group in groups.items()} == {
        "state": ["x"], "momentum": [], "control": ["u"], "multiplier": ["mu_x"]
    }  # fmt: skip
    (x,), (u,) = groups["state"], groups["control"]
    np.testing.assert_allclose(x.values[:, 0], result.q[:, 0])
    np.testing.assert_allclose(x.t, np.linspace(0, 2, 41), atol=1e-14)
    assert (x.lower[0], x.upper[0]) == (0.7, np.inf)
    assert (u.values.shape, u.on_intervals) == ((40, 1), True)


def long_chain(steps: int) -> tuple[float, np.ndarray, np.ndarray]:
    """The midpoint rule for x' = x(t - 3/4)/2 - u - u(t - 1/2)/3 on [0, 2] without segments: cost, x, u.

    x = 1 + t and u = t before; the cost is the integral of x^2 + u^2. All conditions are linear: one dense KKT system.
    """
    h, of_x, of_u = 2 / steps, 3 * steps // 8, steps // 4
    size = 2 * steps + 1  # x_0, ..., x_N, u_0, ..., u_{N-1}
    jacobian, right = np.zeros((steps + 1, size)), np.zeros(steps + 1)
    jacobian[steps, 0], right[steps] = 1.0, 1.0
    quadratic = np.zeros((size, size))
    for k in range(steps):
        middle = (k + 0.5) * h
        jacobian[k, [k, k + 1]] += [-1.0, 1.0]
        jacobian[k, steps + 1 + k] += h
        if k >= of_x:
            jacobian[k, [k - of_x, k - of_x + 1]] -= h / 4
        else:
            right[k] += h / 2 * (1 + middle - 0.75)
        if k >= of_u:
            jacobian[k, steps + 1 + k - of_u] += h / 3
        else:
            right[k] -= h / 3 * (middle - 0.5)
        quadratic[np.ix_([k, k + 1], [k, k + 1])] += h / 4
        quadratic[steps + 1 + k, steps + 1 + k] += h
    zero = np.zeros((steps + 1, steps + 1))
    kkt = np.block([[2 * quadratic, jacobian.T], [jacobian, zero]])
    z = np.linalg.solve(kkt, np.concatenate([np.zeros(size), right]))[:size]
    return float(z @ quadratic @ z), z[: steps + 1], z[steps + 1 :]


def test_delays_of_states_and_controls_that_have_a_common_part():
    t, x, u = time(), state("x"), control("u")
    problem = Control(
        dynamics={x: x.delayed(0.75) / 2 - u - u.delayed(0.5) / 3},
        cost=x**2 + u**2,
        duration=2,
        history={x: 1 + t, u: t},
    )
    assert normalise(problem).segments.number == 8
    result, (cost, path, controls_) = solved(problem, 32), long_chain(32)
    assert result.cost == pytest.approx(cost, rel=1e-10)
    np.testing.assert_allclose(result.q[:, 0], path, atol=1e-10)
    np.testing.assert_allclose(result.u[:, 0], controls_, atol=1e-10)


def test_a_delay_longer_than_the_duration_reads_the_history_alone():
    t, x, u = time(), state("x"), control("u")
    late = solved(Control(dynamics={x: x.delayed(3) - u}, cost=x**2 + u**2, duration=2, history={x: sin(t)}), 20)
    y, w = state("y"), control("w")
    known = Control(dynamics={y: sin(t - 3) - w}, cost=y**2 + w**2, duration=2, start={y: 0})
    assert late.cost == pytest.approx(solved(known, 20).cost, rel=1e-13)


@pytest.mark.slow
def test_a_pendulum_on_a_circle_with_late_friction():
    """x^2 + y^2 = 1 in Cartesian coordinates, against the angle; momenta and forces of the rod join across segments."""
    (x, y), (dx, dy) = coordinates("x y")
    pendulum = Control(
        lagrangian=(dx**2 + dy**2) / 2 - y,
        force={x: -0.3 * dx.delayed(0.5)},
        constraint=[x**2 + y**2 - 1],
        duration=1.5,
        history={x: 0.6, y: -0.8},
    )
    pieces = []

    def late(t: float) -> float:
        if t <= 0.0:
            return 0.0
        angle, speed = pieces[math.ceil(2 * t - 1e-9) - 1](t)
        return math.cos(angle) * speed

    def rates(t, z):  # x = sin a, y = -cos a
        return [z[1], -math.sin(z[0]) - 0.3 * late(t - 0.5) * math.cos(z[0])]

    z = [math.asin(0.6), 0.0]
    for n in range(3):
        piece = solve_ivp(rates, (n / 2, (n + 1) / 2), z, "DOP853", rtol=1e-11, atol=1e-12, dense_output=True)
        pieces.append(piece.sol)
        z = piece.y[:, -1]
    module = without_compilation(text_of(pendulum))
    errors = []
    for steps in (24, 48):
        result = result_of(module, steps)
        np.testing.assert_allclose(np.hypot(*result.q.T), 1.0, atol=1e-10)
        errors.append(np.abs(result.q[-1] - [math.sin(z[0]), -math.cos(z[0])]).max())
    assert math.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)


@pytest.mark.slow
def test_conditions_on_the_whole_motion_hold_across_segments():
    x, y, u, v = *states("x y"), *controls("u v")
    problem = Control(
        dynamics={x: x.delayed(0.5) - u, y: v},
        cost=u**2 + v**2 + x**2,
        duration=2,
        history={x: 1},
        start={y: 0},
        path={"sum": Eq(x + y, 1), "ramp": u - x.delayed(1) <= 0.4},
        integral={"mean": Eq(x, 1.3)},
    )
    result = solved(problem, 16)
    np.testing.assert_allclose(result.q.sum(axis=1), 1.0, atol=1e-9)
    middle = (result.q[1:, 0] + result.q[:-1, 0]) / 2
    assert middle.sum() * 2 / 16 == pytest.approx(1.3, abs=1e-9)
    before = np.concatenate([np.ones(8), middle[:8]])
    assert (result.u[:, 0] - before).max() == pytest.approx(0.4, abs=1e-6)
    assert result.summary["multiplier of mean"] != 0.0


def test_messages_tell_the_time_of_the_whole_motion():
    x, u = state("x"), control("u")
    problem = Control(
        dynamics={x: x.delayed(0.5) - u}, cost=u**2, duration=2, history={x: 1}, bounds={u: (-0.1, 0.1)}, end={x: 0}
    )
    module = without_compilation(text_of(problem))
    run = Run(4)
    result = control_result(module, "newton", run, find_driver("newton").function("control")(module, run))
    told = put_together(result, module.metadata).message
    assert "x_" not in told
    assert "u_" not in told
    assert "the continuity of x at t = 0.5 is off by" in told
    assert "the step of x on interval 4 (t = 0.5)" in told
