"""Poles of the equations of motion that a solution leaps over between two nodes.

A thrust over a mass that falls through zero, say: the discrete equations hold, since they are evaluated on either side,
and no motion goes on beyond the pole. Where the solution is a straight line between nodes, what the equations give for
its states is read off the gradient of the Lagrangian on a finer grid, and looked at ever more closely around its
largest change. Near a pole that grows without end; a smooth right-hand side, however steep, comes to rest.

Stages of explicit schemes beyond the bounds of states, where the dynamics were evaluated all the same. A stage of an
explicit scheme follows from the node before it less accurately than the step does, so that no bound is imposed on it.
Kinetics that change their sign beyond a bound lead to a motion that does not exist.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from codegen.interfaces import ControlModule, Grid, Matrix, Vector, time_grid
from codegen.runtime.record import Kind
from codegen.runtime.search.convergence import sizes_of_terms
from codegen.solutions.between_nodes import carried, cut

PARTS = 8
"""In how many parts an interval is cut, and then what surrounds the largest change."""
LEVELS = 8
"""How often one looks more closely, each time at three eighths of the distance."""
BESIDE = 1.5
"""Parts to either side of the largest change that are looked at: nodes tell nothing of what is next to an end."""
CONSPICUOUS = 5.0
"""Largest change from part to part on an interval, in units of what is usual there, that is worth a closer look."""
WITHOUT_END = 1e3
"""The same at the end: at a simple pole it is some 2.7^LEVELS, and less than one where a right-hand side is smooth."""
GROWTH = 16.0
"""How many times as large it has become on the last levels: at a pole some hundred, at a jump it stays the same."""
SHORTEST, ROOM, LEAST_FRACTION = 1e-5, 2e-10, 1e-8
"""Part of an interval, and of the duration, that is left where nothing has to be looked at, since grids have no
intervals without a length; and the shortest interval that can be cut so."""
NEGLIGIBLE, ROUNDING = 1e-6, 1e-9
"""Parts of the largest value on all intervals, and of the largest terms of equations, below which a change is none."""


@dataclass(frozen=True)
class Pole:
    """A pole of the equation of a state inside an interval: name of the state, time, and body if there are several."""

    state: str
    time: float
    body: int | None = None

    @property
    def note(self) -> str:
        """The message for the author, with the remedy."""
        of_body = "" if self.body is None else f" of body {self.body}"
        return (
            f"between nodes, at t = {self.time:.4g}, the equation of {self.state}{of_body} grows without end: what was "
            "found leaps over a pole, and may be no motion beyond it; keep what is divided by away from zero by bounds"
        )


@dataclass(frozen=True)
class _Equation:
    """The equation of a state, and its index among the unknowns of a node, or else of an interval."""

    state: str
    place: int
    at_nodes: bool


def poles(module: ControlModule, unknowns: Vector, steps: int, fractions: Vector | None) -> list[Pole]:
    """The poles that a solution leaps over, one at most of each equation of motion, and in each interval.

    `unknowns` (n,) are those of `steps` intervals in each phase, equal ones or those of `fractions`. The first interval
    behind a switch is left out, since a state may jump there, and so are grids with intervals below `LEAST_FRACTION`.
    """
    coarse = time_grid(module, steps, fractions)
    lengths = np.diff(coarse.nodes) / steps
    if lengths.min() < LEAST_FRACTION:
        return []
    evenly = np.full((len(lengths), PARTS), 1.0 / PARTS)
    first = _Looked(module, coarse, unknowns, evenly)
    suspects = list(_suspects(first, sizes_of_terms(coarse, unknowns)[0], steps))
    if not suspects:
        return []
    evenly = np.full((len(lengths), PARTS + 2), 1.0 / (PARTS + 2))
    for level in range(LEVELS):
        width = (BESIDE / PARTS) * (2.0 * BESIDE / PARTS) ** level
        cuts = evenly.copy()
        for suspect in suspects:
            cuts[suspect.interval] = _around(suspect.middle, width, ROOM / lengths[suspect.interval])
        closer = _Looked(module, coarse, unknowns, cuts)
        suspects = [suspect.closer(closer) for suspect in suspects]
    return [
        Pole(s.equation.state, first.time(s.interval, s.middle), s.body if module.metadata.bodies > 1 else None)
        for s in suspects
        if s.grows_without_end
    ]


@dataclass(frozen=True)
class _Suspect:
    """An equation that changes much inside an interval: where, in parts of it, what is usual, and changes so far."""

    equation: _Equation
    body: int
    interval: int
    middle: float
    usual: float
    largest: tuple[float, ...] = ()

    def closer(self, looked: _Looked) -> _Suspect:
        """The same after a closer look."""
        here = looked.changes(self.equation)[self.body, self.interval]
        part = int(np.argmax(here))
        middle = looked.middle(self.equation, self.interval, part)
        return replace(self, middle=middle, largest=(*self.largest, float(here[part])))

    @property
    def grows_without_end(self) -> bool:
        """Whether the changes say that there is a pole."""
        return self.largest[-1] > max(WITHOUT_END * self.usual, GROWTH * min(self.largest[: LEVELS // 2]))


def _suspects(first: _Looked, terms: float, steps: int) -> Iterator[_Suspect]:
    """Of every equation the interval in which it changes most, if that is worth a closer look; each interval once."""
    lengths, taken = np.diff(first.grid.nodes).reshape(first.cuts.shape).mean(axis=1), set[int]()
    for equation in _equations(first.module):
        changes = first.changes(equation)
        changes[:, np.flatnonzero(np.arange(len(lengths)) % steps == 0)[1:]] = 0.0
        usual = np.maximum(first.usual(equation), ROUNDING * terms / lengths)
        body, interval, part = map(int, np.unravel_index(int(np.argmax(changes / usual[..., None])), changes.shape))
        ordinary = float(usual[body, interval])
        if interval not in taken and changes[body, interval, part] >= CONSPICUOUS * ordinary:
            taken.add(interval)
            yield _Suspect(equation, body, interval, first.middle(equation, interval, part), ordinary)


def _equations(module: Any) -> Iterator[_Equation]:
    """The equations of motion of a module's states, without those of stages."""
    metadata = module.metadata
    nodes = list(metadata.node)
    for at_nodes, names in ((True, nodes), (False, metadata.interval)):
        for place, name in enumerate(names):
            meaning = metadata.meanings.get(name)
            if meaning and meaning.kind in (Kind.STEP, Kind.MOTION) and meaning.of in nodes:
                yield _Equation(meaning.of, place, at_nodes)


def _around(middle: float, width: float, room: float) -> Vector:
    """Parts of an interval: those before and behind what is looked at, `width` to either side of its middle, inside.

    Each is `room` long at least.
    """
    begin, end = max(0.0, middle - width), min(1.0, middle + width)
    parts = np.diff(np.concatenate([[0.0], np.linspace(begin, end, PARTS + 1), [1.0]]))
    parts = np.maximum(parts, max(SHORTEST, room))
    return np.asarray(parts / parts.sum())


class _Looked:
    """The equations of motion on a finer grid, on which a solution is straight inside every interval."""

    def __init__(self, module: Any, coarse: Grid, unknowns: Vector, cuts: Matrix) -> None:
        self.module, self.cuts, self.grid = module, cuts, cut(module, coarse, cuts)
        self._unknowns = carried(module, coarse, self.grid, unknowns, cuts.shape[1], straight=True)
        # Have stages lie between the nodes of the finer grid.
        nodes, intervals = self.module.views(self.grid, self._unknowns)
        names = list(self.module.metadata.node)
        for place, name in enumerate(self.module.metadata.interval):
            of = self.module.metadata.stages.get(name)
            if of in names and not self.module.problem.structure.is_multiplier[nodes.shape[2] + place]:
                state = nodes[:, :, names.index(of)]
                intervals[:, :, place] = 0.5 * (state[:, :-1] + state[:, 1:])
        self._gradient = module.evaluate(self.grid, self._unknowns).gradient

    def changes(self, equation: _Equation) -> Matrix:
        """How much what an equation gives changes from part to part of intervals: (bodies, intervals, parts - 1).

        At nodes those inside intervals count alone, of which there is one less. What is no number counts as zero.
        """
        return np.abs(np.diff(self._values(equation), axis=2))

    def usual(self, equation: _Equation) -> Matrix:
        """The median of these changes on each interval (bodies, intervals), or what is negligible, if that is more."""
        largest = float(np.abs(self._values(equation)).max())
        usual: Matrix = np.median(self.changes(equation), axis=2)
        return np.maximum(usual, max(NEGLIGIBLE * largest, 1e-300))

    def middle(self, equation: _Equation, interval: int, part: int) -> float:
        """Where a change is, in parts of an interval."""
        ends = np.concatenate([[0.0], np.cumsum(self.cuts[interval])])
        looked = ends[1:-1] if equation.at_nodes else 0.5 * (ends[:-1] + ends[1:])
        return float(0.5 * (looked[part] + looked[part + 1]))

    def _values(self, equation: _Equation) -> Matrix:
        """What an equation gives per length of an interval, in every part of it or at the nodes between the parts."""
        nodes, intervals = self.module.views(self.grid, self._gradient)
        lengths = np.diff(self.grid.nodes).reshape(self.cuts.shape)
        if equation.at_nodes:
            rows = nodes[:, :-1, equation.place].reshape(-1, *self.cuts.shape)[:, :, 1:]
            lengths = 0.5 * (lengths[:, :-1] + lengths[:, 1:])
        else:
            rows = intervals[:, :, equation.place].reshape(-1, *self.cuts.shape)
        return np.asarray(np.nan_to_num(rows / lengths, nan=0.0, posinf=0.0, neginf=0.0))

    def time(self, interval: int, share: float) -> float:
        """The time at a part of an interval."""
        times = np.asarray(self.module.unpack(self.grid, self._unknowns)[0])
        begin, end = times[interval * self.cuts.shape[1]], times[(interval + 1) * self.cuts.shape[1]]
        return float(begin + share * (end - begin))


STAGES_NEGLIGIBLE = 1e-6
"""Part of a state's largest value by which a stage may be beyond a bound."""


@dataclass(frozen=True)
class StageBeyond:
    """The stage of a state that is farthest beyond a bound: its value, the bound, and when its interval begins."""

    state: str
    value: float
    limit: float
    time: float
    body: int | None = None

    @property
    def note(self) -> str:
        """The message for the author, with the remedy."""
        of_body = "" if self.body is None else f" of body {self.body}"
        return (
            f"{self.state}{of_body} is {self.value:.4g} at a stage of the interval from t = {self.time:.4g}, "
            f"{abs(self.value - self.limit):.2g} beyond its bound, and the dynamics were evaluated there: the scheme "
            "holds bounds at nodes alone; take gauss-4, or more --steps"
        )


def stages_beyond(
    module: ControlModule, unknowns: Vector, steps: int, fractions: Vector | None
) -> Iterator[StageBeyond]:
    """The worst stage of every state whose stages have no bounds, though the state has, if any is beyond them.

    `unknowns` (n,) are those of `steps` intervals in each phase, equal ones or those of `fractions`.
    """
    generated: Any = module
    metadata = module.metadata
    if not metadata.inequalities or any(m.kind == Kind.BOUND_SLACK for m in metadata.meanings.values()):
        return
    grid, names = time_grid(module, steps, fractions), list(metadata.node)
    nodes, intervals = generated.views(grid, unknowns)
    limits = [generated.views(grid, bound) for bound in module.variable_bounds(grid)]
    stages = dict[str, list[int]]()
    for column, name in enumerate(metadata.interval):
        state = metadata.stages.get(name)
        if state in names and not generated.problem.structure.is_multiplier[len(names) + column]:
            stages.setdefault(state, []).append(column)
    times = module.unpack(grid, unknowns)[0] if stages else np.empty(0)
    for state, columns in stages.items():
        if any(np.isfinite(inside[:, :, columns]).any() for _, inside in limits):
            continue
        of_nodes = [at_nodes[:, :, names.index(state)] for at_nodes, _ in limits]
        lower, upper = (_usual(bound, steps)[:, :, None] for bound in of_nodes)
        values = intervals[:, :, columns]
        beyond = np.maximum(lower - values, values - upper)
        worst = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
        if beyond[worst] <= STAGES_NEGLIGIBLE * max(1e-300, np.abs(nodes[:, :, names.index(state)]).max()):
            continue
        body, interval, _ = map(int, worst)
        limit = (lower if values[worst] < lower[body, interval, 0] else upper)[body, interval, 0]
        own = body if metadata.bodies > 1 else None
        yield StageBeyond(state, float(values[worst]), float(limit), float(times[interval]), own)


def _usual(bounds: np.ndarray, steps: int) -> np.ndarray:
    """For every interval (bodies, intervals) the bound that most nodes of its phase have; ends may have others."""
    phases = (bounds.shape[1] - 1) // steps
    own = [bounds[:, phase * steps + min(phase, 1) : (phase + 1) * steps + 1] for phase in range(phases)]
    middles = [np.sort(part, axis=1)[:, part.shape[1] // 2] for part in own]
    return np.repeat(np.stack(middles, axis=1), steps, axis=1)
