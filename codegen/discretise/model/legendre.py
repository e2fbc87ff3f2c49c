"""The continuous Legendre transform between the Lagrangian and the Hamiltonian form of a model.

With p = dL/dv and H(q, p, t) = p.v - L(q, v, t) the transform is an involution: v = dH/dp and L = p.v - H. One routine
therefore serves both directions. Source: Marsden and West, Discrete mechanics and variational integrators (2001),
section 1.4.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import sympy
from sympy.functions.elementary.trigonometric import TrigonometricFunction
from sympy.simplify.fu import TR8

from codegen.discretise.model.definitions import Boundary, Model, prescribed
from codegen.errors import BoundaryError, DegenerateError, SizeError, SymbolError
from codegen.symbolic import checks as expressions
from codegen.symbolic.derivatives import gradient, partials
from codegen.symbolic.zeros import identically_zero

_ADJUGATE_LIMIT = 3
"""Greatest matrix size for which adjugate over determinant is shorter than the nested fractions of an elimination."""
_SIMPLIFY_LIMIT = 150
"""Greatest number of operations for simplifications by sympy, which are slow."""
_TRIGSIMP_LIMIT = 40
"""Greatest number of operations for `trigsimp`; above it only TR8 is used, which writes products as sums of cosines."""
_WRITTEN_LIMIT = 100_000
"""Greatest number of operations of an inverse matrix that is written out."""


def hamiltonian_form(model: Model) -> Model:
    """Return the model with H(q, p, t) in place of L(q, v, t); force, cost and boundary are rewritten in (q, p, u, t).

    The momenta have the names `p_<coordinate>`. A model without Lagrangian is returned unchanged. Raises SymbolError
    when such a name is taken, DegenerateError when p = dL/dv has no unique solution, and BoundaryError when a
    prescribed velocity at an end does not determine its momentum.
    """
    return _transformed(model, "hamiltonian") if model.form == "lagrangian" else model


def lagrangian_form(model: Model) -> Model:
    """Return the model with L(q, v, t) in place of H(q, p, t); force, cost and boundary are rewritten in (q, v, u, t).

    The velocities have the names `d<coordinate>`. A Lagrangian model is returned unchanged. Raises SymbolError when
    such a name is taken, DegenerateError when v = dH/dp has no unique solution, and BoundaryError when a prescribed
    momentum at an end does not determine its velocity.
    """
    return model if model.form == "lagrangian" else _transformed(model, "lagrangian")


def in_phase_space(model: Model) -> Model:
    """Return a Lagrangian model with momenta as rates and boundary values, but without the Hamiltonian.

    This part of the Hamiltonian form does not need the solution of p = dL/dv for v. Raises SymbolError and
    BoundaryError like `hamiltonian_form`.
    """
    conjugates, slopes = conjugate_symbols(model), gradient(model.function, model.rates)
    return replace(
        model,
        form="hamiltonian",
        rates=conjugates,
        function=sympy.S.Zero,
        start=_boundary(model, "start", model.start, sympy.S.Zero, slopes, conjugates),
        end=model.end and _boundary(model, "end", model.end, model.duration, slopes, conjugates),
    )


def momentum_of_velocity(model: Model) -> tuple[sympy.Expr, ...]:
    """Return p(q, v, t), one expression for each coordinate: dL/dv, or v = dH/dp solved for p.

    Symbols are those of the model and, for a Hamiltonian, velocities `d<coordinate>`. Raises errors as the transforms.
    """
    if model.form == "lagrangian":
        return gradient(model.function, model.rates)
    return _dual(model, conjugate_symbols(model))[1]


def velocity_of_momentum(model: Model) -> tuple[sympy.Expr, ...]:
    """Return v(q, p, t), one expression for each coordinate: dH/dp, or p = dL/dv solved for v.

    Symbols are those of the model and, for a Lagrangian, momenta `p_<coordinate>`. Raises errors as the transforms.
    """
    if model.form == "hamiltonian":
        return gradient(model.function, model.rates)
    return _dual(model, conjugate_symbols(model))[1]


def conjugate_symbols(model: Model) -> tuple[sympy.Symbol, ...]:
    """Return the symbols of the other form: momenta `p_<q>` of a Lagrangian, velocities `d<q>` of a Hamiltonian.

    Raises SymbolError when another symbol of the model has such a name.
    """
    prefix = "p_" if model.form == "lagrangian" else "d"
    return new_symbols(model, prefix, model.coordinates)


def new_symbols(model: Model, prefix: str, of: Sequence[sympy.Symbol]) -> tuple[sympy.Symbol, ...]:
    """Return a real symbol `<prefix><name>` for each symbol in `of`; raise SymbolError if the model has that name."""
    groups = (model.coordinates, model.rates, model.controls, model.parameters, (model.time,))
    taken = {symbol.name for group in groups for symbol in group}
    for symbol in of:
        if prefix + symbol.name in taken:
            raise SymbolError(
                f"{prefix}{symbol} is declared, but the name is needed for the partner of {symbol}",
                "give the declared symbol another name",
            )
    return tuple(sympy.Symbol(prefix + symbol.name, real=True) for symbol in of)


def solve_blocks(matrix: sympy.Matrix, right: Sequence[sympy.Expr]) -> tuple[sympy.Expr, ...]:
    """Return the solution of a regular square symbolic system, solved for one connected block at a time.

    A block is a set of unknowns that nonzero entries couple. A diagonal matrix therefore costs one division for each
    unknown. Entries are simplified first, because a zero that is not recognised joins two blocks. Raises
    DegenerateError, with the first row, if a block is singular, and SizeError if a block is too large.
    """
    if _inverse_operations(matrix) > _WRITTEN_LIMIT:
        # Long entries that are identically zero may separate the blocks.
        sparse = matrix.applyfunc(lambda entry: sympy.S.Zero if identically_zero(entry) else entry)
        for block in sparse.connected_components():
            rows = sorted(block)
            operations = _inverse_operations(sparse.extract(rows, rows))
            if operations > _WRITTEN_LIMIT:
                quantities = ", ".join(sorted(map(str, sparse.free_symbols)))
                raise SizeError(
                    f"the inverse of a matrix that couples {len(rows)} coordinates would have about {operations:.0e} "
                    f"operations in {quantities}",
                    "use --method variational, which needs no inverse, or coordinates that the kinetic energy couples "
                    "less",
                )
    matrix = matrix.applyfunc(_simplified_entry)
    solution = [sympy.S.Zero] * len(right)
    for block in matrix.connected_components():
        rows = sorted(block)
        part = matrix.extract(rows, rows)
        values = sympy.Matrix([right[row] for row in rows])
        if len(rows) <= _ADJUGATE_LIMIT:
            determinant = _simplified_entry(part.det(method="berkowitz"))
            if identically_zero(determinant):
                raise DegenerateError(f"a linear system is singular in row {rows[0] + 1}", "check that it is regular")
            unknowns = part.adjugate() * values / determinant
        else:
            unknowns = part.LUsolve(values, iszerofunc=identically_zero)
        for row, value in zip(rows, unknowns, strict=True):
            solution[row] = value
    return tuple(solution)


def _inverse_operations(matrix: sympy.Matrix) -> float:
    """Return the estimated number of operations of an inverse: each row of an elimination quadruples the terms."""
    if matrix.rows <= _ADJUGATE_LIMIT:
        return 0.0
    return float(4**matrix.rows * sum(int(entry.count_ops()) for entry in matrix) / matrix.rows**2)


def _simplified_entry(entry: sympy.Expr) -> sympy.Expr:
    """Return the shortest of an entry, its expansion, and a trigonometric simplification, which exposes zeros."""
    if not entry.args or entry.count_ops() > _SIMPLIFY_LIMIT:
        return entry
    expanded = sympy.expand(entry)
    candidates = [entry, expanded]
    if expanded.has(TrigonometricFunction) and expanded.count_ops() < _SIMPLIFY_LIMIT:
        candidates.append(sympy.trigsimp(expanded) if expanded.count_ops() < _TRIGSIMP_LIMIT else TR8(expanded))
    return min(candidates, key=lambda candidate: candidate.count_ops())


def _transformed(model: Model, form: str) -> Model:
    conjugates = conjugate_symbols(model)
    function, old_rates = _dual(model, conjugates)
    substitution = dict(zip(model.rates, old_rates, strict=True))
    slopes = gradient(model.function, model.rates)
    return replace(
        model,
        form=form,
        rates=conjugates,
        function=function,
        force=tuple(component.xreplace(substitution) for component in model.force),
        cost=None if model.cost is None else model.cost.xreplace(substitution),
        start=_boundary(model, "start", model.start, sympy.S.Zero, slopes, conjugates),
        end=model.end and _boundary(model, "end", model.end, model.duration, slopes, conjugates),
    )


def _dual(model: Model, conjugates: Sequence[sympy.Symbol]) -> tuple[sympy.Expr, tuple[sympy.Expr, ...]]:
    """Return y.x - f(x) and x(y): f is the function of the model, x are its rates, y = df/dx the `conjugates`."""
    function, rates = model.function, model.rates
    hessian = _hessian(function, rates)
    null = expressions.null_direction(expressions.values_at(hessian, point) for point in _trial_points(model))
    if null is not None:
        names = " ".join(str(y) for y, weight in zip(conjugates, null, strict=True) if abs(weight) > 1e-6)
        raise DegenerateError(
            f"{names} does not determine {' '.join(map(str, rates))}: the Legendre transform is degenerate",
            "make the kinetic energy depend on every velocity (or momentum) quadratically",
        )
    if hessian.has(*rates):
        hessian = hessian.applyfunc(sympy.expand)
    if hessian.has(*rates):
        return _nonlinear_dual(model, conjugates)
    at_rest = dict.fromkeys(rates, sympy.S.Zero)
    shifted = tuple(y - slope.xreplace(at_rest) for y, slope in zip(conjugates, gradient(function, rates), strict=True))
    solved = solve_blocks(hessian, shifted)
    # f = x.Mx/2 + b.x - V gives y.x - f = (y - b).M^-1 (y - b)/2 + V, without the products that would cancel.
    half = sympy.Add(*(s * x for s, x in zip(shifted, solved, strict=True))) / 2
    return sympy.expand_mul(half, deep=False) - function.xreplace(at_rest), solved


def _hessian(function: sympy.Expr, symbols: Sequence[sympy.Symbol]) -> sympy.Matrix:
    places, entries = {symbol: i for i, symbol in enumerate(symbols)}, dict[tuple[int, int], sympy.Expr]()
    for symbol, slope in partials(function, symbols).items():
        i = places[symbol]
        for other, value in partials(slope, symbols[i:]).items():
            entries[i, places[other]] = entries[places[other], i] = value
    return sympy.Matrix(len(symbols), len(symbols), lambda i, j: entries.get((int(i), int(j)), sympy.S.Zero))


def _trial_points(model: Model) -> Iterator[dict[sympy.Symbol, float]]:
    return expressions.sample_points([*model.coordinates, *model.rates, model.time], model.default_values, {})


def _nonlinear_dual(model: Model, conjugates: Sequence[sympy.Symbol]) -> tuple[sympy.Expr, tuple[sympy.Expr, ...]]:
    function, rates = model.function, model.rates
    slopes = gradient(function, rates)
    try:
        candidates = sympy.solve(
            [slope - y for slope, y in zip(slopes, conjugates, strict=True)], list(rates), dict=True
        )
    except NotImplementedError:
        candidates = []
    inverses = [
        tuple(candidate[x] for x in rates)
        for candidate in candidates
        if set(candidate) == set(rates) and _inverts(model, candidate, slopes, conjugates)
    ]
    if len(inverses) != 1:
        names = " ".join(map(str, conjugates))
        raise DegenerateError(
            f"{names} = {', '.join(map(str, slopes))} has {len(inverses) or 'no'} closed solutions for "
            f"{' '.join(map(str, rates))}",
            "write the problem in the other form",
        )
    solved = inverses[0]
    substitution = dict(zip(rates, solved, strict=True))
    dual = sum((x * y for x, y in zip(solved, conjugates, strict=True)), sympy.S.Zero) - function.xreplace(substitution)
    return (sympy.simplify(dual) if dual.count_ops() < _SIMPLIFY_LIMIT else dual), solved


def _inverts(
    model: Model,
    candidate: dict[sympy.Symbol, sympy.Expr],
    slopes: Sequence[sympy.Expr],
    conjugates: Sequence[sympy.Symbol],
) -> bool:
    """Return True if a candidate x(y) gives back x at trial points; sympy may return spurious branches."""
    tried = False
    for point in _trial_points(model):
        image = [expressions.number_at(slope, point) for slope in slopes]
        if None in image:
            continue  # outside the domain of the function, such as above the speed of light
        tried = True
        inverse_point = point | dict(zip(conjugates, image, strict=True))
        for x in model.rates:
            value = expressions.number_at(candidate[x], inverse_point)
            if value is None or abs(value - point[x]) > 1e-6 * (1.0 + abs(point[x])):
                return False
    return tried


def _boundary(
    model: Model,
    where: str,
    boundary: Boundary,
    instant: sympy.Expr,
    slopes: Sequence[sympy.Expr],
    conjugates: Sequence[sympy.Symbol],
) -> Boundary:
    """Return the boundary at `instant` with prescribed rates replaced by conjugates; free rates remain free."""
    fixed = {**prescribed(model, where), model.time: instant}
    rates: list[sympy.Expr | None] = []
    for rate, slope, y, value in zip(model.rates, slopes, conjugates, boundary.rates, strict=True):
        if value is None:
            rates.append(None)
            continue
        determined = slope.xreplace(fixed)
        unknown = sorted(determined.free_symbols & {*model.coordinates, *model.rates}, key=str)
        if unknown:
            raise BoundaryError(
                f"{where} fixes {rate} but leaves {' '.join(map(str, unknown))} free, so it does not determine {y}",
                "fix these too, or use the variational method",
            )
        rates.append(determined)
    return Boundary(boundary.positions, tuple(rates))
