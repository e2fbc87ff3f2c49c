"""Entries of a control module's metadata that are there only where a user should know of something."""

from __future__ import annotations

import sympy
from sympy import Dummy, expand

from codegen.discretise import at_nodes
from codegen.lower.control import inner_times
from codegen.model import Model
from codegen.model.definitions import expressions_of, prescribed
from codegen.model.jumps import jumps
from codegen.model.nonsmooth_costs import kinks
from codegen.model.singular_guesses import singular_at_guess
from codegen.transcribe.program import ControlProgram


def notable(program: ControlProgram) -> list[tuple[str, str]]:
    """The entries of a program."""
    redundant, unseen = program.redundant_couplings, _unseen_controls(program)
    model = program.model
    entries = [("unseen_controls", repr(unseen))] if unseen else []
    entries += [("unused", repr(model.unused))] if model.unused else []
    entries += [("maximised", "True")] if model.maximised else []
    if jumps := _jumps_from_history(model.authored):
        entries.append(("history_jumps", repr(jumps)))
    if (segments := model.segments) and segments.number > 1:
        names = {own: (whole, number) for own, whole, number in segments.names}
        entries.append(("segments", repr({"number": segments.number, "names": names})))
    if integrals := _integral_multipliers(program):
        entries.append(("integrals", repr(integrals)))
    entries += inner_times.metadata(program)
    if bends := _kinks(program):
        entries.append(("kinks", repr(bends)))
    if steps := _jumps(program):
        entries.append(("discontinuities", repr(steps)))
    singular = dict.fromkeys(one for own in model.phases or (model,) for one in singular_at_guess(own))
    if singular:
        entries.append(("singular_at_guess", repr(tuple(singular))))
    if redundant:
        entries.append(("coupling_conditions", repr(len(program.couplings) + len(redundant))))
        entries.append(("redundant_conditions", repr(redundant)))
    ends = (("start", program.start), ("end", program.end))
    if dependent := tuple((name, where) for where, end in ends for name in end.dependent):
        entries.append(("dependent_values", repr(dependent)))
    if decided := tuple((name, where) for where, end in ends for _, name in end.determined if name):
        entries.append(("decided_conditions", repr(tuple(dict.fromkeys(decided)))))
    return entries


def _jumps_from_history(model: Model) -> tuple[tuple[str, str, str], ...]:
    """Quantities whose given value at the start is not where their history ends, with both values."""
    given, found = prescribed(model, "start"), {}
    for delay in model.delays:
        last = delay.history.xreplace({model.time: sympy.S.Zero})
        value = given.get(delay.quantity, last)
        if sympy.simplify(value - last) != 0:
            found[delay.quantity.name] = (sympy.sstr(value), sympy.sstr(last))
    return tuple((name, *values) for name, values in found.items())


def _integral_multipliers(program: ControlProgram) -> tuple[tuple[str, int], ...]:
    """The name of every condition on an integral, and the index of its multiplier among the unknowns of no node."""
    own, bodies = program.own, program.bodies
    found = []
    for index, integrals in [(0, program.integrals), *((i, p.integrals) for i, p in enumerate(program.phases, 1))]:
        for integral in integrals:
            j = program.shared_symbols.index(integral.multiplier)
            where = f" in phase {index}" if index else ""
            for body in range(bodies if j < own else 1):
                of_body = f" of body {body}" if bodies > 1 else ""
                found.append((f"{integral.condition.name}{where}{of_body}", body * own + j))
    return tuple(found)


def _kinks(program: ControlProgram) -> tuple[str, ...]:
    """Terms of the cost, of any phase, whose slope jumps where a motion may be."""
    models = program.model.phases or (program.model,)
    found: dict[str, None] = {}
    for model in models:
        moving = (*model.coordinates, *model.rates, *model.controls)
        for cost in (model.cost or sympy.S.Zero, model.terminal_cost):
            found |= dict.fromkeys(kinks(cost, moving))
    return tuple(found)


def _jumps(program: ControlProgram) -> tuple[str, ...]:
    """Borders at which the cost, the dynamics, forces or conditions of any phase jump."""
    found: dict[str, None] = {}
    for model in program.model.phases or (program.model,):
        moving = (*model.coordinates, *model.rates, *model.controls)
        found |= dict.fromkeys(border for part in expressions_of(model) for border in jumps(part, moving))
    return tuple(found)


def _unseen_controls(program: ControlProgram) -> tuple[str, ...]:
    """Nodal controls whose alternation the discrete cost does not see, because only sums of neighbours occur in it.

    `codegen check` decides with numbers what this finds by expanding.
    """
    if not program.nodal_controls or program.model.cost is None:
        return ()
    controls = [u for u in program.model.controls if program.model.cost.has(u)]
    left, right = at_nodes(controls, "_k"), at_nodes(controls, "_k1")
    total = Dummy("sum", real=True)
    alone = (expand(program.cost.xreplace({b: total - a})).has(a) for a, b in zip(left, right, strict=True))
    return tuple(u.name for u, is_seen in zip(controls, alone, strict=True) if not is_seen)
