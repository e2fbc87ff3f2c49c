"""Evidence for particles with pairwise interaction: kernels, gradients, tracers.

Evidence about kernels: H = 1/2 sum p_i . p_j G(q_i, q_j) with G positive definite, also where points nearly meet.
Points that nearly meet, and points near the boundary of the domain, are where digits are lost. There the emitted matrix
of G is compared with the author's expression in 50 digits, at distances down to 1e-150 from each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr

from codegen.discretise import transcribe
from codegen.discretise.model.from_problem import load_problem
from codegen.discretise.model.pairwise import PairwiseModel
from codegen.discretise.particles import PARTICLE_SCHEMES
from codegen.emit import differentiation, lower, naming, rendering
from codegen.emit.naming import Choices
from codegen.evidence.checks import layout
from codegen.evidence.checks.base import Finding
from codegen.problem.sources import Source
from codegen.runtime.particles.steps import advance, advance_directions, curvature_at
from codegen.runtime.particles.tracers import carry_points
from codegen.solving.loading import load
from codegen.symbolic.zeros import identically_zero

DIGITS = 50


def tracer_findings(model: PairwiseModel, module: Any, states: list[Any]) -> Iterator[Finding]:
    """All evidence about a module that carries tracer points, from some states of particles."""
    if not model.passive:
        return
    own, parameters = np.ones((states[0].shape[1], len(model.own))), np.array(model.defaults, dtype=float)
    generator = np.random.default_rng(2)
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


COUNT = 24
CLOSE = tuple(10.0**-k for k in (1, 2, 4, 8, 12, 16, 30, 100, 150))
"""Distances of two points of which one is at the origin, so that they are exact."""
RIM = tuple(10.0**-k for k in (1, 2, 4, 6, 8))
"""Distances from the boundary of the unit ball, as shares of its radius."""


def kernel_findings(model: PairwiseModel, module: Any) -> Iterator[Finding]:
    """All evidence about a module whose momenta meet in a kernel; none about others."""
    kernel = _kernel(model)
    if kernel is None or not hasattr(module, "momentum_matrix"):
        return
    size = len(model.coordinates)
    axis, base = np.eye(size)[0], np.zeros(size)
    if not (_is_inside(model, base) and _is_inside(model, 0.999 * axis)):
        return  # of another domain than space or a ball about the origin, no places are known
    # Points all over the unit ball, some of them crowded, and some near its boundary.
    generator = np.random.default_rng(4)
    directions = generator.normal(size=(COUNT, len(model.coordinates)))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    radii = np.concatenate([np.linspace(0.05, 0.9, COUNT - 4), [0.99, 0.999, 0.301, 0.302]])
    places = radii[:, None] * directions
    places[-1] = places[-2] * 1.001
    matrix = _matrix(model, module, places)
    scale = np.sqrt(np.diag(matrix))
    least = float(np.linalg.eigvalsh(matrix / np.outer(scale, scale))[0])
    symmetric = bool((matrix == matrix.T).all())
    # What is not positive by rounding alone, as where a smooth kernel meets many points, is no evidence against it.
    passed = symmetric and least > -COUNT * float(np.finfo(float).eps)
    detail = f"least eigenvalue {least:.1e} of {COUNT} points, with ones in the diagonal"
    yield Finding("kernel", "positive definite", passed, detail if symmetric else "the matrix is not symmetric")
    near = [np.stack([base, distance * axis]) for distance in CLOSE]
    yield _agreement(model, module, kernel, near, "the kernel where two points nearly meet, against 50 digits")
    if not _is_inside(model, 1.000001 * axis):
        other = np.full(size, 0.1)
        rim = [np.stack([(1.0 - far) * axis, other]) for far in RIM]
        both = [np.stack([(1.0 - far) * axis, (1.0 - 2.0 * far) * axis]) for far in RIM]
        yield _agreement(model, module, kernel, [*rim, *both], "the kernel near the boundary, against 50 digits")
    yield _limit(model, module)


def _kernel(model: PairwiseModel) -> Expr | None:
    """G, where the pair term is p_i . p_j G without momenta in G, and has a limit where points meet."""
    entries = [[sympy.diff(model.pair_term, p, r) for r in model.second.p] for p in model.first.p]
    moving = {*model.first.p, *model.second.p, *model.first.own, *model.second.own}
    kernel = entries[0][0]
    if model.limit is None or kernel == 0 or kernel.free_symbols & moving:
        return None
    size = range(len(entries))
    fits = all(identically_zero(entries[a][b] - (kernel if a == b else 0)) for a in size for b in size)
    return kernel if fits else None


def _is_inside(model: PairwiseModel, place: NDArray[np.float64]) -> bool:
    """Whether a particle may be at a place, with the parameters' default values."""
    values = dict(zip(model.parameters, model.defaults, strict=True))
    values |= dict(zip(model.first.q, map(sympy.Float, place.tolist()), strict=True))
    return all(bool(expression.subs(values) > 0) for expression in model.domain)


def _matrix(model: PairwiseModel, module: Any, places: NDArray[np.float64]) -> NDArray[np.float64]:
    state, matrix = np.stack([places, np.zeros_like(places)]), np.empty((len(places), len(places)))
    module.momentum_matrix(state, np.ones((len(places), len(model.own))), np.array(model.defaults, dtype=float), matrix)
    return matrix


def _agreement(
    model: PairwiseModel, module: Any, kernel: Expr, cases: list[NDArray[np.float64]], subject: str
) -> Finding:
    values = {p: sympy.Rational(v) for p, v in zip(model.parameters, model.defaults, strict=True)}
    exact = sympy.lambdify([*model.first.q, *model.second.q], kernel.subs(values), "mpmath")
    worst = 0.0
    with mpmath.workdps(DIGITS):
        for places in cases:
            wanted = exact(*(mpmath.mpf(float(x)) for x in places.ravel()))
            found = float(_matrix(model, module, places)[0, 1])
            worst = max(worst, abs(float((mpmath.mpf(found) - wanted) / wanted)))
    return small_error("kernel", subject, worst, 1e-12)


def _limit(model: PairwiseModel, module: Any) -> Finding:
    """Where points meet, the kernel of two is that of one with itself."""
    size = len(model.coordinates)
    worst = 0.0
    for share in (0.0, 0.5, 0.9):
        place = np.full(size, share / np.sqrt(size))
        matrix = _matrix(model, module, np.stack([place, place]))
        worst = max(worst, float(np.abs(matrix - matrix[0, 0]).max() / matrix[0, 0]))
    return small_error("kernel", "the limit where points meet", worst, 1e-14)


_PARTICLES = 4
_LENGTHS = tuple(0.05 / 8**k for k in range(7))
"""Of steps, until one can be made: particles at random positions may repel each other strongly."""


def particle_findings(
    source: Source, arguments: Mapping[str, str], choices: Choices, module_path: Path
) -> Iterator[Finding]:
    """All evidence about a module of particles, as it lies on disk."""
    model = load_problem(source, arguments)
    assert isinstance(model, PairwiseModel)
    program = transcribe.transcribe(model, choices.scheme, choices.method)
    fresh = lower.lower(program, differentiation.derivatives(program))
    origin = naming.origin_of(source, arguments, choices)
    text = rendering.render(fresh, origin)
    module: Any = load(module_path)
    yield from layout.compare(module_path, module, origin.inputs, text)
    generator = np.random.default_rng(1)
    states = [_state(model, generator, scale) for scale in (0.6, 0.6, 1e-2)]
    own, parameters = _own(model), np.array(model.defaults, dtype=float)
    errors = []
    for state in states:
        total, _ = exact(model, state, own)
        errors.append(abs(float((mpmath.mpf(module.hamiltonian(state, own, parameters)) - total) / total)))
    yield small_error("derivatives", "the Hamiltonian against 50 digits", max(errors), 1e-12)
    if hasattr(module, "hamiltonian_gradient"):
        yield _gradient(model, module, states)
        yield _hessian(model, module, states[0])
        yield _products(model, module, states[0], generator)
    yield from _symplectic(model, module, states[0], program.scheme)
    yield from kernel_findings(model, module)
    yield from tracer_findings(model, module, states)


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


def _gradient(model: PairwiseModel, module: Any, states: list[Any]) -> Finding:
    own, parameters = _own(model), np.array(model.defaults, dtype=float)
    errors = []
    for state in states:
        _, wanted = exact(model, state, own)
        gradient = np.empty(state.shape)
        module.hamiltonian_gradient(state, own, parameters, gradient)
        size = max(abs(value) for value in wanted)
        errors.append(max(abs(float((v - w) / size)) for v, w in zip(gradient.ravel().tolist(), wanted, strict=True)))
    return small_error("derivatives", "H_q and H_p against 50 digits", max(errors), 1e-12)


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
    return small_error(
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
    return small_error("derivatives", "products with the second derivatives", error, 1e-12)


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
