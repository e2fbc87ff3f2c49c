"""Tables on the terminal."""

from __future__ import annotations

from dataclasses import replace
from html import escape

import numpy as np
import pytest
from invented_results import BOUNDED, unsolved
from matplotlib.figure import Figure
from rich.console import Console

from codegen.runtime.search.solution import print_log
from codegen.show.figures import quantities
from codegen.show.notebook import html
from codegen.solving import api
from codegen.solving.results.output import as_record, as_table, log_table

NEWTON = (4.5, 1e-9, 2e-3, 0.0, 1.0)
INTERIOR_POINT = (*NEWTON, 0.25)

NAMED = '''"""Push a cart in the least time, with a work that is prescribed."""
from codegen import Control, control, free_parameter, states
def problem():
    x_max, v = states("x_max v")
    u_1 = control("u_1")
    T_1 = free_parameter("T_1", guess=2.5, lower=0.1)
    return Control(
        dynamics={x_max: v, v: u_1}, cost=1, duration=T_1, start={x_max: 0, v: 0}, end={x_max: 1, v: 0}, steps=4,
        integral=[u_1**2 <= 6],
    )
'''
MOVING = '''"""A mass on a spring."""
from codegen import Simulate, coordinate
def problem():
    x_max, v_max = coordinate("x_max")
    return Simulate(lagrangian=v_max**2/2 - x_max**2/2, duration=1, start={x_max: 1, v_max: 0}, steps=4)
'''


@pytest.mark.parametrize(("row", "last"), [(NEWTON, "step"), (INTERIOR_POINT, "barrier")])
def test_log_of_either_solver(interpreted, capsys, row, last):
    """Newton's method logs five numbers for every iterate, the interior point method its barrier's weight as well."""
    module = interpreted("bounded", BOUNDED)
    table = log_table(replace(unsolved(module), log=np.array([row, row])))
    console = Console(width=120)
    with console.capture() as captured:
        console.print(table)
    heading, *_ = (line for line in captured.get().splitlines() if "cost" in line)
    assert heading.split()[-1] == last
    print_log(np.array([row, row]))
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    assert len(lines[-1].split()) == 1 + len(row)


@pytest.mark.parametrize(
    ("problem", "steps"), [("bouncing_ball", "2 x 3 steps"), ("double_integrator_effort", "3 steps")]
)
def test_steps_of_phases(interpreted, problem, steps):
    """Both phases have as many as were asked for."""
    result = api.solve(interpreted(problem), steps=3)
    console, figure = Console(width=120), Figure()
    with console.capture() as captured:
        console.print(as_table(as_record(result, 0.0, 0.0), result))
    quantities.title(figure, result)
    for text in (captured.get(), figure.get_suptitle().replace("\n", " ")):
        assert f"{result.scheme}, {steps}" in text


@pytest.mark.parametrize(
    ("name", "text", "shown"),
    [
        ("named", NAMED, {"T_1", "multiplier of u_1**2 <= 6", "largest control", "final state miss"}),
        ("moving", MOVING, {"final x_max", "final p_x_max", "energy drift", "steps per second"}),
    ],
)
def test_names_of_an_author_are_shown_as_written(interpreted, name, text, shown):
    """On the terminal and in a notebook; other words have blanks between them."""
    result = api.solve(interpreted(name, text))
    console = Console(width=120)
    with console.capture() as captured:
        console.print(as_table(as_record(result, 0.0, 0.0), result))
    lines, page = [line.strip() for line in captured.get().splitlines()], html(result)
    for entry in shown:
        assert any(line.startswith(f"{entry}  ") for line in lines), captured.get()
        assert f">{escape(entry)}<" in page
