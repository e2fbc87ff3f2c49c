"""The motion that follows from the given start under the controls of a guess, interval by interval.

Where all states are given at the start and none at the end, a guess by straight lines is constant, and grossly violates
dynamics that grow or decay: of epidemics, cells and reactions the first steps then go far astray. A motion obeys them,
but may be no better a place to begin where the dynamics are unstable, so that searches begin there only after others
have taken long, or failed.
"""

import numpy as np

from codegen.runtime.optimise.active_bounds import bounds_of
from codegen.runtime.optimise.callbacks import interval_hessians
from codegen.runtime.stand_ins.example import (
    ELEMENT,
    HESSIAN_COLUMNS,
    HESSIAN_ROWS,
    INEQUALITIES,
    MOTION_EQUATIONS,
    MOTION_UNKNOWNS,
    NODE,
    ROOT,
    SLACKED,
    STRIDE,
)
from codegen.runtime.unknowns.point import measured_gradient
from codegen.runtime.unknowns.slacks import with_slacks
from codegen.runtime.unknowns.time_grid import NONE

NEWTON_STEPS = 20  # on one interval
RELATIVE = 1e-10  # part of what is solved for that the last of them may be
BEYOND = 1e6  # a motion that grows by it runs away


def motion_entries():
    """Entries (3, m) of an interval's Hessian that belong to the motion: number, row and column of its matrix."""
    row, column = ({int(j): i for i, j in enumerate(kind)} for kind in (MOTION_EQUATIONS, MOTION_UNKNOWNS))
    pairs = list(enumerate(zip(HESSIAN_ROWS.tolist(), HESSIAN_COLUMNS.tolist(), strict=True)))
    found = [(k, row[i], column[j]) for k, (i, j) in pairs if i in row and j in column]
    found += [(k, row[j], column[i]) for k, (i, j) in pairs if j in row and i in column]
    return np.array(found).T


MOTION_ENTRIES = motion_entries()


def forward_motion(grid, unknowns):
    """The unknowns (n,) of the motion under the controls of a guess (n,), no multipliers; None where there is none.

    Controls are moved inside their bounds. Everything is in the problem's own units.
    """
    own = np.where(grid.is_multiplier, 0.0, unknowns)
    if INEQUALITIES:
        lower, upper = bounds_of(grid)
        own = np.minimum(np.maximum(own, lower), upper)
    limit, common = BEYOND * max(1.0, np.abs(own).max()), own[own.size - ROOT :]
    piece, inside = np.concatenate([own[:ELEMENT], common]), MOTION_UNKNOWNS[MOTION_UNKNOWNS < STRIDE]
    for k in range(grid.steps):
        first, solved = k * STRIDE, piece[inside]
        piece[:ELEMENT] = own[first : first + ELEMENT]
        piece[STRIDE:ELEMENT] = piece[:NODE]
        if k > 0:
            piece[inside] = solved  # stages begin as those of the interval before
        if not is_solved_for_motion(grid, k, piece) or not np.abs(piece).max() <= limit:
            return None
        own[first + MOTION_UNKNOWNS] = piece[MOTION_UNKNOWNS]
    if SLACKED:
        own = with_slacks(grid, own)
    return own


def is_solved_for_motion(grid, k, piece):
    """Whether Newton's method finds the state after interval k, and its stages, from the state before it.

    `piece` (ELEMENT + ROOT,) has the unknowns of the interval and both nodes, and those that no node owns.
    """
    times, gradient, values = grid.nodes[k : k + 2], np.empty(piece.size), np.empty((1, HESSIAN_ROWS.size))
    kinds, (entry, row, column) = np.zeros(piece.size, bool), MOTION_ENTRIES
    matrix = np.zeros((MOTION_EQUATIONS.size, MOTION_UNKNOWNS.size))
    for _ in range(NEWTON_STEPS):
        measured_gradient(piece, NONE, 1.0, 1, grid.h, times, grid.parameters, kinds, gradient)
        interval_hessians(piece, 1, grid.h, times, grid.parameters, values)
        matrix[row, column] = values[0, entry]
        if not np.isfinite(matrix).all():
            return False
        try:
            step = np.linalg.solve(matrix, gradient[MOTION_EQUATIONS])
        except np.linalg.LinAlgError:
            return False
        piece[MOTION_UNKNOWNS] -= step
        if not np.abs(step).max() < np.inf:
            return False
        if (np.abs(step) <= RELATIVE * np.maximum(1.0, np.abs(piece[MOTION_UNKNOWNS]))).all():
            return True
    return False
