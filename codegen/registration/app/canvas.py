"""One figure of the page: an image and the points on it, which can be clicked and dragged.

Figures are made once for each session and then shown other images: what the browser is told of a new figure may arrive
before the figure itself does, because Panel and Bokeh send their messages independently of each other.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from bokeh.core.properties import value
from bokeh.models import ColumnDataSource, CustomJS, PointDrawTool, Range1d, WheelZoomTool
from bokeh.plotting import figure
from numpy.typing import NDArray

from codegen.registration.app.picture import rgba
from codegen.registration.app.state import Side, Work

Lines: TypeAlias = tuple[list[NDArray[np.float64]], list[NDArray[np.float64]]]

# Okabe and Ito's colours, which the colour-blind tell apart; black, and yellow on white, are left out.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
PATIENCE = 300
"""Milliseconds after which the browser tells of a drag although what it told last has not been answered."""

_BEGUN = """
const { x_range, y_range } = figure
dragging.__ranges = [x_range.start, x_range.end, y_range.end, y_range.start]
"""
# One position is under way at a time, so that nothing piles up where the machine is slow; the newest follows an answer.
_TELL = """
const tell = () => {
  const row = dragging.__row, now = Date.now()
  if (row === undefined || !source.get_column("id")[row]) return
  dragging.__behind = now - (dragging.__reported ?? 0) < patience
  if (dragging.__behind) return
  dragging.__reported = now
  const [id, x, y] = ["id", "x", "y"].map((name) => [source.get_column(name)[row]])
  dragging.data = { id, x, y }
}
"""
# A drag of a point moves it; a drag of the empty image shifts a view that was zoomed into.
_DRAGGED = f"""
{_TELL}
if (source.selected.indices.length) {{
  dragging.__row = source.selected.indices[0]
  tell()
}} else {{
  const [left, right, top, bottom] = dragging.__ranges
  const [width] = picture.get_column("dw"), [height] = picture.get_column("dh")
  const within = (shift, low, high, least, most) => Math.min(Math.max(shift, least - low), most - high)
  const x = within(-cb_obj.delta_x * (right - left) / figure.inner_width, left, right, -0.5, width - 0.5)
  const y = within(-cb_obj.delta_y * (bottom - top) / figure.inner_height, top, bottom, -0.5, height - 0.5)
  figure.x_range.setv({{ start: left + x, end: right + x }})
  figure.y_range.setv({{ start: bottom + y, end: top + y }})
}}
"""
# The same point in the other figure moves when the image does: moving it with the mouse would cost a picture each time.
_ANSWERED = f"""
{_TELL}
if (dragging.__row !== undefined) {{
  const [id] = dragging.get_column("id"), row = twin ? Array.from(twin.get_column("id")).indexOf(id) : -1
  if (id && row >= 0) {{
    for (const name of ["x", "y"]) twin.get_column(name)[row] = dragging.get_column(name)[0]
    twin.change.emit()
  }}
  dragging.__reported = 0
  if (dragging.__behind) tell()
}}
"""
# The tool tells of the end of a drag itself; this comes after it. A point that stayed selected would be dragged along.
_RELEASED = """
dragging.__row = undefined
dragging.__reported = 0
setTimeout(() => {
  source.selected.indices = []
  released.data = { count: [released.data.count[0] + 1] }
}, 0)
"""
_CHOSEN = "setTimeout(() => { source.selected.indices = [] }, 0)"


class Points:
    """The points of one side as one figure has them: a table, and which of them is being dragged to where."""

    def __init__(self, side: Side) -> None:
        self.side = side
        columns = ("x", "y", "id", "edition", "label", "colour", "inside", "size", "rim")
        self.source = ColumnDataSource({name: [] for name in columns}, name="points")
        self.dragging = ColumnDataSource({"id": [], "x": [], "y": []})
        self.released = ColumnDataSource({"count": [0]})


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
    """A figure for images of any shape, with the points of one side, which can be drawn and dragged."""

    def __init__(self, points: Points, label: str) -> None:
        self.shape = (0, 0)
        self.figure = figure(
            x_range=Range1d(-0.5, 0.5), y_range=Range1d(0.5, -0.5), sizing_mode="scale_width", tools="",
            toolbar_location=None, min_border=0, outline_line_color="#c5ccd3", background_fill_color="#f2f4f6",
            name=label, margin=0,
        )  # fmt: skip
        self.figure.axis.visible = False
        self.figure.grid.visible = False
        self.picture = image_source({"xs": [], "ys": []})
        self.draw_image(self.picture)
        self.points = points
        self._between()
        lines = {"xs": "xs", "ys": "ys", "source": self.picture}
        self.figure.multi_line(**lines, line_color="#ffffff", line_width=2.2, line_alpha=0.55)
        self.figure.multi_line(**lines, line_color="#20303f", line_width=0.9, line_alpha=0.9)
        self._marks()

    def resize(self, shape: tuple[int, int]) -> None:
        """Make room for images of a shape (height, width), and show all of it."""
        self.shape = (int(shape[0]), int(shape[1]))
        height, width = self.shape
        self.figure.aspect_ratio = width / height
        self.figure.x_range.update(start=-0.5, end=width - 0.5)
        self.figure.y_range.update(start=height - 0.5, end=-0.5)

    def show(self, image: NDArray[np.uint8], grid: Lines = ([], [])) -> None:
        """Show another image of 8 bits, with the lines of a grid over it: lists of x and of y; all in one message."""
        put_image(self.picture, image, self.shape, xs=[_joined(grid[0])], ys=[_joined(grid[1])])

    def draw_image(self, source: ColumnDataSource) -> Any:
        """Let the figure show the image that a table holds."""
        return self.figure.image_rgba(image="image", x="x", y="y", dw="dw", dh="dh", source=source)

    def _between(self) -> None:
        """Draw more between the image and the grid."""

    def _marks(self) -> None:
        source = self.points.source
        marks = self.figure.scatter(
            "x", "y", source=source, size="size", fill_color="colour", fill_alpha="inside", line_color="colour",
            line_width=2.5,
        )  # fmt: skip
        rims = self.figure.scatter(
            "x", "y", source=source, size="size", fill_color=None, line_color="rim", line_width=1.2
        )
        text = {
            "x": "x", "y": "y", "text": "label", "source": source, "x_offset": 8, "y_offset": -5,
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
        self._follow_the_mouse()

    def _follow_the_mouse(self) -> None:
        known = {"figure": self.figure, "picture": self.picture, "source": self.points.source,
                 "dragging": self.points.dragging, "released": self.points.released, "patience": PATIENCE}  # fmt: skip
        for event, code in {"panstart": _BEGUN, "pan": _DRAGGED, "panend": _RELEASED, "tap": _CHOSEN}.items():
            self.figure.js_on_event(event, CustomJS(args=known, code=code))

    def answers(self, points: Points, twin: Points | None) -> None:
        """A new image here says that a drag has been followed, by its twin too, and that the next may be told."""
        known = {"source": points.source, "dragging": points.dragging, "patience": PATIENCE,
                 "twin": twin.source if twin else None}  # fmt: skip
        self.picture.js_on_change("data", CustomJS(args=known, code=_ANSWERED))


def put_image(source: ColumnDataSource, image: NDArray[np.uint8], shape: tuple[int, int], **more: Any) -> None:
    """Let a table for one image hold this one, stretched over an image of the given shape (height, width)."""
    packed = np.ascontiguousarray(rgba(image)).view(np.uint32)[..., 0]
    source.data = {"image": [packed], "x": [-0.5], "y": [-0.5], "dw": [shape[1]], "dh": [shape[0]], **more}


def _joined(lines: list[NDArray[np.float64]]) -> NDArray[np.float32]:
    """Coordinates of many lines as those of one with gaps, because every array makes two messages."""
    parts = [part for line in lines for part in (line, [np.nan])]
    return np.concatenate(parts).astype(np.float32) if parts else np.empty(0, np.float32)


def image_source(more: dict[str, list[Any]] | None = None) -> ColumnDataSource:
    """An empty table for one image."""
    return ColumnDataSource({"image": [], "x": [], "y": [], "dw": [], "dh": []} | (more or {}))
