"""Draws the bundled example: two fishes, of which one is the other in bent coordinates, and their landmarks.

After D'Arcy Thompson, On Growth and Form (1917), chapter 17, where the sunfish Orthagoriscus is the porcupine fish
Diodon on a grid of hyperbolas and circles. Drawn afresh from formulas; both pictures are dedicated to the public domain
(CC0 1.0). `python tests/registration/draw_example.py FOLDER` writes them again.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.interpolate import CubicSpline

Array = NDArray[np.float64]
Map = Callable[[Array], Array]
Colour = tuple[int, int, int]

SIZE = (512, 400)  # width, height in pixels
FINER = 4  # drawn at so many times the size, then averaged

# Half the body, from the snout (0) to the root of the tail (1): stations along the fish and half its depth there.
STATIONS = np.array([0.0, 0.015, 0.06, 0.15, 0.3, 0.48, 0.66, 0.82, 0.93, 1.0])
DEPTHS = np.array([0.0, 0.05, 0.12, 0.21, 0.295, 0.32, 0.27, 0.17, 0.09, 0.07])
EYE, MOUTH = (0.16, -0.075), (0.035, 0.045)


def porcupine_fish(points: Array) -> Array:
    """Pixels of the moving picture of points (along, across) in units of the body's length."""
    x, y = points.T
    return np.column_stack([62 + 330 * x, 205 + 330 * y])


def sunfish(points: Array) -> Array:
    """The same body in bent coordinates: short and ever deeper towards the tail, on arcs about the snout."""
    x, y = points.T
    deeper = 0.95 + 0.55 * np.clip(x, 0, None) ** 2
    along = 0.94 * x - 0.2 * x**2 - 0.32 * x * y**2
    return np.column_stack([78 + 372 * along, 200 + 330 * y * deeper + 14 * x * (1 - x)])


def profile(x: Array) -> Array:
    """Half the depth of the body at a station along it."""
    root = CubicSpline(np.sqrt(STATIONS), DEPTHS)
    return np.asarray(root(np.sqrt(np.clip(x, 0, 1))))


def outline(scale: float = 1.0) -> Array:
    """The closed outline of the body, shrunk across by a factor."""
    x = np.linspace(0, 1, 200) ** 2
    back = np.column_stack([x, -scale * profile(x)])
    belly = np.column_stack([x, scale * profile(x)])[::-1]
    return np.vstack([back, belly])


def fin(root: Array, tip: Array, rays: int) -> tuple[Array, list[Array]]:
    """A fin between two curves with equally many points: its outline, and its rays."""
    every = np.linspace(0, len(root) - 1, rays).astype(int)
    return np.vstack([root, tip[::-1]]), [np.vstack([root[k], tip[k]]) for k in every]


def fins() -> list[tuple[Array, list[Array]]]:
    """Tail, back, belly and breast fins."""
    s = np.linspace(0, 1, 41)
    tail = fin(
        np.column_stack([np.full(41, 0.985), 0.14 * (s - 0.5)]),
        np.column_stack([1.17 + 0.025 * np.cos(6 * np.pi * s), 0.3 * (s - 0.5)]),
        12,
    )
    x = 0.74 + 0.17 * s
    swept = np.column_stack([x + 0.08 * np.sin(np.pi * s / 2) + 0.02 * s, 0.17 * np.sin(np.pi * s) ** 0.7])
    back = fin(np.column_stack([x, -profile(x)]), np.column_stack([swept[:, 0], -profile(x) - swept[:, 1]]), 10)
    belly = fin(np.column_stack([x, profile(x)]), np.column_stack([swept[:, 0], profile(x) + swept[:, 1] * 0.9]), 10)
    angle = np.linspace(-0.75, 0.75, 41)
    breast = fin(
        np.column_stack([0.37 + 0.01 * np.cos(angle), 0.06 + 0.05 * np.sin(angle)]),
        np.column_stack([0.37 + 0.15 * np.cos(angle), 0.06 + 0.15 * np.sin(angle)]),
        9,
    )
    return [tail, back, belly, breast]


def spines() -> list[Array]:
    """Short strokes on a staggered lattice over the body."""
    strokes = []
    for row, x in enumerate(np.linspace(0.2, 0.96, 20)):
        depth = 0.9 * float(profile(np.array(x)))
        count = max(2, round(depth / 0.021))
        for y in np.linspace(-depth, depth, count) + (row % 2) * depth / count:
            clear_of_fin = np.hypot(x - 0.44, y - 0.06) > 0.1
            if abs(y) < depth and clear_of_fin and np.hypot(x - EYE[0], y - EYE[1]) > 0.07:
                strokes.append(np.array([[x, y], [x + 0.021, y + 0.012 * np.sign(y)]]))
    return strokes


def draw(place: Map, paper: Colour, body: Colour, ink: Colour) -> Image.Image:
    """One fish: every point that is drawn goes through `place`."""
    canvas = Image.new("RGB", (SIZE[0] * FINER, SIZE[1] * FINER), paper)
    pen = ImageDraw.Draw(canvas)

    def placed(points: Array) -> list[tuple[float, float]]:
        return [(float(x), float(y)) for x, y in (place(points) + 0.5) * FINER]

    def mixed(share: float) -> Colour:
        return tuple(round(share * a + (1 - share) * b) for a, b in zip(body, paper, strict=True))  # type: ignore[return-value]

    def line(points: Array, width: float) -> None:
        pen.line(placed(points), fill=ink, width=round(width * FINER), joint="curve")

    *others, breast = fins()
    for shape, rays in others:
        pen.polygon(placed(shape), fill=mixed(0.6))
        line(np.vstack([shape, shape[:1]]), 1.2)
        for ray in rays:
            line(ray, 0.8)
    for step in np.linspace(0, 1, 25):  # rounder towards the middle
        pen.polygon(placed(outline(1 - 0.75 * step)), fill=mixed(1 - 0.45 * step))
    for stroke in spines():
        line(stroke, 1.3)
    pen.polygon(placed(breast[0]), fill=mixed(0.85))
    line(np.vstack([breast[0], breast[0][:1]]), 1.2)
    for ray in breast[1]:
        line(ray, 0.8)
    gill = np.linspace(-1, 1, 40)
    line(np.column_stack([0.285 + 0.035 * (1 - gill**2), 0.02 + 0.13 * gill]), 1.6)
    line(outline(), 2.0)
    line(np.array([[0.0, 0.012], [0.02, 0.026], [0.05, 0.04], [0.075, 0.04]]), 1.8)
    turn = np.linspace(0, 2 * np.pi, 60)
    ring = np.column_stack([np.cos(turn), np.sin(turn)])
    for radius, fill in ((0.05, ink), (0.043, paper), (0.024, ink)):
        pen.polygon(placed(np.array(EYE) + radius * ring), fill=fill)
    pen.polygon(placed(np.array(EYE) + [-0.009, -0.009] + 0.008 * ring), fill=paper)
    return canvas.resize(SIZE, Image.Resampling.BOX)


def homologous() -> dict[str, tuple[float, float]]:
    """Landmarks of the body by name."""

    def back(x: float) -> tuple[float, float]:
        return x, -float(profile(np.array(x)))

    def belly(x: float) -> tuple[float, float]:
        return x, float(profile(np.array(x)))

    def tip(number: int) -> tuple[float, float]:
        x, y = fins()[number][0][-19]
        return float(x), float(y)

    return {
        "snout": (0.0, 0.0),
        "corner of the mouth": (0.075, 0.04),
        "eye": EYE,
        "upper end of the gill": (0.285, -0.11),
        "lower end of the gill": (0.285, 0.15),
        "root of the breast fin": (0.38, 0.06),
        "tip of the breast fin": (0.52, 0.06),
        "brow": back(0.15),
        "highest point of the back": back(0.48),
        "front of the back fin": back(0.74),
        "tip of the back fin": tip(1),
        "end of the back fin": back(0.91),
        "chin": belly(0.15),
        "lowest point of the belly": belly(0.48),
        "front of the belly fin": belly(0.74),
        "tip of the belly fin": tip(2),
        "end of the belly fin": belly(0.91),
        "upper tip of the tail": (1.195, -0.15),
        "middle of the tail": (1.145, 0.0),
        "lower tip of the tail": (1.195, 0.15),
    }


def main(folder: Path) -> None:
    """Write both pictures and the landmarks."""
    drawn = {
        "moving.png": draw(porcupine_fish, (250, 243, 228), (214, 152, 84), (70, 38, 18)),
        "fixed.png": draw(sunfish, (236, 243, 247), (112, 158, 190), (18, 40, 66)),
    }
    for name, image in drawn.items():
        image.quantize(64, dither=Image.Dither.NONE).convert("RGB").save(folder / name, optimize=True)
    points = np.array(list(homologous().values()))
    rows = np.round(np.hstack([porcupine_fish(points), sunfish(points)]), 1)
    text = "moving_x,moving_y,fixed_x,fixed_y\n" + "".join(",".join(f"{v:.1f}" for v in row) + "\n" for row in rows)
    (folder / "landmarks.csv").write_text(text)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
