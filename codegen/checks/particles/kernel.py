"""Evidence about kernels: H = 1/2 sum p_i . p_j G(q_i, q_j) with G positive definite, also where points nearly meet.

Points that nearly meet, and points near the boundary of the domain, are where digits are lost. There the emitted matrix
of G is compared with the author's expression in 50 digits, at distances down to 1e-150 from each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mpmath
import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr

from codegen.checks.base import Finding
from codegen.checks.particles.tracers import small_error
from codegen.expressions.zeros import identically_zero
from codegen.model.pairwise import PairwiseModel

DIGITS = 50
COUNT = 24
CLOSE = tuple(10.0**-k for k in (1, 2, 4, 8, 12, 16, 30, 100, 150))
"""Distances of two points of which one is at the origin, so that they are exact."""
RIM = tuple(10.0**-k for k in (1, 2, 4, 6, 8))
"""Distances from the boundary of the unit ball, as shares of its radius."""


def findings(model: PairwiseModel, module: Any) -> Iterator[Finding]:
    """All evidence about a module whose momenta meet in a kernel; none about others."""
    kernel = _kernel(model)
    if kernel is None or not hasattr(module, "momentum_matrix"):
        return
    size = len(model.coordinates)
    axis, base = np.eye(size)[0], np.zeros(size)
    if not (_is_inside(model, base) and _is_inside(model, 0.999 * axis)):
        return  # of another domain than space or a ball about the origin, no places are known
    yield _positive(model, module)
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


def _positive(model: PairwiseModel, module: Any) -> Finding:
    """Points all over the unit ball, some of them crowded, and some near its boundary."""
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
    return Finding("kernel", "positive definite", passed, detail if symmetric else "the matrix is not symmetric")


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
