"""The cases of a sweep: a grid of values, a table with a row for each case, or samples of distributions.

Values are numbers, or texts for arguments of problem() that take words. A grid stores the values of each quantity once.
So its memory grows with the sum of the numbers of values, not with the number of cases.

Samples follow distributions of scipy.stats. Their quantiles are random points, a Latin hypercube or a Sobol sequence.
Sources: McKay, Beckman and Conover (1979) for Latin hypercubes; Sobol' (1967) and Owen (1998) for scrambled sequences.
"""

from __future__ import annotations

import ast
import csv
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from codegen.batch.executors import counted
from codegen.errors import ArgumentError, NumericsError, clause, is_count, nearest, one_line

Values: TypeAlias = NDArray[np.float64] | NDArray[np.str_]
MOST_CASES = 100_000_000
CASE = "case"  # name of the only dimension of cases from a table or from samples


@dataclass(frozen=True, eq=False)
class Cases:
    """The values of the varied quantities, and the dimension along which each quantity varies.

    `dims` and `shape` are the names and lengths of the dimensions; the last dimension varies fastest. `axes[name]` is
    the index of a quantity's dimension, and `columns[name]` (n,) its values along this dimension. `lines` (n,) are the
    line numbers of cases that were read from `file`.
    """

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    columns: Mapping[str, Values]
    axes: Mapping[str, int]
    file: Path | None = None
    lines: NDArray[np.intp] | None = None

    def __post_init__(self) -> None:
        """Raise NumericsError for too many cases."""
        if self.number > MOST_CASES:
            raise NumericsError(f"there are {self.number} cases, and at most {MOST_CASES} fit", "take fewer values")

    @property
    def number(self) -> int:
        """Number of cases."""
        return math.prod(self.shape)

    @property
    def is_grid(self) -> bool:
        """True if every quantity, or group of zipped quantities, has its own dimension."""
        return self.dims != (CASE,)

    def origin(self, row: int) -> str:
        """Return "FILE:LINE: " as a prefix of messages about a row, or an empty text for cases without a file."""
        return "" if self.lines is None else f"{self.file}:{self.lines[row]}: "

    def chosen(self, indices: NDArray[np.intp]) -> dict[str, Values]:
        """Return the values (n,) of each quantity for the cases with these indices (n,)."""
        along = np.unravel_index(indices, self.shape)
        return {name: self.columns[name][along[axis]] for name, axis in self.axes.items()}

    def points(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the cases with these indices (n,) as points (n, quantities); each quantity is scaled by its range."""
        return np.column_stack([self._scaled(name, column) for name, column in self.chosen(indices).items()])

    def points_along(self, axis: int) -> NDArray[np.float64]:
        """Return the n values along one dimension as points (n, quantities), each scaled by its range."""
        own = [name for name, place in self.axes.items() if place == axis]
        return np.column_stack([self._scaled(name, self.columns[name]) for name in own])

    def _scaled(self, name: str, column: Values) -> NDArray[np.float64]:
        """Return (value - least value) / range for numbers, and the position in sorted order for texts."""
        known = self._ranges[name]
        if not isinstance(known, tuple):
            return np.searchsorted(known, column).astype(float)
        least, extent = known
        return np.asarray((np.asarray(column, dtype=float) - least) / extent)

    @cached_property
    def _ranges(self) -> dict[str, tuple[float, float] | NDArray[np.str_]]:
        """The least value and the range of each quantity, or its sorted texts; stored, because columns may be long."""
        return {
            name: np.unique(column).astype(np.str_)
            if column.dtype.kind == "U"
            else (float(np.min(column)), float(np.ptp(column)) or 1.0)
            for name, column in self.columns.items()
        }


def rows_of(columns: Mapping[str, Values]) -> list[dict[str, float | str]]:
    """Return each row of the columns (n,) as a mapping of names to values."""
    return [dict(zip(columns, row)) for row in zip(*(column.tolist() for column in columns.values()), strict=True)]


def grid(axes: Mapping[str, object], zipped: Sequence[Sequence[str]] = ()) -> Cases:
    """Return all combinations of the values of each quantity; a zipped group of names varies along one dimension.

    Raises ArgumentError for invalid values, and for names that cannot be zipped.
    """
    columns = {name: values_of(name, values) for name, values in axes.items()}
    # The quantity that names the dimension of each quantity: itself, or the first of its group.
    heads, seen = {name: name for name in columns}, set[str]()
    for group in zipped:
        words = ",".join(group)
        if len(group) < 2 or len(set(group)) < len(group):
            raise ArgumentError(f"--zip {words}: there is nothing to pair", "name two varied quantities, as --zip m,r0")
        for name in group:
            if name not in columns:
                raise ArgumentError(f"--zip {words}: {name} is not varied", f"give --vary {name}=...")
            if name in seen:
                raise ArgumentError(f"--zip names {name} twice", "put all that vary together into one --zip")
            if columns[name].size != columns[group[0]].size:
                sizes = f"{counted(columns[group[0]].size, 'value')}, {name} has {columns[name].size}"
                raise ArgumentError(f"--zip {words}: {group[0]} has {sizes}", "give as many of both")
            heads[name] = group[0]
        seen.update(group)
    dims = tuple(name for name in columns if heads[name] == name)
    shape = tuple(columns[name].size for name in dims)
    return Cases(dims, shape, columns, {name: dims.index(heads[name]) for name in columns})


def values_of(name: str, values: object) -> Values:
    """Return the values of one quantity (n,) as numbers or texts; raises ArgumentError for other values."""
    try:
        array = np.atleast_1d(np.asarray(values))
    except (TypeError, ValueError):
        array = np.empty((0, 0))
    if array.ndim != 1 or array.size == 0 or array.dtype.kind not in "biufU":
        raise ArgumentError(
            f"{clause(name)} has no values that can be varied", "give numbers, as --vary r1=5.5:6.5:101"
        )
    if array.dtype.kind == "U":
        return array
    numbers = np.asarray(array, dtype=float)
    if not np.isfinite(numbers).all():
        raise ArgumentError(f"{clause(name)} has values that are not finite", "give finite numbers")
    return numbers


def axis_of(item: str) -> tuple[str, Values]:
    """Return the name and values of `--vary NAME=first:last:count` or `NAME=a,b,c`; raises ArgumentError otherwise."""
    name, text = assigned("--vary", item, "r1=5.5:6.5:101")
    if ":" not in text:
        words = [word.strip() for word in text.split(",")]
        if not all(words):
            raise ArgumentError(clause(f"--vary {item} has an empty value"), f"write --vary {name}=a,b,c")
        return name, _column(words)
    parts = text.split(":")
    if len(parts) != 3 or not (parts[2].strip().isascii() and parts[2].strip().isdigit()):
        remedy = f"write --vary {name}=first:last:count or --vary {name}=a,b,c"
        raise ArgumentError(clause(f"--vary {item} is no range"), remedy)
    count = int(parts[2])
    if not 1 <= count <= MOST_CASES:
        raise ArgumentError(clause(f"--vary {item} has {count} values"), f"give from 1 to {MOST_CASES}")
    first, last = (number_of(f"--vary {item}", part) for part in parts[:2])
    return name, np.linspace(first, last, count)


def assigned(option: str, item: str, example: str) -> tuple[str, str]:
    """Return name and text of an item NAME=TEXT of an option; raises ArgumentError if one of them is missing."""
    name, equals, text = item.partition("=")
    if not (name.strip() and equals and text.strip()):
        raise ArgumentError(clause(f"{option} {item!r} is not of the form NAME=..."), f"write {option} {example}")
    return name.strip(), text.strip()


def number_of(what: str, text: str) -> float:
    """Return the finite number in a text; raises ArgumentError, with a message about `what`, for another text."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ArgumentError(clause(f"{what}: {text.strip()!r} is no finite number"), "give finite numbers")
    return number


def _column(words: Sequence[str]) -> Values:
    """Return an array of numbers if all words are numbers, else an array of texts."""
    try:
        return np.array([float(word) for word in words])
    except ValueError:
        return np.array(words, dtype=np.str_)


def table(source: Any) -> Cases:
    """Return a case for each row of a file of comma-separated values, or of a mapping of names to columns.

    Raises ArgumentError, with file and line, for an invalid table.
    """
    if isinstance(source, str | Path):
        return _table_of(Path(source))
    if not hasattr(source, "keys"):
        remedy = "give a file, a mapping of names to columns, or a number"
        raise ArgumentError(f"cases are {clause(repr(source))}", remedy)
    columns = {str(name): np.asarray(source[name]) for name in source.keys()}  # noqa: SIM118  for pandas
    if not columns:
        raise ArgumentError("cases: there are no columns", "give a column for each varied quantity")
    checked = {name: values_of(f"cases: {name}", values) for name, values in columns.items()}
    sizes = {values.size for values in checked.values()}
    if len(sizes) > 1:
        raise ArgumentError("cases: columns of different lengths", "give a row for each case")
    return as_rows(checked, sizes.pop())


def _table_of(path: Path) -> Cases:
    """Return the cases of a file of comma-separated values, with their line numbers."""
    texts: dict[str, list[str]] = {}
    numbers = list[int]()
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = enumerate(csv.reader(file, skipinitialspace=True), start=1)
            rows = ((number, [word.strip() for word in line]) for number, line in lines if line)
            _, names = next(rows, (1, []))
            if not all(names) or len(set(names)) < len(names):
                finding = f"{path}:1: the names {clause(','.join(names))} are missing in parts, or twice there"
                raise ArgumentError(finding, "name each varied quantity once in the first line")
            texts = {name: [] for name in names}
            for number, words in rows:
                if len(words) != len(names) or not all(words):
                    values = counted(sum(map(bool, words)), "value")
                    finding = f"{path}:{number}: {values} for {counted(len(names), 'name')}"
                    raise ArgumentError(finding, "give a value for every name")
                numbers.append(number)
                for name, word in zip(names, words, strict=True):
                    texts[name].append(word)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = one_line(getattr(error, "strerror", None) or str(error), 100)
        raise ArgumentError(f"--cases {path} cannot be read ({reason})", "give a table as text") from None
    if not texts:
        raise ArgumentError(f"{path}: there are no columns", "name the varied quantities in the first line")
    if not numbers:
        raise ArgumentError(f"{path} holds no cases", "give a line for each case behind the names")
    columns = {name: _column(words) for name, words in texts.items()}
    cases = replace(as_rows(columns, len(numbers)), file=path, lines=np.array(numbers, dtype=np.intp))
    for name, column in columns.items():
        if column.dtype.kind == "f" and not np.isfinite(column).all():
            row = int(np.argmin(np.isfinite(column)))
            finding = f"{cases.origin(row)}{name} is not finite ({column[row]})"
            raise ArgumentError(clause(finding), "give finite numbers")
    return cases


def as_rows(columns: Mapping[str, Values], number: int) -> Cases:
    """Return cases along a single dimension, from columns (number,)."""
    return Cases((CASE,), (number,), columns, dict.fromkeys(columns, 0))


NUMBER = 1000  # default number of samples


def _random(number: int, dimensions: int, rng: np.random.Generator) -> NDArray[np.float64]:
    return rng.random((number, dimensions))


def _latin(number: int, dimensions: int, rng: np.random.Generator) -> NDArray[np.float64]:
    from scipy.stats import qmc

    return np.asarray(qmc.LatinHypercube(dimensions, seed=rng).random(number))


def _sobol(number: int, dimensions: int, rng: np.random.Generator) -> NDArray[np.float64]:
    from scipy.stats import qmc

    # The sequence is balanced in powers of two; of a longer one the first are taken.
    return np.asarray(qmc.Sobol(dimensions, seed=rng).random_base2(max(number - 1, 1).bit_length())[:number])


SAMPLINGS: dict[str, Callable[[int, int, np.random.Generator], NDArray[np.float64]]] = {
    "random": _random,
    "latin": _latin,
    "sobol": _sobol,
}
"""Sampling methods by name: (number, dimensions, generator) -> points of the unit cube (number, dimensions)."""


@runtime_checkable
class Distribution(Protocol):
    """A distribution of scipy.stats with fixed parameters ("frozen")."""

    def ppf(self, q: object) -> NDArray[np.float64]:
        """Return the quantiles of probabilities."""


PLAIN: dict[str, Callable[[float, float], tuple[str, float, float]]] = {
    "uniform": lambda low, high: ("uniform", low, high - low),
    "normal": lambda mean, deviation: ("norm", mean, deviation),
}
"""Distributions with arguments other than in scipy, which give the name, location and scale there."""


def samples(distributions: Mapping[str, object], number: int, sampling: str, seed: int) -> Cases:
    """Return samples of independent quantities; the same arguments give the same samples.

    A distribution is a text such as `normal(100, 5)`, or a frozen distribution of scipy. Raises ArgumentError for an
    invalid distribution, sampling method, number or seed.
    """
    require_sampling(sampling)
    if not is_count(number) or number > MOST_CASES:
        raise ArgumentError(f"{clause(repr(number))} samples", f"give a number of --cases from 1 to {MOST_CASES}")
    if not is_count(seed, 0):
        raise ArgumentError(f"--seed {clause(repr(seed))}", "give a whole number that is not negative")
    frozen = {name: _distribution(name, text) for name, text in distributions.items()}
    points = SAMPLINGS[sampling](number, len(frozen), np.random.default_rng(seed))
    # Quantiles of most distributions are infinite at 0 and 1.
    points = np.clip(points, 2.0**-53, 1.0 - 2.0**-53)
    columns = {}
    for (name, distribution), places in zip(frozen.items(), points.T, strict=True):
        values = np.asarray(distribution.ppf(places), dtype=float)
        if not np.isfinite(values).all():
            finding = f"--sample {name}: {clause(str(distributions[name]))} has no finite values"
            raise ArgumentError(finding, "correct its arguments, such as a negative deviation")
        columns[name] = values
    return as_rows(columns, number)


def require_sampling(sampling: str) -> None:
    """Raise ArgumentError for an unknown sampling method."""
    if sampling not in SAMPLINGS:
        raise ArgumentError(f"there is no sampling method {clause(repr(sampling))}", f"use {', '.join(SAMPLINGS)}")


def _distribution(name: str, distribution: object) -> Distribution:
    """Return the frozen distribution that a text or object describes; raises ArgumentError for an invalid text."""
    if isinstance(distribution, Distribution):
        return distribution
    from scipy import stats

    try:  # to read a text such as `beta(2, 5, scale=3)`
        call = ast.parse(str(distribution).strip(), mode="eval").body
        if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name)):
            raise ValueError
        positional = [float(ast.literal_eval(argument)) for argument in call.args]
        named = {word.arg or "": float(ast.literal_eval(word.value)) for word in call.keywords}
    except (SyntaxError, ValueError, TypeError, RecursionError, MemoryError):
        finding = clause(f"--sample {name}={distribution} is no distribution")
        raise ArgumentError(finding, f"write --sample {name}=normal(100, 5)") from None
    family = call.func.id
    known = {key for key in dir(stats) if callable(getattr(getattr(stats, key), "ppf", None))} | set(PLAIN)
    if family not in known:
        remedy = nearest(family, known, "take one of scipy.stats, such as lognorm", 3)
        raise ArgumentError(clause(f"--sample {name}: there is no distribution {family}"), remedy)
    try:
        name_there, *plain = PLAIN[family](*positional, **named) if family in PLAIN else (family, *positional)
        frozen: Distribution = getattr(stats, str(name_there))(*plain, **({} if family in PLAIN else named))
        frozen.ppf(0.5)
    except TypeError:  # its message names internal functions: write another one
        if family in PLAIN:
            arguments = list(inspect.signature(PLAIN[family]).parameters)
        else:
            shapes = (getattr(getattr(stats, family), "shapes", None) or "").split(",")
            arguments = [*filter(None, map(str.strip, shapes)), "loc=0", "scale=1"]
        form = f"{family}({', '.join(arguments)})"
        finding = clause(f"--sample {name}={distribution} has other arguments than {form}")
        raise ArgumentError(finding, f"write {form}") from None
    except ValueError as error:
        finding = clause(f"--sample {name}={distribution}: {one_line(str(error), 150)}")
        remedy = "give its arguments as in normal(mean, deviation), uniform(low, high), or as scipy.stats has them"
        raise ArgumentError(finding, remedy) from None
    return frozen
