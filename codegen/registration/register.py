"""Registration: from pairs of landmarks to a map that carries each where it belongs, and to the map's inverse."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from codegen.registration.alignment import Kind
from codegen.registration.frame import MARGIN
from codegen.registration.leave_one_out import choose_sigma
from codegen.registration.maps import TOLERANCE, Registration, registered
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.solver import DEFAULT_SCHEME


def register(
    pairs: LandmarkPairs,
    shape: Sequence[int],
    *,
    fixed_shape: Sequence[int] | None = None,
    align: Kind = "similarity",
    sigma: float | Literal["auto"] = 0.0,
    scheme: str = DEFAULT_SCHEME,
    steps: int | None = None,
    tolerance: float = TOLERANCE,
    margin: float = MARGIN,
    start: Registration | None = None,
    quick: bool = False,
) -> Registration:
    """Find the map that carries the moving landmarks to the fixed ones.

    `shape` is (height, width, ...) of the moving image, `fixed_shape` that of the fixed one where it differs. With a
    `sigma`, in pixels, landmarks may miss for the sake of a smoother map: what the inverse map makes of a fixed one
    lies beside the moving one by sigma^2/radius times its momentum there, in pixels of the fixed image. Zero means that
    they are met exactly, "auto" takes the sigma with the least leave-one-out error. Without `steps` as many are taken
    as leave an error of the map below `tolerance` pixels. The solver starts from an earlier registration, `start`, of
    as many landmarks, as when a landmark is dragged; it gives up soon where it is to be `quick`.

    Raises LandmarkError when the landmarks cannot be used, RegistrationError when no solution is found.
    """
    if sigma == "auto":
        sigma = choose_sigma(
            pairs, shape, fixed_shape=fixed_shape, align=align, scheme=scheme, steps=steps, margin=margin
        )
    return registered(
        pairs, shape, fixed_shape=fixed_shape, align=align, sigma=sigma, scheme=scheme, steps=steps,
        tolerance=tolerance, margin=margin, start=start, quick=quick,
    )  # fmt: skip
