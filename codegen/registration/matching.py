"""What is to be matched, whatever the number of steps: landmarks, their alignment, the frame; and its solution.

Landmarks that are given twice: pairs that are one to within what nobody can see, which are carried as one. Two points
so close have nearly the same rows in the Green's function; below some 1e-5 pixels rounding makes their momenta
arbitrary, and no motion is found although there is an obvious one.

Landmarks in another order: whether they fit much better if some change their partners. Two files whose rows do not
correspond are what most often makes a registration impossible, and then no pair is to blame more than others. Partners
are found as the iterative closest point method does (Besl and McKay 1992, IEEE Trans. Pattern Anal. Mach. Intell.
14(2)), but one to one (the assignment problem), from several alignments.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from codegen.errors import LandmarkError, RegistrationError
from codegen.registration.alignment import Alignment, Kind, align
from codegen.registration.grid import MARGINS, Extent, Frame, Grid, corners, grid_of, place_text
from codegen.registration.pairs import LandmarkPairs, PointArray
from codegen.registration.solver import DEFAULT_SCHEME, Flow, FlowModule, registration_module
from codegen.solving.drivers.shared import quiet_single_thread

ONE = 1e-4
"""Distance in pixels, in the moving and in the fixed image, up to which two pairs are carried as one."""


def groups_of(moving: NDArray[np.float64], fixed: NDArray[np.float64], pixel: float = 1.0) -> NDArray[np.intp]:
    """The number of the group of each pair, from zero in the order of their first members, shape (n,).

    `pixel` is the size of a pixel in the units of the points.
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
"""Of fewer landmarks another order says nothing, and of more it takes too long to look for one."""
MOST_TURNED = 200
"""More are looked at without turning them."""
BETTER = 0.25
"""The share of the squared distances that other partners may leave at the most."""
ROUNDS = 20
NAMED = 5
"""Landmarks that are named at the most."""


def partners(pairs: LandmarkPairs) -> NDArray[np.intp] | None:
    """The number of the fixed landmark that each moving one fits, shape (n,); None where none other fits much better.

    What is compared are squared distances after the best similarity.
    """
    count = len(pairs)
    if not FEWEST <= count <= MOST:
        return None
    given = _left(pairs, np.arange(count))
    best, least = np.arange(count), BETTER * given
    for start in _starts(pairs):
        order = _assigned(start, pairs.fixed)
        for _ in range(ROUNDS):
            try:
                moved = align(_reordered(pairs, order)).apply(pairs.moving)
            except LandmarkError:  # a mirrored or a degenerate fit
                break
            following = _assigned(moved, pairs.fixed)
            if (following == order).all():
                break
            order = following
        left = _left(pairs, order)
        if left < least:
            best, least = order, left
    return best if (best != np.arange(count)).any() else None


def said_of_partners(pairs: LandmarkPairs) -> str:
    """Which landmarks fit other partners much better, in words; empty where none do."""
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
    """Where moving landmarks may belong before any partner is known: as they are; alike in place and size, turned."""
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


def _reordered(pairs: LandmarkPairs, order: NDArray[np.intp]) -> LandmarkPairs:
    return LandmarkPairs(pairs.moving, pairs.fixed[order])


def _left(pairs: LandmarkPairs, order: NDArray[np.intp]) -> float:
    """The squared distances that the best similarity leaves; infinite where there is none."""
    reordered = _reordered(pairs, order)
    try:
        return float(((align(reordered).apply(pairs.moving) - reordered.fixed) ** 2).sum())
    except LandmarkError:
        return np.inf


TRUSTED = 0.5
"""The least weight of landmarks that are aligned."""
FAR = 1.5
"""How many times what the linear theory expects landmarks may miss before another solution is looked for."""
IN_ORDER = "give landmarks of both images in the same order"
PATIENCE = 20
"""Iterations after which momenta that do not lead to a solution are given up."""


@dataclass(frozen=True, eq=False)
class Matching:
    """Landmarks to be carried to their places by an alignment and a flow in the frame.

    Images are warped by looking up where each pixel comes from, and that is the way in which the flow runs: it carries
    the fixed landmarks to where the alignment has the moving ones, so that explicit schemes need no iterations there.

    `grid` and `fixed_grid` are those of the moving and the fixed image; in their coordinates, which are pixels for
    pictures, are all distances that are called pixels. `sigma` is the standard deviation
    of a landmark's error in pixels; where it is not zero, the motion has the least

        strength * roughness / 2 + sum_k weights_k |miss_k|^2 / (2 sigma^2),

    with misses where the flow ends, in pixels of the fixed image, and as roughness the squared length of the motion,
    in units in which the disc's radius is 1, as sigma is there. Pairs that are one to within `coincident.ONE` pixels in
    both images are carried as one; `groups`, shape (n,), says by which number.
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
        cls,
        pairs: LandmarkPairs,
        shape: Extent,
        *,
        fixed_shape: Extent | None = None,
        align: Kind = "similarity",
        sigma: float = 0.0,
        scheme: str = DEFAULT_SCHEME,
        margin: float | None = None,
        strength: float = 1.0,
        weights: NDArray[np.float64] | None = None,
    ) -> Matching:
        """Align the landmarks and lay the frame around both images; LandmarkError when something is unusable.

        `shape` and `fixed_shape`, by default the same, are shapes of pictures or grids.

        Only landmarks of a weight of `TRUSTED` and more are aligned.
        """
        grid = grid_of(shape)
        fixed_grid = grid if fixed_shape is None else grid_of(fixed_shape)
        _require_dimension(pairs, grid, fixed_grid)
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
    def shape(self) -> tuple[int, ...]:
        """The shape of the moving image: (height, width), or (slices, rows, columns)."""
        return self.grid.shape

    @property
    def fixed_shape(self) -> tuple[int, ...]:
        """That of the fixed image."""
        return self.fixed_grid.shape

    @property
    def pixel(self) -> float:
        """The finest spacing of the fixed image, in units of which errors are judged: 1 for pictures."""
        return self.fixed_grid.pixel

    @property
    def unit(self) -> str:
        """What distances are counted in: pixels for pictures."""
        return self.fixed_grid.unit

    @property
    def module(self) -> FlowModule:
        """The generated module whose flow carries the landmarks."""
        return registration_module(self.scheme, self.pairs.dimension)

    @property
    def ends(self) -> tuple[PointArray, PointArray]:
        """Where the flow takes the landmarks up in the disc, and where, by the alignment, it is to bring them."""
        fixed, moving = self.pairs.fixed, self.alignment.apply(self.pairs.moving)
        return self.frame.to_disc(self._grouped(fixed)), self.frame.to_disc(self._grouped(moving))

    @property
    def all_ends(self) -> tuple[PointArray, PointArray]:
        """The same of every pair, whether or not it is carried as one with others."""
        return self.frame.to_disc(self.pairs.fixed), self.frame.to_disc(self.alignment.apply(self.pairs.moving))

    @cached_property
    def covariance(self) -> NDArray[np.float64]:
        """The Green's function at the places where the flow takes the pairs up, shape (n, n)."""
        return self._covariance(self._case(1))[np.ix_(self.groups, self.groups)]

    def _covariance(self, case: Any) -> NDArray[np.float64]:
        """The same of what is carried, shape (m, m)."""
        matrix = np.empty((len(case.start), len(case.start)))
        state = np.stack([case.start, np.zeros_like(case.start)])
        self.module.momentum_matrix(state, case.own, case.parameters, matrix)
        return matrix

    @property
    def ridge(self) -> float:
        """The square of how far a landmark of weight 1 misses for a unit of momentum, in units of the disc."""
        return float((self.sigma * self.frame.scale) ** 2 * self.strength)

    def realigned(self, trusted: NDArray[np.bool_]) -> Alignment:
        """The alignment of the same kind that fits some of the landmarks, shape (n,), best."""
        return _aligned(self.pairs.chosen(trusted), self.align)

    def weighted(self, weights: NDArray[np.float64]) -> Matching:
        """The same with other weights, shape (n,), and the alignment of those that are trusted."""
        return self._of(self.pairs, weights)

    def without(self, k: int) -> Matching:
        """The same without pair number k, aligned anew, in a frame of its own."""
        return self._of(self.pairs.without(k), np.delete(self.weights, k))

    def _of(self, pairs: LandmarkPairs, weights: NDArray[np.float64]) -> Matching:
        return Matching.of(
            pairs, self.grid, fixed_shape=self.fixed_grid, align=self.align, sigma=self.sigma, scheme=self.scheme,
            margin=self.margin, strength=self.strength, weights=weights,
        )  # fmt: skip

    def _grouped(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """The weighted means of values of pairs, shape (n, d), in their groups, shape (m, 2)."""
        if len(self.pairs) == self.groups.max() + 1:
            return values
        sums = [np.bincount(self.groups, self.weights * column) for column in values.T]
        return np.stack(sums, axis=1) / self._group_weights[:, None]

    @property
    def _group_weights(self) -> NDArray[np.float64]:
        return np.asarray(np.bincount(self.groups, self.weights))

    def solve(
        self, steps: int, velocities: NDArray[np.float64] | None = None, quick: bool = False
    ) -> tuple[Flow, Any, str]:
        """The motion that carries the landmarks in so many steps, the generated solver's account, and what led to it.

        The solver starts from guessed `velocities` of the pairs at the start, shape (n, d), if there are any, from
        those of the straight way, and from a path of least action; unless it is to be `quick`, it then climbs its
        ladder of further attempts. Raises RegistrationError, naming the landmarks that are hardest, when no attempt
        succeeds.
        """
        module, case = self.module, self._case(steps)
        with quiet_single_thread():
            found = self._cheapest(case, None if velocities is None else self._grouped(velocities))
            if found is not None:
                return self._flow(case, found[0]), *found
            if not quick:
                solution = module.solve_case(case)
                if solution.status == "solved":
                    return self._flow(case, solution), solution, solution.attempts[-1].split(":")[0]
        said = f"no motion of {steps} steps of {self.scheme} was found that carries the landmarks to their places"
        if out_of_order := said_of_partners(self.pairs):
            raise RegistrationError(f"{said}; {out_of_order}", IN_ORDER)
        remedy = "allow for a sigma, take more steps, or leave out landmarks that are close and move apart"
        raise RegistrationError(said + self._hardest(), remedy)

    def _cheapest(self, case: Any, velocities: NDArray[np.float64] | None) -> tuple[Any, str] | None:
        """The solution to be taken and what led to it, if any attempt had one.

        With a sigma, equations are solved by any stationary point of the cost, such as two landmarks that ought to
        change places and end together half way. One that misses by more than the linear theory expects is compared with
        what other momenta lead to.
        """
        module, least = self.module, np.inf
        best: tuple[Any, str] | None = None
        for name, momenta in self._first_momenta(case, velocities):
            solution = module.solve_case(case._replace(max_iterations=PATIENCE), momenta)
            if solution.status == "solved":
                penalised = module.penalised(case, solution.cost, solution.q[-1])
                if best is None or penalised < least:
                    best, least = (solution, f"shooting from {name}"), penalised
                if not self._misses_by_far(case, best[0].q[-1]):
                    break
        return best

    def _misses_by_far(self, case: Any, end: NDArray[np.float64]) -> bool:
        """Whether the root mean square of misses is much larger than that of small momenta for small displacements."""
        if self.ridge == 0.0:
            return False
        start, target = self.all_ends
        ridges = self.ridge / self.weights
        pulls = np.linalg.solve(self.covariance + np.diag(ridges), target - start)
        expected = np.linalg.norm(np.sqrt(ridges)[:, None] * pulls)
        missed = (end - case.target) / case.sigma[:, None]
        return bool(np.linalg.norm(missed) > FAR * expected)

    def _case(self, steps: int) -> Any:
        """The generated module's account of what is to be connected."""
        start, target = self.ends
        sigma = np.sqrt(self.ridge / self._group_weights)
        try:
            return self.module.make_case(start, target, steps, sigma=sigma)
        except ValueError as error:
            raise LandmarkError(str(error), "correct the landmarks, or the arguments") from error

    def _first_momenta(
        self, case: Any, velocities: NDArray[np.float64] | None
    ) -> Iterator[tuple[str, NDArray[np.float64]]]:
        """Momenta from which shooting is likely to arrive, the cheapest first, and what they are called."""
        module = self.module
        if velocities is not None:
            yield "a known registration", module.momenta_of(case, case.start, velocities)
        yield "the straight way", self._straight_momenta(case)
        if np.isfinite(self._of_least_action).all():
            yield "a path of least action", self._of_least_action

    def _straight_momenta(self, case: Any) -> NDArray[np.float64]:
        """Those of the linear theory: the straight way, as far as landmarks are to go it."""
        module = self.module
        if self.ridge == 0.0:
            straight = (case.target - case.start) / case.duration
            return module.momenta_of(case, case.start, straight)
        matrix = self._covariance(case) * case.duration + np.diag(case.sigma**2)
        return np.asarray(np.linalg.solve(matrix, case.target - case.start))

    @cached_property
    def _of_least_action(self) -> NDArray[np.float64]:
        """Momenta at the start of a path of least action, whose intervals are its own: they serve any steps.

        NaN where there is no such path, or where there are too many landmarks to look for one.
        """
        return self.module.momenta_of_least_action(self._case(1))

    def _flow(self, case: Any, solution: Any) -> Flow:
        module = self.module
        path = np.stack([solution.q, solution.p], axis=1)
        return Flow(module, case, path, module.stages_of(case, path))

    def _hardest(self) -> str:
        """What is said of landmarks that no motion was found for: the two whose way apart changes most.

        It is measured by the shorter of both, so that two that are nearly one in either image come first.
        """
        before, after = self.alignment.apply(self.pairs.moving), self.pairs.fixed
        if len(before) < 2:
            return ""
        i, j = np.triu_indices(len(before), 1)
        apart = np.minimum(*(np.linalg.norm(points[i] - points[j], axis=1) for points in (before, after)))
        changes = np.linalg.norm((after - before)[i] - (after - before)[j], axis=1) / apart
        worst = int(np.argmax(np.where(self.groups[i] == self.groups[j], 0.0, changes)))
        one, other = (self.pairs.names[k[worst]] for k in (i, j))
        return (
            f"; hardest are landmarks {one} and {other}, near {place_text(self.grid.said(self.pairs.moving[i[worst]]))}"
        )


_aligned = align  # a parameter of `Matching.of` has that name


def _require_dimension(pairs: LandmarkPairs, *grids: Grid) -> None:
    """Refuse landmarks in the plane for volumes, and the other way about."""
    if any(grid.dimension != pairs.dimension for grid in grids):
        axes, said = ("x and y", "the images are volumes") if pairs.dimension == 2 else ("x, y, z", "an image is flat")
        raise LandmarkError(f"landmarks have {axes}, and {said}", "give landmarks and images of one dimension")
