"""Tracer points, which have no momenta, carried along the motion of particles, forwards or backwards."""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_pairs import DIMENSION, POINTS
from codegen.runtime.stand_ins.example_tracers import BLOCK
from codegen.runtime.particles.pair_trajectory import defects
from codegen.runtime.particles.tracer_substeps import tracer_step


@njit(cache=True, error_model="numpy", nogil=True)
def carry_points(points, h, first, last, stages, own, parameters, carried, jacobians):
    """Fill `carried`, shape (n, d), with `points` carried from time `first` to time `last`, block after block.

    `jacobians`, shape (n, d, d), gets the derivatives of that map, unless it is empty. Times are in steps.
    """
    count, square = points.shape[0], DIMENSION * DIMENSION
    positions, velocities = np.empty(DIMENSION * BLOCK), np.empty((4, DIMENSION * BLOCK))
    tangents = np.empty(square * BLOCK if jacobians.size > 0 else 0)
    for start in range(0, count, BLOCK):
        for m in range(BLOCK):
            row = min(start + m, count - 1)
            for a in range(DIMENSION):
                positions[a * BLOCK + m] = points[row, a]
        velocities[:] = 0.0
        for e in range(tangents.size):
            tangents[e] = 1.0 if (e // BLOCK) % (DIMENSION + 1) == 0 else 0.0
        low, high = min(first, last), max(first, last)
        begin, end = int(np.floor(low)), int(np.ceil(high))
        for turn in range(end - begin):
            k = begin + turn if last > first else end - 1 - turn
            share = min(high, k + 1.0) - max(low, float(k))
            step = h * share if last > first else -h * share
            tracer_step(k, step, stages, own, parameters, positions, tangents, velocities, turn)
        for m in range(min(BLOCK, count - start)):
            for a in range(DIMENSION):
                carried[start + m, a] = positions[a * BLOCK + m]
            for e in range(square if jacobians.size > 0 else 0):
                jacobians[start + m, e // DIMENSION, e % DIMENSION] = tangents[e * BLOCK + m]


def stages_of(case, path):
    """The states at which the scheme evaluates H along the states `path`, shape (N POINTS, 2, n, d)."""
    points, errors = np.zeros((case.steps * POINTS, *path.shape[1:])), np.zeros((case.steps, *path.shape[1:]))
    if defects(case.duration / case.steps, case.own, case.parameters, path, points, errors) < 0:
        raise ValueError("path has a state from which no step can be made; carry points along a solved path")
    return points


def carry(case, stages, points, first=0.0, last=None, derivative=False):
    """Carry tracer points, shape (m, d), along the motion whose `stages` are given, from one time to another.

    Times are in steps, from 0 to the number of steps; by default the points are carried from the first to the last, and
    from `first` back to an earlier `last` by the inverse of that map. A time between two nodes is reached by part of a
    step. Returns the positions, shape (m, d), and the derivatives of the map, shape (m, d, d), or None. A point outside
    the domain of the particles stays where it is; one for which an implicit step has no solution becomes NaN. Raises
    ValueError when points or times are unusable.
    """
    points = np.ascontiguousarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1] != DIMENSION:
        raise ValueError(f"points have shape {points.shape}, expected (m, {DIMENSION})")
    first, last = float(first), float(case.steps if last is None else last)
    for name, time in (("first", first), ("last", last)):
        if not 0.0 <= time <= case.steps:
            raise ValueError(f"{name} is {time}, expected a time between 0 and {case.steps} steps")
    carried = np.empty(points.shape)
    jacobians = np.empty((len(points) if derivative else 0, DIMENSION, DIMENSION))
    h = case.duration / case.steps
    carry_points(points, h, first, last, stages, case.own, case.parameters, carried, jacobians)
    return carried, jacobians if derivative else None
