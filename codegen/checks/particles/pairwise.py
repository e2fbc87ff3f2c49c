"""Evidence about modules of particles: kernels against 50 digits, tangents, symplecticity, the limit at coincidence."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import sympy

from codegen import derive, emit, lower, naming, transcribe
from codegen.author.sources import Source
from codegen.checks.base import Finding
from codegen.checks.module import provenance
from codegen.checks.particles import kernel, tracers
from codegen.loading import load
from codegen.model.from_file import load_problem
from codegen.model.pairwise import PairwiseModel
from codegen.naming import Choices
from codegen.runtime.particles.steps import advance, advance_directions, curvature_at
from codegen.schemes.particles import PARTICLE_SCHEMES

DIGITS = 50
_PARTICLES = 4
_LENGTHS = tuple(0.05 / 8**k for k in range(7))
"""Of steps, until one can be made: particles at random positions may repel each other strongly."""


def findings(source: Source, arguments: Mapping[str, str], choices: Choices, module_path: Path) -> Iterator[Finding]:
    """All evidence about a module of particles, as it lies on disk."""
    model = load_problem(source, arguments)
    assert isinstance(model, PairwiseModel)
    program = transcribe.transcribe(model, choices.scheme, choices.method)
    fresh = lower.lower(program, derive.derivatives(program))
    origin = naming.origin_of(source, arguments, choices)
    text = emit.render(fresh, origin)
    module: Any = load(module_path)
    yield from provenance.compare(module_path, module, origin.inputs, text)
    generator = np.random.default_rng(1)
    states = [_state(model, generator, scale) for scale in (0.6, 0.6, 1e-2)]
    yield _value(model, module, states)
    if hasattr(module, "hamiltonian_gradient"):
        yield _gradient(model, module, states)
        yield _hessian(model, module, states[0])
        yield _products(model, module, states[0], generator)
    yield from _symplectic(model, module, states[0], program.scheme)
    yield from kernel.findings(model, module)
    yield from tracers.findings(model, module, states)


def _state(model: PairwiseModel, generator: np.random.Generator, scale: float) -> Any:
    size = len(model.coordinates)
    return scale * generator.uniform(-1.0, 1.0, (2, _PARTICLES, size)) / np.sqrt(size)


def _own(model: PairwiseModel) -> Any:
    return np.ones((_PARTICLES, len(model.own)))


def exact(model: PairwiseModel, state: Any, own: Any) -> tuple[Any, list[Any]]:
    """H and its gradient at a state from the author's expressions with 50 digits; the gradient as a flat list."""
    with mpmath.workdps(DIGITS):
        of_one, of_two = _functions(model)
        count, size = state.shape[1], state.shape[2]
        values = [[mpmath.mpf(float(v)) for v in (*state[0, i], *state[1, i], *own[i])] for i in range(count)]
        total, gradient = mpmath.mpf(0), [[[mpmath.mpf(0)] * size for _ in range(count)] for _ in range(2)]

        def add(particle: int, slopes: list[Any]) -> None:
            for k, slope in enumerate(slopes):
                gradient[k // size][particle][k % size] += slope

        for i in range(count):
            energy, *slopes = of_one(*values[i])
            total += energy
            add(i, slopes)
            for j in range(i):
                energy, *slopes = of_two(*values[i], *values[j])
                total += energy
                add(i, slopes[: 2 * size])
                add(j, slopes[2 * size :])
        return total, [value for part in gradient for row in part for value in row]


def _functions(model: PairwiseModel) -> tuple[Any, Any]:
    """The self term of a particle, and the pair term of two, each followed by its derivatives, for mpmath."""
    parameters = {p: sympy.Rational(v) for p, v in zip(model.parameters, model.defaults, strict=True)}
    single = [*model.first.moving, *model.first.own]
    both = [*single, *model.second.moving, *model.second.own]

    def function(arguments: list[sympy.Symbol], term: sympy.Expr, moving: tuple[sympy.Symbol, ...]) -> Any:
        wanted = [term, *(sympy.diff(term, z) for z in moving)]
        return sympy.lambdify(arguments, [e.subs(parameters) for e in wanted], "mpmath")

    return (
        function(single, model.self_term, model.first.moving),
        function(both, model.pair_term, (*model.first.moving, *model.second.moving)),
    )


def _value(model: PairwiseModel, module: Any, states: list[Any]) -> Finding:
    own, parameters = _own(model), np.array(model.defaults, dtype=float)
    errors = []
    for state in states:
        total, _ = exact(model, state, own)
        errors.append(abs(float((mpmath.mpf(module.hamiltonian(state, own, parameters)) - total) / total)))
    return tracers.small_error("derivatives", "the Hamiltonian against 50 digits", max(errors), 1e-12)


def _gradient(model: PairwiseModel, module: Any, states: list[Any]) -> Finding:
    own, parameters = _own(model), np.array(model.defaults, dtype=float)
    errors = []
    for state in states:
        _, wanted = exact(model, state, own)
        gradient = np.empty(state.shape)
        module.hamiltonian_gradient(state, own, parameters, gradient)
        size = max(abs(value) for value in wanted)
        errors.append(max(abs(float((v - w) / size)) for v, w in zip(gradient.ravel().tolist(), wanted, strict=True)))
    return tracers.small_error("derivatives", "H_q and H_p against 50 digits", max(errors), 1e-12)


def _hessian(model: PairwiseModel, module: Any, state: Any) -> Finding:
    own, parameters = _own(model), np.array(model.defaults, dtype=float)
    hessian = np.empty((state.size, state.size))
    module.hamiltonian_hessian(state, own, parameters, hessian)
    error = 0.0
    for k in range(0, state.size, 3):
        shifted = []
        for sign in (1.0, -1.0):
            other = state.copy()
            other.reshape(-1)[k] += sign * 1e-6
            shifted.append((other.reshape(-1)[k], exact(model, other, own)[1]))
        (x1, g1), (x0, g0) = shifted
        column = [float((a - b) / (mpmath.mpf(x1) - mpmath.mpf(x0))) for a, b in zip(g1, g0, strict=True)]
        error = max(error, float(np.abs(hessian[:, k] - column).max()))
    return tracers.small_error(
        "derivatives", "second derivatives against differences", error / float(np.abs(hessian).max()), 1e-8
    )


def _products(model: PairwiseModel, module: Any, state: Any, generator: np.random.Generator) -> Finding:
    own, parameters = _own(model), np.array(model.defaults, dtype=float)
    hessian = np.empty((state.size, state.size))
    module.hamiltonian_hessian(state, own, parameters, hessian)
    directions = generator.normal(size=(state.size, 3))
    products = np.empty_like(directions)
    module.hessian_products(state, own, parameters, directions, products)
    error = float(np.abs(products - hessian @ directions).max() / np.abs(products).max())
    return tracers.small_error("derivatives", "products with the second derivatives", error, 1e-12)


def _symplectic(model: PairwiseModel, module: Any, state: Any, scheme: str) -> Iterator[Finding]:
    """D' J D = J for the derivative D of one step, for a scheme that promises it; and that no other one does."""
    if module.problem.gradient is None:
        return
    own, parameters, pairs = _own(model), np.array(model.defaults, dtype=float), module.problem.pairs
    points, after = np.zeros((module.POINTS, *state.shape)), np.empty_like(state)
    made = (h for h in _LENGTHS if advance(pairs, state, h, own, parameters, points, 0.0, after) >= 0)
    if (h := next(made, None)) is None:
        yield Finding(
            "symplecticity", "one step", False, f"no step could be made, down to a length of {_LENGTHS[-1]:g}"
        )
        return
    curvature = curvature_at(module.problem, points, own, parameters)
    derivative = np.empty((state.size, state.size))
    advance_directions(pairs, curvature, points, 0, h, own, parameters, np.eye(state.size), derivative)
    half = state.size // 2
    form = np.block([[np.zeros((half, half)), np.eye(half)], [-np.eye(half), np.zeros((half, half))]])
    size = np.abs(derivative).T @ np.abs(form) @ np.abs(derivative)  # coordinates and momenta have units of their own
    difference = np.abs(derivative.T @ form @ derivative - form)
    error = float(np.max(difference / np.where(size > 0.0, size, 1.0)))
    promised = PARTICLE_SCHEMES[scheme].symplectic
    claim = f"the scheme is {'' if promised else 'not '}symplectic"
    detail = f"|D' J D - J| / |D|' |J| |D| = {error:.1e} for a step of {h:g}; {claim}"
    yield Finding("symplecticity", "one step", error < 1e-11 if promised else error > 1e-11, detail)
