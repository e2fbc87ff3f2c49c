"""The buttons, choices and table of the page."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import numpy as np
import pandas as pd
import panel as pn
from numpy.typing import NDArray

from codegen.registration.app.result import MODES
from codegen.registration.app.state import Work
from codegen.registration.formats import FORMATS
from codegen.registration.solver import DEFAULT_SCHEME

ALIGNMENTS = {"similarity": "similarity", "affine": "affine", "none": "none"}
SCHEMES = tuple(dict.fromkeys((DEFAULT_SCHEME, "midpoint", "rk4", "explicit-euler")))
STYLE = (files("codegen.registration.app") / "style.css").read_text()
_TABLE_STYLE = r"""
.tabulator { font-size: 12px; border: 1px solid #d7dde3; }
.tabulator-row .tabulator-cell { font-size: 12px; }
.tabulator .tabulator-header .tabulator-col { text-align: center; }
.tabulator .tabulator-header .tabulator-col .tabulator-col-content { padding: 4px; }
.tabulator .tabulator-header .tabulator-col .tabulator-col-title { font-size: 11px; padding-right: 0 !important; }
.tabulator .tabulator-header .tabulator-col .tabulator-col-content .tabulator-col-sorter { display: none !important; }
.tabulator .tabulator-header .tabulator-col[aria-sort="ascending"] .tabulator-col-title::after { content: " \25B4"; }
.tabulator .tabulator-header .tabulator-col[aria-sort="descending"] .tabulator-col-title::after { content: " \25BE"; }
.tabulator-row .tabulator-cell { padding: 3px 5px; height: 24px; min-height: 24px; }
.tabulator-row { min-height: 24px; }
.tabulator-row.tabulator-selected { background: #cfe5f5; font-weight: 600; }
"""
INTERPOLATIONS = ("linear", "nearest", "cubic")


def button(name: str, hint: str = "", **values: Any) -> pn.widgets.Button:
    """A plain button whose hint is shown when the mouse rests on it."""
    return pn.widgets.Button(label=name, description=hint or None, margin=0, stylesheets=[STYLE], **values)


class Controls:
    """All widgets, without what they do."""

    def __init__(self) -> None:
        self.undo = button("Undo", "Ctrl+Z")
        self.redo = button("Redo", "Ctrl+Shift+Z")
        self.delete = button("Delete pair", "Delete: the pair that is highlighted")
        self.clear = button("Delete all")
        self.example = button("Example", "Two drawn fishes, with their landmarks")
        self.mode = pn.widgets.RadioButtonGroup(options=list(MODES), value=MODES[0], margin=0, stylesheets=[STYLE])
        self.grid = pn.widgets.Checkbox(label="Grid", value=True, margin=(2, 10, 2, 0), stylesheets=[STYLE])
        self.points = pn.widgets.Checkbox(label="Points", value=True, margin=(2, 10, 2, 0), stylesheets=[STYLE])
        self.live = pn.widgets.Checkbox(
            label="Solve while dragging", value=True, margin=(2, 10, 2, 0), stylesheets=[STYLE]
        )
        self.time = pn.widgets.FloatSlider(
            label="Time along the flow", start=0.0, end=1.0, value=1.0,
            step=0.02, margin=0, sizing_mode="stretch_width", stylesheets=[STYLE],
        )  # fmt: skip
        narrow = {"margin": 0, "width": 145, "stylesheets": [STYLE]}
        self.align = pn.widgets.Select(label="Alignment first", options=ALIGNMENTS, **narrow)
        self.sigma = pn.widgets.FloatInput(label="May miss by, pixels", value=0.0, start=0.0, step=0.5, **narrow)
        self.choose = button("Choose it", "Take the distance with which landmarks that are left out are met best")
        self.scheme = pn.widgets.Select(label="Scheme", options=list(SCHEMES), **narrow)
        self.interpolation = pn.widgets.Select(label="Interpolation", options=list(INTERPOLATIONS), **narrow)
        self.save_image = button("Warped image")
        self.save_field = button("Field", "The displacement field, from fixed to moving, as .npz")
        self.save_gif = button("Animated GIF")
        self.save_landmarks = button("Landmarks")
        self.format = pn.widgets.Select(
            options={form.title: name for name, form in FORMATS.items()}, **narrow | {"width": 200}
        )
        self.table = _table()


def _table() -> pn.widgets.Tabulator:
    right = {"type": "money", "precision": 1, "thousand": ""}
    fine = {"type": "money", "precision": 2, "thousand": ""}
    places = ("moving_x", "moving_y", "fixed_x", "fixed_y")
    errors = ("residual", "left_out")
    titles = dict(zip(places, "xyxy")) | {"number": "#", "residual": "residual", "left_out": "left out"}
    groups = {"moving": ["moving_x", "moving_y"], "fixed": ["fixed_x", "fixed_y"], "error": list(errors)}
    return pn.widgets.Tabulator(
        table_rows(Work(), None, None),
        show_index=False, disabled=True, selectable=1, height=236, sizing_mode="stretch_width", layout="fit_columns",
        titles=titles, groups=groups, theme="simple",
        formatters=dict.fromkeys(places, right) | dict.fromkeys(errors, fine),
        text_align=dict.fromkeys((*places, *errors), "right"), margin=0, pagination=None, header_filters=False,
        widths={"number": 44, "name": 90}, hidden_columns=["name"],
        configuration={"columnDefaults": {"resizable": False, "minWidth": 56}}, stylesheets=[_TABLE_STYLE],
    )  # fmt: skip


def table_rows(work: Work, residuals: NDArray[np.float64] | None, left_out: NDArray[np.float64] | None) -> pd.DataFrame:
    """The table; errors that are not known, or belong to other pairs, are left open.

    Whatever is known, columns keep their types: with others the browser would build the table anew, and while it does,
    Panel 1.9 may wait for that in a loop without end.
    """
    count = len(work.pairs)
    moving = np.array([pair.moving for pair in work.pairs]).reshape(-1, 2)
    fixed = np.array([pair.fixed for pair in work.pairs]).reshape(-1, 2)

    def known(errors: NDArray[np.float64] | None) -> pd.Series[Any]:
        return pd.Series(errors if errors is not None and len(errors) == count else [None] * count, dtype=object)

    return pd.DataFrame(
        {
            "number": np.arange(1, count + 1), "name": pd.Series([pair.name for pair in work.pairs], dtype=object),
            "moving_x": moving[:, 0], "moving_y": moving[:, 1], "fixed_x": fixed[:, 0], "fixed_y": fixed[:, 1],
            "residual": known(residuals), "left_out": known(left_out),
        }
    )  # fmt: skip
