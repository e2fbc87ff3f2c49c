"""The table of tasks: what may be done with a problem, and which functions do what is special to each.

Whoever would ask for a module's task takes its row instead, `task_of(module)`, and calls what stands there. The
functions belong to files of higher floors, which are imported when they are called first: this file imports nothing
slow, and parts of any floor may use it. What tasks have each in its own way is a field of the row.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Any


@dataclass(frozen=True)
class Home:
    """A function by its file below `codegen` and its name there, called as if it were the function.

    An import by a string: `tests/test_import_graph.py` reads it, and lists the arrows that run back by such.
    """

    file: str
    name: str

    def __call__(self, *positional: Any, **named: Any) -> Any:
        """Import the file where that has not happened, and call the function."""
        return getattr(_imported(self.file), self.name)(*positional, **named)


@cache
def _imported(file: str) -> ModuleType:
    """A file below `codegen`; to ask the import system each time takes longer than some of the functions."""
    return import_module(f"codegen.{file}")


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
    result: Home
    """(module, name of the driver, run, attempt) -> Result: residuals evaluated anew, false claims taken back."""
    numbers: Home
    """(metadata, run) -> how many floating-point numbers a run keeps."""
    touch: Home
    """(module, steps): have machine code ready of what drivers of scipy call."""
    small: Home
    """(module): solve on a few intervals, or for a few particles, so that functions have been called once."""
    outline: Home
    """(module, name of the driver, run, attempt) -> Outline: as `result`, without what is told of it beside."""


def _task(name: str, noun: str, options: str, functions: str) -> Task:
    """A row: what the functions are called that parts of the package have for a task."""
    return Task(
        name,
        noun,
        frozenset(options.split()),
        tuple(functions.split()),
        result=Home(f"solutions.{name}", f"{name}_result"),
        numbers=Home(f"solutions.{name}", "stored_numbers"),
        touch=Home("machine_code.parts", f"{name}_touched"),
        small=Home("machine_code.parts", f"{name}_small"),
        outline=Home(f"solutions.{name}", f"{name}_outline"),
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
