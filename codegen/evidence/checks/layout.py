"""The comparison of a module's sizes and patterns with the derivation, and the layout of the flat vector of unknowns.

Compiled code does not check array bounds, so a module whose layout does not fit must not run at all. The check runs
every kernel once as plain Python with arrays of the derived sizes. This finds accesses outside an array. Arrays start
as NaN, so that missing entries are visible.

`FlatVector` derives the positions of unknowns from the program alone. For each body the vector holds node 0,
interval 0, node 1, ..., node N. Then follow the linking unknowns of every body, the linking unknowns of the whole
problem, and the multipliers of the conditions between bodies.

Points near the initial guess of the module have its boundary values and default parameters. Far from the guess an
exponential atmosphere, a reaction rate or a Gaussian may be constant, and a check would detect no error.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, cast

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Symbol

from codegen import identifiers
from codegen.discretise.interval import STEP
from codegen.discretise.program import ControlProgram, IntervalElement, StepProgram, Unknown
from codegen.emit.lower.control.kernels import named_elements
from codegen.emit.lower.control.layout import parameters
from codegen.emit.lower.simulate import EVENT_KERNELS, rows_of_events
from codegen.emit.verify.comparison import Values, with_time
from codegen.emit.verify.kernels import part_of_chain
from codegen.emit.verify.shares import shared_symbols
from codegen.evidence.checks.base import Context, Finding, NoPointError, Point, not_measured, random_points
from codegen.runtime.record import Meaning, Record
from codegen.runtime.search.grid import free_unknowns
from codegen.solving.loading import Vector
from codegen.symbolic.functions import numbers_of

_STEPS = 2
Inputs = tuple[float | Vector, ...]


def check_layout(context: Context) -> Iterator[Finding]:
    """Check names and sizes of the module, then run every kernel. The finding names the first problem."""
    module, program = context.module, context.program
    if isinstance(program, ControlProgram):
        problems = _control_problems(module, program)
    else:
        problems = _step_problems(module, program)
    try:
        problem = next(problems, "")
    except NoPointError as error:
        yield not_measured("layout", "sizes and patterns", str(error))
        return
    yield Finding("layout", "sizes and patterns", not problem, problem or "every kernel fills its arrays, and no more")


def compare(file: Path, module: ModuleType, inputs: str, text: str) -> Iterator[Finding]:
    """Compare a module's recorded hash with the hash `inputs`, and its `file` with the newly derived `text`."""
    recorded = module.metadata.inputs
    right = "the recorded hash is that of the problem file, its arguments and versions"
    wrong = f"made from other inputs (recorded {str(recorded)[:12]}, now {inputs[:12]}); build it again"
    yield Finding.decided("provenance", "inputs", recorded == inputs, right, wrong)
    lines, others = (s.splitlines(keepends=True) for s in (file.read_text(encoding="utf-8"), text))
    if lines == others:
        yield Finding("provenance", "text", True, "identical to a fresh derivation, byte by byte")
        return
    opcodes = difflib.SequenceMatcher(None, lines, others, autojunk=False).get_opcodes()
    _, first, last, start, stop = next(opcode for opcode in opcodes if opcode[0] != "equal")
    ours = lines[first].strip() if first < last else "nothing"
    theirs = others[start].strip() if start < stop else "nothing"
    detail = f"line {first + 1} reads {ours[:120]!r}, expected {theirs[:120]!r}"
    yield Finding("provenance", "text", False, detail)


Indices = NDArray[np.int64]


class FlatVector:
    """The positions of unknowns in the flat vector for `steps` intervals. `body` and `k` (node, interval) start at 0.

    `inside` are the unknowns of a node and of the interval after it. `chain` is the number of unknowns in the nodes and
    intervals of a body. `inner_nodes` maps the number of a node to the number of the inner time at this node.
    """

    def __init__(self, program: ControlProgram, steps: int) -> None:
        self.program, self.steps = program, steps
        self.phase_steps = steps // max(1, len(program.phases))
        self.inside: tuple[Unknown, ...] = (*program.node, *program.interval, *program.controls, *program.slacks)
        self.chain = steps * len(self.inside) + len(program.node)
        self.first_shared = program.model.bodies * self.chain
        self.first_coupling = (
            self.first_shared + program.model.bodies * program.linking.own + len(program.linking.common)
        )
        self.size = self.first_coupling + len(program.linking.couplings)
        count = len(program.inner.times)
        self.inner_nodes = {number + 1: number for number in range(count)} if steps == count + 1 else {}

    @classmethod
    def on_grid(cls, program: ControlProgram, steps: int) -> FlatVector:
        """Return the layout for a grid of `steps` intervals, or of `steps` intervals per phase if there are phases."""
        return cls(program, steps * max(1, len(program.phases)))

    def share(self, k: int) -> IntervalElement:
        """Return the terms of interval k in the Lagrangian of the optimisation problem."""
        if not self.program.phases:
            return self.program.interval_elements[0]
        index, within = divmod(k, self.phase_steps)
        phase = self.program.phases[index]
        return phase.elements[0] if within == 0 else phase.regular

    def node(self, body: int, k: int) -> Indices:
        """Return the indices of the unknowns of a node."""
        return body * self.chain + k * len(self.inside) + np.arange(len(self.program.node))

    def interval(self, body: int, k: int) -> Indices:
        """Return the indices of the unknowns between two nodes: stages, multipliers, controls, slacks."""
        first = body * self.chain + k * len(self.inside)
        return first + np.arange(len(self.program.node), len(self.inside))

    def shared(self, body: int) -> Indices:
        """Return the indices of the linking unknowns of a body, then of the whole problem."""
        program = self.program
        common = self.first_shared + program.model.bodies * program.linking.own
        of_body = self.first_shared + body * program.linking.own + np.arange(program.linking.own)
        return np.concatenate([of_body, common + np.arange(len(program.linking.common))])

    def element(self, body: int, k: int) -> Indices:
        """Return the indices of all unknowns in the terms of interval k in the Lagrangian."""
        return np.concatenate([self.node(body, k), self.interval(body, k), self.node(body, k + 1), self.shared(body)])

    def end(self, body: int, where: str) -> Indices:
        """Return the indices of all unknowns in the Lagrangian's terms of the end `where`: "start" or "end"."""
        return np.concatenate([self.node(body, 0 if where == "start" else self.steps), self.shared(body)])

    def unknowns(self) -> list[tuple[Unknown, str]]:
        """Return all unknowns with their places, such as " at node 3 of body 0"."""
        program, several = self.program, self.program.model.bodies > 1
        of_bodies = [f" of body {body}" if several else "" for body in range(program.model.bodies)]
        unknowns = []
        for of_body in of_bodies:
            for k in range(self.steps):
                unknowns += [(u, f" at node {k}{of_body}") for u in program.node]
                unknowns += [(u, f" on interval {k}{of_body}") for u in self.inside[len(program.node) :]]
            unknowns += [(u, f" at node {self.steps}{of_body}") for u in program.node]
        unknowns += [(u, of_body) for of_body in of_bodies for u in program.linking.of_bodies]
        return unknowns + [
            (u, "") for u in (*program.linking.common, *(c.multiplier for c in program.linking.couplings))
        ]

    def multipliers(self) -> NDArray[np.bool_]:
        """Return the boolean mask of the multipliers."""
        return np.array([unknown.multiplier for unknown, _ in self.unknowns()], bool)

    def free(self) -> NDArray[np.bool_]:
        """Return the mask of unknowns that are neither prescribed, nor tied to a linking unknown, nor unused."""
        program, free = self.program, np.ones(self.size, bool)
        for body in range(program.model.bodies):
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
        """Return for every unknown its index, or the index of the linking unknown that it equals up to an offset."""
        indices = np.arange(self.size)
        for body in range(self.program.model.bodies):
            for k, end in ((0, self.program.start), (self.steps, self.program.end)):
                for index, j, _ in end.shared:
                    indices[self.node(body, k)[index]] = self.shared(body)[j]
        return indices

    def names(self) -> list[str]:
        """Return a name for every unknown, for example `lambda_x at node 3 of body 0`."""
        return [f"{unknown.name}{place}" for unknown, place in self.unknowns()]

    def meanings(self) -> list[Meaning]:
        """Return the meaning of every unknown."""
        return [unknown.meaning for unknown, _ in self.unknowns()]


def other_symbols(program: ControlProgram) -> list[Symbol]:
    """Return the symbols of the Lagrangian other than unknowns: parameters, boundary values, time and step.

    If there are inner times, the symbols of an interval's left node come before the time.
    """
    data = (*program.model.parameters, *(v.symbol for v in program.boundary_values))
    return [*data, *program.inner.symbols, program.model.time, STEP]


def kernel_stems(program: ControlProgram) -> list[str]:
    """Return the name of every interval kernel without its ending `_gradient` or `_hessian`."""
    return [stem for stem, _ in named_elements(program)]


def pattern_of(module: ModuleType, share: str) -> list[tuple[int, int]]:
    """Return the entries (row, column) of an emitted Hessian; `share` is "interval", "start" or "end". May be empty."""
    prefix = f"{share.upper()}_" if share in ("start", "end") else ""
    rows, columns = (getattr(module, f"{prefix}HESSIAN_{side}", ()) for side in ("ROWS", "COLUMNS"))
    return [(int(r), int(c)) for r, c in zip(rows, columns, strict=True)]


def parameter_vector(point: Point, program: ControlProgram) -> Vector:
    """Return a row of `grid.parameters` for an interval that begins at the first inner time.

    The row holds parameters, boundary values, inner times, linking unknowns, and numbers of tables.
    """
    data = (*program.model.parameters, *(value.symbol for value in program.boundary_values))
    later, inner = range(1, len(program.inner.times)), list[float]()
    if program.inner.times:
        time, step = point[program.model.time], point[STEP]
        inner += [time, *(time + 2.0 * i * step for i in later)]
        inner += [value for s in program.inner.symbols for value in (point[s], *(0.0 for _ in later))]
    shared = [point[s] for s in program.linking.symbols]
    return np.array([*(point[s] for s in data), *inner, *shared, *numbers_of(program.model)])


def step_lengths(point: Point, program: StepProgram) -> Vector:
    """Return the step lengths that a simulation kernel takes: one, or several for a composition."""
    return np.array([point[h] for h in program.lengths], dtype=float)


def few_steps(program: ControlProgram, steps: int) -> int:
    """Return `steps`; with inner times, the number of intervals that places one interval between any two times."""
    return len(program.inner.times) + 1 if program.inner.times else steps


_PREFERRED = (5, 2, 10, 7, 3, 6, 1, 0)
"""Indices of points near the guess, by preference: three positions, each with four perturbations of growing size."""


def near_interval(context: Context, program: ControlProgram, stem: str) -> list[dict[Symbol, float]]:
    """Return points (numbers by symbol) near the initial guess, in intervals that use the kernel `stem`."""
    if context.guessed is None:
        return []
    local = program.element_symbols[: len(program.element_symbols) - len(program.linking.unknowns)]
    return _points(context.guessed.on_intervals(local, parameters(program), part_of_chain(program, stem)), program)


def near_end(context: Context, program: ControlProgram, end: str) -> list[dict[Symbol, float]]:
    """Return points (numbers by symbol) near the initial guess, at the node of `end`: "start" or "end"."""
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


def _control_problems(module: ModuleType, program: ControlProgram) -> Iterator[str]:
    """Yield a text for each contradiction between a control module and its program; later ones may be consequences."""
    flat = FlatVector.on_grid(program, few_steps(program, _STEPS))
    names = {
        "node": tuple(u.name for u in program.node),
        "interval": tuple(u.name for u in flat.inside[len(program.node) :]),
        "start": tuple(v.quantity for v in program.boundary_values if v.where == "start"),
        "end": tuple(v.quantity for v in program.boundary_values if v.where == "end"),
        "parameters": tuple(p.name for p in program.model.parameters),
    }
    constants = _constants(program)
    yield from _differing_values(module, names, constants)

    structure = module.problem.structure
    for name, value in constants.items():
        emitted = _plain(getattr(structure, name.lower()))
        if emitted != value:
            yield f"{name.lower()} of the structure is {emitted}, expected {value}"
    for prefix in ("", "START_", "END_"):
        for side in ("ROWS", "COLUMNS"):
            indices = getattr(structure, f"{prefix}{side}".lower())
            if not np.array_equal(indices, _indices(module, f"{prefix}HESSIAN_{side}")):
                yield f"{prefix}{side} of the structure are not {prefix}HESSIAN_{side}".lower()
    # Slacks are eliminated inside their interval; controls as well if their block allows it.
    slacks = len(program.slacks)
    possible = sorted({slacks, slacks + len(program.controls)})
    if structure.condensed not in possible:
        yield f"condensed of the structure is {structure.condensed}, expected {' or '.join(map(str, possible))}"

    node, shared, unknowns = len(program.node), len(program.linking.unknowns), program.element_symbols
    for prefix, size in (("", len(unknowns)), ("START_", node + shared), ("END_", node + shared)):
        rows, columns = (_indices(module, f"{prefix}HESSIAN_{side}") for side in ("ROWS", "COLUMNS"))
        if rows.size != columns.size or np.any(columns > rows) or np.any(columns < 0) or np.any(rows >= size):
            yield f"{prefix}HESSIAN_ROWS and {prefix}HESSIAN_COLUMNS are no lower triangle of a matrix of size {size}"

    if program.linking.couplings:  # tables of the terms of conditions between bodies
        kinds, indices = _indices(module, "COUPLING_KINDS"), _indices(module, "COUPLING_INDICES")
        available = sum(hasattr(module, f"coupling_{kind}") for kind in range(kinds.size))
        for name, limit in (
            ("KINDS", available),
            ("ROWS", len(program.linking.couplings)),
            ("COUNTS", indices.shape[-1] + 1),
            ("INDICES", program.model.bodies * program.linking.own + len(program.linking.common)),
        ):
            table = _indices(module, f"COUPLING_{name}")
            if table.shape[0] != kinds.size or np.any(table < 0) or np.any(table >= limit):
                yield f"COUPLING_{name} is {table.tolist()}, expected {kinds.size} entries below {limit}"
    grid = module.make_grid(flat.phase_steps)
    count = len(program.model.parameters) + len(program.boundary_values) + len(program.inner.values)
    count += len(program.linking.unknowns) + len(numbers_of(program.model))
    if program.sample is not None:
        samples = count, 1 + len(program.sample.symbols)
        first, size = module.problem.structure.first_sample, module.problem.structure.sample
        if samples != (first, size):
            yield f"samples of {size} numbers begin at {first}, expected {samples[1]} at {samples[0]}"
        count += samples[1] * max(len(data.rows) for data in program.model.measurements)
    if grid.parameters.shape != (program.model.bodies, count):
        yield f"grid.parameters has shape {grid.parameters.shape}, expected {(program.model.bodies, count)}"
    for name, mask, expected in (
        ("grid.is_multiplier", grid.is_multiplier, flat.multipliers()),
        ("free_unknowns", free_unknowns(grid), flat.free()),
    ):
        if mask.shape != expected.shape:
            yield f"{name} has {mask.size} entries, expected {expected.size}"
        if not np.array_equal(mask, expected):
            yield f"{name} is wrong for {flat.names()[int(np.argmax(mask != expected))]}"
    yield from _failing_kernels(module, program)


def _differing_values(
    module: ModuleType, names: Mapping[str, Sequence[str]], constants: Mapping[str, object]
) -> Iterator[str]:
    """Yield a text for each recorded name or constant of the module that differs from its expected value."""
    recorded: Record = module.metadata
    for key, marked in names.items():
        expected = tuple(identifiers.plain(name) for name in marked)
        if (emitted := tuple(getattr(recorded, key))) != expected:
            yield f"{key} is {emitted}, expected {expected}"
    for name, value in constants.items():
        constant = _plain(getattr(module, name, None))
        if constant != value:
            yield f"{name} is {constant}, expected {value}"


def _plain(value: object) -> object:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _indices(module: ModuleType, name: str) -> NDArray[np.int64]:
    return np.asarray(getattr(module, name, ()), dtype=np.int64)


def _constants(program: ControlProgram) -> dict[str, object]:
    """Return the expected sizes and index arrays of the module by name, derived from the program."""
    own, shared = program.linking.own, len(program.linking.unknowns)
    node, couplings = len(program.node), len(program.linking.couplings)
    stride = node + len(program.interval) + len(program.controls) + len(program.slacks)
    constants: dict[str, object] = {
        "NODE": node,
        "STRIDE": stride,
        "ELEMENT": stride + node,
        "BODIES": program.model.bodies,
        **({"OWN": own} if program.linking.unknowns else {}),
        "SHARED": shared,
        "COUPLINGS": couplings,
        "ROOT": program.model.bodies * own + shared - own + couplings,
        **({"PHASES": len(program.phases)} if program.phases else {}),
        "IS_MULTIPLIER": [u.multiplier for u in FlatVector(program, _STEPS).inside],
        "ONLY_AT_ENDS": list(program.only_at_ends),
    }
    for name, end in (("START", program.start), ("END", program.end)):
        constants[f"{name}_PINNED"] = sorted([*(i for i, _ in end.pins), *(i for i, _, _ in end.shared)])
        if program.start.shared or program.end.shared:
            constants[f"{name}_TIED"] = [index for index, _, _ in end.shared]
            constants[f"{name}_SHARED"] = [j for _, j, _ in end.shared]
    if program.method == "variational":
        n = len(program.model.coordinates)
        constants["EQUATIONS"] = list(range(n, 2 * n))
    if program.slacks:
        first = node + len(program.interval) + len(program.controls)
        constants["SLACKS"] = list(range(first, first + len(program.slacks)))
        constants["SLACK_MULTIPLIERS"] = [node + index for index in program.slack_multipliers]
    if program.phases:
        inside = range(stride - node)
        constants["PHASE_LACKS"] = [[i in phase.regular.lacking for i in inside] for phase in program.phases]
        constants["SWITCH_LACKS"] = [[i in phase.elements[0].lacking for i in inside] for phase in program.phases[1:]]
    if any(u.multiplier for u in program.linking.unknowns):
        constants["SHARED_IS_MULTIPLIER"] = [u.multiplier for u in program.linking.unknowns]
    return constants


def _failing_kernels(module: ModuleType, program: ControlProgram) -> Iterator[str]:
    unknowns = program.element_symbols
    symbols = [*unknowns, *other_symbols(program)]
    values = [e for share in program.interval_elements for e in (share.element, share.cost)]
    values += [program.start.element, program.end.element]
    (point,) = random_points(values, symbols, program.model, count=1)
    shared, size, node = len(program.linking.unknowns), len(unknowns), len(program.node)
    x, data = np.array([point[s] for s in unknowns[: size - shared]]), parameter_vector(point, program)
    t, h = point[program.model.time], point[STEP]
    entries = _indices(module, "HESSIAN_ROWS").size
    for stem in dict.fromkeys([*kernel_stems(program), "interval"]):
        yield from _run(module, f"{stem}_gradient", (x, t, h, data), gradient=(size,))
        yield from _run(module, f"{stem}_hessian", (x, t, h, data), hessian=(entries,))
    for end, local in (("start", x[:node]), ("end", x[x.size - node :])):
        yield from _run(module, f"{end}_gradient", (local, t, data), adds=True, gradient=(node + shared,))
        end_entries = _indices(module, f"{end.upper()}_HESSIAN_ROWS").size
        if hasattr(module, f"{end}_hessian") or end_entries:
            yield from _run(module, f"{end}_hessian", (local, t, data), hessian=(end_entries,))
    if program.sample is not None:
        row = np.concatenate([data, np.full(module.problem.structure.sample, 0.5)])
        arguments = (x, t, h, row, data.size)
        yield from _run(module, "sample_values", arguments, values=(len(program.sample.values),))
        yield from _run(module, "sample_gradient", arguments, adds=True, gradient=(size,))
        yield from _run(module, "sample_hessian", arguments, adds=True, hessian=(entries,))
    if program.linking.couplings:  # the tables have the number of values that each term reads
        conditions, symbols = [coupling.expression for coupling in program.linking.couplings], shared_symbols(program)
        (point,) = random_points(conditions, [*symbols, *other_symbols(program)], program.model, count=1)
        linking = np.array([point[symbol] for symbol in symbols])
        tables = module.COUPLING_KINDS, module.COUPLING_COUNTS, module.COUPLING_INDICES
        for kind, count, indices in zip(*tables, strict=True):
            inputs = linking[indices[:count]], data
            yield from _run(module, f"coupling_{kind}", inputs, slopes=(count,), curvatures=(count * count,))


def _step_problems(module: ModuleType, program: StepProgram) -> Iterator[str]:
    """Yield a text for each contradiction between a simulation module and its program."""
    names = {
        "node": tuple(u.name for u in program.state),
        "stages": tuple(s.name for s in program.stage_symbols),
        "unknowns": tuple(s.name for s in program.unknowns),
        "constraints": tuple(c.name for c in program.constraints),
        "events": tuple(event.name for event in program.events),
        "gaps": tuple(gap.name for gap in program.gaps),
        "parameters": tuple(p.name for p in program.model.parameters),
    }
    if program.fractions:
        fractions = np.array(getattr(module, "FRACTIONS", []))
        exact = np.array([[float(sympy.N(f, 20)) for f in row] for row in program.fractions])
        if fractions.shape != exact.shape or not np.abs(fractions - exact).max() < 1e-15:
            yield "FRACTIONS are not those of the composition"
    sizes = {"STATE": len(program.state), "STAGES": len(program.stage_symbols), "UNKNOWNS": len(program.unknowns)}
    yield from _differing_values(module, names, {k: size for k, size in sizes.items() if size or hasattr(module, k)})

    interval = [*program.stage_symbols, *program.right_symbols]
    symbols = [*program.left_symbols, *interval, *program.model.parameters, program.model.time]
    symbols = list(dict.fromkeys([*symbols, *program.lengths, *program.unknowns]))
    (point,) = random_points([value for _, value in program.equations], symbols, program.model, count=1)

    def at(group: Sequence[Symbol]) -> Vector:
        return np.array([point[symbol] for symbol in group])

    data = np.array([*at(program.model.parameters), *numbers_of(program.model)])
    base = (at(program.left_symbols), point[program.model.time], step_lengths(point, program), data)
    size, whole = len(program.unknowns), len(interval)
    yield from _run(module, "step_equations", (base[0], at(interval), *base[1:]), residual=(whole,))
    if program.energy is not None:
        yield from _run(module, "energy", (base[0], base[1], base[3]))
    if program.constraints:
        shape = (sum(len(c.row) for c in program.constraints),)
        yield from _run(module, "node_constraints", (base[0], base[1], base[3]), True, values=shape)
    for name, entries in rows_of_events(program).items():
        yield from _run(module, name, (base[0], base[1], base[3]), False, **{EVENT_KERNELS[name][0]: (len(entries),)})
    if not size:
        yield from _run(module, "explicit_step", base, interval=(whole,))
        return
    y = at(program.unknowns)
    yield from _run(module, "predict_step", base, unknowns=(size,))
    yield from _run(module, "step_residual", (y, *base), residual=(size,))
    yield from _run(module, "step_jacobian", (y, *base), True, residual=(size,), jacobian=(size**2,))
    yield from _run(module, "complete_step", (y, *base), interval=(whole,))


def _in_python(module: ModuleType, kernel: object) -> Callable[..., object]:
    """Return a kernel as a function of plain Python, which calls other kernels in plain Python too.

    After a solve, kernels that only compiled functions call have no machine code that Python could call.
    """

    def plain(value: object) -> Any:
        return getattr(value, "py_func", getattr(value, "function", value))

    function = plain(kernel)
    if not isinstance(function, FunctionType):
        return cast("Callable[..., object]", function)
    kernels = {name: plain(each) for name, each in vars(module).items() if name.endswith(("_gradient", "_hessian"))}
    return FunctionType(function.__code__, {**function.__globals__, **kernels}, argdefs=function.__defaults__)


def _run(
    module: ModuleType, name: str, inputs: Inputs, adds: bool = False, **outputs: tuple[int, ...]
) -> Iterator[str]:
    """Run a kernel in plain Python and yield its problems. Outputs of these shapes start at 0 if `adds`, else NaN."""
    kernel = getattr(module, name, None)
    if kernel is None:
        yield f"kernel {name} is missing"
        return
    arrays = {key: np.full(shape, 0.0 if adds else np.nan) for key, shape in outputs.items()}
    try:
        _in_python(module, kernel)(*inputs, **arrays)
    except Exception as error:  # a damaged kernel may fail in any way
        yield " ".join(f"kernel {name} fails ({type(error).__name__}: {error})".split())
    for key, array in arrays.items():
        if np.isnan(array).any():
            yield f"kernel {name} leaves {key}{np.argwhere(np.isnan(array))[0].tolist()} without a value"
