"""Sweeps of particles that are connected: the laws of geodesics, the numbers of single solves, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from golden import ROOT

import codegen
from codegen.errors import ArgumentError
from codegen.problem.points import PointSet

REGISTRATION = ROOT / "problems" / "image_registration.py"


@pytest.fixture(scope="module")
def points():
    places = np.random.default_rng(3).uniform(-0.5, 0.5, (5, 2))
    return PointSet(places, places + 0.1 * np.sin(3.0 * places[:, ::-1]), np.zeros(5))


@pytest.fixture(scope="module")
def swept(points):
    return codegen.sweep(REGISTRATION, {"steps": [4, 8, 16], "duration": [1.0, 2.0]}, points=points, keep=("q", "p"))


def test_the_cost_of_a_geodesic_falls_with_the_time_it_has(swept):
    assert (swept.status == "solved").all()
    np.testing.assert_allclose(swept.cost.sel(duration=1.0), 2.0 * swept.cost.sel(duration=2.0), rtol=1e-9)
    np.testing.assert_allclose(swept.p.sel(duration=1.0), 2.0 * swept.p.sel(duration=2.0), rtol=1e-7, atol=1e-9)


def test_the_cost_is_of_the_order_of_the_scheme(swept):
    coarse, middle, fine = swept.cost.sel(duration=1.0).values
    assert np.log2((coarse - middle) / (middle - fine)) == pytest.approx(2.0, abs=0.1)


def test_each_case_has_the_numbers_of_a_solve(swept, points):
    alone = codegen.solve(REGISTRATION, steps=8, points=points)
    row = swept.sel(steps=8, duration=1.0)
    assert list(row.coordinate.values[:3]) == ["x_1", "y_1", "x_2"]
    np.testing.assert_array_equal(row.q.values[:9], alone.q)
    assert np.isnan(row.q.values[9:]).all()
    assert float(row.cost) == alone.cost


def test_two_processes_have_the_bits_of_one(swept, points):
    varied = {"steps": [4, 8, 16], "duration": [1.0, 2.0]}
    other = codegen.sweep(REGISTRATION, varied, points=points, keep=("q", "p"), workers=2, chunk=1)
    for name in ("q", "p", "cost"):
        np.testing.assert_array_equal(swept[name], other[name])


def test_a_store_of_other_points_is_refused(tmp_path, points):
    out, varied = tmp_path / "s.zarr", {"duration": [1.0, 2.0]}
    codegen.sweep(REGISTRATION, varied, points=points, out=out)
    codegen.sweep(REGISTRATION, varied, points=points, out=out, resume=True)
    moved = replace(points, target=points.target + 0.01)
    with pytest.raises(ArgumentError, match="another sweep"):
        codegen.sweep(REGISTRATION, varied, points=moved, out=out, resume=True)


def test_without_points_those_of_the_problem_are_connected():
    found = codegen.sweep(REGISTRATION, {"duration": [1.0]})
    assert found.sizes["coordinate"] == 80
    assert (found.status == "solved").all()


@pytest.mark.parametrize("name", ["start.x", "sigma", "tolerance"])
def test_what_a_registration_has_not_cannot_vary(points, name):
    with pytest.raises(ArgumentError, match="nothing that can be varied"):
        codegen.sweep(REGISTRATION, {name: [0.1, 0.2]}, points=points)
