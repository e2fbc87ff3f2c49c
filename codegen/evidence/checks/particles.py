"""Checks of particles with pairwise interaction: H and its derivatives, symplecticity, kernels, tracer points.

The references for H, its gradient and the velocity of tracer points are the author's expressions in 50 digits.

In some problems H = 1/2 sum p_i . p_j G(q_i, q_j) with a positive definite kernel G. Digits are lost where points
nearly meet, and near the boundary of the domain. There the emitted matrix of G is compared with the author's expression
in 50 digits, at distances down to 1e-150.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType

import mpmath
import numpy as np
import sympy
from numpy.typing import NDArray

from codegen.discretise import transcribe
from codegen.discretise.model.from_problem import load_problem
from codegen.discretise.model.pairwise import PairwiseModel
from codegen.discretise.particles import PARTICLE_SCHEMES
from codegen.emit import differentiation, lower, naming, rendering
from codegen.emit.naming import Choices
from codegen.evidence.checks import authored, layout
from codegen.evidence.checks.base import Finding
from codegen.problem.sources import Source
from codegen.runtime.particles.steps import advance, advance_directions, curvature_at
from codegen.runtime.particles.tracers import carry_points
from codegen.solving.loading import load
from codegen.symbolic.zeros import identically_zero

DIGITS = 50
_PARTICLES = 4
_LENGTHS = tuple(0.05 / 8**k for k in range(7))
"""Step lengths to try in this order, because particles at random positions may repel each other strongly."""
Array = NDArray[np.float64]


def particle_findings(
    source: Source, arguments: Mapping[str, str], choices: Choices, module_path: Path
) -> Iterator[Finding]:
    """Yield all findings about a generated module of particles on disk."""
    model = load_problem(source, arguments)
    assert isinstance(model, PairwiseModel)
    program = transcribe.transcribe(model, choices.scheme, choices.method)
    fresh = lower.lower(program, differentiation.derivatives(program))
    origin = naming.origin_of(source, arguments, choices)
    text = rendering.render(fresh, origin)
    module = load(module_path)
    assert isinstance(module, ModuleType)
    yield from layout.compare(module_path, module, origin.inputs, text)
    yield from authored.check_particles(source.written(arguments)[1], module)
    generator, size = np.random.default_rng(1), len(model.coordinates)
    states = [scale * generator.uniform(-1.0, 1.0, (2, _PARTICLES, size)) / np.sqrt(size) for scale in (0.6, 0.6, 1e-2)]
    yield from _derivatives(model, module, states, generator)
    yield from _symplectic(model, module, states[0], program.scheme)
    yield from _kernel_findings(model, module)
    yield from tracer_findings(model, module, states)


def _data(model: PairwiseModel, count: int) -> tuple[Array, Array]:
    """Return the constants of each particle (count, k), here all ones, and the default parameters."""
    return np.ones((count, len(model.own))), np.array(model.defaults, dtype=float)


def _small_error(check: str, subject: str, error: float, limit: float) -> Finding:
    """Return a finding that passes if a relative error is within a limit."""
    return Finding(check, subject, error <= limit, f"largest relative error {error:.1e}, allowed {limit:.0e}")


def _error(emitted: Array, exact: list[mpmath.mpf]) -> float:
    """Return the largest error of the emitted entries, relative to the largest exact entry."""
    size = max(abs(value) for value in exact)
    return max(abs(float((v - w) / size)) for v, w in zip(emitted.tolist(), exact, strict=True))


def _derivatives(
    model: PairwiseModel, module: ModuleType, states: list[Array], generator: np.random.Generator
) -> Iterator[Finding]:
    """Compare H and its gradient with 50 digits, and second derivatives with differences; each yields a finding."""
    own, parameters = _data(model, _PARTICLES)
    exact, energies, gradients = _exact(model), [], []
    for state in states:
        energy, slopes = exact(state, own)
        energies.append(abs(float((mpmath.mpf(module.hamiltonian(state, own, parameters)) - energy) / energy)))
        if hasattr(module, "hamiltonian_gradient"):
            gradient = np.empty(state.shape)
            module.hamiltonian_gradient(state, own, parameters, gradient)
            gradients.append(_error(gradient.ravel(), slopes))
    yield _small_error("derivatives", "the Hamiltonian against 50 digits", max(energies), 1e-12)
    if not gradients:
        return
    yield _small_error("derivatives", "H_q and H_p against 50 digits", max(gradients), 1e-12)

    state, hessian, error = states[0], np.empty((states[0].size, states[0].size)), 0.0
    module.hamiltonian_hessian(state, own, parameters, hessian)
    for k in range(0, state.size, 3):
        shifted = []
        for sign in (1.0, -1.0):
            other = state.copy()
            other.reshape(-1)[k] += sign * 1e-6
            shifted.append((mpmath.mpf(other.reshape(-1)[k]), exact(other, own)[1]))
        (x1, g1), (x0, g0) = shifted
        column = [float((a - b) / (x1 - x0)) for a, b in zip(g1, g0, strict=True)]
        error = max(error, float(np.abs(hessian[:, k] - column).max()))
    size = float(np.abs(hessian).max())
    yield _small_error("derivatives", "second derivatives against differences", error / size, 1e-8)

    directions = generator.normal(size=(state.size, 3))
    products = np.empty_like(directions)
    module.hessian_products(state, own, parameters, directions, products)
    error = float(np.abs(products - hessian @ directions).max() / np.abs(products).max())
    yield _small_error("derivatives", "products with the second derivatives", error, 1e-12)


def _exact(model: PairwiseModel) -> Callable[[Array, Array], tuple[mpmath.mpf, list[mpmath.mpf]]]:
    """Return a function of (states, constants) for H and its flat gradient, from the author's terms in 50 digits."""
    parameters = {p: sympy.Rational(v) for p, v in zip(model.parameters, model.defaults, strict=True)}
    first, second = model.first, model.second

    single, both = [*first.moving, *first.own], [*first.moving, *first.own, *second.moving, *second.own]
    of_one, of_two = (  # a term and its derivatives
        sympy.lambdify(symbols, [e.subs(parameters) for e in (term, *(sympy.diff(term, z) for z in moving))], "mpmath")
        for symbols, term, moving in (
            (single, model.self_term, first.moving),
            (both, model.pair_term, (*first.moving, *second.moving)),
        )
    )

    def exact(state: Array, own: Array) -> tuple[mpmath.mpf, list[mpmath.mpf]]:
        count, size = state.shape[1], state.shape[2]
        with mpmath.workdps(DIGITS):
            values = [[mpmath.mpf(float(v)) for v in (*state[0, i], *state[1, i], *own[i])] for i in range(count)]
            total, gradient = mpmath.mpf(0), np.full(state.shape, mpmath.mpf(0), dtype=object)

            for i in range(count):
                energy, *slopes = of_one(*values[i])
                total += energy
                gradient[:, i] += np.array(slopes, dtype=object).reshape(2, size)
                for j in range(i):
                    energy, *slopes = of_two(*values[i], *values[j])
                    total += energy
                    gradient[:, [i, j]] += np.array(slopes, dtype=object).reshape(2, 2, size).swapaxes(0, 1)
            return total, list(gradient.ravel())

    return exact


def _symplectic(model: PairwiseModel, module: ModuleType, state: Array, scheme: str) -> Iterator[Finding]:
    """Check D' J D = J for the derivative D of one step. Schemes that are not symplectic must violate it."""
    if module.problem.gradient is None:
        return
    (own, parameters), pairs = _data(model, _PARTICLES), module.problem.pairs
    points, after = np.zeros((module.POINTS, *state.shape)), np.empty_like(state)
    for h in _LENGTHS:
        if advance(pairs, state, h, own, parameters, points, 0.0, after) >= 0:
            break
    else:
        detail = f"no step could be made, down to a length of {_LENGTHS[-1]:g}"
        yield Finding("symplecticity", "one step", False, detail)
        return
    curvature = curvature_at(module.problem, points, own, parameters)
    derivative = np.empty((state.size, state.size))
    advance_directions(pairs, curvature, points, 0, h, own, parameters, np.eye(state.size), derivative)
    half = state.size // 2
    form = np.block([[np.zeros((half, half)), np.eye(half)], [-np.eye(half), np.zeros((half, half))]])
    size = np.abs(derivative).T @ np.abs(form) @ np.abs(derivative)  # coordinates and momenta have different units
    difference = np.abs(derivative.T @ form @ derivative - form)
    error = float(np.max(difference / np.where(size > 0.0, size, 1.0)))
    promised = PARTICLE_SCHEMES[scheme].symplectic
    claim = f"the scheme is {'' if promised else 'not '}symplectic"
    detail = f"|D' J D - J| / |D|' |J| |D| = {error:.1e} for a step of {h:g}; {claim}"
    yield Finding("symplecticity", "one step", error < 1e-11 if promised else error > 1e-11, detail)


_POINTS = 24
_CLOSE = tuple(10.0**-k for k in (1, 2, 4, 8, 12, 16, 30, 100, 150))
"""Distances of two points. One point is at the origin, so that the distances are exact."""
_RIM = tuple(10.0**-k for k in (1, 2, 4, 6, 8))  # distances from the boundary of the unit ball, relative to its radius


def _kernel_findings(model: PairwiseModel, module: ModuleType) -> Iterator[Finding]:
    """Yield findings about the kernel G, if the pair term of the Hamiltonian is p_i . p_j G(q_i, q_j)."""
    # The pair term is p_i . p_j G without momenta in G, and G has a limit where points meet.
    entries = [[sympy.diff(model.pair_term, p, r) for r in model.second.p] for p in model.first.p]
    kernel, size = entries[0][0], len(entries)
    moving = {*model.first.p, *model.second.p, *model.first.own, *model.second.own}
    if model.limit is None or kernel == 0 or kernel.free_symbols & moving or not hasattr(module, "momentum_matrix"):
        return
    if not all(identically_zero(entries[a][b] - (kernel if a == b else 0)) for a in range(size) for b in range(size)):
        return

    def is_inside(position: Array) -> bool:
        values = dict(zip(model.parameters, model.defaults, strict=True))
        values |= dict(zip(model.first.q, map(sympy.Float, position.tolist()), strict=True))
        return all(bool(expression.subs(values) > 0) for expression in model.domain)

    def matrix_at(positions: Array) -> Array:
        state, matrix = np.stack([positions, np.zeros_like(positions)]), np.empty((len(positions), len(positions)))
        module.momentum_matrix(state, *_data(model, len(positions)), matrix)
        return matrix

    axis, base = np.eye(size)[0], np.zeros(size)
    if not (is_inside(base) and is_inside(0.999 * axis)):
        return  # the domain must contain the unit ball, in which the positions are drawn

    # Points in the whole unit ball, some of them crowded, and some near its boundary.
    generator = np.random.default_rng(4)
    directions = generator.normal(size=(_POINTS, size))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    radii = np.concatenate([np.linspace(0.05, 0.9, _POINTS - 4), [0.99, 0.999, 0.301, 0.302]])
    positions = radii[:, None] * directions
    positions[-1] = positions[-2] * 1.001
    matrix = matrix_at(positions)
    scale = np.sqrt(np.diag(matrix))
    least = float(np.linalg.eigvalsh(matrix / np.outer(scale, scale))[0])
    symmetric = bool((matrix == matrix.T).all())
    # A negative eigenvalue as small as rounding errors is no failure: smooth kernels of many points have such ones.
    passed = symmetric and least > -_POINTS * float(np.finfo(float).eps)
    detail = f"least eigenvalue {least:.1e} of {_POINTS} points, with ones in the diagonal"
    yield Finding("kernel", "positive definite", passed, detail if symmetric else "the matrix is not symmetric")

    cases = {
        "the kernel where two points nearly meet, against 50 digits": [
            np.stack([base, distance * axis]) for distance in _CLOSE
        ]
    }
    if not is_inside(1.000001 * axis):
        other = np.full(size, 0.1)
        rim = [np.stack([(1.0 - far) * axis, other]) for far in _RIM]
        rim += [np.stack([(1.0 - far) * axis, (1.0 - 2.0 * far) * axis]) for far in _RIM]
        cases["the kernel near the boundary, against 50 digits"] = rim
    values = {p: sympy.Rational(v) for p, v in zip(model.parameters, model.defaults, strict=True)}
    exact = sympy.lambdify([*model.first.q, *model.second.q], kernel.subs(values), "mpmath")
    for subject, pairs in cases.items():
        worst = 0.0
        with mpmath.workdps(DIGITS):
            for pair in pairs:
                expected = exact(*(mpmath.mpf(float(x)) for x in pair.ravel()))
                emitted = mpmath.mpf(float(matrix_at(pair)[0, 1]))
                worst = max(worst, abs(float((emitted - expected) / expected)))
        yield _small_error("kernel", subject, worst, 1e-12)

    worst = 0.0  # the kernel of two points that meet is the kernel of a point with itself
    for share in (0.0, 0.5, 0.9):
        position = np.full(size, share / np.sqrt(size))
        matrix = matrix_at(np.stack([position, position]))
        worst = max(worst, float(np.abs(matrix - matrix[0, 0]).max() / matrix[0, 0]))
    yield _small_error("kernel", "the limit where points meet", worst, 1e-14)


def tracer_findings(model: PairwiseModel, module: ModuleType, states: list[Array]) -> Iterator[Finding]:
    """Yield findings about tracer points, if the problem has any; `states` are arrays (2, particles, n) of q and p."""
    if not model.passive:
        return
    own, parameters = _data(model, states[0].shape[1])
    generator = np.random.default_rng(2)
    errors, slope_errors, size, block = [], [], len(model.coordinates), int(module.BLOCK)
    # The velocity of a tracer point and its gradient, row by row, from the author's pair term in 50 digits.
    rest = dict.fromkeys(model.first.p, sympy.S.Zero)
    rest |= {p: sympy.Rational(v) for p, v in zip(model.parameters, model.defaults, strict=True)}
    terms = [sympy.diff(model.pair_term, p) for p in model.first.p]
    expected = [*terms, *(sympy.diff(term, q) for term in terms for q in model.first.q)]
    arguments = [*model.first.q, *model.second.moving, *model.second.own]
    function = sympy.lambdify(arguments, [e.subs(rest) for e in expected], "mpmath")
    for state in states:
        positions = np.abs(state[0]).max() * generator.uniform(-0.7, 0.7, (size, block))
        positions[:, 0] = state[0, 0] + 1e-9  # where digits are lost most easily
        rates, gradients, alone = np.empty(size * block), np.empty(size * size * block), np.empty(size * block)
        module.tracer_gradient(positions.ravel(), state, own, parameters, rates, gradients)
        module.tracer_velocity(positions.ravel(), state, own, parameters, alone)
        for m in range(min(3, block)):
            with mpmath.workdps(DIGITS):
                totals = [mpmath.mpf(0)] * len(expected)
                for j in range(state.shape[1]):
                    numbers = [mpmath.mpf(float(v)) for v in (*positions[:, m], *state[0, j], *state[1, j], *own[j])]
                    totals = [total + value for total, value in zip(totals, function(*numbers), strict=True)]
            velocity, gradient = totals[:size], totals[size:]
            for emitted in (rates, alone):
                errors.append(_error(emitted.reshape(size, block)[:, m], velocity))
            slope_errors.append(_error(gradients.reshape(size * size, block)[:, m], gradient))
    yield _small_error("derivatives", "velocity of tracer points against 50 digits", max(errors), 1e-12)
    yield _small_error("derivatives", "its derivative by position against 50 digits", max(slope_errors), 1e-12)

    # A tracer point on a particle moves like the particle.
    state, error = states[0], 0.0
    forces, rates = np.empty(state.shape), np.empty(size * block)
    module.hamiltonian_gradient(state, own, parameters, forces)
    for i in range(state.shape[1]):
        module.tracer_velocity(np.repeat(state[0, i], block), state, own, parameters, rates)
        error = max(error, float(np.abs(rates.reshape(size, block)[:, 0] - forces[1, i]).max()))
    error /= float(np.abs(forces[1]).max())
    yield _small_error("consistency", "tracer points on particles", error, 1e-12)

    # Carry points through a step and its inverse. The product of both derivatives is the unit matrix.
    h, stages = 0.02, np.zeros((module.POINTS, *state.shape))
    if advance(module.problem.pairs, state, h, own, parameters, stages, 0.0, np.empty_like(state)) < 0:
        yield Finding("consistency", "the way back", False, "the step could not be made")
        return
    points = np.abs(state[0]).max() * generator.uniform(-0.7, 0.7, (block, size))
    ahead, back, tangents, inverse = (np.empty((block, *[size] * k)) for k in (1, 1, 2, 2))
    tracers = module.problem.tracers
    carry_points(tracers, points, h, 0.0, 1.0, stages, own, parameters, ahead, tangents)
    carry_points(tracers, ahead, h, 1.0, 0.0, stages, own, parameters, back, inverse)
    yield _small_error("consistency", "tracer points carried there and back", float(np.abs(back - points).max()), 1e-13)
    error = float(np.abs(inverse @ tangents - np.eye(size)).max())
    yield _small_error("consistency", "the derivatives of both", error, 1e-12)
