"""Images: PNG, JPEG and TIFF with 8-bit, 16-bit or float samples, grey or in colour, with or without opacity.

The kind of a file is what its first bytes say, whatever its name; its size in bytes and pixels is checked before
anything is decoded. Samples stay as they are stored; palettes become colours, and orientations that EXIF prescribes are
applied, so that the first row is the upper one. Images are decoded by Pillow and tifffile, and by SimpleITK where a PNG
file has several channels of 16 bits.

Kinds of image files, decoded and encoded by Pillow and tifffile.

How large the pixels of an image are, where its file says so: TIFF files of ImageJ, of OME and with a resolution.

What NIfTI, NRRD and MetaImage say is read with their samples, in `codegen.registration.app.reading`.
"""

from __future__ import annotations

import io
import logging
import re
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from codegen.errors import CodegenError, ExtraError, ImageError
from codegen.files import replacing

KINDS = {"PNG": (".png",), "JPEG": (".jpg", ".jpeg"), "TIFF": (".tif", ".tiff")}


@dataclass(frozen=True)
class Header:
    """Kind of file, size in pixels, bits of a sample and stored samples of a pixel."""

    kind: str
    width: int
    height: int
    bits: int
    samples: int


@contextmanager
def readable(name: str) -> Iterator[None]:
    """Errors of decoders, of which there are many kinds for damaged files, as one ImageError."""
    try:
        yield
    except CodegenError:
        raise
    except MemoryError as error:
        raise ImageError(f"{name} does not fit into memory", "give a smaller image") from error
    except Exception as error:  # decoders raise nearly everything for damaged files
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise ImageError(f"{name} is damaged or no image ({reason})", "give a whole PNG, JPEG or TIFF file") from error


ORIENTATION = 0x0112


def decode_by_pillow(name: str, data: bytes, header: Header) -> tuple[NDArray[Any], bytes | None, int]:
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


def require_fitting_by_pillow(path: Path, kind: str, dtype: np.dtype[Any], channels: int) -> None:
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


def encode_by_pillow(path: Path, temporary: Path, kind: str, pixels: NDArray[Any], profile: bytes | None) -> None:
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


def tiff_header(name: str, data: bytes) -> Header:
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


def decode_tiff(name: str, data: bytes, header: Header) -> tuple[NDArray[Any], bytes | None, int]:
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


def require_fitting_tiff(path: Path, kind: str, dtype: np.dtype[Any], channels: int) -> None:
    """Refuse samples that are not written; ImageError names the file."""
    if dtype not in SAMPLES:
        raise ImageError(f"{path}: samples of {dtype} cannot be written", "convert them to 32-bit floats")
    _tifffile()


def encode_tiff(path: Path, temporary: Path, kind: str, pixels: NDArray[Any], profile: bytes | None) -> None:
    """Write one page, compressed without loss, to `temporary`."""
    channels = pixels.shape[2] if pixels.ndim == 3 else 1
    _tifffile().imwrite(
        temporary, pixels, photometric="rgb" if channels > 2 else "minisblack", compression="zlib", metadata=None,
        extrasamples=["unassalpha"] if channels in (2, 4) else None, iccprofile=profile,
        planarconfig="contig" if channels > 1 else None,
    )  # fmt: skip


VOLUMES = (".nii", ".nii.gz", ".mha", ".mhd", ".nrrd", ".nhdr")
"""What `codegen.registration.volumes` reads."""
_PNG = b"\x89PNG\r\n\x1a\n"
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}

# Frames of JPEG (ITU-T T.81, table B.1): SOF0 to SOF15 without DHT, JPG and DAC; markers without a length.
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_BARE = frozenset(range(0xD0, 0xD9)) | {0x01, 0xFF}


def header_of(name: str, data: bytes) -> Header:
    """Read the header; ImageError when the bytes begin like no PNG, JPEG or TIFF file."""
    if data.startswith(_PNG):
        # The IHDR chunk, which comes first (PNG specification, 11.2.2).
        if len(data) < 33 or data[12:16] != b"IHDR" or zlib.crc32(data[12:29]) != struct.unpack(">I", data[29:33])[0]:
            raise ImageError(f"{name} has a damaged header", "give a whole PNG file")
        width, height, bits, colour = struct.unpack(">IIBB", data[16:26])
        return Header("PNG", width, height, bits, _PNG_CHANNELS.get(colour, 0))
    if data.startswith(b"\xff\xd8\xff"):
        return _jpeg(name, data)
    if data.startswith(_TIFF):
        return tiff_header(name, data)
    if name.lower().endswith(VOLUMES):
        raise ImageError(f"{name} is a volume, and this is for pictures", "give codegen warp two volumes")
    what = "is empty" if not data else "is no PNG, JPEG or TIFF file"
    raise ImageError(f"{name} {what}", "convert it to PNG, JPEG or TIFF")


def _jpeg(name: str, data: bytes) -> Header:
    """The frame header (ITU-T T.81, B.2.2), which follows any number of other segments."""
    place = 2
    while place + 4 <= len(data):
        marker = data[place + 1]
        if data[place] != 0xFF:
            break
        if marker in _BARE:
            place += 1 if marker == 0xFF else 2
            continue
        (length,) = struct.unpack(">H", data[place + 2 : place + 4])
        if marker in _FRAMES and place + 10 <= len(data):
            bits, height, width, samples = struct.unpack(">BHHB", data[place + 4 : place + 10])
            return Header("JPEG", width, height, bits, samples)
        if length < 2 or marker == 0xDA:
            break
        place += 2 + length
    raise ImageError(f"{name} has no frame header", "give a whole JPEG file")


_NAMES = {"micron": "µm", "microns": "µm", "um": "µm", "\\u00b5m": "µm", "inch": "in", "": "mm"}
_PRINT = (1.0, 72.0, 96.0, 100.0, 150.0, 200.0, 240.0, 300.0, 600.0, 1200.0)
"""Dots to an inch that programs write without having measured anything."""
_SIZE = r'PhysicalSize{}="([0-9.eE+-]+)"'
LONGEST = 1000.0
"""How many times as long as wide a pixel may be."""
MOST_UNIT = 12


@dataclass(frozen=True)
class Spacing:
    """Width and height of a pixel in a unit of length."""

    x: float
    y: float
    unit: str

    @property
    def side(self) -> float:
        """The side of a square with the area of a pixel."""
        return self.x if self.x == self.y else float(np.sqrt(self.x) * np.sqrt(self.y))

    def lengths(self, misses: NDArray[np.float64]) -> NDArray[np.float64]:
        """The lengths in the unit of vectors, shape (n, 2), that are in units of `side`, as misses are."""
        return np.asarray(np.linalg.norm(misses * self.side, axis=1))


def spacing_of(kind: str, data: bytes) -> Spacing | None:
    """The spacing that an image file carries; None where it carries none that means anything."""
    if kind != "TIFF":
        return None  # what PNG and JPEG files carry is how they are to be printed
    try:
        found = _of_tiff(data)
    except Exception:  # the pixels could be read; whatever is wrong with the rest is no reason to refuse them
        return None
    return None if found is None else meant(found)


def meant(spacing: Spacing) -> Spacing | None:
    """The same, if anything can have that size and shape."""
    sides = sorted((spacing.x, spacing.y))
    return spacing if 1e-12 < sides[0] <= sides[1] < min(1e12, LONGEST * sides[0]) else None


def _of_tiff(data: bytes) -> Spacing | None:
    import tifffile

    with tifffile.TiffFile(io.BytesIO(data)) as file:
        if file.is_ome and file.ome_metadata:
            return _of_ome(file.ome_metadata)
        page: Any = file.pages[0]
        x, y = (_number(page.tags.valueof(tag)) for tag in (282, 283))
        if not (x and y):
            return None
        if file.is_imagej:
            unit = str((file.imagej_metadata or {}).get("unit", ""))
            return Spacing(1 / x, 1 / y, named(unit)) if unit and unit != "pixel" else None
        code = int(page.tags.valueof(296) or 2)
        if code == 3:
            return Spacing(10 / x, 10 / y, "mm")
        return Spacing(25.4 / x, 25.4 / y, "mm") if code == 2 and x not in _PRINT else None


def _of_ome(text: str) -> Spacing | None:
    x, y = (re.search(_SIZE.format(axis), text) for axis in "XY")
    if x is None or y is None:
        return None
    unit = re.search(r'PhysicalSizeXUnit="([^"]*)"', text)
    return Spacing(float(x[1]), float(y[1]), named(unit[1] if unit else "µm"))


def named(unit: str) -> str:
    """A unit as the page shows it."""
    return _NAMES.get(unit, unit)[:MOST_UNIT]


def _number(value: Any) -> float:
    """A rational number as TIFF stores it; zero where there is none."""
    if not value:
        return 0.0
    top, bottom = value if isinstance(value, tuple) else (value, 1)
    return float(top) / float(bottom) if bottom else 0.0


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
    "PNG": decode_by_pillow,
    "JPEG": decode_by_pillow,
    "TIFF": decode_tiff,
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
    encode = encode_tiff if kind == "TIFF" else encode_by_pillow
    with replacing(path) as temporary:
        encode(path, temporary, kind, pixels, profile)


def require_fitting(path: Path, pixels: Pixels) -> None:
    """Refuse samples and channels that the kind of file has no place for; ImageError names the file."""
    kind = require_kind(path)
    if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] not in (2, 3, 4)) or not pixels.size:
        raise ImageError(f"{path}: an array of shape {pixels.shape} is no image", "give (h, w) or (h, w, 2 to 4)")
    check = require_fitting_tiff if kind == "TIFF" else require_fitting_by_pillow
    check(path, kind, pixels.dtype, pixels.shape[2] if pixels.ndim == 3 else 1)


def require_kind(path: Path) -> str:
    """The kind of image that the suffix of a file to be written means; ImageError when it means none."""
    for kind, suffixes in KINDS.items():
        if path.suffix.lower() in suffixes:
            return kind
    known = ", ".join(suffix for suffixes in KINDS.values() for suffix in suffixes)
    raise ImageError(f"{path}: unknown kind of image", f"let its name end in one of {known}")
