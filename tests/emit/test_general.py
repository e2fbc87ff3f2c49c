"""The general form of a module leaves nothing out, and has the same answer; uncompiled."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from interpreted import of_problem

from codegen import Control, Simulate, canonical_pair, control, coordinate
from codegen.emit.naming import Choices, module_name
from codegen.errors import ArgumentError
from codegen.solving.compiler import build, generate

PROBLEMS = Path(__file__).parents[2] / "problems"


def swing() -> Simulate:
    """A unit mass on a spring of unit stiffness: q = cos t, p = -sin t."""
    q, p = canonical_pair("q", "p")
    return Simulate(hamiltonian=p**2 / 2 + q**2 / 2, duration=2, start={q: 1, p: 0}, steps=20)


def effort(bound: float | None = None) -> Control:
    """One unit of length in one unit of time with least effort; 12 N^2/(N^2 - 1) is the discrete cost."""
    x, v = coordinate("x")
    u = control("u")
    return Control(
        lagrangian=v**2 / 2, force={x: u}, cost=u**2, duration=1, start={x: 0, v: 0}, end={x: 1, v: 0}, steps=20,
        bounds={} if bound is None else {u: (-bound, bound)},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("scheme", "method"),
    [
        ("explicit-euler", "hamiltonian"),
        ("stormer-verlet", "variational"),
        ("midpoint", "hamiltonian"),  # implicit, and explicit here, since the force is linear
        ("yoshida-4", "hamiltonian"),
        ("gauss-4", "variational"),
    ],
)
def test_a_step_that_needs_no_iteration_is_the_same_by_newtons_method(scheme, method):
    own, general = (of_problem(swing(), scheme=scheme, method=method, general=g) for g in (False, True))
    assert (own.metadata.solver, general.metadata.solver) == ("explicit", "newton")
    assert len(general.metadata.unknowns) == len(general.metadata.stages) + 2
    assert len(general.metadata.left_out) < len(own.metadata.left_out)
    one, other = own.solve(20), general.solve(20)
    assert other.status == "solved"
    assert one.iterations == 0
    assert other.iterations >= 20
    np.testing.assert_allclose(other.q, one.q, atol=1e-13)
    np.testing.assert_allclose(other.p, one.p, atol=1e-13)
    h = 0.1
    if scheme == "explicit-euler":  # |z| grows by sqrt(1 + h^2) in every step
        assert np.hypot(other.q[-1, 0], other.p[-1, 0]) == pytest.approx((1.0 + h**2) ** 10, rel=1e-13)


def test_an_optimum_is_the_same_by_an_interior_point_method_with_everything_in_place():
    own, general = (of_problem(effort(), general=g) for g in (False, True))
    exact = 12.0 * 20**2 / (20**2 - 1)
    for module in (own, general):
        solution = module.solve(20)
        assert solution.status == "solved"
        assert solution.cost == pytest.approx(exact, rel=1e-9)
    assert [(m.metadata.inequalities, m.metadata.shared) for m in (own, general)] == [
        (False, ()),
        (True, ("idle",)),
    ]
    size = general.ELEMENT + 1
    assert len(general.HESSIAN_ROWS) == size * (size + 1) // 2 > len(own.HESSIAN_ROWS)
    assert (own.CONDENSED, general.CONDENSED) == (1, 0)
    assert own.solve(20).iterations == 1
    assert general.solve(20).unknowns[-1] == pytest.approx(0.0, abs=1e-9)  # the parameter that nothing reads


def test_bounds_that_matter_hold_in_the_general_form():
    """|u| <= 5 binds: without it u = 6 at the ends of a fine grid."""
    own, general = (of_problem(effort(5.0), general=g).solve(10) for g in (False, True))
    assert own.status == general.status == "solved"
    assert general.cost == pytest.approx(own.cost, rel=1e-7)
    assert np.abs(general.u).max() <= 5.0 + 1e-9


def test_the_general_form_is_another_module(tmp_path, monkeypatch):
    """It has a name and a place in the cache of its own; its header says what it is."""
    monkeypatch.setenv("CODEGEN_CACHE_DIR", str(tmp_path))
    path = PROBLEMS / "pendulum.py"
    made = [build(path, {}, general=general, out=tmp_path) for general in (False, True, False)]
    assert [m.name for m in made] == ["pendulum", "pendulum_general_form", "pendulum"]
    assert [m.cached for m in made] == [False, False, True]
    assert "(in the general form, for measurements)" in made[1].path.read_text()
    assert "general form" not in made[0].path.read_text()
    assert module_name(path, {}, Choices(general=True)) == "pendulum_general_form"


def test_particles_have_no_general_form():
    with pytest.raises(ArgumentError, match="no general form"):
        generate(PROBLEMS / "lennard_jones.py", {}, Choices(general=True))
