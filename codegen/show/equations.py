"""The derived continuous and discrete equations as text or LaTeX, for the terminal and for notebooks.

Equations of motion of bodies with rotations are written in attitudes R and angular velocities omega. With
mu = dL/domega, the moment m(f) of a function f(R), and the torque M, all in the frame of the body,

    d/dt mu + omega x mu - m(L) - M - sum of kappa m(c) = 0,    m(f)_k = sum_ij df/dR_ij (R hat(e_k))_ij.

The model has quaternions. Its expressions contain the entries of R and omega as an author wrote them, and symbols
replace these.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import sympy
from sympy import Add, Expr, Matrix, S, Symbol, expand_mul
from sympy.simplify.fu import TR8

from codegen.discretise import contact, schemes, transcribe
from codegen.discretise.conditions import CONDITIONS
from codegen.discretise.conditions.holonomic import Constraints
from codegen.discretise.conditions.rolling import discrete
from codegen.discretise.degenerate import for_method, step_interval
from codegen.discretise.interval import STEP, at_nodes, one_step_interval, repeated, variational_interval
from codegen.discretise.model import legendre
from codegen.discretise.model.definitions import Bounds, LinearLagrangian, Model, prescribed
from codegen.discretise.model.from_problem import load_problem
from codegen.discretise.model.pairwise import PairwiseModel
from codegen.discretise.particles import pairwise
from codegen.discretise.program import ControlProgram, Names, StepProgram
from codegen.discretise.rotations import half_imaginary, in_body_rates
from codegen.problem.rotations import rotation_matrix, squared_length
from codegen.problem.sources import Source, settings_of, source_of
from codegen.runtime.record import EventAction
from codegen.show.notation import WIDTH, Block, Notation, written
from codegen.symbolic.derivatives import gradient
from codegen.symbolic.functions import tables_of
from codegen.symbolic.tables import OUTSIDE
from codegen.symbolic.terms import Invariants


def pairwise_equations(model: PairwiseModel, scheme: str | None, method: str | None, latex: bool) -> str:
    """Return as text the Hamiltonian of particles, its scalars, its derivatives and the equations of a step."""
    program = pairwise(model, scheme, method)
    lines = [f"{model.title.rstrip('.')} ({program.method} method, scheme {program.scheme})", ""]
    parts = Invariants.of(model.pair_term, model.first.moving, model.second.moving)
    rows: list[tuple[Symbol, Expr]] = [(Symbol("self"), model.self_term)]
    rows += [*zip(parts.symbols, parts.polynomials, strict=True), (Symbol("pair"), parts.outer)]
    if model.limit is not None:
        rows.append((Symbol("limit of pair where particles meet"), model.limit))
    slopes = [Symbol(f"pair_by_{s}") for s in parts.symbols]
    rows += [(slope, parts.slope(k)) for k, slope in enumerate(slopes)]
    for z in model.first.moving:
        terms = (slope * sympy.diff(p, z) for slope, p in zip(slopes, parts.polynomials, strict=True))
        rows.append((Symbol(f"pair_by_{z}"), sum(terms, sympy.S.Zero)))
    h = Symbol("h")
    for fraction, a, b in program.substeps:
        q = f"H_p((1 - {a}) q_0 + {a} q_1, (1 - {b}) p_0 + {b} p_1)"
        rows.append((Symbol("q_1"), Symbol("q_0") + fraction * h * Symbol(q)))
        rows.append((Symbol("p_1"), Symbol("p_0") - fraction * h * Symbol(q.replace("H_p", "H_q"))))
    if latex:
        equations_of = (rf"\[ {sympy.latex(a)} = {sympy.latex(b)} \]" for a, b in rows)
        return "\n".join([rf"\section*{{{lines[0]}}}", *equations_of])
    for left, right in rows:
        lines += textwrap.wrap(f"{left} = {sympy.sstr(right)}", WIDTH, initial_indent="  ", subsequent_indent="      ")
    return "\n".join(lines)


def is_past(name: str) -> bool:
    """Return True if a name marks a past (delayed) value."""
    return "@t-" in name


def with_past(model: Model) -> Model:
    """Return the model with past values as further coordinates, without equations of motion for them."""
    coordinates: dict[Symbol, Symbol] = {}
    controls = []
    for delay in model.delays:
        x, lag = delay.quantity, delay.symbol.name.partition("@")[2]
        if x in model.controls:
            controls.append(delay.symbol)
            continue
        if x not in (*model.coordinates, *model.rates):  # a velocity, where momenta are the rates
            continue
        index = (model.rates if x in model.rates else model.coordinates).index(x)
        rate = f"{model.rates[index]}@{lag}" if model.rates else ""
        coordinates[Symbol(f"{model.coordinates[index]}@{lag}", real=True)] = Symbol(rate, real=True)
    if not model.delays:
        return model
    none = (None,) * len(coordinates)
    zeros = (sympy.S.Zero,) * len(coordinates)
    first_order = model.form == "first-order"
    assert model.end is not None, "only control problems have delays"
    rates = none if model.rates else ()
    return replace(
        model,
        coordinates=(*model.coordinates, *coordinates),
        rates=(*model.rates, *coordinates.values()) if model.rates else (),
        controls=(*model.controls, *controls),
        force=() if first_order else (*model.force, *zeros),
        dynamics=(*model.dynamics, *zeros) if first_order else (),
        start=replace(model.start, positions=(*model.start.positions, *none), rates=(*model.start.rates, *rates)),
        end=replace(model.end, positions=(*model.end.positions, *none), rates=(*model.end.rates, *rates)),
    )


def delay_blocks(model: Model) -> Iterator[Block]:
    """Yield blocks with the histories of delayed quantities and the segments of the method of steps."""
    whole, segments = model.authored, model.segments
    if not whole.delays:
        return
    histories = {delay.quantity: delay.history for delay in whole.delays}
    yield Block("Before t = 0", tuple(histories.items()))
    if segments is not None and segments.number > 1:
        backs = {delay.lag: back for delay, back in zip(whole.delays, segments.steps_back, strict=True) if back}
        counts = {lag: f"{back} segment{'s' if back > 1 else ''}" for lag, back in backs.items()}
        shifts = ", ".join(f"t - {lag} is {count} before" for lag, count in counts.items())
        text = (
            f"{segments.number} segments of length {model.duration} run side by side, each beginning where the one "
            f"before it ends: {shifts}, at the same point of a step"
        )
        yield Block("Method of steps", (), ((text, text + r"\\"),))


_SHORTEN_LIMIT = 120  # largest number of operations of an expression that is simplified
_FLAT_BONUS = 1.6

_EULER_LAGRANGE = (
    "d/dt ∂L/∂v - ∂L/∂q - f = 0, written out",
    r"$\frac{d}{dt} \partial L/\partial v - \partial L/\partial q - f = 0$, written out",
)
_CONSTRAINED = (
    "d/dt ∂L/∂v - ∂L/∂q - f - Gᵀκ = 0 with the forces κ of the constraints, written out",
    r"$\frac{d}{dt} \partial L/\partial v - \partial L/\partial q - f - G^T \kappa = 0$ with the forces $\kappa$ of the"
    " constraints, written out",
)
_LEGENDRE = (
    "pₖ = -D₁ Ld(qₖ, qₖ₊₁) - f⁻,  pₖ₊₁ = D₂ Ld(qₖ, qₖ₊₁) + f⁺",
    r"$p_k = -D_1 L_d(q_k, q_{k+1}) - f^-$, $p_{k+1} = D_2 L_d(q_k, q_{k+1}) + f^+$",
)
_BALANCE = (
    "D₂ Ld(qₖ₋₁, qₖ) + D₁ Ld(qₖ, qₖ₊₁) + f⁺ₖ₋₁ + f⁻ₖ = 0 for k = 1, ..., N - 1, written out",
    r"$D_2 L_d(q_{k-1}, q_k) + D_1 L_d(q_k, q_{k+1}) + f^+_{k-1} + f^-_k = 0$ for $k = 1, \dots, N - 1$, written out",
)
_CONSTRAINED_BALANCE = (
    "D₂ Ld(qₖ₋₁, qₖ) + D₁ Ld(qₖ, qₖ₊₁) + f⁺ₖ₋₁ + f⁻ₖ + h G(qₖ)ᵀκₖ = 0 for k = 1, ..., N - 1, written out",
    r"$D_2 L_d(q_{k-1}, q_k) + D_1 L_d(q_k, q_{k+1}) + f^+_{k-1} + f^-_k + h G(q_k)^T \kappa_k = 0$"
    r" for $k = 1, \dots, N - 1$, written out",
)
_MAXIMISED = ("the cost is minus what is to be greatest",) * 2
_MOMENTA = ("the discrete momenta of the first and last node are those of the prescribed velocities",) * 2


def equations(
    problem: Source | Path | str,
    arguments: Mapping[str, str] | None = None,
    *,
    scheme: str | None = None,
    method: str | None = None,
    controls: str = "interval",
    latex: bool = False,
) -> str:
    """Return the equations of a problem and of its discretisation, as text of about 100 columns or as LaTeX.

    LaTeX needs the package amsmath. Raises CodegenError for an unusable problem, scheme, method or controls.
    """
    source = source_of(problem)
    model = load_problem(source, settings_of(source, arguments))
    if isinstance(model, PairwiseModel):
        return pairwise_equations(model, scheme, method, latex)
    program = transcribe.transcribe(model, scheme, method, controls)
    model = for_method(model, program.method)
    shown = with_past(_side(model.authored, program.method))
    notation = Notation.of(model, shown, _side(model, program.method), latex=latex)
    title = f"{model.title.rstrip('.')} ({program.method} method, scheme {program.scheme})"
    own = (
        _of_phases(model, program)
        if model.phases
        else (*_continuous(model.authored, program.method), *delay_blocks(model), *_discrete(shown, program))
    )
    rest, whole = [*_ends(program)], model.authored
    if whole.terminal_cost != 0:
        at_end = {symbol: _named(f"{symbol}@T") for symbol in (*whole.coordinates, *whole.rates)}
        rest.append(Block("Terminal cost", ((_named("C_T"), whole.terminal_cost.xreplace(at_end)),)))
    if whole.free_parameters:
        rows = tuple((free.symbol, free.guess) for free in whole.free_parameters)
        limits = [Bounds(free.symbol, free.lower, free.upper) for free in whole.free_parameters]
        rest.append(Block("Free parameters, at their first guess", rows, _within(limits, notation)))
    for number, part in enumerate(whole.phases or (whole,), start=1):
        if limited := _within(part.bounds, notation):
            rest.append(Block(f"Bounds in phase {number}" if whole.phases else "Bounds", (), limited))
    if tables := tables_of(model):
        lines = [f"{table.summary}; {OUTSIDE[table.shape.outside]}" for table in tables]
        rest.append(Block("Tables", (), tuple((line, line) for line in lines)))

    def remark(words: str, symbols: Sequence[Symbol], none: str = "") -> tuple[str, str]:
        names = (notation.name(symbol) for symbol in symbols)
        text = words + (", ".join(f"${name}$" if notation.latex else name for name in names) or none)
        return text, text + r"\\" if notation.latex else ""

    # The unknowns of nodes, intervals and steps.
    if isinstance(program, StepProgram):
        remarks = [
            remark("state at a node: ", program.left_symbols),
            remark("solved for numerically in each step: ", program.unknowns, "nothing, the step is explicit"),
        ]
    else:
        remarks = [
            remark("at a node: ", program.left_symbols),
            remark("on an interval: ", (*program.interval_symbols, *program.control_symbols), "nothing"),
            ("order: node 0, interval 0, node 1, ..., node N",) * 2,
        ]
    rest.append(Block("Layout of the unknowns", remarks=tuple(remarks)))
    blocks: Iterable[Block] = [*own, *rest]
    if whole.rotations:
        blocks = in_attitudes(blocks, Attitudes(whole))
    return written(title, [*blocks], notation)


def _within(bounds: Iterable[Bounds], notation: Notation) -> tuple[tuple[str, str], ...]:
    """Return a remark (plain text, LaTeX) for each bounded quantity."""
    remarks = []
    for limits in (b for b in bounds if b.conditions):
        parts = [part for part in (limits.lower, limits.symbol, limits.upper) if part is not None]
        shown = [notation.translated(part) for part in parts]
        tex = r" \leq ".join(sympy.latex(part) for part in shown)
        remarks.append((" ≤ ".join(sympy.sstr(part) for part in shown), rf"${tex}$\\"))
    return tuple(remarks)


def _of_phases(model: Model, program: ControlProgram | StepProgram) -> Iterator[Block]:
    """Yield the equations of each phase, in the time of the phase, and of the switches between phases."""
    assert isinstance(program, ControlProgram), "a simulation has a single phase"
    for number, phase in enumerate(model.phases, start=1):
        if number > 1:
            # Prescribed values before the switch, values after it, the terminal cost and the conditions.
            before = model.phases[number - 2]
            rows = [(_named(f"{symbol}@-"), value) for symbol, value in prescribed(before, "end").items()]
            left = {symbol: _named(f"{symbol}@-") for symbol in (*before.coordinates, *before.rates)}
            rows += [(_named(f"{symbol}@+"), value.xreplace(left)) for symbol, value in model.jumps[number - 2]]
            rows += [(_named("cost"), before.terminal_cost.xreplace(left))] if before.terminal_cost != 0 else []
            conditions = ", ".join(condition.name for condition in before.end_conditions)
            remark = f"before it {conditions}" if conditions else "" if rows else "everything is continuous"
            remarks = ((remark, remark),) if remark else ()
            yield Block(f"Switch from phase {number - 1} to phase {number}", tuple(rows), remarks)
        for block in (*_continuous(phase, program.method), *_discrete(phase, program)):
            yield replace(block, heading=f"Phase {number}: {block.heading}")


def _side(model: Model, method: str) -> Model:
    transform = legendre.lagrangian_form if method == "variational" else legendre.hamiltonian_form
    return transform(model.with_free_ends)


def _named(name: str) -> Symbol:
    return Symbol(name, real=True)


def _continuous(authored: Model, method: str) -> Iterator[Block]:
    """Yield the author's Lagrangian or Hamiltonian, its Legendre transform if needed, and the equations of motion."""
    model = _side(authored, method)
    letter = model.form[0].upper()
    forced = "Forced " if any(model.force) else ""
    if model.rotations:
        attitudes = Attitudes(model)
        yield from (attitudes.lagrangian(), attitudes.balances(_shortest))
    elif model.form != "first-order":
        if authored.form != model.form:
            yield Block(authored.form.capitalize(), ((_named(authored.form[0].upper()), authored.function),))
        rows = [(_named(letter), model.function)]
        rows += [(_named(f"f_{q}"), f) for q, f in zip(model.coordinates, model.force, strict=True) if f != 0]
        yield Block(model.form.capitalize() + (" and forces" if len(rows) > 1 else ""), tuple(rows))
    if model.form == "first-order":
        if model.linear:
            yield from _linear(model, model.linear)
        pairs = zip(model.coordinates, model.dynamics, strict=True)
        yield Block("Dynamics", tuple((_named(f"rate {x}"), f) for x, f in pairs))
    elif letter == "L" and not model.rotations:
        q, v = model.coordinates, model.rates
        accelerations = [_named(f"acceleration {x}") for x in q]
        balances, constraints = [], Constraints(model, Names(model))
        acting = zip(model.force, constraints.along, contact.force(model), strict=True)
        for x, w, force in zip(q, v, map(sum, acting), strict=True):
            momentum = sympy.diff(model.function, w)
            rate = sympy.diff(momentum, model.time)
            rate += sum(sympy.diff(momentum, y) * z for y, z in zip((*q, *v), (*v, *accelerations), strict=True))
            balances.append((_named("0"), _shortest(rate - sympy.diff(model.function, x) - force)))
        remark = _CONSTRAINED if constraints.kappa else _EULER_LAGRANGE
        yield Block(f"{forced}Euler-Lagrange equations", tuple(balances), (remark,))
    elif letter == "H":
        slopes = [f - sympy.diff(model.function, q) for q, f in zip(model.coordinates, model.force, strict=True)]
        field = [*(sympy.diff(model.function, p) for p in model.rates), *slopes]
        states = (*model.coordinates, *model.rates)
        rates = tuple((_named(f"rate {x}"), _shortest(e)) for x, e in zip(states, field, strict=True))
        yield Block(f"{forced}Hamilton's equations", rates)
    # Integrands of the cost, and conditions.
    if model.cost is not None:
        remarks = (_MAXIMISED,) if model.maximised else ()
        pair = (_named("C"), model.cost), (_named("T"), model.duration)
        yield Block("Rate of the cost, and duration", pair, remarks)
    for heading, shown in (block for kind in CONDITIONS for block in kind.shown(model)):
        yield Block(heading, tuple((_named(name), value) for name, value in shown))
    for event in authored.events:
        effects = {EventAction.STOP: "The event ends the motion.", EventAction.RECORD: "The event is only recorded."}
        changes = tuple((_named(f"{symbol}_after"), value) for symbol, value in event.changes)
        effect = effects.get(event.action)
        shown = ((_named("0"), event.expression), *changes)
        yield Block(f"Event {event.name}", shown, ((effect, effect),) if effect else ())
    if authored.gaps:
        gaps = [(_named(f"gap_{i}"), gap.expression) for i, gap in enumerate(authored.gaps, 1)]
        factors = [(_named(f"restitution_{i}"), gap.restitution) for i, gap in enumerate(authored.gaps, 1)]
        yield Block("Gaps, which do not become negative", (*gaps, *factors))


def _linear(model: Model, linear: LinearLagrangian) -> Iterator[Block]:
    """Yield a Lagrangian that is linear in the velocities, its forces, and the momenta of its canonical pairs."""
    rates = {v: _named(f"rate {x}") for x, v in zip(model.coordinates, linear.rates, strict=True)}
    rows = [(_named("L"), linear.function.xreplace(rates))]
    rows += [(_named(f"f_{x}"), f) for x, f in zip(model.coordinates, linear.force, strict=True) if f != 0]
    yield Block("Lagrangian, linear in the velocities", tuple(rows))
    if linear.pairs:
        momenta = zip(linear.pairs.positions, linear.pairs.momenta, strict=True)
        yield Block("Momenta of the canonical pairs", tuple((_named(f"p_{x}"), p) for x, p in momenta))


def _discrete(model: Model, program: ControlProgram | StepProgram) -> Iterator[Block]:
    side, scheme = _side(model, program.method), schemes.find(program.scheme, program.method)
    controls = program.controlled
    if scheme.parts:  # fractions of h that the base method takes one after the other
        rows = []
        for i, row in enumerate(scheme.parts, start=1):
            names = (f"h_{i}",) if len(row) == 1 else (f"h_1({i})", f"h_2({i})")
            rows += [(_named(name), STEP * sympy.N(part, 16)) for name, part in zip(names, row, strict=True)]
        text = f"{len(scheme.parts)} steps of {repeated(scheme)[1].name}, one after the other"
        yield Block("Composition", tuple(rows), ((text, text + r"\\"),))
    if isinstance(program, StepProgram):
        _, scheme = repeated(scheme)
    if side.rotations:
        is_step = isinstance(program, StepProgram)
        remarks = [MIDPOINT if scheme.name == "midpoint" else OTHER, *([] if is_step else [OF_OPTIMA])]
        yield Block("Discretisation of the attitudes", (), tuple(remarks))
        if isinstance(program, StepProgram):
            rows = [(_named("0"), _shortest(value)) for _, value in program.equations]
            yield Block("Equations of one step", tuple(rows))
        interval = variational_interval(side, scheme, controls)
        cost, quadratures = interval.cost, interval.integrals
    elif scheme.variational:
        interval = variational_interval(side, scheme, controls)
        coordinates = [q.name for q in side.coordinates]
        own = [i for i, name in enumerate(coordinates) if not is_past(name)]
        rows = [(_named("L_d"), _shortest(interval.lagrangian))]
        for mark, forces in (("f-", interval.force_minus), ("f+", interval.force_plus)):
            rows += [(_named(f"{mark} {name}"), f) for name, f in zip(coordinates, forces, strict=True) if f != 0]
        rows += [(_named(f"f {q}"), f) for q, f in zip(interval.inner, interval.force_inner, strict=True) if f != 0]
        yield Block("Discrete Lagrangian" + (" and discrete forces" if len(rows) > 1 else ""), tuple(rows))
        pairs = zip(interval.inner, interval.inner_balance, strict=True)
        if inner := tuple((_named("0"), _shortest(balance)) for q, balance in pairs if not is_past(q.name)):
            yield Block("Balances at inner points", inner)
        momenta = [(_named(f"p_{coordinates[i]}_k"), _shortest(interval.left_momentum[i])) for i in own]
        momenta += [(_named(f"p_{coordinates[i]}_k1"), _shortest(interval.right_momentum[i])) for i in own]
        yield Block("Discrete Legendre transforms", tuple(momenta), (_LEGENDRE,))
        # This substitution moves expressions from the interval after node k to the interval before node k.
        sites = interval.q
        shift: dict[Symbol, Expr] = dict(zip(sites.left, at_nodes(side.coordinates, "_k-1"), strict=True))
        shift |= dict(zip(sites.right, sites.left, strict=True))
        shift |= dict(zip(interval.inner, at_nodes(interval.inner, "_k-1"), strict=True))
        shift |= {u: _named(f"{u.name}-1") for u in sites.of_interval}
        if sites.nodal:
            shift |= dict(zip(sites.right_controls, sites.left_controls, strict=True))
        shift[side.time] = side.time - STEP
        balances, constraints = [], Constraints(side, Names(side))
        acting = zip(constraints.force("_k"), contact.impulses(side), strict=True)
        impulses = [2 * of_constraints + of_contact for of_constraints, of_contact in acting]
        for i in own:
            before = _shortest(interval.right_momentum[i].xreplace(shift))
            balances.append((_named("0"), _shortest(before - _shortest(interval.left_momentum[i]) + impulses[i])))
        heading = ("Forced discrete" if any(side.force) else "Discrete") + " Euler-Lagrange equations"
        yield Block(heading, tuple(balances), (_CONSTRAINED_BALANCE if constraints.kappa else _BALANCE,))
        if means := tuple((_named("0"), _shortest(mean)) for mean in discrete(side, scheme) if side.rolling):
            yield Block("Discrete rolling constraints of an interval", means)
        if isinstance(program, StepProgram) and program.constraints:
            rows = [(_named("0"), _shortest(value)) for _, value in program.equations]
            yield Block("Equations of one step, with the forces of the constraints at both nodes", tuple(rows))
        cost, quadratures = interval.cost, interval.integrals
    else:
        step = step_interval(side, scheme) if side.linear else one_step_interval(side, scheme, controls)
        # Solve each equation for the value that it updates.
        updates = list(zip((*step.stages, *step.q.right, *step.p.right), step.equations, strict=True))
        rows = [(y, _shortest(y - e)) for y, e in updates if not is_past(y.name)]
        if side.linear and side.linear.pairs:  # momenta determine the coordinates
            rows = [(_named("0"), _shortest(e)) for _, e in updates]
        yield Block("One step", tuple(rows))
        cost, quadratures = step.cost, step.integrals
    if model.cost is not None:
        yield Block("Discrete cost, summed over all intervals", ((_named("C_d"), cost),))
    if quadratures:
        shares = tuple((_named(f"Gd_{i}"), value) for i, value in enumerate(quadratures, start=1))
        yield Block("Shares in integrals, whose sums over all intervals are those of the integrals", shares)


def _ends(program: ControlProgram | StepProgram) -> Iterator[Block]:
    if isinstance(program, StepProgram):
        values = {value.symbol: value.value for value in program.start_values}
        pairs = zip(program.state, program.start, strict=True)
        yield Block("Initial state", tuple((_named(f"{u.name}@0"), e.xreplace(values)) for u, e in pairs))
        return
    values = {value.symbol: value.value for value in program.boundary_values}
    rows: list[tuple[Symbol, Expr]] = []
    for end, mark, symbols in ((program.start, "@0", program.left_symbols), (program.end, "@T", program.right_symbols)):
        pins = {symbols[i]: value.xreplace(values) for i, value in end.pins}
        node = list(zip(program.node, symbols, strict=True))
        rows += [(_named(u.name + mark), pins[s]) for u, s in node if s in pins and not u.multiplier]
        named = {u.name for u, s in node if s in pins}
        rows += [
            (_named(f"{condition}{mark}"), _shortest(condition.value.xreplace(pins).xreplace(values)))
            for condition in end.conditions
            if str(condition) not in named
        ]
    remarks = [_MOMENTA] if program.method == "variational" else []
    for where, end in (("start", program.start), ("end", program.end)):
        remarks += [(f"{bound.condition} at the {where}",) * 2 for _, bound in end.bounds]
    model, shown = program.model, tuple(rows)
    if model.segments is not None:  # show the ends of the whole motion only, without the conditions that join segments
        names = {own: (whole, number) for own, whole, number in model.segments.names}
        outer, last = [], {"0": 1, "T": model.segments.number}
        for symbol, value in rows:
            name, mark, end = symbol.name.rpartition("@")
            stem = "p_" if name not in names and name.startswith("p_") else ""
            whole, number = names.get(name.removeprefix(stem), ("", 0))
            if number == last.get(end):
                outer.append((_named(f"{stem}{whole}{mark}{end}"), value))
        shown = tuple(outer)
    yield Block("Boundary conditions", shown, tuple(remarks))


def _shortest(expression: Expr) -> Expr:
    """Return the shortest of some equal expressions, without a common denominator of all terms.

    Products of sines and cosines become sums, so that sin^2 + cos^2 becomes 1. `sympy.simplify` finds little more and
    takes twenty times as long.
    """
    if expression.count_ops() > _SHORTEN_LIMIT:
        return expression
    expanded = sympy.expand(expression)
    flat = min(expanded, sympy.expand(TR8(expanded)), key=_length)
    terms = Add.make_args(expand_mul(expression, deep=False))
    termwise = Add(*(min((sympy.together(form) for form in (term, TR8(term))), key=_length) for term in terms))
    factored = (sympy.factor_terms(sympy.signsimp(form)) for form in (expression, flat, termwise))
    shorter = min(expression, *factored, key=_length)
    # A flat sum is easier to read than nested fractions that are a little shorter.
    return flat if _length(flat) <= _FLAT_BONUS * _length(shorter) else shorter


def _length(expression: Expr) -> int:
    """Return the number of operations."""
    return int(expression.count_ops())


@dataclass(frozen=True)
class Equations:
    """The equations of a problem and of its discretisation; `str` returns the `text` of `codegen show`.

    In a notebook they are shown as mathematics. The `latex` needs the package amsmath.
    """

    text: str
    _latex: Callable[[], str]

    @cached_property
    def latex(self) -> str:
        """The equations as LaTeX, derived on demand."""
        return self._latex()

    def __repr__(self) -> str:  # also for `str`
        return self.text

    def _repr_markdown_(self) -> str:
        return as_markdown(self.latex)


def derived_equations(
    problem: Source | Path | str,
    arguments: Mapping[str, str],
    scheme: str | None = None,
    method: str | None = None,
    controls: str = "interval",
) -> Equations:
    """Return the equations of a problem file or object; raises the errors of `equations`."""
    derived = partial(equations, problem, arguments, scheme=scheme, method=method, controls=controls)
    return Equations(derived(), partial(derived, latex=True))


_HEADING = re.compile(r"^\\(section\*|paragraph)\{(.*)\}$", re.MULTILINE)
_ALIGNED = re.compile(r"\\begin\{align\*\}\n(.*?)\n\\end\{align\*\}", re.DOTALL)
_ESCAPE = re.compile(r"\\([_%&#$^{}])")


def as_markdown(latex: str) -> str:
    """Return the LaTeX of `codegen show --latex` as Markdown for notebooks, with mathematics between $ signs."""

    def heading(match: re.Match[str]) -> str:
        mark = "###" if match[1] == "section*" else "####"
        return f"{mark} " + _ESCAPE.sub(r"\1", match[2])

    outside = re.sub(r"^([^&\n]*)\\\\$", r"\1  ", _HEADING.sub(heading, latex), flags=re.MULTILINE)
    return _ALIGNED.sub(r"\n$$\n\\begin{aligned}\n\1\n\\end{aligned}\n$$", outside)


# ---- Rotations ----

Shorten = Callable[[Expr], Expr]
_AXES = "xyz"
_ABOUT = (
    "{R} is the rotation from the frame of the body to that of space, with the entries {R}_11 to {R}_33, and omega its "
    "angular velocity in the frame of the body. The coordinates of {R} are the unit quaternion {q}."
)
_BALANCE_OF_ROTATIONS = (
    "d/dt μ + ω × μ - m(L) - M - κ m(c) = 0 in the frame of the body, with μ = ∂L/∂ω, the moments m = dR·∂/∂R and the "
    "torque M, written out; κ are the forces of constraints",
    r"$\frac{d}{dt} \mu + \omega \times \mu - m(L) - M - \kappa m(c) = 0$ in the frame of the body, with $\mu = "
    r"\partial L/\partial \omega$, moments $m$ and the torque $M$, written out; $\kappa$ are the forces of constraints",
)
MIDPOINT = (
    "The discrete Lagrangian is h L in the middle of the step, of the quaternion (qₖ + qₖ₊₁)/2 and its velocity "
    "(qₖ₊₁ - qₖ)/h. So Rₖ₊₁ = Rₖ τ(h ω) with |h ω| = 4 tan(angle/4), the square of Cayley's map of h ω/2.",
    r"The discrete Lagrangian is $h L$ in the middle of the step, of the quaternion $(q_k + q_{k+1})/2$ and its "
    r"velocity $(q_{k+1} - q_k)/h$. So $R_{k+1} = R_k \tau(h \omega)$ with $|h \omega| = 4 \tan(\mathrm{angle}/4)$, "
    r"the square of Cayley's map of $h \omega/2$.",
)
OTHER = (
    "The discrete Lagrangian is the quadrature of L by the scheme, with the velocity (qₖ₊₁ - qₖ)/h of the quaternion.",
    r"The discrete Lagrangian is the quadrature of $L$ by the scheme, with the velocity $(q_{k+1} - q_k)/h$ of the "
    "quaternion.",
)
OF_OPTIMA = (
    "Unknowns are the quaternions, with the discrete Euler-Lagrange equations "
    "D₂ Ld(qₖ₋₁, qₖ) + D₁ Ld(qₖ, qₖ₊₁) + f⁺ₖ₋₁ + f⁻ₖ + h Gᵀκ = 0. There L has a further multiple of (q · dq)², which "
    "vanishes along every motion and makes the momenta of the quaternion regular.",
    r"Unknowns are the quaternions, with the discrete Euler-Lagrange equations $D_2 L_d(q_{k-1}, q_k) + "
    r"D_1 L_d(q_k, q_{k+1}) + f^+_{k-1} + f^-_k + h G^T \kappa = 0$. There $L$ has a further multiple of "
    r"$(q \cdot dq)^2$, which vanishes along every motion and makes the momenta of the quaternion regular.",
)


@dataclass(frozen=True)
class _Body:
    """The attitude of a body: its name, quaternion, and the symbols of R (3, 3) and omega (3,)."""

    name: str
    quaternion: tuple[Symbol, ...]
    matrix: Matrix
    omega: Matrix


class Attitudes:
    """The attitudes of a Lagrangian model with rotations, and its expressions in terms of them."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.bodies = list[_Body]()
        for name, quaternion in zip(model.attitudes, model.rotations, strict=True):
            ending = "" if len(model.rotations) == 1 else f"_{name}"
            matrix = Matrix(3, 3, lambda i, j, name=name: _named(f"{name}_{i + 1}{j + 1}"))
            omega = Matrix([_named(f"omega{ending}_{axis}") for axis in _AXES])
            self.bodies.append(_Body(name, quaternion, matrix, omega))
        turning = {q for body in self.bodies for q in body.quaternion}
        rates = dict(zip(model.coordinates, model.rates, strict=True))
        self.positions = {x: v for x, v in rates.items() if x not in turning}

    def written(self, expression: Expr) -> Expr:
        """Return an expression in the attitudes and angular velocities, as far as an author wrote it in them."""
        rates = {body.quaternion: tuple(body.omega) for body in self.bodies}
        expression = in_body_rates(self.model, expression, rates)
        for body in self.bodies:
            squares = squared_length(body.quaternion)
            entries = zip(rotation_matrix(body.quaternion), body.matrix, strict=True)
            numerators: dict[Expr, Expr] = {entry * squares: symbol * squares for entry, symbol in entries}
            expression = expression.xreplace(numerators).xreplace({squares: S.One})
        return expression

    def torque(self, body: _Body) -> Matrix:
        """Return the torque of the forces on a body, in its frame."""
        force = dict(zip(self.model.coordinates, self.model.force, strict=True))
        at_identity = dict(zip(body.quaternion, (S.One, S.Zero, S.Zero, S.Zero), strict=True))
        # In terms of R and omega, only the factor q of the force 2 q (0, M) has the quaternion.
        parts = [self.written(force[q]) for q in body.quaternion[1:]]
        return Matrix([part.xreplace(at_identity) / 2 for part in parts])

    def lagrangian(self) -> Block:
        """Return the block of the Lagrangian, the generalised forces and the torques, written in attitudes."""
        rows = [(_named("L"), self.written(self.model.function))]
        force = dict(zip(self.model.coordinates, self.model.force, strict=True))
        rows += [(_named(f"f_{x}"), self.written(force[x])) for x in self.positions if force[x] != 0]
        for body in self.bodies:
            ending = "" if len(self.bodies) == 1 else f"_{body.name}"
            named = zip(_AXES, self.torque(body), strict=True)
            rows += [(_named(f"M{ending}_{axis}"), part) for axis, part in named if part != 0]
        abouts = [_ABOUT.format(R=body.name, q=", ".join(map(str, body.quaternion))) for body in self.bodies]
        heading = "Lagrangian" + (" and forces" if len(rows) > 1 else "")
        return Block(heading, tuple(rows), tuple((about, about.replace("_", r"\_")) for about in abouts))

    def balances(self, shorten: Shorten) -> Block:
        """Return the block of the Euler-Lagrange equations of positions and of Euler's equations of attitudes."""
        model, function = self.model, self.written(self.model.function)
        force = dict(zip(model.coordinates, model.force, strict=True))
        lengths = [squared_length(body.quaternion) - 1 for body in self.bodies]
        kappa = [_named(unknown.name) for unknown in Constraints(model, Names(model)).kappa]
        holonomic = zip(kappa, model.holonomic, strict=False)
        pulls = [(k, self.written(c)) for k, c in holonomic if c not in lengths]
        slips = [(k, self.written(c)) for k, c in zip(kappa[len(model.holonomic) :], model.rolling, strict=True)]
        rows = list[tuple[Expr, Expr]]()
        for x, v in self.positions.items():
            normal = Add(*(k * sympy.diff(c, x) for k, c in pulls), *(k * sympy.diff(c, v) for k, c in slips))
            balance = self._rate(sympy.diff(function, v)) - sympy.diff(function, x) - self.written(force[x]) - normal
            rows.append((_named("0"), shorten(balance)))
        for body in self.bodies:
            mu = Matrix(gradient(function, tuple(body.omega)))
            balance = mu.applyfunc(self._rate) + body.omega.cross(mu) - _moment(function, body) - self.torque(body)
            for k, c in pulls:
                balance -= k * _moment(c, body)
            for k, c in slips:
                balance -= k * Matrix(gradient(c, tuple(body.omega)))
            rows += [(_named("0"), shorten(part)) for part in balance]
        return Block("Equations of motion", tuple(rows), (_BALANCE_OF_ROTATIONS,))

    def _rate(self, function: Expr) -> Expr:
        """Return the time derivative of a function of positions, attitudes and their velocities."""
        terms = [sympy.diff(function, self.model.time)]
        for x, v in self.positions.items():
            terms += [sympy.diff(function, x) * v, sympy.diff(function, v) * _named(f"acceleration {x}")]
        for body in self.bodies:
            terms.append(_moment(function, body).dot(body.omega))
            terms += [sympy.diff(function, w) * _named(f"rate {w}") for w in body.omega]
        return Add(*terms)


def _moment(function: Expr, body: _Body) -> Matrix:
    """Return the derivative of a function along rotations of a body about its axes (3,)."""
    moments = list[Expr]()
    for k in range(3):
        turned = body.matrix * _hat(Matrix([int(i == k) for i in range(3)]))
        moments.append(Add(*(sympy.diff(function, r) * d for r, d in zip(body.matrix, turned, strict=True))))
    return Matrix(moments) + half_imaginary(body.quaternion, gradient(function, body.quaternion))


def _hat(v: Sequence[Expr]) -> Matrix:
    return Matrix([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def in_attitudes(blocks: Iterable[Block], attitudes: Attitudes) -> Iterator[Block]:
    """Yield blocks whose expressions are written in attitudes and angular velocities."""
    for block in blocks:
        rows = tuple((left, attitudes.written(right)) for left, right in block.equations)
        yield Block(block.heading, rows, block.remarks)
