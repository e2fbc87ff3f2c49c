"""Warped images: every pixel of the result is looked up where the inverse map says that it comes from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from codegen.errors import ArgumentError, ImageError
from codegen.registration.frame import pixel_grid
from codegen.registration.register import Registration

Interpolation: TypeAlias = Literal["nearest", "linear", "cubic"]
ORDERS: dict[str, int] = {"nearest": 0, "linear": 1, "cubic": 3}


@dataclass(frozen=True)
class WarpReport:
    """How positions were found: exactly at every pixel, or on every `spacing`-th with an error of at most `bound`."""

    spacing: int
    bound: float
    outside: int


def warp(
    pixels: Any,
    registration: Registration,
    *,
    interpolation: Interpolation = "linear",
    inverse: bool = False,
    shape: Sequence[int] | None = None,
    spacing: int | Literal["auto"] | None = None,
    fill: float = 0.0,
    time: float = 1.0,
) -> NDArray[Any]:
    """The moving image in the frame of the fixed one, or with `inverse` the fixed image in that of the moving one.

    `pixels` has shape (height, width) or (height, width, channels); what is returned has the dtype of `pixels` and
    the size `shape`, by default that of the other image. Pixels that come from outside the image are `fill`.
    """
    return warp_reported(
        pixels, registration, interpolation=interpolation, inverse=inverse, shape=shape, spacing=spacing, fill=fill,
        time=time,
    )[0]  # fmt: skip


def warp_reported(
    pixels: Any,
    registration: Registration,
    *,
    interpolation: Interpolation = "linear",
    inverse: bool = False,
    shape: Sequence[int] | None = None,
    spacing: int | Literal["auto"] | None = None,
    fill: float = 0.0,
    time: float = 1.0,
) -> tuple[NDArray[Any], WarpReport]:
    """The same as `warp`, and a report."""
    image = np.asarray(pixels)
    _require_image(image, interpolation)
    default = registration.shape if inverse else registration.fixed_shape
    height, width = (int(length) for length in tuple(default if shape is None else shape)[:2])
    sources = registration.positions(time, pixel_grid((height, width)), inverse=not inverse)
    warped, outside = sample(image, sources.reshape(height, width, 2), ORDERS[interpolation], fill)
    return warped, WarpReport(1, 0.0, outside)


def sample(image: NDArray[Any], sources: NDArray[np.float64], order: int, fill: float) -> tuple[NDArray[Any], int]:
    """The image at positions (x, y), shape (h, w, 2), by splines of the given order; and how many lie outside.

    A pixel reaches half a pixel about its centre; what lies beyond the outermost centres, but within their pixels, has
    the value at the edge.
    """
    height, width = image.shape[:2]
    x, y = sources[..., 0], sources[..., 1]
    inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
    places = np.stack([np.clip(y, 0.0, height - 1.0), np.clip(x, 0.0, width - 1.0)])
    warped = np.empty((*inside.shape, *image.shape[2:]), image.dtype)
    for channel in np.ndindex(image.shape[2:]):
        layer = (slice(None), slice(None), *channel)
        values = scipy.ndimage.map_coordinates(
            image[layer], places, order=order, mode="nearest", output=image.dtype if order == 0 else np.float64
        )
        warped[layer] = np.where(inside, as_type(values, image.dtype), as_type(np.float64(fill), image.dtype))
    return warped, int(inside.size - inside.sum())


def as_type(values: Any, dtype: np.dtype[Any]) -> Any:
    """Values of another type: rounded to the nearest integer and clipped to what the type holds."""
    if values.dtype == dtype or not np.issubdtype(dtype, np.integer):
        return values.astype(dtype)
    limits = np.iinfo(dtype)
    return np.clip(np.rint(values), limits.min, limits.max).astype(dtype)


def _require_image(image: NDArray[Any], interpolation: str) -> None:
    if interpolation not in ORDERS:
        raise ArgumentError(f"interpolation is {interpolation!r}", f"use {', '.join(ORDERS)}")
    if image.ndim not in (2, 3) or image.size == 0:
        raise ImageError(f"the image has shape {image.shape}", "give (height, width) or (height, width, channels)")
    if image.dtype.kind not in "uif":
        raise ImageError(f"the image's values are of type {image.dtype}", "give integers or floating-point numbers")
