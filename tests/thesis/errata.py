"""Errata of the thesis, each with a proof: the defect of the corrected statement vanishes, the other does not.

The proofs are computations with sympy and numpy. Both statements pass through the same function, so that a proof that
shows nothing fails. Statements are functions, signs or numbers, transcribed from the thesis.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import mpmath
import numpy as np
import sympy
from sympy import Expr, Matrix, Rational, cos, log, sin

from thesis.entries import (
    REGISTRATION,
    Agreement,
    Entry,
    Kind,
    Row,
    Runs,
    Vector,
    collected,
    euler_warp,
    green,
    hamiltonian,
    trilobites,
)

ERRATA: list[Entry] = []
erratum = collected(Kind.ERRATUM, ERRATA, Agreement.CORRECTED)
ROUNDING = 1e-9
"""The largest defect that counts as a rounding error."""


@dataclass(frozen=True)
class Proof:
    """A measure of how wrong a statement is, with the printed statement and the corrected one."""

    defect: Callable[[Any], float]
    printed: Any
    corrected: Any
    expected_status: int = 0

    def __call__(self, run: Runs) -> Iterator[Row]:
        """Run the commands, and yield the defects of both statements; that of the printed one must be large."""
        for number in range(len(run.entry.commands)):
            status = run(number).status
            yield Row("exit status of the command", status, "", self.expected_status, self.expected_status)
        yield Row("defect of the corrected statement", abs(self.defect(self.corrected)), high=ROUNDING)
        yield Row("defect of the printed statement", abs(self.defect(self.printed)), low=1e3 * ROUNDING)


h, q, p, alpha = sympy.symbols("h q p alpha", real=True)
POINT = {q: Rational(3, 5), p: Rational(7, 10), alpha: Rational(3, 10)}
Field = tuple[Expr, Expr]


def size(expressions: Sequence[Expr]) -> float:
    """Return the largest value at the point (q, p, alpha) = (0.6, 0.7, 0.3), or 0 for expressions that vanish."""
    return max(abs(float(sympy.simplify(each).subs(POINT))) for each in expressions)


# ---- Chapter 2 ----


def modified_field(position: Callable[[Expr, Expr], Field]) -> list[Field]:
    """Return f, f2, f3 of (2.5.1) from the arguments (v, a) of a method q1 = q + h v, p1 = p - h sin(a).

    With the Taylor coefficients d_j of the map, f2 = d2 - f'f/2 and f3 = d3 - (f'f2 + f2'f)/2 - (f'f)'f/6.
    """
    one = (q, p)
    for _ in range(3):  # each pass determines one more power of h
        v, a = position(*one)
        after = q + h * v, p - h * sin(a)
        one = tuple(sympy.series(new, h, 0, 4).removeO().expand() for new in after)
    d = [Matrix([new.coeff(h, k) for new in one]) for k in range(4)]

    def along(field: Matrix, direction: Matrix) -> Matrix:
        return field.jacobian([q, p]) * direction

    f = d[1]
    f2 = d[2] - along(f, f) / 2
    f3 = d[3] - (along(f, f2) + along(f2, f)) / 2 - along(along(f, f), f) / 6
    return [tuple(sympy.simplify(field)) for field in (f, f2, f3)]


def family(one_q: Expr, one_p: Expr) -> Field:
    """Return the arguments of the methods (2.5.2) with the parameter alpha."""
    return alpha * p + (1 - alpha) * one_p, (1 - alpha) * q + alpha * one_q


def _f3(factor: Expr) -> Expr:
    found = modified_field(family)[2]
    claimed = factor[0] * p * cos(q), factor[0] * factor[1]
    return size([a - b for a, b in zip(found, claimed, strict=True)])


erratum(
    "f3", "Example 2.5.1, f3",
    "Printed: $f_3 = \\alpha(\\alpha - 1/6)(p\\cos q, -\\sin q\\cos q + p^2\\sin q/2)$. "
    "Correct: the factor is $(6\\alpha^2 - 6\\alpha + 1)/6$. Equation (2.5.5) agrees with the correct factor.",
    "codegen analyse problems/pendulum.py --scheme alpha --order 2",
    remark="The proof expands the map of the family in powers of h, without the package.",
)(Proof(_f3, *(
    (factor, -sin(q) * cos(q) + p**2 * sin(q) / 2)
    for factor in (alpha * (alpha - Rational(1, 6)), (6 * alpha**2 - 6 * alpha + 1) / 6)
)))  # fmt: skip


def _midpoint_energy(second: Expr) -> float:
    f3 = [each.subs(alpha, Rational(1, 2)) for each in modified_field(family)[2]]
    return size([sympy.diff(second, p) - f3[0], -sympy.diff(second, q) - f3[1]])


erratum(
    "midpoint-energy", "Equation (2.5.6)",
    "Printed: $\\tilde H = p^2/2 - \\cos q - h^2(2p^2 - \\cos 2q)/48$. Correct: $2p^2\\cos q$ in place of $2p^2$.",
    "codegen analyse problems/pendulum.py --scheme midpoint --order 2",
)(Proof(_midpoint_energy, *(-(2 * p**2 * own - cos(2 * q)) / 48 for own in (1, cos(q)))))  # fmt: skip


def _legendre(sign: int) -> float:
    after, step = sympy.symbols("q1 h", positive=True)
    discrete = step * ((after - q) / step) ** 2 / 2  # a free particle of mass 1
    return size([(sign * sympy.diff(discrete, q) - (after - q) / step).subs({after: 1, step: Rational(1, 10)})])


erratum(
    "legendre-sign", "Section 2.4",
    "Printed: $p_k = -D_1 L_d = \\partial L_d/\\partial q_k$. Correct: $p_k = -\\partial L_d/\\partial q_k$. "
    "The momentum of a free particle is its mass times its velocity.",
    "codegen check problems/pendulum.py --set form=lagrangian",
)(Proof(_legendre, 1, -1))  # fmt: skip


def _symplecticity(is_transposed: bool) -> float:
    generator = np.random.default_rng(1)
    mixed, hpp, hqq = generator.normal(size=(3, 2, 2))
    hpp, hqq, one, zero, step = hpp + hpp.T, hqq + hqq.T, np.eye(2), np.zeros((2, 2)), 0.1
    left = np.block([[one, -step * hpp], [zero, one + step * mixed]])
    right = np.block([[one + step * (mixed.T if is_transposed else mixed), zero], [-step * hqq, one]])
    map_, J = np.linalg.solve(left, right), np.block([[zero, one], [-one, zero]])
    return float(np.abs(map_.T @ J @ map_ - J).max())


erratum(
    "transposed-block", "Example 2.4.1",
    "Printed: the block $I + hH_{qp}$ twice. Correct: its transpose, $I + hH_{qp}^T$, on the right. "
    "One degree of freedom hides the difference.",
    remark="Random second derivatives of a Hamiltonian with two degrees of freedom.",
)(Proof(_symplecticity, False, True))  # fmt: skip

# ---- Chapter 3 and appendix A ----


def _free_modes(averages: Callable[[int], Vector]) -> float:
    matrix = averages(20)
    return float(matrix.shape[1] - np.linalg.matrix_rank(matrix))


def averages_of_nodes(steps: int) -> Vector:
    """Return the matrix (N, N + 1) that maps controls on nodes to averages on intervals."""
    return 0.5 * (np.eye(steps, steps + 1) + np.eye(steps, steps + 1, 1))


erratum(
    "nodal-controls", "Sections 3.2, 3.3 and A.1",
    "Printed: controls on nodes, averaged on intervals. An alternating control has zero averages and costs nothing. "
    "Correct: one control on each interval. The defect is the number of directions of controls without effect. "
    "The check fails, as it should, and names the mode.",
    "codegen check problems/orbital_transfer.py --controls nodal",
    remark="`figure-3.7` and `figure-A.4` measure the consequences.",
)(Proof(_free_modes, averages_of_nodes, np.eye, 1))  # fmt: skip


def _inertia(sign: int) -> float:
    k = np.arange(3)
    return float(np.diff((0.5 * (0.1 * k) ** 2), 2)[0] / 0.1**2 + sign * 0.25 * (1 + 2 + 1))


erratum(
    "hovercraft-sign", "Section A.1, discrete Euler-Lagrange equations",
    "Printed: $M(q_{k+1} - 2q_k + q_{k-1})/h^2 + (f_{k-1} + 2f_k + f_{k+1})/4 = 0$. Correct: minus the force. "
    "The proof is a unit mass under a unit force, $q = t^2/2$.",
    remark="The listings have the right sign.",
)(Proof(_inertia, 1, -1))  # fmt: skip


def _rotated_length(sign: int) -> float:
    f1, f2 = sympy.symbols("f1 f2", real=True)
    rotated = cos(q) * f1 - sin(q) * f2, sin(q) * f1 + sign * cos(q) * f2
    return size([(rotated[0] ** 2 + rotated[1] ** 2 - f1**2 - f2**2).subs({f1: 2, f2: 3})])


erratum(
    "hovercraft-force", "Listings A.2.5 and A.2.9",
    "Coded: the force along y is $\\sin\\theta f_1 - \\cos\\theta f_2$. Correct, and in the text: "
    "$\\sin\\theta f_1 + \\cos\\theta f_2$. A rotation keeps the length of the force.",
)(Proof(_rotated_length, -1, 1))  # fmt: skip


def _angle(root: Callable[[float], float]) -> float:
    corners = 2.0 * np.exp(2j * np.pi * np.arange(5) / 5) / (2 * np.sin(np.pi / 5))  # sides of length R = 2
    first, second = corners[1] - corners[0], corners[-1] - corners[0]
    d = (first * second.conjugate()).real
    return float(np.arccos(d / (root(abs(first) ** 2) * root(abs(second) ** 2))) - np.pi * 3 / 5)


erratum(
    "hovercraft-angles", "Listing A.2.5, interior angles",
    "Coded: acos(d/(n1 n2)) with squared lengths n1, n2. Correct: with lengths. Sides of R = 1 hide the difference; "
    "the proof takes R = 2.",
)(Proof(_angle, lambda n: n, np.sqrt))  # fmt: skip


def _redundancy(is_minimal: bool) -> float:
    craft = 5
    places = sympy.symbols(f"x:{craft} y:{craft}", real=True)
    xy = [Matrix([places[i], places[craft + i]]) for i in range(craft)]
    sides = [(xy[i] - xy[(i + 1) % craft]).dot(xy[i] - xy[(i + 1) % craft]) - 1 for i in range(craft)]
    centre = [sum(point[a] for point in xy) / craft - 2 for a in range(2)]
    radii = [(xy[i] - Matrix([2, 2])).dot(xy[i] - Matrix([2, 2])) for i in range(craft - 3)]
    angles = [(xy[i - 1] - xy[i]).dot(xy[(i + 1) % craft] - xy[i]) for i in range(craft)]
    conditions = Matrix([*sides, *centre, xy[0][1] - 2, *(radii if is_minimal else angles)])
    turn = np.pi + 2 * np.pi * np.arange(craft) / craft
    radius = 1 / (2 * np.sin(np.pi / craft))
    values = [*(2 + radius * np.cos(turn)), *(2 + radius * np.sin(turn))]
    jacobian = sympy.lambdify(places, conditions.jacobian(places))(*values)
    return float(len(conditions) - np.linalg.matrix_rank(jacobian))


erratum(
    "hovercraft-redundancy", "Section A.1, final configuration for H > 3",
    "Printed: sides, centre, height and all angles, 2 H + 3 conditions for 2 H coordinates. They are redundant. "
    "Correct: sides, centre, height and H - 3 radii. The defect is the number of conditions minus their rank, H = 5.",
    "codegen solve problems/hovercraft.py --set craft=5 --set conditions=redundant",
)(Proof(_redundancy, False, True))  # fmt: skip

# ---- Chapter 4 ----

x, y, s = sympy.symbols("x y s", real=True)


def plate(place: tuple[Expr, Expr], source: tuple[Expr, Expr]) -> Expr:
    """Return G of (4.1.6)."""
    d = (place[0] - source[0]) ** 2 + (place[1] - source[1]) ** 2
    a2 = (
        (place[0] ** 2 + place[1] ** 2) * (source[0] ** 2 + source[1] ** 2)
        - 2 * (place[0] * source[0] + place[1] * source[1]) + 1
    ) / d  # fmt: skip
    return d * ((a2 - 1) / 2 - log(a2) / 2)


def laplacian(function: Expr) -> Expr:
    """Return the Laplacian by x and y."""
    return sympy.diff(function, x, 2) + sympy.diff(function, y, 2)


SOURCES = (Rational(3, 10), Rational(1, 5)), (Rational(-1, 2), Rational(1, 4))


def flux(function: Expr) -> float:
    """Return the flux of the gradient of the Laplacian through a circle around the first source."""
    curvature = laplacian(function)
    slopes = sympy.lambdify((x, y), [sympy.diff(curvature, each) for each in (x, y)], "numpy")
    angle, radius = 2 * np.pi * np.arange(64) / 64, 0.2
    normal = np.cos(angle), np.sin(angle)
    found = slopes(*(float(at) + radius * n for at, n in zip(SOURCES[0], normal, strict=True)))
    return float(np.mean(normal[0] * found[0] + normal[1] * found[1]) * 2 * np.pi * radius)


erratum(
    "green-constant", "Equations (4.1.4) and (4.1.6)",
    "Printed: $\\Delta^2 G = \\delta$ for G of (4.1.6). Correct: $\\Delta^2 G = 8\\pi\\delta$. The defect compares the "
    "flux of $\\nabla\\Delta G$ through a circle around the source with the printed and with the correct strength.",
    remark="All costs of the thesis and of this project are in units with this factor.",
)(Proof(lambda strength: flux(plate((x, y), SOURCES[0])) / strength - 1, 1.0, 8 * np.pi))  # fmt: skip


def _interpolation(strength: Callable[[Vector, Vector], float]) -> float:
    places = np.array(SOURCES, dtype=float)
    matrix, displacements = green(places[:, None], places[None]), np.array([0.1, -0.2])
    coefficients = np.linalg.solve(matrix, displacements)
    spline = sum(float(a) * plate((x, y), place) for a, place in zip(coefficients, SOURCES, strict=True))
    return flux(spline) / (8 * np.pi) - strength(coefficients, matrix @ coefficients - displacements)


erratum(
    "source-terms", "Equation (4.1.3a)",
    "Printed: $\\Delta^2 v = \\sum_i \\delta(q - q_i)(v(q) - v_i)$. Its right side vanishes for every interpolating v. "
    "Correct: $\\sum_i \\alpha_i\\delta(q - q_i)$ with the coefficients of (4.1.5). The defect is the strength at the "
    "first of two landmarks, from the flux of $\\nabla\\Delta v$, minus that of the right side.",
    remark="Strengths are in units of the factor $8\\pi$ of erratum `green-constant`.",
)(Proof(_interpolation, lambda a, misfit: misfit[0], lambda a, misfit: a[0]))  # fmt: skip

NEAR = np.array([1.0 - 1e-7, 0.0]), np.array([-0.5, 0.3])
"""A point near the unit circle, and another one."""


def _near_circle(value: Callable[[Vector, Vector], float]) -> float:
    with mpmath.workdps(60):
        a, b = ([mpmath.mpf(float(each)) for each in point] for point in NEAR)
        s = sum((i - j) ** 2 for i, j in zip(a, b, strict=True))
        ab = mpmath.fprod(1 - sum(i * i for i in point) for point in (a, b))
        return float(value(*NEAR) / (ab / 2 - s / 2 * mpmath.log1p(ab / s)) - 1)


def coded_green(a: Vector, b: Vector) -> float:
    """Return G as E.2.5 computes it, with A formed explicitly."""
    s = ((a - b) ** 2).sum()
    root = np.sqrt(a @ a * (b @ b) - 2 * (a @ b) + 1) / np.sqrt(s)
    return float(0.5 * (a @ a - 1) * (b @ b - 1) - s * np.log(root))


erratum(
    "green-cancellation", "Listings E.2.5 and E.2.6",
    "Coded: A is formed, then its logarithm. G is a difference of nearly equal numbers near the unit circle. Correct: "
    "$G = ab/2 - s\\log(1 + ab/s)/2$. The defect is the relative error of G at a distance of 1e-7 from the circle.",
    remark="The absolute error is small, because G vanishes on the circle. Near-coincident points lose no digits, "
    "as the claim `green` shows.",
)(Proof(_near_circle, coded_green, lambda a, b: float(green(a, b))))  # fmt: skip

# ---- Chapter 5 and appendix E ----


def _landmarks_of_the_warp(is_delayed: bool) -> float:
    import codegen

    result = codegen.solve(REGISTRATION, scheme="explicit-euler", steps=10)
    q, p = (each.reshape(11, -1, 2) for each in (result.q, result.p))
    start, target = trilobites()
    return float(np.abs(euler_warp(q, p, start, is_delayed) - target).max())


erratum(
    "warp-indices", "Listing E.5.8",
    "Coded: the step k of the image pairs $q_{k+1}$ with $p_k$. Correct: $q_k$ with $p_k$, as the landmarks themselves "
    "move. The defect is the largest distance of a warped landmark of the trilobites from its target.",
    "codegen solve problems/image_registration.py --scheme explicit-euler --steps 10",
)(Proof(_landmarks_of_the_warp, False, True))  # fmt: skip

DECLARED = ("z", "image", "N", "nc", "fmt", "outfile")
"""The arguments of GISwarp in E.5.8."""

erratum(
    "warp-arguments", "Listing E.5.5",
    "Coded: GISwarp(image, N, z, fmt, file). Correct: GISwarp(z, image, N, nc, fmt, file). The defect is the number of "
    "arguments at a wrong position.",
    remark="A comparison with the arguments that E.5.8 declares.",
)(Proof(
    lambda call: sum(own != call[i] for i, own in enumerate(DECLARED) if i < len(call)) + len(DECLARED) - len(call),
    ("image", "N", "z", "fmt", "outfile"), DECLARED,
))  # fmt: skip

READS_OPTIONS = {"fmin": "options", "fsol": "options"}
"""The variables that the branches of E.3.9 pass to fminsearch and fsolve."""

erratum(
    "missing-options", "Listing E.3.9",
    "Coded: `options` is defined in the branch of fsolve only, and fminsearch reads it. Correct: a definition in both "
    "branches. The defect is the number of branches that read an undefined variable.",
)(Proof(
    lambda defined: sum(name not in defined[branch] for branch, name in READS_OPTIONS.items()),
    {"fmin": (), "fsol": ("options",)}, {"fmin": ("options",), "fsol": ("options",)},
))  # fmt: skip


def coded_deviation(miss: Vector) -> float:
    """Return what eEstep (E.3.2) gives to fminsearch."""
    return float((miss**2).sum())


erratum(
    "fmin-square", "Sections 4.2 and 5.1",
    "Printed: fminsearch minimises the norm of the deviation. Correct: the square of the norm, as E.3.2 computes it. "
    "The minimum is the same, but a tolerance on the square is weaker.",
)(Proof(
    lambda statement: statement(np.array([0.3, 0.4])) - coded_deviation(np.array([0.3, 0.4])),
    np.linalg.norm, lambda miss: np.linalg.norm(miss) ** 2,
))  # fmt: skip


def averaged_cost(q: Vector, p: Vector) -> float:
    """Return the cost of GISmidcost (E.4.2): 2 h sum H at averages of neighbouring nodes of q, p (N + 1, n, 2)."""
    middle = zip((q[1:] + q[:-1]) / 2, (p[1:] + p[:-1]) / 2, strict=True)
    return float(np.mean([2 * hamiltonian(*each) for each in middle]))


def _benchmark(cost: Callable[[Vector, Vector], float]) -> float:
    import codegen

    exact = codegen.solve(REGISTRATION, scheme="dop853", tolerance=1e-13)
    q, p = (each.reshape(exact.steps + 1, -1, 2) for each in (exact.q, exact.p))
    return cost(q, p) - float(exact.cost or np.nan)


erratum(
    "benchmark-cost", "Table 5.2 and Figure 5.17",
    "Printed: errors against a benchmark, whose cost E.5.3 computes by the midpoint rule on 11 nodes of ode113. That "
    "benchmark is itself wrong. Correct: H is constant, so that the cost is 2 H at any node. The defect is the error "
    "of the benchmark on the trilobites.",
    "codegen solve problems/image_registration.py --scheme dop853 --tolerance 1e-13",
    remark="`table-5.2` has errors against both benchmarks.",
)(Proof(_benchmark, averaged_cost, lambda q, p: 2 * hamiltonian(q[0], p[0])))  # fmt: skip
