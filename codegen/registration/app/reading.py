"""Images that visitors open, images on the command line, and the bundled example.

Pictures in files of volumes: single slices as NIfTI, NRRD and MetaImage, with the size of their pixels. As with
pictures, the kind of a file is what its first bytes say, and sizes are looked at before samples are read, by SimpleITK.
Rows and columns stay as they are stored: landmarks count in pixels of the file, as other programs have them, and
nothing is turned by orientations; the page says which edge is which side of the patient instead. Files that name others
are refused: who opens one in a browser would have the server read whatever it names.
"""

from __future__ import annotations

import re
import tempfile
import zlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path, PurePath
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ArgumentError, ImageError, PointsError
from codegen.registration.app.session import NAME_LENGTH, Picture, Session, Work, pairs_of
from codegen.registration.formats import FORMATS, parse_landmarks
from codegen.registration.images import SAMPLES, Limits, Spacing, meant, named, read_image
from codegen.registration.volumes import library, require_whole, silent, telling

Edges: TypeAlias = tuple[str, str, str, str]
_NIFTI = 352
"""Bytes of a header of NIfTI with its magic number."""
_METAIMAGE = re.compile(rb"\s*(ObjectType|Comment|NDims)\s*=")
_ELSEWHERE = re.compile(rb"^\s*data\s*file", re.MULTILINE | re.IGNORECASE)
"""A line of NRRD that names other files."""
_HERE = re.compile(rb"\s*=\s*LOCAL\s*\n")
"""What follows a key of MetaImage, the last of its header, where samples follow that."""
_PLACED = re.compile(rb"^space: *(left|right|lps|ras|las)", re.MULTILINE | re.IGNORECASE)
"""A line of NRRD by which axes are those of a patient."""
_UNIT = re.compile(rb'^(?:space )?units: *"([^"\r\n]*)"', re.MULTILINE)
_KINDS = {".nii": "NIfTI", ".nii.gz": "NIfTI", ".nrrd": "NRRD", ".mha": "MetaImage"}
OBLIQUE = 0.3
"""Cosine of an axis with a direction of the patient from which on an edge is called by that, too."""
MICROMETRES = 3
"""A code of NIfTI's `xyzt_units`."""


def ending_of(data: bytes) -> str | None:
    """The name's ending by which SimpleITK knows what these bytes are; None where they are no such file."""
    if data.startswith(b"NRRD"):
        return ".nrrd"
    if _METAIMAGE.match(data[:200]):
        return ".mha"
    if data.startswith(b"\x1f\x8b"):
        with suppress(zlib.error):
            return ".nii.gz" if _is_nifti(zlib.decompressobj(31).decompress(data[: 1 << 16], _NIFTI)) else None
    return ".nii" if _is_nifti(data) else None


def _is_nifti(data: bytes) -> bool:
    return data[344:348] in (b"n+1\0", b"ni1\0") or data[4:8] in (b"n+2\0", b"ni2\0")


@dataclass(frozen=True, eq=False)
class Slice:
    """Pixels, shape (h, w) or (h, w, 3 or 4), and the kind of file; where it says so, the size of a pixel and `edges`.

    Those are the sides of the patient towards which the left, right, upper and lower edge lie.
    """

    pixels: NDArray[Any]
    kind: str
    spacing: Spacing | None
    edges: Edges | None


def read_slice(data: bytes, ending: str, limits: Limits, name: str) -> Slice:
    """Read a picture from the bytes of a file of volumes.

    Raises ImageError, naming the file, for volumes, files that name others, more pixels than `limits` allow, samples
    that pictures do not have, and what is damaged; ExtraError where the library that reads it is missing.
    """
    # Refuse headers whose samples are in another file.
    if ending == ".mha":
        _, *rest = data.split(b"ElementDataFile")  # of all, since a comment may hold the first
        is_alone = all(_HERE.match(part[:100]) for part in rest)
    else:
        is_alone = ending != ".nrrd" or _ELSEWHERE.search(_text(data)) is None
    if not is_alone:
        raise ImageError(f"{name} names another file for its samples", "save it as one file: .nrrd, .mha or .nii")
    itk = library("SimpleITK")
    with tempfile.TemporaryDirectory(prefix="codegen-") as folder:
        path = Path(folder) / f"image{ending}"
        path.write_bytes(data)
        with telling(name), silent():
            reader = itk.ImageFileReader()
            reader.SetFileName(str(path))
            reader.ReadImageInformation()
            axes = _axes(name, reader, limits)
            _require_components(name, reader.GetNumberOfComponents())
            require_whole(path, reader, name)
            samples = itk.GetArrayFromImage(reader.Execute())
    if samples.dtype not in SAMPLES:
        remedy = "save it with 8 or 16-bit integers or 32-bit floats"
        raise ImageError(f"{name} holds samples of {samples.dtype}", remedy)
    width, height = (reader.GetSize()[axis] for axis in axes)
    pixels = samples.reshape(height, width, *samples.shape[reader.GetDimension() :])
    spacing, edges = _spacing(data, ending, reader, axes), _edges(data, ending, reader, axes)
    return Slice(np.ascontiguousarray(pixels), _KINDS[ending], spacing, edges)


def _text(data: bytes) -> bytes:
    """The header of NRRD, which ends with an empty line."""
    return re.split(rb"\r?\n\r?\n", data, maxsplit=1)[0]


def _axes(name: str, reader: Any, limits: Limits) -> tuple[int, int]:
    """The axes of columns and of rows: those that are longer than 1."""
    size = reader.GetSize()
    said = " x ".join(map(str, size))
    axes = tuple(k for k, length in enumerate(size) if length > 1)
    if len(axes) > 2:
        remedy = "save one slice as a file of its own, or give codegen warp the volumes"
        raise ImageError(f"{name} is a volume ({said} voxels), and the page is for pictures", remedy)
    if len(axes) < 2:
        axes = (0, 1)
    if size[axes[0]] * size[axes[1]] > limits.pixels:
        raise ImageError(f"{name} has {said} pixels, more than {limits.pixels}", "give a smaller image")
    return axes[0], axes[1]


def _require_components(name: str, components: int) -> None:
    if components not in (1, 3, 4):
        raise ImageError(f"{name} has {components} numbers in each pixel", "give grey, RGB or RGB with opacity")


def _edges(data: bytes, ending: str, reader: Any, axes: tuple[int, int]) -> Edges | None:
    """The sides of the patient towards which edges lie; None of files that place nothing in space."""
    if reader.GetDimension() < 3 or not _is_placed(data, ending, reader):
        return None
    dimension = reader.GetDimension()
    cosines = np.array(reader.GetDirection()).reshape(dimension, dimension)[:3]
    right, lower = cosines[:, axes[0]], cosines[:, axes[1]]
    return _side(-right), _side(right), _side(-lower), _side(lower)


def _is_placed(data: bytes, ending: str, reader: Any) -> bool:
    """Whether a file says how its axes lie; what the library assumes otherwise is not that."""
    if ending.startswith(".nii"):
        return any(int(float(reader.GetMetaData(key))) for key in ("qform_code", "sform_code"))
    if ending == ".nrrd":
        return _PLACED.search(_text(data)) is not None
    return b"TransformMatrix" in data[:4096]


def _side(direction: NDArray[np.float64]) -> str:
    """The letters of the patient's sides towards which a direction in LPS points, the nearest first."""
    order = np.argsort(-np.abs(direction), kind="stable")
    letters = ("RL", "AP", "IS")
    return "".join(letters[k][int(direction[k] > 0.0)] for k in order if abs(direction[k]) >= OBLIQUE)


def _spacing(data: bytes, ending: str, reader: Any, axes: tuple[int, int]) -> Spacing | None:
    """The size of a pixel; None for 1 by 1 of no unit, which programs write that know none."""
    x, y = (float(reader.GetSpacing()[axis]) for axis in axes)
    unit = ""
    if ending.startswith(".nii"):
        code = int(reader.GetMetaData("xyzt_units")) & 7
        unit = "mm" if code else ""
        if code == MICROMETRES:  # which the library makes millimetres
            x, y, unit = 1e3 * x, 1e3 * y, "µm"
    elif ending == ".nrrd":
        found = _UNIT.search(_text(data))
        unit = named(found[1].decode("utf-8", errors="replace")) if found else ""
    return None if not unit and x == y == 1.0 else meant(Spacing(x, y, unit or "mm"))


LIMITS = Limits(bytes=32 << 20, pixels=1 << 25)
"""The largest file and the largest image that the page takes; codegen warp takes more."""
MOST_LANDMARK_BYTES = 8 << 20
"""The largest landmark file that the page takes."""
_WORDS = {"moving": ("moving", "source"), "fixed": ("fixed", "target")}
"""Words in names of landmark files, and the image whose points these hold."""
Files: TypeAlias = list[tuple[str, bytes]]
_EXAMPLE = files("codegen.registration.app") / "example"


def picture_from(data: bytes, name: str) -> Picture:
    """Decode an image within LIMITS. Only the last part of its name is kept, to be shown; raises ImageError."""
    shown = PurePath(name.replace("\\", "/")).name[-NAME_LENGTH:] or "image"
    if len(data) <= LIMITS.bytes and (ending := ending_of(data)) is not None:
        found = read_slice(data, ending, LIMITS, shown)
        return Picture(found.pixels, shown, data, found.kind, None, found.spacing, found.edges)
    image = read_image(data, LIMITS, shown)
    return Picture(image.pixels, shown, data, image.kind, image.profile, image.spacing)


def picture_at(path: Path) -> Picture:
    """The image in a file; raises ImageError."""
    try:
        with path.open("rb") as file:
            data = file.read(LIMITS.bytes + 1)
    except (OSError, ValueError) as error:
        raise ImageError(f"{path} cannot be read ({getattr(error, 'strerror', error)})", "give an image") from error
    return picture_from(data, path.name)


def in_order(files: Files) -> tuple[Files, list[str]]:
    """Landmark files with the moving one first, and what the visitor should know of that; nothing for a single file.

    Names tell them apart where one of them has a word for its image; otherwise they are taken as they were chosen.
    PointsError where a file came without its partner.
    """
    if len(files) == 1 and _is_half(*files[0]):
        remedy = "choose the moving and the fixed file together, holding Ctrl (or Cmd) while clicking the second"
        raise PointsError(f"{files[0][0]} has the points of one image only", remedy)
    if len(files) != 2:
        return files, []
    first, second = (_side_named(name) for name, _ in files)
    named = first != second
    turned = named and (first == "fixed" or second == "moving")
    ordered = files[::-1] if turned else files
    moving, fixed = (name for name, _ in ordered)
    why = "as their names say" if named else "in the order in which they came; rename them to contain moving and fixed"
    return ordered, [f"{moving} was taken for the moving image and {fixed} for the fixed one, {why}"]


def _side_named(name: str) -> str:
    """The image that a file's name tells of, if it tells of one."""
    found = [side for side, words in _WORDS.items() if any(word in name.lower() for word in words)]
    return found[0] if len(found) == 1 else ""


def _is_half(name: str, data: bytes) -> bool:
    """Whether a file looks like one of a pair."""
    begin = data[:2000].decode("utf-8-sig", errors="replace")
    fitting = [form for form in FORMATS.values() if name.lower().endswith(form.suffixes) and form.recognises(begin)]
    return bool(fitting) and all(form.files == 2 for form in fitting)


def example() -> Session:
    """Two drawn fishes with their landmarks, of which the sunfish is the porcupine fish in bent coordinates."""
    moving = picture_from((_EXAMPLE / "moving.png").read_bytes(), "porcupine fish.png")
    fixed = picture_from((_EXAMPLE / "fixed.png").read_bytes(), "sunfish.png")
    landmarks = parse_landmarks([("landmarks.csv", (_EXAMPLE / "landmarks.csv").read_bytes())])
    return Session(moving, fixed, Work(pairs_of(landmarks, 1)))


def session_of(images: Sequence[Path]) -> Session:
    """A session on no image (the example), one, or a moving and a fixed one; ArgumentError for more."""
    if not images:
        return example()
    if len(images) > 2:
        raise ArgumentError(f"{len(images)} images were given", "give one, or a moving and a fixed one")
    moving, *fixed = map(picture_at, images)
    return Session(moving, fixed[0] if fixed else None)
