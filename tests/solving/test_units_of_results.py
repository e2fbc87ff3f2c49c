"""Units of a solution: in its tables, its data set, its frame, and of several bodies by each name."""

from __future__ import annotations

import pickle
from dataclasses import replace

import pytest
from made_records import control_record

from codegen.solving import api
from codegen.solving.results.output import as_record, as_table
from codegen.solving.results.result import component_units

SPRING = '''"""Let a mass on a spring swing."""
from codegen import Simulate, coordinate, parameters
def problem():
    x, v = coordinate("x", unit="m")
    m, k = parameters(m=(2, "kg"), k=(3, "N/m"))
    return Simulate(lagrangian=m * v**2 / 2 - k * x**2 / 2, start={x: 1, v: 0}, duration=2, steps=20)
'''


@pytest.fixture(scope="module")
def solution(interpreted):
    return api.solve(interpreted("spring", SPRING))


def test_those_that_follow_are_there_as_well(solution):
    wanted = {"x": "m", "dx": "m/s", "m": "kg", "k": "N/m", "t": "s", "p_x": "kg·m/s", "energy": "J"}
    assert solution.units == wanted
    assert pickle.loads(pickle.dumps(solution)).units == wanted


def test_in_a_data_set_and_a_frame(solution):
    data = solution.to_dataset()
    assert (data.t.attrs["units"], data.energy.attrs["units"]) == ("s", "J")
    assert data.q.sel(coordinate="x").coordinate_unit == "m"
    assert data.p.sel(momentum="p_x").momentum_unit == "kg·m/s"
    assert solution.to_frame().attrs["units"] == {"t": "s", "x": "m", "p_x": "kg·m/s", "energy": "J"}


def test_in_tables(solution):
    table = as_table(as_record(solution, 0.0, 0.0), solution)
    rows = dict(zip(*(column._cells for column in table.columns), strict=True))
    assert rows["duration"] == "2 s"
    assert rows["final x"].endswith(" m")
    assert rows["energy drift"].endswith(" J")
    assert " m</td>" in solution._repr_html_()


def test_of_several_bodies():
    metadata = control_record(coordinates=("x",), rates=("dx",), control_names=("u",), bodies=2)
    found = component_units(replace(metadata, units={"x": "m", "u": "N", "t": "s"}))
    assert found == {"x": "m", "u": "N", "t": "s", "x_0": "m", "x_1": "m", "u_0": "N", "u_1": "N"}
    assert component_units(metadata) == {}
