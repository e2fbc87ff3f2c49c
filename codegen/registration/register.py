"""Registration: from pairs of landmarks to a map that carries each where it belongs, and to the map's inverse.

From a sigma to a map: how strongly roughness counts, so that landmarks are missed by about their standard error. A cost
of misfit and roughness has a free factor, the strength of the latter. It is found by the discrepancy principle (Morozov
1966): the map is as smooth as residuals of the stated size allow, less what the fit follows of the errors
(`codegen.registration.linear`). Residuals grow with the strength, so few solves suffice, each from the one before; the
linear theory says where to begin.

Leave-one-out: how well the map that all other landmarks give predicts each landmark, and what follows from that.

The error at a landmark that was left out is a target registration error, which the residual at a landmark that was
used is not. A landmark whose error stands out from the others' was probably placed wrongly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from codegen.errors import LandmarkError, RegistrationError
from codegen.registration.alignment import Kind
from codegen.registration.grid import Extent
from codegen.registration.linear import Freedom, Linear, chosen_alignment
from codegen.registration.maps import TOLERANCE, Registration, in_steps, refined, solved
from codegen.registration.matching import IN_ORDER, Matching, said_of_partners
from codegen.registration.noise import Loss, Outliers, choose_sigma, outliers_of, scale_of, weights_of
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.solver import DEFAULT_SCHEME

MOST_SOLVES = 20
"""The most solves that looking for a strength may take."""
CLOSE = 0.05
"""How far residuals may be from the size that they are to have, as a fraction, when the search ends."""
STALLED = 4
"""Solves after which a search ends that comes no nearer."""
EASIER = 16.0
"""The factor by which the strength is raised where there is no solution."""
ALIGNED = 1e4
"""The ridge, as a multiple of the largest eigenvalue of the covariance, with which the alignment alone is left."""

Said = Callable[[str], None]


def register(
    pairs: LandmarkPairs,
    shape: Extent,
    *,
    fixed_shape: Extent | None = None,
    align: Kind = "auto",
    sigma: float | Literal["auto"] = 0.0,
    loss: Loss = "linear",
    scheme: str = DEFAULT_SCHEME,
    steps: int | None = None,
    tolerance: float = TOLERANCE,
    margin: float | None = None,
    start: Registration | None = None,
    quick: bool = False,
    progress: Said | None = None,
) -> Registration:
    """Find the map that carries the moving landmarks to the fixed ones.

    `shape` is (height, width, ...) of the moving image, `fixed_shape` that of the fixed one where it differs. `sigma`
    is the standard deviation of the error of a landmark's coordinates, in pixels of the fixed image: the map is then
    the smoothest whose residuals are of that size, less what the fit follows of the errors by its degrees of freedom,
    that is 0.8 to 1 of sigma, to within 5 percent. The strength with which its roughness counts follows from that
    (`Registration.matching.strength`; the cost is in `Matching`). Zero means that landmarks are met exactly, "auto"
    takes the estimate of `estimate_sigma`. A robust `loss`, "huber", "cauchy" or "tukey", lets landmarks that miss by
    many sigmas pull less. "auto" for `align` takes the kind with the least leave-one-out error.

    Without `steps` as many are taken as leave an error of the map below `tolerance` pixels. The solver starts from an
    earlier registration, `start`, of as many landmarks, as when a landmark is dragged; it gives up soon where it is to
    be `quick`. With a sigma there are up to 20 solves, and `progress` is told a line after each.

    The disc reaches beyond the images by a `margin`, by default that of `codegen.registration.grid.MARGINS`.

    Raises LandmarkError when the landmarks cannot be used, ArgumentError for an unknown alignment or loss, and
    RegistrationError when no solution is found, or none whose residuals are as small as sigma.
    """
    if align == "auto":
        align = chosen_alignment(pairs, shape, fixed_shape=fixed_shape, scheme=scheme, margin=margin).kind
    if sigma == "auto":
        sigma = choose_sigma(pairs, shape, fixed_shape=fixed_shape, align=align, scheme=scheme, margin=margin)
    weights = weights_of(loss, np.zeros(len(pairs)))
    matching = Matching.of(
        pairs, shape, fixed_shape=fixed_shape, align=align, sigma=sigma, scheme=scheme, margin=margin, weights=weights
    )
    velocities = None if start is None or len(start.pairs) != len(pairs) else _guess(matching, start)
    if sigma == 0.0:
        return solved(matching, steps, tolerance, velocities, quick)
    if loss != "linear":
        misses = np.nan_to_num(outliers_of(matching).errors) / sigma
        matching = matching.weighted(weights_of(loss, misses, pairs.dimension))
    if start is not None and velocities is not None and start.sigma == sigma and loss == "linear":
        matching = replace(matching, strength=start.matching.strength)
        if quick and steps is not None:
            return in_steps(matching, steps, velocities, quick)
    else:
        matching = replace(matching, strength=_first_strength(matching))
    return _Search(matching, loss, steps, tolerance, progress or _silent).run(velocities)


def _silent(text: str) -> None:
    """Say nothing."""


def _first_strength(matching: Matching) -> float:
    """The strength that the linear theory gives, of the landmarks that are trusted."""
    freedom = Freedom.of(matching)
    ridge = freedom.ridge_for(freedom.target(matching.sigma))
    return min(ridge, ALIGNED * freedom.linear.largest) / replace(matching, strength=1.0).ridge


def _guess(matching: Matching, known: Registration) -> NDArray[np.float64]:
    """Velocities at the start from those of nearly the same landmarks: what differs is taken for a straight way."""
    (start, target), (known_start, known_target) = matching.all_ends, known.matching.all_ends
    return np.asarray(known.velocities + (target - start) - (known_target - known_start))


@dataclass
class _Search:
    """The search for a strength, and for weights where the loss is robust; it counts its solves."""

    matching: Matching
    loss: Loss
    steps: int | None
    tolerance: float
    say: Said
    solves: int = 0

    def run(self, velocities: NDArray[np.float64] | None) -> Registration:
        """The registration with residuals as large as errors of sigma leave them; RegistrationError without any."""
        found = self._first(velocities)
        target = Freedom.of(self.matching).target(self.matching.sigma)
        low, high = -np.inf, np.inf  # logarithms of strengths whose residuals are too small, and too large
        known: list[tuple[float, float]] = []
        while self.solves < MOST_SOLVES:
            scale = scale_of(self.loss, found.residuals, found.dimension)
            here, excess = float(np.log(found.matching.strength)), float(np.log(scale / target))
            sigma, unit = self.matching.sigma, self.matching.unit
            self.say(f"solve {self.solves}: residuals of {scale:.3g} {unit} for a sigma of {sigma:g}")
            # Whether residuals are of the right size, or smaller although the alignment does nearly all.
            aligned = found.matching.ridge >= 0.99 * ALIGNED * Linear.of(found.matching).largest
            settled = self.loss == "linear" or self.solves > 3
            if (abs(excess) <= CLOSE and settled) or (aligned and excess < 0.0):
                break
            low, high = (here, high) if excess < 0.0 else (low, here)
            known.append((here, excess))
            if _stalls(known):
                break
            following = self._next(found, known, low, high)
            if following is None:
                break
            found = following
        return self._finished(found)

    def _first(self, velocities: NDArray[np.float64] | None) -> Registration:
        """A solution with the first strength, or with a larger one where that has none."""
        while True:
            self.solves += 1
            try:
                return solved(self.matching, self.steps, 10.0 * self.tolerance, velocities)
            except RegistrationError:
                if self.solves >= 5:
                    raise
                self.matching = replace(self.matching, strength=EASIER * self.matching.strength)

    def _next(
        self, found: Registration, known: list[tuple[float, float]], low: float, high: float
    ) -> Registration | None:
        """The solution of a strength that is likely to be nearer; None where there is none, nor one on the way."""
        wanted = _better(known, low, high)
        matching = found.matching
        if self.loss != "linear":
            matching = matching.weighted(weights_of(self.loss, found.residuals / matching.sigma, found.dimension))
        largest = ALIGNED * Linear.of(matching).largest / replace(matching, strength=1.0).ridge
        here = known[-1][0]
        for _ in range(3):
            self.solves += 1
            changed = replace(matching, strength=float(min(np.exp(wanted), largest)))
            try:
                return in_steps(changed, found.steps, _continued(found, changed), quick=True)
            except RegistrationError:
                wanted = 0.5 * (wanted + here)
        return None

    def _finished(self, found: Registration) -> Registration:
        """The same with as many steps as were asked for, or as its error demands."""
        scale = scale_of(self.loss, found.residuals, found.dimension)
        if scale > 1.25 * self.matching.sigma:
            finding = f"residuals are {scale:.3g} {self.matching.unit} where sigma is {self.matching.sigma:g}"
            if out_of_order := said_of_partners(self.matching.pairs):
                raise RegistrationError(f"{finding}, and no map comes nearer; {out_of_order}", IN_ORDER)
            remedy = "give a larger sigma, or look for landmarks out of place"
            raise RegistrationError(f"{finding}, and no map was found that comes nearer", remedy)
        if self.steps is None and not (found.error <= self.tolerance * self.matching.pixel):
            found = refined(found.matching, self.tolerance, found.velocities, found.steps)
        return replace(found, solves=self.solves)


def _stalls(known: list[tuple[float, float]]) -> bool:
    """Whether residuals that are too large have not become smaller for some solves, though the strength has."""
    recent = [excess for _, excess in known[-STALLED:]]
    return len(recent) == STALLED and min(recent) > CLOSE and min(recent[1:]) > recent[0] - CLOSE


def _better(known: list[tuple[float, float]], low: float, high: float) -> float:
    """The logarithm of a strength, by a secant, within what is known; residuals grow about as its square root."""
    here, excess = known[-1]
    slope = 0.5
    if len(known) > 1 and known[-2][0] != here:
        slope = float(np.clip((excess - known[-2][1]) / (here - known[-2][0]), 0.1, 2.0))
    wanted = here - float(np.clip(excess / slope, -4.0, 4.0))
    if not low < wanted < high:
        wanted = 0.5 * (low + high)
    return wanted


def _continued(found: Registration, changed: Matching) -> NDArray[np.float64]:
    """Velocities of the pairs for another strength or other weights, as the linear theory has them."""
    if changed.frame != found.frame:
        return _guess(changed, found)
    return Linear.of(changed).continued(found.velocities, found.matching.ridge, changed.ridge)


ENOUGH = 0.1
"""Error of a map, in pixels, below which its steps are many enough to predict landmarks with."""
MOST_LEFT_OUT = 100
"""Of more landmarks, none is left out in turn: it would take as many registrations."""
OUTLIER = 3.5
"""Modified z-score of outliers: Iglewicz and Hoaglin (1993), How to detect and handle outliers."""


@dataclass(frozen=True, eq=False)
class LeaveOneOut:
    """Where landmarks that were left out arrive, from the fixed ones, in pixels of the fixed image, shape (n, d).

    They are NaN where the others determine no map, as that of an only landmark. `ranking` are the numbers of the
    landmarks, counted from zero, from the largest error to the least; `outliers` those whose error stands out.
    """

    misses: NDArray[np.float64]
    ranking: tuple[int, ...]
    outliers: tuple[int, ...]

    @cached_property
    def errors(self) -> NDArray[np.float64]:
        """Errors of landmarks that were left out, in pixels of the fixed image, shape (n,)."""
        return np.asarray(np.linalg.norm(self.misses, axis=1))


def leave_one_out(
    pairs: LandmarkPairs,
    shape: Extent,
    *,
    steps: int | None = None,
    tolerance: float = ENOUGH,
    start: Registration | None = None,
    **options: Any,
) -> LeaveOneOut:
    """Register once with all landmarks and once without each; arguments are those of `register`.

    Without `steps`, as many are taken as leave an error of the map below `tolerance` pixels, here a larger one than
    `register` has, because errors of prediction are of the order of pixels.
    """
    count = len(pairs)
    misses = np.full((count, pairs.dimension), np.nan)
    if count > 1:
        full = register(pairs, shape, steps=steps, tolerance=tolerance, start=start, **options)
        velocities = full.velocities
    for k in range(count if count > 1 else 0):
        try:
            kept = full.matching.without(k)
            found = in_steps(kept, full.steps, np.delete(velocities, k, axis=0), quick=True)
        except (LandmarkError, RegistrationError):
            continue
        misses[k] = found.map_points(pairs.moving[k : k + 1])[0] - pairs.fixed[k]
    errors = np.linalg.norm(misses, axis=1)
    ranking = np.argsort(-np.nan_to_num(errors, nan=-1.0), kind="stable")
    return LeaveOneOut(misses, tuple(map(int, ranking)), _outliers(errors, ranking))


def _outliers(errors: NDArray[np.float64], ranking: NDArray[np.intp]) -> tuple[int, ...]:
    """The numbers of errors far above the median, in units of the median deviation from it."""
    known = errors[np.isfinite(errors)]
    if known.size < 3:
        return ()
    median = np.median(known)
    deviation = np.median(np.abs(known - median))
    return tuple(int(k) for k in ranking if 0.6745 * (errors[k] - median) > OUTLIER * deviation)


def out_of_place(outliers: Outliers | None, left_out: LeaveOneOut | None) -> tuple[int, ...]:
    """The numbers of the landmarks that are named as outliers; of few landmarks, by leaving each out."""
    if outliers is not None and not np.isnan(outliers.errors).all():
        return outliers.numbers
    return left_out.outliers if left_out is not None else ()
