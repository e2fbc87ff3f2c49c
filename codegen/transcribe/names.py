"""Names of unknowns that the author did not declare, and the symbols of named unknowns at the nodes."""

from __future__ import annotations

from collections.abc import Iterable

from sympy import Symbol

from codegen.discretise import at_nodes
from codegen.model import Model


class Names:
    """Hands out names `<stem>_1`, `<stem>_2`, ... and `<stem>_<quantity>` that no symbol of the model has."""

    def __init__(self, model: Model) -> None:
        """Take note of every name that the author declared, or that is derived from one."""
        quantities = (*model.coordinates, *model.rates, *model.controls, *model.parameters, model.time)
        others = (*(p.symbol for p in model.free_parameters), *(value.symbol for value in model.end_values))
        self._taken = {symbol.name for symbol in (*quantities, *others)}
        self._taken |= {f"{prefix}_{q.name}" for prefix in ("lambda", "mu", "nu", "p") for q in quantities}

    def numbered(self, stem: str) -> str:
        """The next free name `<stem>_<number>`."""
        number = 1
        while f"{stem}_{number}" in self._taken:
            number += 1
        return self._take(f"{stem}_{number}")

    def named(self, stem: str, quantity: Symbol) -> str:
        """The name `<stem>_<quantity>`, with underscores appended until it is free."""
        name = f"{stem}_{quantity.name}"
        while name in self._taken:
            name += "_"
        return self._take(name)

    def reserve(self, names: Iterable[str]) -> None:
        """Never hand out these names."""
        self._taken |= set(names)

    def _take(self, name: str) -> str:
        self._taken.add(name)
        return name


def symbols(names: Iterable[str], suffix: str) -> tuple[Symbol, ...]:
    """The symbols of named unknowns at a node (`_k`, `_k1`) or on the interval (`_k`)."""
    return at_nodes([Symbol(name) for name in names], suffix)
