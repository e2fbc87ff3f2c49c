"""Files of the page: reading of images that visitors open, and the storage of works.

Images are opened by visitors or named on the command line, or are the bundled example. Single slices in NIfTI, NRRD and
MetaImage files are pictures, too, and are read by SimpleITK. The first bytes of a file determine its kind, and its size
is checked before samples are read. Rows and columns remain as stored, because landmarks are in pixels of the file, as
in other programs. Instead of turning slices, the page shows which edge is which side of the patient. Files that name
other files are refused, since a visitor must not choose files of the server.

A work has the landmark pairs, settings and images of one visitor of the page. Works are files in a folder of the user
who runs the server. The address of the page contains the random name of the work, its token; all tabs with this token
share the work. Images are stored once, under the hash of their content.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import tempfile
import zlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path, PurePath
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ArgumentError, CodegenError, ImageError, PointsError
from codegen.files import refused, replacing
from codegen.registration.app.session import (
    NAME_LENGTH,
    Edges,
    Picture,
    Session,
    Work,
    as_record,
    from_record,
    pairs_of,
)
from codegen.registration.formats import FORMATS, parse_landmarks
from codegen.registration.images import SAMPLES, Limits, Spacing, library, read_image, unit_name
from codegen.registration.volumes import ITK, VolumeReader, library_errors, require_whole, silent

Files: TypeAlias = list[tuple[str, bytes]]  # the names and contents of files

LIMITS = Limits(bytes=32 << 20, pixels=1 << 25)
"""The largest file and the largest image of the page; codegen warp accepts larger ones."""
MOST_LANDMARK_BYTES = 8 << 20  # the largest size, in bytes, of a landmark file of the page
_SIDES = {"moving": ("moving", "source"), "fixed": ("fixed", "target")}
"""Words in the name of a landmark file that tell which image its points belong to."""
_EXAMPLE = files("codegen.registration.app") / "example"

_KINDS = {".nii": "NIfTI", ".nii.gz": "NIfTI", ".nrrd": "NRRD", ".mha": "MetaImage"}
_NIFTI = 352  # number of bytes of a NIfTI header with its magic number
_METAIMAGE = re.compile(rb"\s*(ObjectType|Comment|NDims)\s*=")
_METAIMAGE_LOCAL = re.compile(rb"\s*=\s*LOCAL\s*\n")
"""The value of ElementDataFile, the last key of a MetaImage header, if the samples are in the same file."""
_NRRD_OTHER_FILE = re.compile(rb"^\s*data\s*file", re.MULTILINE | re.IGNORECASE)
"""A line of an NRRD header that names another file for the samples."""
_NRRD_SPACE = re.compile(rb"^space: *(left|right|lps|ras|las)", re.MULTILINE | re.IGNORECASE)
"""A line of an NRRD header that relates its axes to a patient."""
_NRRD_UNIT = re.compile(rb'^(?:space )?units: *"([^"\r\n]*)"', re.MULTILINE)
_MICROMETRES = 3  # the code of micrometres in `xyzt_units` of NIfTI
OBLIQUE = 0.3
"""Smallest cosine of the angle between an image axis and a patient axis at which an edge is named after the latter."""


def picture_from(data: bytes, name: str) -> Picture:
    """Return the image in the bytes of a file named `name`; ImageError if it is not readable or exceeds LIMITS."""
    shown = PurePath(name.replace("\\", "/")).name[-NAME_LENGTH:] or "image"
    if len(data) <= LIMITS.bytes and (suffix := _volume_suffix(data)) is not None:
        return _read_slice(data, suffix, shown)
    image = read_image(data, LIMITS, shown)
    return Picture(image.pixels, shown, data, image.kind, image.profile, image.spacing)


def session_of(images: Sequence[Path]) -> Session:
    """Return a session on one image, a moving and a fixed image, or by default the example; ArgumentError for more."""
    if not images:
        return example()
    if len(images) > 2:
        raise ArgumentError(f"{len(images)} images were given", "give one, or a moving and a fixed one")
    pictures = []
    for path in images:
        try:
            with path.open("rb") as file:
                data = file.read(LIMITS.bytes + 1)
        except (OSError, ValueError) as error:
            raise ImageError(f"{path} cannot be read ({getattr(error, 'strerror', error)})", "give an image") from error
        pictures.append(picture_from(data, path.name))
    return Session(pictures[0], pictures[1] if len(pictures) == 2 else None)


def example() -> Session:
    """Return a session on drawings of two fishes; the sunfish is the porcupine fish in curved coordinates."""
    moving = picture_from((_EXAMPLE / "moving.png").read_bytes(), "porcupine fish.png")
    fixed = picture_from((_EXAMPLE / "fixed.png").read_bytes(), "sunfish.png")
    landmarks = parse_landmarks([("landmarks.csv", (_EXAMPLE / "landmarks.csv").read_bytes())])
    return Session(moving, fixed, Work(pairs_of(landmarks, 1)))


def in_order(files: Files) -> tuple[Files, list[str]]:
    """Return one or two landmark files, the moving file first, and remarks for the visitor about the order.

    The order changes only if words such as "fixed" in the names of files require this. Raises PointsError for a single
    file with the points of one image.
    """
    if len(files) == 1:
        name, data = files[0]
        begin = data[:2000].decode("utf-8-sig", errors="replace")
        formats = [form for form in FORMATS.values() if name.lower().endswith(form.suffixes) and form.recognises(begin)]
        if formats and all(form.files == 2 for form in formats):
            remedy = "choose the moving and the fixed file together, holding Ctrl (or Cmd) while clicking the second"
            raise PointsError(f"{name} has the points of one image only", remedy)
    if len(files) != 2:
        return files, []
    mentioned = []  # "moving" or "fixed" for each name; empty if a name mentions neither or both
    for name, _ in files:
        sides = [side for side, words in _SIDES.items() if any(word in name.lower() for word in words)]
        mentioned.append(sides[0] if len(sides) == 1 else "")
    first, second = mentioned
    decided = first != second
    ordered = files[::-1] if decided and (first == "fixed" or second == "moving") else files
    moving, fixed = (name for name, _ in ordered)
    why = "in the order in which they came; rename them to contain moving and fixed"
    if decided:
        why = "as their names say"
    return ordered, [f"{moving} was taken for the moving image and {fixed} for the fixed one, {why}"]


def _volume_suffix(data: bytes) -> str | None:
    """Return the suffix that SimpleITK needs for a volume file with these bytes; None for other kinds of files."""
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


def _read_slice(data: bytes, suffix: str, name: str) -> Picture:
    """Return the single slice of a file in a format of volumes.

    Raises ImageError for volumes, for files that name other files, for more pixels than LIMITS allow, for unsupported
    samples and for damaged files; ExtraError if SimpleITK is missing.
    """
    if suffix == ".mha":
        _, *values = data.split(b"ElementDataFile")  # all occurrences, since the first may be in a comment
        is_complete = all(_METAIMAGE_LOCAL.match(value[:100]) for value in values)
    else:
        is_complete = suffix != ".nrrd" or _NRRD_OTHER_FILE.search(_nrrd_header(data)) is None
    if not is_complete:
        raise ImageError(f"{name} names another file for its samples", "save it as one file: .nrrd, .mha or .nii")
    itk = library(*ITK)
    with tempfile.TemporaryDirectory(prefix="codegen-") as folder:
        path = Path(folder) / f"image{suffix}"
        path.write_bytes(data)
        with library_errors(name), silent():
            reader = itk.ImageFileReader()
            reader.SetFileName(str(path))
            reader.ReadImageInformation()
            size = reader.GetSize()
            text = " x ".join(map(str, size))
            axes = [k for k, length in enumerate(size) if length > 1]
            if len(axes) > 2:
                remedy = "save one slice as a file of its own, or give codegen warp the volumes"
                raise ImageError(f"{name} is a volume ({text} voxels), and the page is for pictures", remedy)
            column, row = axes if len(axes) == 2 else (0, 1)
            if size[column] * size[row] > LIMITS.pixels:
                raise ImageError(f"{name} has {text} pixels, more than {LIMITS.pixels}", "give a smaller image")
            components = reader.GetNumberOfComponents()
            if components not in (1, 3, 4):
                finding = f"{name} has {components} numbers in each pixel"
                raise ImageError(finding, "give grey, RGB or RGB with opacity")
            require_whole(path, reader, name)
            samples = itk.GetArrayFromImage(reader.Execute())
    if samples.dtype not in SAMPLES:
        remedy = "save it with 8 or 16-bit integers or 32-bit floats"
        raise ImageError(f"{name} holds samples of {samples.dtype}", remedy)
    pixels = samples.reshape(size[row], size[column], *samples.shape[reader.GetDimension() :])
    spacing, edges = _spacing(data, suffix, reader, column, row), _edges(data, suffix, reader, column, row)
    return Picture(np.ascontiguousarray(pixels), name, data, _KINDS[suffix], None, spacing, edges)


def _nrrd_header(data: bytes) -> bytes:
    """Return the header of an NRRD file, which ends at an empty line."""
    return re.split(rb"\r?\n\r?\n", data, maxsplit=1)[0]


def _edges(data: bytes, suffix: str, reader: VolumeReader, column: int, row: int) -> Edges | None:
    """Return the patient's sides at the left, right, upper and lower edge; None if the file has no orientation."""
    dimension = reader.GetDimension()
    # The header is searched, because SimpleITK returns a default orientation if the file has none.
    if suffix.startswith(".nii"):
        is_oriented = any(int(float(reader.GetMetaData(key))) for key in ("qform_code", "sform_code"))
    elif suffix == ".nrrd":
        is_oriented = _NRRD_SPACE.search(_nrrd_header(data)) is not None
    else:
        is_oriented = b"TransformMatrix" in data[:4096]
    if dimension < 3 or not is_oriented:
        return None
    cosines = np.array(reader.GetDirection()).reshape(dimension, dimension)[:3]
    right, lower = cosines[:, column], cosines[:, row]
    return _patient_side(-right), _patient_side(right), _patient_side(-lower), _patient_side(lower)


def _patient_side(direction: NDArray[np.float64]) -> str:
    """Return the letters of the patient's sides to which a direction in LPS points, such as "LA", the nearest first."""
    order = np.argsort(-np.abs(direction), kind="stable")
    letters = ("RL", "AP", "IS")
    return "".join(letters[k][int(direction[k] > 0.0)] for k in order if abs(direction[k]) >= OBLIQUE)


def _spacing(data: bytes, suffix: str, reader: VolumeReader, column: int, row: int) -> Spacing | None:
    """Return the size of a pixel; None for 1 by 1 without a unit, which programs write for an unknown size."""
    x, y = (float(reader.GetSpacing()[axis]) for axis in (column, row))
    unit = ""
    if suffix.startswith(".nii"):
        code = int(reader.GetMetaData("xyzt_units")) & 7
        unit = "mm" if code else ""
        if code == _MICROMETRES:  # SimpleITK converts them to millimetres
            x, y, unit = 1e3 * x, 1e3 * y, "µm"
    elif suffix == ".nrrd":
        line = _NRRD_UNIT.search(_nrrd_header(data))
        unit = unit_name(line[1].decode("utf-8", errors="replace")) if line else ""
    if not unit and x == y == 1.0:
        return None
    spacing = Spacing(x, y, unit or "mm")
    return spacing if spacing.is_plausible else None


MOST_WORKS = 50  # largest number of works that are kept; older works are deleted
PROBE = 4096  # number of bytes that are written to test that a folder is writable
TOKEN = re.compile(r"[0-9a-f]{32}")
DIGEST = re.compile(r"[0-9a-f]{64}")


def default_folder() -> Path:
    """Return the folder of works: $CODEGEN_STATE_DIR, or by default a folder in the state directory of the user."""
    given = os.environ.get("CODEGEN_STATE_DIR")
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    return Path(given) if given else state / "codegen" / "app"


def new_token() -> str:
    """Return a random token for the name of a work."""
    return secrets.token_hex(16)


class OtherWriterError(CodegenError):
    """Raised if another server has changed the same work since it was last read or written."""


@dataclass(frozen=True)
class Saved:
    """A work to be saved, or a saved work; `heard` maps every tab to the number of its last edit in this work.

    `edition` is a random text that changes with every save, so that changes by another server are detected.
    """

    moving: Picture
    fixed: Picture | None
    work: Work
    heard: dict[str, int]
    edition: str


@dataclass(frozen=True)
class Store:
    """The folder of works; nothing outside the folder is read or written."""

    folder: Path

    def require_writable(self) -> None:
        """Raise FileError, with the option that selects another folder, if works cannot be saved in this folder."""
        remedy = "choose another folder with --state, or $CODEGEN_STATE_DIR"
        try:
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            with tempfile.TemporaryFile(dir=self.folder) as probe:
                probe.write(bytes(PROBE))
        except OSError as error:
            raise refused(error, self.folder, remedy) from error

    def save(self, token: str, saved: Saved) -> Saved:
        """Write a work and its new images, and return the work with its new edition.

        Raises OtherWriterError if the edition in the file is not `saved.edition`, and FileError if the file system
        refuses. After an error the file is unchanged.
        """
        path = self._path(token)
        if path is None:
            return saved
        with suppress(OSError):  # writing a file reports a missing folder
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        try:
            edition = str(json.loads(path.read_text())["edition"])
        except (OSError, ValueError, KeyError, TypeError):  # the file is missing or not readable
            edition = ""
        if edition and edition != saved.edition:
            finding = "another codegen app has changed this work meanwhile"
            raise OtherWriterError(finding, "both states are kept, this one under a new address")
        labels: list[dict[str, str] | None] = []
        for picture in (saved.moving, saved.fixed):
            labels.append(None if picture is None else {"digest": picture.digest, "name": picture.name})
            if picture is not None and picture.source and not (self.folder / picture.digest).exists():
                with replacing(self.folder / picture.digest) as temporary:
                    temporary.write_bytes(picture.source)
        written = replace(saved, edition=secrets.token_hex(8))
        images = {"moving": labels[0], "fixed": labels[1], "heard": saved.heard, "edition": written.edition}
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(as_record(saved.work) | images))
        # Delete the oldest works, and images that no work uses.
        with suppress(OSError, ValueError):
            works = sorted(self.folder.glob("*.json"), key=lambda path: path.stat().st_mtime, reverse=True)
            if len(works) > MOST_WORKS:
                texts = "".join(path.read_text() for path in works[:MOST_WORKS])
                images_of_none = [p for p in self.folder.iterdir() if DIGEST.fullmatch(p.name) and p.name not in texts]
                for path in (*works[MOST_WORKS:], *images_of_none):
                    path.unlink(missing_ok=True)
        return written

    def load(self, token: str) -> Saved | None:
        """Return the work with this token; None if it is missing or not readable."""
        path = self._path(token)
        if path is None or not path.is_file():
            return None
        try:
            record = json.loads(path.read_text())
            pictures: list[Picture | None] = []
            for label in (record["moving"], record["fixed"]):
                if label is not None and not DIGEST.fullmatch(str(label["digest"])):
                    return None
                data = None if label is None else (self.folder / str(label["digest"])).read_bytes()
                pictures.append(None if data is None else picture_from(data, str(label["name"])))
            moving, fixed = pictures
            if moving is None:
                return None
            heard = {str(client): int(number) for client, number in record["heard"].items()}
            return Saved(moving, fixed, from_record(record), heard, str(record["edition"]))
        except (OSError, ValueError, KeyError, TypeError, AttributeError, CodegenError):
            return None

    def _path(self, token: str) -> Path | None:
        return self.folder / f"{token}.json" if TOKEN.fullmatch(token) else None
