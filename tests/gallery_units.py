"""The gallery's problems in other units of mass, length and time.

`in_units` writes every quantity x of a problem as X/a, where a is the unit's factor and X the number that a user of
the other unit sees; equations, costs and conditions get the factors of their own dimensions. The three factors are
parameters of the problem, called `mass_unit`, `length_unit` and `time_unit`, so that one module solves it in all units.
Dimensions are exponents of (mass, length, time); what is not listed is a pure number, and velocities follow from
coordinates. Where a problem's own equations hide a mass or a length of one, any dimensions will do that fit together:
the mathematics only sees the factors.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import sympy

from codegen import Control, Phases, parameters
from codegen.discretise.model.from_problem import normalise
from codegen.emit.lower.module import Origin
from codegen.emit.naming import Choices
from codegen.problem.symbols import EndValue, FreeParameter, Momentum, Time, Velocity
from codegen.solving.compiler import generate_from_model

PROBLEMS = Path(__file__).resolve().parent.parent / "problems"
Dimension = tuple[float, float, float]
NUMBER, LENGTH, TIME, MASS = (0, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 0)
SPEED, ACCELERATION, FORCE, ENERGY = (0, 1, -1), (0, 1, -2), (1, 1, -2), (1, 2, -2)
RATE, SPIN, FLOW = (0, 0, -1), (0, 0, -2), (1, 0, -1)


def times(dimension: Dimension, power: float, time: float = 0.0) -> Dimension:
    """A power of a dimension, multiplied by a power of time."""
    mass, length, second = (power * exponent for exponent in dimension)
    return mass, length, second + time


@dataclass(frozen=True)
class Units:
    """Dimensions of a problem's quantities by name, of its cost (the whole integral), and of its conditions in turn."""

    of: Mapping[str, Dimension]
    cost: Dimension
    path: Sequence[Dimension] = ()
    end: Sequence[Dimension] = ()
    start: Sequence[Dimension] = ()
    constraint: Sequence[Dimension] = ()
    arguments: Mapping[str, Any] = field(default_factory=dict)
    steps: int = 20


def per_second(dimension: Dimension) -> Dimension:
    """The dimension of a derivative by time."""
    return times(dimension, 1, -1)


EFFORT = times(FORCE, 2, 1)  # the integral of a squared force
TORQUE = times(ENERGY, 2, 1)

GALLERY: dict[str, Units] = {
    "linear_pendulum": Units({"q": LENGTH, "f": FORCE}, EFFORT, steps=50),
    "orbital_transfer": Units({"r": LENGTH, "u": FORCE}, EFFORT, steps=50),
    "hovercraft": Units(
        {"x": LENGTH, "y": LENGTH, "f1": FORCE, "f2": FORCE},
        EFFORT,
        end=[times(LENGTH, 2)] * 3 + [LENGTH] * 3,
    ),
    "double_integrator": Units({"x": LENGTH, "f": FORCE, "T": TIME}, TIME),
    "double_integrator_effort": Units({"x": LENGTH, "f": FORCE}, EFFORT),
    "bryson_denham": Units({"x": LENGTH, "f": FORCE}, EFFORT, steps=30),
    "brachistochrone": Units({"x": LENGTH, "y": LENGTH, "v": SPEED, "T": TIME}, TIME),
    "cart_pole": Units({"x": LENGTH, "u": FORCE}, EFFORT),
    "pendulum_swing_up": Units({"torque": ENERGY}, TORQUE, steps=50),
    "acrobot": Units({"u": ENERGY}, TORQUE),
    "quadrotor": Units({"x": LENGTH, "y": LENGTH, "u1": FORCE, "u2": FORCE}, EFFORT),
    "two_link_arm": Units({"u1": ENERGY, "u2": ENERGY, "T": TIME}, TIME),
    "n_link_pendulum": Units({"u1": ENERGY, "u2": ENERGY}, TORQUE),
    "crane": Units(
        {"x1": LENGTH, "x2": LENGTH, "x4": SPEED, "x5": SPEED, "x6": RATE, "u1": ACCELERATION, "u2": ACCELERATION},
        NUMBER,
        steps=45,
    ),
    "robot_arm": Units(
        {
            **{"rho": LENGTH, "drho": SPEED, "dtheta": RATE, "dphi": RATE},
            **{"u_rho": FORCE, "u_theta": ENERGY, "u_phi": ENERGY, "T": TIME},
        },
        TIME,
    ),
    "spherical_pendulum": Units(
        dict.fromkeys("xyz", LENGTH) | {"u1": FORCE, "u2": FORCE}, EFFORT, constraint=[times(LENGTH, 2)]
    ),
    "four_bar": Units({"u": ENERGY}, TORQUE, constraint=[LENGTH] * 2),
    "convoy": Units(
        dict.fromkeys("sxy", LENGTH) | dict.fromkeys(("F", "f_x", "f_y"), FORCE), EFFORT, path=[times(LENGTH, 2)]
    ),
    "van_der_pol": Units({"x1": SPEED, "x2": LENGTH, "u": ACCELERATION}, times(LENGTH, 2)),
    "hypersensitive": Units({"x": LENGTH, "u": SPEED}, times(LENGTH, 2)),
    "betts_10_7": Units({"x": LENGTH, "u": SPEED}, times(LENGTH, 2), arguments={"duration": 20}, steps=100),
    "goddard_rocket": Units({"r": LENGTH, "v": SPEED, "m": MASS, "thrust": FORCE, "T": TIME}, LENGTH),
    "low_thrust": Units({"r": LENGTH, "w1": FORCE, "w2": FORCE}, LENGTH, path=[times(FORCE, 2)], end=[(0, 5, -2)]),
    "cart_pendulum": Units({"y": LENGTH, "u": FORCE}, EFFORT),
    "two_stage_rocket": Units(
        {"r": LENGTH, "v": SPEED, "m": MASS, "thrust": FORCE} | dict.fromkeys(("T_1", "T_2", "T_3"), TIME),
        LENGTH,
        steps=10,
    ),
    "bouncing_ball": Units(
        dict.fromkeys("xy", LENGTH) | {"f_x": FORCE, "f_y": FORCE, "T_1": TIME, "T_2": TIME}, EFFORT, steps=10
    ),
}
"""The control problems of the gallery; `steps` are those on which tests compare."""


def gallery_problem(name: str) -> Control | Phases:
    """A problem of the gallery in units whose factors are parameters."""
    units = GALLERY[name]
    specification = importlib.util.spec_from_file_location(name, PROBLEMS / f"{name}.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return in_units(module.problem(**units.arguments), units)


def in_units(problem: Control | Phases, units: Units) -> Control | Phases:
    """The same problem in other units; the units' factors are parameters, one by default."""
    factors = parameters(mass_unit=1, length_unit=1, time_unit=1)
    if isinstance(problem, Phases):
        seen: set[Any] = set()
        phases = [_Converter(units, factors, seen).control(phase) for phase in problem.phases]
        jumps = [_Converter(units, factors, seen).values(jump) for jump in problem.jumps]
        return Phases(*phases, jumps=jumps)
    return _Converter(units, factors, set()).control(problem)


class _Converter:
    """Replaces every quantity x in expressions by x/a."""

    def __init__(self, units: Units, factors: Sequence[Any], seen: set[Any]) -> None:
        self.units, self.factors, self.seen = units, factors, seen

    def factor(self, dimension: Dimension) -> Any:
        """The product of the units' factors to the powers of a dimension."""
        powers = zip(self.factors, dimension, strict=True)
        return sympy.Mul(*(factor ** sympy.nsimplify(power) for factor, power in powers))

    def dimension(self, symbol: Any) -> Dimension:
        """The dimension of a quantity."""
        if isinstance(symbol, Velocity):
            return per_second(self.dimension(symbol.partner))
        if isinstance(symbol, Momentum):
            return tuple(e - q for e, q in zip(times(ENERGY, 1, 1), self.dimension(symbol.partner), strict=True))
        if isinstance(symbol, EndValue):
            return self.dimension(symbol.partner)
        return TIME if isinstance(symbol, Time) else self.units.of.get(symbol.name, NUMBER)

    def expression(self, value: Any, dimension: Dimension = NUMBER) -> Any:
        """An expression in the new quantities, times the factor of its own dimension."""
        value = sympy.sympify(value)
        new = {symbol: symbol / self.factor(self.dimension(symbol)) for symbol in value.free_symbols}
        return value.subs(new, simultaneous=True) * self.factor(dimension)

    def values(self, mapping: Mapping[Any, Any]) -> dict[Any, Any]:
        """Values of quantities."""
        return {symbol: self.expression(value, self.dimension(symbol)) for symbol, value in mapping.items()}

    def relation(self, relation: Any, dimension: Dimension) -> Any:
        """A relation, both sides multiplied by the factor of its dimension."""
        if isinstance(relation, sympy.core.relational.Relational):
            return relation.func(*(self.expression(side, dimension) for side in relation.args))
        return self.expression(relation, dimension)

    def relations(self, relations: Sequence[Any], dimensions: Sequence[Dimension]) -> list[Any]:
        """Relations with the dimensions of each."""
        return [self.relation(r, d) for r, d in zip(relations, dimensions, strict=True)]

    def bounds(self, bounds: Mapping[Any, Any]) -> dict[Any, Any]:
        """Bounds of quantities, None where there is none."""
        return {
            symbol: tuple(None if value is None else self.expression(value, self.dimension(symbol)) for value in pair)
            for symbol, pair in bounds.items()
        }

    def free_parameters(self, problem: Control) -> None:
        """Convert guesses and bounds of the free parameters of which a problem's duration or cost consists, once."""
        for expression in (problem.duration, problem.cost, problem.terminal_cost):
            for symbol in sympy.sympify(expression).free_symbols:
                if isinstance(symbol, FreeParameter) and symbol not in self.seen:
                    self.seen.add(symbol)
                    for name in ("guess", "lower", "upper"):
                        value = getattr(symbol, name)
                        if value is not None:
                            setattr(symbol, name, self.expression(value, self.dimension(symbol)))

    def control(self, problem: Control) -> Control:
        """One problem."""
        units = self.units
        self.free_parameters(problem)
        motion: dict[str, Any] = {}
        if problem.dynamics is not None:
            rates = problem.dynamics.items()
            motion["dynamics"] = {x: self.expression(f, per_second(self.dimension(x))) for x, f in rates}
        for name in ("lagrangian", "hamiltonian"):
            if getattr(problem, name) is not None:
                motion[name] = self.expression(getattr(problem, name), ENERGY)
        forces = problem.force.items()
        against = {q: tuple(e - d for e, d in zip(ENERGY, self.dimension(q), strict=True)) for q, _ in forces}
        return replace(
            problem,
            **motion,
            force={q: self.expression(f, against[q]) for q, f in forces},
            cost=self.expression(problem.cost, per_second(units.cost)),
            terminal_cost=self.expression(problem.terminal_cost, units.cost),
            duration=self.expression(problem.duration, TIME),
            start=self.values(problem.start),
            end=self.values(problem.end),
            guess=self.values(problem.guess),
            bounds=self.bounds(problem.bounds),
            path=self.relations(problem.path, units.path),
            end_conditions=self.relations(problem.end_conditions, units.end),
            start_conditions=self.relations(problem.start_conditions, units.start),
            constraint=self.relations(problem.constraint, units.constraint),
            drawing=(),
        )


UNITS = ("mass_unit", "length_unit", "time_unit")


def cost_factor(name: str, **factors: float) -> float:
    """The factor of a problem's cost for factors of the units."""
    powers = zip(UNITS, GALLERY[name].cost, strict=True)
    return float(np.prod([factors.get(unit, 1.0) ** float(power) for unit, power in powers]))


def text_in_units(name: str) -> str:
    """The text of the module of `gallery_problem`."""
    origin = Origin(f"{name}.py", f"codegen build {name}.py", "0", ("codegen",))
    return generate_from_model(normalise(gallery_problem(name)), Choices(), origin)
