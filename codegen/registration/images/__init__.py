"""Images: PNG, JPEG and TIFF with 8-bit, 16-bit or float samples, grey or in colour, with or without opacity.

The kind of a file is what its first bytes say, whatever its name; its size in bytes and pixels is checked before
anything is decoded. Samples stay as they are stored; palettes become colours, and orientations that EXIF prescribes are
applied, so that the first row is the upper one. Images are decoded by Pillow and tifffile, and by SimpleITK where a PNG
file has several channels of 16 bits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ImageError
from codegen.files import replacing
from codegen.registration.images import codecs
from codegen.registration.images.codecs import KINDS, Header, header_of, readable
from codegen.registration.images.spacing import Spacing, spacing_of

Pixels: TypeAlias = NDArray[Any]
"""An image of shape (h, w), or (h, w, c) with c = 2 (grey, opacity), 3 (RGB) or 4 (RGB, opacity)."""

CHANNELS = {1: "grey", 2: "grey with opacity", 3: "RGB", 4: "RGB with opacity"}


@dataclass(frozen=True)
class Limits:
    """The largest file, in bytes, and the largest image, in pixels, that are read."""

    bytes: int = 1 << 30
    pixels: int = 1 << 26


@dataclass(frozen=True, eq=False)
class Image:
    """Pixels as they are stored, and the kind of file ("PNG", "JPEG" or "TIFF").

    Where a file has them, its colour profile (ICC) and the size of a pixel.
    """

    pixels: Pixels
    kind: str
    profile: bytes | None = None
    spacing: Spacing | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """(h, w) or (h, w, c)."""
        return self.pixels.shape

    @property
    def channels(self) -> str:
        """What the samples of a pixel are, in words."""
        return CHANNELS[self.pixels.shape[2] if self.pixels.ndim == 3 else 1]


def read_image(source: Path | str | bytes, limits: Limits | None = None, name: str = "") -> Image:
    """Read an image from a path, or from the bytes of a file, which errors then call `name`.

    Raises ImageError for what is no PNG, JPEG or TIFF file or is damaged, for more bytes or pixels than `limits` allow,
    and for samples of another kind than 8, 16 or 32-bit integers and 32 or 64-bit floats.
    """
    limits = limits or Limits()
    data, name = _contents(source, limits, name)
    if len(data) > limits.bytes:
        raise ImageError(f"{name} has more than {limits.bytes} bytes", "give a smaller file")
    with readable(name):
        header = header_of(name, data)
    if header.width < 1 or header.height < 1:
        raise ImageError(f"{name} has {header.width} x {header.height} pixels", "give an image")
    if header.width * header.height > limits.pixels:
        finding = f"{name} has {header.width} x {header.height} pixels, more than {limits.pixels}"
        raise ImageError(finding, "give a smaller image")
    with readable(name):
        pixels, profile, orientation = _DECODERS[header.kind](name, data, header)
    if pixels.shape[:2] != (header.height, header.width):
        raise ImageError(f"{name} announces {header.width} x {header.height} pixels and holds others", "save it anew")
    turned = _ORIENTATIONS.get(orientation, _ORIENTATIONS[1])(pixels)
    spacing = spacing_of(header.kind, data)
    if spacing is not None and orientation in _SIDEWAYS:
        spacing = Spacing(spacing.y, spacing.x, spacing.unit)
    return Image(np.ascontiguousarray(turned), header.kind, profile, spacing)


def _contents(source: Path | str | bytes, limits: Limits, name: str) -> tuple[bytes, str]:
    """The bytes, one more than are allowed at the most, and what to call them."""
    if isinstance(source, bytes):
        return source, name or "the image"
    try:
        with Path(source).open("rb") as file:
            return file.read(limits.bytes + 1), name or str(source)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ImageError(f"{source} cannot be read ({reason})", "give an image file") from error


_DECODERS: dict[str, Callable[[str, bytes, Header], tuple[Pixels, bytes | None, int]]] = {
    "PNG": codecs.decode,
    "JPEG": codecs.decode,
    "TIFF": codecs.decode_tiff,
}

# EXIF 2.32, tag 0x0112: where the first row and the first column of the stored array are to be seen.
_ORIENTATIONS: dict[int, Callable[[Pixels], Pixels]] = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: a[::-1].swapaxes(0, 1),
    7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
    8: lambda a: a[:, ::-1].swapaxes(0, 1),
}
_SIDEWAYS = (5, 6, 7, 8)


def write_image(path: Path, pixels: Pixels, profile: bytes | None = None) -> None:
    """Write an image as its suffix says, replacing the file as a whole or leaving it as it was.

    PNG takes 8-bit and 16-bit samples, JPEG 8-bit grey and RGB (quality 95, which loses a little), TIFF all kinds.
    Raises ImageError where file and samples do not fit, and FileError where the file system refuses.
    """
    path = Path(path)
    require_fitting(path, pixels)
    kind = require_kind(path)
    encode = codecs.encode_tiff if kind == "TIFF" else codecs.encode
    with replacing(path) as temporary:
        encode(path, temporary, kind, pixels, profile)


def require_fitting(path: Path, pixels: Pixels) -> None:
    """Refuse samples and channels that the kind of file has no place for; ImageError names the file."""
    kind = require_kind(path)
    if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] not in (2, 3, 4)) or not pixels.size:
        raise ImageError(f"{path}: an array of shape {pixels.shape} is no image", "give (h, w) or (h, w, 2 to 4)")
    check = codecs.require_fitting_tiff if kind == "TIFF" else codecs.require_fitting
    check(path, kind, pixels.dtype, pixels.shape[2] if pixels.ndim == 3 else 1)


def require_kind(path: Path) -> str:
    """The kind of image that the suffix of a file to be written means; ImageError when it means none."""
    for kind, suffixes in KINDS.items():
        if path.suffix.lower() in suffixes:
            return kind
    known = ", ".join(suffix for suffixes in KINDS.values() for suffix in suffixes)
    raise ImageError(f"{path}: unknown kind of image", f"let its name end in one of {known}")
