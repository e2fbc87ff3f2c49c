"""The third figure: the warped image, and what it is compared with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.models import ColumnDataSource, CustomJS, LinearColorMapper
from numpy.typing import NDArray

from codegen.registration.app.canvas import Canvas, put_image
from codegen.registration.app.picture import rgba
from codegen.registration.app.solving import Certified
from codegen.registration.app.state import Side

MODES = ("Warped", "Blink", "Checkerboard", "Blend", "Areas")
SQUARES = 10
"""Squares of the checkerboard along the longer side."""
BLINK_MILLISECONDS = 700

_BLINKING = """
const [blinks, shown] = fixed.tags
clearInterval(window.__blinking)
if (blinks) window.__blinking = setInterval(() => { fixed.visible = !fixed.visible }, every)
else fixed.visible = shown
"""


ENDS = ((0, 90, 170), (247, 247, 247), (200, 85, 0))
"""Blue for smaller, white, orange for larger: the colour-blind tell them apart."""


def diverging(count: int = 129) -> list[str]:
    """So many colours between ENDS."""
    ends = np.array(ENDS, dtype=float)
    places = np.linspace(0, 2, count)
    rgb = np.column_stack([np.interp(places, [0, 1, 2], ends[:, k]) for k in range(3)]).round().astype(int)
    return ["#{:02x}{:02x}{:02x}".format(*colour) for colour in rgb]


class ResultCanvas(Canvas):
    """The frame of the fixed image: the warped image, with the fixed one or the map of det J over it."""

    def __init__(self, shape: Sequence[int], sources: dict[Side, ColumnDataSource], label: str) -> None:
        self._mode = MODES[0]
        self._fixed: NDArray[np.uint8] | None = None
        super().__init__(shape, sources, "fixed", label)
        blink = CustomJS(args={"fixed": self._over, "every": BLINK_MILLISECONDS}, code=_BLINKING)
        self._over.js_on_change("tags", blink)  # tags: whether to blink, and whether to be visible otherwise

    def _lines(self) -> None:
        self.over = ColumnDataSource({"image": [], "x": [], "y": [], "dw": [], "dh": []})
        self._over = self._draw_image(self.over)
        self._over.visible = False
        self.areas = ColumnDataSource({"image": [], "x": [], "y": [], "dw": [], "dh": []})
        self.mapper = LinearColorMapper(palette=diverging(), low=-1.0, high=1.0)
        self._areas = self.figure.image(
            image="image", x="x", y="y", dw="dw", dh="dh", source=self.areas, color_mapper=self.mapper, alpha=0.8
        )
        self._areas.visible = False
        self.extreme = 0.0  # the largest of |log2 det J| on the map
        super()._lines()
        self.carried = ColumnDataSource({"x": [], "y": []})
        dots = self.figure.scatter("x", "y", source=self.carried, size=7, fill_color="#111111", line_color="#ffffff")
        self._dots = dots

    def compare(self, mode: str, fixed: NDArray[np.uint8]) -> None:
        """Show the warped image in one of MODES."""
        self._mode = mode
        over = rgba(fixed).copy()
        if mode == "Checkerboard":
            over[..., 3] = np.where(_squares(over.shape[:2]), over[..., 3], 0)
        elif mode == "Blend":
            over[..., 3] //= 2
        laid_over = mode in ("Blink", "Checkerboard", "Blend")
        if laid_over:
            put_image(self.over, over, self.shape)
        self._over.visible = laid_over
        self._over.tags = [mode == "Blink", laid_over]
        self._areas.visible = mode == "Areas"

    def show_areas(self, certified: Certified | None) -> None:
        """Colour the map of det J, on a logarithmic scale that is the same for growth and shrinking."""
        if certified is None:
            self.areas.data = {name: [] for name in self.areas.data}
            return
        values = np.log2(np.clip(certified.areas, 1e-6, 1e6))
        self.extreme = max(0.1, float(np.abs(values).max()))
        self.mapper.update(low=-self.extreme, high=self.extreme)
        height, width = self.shape
        self.areas.data = {"image": [values], "x": [-0.5], "y": [-0.5], "dw": [width], "dh": [height]}

    def show_carried(self, points: NDArray[np.float64], time: float) -> None:
        """Small dots where landmarks are on their way; at the end the points themselves stand there."""
        between = time < 1.0
        self.carried.data = {"x": points[:, 0] if between else [], "y": points[:, 1] if between else []}
        for renderer in self.point_renderers:
            renderer.visible = not between

    def show_points(self, shown: bool) -> None:
        """Draw the landmarks, or leave the picture free of them."""
        for renderer in self.point_renderers:
            renderer.visible = shown


def _squares(shape: Sequence[int]) -> NDArray[np.bool_]:
    size = max(1, max(shape) // SQUARES)
    rows, columns = np.indices((shape[0], shape[1])) // size
    return np.asarray((rows + columns) % 2 == 1)
