"""Conditions on integrals: closed forms in every form, inequalities, bodies, phases, refusals, a planted defect."""

from __future__ import annotations

from dataclasses import replace

import pytest
import sympy
from interpreted import text_of, without_compilation
from written_objects import unit_mass

from codegen import Control, Phases, body_number, control, coordinate, states, together
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.schemes import find
from codegen.discretise.transcribe import transcribe
from codegen.emit.naming import Choices
from codegen.errors import ExpressionError
from codegen.evidence.checks import CHECKS, apply
from codegen.evidence.checks.base import Context

AREA = 0.1
EFFORT = 720.0 * AREA**2
"""The least integral of x''^2 from rest at 0 to rest at 0 in unit time with the area a: x = 30 a t^2 (1 - t)^2."""


def with_area(form: str = "lagrangian", relation=sympy.Eq, limit: float = AREA, **others) -> Control:
    """A unit mass that rests at 0 at both ends and encloses an area with the axis of time."""
    x, v, u, motion = unit_mass(form)
    rest = {x: 0, v: 0}
    conditions = {"integral": {"area": relation(x, limit)}} if relation is not None else {}
    return Control(**{**motion, "cost": u**2, "duration": 1, "start": rest, "end": rest, **conditions, **others})


def solved(problem: Control | Phases, steps: int, **choices: str):
    module = without_compilation(text_of(problem, **choices))
    solution = module.solve(steps)
    assert solution.status == "solved", solution.message
    return module, solution


def multipliers(module, solution) -> list[float]:
    first = solution.unknowns.size - module.problem.structure.root
    return [float(solution.unknowns[first + index]) for _, index in module.metadata.integrals]


@pytest.mark.parametrize("form", ["lagrangian", "hamiltonian", "dynamics"])
@pytest.mark.parametrize("scheme", ["midpoint", "trapezoidal"])
def test_least_effort_with_an_area_in_every_form(form, scheme):
    """Cost and multiplier converge with order 2; the multiplier is minus the slope of the cost by the area."""
    if (form, scheme) == ("hamiltonian", "trapezoidal"):
        scheme = "stormer-verlet"
    errors = []
    for steps in (16, 32):
        module, solution = solved(with_area(form), steps, scheme=scheme)
        (multiplier,) = multipliers(module, solution)
        errors.append((abs(solution.cost / EFFORT - 1.0), abs(multiplier / (2.0 * EFFORT / AREA) + 1.0)))
    for coarse, fine in zip(*errors, strict=True):
        assert fine < 0.012
        assert coarse / fine == pytest.approx(4.0, rel=0.2)


def test_the_multiplier_is_the_slope_of_the_discrete_cost():
    costs = [solved(with_area(limit=AREA + d), 10)[1].cost for d in (-1e-3, 1e-3)]
    (multiplier,) = multipliers(*solved(with_area(), 10))
    assert multiplier == pytest.approx((costs[0] - costs[1]) / 2e-3, rel=1e-8)  # the cost is quadratic in the area


@pytest.mark.parametrize(("relation", "limit"), [(sympy.Ge, AREA), (sympy.Le, -AREA)])
def test_an_inequality_that_is_active_is_an_equation(relation, limit):
    cost = solved(with_area(), 12)[1].cost
    module, solution = solved(with_area(relation=relation, limit=limit), 12)
    assert solution.cost == pytest.approx(cost, rel=1e-7)
    assert abs(multipliers(module, solution)[0]) == pytest.approx(2.0 * cost / AREA, rel=1e-5)


def test_an_inequality_that_is_not_active_changes_nothing():
    """All else vanishes: the value, which only the end's own share has, tells how large the terms are."""
    module, solution = solved(with_area(relation=sympy.Le, limit=AREA), 12)
    assert abs(solution.cost) < 1e-7
    assert abs(multipliers(module, solution)[0]) < 1e-6


def test_the_value_may_stand_on_either_side():
    x, v = states("x v")
    u = control("u")
    given = {"dynamics": {x: v, v: u}, "cost": u**2, "duration": 1, "start": {x: 0, v: 0}, "end": {x: 1, v: 0}}
    costs = {
        solved(Control(**given, integral=[relation]), 8)[1].cost
        for relation in (sympy.Ge(x, 0.6, evaluate=False), sympy.Le(0.6, x, evaluate=False), -x <= -0.6)
    }
    assert max(costs) == pytest.approx(min(costs), rel=1e-9)
    assert min(costs) > solved(Control(**given), 8)[1].cost * 1.1


def test_each_body_has_its_own():
    problem = with_area(bodies=3, start={}, end={})
    (x,) = problem.force
    number = body_number()
    at_rest = {x: number, x.partner: 0}
    problem = replace(problem, start=at_rest, end=at_rest, integral=[sympy.Eq(x, AREA)])
    module, solution = solved(problem, 10)
    assert [name for name, _ in module.metadata.integrals] == [f"x = 0.1 of body {i}" for i in range(3)]
    found = multipliers(module, solution)
    # Around x = i the area that is left to enclose is a - i, and the discrete cost is quadratic in it.
    single = multipliers(*solved(with_area(), 10))[0] / AREA
    assert found == pytest.approx([single * (AREA - i) for i in range(3)], rel=1e-9)


def test_different_bodies_keep_theirs():
    problem = together(with_area(), _elsewhere())
    cost = solved(problem, 10)[1].cost
    assert cost == pytest.approx(2.0 * solved(with_area(), 10)[1].cost, rel=1e-9)


def _elsewhere() -> Control:
    y, w = coordinate("y")
    f = control("f")
    rest = {y: 0, w: 0}
    return Control(
        lagrangian=w**2 / 2, force={y: f}, cost=f**2, duration=1, start=rest, end=rest, integral=[sympy.Eq(y, -AREA)]
    )


def test_each_phase_has_its_own():
    """With x' = u a phase of length h from x to y with the area a takes (y-x)^2/h + 12 (a-(x+y)h/2)^2/h^3."""
    x = states("x")[0]
    u = control("u")

    def phase(**others) -> Control:
        return Control(dynamics={x: u}, cost=u**2, duration=0.5, steps=40, **others)

    first = phase(start={x: 0}, integral=[sympy.Eq(x, 0.3)])
    second = phase(end={x: 0}, integral={"rest of the area": sympy.Eq(x, -0.1)})
    module, solution = solved(Phases(first, second), 40)
    m = sympy.Symbol("m")
    parts = [m**2 / 0.5 + 12 * (a - m * 0.25) ** 2 / 0.125 for a in (0.3, -0.1)]
    switch = sympy.solve(sympy.diff(sum(parts), m), m)[0]
    assert solution.cost == pytest.approx(float(sum(parts).subs(m, switch)), rel=2e-3)
    assert [name for name, _ in module.metadata.integrals] == ["x = 0.3 in phase 1", "rest of the area in phase 2"]
    wanted = [-24 * (a - switch * 0.25) / 0.125 for a in (0.3, -0.1)]
    assert multipliers(module, solution) == pytest.approx([float(w) for w in wanted], rel=2e-3)


@pytest.mark.parametrize(
    ("written", "finding"),
    [
        (lambda x, v, u: [sympy.Eq(x, u)], "both sides of integral"),
        (lambda x, v, u: [u**2], r"u\*\*2 = 0 has an integrand of one sign"),
        (lambda x, v, u: [u**2 + v**4 <= 0], "has an integrand of one sign"),
        (lambda x, v, u: [sympy.Eq(sympy.Symbol("z", real=True), 1)], "no integrand"),
        (lambda x, v, u: [sympy.Eq(x, sympy.oo)], "integral"),
        (lambda x, v, u: [sympy.Eq(x * body_number(), 1)], "depends on body"),
        (lambda x, v, u: sympy.Eq(x, 1), "integral is a single relation"),
        (lambda x, v, u: [sympy.Eq(x, 1), sympy.Eq(x, 1)], "twice"),
        (lambda x, v, u: [sympy.Le(sympy.acos(2 + v**2), 1, evaluate=False)], "no finite real value"),
        (lambda x, v, u: {"": sympy.Eq(x, 1)}, "has the name ''"),
        (lambda x, v, u: {"a": u <= 1, "a ": u <= 2}, "two relations of the name 'a'"),
    ],
)
def test_refusals(written, finding):
    problem = with_area()
    (x,) = problem.force
    (u,) = problem.force.values()
    with pytest.raises(Exception, match=finding) as raised:
        normalise(replace(problem, integral=written(x, x.partner, u)))
    assert "codegen" in type(raised.value).__module__


def test_a_wrong_quadrature_is_found():
    model = normalise(with_area())
    program, scheme = transcribe(model), find("midpoint", "variational")
    context = Context(Choices(), model, program, scheme, None)
    (finding,) = CHECKS["integrals"].findings(context)
    assert finding.passed
    *others, quadrature = program.equations
    wrong = replace(program, equations=(*others, replace(quadrature, value=2 * quadrature.value)))
    (finding,) = CHECKS["integrals"].findings(replace(context, program=wrong))
    assert not finding.passed
    with pytest.raises(ExpressionError):
        normalise(replace(with_area(), integral=[True]))


@pytest.mark.parametrize("method", ["variational", "hamiltonian"])
def test_integrals_of_velocities_are_checked_in_phases(method):
    """Each phase is as its author wrote it, the equations are in velocities or momenta."""
    x, v = coordinate("x")
    u = control("u")
    motion = {"lagrangian": v**2, "force": {x: u}, "cost": u**2, "duration": 1}
    first = Control(**motion, start={x: 0, v: 0}, integral=[u**2 + v**2 <= 9])
    model = normalise(Phases(first, Control(**motion, end={x: 1, v: 0}, integral=[u * v <= 9])))
    program, scheme = transcribe(model, method=method), find("midpoint", method)
    findings = list(apply("integrals", Context(Choices(), model, program, scheme, None)))
    assert [finding.passed for finding in findings] == [True, True]


@pytest.mark.parametrize("scheme", ["position-verlet", "yoshida-4", "suzuki-4"])
def test_a_stage_that_only_the_integrand_reads_stays(scheme):
    """A free mass evaluates no force at the middle of a step, where the integrand of the area is."""
    errors = [
        solved(with_area("hamiltonian"), steps, method="hamiltonian", scheme=scheme)[1].cost / EFFORT - 1.0
        for steps in (8, 16)
    ]
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.2)


def test_shared_integrals_of_different_bodies():
    """Two masses of which one may take all effort share it by convexity: each takes half of the area."""
    one, other = with_area(relation=None), _elsewhere()
    (x,), (y,) = one.force, other.force
    problem = together(one, replace(other, integral=()), integral={"both": sympy.Eq(x - y, 2.0 * AREA)})
    assert solved(problem, 10)[1].cost == pytest.approx(2.0 * solved(with_area(), 10)[1].cost, rel=1e-9)
