"""The table of tasks: what it refers to exists, and each module has what its row promises."""

import inspect
from dataclasses import fields
from importlib import import_module

import pytest

from codegen.deferred import Deferred
from codegen.problem.particles import Connect
from codegen.problem.problem import Control, Simulate
from codegen.solving.drivers import DRIVERS, TASKS, task_of


def homes(task):
    return {f.name: getattr(task, f.name) for f in fields(task) if isinstance(getattr(task, f.name), Deferred)}


def test_tasks_are_those_that_problems_can_have():
    assert set(TASKS) == {kind.task for kind in (Control, Simulate, Connect)}
    assert all(name == task.name for name, task in TASKS.items())


@pytest.mark.parametrize("name", TASKS)
def test_functions_exist_and_take_what_those_of_other_tasks_take(name):
    def parameters(home):
        found = getattr(import_module(f"codegen.{home.file}"), home.name)
        return [parameter.name.lstrip("_") for parameter in inspect.signature(found).parameters.values()]

    for role, home in homes(TASKS[name]).items():
        assert parameters(home) == parameters(homes(TASKS["control"])[role]), (name, role)


@pytest.mark.parametrize("name", TASKS)
def test_every_task_has_a_driver_of_its_own_and_others(name):
    able = [driver.name for driver in DRIVERS.values() if name in driver.tasks]
    assert able[0] == "newton"
    assert len(able) > 1
    assert all(callable(DRIVERS[driver].function(name)) for driver in able)


@pytest.mark.parametrize(
    ("problem", "name"),
    [
        ("cart_pole", "control"),
        ("pendulum", "simulate"),
        ("lennard_jones", "simulate"),
        ("image_registration", "connect"),
    ],
)
def test_modules_have_what_their_row_says(interpreted, problem, name):
    module = interpreted(problem)
    assert task_of(module) is TASKS[name]
    assert all(callable(getattr(module, function)) for function in task_of(module).functions)
