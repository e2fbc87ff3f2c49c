"""The matching of landmarks by an alignment and a flow: the problem, for any number of steps, and its solution.

Coincident landmarks: nearly identical pairs are carried as one point. Very close points have nearly equal rows in the
matrix of the Green's function. Below about 1e-5 pixels rounding makes their momenta arbitrary, and the solver fails.

Landmarks in another order: two files whose rows do not correspond are the most frequent cause of a failed registration.
Partners that fit much better are found by iterative closest points (Besl and McKay 1992, IEEE Trans. Pattern Anal.
Mach. Intell. 14(2)) from several alignments. The partners are one to one (the assignment problem).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from codegen.errors import LandmarkError, RegistrationError
from codegen.registration.grid import MARGINS, Extent, Frame, Grid, corners, grid_of, place_text
from codegen.registration.pairs import Alignment, Kind, LandmarkPairs, PointArray, align
from codegen.registration.solver import DEFAULT_SCHEME, Flow, FlowCase, FlowModule, registration_module
from codegen.solving.drivers.quiet import quiet_single_thread

if TYPE_CHECKING:
    from codegen.runtime.particles.cascade import Solution

ONE = 1e-4  # largest distance, in pixels in each image, between two pairs that are carried as one point


def groups_of(moving: NDArray[np.float64], fixed: NDArray[np.float64], pixel: float = 1.0) -> NDArray[np.intp]:
    """Return the number of the group of each pair, shape (n,); pairs within `ONE` pixels of each other form a group.

    Groups are numbered from zero in the order of their first pairs. `pixel` is the side of a pixel in units of points.
    """
    close = KDTree(fixed).query_pairs(ONE * pixel, output_type="ndarray")
    close = close[np.linalg.norm(moving[close[:, 0]] - moving[close[:, 1]], axis=1) <= ONE * pixel]
    count = len(fixed)
    if not close.size:
        return np.arange(count)
    graph = coo_array((np.ones(len(close)), (close[:, 0], close[:, 1])), shape=(count, count))
    labels = connected_components(graph, directed=False)[1]
    _, first, numbers = np.unique(labels, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[numbers], dtype=np.intp)


FEWEST, MOST = 4, 1000
"""Fewest and most landmarks for which a better order is searched; with more, the search takes too long."""
MOST_TURNED = 200  # most landmarks for which rotations are tried
BETTER = 0.25
"""The ratio of squared distances, other partners to given partners, below which other partners fit much better."""
ROUNDS = 20  # most iterations of closest points
NAMED = 5  # most landmarks in a message


def partners(pairs: LandmarkPairs) -> NDArray[np.intp] | None:
    """Return the index of the fixed landmark that fits each moving one, shape (n,); None if no order fits much better.

    The criterion is the sum of squared distances after the best similarity.
    """
    count = len(pairs)
    if not FEWEST <= count <= MOST:
        return None
    best, least = np.arange(count), BETTER * _squared_distances(pairs, np.arange(count))
    for start in _starts(pairs):
        order = _assigned(start, pairs.fixed)
        for _ in range(ROUNDS):
            try:
                moved = align(LandmarkPairs(pairs.moving, pairs.fixed[order])).apply(pairs.moving)
            except LandmarkError:  # a mirrored or a degenerate fit
                break
            following = _assigned(moved, pairs.fixed)
            if (following == order).all():
                break
            order = following
        distances = _squared_distances(pairs, order)
        if distances < least:
            best, least = order, distances
    return best if (best != np.arange(count)).any() else None


def said_of_partners(pairs: LandmarkPairs) -> str:
    """Return a message with the landmarks that fit other partners much better, or an empty string."""
    order = partners(pairs)
    if order is None:
        return ""
    other = np.flatnonzero(order != np.arange(len(pairs)))
    names = pairs.names
    if len(other) == 2:
        return f"landmarks {names[other[0]]} and {names[other[1]]} seem to have changed places"
    named = ", ".join(f"{names[k]} with {names[order[k]]}" for k in other[:NAMED])
    more = " ..." if len(other) > NAMED else ""
    return f"{len(other)} of {len(pairs)} landmarks fit others' partners better (moving {named}{more})"


def _starts(pairs: LandmarkPairs) -> Iterator[PointArray]:
    """Yield initial positions of moving landmarks: unchanged; with mean and spread of the fixed, in some rotations."""
    yield pairs.moving
    middle, spread = pairs.fixed.mean(axis=0), pairs.fixed.std()
    centred = (pairs.moving - pairs.moving.mean(axis=0)) * (spread / pairs.moving.std())
    if len(pairs) > MOST_TURNED:
        yield centred + middle
    elif pairs.dimension == 2:
        for cosine, sine in ((np.cos(angle), np.sin(angle)) for angle in np.arange(12) * np.pi / 6.0):
            yield centred @ np.array([[cosine, sine], [-sine, cosine]]) + middle
    else:
        for turn in Rotation.create_group("O"):
            yield turn.apply(centred) + middle


def _assigned(moved: PointArray, fixed: PointArray) -> NDArray[np.intp]:
    return np.asarray(linear_sum_assignment(cdist(moved, fixed, "sqeuclidean"))[1])


def _squared_distances(pairs: LandmarkPairs, order: NDArray[np.intp]) -> float:
    """Return the sum of squared distances after the best similarity for an `order`; infinite without a similarity."""
    reordered = LandmarkPairs(pairs.moving, pairs.fixed[order])
    try:
        return float(((align(reordered).apply(pairs.moving) - reordered.fixed) ** 2).sum())
    except LandmarkError:
        return np.inf


TRUSTED = 0.5  # the least weight of landmarks that determine the alignment
FAR = 1.5  # the ratio of misses to the prediction of the linear theory above which other initial momenta are tried
IN_ORDER = "give landmarks of both images in the same order"
PATIENCE = 20  # most iterations of shooting from one initial guess of the momenta


@dataclass(frozen=True, eq=False)
class Matching:
    """Landmarks to be matched by an alignment and a flow in the frame.

    The flow carries the fixed landmarks to the aligned moving ones. The values of warped images are read in this
    direction, from fixed to moving, so that explicit schemes need no iterations for images.

    All distances in pixels are in the coordinates of `grid` and `fixed_grid`, which are pixels for pictures. `sigma` is
    the standard deviation of the error of a coordinate in pixels. If it is not zero, the motion minimises

        strength * roughness / 2 + sum_k weights_k |miss_k|^2 / (2 sigma^2).

    A miss is the error of a landmark at the end of the flow, in the unit of sigma. The roughness is the squared length
    of the motion in units of the radius of the disc. Pairs closer than `ONE` pixels in both images are carried as one
    point; `groups`, shape (n,), has the number of the group of each pair.
    """

    pairs: LandmarkPairs
    grid: Grid
    fixed_grid: Grid
    alignment: Alignment
    frame: Frame
    sigma: float
    scheme: str
    strength: float
    weights: NDArray[np.float64]
    groups: NDArray[np.intp]
    align: Kind
    margin: float

    @classmethod
    def of(
        cls, pairs: LandmarkPairs, shape: Extent, *, fixed_shape: Extent | None = None, align: Kind = "similarity",
        sigma: float = 0.0, scheme: str = DEFAULT_SCHEME, margin: float | None = None, strength: float = 1.0,
        weights: NDArray[np.float64] | None = None,
    ) -> Matching:  # fmt: skip
        """Align the landmarks and lay the frame around both images; LandmarkError for unusable arguments.

        `shape` and `fixed_shape`, by default equal, are shapes of pictures or grids. Only landmarks with a weight of at
        least `TRUSTED` determine the alignment. `margin` is the margin of the disc around the images, as in `register`.
        """
        grid = grid_of(shape)
        fixed_grid = grid if fixed_shape is None else grid_of(fixed_shape)
        if grid.dimension != pairs.dimension or fixed_grid.dimension != pairs.dimension:
            axes, other = ("x and y", "the images are volumes")
            if pairs.dimension == 3:
                axes, other = "x, y, z", "an image is flat"
            raise LandmarkError(f"landmarks have {axes}, and {other}", "give landmarks and images of one dimension")
        if not 0.0 <= sigma < np.inf:
            raise LandmarkError(f"sigma is {sigma!r}", f"give a distance in {fixed_grid.unit} that is not negative")
        if weights is None:
            weights = np.ones(len(pairs))
        margin = MARGINS[pairs.dimension] if margin is None else margin
        alignment = _aligned(pairs.chosen(weights >= TRUSTED) if (weights >= TRUSTED).any() else pairs, align)
        moved = [alignment.apply(corners(grid)), alignment.apply(pairs.moving)]
        frame = Frame.around(np.vstack([corners(fixed_grid), pairs.fixed, *moved]), margin)
        groups = groups_of(pairs.moving, pairs.fixed, fixed_grid.pixel)
        return cls(
            pairs, grid, fixed_grid, alignment, frame, float(sigma), scheme, float(strength), weights, groups,
            align, margin,
        )  # fmt: skip

    @property
    def module(self) -> FlowModule:
        """The generated module whose flow carries the landmarks."""
        return registration_module(self.scheme, self.pairs.dimension)

    @property
    def ends(self) -> tuple[PointArray, PointArray]:
        """Starts and targets of the flow in the disc: the fixed landmarks, and the aligned moving landmarks."""
        return self.frame.to_disc(self.pairs.fixed), self.frame.to_disc(self.alignment.apply(self.pairs.moving))

    @cached_property
    def covariance(self) -> NDArray[np.float64]:
        """The Green's function between the starts of all pairs, shape (n, n)."""
        return self._covariance(self._case(1))[np.ix_(self.groups, self.groups)]

    def _covariance(self, case: FlowCase) -> NDArray[np.float64]:
        """Return the Green's function between the starts of all groups, shape (m, m)."""
        matrix = np.empty((len(case.start), len(case.start)))
        state = np.stack([case.start, np.zeros_like(case.start)])
        self.module.momentum_matrix(state, case.own, case.parameters, matrix)
        return matrix

    @property
    def ridge(self) -> float:
        """sigma^2 times the strength, in units of the disc: the miss of a landmark of weight 1 per unit of momentum."""
        return float((self.sigma * self.frame.scale) ** 2 * self.strength)

    def realigned(self, trusted: NDArray[np.bool_]) -> Alignment:
        """Return the alignment of the same kind that fits the landmarks marked in `trusted`, shape (n,)."""
        return _aligned(self.pairs.chosen(trusted), self.align)

    def matched(self, pairs: LandmarkPairs, weights: NDArray[np.float64]) -> Matching:
        """Return the matching of other pairs and weights, shape (n,), with the same options and a new alignment."""
        return Matching.of(
            pairs, self.grid, fixed_shape=self.fixed_grid, align=self.align, sigma=self.sigma, scheme=self.scheme,
            margin=self.margin, strength=self.strength, weights=weights,
        )  # fmt: skip

    def _grouped(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the weighted mean of each group, shape (m, d), from values of all pairs, shape (n, d)."""
        if len(self.pairs) == self.groups.max() + 1:
            return values
        sums = [np.bincount(self.groups, self.weights * column) for column in values.T]
        return np.stack(sums, axis=1) / np.bincount(self.groups, self.weights)[:, None]

    def solve(
        self, steps: int, velocities: NDArray[np.float64] | None = None, quick: bool = False
    ) -> tuple[Flow, Solution, str]:
        """Solve for the motion in a number of steps; return the flow, the solution and the name of the attempt.

        The initial guesses are the initial `velocities` of the pairs, shape (n, d), if not None, then straight lines,
        then a path of least action. If they fail and `quick` is False, the generated solver makes further attempts.
        Raise RegistrationError, with the most difficult landmarks, if no attempt succeeds.
        """
        module, case = self.module, self._case(steps)
        with quiet_single_thread():
            best = self._cheapest(case, None if velocities is None else self._grouped(velocities))
            if best is None and not quick:
                solution = module.solve_case(case)
                if solution.status == "solved":
                    best = solution, solution.attempts[-1].split(":")[0]
            if best is not None:
                path = np.stack([best[0].q, best[0].p], axis=1)
                return Flow(module, case, path, module.stages_of(case, path)), *best
        finding = f"no motion of {steps} steps of {self.scheme} was found that carries the landmarks to their places"
        if out_of_order := said_of_partners(self.pairs):
            raise RegistrationError(f"{finding}; {out_of_order}", IN_ORDER)
        before, after = self.alignment.apply(self.pairs.moving), self.pairs.fixed
        if len(before) > 1:
            # The two landmarks whose distance changes most, relative to the smaller distance of both images.
            i, j = np.triu_indices(len(before), 1)
            apart = np.minimum(*(np.linalg.norm(points[i] - points[j], axis=1) for points in (before, after)))
            changes = np.linalg.norm((after - before)[i] - (after - before)[j], axis=1) / apart
            worst = int(np.argmax(np.where(self.groups[i] == self.groups[j], 0.0, changes)))
            one, other = (self.pairs.names[k[worst]] for k in (i, j))
            place = place_text(self.grid.said(self.pairs.moving[i[worst]]))
            finding += f"; hardest are landmarks {one} and {other}, near {place}"
        remedy = "allow for a sigma, take more steps, or leave out landmarks that are close and move apart"
        raise RegistrationError(finding, remedy)

    def _cheapest(self, case: FlowCase, velocities: NDArray[np.float64] | None) -> tuple[Solution, str] | None:
        """Return the solution of least cost with the name of its attempt; None if no attempt has a solution.

        With a sigma, every stationary point of the cost solves the equations, also a motion in which two landmarks meet
        halfway instead of exchanging their positions. If the misses of a solution are larger than the linear theory
        predicts, solutions from other initial momenta are tried.
        """
        module, least = self.module, np.inf
        best: tuple[Solution, str] | None = None
        for name, momenta in self._first_momenta(case, velocities):
            solution = module.solve_case(case._replace(max_iterations=PATIENCE), momenta)
            if solution.status == "solved":
                penalised = module.penalised(case, solution.cost, solution.q[-1])
                if best is None or penalised < least:
                    best, least = (solution, f"shooting from {name}"), penalised
                if self.ridge == 0.0:
                    break
                # The norm of the misses relative to sigma, and its prediction by the linear theory.
                start, target = self.ends
                ridges = self.ridge / self.weights
                pulls = np.linalg.solve(self.covariance + np.diag(ridges), target - start)
                expected = np.linalg.norm(np.sqrt(ridges)[:, None] * pulls)
                misses = (best[0].q[-1] - case.target) / case.sigma[:, None]
                if not np.linalg.norm(misses) > FAR * expected:
                    break
        return best

    def _case(self, steps: int) -> FlowCase:
        """Return the data of the problem for the generated module."""
        fixed, moving = self._grouped(self.pairs.fixed), self._grouped(self.alignment.apply(self.pairs.moving))
        start, target = self.frame.to_disc(fixed), self.frame.to_disc(moving)
        sigma = np.sqrt(self.ridge / np.bincount(self.groups, self.weights))
        try:
            return self.module.make_case(start, target, steps, sigma=sigma)
        except ValueError as error:
            raise LandmarkError(str(error), "correct the landmarks, or the arguments") from error

    def _first_momenta(
        self, case: FlowCase, velocities: NDArray[np.float64] | None
    ) -> Iterator[tuple[str, NDArray[np.float64]]]:
        """Yield the names and values of initial momenta for shooting, shape (m, d), the cheapest to compute first."""
        module = self.module
        if velocities is not None:
            yield "a known registration", module.momenta_of(case, case.start, velocities)
        if self.ridge == 0.0:
            straight = (case.target - case.start) / case.duration
            yield "the straight way", module.momenta_of(case, case.start, straight)
        else:  # the linear theory
            matrix = self._covariance(case) * case.duration + np.diag(case.sigma**2)
            yield "the straight way", np.asarray(np.linalg.solve(matrix, case.target - case.start))
        if np.isfinite(self._of_least_action).all():
            yield "a path of least action", self._of_least_action

    @cached_property
    def _of_least_action(self) -> NDArray[np.float64]:
        """Initial momenta of a path of least action, for any number of steps.

        They are NaN if there is no such path, or if there are too many landmarks.
        """
        return self.module.momenta_of_least_action(self._case(1))


_aligned = align  # because a parameter of `Matching.of` is also named `align`
