"""Saved results to start from: reading a file of `--save`, and refusing one that belongs to another problem.

Several first guesses: a nonlinear problem has local optima, and points near which its equations cannot be satisfied.
The first guess is the problem's own. To each further one smooth curves are added, sums of a few sines that vanish at
both ends with random amplitudes, one curve for each quantity. They are seeded: the same call gives the same guesses.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from codegen.errors import ArgumentError, NumericsError
from codegen.runtime.search.cascade import varied_guess
from codegen.solving.loading import ControlModule, GeneratedModule, Matrix, Vector, time_grid
from codegen.solving.results.result import Result, component_names
from codegen.solving.results.segments import segments_of

_REMEDY = "give a file that --save wrote when this problem was solved"


@dataclass(frozen=True)
class SavedStart:
    """The unknowns of a saved optimisation, and what the file says of their meaning, if it does.

    `names` are those of the columns of q and u; `nodes` is how many times there are.
    """

    path: Path
    unknowns: Vector
    names: dict[str, tuple[str, ...]]
    nodes: int | None


def start_of(warm: Vector | Path | str | None) -> Callable[[GeneratedModule], Vector | None]:
    """What gives the unknowns to start from, read from their file already, once there is a module for them to fit."""
    if warm is None:
        return lambda module: None
    if not isinstance(warm, Path | str):
        unknowns = _vector("--warm", warm, "give the unknowns of a result")
        return lambda module: unknowns
    saved = read_start(Path(warm))
    return lambda module: fitting(saved, module)


def read_start(path: Path) -> SavedStart:
    """Read a saved optimisation; ArgumentError when there is no such file, or no solution in it."""
    if not path.is_file():
        raise ArgumentError(f"--warm {path}: {'is a directory' if path.is_dir() else 'no such file'}", _REMEDY)
    try:
        if not zipfile.is_zipfile(path):
            raise ArgumentError(f"--warm {path} is no .npz file", _REMEDY)
        with np.load(path, allow_pickle=False) as archive:
            if "unknowns" not in archive:
                raise ArgumentError(f"--warm {path} holds no unknowns of an optimisation", _REMEDY)
            unknowns = _vector(f"--warm {path}: its unknowns", archive["unknowns"], _REMEDY)
            named = [name for name in ("q", "u") if f"{name}_names" in archive]
            names = {name: tuple(map(str, archive[f"{name}_names"])) for name in named}
            nodes = archive["t"].size if "t" in archive else None
    except (OSError, ValueError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        reason = " ".join(f"{error}".split())
        raise ArgumentError(f"--warm {path} cannot be read ({reason})", _REMEDY) from None
    return SavedStart(path, unknowns, names, nodes)


def _vector(what: str, values: Any, remedy: str) -> Vector:
    """Values as a vector; ArgumentError says what is none."""
    try:
        vector = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        vector = np.empty((0, 0))
    if vector.ndim != 1 or not np.isfinite(vector).all():
        raise ArgumentError(f"{what}: no vector of finite numbers", remedy)
    return vector


def fitting(saved: SavedStart, module: GeneratedModule) -> Vector:
    """The saved unknowns, if they may be those of a module; ArgumentError tells by what they are not.

    A file without names is judged by its size alone.
    """
    own, segments = component_names(module.metadata), segments_of(module.metadata)
    if segments is not None:
        own = {kind: segments.columns(names)[0] for kind, names in own.items()}
    for kind, what in (("q", "coordinates"), ("u", "controls")):
        given = saved.names.get(kind, ())
        if saved.names and given != own[kind]:
            differ = f"its {what} are {_listed(given)}, those of the problem {_listed(own[kind])}"
            raise ArgumentError(f"--warm {saved.path}: {differ}", _REMEDY)
    remedy = f"{_REMEDY}, by the same method, scheme and controls"
    try:
        steps = source_steps(cast(ControlModule, module), saved.unknowns)
    except NumericsError:
        finding = f"--warm {saved.path}: its {saved.unknowns.size} unknowns fit no number of steps of this problem"
        raise ArgumentError(finding, remedy) from None
    parts = segments.number if segments else module.metadata.phases
    if saved.nodes is not None and saved.nodes != steps * parts + 1:
        finding = f"--warm {saved.path}: its {saved.unknowns.size} unknowns on {saved.nodes} nodes are others than here"
        raise ArgumentError(finding, remedy)
    return saved.unknowns


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(names) or "none"


SAME = 1e-6
"""The relative difference up to which two costs belong to one optimum."""


def varied(module: ControlModule, steps: int, seed: int) -> Vector:
    """The problem's own guess on N = `steps` intervals with a random smooth curve added to every quantity."""
    grid = module.make_grid(steps)
    guess: Vector = varied_guess(grid, module.initial_guess(grid), seed)
    return guess


def best_of(solve: Callable[[Vector | None], Result], module: ControlModule, steps: int, starts: int) -> Result:
    """Solve from `starts` guesses; the solution of least cost, or the first failure where nothing is solved.

    Every guess has a line in `attempts`. The summary gains how many guesses were solved, and how many of them ended in
    the optimum that is returned.
    """
    results = [solve(None), *(solve(varied(module, steps, seed)) for seed in range(1, starts))]
    solved = [result for result in results if result.solved and result.cost is not None]
    best = min(solved, key=_cost, default=results[0])
    alike = sum(abs(_cost(result) - _cost(best)) <= SAME * max(1.0, abs(_cost(best))) for result in solved)
    return replace(
        best,
        attempts=tuple(_line(number, result) for number, result in enumerate(results, start=1)),
        summary={**best.summary, "guesses": starts, "guesses_solved": len(solved), "guesses_with_this_cost": alike},
    )


def _cost(result: Result) -> float:
    return float("inf") if result.cost is None else result.cost


def _line(number: int, result: Result) -> str:
    origin = "the problem's own" if number == 1 else "varied"
    cost = f", cost {result.cost:.9g}" if result.solved and result.cost is not None else ""
    return f"guess {number} ({origin}): {result.status}, {result.iterations} iterations{cost}"


def transferred(
    module: ControlModule, unknowns: Vector, steps: int, source: Vector | None = None, target: Vector | None = None
) -> Vector:
    """A solution's unknowns on a grid of N intervals, N = `steps`: interpolated in time, without overshoot.

    Nodes are interpolated between nodes, intervals between their midpoints, in every phase by itself. Intervals are
    equal, or last the fractions `source` of the solution and `target` of the new grid. Raises NumericsError when the
    vector belongs to another problem.
    """
    old_steps = source_steps(module, unknowns)
    old_grid, new_grid = time_grid(module, old_steps, source), time_grid(module, steps, target)
    result = np.zeros(new_grid.is_multiplier.size)
    old_nodes, old_intervals = module.views(old_grid, unknowns)
    new_nodes, new_intervals = module.views(new_grid, result)
    old_times, new_times = old_grid.nodes / old_steps, new_grid.nodes / steps
    for phase in range(module.metadata.phases):
        first = min(phase, 1)  # the node at a switch belongs to the phase before, since it has the values before a jump
        old, new = (slice(phase * n + first, (phase + 1) * n + 1) for n in (old_steps, steps))
        new_nodes[:, new] = _interpolated(old_times[old], old_nodes[:, old], new_times[new])
        old, new = (slice(phase * n, (phase + 1) * n) for n in (old_steps, steps))
        new_intervals[:, new] = _interpolated(_middles(old_times)[old], old_intervals[:, old], _middles(new_times)[new])
    rest = module.problem.structure.root
    result[result.size - rest :] = unknowns[unknowns.size - rest :]
    return module.with_pinned_values(new_grid, result)


def source_steps(module: ControlModule, unknowns: Vector) -> int:
    """The number of intervals, of each phase, that a vector of unknowns belongs to."""
    metadata = module.metadata
    node, bodies = len(metadata.node), metadata.bodies
    phase = metadata.phases * (node + len(metadata.interval))
    steps: int
    steps, rest = divmod((unknowns.size - module.problem.structure.root) // bodies - node, phase)
    if rest or steps < 1 or bodies * (steps * phase + node) + module.problem.structure.root != unknowns.size:
        raise NumericsError(
            f"the start has {unknowns.size} unknowns, which fit no number of steps", "use a solution of this problem"
        )
    return steps


def _middles(times: Vector) -> Vector:
    return 0.5 * (times[:-1] + times[1:])


def _interpolated(t: Vector, values: Matrix, at: Vector) -> Matrix:
    if t.size == 1:
        return np.repeat(values, at.size, axis=1)
    from scipy.interpolate import PchipInterpolator  # which takes long to import

    with np.errstate(over="ignore"):  # reciprocals of slopes that are next to zero
        return np.asarray(PchipInterpolator(t, values, axis=1)(np.clip(at, t[0], t[-1])), dtype=float)
