"""The emitted sparsity patterns, both ways: nothing outside them, nothing in them that is identically zero."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product

from sympy import Expr, Symbol

from codegen.checks.base import Context, Finding
from codegen.checks.evaluation import NOTHING, Point, curved_beyond, function_of, random_points, second_differences
from codegen.checks.module.kernel_arguments import kernel_stems, other_symbols, pattern_of
from codegen.checks.solution.ranges import near_end, near_interval
from codegen.expressions.zeros import identically_zero
from codegen.transcribe.program import ControlProgram

Pair = tuple[int, int]
_MEASURED = 0.4
"""What stands for everything that belongs to a sample, where all else is as at the guess."""


def check(context: Context) -> Iterator[Finding]:
    """Compare the patterns of the interval and of both ends with where second differences of l are not zero."""
    program = context.control
    elements = [share.element for share in program.interval_elements]
    likely = [point for stem in kernel_stems(program) for point in near_interval(context, program, stem)[:2]]
    if program.sample is not None:
        elements.append(program.sample.element)
        likely = [{**point, **dict.fromkeys(program.sample.symbols, _MEASURED)} for point in likely]
    yield from _compared(context, program, "interval", elements, program.element_symbols, set(), likely)
    for name, end, node in (
        ("start", program.start, program.left_symbols),
        ("end", program.end, program.right_symbols),
    ):
        pinned = {index for index, _ in end.pins}
        likely = near_end(context, program, name)[:2]
        yield from _compared(context, program, name, [end.element], (*node, *program.shared_symbols), pinned, likely)


def _compared(
    context: Context,
    program: ControlProgram,
    name: str,
    scalars: Sequence[Expr],
    unknowns: Sequence[Symbol],
    pinned: set[int],
    likely: Sequence[Point],
) -> Iterator[Finding]:
    """Shares of the Lagrangian that have one pattern; what is pinned counts as a number there."""
    symbols = [*unknowns, *other_symbols(program)]
    symbols += program.sample.symbols if program.sample is not None and name == "interval" else ()
    emitted = pattern_of(context.module, name)
    free = [index for index in range(len(unknowns)) if index not in pinned]
    missing, occupied = set[Pair](), set[Pair]()
    seed = 7
    points = random_points(scalars, symbols, program.model, len(likely) + 1, seed, likely)
    for function, point in product([function_of(symbols, [scalar]) for scalar in scalars], points):
        numbers = [point[symbol] for symbol in symbols]
        values = second_differences(function, numbers, emitted)
        least = NOTHING * max(map(abs, values.values()), default=0)
        occupied |= {pair for pair, value in values.items() if abs(value) > least}
        missing |= curved_beyond(function, numbers, free, emitted)
    if name != "interval" and not emitted and not missing:
        return

    # Where differences are lost in rounding, or flat at all points, only algebra can tell.
    missing = {pair for pair in missing if not _is_zero(scalars, unknowns, pair)}
    needless = {pair for pair in set(emitted) - occupied if _is_zero(scalars, unknowns, pair)}

    def named(entries: set[Pair]) -> str:
        r, c = min(entries)
        more = f" and {len(entries) - 1} more" if len(entries) > 1 else ""
        return f"d2l/d{unknowns[r]} d{unknowns[c]}{more}"

    repeated = len(emitted) - len(set(emitted))
    outside = f"the {len(free) * (len(free) + 1) // 2 - len(set(emitted))} entries outside the pattern vanish"
    kernel = f"{name}_hessian"
    yield Finding("sparsity", kernel, not missing, f"not emitted: {named(missing)}" if missing else outside)
    wrong = f"identically zero: {named(needless)}" if needless else f"{repeated} entries are emitted twice"
    inside = f"none of the {len(emitted)} emitted entries is identically zero"
    yield Finding("sparsity", kernel, not needless and not repeated, wrong if needless or repeated else inside)


def _is_zero(scalars: Sequence[Expr], unknowns: Sequence[Symbol], pair: Pair) -> bool:
    """Whether a second derivative of every share is proved to be zero."""
    row, column = pair
    return all(identically_zero(scalar.diff(unknowns[column]).diff(unknowns[row])) for scalar in scalars)
