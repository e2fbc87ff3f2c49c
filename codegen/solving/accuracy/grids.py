"""Time grids as fractions of every phase: bisected, and distributed anew by how much error an interval makes.

A grid is an array (phases, N) of what its intervals last, in parts of their phase. Sources: de Boor (1973), Good
approximation by splines with variable knots, for equidistribution; Betts (2010), Practical methods for optimal control,
section 4.7.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from codegen.interfaces import Matrix, Vector
from codegen.solving.accuracy.arcs import FAR, Gap, around

LEAST_DENSITY = 0.1
"""Of the mean density of nodes, where nothing happens."""
GRADE = 0.5
"""By how much of the distance between them two intervals may differ in length."""
CUTS = 8
"""Intervals into which a gap between two arcs is cut."""
PIECES = 8
"""Parts of an interval on each of which new intervals have one length."""
SHORTEST = 1e-9
"""Part of a phase that an interval has at least."""


def equal(phases: int, steps: int) -> Matrix:
    """N = `steps` equal intervals in every phase."""
    return np.full((phases, steps), 1.0 / steps)


def bisected(grid: Matrix) -> Matrix:
    """The grid with every interval cut in two."""
    return np.repeat(grid / 2.0, 2, axis=1)


def refined(
    grid: Matrix,
    errors: Matrix,
    order: int,
    ratio: float,
    limits: tuple[float, float],
    gaps: Sequence[Gap],
    narrow: float = SHORTEST,
) -> Matrix:
    """A grid whose intervals on arcs make equal errors, `ratio` times smaller in all, and whose gaps are cut.

    `errors` (phases, N) are those of the intervals of `grid`, of the order p + 1, p = `order`, in their length. The
    number of intervals on the arcs of a phase is between the two `limits`. Lengths of neighbours do not differ by much.
    A gap that is `narrow` is not cut any more, and where its switching time is known, a node is moved there.
    """
    amounts = _amounts(grid, errors, order, gaps)
    total = float((amounts ** (order + 1)).sum())
    wished = (ratio * (amounts.sum(axis=1) ** (order + 1)).sum() / total) ** (1.0 / order) if total > 0.0 else LEAST
    count = float(np.clip(wished, max(LEAST, limits[0]), limits[1]))
    lengths = [
        _lengths(own, amount, count, [gap for gap in gaps if gap.phase == phase], narrow)
        for phase, (own, amount) in enumerate(zip(grid, amounts, strict=True))
    ]
    steps = max(int(np.ceil((pieces / wanted).sum())) for pieces, wanted in lengths)
    times = [[gap.switch for gap in gaps if gap.phase == phase] for phase in range(len(grid))]
    return np.array([_placed(*own, steps, known) for own, known in zip(lengths, times, strict=True)])


def through(grid: Matrix, places: Sequence[float]) -> Matrix:
    """A grid of one phase whose nodes are moved so that some of them are at given places, in parts of the whole."""
    if not places:
        return grid
    nodes, count = np.append(0.0, np.cumsum(grid[0])), len(places)
    chosen = [0]
    for number, place in enumerate(places):
        nearest = int(np.argmin(np.abs(nodes - place)))
        chosen.append(min(max(nearest, chosen[-1] + 1), nodes.size - 1 - (count - number)))
    moved = np.interp(nodes, nodes[[*chosen, -1]], [0.0, *places, nodes[-1]])
    return np.asarray(np.diff(moved)[None] / nodes[-1], dtype=float)


def _amounts(grid: Matrix, errors: Matrix, order: int, gaps: Sequence[Gap]) -> Matrix:
    """How many intervals each interval is worth, up to a factor; in gaps and beside them as many as farther away."""
    amounts = np.maximum(errors, 0.0) ** (1.0 / (order + 1))
    for phase, lengths in enumerate(grid):
        known = np.ones(lengths.size, bool)
        for gap in gaps:
            if gap.phase == phase:
                known[around(np.cumsum(lengths), gap, FAR)] = False
        if known.any():
            middles = np.cumsum(lengths) - lengths / 2.0
            density = amounts[phase, known] / lengths[known]
            amounts[phase, ~known] = np.interp(middles[~known], middles[known], density) * lengths[~known]
    return amounts


LEAST = 10.0
"""Intervals of a phase at least."""


def _lengths(
    lengths: Vector, amounts: Vector, count: float, gaps: Sequence[Gap], narrow: float
) -> tuple[Vector, Vector]:
    """The pieces of a phase, and how long intervals on each of them shall be."""
    mean = amounts.sum() / count
    longest = 1.0 / (LEAST_DENSITY * count)
    wanted = np.minimum(lengths * mean / np.maximum(amounts, 1e-3 * mean * lengths + 1e-300), longest)
    nodes = np.concatenate([[0.0], np.cumsum(np.repeat(lengths / PIECES, PIECES))])
    cuts = [np.linspace(gap.begin, gap.end, CUTS + 1) for gap in gaps]
    nodes = np.unique(np.clip(np.concatenate([nodes, *cuts]), 0.0, nodes[-1]))
    nodes = nodes[np.append(True, np.diff(nodes) > 1e-14)]
    pieces, middles = np.diff(nodes), 0.5 * (nodes[:-1] + nodes[1:])
    own = np.searchsorted(np.cumsum(lengths), middles)
    fine = wanted[np.minimum(own, lengths.size - 1)]
    for gap in gaps:
        inside = (middles > gap.begin) & (middles < gap.end)
        fine[inside] = np.minimum(fine[inside], max((gap.end - gap.begin) / CUTS, narrow / 4.0))
    return pieces, _graded(fine, middles)


def _graded(wanted: Vector, middles: Vector) -> Vector:
    """Lengths, no longer than those that are wanted, that change no faster than GRADE times the distance."""
    out, distance = wanted.copy(), GRADE * np.diff(middles)
    for k in range(1, out.size):
        out[k] = min(out[k], out[k - 1] + distance[k - 1])
    for k in range(out.size - 2, -1, -1):
        out[k] = min(out[k], out[k + 1] + distance[k])
    return out


def _placed(pieces: Vector, wanted: Vector, steps: int, switches: Sequence[float | None]) -> Vector:
    """N = `steps` intervals whose lengths are in proportion to those that are wanted, with nodes at switching times."""
    share = np.concatenate([[0.0], np.cumsum(pieces / wanted)])
    nodes = np.interp(np.linspace(0.0, share[-1], steps + 1), share, np.concatenate([[0.0], np.cumsum(pieces)]))
    for switch in switches:
        if switch is not None:
            nodes[1 + int(np.argmin(np.abs(nodes[1:-1] - switch)))] = switch
    new = np.maximum(np.diff(nodes), SHORTEST / 4.0)
    return np.asarray(new / new.sum(), dtype=float)
