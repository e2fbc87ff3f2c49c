"""The table of tasks: for each task its options and the functions that depend on the task.

Code that depends on the task of a module calls the functions in the row `task_of(module)`. These functions belong to
other files, which are imported on the first call. Hence this file imports nothing slow, and all rooms may use it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from codegen.deferred import Deferred


@dataclass(frozen=True)
class Task:
    """The properties of a task.

    `noun` names problems of the task in messages. `options` are arguments of `codegen.solve` that apply to the task
    with every driver; the table of drivers has the other options. `functions` are required of a module of the task.
    """

    name: str
    noun: str
    options: frozenset[str]
    functions: tuple[str, ...]
    result: Deferred
    """(module, name of the driver, run, attempt) -> Result, from residuals that are evaluated outside the driver."""
    numbers: Deferred
    """(metadata, run) -> number of floating-point numbers that a run stores."""
    touch: Deferred
    """(module, steps): load the machine code that drivers of scipy call."""
    small: Deferred
    """(module): solve on a few intervals, or for a few particles, which loads all machine code."""
    outline: Deferred
    """(module, name of the driver, run, attempt) -> Outline: the part of the result that sweeps store."""


def _task(name: str, noun: str, options: str, functions: str) -> Task:
    """Return the row of a task, whose functions are found by their names."""
    file = "control" if name == "control" else "motions"
    return Task(
        name,
        noun,
        frozenset(options.split()),
        tuple(functions.split()),
        result=Deferred(f"solving.results.{file}", f"{name}_result"),
        numbers=Deferred(f"solving.results.{file}", f"{name}_numbers"),
        touch=Deferred("solving.machine_code.compilation", f"{name}_touched"),
        small=Deferred("solving.machine_code.compilation", f"{name}_small"),
        outline=Deferred(f"solving.results.{file}", f"{name}_outline"),
    )


TASKS = {
    task.name: task
    for task in (
        _task("simulate", "simulations", "every tables", "solve make_grid energy path_residual"),
        _task(
            "control",
            "optimisation",
            "warm doublings accuracy guesses tables observations sensitivities",
            "solve make_grid nlp initial_guess with_pinned_values primal_unknowns multiplier_unknowns evaluate unpack",
        ),
        _task(
            "connect",
            "particles that are connected",
            "points",
            "solve solve_case make_case residual jacobian path_cost path_errors hamiltonian",
        ),
    )
}
"""All tasks by name; tests run over this table."""


def task_of(module: Any) -> Task:
    """Return the task of a loaded module."""
    return TASKS[module.metadata.task]
