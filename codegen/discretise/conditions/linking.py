"""Linking variables: unknowns that belong to no node, and conditions between bodies.

Linking variables are static parameters of the problem, coupled coordinates of each body at the end, and values where
segments of one motion meet.

The value w where two segments meet is a linking variable. The quantity at the start of the later segment equals w. For
the quantity x at the end of the earlier segment, the Lagrangian gains zeta (x - w) at the end. The multiplier zeta is
also a linking variable. Each segment is then an initial value problem with a solution, also without controls. A
velocity is no unknown of a node: since all segments have the same Lagrangian, equal velocities mean equal momenta. The
discrete momenta of both segments match a linking variable pi. In the equation of the earlier segment the multiplier is
a linking variable.

Couplings between bodies may be redundant although no two couplings are alike. Of the 2 H + 3 equations for sides,
centre, height and interior angles of a regular polygon with H corners, only 2 H are independent. A solver needs
independent equations. They are found numerically, at a configuration where all couplings hold.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr, Max, Min, S, Symbol

from codegen.discretise.conditions.periodic import Alias, Own, Periodic, own_unknown
from codegen.discretise.model.definitions import Model, prescribed
from codegen.discretise.model.guesses import DURATION, momentum_guess
from codegen.discretise.model.values import values_at_guess
from codegen.discretise.program import Coupling, Names, Unknown, symbols
from codegen.errors import BoundaryError
from codegen.runtime.record import Kind, Meaning
from codegen.symbolic import checks as expressions
from codegen.symbolic.terms import sorted_terms

_DEPENDENT = 1e-7
"""Tolerance for the component of a gradient outside the span of earlier gradients, relative to its length."""
_NAMED = 1e-6
_HOLDS = 1e-8
"""Tolerance for the distance from the set where all couplings hold, relative to the scale of the configuration."""
_EXACT = 1e-15
_ITERATIONS = 50

Array = NDArray[np.float64]
System = Callable[[Array], tuple[Array, Array]]
"""A function that returns residuals (m,) and Jacobian (m, n) at a configuration (n,)."""


@dataclass(frozen=True)
class Shared:
    """The linking variables of every body (`own`) and of the problem (`common`), and the couplings of bodies.

    `start_aliases` and `end_aliases` are unknowns of nodes that equal linking variables at the ends. `redundant` are
    the numbers, from 1, and names of the couplings that follow from the others.
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
        """All linking variables in order."""
        return (*self.own, *self.common)


def shared_unknowns(model: Model, periodic: Periodic, guesses: Sequence[Expr], names: Names) -> Shared:
    """Return the linking variables: static parameters, values of `periodic`, and coupled coordinates at the end.

    `guesses` belong to the coordinates. Raises BoundaryError when a coupled coordinate is fixed at the end, and for a
    coupling whose gradient vanishes where it holds, which no Newton step can reach.
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
        own.append(own_unknown(name, Kind.END_VALUE, q, guesses[i].subs(model.time, DURATION)))
        aliases.append((q.name, name, S.Zero))
    values = model.end_values
    shifted = {v.symbol: v.symbol + offset[v.coordinate] for v in values if offset[v.coordinate] != 0}
    independent = independent_couplings(model)
    couplings = tuple(model.couplings[i] for i in independent.kept)
    if not independent.consistent:
        # If couplings contradict each other, keep all: dependent couplings need not hold.
        couplings = model.couplings
    for dropped, sources in independent.dropped if independent.consistent else ():
        if not sources:
            raise BoundaryError(
                f"the condition {model.couplings[dropped]} between bodies has no slope where it holds",
                "write it without its square, or leave it out",
            )
    tied_nodes = (*periodic.start_aliases, *periodic.end_aliases, *aliases)
    return Shared(
        own=tuple(o if o.follows else replace(o, unknown=_bounded(model, o.unknown, tied_nodes)) for o in own),
        common=common,
        start_aliases=periodic.start_aliases,
        end_aliases=(*periodic.end_aliases, *aliases),
        couplings=tuple(
            Coupling(Unknown(names.numbered("nu"), Meaning(Kind.COUPLING, c.name)), c.expression.xreplace(shifted))
            for c in couplings
        ),
        coupling_symbols=tuple((v.symbol, v.body, index[v.coordinate]) for v in values),
        redundant=tuple((i, c.name) for i, c in enumerate(model.couplings, start=1) if c not in couplings),
    )


def _bounded(model: Model, unknown: Unknown, aliases: Sequence[Alias]) -> Unknown:
    """Return a linking variable with the bounds, minus the offsets, of the quantities that equal it at the ends."""
    bounds = {bound.symbol.name: bound for bound in model.bounds}
    tied = [(bounds[name], offset) for name, other, offset in aliases if other == unknown.name and name in bounds]
    lower = [bound.lower - offset for bound, offset in tied if bound.lower is not None]
    upper = [bound.upper - offset for bound, offset in tied if bound.upper is not None]
    return replace(unknown, lower=Max(*lower) if lower else None, upper=Min(*upper) if upper else None)


def joined_unknowns(model: Model, quantities: Sequence[Symbol], guesses: Sequence[Expr], names: Names) -> Periodic:
    """Return the terms that continue coordinates, and momenta of a Hamiltonian, from one segment to the next."""
    out, guess = Periodic(), dict(zip(quantities, guesses, strict=True))
    for group in (model.coordinates, model.rates):
        for i, j in _joined_indices(model) if group and set(group) <= set(quantities) else ():
            last, first = group[i], group[j]
            start = guess[first].subs(model.time, 0)
            own = own_unknown(names.named("joined", first), Kind.START_VALUE, first, start, follows=True)
            zeta = own_unknown(names.named("nu", first), Kind.CONTINUITY, last, S.Zero, follows=True)
            (at_end_node,) = symbols([last.name], "_k1")
            share = zeta.symbol * (at_end_node - own.symbol)
            out += Periodic((own, zeta), start_aliases=((first.name, own.unknown.name, S.Zero),), end_share=share)
    return out


def joined_momenta(model: Model, names: Names) -> Periodic:
    """Return the terms that continue the discrete momenta of a Lagrangian model from one segment to the next."""
    out = Periodic()
    for i, j in _joined_indices(model):
        last, first = model.coordinates[i], model.coordinates[j]
        guess = momentum_guess(model)[j].subs(model.time, 0)
        own = own_unknown(names.named("pi", first), Kind.START_MOMENTUM, first, guess, follows=True)
        name = names.named("nu", model.rates[j])
        zeta = own_unknown(name, Kind.MOMENTUM_CONTINUITY, last, S.Zero, follows=True)
        out += Periodic(
            (own, zeta),
            end_aliases=((f"lambda_{last}", zeta.unknown.name, S.Zero),),
            start_momenta=((j, own.symbol),),
            end_momenta=((i, own.symbol),),
        )
    return out


def _joined_indices(model: Model) -> list[tuple[int, int]]:
    """Return index pairs of joined coordinates: the first one at the end equals the second one at the start."""
    return [(model.coordinates.index(last), model.coordinates.index(first)) for last, first in model.joined]


@dataclass(frozen=True)
class IndependentCouplings:
    """The couplings that are `kept` (indices in `Model.couplings`), and the reasons to drop the others.

    `dropped` gives the index of each other coupling and the names of the equations from which it follows, or no names
    where its gradient vanishes. The couplings are not `consistent` if no configuration was found where all of them
    hold. Then `violated` is the name of the coupling with the largest violation, and dependence was judged at the
    configuration with the smallest total violation.
    """

    kept: tuple[int, ...]
    dropped: tuple[tuple[int, tuple[str, ...]], ...]
    consistent: bool = True
    violated: str = ""


@dataclass(frozen=True)
class _Equations:
    """Equations between end values: names, expressions of the unknowns, and the initial guess of the unknowns.

    The end conditions of single bodies come first, the couplings last.
    """

    names: tuple[str, ...]
    expressions: tuple[sympy.Expr, ...]
    unknowns: tuple[sympy.Symbol, ...]
    guess: Array


def independent_couplings(model: Model) -> IndependentCouplings:
    """Return the independent couplings of a model, and the couplings that follow from earlier equations.

    Earlier equations are the couplings written before, and the end conditions of single bodies, which are always kept.
    Dependence is judged to first order at the default parameters. The configuration is near the guess and satisfies all
    equations, if possible (Levenberg-Marquardt steps, from the guess and from points near it).
    """
    if not model.couplings:
        return IndependentCouplings((), ())
    equations = _equations(model)
    system = _system(equations)
    guess, generator = equations.guess, np.random.default_rng(1)
    size = max(1.0, float(np.abs(guess).max()))
    projections = []
    for distance in (0.0, 1e-3, 1e-1, 1.0, 1.0, 1.0):
        start = guess + distance * size * generator.uniform(-1.0, 1.0, guess.size) if distance else guess
        projections.append(_projected(system, start))
        # The guess may be special, such as bodies in one line, and so may the configuration near the guess.
        if distance and any(violation <= _HOLDS for _, violation in projections):
            break
    nearest, least = min(projections, key=lambda projection: projection[1])
    typical = np.linalg.norm(system(start)[1], axis=1)
    solutions = []
    for point in [point for point, violation in projections if violation <= _HOLDS] or [nearest]:
        jacobian = system(point)[1]
        vanishes = np.linalg.norm(jacobian, axis=1) <= _DEPENDENT * typical
        solutions.append(_sorted_rows(equations.names, np.where(vanishes[:, None], 0.0, jacobian)))
    kept, dropped = max(solutions, key=lambda rows: len(rows[0]))
    first = len(equations.names) - len(model.couplings)
    couplings = IndependentCouplings(
        tuple(index - first for index in kept if index >= first),
        tuple((index - first, names) for index, names in dropped if index >= first),
    )
    if least <= _HOLDS:
        return couplings
    worst = int(np.argmax(np.abs(_scaled(*system(nearest))[0])))
    return replace(couplings, consistent=False, violated=equations.names[worst])


def _equations(model: Model) -> _Equations:
    end_values = {(value.body, value.coordinate): value.symbol for value in model.end_values}
    fixed = prescribed(model, "end")
    equations, guess = [], dict[sympy.Symbol, float]()
    conditions = [condition for condition in model.end_conditions if condition.equality]
    present = {symbol for condition in conditions for symbol in condition.expression.free_symbols}
    values = values_at_guess(model)
    duration = expressions.rounded_at(model.duration, values)
    assert duration is not None, "checked when the model was made"
    values |= {model.time: duration}
    # The initial guess of each coordinate, then of each rate, as a function of time; or None.
    motions = [dict(model.guess).get(q, x) for q, x in zip(model.coordinates, model.start.positions, strict=True)]
    if model.form == "lagrangian":
        motions += [None if motion is None else sympy.diff(motion, model.time) for motion in motions]
    for body in range(model.bodies):
        values |= {model.body: float(body)} if model.body is not None else {}
        substitution: dict[sympy.Symbol, sympy.Expr] = {}
        for index, symbol in enumerate((*model.coordinates, *model.rates)):
            if symbol not in present and (body, index) not in end_values:
                continue
            number = expressions.rounded_at(fixed[symbol], values) if symbol in fixed else None
            if number is not None:
                substitution[symbol] = sympy.Float(number)
                continue
            unknown = end_values.get((body, index), sympy.Dummy(f"{symbol}_{body}", real=True))
            motion = motions[index] if index < len(motions) else None
            substitution[symbol] = unknown
            guess[unknown] = 0.0 if motion is None else expressions.rounded_at(motion, values) or 0.0
        equations += [(f"{g.name} of body {body}", g.expression.xreplace(substitution)) for g in conditions]
    equations += [(condition.name, condition.expression) for condition in model.couplings]
    guess |= {parameter.symbol: values[parameter.symbol] for parameter in model.free_parameters}
    occurring = {symbol for _, expression in equations for symbol in expression.free_symbols}
    unknowns = tuple(symbol for symbol in guess if symbol in occurring)
    numbers = {symbol: sympy.Float(number) for symbol, number in model.default_values.items()}
    return _Equations(
        names=tuple(name for name, _ in equations),
        expressions=tuple(expression.xreplace(numbers) for _, expression in equations),
        unknowns=unknowns,
        guess=np.array([guess[symbol] for symbol in unknowns]),
    )


def _system(equations: _Equations) -> System:
    """Return a function for residuals and Jacobian, which evaluates all terms of a kind at once."""
    size = len(equations.expressions), len(equations.unknowns)
    kinds, instances = sorted_terms(equations.expressions, {s: j for j, s in enumerate(equations.unknowns)})
    functions = list[Callable[..., list[Array]]]()
    for kind in kinds:  # a term and its derivatives with respect to all its arguments
        value = kind.expression
        if value.has(sympy.Max, sympy.Min):  # numpy's maximum takes no array with a number
            value = value.rewrite(sympy.Piecewise)
        slopes = [sympy.diff(value, argument) for argument in kind.arguments]
        functions.append(sympy.lambdify(kind.arguments, [value, *slopes], "numpy", cse=True))
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


def _scaled(residuals: Array, jacobian: Array) -> tuple[Array, Array]:
    """Return residuals and Jacobian divided by the lengths of the gradients, so that residuals are distances."""
    length = np.linalg.norm(jacobian, axis=1)
    length[~(length > 0.0)] = 1.0
    return residuals / length, jacobian / length[:, None]


def _projected(system: System, point: Array) -> tuple[Array, float]:
    """Return a nearby point of the set where all equations hold, and its relative distance from the set.

    The damping of the steps is the square of the residuals, with which they converge quadratically even where
    equations are redundant (Yamashita and Fukushima, 2001, On the rate of convergence of the Levenberg-Marquardt
    method). A line search halves the step until the error decreases.
    """
    residuals, jacobian = _scaled(*system(point))
    error = float(np.linalg.norm(residuals))
    for _ in range(_ITERATIONS):
        if not np.isfinite(jacobian).all() or not _EXACT * np.abs(point).max() < error < np.inf:
            break
        damped = np.vstack([jacobian, min(error, 1.0) * np.eye(point.size)])
        step = np.linalg.lstsq(damped, -np.concatenate([residuals, np.zeros(point.size)]), rcond=None)[0]
        for length in 0.5 ** np.arange(12):
            trial = point + length * step
            trial_equations = _scaled(*system(trial))
            trial_error = float(np.linalg.norm(trial_equations[0]))
            if trial_error < error and np.isfinite(trial_equations[1]).all():
                break
        else:
            break
        point, (residuals, jacobian), error = trial, trial_equations, trial_error
    size = max(1.0, float(np.abs(point).max()))
    return point, error / size if np.isfinite(error) and np.isfinite(jacobian).all() else np.inf


def _sorted_rows(
    titles: Sequence[str], jacobian: Array
) -> tuple[tuple[int, ...], tuple[tuple[int, tuple[str, ...]], ...]]:
    """Return the indices of independent rows, and the index of each other row with the `titles` of its source rows.

    Gram-Schmidt in the order of the rows orthogonalises each row twice, so that the basis is orthogonal to rounding.
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
            continue
        weights = np.linalg.lstsq(rows[kept].T, row, rcond=None)[0]
        sources = tuple(titles[i] for i, weight in zip(kept, weights, strict=True) if abs(weight) > _NAMED)
        dropped.append((index, sources))
    return tuple(kept), tuple(dropped)
