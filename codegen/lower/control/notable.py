"""Fields of the record of a control module that are there only where a user should know of something."""

from __future__ import annotations

from typing import Any

import sympy
from sympy import Dummy, expand

from codegen.discretise import at_nodes
from codegen.model import Model
from codegen.model.definitions import expressions_of, prescribed
from codegen.model.jumps import jumps
from codegen.model.nonsmooth_costs import kinks
from codegen.model.singular_guesses import singular_at_guess
from codegen.runtime.record import SegmentRecord
from codegen.transcribe.program import ControlProgram


def notable(program: ControlProgram) -> dict[str, Any]:
    """The fields of a record that are empty for most programs."""
    model, redundant, inner = program.model, program.redundant_couplings, program.inner
    models = model.phases or (model,)
    segments = None
    if model.segments and model.segments.number > 1:
        names = {own: (whole, number) for own, whole, number in model.segments.names}
        segments = SegmentRecord(model.segments.number, names)
    ends = (("start", program.start), ("end", program.end))
    decided = dict.fromkeys((name, where) for where, end in ends for _, name in end.determined if name)
    return {
        "unseen_controls": _unseen_controls(program),
        "maximised": model.maximised,
        "history_jumps": _jumps_from_history(model.authored),
        "segments": segments,
        "integrals": _integral_multipliers(program),
        "inner_times": len(inner.times),
        "waypoints": inner.clock is not None,
        "inner_conditions": inner.multipliers,
        "kinks": _kinks(program),
        "discontinuities": _jumps(program),
        "singular_at_guess": tuple(dict.fromkeys(one for own in models for one in singular_at_guess(own))),
        "coupling_conditions": len(program.couplings) + len(redundant) if redundant else 0,
        "redundant_conditions": redundant,
        "dependent_values": tuple((name, where) for where, end in ends for name in end.dependent),
        "decided_conditions": tuple(decided),
    }


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
