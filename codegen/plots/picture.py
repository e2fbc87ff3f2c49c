"""Pictures as notebooks show them and as files: a figure of matplotlib, and a film."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from codegen.errors import ArgumentError
from codegen.files import replacing

_DPI = 110


@dataclass(frozen=True, eq=False)
class Picture:
    """A `figure` of matplotlib with its style, which a notebook shows; `save` writes it to a file."""

    figure: Figure
    _style: Mapping[Any, Any]

    def save(self, path: Path | str) -> None:
        """Write the figure to a file, .png, .pdf or .svg; ArgumentError for another ending."""
        if Path(path).suffix.lower() not in (".png", ".pdf", ".svg"):
            raise ArgumentError(f"{path}: unknown kind of picture", "let it end in .png, .pdf or .svg")
        metadata = {"Date": None} if Path(path).suffix.lower() == ".svg" else None
        with matplotlib.rc_context(dict(self._style)), replacing(Path(path)) as temporary:
            self.figure.savefig(temporary, dpi=150, metadata=metadata)

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        with matplotlib.rc_context(dict(self._style)):
            self.figure.savefig(file, format="png", dpi=_DPI)
        return file.getvalue()


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
        from html import escape

        return f'<img alt="{escape(self.title)}" src="data:image/gif;base64,{base64.b64encode(self.data).decode()}">'
