"""Machine code that a solve needs: kernels, the linear system of the shape, functions of the runtime."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numba import boolean, config, float64, int64, typeof, types

from codegen.runtime.record import Task
from codegen.solving.interfaces import few_steps

REALS, TABLE, CUBE, FOURFOLD = (types.Array(float64, d, "C") for d in (1, 2, 3, 4))
INTEGERS, INDEX_TABLE = (types.Array(int64, d, "C") for d in (1, 2))
MASK, MASKS, READ_MASK = types.Array(boolean, 1, "C"), types.Array(boolean, 2, "C"), types.Array(boolean, 1, "C", True)
INTEGERS_AT = types.CPointer(int64)

Signature = tuple[Any, ...]


@dataclass(frozen=True)
class Part:
    """Machine code that one process makes: the function of Python, the call that compiles it, and what it serves.

    It serves the "problem" alone, or all problems of a "shape", or as a part of the "runtime" all problems.
    """

    function: Any
    make: Callable[[], Any]
    serves: str = "problem"

    @property
    def is_kept(self) -> bool:
        """True if machine code of the function is on the disk."""
        from codegen.runtime.kept_code import is_kept

        return bool(is_kept(self.function))


def has_machine_code(module: Any) -> bool:
    """Return True if all machine code that solutions of a module need is on the disk."""
    return all(part.is_kept for part in parts_of(module))


def parts_of(module: Any) -> list[Part]:
    """Return all parts, in the order in which processes are to take them.

    Nothing if numba is switched off, or if the module has numerics of its own.
    """
    runtime = {
        "codegen.runtime.search.problem": search_functions,
        "codegen.runtime.stepping.problem": step_functions,
        "codegen.runtime.particles.problem": particle_functions,
    }.get(type(module.problem).__module__)
    if config.DISABLE_JIT or runtime is None:  # type: ignore[attr-defined]
        return []
    first, *others = (
        Part(function.py_func, partial(function.compile, signature), "runtime")
        for function, signature in runtime(module.problem)
    )
    kernels = [Part(kernel.function, partial(getattr, kernel, "address")) for kernel in module.problem.kernels()]
    if hasattr(module.problem, "structure"):
        *system_parts, system = linear_system(module.problem.structure.shape)
        return [first, *system_parts, *others, *kernels, system]
    return [first, *kernels, *others]


def linear_system(shape: Any) -> Iterator[Part]:
    """Yield the parts of the linear system of a shape; the last one takes the others in."""
    from codegen.runtime.kkt.specialised import compiled_system, system_module

    system = system_module(shape)
    of_stages: Signature = (types.none, types.none)
    if shape.stages:
        kept = types.Tuple((TABLE, CUBE, TABLE, CUBE, CUBE, CUBE, CUBE, INDEX_TABLE))
        of_stages = (kept, types.Tuple((TABLE, TABLE, TABLE, TABLE, REALS)))
    elimination = (
        INTEGERS_AT, TABLE, REALS, REALS, REALS, REALS, int64, TABLE, TABLE, INTEGERS, CUBE, CUBE, *of_stages, TABLE,
        TABLE, TABLE,
    )  # fmt: skip
    substitution = {
        system.forward: (INTEGERS_AT, TABLE, TABLE, INTEGERS, int64, REALS, REALS, REALS),
        system.backward: (INTEGERS_AT, TABLE, INTEGERS, int64, int64, REALS, REALS, REALS),
        system.condense: (INTEGERS_AT, REALS, CUBE, CUBE, *of_stages, int64, REALS),
        system.recover_condensed: (INTEGERS_AT, REALS, CUBE, CUBE, *of_stages, int64, REALS, REALS),
    }

    def solve() -> None:
        for function, signature in substitution.items():
            function.compile(signature)

    yield Part(system.system, partial(system.eliminate_body.compile, elimination), "shape")
    yield Part(system.system, solve, "shape")
    yield Part(system.system, partial(compiled_system, shape), "shape")


def search_functions(problem: Any) -> Iterator[tuple[Any, Signature]]:
    """Yield the functions of searches that Python calls, and the types that all problems call them with."""
    from codegen.runtime.search import bounds as box
    from codegen.runtime.search import cascade, descent, iterates, linear_system, point, scaling, solve
    from codegen.runtime.search import sensitivities as changes

    grid = (int64, float64, REALS, TABLE)  # steps, h, nodes, parameters
    factors = (int64, REALS, INTEGERS, int64, INTEGERS)  # equations, factors, orders, inverses, counts
    bounds = types.Tuple((INTEGERS, *[REALS] * 5))
    addresses = types.UniTuple(int64, 3)
    on_grid = types.Tuple((*grid, MASK, REALS, REALS, float64, INDEX_TABLE, READ_MASK, INDEX_TABLE))
    yield descent.descend, (
        addresses, on_grid,
        types.Tuple((INTEGERS, REALS, INTEGERS, *[REALS] * 3, int64, INTEGERS, int64, INTEGERS, INTEGERS)),
        bounds, float64, int64, int64, REALS, INTEGERS, *[TABLE] * 5,
    )  # fmt: skip
    yield descent.begin_beside, (addresses, on_grid, bounds, float64, REALS, INTEGERS, TABLE, TABLE)
    quantities = scaling.Quantities(
        **{
            name: np.zeros((1, 2) if name == "tied" else 1, kind)
            for name, kind in zip(scaling.Quantities._fields, QUANTITIES, strict=True)
        }
    )
    yield scaling.fill_scaling_factors, (
        typeof(quantities), int64, int64, *grid, MASK, *[REALS] * 3, INDEX_TABLE, INTEGERS, INTEGERS, INTEGERS, MASKS,
        boolean, REALS, TABLE, REALS,
    )  # fmt: skip
    yield point.measured_gradient, (int64, REALS, REALS, float64, *grid, MASK, REALS, REALS)
    yield linear_system.factor_at, (
        int64, int64, *[REALS] * 4, *grid, INTEGERS, *[REALS] * 3, *factors, REALS, boolean,
    )  # fmt: skip
    yield linear_system.fill_entry_factors, (REALS, REALS, INTEGERS, INTEGERS, MASK, REALS, INTEGERS, TABLE)
    yield linear_system.solve_at, (int64, int64, INTEGERS, REALS, *factors, REALS)
    yield linear_system.multiply_entries, (REALS, INTEGERS, INTEGERS, int64, INTEGERS, REALS, REALS, boolean)
    yield linear_system.call_hessians, (int64, REALS, *grid, INTEGERS, REALS)
    yield point.fill_momenta, (int64, REALS, *grid, INTEGERS, int64, CUBE, CUBE)
    yield solve.correction, (REALS, REALS, MASK, REALS, REALS)
    if problem.variable_bounds is not None:
        yield iterates.finite_bounds, (REALS, REALS)
        yield box.first_beyond, (*[int64] * 4, *[REALS] * 4, float64)
        yield cascade.clip, (
            addresses, on_grid, bounds, types.UniTuple(float64, 5), REALS, REALS, TABLE, REALS, REALS,
        )  # fmt: skip
    if problem.data is not None:
        along = (
            int64, INTEGERS, REALS, INTEGERS, INTEGERS, REALS, INTEGERS, INTEGERS, INTEGERS, INTEGERS, INTEGERS,
        )  # fmt: skip
        yield changes.change_along, (TABLE, CUBE, TABLE, *along, TABLE, REALS)
        yield changes.momenta_along, (REALS, TABLE, REALS, *along, INTEGERS, CUBE)
        yield changes.add_steps, (TABLE, TABLE, REALS, REALS, MASK, TABLE, TABLE)
        yield changes.solve_all, (int64, int64, INTEGERS, TABLE, *factors, TABLE)
        yield changes.largest_residual, (REALS, MASK, TABLE)
        yield changes.multiply, (TABLE, REALS)


QUANTITIES = (
    int, bool, int, bool, float, bool, bool, float, float, bool, bool, int, int, int, int, int, float, int, int,
)  # fmt: skip
"""Types of the entries of `Quantities`."""


def step_functions(problem: Any) -> Iterator[tuple[Any, Signature]]:
    """Yield the functions that make steps of a motion, and the types that all problems call them with."""
    from codegen.runtime import arithmetic
    from codegen.runtime.stepping import steps

    scheme = typeof(steps.Scheme(*[0] * len(steps.Scheme._fields)))
    if problem.all_steps is None:
        yield steps.follow, (
            scheme, REALS, REALS, int64, float64, REALS, float64, int64, int64, TABLE, TABLE,
        )  # fmt: skip
    yield steps.largest_residual, (
        scheme, REALS, TABLE, TABLE, int64, int64, float64, REALS, float64, int64, int64,
    )  # fmt: skip
    yield steps.energies, (int64, TABLE, REALS, REALS, REALS)
    yield arithmetic.factor_matrix, (TABLE, INTEGERS)
    yield arithmetic.solve_factored, (TABLE, INTEGERS, REALS)


def particle_functions(problem: Any) -> Iterator[tuple[Any, Signature]]:
    """Yield the functions that move particles, or connect them, and the types that all problems call them with."""
    from codegen.runtime import arithmetic
    from codegen.runtime.particles import motion, shooting, steps, tracers

    pairs, shape = typeof(steps.Pairs(*[0] * len(steps.Pairs._fields))), types.UniTuple(int64, 3)
    own = (TABLE, REALS)  # parameters of each particle, and of all
    if problem.metadata.task == Task.SIMULATE:
        yield motion.follow_particles, (pairs, CUBE, int64, float64, *own, int64, TABLE, TABLE)
        yield motion.largest_difference, (pairs, TABLE, TABLE, int64, float64, *own, shape)
        yield motion.energies_of, (pairs, TABLE, *own, shape, REALS)
        return
    linear = (pairs, CUBE, FOURFOLD, int64, float64, *own, TABLE)
    yield shooting.broyden_steps, (pairs, float64, *own, TABLE, REALS, TABLE, float64, FOURFOLD, FOURFOLD)
    yield steps.follow, (pairs, float64, *own, FOURFOLD, FOURFOLD, float64)
    yield steps.defects, (pairs, float64, *own, FOURFOLD, FOURFOLD, FOURFOLD)
    yield steps.cost_and_energies, (pairs, float64, *own, FOURFOLD, FOURFOLD, REALS, REALS)
    yield steps.discrete_cost, (pairs, float64, *own, FOURFOLD, REALS)
    yield shooting.tangents, linear
    yield steps.advance_directions, (*linear, TABLE)
    yield shooting.extend_basis, (int64, TABLE, TABLE, TABLE, REALS)
    yield steps.fill_curvature, (int64, FOURFOLD, *own, CUBE)
    yield arithmetic.cholesky, (TABLE,)
    yield arithmetic.solve_cholesky, (TABLE, TABLE)
    yield arithmetic.max_norm, (REALS,)
    if problem.tracer_gradient is not None:
        known = typeof(tracers.Tracers(*[0] * len(tracers.Tracers._fields)))
        yield tracers.carry_points, (
            known, TABLE, float64, float64, float64, FOURFOLD, *own, TABLE, CUBE,
        )  # fmt: skip


def small_case(module: Any, steps: int = 2) -> Any:
    """Thirteen particles near the origin that move a little, to have functions compiled by."""
    dimension = module.metadata.coordinates
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
