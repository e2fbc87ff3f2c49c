"""The works that are open, by their names: opened when a first tab asks for one, closed after the last has left."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from codegen.registration.app.autosave import TOKEN, Store, new_token
from codegen.registration.app.live import LiveWork
from codegen.registration.app.session import Session
from codegen.registration.app.worker import Deliver

PATIENCE = 60.0
"""Seconds for which a work without tabs is kept in memory; a page that is loaded again takes less."""


@dataclass
class Works:
    """`begun` makes the session of a new work, `later` calls a function after so many seconds."""

    begun: Callable[[], Session]
    deliver: Deliver
    later: Callable[[float, Callable[[], None]], object]
    store: Store | None = None
    only: LiveWork | None = None  # that of a notebook: all tabs show it, whatever they ask for
    open: dict[str, LiveWork] = field(default_factory=dict)

    def find(self, token: str) -> LiveWork | None:
        """The work that is open under a name."""
        if self.only is not None:
            return self.only
        found = self.open.get(token)
        if found is not None and found.token != token:
            return None  # it has got another name since
        return found

    def get(self, token: str) -> LiveWork:
        """The work of that name, as it is or as it was saved; a new one where there is none."""
        found = self.find(token)
        if found is not None:
            return found
        saved = self.store.load(token) if self.store is not None and TOKEN.fullmatch(token) else None
        if saved is not None:
            session = Session(saved.moving, saved.fixed, saved.work)
            work = LiveWork(session, self.deliver, self.store, token, saved)
        else:
            # A page that comes back to a work that nobody saved keeps its name, and sends its edits again.
            fresh = token if TOKEN.fullmatch(token) and not self._is_damaged(token) else new_token()
            work = LiveWork(self.begun(), self.deliver, self.store, fresh)
        work.renamed = self._enter
        self._enter(work)
        return work

    def _enter(self, work: LiveWork) -> None:
        self.open[work.token] = work

    def _is_damaged(self, token: str) -> bool:
        """Whether there is a file that cannot be read: nothing may be written over it."""
        return self.store is not None and (self.store.folder / f"{token}.json").exists()

    def left(self, work: LiveWork) -> None:
        """A tab has gone; after a while nothing of its work is in memory unless another has come."""

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
