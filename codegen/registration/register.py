"""Registration: from pairs of landmarks to a map that carries each where it belongs, and to the map's inverse."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from codegen.registration.alignment import Kind
from codegen.registration.choice import chosen_alignment
from codegen.registration.grid import Extent
from codegen.registration.losses import Loss
from codegen.registration.maps import TOLERANCE, Registration
from codegen.registration.noise import choose_sigma
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.smoothing import registered
from codegen.registration.solver import DEFAULT_SCHEME


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
    progress: Callable[[str], None] | None = None,
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

    The disc reaches beyond the images by a `margin`, by default that of `codegen.registration.frame.MARGINS`.

    Raises LandmarkError when the landmarks cannot be used, ArgumentError for an unknown alignment or loss, and
    RegistrationError when no solution is found, or none whose residuals are as small as sigma.
    """
    if align == "auto":
        align = chosen_alignment(pairs, shape, fixed_shape=fixed_shape, scheme=scheme, margin=margin).kind
    if sigma == "auto":
        sigma = choose_sigma(pairs, shape, fixed_shape=fixed_shape, align=align, scheme=scheme, margin=margin)
    return registered(
        pairs, shape, fixed_shape=fixed_shape, align=align, sigma=sigma, loss=loss, scheme=scheme, steps=steps,
        tolerance=tolerance, margin=margin, start=start, quick=quick, progress=progress,
    )  # fmt: skip
