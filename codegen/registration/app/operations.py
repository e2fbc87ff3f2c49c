"""What a page asks to be done to its session, taken from a message that may hold anything."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, TypeAlias

from codegen.errors import LandmarkError
from codegen.registration.alignment import KINDS
from codegen.registration.app.session import Session
from codegen.registration.app.state import MOST_PAIRS, Place, Settings, Side

Message: TypeAlias = Mapping[str, Any]
SCHEMES = {"rk4": "fourth order", "midpoint": "second order", "explicit-euler": "first order"}
"""Schemes that the page offers, and what is said of them."""
ALIGNMENTS = ("auto", *KINDS)
INTERPOLATIONS = ("linear", "cubic", "nearest")
_REMEDY = "load the page again"


def operate(session: Session, message: Message) -> int | None:
    """Do what an edit says; the identity of the pair that was added or completed by it, if one was.

    LandmarkError for what is no edit, and what the session itself raises; nothing has then been changed.
    """
    act = _ACTS.get(str(message.get("do")))
    if act is None:
        raise LandmarkError(f"{str(message.get('do'))[:40]!r} is no edit", _REMEDY)
    try:
        return act(session, message)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise LandmarkError(f"the edit {message['do']!r} cannot be read", _REMEDY) from error


def _add(session: Session, message: Message) -> int:
    awaiting = message.get("awaiting")
    pair = session.add(_side(message), _place(message["place"]), None if awaiting is None else int(awaiting))
    return pair.identity


def _move(session: Session, message: Message) -> None:
    session.move(int(message["id"]), _side(message), _place(message["place"]), bool(message["settled"]))


def _rename(session: Session, message: Message) -> None:
    session.rename(int(message["id"]), str(message["name"]))


def _activate(session: Session, message: Message) -> None:
    session.activate(_identities(message), bool(message["active"]))


def _remove(session: Session, message: Message) -> None:
    session.remove(*_identities(message))


def _set(session: Session, message: Message) -> None:
    given = message["settings"]
    settings = Settings(**{f.name: type(f.default)(given[f.name]) for f in fields(Settings)})  # type: ignore[misc]
    known = {"align": ALIGNMENTS, "scheme": SCHEMES, "interpolation": INTERPOLATIONS}
    for name, choices in known.items():
        if getattr(settings, name) not in choices:
            raise ValueError(name)
    session.set(settings)


def _undo(session: Session, message: Message) -> None:
    session.undo()


def _redo(session: Session, message: Message) -> None:
    session.redo()


def _settle(session: Session, message: Message) -> None:
    session.settle()


_ACTS: dict[str, Callable[[Session, Message], int | None]] = {
    "add": _add, "move": _move, "rename": _rename, "activate": _activate, "remove": _remove, "set": _set,
    "undo": _undo, "redo": _redo, "settle": _settle,
}  # fmt: skip


def _side(message: Message) -> Side:
    side: Any = message["side"]
    if side not in ("moving", "fixed"):
        raise ValueError("side")
    return "moving" if side == "moving" else "fixed"


def _place(values: Any) -> Place:
    x, y = values
    return float(x), float(y)


def _identities(message: Message) -> list[int]:
    return [int(identity) for identity in list(message["ids"])[:MOST_PAIRS]]
