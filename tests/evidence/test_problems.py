"""Mistakes in equations, controls and boundary conditions are found and named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from failed_checks import failures
from sympy import Symbol

from codegen.evidence import checks

PROBLEMS = Path(__file__).parents[2] / "problems"


DRIFTING = '''"""A cart that is pushed along r drifts along phi without force."""

from codegen import Control, control, coordinates


def problem() -> Control:
    (r, phi), (dr, dphi) = coordinates("r phi")
    u = control("u")
    return Control(
        lagrangian=(dr**2 + dphi**2) / 2 - r**2,
        force={r: u},
        cost=u**2,
        duration=1,
        start={r: 0, dr: 0, phi: 0, dphi: 1},
        end={r: 1, dr: 0, END},
    )
'''


@pytest.mark.parametrize("problem", ["linear_pendulum", "orbital_transfer"])
@pytest.mark.parametrize("method", ["variational", "hamiltonian"])
def test_sign_of_the_force(prepared, problem, method):
    context = prepared(problem, {}, method=method)
    opposite = replace(context.model, force=tuple(-f for f in context.model.force))
    (failure,) = failures("discrete equations", replace(context, model=opposite))
    assert "differs from the forced equation of motion" in failure.detail


def test_lost_minus_sign_of_the_discrete_momentum(prepared):
    # p_k = D1 Ld instead of -D1 Ld.
    context = prepared("linear_pendulum")
    multiplier = Symbol("lambda_q_k", real=True)
    program = replace(context.program, element=context.program.element.xreplace({multiplier: -multiplier}))
    found = failures("momentum matching", replace(context, program=program))
    assert [failure.subject for failure in found] == ["node equation of q", "discrete momenta of q"]


def test_momenta_at_the_ends(prepared):
    context = prepared("orbital_transfer")
    faster = replace(context.model.end, rates=tuple(2 * v + 1 for v in context.model.end.rates))
    (failure,) = failures("momentum matching", replace(context, model=replace(context.model, end=faster)))
    assert failure.subject == "momenta at the end"


@pytest.mark.parametrize("method", ["variational", "hamiltonian"])
def test_alternating_control_is_named(prepared, method):
    (failure,) = failures("null controls", prepared("linear_pendulum", {}, method=method, controls="nodal"))
    assert "alternating nodal control f" in failure.detail
    assert "undetermined" in failure.detail


def test_alternating_control_that_acts(prepared):
    failure, optimum = failures("null controls", prepared("orbital_transfer", {}, controls="nodal"))
    assert "alternating nodal control u" in failure.detail
    assert "acts on the motion" in failure.detail
    assert "a false optimum" in optimum.detail


def test_false_optimum_of_the_hovercraft(prepared):
    """Controls on nodes lead to 22.36, where the true optimum is 1034 (measured with three programs)."""
    *modes, optimum = failures("null controls", prepared("hovercraft", {}, controls="nodal"))
    assert [mode.subject for mode in modes] == ["nodal control f1", "nodal control f2"]
    assert all("acts on the motion" in mode.detail for mode in modes)
    assert optimum.subject == "optimum with nodal controls"
    assert "a false optimum" in optimum.detail
    assert "discrete cost 22.3601," in optimum.detail


def test_nodal_controls_are_harmless_with_the_trapezoidal_rule(prepared):
    context = prepared("linear_pendulum", {}, scheme="trapezoidal", controls="nodal")
    assert failures("null controls", context) == []


CONSTANT = '''"""A boat of constant speed: the integral of its squared speed is the same whatever the rudder does."""

from sympy import cos, sin

from codegen import Control, control, states


def problem() -> Control:
    x, y = states("x y")
    theta = control("theta")
    cost = (2 * cos(theta)) ** 2 + (2 * sin(theta)) ** 2
    dynamics = {x: 2 * cos(theta), y: 2 * sin(theta)}
    return Control(dynamics=dynamics, cost=cost, duration=1, start={x: 0, y: 0}, end={x: 1, y: 1}, steps=10)
'''


def test_a_cost_that_is_constant_has_no_null_controls_of_the_scheme(prepared, tmp_path: Path):
    path = tmp_path / "boat.py"
    path.write_text(CONSTANT, encoding="utf-8")
    assert failures("null controls", prepared(path, {})) == []


@pytest.mark.parametrize("method", ["variational", "hamiltonian"])
def test_redundant_boundary_condition(prepared, tmp_path: Path, method):
    path = tmp_path / "drifting.py"
    path.write_text(DRIFTING.replace("END", "phi: 1, dphi: 1"), encoding="utf-8")
    # The drift decides both the last place and the last velocity.
    first, second = failures("boundary rank", prepared(path, {}, method=method))
    for failure in (first, second):
        assert "redundant or unreachable" in failure.detail
        assert "phi" in failure.detail
        assert " dr" not in failure.detail.partition("(")[0]
    assert "end dphi" in first.detail + second.detail


def test_end_that_is_left_free(prepared, tmp_path: Path):
    path = tmp_path / "drifting.py"
    path.write_text(DRIFTING.replace(", END", ""), encoding="utf-8")
    assert failures("boundary rank", prepared(path)) == []


def test_convergence_at_a_wrong_order(prepared, monkeypatch):
    context = prepared("linear_pendulum", {}, method="hamiltonian", scheme="explicit-euler")
    monkeypatch.setattr("codegen.evidence.checks.solution.order_of_optima", lambda module: 2)
    (failure,) = failures("optimum", context)
    assert "order 1.00, 2 is expected" in failure.detail


def test_controls_limit_the_order(prepared):
    """More than order 2 is not asked of controls that are constant on each interval."""
    (finding,) = checks.apply("optimum", prepared("linear_pendulum", {}, scheme="gauss-4"))
    assert finding.passed
    assert "2 is expected" in finding.detail


def test_convergence_to_the_published_optimum(prepared):
    # The closed form of a linear oscillator that is steered with the least effort.
    (finding,) = checks.apply("optimum", prepared("linear_pendulum"))
    assert "J* = 4.53076098108 " in finding.detail


# ---- Conditions between bodies ----

ROW = '''"""Points on a line, pushed to places that depend on each other."""
from codegen import Control, body_number, control, coordinate
def problem() -> Control:
    x, v = coordinate("x")
    f, i = control("f"), body_number()
    return Control(lagrangian=v**2 / 2, force={x: f}, cost=f**2, duration=1, bodies=3, start={x: 0, v: 0},
                   end_conditions=[CONDITIONS], guess={x: GUESS}, steps=8)
'''


def row(folder: Path, *conditions: str, guess: str = "i") -> Path:
    path = folder / "row.py"
    path.write_text(ROW.replace("CONDITIONS", ", ".join(conditions)).replace("GUESS", guess))
    return path


def couplings(context):
    return [f for f in checks.apply("boundary rank", context) if f.subject != "all equations"]


def test_redundant_coupling_is_named_and_left_out(prepared, tmp_path: Path):
    context = prepared(row(tmp_path, "x.of(1) - x.of(0) - 1", "x.of(2) - x.of(1) - 1", "x.of(2) - x.of(0) - 2"))
    summary, redundant = couplings(context)
    assert summary.detail == "2 of 3 are independent"
    assert redundant.subject == "-x_0 + x_2 - 2 = 0"
    assert "redundant, and left out" in redundant.detail
    assert "-x_0 + x_1 - 1 = 0; -x_1 + x_2 - 1 = 0" in redundant.detail
    assert summary.passed
    assert redundant.passed
    assert failures("boundary rank", context) == []
    assert failures("derivatives", context) == []


def test_coupling_that_only_seems_redundant(prepared, tmp_path: Path):
    """Of the two distances that the first condition allows, the second wants one and the guess leads to the other."""
    context = prepared(row(tmp_path, "(x.of(1) - x.of(0))**2 - 1", "x.of(1) - x.of(0) + 1", guess="i"))
    (failure,) = failures("boundary rank", context)
    assert failure.subject == "-x_0 + x_1 + 1 = 0"
    assert "the solution violates it by 2" in failure.detail


def test_contradicting_couplings(prepared, tmp_path: Path):
    context = prepared(row(tmp_path, "x.of(1) - x.of(0) - 1", "x.of(1) - x.of(0) - 2"))
    dependent, failure = failures("boundary rank", context)
    assert "no boundary condition" in dependent.detail
    assert "they contradict each other" in failure.detail
    assert "x_1 - " in failure.detail


# ---- First-order systems and free durations ----


def test_sign_in_a_first_order_system(prepared):
    context = prepared("van_der_pol")
    opposite = replace(context.model, dynamics=(-context.model.dynamics[0], context.model.dynamics[1]))
    (failure,) = failures("discrete equations", replace(context, model=opposite))
    assert failure.subject == "step of x1"


def test_checks_that_do_not_apply_say_why(prepared):
    reasons = {
        "optimum": "this one has a first-order system, bounds",
        "momentum matching": "the one-step method has no discrete Lagrangian",
        "symplecticity": "a first-order system has no symplectic form",
        "discrete Noether": "a first-order system has no momenta",
    }
    for name, reason in reasons.items():
        (finding,) = checks.apply(name, prepared("van_der_pol"))
        assert finding.passed
        assert not finding.applies
        assert reason in finding.detail


OUTSIDE = '''"""A root that no number has at the guess."""
from sympy import sqrt
from codegen import Control, control, states
def problem() -> Control:
    x, v = states("x v")
    u = control("u")
    return Control(dynamics={x: v, v: u}, cost=u**2, duration=1, start={x: 0, v: 0}, end={x: 1},
                   path=[sqrt(x - 0.5) + u <= 5], steps=6)
'''


def test_rows_that_need_a_finite_guess_are_not_measured_where_there_is_none(prepared, tmp_path: Path):
    path = tmp_path / "outside.py"
    path.write_text(OUTSIDE)
    context = prepared(path)
    found = {name: checks.apply(name, context) for name in ("assembly", "boundary rank", "derivatives")}
    for name in ("assembly", "boundary rank"):
        (finding,) = found[name]
        assert finding.passed
        assert not finding.applies
        assert finding.detail.startswith("not measured: ")
    assert all(finding.passed and finding.applies for finding in found["derivatives"])


def test_default_scheme_by_its_name(interpreting):
    """The default is recorded without a name, and named or not it is the same module."""
    path = PROBLEMS / "double_integrator_effort.py"
    found = checks.run(path, scheme="midpoint")
    assert all(finding.passed for finding in found if finding.check == "provenance")


FLAT = '''"""A reaction that runs at 350 K only, a long way from numbers about 1."""
from sympy import exp
from codegen import Control, control, parameters, states
def problem() -> Control:
    T, c = states("T c")
    u = control("u")
    k, E = parameters(k=7.2e10, E=8750)
    return Control(dynamics={T: u + c * k * exp(-E / T) / 100, c: -c * k * exp(-E / T)}, cost=u**2, duration=1,
                   start={T: 350, c: 1}, end={T: 355}, steps=20)
'''


def test_what_is_flat_at_most_points_is_neither_needless_nor_overlooked(prepared, damaged, tmp_path: Path):
    path = tmp_path / "reaction.py"
    path.write_text(FLAT)
    context = prepared(path)
    assert not failures("sparsity", context)
    assert not failures("derivatives", context)
    text = Path(context.module.__file__).read_text(encoding="utf-8")
    first = next(line for line in text.splitlines() if "d2l/dT_k dT_k" in line)
    broken = damaged(context, first, first.split("=")[0] + "= 0.0")
    assert failures("derivatives", broken)


@pytest.mark.parametrize(
    "function", ["lagrangian=dq**2 / 2 - 9.81 * q", "hamiltonian=p + q**2 / 2", "hamiltonian=p**2 / 2 + 9.81 * q"]
)
def test_area_is_preserved_by_accident_where_half_of_the_energy_is_linear(prepared, tmp_path, function):
    """The Jacobian of a step is then triangular with ones on its diagonal, whatever the scheme."""
    symbols, rate = ("canonical_pair('q', 'p')", "p") if "hamiltonian" in function else ("coordinate('q')", "dq")
    path = tmp_path / "linear.py"
    path.write_text(
        '"""Linear."""\nfrom codegen import Simulate, canonical_pair, coordinate\n\ndef problem() -> Simulate:\n'
        f"    q, {rate} = {symbols}\n    return Simulate({function}, start={{q: 0, {rate}: 1}}, duration=2, steps=50)\n"
    )
    context = prepared(path)
    found = checks.apply("area preservation", context)
    assert sum(finding.applies for finding in found) > 5
    assert not [*failures("area preservation", context), *failures("midpoint equivalence", context)]


def test_area_is_preserved_by_accident_where_the_hessian_of_the_hamiltonian_is_singular(prepared, tmp_path):
    """A rope is wound up: H = p^2/(2 (2 + q)) + 9.81 q has H_qq H_pp = H_qp^2, so that det = 1 for explicit Euler."""
    path = tmp_path / "rope.py"
    path.write_text(
        '"""Rope."""\nfrom codegen import Simulate, coordinate\n\ndef problem() -> Simulate:\n'
        "    q, v = coordinate('q')\n    function = (2 + q) * v**2 / 2 - 9.81 * q\n"
        "    return Simulate(lagrangian=function, start={q: 1, v: 1}, duration=0.1, steps=50)\n"
    )
    context = prepared(path)
    (euler,) = [f for f in checks.apply("area preservation", context) if f.subject == "explicit-euler (hamiltonian)"]
    assert "det = 1, and the scheme is not symplectic" in euler.detail
    assert not failures("area preservation", context)


HAMILTONIAN = '''"""A mass whose momentum is given at both ends."""

from codegen import Control, canonical_pair, control


def problem() -> Control:
    q, p = canonical_pair("q", "p")
    u = control("u")
    return Control(
        hamiltonian=p**2 / 4 + q**2, force={q: u}, cost=u**2, duration=1, start={q: 0, p: 1}, end={q: 1, p: 0}, steps=8
    )
'''


@pytest.mark.parametrize("method", ["variational", "hamiltonian"])
def test_momenta_that_are_given_are_velocities_on_the_other_side(prepared, tmp_path, method):
    path = tmp_path / "mass.py"
    path.write_text(HAMILTONIAN, encoding="utf-8")
    findings = checks.apply("given values", prepared(path, {}, method=method))
    assert all(finding.passed for finding in findings), findings
    wanted = "start q, start dq, end q, end dq" if method == "variational" else "start q, start p, end q, end p"
    assert wanted in findings[0].detail
