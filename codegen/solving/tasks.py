"""The table of tasks, with the options and the functions that differ between tasks.

Code that depends on the task of a module calls the functions in the row `task_of(module)`. These functions are defined
in other files, which are imported on the first call. Hence this file imports nothing slow, and any file may import it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from codegen.deferred import Deferred


@dataclass(frozen=True)
class Task:
    """The properties of a task.

    `noun` names problems of the task in messages. `options` are arguments of `codegen.solve` that apply to the task
    with every driver; the table of drivers has the other options. `functions` are the names of functions that every
    module of the task must have.
    """

    name: str
    noun: str
    options: frozenset[str]
    functions: tuple[str, ...]
    result: Deferred
    """The function (module, name of driver, run, attempt, seconds) -> Result.

    Residuals are evaluated independently of the driver.
    """
    numbers: Deferred
    """The function (metadata, run) -> number of floating-point numbers that a run stores."""
    warm_up: Deferred
    """The function (module, steps) that loads the machine code for drivers of scipy."""
    small: Deferred
    """The function (module) that loads all machine code by solving a small case."""
    outline: Deferred
    """The function (module, name of driver, run, attempt) -> Outline, the part of the result that sweeps store."""


def _task(name: str, noun: str, options: str, functions: str) -> Task:
    """Return the row of a task; `options` and `functions` are names that are separated by blanks."""
    file = "control" if name == "control" else "motions"
    return Task(
        name,
        noun,
        frozenset(options.split()),
        tuple(functions.split()),
        result=Deferred(f"solving.results.{file}", f"{name}_result"),
        numbers=Deferred(f"solving.results.{file}", f"{name}_numbers"),
        warm_up=Deferred("solving.machine_code.compilation", f"{name}_warmed_up"),
        small=Deferred("solving.machine_code.compilation", f"{name}_small"),
        outline=Deferred(f"solving.results.{file}", f"{name}_outline"),
    )


TASKS = {
    task.name: task
    for task in (
        _task("simulate", "simulations", "every tables accuracy", "solve make_grid path_residual step"),
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
    """Return the row of the table of tasks for a loaded module."""
    return TASKS[module.metadata.task]
