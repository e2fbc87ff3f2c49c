"""What is kept of each case where nothing is said: all arrays that fit, and what is said of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray
from command_lines import ORBIT, PENDULUM, run

import codegen
from codegen.batch.layout import FITS, Shapes, layout_of
from codegen.errors import ArgumentError

COLUMNS = {"q": ("x", "y"), "p": ("x", "y"), "u": ("f",), "multipliers": ("x", "y")}
ROWS = {"t": "node", "q": "node", "p": "node", "u": 1, "multipliers": "node"}
SHAPES = Shapes(ROWS, COLUMNS, 1, 0, 1, 100)
EACH = 8 * (101 * (1 + 2 + 2 + 2) + 100)


def test_all_is_kept_as_long_as_it_fits():
    most = FITS // EACH
    every, few = (layout_of((SHAPES,), None, None, cases) for cases in (most, most + 1))
    assert (every.bytes, set(every.dims), every.left_out) == (EACH, set(ROWS), ())
    assert (set(few.dims), few.left_out) == ({"t", "q", "u"}, ("p", "multipliers"))
    assert set(layout_of((SHAPES,), None, tuple(ROWS), most + 1).dims) == set(ROWS)  # as it was asked for


def test_what_modules_have_at_other_places_is_left_out_unless_it_is_asked_for():
    other = replace(SHAPES, rows={**ROWS, "multipliers": 1})
    assert set(layout_of((SHAPES, other), None, None, 10).dims) == {"t", "q", "p", "u"}
    with pytest.raises(ArgumentError, match="--keep multipliers: some of the modules have it elsewhere"):
        layout_of((SHAPES, other), None, ("multipliers",), 10)


def test_arrays_of_a_sweep_are_those_of_a_solve(orbital_transfer, pendulum):
    data = codegen.sweep(ORBIT, {"r1": [5.9, 6.0]}, steps=20, workers=1)
    own = codegen.solve(ORBIT, steps=20)
    for name in ("t", "q", "p", "u", "multipliers"):
        np.testing.assert_allclose(data[name].isel(r1=1), getattr(own, name), rtol=1e-6, atol=1e-9)
    data = codegen.sweep(PENDULUM, {"duration": [1.0, 2.0]}, steps=20, workers=1)
    assert {"t", "q", "p", "energy"} < set(data.data_vars)
    assert np.isfinite(data.energy).all()


def test_the_command_says_what_is_kept_and_what_is_not(folder, orbital_transfer, monkeypatch):
    words = ("sweep", ORBIT, "--vary", "r1=5.9,6", "--steps", 20, "--workers", 1)
    kept = "\nt, q, p, u, multipliers of each, 1.34 kB before compression (--keep)\n"
    assert kept in run(*words, "--out", "a.nc").stdout
    assert " of each" not in run(*words, "--keep", "none", "--out", "b.nc").stdout
    monkeypatch.setattr("codegen.batch.layout.FITS", 2000)
    done = run(*words, "--out", "c.nc")
    assert "t, q, u of each, 0.664 kB before compression; with p, multipliers" in " ".join(done.stdout.split())
    assert set(xarray.open_dataset("c.nc").data_vars) >= {"t", "q", "u"}
    assert not {"p", "multipliers"} & set(xarray.open_dataset("c.nc").data_vars)
