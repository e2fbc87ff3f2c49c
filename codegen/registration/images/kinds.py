"""Kinds of image files, what is known of a file before it is decoded, and errors of decoders as ImageError."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from codegen.errors import CodegenError, ImageError

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
