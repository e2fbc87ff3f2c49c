"""Which couplings between bodies follow from the others, found numerically where all of them hold.

A set of conditions may be redundant although no two of them are alike: of the sides, centre, height and interior angles
of a regular polygon with H corners, 2 H + 3 equations, only 2 H are independent. A solver needs the independent ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import sympy

from codegen import expressions
from codegen.model import Model
from codegen.model.values import values_at_guess

_DEPENDENT = 1e-7
"""Part of a gradient outside the span of earlier gradients, relative to its length, that counts as rounding."""
_NAMED = 1e-6
_HOLDS = 1e-8
"""Distance to the set where a coupling holds, relative to the size of the configuration, that counts as none."""
_EXACT = 1e-15
_ITERATIONS = 50

Array = np.ndarray
System = Callable[[Array], tuple[Array, Array]]
"""Residuals and their Jacobian at a configuration."""


@dataclass(frozen=True)
class IndependentCouplings:
    """Which couplings are to be `kept` (places in `Model.couplings`), and why the others are not.

    `dropped` gives the place of each other coupling and the names of those that it follows from; no names where its
    gradient vanishes. When the couplings are not `consistent`, no configuration was found where all of them hold;
    `violated` then names the one that is farthest from holding, and dependence was judged at the configuration where
    they are nearest to it.
    """

    kept: tuple[int, ...]
    dropped: tuple[tuple[int, tuple[str, ...]], ...]
    consistent: bool = True
    violated: str = ""


def independent_couplings(model: Model) -> IndependentCouplings:
    """Sort the couplings of a model into independent ones and ones that follow from those written before them.

    Judged to first order at the default parameters, at a configuration that lies near the guess and fulfils all
    couplings, if there is one (Levenberg-Marquardt steps, from the guess and from points beside it).
    """
    if not model.couplings:
        return IndependentCouplings((), ())
    system, guess = _system(model), _guessed_configuration(model)
    tried = []
    for number, start in enumerate(_starts(guess)):
        tried.append(_projected(system, start))
        # The guess may be special, such as bodies in one line, and so may the configuration that is found from it.
        if number > 0 and any(distance <= _HOLDS for _, distance in tried):
            break
    nearest, least = min(tried, key=lambda projection: projection[1])
    typical = np.linalg.norm(system(start)[1], axis=1)
    points = [point for point, distance in tried if distance <= _HOLDS] or [nearest]
    sorted_rows = [_sorted_rows(model, _without_vanishing(system(point)[1], typical)) for point in points]
    kept, dropped = max(sorted_rows, key=lambda rows: len(rows[0]))
    if least <= _HOLDS:
        return IndependentCouplings(kept, dropped)
    worst = int(np.argmax(np.abs(_scaled(*system(nearest))[0])))
    return IndependentCouplings(kept, dropped, False, model.couplings[worst].name)


def _unknowns(model: Model) -> list[sympy.Symbol]:
    """End values, then the free parameters that occur in couplings."""
    inside = {symbol for condition in model.couplings for symbol in condition.expression.free_symbols}
    return [value.symbol for value in model.end_values] + [
        free.symbol for free in model.free_parameters if free.symbol in inside
    ]


def _system(model: Model) -> System:
    unknowns = _unknowns(model)
    values = {s: v for s, v in values_at_guess(model).items() if s not in unknowns}
    residuals = [condition.expression.xreplace(values) for condition in model.couplings]
    places = [(i, j) for i, e in enumerate(residuals) for j, s in enumerate(unknowns) if s in e.free_symbols]
    entries = [sympy.diff(residuals[i], unknowns[j]) for i, j in places]
    function = sympy.lambdify(unknowns, [*residuals, *entries], "numpy", cse=True)
    rows, columns = np.array(places).T

    def system(point: Array) -> tuple[Array, Array]:
        with np.errstate(all="ignore"):
            numbers = np.array(function(*point), dtype=float)
        jacobian = np.zeros((len(residuals), len(unknowns)))
        jacobian[rows, columns] = numbers[len(residuals) :]
        return numbers[: len(residuals)], jacobian

    return system


def _guessed_configuration(model: Model) -> Array:
    """The end of the motion from which the solver starts, as far as it has values."""
    values = values_at_guess(model)
    duration = expressions.rounded_at(model.duration, values)
    assert duration is not None, "checked when the model was made"
    guess = dict(model.guess)
    place = []
    for end in model.end_values:
        motion = guess.get(model.coordinates[end.coordinate], model.start.positions[end.coordinate])
        at_end = values | {model.time: duration} | ({model.body: float(end.body)} if model.body is not None else {})
        number = expressions.rounded_at(motion, at_end) if motion is not None else None
        place.append(0.0 if number is None else number)
    return np.array([*place, *(values[symbol] for symbol in _unknowns(model)[len(place) :])])


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


def _sorted_rows(model: Model, jacobian: Array) -> tuple[tuple[int, ...], tuple[tuple[int, tuple[str, ...]], ...]]:
    """Gram-Schmidt in the order of the rows: those that point out of the span of earlier ones, and the others.

    Each row is orthogonalised twice, which keeps the basis orthogonal to rounding.
    """
    kept: list[int] = []
    dropped: list[tuple[int, tuple[str, ...]]] = []
    basis = np.empty((0, jacobian.shape[1]))
    _, rows = _scaled(np.zeros(len(jacobian)), jacobian)
    for place, row in enumerate(rows):
        rest = row - basis.T @ (basis @ row)
        rest -= basis.T @ (basis @ rest)
        length = float(np.linalg.norm(rest))
        if length > _DEPENDENT:
            basis = np.vstack([basis, rest / length])
            kept.append(place)
        else:
            dropped.append((place, _names(model, kept, rows[kept], row)))
    return tuple(kept), tuple(dropped)


def _names(model: Model, kept: Sequence[int], rows: Array, row: Array) -> tuple[str, ...]:
    """The kept couplings whose gradients combine to the given row."""
    weights = np.linalg.lstsq(rows.T, row, rcond=None)[0]
    return tuple(
        model.couplings[place].name for place, weight in zip(kept, weights, strict=True) if abs(weight) > _NAMED
    )
