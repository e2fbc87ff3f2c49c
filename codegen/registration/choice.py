"""Which alignment comes before the flow: the one after which landmarks that are left out are predicted best.

An affine map takes more out of the flow than a similarity, which is less for the flow to do, but it has more to be
fitted, and follows the errors of few landmarks. Leaving out each landmark in turn decides, by the linear theory, in
which the prediction of one by all others needs no solve.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import LandmarkError
from codegen.registration.alignment import Kind, align, require_unmirrored
from codegen.registration.grid import Extent, grid_of
from codegen.registration.linear import Linear
from codegen.registration.matching import Matching
from codegen.registration.pairs import LandmarkPairs

CANDIDATES: tuple[Kind, ...] = ("similarity", "affine", "none")
"""Of equal errors, the first of these."""
FEWEST = 4
"""Of fewer landmarks, those that are left do not determine every candidate."""
MOST = 500
"""Of more landmarks, so many that are drawn evenly decide; time grows with the cube of their number."""
CLEARLY = 0.98
"""Another than the first has to have so much less of its error."""


@dataclass(frozen=True)
class AlignmentChoice:
    """The kind that was chosen, and the mean leave-one-out error with each kind that could be tried, in pixels."""

    kind: Kind
    errors: dict[str, float]
    unit: str = "pixels"

    @property
    def text(self) -> str:
        """What was compared, in words."""
        compared = ", ".join(f"{kind} {error:.3g}" for kind, error in self.errors.items())
        return (
            f"{self.kind} by leave-one-out ({self.unit}: {compared})"
            if compared
            else f"{self.kind}: too few to compare"
        )


def chosen_alignment(pairs: LandmarkPairs, shape: Extent, **options: Any) -> AlignmentChoice:
    """Compare alignments; arguments are those of `Matching.of`. LandmarkError where the landmarks mirror the image."""
    require_unmirrored(pairs)
    if len(pairs) < FEWEST:
        return AlignmentChoice(CANDIDATES[0], {})
    if len(pairs) > MOST:
        kept = np.zeros(len(pairs), dtype=bool)
        # Drawn, because every so-many-th landmark of a grid may be those of a few columns; always the same.
        kept[np.random.default_rng(0).choice(len(pairs), MOST, replace=False)] = True
        pairs = pairs.chosen(kept)
    errors: dict[str, float] = {}
    for kind in CANDIDATES:
        try:
            matching = Matching.of(pairs, shape, align=kind, **options)
            found = float(np.mean(left_out_errors(matching, kind)))
        except LandmarkError:  # a landmark is left out whose absence makes the others turn the image over
            continue
        if matching.alignment.kind == kind:
            errors[kind] = found
    if not errors:  # which says why as soon as it is used
        return AlignmentChoice(CANDIDATES[0], {})
    best = min(errors, key=lambda kind: errors[kind] if kind == CANDIDATES[0] else errors[kind] / CLEARLY)
    return AlignmentChoice(next(kind for kind in CANDIDATES if kind == best), errors, grid_of(shape).unit)


def left_out_errors(matching: Matching, kind: Kind) -> NDArray[np.float64]:
    """What the linear theory leaves of each landmark in pixels, predicted by the others and their alignment, (n,)."""
    pairs, linear = matching.pairs, Linear.of(matching)
    precision = linear.precision(linear.by_cross_validation())
    errors = np.empty(len(pairs))
    for k in range(len(pairs)):
        displacements = align(pairs.without(k), kind).apply(pairs.moving) - pairs.fixed
        errors[k] = np.linalg.norm(precision[k] @ displacements) / precision[k, k]
    return errors
