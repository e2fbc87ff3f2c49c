"""What is compiled of a module of each task: calls for its parts, and for what drivers of scipy call."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from codegen.interfaces import few_steps

Calls = list[Callable[[], Any]]


def control_parts(module: Any) -> Calls:
    """Calls for a module that optimises; the linear system comes first, and what needs its parts after it.

    Nothing is called before, not even for a guess: slacks have theirs from an evaluation, which is a part of its own.
    """
    grid = module.make_grid(few_steps(module, 2))
    unknowns = np.ones(grid.is_multiplier.size)
    step, zeros = np.zeros_like(unknowns), np.zeros_like(unknowns)
    calls = [
        lambda: module.solve_kkt(grid, module.allocate_system(grid), zeros, step),  # its factors are zeros
        lambda: module.evaluate(grid, module.initial_guess(grid)),
    ]
    if hasattr(module, "fill_sizes"):
        calls.append(lambda: module.scaled_grid(grid, unknowns))
    if hasattr(module, "linear_residual"):
        calls.append(lambda: module.linear_residual(grid, unknowns, zeros, zeros, step))
    if hasattr(module, "finite_bounds"):
        calls += _barrier_parts(module, grid, unknowns, zeros)
    elif hasattr(module, "slope_of"):  # a linear-quadratic problem has none
        calls.append(lambda: module.slope_of(unknowns, zeros, zeros, grid.is_multiplier))
    if hasattr(module, "tables_beyond"):
        calls.append(lambda: module.tables_beyond(grid, unknowns))
    return [*calls, lambda: module.unpack(grid, unknowns), lambda: module.sizes_of_terms(grid, unknowns)]


def _barrier_parts(module: Any, grid: Any, unknowns: Any, step: Any) -> Calls:
    """Calls of what is called where unknowns have bounds."""
    bounds = module.finite_bounds(*module.variable_bounds(grid))
    distance, gradient = np.ones(bounds[0].size), np.ones_like(unknowns)
    duals, result = np.ones(distance.size), np.empty(distance.size)
    places = bounds.indices, bounds.side, distance
    search, point = module.search_on(grid), module.Point(unknowns, gradient, *[0.0] * 5)
    iterate = module.Iterate(point, 1.0, distance, 0.0, duals)
    taken = module.Step(step, duals, step, 0.0, False, 1.0, 1.0, None)
    barrier = grid.is_multiplier, *places, duals, 1.0
    return [
        lambda: module.measure_optimality(gradient, unknowns, grid.is_multiplier, *places, duals),
        lambda: module.slopes_without_multipliers(
            gradient, grid.is_multiplier, *places[:2], duals, np.empty_like(step), np.empty_like(step)
        ),
        lambda: module.add_barrier(gradient, *barrier, 0.0, 0.0, np.empty_like(step), np.empty_like(step)),
        lambda: module.moved(search, iterate, taken, 0.0),
        lambda: module.approach(unknowns.copy(), *bounds[:1], *bounds[2:], 0.0, 0.0, distance, result),
        lambda: module.push_inside(*module.variable_bounds(grid), unknowns, 0.1),
        lambda: module.prescribed_beyond(grid, unknowns),
        lambda: module.remaining_gap(unknowns, gradient, *module.variable_bounds(grid)),
    ]


def simulate_parts(module: Any) -> Calls:
    """Calls for a module that follows a motion."""
    return kernel_parts(module)


def connect_parts(module: Any) -> Calls:
    """Calls for a module that connects points; where it carries others along, all that a registration calls."""
    return kernel_parts(module)


def kernel_parts(module: Any) -> Calls:
    """Calls that compile one kernel each."""
    return [partial(getattr, kernel, "address") for kernel in module.problem.kernels()]


def small_case(module: Any, steps: int = 2) -> Any:
    """Thirteen particles near the origin that move a little, to have functions compiled by."""
    dimension = module.metadata["coordinates"]
    angles = np.linspace(0.0, 2.0 * np.pi, 13, endpoint=False)
    start = np.stack([0.1 * np.cos((axis + 1) * angles + axis) for axis in range(len(dimension))], axis=1)
    start[:, 0] += 0.01 * np.arange(13)
    return module.make_case(start, start + 0.001, steps)


def control_small(module: Any) -> None:
    """Make one iteration on a few intervals."""
    module.solve(few_steps(module, 2), max_iterations=1)


def simulate_small(module: Any) -> None:
    """Make two steps."""
    module.solve(2)


def connect_small(module: Any) -> None:
    """Connect a few particles."""
    module.solve_case(small_case(module))


def control_touched(module: Any, steps: int) -> None:
    """Call the functions of optimisers at the first guess."""
    program = module.nlp(steps)
    for evaluate in (program.cost, program.gradient, program.constraints, program.jacobian, program.hessian):
        evaluate(program.x0)


def simulate_touched(module: Any, _steps: int) -> None:
    """Make one step."""
    module.solve(steps=1)


def connect_touched(_module: Any, _steps: int) -> None:
    """Nothing: machine code of particles is read when a driver first calls it, in a run that is not timed."""
