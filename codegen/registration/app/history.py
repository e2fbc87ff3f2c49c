"""Undo and redo over values that never change."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Generic, TypeVar

State = TypeVar("State")

MOST = 200
"""So many steps can be undone."""


class History(Generic[State]):
    """A present state with those before and after it.

    Changes that carry the same `gesture` replace one another until `settle` is called: a drag is one step.
    """

    def __init__(self, present: State) -> None:
        self.present = present
        self._past: list[State] = []
        self._future: list[State] = []
        self._gesture: Hashable = None

    def change(self, state: State, gesture: Hashable = None) -> None:
        """Make a state the present one."""
        if state == self.present:
            return
        if gesture is None or gesture != self._gesture:
            self._past = [*self._past[-MOST + 1 :], self.present]
        self._gesture = gesture
        self._future.clear()
        self.present = state

    def settle(self) -> None:
        """End the gesture: the next change is a step of its own."""
        self._gesture = None

    @property
    def can_undo(self) -> bool:
        """Whether there is a state before this one."""
        return bool(self._past)

    @property
    def can_redo(self) -> bool:
        """Whether there is a state that was undone."""
        return bool(self._future)

    def undo(self) -> bool:
        """Go back one step; whether there was one."""
        return self._go(self._past, self._future)

    def redo(self) -> bool:
        """Go forward to what was undone; whether there was anything."""
        return self._go(self._future, self._past)

    def _go(self, source: list[State], target: list[State]) -> bool:
        self._gesture = None
        if not source:
            return False
        target.append(self.present)
        self.present = source.pop()
        return True
