"""Tables on the terminal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from invented_results import BOUNDED, unsolved
from matplotlib.figure import Figure
from rich.console import Console

from codegen import solving
from codegen.plots import style
from codegen.solutions.output import as_record, as_table, log_table

NEWTON = (4.5, 1e-9, 2e-3, 0.0, 1.0)
INTERIOR_POINT = (*NEWTON, 0.25)


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
    module.print_log([row, row])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    assert len(lines[-1].split()) == 1 + len(row)


@pytest.mark.parametrize(
    ("problem", "steps"), [("bouncing_ball", "2 x 3 steps"), ("double_integrator_effort", "3 steps")]
)
def test_steps_of_phases(interpreted, problem, steps):
    """Both phases have as many as were asked for."""
    result = solving.solve(interpreted(problem), steps=3)
    console, figure = Console(width=120), Figure()
    with console.capture() as captured:
        console.print(as_table(as_record(result, 0.0, 0.0), result.intervals))
    style.title(figure, result)
    for text in (captured.get(), figure.get_suptitle().replace("\n", " ")):
        assert f"{result.scheme}, {steps}" in text
