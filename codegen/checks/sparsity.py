"""The emitted sparsity pattern, both ways: nothing outside it, nothing in it that is identically zero."""

from __future__ import annotations

from collections.abc import Iterator

from codegen.checks.base import Context, Finding
from codegen.checks.derivatives import control_symbols
from codegen.checks.evaluation import NOTHING, function_of, hessian, random_points
from codegen.discretise import STEP
from codegen.transcribe.program import ControlProgram


def check(context: Context) -> Iterator[Finding]:
    """Compare HESSIAN_ROWS and HESSIAN_COLUMNS with where second differences of l are not zero."""
    program = context.program
    if not isinstance(program, ControlProgram):
        return
    unknowns, parameters = control_symbols(program)
    symbols = [*unknowns, *parameters, program.model.time, STEP]
    scalar = function_of(symbols, [program.element])
    occupied: set[tuple[int, int]] = set()
    for point in random_points([program.element], symbols, program.model.default_values, count=2, seed=7):
        full = hessian(scalar, [point[symbol] for symbol in symbols], range(len(unknowns)))
        least = NOTHING * max(abs(value) for row in full for value in row)
        occupied |= {(r, c) for r, row in enumerate(full) for c, value in enumerate(row) if abs(value) > least}
    emitted = list(zip(map(int, context.module.HESSIAN_ROWS), map(int, context.module.HESSIAN_COLUMNS), strict=True))

    def named(entries: set[tuple[int, int]]) -> str:
        r, c = min(entries)
        more = f" and {len(entries) - 1} more" if len(entries) > 1 else ""
        return f"d2l/d{unknowns[r]} d{unknowns[c]}{more}"

    missing, needless = occupied - set(emitted), set(emitted) - occupied
    repeated = len(emitted) - len(set(emitted))
    total = len(unknowns) * (len(unknowns) + 1) // 2
    outside = f"the {total - len(occupied)} entries outside the pattern vanish"
    yield Finding("sparsity", "interval_hessian", not missing, f"not emitted: {named(missing)}" if missing else outside)
    wrong = f"identically zero: {named(needless)}" if needless else f"{repeated} entries are emitted twice"
    inside = f"none of the {len(emitted)} emitted entries is identically zero"
    yield Finding(
        "sparsity", "interval_hessian", not needless and not repeated, wrong if needless or repeated else inside
    )
