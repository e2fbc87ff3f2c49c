"""The motion that follows from the given start under the controls of a guess, interval by interval.

Where all states are given at the start and none at the end, a guess by straight lines is constant, and grossly violates
dynamics that grow or decay: of epidemics, cells and reactions the first steps then go far astray. A motion obeys them,
but may be no better a start where the dynamics are unstable, so that searches begin there only after others have taken
long, or failed.
"""

import numpy as np

from codegen.runtime.search.bounds import bounds_of
from codegen.runtime.search.parts import fill
from codegen.runtime.search.slacks import with_slacks

NEWTON_STEPS = 20  # on one interval
RELATIVE = 1e-10  # part of what is solved for that the last of them may be
BEYOND = 1e6  # a motion that grows by it runs away


def motion_entries(s):
    """Return the entries of an interval's Hessian that belong to the motion: (3, m), with number, row and column."""
    row, column = ({int(j): i for i, j in enumerate(kind)} for kind in (s.motion_equations, s.motion_unknowns))
    pairs = list(enumerate(zip(s.rows.tolist(), s.columns.tolist(), strict=True)))
    found = [(k, row[i], column[j]) for k, (i, j) in pairs if i in row and j in column]
    found += [(k, row[j], column[i]) for k, (i, j) in pairs if j in row and i in column]
    return np.array(found).T


def forward_motion(grid, unknowns):
    """Return the unknowns (n,) of the motion under the controls of a guess (n,), without multipliers, or None.

    Controls are moved inside their bounds. Everything is in the problem's own units.
    """
    s, (lower, upper) = grid.problem.structure, bounds_of(grid)
    own = np.minimum(np.maximum(np.where(grid.is_multiplier, 0.0, unknowns), lower), upper)
    limit, common = BEYOND * max(1.0, np.abs(own).max()), own[own.size - s.root :]
    piece, inside = np.concatenate([own[: s.element], common]), s.motion_unknowns[s.motion_unknowns < s.stride]
    entries = motion_entries(s)
    for k in range(grid.steps):
        first, solved = k * s.stride, piece[inside]
        piece[: s.element] = own[first : first + s.element]
        piece[s.stride : s.element] = piece[: s.node]
        if k > 0:
            piece[inside] = solved  # stages begin as those of the interval before
        if not is_solved_for_motion(grid, k, piece, entries) or not np.abs(piece).max() <= limit:
            return None
        own[first + s.motion_unknowns] = piece[s.motion_unknowns]
    if s.slacks.size:
        own = with_slacks(grid, own)
    return own


def is_solved_for_motion(grid, k, piece, entries):
    """Return True if Newton's method finds the state after interval k, and its stages, from the state before it.

    `piece` (element + root,) has the unknowns of the interval and both nodes, and those that no node owns.
    """
    s, (entry, row, column) = grid.problem.structure, entries
    times, gradient, values = grid.nodes[k : k + 2].copy(), np.empty(piece.size), np.empty(s.entry_count(1))
    data = 1, grid.h, times, grid.parameters
    matrix = np.zeros((s.motion_equations.size, s.motion_unknowns.size))
    for _ in range(NEWTON_STEPS):
        fill(grid.problem.gradient.address, piece, *data, gradient)
        fill(grid.problem.hessians.address, piece, *data, values)
        matrix[row, column] = values[entry]
        if not np.isfinite(matrix).all():
            return False
        try:
            step = np.linalg.solve(matrix, gradient[s.motion_equations])
        except np.linalg.LinAlgError:
            return False
        piece[s.motion_unknowns] -= step
        if not np.abs(step).max() < np.inf:
            return False
        if (np.abs(step) <= RELATIVE * np.maximum(1.0, np.abs(piece[s.motion_unknowns]))).all():
            return True
    return False
