"""Prescribed end values and bounds of a control problem's unknowns, as assignments to array views of the unknowns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sympy import Expr, Max, Min, oo

from codegen.discretise.program import ControlProgram, Unknown
from codegen.emit.lower.control.layout import inputs, phase_slice, phase_start, phase_steps, shared_views
from codegen.emit.lower.kernels import Line
from codegen.emit.lower.module import BoundText, PinText
from codegen.emit.lower.printer import array_code


def pins(program: ControlProgram) -> PinText:
    """Return code that assigns the prescribed values at both ends to the unknowns."""
    ends = (("0", program.start), ("-1", program.end))
    values = [v for _, end in ends for _, v in end.pins] + [v for _, end in ends for _, _, v in end.shared]
    lines = []
    for node, end in ends:
        for index, value in sorted(end.pins, key=lambda pin: pin[0]):
            lines.append(Line(f"nodes[:, {node}, {index}]", array_code(value)))
        for index, j, offset in end.shared:
            shared = f"own[:, {j}]" if j < program.linking.own else f"common[{j - program.linking.own}]"
            code = shared if offset == 0 else f"{shared} + {array_code(offset)}"
            lines.append(Line(f"nodes[:, {node}, {index}]", code))
    for number, index in enumerate(program.inner.unknowns):
        lines.append(Line(f"nodes[:, without_inner_unknown(grid, {number}), {index}]", "0.0"))
    needs_shared = bool(program.start.shared or program.end.shared)
    views = shared_views(program, "own, common", "unknowns") if needs_shared else ()
    return PinText((*inputs(program, values, column=False), *views), tuple(lines))


@dataclass(frozen=True)
class Bound:
    """A bound of an unknown, assigned to `target`; `is_common` is True if all bodies have the same number."""

    target: str
    value: Expr
    name: str
    is_common: bool = False

    @property
    def line(self) -> Line:
        """The line that assigns the bound."""
        code = common_code(self.value) if self.is_common else array_code(self.value)
        return Line(self.target, {oo: "np.inf", -oo: "-np.inf"}.get(self.value) or code, self.name)


def common_code(value: Expr) -> str:
    """Return code of a value that is equal for all bodies, as one number: parameters have a row for each body."""
    return f"np.max({array_code(value)})" if value.free_symbols else array_code(value)


def bounds(program: ControlProgram) -> BoundText:
    """Return code that assigns all bounds; it is empty for a problem without inequalities."""
    if not program.has_inequalities:
        return BoundText()
    values = bound_values(program)
    return BoundText(
        inputs=inputs(program, [bound.value for bound in values]),
        views=(*phase_steps(program), *bound_views(program)),
        lines=((*(bound.line for bound in values), *slack_bounds(program)),),
    )


def bound_views(program: ControlProgram) -> tuple[Line, ...]:
    """Return lines that make array views of the bounds of linking variables."""
    return (
        *shared_views(program, "lower_own, lower_common", "lower"),
        *shared_views(program, "upper_own, upper_common", "upper"),
    )


def bound_values(program: ControlProgram) -> list[Bound]:
    """Return the bounds of all unknowns except slacks."""
    values = list[Bound]()

    def add(target: str, unknown: Unknown, is_common: bool = False) -> None:
        values.extend(Bound(f"{side}_{target}", v, unknown.name, is_common) for side, v in _limits(unknown))

    inside = len(program.interval) + len(program.controls)
    for i, phase in enumerate(program.phases):
        for j, unknown in enumerate(phase.node):
            add(f"nodes[:, {phase_slice(program, i, at_nodes=True)}, {j}]", unknown)
        for j, unknown in enumerate(phase.inside[:inside]):
            add(f"intervals[:, {phase_slice(program, i)}, {j}]", unknown)
        if i:
            # At a switch, continuous quantities obey the bounds of both phases; prescribed quantities have no bounds.
            before, after = program.phases[i - 1], program.phases[i]
            for j, (earlier, later) in enumerate(zip(before.node, after.node, strict=True)):
                limits_before, limits = dict(_limits(earlier)), dict(_limits(later)) if j not in after.jumping else {}
                if j in after.given:
                    limits = {side: -oo if side == "lower" else oo for side in limits_before}
                elif limits_before:
                    limits = {
                        side: (Max if side == "lower" else Min)(limits_before.get(side, value), value)
                        for side, value in limits.items()
                    }
                name = f"{later.name} at the switch"
                values += [Bound(f"{side}_nodes[:, {phase_start(i)}, {j}]", v, name) for side, v in limits.items()]
    if not program.phases:
        for group, unknowns in (
            ("nodes[:, :", program.node),
            ("intervals[:, :", (*program.interval, *program.controls)),
            ("own[:", program.linking.of_bodies),
        ):
            for j, unknown in enumerate(unknowns):
                add(f"{group}, {j}]", unknown)
    for j, unknown in enumerate(program.linking.common):
        add(f"common[{j}]", unknown, is_common=program.model.bodies > 1)
    for number, *window in () if program.phases else program.inner.windows:
        for side, value in zip(("lower", "upper"), window, strict=True):
            if value is not None:
                target = f"{side}_nodes[:, grid.inner[{number}], {program.inner.clock}]"
                values.append(Bound(target, value, f"the window of waypoint {number + 1}", True))
    for node, end in ((":1", program.start), ("-1:", program.end)):
        for j, bound in end.bounds:
            for side, value in (("lower", bound.lower), ("upper", bound.upper)):
                if value is not None:
                    values.append(Bound(f"{side}_nodes[:, {node}, {j}]", value, bound.condition))
    return values


def _limits(unknown: Unknown) -> Iterator[tuple[str, Expr]]:
    """Yield side ("lower" or "upper") and value of each bound of an unknown."""
    for side, value in (("lower", unknown.lower), ("upper", unknown.upper)):
        if value is not None:
            yield side, value


def slack_bounds(program: ControlProgram) -> list[Line]:
    """Return the bounds of slacks, then lines that remove bounds where other values determine an unknown.

    The bound of a determined slack becomes -1, so that the slack stays above it and its barrier term stays finite.
    """
    first = len(program.interval) + len(program.controls)
    lines = []
    for j, slack in enumerate(program.slacks):
        assert slack.lower is not None, "a slack has a least value"
        lines.append(Line(f"lower_intervals[:, :, {first + j}]", array_code(slack.lower), slack.name))
    slack_names, node_names = [slack.name for slack in program.slacks], [unknown.name for unknown in program.node]

    def remove_bounds(node_slacks: Sequence[tuple[int, int]], node: str, interval: str, name: str) -> None:
        comment = f"{name} is determined there"
        if name in slack_names:
            index = first + slack_names.index(name)
            lines.append(Line(f"lower_intervals[:, {interval}, {index}]", "-1.0", comment))
            return
        index = node_names.index(name)
        if index in [slack for slack, _ in node_slacks]:
            lines.append(Line(f"lower_nodes[:, {node}, {index}]", "-1.0", comment))
            return
        lines.append(Line(f"lower_nodes[:, {node}, {index}]", "-np.inf", comment))
        lines.append(Line(f"upper_nodes[:, {node}, {index}]", "np.inf", comment))

    for node, end in (("0", program.start), ("-1", program.end)):
        lines += [Line(f"lower_nodes[:, {node}, {i}]", "0.0", program.node[i].name) for i, _ in end.slacks]
        for name, _ in end.determined:
            remove_bounds(end.slacks, node, node, name)
    for number, name, before in program.inner.determined:
        node = f"grid.inner[{number}]"
        remove_bounds((), node, f"{node} - 1" if before else node, name)
    return lines
