"""Lowering of an initial value problem, its derivatives, events and gaps to the kernels and texts of a module.

The equations of a long chain have one loop for all inner links. A row is a sequence of outputs that belong together,
such as an equation and its derivatives. Alike rows differ only in the indices of arrays. An index is linear in the
number i of the repetition, or comes from a table with one row for each repetition. Common subexpressions are found in
one row at a time.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import sympy
from sympy import Expr, Symbol

from codegen.discretise.program import StepProgram
from codegen.emit.differentiation import StepDerivatives
from codegen.emit.lower.kernels import (
    KERNEL,
    VALUE,
    Kernel,
    Line,
    Loop,
    Output,
    described_tables,
    inputs_kernel,
    kernel,
    needed,
    range_constants,
    ranged_inputs,
    table_constants,
    table_kernels,
)
from codegen.emit.lower.module import SimulateModule, arguments_of, record_fields, system_fields
from codegen.emit.lower.printer import readable, scalar_code, stabilised, with_decimal_roots
from codegen.runtime.record import EventAction, SimulationRecord, StepSolver, phrase
from codegen.symbolic.checks import longer_than
from codegen.symbolic.derivatives import values_of
from codegen.symbolic.functions import TableBase, tables_of
from codegen.symbolic.graph import Assignment, StraightLine
from codegen.symbolic.tables import TableData
from codegen.symbolic.terms import MANY, Family, are_many, families

_LONG_VALUE = 100
"""Number of operations from which the value of an assignment is not substituted into the rows."""
_GROWTH = 4
"""Factor by which the rows may grow if assignments are substituted into them."""
Column = tuple[int, ...]
"""The index of an array in each repetition of a loop."""


def looped(
    name: str,
    summary: str,
    arguments: Sequence[str],
    codes: Mapping[Symbol, str],
    outputs: Sequence[Output],
    assignments: Sequence[Assignment] = (),
    decorators: tuple[str, ...] = (),
    straight_line: Sequence[Assignment] = (),
    row_of: Sequence[int] = (),
) -> Kernel:
    """Return the result of `kernel`, with loops over alike rows if there are many.

    `row_of` has the number of the row of each output; by default each output is a row. The `assignments` are
    substituted into the rows of loops. The `straight_line` is evaluated before all rows.
    """
    rows: list[list[Output]] = [[] for _ in range(max(row_of, default=-1) + 1)] if row_of else [[o] for o in outputs]
    for output, row in zip(outputs, row_of, strict=False):
        rows[row].append(output)
    written, kept = _substituted(rows, assignments) if len(rows) >= MANY else (None, [])
    found = families([[o.value for o in row] for row in written or ()], lambda s: _split(codes.get(s, s.name))[0])
    if written is None or not are_many(found):
        return kernel(name, summary, arguments, codes, outputs, None, assignments, decorators, straight_line)
    # Rows that read tables stay outside of loops.
    long = [f for f in found if f.is_large and not any(value.has(TableBase) for value in f.template)]
    inside = {member.row for family in long for member in family.members}
    others = [output for i, row in enumerate(written) if i not in inside for output in row]
    plain = kernel(name, summary, arguments, codes, others, None, kept, decorators, straight_line)
    writer = _Writer(name, codes, {*arguments, *(line.target for line in (*plain.inputs, *plain.body))})
    loops = [writer.loop(family, [written[member.row] for member in family.members]) for family in long]
    read = writer.fixed | {line.target for line in plain.inputs}
    return replace(
        plain,
        inputs=tuple(Line(s.name, code) for s, code in codes.items() if s.name in read and code != s.name),
        loops=tuple(loops),
        tables=tuple(writer.tables),
        operations_before=plain.operations_before + writer.before,
        operations_after=plain.operations_after + writer.after,
    )


def _substituted(
    rows: Sequence[Sequence[Output]], assignments: Sequence[Assignment]
) -> tuple[list[list[Output]] | None, list[Assignment]]:
    """Return rows without short assignments, or None if the rows become much longer, and the long assignments."""
    values, kept = dict[Expr, Expr](), list[Assignment]()
    if not assignments:
        return [list(row) for row in rows], kept
    for symbol, value in assignments:
        written = value.xreplace(values)
        if longer_than(_LONG_VALUE, [written]):
            kept.append((symbol, written))
        else:
            values[symbol] = written
    replaced = [[replace(output, value=output.value.xreplace(values)) for output in row] for row in rows]
    before = sum(int(value.count_ops()) for _, value in assignments)
    before += sum(int(output.value.count_ops()) for row in rows for output in row)
    after = sum(int(output.value.count_ops()) for row in replaced for output in row)
    return replaced if after <= _GROWTH * before else None, kept


def _split(code: str) -> tuple[str, int]:
    """Return the array and the index in the code of an entry; the code and -1 for other code."""
    match = re.fullmatch(r"(\w+)\[(\d+)\]", code)
    return (match[1], int(match[2])) if match else (code, -1)


class _Writer:
    """A writer of the loops of one kernel.

    `tables` are the constants that the loops read. `fixed` are the names of symbols that are the same in all rows.
    """

    def __init__(self, kernel: str, codes: Mapping[Symbol, str], taken: set[str]) -> None:
        self.kernel, self.codes = kernel, codes
        self.taken = taken | {symbol.name for symbol in codes} | {"i"}
        self.tables: list[Line] = []
        self.fixed: set[str] = set()
        self.before = self.after = 0

    def loop(self, family: Family, rows: Sequence[Sequence[Output]]) -> Loop:
        """Return the loop over the members of a family, whose outputs are `rows`."""
        count = len(family.members)
        table = _Table(f"{self.kernel.upper()}_{len(self.tables) + 1}", count)
        names, inputs = dict[Symbol, Symbol](), list[Line]()
        for slot, symbols in zip(family.slots, zip(*(m.symbols for m in family.members), strict=True), strict=True):
            if len(set(symbols)) == 1:
                names[slot] = symbols[0]
                self.fixed.add(symbols[0].name)
                continue
            arrays, indices = zip(*(_split(self.codes[symbol]) for symbol in symbols), strict=True)
            inputs.append(Line(slot.name, f"{arrays[0]}[{table.code(indices)}]"))
        values = [with_decimal_roots(stabilised(value.xreplace(names))) for value in family.template]
        taken = self.taken | {slot.name for slot in family.slots}
        fresh = (Symbol(f"x{i}", real=True) for i in range(10**9) if f"x{i}" not in taken)
        common, reduced = sympy.cse(values, symbols=fresh, order="canonical")
        outputs = list[Line]()
        for number, value in enumerate(reduced):
            targets = [_split(row[number].target) for row in rows]
            first = rows[0][number]
            target = f"{targets[0][0]}[{table.code([index for _, index in targets])}]"
            comment = f"for i = 0: {first.comment}" if first.comment else ""
            outputs.append(Line(target, scalar_code(value), comment, first.operator))
        if table.columns:
            self.tables.append(table.line)
        self.before += count * sum(int(value.count_ops()) for value in values)
        self.after += count * sum(int(value.count_ops()) for value in (*(value for _, value in common), *reduced))
        body = [Line(symbol.name, scalar_code(value)) for symbol, value in common]
        return Loop(count, (*inputs, *body, *outputs))


class _Table:
    """The indices of a loop that are not linear in the number of the repetition; equal columns are kept once."""

    def __init__(self, name: str, count: int) -> None:
        self.name, self.count = name, count
        self.columns: list[Column] = []

    def code(self, indices: Sequence[int]) -> str:
        """Return the code of an index that has the given values in the repetitions."""
        first, step = indices[0], indices[1] - indices[0]
        if all(index == first + step * i for i, index in enumerate(indices)):
            variable = {0: "", 1: "i"}.get(step, f"{step}*i")
        else:
            column = tuple(index - first for index in indices)
            if column not in self.columns:
                self.columns.append(column)
            variable = f"{self.name}[i, {self.columns.index(column)}]"
        if not variable:
            return str(first)
        return f"{variable} + {first}" if first else variable

    @property
    def line(self) -> Line:
        """The constant of the module that holds the table."""
        rows = (f"[{', '.join(map(str, row))}]" for row in zip(*self.columns, strict=True))
        return Line(self.name, f"np.array([{', '.join(rows)}])", "indices of a loop: rows are its repetitions")


_LONG = 1000
"""Number of operations from which common subexpressions of the equations are found on an expression graph."""
_MANY = 12
"""Number of unknowns of a step from which a band is used."""
_LONGEST_LIST = 21
"""Greatest length of a list of names in a docstring; the comments at STATE and UNKNOWNS always have the list."""
_ARGUMENTS = ("state", "t", "lengths", "parameters")
"""The arguments that all kernels of a time step have in common."""


def lower_step(program: StepProgram, derivatives: StepDerivatives) -> SimulateModule:
    """Return the module that solves an initial value problem, with all kernels and texts as strings."""
    model, tables, codes = program.model, tables_of(program.model), _codes(program)
    equations = [value for _, value in program.equations]
    is_watched = bool(program.events or program.gaps)
    ranged = ranged_inputs(tables, len(model.parameters), equations)
    inside = {symbol: f"interval[{i}]" for i, symbol in enumerate(_interval(program))}
    inside |= {symbol: code for symbol, code in codes.items() if symbol not in inside}
    names, values = zip(*program.equations, strict=True)
    is_long = longer_than(_LONG, values) and not are_many(families([[value] for value in values]))
    straight = values_of(values) if is_long else StraightLine(values=values)
    kernels = [
        *_step_kernels(program, derivatives),
        looped(
            "step_equations",
            "Fill `residual` (STAGES + STATE,) of the equations of the scheme, in the form of the docstring above.",
            ("state", "interval", *_ARGUMENTS[1:], "residual"), inside,
            [Output(f"residual[{i}]", value, names[i]) for i, value in enumerate(straight.values)],
            decorators=KERNEL, straight_line=straight.assignments,
        ),
    ]  # fmt: skip
    if program.energy is not None:
        kernels.append(
            kernel(
                "energy", "Return the Hamiltonian at `state` (STATE,).",
                ("state", "t", "parameters"), codes, (), program.energy,
                decorators=VALUE, straight_line=needed(program.state_assignments, (program.energy,)),
            )
        )  # fmt: skip
    if program.constraints:
        kernels.append(_constraints_kernel(program, codes))
    kernels += event_kernels(program, codes)
    if ranged:
        arguments, entry = ("state", "interval", *_ARGUMENTS[1:]), "inputs[2*{0} + {1}]"
        kernels.append(inputs_kernel("step_inputs", "in a step", arguments, inside, ranged, equations, entry, KERNEL))
    solver = _solver(program, derivatives)
    of_steps = ("predict", "residual", "jacobian", "complete") if program.unknowns and not program.fractions else ()
    every: tuple[str, ...] = ("initial_state", "make_grid", "metadata", "path_residual", "problem", "solve", "step")
    fields = {"metadata": "metadata", "state": "STATE", "stages": "STAGES"}
    fields |= {"equations": "step_equations"}
    if program.energy is not None:
        fields, every = {**fields, "energy": "energy"}, ("energy", *every)
    if program.unknowns:
        # The numbers of diagonals under and over the main diagonal.
        size = len(derivatives.jacobian)
        places = [(i, j) for i, row in enumerate(derivatives.jacobian) for j, entry in enumerate(row) if entry != 0]
        below, above = max(max(i - j, 0) for i, j in places), max(max(j - i, 0) for i, j in places)
        fields |= {
            "unknowns": "UNKNOWNS", "predict": "predict_step", "residual": "step_residual",
            "jacobian": "step_jacobian", "complete": "complete_step",
            **({"bands": repr((below, above))} if size >= _MANY and 2 * below + above < size else {}),
            "is_linear": repr(solver is not StepSolver.NEWTON), "is_constant": repr(solver is StepSolver.CONSTANT),
        }  # fmt: skip
    else:
        fields |= {"explicit": "explicit_step", **({} if ranged or is_watched else {"all_steps": "all_steps"})}
    fields |= {"fractions": "FRACTIONS"} if program.fractions else {}
    fields |= {"inputs": "step_inputs", "ranges": "RANGES", "range_names": "RANGE_NAMES"} if ranged else {}
    fields |= {"tables": "TABLES"} if tables else {}
    fields |= {"constraints": "node_constraints"} if program.constraints else {}
    fields |= event_fields(program)
    fields |= {"has_momenta": "False"} if model.linear else {}
    sizes = f"STATE, STAGES, {len(program.fractions) or 1}, {len(program.lengths)}"
    stages = ", ".join(symbol.name for symbol in program.stage_symbols) or "none"
    state_names = ", ".join(unknown.name for unknown in program.state)
    meanings = "; ".join(f"{i}: {phrase(u.meaning)}" for i, u in enumerate(program.state))
    lines = [
        Line("STATE", str(len(program.state)), meanings),
        Line("STAGES", str(len(program.stage_symbols)), f"values inside a step: {stages}"),
    ]
    if program.unknowns:
        listed = ", ".join(symbol.name for symbol in program.unknowns)
        lines.append(Line("UNKNOWNS", str(len(program.unknowns)), f"unknowns of the equations of a step: {listed}"))
    if program.fractions:
        rows = [f"[{', '.join(scalar_code(sympy.N(f, 20)) for f in row)}]" for row in program.fractions]
        meaning = "lengths of the steps of the base scheme that make up one step, relative to it"
        lines.append(Line("FRACTIONS", f"np.array([{', '.join(rows)}])", meaning))
    return SimulateModule(
        template="simulate.py.j2",
        name=model.name,
        title=model.title,
        description=tuple(_description(program, kernels, described_tables(tables))),
        metadata=_record(program, derivatives, kernels, tables),
        constants=(*lines, *table_constants(tables), *range_constants(ranged), *(t for k in kernels for t in k.tables)),
        kernels=(*table_kernels(tables, len(model.parameters)), *kernels),
        sizes=(),
        public=tuple(sorted((*every, *of_steps, *(("first_outside",) if ranged else ())))),
        record=tuple(fields.items()),
        explicit_sizes=() if program.unknowns or ranged or is_watched else (sizes,),
        arguments=arguments_of(model),
        table_arguments=("tables",) if tables else (),
        steps=model.steps,
        duration=scalar_code(model.duration),
        start_values=tuple(
            Line(value.symbol.name, scalar_code(value.value), value.quantity) for value in program.start_values
        ),
        start=tuple(
            Line(unknown.name, scalar_code(value)) for unknown, value in zip(program.state, program.start, strict=True)
        ),
        start_example=f'{{"{program.start_values[0].quantity}": 0.5}}',
        state_names=state_names if len(state_names) <= _LONGEST_LIST else "ordered as STATE",
    )


def _constraints_kernel(program: StepProgram, codes: Mapping[Symbol, str]) -> Kernel:
    """Return the kernel that checks of a state and messages read."""
    outputs, row_of = list[Output](), list[int]()
    for row, constraint in enumerate(program.constraints):
        slopes = (f"its derivative by {q}" for q in program.model.coordinates)
        meanings = (constraint.name, "its rate", "scale of its rate", *slopes)
        entries = enumerate(zip(constraint.row, meanings, strict=True), row * len(constraint.row))
        outputs += [Output(f"values[{i}]", value, meaning) for i, (value, meaning) in entries if value != 0]
        row_of += [row] * (len(outputs) - len(row_of))
    return looped(
        "node_constraints",
        "Fill `values` (constraints, 3 + coordinates) but for zeros: value, rate, scale of the rate, gradient.",
        ("state", "t", "parameters", "values"), codes, outputs,
        needed(program.state_assignments, [output.value for output in outputs]), KERNEL, row_of=row_of,
    )  # fmt: skip


def _codes(program: StepProgram) -> dict[Symbol, str]:
    """Return the code that reads each symbol inside a kernel of a time step."""
    codes = {symbol: f"unknowns[{i}]" for i, symbol in enumerate(program.unknowns)}
    codes |= {symbol: f"state[{i}]" for i, symbol in enumerate(program.left_symbols)}
    codes |= {symbol: f"parameters[{i}]" for i, symbol in enumerate(program.model.parameters)}
    codes |= {h: f"lengths[{i}]" for i, h in enumerate(program.lengths)}
    return codes | {program.model.time: "t"}


def _interval(program: StepProgram) -> tuple[Symbol, ...]:
    return (*program.stage_symbols, *program.right_symbols)


def _step_kernels(program: StepProgram, derivatives: StepDerivatives) -> list[Kernel]:
    """Return the kernel of an explicit time step, or the kernels of Newton's method for an implicit step."""
    codes, names = _codes(program), [symbol.name for symbol in program.unknowns]
    interval = [Output(f"interval[{i}]", symbol, symbol.name) for i, symbol in enumerate(_interval(program))]
    if not program.unknowns:
        return [
            looped(
                "explicit_step",
                "Fill `interval` (STAGES + STATE,) with inner stages and the state at the right node, "
                "from `state` (STATE,).",
                (*_ARGUMENTS, "interval"), codes, interval, program.before, KERNEL,
            )
        ]  # fmt: skip
    guess = [Output(f"unknowns[{i}]", value, names[i]) for i, value in enumerate(program.guess)]
    residual = [Output(f"residual[{i}]", value, "") for i, value in enumerate(derivatives.residual)]
    entries = [
        Output(f"jacobian[{i * len(names) + j}]", entry, f"by {names[j]}")
        for i, row in enumerate(derivatives.jacobian)
        for j, entry in enumerate(row)
        if entry != 0
    ]
    row_of = [i for i, row in enumerate(derivatives.jacobian) for entry in row if entry != 0]
    listed = ", ".join(names)
    if len(listed) > _LONGEST_LIST:
        listed = "the unknowns"
    written = (*program.before, *derivatives.assignments)
    of_residual = needed(written, derivatives.residual)
    of_both = needed(written, (*derivatives.residual, *(entry.value for entry in entries)))
    # Long expressions are a straight-line program, which shares all common subexpressions already.
    is_straight = bool(derivatives.assignments)
    return [
        looped(
            "predict_step", f"Fill `unknowns` (UNKNOWNS,), {listed}, with the initial guess at `state` (STATE,).",
            (*_ARGUMENTS, "unknowns"), codes, guess,
            decorators=KERNEL, straight_line=needed(program.state_assignments, program.guess),
        ),
        looped(
            "step_residual", f"Fill `residual` (UNKNOWNS,) of the equations of a step, a function of {listed}.",
            ("unknowns", *_ARGUMENTS, "residual"), codes, residual,
            () if is_straight else of_residual, KERNEL, straight_line=of_residual if is_straight else (),
        ),
        looped(
            "step_jacobian",
            f"Fill the residual, and the entries of its `jacobian` (UNKNOWNS UNKNOWNS,) by {listed} that are not zero.",
            ("unknowns", *_ARGUMENTS, "residual", "jacobian"), codes, [*residual, *entries],
            () if is_straight else of_both, KERNEL, straight_line=of_both if is_straight else (),
            row_of=[*range(len(residual)), *row_of],
        ),
        looped(
            "complete_step",
            f"Fill `interval` (STAGES + STATE,): inner stages, and the state at the right node, given {listed}.",
            ("unknowns", *_ARGUMENTS, "interval"), codes, interval, (*program.before, *program.after), KERNEL,
        ),
    ]  # fmt: skip


def _solver(program: StepProgram, derivatives: StepDerivatives) -> StepSolver:
    """Return the method that solves the equations of a time step."""
    if not program.unknowns:
        return StepSolver.EXPLICIT
    if not program.linear:
        return StepSolver.NEWTON
    return StepSolver.CONSTANT if derivatives.constant and not program.fractions else StepSolver.LINEAR


def _description(program: StepProgram, kernels: Sequence[Kernel], tables: Sequence[str]) -> list[str]:
    lines = ["One step from t_k to t_k1 = t_k + h (suffixes _k and _k1 mark its nodes):", ""]
    if program.fractions:
        lengths = ", ".join(symbol.name for symbol in program.lengths)
        lines = [
            f"One step is made up of {len(program.fractions)} steps of another scheme; FRACTIONS holds {lengths}.",
            "Each leads from t_k to t_k1 (suffixes _k and _k1 mark its nodes):",
            "",
        ]
    lines += [f"    {name} = {readable(value)}" for name, value in program.summary]
    if program.method == "variational":
        lines += ["", "where each p_k = -D1 Ld - f- and p_k1 = D2 Ld + f+ (position-momentum form)."]
        if program.constraints:
            names = ", ".join(u.name for u in program.holonomic_multipliers)
            lines.append(f"The forces {names} of the constraints act at both nodes, each during half a step.")
    if program.unknowns:
        names = ", ".join(symbol.name for symbol in program.unknowns)
        lines += ["", f"These are solved for {names}; the rest is explicit."]
    if program.constraints:
        lines.append("An impulse is the force at its node times h/2.")
    if program.velocities:
        lines += ["", "Velocities of the step are unknowns in place of positions, so that no digits cancel:", ""]
        for velocity, after, before, time in program.velocities:
            divisor = sympy.sstr(time) if time.is_Symbol else f"({sympy.sstr(time)})"
            lines.append(f"    {velocity} = ({after} - {before})/{divisor}")
    lines += event_lines(program)
    lines += ["", "Tables:", "", *(f"    {line}" for line in tables)] if tables else []
    lines += ["", "Operations of one evaluation, before and after common subexpressions are shared:", ""]
    return [*lines, *(f"    {k.name}: {k.operations_before} -> {k.operations_after}" for k in kernels)]


def _record(
    program: StepProgram, derivatives: StepDerivatives, kernels: Sequence[Kernel], tables: Sequence[TableData]
) -> SimulationRecord:
    model, solver = program.model, _solver(program, derivatives)
    held = (*model.holonomic, *model.rolling)
    out = []
    if solver is StepSolver.EXPLICIT:
        system = "system" if model.form == "first-order" else model.form.capitalize()
        out.append(f"Newton's method: the scheme is explicit for this {system}")
    if solver in (StepSolver.LINEAR, StepSolver.CONSTANT):
        out.append("Newton's iteration: the equations of a step are linear, one linear solve is exact")
    if solver is StepSolver.CONSTANT:
        out.append("factorisation in every step: the matrix depends on parameters and h only")
    if len(program.unknowns) == 1:
        out.append("linear algebra: a step has one unknown")
    eliminated = [s.name for s in _interval(program) if s not in program.unknowns]
    if program.unknowns and eliminated:
        names = ", ".join(symbol.name for symbol in program.unknowns)
        out.append(f"{', '.join(eliminated)} among the unknowns: explicit, given {names}")
    if model.form != "first-order":
        cyclic = [str(q) for q in model.coordinates if not any(e.has(q) for e in (model.function, *model.force))]
        if cyclic:
            out.append(f"derivatives of the {model.form.capitalize()} by {', '.join(cyclic)}: cyclic")
        idle = [str(q) for q, f in zip(model.coordinates, model.force, strict=True) if f == 0]
        if len(idle) == len(model.coordinates):
            out.append("forces: there are none")
        elif idle:
            out.append(f"forces on {', '.join(idle)}: there are none")
    if not any(e.has(model.time) for e in (model.function, *model.force, *model.dynamics, *held)):
        out.append("time in the kernels: nothing depends on it explicitly")
    return SimulationRecord(
        **record_fields(program, program.order, kernels, out),
        **system_fields(model, tables),
        start=tuple(value.quantity for value in program.start_values),
        parts=len(program.fractions),
        solver=solver,
        momenta=tuple(u.name for u in program.state[len(model.coordinates) :]),
        node=tuple(u.name for u in program.state),
        stages=tuple(s.name for s in program.stage_symbols),
        unknowns=tuple(s.name for s in program.unknowns),
        constraints=tuple(c.name for c in program.constraints),
        rolling=tuple(c.name for c in program.constraints[len(model.holonomic) :]),
        events=tuple(event.name for event in program.events),
        gaps=tuple(gap.name for gap in program.gaps),
        conservative=program.energy is not None
        and not any(model.linear.force if model.linear else model.force)
        and not any(event.after for event in program.events)
        and not any(e.has(model.time) for e in (program.energy, *model.dynamics, *held))
        and not any(gap.expression.has(model.time) for gap in model.gaps)
        and not any(c.xreplace(dict.fromkeys(model.rates, sympy.S.Zero)) for c in model.rolling)
        and all(gap.restitution == 1 for gap in program.gaps),
    )


# Events and gaps

EVENT_KERNELS = {
    "event_values": (
        "values",
        "Fill `values` (events + gaps, 3): value, rate along the motion, and sum of the moduli of the terms.",
    ),
    "event_jumps": ("jumps", "Fill `jumps` (changes, STATE): the state after each event that changes the state."),
    "gap_normals": (
        "normals",
        "Fill `normals` (gaps, 3 + 2 coordinates): acceleration, restitution, size of the rate, G, M^-1 G^T.",
    ),
}
"""The kernels of events and gaps: the array that they fill, and the first line of their docstring."""


def rows_of_events(program: StepProgram) -> dict[str, list[tuple[str, Expr]]]:
    """Return the entries, with their meanings, of the arrays that the kernels of events and gaps fill."""
    names = [q.name for q in program.model.coordinates]
    of_contact = (
        "acceleration",
        "restitution",
        "size of the rate",
        *(f"slope by {q}" for q in names),
        *(f"response of {q}" for q in names),
    )
    rows = {
        "event_values": [
            (f"{meaning} of {event.name}", value)
            for event in (*program.events, *program.gaps)
            for meaning, value in zip(("value", "rate", "scale"), event.row, strict=True)
        ],
        "event_jumps": [
            (f"{unknown.name} after {event.name}", value)
            for event in program.events
            if event.after
            for unknown, value in zip(program.state, event.after, strict=True)
        ],
        "gap_normals": [
            (f"{meaning}, {gap.name}", value)
            for gap in program.gaps
            for meaning, value in zip(of_contact, gap.contact, strict=True)
        ],
    }
    return {name: entries for name, entries in rows.items() if entries}


def event_kernels(program: StepProgram, codes: Mapping[Symbol, str]) -> list[Kernel]:
    """Return the kernels of events and gaps; none without events and gaps."""
    assignments, kernels = (*program.state_assignments, *program.event_assignments), list[Kernel]()
    for name, entries in rows_of_events(program).items():
        array, summary = EVENT_KERNELS[name]
        read = needed(assignments, [value for _, value in entries])
        # Assignments of a large mass matrix share all common subexpressions; those of constraint forces do not.
        is_shared = bool(program.state_assignments) and not program.constraints
        kernels.append(
            kernel(
                name, summary, ("state", "t", "parameters", array), codes,
                [Output(f"{array}[{i}]", value, meaning) for i, (meaning, value) in enumerate(entries)],
                assignments=() if is_shared else read, decorators=KERNEL, straight_line=read if is_shared else (),
            )
        )  # fmt: skip
    return kernels


def event_fields(program: StepProgram) -> dict[str, str]:
    """Return the fields of the StepProblem with their code."""
    if not (program.events or program.gaps):
        return {}
    actions, rules, row = list(EventAction), list[str](), 0
    for event in (*program.events, *program.gaps):
        rules.append(f"({actions.index(event.action)}, {event.direction}, {row if event.after else -1})")
        row += bool(event.after)
    fields = {"events": "event_values", "rules": f"np.array([{', '.join(rules)}])"}
    fields |= {"jumps": "event_jumps"} if row else {}
    return fields | ({"normals": "gap_normals"} if program.gaps else {})


def event_lines(program: StepProgram) -> list[str]:
    """Return the lines about events and gaps in the docstring of a module."""
    lines = list[str]()
    if program.events:
        lines += ["", "Events, at zeros of:", ""]
        for event in program.model.events:
            changes = ", ".join(f"{symbol} = {readable(value)}" for symbol, value in event.changes)
            effect = f"then {changes}" if changes else {"stop": "end of the motion"}.get(event.action, event.action)
            lines.append(f"    {event.name}: {readable(event.expression)}, {effect}")
    if program.gaps:
        lines += ["", "Gaps, which do not become negative, with their coefficients of restitution:", ""]
        lines += [f"    {readable(gap.expression)}: {readable(gap.restitution)}" for gap in program.model.gaps]
    return lines
