"""Systems of many coordinates: what is derived of them is right, and is not written out where that would take hours."""

import types
from pathlib import Path

import numpy as np
import pytest
import sympy
from interpreted import Interpreted, of_problem
from numpy.testing import assert_allclose

from codegen.discretise import schemes
from codegen.discretise.elimination import linear_in
from codegen.discretise.interval import STEP
from codegen.discretise.model.definitions import Model
from codegen.discretise.model.from_problem import load_problem
from codegen.discretise.model.legendre import conjugate_symbols, hamiltonian_form, in_phase_space
from codegen.discretise.simulation import phase_functions
from codegen.discretise.transcribe import transcribe
from codegen.emit.differentiation import step_derivatives
from codegen.emit.naming import Choices
from codegen.errors import SizeError
from codegen.evidence import checks
from codegen.evidence.checks.base import Context
from codegen.symbolic import derivatives as differentiate
from codegen.symbolic.derivatives import hessian_samples

FOLDER = Path(__file__).parents[1] / "large_systems"


def model_of(name: str, **arguments: object) -> Model:
    model = load_problem(FOLDER / f"{name}.py", {key: str(value) for key, value in arguments.items()})
    assert isinstance(model, Model)
    return model


def numbers_of(model: Model, seed: int = 0) -> dict[sympy.Symbol, float]:
    symbols = (*model.coordinates, *model.rates, *conjugate_symbols(model))
    drawn = np.random.default_rng(seed).uniform(-1, 1, len(symbols))
    return dict(zip(symbols, drawn, strict=True)) | model.default_values


def test_velocities_and_energy_of_an_arm_are_those_of_its_mass_matrix() -> None:
    model = model_of("arm", links=6, task="simulate")
    found = phase_functions(model)
    assert found is not None
    values = numbers_of(model)
    for symbol, value in found.assignments:
        values[symbol] = float(value.xreplace(values))
    lagrangian = sympy.lambdify([*model.coordinates, *model.rates, *model.parameters], model.function, cse=True)
    q, p = ([values[s] for s in symbols] for symbols in (model.coordinates, conjugate_symbols(model)))

    def at(v: np.ndarray) -> float:
        return float(lagrangian(*q, *v, *model.defaults))

    # L = v.Mv/2 - V, so that M follows from values of L alone.
    unit = np.eye(6)
    single = [at(e) - at(0 * e) for e in unit]
    mass = np.array([[at(a + b) - at(0 * a) - x - y for b, y in zip(unit, single)] for a, x in zip(unit, single)])
    velocities = np.linalg.solve(mass, p)
    assert_allclose([float(v.xreplace(values)) for v in found.velocities], velocities, rtol=1e-10)
    assert_allclose(float(found.energy.xreplace(values)), np.dot(p, velocities) - at(velocities), rtol=1e-10)


def test_layout_and_kernels_are_checked_where_the_energy_reads_assignments(tmp_path: Path) -> None:
    arguments = {"links": "5", "task": "simulate"}
    model = model_of("arm", **arguments)
    program = transcribe(model, None, None, "interval")
    assert program.state_assignments
    module = Interpreted(tmp_path, FOLDER)("arm", arguments=arguments)
    context = Context(Choices(), model, program, schemes.find(program.scheme, program.method), module)
    findings = [finding for name in ("layout", "derivatives") for finding in checks.apply(name, context)]
    assert not [f for f in findings if not f.passed]
    assert any(finding.subject == "energy" for finding in findings), findings


def test_small_and_decoupled_systems_have_their_hamiltonian_written_out() -> None:
    assert phase_functions(model_of("arm", links=3, task="simulate")) is None
    assert phase_functions(model_of("chain")) is None


def test_phase_space_without_hamiltonian_has_the_same_ends() -> None:
    model = model_of("arm", links=3, task="simulate")
    whole, without = hamiltonian_form(model), in_phase_space(model)
    assert without.rates == whole.rates
    assert without.start == whole.start


def test_an_inverse_that_would_be_too_long_is_refused() -> None:
    with pytest.raises(SizeError, match=r"couples 6 coordinates.*--method variational"):
        hamiltonian_form(model_of("arm", task="simulate"))


def test_sums_to_high_powers_are_not_multiplied_out() -> None:
    x = sympy.symbols("x0:12", real=True)
    distance = sum(a**2 for a in x) + STEP * x[0] * x[1]
    long = x[0] * distance ** sympy.Rational(-7, 2) + x[1] * distance**9
    assert linear_in(long, x[0], set(x)) is None
    assert linear_in(long + 3 * STEP * x[0], x[0], set(x)) is None


def test_linearity_is_read_off_long_expressions_and_found_in_short_ones() -> None:
    x, y, a, b = sympy.symbols("x y a b", real=True)
    long = sum(sympy.sin(i * y) ** i for i in range(1, 99))
    assert linear_in(long + 2 * STEP * (a * x + y), x, {x, y}) == 2 * STEP * a
    assert linear_in((x + a) ** 2 - x**2 + b, x, {x, y}) == 2 * a
    assert linear_in(x * (y + a) - x * y, x, {x, y}) == a
    assert linear_in(x * y, x, {x, y}) is None
    assert linear_in(x * y, x, {x}) == y


def test_jacobian_of_a_long_step_is_that_of_its_residual() -> None:
    program = transcribe(model_of("arm", links=4, task="simulate"), None, None, "interval")
    found = step_derivatives(program)
    assert found.assignments
    symbols = set().union(*(r.free_symbols for r in program.residual))
    drawn = np.random.default_rng(1).uniform(0.5, 1.5, len(symbols))
    point = dict(zip(sorted(symbols, key=str), drawn, strict=True))
    values = dict(point)
    for symbol, value in found.assignments:
        values[symbol] = float(value.xreplace(values))
    residual = sympy.lambdify([*point], list(program.residual), "mpmath", cse=True)
    assert_allclose([float(r.xreplace(values)) for r in found.residual], [*map(float, residual(*point.values()))])
    for j, y in enumerate(program.unknowns):
        step = 1e-6
        ahead, behind = (residual(*(point | {y: point[y] + s}).values()) for s in (step, -step))
        differences = [float(a - b) / (2 * step) for a, b in zip(ahead, behind, strict=True)]
        assert_allclose([float(row[j].xreplace(values)) for row in found.jacobian], differences, rtol=1e-6, atol=1e-7)


def test_a_jacobian_leaves_out_what_vanishes_and_keeps_what_is_small() -> None:
    x, y, a = sympy.symbols("x y a", real=True)
    values = (sympy.sin(x) ** 2 + sympy.cos(x) ** 2 + a * y, sympy.exp(-(a**2) - 900) * x)
    program, indices = differentiate.jacobian(values, (x, y), (a,))
    assert indices == ((0, 1), (1, 0))
    assert program.values[2] == a
    assert sympy.simplify(program.values[3] - sympy.exp(-(a**2) - 900)) == 0


def test_samples_of_second_derivatives() -> None:
    x, y, a = sympy.symbols("x y a", real=True)
    function = sympy.exp(a * x) * y**2 / 2 + abs(x) * y
    (first, outside) = hessian_samples(
        function / sympy.sqrt(a), (x, y), [{x: 0.5, y: 2.0, a: 4.0}, {x: 1, y: 1, a: -1}]
    )
    e = np.exp(2.0)
    assert_allclose(first, np.array([[16 * 2 * e, 4 * 2 * e + 1], [4 * 2 * e + 1, e]]) / 2, rtol=1e-14)
    assert outside is None


def test_three_bodies_return_on_the_figure_eight() -> None:
    """The period 6.32591398 is Simo's; the midpoint rule misses the start by what its order promises."""
    problem = load_text("bodies").problem()
    module = of_problem(problem)
    errors = []
    for steps in (400, 800):
        solution = module.solve(steps)
        assert solution.status == "solved"
        errors.append(np.abs(solution.q[-1] - solution.q[0]).max())
    assert errors[1] < 2e-3
    assert_allclose(errors[0] / errors[1], 4.0, rtol=0.1)


def test_five_bodies_turn_on_a_polygon() -> None:
    module = of_problem(load_text("bodies").problem(bodies=5))
    rate = np.sqrt(sum(1 / np.sin(np.pi * k / 5) for k in range(1, 5)) / 4)
    solution = module.solve(600)
    angles = rate * solution.t[:100, None] + 2 * np.pi * np.arange(5) / 5
    expected = np.stack([np.cos(angles), np.sin(angles)], axis=-1).reshape(100, 10)
    assert_allclose(solution.q[:100], expected, atol=2e-4)


def load_text(name: str) -> types.ModuleType:
    """The problem file as a module."""
    module = types.ModuleType(name)
    exec((FOLDER / f"{name}.py").read_text(), module.__dict__)
    return module
