"""The certificate of a registration: the map does not fold, its inverse is accurate, and landmarks have residuals.

A flow folds nowhere if the derivative D Phi of every step Phi satisfies |D Phi - I| < 1. For an explicit Runge-Kutta
method |D Phi - I| <= h sum_s |b_s| L_s d_s. L_s bounds the gradient of the velocity at stage s, and d_s = 1 + h
sum_r |a_sr| L_r d_r bounds the derivative of the stage. If the sum is below 1, det D Phi is positive at every point of
the disc or ball, also between pixels. Then the determinant of all steps together is positive, too.

In the plane L_s is the largest gradient at the nodes of a grid, plus a bound of its change between a point and the
nearest node. For a point x and a landmark q, the second derivative of the Green's function is

    (|q|^2 (1 - s/t) - log(t/s)) I + 2 z z^T,
    s = |x - q|^2,   t = |1 - x q*|^2 <= 4,   |z| = (1 - |q|^2)/sqrt(t) <= 1 + |q|,

so its norm is at most the larger of log(4/s) and |q|^2 + 2 (1 + |q|)^2 <= 9. Along a path the gradient changes most if
q is in the middle, which gives the integral in `bound_of_steps`. Relative rounding errors of about 1e-15 are neglected.

In space, with s = |x - q|^2, t = |1 - x q*|^2, u = (|q|^2 x - q)/sqrt(t), e the unit vector from q to x and
r = sqrt(s/t) <= 1,

    gradient = (1 - r) ((1 + r) u - 2 e),   whose norm is at most 2 + |q|, since |u| = |q|;
    second derivative = ((1 - r^2)(|q|^2 I - u u^T) + 2 (e - r u)(e - r u)^T)/sqrt(t) - 2 (1 - r)(I - e e^T)/sqrt(s),

two parts that are not negative, together at most 2 (1 + |q|)^2/sqrt(t), and a part that is not positive, at least
-2/sqrt(s). So a gradient jumps at a landmark by at most twice its bound, and changes little elsewhere.

In space L_s is the largest bound of the gradient in the cells of a grid. The bound of a cell is the gradient in its
middle, plus a bound of the change within the cell. Cells whose bounds are well above the largest gradient are divided
repeatedly, so that cells are small only where necessary. Beyond the rim nothing moves, and gradients are zero.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from codegen.errors import RegistrationError
from codegen.registration.grid import Extent, Grid, grid_of, mesh, pixel_grid
from codegen.registration.maps import ROUND_TRIP, Registration, in_steps
from codegen.registration.pairs import PointArray
from codegen.registration.solver import Flow, of_steps
from codegen.registration.warp import PORTION, Positions

Array = NDArray[np.float64]

SPACING = 8  # pixels between evaluations of det J if det J is proved to be positive
NEAR, EXTREMES, REACH = 2, 24, {2: SPACING, 3: 4}
"""Half-width, in pixels, of squares around landmarks; number of lowest and highest det J; half-width around each."""
MOST_STEPS, NODES = 64, 200_000
"""Most steps that `in_provable_steps` tries, and the number of nodes that a proof in space may always use."""
CHEAPER = 4  # fewest pixels of the image per node of the grid of a proof, so that a proof is cheaper than all pixels
SENT = {2: 129, 3: 25}  # most pixels along each axis whose round trip is evaluated, by dimension
CURVED = 9.0  # bound of the second derivative of the Green's function in the plane far from its singularity
FIRST, LAST = 32, 512  # nodes per radius of the disc, on the coarsest and on the finest grid
HOPELESS = 16.0  # the largest bound of a step after which the proof is tried on a grid of half the spacing
COARSEST_CELLS, FINEST_CELLS = 8, 512  # coarsest cells, and finest cells, per radius of the ball
AT_ONCE = 1 << 16  # pairs of a cell and a landmark that are evaluated together, few enough for the cache of a processor
CLOSE = (8.0, 4.0, 2.0, 1.5, 1.2)
"""Largest accepted ratios of the bound of a cell to the largest gradient, which are tried in turn."""


@dataclass(frozen=True)
class Certificate:
    """Determinants and errors of a map at the pixels (of a volume: the voxels) of the warped image.

    `det_min` and `det_max` are the extremes of det J, the factor by which the map from moving to fixed enlarges areas
    or volumes. `det_min_at` is the pixel (x, y) of `det_min`, or a point in the coordinates of a volume. `folded`
    counts pixels whose det J is not positive, and `first_fold` is the first such pixel in reading order. `round_trip`
    is the largest error, in pixels, of points after the map and its inverse, `residual_max` the largest residual of a
    landmark. `proved` is True if bounds of derivatives prove that det J is positive, and within `det_bounds`, at all
    points. `evaluated` is the number of evaluations of det J.
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
    """Certify that the map does not fold, by bounds of its derivative if possible, or pixel by pixel.

    Parameters
    ----------
    registration : Registration
        The map.
    shape : sequence of int or Grid, optional
        The shape or grid of the warped image; by default the grid of the fixed image.
    inverse : bool
        Evaluate det J at the pixels of the moving image, from the derivative of the map instead of its inverse.

    Returns
    -------
    Certificate
        `passed` is True if the map is solved, does not fold, and has a round trip within 1e-8 pixels.

    Notes
    -----
    If every step is proved to fold nowhere (see `codegen.registration.certificate`), det J is evaluated at every
    `SPACING`-th pixel, around landmarks and around the extremes. Otherwise det J is evaluated at every pixel. det J is
    the reciprocal determinant of the discrete inverse map, whose derivative is exact: it is computed along the steps,
    not from differences between pixels. The round trip is evaluated on a grid of at most 129 by 129 pixels, or 25 by 25
    by 25 voxels, and at every landmark.
    """
    return certificate_of(registration, shape, inverse=inverse)[0]


def certificate_of(
    registration: Registration, shape: Extent | None = None, *, inverse: bool = False
) -> tuple[Certificate, Positions | None]:
    """Return the certificate of `certify`, and the positions of all pixels, or None for volumes and after a proof."""
    default = registration.grid if inverse else registration.fixed_grid
    grid = grid_of(default if shape is None else shape)
    bounds = None
    if registration.alignment.determinant > 0.0 and registration.status == "solved":
        # In space a proof takes less time than all voxels, even for a small volume.
        least = NODES if grid.dimension == 3 else 0
        bounds = bound_of_steps(registration.flow, max(least, int(grid.count / CHEAPER)))
    carry = registration.leaving if inverse else registration.arriving
    if bounds is None and grid.dimension == 2:
        return certify_with_positions(registration, grid, inverse=inverse)
    if bounds is None:
        # Every voxel, with one portion in memory at a time.
        findings = _Findings(np.inf, (), -np.inf, 0, None, 0)
        for _, places in grid.portions(PORTION):
            findings = findings.joined(_Findings.of(places, carry(places)[1]))
        return _certificate(registration, grid, inverse, findings), None
    # Every n-th pixel, the last row and column, and pixels around landmarks, where det J is least smooth.
    lines = [np.unique(np.append(np.arange(0, length, SPACING), length - 1)).astype(float) for length in grid.size]
    landmarks = registration.pairs.moving if inverse else registration.pairs.fixed
    points = np.vstack([grid.to_places(mesh(lines)), _around(landmarks, grid, NEAR)])
    determinants = carry(points)[1]
    # All pixels around the extremes.
    order = np.argsort(determinants)
    more = _around(points[np.concatenate([order[:EXTREMES], order[-EXTREMES:]])], grid, REACH[grid.dimension])
    findings = _Findings.of(np.vstack([points, more]), np.concatenate([determinants, carry(more)[1]]))
    certificate = _certificate(registration, grid, inverse, findings)
    scale, power = registration.alignment.determinant, float(grid.dimension)
    # The flow runs from fixed to moving: its determinant is the reciprocal.
    low, high = (float(scale * np.exp(-power * np.log1p(sign * bounds).sum())) for sign in (1.0, -1.0))
    message = certificate.message
    if certificate.passed:
        message = f"the map is proved to fold nowhere; least det J found is {certificate.det_min:.4g}"
    return replace(certificate, proved=True, det_bounds=(low, high), message=message), None


def certify_with_positions(
    registration: Registration, shape: Extent | None = None, *, inverse: bool = False
) -> tuple[Certificate, Positions]:
    """Return the certificate from det J at every pixel, and the positions of all pixels, which `warp` needs.

    The images are pictures, and the arguments are as in `certify`. Folds between pixels are not detected.
    """
    default = registration.grid if inverse else registration.fixed_grid
    grid = grid_of(default if shape is None else shape)
    carry = registration.leaving if inverse else registration.arriving
    places, determinants = np.empty((grid.count, 2)), np.empty(grid.count)
    for part, pixels in grid.portions(PORTION):
        places[part], determinants[part] = carry(pixels)
    findings = _Findings.of(pixel_grid(grid.shape), determinants)
    return _certificate(registration, grid, inverse, findings), Positions(places.reshape(*grid.shape, 2))


def in_provable_steps(registration: Registration) -> Registration:
    """Double the number of steps until each step is proved to fold nowhere; on failure return the map unchanged."""
    candidate = registration
    while hasattr(candidate.flow.module, "ROWS") and bound_of_steps(candidate.flow, NODES) is None:
        if 2 * candidate.steps > MOST_STEPS or candidate.status != "solved":
            return registration
        try:
            candidate = in_steps(candidate.matching, 2 * candidate.steps, candidate.velocities, quick=True)
        except RegistrationError:
            return registration
    return replace(candidate, error=registration.error, solves=registration.solves)


def _around(points: PointArray, grid: Grid, reach: int) -> PointArray:
    """Return the pixels at most `reach` pixels from any of the points along each axis, each pixel once."""
    offsets = mesh([np.arange(-reach, reach + 1.0)] * grid.dimension)
    indices = np.unique((np.rint(grid.to_indices(points))[:, None] + offsets).reshape(-1, grid.dimension), axis=0)
    inside = ((indices >= 0.0) & (indices <= np.array(grid.size) - 1)).all(axis=1)
    return grid.to_places(indices[inside])


@dataclass(frozen=True)
class _Findings:
    """The least and largest determinants at evaluated points, and the number and first point of folds."""

    least: float
    least_at: tuple[float, ...]
    largest: float
    folded: int
    first: tuple[float, ...] | None
    evaluated: int

    @classmethod
    def of(cls, points: PointArray, determinants: Array) -> _Findings:
        finite = np.isfinite(determinants)
        least = int(np.argmin(np.where(finite, determinants, np.inf)))
        wrong = np.flatnonzero(~((determinants > 0.0) & finite))
        first = tuple(map(float, points[wrong[0]])) if wrong.size else None
        largest = float(determinants[finite].max(initial=-np.inf)) if finite.any() else np.nan
        place = tuple(map(float, points[least]))
        return cls(float(determinants[least]), place, largest, int(wrong.size), first, len(points))

    def joined(self, other: _Findings) -> _Findings:
        """Return the findings of both portions of points; `other` is the later portion."""
        lower = other if other.least < self.least else self
        return _Findings(
            lower.least, lower.least_at or other.least_at, float(np.fmax(self.largest, other.largest)),
            self.folded + other.folded, self.first or other.first, self.evaluated + other.evaluated,
        )  # fmt: skip


def _certificate(registration: Registration, grid: Grid, inverse: bool, findings: _Findings) -> Certificate:
    """Evaluate the round trip, and return the certificate of the findings."""
    there, back = registration.map_points_inverse, registration.map_points
    landmarks = registration.pairs.fixed
    if inverse:
        there, back, landmarks = back, there, registration.pairs.moving
    points = np.vstack([grid.samples(SENT[grid.dimension]), landmarks])
    distance = float(np.linalg.norm(back(there(points)) - points, axis=1).max())
    round_trip = distance if np.isfinite(distance) else np.inf
    is_accurate = round_trip <= ROUND_TRIP * registration.fixed_grid.pixel
    if findings.first is not None:
        samples = "pixels" if grid.dimension == 2 else "voxels"
        place = ", ".join(f"{x:g}" for x in findings.first)
        message = f"the map folds at {findings.folded} {samples}, the first at ({place}); take more steps"
    elif not is_accurate:
        message = f"points come back only to within {round_trip:.1e} {registration.fixed_grid.unit}; take more steps"
    elif registration.status != "solved":
        message = registration.message
    else:
        message = f"the map does not fold: det J is at least {findings.least:.4g}"
    passed = findings.folded == 0 and is_accurate and registration.status == "solved"
    return Certificate(
        findings.least, findings.largest, findings.least_at, findings.folded, findings.first, round_trip,
        float(registration.residuals.max()), passed, message, evaluated=findings.evaluated,
    )  # fmt: skip


def bound_of_steps(flow: Flow, most_nodes: int) -> Array | None:
    """Bound |D Phi - I| for each step Phi, shape (N,), with at most `most_nodes` nodes, or cells in space, per stage.

    Return None if a bound is not below 1, or if the scheme is not explicit.
    """
    if not (hasattr(flow.module, "ROWS") and hasattr(flow.module, "tracer_gradient")):
        return None
    if flow.points.shape[-1] == 3:
        return _bound_in_ball(flow, most_nodes)
    module = flow.module
    momenta, nodes = np.linalg.norm(flow.points[:, 1], axis=2).sum(axis=1), FIRST
    rates, gradients = np.empty(2 * module.BLOCK), np.empty(4 * module.BLOCK)
    while nodes <= LAST and 3.2 * nodes**2 <= most_nodes:
        # The largest change of the gradient near a landmark of momentum 1 in the middle of a path to a node.
        length = np.sqrt(0.5) / nodes
        near = np.log(4.0) + 2.0 + 2.0 * np.log(2.0 / length)
        changes = momenta * float(length * (near + max(0.0, CURVED - near + 2.0)))
        if (of_steps(flow, changes) < 1.0).all():  # gradients at nodes can only increase the bounds
            points = mesh([np.arange(-nodes, nodes + 1) / nodes] * 2)
            points = points[(points**2).sum(axis=1) < 1.0]
            # Blocks of nodes in the layout of the kernels: all x first.
            blocks = [
                points[np.minimum(np.arange(k, k + module.BLOCK), len(points) - 1)].T.ravel()
                for k in range(0, len(points), module.BLOCK)
            ]
            largest = np.zeros(len(flow.points))
            for s, state in enumerate(flow.points):
                for block in blocks:
                    module.tracer_gradient(block, state, flow.case.own, flow.case.parameters, rates, gradients)
                    # Spectral norms: a matrix is a similarity plus a mirrored similarity; their norms add.
                    a, b, c, d = gradients.reshape(4, -1)
                    norms = 0.5 * (np.hypot(a + d, c - b) + np.hypot(a - d, c + b))
                    largest[s] = max(largest[s], float(norms.max()))
            bounds = of_steps(flow, largest + changes)
            if (bounds < 1.0).all():
                return bounds
            if bounds.max() > HOPELESS:
                return None
        nodes *= 2
    return None


def _bound_in_ball(flow: Flow, most_cells: int) -> Array | None:
    """Bound |D Phi - I| for each step of an explicit scheme in space, shape (N,); None if a bound is not below 1."""
    # Every bound is at least the change of the gradient in the finest cells at landmarks.
    least = np.array([_changes_in_cells(state, state[0], 1.0 / FINEST_CELLS).max() for state in flow.points])
    seen = np.array([_gradients(flow, state, _cells()).max() for state in flow.points])
    for close in CLOSE:
        if not (of_steps(flow, np.maximum(least, close * seen)) < 1.0).all():
            continue
        gradients = []
        for state in flow.points:
            bound = _largest_gradient(flow, state, close, most_cells)
            if bound is None:
                return None
            gradients.append(bound)
        bounds = of_steps(flow, np.array(gradients))
        if (bounds < 1.0).all():
            return bounds
    return None


def _largest_gradient(flow: Flow, state: Array, close: float, most_cells: int) -> float | None:
    """Bound the velocity gradient of a stage, to a ratio `close` if possible; None if that takes over `most_cells`."""
    middles, width = _cells(), 1.0 / COARSEST_CELLS
    bound = least = 0.0
    used = 0
    while len(middles):
        used += len(middles)
        if used > most_cells:
            return None
        gradients = _gradients(flow, state, middles)
        least = max(least, float(gradients.max()))
        reach = gradients + _changes_in_cells(state, middles, width)
        is_open = (reach > close * least) & (width > 1.0 / FINEST_CELLS)
        bound = max(bound, float(reach[~is_open].max(initial=0.0)))
        # Divide cells into cells of half the width.
        offsets = mesh([np.array([-0.25, 0.25]) * width] * 3)
        middles, width = (middles[is_open][:, None] + offsets).reshape(-1, 3), 0.5 * width
    return bound


def _changes_in_cells(state: Array, points: Array, width: float) -> Array:
    """Bound the change of the velocity gradient from the middles `points` to all points of their cells, shape (m,)."""
    places, pulls = state[0], np.linalg.norm(state[1], axis=1)
    length, far = float(np.sqrt(0.75) * width), np.minimum(np.linalg.norm(state[0], axis=1), 1.0)
    whole, curved, rim = 2.0 * (2.0 + far), 2.0 * length * (1.0 + far) ** 2, 1.0 - far
    changes, rows = np.empty(len(points)), max(1, AT_ONCE // len(places))
    for part in (slice(k, k + rows) for k in range(0, len(points), rows)):
        # Below, a cell that may contain a landmark gets the bound `whole`.
        apart = np.maximum(cdist(points[part], places) - length, 1e-300)
        bent = np.maximum(2.0 * length / apart, curved / np.maximum(apart, rim))
        changes[part] = np.minimum(bent, whole) @ pulls
    return changes


@cache
def _cells() -> Array:
    """Return the middles of the coarsest cells that intersect the ball, shape (m, 3)."""
    points = mesh([np.arange(-COARSEST_CELLS, COARSEST_CELLS + 1) / COARSEST_CELLS] * 3)
    reach = 1.0 + np.sqrt(0.75) / COARSEST_CELLS
    return np.asarray(points[(points**2).sum(axis=1) < reach**2])


def _gradients(flow: Flow, state: Array, points: Array) -> Array:
    """Bound the spectral norm of the velocity gradient at points, shape (m,): zero beyond the rim."""
    size = flow.module.BLOCK
    rates, gradients = np.empty(3 * size), np.empty(9 * size)
    norms = np.zeros(len(points))
    inside = np.flatnonzero((points**2).sum(axis=1) < 1.0)
    for k in range(0, len(inside), size):
        part = inside[np.minimum(np.arange(k, k + size), len(inside) - 1)]
        block = points[part].T.ravel()
        flow.module.tracer_gradient(block, state, flow.case.own, flow.case.parameters, rates, gradients)
        norms[part] = np.linalg.norm(gradients.reshape(9, -1), axis=0)
    return norms
