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
What holds in space is in `codegen.registration.space_bounds`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.registration import space_bounds
from codegen.registration.flow import Flow, of_steps
from codegen.registration.grid import mesh

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
        return space_bounds.bound_of_steps(flow, most_nodes)
    momenta, nodes = np.linalg.norm(flow.points[:, 1], axis=2).sum(axis=1), FIRST
    while nodes <= LAST and 3.2 * nodes**2 <= most_nodes:
        changes = momenta * _change(np.sqrt(0.5) / nodes)
        if (of_steps(flow, changes) < 1.0).all():  # gradients at nodes can only add to that
            bounds = of_steps(flow, _largest_gradients(flow, nodes) + changes)
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


def _largest_gradients(flow: Flow, nodes: int) -> NDArray[np.float64]:
    """The largest spectral norm of the velocity's gradient at the nodes of a grid in the disc, for each stage."""
    module: Any = flow.module
    blocks = list(_blocks(nodes, module.BLOCK))
    rates, gradients = np.empty(2 * module.BLOCK), np.empty(4 * module.BLOCK)
    found = np.zeros(len(flow.points))
    for s, state in enumerate(flow.points):
        for block in blocks:
            module.tracer_gradient(block, state, flow.case.own, flow.case.parameters, rates, gradients)
            found[s] = max(found[s], float(_norms(gradients.reshape(4, -1)).max()))
    return found


def _norms(gradients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Spectral norms of matrices whose entries are rows."""
    a, b, c, d = gradients
    # The larger singular value: a matrix is a similarity and a mirrored one, whose stretches add.
    return np.asarray(0.5 * (np.hypot(a + d, c - b) + np.hypot(a - d, c + b)))


def _blocks(nodes: int, size: int) -> Iterator[NDArray[np.float64]]:
    """The nodes of a square grid that lie in the disc, in blocks as kernels take them: all x first."""
    points = mesh([np.arange(-nodes, nodes + 1) / nodes] * 2)
    points = points[(points**2).sum(axis=1) < 1.0]
    for k in range(0, len(points), size):
        kept = np.minimum(np.arange(k, k + size), len(points) - 1)
        yield points[kept].T.ravel()
