"""Sensitivities of a solution against central differences of the problem solved again, with other data.

All quantities change at once, in proportions drawn at random: first by themselves, then parameters alone, which
boundary values and the duration follow. Where that leaves no solution, as beyond the range of a table or a bound on a
prescribed value, those that cannot change even alone stay as they are, and are named. Differences with three lengths,
halved each time, are extrapolated twice (Richardson): the two results differ by what the reference may be off.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from codegen.checks.base import Context, Finding, does_not_apply, not_measured
from codegen.sweeping.quantities import Quantity, given_to, quantities

_NAME = "sensitivities"
_LENGTHS = (1e-2, 1e-3, 1e-4)
"""Of changes to both sides, in parts of quantities."""
_ALLOWED, _ROUGH = 1e-6, 1e-5
"""Parts of the largest entry that differences may be; and that references may be off, beyond which they say nothing."""
_KINK = 1e-3
"""Parts of a derivative by which those to both sides differ where there is none."""
_FLOOR = 1e-3
"""Parts of the largest value below which its derivatives are compared as if they were that large."""
_KINDS = ("cost", "q", "u", "multipliers")
_TOLERANCES = (1e-12, 1e-10)


@dataclass(frozen=True)
class _Direction:
    """Quantities that change, their values, and by how much they do."""

    subject: str
    varied: tuple[Quantity, ...]
    values: tuple[Any, ...]
    changes: Any
    given: tuple[str, ...]


def check(context: Context) -> Iterator[Finding]:
    """Compare along two directions."""
    module, solution = context.module, context.solution
    if module.metadata.sensitivities is None:
        yield does_not_apply(_NAME, "the module has none, unless it is built with --sensitivities")
        return
    subject = f"solution on {solution.t.size - 1} intervals"
    if solution.status != "solved":
        yield not_measured(_NAME, subject, solution.message)
        return
    steps = (solution.t.size - 1) // max(1, len(context.control.phases))
    solution = _solved(module, steps, {}, solution.unknowns) or solution
    for direction in _directions(module, module.make_grid(steps)):
        yield _compared(module, steps, solution, direction)


def _directions(module: Any, grid: Any) -> Iterator[_Direction]:
    """Changes of everything by itself, and of parameters, which all else follows."""
    names, count = module.QUANTITIES, len(module.metadata.parameters)
    values = (*grid.parameters[:, : module.OWN_QUANTITIES].T, grid.steps * grid.h)[: len(names)]
    own = tuple(v if i >= count else float(np.max(v)) for i, v in enumerate(values))
    sizes = np.array([max(float(np.abs(value).max()), 0.1) for value in own])
    signs = np.random.default_rng(11).uniform(0.3, 1.0, len(names)) * np.where(np.arange(len(names)) % 2, 1.0, -1.0)
    known = quantities(names, module, ())
    given = tuple(names[count:])
    yield _Direction("all quantities by themselves", known, own, sizes * signs, given)
    if given and count:
        yield _Direction("parameters, which others follow", known[:count], own[:count], (sizes * signs)[:count], ())


def _compared(module: Any, steps: int, solution: Any, direction: _Direction) -> Finding:
    grid, subject = module.make_grid(steps), f"{direction.subject}, {steps} intervals"
    found = module.sensitivities(grid, solution.unknowns, direction.given)
    if found.failure:
        return not_measured(_NAME, subject, found.failure)
    if found.doubtful.size:
        return not_measured(_NAME, subject, f"strict complementarity fails for {found.doubtful.size} unknowns")
    direction, references, left_out = _references(module, steps, solution, direction)
    if not references:
        return not_measured(_NAME, subject, f"the problem beside the solution is not solved{left_out}")
    subject += left_out
    pairs = [pair[:2] for pair in references]
    if any(_bends(references, kind, _array(solution, kind)) for kind in _KINDS):
        return not_measured(_NAME, subject, "derivatives to both sides differ, as where bounds begin to hold")
    said = _along(module, grid, solution, found, direction)
    worst, beyond, rough, of = 0.0, 0.0, 0.0, ""
    for kind in _KINDS:
        at = np.asarray(getattr(solution, kind), dtype=float)
        if not at.size:
            continue
        floor = _FLOOR * float(np.abs(at).max())
        errors = []
        for coarse, fine in pairs:
            scale = max(float(np.abs(fine[kind]).max()), floor, 1e-300)
            noise = float(np.abs(fine[kind] - coarse[kind]).max()) / scale
            errors.append((noise, float(np.abs(said[kind] - fine[kind]).max()) / scale))
        noise, error = min(errors)
        rough = max(rough, noise)
        worst = max(worst, error)
        if not error - 10.0 * noise <= max(beyond, _ALLOWED):
            beyond, of = error - 10.0 * noise, kind
    if rough > _ROUGH:
        return not_measured(_NAME, subject, f"differences do not converge, only to {rough:.0e}, as where bounds change")
    detail = f"differ by at most {worst:.1e} from central differences, which are good to {rough:.0e}"
    return Finding(_NAME, subject, not of, f"those of {of} {detail}" if of else detail)


def _along(module: Any, grid: Any, solution: Any, found: Any, direction: _Direction) -> dict[str, Any]:
    """The derivatives along a direction by those that were found."""
    total: dict[str, Any] = dict.fromkeys(_KINDS, 0.0)
    for quantity, change in zip(direction.varied, direction.changes, strict=True):
        i = module.QUANTITIES.index(quantity.name)
        _, q, _, u, multipliers = module.unpacked_rates(grid, solution.unknowns, found, i)
        for kind, own in (("cost", found.cost[i]), ("q", q), ("u", u), ("multipliers", multipliers)):
            total[kind] = total[kind] + change * own
    return total


def _references(
    module: Any, steps: int, solution: Any, direction: _Direction
) -> tuple[_Direction, list[tuple[dict[str, Any], ...]], str]:
    """The direction along which there are references of all lengths, these, and words for what it leaves out.

    There are none where the problem is not solved beside the solution, though every quantity can change alone.
    """
    found = [_reference(module, steps, solution, direction, length) for length in _LENGTHS]
    references = [pair for pair in found if pair is not None]
    if len(references) == len(found):
        return direction, references, ""
    count = len(direction.varied)
    can = np.array([_can_change(module, steps, solution, direction, np.arange(count) == i) for i in range(count)])
    if can.all() or not can.any():
        return direction, [], ""
    left_out = ", ".join(direction.varied[i].name for i in np.flatnonzero(~can))
    direction = _part(direction, can)
    found = [_reference(module, steps, solution, direction, length) for length in _LENGTHS]
    references = [pair for pair in found if pair is not None]
    return direction, references if len(references) == len(found) else [], f", without {left_out}"


def _can_change(module: Any, steps: int, solution: Any, direction: _Direction, which: Any) -> bool:
    """Whether there are solutions to both sides of some quantities' values, as far as the longest differences go."""
    alone = _part(direction, which)
    return all(_moved(module, steps, solution, alone, side * _LENGTHS[0]) is not None for side in (1, -1))


def _part(direction: _Direction, which: Any) -> _Direction:
    """A direction in which only some of the quantities change; the others keep their values by themselves."""
    return replace(direction, changes=np.where(which, direction.changes, 0.0))


def _reference(
    module: Any, steps: int, solution: Any, direction: _Direction, length: float
) -> tuple[dict[str, Any], ...] | None:
    """Extrapolated differences with a length and its half, with its half and quarter, and what both sides differ by."""
    differences, bend = [], dict[str, Any]()
    for part in (length, 0.5 * length, 0.25 * length):
        ends = [_moved(module, steps, solution, direction, side * part) for side in (1, -1)]
        if ends[0] is None or ends[1] is None:
            return None
        above, below = ends
        if part == length:
            for kind in _KINDS:
                sides = _array(above, kind) + _array(below, kind) - 2.0 * _array(solution, kind)
                bend[kind] = float(np.abs(sides).max(initial=0.0)) / length
        differences.append({kind: (_array(above, kind) - _array(below, kind)) / (2 * part) for kind in _KINDS})
    return _extrapolated(differences[:2]), _extrapolated(differences[1:]), bend


def _extrapolated(differences: Sequence[dict[str, Any]]) -> dict[str, Any]:
    coarse, fine = differences
    return {kind: (4.0 * fine[kind] - coarse[kind]) / 3.0 for kind in _KINDS}


def _bends(references: Sequence[tuple[dict[str, Any], ...]], kind: str, values: Any) -> bool:
    """Whether derivatives to both sides differ by more than curvature makes them, which is in proportion to lengths."""
    _, _, longer = references[-2]
    _, fine, bend = references[-1]
    largest = max(float(np.abs(fine[kind]).max(initial=0.0)), _FLOOR * float(np.abs(values).max(initial=0.0)))
    return bool(bend[kind] > max(0.3 * longer[kind], _KINK * largest))


def _array(solution: Any, kind: str) -> Any:
    return np.asarray(getattr(solution, kind), dtype=float)


def _moved(module: Any, steps: int, solution: Any, direction: _Direction, part: float) -> Any:
    """The solution with other data, or None."""
    moved = zip(direction.varied, direction.values, direction.changes, strict=True)
    return _solved(module, steps, given_to({q: v + part * change for q, v, change in moved}), solution.unknowns)


def _solved(module: Any, steps: int, values: dict[str, Any], start: Any) -> Any:
    """What is found near a solution, to the least tolerance that is reached; None where none is."""
    for tolerance in _TOLERANCES:
        found = module.solve(steps, **values, guess=start, warm=True, tolerance=tolerance)
        if found.status == "solved":
            return found
    return None
