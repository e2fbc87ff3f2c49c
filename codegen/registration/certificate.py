"""The certificate of a registration: that it does not fold, that its inverse is one, and how well landmarks are met.

A proof that a flow does not fold anywhere: every step differs from the identity by less than the identity. A step Phi
of an explicit Runge-Kutta method has a derivative with |D Phi - I| <= h sum_s b_s L_s d_s, where L_s bounds the
velocity's gradient at stage s, and d_s = 1 + h sum_r |a_sr| L_r d_r that of the stage. Below 1, the determinant of D
Phi is positive at every point of the disc or ball, not at pixels alone, and so is that of all steps one after the
other.

L_s is the largest gradient at the nodes of a grid, plus what gradients can change by on the way to the nearest node.
The second derivative of the Green's function is

    (|q|^2 (1 - s/t) - log(t/s)) I + 2 z z^T,
    s = |x - q|^2,   t = |1 - x q*|^2 <= 4,   |z| = (1 - |q|^2)/sqrt(t) <= 1 + |q|,

so its norm is at most the larger of log(4/s) and |q|^2 + 2 (1 + |q|)^2 <= 9. On a way of length r that is worst if q
lies in its middle, which gives the integral in `_change`. Rounding, some 1e-15 of these sums, is left out of account.
In space, by the same bounds of steps:

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
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from codegen.errors import RegistrationError
from codegen.registration.grid import Extent, Grid, grid_of, mesh, pixel_grid, slabs
from codegen.registration.maps import ROUND_TRIP, Registration, in_steps
from codegen.registration.pairs import PointArray
from codegen.registration.solver import Flow, of_steps
from codegen.registration.warp import PORTION, Positions

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
        # The middles of the cells of half the width that fill cells.
        offsets = mesh([np.array([-0.25, 0.25]) * width] * 3)
        middles, width = (middles[is_open][:, None] + offsets).reshape(-1, 3), 0.5 * width
    return bound


@cache
def _cells() -> Array:
    """The middles of the coarsest cells that meet the ball, shape (m, 3)."""
    points = mesh([np.arange(-COARSEST_CELLS, COARSEST_CELLS + 1) / COARSEST_CELLS] * 3)
    reach = 1.0 + np.sqrt(0.75) / COARSEST_CELLS
    return np.asarray(points[(points**2).sum(axis=1) < reach**2])


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


SPACING = 8
"""Pixels between those at which det J is evaluated where it is proved to be positive."""
NEAR, EXTREMES, REACH = 2, 24, {2: SPACING, 3: 4}
"""How far about landmarks every pixel is evaluated; of how many extremes, and how far, all are that lie about them."""
MOST_STEPS, NODES = 64, 200_000
"""The most steps that are made for the sake of a proof in space, and nodes of a grid by which one is tried."""
CHEAPER = 4
"""A node of a proof costs less than a pixel; so many times fewer are taken at most."""
SENT = {2: 129, 3: 25}
"""The most pixels along each axis that are sent there and back."""


@dataclass(frozen=True)
class Certificate:
    """What was found on the pixels of the warped image: those of the fixed one, or of the moving one by the inverse.

    Of volumes, pixels are voxels, areas are volumes, and places are in the coordinates of the landmarks.

    `det_min` and `det_max` are the extremes of det J, the factor by which the map moving to fixed enlarges areas there;
    `det_min_at` is the pixel (x, y) of the least. `folded` counts the pixels at which it is not positive, `first_fold`
    is the first of them in reading order. `round_trip` and `residual_max` are in pixels.
    Where bounds of the derivative decide, it is `proved` that det J is positive everywhere, and within `det_bounds`;
    the extremes are then those of `evaluated` pixels.
    """

    det_min: float
    det_max: float
    det_min_at: tuple[float, ...]
    folded: int
    first_fold: tuple[float, ...] | None
    round_trip: float
    residual_max: float
    passed: bool
    message: str
    proved: bool = False
    det_bounds: tuple[float, float] | None = None
    evaluated: int = 0


def certify(registration: Registration, shape: Extent | None = None, *, inverse: bool = False) -> Certificate:
    """Certify that the map does not fold, by bounds of its derivative where they decide, or pixel by pixel.

    Where every step is proved to differ from the identity by less than the identity, as in
    `codegen.registration.certificate`, the map folds nowhere, between pixels neither; det J is then evaluated at every
    `SPACING`-th pixel, at those about landmarks, and at all about the extremes that were found. Otherwise every pixel
    of the fixed image is evaluated, or of an image of another shape. The derivative is that of the discrete inverse
    map, carried along its steps, not a difference of neighbouring pixels; its determinant is that of the map where the
    pixel comes from, turned over. With `inverse`, the pixels are those of the moving image, and the derivative is that
    of the map itself. Every pixel of a grid of at most 129 by 129, or in space of 25 by 25 by 25, and every landmark,
    is also sent there and back.
    What passes comes back to within 1e-8 pixels.
    """
    return certificate_of(registration, shape, inverse=inverse)[0]


def certificate_of(
    registration: Registration, shape: Extent | None = None, *, inverse: bool = False
) -> tuple[Certificate, Positions | None]:
    """The same, and where every pixel comes from if all of them had to be evaluated."""
    whole = _whole(registration, shape, inverse)
    bounds = _bounds(registration, whole)
    if bounds is None and whole.dimension == 3:
        return _certified_in_slabs(registration, whole, inverse), None
    if bounds is None:
        return certify_with_positions(registration, shape, inverse=inverse)
    # Every so-many-th pixel, the last row and column, and the pixels about landmarks, where det J is least smooth.
    lines = [np.unique(np.append(np.arange(0, length, SPACING), length - 1)).astype(float) for length in whole.size]
    landmarks = registration.pairs.moving if inverse else registration.pairs.fixed
    points = np.vstack([whole.to_places(mesh(lines)), _about(landmarks, whole, NEAR)])
    _, determinants = (registration.leaving if inverse else registration.arriving)(points)
    points, determinants = _about_extremes(registration, whole, inverse, points, determinants)
    found = _certificate(registration, whole, inverse, points, determinants)
    scale, power = registration.alignment.determinant, float(registration.dimension)
    # The flow runs from fixed to moving, so that its determinant is turned over.
    low, high = (float(scale * np.exp(-power * np.log1p(sign * bounds).sum())) for sign in (1.0, -1.0))
    message = found.message
    if found.passed:
        message = f"the map is proved to fold nowhere; least det J found is {found.det_min:.4g}"
    return replace(found, proved=True, det_bounds=(low, high), message=message), None


def in_provable_steps(registration: Registration) -> Registration:
    """The same map in so many more steps that each is proved not to fold; as it is where that takes too many."""
    found = registration
    while is_explicit(found.flow) and bound_of_steps(found.flow, NODES) is None:
        if 2 * found.steps > MOST_STEPS or found.status != "solved":
            return registration
        try:
            found = in_steps(found.matching, 2 * found.steps, found.velocities, quick=True)
        except RegistrationError:
            return registration
    return replace(found, error=registration.error, solves=registration.solves)


def _whole(registration: Registration, shape: Extent | None, inverse: bool) -> Grid:
    default = registration.grid if inverse else registration.fixed_grid
    return default if shape is None else grid_of(shape)


def _bounds(registration: Registration, grid: Grid) -> NDArray[np.float64] | None:
    """Bounds of the flow's steps, if they decide with less work than evaluating every pixel."""
    if registration.alignment.determinant <= 0.0 or registration.status != "solved":
        return None
    least = NODES if grid.dimension == 3 else 0  # in space few nodes take less time than all voxels of a small volume
    return bound_of_steps(registration.flow, max(least, int(grid.count / CHEAPER)))


def _about(points: PointArray, grid: Grid, reach: int) -> PointArray:
    """The pixels in squares, or voxels in cubes, about points, each of them once."""
    offsets = mesh([np.arange(-reach, reach + 1.0)] * grid.dimension)
    found = np.unique((np.rint(grid.to_indices(points))[:, None] + offsets).reshape(-1, grid.dimension), axis=0)
    inside = ((found >= 0.0) & (found <= np.array(grid.size) - 1)).all(axis=1)
    return grid.to_places(found[inside])


def _about_extremes(
    registration: Registration, grid: Grid, inverse: bool, points: PointArray, determinants: NDArray[np.float64]
) -> tuple[PointArray, NDArray[np.float64]]:  # fmt: skip
    """The same and all pixels about the least and the largest determinants, with theirs."""
    order = np.argsort(determinants)
    chosen = points[np.concatenate([order[:EXTREMES], order[-EXTREMES:]])]
    more = _about(chosen, grid, REACH[grid.dimension])
    _, found = (registration.leaving if inverse else registration.arriving)(more)
    return np.vstack([points, more]), np.concatenate([determinants, found])


def certify_with_positions(
    registration: Registration, shape: Extent | None = None, *, inverse: bool = False
) -> tuple[Certificate, Positions]:
    """The certificate of every pixel, and where each comes from, which is found on the same way and `warp` needs.

    The arguments are those of `certify`; between pixels nothing is evaluated.
    """
    whole = _whole(registration, shape, inverse)
    carried = registration.leaving if inverse else registration.arriving
    grid = pixel_grid(whole.shape)
    places, determinants = np.empty_like(grid), np.empty(len(grid))
    for part in (slice(k, k + PORTION) for k in range(0, len(grid), PORTION)):
        places[part], determinants[part] = carried(grid[part])
    certificate = _certificate(registration, whole, inverse, grid, determinants)
    return certificate, Positions(places.reshape(*whole.shape, 2))


def _certified_in_slabs(registration: Registration, grid: Grid, inverse: bool) -> Certificate:
    """The certificate of every voxel, of which few are in memory at once."""
    carried = registration.leaving if inverse else registration.arriving
    columns, rows, slices = grid.size
    found = _Found.none()
    for slab in slabs(slices, max(1, PORTION // (columns * rows))):
        lines = [np.arange(float(columns)), np.arange(float(rows)), np.arange(float(slab.start), float(slab.stop))]
        places = grid.to_places(mesh(lines))
        found = found.joined(_Found.of(places, carried(places)[1]))
    return _judged(registration, grid, inverse, found)


@dataclass(frozen=True)
class _Found:
    """The extremes of determinants, their places, and where they are not positive, of so many as were evaluated."""

    least: float
    least_at: tuple[float, ...]
    largest: float
    folded: int
    first: tuple[float, ...] | None
    evaluated: int

    @classmethod
    def none(cls) -> _Found:
        return cls(np.inf, (), -np.inf, 0, None, 0)

    @classmethod
    def of(cls, points: PointArray, determinants: NDArray[np.float64]) -> _Found:
        known = np.isfinite(determinants)
        least = int(np.argmin(np.where(known, determinants, np.inf)))
        wrong = np.flatnonzero(~((determinants > 0.0) & known))
        first = tuple(map(float, points[wrong[0]])) if wrong.size else None
        largest = float(determinants[known].max(initial=-np.inf)) if known.any() else np.nan
        place = tuple(map(float, points[least]))
        return cls(float(determinants[least]), place, largest, int(wrong.size), first, len(points))

    def joined(self, other: _Found) -> _Found:
        """Both together, this one first."""
        lower = self if not other.least < self.least else other
        return _Found(
            lower.least, lower.least_at or other.least_at, float(np.fmax(self.largest, other.largest)),
            self.folded + other.folded, self.first or other.first, self.evaluated + other.evaluated,
        )  # fmt: skip


def _certificate(
    registration: Registration, grid: Grid, inverse: bool, points: PointArray, determinants: NDArray[np.float64]
) -> Certificate:
    """What determinants at points say, and points that come back."""
    return _judged(registration, grid, inverse, _Found.of(points, determinants))


def _judged(registration: Registration, grid: Grid, inverse: bool, found: _Found) -> Certificate:
    # The farthest that a point comes back from where it was, in pixels; infinite where one does not come back.
    there, back = registration.map_points_inverse, registration.map_points
    landmarks = registration.pairs.fixed
    if inverse:
        there, back, landmarks = back, there, registration.pairs.moving
    points = np.vstack([grid.samples(SENT[grid.dimension]), landmarks])
    distance = float(np.linalg.norm(back(there(points)) - points, axis=1).max())
    round_trip = distance if np.isfinite(distance) else np.inf
    return Certificate(
        found.least,
        found.largest,
        found.least_at,
        found.folded,
        found.first,
        round_trip,
        float(registration.residuals.max()),
        found.folded == 0
        and round_trip <= ROUND_TRIP * registration.fixed_grid.pixel
        and registration.status == "solved",
        _message(registration, round_trip, found),
        evaluated=found.evaluated,
    )


def _message(registration: Registration, round_trip: float, found: _Found) -> str:
    if found.first is not None:
        what = "pixels" if registration.dimension == 2 else "voxels"
        place = ", ".join(f"{x:g}" for x in found.first)
        return f"the map folds at {found.folded} {what}, the first at ({place}); take more steps"
    if not round_trip <= ROUND_TRIP * registration.fixed_grid.pixel:
        return f"points come back only to within {round_trip:.1e} {registration.fixed_grid.unit}; take more steps"
    if registration.status != "solved":
        return registration.message
    return f"the map does not fold: det J is at least {found.least:.4g}"
