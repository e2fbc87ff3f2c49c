"""Sizes and patterns of the module against the derivation, and every kernel run once inside arrays of those sizes.

Compiled code does not check bounds, so a module whose layout does not fit must not be run at all. Here the kernels are
interpreted, which finds what lies outside an array, and arrays start out as NaN, which finds what is never written.

Where unknowns stand in the flat vector of a control module, derived from the program alone.

For each body node 0, interval 0, node 1, ..., node N; then the shared unknowns of every body, those of the whole
problem, and the multipliers of the conditions between bodies.

Points where a problem is solved: near the guess of its module, with its boundary values and default parameters. Away
from there an exponential atmosphere, a reaction rate or a Gaussian may be flat, and a check would be blind.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Symbol

from codegen import identifiers
from codegen.discretise.interval import STEP
from codegen.discretise.program import ControlProgram, IntervalElement, StepProgram, Unknown
from codegen.emit.lower.control.layout import parameters
from codegen.emit.lower.control.phases import named_elements
from codegen.emit.verify.comparison import Values, with_time
from codegen.emit.verify.kernels import part_of_chain
from codegen.emit.verify.shares import shared_symbols
from codegen.evidence.checks.base import Context, Finding, NoPointError, Point, not_measured, random_points
from codegen.runtime.record import Meaning, Record
from codegen.runtime.search.grid import free_unknowns
from codegen.symbolic.table_functions import numbers_of

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class FlatVector:
    """The layout for `steps` intervals; `body`, `k` and `j` count from zero."""

    program: ControlProgram
    steps: int

    @classmethod
    def on_grid(cls, program: ControlProgram, steps: int) -> FlatVector:
        """The layout on the module's grid of that many steps, which are those of each phase where there are phases."""
        return cls(program, steps * max(1, len(program.phases)))

    @property
    def phase_steps(self) -> int:
        """The intervals of each phase."""
        return self.steps // max(1, len(self.program.phases))

    def share(self, k: int) -> IntervalElement:
        """What interval k adds to the Lagrangian of the optimisation problem."""
        if not self.program.phases:
            return self.program.interval_elements[0]
        index, within = divmod(k, self.phase_steps)
        phase = self.program.phases[index]
        return phase.elements[0] if within == 0 else phase.regular

    @property
    def inner_nodes(self) -> dict[int, int]:
        """The numbers of nodes at inner times, with those of the times, where one interval is between any two."""
        count = len(self.program.inner.times)
        return {number + 1: number for number in range(count)} if self.steps == count + 1 else {}

    @property
    def inside(self) -> tuple[Unknown, ...]:
        """Unknowns of a node and of the interval after it."""
        program = self.program
        return (*program.node, *program.interval, *program.controls, *program.slacks)

    @property
    def chain(self) -> int:
        """How many unknowns a body's nodes and intervals have."""
        return self.steps * len(self.inside) + len(self.program.node)

    @property
    def first_shared(self) -> int:
        """Where the unknowns begin that no node owns."""
        return self.program.bodies * self.chain

    @property
    def first_coupling(self) -> int:
        """Where the multipliers of the conditions between bodies begin."""
        program = self.program
        return self.first_shared + program.bodies * program.own + len(program.shared) - program.own

    @property
    def size(self) -> int:
        """The number of all unknowns."""
        return self.first_coupling + len(self.program.couplings)

    def node(self, body: int, k: int) -> Indices:
        """Indices of the unknowns of a node."""
        return body * self.chain + k * len(self.inside) + np.arange(len(self.program.node))

    def interval(self, body: int, k: int) -> Indices:
        """Indices of the unknowns between two nodes: stages, multipliers, controls, slacks."""
        first = body * self.chain + k * len(self.inside)
        return first + np.arange(len(self.program.node), len(self.inside))

    def shared(self, body: int) -> Indices:
        """Indices of the shared unknowns of a body: its own, then those of the whole problem."""
        program = self.program
        common = self.first_shared + program.bodies * program.own
        own = self.first_shared + body * program.own + np.arange(program.own)
        return np.concatenate([own, common + np.arange(len(program.shared) - program.own)])

    def element(self, body: int, k: int) -> Indices:
        """Indices of all unknowns on which an interval's share of the Lagrangian may depend."""
        return np.concatenate([self.node(body, k), self.interval(body, k), self.node(body, k + 1), self.shared(body)])

    def end(self, body: int, where: str) -> Indices:
        """Indices of all unknowns on which an end's share of the Lagrangian may depend."""
        return np.concatenate([self.node(body, 0 if where == "start" else self.steps), self.shared(body)])

    def multipliers(self) -> NDArray[np.bool_]:
        """Which unknowns multiply an equation."""
        chain = [*[u.multiplier for u in self.inside] * self.steps, *[u.multiplier for u in self.program.node]]
        shared = np.zeros(self.size - self.first_shared, bool)
        shared[self.first_coupling - self.first_shared :] = True
        for body in range(self.program.bodies):
            shared[self.shared(body) - self.first_shared] = [u.multiplier for u in self.program.shared]
        return np.concatenate([np.tile(np.array(chain, bool), self.program.bodies), shared])

    def free(self) -> NDArray[np.bool_]:
        """Which unknowns neither are given at an end, nor equal a shared one, nor lack a meaning where they are."""
        program, free = self.program, np.ones(self.size, bool)
        for body in range(program.bodies):
            for k in range(1, self.steps):
                free[self.node(body, k)[list(program.only_at_ends)]] = False
            for k in range(self.steps):
                free[self.interval(body, k)[list(self.share(k).lacking)]] = False
            for k in range(self.steps + 1):
                free[self.node(body, k)[list(program.inner.unknowns)]] = False
            for k, number in self.inner_nodes.items():
                free[self.node(body, k)[list(program.inner.unknowns)]] = program.inner.present[number]
                free[self.interval(body, k)[list(program.inner.lacking)]] = False
            for k, end in ((0, program.start), (self.steps, program.end)):
                free[self.node(body, k)[[*(i for i, _ in end.pins), *(i for i, _, _ in end.shared)]]] = False
        return free

    def representatives(self) -> Indices:
        """For every unknown its own index, or that of the shared unknown that it equals up to an offset."""
        indices = np.arange(self.size)
        for body in range(self.program.bodies):
            for k, end in ((0, self.program.start), (self.steps, self.program.end)):
                for index, j, _ in end.shared:
                    indices[self.node(body, k)[index]] = self.shared(body)[j]
        return indices

    def names(self) -> list[str]:
        """What to call every unknown, as in `lambda_x at node 3 of body 0`."""
        program, several = self.program, self.program.bodies > 1
        listed = []
        for body in range(program.bodies):
            of_body = f" of body {body}" if several else ""
            for k in range(self.steps):
                listed += [f"{u.name} at node {k}{of_body}" for u in program.node]
                listed += [f"{u.name} on interval {k}{of_body}" for u in self.inside[len(program.node) :]]
            listed += [f"{u.name} at node {self.steps}{of_body}" for u in program.node]
        for body in range(program.bodies):
            listed += [f"{u.name} of body {body}" if several else u.name for u in program.shared[: program.own]]
        listed += [u.name for u in program.shared[program.own :]]
        return listed + [c.multiplier.name for c in program.couplings]

    def meanings(self) -> list[Meaning]:
        """What every unknown is, wherever it lives."""
        program = self.program
        chain = [*[u.meaning for u in self.inside] * self.steps, *[u.meaning for u in program.node]]
        own, common = program.shared[: program.own], program.shared[program.own :]
        of_bodies = [*chain * program.bodies, *[u.meaning for u in own] * program.bodies]
        return [*of_bodies, *(u.meaning for u in common), *(c.multiplier.meaning for c in program.couplings)]


def other_symbols(program: ControlProgram) -> list[Symbol]:
    """What the shares of the Lagrangian depend on beside unknowns: parameters, boundary values, time and step.

    Where there are inner times, numbers of the left node come before the time.
    """
    given = (*program.model.parameters, *(v.symbol for v in program.boundary_values))
    return [*given, *program.inner.symbols, program.model.time, STEP]


def kernel_stems(program: ControlProgram) -> list[str]:
    """The names of the kernels of an interval, without `_gradient` or `_hessian`, one for each of its elements."""
    return [stem for stem, _ in named_elements(program)]


def pattern_of(module: Any, share: str) -> list[tuple[int, int]]:
    """Rows and columns of the emitted Hessian of the interval, the start or the end; none where there is no kernel."""
    prefix = f"{share.upper()}_" if share in ("start", "end") else ""
    rows, columns = (getattr(module, f"{prefix}HESSIAN_{side}", ()) for side in ("ROWS", "COLUMNS"))
    return [(int(r), int(c)) for r, c in zip(rows, columns, strict=True)]


def parameter_vector(point: Point, program: ControlProgram) -> Any:
    """A row of `grid.parameters`: parameters, boundary values, inner times, shared unknowns, and numbers of tables.

    The interval begins at the first of the inner times.
    """
    given = (*program.model.parameters, *(value.symbol for value in program.boundary_values))
    later, inner = range(1, len(program.inner.times)), list[float]()
    if program.inner.times:
        time, step = point[program.model.time], point[STEP]
        inner += [time, *(time + 2.0 * i * step for i in later)]
        inner += [value for s in program.inner.symbols for value in (point[s], *(0.0 for _ in later))]
    shared = [point[s] for s in program.shared_symbols]
    return np.array([*(point[s] for s in given), *inner, *shared, *numbers_of(program.model)])


def step_lengths(point: Point, program: StepProgram) -> Any:
    """The lengths that a kernel takes: several where a composition has them, else that of the step."""
    return np.array([point[h] for h in program.lengths], dtype=float)


def few_steps(program: ControlProgram, steps: int) -> int:
    """As many intervals, or, where there are inner times, one between any two of them."""
    return len(program.inner.times) + 1 if program.inner.times else steps


_PREFERRED = (5, 2, 10, 7, 3, 6, 1, 0)
"""The order in which points of three places, each moved by ever more, are taken."""


def near_interval(context: Context, program: ControlProgram, stem: str) -> list[dict[Symbol, float]]:
    """Values of all symbols on intervals of a kind."""
    if context.guessed is None:
        return []
    local = program.element_symbols[: len(program.element_symbols) - len(program.shared)]
    return _points(context.guessed.on_intervals(local, parameters(program), part_of_chain(program, stem)), program)


def near_end(context: Context, program: ControlProgram, end: str) -> list[dict[Symbol, float]]:
    """Values of all symbols at the first or last node."""
    if context.guessed is None:
        return []
    node = program.left_symbols if end == "start" else program.right_symbols
    return _points(context.guessed.at_node(end == "end", node, parameters(program)), program)


def _points(values: Values, program: ControlProgram) -> list[dict[Symbol, float]]:
    named, inner = with_time(values, program.model.time), program.inner
    for column, symbol in enumerate(inner.symbols, start=1):
        named[symbol] = named[inner.parameters[column * len(inner.times)]]
    count = len(next(iter(named.values())))
    return [{s: float(array[index]) for s, array in named.items()} for index in _PREFERRED if index < count]


_STEPS = 2


def check_layout(context: Context) -> Iterator[Finding]:
    """Compare names and sizes, then run every kernel."""
    try:
        problem = _problem(context)
    except NoPointError as error:
        yield not_measured("layout", "sizes and patterns", str(error))
        return
    yield Finding("layout", "sizes and patterns", not problem, problem or "every kernel fills its arrays, and no more")


def _problem(context: Context) -> str:
    """What does not fit; empty where everything does."""
    if isinstance(context.program, ControlProgram):
        return _control_difference(context.module, context.program) or _control_run(context.module, context.program)
    return _step_difference(context.module, context.program) or _step_run(context.module, context.program)


def _control_difference(module: Any, program: ControlProgram) -> str:
    """How tables of the module contradict the program; empty when they do not."""
    flat = FlatVector.on_grid(program, few_steps(program, _STEPS))
    names = {
        "node": tuple(u.name for u in program.node),
        "interval": tuple(u.name for u in flat.inside[len(program.node) :]),
        "start": tuple(v.quantity for v in program.boundary_values if v.where == "start"),
        "end": tuple(v.quantity for v in program.boundary_values if v.where == "end"),
        "parameters": tuple(p.name for p in program.model.parameters),
    }
    return (
        _differing_metadata(module.metadata, names)
        or _differing_values(module, _sizes(program) | _tables(program))
        or _differing_structure(module, program)
        or _differing_condensed(module, program)
        or _differing_patterns(module, program)
        or _differing_couplings(module, program)
        or _differing_grid(module, program, flat)
    )


def _differing_metadata(recorded: Record, names: Mapping[str, tuple[str, ...]]) -> str:
    for key, marked in names.items():
        wanted = tuple(identifiers.plain(name) for name in marked)
        if (found := tuple(getattr(recorded, key))) != wanted:
            return f"{key} is {found}, expected {wanted}"
    return ""


def _differing_values(module: Any, wanted: Mapping[str, Any]) -> str:
    """The first of some constants that is missing or not what it should be."""
    for name, value in wanted.items():
        found = getattr(module, name, None)
        if _plain(found) != value:
            return f"{name} is {_plain(found)}, expected {value}"
    return ""


def _differing_structure(module: Any, program: ControlProgram) -> str:
    """The first field of the structure, which all solvers read, that contradicts the program."""
    structure = module.problem.structure
    for name, value in (_sizes(program) | _tables(program)).items():
        found = _plain(getattr(structure, name.lower()))
        if found != value:
            return f"{name.lower()} of the structure is {found}, expected {value}"
    for prefix in ("", "START_", "END_"):
        for side in ("ROWS", "COLUMNS"):
            found, own = getattr(structure, f"{prefix}{side}".lower()), _indices(module, f"{prefix}HESSIAN_{side}")
            if not np.array_equal(found, own):
                return f"{prefix}{side} of the structure are not {prefix}HESSIAN_{side}".lower()
    return ""


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _sizes(program: ControlProgram) -> dict[str, int]:
    own, shared = program.own, len(program.shared)
    node, couplings = len(program.node), len(program.couplings)
    stride = node + len(program.interval) + len(program.controls) + len(program.slacks)
    return {
        "NODE": node,
        "STRIDE": stride,
        "ELEMENT": stride + node,
        "BODIES": program.bodies,
        **({"OWN": own} if program.shared else {}),
        "SHARED": shared,
        "COUPLINGS": couplings,
        "ROOT": program.bodies * own + shared - own + couplings,
        **({"PHASES": len(program.phases)} if program.phases else {}),
    }


def _differing_condensed(module: Any, program: ControlProgram) -> str:
    """Slacks are eliminated inside their interval, and with them controls if their block allows it."""
    slacks = len(program.slacks)
    possible = sorted({slacks, slacks + len(program.controls)})
    condensed = module.problem.structure.condensed
    if condensed in possible:
        return ""
    return f"condensed of the structure is {condensed}, expected {' or '.join(map(str, possible))}"


def _tables(program: ControlProgram) -> dict[str, list[Any]]:
    """Index arrays that follow from the program."""
    tables: dict[str, list[Any]] = {
        "IS_MULTIPLIER": [u.multiplier for u in FlatVector(program, _STEPS).inside],
        "ONLY_AT_ENDS": list(program.only_at_ends),
    }
    for name, end in (("START", program.start), ("END", program.end)):
        tables[f"{name}_PINNED"] = sorted([*(index for index, _ in end.pins), *(index for index, _, _ in end.shared)])
        if program.start.shared or program.end.shared:
            tables[f"{name}_TIED"] = [index for index, _, _ in end.shared]
            tables[f"{name}_SHARED"] = [j for _, j, _ in end.shared]
    if program.method == "variational":
        n = len(program.model.coordinates)
        tables["EQUATIONS"] = list(range(n, 2 * n))
    if program.slacks:
        node = len(program.node)
        first = node + len(program.interval) + len(program.controls)
        tables["SLACKS"] = list(range(first, first + len(program.slacks)))
        tables["SLACK_MULTIPLIERS"] = [node + index for index in program.slack_multipliers]
    if program.phases:
        inside = range(len(program.interval) + len(program.controls) + len(program.slacks))
        tables["PHASE_LACKS"] = [[i in phase.regular.lacking for i in inside] for phase in program.phases]
        tables["SWITCH_LACKS"] = [[i in phase.elements[0].lacking for i in inside] for phase in program.phases[1:]]
    if any(u.multiplier for u in program.shared):
        tables["SHARED_IS_MULTIPLIER"] = [u.multiplier for u in program.shared]
    return tables


def _differing_patterns(module: Any, program: ControlProgram) -> str:
    node, shared = len(program.node), len(program.shared)
    element = len(program.element_symbols)
    for prefix, size in (("", element), ("START_", node + shared), ("END_", node + shared)):
        rows, columns = (_indices(module, f"{prefix}HESSIAN_{side}") for side in ("ROWS", "COLUMNS"))
        if rows.size != columns.size or np.any(columns > rows) or np.any(columns < 0) or np.any(rows >= size):
            return f"{prefix}HESSIAN_ROWS and {prefix}HESSIAN_COLUMNS are no lower triangle of a matrix of size {size}"
    return ""


def _differing_couplings(module: Any, program: ControlProgram) -> str:
    """Whether the tables of the terms of conditions between bodies stay inside what they refer to."""
    if not program.couplings:
        return ""
    kinds, rows, counts = (_indices(module, f"COUPLING_{name}") for name in ("KINDS", "ROWS", "COUNTS"))
    indices = _indices(module, "COUPLING_INDICES")
    available = sum(hasattr(module, f"coupling_{kind}") for kind in range(kinds.size))
    unknowns = _sizes(program)["ROOT"] - len(program.couplings)
    limits = (
        ("KINDS", kinds, available),
        ("ROWS", rows, len(program.couplings)),
        ("COUNTS", counts, indices.shape[-1] + 1),
        ("INDICES", indices, unknowns),
    )
    for name, table, size in limits:
        if table.shape[0] != kinds.size or np.any(table < 0) or np.any(table >= size):
            return f"COUPLING_{name} is {table.tolist()}, expected {kinds.size} entries below {size}"
    return ""


def _differing_grid(module: Any, program: ControlProgram, flat: FlatVector) -> str:
    """The vector of unknowns and the table of parameters that the module makes."""
    grid = module.make_grid(flat.phase_steps)
    parameters = len(program.model.parameters) + len(program.boundary_values) + len(program.inner.values)
    parameters += len(program.shared) + len(numbers_of(program.model))
    if program.sample is not None:
        own = parameters, 1 + len(program.sample.symbols)
        first, size = module.problem.structure.first_sample, module.problem.structure.sample
        if own != (first, size):
            return f"samples of {size} numbers begin at {first}, expected {own[1]} at {own[0]}"
        parameters += own[1] * max(len(data.rows) for data in program.model.measurements)
    if grid.parameters.shape != (program.bodies, parameters):
        return f"grid.parameters has shape {grid.parameters.shape}, expected {(program.bodies, parameters)}"
    for name, found, wanted in (
        ("grid.is_multiplier", grid.is_multiplier, flat.multipliers()),
        ("free_unknowns", free_unknowns(grid), flat.free()),
    ):
        if found.shape != wanted.shape:
            return f"{name} has {found.size} entries, expected {wanted.size}"
        if not np.array_equal(found, wanted):
            return f"{name} is wrong for {flat.names()[int(np.argmax(found != wanted))]}"
    return ""


def _indices(module: Any, name: str) -> Any:
    return np.asarray(getattr(module, name, ()), dtype=np.int64)


def _control_run(module: Any, program: ControlProgram) -> str:
    unknowns = program.element_symbols
    symbols = [*unknowns, *other_symbols(program)]
    values = [e for share in program.interval_elements for e in (share.element, share.cost)]
    values += [program.start.element, program.end.element]
    (point,) = random_points(values, symbols, program.model, count=1)
    shared, size, node = len(program.shared), len(unknowns), len(program.node)
    x, given = np.array([point[s] for s in unknowns[: size - shared]]), parameter_vector(point, program)
    t, h = point[program.model.time], point[STEP]
    entries = _indices(module, "HESSIAN_ROWS").size
    problem = ""
    for stem in dict.fromkeys([*kernel_stems(program), "interval"]):
        problem = problem or _run(module, f"{stem}_gradient", (x, t, h, given), gradient=(size,))
        problem = problem or _run(module, f"{stem}_hessian", (x, t, h, given), hessian=(entries,))
    for end, local in (("start", x[:node]), ("end", x[x.size - node :])):
        problem = problem or _run(module, f"{end}_gradient", (local, t, given), adds=True, gradient=(node + shared,))
        entries = _indices(module, f"{end.upper()}_HESSIAN_ROWS").size
        if hasattr(module, f"{end}_hessian") or entries:
            problem = problem or _run(module, f"{end}_hessian", (local, t, given), hessian=(entries,))
    if program.sample is not None:
        row = np.concatenate([given, np.full(module.problem.structure.sample, 0.5)])
        arguments = (x, t, h, row, given.size)
        problem = problem or _run(module, "sample_values", arguments, values=(len(program.sample.values),))
        problem = problem or _run(module, "sample_gradient", arguments, adds=True, gradient=(size,))
        entries = _indices(module, "HESSIAN_ROWS").size
        problem = problem or _run(module, "sample_hessian", arguments, adds=True, hessian=(entries,))
    return problem or _run_couplings(module, program, given)


def _run_couplings(module: Any, program: ControlProgram, given: Any) -> str:
    """Run the kernel of every term of the conditions between bodies with as many values as it is said to read."""
    if not program.couplings:
        return ""
    conditions = [coupling.expression for coupling in program.couplings]
    symbols = shared_symbols(program)
    (point,) = random_points(conditions, [*symbols, *other_symbols(program)], program.model, count=1)
    values = np.array([point[symbol] for symbol in symbols])
    tables = module.COUPLING_KINDS, module.COUPLING_COUNTS, module.COUPLING_INDICES
    for kind, count, indices in zip(*tables, strict=True):
        shapes: dict[str, Any] = {"slopes": (count,), "curvatures": (count * count,)}
        problem = _run(module, f"coupling_{kind}", (values[indices[:count]], given), **shapes)
        if problem:
            return problem
    return ""


def _step_difference(module: Any, program: StepProgram) -> str:
    """How names or sizes of the module contradict the program; empty when they do not."""
    names = {
        "node": tuple(u.name for u in program.state),
        "stages": tuple(s.name for s in program.stage_symbols),
        "unknowns": tuple(s.name for s in program.unknowns),
        "parameters": tuple(p.name for p in program.model.parameters),
    }
    sizes = {"STATE": len(program.state), "STAGES": len(program.stage_symbols), "UNKNOWNS": len(program.unknowns)}
    if program.fractions:
        found = np.array(getattr(module, "FRACTIONS", []))
        exact = np.array([[float(sympy.N(f, 20)) for f in row] for row in program.fractions])
        if found.shape != exact.shape or not np.abs(found - exact).max() < 1e-15:
            return "FRACTIONS are not those of the composition"
    wanted = {name: size for name, size in sizes.items() if size or hasattr(module, name)}
    return _differing_metadata(module.metadata, names) or _differing_values(module, wanted)


def _step_run(module: Any, program: StepProgram) -> str:
    interval = [*program.stage_symbols, *program.right_symbols]
    symbols = [*program.left_symbols, *interval, *program.model.parameters, program.model.time]
    symbols = list(dict.fromkeys([*symbols, *program.lengths, *program.unknowns]))
    expressions = [value for _, value in program.equations]
    (point,) = random_points(expressions, symbols, program.model, count=1)

    def at(group: Any) -> Any:
        return np.array([point[symbol] for symbol in group])

    length = step_lengths(point, program)
    parameters = np.array([*at(program.model.parameters), *numbers_of(program.model)])
    base = (at(program.left_symbols), point[program.model.time], length, parameters)
    size, whole = len(program.unknowns), len(interval)
    problem = _run(module, "step_equations", (base[0], at(interval), *base[1:]), residual=(whole,))
    problem = problem or _run(module, "energy", (base[0], base[1], base[3]))
    if not size:
        return problem or _run(module, "explicit_step", base, interval=(whole,))
    y = at(program.unknowns)
    problem = problem or _run(module, "predict_step", base, unknowns=(size,))
    problem = problem or _run(module, "step_residual", (y, *base), residual=(size,))
    problem = problem or _run(module, "step_jacobian", (y, *base), residual=(size,), jacobian=(size**2,))
    return problem or _run(module, "complete_step", (y, *base), interval=(whole,))


def _run(module: Any, name: str, inputs: Any, adds: bool = False, **outputs: tuple[int, ...]) -> str:
    """Interpret a kernel with outputs of the given shapes; what goes wrong, in words."""
    kernel = getattr(module, name, None)
    if kernel is None:
        return f"kernel {name} is missing"
    arrays = {key: np.full(shape, 0.0 if adds else np.nan) for key, shape in outputs.items()}
    try:
        getattr(kernel, "py_func", getattr(kernel, "function", kernel))(*inputs, **arrays)
    except Exception as error:  # a damaged kernel may fail in any way
        return " ".join(f"kernel {name} fails ({type(error).__name__}: {error})".split())
    for key, array in arrays.items():
        if np.isnan(array).any():
            return f"kernel {name} leaves {key}{np.argwhere(np.isnan(array))[0].tolist()} without a value"
    return ""


def compare(file: Path, module: Any, inputs: str, text: str) -> Iterator[Finding]:
    """Compare the recorded hash of the inputs, and the text line by line, with those of a fresh derivation."""
    recorded = module.metadata.inputs
    same = recorded == inputs
    detail = "the recorded hash is that of the problem file, its arguments and versions"
    if not same:
        detail = f"made from other inputs (recorded {str(recorded)[:12]}, now {inputs[:12]}); build it again"
    yield Finding("provenance", "inputs", same, detail)
    difference = first_difference(file.read_text(encoding="utf-8"), text)
    detail = difference or "identical to a fresh derivation, byte by byte"
    yield Finding("provenance", "text", not difference, detail)


def first_difference(found: str, wanted: str) -> str:
    """The first line in which two texts differ, in words; empty when they are the same."""
    if found == wanted:
        return ""
    lines, others = found.splitlines(keepends=True), wanted.splitlines(keepends=True)
    matcher = difflib.SequenceMatcher(None, lines, others, autojunk=False)
    for tag, first, last, start, stop in matcher.get_opcodes():
        if tag == "equal":
            continue
        ours = lines[first].strip() if first < last else "nothing"
        theirs = others[start].strip() if start < stop else "nothing"
        return f"line {first + 1} reads {ours[:120]!r}, expected {theirs[:120]!r}"
    return "the texts differ"
