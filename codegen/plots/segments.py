"""What a figure shows of a problem with delays: the quantities of its segments, one after the other in time."""

from __future__ import annotations

import numpy as np

from codegen.interfaces import ControlModule, Matrix, Vector
from codegen.plots import quantities as of_segments
from codegen.plots.quantities import Inequality, Quantity
from codegen.solutions.result import Result
from codegen.solutions.segments import Segments, put_together, segments_of


def quantities(module: ControlModule, result: Result) -> dict[str, list[Quantity]]:
    """States, momenta, multipliers and controls of a result, each list in the order of declaration."""
    segments, cut = segments_of(module.metadata), result.by_segments
    if segments is None or cut is None:
        return of_segments.quantities(module, result)
    found = of_segments.quantities(module, cut)
    return {kind: _in_time(group, segments, cut) for kind, group in found.items()}


def inequalities(module: ControlModule, result: Result) -> list[Inequality]:
    """The path inequalities of a result, one for every condition that the author wrote."""
    cut = result.by_segments
    if cut is None:
        return of_segments.inequalities(module, result)
    duration, parts = float(cut.t[-1] - cut.t[0]), dict[str, list[tuple[Vector, Matrix]]]()
    for own in of_segments.inequalities(module, cut):
        name = own.name.removesuffix(f" in segment {own.segment}")
        parts.setdefault(name, []).append((own.t + (own.segment - 1) * duration, own.distance))
    return [
        Inequality(name, np.concatenate([t for t, _ in own]), np.concatenate([values for _, values in own]))
        for name, own in parts.items()
    ]


def first_guess(module: ControlModule, result: Result) -> Result:
    """The result as it would be if the solver had not moved from the problem's first guess."""
    if result.by_segments is None:
        return of_segments.first_guess(module, result)
    return put_together(of_segments.first_guess(module, result.by_segments), module.metadata)


def _in_time(group: list[Quantity], segments: Segments, cut: Result) -> list[Quantity]:
    """One quantity for those of all segments that have the same name."""
    names, columns = segments.columns([quantity.name for quantity in group])
    return [_joined(name, [group[i] for i in own], cut) for name, own in zip(names, columns.T, strict=True)]


def _joined(name: str, parts: list[Quantity], cut: Result) -> Quantity:
    """One quantity from those of its segments, which meet at nodes, but not within intervals."""
    first, duration = parts[0], float(cut.t[-1] - cut.t[0])
    at_nodes = first.t.size == cut.t.size

    def rows(tables: list[Matrix], meet: bool) -> Matrix:
        return np.concatenate([table[int(meet and i > 0) :] for i, table in enumerate(tables)])

    guesses = [part.guess for part in parts if part.guess is not None]
    return Quantity(
        name,
        first.kind,
        np.concatenate([part.t[int(at_nodes and i > 0) :] + i * duration for i, part in enumerate(parts)]),
        rows([part.values for part in parts], at_nodes and not first.on_intervals),
        first.lower,
        first.upper,
        rows(guesses, at_nodes and not first.on_intervals) if guesses else None,
        unit=cut.units.get(name, ""),
    )
