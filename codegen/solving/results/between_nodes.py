"""The motion of a solution inside intervals: violated path conditions, poles, and stages beyond bounds.

Path conditions on states alone hold at nodes, and at the points where the scheme evaluates. On a coarse grid a motion
may still pass through a thin obstacle, or jump from one branch of an equality to another. The solution is therefore
transferred to two finer grids. The first one divides every interval into `PARTS` equal parts. The second one has a node
at the largest violation inside every interval, which a parabola through the values on the first grid predicts. The
value of a condition is the derivative of the Lagrangian with respect to its multiplier. Compiled code of the module
evaluates the gradient of the Lagrangian.

A pole of the equations of motion may lie between two nodes, for example if a thrust is divided by a mass that passes
through zero. The discrete equations hold on both sides of a pole, but no motion crosses it. The solution is
interpolated linearly between the nodes. The right-hand sides along this line are components of the gradient of the
Lagrangian on a finer grid. The grid is refined repeatedly around their largest change. Near a pole the change grows
without limit; for a smooth right-hand side, however steep, it converges to zero.

Stages of explicit schemes may lie beyond the bounds of states, although the dynamics were evaluated there. An explicit
scheme computes a stage less accurately than the step, and no bound is imposed on the stage. Reaction rates that change
their sign beyond a bound then lead to a motion that does not exist.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from codegen.runtime.record import Kind, Meaning, Place, phrase
from codegen.runtime.search.termination import sizes_of_terms
from codegen.solving.loading import ControlModule, Grid, Matrix, Vector, time_grid
from codegen.solving.warm_start import interpolated

PARTS = 8
"""Number of parts into which every interval is divided."""
GROSS = 0.05
"""Violation, relative to the terms of the condition, above which the user is warned."""
NEGLIGIBLE = 1e-7
"""Violations below this multiple of the largest term of the condition along the motion are ignored."""
INCREMENT = 1e-6
"""Relative increment of the finite differences that measure the terms of a condition."""
LEVELS = 8
"""Number of refinements around a suspected pole; each one reduces the refined neighbourhood to three eighths."""
BESIDE = 1.5
"""Half width, relative to an interval, of the first neighbourhood that is refined around the largest change."""
CONSPICUOUS = 5.0
"""A pole is suspected if the largest change between two parts exceeds the usual change of the interval by this."""
WITHOUT_END = 1e3
"""The same ratio that confirms a pole after all refinements.

The ratio is about 2.7^LEVELS at a simple pole, and less than one for a smooth right-hand side.
"""
GROWTH = 16.0
"""Least ratio of the change in the last refinement to the smallest change in the first half of the refinements.

The ratio is some hundred at a pole, and one at a jump.
"""
SHORTEST, ROOM, LEAST_FRACTION = 1e-5, 2e-10, 1e-8
"""Least length of a part relative to its interval, of a part relative to the duration, and of an interval.

Grids with an interval shorter than the fraction `LEAST_FRACTION` of the duration are not searched for poles.
"""
NEGLIGIBLE_POLE, ROUNDING = 1e-6, 1e-9
"""Negligible change, relative to the largest value of the equation, and to the largest terms of all equations."""
STAGES_NEGLIGIBLE = 1e-6
"""Distance of a stage from a bound that is ignored, relative to the largest value of the state."""


# Transfer to finer grids


def _divided(module: ControlModule, coarse: Grid, cuts: Matrix) -> Grid:
    """Return the finer grid: row i of `cuts` (intervals, parts) has the relative lengths of the parts of interval i."""
    phases = module.metadata.phases
    parts = (np.diff(coarse.nodes)[:, None] * cuts).reshape(phases, -1)
    parts /= parts.sum(axis=1, keepdims=True)
    return time_grid(module, parts.shape[1], parts if phases > 1 else parts[0])


def _transferred(
    module: ControlModule, coarse: Grid, fine: Grid, unknowns: Vector, parts: int, straight: bool = False
) -> Vector:
    """Return the unknowns of a solution on the grid `fine`, which divides each interval of `coarse` into `parts`.

    States are interpolated linearly for a scheme of order two or if `straight` is True, otherwise by monotone cubics.
    Values on intervals are repeated for each part. Slacks and multipliers are zero.
    """
    result = np.zeros(fine.is_multiplier.size)
    nodes, intervals = module.views(coarse, unknowns)
    new_nodes, new_intervals = module.views(fine, result)
    straight = straight or module.metadata.order == 2
    phases = module.metadata.phases
    for phase in range(phases):
        count = intervals.shape[1] // phases
        old, new = (slice(phase * n + min(phase, 1), (phase + 1) * n + 1) for n in (count, parts * count))
        t, at, values = (coarse.nodes / coarse.steps)[old], (fine.nodes / fine.steps)[new], nodes[:, old]
        if straight or t.size <= 2:
            left = np.clip(np.searchsorted(t, at, side="right") - 1, 0, max(0, t.size - 2))
            right = np.minimum(left + 1, t.size - 1)
            width = np.where(right > left, t[right] - t[left], 1.0)
            share = np.clip((at - t[left]) / width, 0.0, 1.0)[None, :, None]
            new_nodes[:, new] = (1.0 - share) * values[:, left] + share * values[:, right]
        else:
            new_nodes[:, new] = interpolated(t, values, at)
    new_intervals[:] = np.repeat(intervals, parts, axis=1)
    new_intervals[:, :, module.problem.structure.slacks - nodes.shape[2]] = 0.0
    root = module.problem.structure.root
    result[result.size - root :] = unknowns[unknowns.size - root :]
    result[fine.is_multiplier] = 0.0
    return result


def _of_body(body: int | None) -> str:
    return "" if body is None else f" of body {body}"


# Path conditions


@dataclass(frozen=True)
class Excursion:
    """The worst violation of a path condition or holonomic constraint g(x) inside an interval.

    Attributes
    ----------
    condition : str
        Name of the condition in the module; a problem with delays appends the segment of the motion.
    violation, relative : float
        Violation d, and d relative to d + sum |x_i dg/dx_i|, between 0 and 1. Close to the feasible set, `relative` is
        the distance to the feasible set relative to the states x. In the middle of an obstacle, where the gradient
        vanishes, `relative` is 1.
    time : float
        Time of the violation, measured from the start of the whole motion.
    body : int or None
        Number of the body from 0; None for a single body.
    segment : int
        Number of the segment of a problem with delays, from 1; 0 without delays.
    """

    condition: str
    violation: float
    relative: float
    time: float
    body: int | None = None
    segment: int = 0

    @property
    def is_gross(self) -> bool:
        """True if the violation requires a finer grid."""
        return self.relative > GROSS

    @property
    def note(self) -> str:
        """The warning for the user, with the remedy."""
        condition = self.condition.removesuffix(f" in segment {self.segment}")
        return (
            f"between nodes the motion{_of_body(self.body)} violates {condition} by {self.figures}: the grid is too "
            "coarse for it, and what was found may be no motion at all; take more --steps, or --doublings"
        )

    @property
    def figures(self) -> str:
        """The text of the amount, the time and the relative size of the violation."""
        percent = 100.0 * self.relative
        share = f"{percent:.0f}" if percent >= 1.0 else f"{percent:.1g}"
        return f"{self.violation:.2g} at t = {self.time:.4g}, {share} % of the size of its terms"


@dataclass(frozen=True)
class _Row:
    """A path condition or holonomic constraint, with its location in the gradient of the Lagrangian.

    `index` is the index of its multiplier among the unknowns of a node for an `equality`, and otherwise among the
    unknowns of a node and the interval after it. `states` are the indices in a node of the states on which the
    condition depends. `phases` are the phases in which it is imposed.
    """

    name: str
    index: int
    equality: bool
    states: tuple[int, ...]
    phases: tuple[int, ...]
    segment: int


def excursions(module: ControlModule, unknowns: Vector, steps: int, fractions: Vector | None) -> list[Excursion]:
    """Return the worst violation between nodes of every path condition on states and of every holonomic constraint.

    The grid has `steps` intervals in every phase. `fractions` are the lengths of the intervals relative to the
    duration; None means equal intervals. The first interval after a switch is omitted, because a state may jump there.
    Conditions without a significant violation are not in the list.
    """
    rows = list(_rows(module))
    if not rows:
        return []
    coarse = time_grid(module, steps, fractions)
    intervals = module.metadata.phases * steps
    evenly = _Sampled(module, coarse, unknowns, np.full((intervals, PARTS), 1.0 / PARTS))
    worst = list[Excursion]()
    for row in rows:
        candidates = [_worst(evenly, row, steps)]
        shares = _peaks(row, evenly.values(row))
        if shares is not None:
            at_peaks = _Sampled(module, coarse, unknowns, np.stack([shares, 1.0 - shares], 1))
            candidates.append(_worst(at_peaks, row, steps))
        worst += sorted((one for one in candidates if one is not None), key=lambda one: one.relative)[-1:]
    return worst


def sampled_conditions(module: ControlModule) -> tuple[str, ...]:
    """Return the names of the conditions that `excursions` evaluates."""
    return tuple(dict.fromkeys(row.name for row in _rows(module)))


def _rows(module: ControlModule) -> Iterator[_Row]:
    """Yield the conditions of a module that depend only on the states of one node, on time and on parameters."""
    metadata, structure = module.metadata, module.problem.structure
    first, stride = structure.node, structure.stride
    # Indices count the unknowns of a node, an interval and the next node. Partners of an index are all indices with
    # which the Hessian of the Lagrangian has a non-zero entry.
    partners: dict[int, set[int]] = {}
    for i, j in zip(structure.rows.tolist(), structure.columns.tolist(), strict=True):
        partners.setdefault(i, set()).add(j)
        partners.setdefault(j, set()).add(i)
    every = tuple(range(metadata.phases))
    for i, name in enumerate(metadata.node):
        meaning = metadata.meanings.get(name)
        coupled = partners.get(i, set()) - {i}
        same_node = {j for j in coupled if j < first}
        if not (meaning and structure.is_multiplier[i] and same_node):
            continue
        if not any(first <= j < stride + first for j in coupled):
            condition = meaning.of if meaning.kind == Kind.CONSTRAINT else phrase(meaning, role=False)
            yield _Row(condition, i, True, tuple(sorted(same_node)), every, meaning.segment)
    for slack, multiplier in zip(structure.slacks, structure.slack_multipliers, strict=True):
        coupled = partners.get(int(multiplier), set()) - {int(slack), int(multiplier)}
        if any(j < stride for j in coupled):
            continue  # depends on the left node, or on the interval
        states = tuple(sorted(j - stride for j in coupled if j < stride + first))
        phases: dict[Meaning, list[int]] = {}
        for phase, meanings in enumerate(metadata.slack_meanings):
            meaning = meanings.get(metadata.interval[slack - first])
            if meaning and meaning.kind.place == Place.INTERVAL and meaning.at == 1:
                phases.setdefault(meaning, []).append(phase)
        for meaning, where in phases.items():
            yield _Row(meaning.subject, int(multiplier), False, states, tuple(where), meaning.segment)


class _Sampled:
    """A solution on a finer grid, with the values of conditions and the magnitudes of their terms.

    Row i of `cuts` (intervals, parts) has the relative lengths of the parts of interval i.
    """

    def __init__(self, module: ControlModule, coarse: Grid, unknowns: Vector, cuts: Matrix) -> None:
        self.module, self.grid = module, _divided(module, coarse, cuts)
        self.intervals, self.parts = cuts.shape
        self._unknowns = _transferred(module, coarse, self.grid, unknowns, self.parts)
        self._gradient = module.evaluate(self.grid, self._unknowns).gradient
        self._perturbed: dict[int, Vector] = {}
        self.times = np.asarray(module.unpack(self.grid, self._unknowns)[0])

    def values(self, row: _Row, gradient: Vector | None = None) -> Matrix:
        """Return the values of a condition (bodies, intervals, parts + 1) from the left to the right node of intervals.

        The values are read from `gradient`, the gradient of the Lagrangian; None means the gradient at the solution.
        """
        nodes, intervals = self.module.views(self.grid, self._gradient if gradient is None else gradient)
        if row.equality:
            at_nodes = nodes[:, :, row.index]
        else:  # an inequality has a value at the right node of each interval, and none at the first node
            at_right = intervals[:, :, row.index - nodes.shape[2]]
            at_nodes = np.concatenate([np.full((at_right.shape[0], 1), -np.inf), at_right], axis=1)
        index = self.parts * np.arange(self.intervals)[:, None] + np.arange(self.parts + 1)
        return np.asarray(at_nodes[:, index])

    def terms(self, row: _Row) -> Matrix:
        """Return the sum of |x_i dg/dx_i| over all states x_i, for the condition g of a row, shaped as `values`."""
        values = self.values(row)
        total = np.zeros_like(values)
        for state in row.states:
            if state not in self._perturbed:
                perturbed = self._unknowns.copy()
                self.module.views(self.grid, perturbed)[0][:, :, state] *= 1.0 + INCREMENT
                self._perturbed[state] = self.module.evaluate(self.grid, perturbed).gradient
            total += np.abs(self.values(row, self._perturbed[state]) - values) / INCREMENT
        return total


def _peaks(row: _Row, values: Matrix) -> Vector | None:
    """Return the positions (intervals,) of the largest violation inside each interval, as fractions of the interval.

    `values` (bodies, intervals, parts + 1) are values of the condition. Each position is the extremum of a parabola
    through three neighbouring values. An obstacle that is thinner than a part lies between two values, and still bends
    the values around it. Intervals without a violation have the position 1/2. Return None if no interval has one.
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


def _worst(sampled: _Sampled, row: _Row, steps: int) -> Excursion | None:
    """Return the worst violation of a condition inside intervals, relative to its terms; None if it is negligible.

    The larger violation at the two nodes of an interval is subtracted. Every phase has `steps` intervals.
    """
    values = sampled.values(row)
    violation = np.abs(values) if row.equality else np.maximum(values, 0.0)
    at_nodes = np.maximum(violation[:, :, :1], violation[:, :, -1:])
    beyond: NDArray[np.float64] = np.nan_to_num(violation - at_nodes, nan=0.0, posinf=0.0)[:, :, 1:-1]
    # Omit intervals of other phases, and the first interval after a switch.
    phase, number = np.divmod(np.arange(beyond.shape[1]), steps)
    beyond[:, ~np.asarray(np.isin(phase, row.phases) & ((phase == 0) | (number > 0)))] = 0.0
    if beyond.max(initial=0.0) <= 0.0:
        return None
    with np.errstate(invalid="ignore"):
        terms = np.nan_to_num(sampled.terms(row), nan=0.0, posinf=0.0)
    largest = max(terms.max(), np.abs(values[np.isfinite(values)]).max(initial=0.0))
    inside = terms[:, :, 1:-1]
    relative = np.where(beyond > NEGLIGIBLE * largest, beyond / np.maximum(beyond + inside, 1e-300), 0.0)
    if relative.max() <= 0.0:
        return None
    worst = np.unravel_index(int(np.argmax(relative)), relative.shape)
    body, interval, part = worst
    time = sampled.times[sampled.parts * interval + part + 1]
    time += max(row.segment - 1, 0) * (sampled.times[-1] - sampled.times[0])
    number_of_body = int(body) if sampled.module.metadata.bodies > 1 else None
    figures = float(beyond[worst]), float(relative[worst]), float(time)
    return Excursion(row.name, *figures, number_of_body, row.segment)


# Poles


@dataclass(frozen=True)
class Pole:
    """A pole inside an interval, where the equation of motion of a state is infinite.

    `state` is the name of the state. `body` is the number of the body from 0, or None for a single body.
    """

    state: str
    time: float
    body: int | None = None

    @property
    def note(self) -> str:
        """The warning for the user, with the remedy."""
        return (
            f"between nodes, at t = {self.time:.4g}, the equation of {self.state}{_of_body(self.body)} grows without "
            "end: what was found leaps over a pole, and may be no motion beyond it; keep what is divided by away from "
            "zero by bounds"
        )


@dataclass(frozen=True)
class _Equation:
    """The equation of motion of a state.

    `index` is the index of its multiplier among the unknowns of a node if `at_nodes`, otherwise of an interval.
    """

    state: str
    index: int
    at_nodes: bool


@dataclass(frozen=True)
class _Suspect:
    """An equation of motion with a conspicuously large change inside an interval, which may be a pole.

    `middle` is the position of the change as a fraction of the interval. `usual` is the usual change in the interval.
    `largest` has the largest change of each refinement so far.
    """

    equation: _Equation
    body: int
    interval: int
    middle: float
    usual: float
    largest: tuple[float, ...] = ()


def poles(module: ControlModule, unknowns: Vector, steps: int, fractions: Vector | None) -> list[Pole]:
    """Return the poles that a solution crosses: at most one pole per equation of motion, and at most one per interval.

    `unknowns` (n,) belong to `steps` intervals in each phase. `fractions` are the lengths of the intervals relative to
    the duration; None means equal intervals. The first interval after a switch is omitted, because a state may jump
    there. The list is empty if an interval is shorter than `LEAST_FRACTION`.
    """
    coarse = time_grid(module, steps, fractions)
    lengths = np.diff(coarse.nodes) / steps
    if lengths.min() < LEAST_FRACTION:
        return []
    first = _Refined(module, coarse, unknowns, np.full((len(lengths), PARTS), 1.0 / PARTS))
    rounding = ROUNDING * sizes_of_terms(coarse, unknowns)[0]
    mean_lengths = np.diff(first.grid.nodes).reshape(first.cuts.shape).mean(axis=1)
    suspects, intervals = list[_Suspect](), set[int]()
    after_switches = np.arange(steps, len(lengths), steps)
    for equation in first.equations():
        values = first.values(equation)
        changes = _changes(values)
        changes[:, after_switches] = 0.0
        usual = np.maximum(_usual_changes(values), rounding / mean_lengths)
        body, interval, part = map(int, np.unravel_index(int(np.argmax(changes / usual[..., None])), changes.shape))
        ordinary = float(usual[body, interval])
        if interval not in intervals and changes[body, interval, part] >= CONSPICUOUS * ordinary:
            intervals.add(interval)
            suspects.append(_Suspect(equation, body, interval, first.middle(equation, interval, part), ordinary))
    if not suspects:
        return []
    evenly = np.full((len(lengths), PARTS + 2), 1.0 / (PARTS + 2))
    for level in range(LEVELS):
        width = (BESIDE / PARTS) * (2.0 * BESIDE / PARTS) ** level
        cuts = evenly.copy()
        for suspect in suspects:  # PARTS short parts around the middle, and the rest of the interval on each side
            begin, end = max(0.0, suspect.middle - width), min(1.0, suspect.middle + width)
            parts = np.diff(np.concatenate([[0.0], np.linspace(begin, end, PARTS + 1), [1.0]]))
            parts = np.maximum(parts, max(SHORTEST, ROOM / lengths[suspect.interval]))
            cuts[suspect.interval] = parts / parts.sum()
        finer = _Refined(module, coarse, unknowns, cuts)
        for number, suspect in enumerate(suspects):
            changes = _changes(finer.values(suspect.equation))[suspect.body, suspect.interval]
            part = int(np.argmax(changes))
            middle = finer.middle(suspect.equation, suspect.interval, part)
            suspects[number] = replace(suspect, middle=middle, largest=(*suspect.largest, float(changes[part])))
    return [
        Pole(s.equation.state, first.time(s.interval, s.middle), s.body if module.metadata.bodies > 1 else None)
        for s in suspects
        if s.largest[-1] > max(WITHOUT_END * s.usual, GROWTH * min(s.largest[: LEVELS // 2]))
    ]


def _changes(values: Matrix) -> Matrix:
    """Return the absolute changes (..., m - 1) between neighbouring values (..., m)."""
    return np.abs(values[..., 1:] - values[..., :-1])


def _usual_changes(values: Matrix) -> Matrix:
    """Return the median change of the values (bodies, intervals, m) in each interval, shape (bodies, intervals).

    The median is at least `NEGLIGIBLE_POLE` times the largest of all values.
    """
    ordered = np.sort(_changes(values), axis=-1)
    middle = ordered.shape[-1] // 2
    median = ordered[..., middle] if ordered.shape[-1] % 2 else 0.5 * (ordered[..., middle - 1] + ordered[..., middle])
    return np.maximum(median, max(NEGLIGIBLE_POLE * float(np.abs(values).max()), 1e-300))


class _Refined:
    """The equations of motion on a finer grid, on which the solution is linear inside every original interval.

    Row i of `cuts` (intervals, parts) has the relative lengths of the parts of interval i.
    """

    def __init__(self, module: ControlModule, coarse: Grid, unknowns: Vector, cuts: Matrix) -> None:
        self.module, self.cuts, self.grid = module, cuts, _divided(module, coarse, cuts)
        self._unknowns = _transferred(module, coarse, self.grid, unknowns, cuts.shape[1], straight=True)
        # The value of each stage is the mean of the two nodes of its part.
        nodes, intervals = self.module.views(self.grid, self._unknowns)
        names = list(self.module.metadata.node)
        for index, name in enumerate(self.module.metadata.interval):
            of = self.module.metadata.stages.get(name)
            if of in names and not self.module.problem.structure.is_multiplier[nodes.shape[2] + index]:
                state = nodes[:, :, names.index(of)]
                intervals[:, :, index] = 0.5 * (state[:, :-1] + state[:, 1:])
        self._rows = module.views(self.grid, module.evaluate(self.grid, self._unknowns).gradient)
        self._lengths = np.diff(self.grid.nodes).reshape(cuts.shape)

    def equations(self) -> Iterator[_Equation]:
        """Yield the equations of motion of states, without the equations of stages."""
        metadata = self.module.metadata
        for at_nodes, names in ((True, metadata.node), (False, metadata.interval)):
            for index, name in enumerate(names):
                meaning = metadata.meanings.get(name)
                if meaning and meaning.kind in (Kind.STEP, Kind.MOTION) and meaning.of in metadata.node:
                    yield _Equation(meaning.of, index, at_nodes)

    def middle(self, equation: _Equation, interval: int, part: int) -> float:
        """Return the position of the change with the index `part`, as a fraction of an interval."""
        ends = np.concatenate([[0.0], np.cumsum(self.cuts[interval])])
        places = ends[1:-1] if equation.at_nodes else 0.5 * (ends[:-1] + ends[1:])
        return float(0.5 * (places[part] + places[part + 1]))

    def values(self, equation: _Equation) -> Matrix:
        """Return the values of an equation divided by the time step, in all parts or at the nodes between the parts.

        The shape is (bodies, intervals, parts), or (bodies, intervals, parts - 1) at nodes. Values that are not finite
        are zero.
        """
        nodes, intervals = self._rows
        lengths = self._lengths
        if equation.at_nodes:
            rows = nodes[:, :-1, equation.index].reshape(-1, *self.cuts.shape)[:, :, 1:]
            lengths = 0.5 * (lengths[:, :-1] + lengths[:, 1:])
        else:
            rows = intervals[:, :, equation.index].reshape(-1, *self.cuts.shape)
        values = rows / lengths
        values[~np.isfinite(values)] = 0.0
        return np.asarray(values)

    def time(self, interval: int, share: float) -> float:
        """Return the time at the fraction `share` of an interval."""
        times = np.asarray(self.module.unpack(self.grid, self._unknowns)[0])
        begin, end = times[interval * self.cuts.shape[1]], times[(interval + 1) * self.cuts.shape[1]]
        return float(begin + share * (end - begin))


# Stages


@dataclass(frozen=True)
class StageBeyond:
    """The stage value of a state that is farthest beyond a bound.

    `limit` is the bound. `time` is the start of the interval of the stage. `body` is None for a single body.
    """

    state: str
    value: float
    limit: float
    time: float
    body: int | None = None

    @property
    def note(self) -> str:
        """The warning for the user, with the remedy."""
        return (
            f"{self.state}{_of_body(self.body)} is {self.value:.4g} at a stage of the interval from t = "
            f"{self.time:.4g}, {abs(self.value - self.limit):.2g} beyond its bound, and the dynamics were evaluated "
            "there: the scheme holds bounds at nodes alone; take gauss-4, or more --steps"
        )


def stages_beyond(
    module: ControlModule, unknowns: Vector, steps: int, fractions: Vector | None
) -> Iterator[StageBeyond]:
    """Yield for each bounded state the stage value that is farthest beyond the bound, if any stage is beyond it.

    States whose stage values have bounds of their own are omitted. `unknowns` (n,) belong to `steps` intervals in each
    phase. `fractions` are the lengths of the intervals relative to the duration; None means equal intervals.
    """
    metadata = module.metadata
    if not metadata.inequalities or any(m.kind == Kind.BOUND_SLACK for m in metadata.meanings.values()):
        return
    grid, names = time_grid(module, steps, fractions), list(metadata.node)
    nodes, intervals = module.views(grid, unknowns)
    limits = [module.views(grid, bound) for bound in module.variable_bounds(grid)]
    stages = dict[str, list[int]]()
    for column, name in enumerate(metadata.interval):
        state = metadata.stages.get(name)
        if state in names and not module.problem.structure.is_multiplier[len(names) + column]:
            stages.setdefault(state, []).append(column)
    times = module.unpack(grid, unknowns)[0] if stages else np.empty(0)
    for state, columns in stages.items():
        if any(np.isfinite(inside[:, :, columns]).any() for _, inside in limits):
            continue
        index = names.index(state)
        # The bound of an interval is the median of the bounds at the nodes of its phase, as ends may have other bounds.
        bounds = []
        for at_nodes, _ in limits:
            rows = (slice(phase * steps + min(phase, 1), (phase + 1) * steps + 1) for phase in range(metadata.phases))
            sorted_rows = [np.sort(at_nodes[:, row, index], axis=1) for row in rows]
            medians = np.stack([part[:, part.shape[1] // 2] for part in sorted_rows], axis=1)
            bounds.append(np.repeat(medians, steps, axis=1)[:, :, None])
        lower, upper = bounds
        values = intervals[:, :, columns]
        beyond = np.maximum(lower - values, values - upper)
        worst = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
        if beyond[worst] <= STAGES_NEGLIGIBLE * max(1e-300, np.abs(nodes[:, :, index]).max()):
            continue
        body, interval, _ = map(int, worst)
        limit = (lower if values[worst] < lower[body, interval, 0] else upper)[body, interval, 0]
        number_of_body = body if metadata.bodies > 1 else None
        yield StageBeyond(state, float(values[worst]), float(limit), float(times[interval]), number_of_body)
