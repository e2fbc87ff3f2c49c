"""A proof that a flow does not fold anywhere: every step differs from the identity by less than the identity.

A step Phi of an explicit Runge-Kutta method has a derivative with |D Phi - I| <= h sum_s b_s L_s d_s, where L_s bounds
the velocity's gradient at stage s, and d_s = 1 + h sum_r |a_sr| L_r d_r that of the stage. Below 1, the determinant of
D Phi is positive at every point of the disc or ball, not at pixels alone, and so is that of all steps one after the
other.

L_s is the largest gradient at the nodes of a grid, plus what gradients can change by on the way to the nearest node.
The second derivative of the Green's function is

    (|q|^2 (1 - s/t) - log(t/s)) I + 2 z z^T,
    s = |x - q|^2,   t = |1 - x q*|^2 <= 4,   |z| = (1 - |q|^2)/sqrt(t) <= 1 + |q|,

so its norm is at most the larger of log(4/s) and |q|^2 + 2 (1 + |q|)^2 <= 9. On a way of length r that is worst if q
lies in its middle, which gives the integral in `_change`. Rounding, some 1e-15 of these sums, is left out of account.

A proof that a flow in space does not fold anywhere, by the steps of `codegen.registration.step_bounds`.

With s = |x - q|^2, t = |1 - x q*|^2, u = (|q|^2 x - q)/sqrt(t), e the unit vector from q to x and r = sqrt(s/t) <= 1,

    gradient = (1 - r) ((1 + r) u - 2 e),   whose norm is at most 2 + |q|, since |u| = |q|;
    second derivative = ((1 - r^2)(|q|^2 I - u u^T) + 2 (e - r u)(e - r u)^T)/sqrt(t) - 2 (1 - r)(I - e e^T)/sqrt(s),

two parts that are not negative, together at most 2 (1 + |q|)^2/sqrt(t), and one that is not positive, at least
-2/sqrt(s). So a gradient jumps at a landmark, by no more than twice its bound, and changes by little elsewhere.

L_s is the largest bound of the gradient on the cells of a grid: its size in a cell's middle, and what it can change by
on the way to any place of the cell. Cells whose bounds are well above the largest gradient seen are divided, again and
again, so that they are small only where that decides. Beyond the rim nothing moves, and gradients are zero.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from codegen.registration.flow import Flow, of_steps
from codegen.registration.grid import mesh

Array = NDArray[np.float64]
COARSEST_CELLS, FINEST_CELLS = 8, 512
"""Cells to a radius of the ball, of the coarsest and of the finest size."""
AT_ONCE = 1 << 16
"""Pairs of a cell and a landmark that are looked at together: they fit into a processor's cache."""
CLOSE = (8.0, 4.0, 2.0, 1.5, 1.2)
"""How many times the largest gradient seen a cell's bound may be: the first that leaves bounds of steps below 1."""


def bound_of_steps_in_ball(flow: Flow, most_cells: int) -> Array | None:
    """Bounds of |D Phi - I| for each step, shape (N,), all below 1, from at most so many cells a stage; None if none.

    The scheme is explicit.
    """
    # What is left of changes at landmarks in the finest cells is part of every bound.
    left = np.array([_changes(state, state[0], 1.0 / FINEST_CELLS).max() for state in flow.points])
    seen = np.array([_gradients(flow, state, _cells()).max() for state in flow.points])
    for close in CLOSE:
        if not (of_steps(flow, np.maximum(left, close * seen)) < 1.0).all():
            continue
        gradients = _largest_gradients(flow, close, most_cells)
        if gradients is None:
            return None
        bounds = of_steps(flow, gradients)
        if (bounds < 1.0).all():
            return bounds
    return None


def _changes(state: Array, points: Array, width: float) -> Array:
    """The most by which gradients change from points to any place of cells of a width around them, shape (m,)."""
    places, pulls = state[0], np.linalg.norm(state[1], axis=1)
    length, far = float(np.sqrt(0.75) * width), np.minimum(np.linalg.norm(state[0], axis=1), 1.0)
    whole, curved, rim = 2.0 * (2.0 + far), 2.0 * length * (1.0 + far) ** 2, 1.0 - far
    found, rows = np.empty(len(points)), max(1, AT_ONCE // len(places))
    for part in (slice(k, k + rows) for k in range(0, len(points), rows)):
        # Where a landmark may lie in the cell, the whole bound is taken below.
        apart = np.maximum(cdist(points[part], places) - length, 1e-300)
        bent = np.maximum(2.0 * length / apart, curved / np.maximum(apart, rim))
        found[part] = np.minimum(bent, whole) @ pulls
    return found


def _largest_gradients(flow: Flow, close: float, most_cells: int) -> Array | None:
    """Bounds of the gradient's spectral norm for each stage; None where one takes too many cells."""
    found = np.zeros(len(flow.points))
    for s, state in enumerate(flow.points):
        bound = _largest_gradient(flow, state, close, most_cells)
        if bound is None:
            return None
        found[s] = bound
    return found


def _largest_gradient(flow: Flow, state: Array, close: float, most_cells: int) -> float | None:
    """A bound of the spectral norm of the velocity's gradient in the ball; None where it takes too many cells."""
    middles, width = _cells(), 1.0 / COARSEST_CELLS
    bound = least = 0.0
    used = 0
    while len(middles):
        used += len(middles)
        if used > most_cells:
            return None
        gradients = _gradients(flow, state, middles)
        least = max(least, float(gradients.max()))
        reach = gradients + _changes(state, middles, width)
        is_open = (reach > close * least) & (width > 1.0 / FINEST_CELLS)
        bound = max(bound, float(reach[~is_open].max(initial=0.0)))
        middles, width = _divided(middles[is_open], width), 0.5 * width
    return bound


@cache
def _cells() -> Array:
    """The middles of the coarsest cells that meet the ball, shape (m, 3)."""
    points = mesh([np.arange(-COARSEST_CELLS, COARSEST_CELLS + 1) / COARSEST_CELLS] * 3)
    reach = 1.0 + np.sqrt(0.75) / COARSEST_CELLS
    return np.asarray(points[(points**2).sum(axis=1) < reach**2])


def _divided(middles: Array, width: float) -> Array:
    """The middles of the cells of half the width that fill cells."""
    offsets = mesh([np.array([-0.25, 0.25]) * width] * 3)
    return (middles[:, None] + offsets).reshape(-1, 3)


def _gradients(flow: Flow, state: Array, points: Array) -> Array:
    """Bounds of the spectral norm of the velocity's gradient at points, shape (m,): zero beyond the rim."""
    module: Any = flow.module
    size = module.BLOCK
    rates, gradients = np.empty(3 * size), np.empty(9 * size)
    found = np.zeros(len(points))
    inside = np.flatnonzero((points**2).sum(axis=1) < 1.0)
    for k in range(0, len(inside), size):
        part = inside[np.minimum(np.arange(k, k + size), len(inside) - 1)]
        module.tracer_gradient(points[part].T.ravel(), state, flow.case.own, flow.case.parameters, rates, gradients)
        found[part] = np.linalg.norm(gradients.reshape(9, -1), axis=0)
    return found


CURVED = 9.0
"""Bound of the second derivative of the Green's function far from its singularity."""
FIRST, LAST = 32, 512
"""Nodes to a radius of the disc, on the coarsest and on the finest grid."""
HOPELESS = 16.0
"""How much larger than 1 a bound may be for a grid of half the spacing to be worth a try."""


def bound_of_steps(flow: Flow, most_nodes: int) -> NDArray[np.float64] | None:
    """Bounds of |D Phi - I| for each step, shape (N,), all below 1, from at most so many nodes; None if there are none.

    None as well for a scheme that is not explicit.
    """
    if not is_explicit(flow):
        return None
    if flow.points.shape[-1] == 3:
        return bound_of_steps_in_ball(flow, most_nodes)
    momenta, nodes = np.linalg.norm(flow.points[:, 1], axis=2).sum(axis=1), FIRST
    while nodes <= LAST and 3.2 * nodes**2 <= most_nodes:
        changes = momenta * _change(np.sqrt(0.5) / nodes)
        if (of_steps(flow, changes) < 1.0).all():  # gradients at nodes can only add to that
            bounds = of_steps(flow, _largest_gradients_in_disc(flow, nodes) + changes)
            if (bounds < 1.0).all():
                return bounds
            if bounds.max() > HOPELESS:
                return None
        nodes *= 2
    return None


def is_explicit(flow: Flow) -> bool:
    """Whether the scheme of a flow has bounds."""
    return hasattr(flow.module, "ROWS") and hasattr(flow.module, "tracer_gradient")


def _change(length: float) -> float:
    """The most by which a landmark with momentum 1 changes gradients along a way, if it is in its middle."""
    near = np.log(4.0) + 2.0 + 2.0 * np.log(2.0 / length)
    return float(length * (near + max(0.0, CURVED - near + 2.0)))


def _largest_gradients_in_disc(flow: Flow, nodes: int) -> NDArray[np.float64]:
    """The largest spectral norm of the velocity's gradient at the nodes of a grid in the disc, for each stage."""
    module: Any = flow.module
    blocks = list(_blocks(nodes, module.BLOCK))
    rates, gradients = np.empty(2 * module.BLOCK), np.empty(4 * module.BLOCK)
    found = np.zeros(len(flow.points))
    for s, state in enumerate(flow.points):
        for block in blocks:
            module.tracer_gradient(block, state, flow.case.own, flow.case.parameters, rates, gradients)
            # Spectral norms of matrices whose entries are rows.
            a, b, c, d = gradients.reshape(4, -1)
            # The larger singular value: a matrix is a similarity and a mirrored one, whose stretches add.
            found[s] = max(found[s], float(np.asarray(0.5 * (np.hypot(a + d, c - b) + np.hypot(a - d, c + b))).max()))
    return found


def _blocks(nodes: int, size: int) -> Iterator[NDArray[np.float64]]:
    """The nodes of a square grid that lie in the disc, in blocks as kernels take them: all x first."""
    points = mesh([np.arange(-nodes, nodes + 1) / nodes] * 2)
    points = points[(points**2).sum(axis=1) < 1.0]
    for k in range(0, len(points), size):
        kept = np.minimum(np.arange(k, k + size), len(points) - 1)
        yield points[kept].T.ravel()
