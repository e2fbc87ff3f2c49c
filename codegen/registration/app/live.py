"""An open work: its session, its tabs, and the solving, drawing and saving for them.

All tabs of a work share one session. Each edit of a page has a number, is applied once, and is kept by the page until
it has been saved. So neither a second tab nor the end of the server loses an edit.
"""

from __future__ import annotations

import json
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from codegen.errors import CodegenError, RegistrationError
from codegen.registration.app import messages, solving, worker
from codegen.registration.app.autosave import TOKEN, Keeper, Saved, Store, new_token
from codegen.registration.app.messages import Line, Tab, operate
from codegen.registration.app.session import Session, Work
from codegen.registration.app.solving import Certified, Look, Shown, Wanted
from codegen.registration.app.worker import Deliver, Worker, delivered, slow
from codegen.registration.maps import Registration
from codegen.registration.noise import SigmaEstimate

MOST_CLIENTS = 50
"""Pages whose last edits are remembered."""
MOST_PIXELS = 1 << 23
"""Most pixels of a window."""


class LiveWork:
    """A session with its tabs.

    `deliver` runs a function in the thread of the session, in which all methods are called. The work is saved in
    `store`, if there is one, under the name `token`.
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
        """Called after a change of the name of the work."""
        self._heard = dict(saved.heard) if saved else {}
        self._told: Work | None = None  # the work in all tabs
        self._worker = Worker(deliver, ("draw",))
        self._slow = Worker(deliver, ("sigma", "certify"), slow)
        self._keeper = Keeper(deliver, store, token, saved, self._tell_saved, self._renamed)
        self._awaited: Future[None] | None = None  # the solver that is being compiled

    @property
    def token(self) -> str:
        """The name of the saved work."""
        return self._keeper.token

    def join(self, client: str, line: Line) -> None:
        """Add a tab, whose name is `client`."""
        self.tabs[client] = Tab(line)
        hello = {"type": "hello", "token": self.token, "heard": self._heard.get(client, 0), **messages.offers()}
        line.send(hello)
        line.send(self._is_safe(client))  # the page may have missed the message
        line.send(messages.images(self.session))
        line.send(messages.work(self.session, None))
        if self._told is None:
            self._told = self.session.work
        if self.shown is not None:
            line.send(messages.solved(self.shown))
        if self.certified is not None and self.shown is not None:
            self._send_certified(self.tabs[client], self.certified, self.shown)
        self.draw()

    def leave(self, client: str, line: Line) -> None:
        """Remove a tab: it was closed, or its connection was lost."""
        if client in self.tabs and self.tabs[client].line is line:
            del self.tabs[client]

    def tell(self, message: Mapping[str, Any] | bytes) -> None:
        """Send a message to every tab."""
        for tab in self.tabs.values():
            tab.line.send(message)

    def hear(self, client: str, message: Any) -> None:
        """Handle a message of a tab; errors become a message to this tab."""
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
        """True if a computation or a save is in progress, or if the last save failed."""
        return self._worker.busy or self._slow.busy or self._keeper.busy

    def _edit(self, client: str, tab: Tab, message: Mapping[str, Any]) -> None:
        number = int(message["number"])
        added = None
        if number > self._heard.get(client, 0):
            self._heard.pop(client, None)  # the newest pages come last
            self._heard[client] = number
            while len(self._heard) > MOST_CLIENTS:
                del self._heard[next(iter(self._heard))]
            try:
                added = operate(self.session, message)
            except CodegenError as error:
                tab.line.send(_message(str(error)))
        hasty = message.get("do") == "move" and not message.get("settled")
        # This message comes first: it identifies the added pair for the page.
        tab.line.send({"type": "done", "number": number, "added": added})
        self._tell_work()
        if not hasty or message.get("live", True):
            self.draw(hasty=hasty)
        if not hasty:
            self.save()

    def change(self, act: Callable[[], Any], images: bool = False) -> None:
        """Change the session, and show and save the result; errors of `act` are raised."""
        act()
        if images:
            self.shown = self.certified = None
            self._told = None
            self.tell(messages.images(self.session))
        self._tell_work()
        self.draw()
        self.save()

    def _tell_work(self) -> None:
        self.tell(messages.work(self.session, self._told))
        self._told = self.session.work

    def draw(self, hasty: bool = False, only: str | None = None) -> None:
        """Register the present pairs in the background, and show the result in all tabs, or in one."""
        wanted = Wanted(self.session.task(), hasty, waiting=not self._ready())
        if self._known(wanted) is None:
            only = None
            self._slow.drop("certify")
            self._tell_status("solving" if self.session.work.active and not wanted.waiting else "")
        looks = {client: tab.look for client, tab in self.tabs.items() if only in (None, client)}

        def job() -> Shown:
            # The registration may have been found since the request.
            return solving.shown(wanted, looks, self.session.registration, self._known(wanted))

        self._worker.ask("draw" if only is None else f"draw {only}", job, self._drawn, self._failed)

    def _known(self, wanted: Wanted) -> Registration | None:
        """Return the present registration if it is the wanted one."""
        shown = self.shown
        if wanted.hasty or shown is None or shown.wanted.hasty:
            return None
        return shown.registration if shown.wanted.task.revision == wanted.task.revision else None

    def _drawn(self, shown: Shown) -> None:
        task = shown.wanted.task
        if task.moving is not self.session.moving or task.fixed is not self.session.picture("fixed"):
            return  # other images were opened meanwhile
        is_new = self.shown is None or shown.registration is not self.shown.registration
        self.shown = shown
        self.session.registration = shown.registration
        if is_new or shown.registration is None:
            self.tell(messages.solved(shown))
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
        if certified.revision == shown.wanted.task.revision:
            tab.line.send(messages.certified(certified, shown.wanted.task))
            tab.line.send(messages.areas(certified))

    def _ready(self) -> bool:
        """Return True if the solver of the scheme is ready or not needed; otherwise all is drawn when it is ready."""
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
        """Raise CodegenError while the solver is being compiled."""
        if not self._ready():
            raise RegistrationError("the solver is still being compiled", "try again when the image is warped")

    def _choose_sigma(self) -> None:
        """Estimate sigma in the background."""
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
        """Save the work in the background, and tell every tab which of its edits are saved."""
        session = self.session
        self._keeper.save(Saved(session.moving, session.fixed, session.work, dict(self._heard), ""))

    def _tell_saved(self) -> None:
        for client, tab in self.tabs.items():
            tab.line.send(self._is_safe(client))

    def _is_safe(self, client: str) -> dict[str, Any]:
        """Return the number of the last saved edit of a page, up to which the page may forget its edits."""
        return {"type": "saved", "number": self._keeper.safe.get(client, 0), "problem": self._keeper.problem}

    def _renamed(self, reason: str) -> None:
        """Tell the tabs another name of the work: another server has changed the saved work of the old name."""
        self.renamed(self)
        self.tell({"type": "moved", "token": self.token})
        self._say(reason)

    def _tell_status(self, doing: str) -> None:
        self.tell({"type": "status", "doing": worker.COMPILING if self._awaited is not None else doing})

    def _say(self, text: str, wrong: bool = True) -> None:
        if text or self.message:
            self.message = text
            self.tell(_message(text, wrong))

    def _failed(self, error: BaseException) -> None:
        """Show an error; the session goes on."""
        self._tell_status("")
        if isinstance(error, CodegenError):
            self._say(str(error))
        else:
            traceback.print_exception(error)
            self._say(f"Something unexpected went wrong ({type(error).__name__}); your landmarks are safe")


def _message(text: str, wrong: bool = True) -> dict[str, Any]:
    return {"type": "message", "text": text, "wrong": wrong}


def _look(message: Mapping[str, Any]) -> Look:
    """Return the view of a tab; ValueError for an invalid window."""
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


def parsed(text: str | bytes) -> Any:
    """Parse a message of a page; None for invalid JSON."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


PATIENCE = 60.0
"""Seconds for which a work without tabs stays in memory; reloading a page takes less."""


@dataclass
class Works:
    """All open works.

    `begun` makes the session of a new work, and `later` calls a function after a number of seconds. `only` is the work
    of a notebook, which all tabs show.
    """

    begun: Callable[[], Session]
    deliver: Deliver
    later: Callable[[float, Callable[[], None]], object]
    store: Store | None = None
    only: LiveWork | None = None
    open: dict[str, LiveWork] = field(default_factory=dict)

    def find(self, token: str) -> LiveWork | None:
        """Return the open work of a name."""
        if self.only is not None:
            return self.only
        work = self.open.get(token)
        return None if work is not None and work.token != token else work  # a renamed work has a new token

    def get(self, token: str) -> LiveWork:
        """Return the open or saved work of a name, or a new work."""
        work = self.find(token)
        if work is not None:
            return work
        is_token = TOKEN.fullmatch(token) is not None
        saved = self.store.load(token) if self.store is not None and is_token else None
        if saved is not None:
            session = Session(saved.moving, saved.fixed, saved.work)
            work = LiveWork(session, self.deliver, self.store, token, saved)
        else:
            # The page of an unsaved work keeps its name, and sends its edits again. A damaged file is not overwritten.
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
        """Forget a work without tabs after a while, unless another tab has come."""

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
