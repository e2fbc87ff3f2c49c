"""The largest stable step: of a module at rest, and of a scheme on the oscillator q' = p, p' = -q from its table alone.

In the second no generated code takes part. A step of length x multiplies (q, p) by a matrix. A symplectic step is
stable while the trace of the matrix lies between -2 and 2 (Hairer, Lubich and Wanner 2006, I.5.2 and VIII.6), and turns
the points of an ellipse.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, TypeAlias

import mpmath
import numpy as np

from codegen.schemes import Scheme
from codegen.stress.cases import Case
from codegen.stress.systems import REST, frequency

LEAST, MOST = 0.02, 1e4
"""Steps times frequency between which the limit is looked for."""
POINTS = 1500
"""So many steps are tried between them; the first window of instability of some compositions is 2 % wide."""
GROWTH = 1e-4
"""A spectral radius above one by more than this is growth; explicit Euler's is (h omega)^2/2 above one."""

_known: dict[tuple[str, str], float] = {}


def stable_limit(module: Any, case: Case) -> float:
    """The largest h omega at which no small motion about rest grows: 0 if there is none, infinite if there is no limit.

    Source of the criterion: Hairer, Lubich and Wanner (2006), Geometric numerical integration, VIII.6 and I.5.2.
    """
    key = (module.metadata["inputs"], case.setup.label)
    if key not in _known:
        _known[key] = first_growth(lambda x: spectral_radius(module, case.setup.file.stem, x) <= 1.0 + GROWTH)
    return _known[key]


def first_growth(is_stable: Callable[[float], bool]) -> float:
    """The h omega where motions begin to grow, by trial and bisection; beyond it, other stable steps may follow."""
    if not is_stable(LEAST):
        return 0.0
    grid = np.geomspace(LEAST, MOST, POINTS)
    below = LEAST
    for above in grid[1:]:
        if not is_stable(above):
            for _ in range(40):
                middle = math.sqrt(below * above)
                below, above = (middle, above) if is_stable(middle) else (below, middle)
            return below
        below = above
    return math.inf


def spectral_radius(module: Any, problem: str, h_omega: float) -> float:
    """The largest modulus of an eigenvalue of the step's Jacobian at rest, by central differences."""
    values, rest = REST[problem]
    h = h_omega / frequency(problem, values)
    grid = module.make_grid(1, duration=h, **values)
    size = len(rest)
    change = 1e-6
    columns = []
    for i in range(size):
        offset = np.zeros(size)
        offset[i] = change
        forward, backward = (module.step(grid, np.array(rest) + sign * offset) for sign in (1.0, -1.0))
        columns.append((forward - backward) / (2.0 * change))
    matrix = np.array(columns).T
    return float(np.abs(np.linalg.eigvals(matrix)).max()) if np.isfinite(matrix).all() else math.inf


DIGITS = 30
Rows: TypeAlias = Sequence[Sequence[Any]]


def step_matrix(scheme: Scheme, x: Any) -> tuple[Any, Any, Any, Any]:
    """Entries a, b, c, d of q1 = a q + b p, p1 = c q + d p, in the arithmetic of x: a float, or a number of mpmath."""
    if scheme.variational:
        return _of_action(scheme, x)
    return _of_substeps(scheme, x) if scheme.is_chain else _of_stages(scheme, x)


def _of_substeps(scheme: Scheme, x: Any) -> tuple[Any, Any, Any, Any]:
    """The product of the substeps' matrices, each of a field at ((1-a) q + a q', (1-b) p + b p')."""
    columns = []
    for q, p in ((1, 0), (0, 1)):
        for g, a, b in _substeps(scheme, x.__class__):
            q, p = q + g * x * (1 - b) * p, p - g * x * (1 - a) * q  # the equations' right-hand sides
            scale = 1 + (g * x) ** 2 * a * b
            q, p = (q + g * x * b * p) / scale, (p - g * x * a * q) / scale
        columns.append((q, p))
    return columns[0][0], columns[1][0], columns[0][1], columns[1][1]


def _of_stages(scheme: Scheme, x: Any) -> tuple[Any, Any, Any, Any]:
    """The stages are Q = q + x A P and P = p - x B Q."""
    a, b, (weights,) = _tableau(scheme, x.__class__)
    count, columns = range(len(weights)), []
    left = [[(i == j) + x**2 * sum(b[i][k] * a[k][j] for k in count) for j in count] for i in count]
    for q, p in ((1, 0), (0, 1)):
        momenta = _solved(left, [p - x * sum(row) * q for row in b])
        places = [q + x * _product(row, momenta) for row in a]
        columns.append((q + x * _product(weights, momenta), p - x * _product(weights, places)))
    return columns[0][0], columns[1][0], columns[0][1], columns[1][1]


def _of_action(scheme: Scheme, x: Any) -> tuple[Any, Any, Any, Any]:
    """With Ld = (a q0^2 + 2 b q0 q1 + d q1^2)/2, stationary in inner values, p0 = -a q0 - b q1 and p1 = b q0 + d q1."""
    points = _quadrature(scheme, x.__class__)
    every = range(len(points[0][1]))
    form = [[sum(w * (u[i] * u[j] / x - x * v[i] * v[j]) for w, v, u in points) for j in every] for i in every]
    last = every[-1]
    ends, inner = (0, last), every[1:-1]
    block = [[form[i][j] for j in inner] for i in inner]
    moved = {j: _solved(block, [form[i][j] for i in inner]) for j in ends}
    a, b, d = (
        form[i][j] - sum(form[i][k] * value for k, value in zip(inner, moved[j], strict=True))
        for i, j in ((0, 0), (0, last), (last, last))
    )
    return -a / b, -1 / b, b - a * d / b, -d / b


def _numbers(rows: Rows, number: Any) -> list[list[Any]]:
    """Exact entries in floating-point numbers of a kind."""
    return [[number(str(entry.evalf(DIGITS))) for entry in row] for row in rows]


@cache
def _substeps(scheme: Scheme, number: Any) -> list[list[Any]]:
    return _numbers(scheme.step().substeps, number)


@cache
def _tableau(scheme: Scheme, number: Any) -> tuple[Any, Any, Any]:
    """The coefficients of a scheme as a Runge-Kutta method, for coordinates, for momenta, and the row of weights."""
    table = scheme.step().tableau
    return tuple(_numbers(rows, number) for rows in (table.positions, table.momenta, [table.weights]))  # type: ignore[return-value]


@cache
def _quadrature(scheme: Scheme, number: Any) -> list[tuple[Any, Any, Any]]:
    """By point its weight, and the Lagrange polynomials of the inner nodes and their slopes there."""
    rule = scheme.discrete_lagrangian()
    (nodes,) = _numbers([rule.nodes], number)
    pairs = _numbers([(point.weight, point.abscissa) for point in rule.points], number)
    return [(weight, *_polynomials(nodes, c)) for weight, c in pairs]


def _polynomials(nodes: Sequence[Any], c: Any) -> tuple[list[Any], list[Any]]:
    values, slopes = [], []
    for i, own in enumerate(nodes):
        factors = [((c - node) / (own - node), 1 / (own - node)) for k, node in enumerate(nodes) if k != i]
        value, slope = 1, 0
        for factor, rate in factors:
            value, slope = value * factor, slope * factor + value * rate
        values.append(value)
        slopes.append(slope)
    return values, slopes


def _product(row: Sequence[Any], column: Sequence[Any]) -> Any:
    return sum(a * b for a, b in zip(row, column, strict=True))


def _solved(matrix: Rows, right: Sequence[Any]) -> list[Any]:
    """Of a few linear equations, by elimination with row pivots in the numbers' own arithmetic."""
    rows = [[*row, value] for row, value in zip(matrix, right, strict=True)]
    for k in range(len(rows)):
        pivot = max(range(k, len(rows)), key=lambda i: abs(rows[i][k]))
        rows[k], rows[pivot] = rows[pivot], rows[k]
        for i, row in enumerate(rows):
            if i != k:
                factor = row[k] / rows[k][k]
                rows[i] = [entry - factor * other for entry, other in zip(row, rows[k], strict=True)]
    return [row[-1] / row[k] for k, row in enumerate(rows)]


def growth(scheme: Scheme, x: float) -> float:
    """The largest modulus of the matrix's eigenvalues."""
    a, b, c, d = step_matrix(scheme, float(x))
    root = cmath.sqrt(((a - d) / 2) ** 2 + b * c)
    return float(max(abs((a + d) / 2 + root), abs((a + d) / 2 - root)))


@cache
def limit(scheme: Scheme) -> float:
    """The largest step below which no motion grows: 0 if there is none, infinite if there is no limit."""
    return first_growth(lambda x: growth(scheme, x) <= 1.0 + GROWTH)


def turn(scheme: Scheme, x: float) -> tuple[float, float]:
    """Theta and s of a symplectic scheme below its limit, where q_k = cos(k theta) + s sin(k theta) from rest at q = 1.

    Theta is arccos(trace/2); s is 0 where the scheme is symmetric. NaN beyond the limit.
    """
    with mpmath.workdps(DIGITS):
        a, _, _, d = step_matrix(scheme, mpmath.mpf(x))
        if not abs(a + d) < 2:
            return math.nan, math.nan
        theta = mpmath.acos((a + d) / 2)
        return float(theta), float((a - d) / 2 / mpmath.sin(theta))


def swing(scheme: Scheme, x: float) -> float:
    """By how much of itself the energy swings from rest at q = 1, where a symplectic scheme is stable.

    The step keeps c q^2 + (d - a) q p - b p^2, which has c on the whole motion, and on whose ellipse q^2 + p^2 lies
    between c divided by either eigenvalue.
    """
    with mpmath.workdps(DIGITS):
        a, b, c, d = step_matrix(scheme, mpmath.mpf(x))
        mean, root = (c - b) / 2, mpmath.sqrt(((c + b) / 2) ** 2 + ((d - a) / 2) ** 2)
        if not abs(root) < abs(mean):
            return math.inf
        return float(max(abs(c / (mean + root) - 1), abs(c / (mean - root) - 1)))
