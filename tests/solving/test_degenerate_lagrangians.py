"""Simulations of Lagrangians that are linear in the velocities, against closed forms and DOP853 of scipy."""

from dataclasses import replace

import numpy as np
import pytest
import sympy
from command_lines import run
from conftest import PROBLEMS
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import fsolve
from sympy import Abs, cos, log, sin, sqrt

import codegen
from codegen import Control, Simulate, control, coordinates, parameters, time
from codegen.errors import (
    ArgumentError,
    BoundaryError,
    CodegenError,
    DegenerateError,
    ExpressionError,
    SchemeError,
    SizeError,
)
from codegen.evidence import checks
from codegen.show.equations import equations

VORTICES = PROBLEMS / "point_vortices.py"
BANANA = 43107
"""Duration of a motion of the trapped guiding centre, about one bounce between both ends of its banana orbit."""


def lotka_volterra(gauge: int = 0, **others) -> Simulate:
    """Return two species with the conserved quantity x - log x + y - 2 log y; Omega = 1/(x y) is not constant.

    The derivative of `gauge` x y is added to the Lagrangian, without effect on the motion. Source: Kraus (2017).
    """
    (x, y), (dx, dy) = coordinates("x y")
    energy = x - log(x) + y - 2 * log(y)
    return Simulate(
        lagrangian=log(y) / x * dx + gauge * (y * dx + x * dy) - energy,
        **{"duration": 10, "start": {x: 1, y: 1}, **others},
    )


def guiding_centre(form: str) -> Simulate:
    """Follow a trapped particle in a field like that of a tokamak.

    In `toroidal` coordinates two components of theta vanish. In `cylindrical` coordinates Omega has no zero block.
    Source of the cylindrical field and of the values: Qin and Guan (2008), Physical Review Letters 100, 035006.
    """
    mu, q0 = parameters(mu=2.25e-6, q0=2)
    names = "r a b u" if form == "toroidal" else "R Z b u"
    (r, a, b, u), (dr, da, db, _) = coordinates(names)
    if form == "toroidal":
        R = 1 + r * cos(a)
        A = [0, r**2 / (2 * R), -(r**2) / (2 * q0)]
        field = [0, r / (q0 * R), A[1].diff(r) / r]
        lengths, start = [1, r, R], {r: 0.05, a: 0, b: 0, u: -4.306e-4}
    else:
        R, Z = r, a
        A = [Z / (2 * R), -log(R) / 2, -((R - 1) ** 2 + Z**2) / (2 * q0)]
        field = [-Z / (q0 * R), (R - 1) / (q0 * R), -1 / R]
        lengths, start = [1, 1, R], {R: 1.05, Z: 0, b: 0, u: -4.306e-4}
    size = sqrt(sum(B**2 for B in field))
    theta = [c + u * length * B / size for c, B, length in zip(A, field, lengths, strict=True)]
    return Simulate(
        lagrangian=sum(c * v for c, v in zip(theta, (dr, da, db), strict=True)) - mu * size - u**2 / 2,
        duration=BANANA,
        start=start,
        steps=400,
    )


def reference(problem: Simulate, times):
    """Return the motion (times, coordinates) by DOP853, with Omega q' = dH + d theta/dt - f solved by numpy."""
    lagrangian = sympy.sympify(problem.lagrangian)
    coordinates_ = list(problem.start)
    rates = [q.partner for q in coordinates_]
    clock = sympy.Dummy("t")
    symbols = [s for s in lagrangian.free_symbols if isinstance(s, codegen.problem.symbols.Time)]
    fixed = {s: s.value for s in lagrangian.free_symbols if isinstance(s, codegen.problem.symbols.Parameter)}
    lagrangian = lagrangian.subs(fixed).xreplace(dict.fromkeys(symbols, clock))
    theta = sympy.Matrix([sympy.diff(lagrangian, v) for v in rates])
    slopes = theta.jacobian(coordinates_)
    energy = -lagrangian.subs(dict.fromkeys(rates, 0))
    forces = sympy.Matrix([problem.force.get(q, 0) for q in coordinates_])
    right = sympy.Matrix([sympy.diff(energy, q) for q in coordinates_]) + theta.diff(clock) - forces
    function = sympy.lambdify([clock, coordinates_], [slopes.T - slopes, right.T], cse=True)

    def field(t, z):
        omega, gradient = function(t, z)
        return np.linalg.solve(np.array(omega, dtype=float), np.ravel(gradient))

    start = [float(value) for value in problem.start.values()]
    sizes = np.maximum(np.abs(start), 1e-4)
    span = (0.0, float(times[-1]))
    return solve_ivp(field, span, start, "DOP853", t_eval=times, rtol=1e-12, atol=1e-13 * sizes).y.T


def slopes(errors, steps):
    return np.diff(np.log(errors)) / -np.diff(np.log(steps))


def errors_of(problem, steps, **options):
    solver, errors = codegen.compile(problem, **options), []
    exact = reference(problem, np.linspace(0, float(problem.duration), steps[0] + 1))
    for n in steps:
        result = solver.solve(steps=n)
        assert result.status == "solved"
        assert result.p.shape == (n + 1, 0)
        errors.append(np.abs((result.q[:: n // steps[0]] - exact) / np.abs(exact).max(axis=0)).max())
    return errors


@pytest.mark.parametrize(
    ("scheme", "method", "order"),
    [
        ("symplectic-euler", None, 1),
        ("midpoint", None, 2),
        ("stormer-verlet", None, 2),
        ("gauss-4", None, 4),
        ("yoshida-4", None, 4),
        ("midpoint", "one-step", 2),
        ("gauss-4", "one-step", 4),
    ],
)
def test_two_vortices_turn_as_in_the_closed_form(scheme, method, order):
    """Both circle their centre of circulation at the rate (G1 + G2)/(2 pi d^2). Source: Aref (2007)."""
    solver = codegen.compile(VORTICES, arguments={"vortices": "two"}, scheme=scheme, method=method)
    errors, steps = [], [200, 400, 800]
    for n in steps:
        result = solver.solve(steps=n)
        angle = 3 / (2 * np.pi) * result.t
        turned = np.column_stack([np.cos(angle), np.sin(angle)])
        exact = np.hstack([[2 / 3, 0] - 2 / 3 * turned, [2 / 3, 0] + 1 / 3 * turned])
        errors.append(np.abs(result.q - exact).max())
        assert result.t[-1] == pytest.approx(4 * np.pi**2 / 3, rel=1e-15)
    assert slopes(errors, steps) == pytest.approx(order, abs=0.1)
    assert errors[-1] < {1: 0.06, 2: 1e-3, 4: 1e-6}[order]


def test_impulses_of_four_vortices_are_conserved_to_rounding():
    result = codegen.solve(VORTICES, steps=2000)
    circulation = np.array([1, 1, -1, -1])
    x, y = result.q[:, ::2], result.q[:, 1::2]
    for impulse in (x @ circulation, y @ circulation, (x**2 + y**2) @ circulation):
        assert np.ptp(impulse) < 1e-11
    assert np.ptp(y[:, 0]) > 0.5  # they leapfrog


@pytest.mark.parametrize("scheme", ["midpoint", "stormer-verlet", "gauss-4"])
def test_energy_of_species_has_no_drift_over_a_million_steps(scheme):
    module = codegen.compile(lotka_volterra(), scheme=scheme).module
    solution = module.solve(1_000_000, duration=1e5, every=97)
    assert solution.status == "solved"
    change = solution.energy - solution.energy[0]
    first, last = change[:1000], change[-1000:]
    bound = {"midpoint": 6e-3, "stormer-verlet": 4e-2, "gauss-4": 8e-6}[scheme]
    assert 0.1 * bound < np.ptp(first) < bound
    assert np.ptp(last) == pytest.approx(np.ptp(first), rel=1e-2)
    assert np.mean(last) == pytest.approx(np.mean(first), abs=0.01 * np.ptp(first))


def test_energy_of_four_vortices_has_no_drift_over_a_million_steps():
    module = codegen.compile(VORTICES).module
    solution = module.solve(1_000_000, duration=4e4, every=97)
    change = solution.energy - solution.energy[0]
    first, last = change[:1000], change[-1000:]
    assert 1e-6 < np.ptp(first) < 1e-4 * abs(solution.energy[0])
    assert np.ptp(last) == pytest.approx(np.ptp(first), rel=1e-2)
    assert np.mean(last) == pytest.approx(np.mean(first), abs=0.01 * np.ptp(first))


def test_symplectic_euler_is_the_degenerate_variational_integrator():
    """One step by hand: Ld = theta(x_k, y) (x_k1 - x_k) - h H(x_k, y), of Ellison et al. (2018), section III."""
    h, x0, y0 = 0.1, 1.3, 0.7
    result = codegen.solve(species_at(x0, y0, h), scheme="symplectic-euler")
    x1 = result.q[1, 0]

    def stationary(values):
        """Return dLd/dy = 0 in the first step, and the discrete Euler-Lagrange equation of x at its left node."""
        x, y = values
        of_y = (x - x0) / (x0 * y) - h * (1 - 2 / y)
        of_x = -np.log(y) / x0**2 * (x - x0) - np.log(y) / x0 - h * (1 - 1 / x0) + np.log(y0) / x0
        return of_y, of_x

    x, y = fsolve(stationary, (x0, y0), xtol=1e-12)
    assert x1 == pytest.approx(x, abs=1e-13)
    # The momentum theta(x_k1, y_k1) at the right node is the derivative of Ld by x_k1.
    assert result.q[1, 1] == pytest.approx(np.exp(np.log(y) / x0 * x), abs=1e-12)


def species_at(x0: float, y0: float, h: float) -> Simulate:
    problem = lotka_volterra()
    return replace(problem, start=dict(zip(problem.start, (x0, y0), strict=True)), duration=h, steps=1)


def test_gauge_does_not_change_the_motion():
    first, second = (codegen.solve(lotka_volterra(gauge=g), steps=50) for g in (0, 3))
    assert first.method == second.method == "hamiltonian"
    assert second.q == pytest.approx(first.q, abs=1e-12)


@pytest.mark.parametrize(("scheme", "is_kept"), [("midpoint", True), ("gauss-4", True), ("rk4", False)])
def test_a_step_keeps_the_two_form(scheme, is_kept):
    """det(dz1/dz0) Omega(z1) = Omega(z0) with Omega = 1/(x y), by central differences."""
    solver = codegen.compile(species_at(1.3, 0.7, 0.4), scheme=scheme)
    module, z, distance = solver.module, np.array([1.3, 0.7]), 1e-4
    grid = module.make_grid(1)
    columns = [(module.step(grid, z + d) - module.step(grid, z - d)) / (2 * distance) for d in distance * np.eye(2)]
    area = np.linalg.det(np.column_stack(columns)) / np.prod(module.step(grid, z)) * np.prod(z)
    assert (abs(area - 1) < 1e-7) == is_kept
    assert abs(area - 1) < 1e-2


@pytest.mark.parametrize(
    ("form", "method", "scheme", "order"),
    [
        ("toroidal", "hamiltonian", "midpoint", 2),
        ("toroidal", "hamiltonian", "gauss-4", 4),
        ("cylindrical", "one-step", "midpoint", 2),
        ("cylindrical", "one-step", "gauss-4", 4),
    ],
)
def test_guiding_centre_has_the_order_of_its_scheme(form, method, scheme, order):
    steps = [200, 400, 800]
    errors = errors_of(guiding_centre(form), steps, scheme=scheme, method=method)
    assert slopes(errors, steps) == pytest.approx(order, abs=0.3)
    assert errors[-1] < {2: 2e-2, 4: 1e-4}[order]


def test_toroidal_momentum_of_the_guiding_centre_is_conserved_to_rounding():
    """The angle b is cyclic, and theta_b is its momentum."""
    problem = guiding_centre("toroidal")
    result = codegen.solve(problem, steps=2000)
    r, a, _, u = result.q.T
    R = 1 + r * np.cos(a)
    poloidal, toroidal = r / (2 * R), 1 / R - r * np.cos(a) / (2 * R**2)
    momentum = -(r**2) / 4 + u * R * toroidal / np.hypot(poloidal, toroidal)
    assert np.ptp(r) > 0.01
    assert np.ptp(momentum) < 1e-14
    assert result.summary["energy_drift"] < 1e-5 * result.energy[0]


def driven(**others) -> Simulate:
    (x, y), (dx, dy) = coordinates("x y")
    t = time()
    return Simulate(
        lagrangian=(2 + sin(t)) * x * dy + x**3 * dx / 5 + cos(t) * y * dy - x**2 - y**4 / 4 + x * y * sin(2 * t),
        **{"force": {x: -x / 4, y: sin(x)}, "duration": 3, "start": {x: 0.4, y: 1}, "steps": 50, **others},
    )


@pytest.mark.parametrize(
    ("scheme", "method", "order"),
    [
        ("midpoint", "hamiltonian", 2),
        ("stormer-verlet", "hamiltonian", 2),
        ("yoshida-4", "hamiltonian", 4),
        ("lobatto-4", "hamiltonian", 4),
        ("blanes-moan-4", "hamiltonian", 4),
        ("midpoint", "one-step", 2),
        ("radau-5", "one-step", 5),
    ],
)
def test_forces_and_time_have_the_order_of_the_scheme(scheme, method, order):
    steps = [32, 64, 128]
    errors = errors_of(driven(), steps, scheme=scheme, method=method)
    assert slopes(errors, steps)[-1] == pytest.approx(order, abs=0.3)
    assert errors[-1] < {2: 1e-3, 4: 1e-4, 5: 1e-7}[order]


def test_vortices_whose_circulation_depends_on_their_place():
    """The second problem of Kraus (2017), section 6.3, has two blocks of Omega that are not constant."""
    (a, b, c, d), (da, db, dc, dd) = coordinates("a b c d")
    first, second = 1 + (a**2 + b**2) / 5, 1 + (c**2 + d**2) / 5
    problem = Simulate(
        lagrangian=first * (a * db - b * da) / 2
        + second * (c * dd - d * dc) / 2
        + first * second * log((a - c) ** 2 + (b - d) ** 2) / 8,
        duration=20,
        start={a: 1, b: 0, c: -0.5, d: 0.2},
    )
    steps = [200, 400, 800]
    assert slopes(errors_of(problem, steps), steps) == pytest.approx(2, abs=0.1)
    assert codegen.solve(problem, steps=800).method == "hamiltonian"


def test_a_two_form_without_zero_block_is_kept_if_it_is_constant():
    """L = q.S v/2 - |q|^2/2 with an antisymmetric S: the motion is linear, q' = S^-1 q, and expm gives it."""
    q, v = coordinates("a b c d")
    matrix = np.array([[0, 2, 1, -1], [-2, 0, 3, 1], [-1, -3, 0, 5], [1, -1, -5, 0]])
    theta = [sum(int(s) * x for s, x in zip(row, q, strict=True)) / sympy.S(2) for row in matrix.T]
    problem = Simulate(
        lagrangian=sum(a * w for a, w in zip(theta, v, strict=True)) - sum(x**2 for x in q) / 2,
        duration=4,
        start=dict(zip(q, (1, 0, -1, 2), strict=True)),
    )
    result = codegen.solve(problem, scheme="gauss-6", steps=100)
    assert result.method == "one-step"
    assert result.q[-1] == pytest.approx(expm(4 * np.linalg.inv(matrix)) @ [1, 0, -1, 2], abs=1e-9)
    assert result.summary["energy_drift"] < 1e-13


@pytest.mark.parametrize(
    ("problem", "scheme", "method"),
    [
        (lotka_volterra(gauge=1), "midpoint", None),
        (lotka_volterra(), "gauss-4", "one-step"),
        (driven(), "yoshida-4", None),
        (driven(), "blanes-moan-4", None),
    ],
)
def test_every_check_passes(problem, scheme, method):
    findings = checks.run(codegen.problem.sources.source_of(problem), scheme=scheme, method=method)
    assert [f for f in findings if not f.passed] == []
    subjects = {(f.check, f.subject) for f in findings if f.applies}
    assert ("problem as written", "equations of motion") in subjects
    assert ("problem as written", "energy") in subjects
    assert (("symplecticity", scheme) in subjects) == (method is None)


def test_show_has_lagrangian_momenta_and_step():
    text = equations(VORTICES, {"vortices": "two"})
    for heading in ("Lagrangian, linear in the velocities", "Momenta of the canonical pairs", "Dynamics", "One step"):
        assert heading in text


TWO = coordinates("x y")


def linear(lagrangian, **others):
    (x, y), _ = TWO
    return Simulate(lagrangian=lagrangian, **{"duration": 1, "start": {x: 1, y: 0}, "steps": 20, **others})


def bad_problems():
    (x, y), (dx, dy) = TWO
    (z, w), (dz, _) = coordinates("z w")
    u, (k,) = control("u"), parameters(k=0)
    oscillator = y * dx - (x**2 + y**2) / 2
    q, v = coordinates(" ".join(f"q{i}" for i in range(10)))
    dense = sum((i + 2 * j) * q[i] * v[j] for i in range(10) for j in range(i)) - sum(a**2 for a in q)
    at_rest = {x: 1, y: 0, dx: 0, dy: 0}
    return [
        (linear(oscillator, start=at_rest), {}, BoundaryError, "start gives dx, but .* leave dx out"),
        (linear(oscillator, start={x: 1}), {}, BoundaryError, "start lacks y;"),
        (linear(oscillator - z**2, start={x: 1, y: 0, z: 0}), {}, DegenerateError, "in dz: .* 3 is no even number"),
        (
            linear(oscillator - z**2 + z * dz - w**2, start={x: 1, y: 0, z: 0, w: 0}), {},
            DegenerateError, "degenerate in dz dw: .* d theta is singular; give every coordinate a conjugate one",
        ),
        (linear(y * dx + x * dy - x * y), {}, DegenerateError, "degenerate in dx dy: .* singular"),
        (linear(k * y * dx - x**2), {}, DegenerateError, "degenerate in dx dy"),
        (
            linear(dx**2 / 2 + x * dy - y**2, start=at_rest), {},
            DegenerateError, "degenerate in dy; .* or let the Lagrangian be linear in all velocities",
        ),
        (linear(y * Abs(dx) - x**2, start=at_rest), {}, DegenerateError, "degenerate in dy"),
        (linear(-x * y, start=at_rest), {}, DegenerateError, "degenerate in dy"),
        (linear(oscillator, constraint=[x - y]), {}, ExpressionError, "constraint with a Lagrangian that is linear"),
        (linear(oscillator, force={x: -dx}), {}, ExpressionError, "force of x depends on dx, .* leave it out"),
        (linear(x**2 * dy / 2 - x, start={x: 0, y: 0}), {}, BoundaryError, "start does not determine dx, dy"),
        (linear(dense, start=dict.fromkeys(q, 1)), {}, SizeError, "couples 10 coordinates, from q0 to q9"),
        (linear(oscillator), {"method": "variational"}, ArgumentError, "needs a kinetic energy.*use hamiltonian or"),
        (linear(oscillator), {"scheme": "rectangle"}, SchemeError, "does not belong to the hamiltonian method"),
        (
            linear(sin(x + y) * dx + exp_of(x) * dy - x**2 - y**2), {"method": "hamiltonian"},
            ArgumentError, "'hamiltonian' needs canonical pairs, .* use one-step",
        ),
        (
            Control(lagrangian=oscillator, force={x: u}, cost=u**2, duration=1, start={x: 0, y: 0}), {},
            DegenerateError, "degenerate in dx? ?d?y?; it is linear in the velocities, .* dynamics={x: ...}",
        ),
    ]  # fmt: skip


def exp_of(x):
    return sympy.exp(sympy.sin(x)) * sympy.exp(TWO[0][1] ** 2) / 3


@pytest.mark.parametrize("case", range(17))
def test_bad_input_is_one_line_with_the_remedy(case):
    problem, options, error, text = bad_problems()[case]
    with pytest.raises(error, match=text) as caught:
        codegen.compile(problem, **options)
    assert isinstance(caught.value, CodegenError)
    assert "\n" not in str(caught.value)


def test_events_are_found_in_coordinates():
    """x = cos t and y = -sin t; x vanishes at pi/2."""
    (x, y), (dx, _) = TWO
    problem = linear(y * dx - (x**2 + y**2) / 2, duration=3, events={"crossing": x})
    result = codegen.solve(problem, scheme="gauss-8")
    assert result.t[-1] == pytest.approx(np.pi / 2, abs=1e-10)
    assert abs(result.q[-1, 1]) == pytest.approx(1, abs=1e-10)
    with pytest.raises(ExpressionError, match=r"event turn depends on dx, .* coordinates and time"):
        codegen.compile(linear(y * dx - (x**2 + y**2) / 2, events={"turn": dx}))


def test_a_motion_into_a_singular_two_form_is_not_called_solved():
    """Omega = x, and x = sqrt(1 - 2 t) reaches zero at t = 1/2."""
    (x, _), (_, dy) = TWO
    problem = linear(x**2 * dy / 2 - TWO[0][1] + x)
    for options in ({}, {"method": "one-step"}):
        result = codegen.solve(problem, **options)
        assert result.status != "solved"
        assert result.t[-1] <= 0.5
    early = codegen.solve(problem, steps=200, scheme="gauss-4")
    assert early.q[90, 0] == pytest.approx(np.sqrt(0.1), abs=1e-6)


def test_saved_results_and_sweeps_keep_motion_and_energy(tmp_path):
    result = codegen.solve(VORTICES, steps=200)
    run("solve", VORTICES, "--steps", 200, "--save", tmp_path / "vortices.npz")
    with np.load(tmp_path / "vortices.npz") as saved:
        assert saved["q"] == pytest.approx(result.q, abs=1e-13)
        assert saved["energy"] == pytest.approx(result.energy, abs=1e-13)
    data = codegen.sweep(VORTICES, {"G": [1.0, 2.0]}, steps=200)
    assert (data.status == "solved").all()
    stronger = codegen.solve(VORTICES, steps=200, parameters={"G": 2.0})
    for G, motion in ((1.0, result), (2.0, stronger)):
        assert data.q.sel(G=G).values == pytest.approx(motion.q, abs=1e-12)
    assert stronger.energy[0] == pytest.approx(4 * result.energy[0], rel=1e-14)
