"""The table of tasks: what may be done with a problem, and which functions do what is special to each.

Whoever would ask for a module's task takes its row instead, `task_of(module)`, and calls what stands there. The
functions belong to files of higher floors, which are imported when they are called first: this file imports nothing
slow, and parts of any floor may use it. What tasks have each in its own way is a field of the row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from codegen.deferred import Deferred


@dataclass(frozen=True)
class Task:
    """What is special to a task.

    `noun` is what it is called to solve such a problem. `options` are arguments of `codegen.solve` that mean something
    for this task, whatever the driver; those that depend on the driver stand in the table of drivers. `functions` are
    what a module of the task has at least.
    """

    name: str
    noun: str
    options: frozenset[str]
    functions: tuple[str, ...]
    result: Deferred
    """(module, name of the driver, run, attempt) -> Result: residuals evaluated anew, false claims taken back."""
    numbers: Deferred
    """(metadata, run) -> how many floating-point numbers a run keeps."""
    touch: Deferred
    """(module, steps): have machine code ready of what drivers of scipy call."""
    small: Deferred
    """(module): solve on a few intervals, or for a few particles, so that functions have been called once."""
    outline: Deferred
    """(module, name of the driver, run, attempt) -> Outline: as `result`, without what is told of it beside."""


def _task(name: str, noun: str, options: str, functions: str) -> Task:
    """A row: what the functions are called that parts of the package have for a task."""
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
"""Every task by the name that problem files and modules give it; tests run over this table."""


def task_of(module: Any) -> Task:
    """The task of a loaded module."""
    return TASKS[module.metadata.task]
