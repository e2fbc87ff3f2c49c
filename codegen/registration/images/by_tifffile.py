"""TIFF files of one page, by tifffile; by Pillow where they are compressed otherwise than with Deflate."""

from __future__ import annotations

import io
import logging
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ExtraError, ImageError
from codegen.registration.images.kinds import Header

SAMPLES = frozenset(np.dtype(name) for name in ("u1", "u2", "i2", "u4", "i4", "f4", "f8"))
DEFLATE = (8, 32946)


def _tifffile() -> Any:
    """The library, which says on stderr what is wrong with a file unless it is told not to."""
    try:
        import tifffile
    except ImportError as error:
        finding = "TIFF files take tifffile, which is not installed"
        raise ExtraError(finding, "pip install variational-codegen[images]") from error
    tifffile.logger().setLevel(logging.CRITICAL)
    return tifffile


def header(name: str, data: bytes) -> Header:
    """Size and samples of the first page; ImageError for what this package does not read, by its name."""
    with _tifffile().TiffFile(io.BytesIO(data)) as file:
        page: Any = file.pages[0]
        _require_one_page(name, file)
        if page.photometric.name not in ("MINISBLACK", "RGB", "PALETTE", "YCBCR"):
            raise ImageError(f"{name} stores colours as {page.photometric.name}", "save it as grey or RGB")
        if page.imagedepth != 1 or page.samplesperpixel > 4:
            finding = f"{name} has {page.samplesperpixel} samples in a pixel and {page.imagedepth} layers"
            raise ImageError(finding, "save one image with 1 to 4 channels")
        if page.bitspersample != 1 and (page.dtype is None or np.dtype(page.dtype) not in SAMPLES):
            kind = page.dtype or f"{page.bitspersample} bits"
            raise ImageError(f"{name} holds samples of {kind}", "save it with 8 or 16-bit integers or 32-bit floats")
        return Header("TIFF", page.imagewidth, page.imagelength, page.bitspersample, page.samplesperpixel)


def _require_one_page(name: str, file: Any) -> None:
    """Refuse stacks; reduced copies of the first page are no other image."""
    for number in range(1, 20):
        try:
            page = file.pages[number]
        except IndexError:
            return
        if not page.is_reduced:
            raise ImageError(
                f"{name} holds several images", "save one as a file of its own; codegen warp registers stacks"
            )


def decode(name: str, data: bytes, header: Header) -> tuple[NDArray[Any], bytes | None, int]:
    """Pixels, colour profile and orientation."""
    with _tifffile().TiffFile(io.BytesIO(data)) as file:
        page: Any = file.pages[0]
        plain = page.photometric.name in ("MINISBLACK", "RGB") and page.bitspersample != 1
        if plain and page.compression in (1, *DEFLATE):
            _require_segments(name, data, page)
            pixels = np.asarray(page.asarray())
            if page.planarconfig == 2 and pixels.ndim == 3:
                pixels = np.moveaxis(pixels, 0, -1)
        else:
            pixels = _by_pillow(name, data, page)
        return _native(pixels), page.iccprofile, int(page.tags.valueof(274, 1) or 1)


def _require_segments(name: str, data: bytes, page: Any) -> None:
    """Refuse strips or tiles that lie outside the file, or that unfold to more than the image needs."""
    segments = list(zip(page.dataoffsets, page.databytecounts, strict=True))
    if any(start + length > len(data) for start, length in segments):
        raise ImageError(f"{name} is cut off", "give a whole TIFF file")
    if page.compression not in DEFLATE:
        return
    width, height = (max(side, 1024) for side in (page.imagewidth, page.imagelength))
    across, down = page.tilewidth or 1, page.tilelength or 1
    if across > 2 * width or down > 2 * height:
        raise ImageError(f"{name} has tiles of {across} x {down} pixels", "save it anew")
    most = (width + across) * (height + down) * page.samplesperpixel * page.dtype.itemsize
    for start, length in segments:
        unfolding = zlib.decompressobj()
        most -= len(unfolding.decompress(data[start : start + length], most + 1))
        if most < 0:
            raise ImageError(f"{name} unfolds to more than its pixels", "save it anew")


def _by_pillow(name: str, data: bytes, page: Any) -> NDArray[Any]:
    """Pixels of what tifffile alone does not decode; ImageError where Pillow would change the samples."""
    from PIL import Image

    from codegen.registration.images.by_pillow import plain

    with Image.open(io.BytesIO(data), formats=("TIFF",)) as picture:
        stored = None if page.photometric.name == "PALETTE" or page.bitspersample == 1 else np.dtype(page.dtype)
        pixels = np.asarray(plain(picture))
    channels = pixels.shape[2] if pixels.ndim == 3 else 1
    if stored is not None and (pixels.dtype.newbyteorder("=") != stored or channels != page.samplesperpixel):
        finding = f"{name}: {page.samplesperpixel} channels of {stored} are compressed with {page.compression.name}"
        raise ImageError(finding, "save it without compression, or with Deflate (zip)")
    return pixels


def _native(pixels: NDArray[Any]) -> NDArray[Any]:
    return pixels.astype(pixels.dtype.newbyteorder("="), copy=False)


def require_fitting(path: Path, kind: str, dtype: np.dtype[Any], channels: int) -> None:
    """Refuse samples that are not written; ImageError names the file."""
    if dtype not in SAMPLES:
        raise ImageError(f"{path}: samples of {dtype} cannot be written", "convert them to 32-bit floats")
    _tifffile()


def encode(path: Path, temporary: Path, kind: str, pixels: NDArray[Any], profile: bytes | None) -> None:
    """Write one page, compressed without loss, to `temporary`."""
    channels = pixels.shape[2] if pixels.ndim == 3 else 1
    _tifffile().imwrite(
        temporary, pixels, photometric="rgb" if channels > 2 else "minisblack", compression="zlib", metadata=None,
        extrasamples=["unassalpha"] if channels in (2, 4) else None, iccprofile=profile,
        planarconfig="contig" if channels > 1 else None,
    )  # fmt: skip
