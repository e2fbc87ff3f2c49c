"""One figure of the page: an image and the points on it, which can be clicked and dragged."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.core.properties import value
from bokeh.models import (
    ColumnDataSource,
    CustomJS,
    PointDrawTool,
    Range1d,
    WheelZoomTool,
)
from bokeh.plotting import figure
from numpy.typing import NDArray

from codegen.registration.app.picture import rgba
from codegen.registration.app.state import Side, Work

# Okabe and Ito's colours, which the colour-blind tell apart; black, and yellow on white, are left out.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
WHILE_DRAGGING = 40
"""Milliseconds between messages of a drag."""

_BEGUN = """
const { x_range, y_range } = figure
window.__ranges = [x_range.start, x_range.end, y_range.end, y_range.start]
"""
# A point that is dragged is told of now and then; a drag of the empty image shifts a view that was zoomed into.
_DRAGGED = """
const now = Date.now()
if (source.selected.indices.length) {
  if (now - (window.__dragged ?? 0) < every) return
  window.__dragged = now
  source.setv({ data: source.data }, { check_eq: false })
} else {
  const [left, right, top, bottom] = window.__ranges
  const within = (shift, low, high, least, most) => Math.min(Math.max(shift, least - low), most - high)
  const x = within(-cb_obj.delta_x * (right - left) / figure.inner_width, left, right, -0.5, width - 0.5)
  const y = within(-cb_obj.delta_y * (bottom - top) / figure.inner_height, top, bottom, -0.5, height - 0.5)
  figure.x_range.setv({ start: left + x, end: right + x })
  figure.y_range.setv({ start: bottom + y, end: top + y })
}
"""
# The tool tells of the end of a drag itself; this comes after it. A point that stayed selected would be dragged along.
_RELEASED = """
setTimeout(() => {
  source.selected.indices = []
  released.data = { count: [released.data.count[0] + 1] }
}, 0)
"""
_CHOSEN = "setTimeout(() => { source.selected.indices = [] }, 0)"


def point_source() -> ColumnDataSource:
    """An empty table of points."""
    columns = ("x", "y", "id", "edition", "label", "colour", "inside", "size", "rim")
    return ColumnDataSource({name: [] for name in columns}, name="points")


def point_rows(work: Work, side: Side, edition: int, selected: int | None) -> dict[str, Any]:
    """The columns of the table of points of one image."""
    pairs = work.pairs
    colours = [COLOURS[k % len(COLOURS)] for k in range(len(pairs))]
    return {
        "x": [pair.at(side)[0] for pair in pairs],
        "y": [pair.at(side)[1] for pair in pairs],
        "id": [pair.identity for pair in pairs],
        "edition": [edition] * len(pairs),
        "label": [str(k + 1) for k in range(len(pairs))],
        "colour": colours,
        "inside": [0.15 if pair.guessed == side else 0.95 for pair in pairs],
        "size": [17 if pair.identity == selected else 11 for pair in pairs],
        "rim": ["#000000" if pair.identity == selected else "#ffffff" for pair in pairs],
    }


class Canvas:
    """A figure for images of one shape (height, width); with a side, its points can be drawn and dragged."""

    def __init__(self, shape: Sequence[int], sources: dict[Side, ColumnDataSource], side: Side, label: str) -> None:
        height, width = int(shape[0]), int(shape[1])
        self.shape = (height, width)
        self.figure = figure(
            x_range=Range1d(-0.5, width - 0.5), y_range=Range1d(height - 0.5, -0.5), aspect_ratio=width / height,
            sizing_mode="scale_width", tools="", toolbar_location=None, min_border=0, outline_line_color="#c5ccd3",
            background_fill_color="#f2f4f6", name=label, margin=0,
        )  # fmt: skip
        self.figure.axis.visible = False
        self.figure.grid.visible = False
        self.image = _image_source()
        self._draw_image(self.image)
        self.source = sources[side]
        self._lines()
        self._points()

    def show(self, image: NDArray[np.uint8]) -> None:
        """Show another image, 8 bits."""
        put_image(self.image, image, self.shape)

    def show_grid(self, lines: tuple[list[Any], list[Any]]) -> None:
        """Draw the lines of a grid, lists of x and of y."""
        self.grid.data = {"xs": lines[0], "ys": lines[1]}

    def _draw_image(self, source: ColumnDataSource) -> Any:
        return self.figure.image_rgba(image="image", x="x", y="y", dw="dw", dh="dh", source=source)

    def _lines(self) -> None:
        self.grid = ColumnDataSource({"xs": [], "ys": []})
        self.figure.multi_line("xs", "ys", source=self.grid, line_color="#ffffff", line_width=2.2, line_alpha=0.55)
        self.figure.multi_line("xs", "ys", source=self.grid, line_color="#20303f", line_width=0.9, line_alpha=0.9)

    def _points(self) -> None:
        marks = self.figure.scatter(
            "x", "y", source=self.source, size="size", fill_color="colour", fill_alpha="inside", line_color="colour",
            line_width=2.5,
        )  # fmt: skip
        rims = self.figure.scatter(
            "x", "y", source=self.source, size="size", fill_color=None, line_color="rim", line_width=1.2
        )
        text = {
            "x": "x", "y": "y", "text": "label", "source": self.source, "x_offset": 8, "y_offset": -5,
            "text_font": value("Helvetica, Arial, DejaVu Sans, sans-serif"), "text_font_size": "12px",
            "text_font_style": "bold",
        }  # fmt: skip
        halo = self.figure.text(**text, text_color=None, text_outline_color="#ffffff", text_outline_width=3)
        labels = self.figure.text(**text, text_color="#111111")
        self.point_renderers = [marks, rims, halo, labels]
        for renderer in self.point_renderers:
            renderer.selection_glyph = renderer.glyph
            renderer.nonselection_glyph = renderer.glyph
        draw = PointDrawTool(
            renderers=[marks], default_overrides={"id": 0, "edition": 0, "inside": 0.95, "size": 11,
            "colour": "#444444", "rim": "#ffffff", "label": ""}, description="Click to add a pair, drag to move",
        )  # fmt: skip
        zoom = WheelZoomTool(modifiers={"ctrl": True}, description="Zoom: Ctrl + wheel")
        self.figure.add_tools(draw, zoom)
        self.figure.toolbar.active_tap = draw
        self.figure.toolbar.active_drag = draw
        self.figure.toolbar.active_scroll = zoom
        self.released = ColumnDataSource({"count": [0]})
        shape = {"figure": self.figure, "height": self.shape[0], "width": self.shape[1]}
        dragged = CustomJS(args={"source": self.source, "every": WHILE_DRAGGING, **shape}, code=_DRAGGED)
        self.figure.js_on_event("panstart", CustomJS(args={"figure": self.figure}, code=_BEGUN))
        self.figure.js_on_event("pan", dragged)
        self.figure.js_on_event(
            "panend", CustomJS(args={"source": self.source, "released": self.released}, code=_RELEASED)
        )
        self.figure.js_on_event("tap", CustomJS(args={"source": self.source}, code=_CHOSEN))


def put_image(source: ColumnDataSource, image: NDArray[np.uint8], shape: tuple[int, int]) -> None:
    """Let a table for one image hold this one, stretched over an image of the given shape (height, width)."""
    packed = np.ascontiguousarray(rgba(image)).view(np.uint32)[..., 0]
    source.data = {"image": [packed], "x": [-0.5], "y": [-0.5], "dw": [shape[1]], "dh": [shape[0]]}


def _image_source() -> ColumnDataSource:
    return ColumnDataSource({"image": [], "x": [], "y": [], "dw": [], "dh": []})
