"""Reading and writing of images: PNG, JPEG and TIFF files, grey or in colour, with or without opacity.

Samples are integers of 8, 16 or 32 bits, or floats, and keep their type. The first bytes of a file determine its kind,
not its name. The size in bytes and in pixels is checked before anything is decoded. Palettes are converted to colours.
EXIF orientations are applied, so that the first row is the upper one. Pillow and tifffile decode images; SimpleITK
decodes PNG files with several channels of 16 bits.

TIFF files give the size of a pixel in ImageJ metadata, OME metadata or as a resolution.
`codegen.registration.app.reading` reads the size of a pixel from NIfTI, NRRD and MetaImage.
"""

from __future__ import annotations

import importlib
import io
import logging
import re
import struct
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from codegen.errors import CodegenError, ExtraError, ImageError
from codegen.files import replacing

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

Pixels: TypeAlias = NDArray[Any]
"""An image of shape (h, w), or (h, w, c) with c = 2 (grey, opacity), 3 (RGB) or 4 (RGB, opacity); or a volume."""
SampleType: TypeAlias = np.dtype[Any]

KINDS = {"PNG": (".png",), "JPEG": (".jpg", ".jpeg"), "TIFF": (".tif", ".tiff")}
VOLUMES = (".nii", ".nii.gz", ".mha", ".mhd", ".nrrd", ".nhdr")
"""Suffixes of files that `codegen.registration.volumes` reads."""
SAMPLES = frozenset(np.dtype(name) for name in ("u1", "u2", "i2", "u4", "i4", "f4", "f8"))
LONGEST = 1000.0  # largest plausible ratio of the longer to the shorter side of a pixel
MOST_UNIT = 12  # largest number of characters of the name of a unit

_PNG = b"\x89PNG\r\n\x1a\n"
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
_PNG_OF_16_BITS = "SimpleITK", "which reads and writes PNG with several channels of 16 bits,"
_EXIF_ORIENTATION = 0x0112
_DEFLATE = (8, 32946)
# EXIF 2.32, tag 0x0112: the functions that turn a stored array upright, by orientation.
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
_TRANSPOSED = (5, 6, 7, 8)
_UNITS = {"micron": "µm", "microns": "µm", "um": "µm", "\\u00b5m": "µm", "inch": "in", "": "mm"}
_PRINT = (1.0, 72.0, 96.0, 100.0, 150.0, 200.0, 240.0, 300.0, 600.0, 1200.0)
"""Resolutions, in dots per inch, that programs write by default; they do not mean a measured pixel size."""
_OME_SIZE, _OME_UNIT = r'PhysicalSize{}="([0-9.eE+-]+)"', r'PhysicalSize{}Unit="([^"]+)"'
_METRES = {"pm": 1e-12, "Å": 1e-10, "nm": 1e-9, "µm": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
"""Units of length that can be converted into each other, in metres."""


@dataclass(frozen=True)
class Limits:
    """The largest size of a file, in bytes, and of an image, in pixels, that is read."""

    bytes: int = 1 << 30
    pixels: int = 1 << 26


@dataclass(frozen=True)
class Spacing:
    """The width and height of a pixel, and their unit of length."""

    x: float
    y: float
    unit: str

    @property
    def side(self) -> float:
        """The side of a square with the area of a pixel."""
        return self.x if self.x == self.y else float(np.sqrt(self.x) * np.sqrt(self.y))

    @property
    def is_plausible(self) -> bool:
        """True if a pixel can have this size and this ratio of its sides."""
        short, long = sorted((self.x, self.y))
        return 1e-12 < short <= long < min(1e12, LONGEST * short)

    def lengths(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the lengths, shape (n,) in `unit`, of vectors in units of `side`, shape (n, 2)."""
        return np.asarray(np.linalg.norm(vectors * self.side, axis=1))


@dataclass(frozen=True, eq=False)
class Image:
    """The pixels of an upright image, in the type of the file, and the kind of file: "PNG", "JPEG" or "TIFF".

    `profile` is the colour profile (ICC) and `spacing` the size of a pixel; both are None if missing in the file.
    """

    pixels: Pixels
    kind: str
    profile: bytes | None = None
    spacing: Spacing | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the pixels, (h, w) or (h, w, c)."""
        return self.pixels.shape


@dataclass(frozen=True)
class _Header:
    """The kind of a file, its size in pixels, the bits of a sample, and the number of samples of a pixel."""

    kind: str
    width: int
    height: int
    bits: int
    samples: int


def read_image(source: Path | str | bytes, limits: Limits | None = None, name: str = "") -> Image:
    """Read an image from a path, or from the bytes of a file.

    Parameters
    ----------
    source : Path, str or bytes
        The path, or the content of a file.
    limits : Limits, optional
        The largest file and image.
    name : str
        The name of the image in errors; by default the path.

    Raises
    ------
    ImageError
        For anything but a PNG, JPEG or TIFF file, for damaged files, for more bytes or pixels than `limits` allow,
        and for samples other than 8, 16 or 32-bit integers and 32 or 64-bit floats.
    """
    limits = limits or Limits()
    if isinstance(source, bytes):
        data, name = source, name or "the image"
    else:
        try:
            with Path(source).open("rb") as file:
                data, name = file.read(limits.bytes + 1), name or str(source)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise ImageError(f"{source} cannot be read ({reason})", "give an image file") from error
    if len(data) > limits.bytes:
        raise ImageError(f"{name} has more than {limits.bytes} bytes", "give a smaller file")
    try:
        header = _header(name, data)
        size = f"{header.width} x {header.height} pixels"
        if header.width < 1 or header.height < 1:
            raise ImageError(f"{name} has {size}", "give an image")
        if header.width * header.height > limits.pixels:
            raise ImageError(f"{name} has {size}, more than {limits.pixels}", "give a smaller image")
        decode = _decode_tiff if header.kind == "TIFF" else _decode_by_pillow
        pixels, profile, orientation = decode(name, data, header)
        if pixels.shape[:2] != (header.height, header.width):
            raise ImageError(f"{name} announces {size} and holds others", "save it anew")
    except CodegenError:
        raise
    except MemoryError as error:
        raise ImageError(f"{name} does not fit into memory", "give a smaller image") from error
    except Exception as error:  # for damaged files decoders raise exceptions of almost every class
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise ImageError(f"{name} is damaged or no image ({reason})", "give a whole PNG, JPEG or TIFF file") from error
    # The resolution of PNG and JPEG files refers to a print.
    spacing = _tiff_spacing(name, data) if header.kind == "TIFF" else None
    if spacing is not None and orientation in _TRANSPOSED:
        spacing = Spacing(spacing.y, spacing.x, spacing.unit)
    upright = _ORIENTATIONS.get(orientation, _ORIENTATIONS[1])(pixels)
    return Image(np.ascontiguousarray(upright), header.kind, profile, spacing)


def write_image(path: Path, pixels: Pixels, profile: bytes | None = None) -> None:
    """Write an image in the format of its suffix; an existing file is unchanged if writing fails.

    Parameters
    ----------
    path : Path
        PNG takes 8-bit and 16-bit samples, JPEG 8-bit grey and RGB (quality 95, lossy), TIFF all kinds.
    pixels : array
        Shape (h, w) or (h, w, c).
    profile : bytes, optional
        The colour profile (ICC).

    Raises
    ------
    ImageError
        If the format cannot hold the samples.
    FileError
        If the file system refuses.
    """
    path = Path(path)
    require_fitting(path, pixels)
    kind, channels = require_kind(path), pixels.shape[2] if pixels.ndim == 3 else 1
    with replacing(path) as temporary:
        if kind == "TIFF":
            tifffile().imwrite(
                temporary, pixels, photometric="rgb" if channels > 2 else "minisblack", compression="zlib",
                metadata=None, extrasamples=["unassalpha"] if channels in (2, 4) else None, iccprofile=profile,
                planarconfig="contig" if channels > 1 else None,
            )  # fmt: skip
        elif pixels.dtype == np.uint16 and pixels.ndim == 3:
            itk = library(*_PNG_OF_16_BITS)
            itk.WriteImage(itk.GetImageFromArray(pixels, isVector=True), str(temporary), imageIO="PNGImageIO")
        else:
            from PIL import Image

            options = {"quality": 95, "subsampling": 0} if kind == "JPEG" else {}
            Image.fromarray(pixels).save(temporary, format=kind, icc_profile=profile, **options)


def require_fitting(path: Path, pixels: Pixels) -> None:
    """Raise ImageError if the format of the suffix cannot hold these samples or channels."""
    kind = require_kind(path)
    if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] not in (2, 3, 4)) or not pixels.size:
        raise ImageError(f"{path}: an array of shape {pixels.shape} is no image", "give (h, w) or (h, w, 2 to 4)")
    dtype, channels = pixels.dtype, pixels.shape[2] if pixels.ndim == 3 else 1
    if kind == "TIFF":
        if dtype not in SAMPLES:
            raise ImageError(f"{path}: samples of {dtype} cannot be written", "convert them to 32-bit floats")
        tifffile()
        return
    if kind == "JPEG" and (dtype != np.uint8 or channels not in (1, 3)):
        finding = f"{path}: JPEG holds 8-bit grey or RGB, and this is {dtype} with {channels} channels"
        raise ImageError(finding, "write PNG or TIFF")
    if dtype not in (np.uint8, np.uint16):
        raise ImageError(f"{path}: PNG holds 8-bit or 16-bit samples, and these are {dtype}", "write TIFF")
    if dtype == np.uint16 and channels == 2:
        raise ImageError(f"{path}: 16-bit grey with opacity cannot be written as PNG", "write TIFF")
    if dtype == np.uint16 and channels > 2:
        library(*_PNG_OF_16_BITS)


def require_kind(path: Path) -> str:
    """Return "PNG", "JPEG" or "TIFF" for the suffix of an output; ImageError for other suffixes."""
    for kind, suffixes in KINDS.items():
        if path.suffix.lower() in suffixes:
            return kind
    known = ", ".join(suffix for suffixes in KINDS.values() for suffix in suffixes)
    raise ImageError(f"{path}: unknown kind of image", f"let its name end in one of {known}")


def unit_name(unit: str) -> str:
    """Return the short name of a unit for reports and the page, such as "µm" for "micron"."""
    return _UNITS.get(unit, unit)[:MOST_UNIT]


def rational(value: tuple[int, int] | float | None) -> float:
    """Return the value of a number or fraction of a TIFF tag as a float; zero for a missing or infinite value."""
    top, bottom = value if isinstance(value, tuple) else (value or 0, 1)
    return float(top) / float(bottom) if bottom else 0.0


def library(name: str, use: str) -> ModuleType:
    """Return an imported library; ExtraError, with `use` and the command to install the library, if it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ExtraError(f"{name}, {use} is not installed", f"pip install {name}") from error


def tifffile() -> ModuleType:
    """Return tifffile without its messages on stderr; ExtraError if it is not installed."""
    module = library("tifffile", "which reads and writes TIFF files,")
    module.logger().setLevel(logging.CRITICAL)
    return module


def _header(name: str, data: bytes) -> _Header:
    """Return the header of the file content; ImageError unless it begins like a PNG, JPEG or TIFF file."""
    if data.startswith(_PNG):
        # The IHDR chunk comes first (PNG specification, 11.2.2).
        if len(data) < 33 or data[12:16] != b"IHDR" or zlib.crc32(data[12:29]) != struct.unpack(">I", data[29:33])[0]:
            raise ImageError(f"{name} has a damaged header", "give a whole PNG file")
        width, height, bits, colour = struct.unpack(">IIBB", data[16:26])
        return _Header("PNG", width, height, bits, _PNG_CHANNELS.get(colour, 0))
    if data.startswith(b"\xff\xd8\xff"):
        from PIL.JpegImagePlugin import JpegImageFile

        try:
            picture = JpegImageFile(io.BytesIO(data))  # reads only the header
        except Exception as error:  # for damaged files Pillow raises exceptions of several classes
            raise ImageError(f"{name} has no frame header", "give a whole JPEG file") from error
        return _Header("JPEG", *picture.size, 8, len(picture.getbands()))
    if data.startswith(_TIFF):
        with tifffile().TiffFile(io.BytesIO(data)) as file:
            page = file.pages[0]
            for number in range(1, 20):
                try:
                    other = file.pages[number]
                except IndexError:
                    break
                if not other.is_reduced:  # reduced pages are smaller copies of the first page
                    remedy = "save one as a file of its own; codegen warp registers stacks"
                    raise ImageError(f"{name} holds several images", remedy)
            if page.photometric.name not in ("MINISBLACK", "RGB", "PALETTE", "YCBCR"):
                raise ImageError(f"{name} stores colours as {page.photometric.name}", "save it as grey or RGB")
            if page.imagedepth != 1 or page.samplesperpixel > 4:
                finding = f"{name} has {page.samplesperpixel} samples in a pixel and {page.imagedepth} layers"
                raise ImageError(finding, "save one image with 1 to 4 channels")
            if page.bitspersample != 1 and (page.dtype is None or np.dtype(page.dtype) not in SAMPLES):
                kind = page.dtype or f"{page.bitspersample} bits"
                raise ImageError(
                    f"{name} holds samples of {kind}", "save it with 8 or 16-bit integers or 32-bit floats"
                )
            return _Header("TIFF", page.imagewidth, page.imagelength, page.bitspersample, page.samplesperpixel)
    if name.lower().endswith(VOLUMES):
        raise ImageError(f"{name} is a volume, and this is for pictures", "give codegen warp two volumes")
    problem = "is empty" if not data else "is no PNG, JPEG or TIFF file"
    raise ImageError(f"{name} {problem}", "convert it to PNG, JPEG or TIFF")


def _decode_by_pillow(name: str, data: bytes, header: _Header) -> tuple[Pixels, bytes | None, int]:
    """Return pixels, colour profile and EXIF orientation of a PNG or JPEG file."""
    from PIL import Image

    if header.bits == 16 and header.samples > 1:
        itk = library(*_PNG_OF_16_BITS)
        if header.samples == 2:
            raise ImageError(f"{name} holds 16-bit grey with opacity", "save it as TIFF, or as RGB with opacity")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "image.png"
            path.write_bytes(data)
            try:
                return np.asarray(itk.GetArrayFromImage(itk.ReadImage(str(path), imageIO="PNGImageIO"))), None, 1
            except RuntimeError as error:  # its message is not shown: it names source files of SimpleITK
                raise ImageError(f"{name} is damaged or cut off", "give a whole PNG file") from error
    with Image.open(io.BytesIO(data), formats=(header.kind,)) as picture:
        picture.load()
        profile = picture.info.get("icc_profile")
        orientation = int(picture.getexif().get(_EXIF_ORIENTATION, 1))
        if picture.mode in ("CMYK", "YCCK"):
            raise ImageError(f"{name} holds printing inks (CMYK)", "convert it to RGB")
        pixels = np.asarray(_channels(picture))
    if header.bits == 16 and pixels.dtype != np.uint16:
        pixels = pixels.astype(np.uint16)  # Pillow returns some 16-bit grey images as 32-bit integers
    return pixels, profile, orientation


def _channels(picture: Picture) -> Picture:
    """Return a picture in grey or RGB; palettes, single bits and one transparent colour are converted."""
    transparent = "transparency" in picture.info
    if picture.mode == "P":
        return picture.convert("RGBA" if transparent else "RGB")
    if picture.mode == "1":
        return picture.convert("L")
    if transparent and picture.mode in ("L", "RGB"):
        return picture.convert("LA" if picture.mode == "L" else "RGBA")
    return picture


def _decode_tiff(name: str, data: bytes, header: _Header) -> tuple[Pixels, bytes | None, int]:
    """Return pixels, colour profile and orientation of a TIFF file."""
    with tifffile().TiffFile(io.BytesIO(data)) as file:
        page = file.pages[0]
        is_plain = page.photometric.name in ("MINISBLACK", "RGB") and page.bitspersample != 1
        if is_plain and page.compression in (1, *_DEFLATE):
            # Refuse strips or tiles that lie outside the file, or that decompress to more than the image needs.
            segments = list(zip(page.dataoffsets, page.databytecounts, strict=True))
            if any(start + length > len(data) for start, length in segments):
                raise ImageError(f"{name} is cut off", "give a whole TIFF file")
            if page.compression in _DEFLATE:
                width, height = (max(side, 1024) for side in (page.imagewidth, page.imagelength))
                across, down = page.tilewidth or 1, page.tilelength or 1
                if across > 2 * width or down > 2 * height:
                    raise ImageError(f"{name} has tiles of {across} x {down} pixels", "save it anew")
                most = (width + across) * (height + down) * page.samplesperpixel * page.dtype.itemsize
                for start, length in segments:
                    decompressor = zlib.decompressobj()
                    most -= len(decompressor.decompress(data[start : start + length], most + 1))
                    if most < 0:
                        raise ImageError(f"{name} unfolds to more than its pixels", "save it anew")
            pixels = np.asarray(page.asarray())
            if page.planarconfig == 2 and pixels.ndim == 3:
                pixels = np.moveaxis(pixels, 0, -1)
        else:
            from PIL import Image

            with Image.open(io.BytesIO(data), formats=("TIFF",)) as picture:
                stored = None if page.photometric.name == "PALETTE" or header.bits == 1 else np.dtype(page.dtype)
                pixels = np.asarray(_channels(picture))
            channels = pixels.shape[2] if pixels.ndim == 3 else 1
            if stored is not None and (pixels.dtype.newbyteorder("=") != stored or channels != header.samples):
                finding = f"{name}: {header.samples} channels of {stored} are compressed with {page.compression.name}"
                raise ImageError(finding, "save it without compression, or with Deflate (zip)")
        pixels = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
        return pixels, page.iccprofile, int(page.tags.valueof(274, 1) or 1)


def _tiff_spacing(name: str, data: bytes) -> Spacing | None:
    """Return the size of a pixel in a TIFF file, in the unit of its width; None if it is missing or not plausible.

    Raise ImageError if the units of width and height cannot be converted into each other.
    """
    spacing, units = None, set[str]()
    try:
        with tifffile().TiffFile(io.BytesIO(data)) as file:
            if file.is_ome and file.ome_metadata:
                x, y = (re.search(_OME_SIZE.format(axis), file.ome_metadata) for axis in "XY")
                stated = [re.search(_OME_UNIT.format(axis), file.ome_metadata) for axis in "XY"]
                names = [_UNITS.get(unit[1], unit[1]) for unit in stated if unit is not None] or ["µm"]
                if x is not None and y is not None:
                    across, down = names[0], names[-1]
                    if across == down:
                        spacing = Spacing(float(x[1]), float(y[1]), unit_name(across))
                    elif {across, down} <= set(_METRES):
                        spacing = Spacing(float(x[1]), float(y[1]) * _METRES[down] / _METRES[across], across)
                    else:
                        units = {across, down}
            else:
                tags = file.pages[0].tags
                width, height = (rational(tags.valueof(tag)) for tag in (282, 283))
                if not (width and height):
                    return None
                if file.is_imagej:
                    unit_text = str((file.imagej_metadata or {}).get("unit", ""))
                    if unit_text and unit_text != "pixel":
                        spacing = Spacing(1 / width, 1 / height, unit_name(unit_text))
                else:
                    code = int(tags.valueof(296) or 2)
                    if code == 3:
                        spacing = Spacing(10 / width, 10 / height, "mm")
                    elif code == 2 and width not in _PRINT:
                        spacing = Spacing(25.4 / width, 25.4 / height, "mm")
    except Exception:  # the pixels are readable: errors in metadata are no reason to refuse the image
        return None
    if units:
        raise ImageError(
            f"{name}: the OME metadata give width and height of a pixel in {' and '.join(sorted(units))}, which cannot "
            "be converted",
            "save it with one unit of length for both",
        )
    return spacing if spacing is not None and spacing.is_plausible else None
