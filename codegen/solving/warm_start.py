"""Initial guesses: warm starts from saved results, several varied guesses, and transfer between time grids.

Several guesses are useful for a nonlinear problem, which may have several local optima, and points near which its
equations cannot be satisfied. The first guess is the guess of the problem. Each further guess adds a smooth curve to
each quantity. The curve is a sum of a few sines that vanish at both ends and have random amplitudes. The seeds are
fixed, so that the same call uses the same guesses.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np

from codegen.errors import ArgumentError, NumericsError
from codegen.runtime.search.cascade import varied_guess
from codegen.solving.loading import ControlModule, GeneratedModule, Matrix, Vector, time_grid
from codegen.solving.results.result import Result, component_names
from codegen.solving.results.segments import segments_of

SAME = 1e-6
"""Relative difference of two costs below which the optima are considered to be the same."""
_REMEDY = "give a file that --save wrote when this problem was solved"


@dataclass(frozen=True)
class SavedStart:
    """The solution of an optimisation, read from a file that `--save` has written.

    `unknowns` (n,) are all unknowns. `names` has the names of the columns of q and u, and is empty if they were not
    saved. `nodes` is the number of nodes, or None.
    """

    path: Path
    unknowns: Vector
    names: dict[str, tuple[str, ...]]
    nodes: int | None


def start_of(warm: Result | Vector | Path | str) -> Callable[[GeneratedModule], Vector | None]:
    """Read a warm start, and return a function that maps a module to the initial unknowns (n,).

    The function raises ArgumentError if a saved warm start does not fit the module.
    """
    if not isinstance(warm, Path | str):
        values = warm.unknowns if isinstance(warm, Result) else warm
        unknowns = _vector("warm=", values, "give a result of this problem, or its unknowns")
        return lambda module: unknowns
    saved = read_start(Path(warm))
    return lambda module: fitting(saved, module)


def read_start(path: Path) -> SavedStart:
    """Return the solution of an optimisation from an .npz file.

    Raise ArgumentError if the file is missing or has no solution.
    """
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


def _vector(what: str, values: object, remedy: str) -> Vector:
    try:
        vector = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        vector = np.empty((0, 0))
    if vector.ndim != 1 or not np.isfinite(vector).all():
        raise ArgumentError(f"{what}: no vector of finite numbers", remedy)
    return vector


def fitting(saved: SavedStart, module: GeneratedModule) -> Vector:
    """Return the saved unknowns; raise ArgumentError if they belong to another problem than the module.

    The names of states and controls are compared, and the number of unknowns. Files without names are also accepted.
    """
    names, segments = component_names(module.metadata), segments_of(module.metadata)
    if segments is not None:
        names = {kind: segments.columns(columns)[0] for kind, columns in names.items()}
    for kind, quantities in (("q", "coordinates"), ("u", "controls")):
        in_file = saved.names.get(kind, ())
        if saved.names and in_file != names[kind]:
            lists = [", ".join(each) or "none" for each in (in_file, names[kind])]
            finding = f"--warm {saved.path}: its {quantities} are {lists[0]}, those of the problem {lists[1]}"
            raise ArgumentError(finding, _REMEDY)
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


def varied(module: ControlModule, steps: int, seed: int) -> Vector:
    """Return the initial guess of the problem on N = `steps` intervals, with a random smooth curve for every quantity.

    The curves are added to the guess, and depend only on `seed`.
    """
    grid = module.make_grid(steps)
    guess: Vector = varied_guess(grid, module.initial_guess(grid), seed)
    return guess


def best_of(solve: Callable[[Vector | None], Result], module: ControlModule, steps: int, starts: int) -> Result:
    """Solve from `starts` initial guesses; return the solution of least cost, or the first failure if all fail.

    `solve` maps an initial guess (n,) to a result; None means the guess of the problem. In the returned result
    `attempts` has a line for every guess. Its summary has the number of successful guesses, and the number of guesses
    that lead to the same cost as the returned solution.
    """
    results = [solve(None), *(solve(varied(module, steps, seed)) for seed in range(1, starts))]
    solved = [(result.cost, result) for result in results if result.solved and result.cost is not None]
    least, best = min(solved, key=lambda pair: pair[0], default=(np.inf, results[0]))
    alike = sum(abs(cost - least) <= SAME * max(1.0, abs(least)) for cost, _ in solved)
    attempts = []
    for number, result in enumerate(results, start=1):
        origin = "the problem's own" if number == 1 else "varied"
        cost = f", cost {result.cost:.9g}" if result.solved and result.cost is not None else ""
        attempts.append(f"guess {number} ({origin}): {result.status}, {result.iterations} iterations{cost}")
    summary = {**best.summary, "guesses": starts, "guesses_solved": len(solved), "guesses_with_this_cost": alike}
    return replace(best, attempts=tuple(attempts), summary=summary)


def transferred(
    module: ControlModule, unknowns: Vector, steps: int, source: Vector | None = None, target: Vector | None = None
) -> Vector:
    """Return the `unknowns` of a solution on another grid, with N = `steps` intervals in each phase.

    Values at nodes are interpolated between nodes, and values on intervals between midpoints, for every phase
    separately. The interpolation is monotone and does not overshoot. `source` and `target` are the lengths of the
    intervals, relative to the duration, on the old and the new grid; None means equal intervals. Raise NumericsError if
    the vector belongs to another problem.
    """
    old_steps = source_steps(module, unknowns)
    old_grid, new_grid = time_grid(module, old_steps, source), time_grid(module, steps, target)
    result = np.zeros(new_grid.is_multiplier.size)
    old_nodes, old_intervals = module.views(old_grid, unknowns)
    new_nodes, new_intervals = module.views(new_grid, result)
    old_times, new_times = old_grid.nodes / old_steps, new_grid.nodes / steps
    old_middles, new_middles = (0.5 * (times[:-1] + times[1:]) for times in (old_times, new_times))
    for phase in range(module.metadata.phases):
        first = min(phase, 1)  # the node at a switch has the values before a jump, and belongs to the phase before
        old, new = (slice(phase * n + first, (phase + 1) * n + 1) for n in (old_steps, steps))
        new_nodes[:, new] = interpolated(old_times[old], old_nodes[:, old], new_times[new])
        old, new = (slice(phase * n, (phase + 1) * n) for n in (old_steps, steps))
        new_intervals[:, new] = interpolated(old_middles[old], old_intervals[:, old], new_middles[new])
    root = module.problem.structure.root
    result[result.size - root :] = unknowns[unknowns.size - root :]
    return module.with_pinned_values(new_grid, result)


def interpolated(t: Vector, values: Matrix, at: Vector) -> Matrix:
    """Return values (bodies, times, quantities) at the times `at`, by monotone cubics through the values at `t`."""
    if t.size == 1:
        return np.repeat(values, at.size, axis=1)
    from scipy.interpolate import PchipInterpolator  # its import is slow

    with np.errstate(over="ignore"):  # scipy divides by slopes, which may be almost zero
        return np.asarray(PchipInterpolator(t, values, axis=1)(np.clip(at, t[0], t[-1])), dtype=float)


def source_steps(module: ControlModule, unknowns: Vector) -> int:
    """Return the number of intervals of each phase from the length of a vector of unknowns.

    Raise NumericsError if no number of intervals fits.
    """
    metadata, root = module.metadata, module.problem.structure.root
    node, bodies = len(metadata.node), metadata.bodies
    phase = metadata.phases * (node + len(metadata.interval))
    steps: int
    steps, rest = divmod((unknowns.size - root) // bodies - node, phase)
    if rest or steps < 1 or bodies * (steps * phase + node) + root != unknowns.size:
        raise NumericsError(
            f"the start has {unknowns.size} unknowns, which fit no number of steps",
            "use a solution of this problem by the same method, scheme and controls",
        )
    return steps
