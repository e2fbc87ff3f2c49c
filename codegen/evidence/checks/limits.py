"""A generated module of optimal control along the random motions of its author's problem, on grids of halved intervals.

The unknowns of the module get the values of a motion. Inner stages solve their own equations, so that no scheme needs
to be known. Residuals, weighted by smooth functions, and the cost have limits for short intervals, which are
extrapolated by polynomials in 1/N.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sympy

from codegen.evidence.checks.author import Array, Author, Path, Values, relations_of
from codegen.identifiers import plain
from codegen.problem import symbols
from codegen.problem.problem import Control, Simulate
from codegen.runtime.record import Kind, Method
from codegen.solving.loading import Grid

LIMIT = 1e-6  # largest difference of a limit, relative to the sum of the moduli of the author's terms
UNSURE = 3e-4  # largest error of an extrapolated limit, in the same unit, at which the limit counts as measured
ROUNDING = 1e-11  # largest relative difference of two numbers
PANELS, POINTS = 64, 8  # panels of the reference quadrature, and Gauss-Legendre points of a panel


@dataclass(frozen=True)
class Item:
    """A compared quantity: its name, the author's value, the module's value, and the tolerance of the difference.

    A limit has an `error` of extrapolation. The tolerance of a limit is relative to the moduli of all terms.
    """

    name: str
    author: float
    module: float
    tolerance: float
    error: float = 0.0

    @property
    def difference(self) -> float:
        """The difference of both values, zero for equal infinite bounds."""
        return 0.0 if self.author == self.module else abs(self.author - self.module)

    @property
    def agrees(self) -> bool:
        """True if both values are equal up to the tolerance and the error of extrapolation."""
        return self.difference <= self.tolerance + 10.0 * self.error

    @property
    def is_unsure(self) -> bool:
        """True if extrapolation has left an error that could hide a difference."""
        return not self.error <= UNSURE / LIMIT * self.tolerance


def number_item(name: str, author: float, module: float) -> Item:
    """Return the comparison of a number of the author with that of the module, up to rounding; both may be infinite."""
    size = max(abs(author), abs(module)) if math.isfinite(author) and math.isfinite(module) else 0.0
    return Item(name, float(author), float(module), ROUNDING * size + 1e-14)


def absent(name: str) -> Item:
    """Return an item that fails, for a quantity of the author without a counterpart in the module."""
    return Item(name, math.nan, math.nan, 0.0)


def limit_of(name: str, expected: float, values: Sequence[float], size: float) -> Item:
    """Return the item of a limit; `values` belong to grids of halved intervals, `size` is the sum of all moduli."""
    limit, error = extrapolated(values)
    return Item(name, expected, limit, LIMIT * size + 1e-12, error)


def extrapolated(values: Sequence[float]) -> tuple[float, float]:
    """Return the limit for h -> 0 of values at h, h/2, h/4, ..., by polynomials in h (Neville), and an error."""
    h = [0.5**i for i in range(len(values))]
    table = [list(map(float, values))]
    for order in range(1, len(h)):
        last = table[-1]
        table.append(
            [(h[i] * last[i + 1] - h[i + order] * last[i]) / (h[i] - h[i + order]) for i in range(len(last) - 1)]
        )
    # Two orders may agree by accident. The change by the order before is at least as large as eight times the error.
    return table[-1][0], max(abs(table[-1][0] - table[-2][1]), abs(table[-2][1] - table[-3][2]) / 8.0)


@dataclass(frozen=True)
class Leg:
    """The motion of one body in one phase, from time `begin` on; `label` names phase and body if there are several."""

    phase: int
    begin: float
    length: float
    body: int
    label: str


def weight(t: Array, leg: Leg) -> tuple[Array, Array]:
    """Return a smooth weight that vanishes at both ends of a phase with its first three derivatives, and its slope."""
    s = (t - leg.begin) / leg.length
    bump, change = (s * (1 - s)) ** 4, 4 * (s * (1 - s)) ** 3 * (1 - 2 * s)
    return 256 * bump * (1 + s / 3), 256 * (change * (1 + s / 3) + bump / 3) / leg.length


def quadrature(begin: float, length: float) -> tuple[Array, Array]:
    """Return points and weights of Gauss-Legendre quadrature on the panels of a phase."""
    x, w = np.polynomial.legendre.leggauss(POINTS)
    edges = begin + length * np.arange(PANELS) / PANELS
    width = length / PANELS
    return (edges[:, None] + width * (x + 1) / 2).ravel(), np.tile(w * width / 2, PANELS)


def grid_of(author: Author, steps: int, as_written: bool = False) -> Grid:
    """Return the module's time grid with random parameters.

    Inner times and times of measurements are nodes of every grid: interpolation inside an interval would have an error
    that is no smooth function of 1/N, and could not be extrapolated.

    Prescribed boundary values are those of the random motions, or follow from the parameters `as_written`.
    """
    module, arguments = author.module, author.arguments if as_written else {**author.arguments, **author.moved_ends()}
    measured, first = author.measured_times, author.levels[0]
    is_given = bool(author.record.inner_times or measured.size)
    grid: Grid = module.make_grid(first if is_given else steps, **arguments)
    if not is_given:
        return grid
    nodes, fractions = grid.nodes / first, measured / author.durations[0]
    apart = np.abs(fractions[:, None] - nodes).min(axis=1) > ROUNDING
    lengths = np.diff(np.union1d(nodes, fractions[apart]))
    for _ in range(int(math.log2(steps // first))):
        lengths = np.repeat(lengths / 2, 2)
    grid = module.make_grid(grid=lengths, **arguments)
    return grid


def node_times(author: Author, grid: Grid, phase: int) -> Array:
    """Return the times of the nodes of a phase."""
    size = grid.steps // len(author.phases)
    fractions = (grid.nodes[phase * size : (phase + 1) * size + 1] - phase * size) / size
    return np.asarray(sum(author.durations[:phase]) + author.durations[phase] * fractions)


def named(author: Author, name: str) -> sympy.Symbol | None:
    """Return the author's symbol of a name in the record of the module."""
    return author.quantities.get(plain(name))


def body_label(author: Author, body: int) -> str:
    """Return the words that name a body, "" for a single body."""
    return f" of body {body}" if author.record.bodies > 1 else ""


def free_mask(grid: Grid) -> Array:
    """Return ones for the unknowns that are free, and zeros for others."""
    mask = np.zeros(grid.is_multiplier.size)
    module = grid.problem.structure
    layout = module.inner_layouts(grid.steps, grid.inner) if module.inner_times else module.layouts(grid.steps)
    mask[layout.is_free] = 1.0
    return mask


def fill_linking(author: Author, grid: Grid, unknowns: Array, ends: Mapping[str, float] = {}) -> None:
    """Set the free parameters among the linking variables, and the values at an end of the names in `ends`."""
    first = unknowns.size - grid.problem.structure.root
    for index, name in enumerate(author.record.shared):
        symbol = named(author, name)
        if symbol in author.constants:
            unknowns[first + index] = author.constants[symbol]
        elif plain(name) in ends:
            unknowns[first + index] = ends[plain(name)]


@dataclass(frozen=True)
class Sample:
    """The module along a motion on one grid: residuals of nodes, intervals and linking variables, and the cost."""

    grid: Grid
    unknowns: Array
    nodes: Array
    intervals: Array
    linking: Array
    cost: float


def sampled(author: Author, motions: Sequence[Sequence[Path]], steps: int) -> Sample:
    """Evaluate the module along motions of all bodies and phases; inner stages solve their own equations."""
    module, record, grid = author.module, author.record, grid_of(author, steps)
    unknowns = np.zeros(grid.is_multiplier.size)
    nodes, intervals = module.views(grid, unknowns)
    size, count = grid.steps // len(author.phases), len(author.phases)
    ends, forces = dict[str, float](), [name for name in record.node if record.kind(name) == Kind.NORMAL_FORCE]
    for body, of_phases in enumerate(motions):
        for number in reversed(range(count)):  # the node at a switch belongs to the earlier phase
            motion, t = of_phases[number], node_times(author, grid, number)
            at_nodes, inside = motion(t).values, motion((t[:-1] + t[1:]) / 2).values
            before = of_phases[number - 1](t[:1]).values if number else None
            momenta = author.momenta(author.phases[number], at_nodes, t) if author.rates else {}
            momentum = {
                plain(name): momenta[q] for name, q in zip(record.rates, author.coordinates, strict=False) if momenta
            }
            rows = slice(number * size, (number + 1) * size + 1)
            for index, name in enumerate(record.node):
                value = _value(author, name, at_nodes, momentum)
                if record.kind(name) == Kind.NORMAL_FORCE:
                    nodes[body, rows, index] = trial_force(author, forces.index(name), t)
                elif value is not None:
                    nodes[body, rows, index] = value
                elif record.waypoints and plain(name).startswith("time_"):
                    nodes[body, rows, index] = t
                elif record.waypoints and plain(name).startswith("pace_"):
                    nodes[body, rows, index] = author.durations[number]
            rows = slice(number * size, (number + 1) * size)
            for index, name in enumerate(record.interval):
                base = record.stages.get(name, name)
                if record.kind(name) is not None:
                    continue
                value = _value(author, base, inside, {})
                if value is None and base in momentum:
                    value = (momentum[base][:-1] + momentum[base][1:]) / 2
                if value is None and (rate := author.quantities.get(plain(name).removeprefix("switch_"))) is not None:
                    value = None if before is None else before.get(rate)
                if value is not None:
                    intervals[body, rows, index] = value
        last = of_phases[-1](np.array([sum(author.durations)])).values
        first = of_phases[0](np.array([0.0])).values
        for q in author.coordinates:
            ends[f"coupled_{q}{body_label(author, body)}"] = float(np.ravel(last[q])[0])
            ends[f"periodic_{q}{body_label(author, body)}"] = float(np.ravel(first[q])[0])
    fill_linking(author, grid, unknowns, ends)
    with np.errstate(all="ignore"):
        _solve_stages(author, grid, unknowns)
        point = module.evaluate(grid, unknowns)
    of_nodes, of_intervals = module.views(grid, point.gradient)
    linking = point.gradient[point.gradient.size - grid.problem.structure.root :]
    return Sample(grid, unknowns, of_nodes, of_intervals, linking, point.cost)


def trial_force(author: Author, number: int, t: Array) -> Array:
    """Return the force kappa of a constraint at times t, a smooth function that differs between constraints."""
    return 1.0 + 0.5 * number - (1.0 + number) * t / sum(author.durations)


def normals_of(phase: Control | Simulate, coordinates: Sequence[sympy.Symbol]) -> list[list[sympy.Expr]]:
    """Return the row of each constraint along which its force acts: dc/dq, then A of rolling constraints A v + b."""
    holonomic = [relation.expression for relation in relations_of(getattr(phase, "constraint", ()))]
    rolling = [relation.expression for relation in relations_of(getattr(phase, "rolling", ()))]
    rows = [[sympy.diff(c, q) for q in coordinates] for c in holonomic]
    return rows + [[sympy.diff(c, q.partner) for q in coordinates] for c in rolling]


def _value(author: Author, name: str, values: Values, momenta: Mapping[str, Array]) -> float | Array | None:
    """Return the value of an unknown of the module along a motion; None if it is no quantity of the motion."""
    if plain(name) in momenta and author.record.method != Method.VARIATIONAL:
        return momenta[plain(name)]
    symbol = named(author, name)
    return values.get(symbol) if isinstance(symbol, symbols.Moving) else None


def _solve_stages(author: Author, grid: Grid, unknowns: Array) -> None:
    """Solve the equations of inner stages for the stages, by Newton's method with differences.

    An equation of an interval depends on the stages of the same interval alone. So one difference serves all intervals.
    """
    module, record = author.module, author.record
    kinds = [record.kind(name) for name in record.interval]
    stages = [i for i, n in enumerate(record.interval) if n in record.stages and kinds[i] is None]
    stages = [i for i in stages if plain(record.stages[record.interval[i]]) not in map(str, author.controls)]
    equations = [
        i for i, n in enumerate(record.interval) if n in record.stages and kinds[i] in (Kind.STEP, Kind.MOTION)
    ]
    if not stages or len(stages) != len(equations):
        return
    intervals = module.views(grid, unknowns)[1]

    def residual() -> Array:
        return np.array(module.views(grid, module.evaluate(grid, unknowns).gradient)[1][:, :, equations])

    for _ in range(6):
        error = residual()
        matrix = np.empty((*error.shape, len(stages)))
        for column, index in enumerate(stages):
            kept = intervals[:, :, index].copy()
            increment = 1e-6 * np.maximum(1.0, np.abs(kept))
            intervals[:, :, index] = kept + increment
            matrix[..., column] = (residual() - error) / increment[..., None]
            intervals[:, :, index] = kept
        change = np.linalg.solve(matrix, error[..., None])[..., 0]
        intervals[:, :, stages] -= change
        if not np.abs(change).max() > 1e-13 * max(1.0, np.abs(intervals[:, :, stages]).max()):
            return


def weighted_residual(author: Author, sample: Sample, leg: Leg, name: str, by_length: bool = False) -> float:
    """Return the sum of weight times residual over the nodes or intervals of a phase.

    `name` is the name of the multiplier of the residual. Terms are also multiplied by lengths of intervals on request.
    """
    size, record, t = sample.grid.steps // len(author.phases), author.record, node_times(author, sample.grid, leg.phase)
    begin, names = leg.phase * size, [plain(each) for each in record.node]
    if name in names:
        rows, at, lengths = sample.nodes[leg.body, begin : begin + size + 1, names.index(name)], t, np.gradient(t)
    else:
        index = [plain(each) for each in record.interval].index(name)
        rows = sample.intervals[leg.body, begin : begin + size, index]
        at, lengths = (t[:-1] + t[1:]) / 2, np.diff(t)
    weights = weight(at, leg)[0]
    return float((weights * lengths if by_length else weights) @ rows)
