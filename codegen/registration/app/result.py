"""The third figure: the warped image, and what it is compared with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.models import ColumnDataSource, CustomJS, LinearColorMapper
from numpy.typing import NDArray

from codegen.registration.app.canvas import Canvas, Points, image_source, put_image
from codegen.registration.app.picture import rgba
from codegen.registration.app.solving import Certified

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

    def __init__(self, points: Points, label: str) -> None:
        self._points_wanted = True
        self._arrived = True
        super().__init__(points, label)
        blink = CustomJS(args={"fixed": self._over, "every": BLINK_MILLISECONDS}, code=_BLINKING)
        self._over.js_on_change("tags", blink)  # tags: whether to blink, and whether to be visible otherwise

    def _between(self) -> None:
        self.over = image_source()
        self._over = self.draw_image(self.over)
        self._over.visible = False
        self.areas = image_source()
        self.mapper = LinearColorMapper(palette=diverging(), low=-1.0, high=1.0)
        self._areas = self.figure.image(
            image="image", x="x", y="y", dw="dw", dh="dh", source=self.areas, color_mapper=self.mapper, alpha=0.8
        )
        self._areas.visible = False
        self.extreme = 0.0  # the largest of |log2 det J| on the map
        self.carried = ColumnDataSource({"x": [], "y": []})
        self.figure.scatter("x", "y", source=self.carried, size=7, fill_color="#111111", line_color="#ffffff")

    def compare(self, mode: str, fixed: NDArray[np.uint8]) -> None:
        """Show the warped image in one of MODES."""
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
        arrived = time >= 1.0
        if not (arrived and self._arrived):  # otherwise there is nothing to be changed while a point is dragged
            self.carried.data = {"x": [], "y": []} if arrived else {"x": points[:, 0], "y": points[:, 1]}
        self._arrived = arrived
        self._draw_points()

    def show_points(self, wanted: bool) -> None:
        """Draw the landmarks once they have arrived, or leave the picture free of them."""
        self._points_wanted = wanted
        self._draw_points()

    def _draw_points(self) -> None:
        for renderer in self.point_renderers:
            renderer.visible = self._points_wanted and self._arrived


def _squares(shape: Sequence[int]) -> NDArray[np.bool_]:
    size = max(1, max(shape) // SQUARES)
    rows, columns = np.indices((shape[0], shape[1])) // size
    return np.asarray((rows + columns) % 2 == 1)
