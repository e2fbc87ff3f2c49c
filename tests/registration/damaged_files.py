"""Damaged image and landmark files without end, all from one seed; run as a program it reads them and prints a record.

The record is JSON: how many files were read and refused, every error that is no CodegenError, and by how many bytes the
largest resident size of the process grew.
"""

from __future__ import annotations

import io
import json
import resource
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import SimpleITK  # noqa: F401  loaded before memory is measured, as the other libraries are
import tifffile
from landmark_samples import SAMPLES, SHAPE
from PIL import Image as Pillow
from test_images import HUGE

from codegen.errors import ImageError, PointsError
from codegen.registration.formats import parse_landmarks
from codegen.registration.formats.base import Frames
from codegen.registration.images import Limits, read_image, write_image

TOKENS = (b"nan", b"1e999", b"-", b"\0", b"9" * 5000, b"[" * 5000, b'"', b"\n", b",", b"true", b"LM=999999999",
          b"\xff\xfe", b"Infinity", b"point", b"=", b"{}", b"null", b"1_0", b"\r", b"0x10", "３".encode())  # fmt: skip


def damaged(data: bytes, random: np.random.Generator) -> bytes:
    """One file with one to five changes: cut, cut out, repeated, overwritten or with something put in."""
    for _ in range(random.integers(1, 6)):
        place, end = sorted(random.integers(0, len(data) + 1, 2))
        end = min(end, place + int(random.integers(0, 40)))
        choice = random.integers(0, 6)
        if choice == 0:
            data = data[:place]
        elif choice == 1:
            data = data[:place] + data[end:]
        elif choice == 2:
            data = data[:end] + data[place:]
        elif choice == 3:
            data = data[:place] + random.bytes(end - place) + data[end:]
        elif choice == 4:
            data = data[:place] + TOKENS[random.integers(len(TOKENS))] + data[place:]
        else:
            data = data[:place] + bytes([random.integers(256)]) + data[place + 1 :]
    return data


def landmark_files(random: np.random.Generator) -> Iterator[list[tuple[str, bytes]]]:
    """600 pairs of files: damaged samples, samples under the names of others, and random bytes."""
    samples = [[(name, text.encode()) for name, text in sample.files] for sample in SAMPLES]
    for number in range(500):
        files = samples[number % len(samples)]
        yield [(name, damaged(data, random)) for name, data in files]
    for number in range(50):
        contents = samples[number % len(samples)]
        names = samples[random.integers(len(samples))]
        yield [(name, data) for (name, _), (_, data) in zip(names, contents)]
    for number in range(50):
        names = samples[number % len(samples)]
        yield [(name, random.bytes(int(random.integers(0, 300)))) for name, _ in names]


def image_files(random: np.random.Generator) -> Iterator[tuple[str, bytes]]:
    """Images of every kind: cut at many places, damaged 40 times each, and with headers that announce too much."""
    pixels = (random.random((24, 32, 3)) * 255).astype(np.uint8)
    whole = {}
    for kind, options in (("PNG", {}), ("JPEG", {}), ("TIFF", {"compression": "tiff_lzw"})):
        file = io.BytesIO()
        Pillow.fromarray(pixels).save(file, kind, **options)
        whole[kind] = file.getvalue()
    for kind, options in (("deflate", {"compression": "zlib"}), ("tiles", {"tile": (16, 16)}), ("deep", {})):
        file = io.BytesIO()
        tifffile.imwrite(file, pixels.astype(np.uint16 if kind == "deep" else np.uint8), photometric="rgb", **options)
        whole[kind] = file.getvalue()
    file = io.BytesIO()
    Pillow.fromarray(pixels[..., 0].astype(np.uint16)).save(file, "PNG")
    whole["deep PNG"] = file.getvalue()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "deep.png"
        write_image(path, pixels.astype(np.uint16) * 200)
        whole["deep PNG in colour"] = path.read_bytes()
    for kind, data in whole.items():
        for end in np.unique(np.linspace(0, len(data) - 1, 30).astype(int)):
            yield f"{kind} cut at {end}", data[:end]
        for number in range(40):
            # Half of the damage is done to the header, where it matters most.
            begin = damaged(data[:300], random) + data[300:] if number % 2 else damaged(data, random)
            yield f"{kind} damaged {number}", begin
    for name, (data, _) in HUGE.items():
        yield name, data


def outcomes(read: Callable[[], object], name: str, expected: type[Exception], record: dict) -> None:
    """Count what happens, and keep what must not."""
    try:
        read()
    except expected as error:
        record["refused"] += 1
        if name and not str(error):
            record["untyped"].append(f"{name}: an empty message")
    except BaseException as error:  # whatever it is, it is reported
        record["untyped"].append(f"{name}: {type(error).__name__}: {error}"[:300])
    else:
        record["read"] += 1


def main() -> None:
    """Read everything and print the record."""
    random = np.random.default_rng(20)
    record = {"read": 0, "refused": 0, "untyped": []}
    frames = Frames(SHAPE, SHAPE, "left.jpg", "right.jpg")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for files in landmark_files(random):
        outcomes(lambda files=files: parse_landmarks(files, frames=frames), str(files)[:150], PointsError, record)
    landmarks = record["read"] + record["refused"]
    for name, data in image_files(random):
        outcomes(lambda data=data: read_image(data, Limits(pixels=1_000_000)), name, ImageError, record)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    json.dump({**record, "landmarks": landmarks, "grown": (after - before) * 1024}, sys.stdout)


if __name__ == "__main__":
    main()
