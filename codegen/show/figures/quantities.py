"""What a figure of an optimum shows, as arrays: every quantity with its bounds and first guess, path inequalities."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from codegen.runtime.record import Form, Meaning, Method, Place
from codegen.runtime.search.grid import free_unknowns
from codegen.solving.loading import ControlModule, Matrix, Vector, time_grid
from codegen.solving.results.result import Result
from codegen.solving.results.segments import Segments, multiplier_names, put_together, segments_of

CLOSE, LEAST = 2e-4, 1e-6
"""Relative and absolute distance from a limit that count as none: an interior point method ends a little inside."""

_PER_INTERVAL = 9
"""Times in an interval at which a control that is a polynomial there is drawn."""


@dataclass(frozen=True)
class Quantity:
    """One quantity over time, a column for every body.

    `values` belong to the times `t`, or to the intervals between them when there is one row less. Bounds are infinite
    where there are none, and have rows like the values where they may change. `kind` is state, momentum, multiplier or
    control; `jumps` are the nodes after which another value follows at once; `unit` stands behind the name.
    """

    name: str
    kind: str
    t: Vector
    values: Matrix
    lower: Vector
    upper: Vector
    guess: Matrix | None = None
    jumps: tuple[int, ...] = ()
    unit: str = ""

    @property
    def on_intervals(self) -> bool:
        """Whether the quantity is constant on every interval."""
        return len(self.values) == self.t.size - 1

    def active(self) -> np.ndarray:
        """Which values lie on a bound."""
        room = self.upper - self.lower
        size = np.where(np.isfinite(room), room, _spread(self.values))
        distance = np.minimum(self.values - self.lower, self.upper - self.values)
        return np.asarray(distance <= CLOSE * size + LEAST)

    def is_violated(self) -> bool:
        """Whether a value lies beyond a bound by more than rounding."""
        return bool(np.any((self.values < self.lower - LEAST) | (self.values > self.upper + LEAST)))


@dataclass(frozen=True)
class Inequality:
    """A path inequality g <= 0 as its distance -g from equality (times, bodies), at its own times.

    `segment` is the number of its segment where delays cut the motion, else 0.
    """

    name: str
    t: Vector
    distance: Matrix
    segment: int = 0

    def active(self) -> np.ndarray:
        """Where the inequality holds with equality."""
        return np.asarray(self.distance <= CLOSE * float(np.nanmax(np.abs(self.distance), initial=0.0)) + LEAST)

    def is_violated(self) -> bool:
        """Whether the inequality does not hold, by more than rounding."""
        return bool(np.any(self.distance < -LEAST))


def first_guess(module: ControlModule, result: Result) -> Result:
    """The result as it would be if the solver had not moved from the problem's first guess."""
    grid = time_grid(module, result.steps, result.grid)
    t, q, p, u, multipliers = module.unpack(grid, module.initial_guess(grid))
    return replace(result, t=t, q=q, p=p, u=u, multipliers=multipliers, log=None)


def quantities(module: ControlModule, result: Result) -> dict[str, list[Quantity]]:
    """States, momenta, multipliers and controls of a result, each list in the order of declaration.

    A multiplier belongs to the state of the same index; those of momenta follow.
    """
    assert result.u is not None
    assert result.multipliers is not None
    metadata, guess, bodies = module.metadata, first_guess(module, result), module.metadata.bodies
    fine = (result.t[:-1, None] + np.diff(result.t)[:, None] * np.linspace(0.0, 1.0, _PER_INTERVAL)).ravel()
    coordinates, form = tuple(metadata.coordinates), metadata.form
    momenta = tuple(metadata.rates) if form == Form.HAMILTONIAN else tuple(f"p_{q}" for q in coordinates)
    momenta = () if form == Form.FIRST_ORDER else momenta
    lower, upper = _bounds(module, guess)
    assert guess.u is not None
    groups: dict[str, tuple[tuple[str, ...], Matrix, Matrix, int]] = {
        "state": (coordinates, result.q, guess.q, 0),
        "momentum": (momenta, result.p, guess.p, 1),
        "control": (tuple(metadata.control_names), _drawn(module, result, fine), _drawn(module, guess, fine), 2),
    }
    out: dict[str, list[Quantity]] = {}
    for kind, (names, values, guessed, index) in groups.items():
        # Bounds of momenta mean something only where momenta are unknowns of their own.
        is_bounded = kind != "momentum" or metadata.method == Method.HAMILTONIAN
        tables = [_by_body(table, bodies) for table in (_finite(values), guessed, lower[index], upper[index])]
        none = np.full(bodies, np.inf)
        out[kind] = [
            Quantity(
                name,
                kind,
                fine if kind == "control" and result.stage_abscissae else result.t,
                tables[0][:, :, i],
                _limits(module, tables[2][:, :, i], -np.inf) if is_bounded else -none,
                _limits(module, tables[3][:, :, i], np.inf) if is_bounded else none,
                tables[1][:, :, i] if kind != "momentum" else None,
                _jumps(module, result, name),
                result.units.get(name, ""),
            )
            for i, name in enumerate(names)
        ]
    out["multiplier"] = list(_multipliers(module, result, (*coordinates, *momenta)))
    return out


def inequalities(module: ControlModule, result: Result) -> list[Inequality]:
    """The path inequalities of a result, one for every condition that the author wrote, as they were discretised."""
    metadata = module.metadata
    generated: Any = module  # it has names that only some modules have
    if result.unknowns is None or not hasattr(generated, "SLACKS"):
        return []
    grid = time_grid(module, result.steps, result.grid)
    _, intervals = generated.views(grid, result.unknowns)
    _, residuals = generated.views(grid, generated.evaluate(grid, result.unknowns).gradient)
    columns: dict[Meaning, list[tuple[Vector, Matrix]]] = {}
    first = len(metadata.node)
    for phase, meanings in enumerate(metadata.slack_meanings):
        rows = slice(phase * result.steps, (phase + 1) * result.steps)
        found: dict[Meaning, list[tuple[float, Matrix]]] = {}
        for slack, multiplier in zip(generated.SLACKS - first, generated.SLACK_MULTIPLIERS - first, strict=True):
            meaning = meanings.get(metadata.interval[slack])
            if meaning is None or meaning.kind.place != Place.INTERVAL:
                continue  # another phase has it
            # The equation g + s = 0 may have a residual, so that the slack alone would hide a violation.
            distance = intervals[:, rows, slack] - residuals[:, rows, multiplier]
            found.setdefault(replace(meaning, at=0), []).append((meaning.at, _finite(distance).T))
        for meaning, parts in found.items():
            columns.setdefault(meaning, []).append(_in_order(parts, result.t[:-1][rows], np.diff(result.t)[rows]))
    return [Inequality(m.subject, *_with_gaps(parts), m.segment) for m, parts in columns.items()]


def _in_order(parts: list[tuple[float, Matrix]], t: Vector, steps: Vector) -> tuple[Vector, Matrix]:
    """Times and values of what is known at some points of every interval."""
    times = np.array([t + c * steps for c, _ in parts])
    order = np.argsort(times.ravel(), kind="stable")
    return times.ravel()[order], np.concatenate([values for _, values in parts])[order]


def _with_gaps(parts: list[tuple[Vector, Matrix]]) -> tuple[Vector, Matrix]:
    """Times and values of several stretches, with a value that is not drawn between them."""
    t, values = parts[0]
    for more, others in parts[1:]:
        t = np.concatenate([t, t[-1:], more])
        values = np.concatenate([values, np.full_like(others[:1], np.nan), others])
    return t, values


def _bounds(module: ControlModule, like: Result) -> tuple[list[Matrix], list[Matrix]]:
    """Least and greatest (q, p, u), infinite where there are none."""
    if not module.metadata.inequalities:
        tables = [np.full_like(table, np.inf) for table in (like.q, like.p, like.u)]
        return [-table for table in tables], tables
    grid = time_grid(module, like.steps, like.grid)
    with np.errstate(all="ignore"):  # durations and momenta of infinite unknowns mean nothing
        lower, upper = (module.unpack(grid, bounds) for bounds in module.variable_bounds(grid))
    return [lower[1], lower[2], lower[3]], [upper[1], upper[2], upper[3]]


def _finite(table: Matrix) -> Matrix:
    """NaN, which is not drawn, instead of infinite numbers, where the numerics failed."""
    return np.where(np.isfinite(table), table, np.nan)


def _spread(values: Matrix) -> Vector:
    return np.asarray(np.fmax.reduce(values, axis=0) - np.fmin.reduce(values, axis=0))


def _by_body(table: Matrix, bodies: int) -> Matrix:
    return table.reshape(len(table), bodies, -1)


def _limits(module: ControlModule, table: Matrix, none: float) -> Vector | Matrix:
    """The bound of every body, or at every time as well where there are phases, each with its own bounds."""
    phases = module.metadata.phases
    if phases == 1:
        return _constant(table, none)
    steps = len(table) // phases
    parts = np.split(table, [len(table) - (phases - i) * steps for i in range(1, phases)])
    # The node at the end of a phase has bounds of the next one as well.
    inner = [part[:-1] if len(table) > phases * steps and steps > 1 else part for part in parts]
    return np.concatenate(
        [np.broadcast_to(_constant(own, none), part.shape) for own, part in zip(inner, parts, strict=True)]
    )


def _jumps(module: ControlModule, result: Result, name: str) -> tuple[int, ...]:
    """The nodes after which a coordinate or momentum jumps; a coordinate's multiplier jumps with both."""
    names = {name} | ({name[7:], f"p_{name[7:]}"} if name.startswith("lambda_") else set())
    switches = enumerate(module.metadata.jumps, start=1)
    return tuple(i * result.steps for i, jumping in switches if names & set(jumping))


def _drawn(module: ControlModule, result: Result, fine: Vector) -> Matrix:
    """The controls as they are drawn: those at stages as polynomials, which may jump at nodes."""
    assert result.u is not None
    if not result.stage_abscissae:
        return _present(module, result.u, result.steps)
    # At a node, the value at the end of the interval before it comes first.
    before = np.nextafter(fine, result.t[0])
    here = np.where(np.diff(fine, prepend=-np.inf) > 0.0, before, fine)
    here[0] = fine[0]
    return result.controls_at(here)


def _present(module: ControlModule, controls: Matrix, steps: int) -> Matrix:
    """Controls with NaN, which is not drawn, in phases that have no such control."""
    if module.metadata.phases == 1:
        return controls
    grid = module.make_grid(steps)
    _, intervals = module.views(grid, np.where(free_unknowns(grid), 0.0, np.nan))
    inside = module.metadata.interval
    # The last of a name: multipliers come first, one of which may be called like a control.
    indices = [len(inside) - 1 - inside[::-1].index(name) for name in module.metadata.control_names]
    return np.asarray(controls + intervals[0][:, indices])


def _constant(table: Matrix, none: float) -> Vector:
    """The bound of every body: it is the same at all times, but missing where a boundary value takes its place."""
    finite = np.isfinite(table)
    found = np.where(finite, table, -np.inf if none < 0 else np.inf)
    return np.asarray(found.max(axis=0) if none < 0 else found.min(axis=0), dtype=float)


def _multipliers(module: ControlModule, result: Result, names: tuple[str, ...]) -> Iterator[Quantity]:
    """Multipliers of the equations of motion, in the order of the quantities that they belong to."""
    metadata, bodies = module.metadata, module.metadata.bodies
    assert result.multipliers is not None
    table = _by_body(_finite(result.multipliers), bodies)
    none = np.full(bodies, np.inf)
    columns = multiplier_names(metadata, table.shape[2])
    wanted = {f"{stem}_{name}" for stem in ("lambda", "mu") for name in names}
    for i, column in enumerate(columns):
        if column in wanted:
            jumps = _jumps(module, result, column)
            yield Quantity(column, "multiplier", result.t, table[:, :, i], -none, none, jumps=jumps)


def quantities_of_segments(module: ControlModule, result: Result) -> dict[str, list[Quantity]]:
    """States, momenta, multipliers and controls of a result, each list in the order of declaration."""
    segments, cut = segments_of(module.metadata), result.by_segments
    if segments is None or cut is None:
        return quantities(module, result)
    found = quantities(module, cut)
    return {kind: _in_time(group, segments, cut) for kind, group in found.items()}


def inequalities_of_segments(module: ControlModule, result: Result) -> list[Inequality]:
    """The path inequalities of a result, one for every condition that the author wrote."""
    cut = result.by_segments
    if cut is None:
        return inequalities(module, result)
    duration, parts = float(cut.t[-1] - cut.t[0]), dict[str, list[tuple[Vector, Matrix]]]()
    for own in inequalities(module, cut):
        name = own.name.removesuffix(f" in segment {own.segment}")
        parts.setdefault(name, []).append((own.t + (own.segment - 1) * duration, own.distance))
    return [
        Inequality(name, np.concatenate([t for t, _ in own]), np.concatenate([values for _, values in own]))
        for name, own in parts.items()
    ]


def first_guess_of_segments(module: ControlModule, result: Result) -> Result:
    """The result as it would be if the solver had not moved from the problem's first guess."""
    if result.by_segments is None:
        return first_guess(module, result)
    return put_together(first_guess(module, result.by_segments), module.metadata)


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
