"""Evidence about points without momenta: kernels against 50 digits, company of the particles, the way back."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mpmath
import numpy as np
import sympy

from codegen.checks.base import Finding
from codegen.model.pairwise import PairwiseModel
from codegen.runtime.particles.steps import advance
from codegen.runtime.particles.tracers import carry_points

DIGITS = 50


def findings(model: PairwiseModel, module: Any, states: list[Any]) -> Iterator[Finding]:
    """All evidence about a module that carries tracer points, from some states of particles."""
    if not model.passive:
        return
    own, parameters = np.ones((states[0].shape[1], len(model.own))), np.array(model.defaults, dtype=float)
    generator = np.random.default_rng(2)
    yield from _kernels(model, module, states, own, parameters, generator)
    yield _company(module, states[0], own, parameters)
    yield from _way_back(module, states[0], own, parameters, generator)


def exact_velocity(model: PairwiseModel, point: Any, state: Any, own: Any) -> tuple[list[Any], list[Any]]:
    """The velocity of a tracer point and its gradient, row after row, from the author's pair term with 50 digits."""
    size = len(model.coordinates)
    rest = dict.fromkeys(model.first.p, sympy.S.Zero)
    rest |= {p: sympy.Rational(v) for p, v in zip(model.parameters, model.defaults, strict=True)}
    rates = [sympy.diff(model.pair_term, p) for p in model.first.p]
    wanted = [*rates, *(sympy.diff(rate, q) for rate in rates for q in model.first.q)]
    arguments = [*model.first.q, *model.second.moving, *model.second.own]
    function = sympy.lambdify(arguments, [e.subs(rest) for e in wanted], "mpmath")
    with mpmath.workdps(DIGITS):
        totals = [mpmath.mpf(0)] * len(wanted)
        for j in range(state.shape[1]):
            values = [mpmath.mpf(float(v)) for v in (*point, *state[0, j], *state[1, j], *own[j])]
            totals = [total + value for total, value in zip(totals, function(*values), strict=True)]
    return totals[:size], totals[size:]


def _kernels(
    model: PairwiseModel, module: Any, states: list[Any], own: Any, parameters: Any, generator: np.random.Generator
) -> Iterator[Finding]:
    errors, slope_errors, size, block = [], [], len(model.coordinates), int(module.BLOCK)
    for state in states:
        positions = np.abs(state[0]).max() * generator.uniform(-0.7, 0.7, (size, block))
        positions[:, 0] = state[0, 0] + 1e-9  # where digits are lost most easily
        rates, gradients, alone = np.empty(size * block), np.empty(size * size * block), np.empty(size * block)
        module.tracer_gradient(positions.ravel(), state, own, parameters, rates, gradients)
        module.tracer_velocity(positions.ravel(), state, own, parameters, alone)
        for m in range(min(3, block)):
            velocity, gradient = exact_velocity(model, positions[:, m], state, own)
            for found in (rates, alone):
                errors.append(_error(found.reshape(size, block)[:, m], velocity))
            slope_errors.append(_error(gradients.reshape(size * size, block)[:, m], gradient))
    yield small_error("derivatives", "velocity of tracer points against 50 digits", max(errors), 1e-12)
    yield small_error("derivatives", "its derivative by position against 50 digits", max(slope_errors), 1e-12)


def _company(module: Any, state: Any, own: Any, parameters: Any) -> Finding:
    """A tracer point on a particle moves as it does."""
    _, count, size = state.shape
    block = int(module.BLOCK)
    gradient, rates, error = np.empty(state.shape), np.empty(size * block), 0.0
    module.hamiltonian_gradient(state, own, parameters, gradient)
    for i in range(count):
        positions = np.repeat(state[0, i], block)
        module.tracer_velocity(positions, state, own, parameters, rates)
        error = max(error, float(np.abs(rates.reshape(size, block)[:, 0] - gradient[1, i]).max()))
    return small_error("consistency", "tracer points on particles", error / float(np.abs(gradient[1]).max()), 1e-12)


def _way_back(module: Any, state: Any, own: Any, parameters: Any, generator: np.random.Generator) -> Iterator[Finding]:
    """Points that make a step and its inverse, and the product of the derivatives of both."""
    h, stages = 0.02, np.zeros((module.POINTS, *state.shape))
    if advance(module.problem.pairs, state, h, own, parameters, stages, 0.0, np.empty_like(state)) < 0:
        yield Finding("consistency", "the way back", False, "the step could not be made")
        return
    size, count = state.shape[2], int(module.BLOCK)
    points = np.abs(state[0]).max() * generator.uniform(-0.7, 0.7, (count, size))
    there, back, tangents, inverse = (np.empty((count, *[size] * k)) for k in (1, 1, 2, 2))
    tracers = module.problem.tracers
    carry_points(tracers, points, h, 0.0, 1.0, stages, own, parameters, there, tangents)
    carry_points(tracers, there, h, 1.0, 0.0, stages, own, parameters, back, inverse)
    yield small_error("consistency", "tracer points carried there and back", float(np.abs(back - points).max()), 1e-13)
    error = float(np.abs(inverse @ tangents - np.eye(size)).max())
    yield small_error("consistency", "the derivatives of both", error, 1e-12)


def _error(found: Any, wanted: list[Any]) -> float:
    size = max(abs(value) for value in wanted)
    return max(abs(float((v - w) / size)) for v, w in zip(found.tolist(), wanted, strict=True))


def small_error(check: str, subject: str, error: float, limit: float) -> Finding:
    """The finding that an error is, or is not, within a limit."""
    return Finding(check, subject, error <= limit, f"largest relative error {error:.1e}, allowed {limit:.0e}")
