"""Statements of the thesis, and the means to measure them: rows, runs of commands, geodesics of landmarks.

`benchmarks/thesis.py` measures all entries, and `docs/_extensions/thesis_page.py` makes the page.

The geodesics use numpy and scipy only, so that they do not depend on generated code.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

ROOT = Path(__file__).resolve().parents[2]
REGISTRATION = ROOT / "problems" / "image_registration.py"
TRILOBITES = ROOT / "problems" / "data" / "trilobite40.csv"

Vector = NDArray[np.float64]


class Kind(StrEnum):
    """Kinds of statements, which are the sections of the page."""

    FIGURE = "Figures"
    TABLE = "Tables"
    CLAIM = "Claims"
    QUESTION = "Open questions"
    ERRATUM = "Errata"


class Agreement(StrEnum):
    """What a measurement says about a statement."""

    SAME = "reproduced"
    OTHER_DATA = "reproduced with other data"
    DIFFERENT = "measured otherwise"
    ANSWERED = "answered"
    CORRECTED = "corrected"


@dataclass(frozen=True)
class Row:
    """A measured quantity, the statement of the thesis about it, and the limits between which the value is expected."""

    quantity: str
    here: float
    there: str = ""
    low: float = -np.inf
    high: float = np.inf

    @property
    def holds(self) -> bool:
        """True if the value is within its limits."""
        return bool(self.low <= self.here <= self.high)


@dataclass(frozen=True)
class Entry:
    """A statement of the thesis, the commands that reproduce it, and the function that measures it.

    `measure` gets a function that runs the command with a number; {names} in commands are filled with values.
    """

    name: str
    kind: Kind
    place: str
    says: str
    measure: Callable[[Runs], Iterable[Row]]
    commands: tuple[str, ...]
    remark: str
    agreement: Agreement


@dataclass(frozen=True)
class Outcome:
    """The result of a command: its exit status, its JSON object and the arrays that it saved."""

    status: int
    record: dict[str, Any]
    arrays: dict[str, Vector]

    @property
    def cost(self) -> float:
        """The cost of a solved problem."""
        assert self.record["status"] == "solved", self.record["message"]
        return float(self.record["cost"])

    @property
    def seconds(self) -> float:
        """The seconds of the solve, without build and compilation."""
        return float(self.record["seconds"]["solve"])


class Runs:
    """Runs the commands of an entry in this process, from the root of the repository.

    `commands` has, for each command of the entry, the texts that were run.
    """

    def __init__(self, entry: Entry, folder: Path) -> None:
        self.entry, self.folder = entry, folder
        self.commands: list[list[str]] = [[] for _ in entry.commands]

    def __call__(self, number: int, **values: object) -> Outcome:
        """Run a command of the entry; `codegen solve` also prints JSON and saves its arrays."""
        import typer.testing

        from codegen.cli import main

        text = self.entry.commands[number].format(**values)
        self.commands[number].append(text.replace(f"{self.folder}/", ""))
        _, command, *arguments = shlex.split(text)
        saved = self.folder / "arrays.npz"
        options = {"solve": ["--json", "--save", str(saved)], "warp": ["--json"]}.get(command, [])
        done = typer.testing.CliRunner().invoke(main, [command, *arguments, *options])
        if done.exception is not None and not isinstance(done.exception, SystemExit):
            raise done.exception
        assert done.stdout or not options, f"{self.entry.commands[number]}: {done.stderr}"
        record: dict[str, Any] = json.loads(done.stdout) if options else {}
        arrays: dict[str, Vector] = {}
        if command == "solve" and saved.exists():
            with np.load(saved) as file:
                arrays = {name: file[name] for name in file.files}
            saved.unlink()
        return Outcome(done.exit_code, record, arrays)


def collected(
    kind: Kind, into: list[Entry], usual: Agreement = Agreement.SAME
) -> Callable[..., Callable[[Callable[[Runs], Iterable[Row]]], Entry]]:
    """Return a decorator that makes an entry of a function that measures, and adds the entry to a list."""

    def decorator(
        name: str, place: str, says: str, *commands: str, remark: str = "", agreement: Agreement = usual
    ) -> Callable[[Callable[[Runs], Iterable[Row]]], Entry]:
        def made(measure: Callable[[Runs], Iterable[Row]]) -> Entry:
            into.append(Entry(name, kind, place, says, measure, commands, remark, agreement))
            return into[-1]

        return made

    return decorator


# ---- Geodesics of landmarks in the unit disc ----


def green(x: Vector, y: Vector) -> Vector:
    """Return G = ab/2 - s/2 log(1 + ab/s) of (4.1.6), with a = 1 - |x|^2, b = 1 - |y|^2, s = |x - y|^2."""
    ab, s = (1 - (x**2).sum(-1)) * (1 - (y**2).sum(-1)), ((x - y) ** 2).sum(-1)
    return np.asarray(ab / 2 - s / 2 * np.log1p(ab / np.where(s > 0, s, np.inf)))


def green_slope(x: Vector, y: Vector) -> Vector:
    """Return the gradient of G by its first argument."""
    a, b, s = 1 - (x**2).sum(-1), 1 - (y**2).sum(-1), ((x - y) ** 2).sum(-1)
    share, logarithm = a * b / (s + a * b), np.log1p(a * b / np.where(s > 0, s, np.inf))
    return np.asarray(-(b * share)[..., None] * x + (share - logarithm)[..., None] * (x - y))


def velocity(x: Vector, q: Vector, p: Vector) -> Vector:
    """Return v(x) = sum_j p_j G(x, q_j) at points x (m, 2)."""
    return np.asarray(green(x[:, None], q[None]) @ p)


def force(q: Vector, p: Vector) -> Vector:
    """Return dp/dt = -dH/dq of (4.1.14b)."""
    return np.asarray(-np.einsum("ij,ijk->ik", p @ p.T, green_slope(q[:, None], q[None])))


def hamiltonian(q: Vector, p: Vector) -> float:
    """Return H = 1/2 sum p_i . p_j G(q_i, q_j)."""
    return float(0.5 * np.sum((p @ p.T) * green(q[:, None], q[None])))


def geodesic(q: Vector, p: Vector, points: Vector, times: Vector) -> tuple[Vector, Vector, Vector]:
    """Return landmarks, momenta and further points at `times`, by DOP853 at tolerance 1e-12."""
    count = q.size

    def field(_: float, z: Vector) -> Vector:
        at, momenta, x = (part.reshape(-1, 2) for part in np.split(z, [count, 2 * count]))
        rates = velocity(at, at, momenta), force(at, momenta), velocity(x, at, momenta)
        return np.concatenate([rate.ravel() for rate in rates])

    start = np.concatenate([q.ravel(), p.ravel(), points.ravel()])
    done = solve_ivp(field, (0.0, times[-1]), start, "DOP853", t_eval=times, rtol=1e-12, atol=1e-13)
    parts = np.split(done.y.T, [count, 2 * count], axis=1)
    q_t, p_t, x_t = (part.reshape(times.size, -1, 2) for part in parts)
    return q_t, p_t, x_t


def euler_warp(q: Vector, p: Vector, points: Vector, delayed: bool = True) -> Vector:
    """Return points after explicit steps along landmarks q, p (N + 1, n, 2); step k has q_k, or q_k+1 as in E.5.8."""
    x, shift = points, 0 if delayed else 1
    for k in range(len(q) - 1):
        x = x + velocity(x, q[k + shift], p[k]) / (len(q) - 1)
    return x


def disc_grid(rows: int = 61, radius: float = 0.999) -> Vector:
    """Return a grid (rows, rows, 2) on the square around the disc; points outside of `radius` are not a number."""
    line = np.linspace(-1, 1, rows)
    grid = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1)
    norm = np.linalg.norm(grid, axis=-1, keepdims=True)
    return np.asarray(np.where(norm > radius, np.nan, grid))


def least_area(places: Vector) -> float:
    """Return the least signed area of the cells of a warped grid (rows, rows, 2), relative to the mean area."""
    first, second = places[1:, 1:] - places[:-1, :-1], places[:-1, 1:] - places[1:, :-1]
    areas = 0.5 * (first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])
    return float(np.nanmin(areas) / abs(np.nanmean(areas)))


def trilobites() -> tuple[Vector, Vector]:
    """Return starts and targets (40, 2) of the landmarks of two trilobites."""
    table = np.loadtxt(TRILOBITES, delimiter=",", skiprows=1)
    return table[:, :2], table[:, 2:4]


def points_file(count: int) -> str:
    """Return the path of the file with `count` random landmarks, relative to the root of the repository."""
    return f"tests/thesis/landmarks_{count}.csv"


def order(steps: Iterable[int], errors: Iterable[float]) -> float:
    """Return the exponent of the decay of errors with the number of steps, by least squares."""
    return float(-np.polyfit(np.log(list(steps)), np.log(list(errors)), 1)[0])


def every(rows: Iterable[Row]) -> Iterator[Row]:
    """Yield rows, with values as plain numbers."""
    for row in rows:
        yield Row(row.quantity, float(row.here), row.there, row.low, row.high)
