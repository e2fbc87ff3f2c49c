"""Registration: from pairs of landmarks to a map that carries each where it belongs, and to the map's inverse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.drivers.scaled import quiet_single_thread
from codegen.errors import LandmarkError, RegistrationError
from codegen.registration.alignment import Alignment, Kind, align
from codegen.registration.flow import Flow
from codegen.registration.frame import MARGIN, Frame, coarse_grid, corners
from codegen.registration.pairs import LandmarkPairs, PointArray, as_points
from codegen.registration.solver import registration_module

TOLERANCE = 0.01
"""Largest error of the map, in pixels, that the automatic choice of steps leaves to the scheme."""
ROUND_TRIP = 1e-8
"""Largest distance in pixels at which a point may come back from the way forwards and backwards."""
FIRST_STEPS, MOST_STEPS = 5, 320


@dataclass(frozen=True, eq=False)
class Registration:
    """A map from the moving image to the fixed one, and its inverse: alignment, then flow.

    `shape` and `fixed_shape` are (height, width) of both images. `residuals` are the distances, in pixels of the fixed
    image, between where moving landmarks arrive and the fixed ones, shape (n,). `error` estimates how far the map is
    from that of infinitely many steps, in pixels, NaN where steps were given. `round_trip` is the farthest from where
    it was, in pixels, that a point of a coarse grid or a landmark comes back. `rung` says which of the solver's
    attempts succeeded, and `message` how.
    """

    pairs: LandmarkPairs
    shape: tuple[int, int]
    fixed_shape: tuple[int, int]
    alignment: Alignment
    frame: Frame
    flow: Flow
    sigma: float
    scheme: str
    steps: int
    residuals: NDArray[np.float64]
    error: float
    round_trip: float
    status: str
    rung: str
    message: str

    def map_points(self, xy: Any) -> PointArray:
        """Moving to fixed, points in pixels of shape (n, 2)."""
        return self.positions(1.0, xy)

    def map_points_inverse(self, xy: Any) -> PointArray:
        """Fixed to moving, points in pixels of shape (n, 2)."""
        return self.positions(1.0, xy, inverse=True)

    def positions(self, time: float, xy: Any, inverse: bool = False) -> PointArray:
        """Where points of the moving image are at a time from 0, where they were, to 1, where `map_points` has them.

        With `inverse`, where points are from that are at given places at that time. Shape (n, 2), pixels.
        """
        points, part = as_points(xy), self._part(time)
        if inverse:
            aligned = points if part is self.alignment else self.alignment.apply(part.apply_inverse(points))
            return self.alignment.apply_inverse(self._carried(aligned, time, 0.0))
        carried = self._carried(self.alignment.apply(points), 0.0, time)
        return carried if part is self.alignment else part.apply(self.alignment.apply_inverse(carried))

    def jacobian(self, xy: Any, inverse: bool = False) -> NDArray[np.float64]:
        """The derivative of the map, or of its inverse, at points in pixels: shape (n, 2, 2), rows are x and y."""
        points = as_points(xy)
        if inverse:
            jacobians = self.flow.carry_with_jacobian(self.frame.to_disc(points), 1.0, 0.0)[1]
            return np.asarray(self.alignment.inverse_matrix @ jacobians)
        aligned = self.frame.to_disc(self.alignment.apply(points))
        return np.asarray(self.flow.carry_with_jacobian(aligned)[1] @ self.alignment.matrix)

    def determinant(self, xy: Any, inverse: bool = False) -> NDArray[np.float64]:
        """The factor by which the map, or its inverse, enlarges areas at points in pixels, shape (n,)."""
        jacobians = self.jacobian(xy, inverse)
        return np.asarray(jacobians[:, 0, 0] * jacobians[:, 1, 1] - jacobians[:, 0, 1] * jacobians[:, 1, 0])

    def _carried(self, points: PointArray, start: float, stop: float) -> PointArray:
        """Points in pixels of the fixed image carried by the flow: what does not move keeps its every bit."""
        before = self.frame.to_disc(points)
        return points + self.frame.radius * (self.flow.carry(before, start, stop) - before)

    def _part(self, time: float) -> Alignment:
        if not 0.0 <= time <= 1.0:
            raise LandmarkError(f"the time is {time!r}", "give a number from 0 to 1")
        return self.alignment.part(time, self.pairs.moving.mean(axis=0))


def register(
    pairs: LandmarkPairs,
    shape: Sequence[int],
    *,
    fixed_shape: Sequence[int] | None = None,
    align: Kind = "similarity",
    sigma: float = 0.0,
    scheme: str = "midpoint",
    steps: int | None = None,
    tolerance: float = TOLERANCE,
    margin: float = MARGIN,
    start: Registration | None = None,
) -> Registration:
    """Find the map that carries the moving landmarks to the fixed ones.

    `shape` is (height, width, ...) of the moving image, `fixed_shape` that of the fixed one where it differs. `sigma`,
    in pixels, is how far landmarks may miss: zero means that they are met exactly. Without `steps` as many are taken
    as leave an error of the map below `tolerance` pixels. The solver starts from an earlier registration, `start`, of as
    many landmarks, as when a landmark is dragged.

    Raises LandmarkError when the landmarks cannot be used, RegistrationError when no solution is found.
    """
    problem = _problem(pairs, shape, fixed_shape, align, sigma, scheme, margin)
    if steps is not None:
        return _solved(problem, steps, _momenta(start, pairs))
    return _refined(problem, tolerance, _momenta(start, pairs))


@dataclass(frozen=True, eq=False)
class _Problem:
    """What is to be registered, whatever the number of steps."""

    pairs: LandmarkPairs
    shape: tuple[int, int]
    fixed_shape: tuple[int, int]
    alignment: Alignment
    frame: Frame
    sigma: float
    scheme: str


def _problem(
    pairs: LandmarkPairs,
    shape: Sequence[int],
    fixed_shape: Sequence[int] | None,
    kind: Kind,
    sigma: float,
    scheme: str,
    margin: float,
) -> _Problem:
    moving_shape = _extent(shape)
    other_shape = moving_shape if fixed_shape is None else _extent(fixed_shape)
    alignment = align(pairs, kind)
    covered = [
        corners(other_shape), alignment.apply(corners(moving_shape)), pairs.fixed, alignment.apply(pairs.moving)
    ]  # fmt: skip
    frame = Frame.around(np.vstack(covered), margin)
    if not 0.0 <= sigma < np.inf:
        raise LandmarkError(f"sigma is {sigma!r}", "give a distance in pixels that is not negative")
    return _Problem(pairs, moving_shape, other_shape, alignment, frame, float(sigma), scheme)


def _extent(shape: Sequence[int]) -> tuple[int, int]:
    height, width = (int(length) for length in tuple(shape)[:2])
    if height < 1 or width < 1:
        raise LandmarkError(f"the image's shape is {tuple(shape)}", "give its height and width in pixels")
    return height, width


def _momenta(previous: Registration | None, pairs: LandmarkPairs) -> NDArray[np.float64] | None:
    return None if previous is None or len(previous.pairs) != len(pairs) else previous.flow.momenta


def _refined(problem: _Problem, tolerance: float, guess: NDArray[np.float64] | None) -> Registration:
    """Double the steps until the map no longer changes, and keep the smallest number whose error is small enough."""
    if not tolerance > 0.0:
        raise LandmarkError(f"the tolerance is {tolerance!r}", "give a number of pixels")
    coarse = _solved(problem, FIRST_STEPS, guess)
    probe = np.vstack([coarse_grid(problem.shape), problem.pairs.moving])
    while True:
        fine = _solved(problem, 2 * coarse.steps, coarse.flow.momenta)
        gain = 2.0 ** float(fine.flow.module.metadata["order"])
        change = float(np.linalg.norm(fine.map_points(probe) - coarse.map_points(probe), axis=1).max())
        if change * gain / (gain - 1.0) <= tolerance:
            return replace(coarse, error=change * gain / (gain - 1.0))
        if change / (gain - 1.0) <= tolerance or 2 * fine.steps > MOST_STEPS:
            return replace(fine, error=change / (gain - 1.0))
        coarse = fine


def _solved(problem: _Problem, steps: int, guess: NDArray[np.float64] | None) -> Registration:
    flow, solution = _flow(problem, steps, guess)
    rung = solution.attempts[-1].split(":")[0]
    found = Registration(
        **vars(problem), flow=flow, steps=steps, residuals=np.empty(0), error=np.nan, round_trip=np.nan,
        status=solution.status, rung=rung, message=solution.message,
    )  # fmt: skip
    residuals = np.linalg.norm(found.map_points(problem.pairs.moving) - problem.pairs.fixed, axis=1)
    probe = np.vstack([coarse_grid(problem.shape), problem.pairs.moving])
    back = np.linalg.norm(found.map_points_inverse(found.map_points(probe)) - probe, axis=1).max()
    return replace(found, residuals=residuals, round_trip=float(back))


def _flow(problem: _Problem, steps: int, guess: NDArray[np.float64] | None) -> tuple[Flow, Any]:
    """The solved motion of the landmarks; RegistrationError when there is none."""
    module, frame, pairs = registration_module(problem.scheme), problem.frame, problem.pairs
    start, target = frame.to_disc(problem.alignment.apply(pairs.moving)), frame.to_disc(pairs.fixed)
    try:
        case = module.make_case(start, target, steps, sigma=problem.sigma * frame.scale)
    except ValueError as error:
        raise LandmarkError(str(error), "correct the landmarks, or the arguments") from error
    with quiet_single_thread():
        solution = None if guess is None else module.solve_case(case, guess)
        if solution is None or solution.status != "solved":
            solution = module.solve_case(case)
        if solution.status != "solved":
            raise RegistrationError(_failure(problem, solution.message), _REMEDY)
        path = np.stack([solution.q, solution.p], axis=1)
    return Flow(module, case, path, module.stages_of(case, path)), solution


_REMEDY = "allow for a sigma, take more steps, or leave out landmarks that are close together and move apart"


def _failure(problem: _Problem, message: str) -> str:
    """What is reported of landmarks that no motion was found for: the two whose distance changes most."""
    before, after = problem.alignment.apply(problem.pairs.moving), problem.pairs.fixed
    if len(before) < 2:
        return message
    i, j = np.triu_indices(len(before), 1)
    apart, moved = np.linalg.norm(before[i] - before[j], axis=1), (after - before)[i] - (after - before)[j]
    worst = int(np.argmax(np.linalg.norm(moved, axis=1) / apart))
    names = problem.pairs.names
    one, other = names[i[worst]], names[j[worst]]
    x, y = problem.pairs.moving[i[worst]]
    return f"{message.split(';')[0]} (hardest are landmarks {one} and {other}, near ({x:.1f}, {y:.1f}))"
