"""How the page is laid out: figures beside each other, or one below the other on narrow windows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import panel as pn

from codegen.registration.app.controls import STYLE, Controls

if TYPE_CHECKING:
    from codegen.registration.app.canvas import Canvas
    from codegen.registration.app.session import Session

_KEYS = (
    "<kbd>Ctrl Z</kbd> undo, <kbd>Ctrl Shift Z</kbd> redo, <kbd>Delete</kbd> removes the chosen pair, "
    "<kbd>Ctrl</kbd> + wheel zooms, dragging beside points shifts."
)
HELP = f"<p><b>Click</b> in either image to add a pair, <b>drag</b> both points to the same feature. {_KEYS}</p>"
HELP_ALONE = f"<p><b>Click</b> to add a point, then <b>drag</b> it in the warped image, which follows. {_KEYS}</p>"


class Layout:
    """The arrangement of a view's widgets, and the places for messages."""

    def __init__(
        self,
        controls: Controls,
        canvases: Mapping[str, Canvas],
        openers: Iterable[pn.viewable.Viewable],
        browser: pn.viewable.Viewable,
    ) -> None:
        """Lay out `controls`, `canvases` by name, buttons that open files, and what talks to the browser."""
        c = controls
        self._message = _html("", visible=False, sizing_mode="stretch_width")
        self._status = _html("")
        self._help = _html(HELP, sizing_mode="stretch_width")
        self._note = _html("", visible=False)
        self._legend = _html("", visible=False, sizing_mode="stretch_width")
        self._titles = {name: _html("", sizing_mode="stretch_width") for name in canvases}
        self._titles["result"].object = _title("Warped", "moving to fixed; points can be dragged here, too")
        self._figures = {name: _figure(self._titles[name], canvas.figure) for name, canvas in canvases.items()}
        self._figures["result"].append(self._legend)
        header = _bar(_html("<h1>Image registration by landmarks</h1>"), self._status, justify_content="space-between")
        opening = _bar(*openers, c.example)
        left = _card("Pairs, in pixels", _bar(c.undo, c.redo, c.delete, c.clear), c.table, self._note, kind="wide")
        saving = (_bar(c.save_image, c.save_gif, c.save_field), _bar(c.save_landmarks, c.format))
        looking = (_bar(c.mode), _bar(c.grid, c.points, c.live), c.time)
        middle = _stack(_card("View", *looking), _card("Download", *saving))
        methods = _bar(c.align, c.scheme, c.interpolation)
        distances = _box(c.sigma, c.choose, gap="6px", align_items="end")
        right = _stack(_card("Registration", methods, distances))
        lower = _box(left, middle, right, gap="10px")
        self.root = pn.Column(
            browser, header, opening, self._help, self._message, _box(*self._figures.values(), gap="10px"), lower,
            css_classes=["page"], sizing_mode="stretch_width", stylesheets=[STYLE],
        )  # fmt: skip

    def show_images(self, session: Session) -> None:
        """Name the present images above their figures, and hide that of the fixed image where there is none."""
        alone = session.fixed is None
        moving, fixed = session.moving, session.picture("fixed")
        self._titles["moving"].object = _title(f"Moving: {moving.name}", _extent(moving.shape))
        self._titles["fixed"].object = _title(f"Fixed: {fixed.name}", _extent(fixed.shape))
        self._figures["fixed"].visible = not alone
        for name in ("moving", "result"):
            self._figures[name].css_classes = ["card", "figure", *(["alone"] if alone else [])]
        self._help.object = HELP_ALONE if alone else HELP

    def message(self, text: str, wrong: bool = True) -> None:
        """Say what went wrong, or what is worth knowing, or nothing any more."""
        role = "alert" if wrong else "status"
        self._message.object = f'<div role="{role}">{escape(text)}</div>' if text else ""
        self._message.visible = bool(text)

    def legend(self, extreme: float | None) -> None:
        """What the colours of the map of areas mean, from 2^-extreme to 2^extreme; none without a map."""
        self._legend.visible = extreme is not None
        if extreme is not None:
            low, high = f"areas × {2**-extreme:.2g}", f"× {2**extreme:.2g}"
            self._legend.object = f'<div class="legend">{low} <i></i> {high}</div>'

    def note(self, text: str) -> None:
        """A remark on the pairs, or none."""
        self._note.object, self._note.visible = f"<p>{escape(text)}</p>", bool(text)

    @property
    def line(self) -> str:
        """The present line on the registration, as HTML."""
        return str(self._status.object)

    def status(self, parts: list[str], folds: bool | None = None, busy: bool = False) -> None:
        """One line on the present registration, and whether it folds if that is known; `busy` for what takes long."""
        text = " · ".join(escape(part) for part in parts)
        if busy:
            text = f'<i class="spinner"></i> {text}'
        if folds is not None:
            text = f'<b class="{"bad" if folds else "good"}">{"folds" if folds else "no folding"}</b> {text}'
        self._status.object = f'<div class="status">{text}</div>'


def _html(text: str, **values: Any) -> pn.pane.HTML:
    return pn.pane.HTML(text, margin=0, stylesheets=[STYLE], **values)


def _box(*contents: Any, **values: Any) -> pn.FlexBox:
    return pn.FlexBox(*contents, margin=0, sizing_mode="stretch_width", stylesheets=[STYLE], **values)


def _bar(*widgets: Any, **values: Any) -> pn.FlexBox:
    return _box(*widgets, gap="6px", align_items="center", css_classes=["bar"], **values)


def _card(title: str, *contents: Any, kind: str = "plain") -> pn.Column:
    heading = _html(f"<h2>{escape(title)}</h2>")
    return pn.Column(
        heading, *contents, css_classes=["card", kind], margin=0, sizing_mode="stretch_width", stylesheets=[STYLE]
    )


def _stack(*cards: Any) -> pn.Column:
    return pn.Column(*cards, css_classes=["stack"], margin=0, stylesheets=[STYLE])


def _title(title: str, note: str) -> str:
    return f"<h2>{escape(title)} <small>{escape(note)}</small></h2>"


def _figure(title: Any, figure: Any) -> pn.Column:
    picture = pn.pane.Bokeh(figure, sizing_mode="scale_width", margin=0)
    return pn.Column(title, picture, css_classes=["card", "figure"], margin=0, stylesheets=[STYLE])


def _extent(shape: tuple[int, int]) -> str:
    return f"{shape[1]} × {shape[0]} px"
