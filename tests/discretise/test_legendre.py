"""The continuous Legendre transform: textbook Hamiltonians, round trips, boundary momenta, refusals."""

from __future__ import annotations

import math
import random
import runpy
from pathlib import Path
from typing import Any

import pytest
import sympy
from sympy import Rational, cos, sin, sqrt

from codegen.discretise.model.definitions import Model
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.model.legendre import (
    hamiltonian_form,
    lagrangian_form,
    momentum_of_velocity,
    velocity_of_momentum,
)
from codegen.errors import BoundaryError, DegenerateError
from codegen.problem.problem import Control, Simulate
from codegen.problem.symbols import canonical_pair, control, coordinate, coordinates, parameters, recorded_declarations

PROBLEMS = Path(__file__).parents[2] / "problems"


def gallery(name: str, **arguments: Any) -> Model:
    with recorded_declarations() as declared:
        problem = runpy.run_path(str(PROBLEMS / f"{name}.py"))["problem"](**arguments)
    return normalise(problem, declared, name, name)


def named(model: Model) -> dict[str, sympy.Symbol]:
    symbols = [*model.coordinates, *model.rates, *model.controls, *model.parameters]
    return {symbol.name: symbol for symbol in symbols}


def chain(count: int) -> Model:
    """A chain of unit masses on unit links, written with the Cartesian velocities of the masses."""
    angles, speeds = coordinates(" ".join(f"q{i}" for i in range(count)))
    lagrangian: Any = 0
    across: Any = 0
    up: Any = 0
    height: Any = 0
    for q, v in zip(angles, speeds, strict=True):
        across, up, height = across + cos(q) * v, up + sin(q) * v, height - cos(q)
        lagrangian += (across**2 + up**2) / 2 - height
    start = {**dict.fromkeys(angles, 1), **dict.fromkeys(speeds, 0)}
    return normalise(Simulate(lagrangian=lagrangian, duration=1, start=start))


def assert_equal_everywhere(first: sympy.Expr, second: sympy.Expr) -> None:
    generator = random.Random(3)
    symbols = sorted(first.free_symbols | second.free_symbols, key=str)
    for _ in range(5):
        point = {symbol: generator.uniform(-1.3, 1.3) for symbol in symbols}
        assert float(first.evalf(subs=point)) == pytest.approx(float(second.evalf(subs=point)), rel=1e-12, abs=1e-12)


def test_hamiltonian_of_the_pendulum() -> None:
    model = hamiltonian_form(gallery("pendulum", form="lagrangian"))
    q, p = model.coordinates[0], model.rates[0]
    assert p.name == "p_q"
    assert sympy.expand(model.function - (p**2 / 2 - cos(q))) == 0
    assert model.start.rates == (sympy.Rational(7, 5),)


def test_hamiltonian_of_the_orbital_transfer() -> None:
    original = gallery("orbital_transfer")
    model = hamiltonian_form(original)
    s = named(model)
    r, m, GM, r0, r1 = (s[name] for name in ("r", "m", "GM", "r0", "r1"))
    expected = (s["p_r"] ** 2 + s["p_phi"] ** 2 / r**2) / (2 * m) - GM * m / r
    assert sympy.simplify(model.function - expected) == 0
    assert model.force == (0, r * s["u"])
    assert model.cost == s["u"] ** 2
    assert model.end is not None
    for boundary, radius in ((model.start, r0), (model.end, r1)):
        assert boundary.rates[0] == 0
        momentum = boundary.rates[1]
        assert momentum is not None
        # m r^2 times the angular speed of the circular orbit, sqrt(GM/r^3)
        assert momentum.subs(model.default_values).evalf() == pytest.approx(
            (m * sqrt(GM * radius)).subs(model.default_values).evalf(), rel=1e-14
        )
    assert sympy.simplify(lagrangian_form(model).function - original.function) == 0


@pytest.mark.parametrize("count", [1, 2, pytest.param(3, marks=pytest.mark.slow)])
def test_chain_keeps_its_energy_and_returns_its_velocities(count: int) -> None:
    model = chain(count)
    dual = hamiltonian_form(model)
    momenta = dict(zip(dual.rates, momentum_of_velocity(model), strict=True))
    energy = sum(p * v for p, v in zip(momenta.values(), model.rates, strict=True)) - model.function
    assert_equal_everywhere(dual.function.xreplace(momenta), energy)
    for velocity, expression in zip(model.rates, velocity_of_momentum(model), strict=True):
        assert_equal_everywhere(expression.xreplace(momenta), velocity)


def test_double_pendulum_round_trip() -> None:
    model = chain(2)
    assert_equal_everywhere(lagrangian_form(hamiltonian_form(model)).function, model.function)


def test_dynamics_of_the_double_pendulum_match_its_textbook_hamiltonian() -> None:
    # Two unit masses on unit links: H = (p1^2 + 2 p2^2 - 2 p1 p2 cos d)/(2 (1 + sin^2 d)) - 2 cos q1 - cos q2.
    model = hamiltonian_form(chain(2))
    (a, b), (p, w) = model.coordinates, model.rates
    expected = (p**2 + 2 * w**2 - 2 * p * w * cos(a - b)) / (2 * (1 + sin(a - b) ** 2)) - 2 * cos(a) - cos(b)
    assert_equal_everywhere(model.function, expected)


def test_uncoupled_bodies_stay_apart() -> None:
    (a, b, c), (da, db, dc) = coordinates("a b c")
    lagrangian = (da**2 + db**2 + da * db * cos(a)) / 2 + (2 + sin(c)) * dc**2 / 2
    start = dict.fromkeys((a, b, c, da, db, dc), 1)
    model = normalise(Simulate(lagrangian=lagrangian, duration=1, start=start))
    velocities = velocity_of_momentum(model)
    assert {s.name for s in velocities[2].free_symbols} == {"c", "p_c"}
    assert {s.name for s in velocities[0].free_symbols} == {"a", "p_a", "p_b"}


def test_linear_terms_and_velocity_dependent_forces_are_rewritten() -> None:
    # A charge in a magnetic potential: L = v^2/2 + B q1 v2 gives H = (p1^2 + (p2 - B q1)^2)/2.
    (y, z), (dy, dz) = coordinates("y z")
    B, d, u = *parameters(B=2, d=0.5), control("u")
    problem = Control(
        lagrangian=(dy**2 + dz**2) / 2 + B * y * dz,
        force={z: u - d * dz},
        cost=u**2 + dz**2,
        duration=1,
        start={y: 1, z: 0, dy: 0, dz: 3},
        end={y: 0, z: 1},
    )
    model = hamiltonian_form(normalise(problem))
    s = named(model)
    kinetic = s["p_z"] - s["B"] * s["y"]
    assert sympy.expand(model.function - (s["p_y"] ** 2 + kinetic**2) / 2) == 0
    assert sympy.expand(model.force[1] - (s["u"] - s["d"] * kinetic)) == 0
    assert model.cost is not None
    assert sympy.expand(model.cost - (s["u"] ** 2 + kinetic**2)) == 0
    assert model.start.rates == (0, s["B"] + 3)
    assert model.end is not None
    assert model.end.rates == (None, None)


def test_relativistic_particle() -> None:
    z, dz = coordinate("z")
    model = normalise(Simulate(lagrangian=-sqrt(1 - dz**2), duration=1, start={z: 0, dz: 0.6}))
    dual = hamiltonian_form(model)
    assert_equal_everywhere(dual.function, sqrt(1 + dual.rates[0] ** 2))
    assert float(dual.start.rates[0]) == pytest.approx(0.75, rel=1e-14)
    assert_equal_everywhere(
        lagrangian_form(dual).function.subs(sympy.Symbol("dz", real=True), sympy.Rational(3, 5)), sympy.Float(-0.8)
    )


def test_free_particle_and_identity() -> None:
    z, p = canonical_pair("z", "p")
    model = normalise(Simulate(hamiltonian=p**2 / 2, duration=1, start={z: 0, p: 1}))
    dual = lagrangian_form(model)
    assert dual.function == dual.rates[0] ** 2 / 2
    assert dual.rates[0].name == "dz"
    assert hamiltonian_form(model) is model
    assert lagrangian_form(dual) is dual


def test_momentum_that_depends_on_a_free_end_is_refused() -> None:
    (r, phi), (dr, dphi) = coordinates("r phi")
    u = control("u")
    problem = Control(
        lagrangian=(dr**2 + r**2 * dphi**2) / 2,
        force={phi: u},
        cost=u**2,
        duration=1,
        start={r: 1, phi: 0, dr: 0, dphi: 1},
        end={phi: 1, dphi: 2},
    )
    with pytest.raises(BoundaryError, match=r"end fixes dphi but leaves r free.*p_phi.*variational"):
        hamiltonian_form(normalise(problem))


def test_degenerate_hamiltonian_is_refused() -> None:
    z, p = canonical_pair("z", "p")
    model = normalise(Simulate(hamiltonian=z * p, duration=1, start={z: 1, p: 1}))
    with pytest.raises(DegenerateError, match="dz does not determine p"):
        lagrangian_form(model)


def test_momentum_without_unique_velocity_is_refused() -> None:
    z, dz = coordinate("z")
    model = normalise(Simulate(lagrangian=cos(dz), duration=1, start={z: 0, dz: 1}))
    with pytest.raises(DegenerateError, match="p_z"):
        hamiltonian_form(model)


def test_a_parameter_may_have_the_name_of_a_momentum() -> None:
    z, dz = coordinate("z")
    (p_z,) = parameters(p_z=math.pi)
    model = hamiltonian_form(normalise(Simulate(lagrangian=p_z * dz**2, duration=1, start={z: 0, dz: 1})))
    (momentum,), (parameter,) = model.rates, model.parameters
    assert momentum != parameter
    assert model.function.subs({momentum: 6, parameter: 2}) == Rational(36, 4 * 2)
