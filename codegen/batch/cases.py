"""The cases of a sweep: a grid of values, a table with a row for each case, or samples; read and refused here.

Values are numbers, or texts where an argument of problem() takes words. A grid holds the values of each quantity once,
so that its size is that of the axes and not of their product.

Samples of distributions: any of scipy.stats by name, at points that are random, a Latin hypercube or of Sobol. Sources:
McKay, Beckman and Conover (1979) for Latin hypercubes; Sobol' (1967) and Owen (1998) for scrambled sequences.
"""

from __future__ import annotations

import ast
import csv
import difflib
import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from codegen.batch.executors.chunks import counted
from codegen.errors import ArgumentError, NumericsError, clause, one_line
from codegen.solving.interfaces import Matrix

Values: TypeAlias = NDArray[np.float64] | NDArray[np.str_]
MOST_CASES = 100_000_000
CASE = "case"
"""The dimension of cases that are no grid."""


@dataclass(frozen=True, eq=False)
class Cases:
    """The varied quantities by name: their values, and the dimension along which each varies.

    `columns` has arrays (n,), as long as their dimension; the number of cases is the product of the `shape`, and cases
    are counted with the last dimension varying fastest. Where they were read from a file, `lines` (n,) tells where.
    """

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    columns: Mapping[str, Values]
    axes: Mapping[str, int]
    file: Path | None = None
    lines: NDArray[np.intp] | None = None

    def __post_init__(self) -> None:
        """Refuse more cases than can be counted out."""
        if self.number > MOST_CASES:
            raise NumericsError(f"there are {self.number} cases, and at most {MOST_CASES} fit", "take fewer values")

    @property
    def number(self) -> int:
        """How many cases there are."""
        return math.prod(self.shape)

    @property
    def is_grid(self) -> bool:
        """Whether every quantity, or group of them, has a dimension of its own."""
        return self.dims != (CASE,)

    def origin(self, row: int) -> str:
        """Where a row was read, as the beginning of a message; nothing for cases that are in no file."""
        return "" if self.lines is None else f"{self.file}:{self.lines[row]}: "

    def places(self, indices: NDArray[np.intp]) -> dict[str, NDArray[np.intp]]:
        """Where the values of some cases stand in the column of each quantity, (n,) for n cases."""
        along = np.unravel_index(indices, self.shape)
        return {name: np.asarray(along[axis]) for name, axis in self.axes.items()}

    def chosen(self, indices: NDArray[np.intp]) -> dict[str, Values]:
        """The values of some cases, a column (n,) for each quantity."""
        return {name: self.columns[name][place] for name, place in self.places(indices).items()}

    def values(self, indices: NDArray[np.intp]) -> list[dict[str, float | str]]:
        """The values of some cases by name."""
        return rows_of(self.chosen(indices))

    def points(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        """Cases as points (n, quantities), every quantity in parts of its range; words are numbered."""
        return np.column_stack([self._ranges[name].parts(column) for name, column in self.chosen(indices).items()])

    def points_along(self, axis: int) -> NDArray[np.float64]:
        """The values of what varies along a dimension as points (n, quantities), in parts of ranges."""
        own = [name for name, place in self.axes.items() if place == axis]
        return np.column_stack([self._ranges[name].parts(self.columns[name]) for name in own])

    @cached_property
    def _ranges(self) -> dict[str, _Range]:
        """The range of each quantity, looked for once: columns may be long, and chunks many."""
        return {name: _range(column) for name, column in self.columns.items()}


def rows_of(columns: Mapping[str, Values]) -> list[dict[str, float | str]]:
    """Columns (n,) of values by name as n cases, each with its values by name."""
    return [dict(zip(columns, row)) for row in zip(*(column.tolist() for column in columns.values()), strict=True)]


@dataclass(frozen=True, eq=False)
class _Range:
    """The least value of a quantity and its extent, or its words."""

    least: float
    extent: float
    words: NDArray[np.str_] | None

    def parts(self, column: Values) -> NDArray[np.float64]:
        if self.words is not None:
            return np.searchsorted(self.words, column).astype(float)
        return np.asarray((np.asarray(column, dtype=float) - self.least) / self.extent)


def _range(column: Values) -> _Range:
    if column.dtype.kind == "U":
        return _Range(0.0, 1.0, np.unique(column))
    return _Range(float(np.min(column)), float(np.ptp(column)) or 1.0, None)


def grid(axes: Mapping[str, Any], zipped: Sequence[Sequence[str]] = ()) -> Cases:
    """All combinations of the values of each quantity; those that are zipped vary together, along one dimension.

    Raises ArgumentError for values that are none, and for names that cannot be zipped.
    """
    columns = {name: values_of(name, values) for name, values in axes.items()}
    heads = _heads(columns, zipped)
    dims = tuple(name for name in columns if heads[name] == name)
    shape = tuple(columns[name].size for name in dims)
    return Cases(dims, shape, columns, {name: dims.index(heads[name]) for name in columns})


def _heads(columns: Mapping[str, Values], zipped: Sequence[Sequence[str]]) -> dict[str, str]:
    """The quantity whose dimension each quantity varies along: its own, or the first of those it is zipped with."""
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
    return heads


def values_of(name: str, values: Any) -> Values:
    """The values of one quantity (n,), as numbers or as texts; ArgumentError for what is neither."""
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
    """The name and the values of `--vary`: NAME=first:last:count or NAME=a,b,c; ArgumentError for anything else."""
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
    """Both sides of NAME=TEXT; ArgumentError where one is missing."""
    name, equals, text = item.partition("=")
    if not (name.strip() and equals and text.strip()):
        raise ArgumentError(clause(f"{option} {item!r} is not of the form NAME=..."), f"write {option} {example}")
    return name.strip(), text.strip()


def number_of(what: str, text: str) -> float:
    """A finite number; ArgumentError for another text."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ArgumentError(clause(f"{what}: {text.strip()!r} is no finite number"), "give finite numbers")
    return number


def _column(words: Sequence[str]) -> Values:
    """Numbers where all words are numbers, else texts."""
    try:
        return np.array([float(word) for word in words])
    except ValueError:
        return np.array(words, dtype=np.str_)


def table(given: Any) -> Cases:
    """A case for each row of a file of comma-separated values, or of a mapping of names to columns.

    Raises ArgumentError, naming the file and the line, for what is no such table.
    """
    if isinstance(given, str | Path):
        return _table_of(Path(given))
    if hasattr(given, "keys"):
        columns = {str(name): np.asarray(given[name]) for name in given.keys()}  # noqa: SIM118  of pandas
    else:
        raise ArgumentError(
            f"cases are {clause(repr(given))}", "give a file, a mapping of names to columns, or a number"
        )
    if not columns:
        raise ArgumentError("cases: there are no columns", "give a column for each varied quantity")
    checked = {name: values_of(f"cases: {name}", values) for name, values in columns.items()}
    sizes = {values.size for values in checked.values()}
    if len(sizes) > 1:
        raise ArgumentError("cases: columns of different lengths", "give a row for each case")
    return as_rows(checked, sizes.pop())


def _table_of(path: Path) -> Cases:
    """The cases of a file, which know their lines."""
    words, lines = _read(path)
    if not words:
        raise ArgumentError(f"{path}: there are no columns", "name the varied quantities in the first line")
    found = replace(as_rows({name: _column(own) for name, own in words.items()}, lines.size), file=path, lines=lines)
    for name, column in found.columns.items():
        if column.dtype.kind == "f" and not np.isfinite(column).all():
            row = int(np.argmin(np.isfinite(column)))
            finding = f"{found.origin(row)}{name} is not finite ({column[row]})"
            raise ArgumentError(clause(finding), "give finite numbers")
    return found


def as_rows(columns: Mapping[str, Values], number: int) -> Cases:
    """Cases one after the other."""
    return Cases((CASE,), (number,), columns, dict.fromkeys(columns, 0))


def _read(path: Path) -> tuple[dict[str, list[str]], NDArray[np.intp]]:
    """The columns of a file, as text, and the lines of its rows."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            return _columns(path, csv.reader(file, skipinitialspace=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = one_line(getattr(error, "strerror", None) or str(error), 100)
        raise ArgumentError(f"--cases {path} cannot be read ({reason})", "give a table as text") from None


def _columns(path: Path, lines: Iterable[Sequence[str]]) -> tuple[dict[str, list[str]], NDArray[np.intp]]:
    rows = ((number, [word.strip() for word in line]) for number, line in enumerate(lines, start=1) if line)
    _, names = next(rows, (1, []))
    if not all(names) or len(set(names)) < len(names):
        finding = f"{path}:1: the names {clause(','.join(names))} are missing in parts, or twice there"
        raise ArgumentError(finding, "name each varied quantity once in the first line")
    columns: dict[str, list[str]] = {name: [] for name in names}
    numbers = list[int]()
    for number, words in rows:
        if len(words) != len(names) or not all(words):
            there = counted(sum(map(bool, words)), "value")
            finding = f"{path}:{number}: {there} for {counted(len(names), 'name')}"
            raise ArgumentError(finding, "give a value for every name")
        numbers.append(number)
        for name, word in zip(names, words, strict=True):
            columns[name].append(word)
    if names and not columns[names[0]]:
        raise ArgumentError(f"{path} holds no cases", "give a line for each case behind the names")
    return columns, np.array(numbers, dtype=np.intp)


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
