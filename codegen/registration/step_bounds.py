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

In space, with u = (|q|^2 x - q)/sqrt(t), e the unit vector from q to x and r = sqrt(s/t) <= 1,

    gradient = (1 - r) ((1 + r) u - 2 e),   whose norm is at most 2 + |q|, since |u| = |q|;
    second derivative = ((1 - r^2)(|q|^2 I - u u^T) + 2 (e - r u)(e - r u)^T)/sqrt(t) - 2 (1 - r)(I - e e^T)/sqrt(s),

two parts that are not negative, together at most 2 (1 + |q|)^2/sqrt(t), and one that is not positive, at least
-2/sqrt(s). So a gradient jumps at a landmark, by no more than twice its bound, and changes by little elsewhere: a place
is at least half as far from any other landmark as that is from the nearest one, which gives the sums in `_jumps`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.registration.flow import Flow
from codegen.registration.grid import mesh

CURVED = 9.0
"""Bound of the second derivative of the Green's function far from its singularity."""
FIRST, LAST = 32, 512
"""Nodes to a radius of the disc or ball, on the coarsest and on the finest grid."""
HOPELESS = 16.0
"""How much larger than 1 a bound may be for a grid of half the spacing to be worth a try."""


def bound_of_steps(flow: Flow, most_nodes: int) -> NDArray[np.float64] | None:
    """Bounds of |D Phi - I| for each step, shape (N,), all below 1, from at most so many nodes; None if there are none.

    None as well for a scheme that is not explicit.
    """
    if not is_explicit(flow):
        return None
    momenta = np.linalg.norm(flow.points[:, 1], axis=2).sum(axis=1)
    dimension, nodes = flow.points.shape[-1], FIRST
    while nodes <= LAST and (3.2, 4.2)[dimension - 2] * nodes**dimension <= most_nodes:
        radius = np.sqrt(dimension / 4.0) / nodes
        changes = momenta * _change(radius) if dimension == 2 else np.array([_jumps(s, radius) for s in flow.points])
        if (_of_steps(flow, changes) < 1.0).all():  # gradients at nodes can only add to that
            bounds = _of_steps(flow, _largest_gradients(flow, nodes) + changes)
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


def _jumps(state: NDArray[np.float64], length: float) -> float:
    """The most by which gradients in space change along a way, for landmarks and momenta of shape (2, n, 3)."""
    places, pulls = state[0], np.linalg.norm(state[1], axis=1)
    far = np.minimum(np.linalg.norm(places, axis=1), 1.0)
    apart = 0.5 * np.linalg.norm(places[:, None] - places, axis=2) - length
    whole = np.broadcast_to(2.0 * (2.0 + far), apart.shape)
    with np.errstate(divide="ignore"):
        curved = np.maximum(2.0 / apart, 2.0 * (1.0 + far) ** 2 / np.maximum(apart, 1.0 - far))
    changes = np.where(apart > 0.0, np.minimum(length * curved, whole), whole)
    return float((changes @ pulls).max())


def _of_steps(flow: Flow, gradients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bounds of |D Phi - I| of each step from those of the gradients at all stages, shape (N POINTS,)."""
    module: Any = flow.module
    h, found = flow.case.duration / flow.steps, np.zeros(flow.steps)
    for k, stages in enumerate(gradients.reshape(flow.steps, module.POINTS)):
        rates: list[float] = []
        for row, gradient in zip(module.ROWS, stages, strict=True):
            stretched = 1.0 + h * sum(abs(a) * rate for a, rate in zip(row, rates, strict=False))
            rates.append(float(gradient) * stretched)
        found[k] = h * sum(abs(b) * rate for b, rate in zip(module.WEIGHTS, rates, strict=True))
    return found


def _largest_gradients(flow: Flow, nodes: int) -> NDArray[np.float64]:
    """The largest spectral norm of the velocity's gradient at the nodes of a grid in the disc, for each stage."""
    module: Any = flow.module
    dimension = flow.points.shape[-1]
    blocks = list(_blocks(nodes, module.BLOCK, dimension))
    rates, gradients = np.empty(dimension * module.BLOCK), np.empty(dimension**2 * module.BLOCK)
    found = np.zeros(len(flow.points))
    for s, state in enumerate(flow.points):
        for block in blocks:
            module.tracer_gradient(block, state, flow.case.own, flow.case.parameters, rates, gradients)
            found[s] = max(found[s], float(_norms(gradients.reshape(dimension**2, -1)).max()))
    return found


def _norms(gradients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Spectral norms of matrices whose entries are rows, or in space what bounds them from above."""
    if len(gradients) > 4:
        return np.asarray(np.sqrt((gradients**2).sum(axis=0)))
    a, b, c, d = gradients
    # The larger singular value: a matrix is a similarity and a mirrored one, whose stretches add.
    return np.asarray(0.5 * (np.hypot(a + d, c - b) + np.hypot(a - d, c + b)))


def _blocks(nodes: int, size: int, dimension: int) -> Iterator[NDArray[np.float64]]:
    """The nodes of a square or cubic grid that lie in the disc or ball, in blocks as kernels take them: all x first."""
    points = mesh([np.arange(-nodes, nodes + 1) / nodes] * dimension)
    points = points[(points**2).sum(axis=1) < 1.0]
    for k in range(0, len(points), size):
        kept = np.minimum(np.arange(k, k + size), len(points) - 1)
        yield points[kept].T.ravel()
