"""Saving one work, again and again, beside the event loop: what has been saved, and what could not be."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from codegen.errors import CodegenError
from codegen.registration.app.autosave import OtherWriterError, Saved, Store, new_token
from codegen.registration.app.worker import Deliver, Worker, saving


class Keeper:
    """Keeps a work under `token`, from the state that was read, if one was; without a store nothing is kept.

    `safe` are the last edits of pages that are in what is kept, and `problem` says why the last attempt failed, if it
    did. `told` is called after every attempt; `renamed` hears why the work has got another name.
    """

    def __init__(
        self,
        deliver: Deliver,
        store: Store | None,
        token: str,
        read: Saved | None,
        told: Callable[[], None],
        renamed: Callable[[str], None],
    ) -> None:
        self.token = token
        self.safe: Mapping[str, int] = dict(read.heard) if read else {}
        self.problem: str | None = None
        self._store, self._edition = store, read.edition if read else ""
        self._told, self._renamed = told, renamed
        self._worker = Worker(deliver, ("save",), saving)

    @property
    def busy(self) -> bool:
        """Whether anything is being saved, or could not be."""
        return self._worker.busy or self.problem is not None

    def save(self, state: Saved) -> None:
        """Save a state soon; of several that wait only the newest."""
        store, token = self._store, self.token
        if store is None:
            self.safe = state.heard
            self._told()
            return

        def job() -> tuple[str, Saved, str]:
            # What was written last is what this state goes on from, even where it was asked for before.
            newest = replace(state, edition=self._edition)
            try:
                return token, store.save(token, newest), ""
            except OtherWriterError as error:
                other = new_token()
                return other, store.save(other, newest), str(error)

        self._worker.ask("save", job, self._saved, self._failed)

    def _saved(self, result: tuple[str, Saved, str]) -> None:
        token, saved, said = result
        self._edition, self.safe, self.problem = saved.edition, saved.heard, None
        if token != self.token:
            self.token = token
            self._renamed(said)
        self._told()

    def _failed(self, error: Exception) -> None:
        self.problem = str(error) if isinstance(error, CodegenError) else type(error).__name__
        self._told()
