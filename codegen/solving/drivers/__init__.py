"""The tasks of modules, and the registry of drivers: methods that solve the problem of a generated module.

Code that depends on the task of a module calls the functions in the row `task_of(module)`. `newton` is the generated
solver. The other drivers call scipy or IPOPT with the functions of the module, for comparison. Functions of tasks and
drivers are imported on the first call: this file imports neither numpy nor numba nor scipy, and any file may import it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from codegen.deferred import Deferred
from codegen.errors import ArgumentError, nearest


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


@dataclass(frozen=True)
class Driver:
    """A driver, with the tasks that it can solve.

    `options` maps each task to the options of a request that apply to the driver. The `file` of a driver has a function
    for each task, with the name of the task. `generated` is True for the solver in the generated module.
    """

    name: str
    file: str
    summary: str
    options: Mapping[str, tuple[str, ...]]
    generated: bool = False

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks that the driver can solve."""
        return tuple(self.options)

    def takes(self, task: str, option: str) -> bool:
        """Return True if the driver accepts an option for a task."""
        return option in self.options.get(task, ())

    def function(self, task: str) -> Callable[..., Any]:
        """Import the driver, and return its function (module, run) -> attempt for a task."""
        return getattr(import_module(f"codegen.solving.drivers.{self.file}"), task)  # type: ignore[no-any-return]


_ROWS = (
    Driver(
        "newton", "newton", "the generated solver",
        {
            "control": ("tolerance", "max_iterations", "time_limit", "scaling", "log", "watch"),
            "simulate": ("max_iterations",),
            "connect": ("tolerance",),
        },
        generated=True,
    ),
    Driver(
        "slsqp", "slsqp", "scipy's sequential least-squares programming, dense",
        {"control": ("max_iterations",), "connect": ()},
    ),
    Driver(
        "trust-constr", "trust_constr", "scipy's trust-region SQP, sparse with exact Hessians",
        {"control": ("max_iterations",), "connect": ()},
    ),
    Driver(
        "ipopt", "ipopt", "IPOPT, an interior point method; needs cyipopt (extra: ipopt)",
        {"control": ("tolerance", "max_iterations", "time_limit")},
    ),
    Driver("fsolve", "fsolve", "MINPACK's hybrid Powell method, dense", {"control": (), "simulate": (), "connect": ()}),
    Driver("fmin", "fmin", "Nelder and Mead's simplex method, for a few particles", {"connect": ()}),
)  # fmt: skip

DRIVERS: dict[str, Driver] = {driver.name: driver for driver in _ROWS}
"""All drivers by name; tests run over this table."""


def find(name: str, task: str | None = None) -> Driver:
    """Return the driver with a name; raise ArgumentError if the driver does not exist or does not apply to the task."""
    if not isinstance(name, str) or name not in DRIVERS:
        raise ArgumentError(f"there is no driver {name!r}", nearest(name, DRIVERS, f"use one of {', '.join(DRIVERS)}"))
    driver = DRIVERS[name]
    if task is not None and task not in driver.tasks:
        names = [other.name for other in DRIVERS.values() if task in other.tasks]
        raise ArgumentError(f"driver {name} does not apply to a {task} problem", f"use one of {', '.join(names)}")
    return driver
