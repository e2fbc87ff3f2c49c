"""Quantities of the figure of an optimum with bounds and initial guess, path inequalities, labels and titles."""

from __future__ import annotations

import ast
import json
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from codegen import identifiers
from codegen.runtime.record import Form, Kind, Meaning, Method, Place
from codegen.runtime.search.grid import free_unknowns
from codegen.show.figures.picture import STYLES, letter_size, present_style
from codegen.solving.loading import ControlModule, Matrix, Vector, time_grid
from codegen.solving.results.display import angular_velocity, angular_velocity_names, columns_of
from codegen.solving.results.result import Result
from codegen.solving.results.segments import multiplier_names, put_together, segments_of

if TYPE_CHECKING:
    from xarray import Dataset

CLOSE, LEAST = 2e-4, 1e-6
"""Relative and absolute distance from a bound up to which it is active: interior-point solutions stay inside."""

_PER_INTERVAL = 9  # number of points in an interval at which the polynomial of a control is drawn


@dataclass(frozen=True)
class Quantity:
    """One quantity over time, with a column for every body.

    `values` belong to the times `t`, or to the intervals if they have one row less. Missing bounds are infinite; bounds
    that change with time have a row for each row of values. `kind` is state, momentum, multiplier or control. `jumps`
    are the nodes after which the value jumps.
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
        """True if the quantity has one value for each interval."""
        return len(self.values) == self.t.size - 1

    def active(self) -> np.ndarray:
        """Return a mask of the values on a bound."""
        room = self.upper - self.lower
        spread = np.fmax.reduce(self.values, axis=0) - np.fmin.reduce(self.values, axis=0)
        size = np.where(np.isfinite(room), room, spread)
        distance = np.minimum(self.values - self.lower, self.upper - self.values)
        return np.asarray(distance <= CLOSE * size + LEAST)

    def is_violated(self) -> bool:
        """Return True if a value violates a bound by more than rounding error."""
        return bool(np.any((self.values < self.lower - LEAST) | (self.values > self.upper + LEAST)))


@dataclass(frozen=True)
class Inequality:
    """A path inequality g <= 0 as its distance -g from equality, shape (times, bodies), at its own times `t`.

    `segment` is the number of the segment, from 1, if delays cut the motion into segments, else 0. If one side of the
    inequality is known, `expression` is the text of the other side, and `bound` (times,) the known side. The
    expression is above its bound if `is_lower`. `spans` are the first and last times of the phases in which the
    inequality holds.
    """

    name: str
    t: Vector
    distance: Matrix
    segment: int = 0
    expression: str = ""
    bound: Vector | None = None
    is_lower: bool = False
    unit: str = ""
    spans: tuple[tuple[float, float], ...] = ()

    @property
    def values(self) -> Matrix:
        """The values (times, bodies) of the expression, or the distance if no bound is known."""
        if self.bound is None:
            return self.distance
        return self.bound[:, None] + (self.distance if self.is_lower else -self.distance)

    def active(self) -> np.ndarray:
        """Return a mask of the times and bodies at which the inequality holds with equality."""
        return np.asarray(self.distance <= CLOSE * float(np.nanmax(np.abs(self.distance), initial=0.0)) + LEAST)

    def is_violated(self) -> bool:
        """Return True if the inequality is violated by more than rounding error."""
        return bool(np.any(self.distance < -LEAST))


def first_guess(module: ControlModule, result: Result) -> Result:
    """Return a copy of a result with the motion of the problem's initial guess."""
    grid = time_grid(module, result.steps, result.grid)
    t, q, p, u, multipliers = module.unpack(grid, module.initial_guess(grid))
    return replace(result, t=t, q=q, p=p, u=u, multipliers=multipliers, log=None)


def quantities(module: ControlModule, result: Result) -> dict[str, list[Quantity]]:
    """Return the states, momenta, multipliers and controls of a result by kind, in the order of declaration.

    A multiplier belongs to the state with the same index; multipliers of momenta follow.
    """
    assert result.u is not None
    assert result.multipliers is not None
    metadata, guess, bodies = module.metadata, first_guess(module, result), module.metadata.bodies
    fine = (result.t[:-1, None] + np.diff(result.t)[:, None] * np.linspace(0.0, 1.0, _PER_INTERVAL)).ravel()
    coordinates, form = tuple(metadata.coordinates), metadata.form
    momenta = tuple(metadata.rates) if form == Form.HAMILTONIAN else tuple(f"p_{q}" for q in coordinates)
    momenta = () if form == Form.FIRST_ORDER else momenta
    assert guess.u is not None
    # Lower and upper bounds of (q, p, u), infinite without bounds.
    upper = [np.full_like(table, np.inf) for table in (guess.q, guess.p, guess.u)]
    lower = [-table for table in upper]
    if metadata.inequalities:
        grid = time_grid(module, guess.steps, guess.grid)
        with np.errstate(all="ignore"):  # durations and momenta computed from infinite bounds are not used
            unpacked = [module.unpack(grid, bounds) for bounds in module.variable_bounds(grid)]
        lower, upper = (list(own[1:4]) for own in unpacked)
    groups: dict[str, tuple[tuple[str, ...], Matrix, Matrix, int]] = {
        "state": (coordinates, result.q, guess.q, 0),
        "momentum": (momenta, result.p, guess.p, 1),
        "control": (tuple(metadata.control_names), _drawn(module, result, fine), _drawn(module, guess, fine), 2),
    }
    out: dict[str, list[Quantity]] = {}
    for kind, (names, values, guessed, index) in groups.items():
        # Bounds of momenta apply only if momenta are unknowns.
        is_bounded = kind != "momentum" or metadata.method == Method.HAMILTONIAN
        tables = (_finite(values), guessed, lower[index], upper[index])
        shown, initial, least, most = (table.reshape(len(table), bodies, -1) for table in tables)
        none = np.full(bodies, np.inf)
        out[kind] = [
            Quantity(
                name,
                kind,
                fine if kind == "control" and result.stage_abscissae else result.t,
                shown[:, :, i],
                _limits(module, least[:, :, i], -np.inf) if is_bounded else -none,
                _limits(module, most[:, :, i], np.inf) if is_bounded else none,
                initial[:, :, i] if kind != "momentum" else None,
                _jumps(module, result, name),
                result.units.get(name, ""),
            )
            for i, name in enumerate(names)
        ]
    # Multipliers of the equations of motion, in the order of their quantities.
    table = _finite(result.multipliers)
    table, none = table.reshape(len(table), bodies, -1), np.full(bodies, np.inf)
    wanted = {f"{stem}_{name}" for stem in ("lambda", "mu") for name in (*coordinates, *momenta)}
    out["multiplier"] = [
        Quantity(name, "multiplier", result.t, table[:, :, i], -none, none, jumps=_jumps(module, result, name))
        for i, name in enumerate(multiplier_names(metadata, table.shape[2]))
        if name in wanted
    ]
    return out


def inequalities(module: ControlModule, result: Result) -> list[Inequality]:
    """Return the path inequalities of a result at the points of the discretisation, one for each condition."""
    return [_with_bound(one, module, result) for one in _distances(module, result)]


def _distances(module: ControlModule, result: Result) -> list[Inequality]:
    """Return the path inequalities of a result as distances, without bounds.

    Of several inequalities with one name at one time, such as both sides of a cone of friction, the least distance
    counts. Products of contact forces are left out: they vanish everywhere.
    """
    metadata = module.metadata
    names = vars(module)  # only some modules have slacks
    if result.unknowns is None or "SLACKS" not in names:
        return []
    grid = time_grid(module, result.steps, result.grid)
    _, intervals = module.views(grid, result.unknowns)
    _, residuals = module.views(grid, module.evaluate(grid, result.unknowns).gradient)
    columns: dict[Meaning, list[tuple[Vector, Matrix]]] = {}
    spans: dict[Meaning, list[tuple[float, float]]] = {}
    first = len(metadata.node)
    for phase, meanings in enumerate(metadata.slack_meanings):
        rows = slice(phase * result.steps, (phase + 1) * result.steps)
        by_meaning: dict[Meaning, dict[float, Matrix]] = {}
        for slack, multiplier in zip(names["SLACKS"] - first, names["SLACK_MULTIPLIERS"] - first, strict=True):
            meaning = meanings.get(metadata.interval[slack])
            if meaning is None or meaning.kind.place != Place.INTERVAL:
                continue  # a condition of another phase
            if meaning.kind is Kind.COMPLEMENTARITY_SLACK:
                continue
            # The equation g + s = 0 may have a residual, so the slack alone would hide a violation.
            distance = _finite(intervals[:, rows, slack] - residuals[:, rows, multiplier]).T
            points = by_meaning.setdefault(replace(meaning, at=0), {})
            points[meaning.at] = np.minimum(points.get(meaning.at, np.inf), distance)
        for meaning, points in by_meaning.items():
            # Sort the points of all intervals by time.
            times = np.concatenate([result.t[:-1][rows] + c * np.diff(result.t)[rows] for c in points])
            order = np.argsort(times, kind="stable")
            values = np.concatenate(list(points.values()))
            columns.setdefault(meaning, []).append((times[order], values[order]))
            spans.setdefault(meaning, []).append((float(result.t[rows.start]), float(result.t[rows.stop])))
    out = []
    for meaning, parts in columns.items():
        t, values = parts[0]
        for more, others in parts[1:]:  # NaN makes a gap between phases
            t = np.concatenate([t, t[-1:], more])
            values = np.concatenate([values, np.full_like(others[:1], np.nan), others])
        out.append(Inequality(meaning.subject, t, values, meaning.segment, spans=tuple(spans[meaning])))
    return out


def by_expression(shown: Sequence[Inequality]) -> list[list[Inequality]]:
    """Return the inequalities in groups, in which lower and upper bounds of the same expression are together."""
    groups: dict[str, list[Inequality]] = {}
    for one in shown:
        groups.setdefault(one.name if one.bound is None else one.expression, []).append(one)
    return list(groups.values())


def _with_bound(shown: Inequality, module: ControlModule, result: Result) -> Inequality:
    """Return the inequality with its expression and bound if one side depends on constants and the time alone.

    The name of an inequality is its relation in Python's notation, unless the author named it.
    """
    try:
        tree = ast.parse(shown.name, mode="eval").body
    except SyntaxError:  # a name in the author's words
        return shown
    if not isinstance(tree, ast.Compare) or len(tree.ops) != 1 or not isinstance(tree.ops[0], (ast.LtE, ast.GtE)):
        return shown
    left, right, is_lower = tree.left, tree.comparators[0], isinstance(tree.ops[0], ast.GtE)
    metadata = module.metadata
    free = {name: result.summary[name] for name in metadata.free_parameters if name in result.summary}
    symbols: dict[str, float | Vector] = {
        "pi": np.pi,
        "E": np.e,
        "t": shown.t,
        **metadata.parameters,
        **result.parameters,
        **free,
    }
    for expression, limit, is_above in ((left, right, is_lower), (right, left, not is_lower)):
        bound = _value(limit, symbols)
        if bound is not None and _value(expression, symbols) is None:
            text = str(ast.get_source_segment(shown.name, expression))
            return replace(
                shown, expression=text, bound=np.broadcast_to(bound, shown.t.shape).astype(float),
                is_lower=is_above, unit=result.units.get(text, ""),
            )  # fmt: skip
    return shown


_FUNCTIONS: dict[str, Callable[..., Vector]] = {
    "sqrt": np.sqrt, "sin": np.sin, "cos": np.cos, "tan": np.tan, "exp": np.exp, "log": np.log, "Abs": np.abs,
    "asin": np.arcsin, "acos": np.arccos, "atan": np.arctan, "sinh": np.sinh, "cosh": np.cosh, "tanh": np.tanh,
}  # fmt: skip
"""Functions that may occur in bounds, by the name that sympy prints."""
_OPERATORS: dict[type[ast.operator], Callable[..., Vector]] = {
    ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.true_divide, ast.Pow: np.power,
}  # fmt: skip


def _value(node: ast.expr, symbols: Mapping[str, float | Vector]) -> Vector | None:
    """Return the value of an expression, or None if another symbol, function or operation occurs."""
    apply: Callable[..., Vector]
    match node:
        case ast.Constant(value=int() | float() as number):
            return np.array(float(number))
        case ast.Name(id=name):
            return np.asarray(symbols[name], dtype=np.float64) if name in symbols else None
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            apply, operands = np.negative, [operand]
        case ast.BinOp(left=left, op=operator, right=right) if type(operator) in _OPERATORS:
            apply, operands = _OPERATORS[type(operator)], [left, right]
        case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if name in _FUNCTIONS:
            apply, operands = _FUNCTIONS[name], [argument]
        case _:
            return None
    values = [value for operand in operands if (value := _value(operand, symbols)) is not None]
    if len(values) < len(operands):
        return None
    with np.errstate(all="ignore"):
        return np.asarray(apply(*values), dtype=np.float64)


def _finite(table: Matrix) -> Matrix:
    """Return a table with NaN, which is not drawn, in place of infinite numbers."""
    return np.where(np.isfinite(table), table, np.nan)


def _limits(module: ControlModule, table: Matrix, none: float) -> Vector | Matrix:
    """Return the bound of every body, with a row for each time if there are phases; `none` replaces missing bounds."""
    phases = module.metadata.phases
    if phases == 1:
        return _constant(table, none)
    steps = len(table) // phases
    parts = np.split(table, [len(table) - (phases - i) * steps for i in range(1, phases)])
    # The node at the end of a phase also has the bounds of the next phase.
    inner = [part[:-1] if len(table) > phases * steps and steps > 1 else part for part in parts]
    return np.concatenate(
        [np.broadcast_to(_constant(own, none), part.shape) for own, part in zip(inner, parts, strict=True)]
    )


def _jumps(module: ControlModule, result: Result, name: str) -> tuple[int, ...]:
    """Return the nodes after which a quantity jumps; a multiplier jumps with its coordinate and its momentum."""
    names = {name} | ({name[7:], f"p_{name[7:]}"} if name.startswith("lambda_") else set())
    switches = enumerate(module.metadata.jumps, start=1)
    return tuple(i * result.steps for i, jumping in switches if names & set(jumping))


def _drawn(module: ControlModule, result: Result, fine: Vector) -> Matrix:
    """Return the controls to draw, at the times `fine` if they are polynomials through stages, which jump at nodes."""
    assert result.u is not None
    if result.stage_abscissae:
        # Of two points at a node, the first point belongs to the interval before the node.
        before = np.nextafter(fine, result.t[0])
        times = np.where(np.diff(fine, prepend=-np.inf) > 0.0, before, fine)
        times[0] = fine[0]
        return result.controls_at(times)
    if module.metadata.phases == 1:
        return result.u
    # Set NaN, which is not drawn, in phases without a control.
    grid = module.make_grid(result.steps)
    _, intervals = module.views(grid, np.where(free_unknowns(grid), 0.0, np.nan))
    inside = module.metadata.interval
    # Find the last index of a name: multipliers come first and may have the name of a control.
    indices = [len(inside) - 1 - inside[::-1].index(name) for name in module.metadata.control_names]
    return np.asarray(result.u + intervals[0][:, indices])


def _constant(table: Matrix, none: float) -> Vector:
    """Return the constant bound of every body from rows in which boundary conditions may replace the bound."""
    bounds = np.where(np.isfinite(table), table, -np.inf if none < 0 else np.inf)
    return np.asarray(bounds.max(axis=0) if none < 0 else bounds.min(axis=0), dtype=float)


def angular_velocities(result: Result) -> dict[int, Quantity]:
    """Return a part of the angular velocity for each column of a quaternion of a single body; |omega| for w."""
    shown, none = dict[int, Quantity](), np.full(1, np.inf)
    columns, spins = columns_of(result), angular_velocity_names(result)
    for spin, name in spins.items() if result.by_segments is None else ():
        omega = angular_velocity(result, name)
        names = (f"|{spin}|", *(f"{spin}_{axis}" for axis in "xyz"))
        values = np.column_stack([np.linalg.norm(omega, axis=1), omega])
        for column, own, part in zip(columns[name], names, values.T, strict=True):
            shown[column] = Quantity(own, "spin", result.t, part[:, None], -none, none)
    return shown


def quantities_of_segments(module: ControlModule, result: Result) -> dict[str, list[Quantity]]:
    """Return the quantities of a result over the whole time; segments cut by delays are joined."""
    segments, cut = segments_of(module.metadata), result.by_segments
    if segments is None or cut is None:
        return quantities(module, result)
    joined: dict[str, list[Quantity]] = {}
    duration = float(cut.t[-1] - cut.t[0])

    def rows(tables: list[Matrix], is_meeting: bool) -> Matrix:
        """Return the rows of all segments; if `is_meeting`, segments share their end nodes."""
        return np.concatenate([table[int(is_meeting and i > 0) :] for i, table in enumerate(tables)])

    for kind, group in quantities(module, cut).items():
        names, columns = segments.columns([quantity.name for quantity in group])
        joined[kind] = []
        for name, own in zip(names, columns.T, strict=True):
            parts = [group[i] for i in own]
            first, guesses = parts[0], [part.guess for part in parts if part.guess is not None]
            at_nodes = first.t.size == cut.t.size
            is_meeting = at_nodes and not first.on_intervals
            joined[kind].append(
                Quantity(
                    name,
                    kind,
                    rows([part.t + i * duration for i, part in enumerate(parts)], at_nodes),
                    rows([part.values for part in parts], is_meeting),
                    first.lower,
                    first.upper,
                    rows(guesses, is_meeting) if guesses else None,
                    unit=cut.units.get(name, ""),
                )
            )
    return joined


def inequalities_of_segments(module: ControlModule, result: Result) -> list[Inequality]:
    """Return the path inequalities of a result over the whole time; segments cut by delays are joined."""
    cut = result.by_segments
    if cut is None:
        return inequalities(module, result)
    duration, parts = float(cut.t[-1] - cut.t[0]), dict[str, list[tuple[Vector, Matrix]]]()
    for own in _distances(module, cut):
        name = own.name.removesuffix(f" in segment {own.segment}")
        parts.setdefault(name, []).append((own.t + (own.segment - 1) * duration, own.distance))
    joined = [
        Inequality(
            name, np.concatenate([t for t, _ in own]), np.concatenate([values for _, values in own]),
            spans=((float(result.t[0]), float(result.t[-1])),),
        )
        for name, own in parts.items()
    ]  # fmt: skip
    return [_with_bound(one, module, result) for one in joined]


def first_guess_of_segments(module: ControlModule, result: Result) -> Result:
    """Return `first_guess` over the whole time; segments cut by delays are joined."""
    if result.by_segments is None:
        return first_guess(module, result)
    return put_together(first_guess(module, result.by_segments), module.metadata)


# ---- Labels and titles ----

_SIGNS = (("**", "^"), ("<=", "≤"), (">=", "≥"), ("*", "·"))


def label(name: str) -> str:
    """Return a symbol's name as LaTeX between $ signs; phi1 becomes a Greek letter with an index."""

    def letter(part: str) -> str:
        rest = part[1:]
        if part.startswith("d") and rest and not rest.isdigit() and not identifiers.word(rest).startswith(r"\mathrm"):
            return rf"\dot{{{identifiers.word(rest)}}}"
        return identifiers.word(part)

    if name.startswith("|"):  # a length
        return f"|{label(name.strip('|'))}|"
    parts = re.sub(r"(?<=[A-Za-z])(\d+)$", r"_\1", name).split("_")
    letters = [letter(part) for part in parts if part] or [identifiers.word(name)]
    return "$" + letters[0] + ("_{" + ",".join(letters[1:]) + "}" if len(letters) > 1 else "") + "$"


def relation(text: str, longest: int = 46) -> str:
    """Return the text of a relation with mathematical signs, cut to at most `longest` characters."""
    for sign, better in _SIGNS:
        text = text.replace(sign, better)
    return text if len(text) <= longest else text[: longest - 1] + "…"


def title(figure: Figure, result: Result, notes: Sequence[str] = ()) -> None:
    """Set the title of a result's figure: problem, discretisation, outcome and notes."""
    outcome = [f"{result.method}, {result.scheme}, {result.intervals}"]
    outcome += [f"cost {result.cost:.6g}"] if result.cost is not None else []
    outcome += [] if result.solved else [f"NOT SOLVED: {result.status}"]
    set_title(figure, result.title, [*outcome, *notes], is_needed=not result.solved)


def set_title(figure: Figure, name: str, details: Sequence[str], is_needed: bool = False) -> None:
    """Set the figure's label, which descriptions use, and its title if the style has titles or `is_needed`."""
    texts = name.rstrip("."), ", ".join(details)
    figure.set_label(". ".join(texts))
    if present_style().has_title or is_needed:
        # Number of letters on a line.
        letters = int(10.0 * figure.get_figwidth() * STYLES["page"].letters / present_style().letters)
        lines = (line for text in texts for line in textwrap.wrap(text, letters))
        figure.suptitle("\n".join(lines), fontsize=letter_size(11))


def quantity(name: str, data: Dataset | None = None) -> str:
    """Return the label of a varied quantity, such as a parameter or `start.r`, the prescribed value of r at the start.

    The label ends with the unit, if a sweep's `data` contain the unit.
    """
    end, dot, own = name.partition(".")
    text = f"{label(own)} at the {end}" if dot else label(name)
    return in_unit(text, unit_in(data, name) if data is not None else "")


def unit_in(data: Dataset, name: str) -> str:
    """Return the unit in a sweep's data of a quantity such as `m`, `start.r`, `cost`, `t` or `duration`, or ""."""
    own = name.rpartition(".")[2]
    return str(json.loads(data.attrs.get("units", "{}")).get("t" if own == "duration" else own, ""))


def statuses(data: Dataset) -> NDArray[np.str_]:
    """Return the status of each case of a sweep as text, whatever text type the file has."""
    values = data["status"].values
    return np.array(values.ravel().tolist(), dtype=np.str_).reshape(values.shape)


def heading(figure: Figure, data: Dataset, where: str = "") -> None:
    """Set the title of a sweep: problem, discretisation, failed cases, and the text `where` on the drawn cases."""
    own = data.attrs
    steps = [f"{own['steps']} steps"] if "steps" in own else []
    status = statuses(data)
    failed = int((status != "solved").sum())
    outcome = f"{status.size} cases" + (f", {failed} FAILED" if failed else "")
    details = [own["formulation"], own["scheme"], *steps, outcome + where]
    set_title(figure, str(own["title"]), details, is_needed=failed > 0)


def in_unit(text: str, unit: str) -> str:
    """Return the label of an axis with the unit, unless the unit is empty."""
    return f"{text} ({unit})" if unit else text
