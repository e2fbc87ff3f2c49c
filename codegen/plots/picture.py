"""Pictures as notebooks show them and as files: a figure of matplotlib, and a film."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from codegen.errors import ArgumentError
from codegen.files import replacing
from codegen.plots.purposes import using
from codegen.plots.words import words_of

_DPI = 110
_TOLD = {".png": "Description", ".pdf": "Subject", ".svg": "Description"}
"""Kinds of pictures, and what their formats call the text that says what is shown."""


def write(figure: Figure, path: Path, style: str = "page") -> None:
    """Write a figure, with the text of what it shows, into a file whose ending matplotlib knows."""
    kind = path.suffix.lower()
    metadata: dict[str, Any] = {_TOLD[kind]: words_of(figure)} if kind in _TOLD else {}
    with using(style):
        figure.savefig(path, metadata=metadata | ({"Date": None} if kind == ".svg" else {}))


def image(data: bytes, kind: str, text: str) -> str:
    """A picture as an element of a page, with the text that stands for it."""
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    return f'<img alt="{escape(text)}" src="{source}" style="max-width:100%">'


@dataclass(frozen=True, eq=False)
class Picture:
    """A `figure` of matplotlib in its style, which a notebook shows; `save` writes it to a file."""

    figure: Figure
    style: str = "page"

    @property
    def text(self) -> str:
        """What the figure shows, in words: every panel with its quantity and its range; files have it as well."""
        return words_of(self.figure)

    def save(self, path: Path | str) -> None:
        """Write the figure to a file, .png, .pdf or .svg; ArgumentError for another ending."""
        if Path(path).suffix.lower() not in _TOLD:
            raise ArgumentError(f"{path}: unknown kind of picture", "let it end in .png, .pdf or .svg")
        with replacing(Path(path)) as temporary:
            write(self.figure, temporary, self.style)

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        with using(self.style):
            self.figure.savefig(file, format="png", dpi=_DPI)
        return file.getvalue()

    def _repr_html_(self) -> str:
        return image(self._repr_png_(), "png", self.text)


@dataclass(frozen=True, eq=False)
class Film:
    """A film of a motion: `data` are the bytes of a GIF, which a notebook shows; `save` writes it to a file."""

    data: bytes = field(repr=False)  # hundreds of kilobytes, which notebooks keep as text beside the picture
    title: str
    _written: Callable[[Path], None] = field(repr=False)

    def save(self, path: Path | str) -> None:
        """Write the film, .gif or .mp4; ArgumentError for another ending, or where ffmpeg is missing or fails."""
        path = Path(path)
        if path.suffix.lower() not in (".gif", ".mp4"):
            raise ArgumentError(f"{path}: unknown kind of film", "let it end in .gif or .mp4")
        with replacing(path) as temporary:
            if path.suffix.lower() == ".gif":
                temporary.write_bytes(self.data)
            else:
                self._written(temporary)

    def _repr_html_(self) -> str:
        return image(self.data, "gif", f"Film: {self.title}")
