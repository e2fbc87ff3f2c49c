"""Sizes and patterns of the module against the derivation, and every kernel run once inside arrays of those sizes.

Compiled code does not check bounds, so a module whose layout does not fit must not be run at all. Here the kernels are
interpreted, which finds what lies outside an array, and arrays start out as NaN, which finds what is never written.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from codegen.checks.base import Context, Finding
from codegen.checks.evaluation import random_points
from codegen.discretise import STEP
from codegen.transcribe.program import ControlProgram, StepProgram


def check(context: Context) -> Iterator[Finding]:
    """Compare names and sizes, then run every kernel."""
    if isinstance(context.program, ControlProgram):
        problem = _control_difference(context.module, context.program) or _control_run(context.module, context.program)
    else:
        problem = _step_difference(context.module, context.program) or _step_run(context.module, context.program)
    yield Finding("layout", "sizes and patterns", not problem, problem or "every kernel fills its arrays, and no more")


def _control_difference(module: Any, program: ControlProgram) -> str:
    """How tables of the module contradict the program; empty when they do not."""
    recorded = module.metadata
    names = {
        "node": tuple(u.name for u in program.node),
        "interval": tuple(u.name for u in (*program.interval, *program.controls)),
        "boundary": tuple(f"{v.where} {v.quantity}" for v in program.boundary_values),
        "parameters": tuple(p.name for p in program.model.parameters),
    }
    for key, wanted in names.items():
        if tuple(recorded.get(key, ())) != wanted:
            return f"{key} is {tuple(recorded.get(key, ()))}, expected {wanted}"
    node, stride = len(program.node), len(program.node) + len(program.interval) + len(program.controls)
    sizes = {"NODE": node, "STRIDE": stride, "ELEMENT": stride + node}
    for name, size in sizes.items():
        if getattr(module, name) != size:
            return f"{name} is {getattr(module, name)}, expected {size}"
    if module.CONTROLS not in (0, len(program.controls)):
        return f"CONTROLS is {module.CONTROLS}, expected 0 or {len(program.controls)}"
    if tuple(module.ONLY_AT_ENDS) != program.only_at_ends:
        return f"ONLY_AT_ENDS is {module.ONLY_AT_ENDS}, expected {program.only_at_ends}"
    multipliers = [u.multiplier for u in (*program.node, *program.interval, *program.controls)]
    if list(module.IS_MULTIPLIER) != multipliers:
        return f"IS_MULTIPLIER is {list(module.IS_MULTIPLIER)}, expected {multipliers}"
    for end, element in (("START", program.start), ("END", program.end)):
        pinned = sorted(place for place, _ in element.pins)
        if list(getattr(module, f"{end}_PINNED")) != pinned:
            return f"{end}_PINNED is {getattr(module, f'{end}_PINNED')}, expected {tuple(pinned)}"
    for prefix, size in (("", stride + node), ("START_", node), ("END_", node)):
        rows, columns = (_indices(module, f"{prefix}HESSIAN_{side}") for side in ("ROWS", "COLUMNS"))
        if rows.size != columns.size or np.any(columns > rows) or np.any(columns < 0) or np.any(rows >= size):
            return f"{prefix}HESSIAN_ROWS and {prefix}HESSIAN_COLUMNS are no lower triangle of a matrix of size {size}"
    return ""


def _indices(module: Any, name: str) -> Any:
    return np.asarray(getattr(module, name, ()), dtype=np.int64)


def _control_run(module: Any, program: ControlProgram) -> str:
    unknowns = [*program.left_symbols, *program.interval_symbols, *program.control_symbols, *program.right_symbols]
    parameters = [*program.model.parameters, *(value.symbol for value in program.boundary_values)]
    symbols = [*unknowns, *parameters, program.model.time, STEP]
    values = [program.element, program.cost, program.start.element, program.end.element]
    (point,) = random_points(values, symbols, program.model.default_values, count=1)
    x, given = (np.array([point[symbol] for symbol in group]) for group in (unknowns, parameters))
    t, h, size = point[program.model.time], point[STEP], len(unknowns)
    entries = _indices(module, "HESSIAN_ROWS").size
    problem = _run(module, "interval_gradient", (x, t, h, given), gradient=(size,))
    problem = problem or _run(module, "interval_hessian", (x, t, h, given), hessian=(entries,))
    node = len(program.node)
    for end, local in (("start", x[:node]), ("end", x[size - node :])):
        problem = problem or _run(module, f"{end}_gradient", (local, t, given), adds=True, gradient=(node,))
        if hasattr(module, f"{end}_hessian"):
            entries = _indices(module, f"{end.upper()}_HESSIAN_ROWS").size
            problem = problem or _run(module, f"{end}_hessian", (local, t, given), hessian=(entries,))
    return problem


def _step_difference(module: Any, program: StepProgram) -> str:
    """How names or sizes of the module contradict the program; empty when they do not."""
    recorded = module.metadata
    names = {
        "node": tuple(u.name for u in program.state),
        "stages": tuple(s.name for s in program.stage_symbols),
        "unknowns": tuple(s.name for s in program.unknowns),
        "parameters": tuple(p.name for p in program.model.parameters),
    }
    for key, wanted in names.items():
        if tuple(recorded.get(key, ())) != wanted:
            return f"{key} is {tuple(recorded.get(key, ()))}, expected {wanted}"
    sizes = {"STATE": len(program.state), "STAGES": len(program.stage_symbols), "UNKNOWNS": len(program.unknowns)}
    for name, size in sizes.items():
        if getattr(module, name, 0) != size:
            return f"{name} is {getattr(module, name, 0)}, expected {size}"
    return ""


def _step_run(module: Any, program: StepProgram) -> str:
    interval = [*program.stage_symbols, *program.right_symbols]
    symbols = [*program.left_symbols, *interval, *program.model.parameters, program.model.time, STEP]
    symbols = list(dict.fromkeys([*symbols, *program.unknowns]))
    expressions = [*(value for _, value in program.equations), program.energy]
    (point,) = random_points(expressions, symbols, program.model.default_values, count=1)

    def at(group: Any) -> Any:
        return np.array([point[symbol] for symbol in group])

    base = (at(program.left_symbols), point[program.model.time], point[STEP], at(program.model.parameters))
    size, whole = len(program.unknowns), len(interval)
    problem = _run(module, "step_equations", (base[0], at(interval), *base[1:]), residual=(whole,))
    problem = problem or _run(module, "energy", (base[0], base[1], base[3]))
    if not size:
        return problem or _run(module, "explicit_step", base, interval=(whole,))
    y = at(program.unknowns)
    problem = problem or _run(module, "predict_step", base, unknowns=(size,))
    problem = problem or _run(module, "step_residual", (y, *base), residual=(size,))
    problem = problem or _run(module, "step_jacobian", (y, *base), residual=(size,), jacobian=(size, size))
    return problem or _run(module, "complete_step", (y, *base), interval=(whole,))


def _run(module: Any, name: str, inputs: Any, adds: bool = False, **outputs: tuple[int, ...]) -> str:
    """Interpret a kernel with outputs of the given shapes; what goes wrong, in words."""
    kernel = getattr(module, name, None)
    if kernel is None:
        return f"kernel {name} is missing"
    arrays = {key: np.full(shape, 0.0 if adds else np.nan) for key, shape in outputs.items()}
    try:
        getattr(kernel, "py_func", kernel)(*inputs, **arrays)
    except Exception as error:  # a damaged kernel may fail in any way
        return " ".join(f"kernel {name} fails ({type(error).__name__}: {error})".split())
    for key, array in arrays.items():
        if np.isnan(array).any():
            return f"kernel {name} leaves {key}{np.argwhere(np.isnan(array))[0].tolist()} without a value"
    return ""
