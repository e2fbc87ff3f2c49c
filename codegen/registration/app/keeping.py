"""Saving one work, again and again, beside the event loop: what has been saved, and what could not be."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TypeAlias

from codegen.errors import CodegenError
from codegen.registration.app.autosave import OtherWriterError, Saved, Store, new_token
from codegen.registration.app.worker import Deliver, Worker, saving

Told: TypeAlias = Callable[[Mapping[str, int], str | None], None]


class Keeper:
    """Keeps a work under `token`, from the `edition` that was read; without a store nothing is kept.

    `told` hears of every attempt: the last edit of each page that is safe now, and what went wrong, or None. `renamed`
    hears why the work has got another name.
    """

    def __init__(
        self,
        deliver: Deliver,
        store: Store | None,
        token: str,
        edition: str,
        told: Told,
        renamed: Callable[[str], None],
    ) -> None:
        self.token = token
        self._store, self._edition = store, edition
        self._told, self._renamed = told, renamed
        self._worker = Worker(deliver, ("save",), saving)
        self._is_unsaved = False

    @property
    def busy(self) -> bool:
        """Whether anything is being saved, or could not be."""
        return self._worker.busy or self._is_unsaved

    def save(self, state: Saved) -> None:
        """Save a state soon; of several that wait only the newest."""
        store, token = self._store, self.token
        if store is None:
            self._told(state.heard, None)
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
        self._edition, self._is_unsaved = saved.edition, False
        if token != self.token:
            self.token = token
            self._renamed(said)
        self._told(saved.heard, None)

    def _failed(self, error: Exception) -> None:
        self._is_unsaved = True
        self._told({}, str(error) if isinstance(error, CodegenError) else type(error).__name__)
