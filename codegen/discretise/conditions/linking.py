"""Unknowns that belong to no node: static parameters of the problem, and each body's coordinates that are coupled.

Segments of one motion that run side by side and meet: a quantity at the end is another one at the start.

The value w where two segments meet is a shared unknown: what begins there equals it, and for what ends there the end
gains zeta (x - w), where the multiplier zeta is shared as well. Each segment by itself is then an initial value problem
with a solution, also in what no control moves. A velocity is no unknown of a node: since all segments have the same
Lagrangian, equal velocities mean equal momenta, and the discrete momenta of both match a shared unknown pi, the last
one by a multiplier that is shared.

Which couplings between bodies follow from the others, found numerically where all of them hold.

A set of conditions may be redundant although no two of them are alike: of the sides, centre, height and interior angles
of a regular polygon with H corners, 2 H + 3 equations, only 2 H are independent. A solver needs the independent ones.

The Jacobian of all equations of a control problem on a few intervals, at a random point, for questions of rank.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr, Max, Min, S, Symbol

from codegen.discretise.conditions.periodic import Alias, Own, Periodic
from codegen.discretise.model.definitions import Condition, Model, prescribed
from codegen.discretise.model.guesses import at_end, at_start, momentum_guess
from codegen.discretise.model.values import values_at_guess
from codegen.discretise.program import Coupling, Names, Unknown, symbols
from codegen.errors import BoundaryError
from codegen.runtime.record import Kind, Meaning
from codegen.symbolic import checks as expressions
from codegen.symbolic.terms import Kind as TermKind
from codegen.symbolic.terms import sorted_terms

_DEPENDENT = 1e-7
"""Part of a gradient outside the span of earlier gradients, relative to its length, that counts as rounding."""
_NAMED = 1e-6
_HOLDS = 1e-8
"""Distance to the set where a coupling holds, relative to the size of the configuration, that counts as none."""
_EXACT = 1e-15
_ITERATIONS = 50

Array = NDArray[np.float64]
System = Callable[[Array], tuple[Array, Array]]
"""Residuals and their Jacobian at a configuration."""


@dataclass(frozen=True)
class IndependentCouplings:
    """Which couplings are to be `kept` (indices in `Model.couplings`), and why the others are not.

    `dropped` gives the index of each other coupling and the names of those that it follows from; no names where its
    gradient vanishes. When the couplings are not `consistent`, no configuration was found where all of them hold;
    `violated` then names the one that is farthest from holding, and dependence was judged at the configuration where
    they are nearest to it.
    """

    kept: tuple[int, ...]
    dropped: tuple[tuple[int, tuple[str, ...]], ...]
    consistent: bool = True
    violated: str = ""


@dataclass(frozen=True)
class _Equations:
    """Equations between end values: names, expressions of the unknowns, and values of the unknowns to start from.

    The first ones are the end conditions of each body by itself, the last ones the couplings.
    """

    names: tuple[str, ...]
    expressions: tuple[sympy.Expr, ...]
    unknowns: tuple[sympy.Symbol, ...]
    guess: Array


def independent_couplings(model: Model) -> IndependentCouplings:
    """Sort the couplings of a model into independent ones and ones that follow from those written before them.

    A coupling may also follow from equations that hold at the end of each body by itself; those are always kept.
    Judged to first order at the default parameters, at a configuration that lies near the guess and fulfils all
    equations, if there is one (Levenberg-Marquardt steps, from the guess and from points beside it).
    """
    if not model.couplings:
        return IndependentCouplings((), ())
    equations = _equations(model)
    system = _system(equations)
    tried = []
    for number, start in enumerate(_starts(equations.guess)):
        tried.append(_projected(system, start))
        # The guess may be special, such as bodies in one line, and so may the configuration that is found from it.
        if number > 0 and any(distance <= _HOLDS for _, distance in tried):
            break
    nearest, least = min(tried, key=lambda projection: projection[1])
    typical = np.linalg.norm(system(start)[1], axis=1)
    points = [point for point, distance in tried if distance <= _HOLDS] or [nearest]
    sorted_rows = [_sorted_rows(equations.names, _without_vanishing(system(point)[1], typical)) for point in points]
    kept, dropped = max(sorted_rows, key=lambda rows: len(rows[0]))
    first = len(equations.names) - len(model.couplings)
    found = IndependentCouplings(
        tuple(index - first for index in kept if index >= first),
        tuple((index - first, names) for index, names in dropped if index >= first),
    )
    if least <= _HOLDS:
        return found
    worst = int(np.argmax(np.abs(_scaled(*system(nearest))[0])))
    return replace(found, consistent=False, violated=equations.names[worst])


def _equations(model: Model) -> _Equations:
    own = {(value.body, value.coordinate): value.symbol for value in model.end_values}
    moving = (*model.coordinates, *model.rates)
    fixed = prescribed(model, "end")
    equations, guess = [], dict[sympy.Symbol, float]()
    conditions = [condition for condition in model.end_conditions if condition.equality]
    present = {symbol for condition in conditions for symbol in condition.expression.free_symbols}
    values = _values_at_end(model)
    for body in range(model.bodies):
        values |= {model.body: float(body)} if model.body is not None else {}
        substitution: dict[sympy.Symbol, sympy.Expr] = {}
        for index, symbol in enumerate(moving):
            if symbol not in present and (body, index) not in own:
                continue
            number = expressions.rounded_at(fixed[symbol], values) if symbol in fixed else None
            substitution[symbol] = own.get((body, index), sympy.Dummy(f"{symbol}_{body}", real=True))
            if number is None:
                guess[substitution[symbol]] = _guessed_end(model, index, values)
            else:
                substitution[symbol] = sympy.Float(number)
        equations += [(f"{g.name} of body {body}", g.expression.xreplace(substitution)) for g in conditions]
    equations += [(condition.name, condition.expression) for condition in model.couplings]
    guess |= {parameter.symbol: values[parameter.symbol] for parameter in model.free_parameters}
    inside = {symbol for _, expression in equations for symbol in expression.free_symbols}
    unknowns = tuple(symbol for symbol in guess if symbol in inside)
    numbers = {symbol: sympy.Float(number) for symbol, number in model.default_values.items()}
    return _Equations(
        names=tuple(name for name, _ in equations),
        expressions=tuple(expression.xreplace(numbers) for _, expression in equations),
        unknowns=unknowns,
        guess=np.array([guess[symbol] for symbol in unknowns]),
    )


def _values_at_end(model: Model) -> dict[sympy.Symbol, float]:
    """What guesses and boundary values depend on at the end of the motion, the number of a body aside."""
    values = values_at_guess(model)
    duration = expressions.rounded_at(model.duration, values)
    assert duration is not None, "checked when the model was made"
    return values | {model.time: duration}


def _guessed_end(model: Model, index: int, values: Mapping[sympy.Symbol, float]) -> float:
    """The end of the motion from which the solver starts, or zero where it has no value."""
    motions = [
        dict(model.guess).get(q, start) for q, start in zip(model.coordinates, model.start.positions, strict=True)
    ]
    count = len(model.coordinates)
    motion = motions[index] if index < count else motions[index - count]
    if motion is None or (index >= count and model.form != "lagrangian"):
        return 0.0
    value = motion if index < count else sympy.diff(motion, model.time)
    return expressions.rounded_at(value, values) or 0.0


def _system(equations: _Equations) -> System:
    """Residuals and Jacobian, term by term; all terms of a kind are evaluated at once."""
    size = len(equations.expressions), len(equations.unknowns)
    kinds, instances = sorted_terms(equations.expressions, {s: j for j, s in enumerate(equations.unknowns)})
    functions = [_with_slopes(kind) for kind in kinds]
    groups = [[instance for instance in instances if instance.kind == kind] for kind in range(len(kinds))]
    rows = [np.array([instance.row for instance in group]) for group in groups]
    indices = [np.array([instance.indices for instance in group], dtype=int).T for group in groups]

    def system(point: Array) -> tuple[Array, Array]:
        residuals, jacobian = np.zeros(size[0]), np.zeros(size)
        for function, row, read in zip(functions, rows, indices, strict=True):
            with np.errstate(all="ignore"):
                value, *slopes = function(*point[read])
            np.add.at(residuals, row, value)
            for index, slope in zip(read, slopes, strict=True):
                np.add.at(jacobian, (row, index), slope)
        return residuals, jacobian

    return system


def _with_slopes(kind: TermKind) -> Callable[..., Any]:
    """A term and its derivatives by all its arguments, as a function of arrays."""
    value = kind.expression
    if value.has(sympy.Max, sympy.Min):  # numpy's take no array beside a number
        value = value.rewrite(sympy.Piecewise)
    slopes = [sympy.diff(value, argument) for argument in kind.arguments]
    return sympy.lambdify(kind.arguments, [value, *slopes], "numpy", cse=True)  # type: ignore[no-any-return]


def _starts(guess: Array) -> Iterator[Array]:
    """The guess, then points at growing distances from it, the same in every run."""
    generator = np.random.default_rng(1)
    size = max(1.0, float(np.abs(guess).max()))
    yield guess
    for distance in (1e-3, 1e-1, 1.0, 1.0, 1.0):
        yield guess + distance * size * generator.uniform(-1.0, 1.0, guess.size)


def _scaled(residuals: Array, jacobian: Array) -> tuple[Array, Array]:
    """Equations divided by the lengths of their gradients, so that residuals are distances."""
    length = np.linalg.norm(jacobian, axis=1)
    length[~(length > 0.0)] = 1.0
    return residuals / length, jacobian / length[:, None]


def _without_vanishing(jacobian: Array, typical: Array) -> Array:
    """The Jacobian with zeros for those gradients that vanish, compared to their `typical` lengths elsewhere."""
    vanishes = np.linalg.norm(jacobian, axis=1) <= _DEPENDENT * typical
    return np.where(vanishes[:, None], 0.0, jacobian)


def _projected(system: System, point: Array) -> tuple[Array, float]:
    """The point moved to where all equations hold, as far as that succeeds, and its relative distance from there.

    The damping of the steps is the square of the residuals, with which they converge quadratically even where
    equations are redundant (Yamashita and Fukushima, 2001, On the rate of convergence of the Levenberg-Marquardt
    method).
    """
    residuals, jacobian = _scaled(*system(point))
    error = float(np.linalg.norm(residuals))
    for _ in range(_ITERATIONS):
        if not np.isfinite(jacobian).all() or not _EXACT * np.abs(point).max() < error < np.inf:
            break
        damped = np.vstack([jacobian, min(error, 1.0) * np.eye(point.size)])
        step = np.linalg.lstsq(damped, -np.concatenate([residuals, np.zeros(point.size)]), rcond=None)[0]
        moved = _improved(system, point, step, error)
        if moved is None:
            break
        point, (residuals, jacobian), error = moved
    size = max(1.0, float(np.abs(point).max()))
    return point, error / size if np.isfinite(error) and np.isfinite(jacobian).all() else np.inf


def _improved(
    system: System, point: Array, step: Array, error: float
) -> tuple[Array, tuple[Array, Array], float] | None:
    """The first of ever shorter steps that makes the error less, if any does."""
    for length in 0.5 ** np.arange(12):
        trial = point + length * step
        equations = _scaled(*system(trial))
        trial_error = float(np.linalg.norm(equations[0]))
        if trial_error < error and np.isfinite(equations[1]).all():
            return trial, equations, trial_error
    return None


def _sorted_rows(
    titles: Sequence[str], jacobian: Array
) -> tuple[tuple[int, ...], tuple[tuple[int, tuple[str, ...]], ...]]:
    """Gram-Schmidt in the order of the rows: those that point out of the span of earlier ones, and the others.

    Each row is orthogonalised twice, which keeps the basis orthogonal to rounding.
    """
    kept: list[int] = []
    dropped: list[tuple[int, tuple[str, ...]]] = []
    basis = np.empty((0, jacobian.shape[1]))
    _, rows = _scaled(np.zeros(len(jacobian)), jacobian)
    for index, row in enumerate(rows):
        rest = row - basis.T @ (basis @ row)
        rest -= basis.T @ (basis @ rest)
        length = float(np.linalg.norm(rest))
        if length > _DEPENDENT:
            basis = np.vstack([basis, rest / length])
            kept.append(index)
        else:
            dropped.append((index, _sources(titles, kept, rows[kept], row)))
    return tuple(kept), tuple(dropped)


def _sources(titles: Sequence[str], kept: Sequence[int], rows: Array, row: Array) -> tuple[str, ...]:
    """The kept equations whose gradients combine to the given row."""
    weights = np.linalg.lstsq(rows.T, row, rcond=None)[0]
    return tuple(titles[index] for index, weight in zip(kept, weights, strict=True) if abs(weight) > _NAMED)


@dataclass(frozen=True)
class Shared:
    """Shared unknowns, first each body's own ones, then the common ones; and what couples bodies.

    `start_aliases` and `end_aliases` say what equals them at the ends; `redundant` are the couplings that
    follow from the others: numbers, from 1, among all of them, and names.
    """

    own: tuple[Own, ...]
    common: tuple[Own, ...]
    start_aliases: tuple[Alias, ...]
    end_aliases: tuple[Alias, ...]
    couplings: tuple[Coupling, ...]
    coupling_symbols: tuple[tuple[Symbol, int, int], ...]
    redundant: tuple[tuple[int, str], ...]

    @property
    def all(self) -> tuple[Own, ...]:
        """All of them in order."""
        return (*self.own, *self.common)


def shared_unknowns(model: Model, periodic: Periodic, guesses: Sequence[Expr], names: Names) -> Shared:
    """Collect static parameters, what periodicity shares, and the coupled coordinates at the end.

    `guesses` are those of the coordinates. Raises BoundaryError when a coupled coordinate is given at the end.
    """
    common = tuple(
        Own(Unknown(p.symbol.name, Meaning(Kind.FREE_PARAMETER, p.symbol.name), p.lower, p.upper), p.symbol, p.guess)
        for p in model.free_parameters
    )
    own, aliases = list(periodic.own), list[Alias]()
    index: dict[int, int] = {}
    offset: dict[int, Expr] = {}
    tied = {name: (other, shift) for name, other, shift in periodic.end_aliases}
    for i in sorted({value.coordinate for value in model.end_values}):
        q = model.coordinates[i]
        assert model.end is not None, "a control problem has an end"
        if model.end.positions[i] is not None:
            raise BoundaryError(f"{q} is given at the end, and couplings depend on it", "leave out one of the two")
        if q.name in tied:
            name, offset[i] = tied[q.name]
            index[i] = next(j for j, o in enumerate(own) if o.unknown.name == name)
            continue
        name = names.named("coupled", q)
        index[i], offset[i] = len(own), S.Zero
        unknown = Unknown(name, Meaning(Kind.END_VALUE, q.name))
        own.append(Own(unknown, Symbol(name, real=True), at_end(model, guesses[i])))
        aliases.append((q.name, name, S.Zero))
    values = model.end_values
    shifted = {v.symbol: v.symbol + offset[v.coordinate] for v in values if offset[v.coordinate] != 0}
    kept = _independent(model)
    tied_nodes = (*periodic.start_aliases, *periodic.end_aliases, *aliases)
    return Shared(
        own=tuple(o if o.follows else replace(o, unknown=_bounded(model, o.unknown, tied_nodes)) for o in own),
        common=common,
        start_aliases=periodic.start_aliases,
        end_aliases=(*periodic.end_aliases, *aliases),
        couplings=tuple(
            Coupling(Unknown(names.numbered("nu"), Meaning(Kind.COUPLING, c.name)), c.expression.xreplace(shifted))
            for c in kept
        ),
        coupling_symbols=tuple((v.symbol, v.body, index[v.coordinate]) for v in values),
        redundant=tuple((i, c.name) for i, c in enumerate(model.couplings, start=1) if c not in kept),
    )


def _bounded(model: Model, unknown: Unknown, aliases: Sequence[Alias]) -> Unknown:
    """Give a shared unknown the bounds of the quantities that equal it, up to their offsets, at the ends."""
    bounds = {bound.symbol.name: bound for bound in model.bounds}
    tied = [(bounds[name], offset) for name, other, offset in aliases if other == unknown.name and name in bounds]
    lower = [bound.lower - offset for bound, offset in tied if bound.lower is not None]
    upper = [bound.upper - offset for bound, offset in tied if bound.upper is not None]
    return replace(unknown, lower=Max(*lower) if lower else None, upper=Min(*upper) if upper else None)


def _independent(model: Model) -> tuple[Condition, ...]:
    """The couplings without those that follow from the others, which would make the KKT matrix singular.

    All of them where they seem to contradict each other: what follows from the others there need not hold with them.
    Raises BoundaryError for a condition without a slope, which no Newton step can reach.
    """
    found = independent_couplings(model)
    if not found.consistent:
        return model.couplings
    for index, others in found.dropped:
        if not others:
            raise BoundaryError(
                f"the condition {model.couplings[index]} between bodies has no slope where it holds",
                "write it without its square, or leave it out",
            )
    return tuple(model.couplings[i] for i in found.kept)


def joined_unknowns(model: Model, quantities: Sequence[Symbol], guesses: Sequence[Expr], names: Names) -> Periodic:
    """What joins the quantities that are unknowns of the node: coordinates, and momenta where these are."""
    out, known = Periodic(), dict(zip(quantities, guesses, strict=True))
    for group in (model.coordinates, model.rates):
        for i, j in _indices(model) if group and set(group) <= set(quantities) else ():
            last, first = group[i], group[j]
            own = _own(
                names.named("joined", first), Meaning(Kind.START_VALUE, first.name), at_start(model, known[first])
            )
            zeta = _multiplier(names.named("nu", first), Meaning(Kind.CONTINUITY, last.name))
            (there,) = symbols([last.name], "_k1")
            share = zeta.symbol * (there - own.symbol)
            out += Periodic((own, zeta), start_aliases=((first.name, own.unknown.name, S.Zero),), end_share=share)
    return out


def joined_momenta(model: Model, names: Names) -> Periodic:
    """What joins the rates of a model in Lagrangian form, whose momenta the discrete ones match."""
    out = Periodic()
    for i, j in _indices(model):
        last, first = model.coordinates[i], model.coordinates[j]
        guess = at_start(model, momentum_guess(model)[j])
        own = _own(names.named("pi", first), Meaning(Kind.START_MOMENTUM, first.name), guess)
        zeta = _multiplier(names.named("nu", model.rates[j]), Meaning(Kind.MOMENTUM_CONTINUITY, last.name))
        alias = (f"lambda_{last}", zeta.unknown.name, S.Zero)
        momenta = ((j, own.symbol),), ((i, own.symbol),)
        out += Periodic((own, zeta), end_aliases=(alias,), start_momenta=momenta[0], end_momenta=momenta[1])
    return out


def _indices(model: Model) -> list[tuple[int, int]]:
    """The coordinates that are joined: indices of that at the end and of that at the start."""
    return [(model.coordinates.index(last), model.coordinates.index(first)) for last, first in model.joined]


def _own(name: str, meaning: Meaning, guess: Expr) -> Own:
    return Own(Unknown(name, meaning), Symbol(name, real=True), guess, follows=True)


def _multiplier(name: str, meaning: Meaning) -> Own:
    return Own(Unknown(name, meaning), Symbol(name, real=True), S.Zero, follows=True)
