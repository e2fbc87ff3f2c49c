"""Open works of the page: an open work has a session, the connections to its tabs, and background jobs.

All tabs of a work share one session; messages are JSON. A tab numbers its edits, and keeps each edit until the server
has saved it. The server applies each edit once. So neither a second tab nor the end of the server loses an edit.
"""

from __future__ import annotations

import json
import math
import struct
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from codegen.errors import CodegenError, LandmarkError, RegistrationError
from codegen.registration.app import solving, worker
from codegen.registration.app.reading import (
    LIMITS,
    MOST_LANDMARK_BYTES,
    TOKEN,
    OtherWriterError,
    Saved,
    Store,
    new_token,
)
from codegen.registration.app.session import MOST_PAIRS, SIDE, Session, Settings, Side, Work
from codegen.registration.app.solving import Certified, Look, Seen, Shown, Wanted
from codegen.registration.app.worker import Deliver, Worker, delivered, saving, slow
from codegen.registration.formats import FORMATS
from codegen.registration.maps import Registration
from codegen.registration.noise import SigmaEstimate
from codegen.registration.pairs import KINDS

Message: TypeAlias = Mapping[str, Any]
Values: TypeAlias = dict[str, Any]

SCHEMES = {"rk4": "fourth order", "midpoint": "second order", "explicit-euler": "first order"}
"""The schemes that the page offers, and texts for their orders."""
ALIGNMENTS = ("auto", *KINDS)
INTERPOLATIONS = ("linear", "cubic", "nearest")
COLOURS = ((0, 90, 170), (247, 247, 247), (200, 85, 0))
"""The colours of the map of det J: blue for smaller, white for equal, orange for larger areas."""
_REMEDY = "load the page again"
MOST_CLIENTS = 50  # largest number of tabs whose last edit number is remembered
MOST_PIXELS = 1 << 23  # largest number of screen pixels of the window that a tab asks for


def operate(session: Session, message: Message) -> int | None:
    """Apply an edit of a tab to the session; return the identity of the pair that "add" adds or completes, else None.

    Raises LandmarkError for an invalid edit, and the errors of the session; the session is then unchanged.
    """
    action = str(message.get("do"))
    try:
        match action:
            case "add":
                awaiting = message.get("awaiting")
                side, place = _side(message), _place(message)
                return session.add(side, place, None if awaiting is None else int(awaiting)).identity
            case "move":
                session.move(int(message["id"]), _side(message), _place(message), bool(message["settled"]))
            case "rename":
                session.rename(int(message["id"]), str(message["name"]))
            case "activate":
                session.activate(_identities(message), bool(message["active"]))
            case "remove":
                session.remove(*_identities(message))
            case "set":
                values = message["settings"]
                settings = Settings(**{f.name: type(f.default)(values[f.name]) for f in fields(Settings)})  # type: ignore[misc]
                choices = {"align": ALIGNMENTS, "scheme": SCHEMES, "interpolation": INTERPOLATIONS}
                for name, allowed in choices.items():
                    if getattr(settings, name) not in allowed:
                        raise ValueError(name)
                session.set(settings)
            case "undo":
                session.undo()
            case "redo":
                session.redo()
            case "settle":
                session.history.settle()
            case _:
                raise LandmarkError(f"{action[:40]!r} is no edit", _REMEDY)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise LandmarkError(f"the edit {action!r} cannot be read", _REMEDY) from error
    return None


def _side(message: Message) -> Side:
    if message["side"] not in ("moving", "fixed"):
        raise ValueError("side")
    return "moving" if message["side"] == "moving" else "fixed"


def _place(message: Message) -> tuple[float, float]:
    x, y = message["place"]
    return float(x), float(y)


def _identities(message: Message) -> list[int]:
    return [int(identity) for identity in list(message["ids"])[:MOST_PAIRS]]


def images_message(session: Session) -> Values:
    """Return the message about the images of a session; its entry `alone` is True for a single image."""
    values: Values = {"type": "images", "alone": session.fixed is None}
    for side, picture in (("moving", session.moving), ("fixed", session.picture("fixed"))):
        height, width = picture.shape
        spacing = picture.spacing
        values[side] = {
            "name": picture.name, "width": width, "height": height, "digest": picture.digest,
            "levels": [level.shape[1::-1] for level in picture.levels],
            "spacing": None if spacing is None else {"x": spacing.x, "y": spacing.y, "unit": spacing.unit},
            "edges": picture.edges,
        }  # fmt: skip
    return values


def work_message(session: Session, before: Work | None) -> Values:
    """Return the message about the work: the pairs changed since `before` (all if None), settings, undo and redo."""
    now = session.work
    earlier = {} if before is None else {pair.identity: pair for pair in before.pairs}
    changed = [pair.row for pair in now.pairs if earlier.get(pair.identity) != pair]
    order = [pair.identity for pair in now.pairs]
    same_order = before is not None and order == [pair.identity for pair in before.pairs]
    return {
        "type": "work", "revision": session.revision, "all": before is None, "changed": changed,
        "order": None if same_order else order, "settings": dict(vars(now.settings)),
        "undo": session.history.can_undo, "redo": session.history.can_redo,
    }  # fmt: skip


def solved_message(shown: Shown) -> Values:
    """Return the message about a registration: residuals by pair, and the chart that maps points between images."""
    registration, task = shown.registration, shown.wanted.task
    values: Values = {"type": "solved", "revision": task.revision, "hasty": shown.wanted.hasty, "found": False}
    if registration is None:
        return values
    identities = [pair.identity for pair in task.work.active]
    values |= {
        "found": True, "steps": registration.steps, "met": registration.status == "solved",
        "residuals": _by_identity(identities, registration.residuals), "alignment": registration.alignment.kind,
    }  # fmt: skip
    if task.fixed.spacing is not None:
        values["residual_lengths"] = _by_identity(identities, task.fixed.spacing.lengths(registration.misses))
    if shown.chart is not None:
        values["chart"] = {side: np.round(places, 3).tolist() for side, places in shown.chart.items()}
    return values


def _by_identity(identities: list[int], values: NDArray[np.float64]) -> dict[str, float | None]:
    return {str(identity): _number(float(value)) for identity, value in zip(identities, values, strict=True)}


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _packed(header: Message, image: NDArray[np.uint8]) -> bytes:
    """Return a binary message: the length of the header, the header as JSON, and the RGBA image, shape (h, w, 4)."""
    height, width = image.shape[:2]
    text = json.dumps({**header, "width": width, "height": height}, allow_nan=False).encode()
    return struct.pack("<I", len(text)) + text + image.tobytes()


class Line(Protocol):
    """The connection to a tab of a browser."""

    def send(self, message: Message | bytes) -> None:
        """Send a dict as JSON, or a picture of `_packed`; closed connections are ignored."""


class Tab:
    """A tab, which receives one picture at a time; of several waiting pictures only the newest is sent."""

    def __init__(self, line: Line) -> None:
        self.line = line
        self.look = Look()
        self._number = 0
        self._busy = False
        self._next: tuple[Seen, int] | None = None

    def show(self, picture: Seen, revision: int) -> None:
        """Send a picture, now or when the tab has drawn the previous one."""
        if self._busy:
            self._next = (picture, revision)
            return
        self._busy = True
        self._number += 1
        look, window = picture.look, picture.look.window
        header: Values = {
            "type": "frame", "number": self._number, "revision": revision, "time": look.time,
            "window": None if window is None else [window.left, window.top, window.right, window.bottom],
            "grid": [[np.round(line[:, axis], 2).tolist() for line in picture.grid] for axis in (0, 1)],
            "carried": np.round(picture.carried, 2).tolist(),
        }  # fmt: skip
        self.line.send(_packed(header, picture.image))

    def drawn(self) -> None:
        """Send the waiting picture, if any, because the tab has drawn the previous picture."""
        self._busy = False
        if self._next is not None:
            following, self._next = self._next, None
            self.show(*following)


class LiveWork:
    """An open work: a session with its tabs.

    All methods are called in the thread of the session; `deliver` runs a function in this thread. The work is saved in
    `store`, unless this is None, under the name `token`. `saved` is the state read from the store, or None.
    """

    def __init__(
        self,
        session: Session,
        deliver: Deliver,
        store: Store | None = None,
        token: str = "",
        saved: Saved | None = None,
    ) -> None:
        self.session, self.deliver = session, deliver
        self.tabs: dict[str, Tab] = {}
        self.shown: Shown | None = None
        self.certified: Certified | None = None
        self.message = ""
        self.renamed: Callable[[LiveWork], None] = lambda _: None
        """The function that is called after a change of the token."""
        self._heard = dict(saved.heard) if saved else {}
        self._told: Work | None = None  # the work that was last sent to the tabs
        self._worker = Worker(deliver, ("draw",))
        self._slow = Worker(deliver, ("sigma", "certify"), slow)
        self.token = token
        """The name under which the work is saved."""
        self._store, self._edition = store, saved.edition if saved else ""
        self._saving = Worker(deliver, ("save",), saving)
        self._safe = dict(self._heard)  # the number of the last saved edit of every tab
        self._problem: str | None = None  # the reason why the last attempt to save failed
        self._awaited: Future[None] | None = None  # the solver that is being compiled

    def join(self, client: str, line: Line) -> None:
        """Add a tab with the name `client`, and send it the present state over `line`, its connection."""
        self.tabs[client] = Tab(line)
        hello = {
            "type": "hello", "token": self.token, "heard": self._heard.get(client, 0),
            "limits": {"image": LIMITS.bytes, "landmarks": MOST_LANDMARK_BYTES, "pairs": MOST_PAIRS}, "tile": SIDE,
            "alignments": ALIGNMENTS, "schemes": SCHEMES, "interpolations": INTERPOLATIONS,
            "formats": {name: form.title for name, form in FORMATS.items()},
            "suffixes": sorted({suffix for form in FORMATS.values() for suffix in form.suffixes}),
        }  # fmt: skip
        line.send(hello)
        line.send(self._is_safe(client))  # the tab may have missed the message before a reconnection
        line.send(images_message(self.session))
        line.send(work_message(self.session, None))
        if self._told is None:
            self._told = self.session.work
        if self.shown is not None:
            line.send(solved_message(self.shown))
        if self.certified is not None and self.shown is not None:
            self._send_certified(self.tabs[client], self.certified, self.shown)
        self.draw()

    def leave(self, client: str, line: Line) -> None:
        """Remove a tab whose connection `line` was closed, unless the tab has a newer connection."""
        if client in self.tabs and self.tabs[client].line is line:
            del self.tabs[client]

    def tell(self, message: Message | bytes) -> None:
        """Send a message to every tab."""
        for tab in self.tabs.values():
            tab.line.send(message)

    def hear(self, client: str, message: object) -> None:
        """Handle a message of the tab `client`; errors are sent to this tab as a message."""
        tab = self.tabs.get(client)
        if tab is None or not isinstance(message, dict):
            return
        try:
            asked = message.get("type")
            if asked == "edit":
                self._edit(client, tab, message)
            elif asked == "look":
                tab.look = _look(message)
                self.draw(only=client)
            elif asked == "drawn":
                tab.drawn()
            elif asked == "save":
                self.save()
            elif asked == "sigma":
                self._choose_sigma()
        except (KeyError, TypeError, ValueError, OverflowError):
            tab.line.send(_message("the page sent what cannot be read; load it again"))

    @property
    def busy(self) -> bool:
        """True if a computation or a save runs or waits, or if the last save failed."""
        return self._worker.busy or self._slow.busy or self._saving.busy or self._problem is not None

    def _edit(self, client: str, tab: Tab, message: Message) -> None:
        """Apply an edit of a tab, unless it was applied before, and tell the tab that it is done."""
        number = int(message["number"])
        added = None
        if number > self._heard.get(client, 0):
            self._heard.pop(client, None)  # the tab with the newest edit comes last
            self._heard[client] = number
            while len(self._heard) > MOST_CLIENTS:
                del self._heard[next(iter(self._heard))]
            try:
                added = operate(self.session, message)
            except CodegenError as error:
                tab.line.send(_message(str(error)))
        hasty = message.get("do") == "move" and not message.get("settled")
        # This message comes first: the tab must know the identity of the pair that it has added.
        tab.line.send({"type": "done", "number": number, "added": added})
        self._tell_work()
        if not hasty or message.get("live", True):
            self.draw(hasty=hasty)
        if not hasty:
            self.save()

    def change(self, act: Callable[[], object], images: bool = False) -> None:
        """Call `act`, which changes the session (and images if `images`); show and save the result. `act` may raise."""
        act()
        if images:
            self.shown = self.certified = None
            self._told = None
            self.tell(images_message(self.session))
        self._tell_work()
        self.draw()
        self.save()

    def _tell_work(self) -> None:
        self.tell(work_message(self.session, self._told))
        self._told = self.session.work

    def draw(self, hasty: bool = False, only: str | None = None) -> None:
        """Register the present pairs in the background, and show the result in all tabs, or in the tab `only`."""
        wanted = Wanted(self.session.task(), hasty, waiting=not self._ready())
        if self._known(wanted) is None:
            only = None
            self._slow.drop("certify")
            self._tell_status("solving" if self.session.work.active and not wanted.waiting else "")
        looks = {client: tab.look for client, tab in self.tabs.items() if only in (None, client)}

        def job() -> Shown:
            # Ask again for a known registration, which may have been computed since the request.
            return solving.shown(wanted, looks, self.session.registration, self._known(wanted))

        self._worker.ask("draw" if only is None else f"draw {only}", job, self._drawn, self._failed)

    def _known(self, wanted: Wanted) -> Registration | None:
        """Return the present registration if it belongs to the wanted task, else None."""
        shown = self.shown
        if wanted.hasty or shown is None or shown.wanted.hasty:
            return None
        return shown.registration if shown.wanted.task.revision == wanted.task.revision else None

    def _drawn(self, shown: Shown) -> None:
        """Send the finished pictures to their tabs, and start the certificate of a new registration."""
        task = shown.wanted.task
        if task.moving is not self.session.moving or task.fixed is not self.session.picture("fixed"):
            return  # other images were opened meanwhile
        is_new = self.shown is None or shown.registration is not self.shown.registration
        self.shown = shown
        self.session.registration = shown.registration
        if is_new or shown.registration is None:
            self.tell(solved_message(shown))
        for client, seen in shown.seen.items():
            if client in self.tabs:
                self.tabs[client].show(seen, shown.wanted.task.revision)
        if is_new and not shown.wanted.hasty:
            self._say("")
        self._tell_status("")
        if shown.wanted.hasty or shown.registration is None:
            return
        revision = shown.wanted.task.revision
        if self.certified is not None and self.certified.revision == revision:
            return

        def certify(certified: Certified | None) -> None:
            if certified is None or certified.revision != self.session.revision:
                return  # the work has changed meanwhile
            self.certified = certified
            for tab in self.tabs.values():
                self._send_certified(tab, certified, shown)

        stale = lambda: self.session.revision != revision  # noqa: E731
        job = partial(solving.certified, shown.wanted, shown.registration, stale)
        self._slow.ask("certify", job, certify, self._failed)

    def _send_certified(self, tab: Tab, certified: Certified, shown: Shown) -> None:
        """Send a tab the certificate, leave-one-out errors and outliers, and the map of det J as a picture."""
        task = shown.wanted.task
        if certified.revision != task.revision:
            return
        identities = [pair.identity for pair in task.work.active]
        values: Values = {
            "type": "certified", "revision": certified.revision, "least": _number(certified.det_min),
            "most": _number(certified.det_max), "folded": certified.folded,
            "round_trip": _number(certified.round_trip), "left_out": None, "extreme": certified.extreme,
            "outliers": [identities[k] for k in certified.outliers],
        }  # fmt: skip
        if certified.left_out is not None:
            values["left_out"] = _by_identity(identities, certified.left_out.errors)
            if task.fixed.spacing is not None:
                lengths = task.fixed.spacing.lengths(certified.left_out.misses)
                values["left_out_lengths"] = _by_identity(identities, lengths)
        elif len(identities) > solving.MOST_LEFT_OUT:
            values["note"] = f"of more than {solving.MOST_LEFT_OUT} pairs, none is left out in turn"
        tab.line.send(values)
        # A logarithmic scale, on which growth and shrinking by the same factor are symmetric.
        shares = np.log2(np.clip(certified.areas, 1e-6, 1e6)) / certified.extreme
        image = np.full((*shares.shape, 4), 255, np.uint8)
        for channel in range(3):
            image[..., channel] = np.interp(shares, [-1.0, 0.0, 1.0], [end[channel] for end in COLOURS]).round()
        tab.line.send(_packed({"type": "areas", "extreme": certified.extreme}, image))

    def _ready(self) -> bool:
        """Return True if the solver is ready or not needed; otherwise prepare the solver, and draw when it is ready."""
        if not self.session.work.active:
            return True
        solver = worker.prepared(self.session.work.settings.scheme)
        if not solver.done() and self._awaited is not solver:
            self._awaited = solver

            def arrived() -> None:
                self._awaited = None
                self.draw()

            solver.add_done_callback(lambda _: delivered(self.deliver, arrived))
        if solver.done() and (error := solver.exception()) is not None:
            self.deliver(partial(self._failed, error))
            return False
        return solver.done()

    def require_solver(self) -> None:
        """Raise RegistrationError while the solver is being compiled."""
        if not self._ready():
            raise RegistrationError("the solver is still being compiled", "try again when the image is warped")

    def _choose_sigma(self) -> None:
        """Estimate the landmark errors in the background, and set sigma to the estimate."""
        try:
            self.require_solver()
        except CodegenError as error:
            self._say(str(error))
            return
        settings = self.session.work.settings
        self._say("estimating the errors of the landmarks …", wrong=False)

        def take(estimate: SigmaEstimate) -> None:
            text = f"landmarks are off by about {estimate.sigma:.3g} pixels (standard deviation)"
            self._say(f"{text}; {estimate.message}" if estimate.message else text, wrong=False)
            self.change(lambda: self.session.set(replace(settings, sigma=round(estimate.sigma, 3))))

        self._slow.ask("sigma", partial(solving.estimated_sigma, self.session.task()), take, self._failed)

    def save(self) -> None:
        """Save the work in the background, and tell every tab which of its edits are saved.

        Of several waiting states only the newest is saved. Without a store nothing is saved, and tabs are told at once.
        """
        session, store, token = self.session, self._store, self.token
        state = Saved(session.moving, session.fixed, session.work, dict(self._heard), "")
        if store is None:
            self._safe = state.heard
            self._tell_saved()
            return

        def job() -> tuple[str, Saved, str]:
            # Use the edition of the last write, which may have come after the request.
            newest = replace(state, edition=self._edition)
            try:
                return token, store.save(token, newest), ""
            except OtherWriterError as error:
                other = new_token()
                return other, store.save(other, newest), str(error)

        def done(result: tuple[str, Saved, str]) -> None:
            name, saved, reason = result
            self._edition, self._safe, self._problem = saved.edition, saved.heard, None
            if name != self.token:  # another server has changed the saved work of the old name
                self.token = name
                self.renamed(self)
                self.tell({"type": "moved", "token": name})
                self._say(reason)
            self._tell_saved()

        def failed(error: Exception) -> None:
            self._problem = str(error) if isinstance(error, CodegenError) else type(error).__name__
            self._tell_saved()

        self._saving.ask("save", job, done, failed)

    def _tell_saved(self) -> None:
        for client, tab in self.tabs.items():
            tab.line.send(self._is_safe(client))

    def _is_safe(self, client: str) -> Values:
        """Return the message about the last saved edit of a tab, which may then forget its edits up to this number."""
        return {"type": "saved", "number": self._safe.get(client, 0), "problem": self._problem}

    def _tell_status(self, doing: str) -> None:
        self.tell({"type": "status", "doing": worker.COMPILING if self._awaited is not None else doing})

    def _say(self, text: str, wrong: bool = True) -> None:
        if text or self.message:
            self.message = text
            self.tell(_message(text, wrong))

    def _failed(self, error: BaseException) -> None:
        """Show an error in all tabs; the session goes on."""
        self._tell_status("")
        if isinstance(error, CodegenError):
            self._say(str(error))
        else:
            traceback.print_exception(error)
            self._say(f"Something unexpected went wrong ({type(error).__name__}); your landmarks are safe")


def _message(text: str, wrong: bool = True) -> Values:
    return {"type": "message", "text": text, "wrong": wrong}


def _look(message: Message) -> Look:
    """Return the view that a tab asks for; ValueError for an invalid window."""
    time = min(max(float(message["time"]), 0.0), 1.0)
    values = message["window"]
    if values is None:
        return Look(None, time, bool(message["grid"]))
    edges = [float(value) for value in values[:4]]
    width, height = (int(value) for value in values[4:6])
    left, top, right, bottom = edges
    if not (right > left and bottom > top and max(map(abs, edges)) < 1e7 and width * height <= MOST_PIXELS):
        raise ValueError("window")
    return Look(solving.Window(left, top, right, bottom, max(1, width), max(1, height)), time, bool(message["grid"]))


def parsed(text: str | bytes) -> object:
    """Return the value of a JSON message of a tab; None for invalid JSON."""
    try:
        message: object = json.loads(text)
        return message
    except (ValueError, RecursionError):
        return None


PATIENCE = 60.0  # time, in seconds, for which a work without tabs stays in memory; reloading a page takes less time


@dataclass
class Works:
    """All open works, by token.

    `begun` returns the session of a new work. In the thread of the sessions, `deliver` calls a function soon, and
    `later` after a number of seconds. `only`, if not None, is the work of a notebook, which all tabs show.
    """

    begun: Callable[[], Session]
    deliver: Deliver
    later: Callable[[float, Callable[[], None]], object]
    store: Store | None = None
    only: LiveWork | None = None
    open: dict[str, LiveWork] = field(default_factory=dict)

    def find(self, token: str) -> LiveWork | None:
        """Return the open work with this token; None if no such work is open."""
        if self.only is not None:
            return self.only
        work = self.open.get(token)
        return None if work is not None and work.token != token else work  # a renamed work has a new token

    def get(self, token: str) -> LiveWork:
        """Return the open or saved work with this token, or a new work."""
        work = self.find(token)
        if work is not None:
            return work
        is_token = TOKEN.fullmatch(token) is not None
        saved = self.store.load(token) if self.store is not None and is_token else None
        if saved is not None:
            session = Session(saved.moving, saved.fixed, saved.work)
            work = LiveWork(session, self.deliver, self.store, token, saved)
        else:
            # An unsaved work keeps its token: its tab sends the edits again. A damaged file is not overwritten.
            is_damaged = self.store is not None and (self.store.folder / f"{token}.json").exists()
            work = LiveWork(
                self.begun(), self.deliver, self.store, token if is_token and not is_damaged else new_token()
            )
        work.renamed = self._enter
        self._enter(work)
        return work

    def _enter(self, work: LiveWork) -> None:
        self.open[work.token] = work

    def left(self, work: LiveWork) -> None:
        """Close a work without tabs after PATIENCE seconds, unless it has a tab again; wait while it is busy."""

        def close() -> None:
            if work.tabs:
                return
            if work.busy:
                self.later(PATIENCE, close)
                return
            for token in [token for token, other in self.open.items() if other is work]:
                del self.open[token]

        if not work.tabs:
            self.later(PATIENCE, close)
