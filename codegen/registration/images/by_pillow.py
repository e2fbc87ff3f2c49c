"""PNG and JPEG files, by Pillow; by SimpleITK where a PNG file has several channels of 16 bits: Pillow keeps 8."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ExtraError, ImageError
from codegen.registration.images.kinds import Header

ORIENTATION = 0x0112


def decode(name: str, data: bytes, header: Header) -> tuple[NDArray[Any], bytes | None, int]:
    """Pixels, colour profile and EXIF orientation."""
    from PIL import Image

    if header.bits == 16 and header.samples > 1:
        return _decode_deep(name, data, header), None, 1
    with Image.open(io.BytesIO(data), formats=(header.kind,)) as picture:
        picture.load()
        profile = picture.info.get("icc_profile")
        orientation = int(picture.getexif().get(ORIENTATION, 1))
        if picture.mode in ("CMYK", "YCCK"):
            raise ImageError(f"{name} holds printing inks (CMYK)", "convert it to RGB")
        pixels = np.asarray(plain(picture))
    if header.bits == 16 and pixels.dtype != np.uint16:
        pixels = pixels.astype(np.uint16)  # Pillow hands some 16-bit grey images over as 32-bit integers
    return pixels, profile, orientation


def plain(picture: Any) -> Any:
    """Palettes, single bits and one transparent colour as the channels they stand for; all else as it is."""
    transparent = "transparency" in picture.info
    if picture.mode == "P":
        return picture.convert("RGBA" if transparent else "RGB")
    if picture.mode == "1":
        return picture.convert("L")
    if transparent and picture.mode in ("L", "RGB"):
        return picture.convert("LA" if picture.mode == "L" else "RGBA")
    return picture


def _decode_deep(name: str, data: bytes, header: Header) -> NDArray[Any]:
    itk = _itk(name)
    if header.samples == 2:
        raise ImageError(f"{name} holds 16-bit grey with opacity", "save it as TIFF, or as RGB with opacity")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "image.png"
        path.write_bytes(data)
        try:
            return np.asarray(itk.GetArrayFromImage(itk.ReadImage(str(path), imageIO="PNGImageIO")))
        except RuntimeError as error:  # its message names files of the library
            raise ImageError(f"{name} is damaged or cut off", "give a whole PNG file") from error


def _itk(name: str) -> Any:
    try:
        import SimpleITK
    except ImportError as error:
        finding = f"{name}: PNG with several channels of 16 bits takes SimpleITK, which is not installed"
        raise ExtraError(finding, "pip install variational-codegen[images], or use TIFF") from error
    return SimpleITK


def require_fitting(path: Path, kind: str, dtype: np.dtype[Any], channels: int) -> None:
    """Refuse samples that a PNG or JPEG file cannot hold; ImageError names the file."""
    if kind == "JPEG" and (dtype != np.uint8 or channels not in (1, 3)):
        finding = f"{path}: JPEG holds 8-bit grey or RGB, and this is {dtype} with {channels} channels"
        raise ImageError(finding, "write PNG or TIFF")
    if dtype not in (np.uint8, np.uint16):
        raise ImageError(f"{path}: PNG holds 8-bit or 16-bit samples, and these are {dtype}", "write TIFF")
    if dtype == np.uint16 and channels == 2:
        raise ImageError(f"{path}: 16-bit grey with opacity cannot be written as PNG", "write TIFF")
    if dtype == np.uint16 and channels > 2:
        _itk(str(path))


def encode(path: Path, temporary: Path, kind: str, pixels: NDArray[Any], profile: bytes | None) -> None:
    """Write a file of the given kind, into which the samples fit, to `temporary`."""
    from PIL import Image

    if pixels.dtype == np.uint16 and pixels.ndim == 3:
        itk = _itk(str(path))
        itk.WriteImage(itk.GetImageFromArray(pixels, isVector=True), str(temporary), imageIO="PNGImageIO")
        return
    options: dict[str, Any] = {"icc_profile": profile} if profile else {}
    if kind == "JPEG":
        options |= {"quality": 95, "subsampling": 0}
    Image.fromarray(pixels).save(temporary, format=kind, **options)
