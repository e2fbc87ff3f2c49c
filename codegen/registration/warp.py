"""Warped images: every pixel of the result is looked up where the inverse map says that it comes from."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from codegen.errors import ArgumentError, ImageError
from codegen.registration.coarse import BOUND, Positions, Spacing, map_grid
from codegen.registration.maps import Registration
from codegen.registration.pairs import PointArray

Interpolation: TypeAlias = Literal["nearest", "linear", "cubic"]
ORDERS: dict[str, int] = {"nearest": 0, "linear": 1, "cubic": 3}

BAND_ROWS = 64
"""Rows of the result that one thread looks up at a time."""
SPLINE_PADDING = 12
"""Pixels by which an image is continued before a spline is fitted, as scipy.ndimage does it for this kind of edge."""


@dataclass(frozen=True)
class WarpReport:
    """How positions were found: at every pixel, or from every `spacing`-th and a share of the others, `exact`.

    `bound` is the largest error, in pixels, of a position that was interpolated; see `codegen.registration.coarse`.
    `outside` counts the pixels of the result that come from outside the image.
    """

    spacing: int
    exact: float
    bound: float
    outside: int


def warp(
    pixels: Any,
    registration: Registration,
    *,
    interpolation: Interpolation = "linear",
    inverse: bool = False,
    shape: Sequence[int] | None = None,
    spacing: Spacing = None,
    bound: float = BOUND,
    fill: float = 0.0,
    time: float = 1.0,
    positions: Positions | None = None,
) -> NDArray[Any]:
    """The moving image in the frame of the fixed one, or with `inverse` the fixed image in that of the moving one.

    `pixels` has shape (height, width) or (height, width, channels); what is returned has the dtype of `pixels` and
    the size `shape`, by default that of the other image. Pixels that come from outside the image are `fill`. With a
    `spacing`, a number of pixels or "auto", positions are interpolated from a coarse grid where that errs by less than
    `bound` pixels. `time` is that of `Registration.positions`. Where pixels come from is not computed again if it is
    given as `positions`, as by `certify_with_positions`; then `inverse`, `shape`, `spacing` and `time` have no effect.

    Raises ImageError for an array that is no image, ArgumentError for an unknown interpolation or spacing.
    """
    return warp_reported(
        pixels, registration, interpolation=interpolation, inverse=inverse, shape=shape, spacing=spacing, bound=bound,
        fill=fill, time=time, positions=positions,
    )[0]  # fmt: skip


def warp_reported(
    pixels: Any,
    registration: Registration,
    *,
    interpolation: Interpolation = "linear",
    inverse: bool = False,
    shape: Sequence[int] | None = None,
    spacing: Spacing = None,
    bound: float = BOUND,
    fill: float = 0.0,
    time: float = 1.0,
    positions: Positions | None = None,
) -> tuple[NDArray[Any], WarpReport]:
    """The same as `warp`, and a report."""
    image = np.asarray(pixels)
    _require_image(image, interpolation)
    default = registration.shape if inverse else registration.fixed_shape
    found = positions or sources(registration, default if shape is None else shape, inverse, spacing, bound, time)
    warped, outside = sample(image, found.places, ORDERS[interpolation], fill)
    return warped, WarpReport(found.spacing, found.exact, found.bound, outside)


def sources(
    registration: Registration,
    shape: Sequence[int],
    inverse: bool = False,
    spacing: Spacing = None,
    bound: float = BOUND,
    time: float = 1.0,
) -> Positions:
    """Where each pixel of a warped image comes from: of the fixed frame by the inverse map, or the other way about."""
    pairs = registration.pairs
    singular = pairs.moving if inverse else registration.positions(time, pairs.moving)

    def function(xy: PointArray) -> PointArray:
        return registration.positions(time, xy, inverse=not inverse)

    return map_grid(function, shape, singular, spacing, bound)


def sample(image: NDArray[Any], sources: NDArray[np.float64], order: int, fill: float) -> tuple[NDArray[Any], int]:
    """The image at positions (x, y), shape (h, w, 2), by splines of the given order; and how many lie outside.

    A pixel reaches half a pixel about its centre; what lies beyond the outermost centres, but within their pixels, has
    the value at the edge.
    """
    layers = [spline_of(image[(..., *channel)], order) for channel in np.ndindex(image.shape[2:])]
    warped = np.empty((*sources.shape[:2], *image.shape[2:]), image.dtype)

    def band(rows: slice) -> int:
        return sample_band(layers, sources[rows], image.shape, order, fill, warped[rows])

    # Interpolation holds no lock, and a band's places stay in the processor's cache.
    bands = [slice(k, k + BAND_ROWS) for k in range(0, len(warped), BAND_ROWS)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return warped, sum(pool.map(band, bands))


def spline_of(layer: NDArray[Any], order: int) -> NDArray[Any]:
    """What is interpolated: the values, or the coefficients of the cubic spline through them, beyond the edges, too."""
    if order < 2:
        return layer
    wide = np.pad(layer.astype(np.float64), SPLINE_PADDING, mode="edge")
    return np.asarray(scipy.ndimage.spline_filter(wide, order, mode="nearest"))


def sample_band(
    layers: Sequence[NDArray[Any]], sources: NDArray[np.float64], shape: Sequence[int], order: int, fill: float,
    warped: NDArray[Any],
) -> int:  # fmt: skip
    """Fill some rows of the result, or of a slice, from places (x, y, ...); how many pixels come from outside."""
    axes = sources.shape[-1]
    places = np.moveaxis(sources[..., ::-1], -1, 0).copy()
    outside = np.zeros(sources.shape[:-1], np.bool_)
    for place, length in zip(places, shape[:axes], strict=True):
        outside |= ~((place >= -0.5) & (place <= length - 0.5))
        np.clip(place, 0.0, length - 1.0, out=place)
    places += SPLINE_PADDING if order > 1 else 0
    for channel, layer in zip(np.ndindex(tuple(shape[axes:])), layers, strict=True):
        values = scipy.ndimage.map_coordinates(
            layer, places, order=order, mode="nearest", prefilter=False,
            output=warped.dtype if order == 0 else np.float64,
        )  # fmt: skip
        warped[(..., *channel)] = as_type(values, warped.dtype)
    if outside.any():
        warped[outside] = as_type(np.float64(fill), warped.dtype)
    return int(outside.sum())


def as_type(values: Any, dtype: np.dtype[Any]) -> Any:
    """Values of another type: rounded to the nearest integer and clipped to what the type holds."""
    if values.dtype == dtype or not np.issubdtype(dtype, np.integer):
        return values.astype(dtype, copy=False)
    limits = np.iinfo(dtype)
    return np.clip(np.rint(values), limits.min, limits.max).astype(dtype)


def _require_image(image: NDArray[Any], interpolation: str) -> None:
    if interpolation not in ORDERS:
        raise ArgumentError(f"interpolation is {interpolation!r}", f"use {', '.join(ORDERS)}")
    if image.ndim not in (2, 3) or image.size == 0:
        raise ImageError(f"the image has shape {image.shape}", "give (height, width) or (height, width, channels)")
    if image.dtype.kind not in "uif":
        raise ImageError(f"the image's values are of type {image.dtype}", "give integers or floating-point numbers")
