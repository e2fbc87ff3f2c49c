"""Random problems whose derivatives are hard to get right: constants of all sizes, flat regions, cancellation, depth.

Each is a first-order or a mechanical control problem, or a simulation, with a state near which its terms are alive.
"""

from __future__ import annotations

import random

import sympy
from sympy import Expr, Max, Rational, Symbol, atan, cos, cosh, exp, log, sin, sqrt, tanh

from codegen import Control, Simulate, control, coordinates, parameters, states, time
from codegen.emit.naming import Choices

Problem = Control | Simulate


def random_problem(seed: int) -> tuple[Problem, Choices]:
    """A problem and how it is built."""
    draw = random.Random(seed)
    place = draw.choice((0, 1, 5, 20, 350, -2))
    terms = 1 if draw.random() < 0.8 else draw.randint(2, 5)  # long scalars have graphs
    kind = draw.choice(("first order",) * 6 + ("mechanical", "simulation"))
    if kind == "first order":
        return _first_order(draw, place, terms)
    return _mechanical(draw, place, terms, simulated=kind == "simulation")


def _first_order(draw: random.Random, place: int, terms: int) -> tuple[Problem, Choices]:
    (x, v), u, (k,) = states("x v"), control("u"), parameters(k=1.5)
    motion = sum(_term(draw, place, (x, v, u), k) for _ in range(terms))
    problem = Control(
        dynamics={x: v, v: u + motion},
        cost=u**2 + (_term(draw, place, (x, v, u), k) if draw.random() < 0.3 else 0),
        terminal_cost=_term(draw, place, (x, v), k) if draw.random() < 0.3 else 0,
        duration=1,
        start={x: place, v: 0},
        guess={x: place + time() / 10},
        steps=6,
    )
    schemes = ("midpoint", "trapezoidal", "implicit-euler", *(("gauss-4",) if draw.random() < 0.1 else ()))
    return problem, Choices(scheme=draw.choice(schemes))


def _mechanical(draw: random.Random, place: int, terms: int, simulated: bool) -> tuple[Problem, Choices]:
    (x, y), (dx, dy) = coordinates("x y")
    (k,) = parameters(k=1.5)
    potential = sum(_term(draw, place, (x, y), k) for _ in range(terms))
    mass = 2 + draw.choice((cos(y), 1 / (1 + (x - place) ** 2), 0))
    lagrangian = mass * dx**2 / 2 + dy**2 / 2 + dx * dy * draw.choice((0, Rational(1, 3))) - potential
    begin = {x: place, y: Rational(1, 3), dx: 0, dy: 1}
    scheme = draw.choice(("midpoint", "trapezoidal"))
    if simulated:
        return Simulate(lagrangian=lagrangian, duration=1, start=begin, steps=20), Choices(scheme=scheme)
    u = control("u")
    force = {x: u - dx / 10}
    t = time()
    guess = {x: place + t / 10, y: Rational(1, 3) + t}
    problem = Control(lagrangian=lagrangian, force=force, cost=u**2, duration=1, start=begin, guess=guess, steps=6)
    if draw.random() < 0.3:
        return problem, Choices(scheme="midpoint", method="hamiltonian")
    return problem, Choices(scheme=scheme)


def _term(draw: random.Random, place: int, symbols: tuple[Symbol, ...], k: Symbol) -> Expr:
    """One term: a constant of any size times functions inside functions."""
    x, y = draw.choice(symbols), draw.choice(symbols)
    shapes = (
        lambda: exp(-((x - place) ** 2) * k) * y,
        lambda: tanh(draw.choice((1, 200, 10**4)) * (x - place)) * (1 + y),
        lambda: 1 / (1 + exp(-draw.choice((1, 20)) * (x - place - 8))),
        lambda: exp(-Rational(draw.choice((1, 30, 8750)), 1) / (1 + x**2)) * y,
        lambda: exp(-(x - place) / (k * draw.choice((1, 10)))) * y**2,
        lambda: (sin(x * y) ** 2 + cos(x * y) ** 2 - 1) * k + x * y,
        lambda: exp(x / 50 + y / 50) - exp(x / 50) * exp(y / 50) + x**2 * y,
        lambda: sqrt(1 + (x - y) ** 2) - sqrt(Rational(1, 10**6) + x**2),
        lambda: log(1 + k**2 * x**2) / (1 + y**2),
        lambda: (x - place) ** 2 - x**2 + 2 * place * x + Rational(1, 10**30) * x**3,
        lambda: _deep(draw, x, y),
        lambda: cosh(y / 10) * atan(k * x),
        lambda: Max(x - place, 0) ** 3 * y,
        lambda: sympy.Piecewise((x**2 * y, x < place), (x**3, True)),
        lambda: (1 + x**2) ** (k / 3) * y,
    )
    size = Rational(10) ** draw.choice((0, 0, 0, -12, -42, -140, -290, 9, 40, 140))
    return draw.choice((-1, 3, Rational(1, 7))) * size * draw.choice(shapes)()


def _deep(draw: random.Random, x: Symbol, y: Symbol) -> Expr:
    """A composition of several functions."""
    shapes = (
        lambda inner: sin(inner) * inner + y,
        lambda inner: tanh(inner + y / 3),
        lambda inner: log(2 + inner**2),
        lambda inner: exp(-(inner**2)),
        lambda inner: inner / (1 + inner**2 + y**2),
    )
    value: Expr = x
    for _ in range(draw.randint(3, 6)):
        value = draw.choice(shapes)(value)
    return value
