"""Samples of distributions: any of scipy.stats by name, at points that are random, a Latin hypercube or of Sobol.

Sources: McKay, Beckman and Conover (1979) for Latin hypercubes; Sobol' (1967) and Owen (1998) for scrambled sequences.
"""

from __future__ import annotations

import ast
import difflib
import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from codegen.errors import ArgumentError, clause, one_line
from codegen.interfaces import Matrix
from codegen.sweeping.cases import MOST_CASES, Cases, as_rows

NUMBER = 1000
"""How many samples there are where nothing is said."""


def _random(number: int, dimensions: int, rng: np.random.Generator) -> Matrix:
    return rng.random((number, dimensions))


def _latin(number: int, dimensions: int, rng: np.random.Generator) -> Matrix:
    from scipy.stats import qmc

    return np.asarray(qmc.LatinHypercube(dimensions, seed=rng).random(number))


def _sobol(number: int, dimensions: int, rng: np.random.Generator) -> Matrix:
    from scipy.stats import qmc

    # The sequence is balanced in powers of two; of a longer one the first are taken.
    return np.asarray(qmc.Sobol(dimensions, seed=rng).random_base2(max(number - 1, 1).bit_length())[:number])


METHODS: dict[str, Callable[[int, int, np.random.Generator], Matrix]] = {
    "random": _random,
    "latin": _latin,
    "sobol": _sobol,
}
"""Ways to take points of the unit cube, (number, dimensions, generator) -> (number, dimensions), by name."""


def _uniform(low: float, high: float) -> Any:
    from scipy import stats

    return stats.uniform(low, high - low)


def _normal(mean: float, deviation: float) -> Any:
    from scipy import stats

    return stats.norm(mean, deviation)


PLAIN: dict[str, Callable[..., Any]] = {"uniform": _uniform, "normal": _normal}
"""Distributions by the arguments that a person writes: uniform(low, high), normal(mean, deviation)."""


def samples(distributions: Mapping[str, Any], number: int, method: str, seed: int) -> Cases:
    """So many samples of independent quantities: the same for the same method and seed.

    A distribution is a text such as `normal(100, 5)`, or one that scipy has frozen. Raises ArgumentError for what is no
    distribution, no method and no number of samples.
    """
    require_method(method)
    if isinstance(number, bool) or not isinstance(number, int) or not 1 <= number <= MOST_CASES:
        raise ArgumentError(f"{clause(repr(number))} samples", f"give a number of --cases from 1 to {MOST_CASES}")
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ArgumentError(f"--seed {clause(repr(seed))}", "give a whole number that is not negative")
    frozen = {name: _distribution(name, given) for name, given in distributions.items()}
    points = METHODS[method](number, len(frozen), np.random.default_rng(seed))
    # At 0 and 1 most distributions are infinite.
    points = np.clip(points, 2.0**-53, 1.0 - 2.0**-53)
    columns = {}
    for (name, distribution), places in zip(frozen.items(), points.T, strict=True):
        values = np.asarray(distribution.ppf(places), dtype=float)
        if not np.isfinite(values).all():
            finding = f"--sample {name}: {clause(str(distributions[name]))} has no finite values"
            raise ArgumentError(finding, "correct its arguments, such as a negative deviation")
        columns[name] = values
    return as_rows(columns, number)


def require_method(method: str) -> None:
    """Refuse a method that is none; ArgumentError."""
    if method not in METHODS:
        remedy = f"use {', '.join(METHODS)}; the formulation of a problem is --formulation"
        raise ArgumentError(f"there is no sampling method {clause(repr(method))}", remedy)


def _distribution(name: str, given: Any) -> Any:
    """A frozen distribution of scipy; ArgumentError tells what is none."""
    if callable(getattr(given, "ppf", None)):
        return given
    from scipy import stats

    family, positional, named = _call(name, given)
    known = {key for key in dir(stats) if callable(getattr(getattr(stats, key), "ppf", None))} | set(PLAIN)
    if family not in known:
        close = difflib.get_close_matches(family, known, 3)
        remedy = f"did you mean {' or '.join(close)}?" if close else "take one of scipy.stats, such as lognorm"
        raise ArgumentError(clause(f"--sample {name}: there is no distribution {family}"), remedy)
    try:
        made = PLAIN[family](*positional, **named) if family in PLAIN else getattr(stats, family)(*positional, **named)
        made.ppf(0.5)
    except TypeError:  # whose text is about functions of scipy, or of this file
        form = f"{family}({', '.join(_arguments(family))})"
        raise ArgumentError(
            clause(f"--sample {name}={given} has other arguments than {form}"), f"write {form}"
        ) from None
    except ValueError as error:
        reason = one_line(str(error), 150)
        remedy = "give its arguments as in normal(mean, deviation), uniform(low, high), or as scipy.stats has them"
        raise ArgumentError(clause(f"--sample {name}={given}: {reason}"), remedy) from None
    return made


def _arguments(family: str) -> list[str]:
    """The names of what a distribution is given."""
    if family in PLAIN:
        return list(inspect.signature(PLAIN[family]).parameters)
    from scipy import stats

    shapes = getattr(getattr(stats, family), "shapes", None) or ""
    return [*filter(None, (shape.strip() for shape in shapes.split(","))), "loc=0", "scale=1"]


def _call(name: str, given: Any) -> tuple[str, list[float], dict[str, float]]:
    """The parts of a text such as `beta(2, 5, scale=3)`."""
    remedy = f"write --sample {name}=normal(100, 5)"
    try:
        call = ast.parse(str(given).strip(), mode="eval").body
        if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name)):
            raise ValueError
        positional = [float(ast.literal_eval(argument)) for argument in call.args]
        named = {word.arg or "": float(ast.literal_eval(word.value)) for word in call.keywords}
    except (SyntaxError, ValueError, TypeError, RecursionError, MemoryError):
        raise ArgumentError(clause(f"--sample {name}={given} is no distribution"), remedy) from None
    return call.func.id, positional, named
