"""Files of points: tables in which every row says where one particle starts and where it is to arrive.

The first line names the columns: `x0,y0,x1,y1` in the plane, `x0,y0,z0,x1,y1,z1` in space, and optionally `sigma`, the
standard deviation with which an arrival is known. Reading needs neither sympy nor a generated module.

Files that a problem file reads: where they lie, and that they were read.
"""

from __future__ import annotations

import csv
import hashlib
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeAlias

import numpy as np
from numpy.typing import NDArray

from codegen.errors import PointsError

Points: TypeAlias = Annotated[Path, "points"]
"""The type of an argument of problem() that names a file of points; a relative default lies beside the problem."""

_AXES = "xyzuvw"


@dataclass(frozen=True)
class PointSet:
    """Starts and targets, arrays of shape (n, d), and the standard deviations of the targets, shape (n,)."""

    start: NDArray[np.float64]
    target: NDArray[np.float64]
    sigma: NDArray[np.float64]

    @property
    def table(self) -> NDArray[np.float64]:
        """All numbers, (n, 2 d + 1)."""
        return np.column_stack([self.start, self.target, self.sigma])


def read_points(path: Path, dimension: int) -> PointSet:
    """Read a file of points in space of the given dimension.

    Raises PointsError, naming the file and the line, when the file is missing, empty, ragged, no text, lacks columns
    or holds what is no finite number, and when it holds more points than could be solved for in memory.
    """
    columns = [f"{axis}{end}" for end in "01" for axis in _AXES[:dimension]]
    if not path.is_file():
        raise PointsError(f"{path}: no such file", f"give a table with the columns {','.join(columns)}")
    _require_size(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [(number, row) for number, row in enumerate(csv.reader(file), 1) if any(map(str.strip, row))]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise PointsError(f"{path} cannot be read ({error})", "give a table of numbers as text") from error
    if not rows:
        raise PointsError(f"{path} is empty", f"give a table with the columns {','.join(columns)}")
    header = [name.strip() for name in rows[0][1]]
    if sorted(set(header) - {"sigma"}) != sorted(columns) or len(set(header)) < len(header):
        remedy = f"name the columns {','.join(columns)} in the first line, and sigma if targets are uncertain"
        raise PointsError(f"{path}: the columns are {','.join(header)[:100]}", remedy)
    if len(rows) == 1:
        raise PointsError(f"{path} holds no points", "give one row for every point")
    table = np.array([finite_numbers(path, number, row, header) for number, row in rows[1:]])
    by_name = {name: table[:, index] for index, name in enumerate(header)}
    start, target = (np.stack([by_name[name] for name in names], axis=1) for names in _halves(columns))
    sigma = by_name.get("sigma", np.zeros(len(table)))
    if (sigma < 0.0).any():
        line = rows[1 + int(np.argmax(sigma < 0.0))][0]
        raise PointsError(f"{path}:{line}: sigma is negative", "give standard deviations")
    return PointSet(start, target, sigma)


def _halves(columns: Sequence[str]) -> Iterable[Sequence[str]]:
    half = len(columns) // 2
    return columns[:half], columns[half:]


def _require_size(path: Path) -> None:
    """Refuse, before it is parsed, a file whose points have a matrix of interactions that exceeds the memory."""
    if not hasattr(os, "sysconf"):
        return
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    most = int(math.sqrt(memory / 32.0))
    with path.open("rb") as file:
        lines = sum(block.count(b"\n") for block in iter(lambda: file.read(1 << 20), b""))
    if lines > most + 1:
        raise PointsError(
            f"{path} holds about {lines} points, whose matrix of interactions takes {8e-9 * lines**2:.0f} GB",
            f"give at most {most} points on this machine",
        )


def finite_numbers(file: Path | str, line: int, row: Sequence[str], header: Sequence[str]) -> list[float]:
    """The numbers of one line of a file; PointsError names the file, the line and the column of what is none."""
    if len(row) != len(header):
        raise PointsError(
            f"{file}:{line}: {len(row)} values for {len(header)} columns", f"give {','.join(header)} in every row"
        )
    numbers = []
    for name, text in zip(header, row, strict=True):
        try:
            number = math.nan if "_" in text else float(text)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise PointsError(f"{file}:{line}: {name} is {text.strip()[:30]!r}", "give finite numbers")
        numbers.append(number)
    return numbers


_folder: ContextVar[Path | None] = ContextVar("folder of the problem file", default=None)
_recorder: ContextVar[list[DataFile] | None] = ContextVar("files that were read", default=None)


@dataclass(frozen=True)
class DataFile:
    """A file as the author wrote its path, and the SHA-256 of what is in it, in hexadecimal."""

    path: str
    digest: str


def data_file(path: Path) -> Path:
    """The path of a file that a problem file reads, relative to its folder; what it holds is recorded."""
    folder = _folder.get()
    found = path if folder is None else folder / path
    recorded = _recorder.get()
    if recorded is not None and found.is_file():
        recorded.append(DataFile(path.as_posix(), digest_of(found)))
    return found


def digest_of(path: Path) -> str:
    """The SHA-256 of a file, nothing of one that cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""


@contextmanager
def beside(folder: Path) -> Iterator[None]:
    """Take relative paths from a folder, inside the block."""
    token = _folder.set(folder)
    try:
        yield
    finally:
        _folder.reset(token)


@contextmanager
def recorded_files() -> Iterator[list[DataFile]]:
    """Record the files that are read inside the block."""
    files: list[DataFile] = []
    token = _recorder.set(files)
    try:
        yield files
    finally:
        _recorder.reset(token)
