"""Files that a problem reads: files of points, and a record of all files that were read.

In a file of points every row is the start and the target of one particle. The first line names the columns:
`x0,y0,x1,y1` in the plane, `x0,y0,z0,x1,y1,z1` in space, and optionally `sigma`, the standard deviation of the target.
Importing this file imports no numpy, and reading points needs neither sympy nor a generated module.
"""

from __future__ import annotations

import csv
import hashlib
import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

from codegen.errors import PointsError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Points: TypeAlias = Annotated[Path, "points"]
"""The type of an argument of problem() that names a file of points.

A relative default path is located in the folder of the problem file.
"""

_AXES = "xyzuvw"
_folder: ContextVar[Path | None] = ContextVar("folder of the problem file", default=None)
_recorder: ContextVar[list[DataFile] | None] = ContextVar("files that were read", default=None)


@dataclass(frozen=True)
class PointSet:
    """The starts and targets (n, d) of n particles, and the standard deviations `sigma` (n,) of the targets."""

    start: NDArray[np.float64]
    target: NDArray[np.float64]
    sigma: NDArray[np.float64]

    @property
    def table(self) -> NDArray[np.float64]:
        """All numbers in one array (n, 2 d + 1): start, target and standard deviation of each particle."""
        import numpy as np

        return np.column_stack([self.start, self.target, self.sigma])


def read_points(path: Path, dimension: int) -> PointSet:
    """Return the points in a file; `dimension` is the dimension of space.

    Raise PointsError, which names the file and the line, if the file is missing, empty or no text. The same error is
    raised for rows of different lengths, missing columns, values that are no finite numbers, and too many points for
    the memory.
    """
    import numpy as np

    columns = [f"{axis}{end}" for end in "01" for axis in _AXES[:dimension]]
    if not path.is_file():
        raise PointsError(f"{path}: no such file", f"give a table with the columns {','.join(columns)}")
    if hasattr(os, "sysconf"):  # the matrix of all interactions must fit into memory
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        most = int(math.sqrt(memory / 32.0))
        with path.open("rb") as binary:
            lines = sum(block.count(b"\n") for block in iter(lambda: binary.read(1 << 20), b""))
        if lines > most + 1:
            raise PointsError(
                f"{path} holds about {lines} points, whose matrix of interactions takes {8e-9 * lines**2:.0f} GB",
                f"give at most {most} points on this machine",
            )
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
    start, target = (
        np.stack([by_name[name] for name in names], axis=1) for names in (columns[:dimension], columns[dimension:])
    )
    sigma = by_name.get("sigma", np.zeros(len(table)))
    if (sigma < 0.0).any():
        line = rows[1 + int(np.argmax(sigma < 0.0))][0]
        raise PointsError(f"{path}:{line}: sigma is negative", "give standard deviations")
    return PointSet(start, target, sigma)


def finite_numbers(file: Path | str, line: int, row: Sequence[str], header: Sequence[str]) -> list[float]:
    """Return the numbers of one row of a file.

    `line` is the number of the line, and `header` has the names of the columns. Raise PointsError, which names the
    file, the line and the column, for a value that is no finite number.
    """
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


@dataclass(frozen=True)
class DataFile:
    """A file that was read: its path as the user wrote it, and the SHA-256 of its content in hexadecimal."""

    path: str
    digest: str


def data_file(path: Path) -> Path:
    """Return the path of a file that a problem reads, and record the file; see `recorded_files`.

    A relative path is joined to the folder of the problem.
    """
    folder = _folder.get()
    located = path if folder is None else folder / path
    recorded = _recorder.get()
    if recorded is not None and located.is_file():
        recorded.append(DataFile(path.as_posix(), digest_of(located)))
    return located


def digest_of(path: Path) -> str:
    """Return the SHA-256 of the content of a file in hexadecimal; empty if the file cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""


@contextmanager
def beside(folder: Path) -> Iterator[None]:
    """Let `data_file` resolve relative paths in a folder during a with block."""
    token = _folder.set(folder)
    try:
        yield
    finally:
        _folder.reset(token)


@contextmanager
def recorded_files() -> Iterator[list[DataFile]]:
    """Record the files that `data_file` locates during a with block; the value of the block is the list of files."""
    files: list[DataFile] = []
    token = _recorder.set(files)
    try:
        yield files
    finally:
        _recorder.reset(token)
