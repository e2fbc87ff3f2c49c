"""What the motion of a solution does inside intervals: path conditions on states alone, sampled between nodes.

The discrete equations hold such conditions at nodes, and where the scheme evaluates. On too coarse a grid a motion may
pass through a thin obstacle all the same, or jump from one branch of an equality to another. The solution is carried to
a grid on which every interval is cut in `PARTS`, then to one that has the peaks between these samples. The conditions
are read there off the gradient of the Lagrangian, by the module's own compiled code: at a new node they are what stands
beside their multipliers.

Poles of the equations of motion that a solution leaps over between two nodes.

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
from numpy.typing import NDArray

from codegen.runtime.record import Kind, Meaning, Place, phrase
from codegen.runtime.search.convergence import sizes_of_terms
from codegen.solving.loading import ControlModule, Grid, Matrix, Vector, time_grid


def cut(module: Any, coarse: Grid, cuts: Matrix) -> Grid:
    """The grid on which every interval is cut in the parts (intervals, parts) of it."""
    phases = module.metadata.phases
    parts = (np.diff(coarse.nodes)[:, None] * cuts).reshape(phases, -1)
    parts /= parts.sum(axis=1, keepdims=True)
    return time_grid(module, parts.shape[1], parts if phases > 1 else parts[0])


def carried(module: Any, coarse: Grid, fine: Grid, unknowns: Vector, parts: int, straight: bool = False) -> Vector:
    """The unknowns on the finer grid: states interpolated, what intervals have as it is, no slacks nor multipliers.

    States are straight lines between the nodes of a scheme of order two, or where that is asked for, and monotone
    cubics for higher orders.
    """
    result = np.zeros(fine.is_multiplier.size)
    nodes, intervals = module.views(coarse, unknowns)
    new_nodes, new_intervals = module.views(fine, result)
    order = module.metadata.order
    phases, old, new = module.metadata.phases, coarse.nodes / coarse.steps, fine.nodes / fine.steps
    for phase in range(phases):
        count = intervals.shape[1] // phases
        here, there = (slice(phase * n + min(phase, 1), (phase + 1) * n + 1) for n in (count, parts * count))
        new_nodes[:, there] = _interpolated(old[here], nodes[:, here], new[there], straight or order == 2)
    new_intervals[:] = np.repeat(intervals, parts, axis=1)
    new_intervals[:, :, module.problem.structure.slacks - nodes.shape[2]] = 0.0
    root = module.problem.structure.root
    result[result.size - root :] = unknowns[unknowns.size - root :]
    result[fine.is_multiplier] = 0.0
    return result


def _interpolated(t: Vector, values: Matrix, at: Vector, straight: bool) -> Matrix:
    if not straight and t.size > 2:
        from scipy.interpolate import PchipInterpolator  # which takes long to import

        with np.errstate(over="ignore"):  # reciprocals of slopes that are next to zero
            return np.asarray(PchipInterpolator(t, values, axis=1)(np.clip(at, t[0], t[-1])), dtype=float)
    left = np.clip(np.searchsorted(t, at, side="right") - 1, 0, max(0, t.size - 2))
    right = np.minimum(left + 1, t.size - 1)
    width = np.where(right > left, t[right] - t[left], 1.0)
    share = np.clip((at - t[left]) / width, 0.0, 1.0)[None, :, None]
    return np.asarray((1.0 - share) * values[:, left] + share * values[:, right])


PARTS = 8
"""In how many parts an interval is cut."""
GROSS = 0.05
"""Violations above it, in parts of the terms of a condition, are worth a note."""
NEGLIGIBLE = 1e-7
"""A violation that is less, in parts of the condition's largest terms along the motion, is none."""
INCREMENT = 1e-6
"""Relative increments by which sizes of terms are measured."""


@dataclass(frozen=True)
class Excursion:
    """How far a condition is violated inside an interval: its name, by how much, and when that is worst.

    `relative` is the violation d in parts of d + sum |x_i dg/dx_i|, between 0 and 1: next to a limit the distance to
    where the condition holds in parts of the states x, and 1 in the middle of an obstacle, where the gradient vanishes.
    `condition` is the module's name of it, with its segment where a delay cut the motion; `time` is that of the whole
    motion, in the problem's units. Of several bodies `body` is the number of the one that is worst.
    `segment` is 0 where no delay cut the motion.
    """

    condition: str
    violation: float
    relative: float
    time: float
    body: int | None = None
    segment: int = 0

    @property
    def is_gross(self) -> bool:
        """Whether a finer grid is called for."""
        return self.relative > GROSS

    @property
    def note(self) -> str:
        """What is to be said of it, and what helps."""
        of_body = "" if self.body is None else f" of body {self.body}"
        condition = self.condition.removesuffix(f" in segment {self.segment}")
        return (
            f"between nodes the motion{of_body} violates {condition} by {self.figures}: the grid is too coarse "
            "for it, and what was found may be no motion at all; take more --steps, or --doublings"
        )

    @property
    def figures(self) -> str:
        """By how much it is violated, and when."""
        percent = 100.0 * self.relative
        share = f"{percent:.0f}" if percent >= 1.0 else f"{percent:.1g}"
        return f"{self.violation:.2g} at t = {self.time:.4g}, {share} % of the size of its terms"


@dataclass(frozen=True)
class _Row:
    """A condition in the gradient: the index of its multiplier in a node or in an interval, and of states in a node."""

    name: str
    index: int
    equality: bool
    states: tuple[int, ...]
    phases: tuple[int, ...]
    segment: int


def excursions(module: ControlModule, unknowns: Vector, steps: int, fractions: Vector | None) -> list[Excursion]:
    """The worst violation between nodes of every path condition on states alone, and of every holonomic constraint.

    States are straight lines between the nodes of a scheme of order two, and monotone cubics for higher orders; the
    grid has `steps` equal intervals in every phase, or those of `fractions`. The first interval behind a switch is left
    out, since a state may jump there. Empty where nothing is violated.
    """
    rows = list(_rows(module))
    if not rows:
        return []
    coarse = time_grid(module, steps, fractions)
    intervals = module.metadata.phases * steps
    evenly = _Sampled(module, coarse, unknowns, np.full((intervals, PARTS), 1.0 / PARTS))
    found = list[Excursion]()
    for row in rows:
        worst = [_worst(evenly, row, steps)]
        shares = _peaks(row, evenly.values(row))
        if shares is not None:
            worst.append(_worst(_Sampled(module, coarse, unknowns, np.stack([shares, 1.0 - shares], 1)), row, steps))
        found += sorted((one for one in worst if one is not None), key=lambda one: one.relative)[-1:]
    return found


def sampled_conditions(module: ControlModule) -> tuple[str, ...]:
    """The names of the conditions that `excursions` looks at, each once."""
    return tuple(dict.fromkeys(row.name for row in _rows(module)))


def _rows(module: Any) -> Iterator[_Row]:
    """The conditions of a module in which nothing but states of one node, times and parameters occur."""
    metadata, structure = module.metadata, module.problem.structure
    first = structure.node
    partners = _partners(structure)
    stride = structure.stride
    every = tuple(range(metadata.phases))
    for i, name in enumerate(metadata.node):
        meaning = metadata.meanings.get(name)
        beside = partners.get(i, set()) - {i}
        own = {j for j in beside if j < first}
        if meaning and structure.is_multiplier[i] and own and not any(first <= j < stride + first for j in beside):
            yield _Row(_condition(meaning), i, True, tuple(sorted(own)), every, meaning.segment)
    for slack, multiplier in zip(structure.slacks, structure.slack_multipliers, strict=True):
        beside = partners.get(int(multiplier), set()) - {int(slack), int(multiplier)}
        if any(j < stride for j in beside):
            continue  # of the left node, or the interval
        states = tuple(sorted(j - stride for j in beside if j < stride + first))
        found: dict[Meaning, list[int]] = {}
        for phase, meanings in enumerate(metadata.slack_meanings):
            meaning = meanings.get(metadata.interval[slack - first])
            if meaning and meaning.kind.place == Place.INTERVAL and meaning.at == 1:
                found.setdefault(meaning, []).append(phase)
        for meaning, where in found.items():
            yield _Row(meaning.subject, int(multiplier), False, states, tuple(where), meaning.segment)


def _condition(meaning: Meaning) -> str:
    """The condition of a multiplier: a constraint as its author wrote it."""
    return meaning.of if meaning.kind == Kind.CONSTRAINT else phrase(meaning, role=False)


def _partners(structure: Any) -> dict[int, set[int]]:
    """For every index of an interval with both its nodes those with which the Hessian of the Lagrangian couples it."""
    found: dict[int, set[int]] = {}
    for i, j in zip(structure.rows.tolist(), structure.columns.tolist(), strict=True):
        found.setdefault(i, set()).add(j)
        found.setdefault(j, set()).add(i)
    return found


def _peaks(row: _Row, values: Matrix) -> Vector | None:
    """Where in every interval, in parts of it, a parabola through three samples is worst; None where none is violated.

    What is thinner than the distance of samples lies between two of them, and shows in how values bend around it.
    """
    left, middle, right = values[..., :-2], values[..., 1:-1], values[..., 2:]
    with np.errstate(all="ignore"):
        slope, bend = 0.5 * (right - left), left - 2.0 * middle + right
        offset = -slope / bend
        peak = middle + 0.5 * slope * offset
        height = np.abs(peak) if row.equality else np.where(bend < 0.0, peak, 0.0)
    height = np.where((np.abs(offset) < 1.0) & np.isfinite(height), height, 0.0)
    if height.max(initial=0.0) <= 0.0:
        return None
    intervals, triples = height.shape[1:]
    best = height.swapaxes(0, 1).reshape(intervals, -1).argmax(axis=1)
    body, triple = np.divmod(best, triples)
    every = np.arange(intervals)
    shares = (triple + 1 + offset[body, every, triple]) / (triples + 1)
    return np.where(height[body, every, triple] > 0.0, np.clip(shares, 1e-6, 1.0 - 1e-6), 0.5)


class _Sampled:
    """Values of conditions where every interval is cut in some parts of it (intervals, parts), and sizes of terms."""

    def __init__(self, module: Any, coarse: Grid, unknowns: Vector, cuts: Matrix) -> None:
        self.module, self.grid = module, cut(module, coarse, cuts)
        self.intervals, self.parts = cuts.shape
        self._unknowns = carried(module, coarse, self.grid, unknowns, self.parts)
        self._gradient = self._gradient_at(self._unknowns)
        self._moved: dict[int, Vector] = {}
        self.times = np.asarray(module.unpack(self.grid, self._unknowns)[0])

    def values(self, row: _Row, gradient: Vector | None = None) -> Matrix:
        """The condition's values (bodies, intervals, parts + 1), from the left node of an interval to its right one."""
        nodes, intervals = self.module.views(self.grid, self._gradient if gradient is None else gradient)
        width = nodes.shape[2]
        at_nodes = nodes[:, :, row.index] if row.equality else self._behind(intervals[:, :, row.index - width])
        index = self.parts * np.arange(self.intervals)[:, None] + np.arange(self.parts + 1)
        return np.asarray(at_nodes[:, index])

    def sizes(self, row: _Row) -> Matrix:
        """The sum of |x_i dg/dx_i| over all states, of the same shape."""
        values = self.values(row)
        total = np.zeros_like(values)
        for state in row.states:
            total += np.abs(self.values(row, self._beside(state)) - values) / INCREMENT
        return total

    @staticmethod
    def _behind(at_right: Matrix) -> Matrix:
        """Values at the right nodes of intervals as those at all nodes; the first node has none."""
        return np.concatenate([np.full((at_right.shape[0], 1), -np.inf), at_right], axis=1)

    def _beside(self, state: int) -> Vector:
        """The gradient where one state of every node is a little larger."""
        if state not in self._moved:
            moved = self._unknowns.copy()
            self.module.views(self.grid, moved)[0][:, :, state] *= 1.0 + INCREMENT
            self._moved[state] = self._gradient_at(moved)
        return self._moved[state]

    def _gradient_at(self, unknowns: Vector) -> Vector:
        gradient: Vector = self.module.evaluate(self.grid, unknowns).gradient
        return gradient


def _worst(sampled: _Sampled, row: _Row, steps: int) -> Excursion | None:
    """Where a condition is worst inside intervals, beyond what it is at their nodes."""
    values = sampled.values(row)
    violation = np.abs(values) if row.equality else np.maximum(values, 0.0)
    at_nodes = np.maximum(violation[:, :, :1], violation[:, :, -1:])
    beyond: NDArray[np.float64] = np.nan_to_num(violation - at_nodes, nan=0.0, posinf=0.0)[:, :, 1:-1]
    # Which intervals belong to the phases of a condition, without the first behind a switch.
    phase, number = np.divmod(np.arange(beyond.shape[1]), steps)
    beyond[:, ~np.asarray(np.isin(phase, row.phases) & ((phase == 0) | (number > 0)))] = 0.0
    if beyond.max(initial=0.0) <= 0.0:
        return None
    with np.errstate(invalid="ignore"):
        sizes = np.nan_to_num(sampled.sizes(row), nan=0.0, posinf=0.0)
    largest = max(sizes.max(), np.abs(values[np.isfinite(values)]).max(initial=0.0))
    inside = sizes[:, :, 1:-1]
    relative = np.where(beyond > NEGLIGIBLE * largest, beyond / np.maximum(beyond + inside, 1e-300), 0.0)
    if relative.max() <= 0.0:
        return None
    body, interval, part = np.unravel_index(int(np.argmax(relative)), relative.shape)
    metadata, time = sampled.module.metadata, sampled.times[sampled.parts * interval + part + 1]
    time += max(row.segment - 1, 0) * (sampled.times[-1] - sampled.times[0])
    worst, own = (body, interval, part), int(body) if metadata.bodies > 1 else None
    return Excursion(row.name, float(beyond[worst]), float(relative[worst]), float(time), own, row.segment)


PARTS_OF_STEP = 8
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
NEGLIGIBLE_POLE, ROUNDING = 1e-6, 1e-9
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
    evenly = np.full((len(lengths), PARTS_OF_STEP), 1.0 / PARTS_OF_STEP)
    first = _Looked(module, coarse, unknowns, evenly)
    suspects = list(_suspects(first, sizes_of_terms(coarse, unknowns)[0], steps))
    if not suspects:
        return []
    evenly = np.full((len(lengths), PARTS_OF_STEP + 2), 1.0 / (PARTS_OF_STEP + 2))
    for level in range(LEVELS):
        width = (BESIDE / PARTS_OF_STEP) * (2.0 * BESIDE / PARTS_OF_STEP) ** level
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
    parts = np.diff(np.concatenate([[0.0], np.linspace(begin, end, PARTS_OF_STEP + 1), [1.0]]))
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
        return np.maximum(usual, max(NEGLIGIBLE_POLE * largest, 1e-300))

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
