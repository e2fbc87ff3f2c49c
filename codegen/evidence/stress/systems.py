"""The mechanics of the stress problems for a comparison with generated code, and the effects of schemes.

The equations of motion are those of `problems.field_of`, in any floating type: scipy needs double precision, the
textbook equations extended precision. The kernel of landmarks is written by hand.

The textbook equations of a step are evaluated in extended precision on the states that a module returns, for H =
|p|^2/2 + V(q) with f = -V_q. No generated code takes part. Source of all forms: Hairer, Lubich and Wanner (2006),
Geometric numerical integration, I.1 and VI.3; variational schemes in their Hamiltonian form, Marsden and West (2001),
section 2.6.

The effect of a scheme on the oscillator q' = p, p' = -q follows from the coefficients of the scheme. A step of length x
multiplies (q, p) by a matrix. A symplectic step is stable while the trace of the matrix lies between -2 and 2. The step
then rotates points along an ellipse (Hairer, Lubich and Wanner 2006, I.5.2 and VIII.6).
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from types import ModuleType
from typing import Any, TypeAlias

import mpmath
import numpy as np
from scipy.linalg import solve_triangular

from codegen.discretise.schemes.base import Scheme
from codegen.evidence.stress.cases import Case
from codegen.evidence.stress.problems import defaults, field_of
from codegen.solving.loading import Vector
from codegen.solving.results.result import Result

# ---- Equilibria ----

Array: TypeAlias = Any
Number: TypeAlias = Any  # a float, or a number of mpmath
Parameters: TypeAlias = Mapping[str, Any]

_STIFF = 1e4
REST: dict[str, tuple[dict[str, float], tuple[float, ...]]] = {
    "oscillator": ({"omega": 1.0}, (0.0, 0.0)),
    "spring_pendulum": ({"k": _STIFF}, (0.0, -1.0 - 1.0 / _STIFF, 0.0, 0.0)),
    "fput": ({"omega": 50.0}, (0.0,) * 12),
}
"""Parameters and equilibrium states (q, p), about which the stability of a scheme is measured, by problem."""


def frequency(problem: str, values: Parameters) -> float:
    """Return the largest frequency of small motions about the equilibrium."""
    return math.sqrt(values["k"]) if problem == "spring_pendulum" else float(values["omega"])


def plate_gradient(q: Array, p: Array) -> tuple[Array, Array]:
    """Return H_q and H_p of H = 1/2 sum_ij p_i . p_j G(q_i, q_j), G being the Green's function of the clamped plate.

    With a = 1 - |x|^2, b = 1 - |y|^2, s = |x - y|^2, w = a b/s: dG = b/2 w/(1 + w) da + (w/(1 + w) - log(1 + w))/2 ds.
    """
    margin = 1.0 - (q**2).sum(axis=1)
    by_position, by_momentum = np.zeros_like(q), np.zeros_like(q)
    for i in range(len(q)):
        by_momentum[i] += p[i] * margin[i] ** 2 / 2.0
        by_position[i] += -(p[i] @ p[i]) * margin[i] * q[i]
        for j in range(len(q)):
            if j == i:
                continue
            difference = q[i] - q[j]
            s = difference @ difference
            w = margin[i] * margin[j] / s
            green = margin[i] * margin[j] / 2.0 - s / 2.0 * np.log1p(w)
            by_momentum[i] += p[j] * green
            slope = margin[j] / 2.0 * w / (1.0 + w) * (-2.0 * q[i])
            slope = slope + (w / (1.0 + w) - np.log1p(w)) * difference
            by_position[i] += (p[i] @ p[j]) * slope
    return by_position, by_momentum


# ---- The textbook's equations of a step ----

Field = Callable[[Array], Array]

TEXTBOOK: dict[str, tuple[float, float]] = {
    "explicit-euler": (0.0, 0.0),
    "implicit-euler": (1.0, 1.0),
    "symplectic-euler": (0.0, 1.0),
    "symplectic-euler-adjoint": (1.0, 0.0),
    "rectangle": (0.0, 1.0),
    "midpoint": (0.5, 0.5),
    "stormer-verlet": (math.nan, math.nan),
    "trapezoidal": (math.nan, math.nan),
}
"""The numbers a and b of each scheme, whose field is evaluated at ((1-a) q0 + a q1, (1-b) p0 + b p1).

NaN stands for half a step of the momentum, a step of the position, and half a step of the momentum.
"""


def textbook_residuals(
    scheme: str, f: Field, h: np.longdouble, q: Array, p: Array, q1: Array, p1: Array
) -> tuple[Array, Array]:
    """Return the residuals (position, momentum) of the textbook equations of a step from (q, p) to (q1, p1)."""
    a, b = TEXTBOOK[scheme]
    if math.isnan(a):
        half = p + h / 2 * f(q)
        return q1 - q - h * half, p1 - half - h / 2 * f(q1)
    return q1 - q - h * ((1.0 - b) * p + b * p1), p1 - p - h * f((1.0 - a) * q + a * q1)


COUNT = 200  # the number of first steps whose textbook equations are evaluated


def textbook_errors(module: ModuleType, case: Case, result: Result) -> float:
    """Return the largest residual of the textbook equations over the first steps, in units of rounding errors.

    The rounding error of a step is estimated in double precision from the magnitudes of its terms. These are the
    states, h p, h f, and h times the change of f by the rounding of positions.
    """
    if result.steps != len(result.t) - 1:
        raise ValueError("the textbook's equations need every step")
    problem = case.setup.problem
    parameters = {**defaults(problem), **dict(case.values)}
    values = {name: np.longdouble(parameters[name]) for name in defaults(problem)}
    h = np.longdouble(module.make_grid(result.steps).h)
    q, p = (np.asarray(a[: COUNT + 1], dtype=np.longdouble) for a in (result.q, result.p))

    def field(positions: Array) -> Array:
        return field_of(problem)(values, np.concatenate([positions, 0 * positions]))[len(positions) :]

    worst, eps, tiny = 0.0, np.finfo(float).eps, np.finfo(float).tiny  # below tiny, numbers have fewer digits
    signs = (-1.0) ** np.arange(q.shape[1])  # neighbours are perturbed in opposite directions
    for k in range(len(q) - 1):
        ends = q[k], q[k + 1]
        position, momentum = (max(np.abs(a[k : k + 2]).max(), tiny) for a in (q, p))
        force = max(np.abs(field(end)).max() for end in ends)
        displacement = h * momentum
        offset = np.longdouble(1e-8) * (position + displacement) * signs
        change = max(np.abs(field(end + offset) - field(end)).max() * 1e8 for end in ends)
        impulse = h * (force + change)
        sizes = position + displacement + h * impulse, momentum + impulse
        errors = textbook_residuals(result.scheme, field, h, q[k], p[k], q[k + 1], p[k + 1])
        for error, size in zip(errors, sizes, strict=True):
            worst = max(worst, float(np.abs(error).max() / (eps * size)))
    return worst


# ---- Measured stability ----

LEAST, MOST = 0.02, 1e4  # the range of h omega in which the stability limit is searched
POINTS = 1500
"""The number of values of h omega in this range; the first unstable window of some compositions is 2 % wide."""
GROWTH = 1e-4
"""A motion grows if the spectral radius exceeds one by more than this; explicit Euler exceeds one by (h omega)^2/2."""

_limits: dict[tuple[str, str], float] = {}
"""Measured stability limits, by the inputs of a module and the label of its scheme."""


def stable_limit(module: ModuleType, case: Case) -> float:
    """Return the largest h omega at which no small motion about the equilibrium grows, 0 if all grow, infinity if none.

    Source of the criterion: Hairer, Lubich and Wanner (2006), Geometric numerical integration, VIII.6 and I.5.2.
    """
    key = (module.metadata.inputs, case.setup.label)
    if key not in _limits:
        _limits[key] = first_growth(lambda x: spectral_radius(module, case.setup.problem, x) <= 1.0 + GROWTH)
    return _limits[key]


def first_growth(is_stable: Callable[[float], bool]) -> float:
    """Return the h omega at which motions begin to grow, by trial and bisection; longer steps may be stable again."""
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


def spectral_radius(module: ModuleType, problem: str, h_omega: float) -> float:
    """Return the spectral radius of the Jacobian of a step at the equilibrium, by central differences."""
    values, state = REST[problem]
    grid = module.make_grid(1, duration=h_omega / frequency(problem, values), **values)
    change = 1e-6
    rest = np.array(state)
    steps = [[module.step(grid, rest + sign * offset) for sign in (1.0, -1.0)] for offset in change * np.eye(rest.size)]
    matrix = np.array([(forward - backward) / (2.0 * change) for forward, backward in steps]).T
    return float(np.abs(np.linalg.eigvals(matrix)).max()) if np.isfinite(matrix).all() else math.inf


# ---- Stability, angles and energies from the tables of schemes ----

DIGITS = 30
Rows: TypeAlias = Sequence[Sequence[Number]]
Entries: TypeAlias = tuple[Number, Number, Number, Number]


def step_matrix(scheme: Scheme, x: Number) -> Entries:
    """Return a, b, c, d of q1 = a q + b p, p1 = c q + d p, in the arithmetic of the step x: float or mpmath."""
    if scheme.variational:
        # With Ld = (a q0^2 + 2 b q0 q1 + d q1^2)/2, stationary in inner values, p0 = -a q0 - b q1 and p1 = b q0 + d q1.
        points = _quadrature(scheme, x.__class__)
        every = range(len(points[0][1]))
        form = [[sum(w * (u[i] * u[j] / x - x * v[i] * v[j]) for w, v, u in points) for j in every] for i in every]
        last = every[-1]
        ends, inner = (0, last), every[1:-1]
        block = [[form[i][j] for j in inner] for i in inner]
        solutions = {j: _solved(block, [form[i][j] for i in inner]) for j in ends}
        a, b, d = (
            form[i][j] - sum(form[i][k] * value for k, value in zip(inner, solutions[j], strict=True))
            for i, j in ((0, 0), (0, last), (last, last))
        )
        return -a / b, -1 / b, b - a * d / b, -d / b
    columns: list[tuple[Number, Number]] = []
    if scheme.is_chain:  # the product of the matrices of the substeps, of fields at ((1-a) q + a q', (1-b) p + b p')
        for q, p in ((1, 0), (0, 1)):
            for g, a, b in _substeps(scheme, x.__class__):
                q, p = q + g * x * (1 - b) * p, p - g * x * (1 - a) * q  # right-hand sides of the equations
                scale = 1 + (g * x) ** 2 * a * b
                q, p = (q + g * x * b * p) / scale, (p - g * x * a * q) / scale
            columns.append((q, p))
    else:  # the stages satisfy Q = q + x A P and P = p - x B Q
        a, b, (weights,) = _tableau(scheme, x.__class__)
        count = range(len(weights))
        matrix = [[(i == j) + x**2 * sum(b[i][k] * a[k][j] for k in count) for j in count] for i in count]
        for q, p in ((1, 0), (0, 1)):
            momenta = _solved(matrix, [p - x * sum(row) * q for row in b])
            positions = [q + x * _product(row, momenta) for row in a]
            columns.append((q + x * _product(weights, momenta), p - x * _product(weights, positions)))
    return columns[0][0], columns[1][0], columns[0][1], columns[1][1]


def _numbers(rows: Rows, number: type[Number]) -> list[list[Number]]:
    return [[number(str(entry.evalf(DIGITS))) for entry in row] for row in rows]


@cache
def _substeps(scheme: Scheme, number: type[Number]) -> list[list[Number]]:
    return _numbers(scheme.step().substeps, number)


@cache
def _tableau(scheme: Scheme, number: type[Number]) -> tuple[Rows, Rows, Rows]:
    """Return the coefficients of a scheme as a Runge-Kutta method, for coordinates and momenta, and its weights."""
    table = scheme.step().tableau
    return _numbers(table.positions, number), _numbers(table.momenta, number), _numbers([table.weights], number)


@cache
def _quadrature(scheme: Scheme, number: type[Number]) -> list[tuple[Number, list[Number], list[Number]]]:
    """Return the weight of each point, and there the values and slopes of the Lagrange polynomials of the nodes."""
    rule = scheme.discrete_lagrangian()
    (nodes,) = _numbers([rule.nodes], number)
    points = []
    for weight, c in _numbers([(point.weight, point.abscissa) for point in rule.points], number):
        values, slopes = [], []
        for i, node in enumerate(nodes):
            value, slope = 1, 0
            for other in (*nodes[:i], *nodes[i + 1 :]):
                factor, rate = (c - other) / (node - other), 1 / (node - other)
                value, slope = value * factor, slope * factor + value * rate
            values.append(value)
            slopes.append(slope)
        points.append((weight, values, slopes))
    return points


def _product(row: Sequence[Number], column: Sequence[Number]) -> Number:
    return sum(a * b for a, b in zip(row, column, strict=True))


def _solved(matrix: Rows, right: Sequence[Number]) -> list[Number]:
    """Return the solution of a small linear system by elimination with row pivots, in the arithmetic of the numbers."""
    rows = [[*row, value] for row, value in zip(matrix, right, strict=True)]
    for k in range(len(rows)):
        pivot = max(range(k, len(rows)), key=lambda i: abs(rows[i][k]))
        rows[k], rows[pivot] = rows[pivot], rows[k]
        for i, row in enumerate(rows):
            if i != k:
                factor = row[k] / rows[k][k]
                rows[i] = [entry - factor * other for entry, other in zip(row, rows[k], strict=True)]
    return [row[-1] / row[k] for k, row in enumerate(rows)]


def stability_function(scheme: Scheme, z: complex) -> complex:
    """Return R(z) = 1 + z b (1 - z A)^-1 e, the factor of a step of length z of y' = y, for a Runge-Kutta method."""
    a, b = table_of(scheme)
    ones = np.ones(len(b))
    return complex(1.0 + z * np.dot(b, np.linalg.solve(np.eye(len(b)) - z * np.array(a), ones)))


def table_of(scheme: Scheme) -> tuple[Rows, Sequence[Number]]:
    """Return the coefficients a_ij for coordinates and the weights of a scheme, as floats."""
    a, _, (b,) = _tableau(scheme, float)
    return a, b


def is_runge_kutta(scheme: Scheme) -> bool:
    """Return True if coordinates and momenta have the same table, so that the scheme has a stability function."""
    return not scheme.variational and scheme.step().tableau.positions == scheme.step().tableau.momenta


@cache
def limit_along(scheme: Scheme, direction: complex) -> float:
    """Return the largest |h lambda| up to which no motion exp(lambda t) grows by steps h though it should not.

    `direction` is lambda/|lambda|. Schemes with different tables for coordinates and momenta are tried on the
    oscillator, whatever the direction.
    """
    if not is_runge_kutta(scheme):
        return limit(scheme)

    def is_stable(x: float) -> bool:
        return (
            abs(stability_function(scheme, x * direction))
            <= max(1.0, math.exp(min(x * direction.real, 700.0))) + GROWTH
        )

    return first_growth(is_stable)


def growth(scheme: Scheme, x: float) -> float:
    """Return the spectral radius of the step matrix."""
    a, b, c, d = step_matrix(scheme, float(x))
    root = cmath.sqrt(((a - d) / 2) ** 2 + b * c)
    return float(max(abs((a + d) / 2 + root), abs((a + d) / 2 - root)))


@cache
def limit(scheme: Scheme) -> float:
    """Return the largest step up to which no motion grows: 0 if motions grow at every step, infinity if at none."""
    return first_growth(lambda x: growth(scheme, x) <= 1.0 + GROWTH)


def area(scheme: Scheme, x: float) -> float:
    """Return the determinant of the step matrix: the factor of areas, and of the energy over many steps."""
    with mpmath.workdps(DIGITS):
        a, b, c, d = step_matrix(scheme, mpmath.mpf(x))
        return float(a * d - b * c)


def preserves_areas(scheme: Scheme) -> bool:
    """Return True if steps of the oscillator preserve areas: symplectic schemes, and symmetric ones with |R(iy)| = 1.

    Lobatto IIIA with three stages is not symplectic, but has the stability function of Gauss with two stages. Source:
    Hairer and Wanner (1996), Solving ordinary differential equations II, IV.5.
    """
    return scheme.symplectic or all(abs(area(scheme, x) - 1.0) < 1e-12 for x in (0.3, 1.1, 7.0))


def turn(scheme: Scheme, x: float) -> tuple[float, float]:
    """Return theta and s of q_k = cos(k theta) + s sin(k theta), the motion from rest at q = 1 if areas are preserved.

    Theta is arccos(trace/2); s is 0 if the scheme is symmetric. Both are NaN beyond the stability limit.
    """
    with mpmath.workdps(DIGITS):
        a, _, _, d = step_matrix(scheme, mpmath.mpf(x))
        if not abs(a + d) < 2:
            return math.nan, math.nan
        theta = mpmath.acos((a + d) / 2)
        return float(theta), float((a - d) / 2 / mpmath.sin(theta))


def swing(scheme: Scheme, x: float) -> float:
    """Return the relative oscillation of the energy from rest at q = 1 by a stable scheme, else infinity.

    A step that preserves areas conserves c q^2 + (d - a) q p - b p^2, which equals c on the whole motion. On this
    ellipse q^2 + p^2 lies between c divided by the one and by the other eigenvalue of the quadratic form.
    """
    with mpmath.workdps(DIGITS):
        a, b, c, d = step_matrix(scheme, mpmath.mpf(x))
        mean, root = (c - b) / 2, mpmath.sqrt(((c + b) / 2) ** 2 + ((d - a) / 2) ** 2)
        if not abs(root) < abs(mean):
            return math.inf
        return float(max(abs(c / (mean + root) - 1), abs(c / (mean - root) - 1)))


# ---- Stiff motions that decay ----


def followed(scheme: Scheme, rate: float, steps: int, start: float) -> Vector:
    """Return y at all nodes of Prothero and Robinson's problem on [0, 1], from the table of a scheme."""
    a, b = (np.array(each, dtype=float) for each in table_of(scheme))
    c, h, y = a.sum(axis=1), 1.0 / steps, [start]
    matrix = np.eye(len(b)) - h * rate * a
    solve = partial(solve_triangular, lower=True, check_finite=False) if not np.triu(a).any() else np.linalg.solve
    for k in range(steps):
        t = (k + c) * h
        with np.errstate(over="ignore", invalid="ignore"):  # explicit schemes beyond their limit
            slopes = solve(matrix, rate * (y[-1] - np.cos(t)) - np.sin(t))
            y.append(float(y[-1] + h * b @ slopes))
    return np.array(y)
