"""What is to be matched, whatever the number of steps: landmarks, their alignment, the frame; and its solution."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.drivers.scaled import quiet_single_thread
from codegen.errors import LandmarkError, RegistrationError
from codegen.registration.alignment import Alignment, Kind, align
from codegen.registration.flow import Flow
from codegen.registration.frame import MARGIN, Frame, corners
from codegen.registration.pairs import LandmarkPairs, PointArray
from codegen.registration.solver import DEFAULT_SCHEME, registration_module

PATIENCE = 20
"""Iterations after which momenta that do not lead to a solution are given up."""


@dataclass(frozen=True, eq=False)
class Matching:
    """Landmarks to be carried to their places by an alignment and a flow in the frame.

    Images are warped by looking up where each pixel comes from, and that is the way in which the flow runs: it carries
    the fixed landmarks to where the alignment has the moving ones, so that explicit schemes need no iterations there.

    `shape` and `fixed_shape` are (height, width) of the moving and the fixed image; `sigma`, in pixels, says how far
    landmarks may miss.
    """

    pairs: LandmarkPairs
    shape: tuple[int, int]
    fixed_shape: tuple[int, int]
    alignment: Alignment
    frame: Frame
    sigma: float
    scheme: str

    @classmethod
    def of(
        cls,
        pairs: LandmarkPairs,
        shape: Sequence[int],
        *,
        fixed_shape: Sequence[int] | None = None,
        align: Kind = "similarity",
        sigma: float = 0.0,
        scheme: str = DEFAULT_SCHEME,
        margin: float = MARGIN,
    ) -> Matching:
        """Align the landmarks and lay the frame around both images; LandmarkError when something is unusable."""
        moving_shape = _extent(shape)
        other_shape = moving_shape if fixed_shape is None else _extent(fixed_shape)
        if not 0.0 <= sigma < np.inf:
            raise LandmarkError(f"sigma is {sigma!r}", "give a distance in pixels that is not negative")
        alignment = _aligned(pairs, align)
        moved = [alignment.apply(corners(moving_shape)), alignment.apply(pairs.moving)]
        frame = Frame.around(np.vstack([corners(other_shape), pairs.fixed, *moved]), margin)
        return cls(pairs, moving_shape, other_shape, alignment, frame, float(sigma), scheme)

    @property
    def ends(self) -> tuple[PointArray, PointArray]:
        """Where the flow takes the landmarks up in the disc, and where, by the alignment, it is to bring them."""
        return self.frame.to_disc(self.pairs.fixed), self.frame.to_disc(self.alignment.apply(self.pairs.moving))

    def solve(
        self, steps: int, velocities: NDArray[np.float64] | None = None, quick: bool = False
    ) -> tuple[Flow, Any, str]:
        """The motion that carries the landmarks in so many steps, the generated solver's account, and what led to it.

        The solver starts from guessed `velocities` at the start, shape (n, 2), if there are any, from those of the
        straight way, and from a path of least action; unless it is to be `quick`, it then climbs its ladder of further
        attempts. Raises RegistrationError, naming the landmarks that are hardest, when no attempt succeeds.
        """
        module = registration_module(self.scheme)
        case = self._case(steps)
        with quiet_single_thread():
            found = self._cheapest(case, velocities)
            if found is not None:
                return self._flow(case, found[0]), *found
            if not quick:
                solution = module.solve_case(case)
                if solution.status == "solved":
                    return self._flow(case, solution), solution, solution.attempts[-1].split(":")[0]
        remedy = "allow for a sigma, take more steps, or leave out landmarks that are close and move apart"
        raise RegistrationError(self._failure(steps), remedy)

    def _cheapest(self, case: Any, velocities: NDArray[np.float64] | None) -> tuple[Any, str] | None:
        """The solution to be taken and what led to it, if any attempt had one.

        With a sigma, equations are solved by any stationary point of the cost, such as two landmarks that ought to
        change places and end together half way. One that misses by far is compared with what other momenta lead to.
        """
        module, least = registration_module(self.scheme), np.inf
        best: tuple[Any, str] | None = None
        for name, momenta in self._first_momenta(case, velocities):
            solution = module.solve_case(case._replace(max_iterations=PATIENCE), momenta)
            if solution.status == "solved":
                penalised = module.penalised(case, solution.cost, solution.q[-1])
                if best is None or penalised < least:
                    best, least = (solution, f"shooting from {name}"), penalised
                if not module.misses_by_far(case, best[0].q[-1]):
                    break
        return best

    def _case(self, steps: int) -> Any:
        """The generated module's account of what is to be connected."""
        start, target = self.ends
        try:
            return registration_module(self.scheme).make_case(start, target, steps, sigma=self.sigma * self.frame.scale)
        except ValueError as error:
            raise LandmarkError(str(error), "correct the landmarks, or the arguments") from error

    def _first_momenta(
        self, case: Any, velocities: NDArray[np.float64] | None
    ) -> Iterator[tuple[str, NDArray[np.float64]]]:
        """Momenta from which shooting is likely to arrive, the cheapest first, and what they are called."""
        module = registration_module(self.scheme)
        if velocities is not None:
            yield "a known registration", module.momenta_of(case.start, velocities, case.own, case.parameters)
        straight = (case.target - case.start) / case.duration
        yield "the straight way", module.momenta_of(case.start, straight, case.own, case.parameters)
        if np.isfinite(self._of_least_action).all():
            yield "a path of least action", self._of_least_action

    @cached_property
    def _of_least_action(self) -> NDArray[np.float64]:
        """Momenta at the start of a path of least action, whose intervals are its own: they serve any steps.

        NaN where there is no such path, or where there are too many landmarks to look for one.
        """
        return registration_module(self.scheme).momenta_of_least_action(self._case(1))

    def _flow(self, case: Any, solution: Any) -> Flow:
        module = registration_module(self.scheme)
        path = np.stack([solution.q, solution.p], axis=1)
        return Flow(module, case, path, module.stages_of(case, path))

    def _failure(self, steps: int) -> str:
        """What is reported of landmarks that no motion was found for: the two whose distance changes most."""
        before, after = self.alignment.apply(self.pairs.moving), self.pairs.fixed
        said = f"no motion of {steps} steps of {self.scheme} was found that carries the landmarks to their places"
        if len(before) < 2:
            return said
        i, j = np.triu_indices(len(before), 1)
        apart = np.linalg.norm(before[i] - before[j], axis=1)
        worst = int(np.argmax(np.linalg.norm((after - before)[i] - (after - before)[j], axis=1) / apart))
        one, other = (self.pairs.names[k[worst]] for k in (i, j))
        x, y = self.pairs.moving[i[worst]]
        return f"{said}; hardest are landmarks {one} and {other}, near ({x:.1f}, {y:.1f})"


_aligned = align  # a parameter of `Matching.of` has that name


def _extent(shape: Sequence[int]) -> tuple[int, int]:
    height, width = (int(length) for length in tuple(shape)[:2])
    if height < 1 or width < 1:
        raise LandmarkError(f"the image's shape is {tuple(shape)}", "give its height and width in pixels")
    return height, width
