"""Rank of all discrete equations, boundary conditions included: none may be redundant or out of reach.

Where the Jacobian of the constraints lacks rank, its left null vectors say which equations of motion depend on each
other, and the boundary conditions that meet them are the ones of which one is too many.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.checks.base import Context, Finding
from codegen.transcribe.program import ControlProgram, EndElement

_INTERVALS = 8
_SINGULAR = 1e-11
_TAKES_PART = 1e-6


def check(context: Context) -> Iterator[Finding]:
    """Decompose the scaled Jacobian at the guess and beside it; the larger rank counts."""
    program = context.program
    if not isinstance(program, ControlProgram):
        return
    module = context.module
    grid = module.make_grid(_INTERVALS)
    guess = module.initial_guess(grid)
    best: tuple[int, NDArray[np.float64], NDArray[np.float64]] | None = None
    generator = np.random.default_rng(11)
    free = np.concatenate([module.primal_unknowns(grid), module.multiplier_unknowns(grid)])
    for amount in (0.0, 0.05):
        unknowns = guess.copy()
        unknowns[free] += amount * generator.uniform(-1, 1, free.size) * (1 + np.abs(unknowns[free]))
        found = _decomposed(module, grid, unknowns)
        if best is None or found[0] < best[0]:
            best = found
    assert best is not None
    lacking, nulls, touched = best
    rows = module.multiplier_unknowns(grid)
    free_count = module.primal_unknowns(grid).size
    if lacking == 0:
        conditions = ", ".join(f"{v.where} {v.quantity}" for v in program.boundary_values)
        detail = f"{rows.size} equations in {free_count} unknowns have full rank (N = {_INTERVALS}): {conditions}"
        yield Finding("boundary rank", "boundary conditions", True, detail)
        return
    for null in range(lacking):
        yield Finding(
            "boundary rank", "boundary conditions", False, _named(program, grid, nulls[:, null], rows, touched[null])
        )


def _decomposed(module: Any, grid: Any, unknowns: Any) -> tuple[int, NDArray[np.float64], NDArray[np.float64]]:
    """How much rank is missing, the left null vectors (columns), and what of every pinned unknown they meet (rows)."""
    rows, columns = module.multiplier_unknowns(grid), module.primal_unknowns(grid)
    matrix = _dense(module.jacobian(grid, unknowns), (rows.size, columns.size))
    row_scale = np.abs(matrix).max(axis=1, initial=0.0)
    row_scale[row_scale == 0.0] = 1.0
    scaled = matrix / row_scale[:, None]
    column_scale = np.abs(scaled).max(axis=0, initial=0.0)
    column_scale[column_scale == 0.0] = 1.0
    left, singular, _ = np.linalg.svd(scaled / column_scale, full_matrices=True)
    rank = int(np.sum(singular > _SINGULAR * singular.max(initial=0.0)))
    nulls = left[:, rank:]
    every = np.flatnonzero(~grid.is_multiplier)
    full = _dense(module.submatrix(grid, unknowns, rows, every, False), (rows.size, every.size))
    share = nulls.T @ (full / row_scale[:, None])
    touched = np.zeros((nulls.shape[1], unknowns.size))
    touched[:, every] = np.abs(share)
    return rows.size - rank, nulls, touched


def _dense(entries: Any, shape: tuple[int, int]) -> NDArray[np.float64]:
    matrix = np.zeros(shape)
    np.add.at(matrix, (entries[0], entries[1]), entries[2])
    return matrix


def _named(program: ControlProgram, grid: Any, null: Any, rows: Any, touched: Any) -> str:
    """Which equations depend on each other, and which boundary conditions take part."""
    stride = len(program.node) + len(program.interval) + len(program.controls)
    names = [*program.node, *program.interval, *program.controls]
    weights = np.zeros(grid.is_multiplier.size)
    weights[rows] = np.abs(null)
    bound = _TAKES_PART * weights.max()
    equations = dict.fromkeys(names[i % stride].meaning for i in np.flatnonzero(weights > bound))
    conditions = _conditions(program, "start", program.start, weights, touched, 0, bound)
    conditions += _conditions(program, "end", program.end, weights, touched, weights.size - len(program.node), bound)
    involved = "; ".join(name.removeprefix("multiplier of ") for name in equations)
    listed = ", ".join(conditions) or "no boundary condition"
    return f"redundant or unreachable: one of {listed} ({involved} depend on each other); leave one of them free"


def _conditions(
    program: ControlProgram, where: str, end: EndElement, weights: Any, touched: Any, first: int, bound: float
) -> list[str]:
    """Prescribed positions (or momenta) whose column a null vector meets, and velocities whose equation it holds."""
    values = {value.symbol: value for value in program.boundary_values}
    found = []
    for place, value in end.pins:
        if value in values and touched[first + place] > bound:
            found.append(f"{where} {values[value].quantity}")
    symbols = program.left_symbols if where == "start" else program.right_symbols
    for place, unknown in enumerate(program.node):
        if not (unknown.multiplier and weights[first + place] > bound):
            continue
        condition = end.element.diff(symbols[place])
        found += [f"{where} {values[s].quantity}" for s in values if s in condition.free_symbols]
    return list(dict.fromkeys(found))
