"""What is shown of a session: figures, table, one line on the registration, and messages."""

from __future__ import annotations

import traceback
from concurrent.futures import Future
from functools import partial
from typing import Any

import numpy as np

from codegen.errors import CodegenError
from codegen.registration.app import preparing, solving
from codegen.registration.app.autosave import Store
from codegen.registration.app.canvas import Canvas, Points, point_rows
from codegen.registration.app.controls import Controls, table_rows
from codegen.registration.app.layout import Layout
from codegen.registration.app.picture import Picture
from codegen.registration.app.result import ResultCanvas
from codegen.registration.app.rows import Editions
from codegen.registration.app.session import Session
from codegen.registration.app.solving import Certified, Shown, Wanted
from codegen.registration.app.state import Side
from codegen.registration.app.worker import Deliver, Worker, delivered, slow

QUICK = ("click moving", "click fixed", "draw")
SLOW = ("save", "sigma", "warped_image", "field", "landmarks", "animation", "certify")


class Screen:
    """The parts of a page that show a session; see View for the arguments."""

    layout: Layout

    def __init__(self, session: Session, deliver: Deliver, store: Store | None, token: str) -> None:
        self.session = session
        self.deliver = deliver
        self.store, self.token = store, token
        self.worker, self.slow = Worker(deliver, QUICK), Worker(deliver, SLOW, slow)
        self.controls = Controls()
        moving, fixed, again = self.points = (Points("moving"), Points("fixed"), Points("fixed"))
        self.canvases: dict[Side, Canvas] = {"moving": Canvas(moving, "moving"), "fixed": Canvas(fixed, "fixed")}
        self.result = ResultCanvas(again, "result")
        self.editions = {points: Editions(points.side) for points in self.points}
        for points, twin in ((moving, None), (fixed, again), (again, fixed)):
            points.released.on_change("data", self._released)
            self.result.answers(points, twin)
        self._awaited: Future[None] | None = None  # the solver that is being compiled
        self._straight: bool | None = None  # whether the moving image has its grid, as far as it was drawn
        self.shown: Shown | None = None
        self.certified: Certified | None = None
        self._writing = False

    def _changed(self) -> None:
        self._show_settings()
        self._show_points()
        self.draw()
        self._save()

    def _released(self, attr: str, old: Any, new: Any) -> None:
        """The mouse button was let go after a drag."""
        self.session.settle()
        self._changed()

    def _show_images(self) -> None:
        """Other images in the same figures."""
        pictures: dict[Side, Picture] = {side: self.session.picture(side) for side in self.canvases}
        for side, canvas in self.canvases.items():
            canvas.resize(pictures[side].shape)
            canvas.show(pictures[side].preview)
        self.result.resize(pictures["fixed"].shape)
        self.result.show(np.zeros((1, 1, 4), np.uint8))  # nothing, until it has been computed
        self.result.show_areas(None)
        self.shown = self.certified = self._straight = None
        self._show_settings()
        self._show_points()
        self._compare()
        self.layout.show_images(self.session)
        self.layout.status(["computing …"])
        self.draw()

    def _show_points(self) -> None:
        self._writing = True
        try:
            for points in self.points:
                edition = self.editions[points].publish(self.session.work)
                points.source.data = point_rows(self.session.work, points.side, edition, self.session.selected)
            self._show_table()
        finally:
            self._writing = False
        self.controls.undo.disabled = not self.session.history.can_undo
        self.controls.redo.disabled = not self.session.history.can_redo
        self.controls.clear.disabled = not self.session.work.pairs
        self.controls.delete.disabled = self.session.selected is None

    def _highlight(self) -> None:
        """Another pair is highlighted, and nothing has moved."""
        number = self.session.number(self.session.selected or 0)
        for points in self.points:
            source, rows = points.source, point_rows(self.session.work, points.side, 0, self.session.selected)
            if len(rows["size"]) == len(source.data["size"]):
                source.patch({name: [(slice(None), rows[name])] for name in ("size", "rim")})
        self._writing = True
        try:
            self.controls.table.selection = [number - 1] if number else []
        finally:
            self._writing = False
        self.controls.delete.disabled = number == 0

    def _show_table(self) -> None:
        residuals = None
        if self.shown is not None and self.shown.registration is not None:
            residuals = self.shown.registration.residuals
        current = self.certified if self.certified and self.certified.revision == self.session.revision else None
        left_out = current.left_out if current else None
        number = self.session.number(self.session.selected or 0)
        named = any(pair.name not in ("", str(k + 1)) for k, pair in enumerate(self.session.work.pairs))
        self.controls.table.hidden_columns = [] if named else ["name"]
        self.controls.table.value = table_rows(self.session.work, residuals, left_out.errors if left_out else None)
        outliers = ", ".join(str(k + 1) for k in sorted(left_out.outliers)) if left_out else ""
        note = f"Worth a second look, because the others do not predict them: {outliers}" if outliers else ""
        if len(self.session.work.pairs) > solving.MOST_LEFT_OUT:
            note = f"Of more than {solving.MOST_LEFT_OUT} pairs, none is left out in turn: it would take too long here"
        self.layout.note(note)
        self.controls.table.selection = [number - 1] if number else []

    def _show_settings(self) -> None:
        self._writing = True
        try:
            for name, value in vars(self.session.work.settings).items():
                getattr(self.controls, name).value = value
        finally:
            self._writing = False

    def _compare(self) -> None:
        self.result.compare(self.controls.mode.value, self.session.picture("fixed").preview)
        self._show_legend()

    def _show_legend(self) -> None:
        mapped = self.controls.mode.value == "Areas" and self.certified is not None
        self.layout.legend(self.result.extreme if mapped else None)

    def _ready(self) -> bool:
        """Whether the solver of the present scheme is at hand, if one is needed; otherwise all is drawn when it is."""
        if not self.session.work.pairs:
            return True
        solver = preparing.prepared(self.session.work.settings.scheme)
        if not solver.done() and self._awaited is not solver:
            self._awaited = solver
            solver.add_done_callback(lambda _: delivered(self.deliver, self._arrived))
        if solver.done() and (error := solver.exception()) is not None:
            self.deliver(partial(self.fail, error))
            return False
        return solver.done()

    def _arrived(self) -> None:
        """The solver has been made ready, or could not be."""
        self._awaited = None
        self.draw()

    def draw(self, hasty: bool = False) -> None:
        """Register the present pairs beside the event loop, and show what comes of it."""
        time, grid = float(self.controls.time.value or 0.0), bool(self.controls.grid.value)
        wanted = Wanted(self.session.task(), time, grid, hasty, waiting=not self._ready())
        previous, known = self.session.registration, None
        if self.shown is not None and not self.shown.wanted.hasty and not hasty:
            same = self.shown.wanted.task.revision == wanted.task.revision
            known = self.shown.registration if same else None
        self.slow.drop("certify")
        self.worker.ask("draw", partial(solving.shown, wanted, previous, known), self._drawn, self.fail)

    def _drawn(self, shown: Shown) -> None:
        self.shown = shown
        self.session.registration = shown.registration
        self.result.show(shown.image, shown.grid)
        self.result.show_carried(shown.carried, shown.wanted.time)
        if shown.wanted.hasty:
            return
        if self._straight is not shown.wanted.grid:
            self._straight = shown.wanted.grid
            straight = solving.grid(self.session.moving, None, 0.0) if self._straight else ([], [])
            self.canvases["moving"].show(self.session.moving.preview, straight)
        self._writing = True
        self._show_table()
        self._writing = False
        self._tell()
        if shown.registration is None:
            self._certified(None)
        elif self.certified is None or self.certified.revision != shown.wanted.task.revision:
            revision = shown.wanted.task.revision
            stale = lambda: self.session.revision != revision  # noqa: E731
            job = partial(solving.certified, shown.wanted, shown.registration, stale)
            self.slow.ask("certify", job, self._certified, self.fail)

    def _certified(self, certified: Certified | None) -> None:
        if certified is None and self.session.work.pairs:
            return  # overtaken by another change
        self.certified = certified
        self.result.show_areas(certified)
        self._show_legend()
        self._writing = True
        self._show_table()
        self._writing = False
        self._tell()

    def _tell(self) -> None:
        """One line on the registration that is shown."""
        shown, certified = self.shown, self.certified
        if self._awaited is not None:
            self.layout.status([preparing.COMPILING], busy=True)
            return
        if shown is None or shown.registration is None:
            self.layout.status([] if self.session.work.pairs else ["no pairs yet: click in an image"])
            return
        registration = shown.registration
        count = len(registration.pairs)
        parts = ["1 pair" if count == 1 else f"{count} pairs", f"{registration.steps} steps"]
        parts.append(f"residual ≤ {registration.residuals.max():.2g} px")
        if certified is None or certified.revision != self.session.revision:
            self.layout.status(parts if shown.wanted.hasty else [*parts, "certifying …"])
            return
        parts.append(f"areas × {certified.det_min:.2f} to {certified.det_max:.2f}")
        parts.append(f"round trip {certified.round_trip:.0e} px")
        # A map that misses its landmarks folds, too, between the pixels that were looked at.
        self.layout.status(parts, folds=certified.folded > 0 or registration.status != "solved")

    def _save(self) -> None:
        if self.store is not None:
            job = partial(self.store.save, self.token, self.session.moving, self.session.fixed, self.session.work)
            self.slow.ask("save", job, lambda _: None, self.fail)

    def fail(self, error: BaseException) -> None:
        """Show what went wrong; the session goes on."""
        self._tell()
        if isinstance(error, CodegenError):
            self.layout.message(str(error))
        else:
            traceback.print_exception(error)
            self.layout.message(f"Something unexpected went wrong ({type(error).__name__}); your landmarks are safe")
