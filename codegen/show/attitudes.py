"""Equations of motion of bodies with rotations, written in attitudes R and angular velocities omega.

With mu = dL/domega, the moment m(f) of a function f(R), and the torque M, all in the frame of the body,

    d/dt mu + omega x mu - m(L) - M - sum of kappa m(c) = 0,    m(f)_k = sum_ij df/dR_ij (R hat(e_k))_ij.

The model has quaternions. Its expressions contain the entries of R and omega as an author wrote them, and symbols
replace these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import sympy
from sympy import Add, Expr, Matrix, S, Symbol

from codegen.discretise.conditions.holonomic import Constraints
from codegen.discretise.model.definitions import Model
from codegen.discretise.program import Names
from codegen.discretise.rotations import half_imaginary, in_body_rates
from codegen.problem.rotations import rotation_matrix, squared_length
from codegen.show.notation import Block
from codegen.symbolic.derivatives import gradient

Shorten = Callable[[Expr], Expr]
_AXES = "xyz"
_ABOUT = (
    "{R} is the rotation from the frame of the body to that of space, with the entries {R}_11 to {R}_33, and omega its "
    "angular velocity in the frame of the body. The coordinates of {R} are the unit quaternion {q}."
)
_BALANCE = (
    "d/dt μ + ω × μ - m(L) - M - κ m(c) = 0 in the frame of the body, with μ = ∂L/∂ω, the moments m = dR·∂/∂R and the "
    "torque M, written out; κ are the forces of constraints",
    r"$\frac{d}{dt} \mu + \omega \times \mu - m(L) - M - \kappa m(c) = 0$ in the frame of the body, with $\mu = "
    r"\partial L/\partial \omega$, moments $m$ and the torque $M$, written out; $\kappa$ are the forces of constraints",
)
MIDPOINT = (
    "The discrete Lagrangian is h L in the middle of the step, of the quaternion (qₖ + qₖ₊₁)/2 and its velocity "
    "(qₖ₊₁ - qₖ)/h. So Rₖ₊₁ = Rₖ τ(h ω) with |h ω| = 4 tan(angle/4), the square of Cayley's map of h ω/2.",
    r"The discrete Lagrangian is $h L$ in the middle of the step, of the quaternion $(q_k + q_{k+1})/2$ and its "
    r"velocity $(q_{k+1} - q_k)/h$. So $R_{k+1} = R_k \tau(h \omega)$ with $|h \omega| = 4 \tan(\mathrm{angle}/4)$, "
    r"the square of Cayley's map of $h \omega/2$.",
)
OTHER = (
    "The discrete Lagrangian is the quadrature of L by the scheme, with the velocity (qₖ₊₁ - qₖ)/h of the quaternion.",
    r"The discrete Lagrangian is the quadrature of $L$ by the scheme, with the velocity $(q_{k+1} - q_k)/h$ of the "
    "quaternion.",
)
OF_OPTIMA = (
    "Unknowns are the quaternions, with the discrete Euler-Lagrange equations "
    "D₂ Ld(qₖ₋₁, qₖ) + D₁ Ld(qₖ, qₖ₊₁) + f⁺ₖ₋₁ + f⁻ₖ + h Gᵀκ = 0. There L has a further multiple of (q · dq)², which "
    "vanishes along every motion and makes the momenta of the quaternion regular.",
    r"Unknowns are the quaternions, with the discrete Euler-Lagrange equations $D_2 L_d(q_{k-1}, q_k) + "
    r"D_1 L_d(q_k, q_{k+1}) + f^+_{k-1} + f^-_k + h G^T \kappa = 0$. There $L$ has a further multiple of "
    r"$(q \cdot dq)^2$, which vanishes along every motion and makes the momenta of the quaternion regular.",
)


@dataclass(frozen=True)
class _Body:
    """The attitude of a body: its name, quaternion, and the symbols of R (3, 3) and omega (3,)."""

    name: str
    quaternion: tuple[Symbol, ...]
    matrix: Matrix
    omega: Matrix


class Attitudes:
    """The attitudes of a Lagrangian model with rotations, and its expressions in terms of them."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.bodies = list[_Body]()
        for name, quaternion in zip(model.attitudes, model.rotations, strict=True):
            ending = "" if len(model.rotations) == 1 else f"_{name}"
            matrix = Matrix(3, 3, lambda i, j, name=name: _real(f"{name}_{i + 1}{j + 1}"))
            omega = Matrix([_real(f"omega{ending}_{axis}") for axis in _AXES])
            self.bodies.append(_Body(name, quaternion, matrix, omega))
        turning = {q for body in self.bodies for q in body.quaternion}
        rates = dict(zip(model.coordinates, model.rates, strict=True))
        self.positions = {x: v for x, v in rates.items() if x not in turning}

    def written(self, expression: Expr) -> Expr:
        """Return an expression in the attitudes and angular velocities, as far as an author wrote it in them."""
        rates = {body.quaternion: tuple(body.omega) for body in self.bodies}
        expression = in_body_rates(self.model, expression, rates)
        for body in self.bodies:
            squares = squared_length(body.quaternion)
            entries = zip(rotation_matrix(body.quaternion), body.matrix, strict=True)
            numerators: dict[Expr, Expr] = {entry * squares: symbol * squares for entry, symbol in entries}
            expression = expression.xreplace(numerators).xreplace({squares: S.One})
        return expression

    def torque(self, body: _Body) -> Matrix:
        """Return the torque of the forces on a body, in its frame."""
        force = dict(zip(self.model.coordinates, self.model.force, strict=True))
        at_identity = dict(zip(body.quaternion, (S.One, S.Zero, S.Zero, S.Zero), strict=True))
        # In terms of R and omega, only the factor q of the force 2 q (0, M) has the quaternion.
        parts = [self.written(force[q]) for q in body.quaternion[1:]]
        return Matrix([part.xreplace(at_identity) / 2 for part in parts])

    def lagrangian(self) -> Block:
        """Return the Lagrangian, with the forces and torques."""
        rows = [(_real("L"), self.written(self.model.function))]
        force = dict(zip(self.model.coordinates, self.model.force, strict=True))
        rows += [(_real(f"f_{x}"), self.written(force[x])) for x in self.positions if force[x] != 0]
        for body in self.bodies:
            ending = "" if len(self.bodies) == 1 else f"_{body.name}"
            named = zip(_AXES, self.torque(body), strict=True)
            rows += [(_real(f"M{ending}_{axis}"), part) for axis, part in named if part != 0]
        abouts = [_ABOUT.format(R=body.name, q=", ".join(map(str, body.quaternion))) for body in self.bodies]
        heading = "Lagrangian" + (" and forces" if len(rows) > 1 else "")
        return Block(heading, tuple(rows), tuple((about, about.replace("_", r"\_")) for about in abouts))

    def balances(self, shorten: Shorten) -> Block:
        """Return the Euler-Lagrange equations of positions, and Euler's equations of attitudes."""
        model, function = self.model, self.written(self.model.function)
        force = dict(zip(model.coordinates, model.force, strict=True))
        lengths = [squared_length(body.quaternion) - 1 for body in self.bodies]
        kappa = [_real(unknown.name) for unknown in Constraints(model, Names(model)).kappa]
        holonomic = zip(kappa, model.holonomic, strict=False)
        pulls = [(k, self.written(c)) for k, c in holonomic if c not in lengths]
        slips = [(k, self.written(c)) for k, c in zip(kappa[len(model.holonomic) :], model.rolling, strict=True)]
        rows = list[tuple[Expr, Expr]]()
        for x, v in self.positions.items():
            normal = Add(*(k * sympy.diff(c, x) for k, c in pulls), *(k * sympy.diff(c, v) for k, c in slips))
            balance = self._rate(sympy.diff(function, v)) - sympy.diff(function, x) - self.written(force[x]) - normal
            rows.append((_real("0"), shorten(balance)))
        for body in self.bodies:
            mu = Matrix(gradient(function, tuple(body.omega)))
            balance = mu.applyfunc(self._rate) + body.omega.cross(mu) - _moment(function, body) - self.torque(body)
            for k, c in pulls:
                balance -= k * _moment(c, body)
            for k, c in slips:
                balance -= k * Matrix(gradient(c, tuple(body.omega)))
            rows += [(_real("0"), shorten(part)) for part in balance]
        return Block("Equations of motion", tuple(rows), (_BALANCE,))

    def _rate(self, function: Expr) -> Expr:
        """Return the time derivative of a function of positions, attitudes and their velocities."""
        terms = [sympy.diff(function, self.model.time)]
        for x, v in self.positions.items():
            terms += [sympy.diff(function, x) * v, sympy.diff(function, v) * _real(f"acceleration {x}")]
        for body in self.bodies:
            terms.append(_moment(function, body).dot(body.omega))
            terms += [sympy.diff(function, w) * _real(f"rate {w}") for w in body.omega]
        return Add(*terms)


def _moment(function: Expr, body: _Body) -> Matrix:
    """Return the derivative of a function along rotations of a body about its axes (3,)."""
    moments = list[Expr]()
    for k in range(3):
        turned = body.matrix * _hat(Matrix([int(i == k) for i in range(3)]))
        moments.append(Add(*(sympy.diff(function, r) * d for r, d in zip(body.matrix, turned, strict=True))))
    return Matrix(moments) + half_imaginary(body.quaternion, gradient(function, body.quaternion))


def _hat(v: Any) -> Matrix:
    return Matrix([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def _real(name: str) -> Symbol:
    return Symbol(name, real=True)


def in_attitudes(blocks: Iterable[Block], attitudes: Attitudes) -> Iterator[Block]:
    """Yield blocks whose expressions are written in attitudes and angular velocities."""
    for block in blocks:
        rows = tuple((left, attitudes.written(right)) for left, right in block.equations)
        yield Block(block.heading, rows, block.remarks)
