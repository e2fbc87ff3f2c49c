"""An image as a session holds it: its pixels as they were read, and a small copy in 8 bits for the screen."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from codegen.registration.app.state import Place

PREVIEW = 512
"""Longest side, in pixels, of what is shown."""
NAME_LENGTH = 60


@dataclass(frozen=True, eq=False)
class Picture:
    """Pixels of shape (h, w) or (h, w, channels), a name to show, and the bytes that they were read from.

    `kind` is the kind of that file, PNG, JPEG or TIFF, and `profile` its colour profile.
    """

    pixels: NDArray[Any]
    name: str = "image"
    source: bytes = field(default=b"", repr=False)
    kind: str = "PNG"
    profile: bytes | None = field(default=None, repr=False)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.pixels.shape[0], self.pixels.shape[1]

    @property
    def stem(self) -> str:
        """A name for files that are made from it: letters and digits only, whatever the visitor's file was called."""
        kept = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in PurePath(self.name).stem)
        return kept[:NAME_LENGTH] or "image"

    def contains(self, place: Place) -> bool:
        """Whether a point lies within the pixels."""
        height, width = self.shape
        return -0.5 <= place[0] <= width - 0.5 and -0.5 <= place[1] <= height - 0.5

    @cached_property
    def digest(self) -> str:
        """A hash of the content."""
        return hashlib.sha256(self.source or self.pixels.tobytes()).hexdigest()

    @cached_property
    def reduction(self) -> int:
        """Preview pixels are averages of so many pixels by so many."""
        return max(1, -(-max(self.shape) // PREVIEW))

    @cached_property
    def preview(self) -> NDArray[np.uint8]:
        """The small copy, 8 bits, (h, w) or (h, w, 3 or 4).

        Values of 8 bits stay as they are; others are stretched between the smallest and the largest.
        """
        pixels = _eight_bits(self.pixels)
        if pixels.ndim == 3 and pixels.shape[2] not in (3, 4):  # grey with opacity, or more bands than a screen shows
            pixels = pixels[..., 0] if pixels.shape[2] < 3 else pixels[..., :3]
        if self.reduction == 1:
            return np.ascontiguousarray(pixels)
        return np.asarray(Image.fromarray(np.ascontiguousarray(pixels)).reduce(self.reduction))

    @cached_property
    def screen(self) -> NDArray[np.uint8]:
        """The small copy as RGBA, (h, w, 4)."""
        return rgba(self.preview)

    def preview_places(self, step: float = 1.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """X and y, in pixels of the image, of every `step`-th pixel of the preview; the last lies at its far edge."""
        height, width = self.preview.shape[:2]
        return _centres(width, step, self.reduction), _centres(height, step, self.reduction)

    def preview_blocks(self, size: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """X and y, in pixels of the image, of the centres of blocks of `size` by `size` pixels of the preview."""
        height, width = self.preview.shape[:2]
        return tuple(
            (np.minimum(np.arange(-(-count // size)) * size + size / 2, count - 0.5)) * self.reduction - 0.5
            for count in (width, height)
        )


def rgba(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An image of 8 bits with four channels."""
    if image.ndim == 3 and image.shape[2] == 4:
        return image
    result = np.full((*image.shape[:2], 4), 255, np.uint8)
    result[..., :3] = image if image.ndim == 3 else image[..., None]
    return result


def _centres(count: int, step: float, reduction: int) -> NDArray[np.float64]:
    places = np.linspace(0.0, count - 1.0, max(2, round((count - 1) / step) + 1)) if count > 1 else np.zeros(1)
    return (places + 0.5) * reduction - 0.5


def _eight_bits(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    if pixels.dtype == np.uint8:
        return pixels
    values = np.nan_to_num(pixels.astype(np.float64), posinf=0.0, neginf=0.0)
    low, high = float(values.min()), float(values.max())
    scale = 255.0 / (high - low) if high > low else 0.0
    return np.rint((values - low) * scale).astype(np.uint8)
