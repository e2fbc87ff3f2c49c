"""Time grids as fractions of every phase: bisected, and distributed anew by how much error an interval makes.

A grid is an array (phases, N) of what its intervals last, in parts of their phase. Sources: de Boor (1973), Good
approximation by splines with variable knots, for equidistribution; Betts (2010), Practical methods for optimal control,
section 4.7.
"""

from __future__ import annotations

import numpy as np

from codegen.loading import Matrix, Vector

LEAST_DENSITY = 0.1
"""Of the mean density of nodes, where nothing happens."""
GRADE = 0.5
"""By how much of the distance between them two intervals may differ in length."""
SHORTEST = 1e-9
"""Part of a phase that an interval has at least."""


def equal(phases: int, steps: int) -> Matrix:
    """N = `steps` equal intervals in every phase."""
    return np.full((phases, steps), 1.0 / steps)


def bisected(grid: Matrix) -> Matrix:
    """The grid with every interval cut in two."""
    return np.repeat(grid / 2.0, 2, axis=1)


def node_indices(grid: Matrix) -> Matrix:
    """The indices of all nodes in their phase, from zero to one: (phases, N + 1)."""
    ends = np.cumsum(grid, axis=1)
    indices = np.concatenate([np.zeros((len(grid), 1)), ends / ends[:, -1:]], axis=1)
    indices[:, -1] = 1.0
    return indices


def redistributed(grid: Matrix, errors: Matrix, order: int, steps: int) -> Matrix:
    """A grid of N = `steps` intervals that make errors of equal size; `errors` (phases, N_old) are those of `grid`.

    An error is taken to be of the order p + 1, p = `order`, in the length of its interval. Lengths of neighbours do not
    differ by much, and no interval is much longer than the mean.
    """
    return np.array([_distributed(own, error, order, steps) for own, error in zip(grid, errors, strict=True)])


def needed(errors: Matrix, order: int, ratio: float) -> float:
    """How many intervals make an error that is `ratio` times smaller, when they all make errors of equal size."""
    amounts = (np.maximum(errors, 0.0) ** (1.0 / (order + 1))).sum(axis=1)
    total = float(errors.sum())
    return float((ratio * (amounts ** (order + 1)).sum() / total) ** (1.0 / order)) if total > 0.0 else 1.0


def _distributed(lengths: Vector, errors: Vector, order: int, steps: int) -> Vector:
    """The same of one phase."""
    amount = np.maximum(errors, 0.0) ** (1.0 / (order + 1))
    if not amount.sum() > 0.0:
        return np.full(steps, 1.0 / steps)
    wanted = lengths * amount.sum() / (np.maximum(amount, 1e-30) * steps)
    density = 1.0 / np.minimum(_graded(wanted, lengths), 1.0 / (LEAST_DENSITY * steps))
    share = np.concatenate([[0.0], np.cumsum(density * lengths)])
    indices = np.concatenate([[0.0], np.cumsum(lengths)])
    nodes = np.interp(np.linspace(0.0, share[-1], steps + 1), share, indices)
    new = np.maximum(np.diff(nodes), SHORTEST)
    return np.asarray(new / new.sum(), dtype=float)


def _graded(wanted: Vector, lengths: Vector) -> Vector:
    """Lengths, no longer than those that are wanted, that change no faster than GRADE times the distance."""
    out, middles = wanted.copy(), np.cumsum(lengths) - lengths / 2.0
    distance = np.diff(middles)
    for k in range(1, out.size):
        out[k] = min(out[k], out[k - 1] + GRADE * distance[k - 1])
    for k in range(out.size - 2, -1, -1):
        out[k] = min(out[k], out[k + 1] + GRADE * distance[k])
    return out
