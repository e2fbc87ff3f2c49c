"""The buttons, choices and table of the page."""

from __future__ import annotations

from typing import Any

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource, DataTable, NumberFormatter, StringFormatter, TableColumn
from numpy.typing import NDArray

from codegen.registration.app.result import MODES
from codegen.registration.app.state import Work
from codegen.registration.formats import FORMATS

ALIGNMENTS = {"similarity (turn, shift, scale)": "similarity", "affine": "affine", "none": "none"}
SCHEMES = ("midpoint", "gauss-4", "explicit-euler")
INTERPOLATIONS = ("linear", "nearest", "cubic")


def button(name: str, hint: str = "", **values: Any) -> pn.widgets.Button:
    """A plain button whose hint is shown when the mouse rests on it."""
    return pn.widgets.Button(name=name, description=hint or None, margin=0, height=32, **values)


class Controls:
    """All widgets, without what they do."""

    def __init__(self) -> None:
        self.undo = button("Undo", "Ctrl+Z")
        self.redo = button("Redo", "Ctrl+Shift+Z")
        self.delete = button("Delete pair", "Delete: the pair that is highlighted")
        self.clear = button("Delete all")
        self.example = button("Example", "Two drawn fishes, with their landmarks")
        self.mode = pn.widgets.RadioButtonGroup(options=list(MODES), value=MODES[0], margin=0, height=32)
        self.grid = pn.widgets.Checkbox(name="Grid", value=True, margin=(6, 0))
        self.points = pn.widgets.Checkbox(name="Points", value=True, margin=(6, 0))
        self.live = pn.widgets.Checkbox(name="Solve while dragging", value=True, margin=(6, 0))
        self.time = pn.widgets.FloatSlider(
            name="Time along the flow: 0 is the moving image, 1 the warped one", start=0.0, end=1.0, value=1.0,
            step=0.02, margin=0, sizing_mode="stretch_width", min_width=200,
        )  # fmt: skip
        narrow = {"margin": 0, "width": 150}
        self.align = pn.widgets.Select(name="Alignment before the flow", options=ALIGNMENTS, margin=0, width=200)
        self.sigma = pn.widgets.FloatInput(name="Landmarks may miss by, px", value=0.0, start=0.0, step=0.5, **narrow)
        self.scheme = pn.widgets.Select(name="Scheme", options=list(SCHEMES), **narrow)
        self.interpolation = pn.widgets.Select(name="Interpolation", options=list(INTERPOLATIONS), **narrow)
        self.save_image = button("Warped image")
        self.save_field = button("Displacement field")
        self.save_gif = button("Animated GIF")
        self.save_landmarks = button("Landmarks")
        self.format = pn.widgets.Select(
            options={form.title: name for name, form in FORMATS.items()}, margin=0, width=190, height=32
        )
        self.rows = ColumnDataSource({name: [] for name in ("label", "mx", "my", "fx", "fy", "residual", "left_out")})
        self.table = _table(self.rows)


def _table(rows: ColumnDataSource) -> DataTable:
    number = NumberFormatter(format="0.0", text_align="right", nan_format="–")
    fine = NumberFormatter(format="0.00", text_align="right", nan_format="–")
    titles = {"mx": "moving x", "my": "moving y", "fx": "fixed x", "fy": "fixed y"}
    columns = [TableColumn(field="label", title="pair", width=60, formatter=StringFormatter(font_style="bold"))]
    columns += [TableColumn(field=name, title=title, width=72, formatter=number) for name, title in titles.items()]
    columns.append(TableColumn(field="residual", title="residual", width=72, formatter=fine))
    columns.append(TableColumn(field="left_out", title="left out", width=72, formatter=fine))
    return DataTable(
        source=rows, columns=columns, index_position=None, height=230, sizing_mode="stretch_width", row_height=24,
        autosize_mode="fit_viewport", sortable=True, reorderable=False,
    )  # fmt: skip


def table_rows(
    work: Work, residuals: NDArray[np.float64] | None, left_out: NDArray[np.float64] | None
) -> dict[str, Any]:
    """The columns of the table; errors that are not known, or belong to other pairs, are left open."""
    count = len(work.pairs)
    unknown = np.full(count, np.nan)
    moving = np.array([pair.moving for pair in work.pairs]).reshape(-1, 2)
    fixed = np.array([pair.fixed for pair in work.pairs]).reshape(-1, 2)
    return {
        "label": [pair.name if pair.name and len(pair.name) > 3 else str(k + 1) for k, pair in enumerate(work.pairs)],
        "mx": moving[:, 0],
        "my": moving[:, 1],
        "fx": fixed[:, 0],
        "fy": fixed[:, 1],
        "residual": residuals if residuals is not None and len(residuals) == count else unknown,
        "left_out": left_out if left_out is not None and len(left_out) == count else unknown,
    }
