"""Sizes of a control problem, which decide what its module holds: numbers of unknowns, and which features it uses."""

from __future__ import annotations

from codegen.derive import ControlDerivatives
from codegen.expressions.table_functions import tables_of
from codegen.transcribe.program import ControlProgram, EndElement


def sizes(program: ControlProgram, derivatives: ControlDerivatives) -> tuple[tuple[str, int], ...]:
    """The number of bodies, whether it is more than one, the shared unknowns of each and in all, and their conditions.

    Then whether there are phases, inequalities, slacks on intervals, no cost, a start from which a motion follows, and
    a right-hand side that takes part in the elimination, and how many numbers tables have.
    """
    own, shared, couplings = program.own, len(program.shared), len(program.couplings)
    return (
        ("BODIES", program.bodies),
        ("SEVERAL", int(program.bodies > 1)),
        ("OWN", own),
        ("SHARED", shared),
        ("COUPLINGS", couplings),
        ("ROOT", program.bodies * own + shared - own + couplings),
        ("TIED", len(program.start.shared) + len(program.end.shared)),
        ("SHARED_MULTIPLIERS", sum(u.multiplier for u in program.shared)),
        ("PHASES", len(program.phases)),
        ("INNER_TIMES", len(program.inner.times)),
        ("FREE_TIMES", len(program.inner.lacking)),
        ("INEQUALITIES", int(program.has_inequalities)),
        ("UNBOUNDED", int(not program.has_inequalities)),
        ("SLACKED", len(program.slacks)),
        ("COSTLESS", int(is_costless(program))),
        ("FORWARD", int(bool(motion_indices(program)[0]))),
        ("SCALED", int(not derivatives.linear_quadratic)),
        ("BACKWARD", int(sweeps_backward(program))),
        ("BORDERED", int(borders_front(program))),
        ("CARRIED", int(carries_right_hand_side(program, derivatives))),
        ("TABLED", sum(table.shape.count for table in tables_of(program.model))),
    )


def is_costless(program: ControlProgram) -> bool:
    """Whether any motion that obeys the conditions will do."""
    costs = [*(part.cost for part in program.interval_elements), program.start.cost, program.end.cost]
    return not program.sample and not any(costs)


def motion_indices(program: ControlProgram) -> tuple[list[int], list[int]]:
    """Local indices of the equations of a step, and of what they determine: stages, and the state after it.

    Both are empty where the start does not give all states, or the end anything, so that no motion follows from a guess
    of controls.
    """
    ends = program.start, program.end
    is_plain = program.method != "variational" and program.bodies == 1 and not program.phases and not program.sample
    if not is_plain or program.inner.times or any(end.shared for end in ends):
        return [], []
    node, inside = len(program.node), program.interval[: len(program.interval) - program.path_multipliers]
    others = {
        *program.only_at_ends,
        *(range(node - len(program.model.controls), node) if program.nodal_controls else ()),
    }
    states = [i for i in range(node) if i not in others]
    given = {i for i, _ in program.start.pins}
    if any(program.node[i].multiplier or i not in given for i in states):
        return [], []
    if program.end.pins or program.end.conditions or program.end.slacks or program.end.bounds:
        return [], []
    if program.path_multipliers > len(program.slack_multipliers):  # equalities, which controls have to obey
        return [], []
    equations = [node + i for i, unknown in enumerate(inside) if unknown.multiplier]
    stride = node + len(program.interval) + len(program.controls) + len(program.slacks)
    unknowns = [node + i for i, u in enumerate(inside) if not u.multiplier] + [stride + i for i in states]
    return (equations, unknowns) if len(equations) == len(unknowns) else ([], [])


def carries_right_hand_side(program: ControlProgram, derivatives: ControlDerivatives) -> bool:
    """Whether the rows of an element matrix, which are as long as a multiple of four, have room for one more column."""
    node, inside = len(program.node), len(program.interval) + len(program.controls) + len(program.slacks)
    block = node + inside - derivatives.condensed - 2 * derivatives.stages
    first = block - len(pinned(first_end(program))) if borders_front(program) else 0
    border = node + first + len(program.shared)  # the next node, block 0, shared unknowns
    return (block + border) % 4 > 0 and border % 4 > 0


def sweeps_backward(program: ControlProgram) -> bool:
    """Whether elimination goes from the last interval to the first.

    Where equations are those of intervals, each then goes with the state at its end, which it determines: the other
    way the elimination would integrate backward in time, and dissipative dynamics would make rounding grow without end.
    Equations of states at nodes, which controls before the last interval may decide, want the other way all the same:
    they are eliminated with the interval after their node, not with the one before it, which may leave them no choice.
    """
    own = (u for i, u in enumerate(program.node) if i not in program.only_at_ends)
    return program.method != "variational" and not any(u.multiplier for u in own)


def first_end(program: ControlProgram) -> EndElement:
    """The end where elimination begins."""
    return program.end if sweeps_backward(program) else program.start


def borders_front(program: ControlProgram) -> bool:
    """Whether block 0 stays to the end of the elimination, because its equations may determine other unknowns.

    Where nothing is given at the end where elimination begins, they determine its state, as in all other blocks.
    """
    return bool(not sweeps_backward(program) or pinned(first_end(program)) or program.only_at_ends)


def pinned(end: EndElement) -> list[int]:
    """Local index of every unknown that is given at an end, or equals a shared one."""
    return sorted([*(i for i, _ in end.pins), *(i for i, _, _ in end.shared)])
