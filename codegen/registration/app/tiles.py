"""Squares of an image at the size at which a screen shows it, as PNG files."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

from codegen.registration.app.picture import Picture

SIDE = 512
"""Pixels along each side of a tile; those at the right and at the lower edge have what is left."""


def tile(picture: Picture, level: int, column: int, row: int) -> bytes | None:
    """A tile of one of the picture's levels, counted from the top left; None where there is none."""
    if not 0 <= level < len(picture.levels) or min(column, row) < 0:
        return None
    top, left = row * SIDE, column * SIDE
    part = picture.levels[level][top : top + SIDE, left : left + SIDE]
    if not part.size:
        return None
    out = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(part)).save(out, "PNG", compress_level=1)
    return out.getvalue()
