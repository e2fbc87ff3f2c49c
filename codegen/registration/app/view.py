"""The page of one session: what a visitor does becomes an operation of the session, and its answer is drawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import panel as pn

from codegen.errors import CodegenError, RegistrationError
from codegen.registration.app import exports, solving
from codegen.registration.app.autosave import Store
from codegen.registration.app.bridge import Browser, FileButton
from codegen.registration.app.canvas import Canvas, Points
from codegen.registration.app.layout import Layout
from codegen.registration.app.reading import LIMITS, Files, example, in_order, picture_from
from codegen.registration.app.rows import Changes, dragged
from codegen.registration.app.screen import Screen
from codegen.registration.app.session import Session
from codegen.registration.app.state import Place, Settings, Side
from codegen.registration.app.worker import Deliver
from codegen.registration.formats import Frames, parse_landmarks

IMAGES = ".png,.jpg,.jpeg,.tif,.tiff"
LANDMARKS = ".csv,.pts,.tps,.json,.txt"
MOST_LANDMARK_BYTES = 8 << 20


class View(Screen):
    """Panel objects for one session; `root` is what is shown.

    `deliver` runs a function in the session's thread; `store` and `token` say where the work is saved, if at all.
    """

    def __init__(self, session: Session, deliver: Deliver, store: Store | None = None, token: str = "") -> None:
        super().__init__(session, deliver, store, token)
        self._clicks: dict[Side, list[Place]] = {"moving": [], "fixed": []}
        # Panel calls back without the document's lock, so that whatever follows has to wait for its turn.
        later = self._later
        self.browser = Browser(later(self._pressed))
        opener = partial(FileButton, failed=later(self.fail), most=LIMITS.bytes)
        self.openers = {
            "Open moving image": opener(later(partial(self._open, "moving")), label="Open moving image", accept=IMAGES),
            "Open fixed image": opener(later(partial(self._open, "fixed")), label="Open fixed image", accept=IMAGES),
            "Bend one image": opener(later(partial(self._open, None)), label="Bend one image", accept=IMAGES),
        }
        self.load_landmarks = FileButton(
            later(self._load), later(self.fail), label="Load landmarks", accept=LANDMARKS, most=MOST_LANDMARK_BYTES,
            count=2,
        )  # fmt: skip
        canvases: dict[str, Canvas] = dict(self.canvases.items()) | {"result": self.result}
        openers = (*self.openers.values(), self.load_landmarks)
        self.layout = Layout(self.controls, canvases, openers, self.browser)
        self._connect()
        self._show_images()

    @property
    def root(self) -> pn.viewable.Viewable:
        """The page."""
        return self.layout.root

    # --- what the visitor does ----------------------------------------------------------------------------------------

    def _connect(self) -> None:
        c = self.controls
        for points in self.points:
            points.source.on_change("data", partial(self._rows_changed, points))
            points.source.selected.on_change("indices", partial(self._point_chosen, points))
            points.dragging.on_change("data", partial(self._dragged, points.side))
        c.table.param.watch(self._row_chosen, "selection")
        for widget, act in {
            c.undo: self.session.undo, c.redo: self.session.redo, c.clear: self.session.clear, c.delete: self._delete,
            c.example: self._example,
        }.items():  # fmt: skip
            widget.on_click(self._later(partial(self._do, act)))
        c.choose.on_click(self._later(self._choose_sigma))
        for choice in (c.align, c.sigma, c.scheme, c.interpolation):
            choice.param.watch(self._set, "value")
        for choice in (c.grid, c.time):
            choice.param.watch(self._later(lambda _: self.draw()), "value")
        c.mode.param.watch(self._later(lambda _: self._compare()), "value")
        c.points.param.watch(self._later(lambda event: self.result.show_points(event.new)), "value")
        for widget, kind in {c.save_image: "warped_image", c.save_field: "field", c.save_gif: "animation",
                             c.save_landmarks: "landmarks"}.items():  # fmt: skip
            widget.on_click(self._later(partial(self._export, kind)))

    def _later(self, act: Callable[..., Any]) -> Callable[..., None]:
        """A function that does something in the session's thread as soon as it may."""

        def ask(*arguments: Any) -> None:
            self.deliver(partial(act, *arguments))

        return ask

    def _do(self, act: Callable[[], Any], event: Any) -> None:
        self.do(act)

    def do(self, act: Callable[[], Any]) -> bool:
        """Do something to the session that ends in itself, and show what became of it; errors become a message.

        Whether there was none.
        """
        try:
            act()
        except CodegenError as error:
            self.fail(error)
            self._show_points()
            return False
        self.layout.message("")
        self._changed()
        return True

    def _rows_changed(self, points: Points, attr: str, old: Any, new: Any) -> None:
        """The browser sent the points of an image: clicks, or the end of a drag."""
        if self._writing:
            return
        side, changes = points.side, self.editions[points].changes(new, self.session.work)
        if changes.added:
            self._expect(side, changes.added)
        if changes.moved:
            self.session.follow(side, replace(changes, added=(), removed=()))
        if changes.removed:
            self.do(partial(self.session.remove, *changes.removed))

    def _dragged(self, side: Side, attr: str, old: Any, new: Any) -> None:
        """The browser told where the point is that is being dragged."""
        for identity, place in dragged(new):
            self.session.move(identity, side, place, settled=False)
            if self.controls.live.value:
                self.draw(hasty=True)

    def _expect(self, side: Side, places: Sequence[Place]) -> None:
        """Add pairs as soon as it is known where the partners of the points that were clicked are to be expected."""
        self._clicks[side] += places
        waiting = tuple(self._clicks[side])

        def add(partners: list[Place]) -> None:
            del self._clicks[side][: len(waiting)]
            self.do(partial(self.session.follow, side, Changes(waiting), partners))

        job = partial(self._expectations, side, waiting)
        self.worker.ask(f"click {side}", job, add, self.fail)

    def _expectations(self, side: Side, places: Sequence[Place]) -> list[Place]:
        return [self.session.expected(side, place) for place in places]

    def _point_chosen(self, points: Points, attr: str, old: Any, new: list[int]) -> None:
        identities = points.source.data["id"]
        if new and new[0] < len(identities) and identities[new[0]]:
            self._choose(int(identities[new[0]]))

    def _row_chosen(self, event: Any) -> None:
        pairs, rows = self.session.work.pairs, event.new
        if not self._writing and rows and rows[0] < len(pairs):
            self.deliver(partial(self._choose, pairs[rows[0]].identity))

    def _choose(self, identity: int | None) -> None:
        if identity != self.session.selected:
            self.session.select(identity)
            self._highlight()

    def _delete(self) -> None:
        if self.session.selected is not None:
            self.session.remove(self.session.selected)

    def _pressed(self, key: str) -> None:
        acts: dict[str, Callable[[], Any]] = {
            "undo": self.session.undo, "redo": self.session.redo, "delete": self._delete,
        }  # fmt: skip
        if key in acts:
            self.do(acts[key])
        elif key == "deselect":
            self._choose(None)

    def _choose_sigma(self, event: Any) -> None:
        """Ask for the best sigma, which takes a while."""
        if not self._solver_at_hand():
            return
        self.layout.status(["choosing the distance …"])
        settings = self.session.work.settings

        def take(sigma: float) -> None:
            self.do(lambda: self.session.set(replace(settings, sigma=round(sigma, 3))))

        self.slow.ask("sigma", partial(solving.chosen_sigma, self.session.task()), take, self.fail)

    def _set(self, event: Any) -> None:
        c = self.controls
        if not self._writing:
            settings = Settings(c.align.value, float(c.sigma.value or 0.0), c.scheme.value, c.interpolation.value)
            self.deliver(partial(self.do, partial(self.session.set, settings)))

    def _solver_at_hand(self) -> bool:
        """Whether there is a solver for what takes long; the visitor is told when there is none yet."""
        ready = self._ready()
        if not ready and self._awaited is not None:
            self.fail(RegistrationError("the solver is still being compiled", "try again when the image is warped"))
        return ready

    # --- images and landmark files --------------------------------------------------------------------------------

    def _open(self, side: Side | None, files: Files) -> None:
        def opened() -> None:
            ((name, data),) = files
            picture = picture_from(data, name)
            if side is None:
                self.session.open_alone(picture)
            else:
                self.session.open(side, picture)
            self._show_images()

        self.do(opened)

    def _load(self, files: Files) -> None:
        def loaded() -> None:
            ordered, remark[:] = in_order(files)
            self.session.load(parse_landmarks(ordered, frames=self._frames()))

        remark: list[str] = []
        if self.do(loaded) and remark:
            self.layout.message(remark[0], wrong=False)

    def _frames(self) -> Frames:
        return Frames(self.session.moving.shape, self.session.picture("fixed").shape)

    def _example(self) -> None:
        made = example()
        self.session.replace(made.moving, made.fixed, made.work)
        self._show_images()

    def _export(self, kind: str, event: Any) -> None:
        self.export(kind)

    def export(self, kind: str) -> None:
        """Make a file beside the event loop and let the browser save it."""
        if kind != "landmarks" and not self._solver_at_hand():
            return
        task = self.session.task()
        jobs: dict[str, Callable[[], Any]] = {
            "warped_image": partial(exports.warped_image, task),
            "field": partial(exports.field, task),
            "landmarks": partial(exports.landmarks, task, self.controls.format.value),
            "animation": partial(exports.animation, task, self.controls.grid.value),
        }
        self.layout.status(["making the file …"])

        def made(result: Any) -> None:
            self._tell()
            for download in result if isinstance(result, tuple) else (result,):
                self.browser.hand_over(download)

        self.slow.ask(kind, jobs[kind], made, self.fail)
