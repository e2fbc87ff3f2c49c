"""First and second derivatives of the terms of a pairwise Hamiltonian, by the chain rule through scalar invariants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from codegen.discretise.model.pairwise import PairwiseModel
from codegen.errors import ExpressionError
from codegen.symbolic.graph import Assignment
from codegen.symbolic.terms import Invariants, without_cancellation
from codegen.symbolic.zeros import identically_zero


@dataclass(frozen=True)
class TermDerivatives:
    """The self term or the pair term, and its derivatives with respect to positions and momenta of its particles.

    `moving` are the symbols of these positions and momenta. The term is a function of `scalars`, which are polynomials
    of moving symbols and of `differences` of two coordinates. `slopes` and `curvatures` assign its first and second
    derivatives with respect to the scalars to symbols. `gradient` (dense) and `hessian` (lower triangle, structural
    nonzeros) read these symbols. `distances` are the scalars that vanish where both particles meet.
    """

    moving: tuple[Symbol, ...]
    differences: tuple[Assignment, ...]
    scalars: tuple[Assignment, ...]
    distances: tuple[Symbol, ...]
    value: Expr
    slopes: tuple[Assignment, ...]
    curvatures: tuple[Assignment, ...]
    gradient: tuple[Expr, ...]
    hessian: tuple[tuple[int, int, Expr], ...]


@dataclass(frozen=True)
class PairDerivatives:
    """The derivatives of the self term, `alone`, and of the pair term, and properties of the whole Hamiltonian H.

    `separable`: no term mixes coordinates and momenta. `quadratic`: H(q, r p) = r^2 H(q, p), so that H is kinetic
    energy. `isotropic`: H_pp is the Kronecker product of a matrix (n, n) and the identity (d, d).
    """

    alone: TermDerivatives
    pair: TermDerivatives
    separable: bool
    quadratic: bool
    isotropic: bool


def pair_derivatives(model: PairwiseModel) -> PairDerivatives:
    """Return first and second derivatives of the self term and the pair term."""
    alone = _differentiated(model.self_term, model.first.moving, ())
    pair = _differentiated(model.pair_term, model.first.moving, model.second.moving)
    dimension = len(model.coordinates)
    mixed = [
        value
        for term in (alone, pair)
        for row, column, value in term.hessian
        if (row // dimension) % 2 != (column // dimension) % 2
    ]
    factor = Symbol("factor", positive=True)
    scaled = {p: factor * p for p in (*model.first.p, *model.second.p)}
    return PairDerivatives(
        alone=alone,
        pair=pair,
        separable=not mixed,
        quadratic=all(  # every term is homogeneous of degree two in the momenta
            sympy.expand(sympy.factor_terms(term.xreplace(scaled) - factor**2 * term)) == 0
            for term in (model.self_term, model.pair_term)
        ),
        isotropic=_is_isotropic(alone, dimension) and _is_isotropic(pair, dimension),
    )


def _differentiated(term: Expr, first: Sequence[Symbol], second: Sequence[Symbol]) -> TermDerivatives:
    """Return a term f(I_1, I_2, ...) of scalars I_k, its gradient f_k dI_k and Hessian f_kl dI_k dI_l + f_k d2I_k."""
    parts = Invariants.of(term, first, second)
    count, moving = len(parts.symbols), parts.moving
    slopes = [Symbol(f"by_{s}", real=True) for s in parts.symbols]
    curvatures: dict[tuple[int, int], Assignment] = {}
    for k in range(count):
        for m in range(k + 1):
            value = parts.curvature(k, m)
            if value != 0:
                curvatures[k, m] = Symbol(f"by_{parts.symbols[k]}_{parts.symbols[m]}", real=True), value
    differences = _Differences(first, second)
    polynomials = [differences.inserted(p) for p in parts.polynomials]
    gradients = [[differences.derivative(p, z) for z in moving] for p in polynomials]
    entries: list[tuple[int, int, Expr]] = []
    for row in range(len(moving)):
        for column in range(row + 1):
            value = sum(
                (f * differences.derivative(g[row], moving[column]) for f, g in zip(slopes, gradients, strict=True)),
                sympy.S.Zero,
            )
            for (k, m), (symbol, _) in curvatures.items():
                value += symbol * gradients[k][row] * gradients[m][column]
                if k != m:
                    value += symbol * gradients[m][row] * gradients[k][column]
            if value != 0:
                entries.append((row, column, value))
    return TermDerivatives(
        moving=moving,
        differences=tuple(differences.used),
        scalars=tuple(zip(parts.symbols, polynomials, strict=True)),
        distances=tuple(parts.symbols[k] for k in parts.distances()),
        value=without_cancellation(parts.outer),
        slopes=tuple((symbol, parts.slope(k)) for k, symbol in enumerate(slopes)),
        curvatures=tuple(curvatures.values()),
        gradient=tuple(
            sum((f * g[z] for f, g in zip(slopes, gradients, strict=True)), sympy.S.Zero) for z in range(len(moving))
        ),
        hessian=tuple(entries),
    )


class _Differences:
    """The symbols of coordinate differences of two particles; `used` lists the differences that polynomials need."""

    def __init__(self, first: Sequence[Symbol], second: Sequence[Symbol]) -> None:
        half = len(second) // 2
        self.pairs = {
            Symbol(f"d{x.name.removesuffix('_i')}", real=True): (x, y)
            for x, y in zip(first[:half], second, strict=False)
        }
        self.used: list[Assignment] = []

    def inserted(self, polynomial: Expr) -> Expr:
        """Return a polynomial rewritten in differences if it depends on them alone, else the same polynomial."""
        written = polynomial.xreplace({x: d + y for d, (x, y) in self.pairs.items()})
        expanded = sympy.expand(written)
        if expanded.free_symbols - self.pairs.keys() or not expanded.free_symbols:
            return polynomial
        for d, (x, y) in self.pairs.items():
            if d in expanded.free_symbols and (d, x - y) not in self.used:
                self.used.append((d, x - y))
        return expanded

    def derivative(self, expression: Expr, z: Symbol) -> Expr:
        """Return the total derivative with respect to a coordinate or momentum z, including the differences."""
        total = sympy.diff(expression, z)
        for d, (x, y) in self.pairs.items():
            if z in (x, y):
                total += sympy.diff(expression, d) * (1 if z == x else -1)
        return total


def _is_isotropic(term: TermDerivatives, dimension: int) -> bool:
    """Return True if second derivatives by momenta couple only equal axes of space, with one value on all axes."""
    blocks: dict[tuple[int, int], set[Expr]] = {}
    counts: dict[tuple[int, int], int] = {}
    for row, column, value in term.hessian:
        (one, a), (other, b) = divmod(row, dimension), divmod(column, dimension)
        if one % 2 == 0 or other % 2 == 0:
            continue
        if a != b:
            return False
        blocks.setdefault((one, other), set()).add(value)
        counts[one, other] = counts.get((one, other), 0) + 1
    return all(len(values) == 1 and counts[index] == dimension for index, values in blocks.items())


@dataclass(frozen=True)
class TracerDerivatives:
    """The contribution of particle j to the `velocity` (d,) of a tracer point i, and its `gradient` (d*d,).

    Entry a*d + b of the gradient is the derivative of velocity component a with respect to coordinate b. Both read the
    symbols that `assignments` define: differences, scalars, and derivatives of the pair term.
    """

    assignments: tuple[Assignment, ...]
    velocity: tuple[Expr, ...]
    gradient: tuple[Expr, ...]


def tracer_derivatives(model: PairwiseModel, derivatives: PairDerivatives) -> TracerDerivatives:
    """Return the velocity of a tracer point, a particle i without momentum: H_p of the pair term at p_i = 0.

    Raises ExpressionError if such a particle gains momentum, if it moves without the other particles, or if it leaves a
    particle that it lies on.
    """
    rest = dict.fromkeys(model.first.p, sympy.S.Zero)
    for name, term in (("pair_term", model.pair_term), ("self_term", model.self_term)):
        for q in model.first.q:
            if not identically_zero(sympy.diff(term, q).xreplace(rest)):
                raise ExpressionError(
                    f"the system has no tracer points: without momentum, {name} still changes with {q}",
                    "leave out passive=True, or write kinetic energies alone",
                )
    for p in model.first.p:
        if not identically_zero(sympy.diff(model.self_term, p).xreplace(rest)):
            raise ExpressionError(
                f"tracer points would move by themselves: self_term changes with {p} where momenta vanish",
                "leave out passive=True, or write a self_term of second degree in momenta",
            )
        if sympy.diff(model.pair_term, p).xreplace(rest).free_symbols & set(model.first.own):
            raise ExpressionError(
                f"a tracer point has no {', '.join(model.own)}, on which its velocity depends",
                "leave out passive=True, or own parameters",
            )
    if model.limit is None:
        raise ExpressionError(
            "the system has no tracer points: where one meets a particle, its velocity has no limit",
            "leave out passive=True, or write a pair_term that is continuous",
        )
    # A tracer point on a particle must move with it: by the limit of the pair term, at the velocity of self_term.
    alone = dict(zip((*model.second.p, *model.second.own), (*model.first.p, *model.first.own), strict=True))
    for p in model.first.p:
        met = sympy.diff(model.limit, p).xreplace(rest).xreplace(alone)
        if not identically_zero(met - sympy.diff(model.self_term, p)):
            raise ExpressionError(
                "a tracer point would leave the particle that it lies on: self_term is not half the limit of "
                "pair_term at coincidence",
                "leave out self_term, or passive=True",
            )
    pair, size = derivatives.pair, len(model.coordinates)
    numbers: dict[Symbol, Expr] = dict.fromkeys(model.first.p, sympy.S.Zero)
    assignments: list[Assignment] = []
    for symbol, value in (*pair.differences, *pair.scalars, *pair.slopes, *pair.curvatures):
        reduced = value.xreplace(numbers)
        if reduced.is_number:
            numbers[symbol] = reduced
        else:
            assignments.append((symbol, reduced))
    entries = {(row, column): value for row, column, value in pair.hessian}
    return TracerDerivatives(
        assignments=tuple(assignments),
        velocity=tuple(value.xreplace(numbers) for value in pair.gradient[size : 2 * size]),
        gradient=tuple(
            entries.get((size + a, b), sympy.S.Zero).xreplace(numbers) for a in range(size) for b in range(size)
        ),
    )
