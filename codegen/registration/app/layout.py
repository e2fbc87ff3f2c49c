"""How the page is laid out: figures beside each other, or one below the other on narrow windows."""

from __future__ import annotations

from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING

import panel as pn

if TYPE_CHECKING:
    from codegen.registration.app.view import View

STYLE = (files("codegen.registration.app") / "style.css").read_text()
HELP = (
    "<b>Click</b> in either image to add a pair, <b>drag</b> its points to the same feature in both images. "
    "The moving image is warped onto the fixed one, never folding. "
    "<kbd>Ctrl</kbd>+<kbd>Z</kbd> undo, <kbd>Ctrl</kbd>+<kbd>Shift</kbd>+<kbd>Z</kbd> redo, <kbd>Delete</kbd> the "
    "highlighted pair, <kbd>Ctrl</kbd>+wheel zooms."
)
HELP_ALONE = "Click to add a point, then <b>drag it in the right-hand picture</b> and see the image follow. " + HELP[-150:]


class Layout:
    """The arrangement of a view's widgets, and the places for messages."""

    def __init__(self, view: View) -> None:
        c = view.controls
        self._message = pn.pane.HTML("", css_classes=["message"], visible=False, sizing_mode="stretch_width", margin=0)
        self._status = pn.pane.HTML("", css_classes=["status"], margin=0)
        self._help = pn.pane.HTML(HELP, css_classes=["help"], sizing_mode="stretch_width", margin=0)
        self._canvases = pn.FlexBox(css_classes=["canvases"], sizing_mode="stretch_width", margin=0, gap="12px")
        title = pn.pane.HTML("<h1>Image registration by landmarks</h1>", margin=0)
        header = _bar(title, self._status, justify_content="space-between")
        opening = _bar(*view.openers.values(), view.load_landmarks, c.example)
        editing = _bar(c.undo, c.redo, c.delete, c.clear)
        looking = _bar(c.mode, c.grid, c.points, c.live)
        saving = _bar(c.save_image, c.save_field, c.save_gif, c.save_landmarks, c.format)
        settings = _bar(c.align, c.sigma, c.scheme, c.interpolation, align_items="end")
        left = _card("Pairs", editing, pn.pane.Bokeh(c.table, sizing_mode="stretch_width", margin=0), wide=True)
        right = _card("View", looking, c.time)
        settings_card = _card("Registration", settings)
        saving_card = _card("Download", saving)
        lower = pn.FlexBox(
            left, pn.Column(right, settings_card, saving_card, css_classes=["stack"], margin=0),
            css_classes=["lower"], gap="12px", sizing_mode="stretch_width", margin=0,
        )  # fmt: skip
        self.root = pn.Column(
            view.browser, header, opening, self._help, self._message, self._canvases, lower, css_classes=["page"],
            sizing_mode="stretch_width", margin=0, stylesheets=[STYLE],
        )  # fmt: skip

    def show_canvases(self, view: View) -> None:
        """Put figures for the present images into the page."""
        alone = view.session.fixed is None
        moving, fixed = view.session.moving, view.session.picture("fixed")
        shown = [_figure(f"Moving: {moving.name}", _extent(moving.shape), view.canvases["moving"].figure)]
        if not alone:
            shown.append(_figure(f"Fixed: {fixed.name}", _extent(fixed.shape), view.canvases["fixed"].figure))
        shown.append(_figure("Warped: moving to fixed", "drag points here, too", view.result.figure))
        self._canvases.objects = shown
        self._help.object = HELP_ALONE if alone else HELP

    def message(self, text: str) -> None:
        """Say what went wrong, or nothing any more."""
        self._message.object = f'<div role="alert">{escape(text)}</div>' if text else ""
        self._message.visible = bool(text)

    def working(self, text: str) -> None:
        """Say what is being done."""
        self._status.object = f'<span class="busy">{escape(text)} …</span>' if text else self._status.object

    def status(self, view: View) -> None:
        """One line on the present registration."""
        shown, certified = view.shown, view.certified
        if shown is None or shown.registration is None:
            self._status.object = "<span>No pairs yet: click in an image</span>"
            return
        registration = shown.registration
        parts = [f"{len(registration.pairs)} pairs", f"{registration.steps} steps"]
        parts.append(f"residual ≤ {registration.residuals.max():.2g} px")
        if certified is not None and certified.revision == view.session.revision:
            verdict = "no folding" if certified.folded == 0 else f"folds at {certified.folded} pixels"
            kind = "good" if certified.folded == 0 else "bad"
            parts.append(f"areas × {certified.det_min:.3g} to {certified.det_max:.3g}")
            parts.append(f"round trip {certified.round_trip:.0e} px")
            parts.insert(0, f'<b class="{kind}">{verdict}</b>')
        self._status.object = "<span>" + " · ".join(parts) + "</span>"


def _bar(*widgets: object, **values: object) -> pn.FlexBox:
    return pn.FlexBox(*widgets, gap="8px", margin=0, sizing_mode="stretch_width", css_classes=["bar"], **values)


def _card(title: str, *contents: object, wide: bool = False) -> pn.Column:
    heading = pn.pane.HTML(f"<h2>{escape(title)}</h2>", margin=0)
    return pn.Column(heading, *contents, css_classes=["card", "wide" if wide else "narrow"], margin=0)


def _figure(title: str, note: str, figure: object) -> pn.Column:
    heading = pn.pane.HTML(f"<h2>{escape(title)} <small>{escape(note)}</small></h2>", margin=0)
    picture = pn.pane.Bokeh(figure, sizing_mode="scale_width", margin=0)
    return pn.Column(heading, picture, css_classes=["card", "figure"], margin=0)


def _extent(shape: tuple[int, int]) -> str:
    return f"{shape[1]} × {shape[0]} px"
