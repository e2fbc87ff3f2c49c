"""A planted jump between local optima: past a hill on its one side or the other."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import xarray
from command_lines import run
from compiled_modules import compiled

import codegen
from codegen.batch.store import Store
from codegen.runtime.search import point

HILL = '''"""Past a hill, on its one side or the other."""

from sympy import exp, pi, sin, tanh

from codegen import Control, controls, coordinates, parameter, time


def problem() -> Control:
    (x, y), (dx, dy) = coordinates("x y")
    (u, v), t, c = controls("u v"), time(), parameter("c", 0.1)
    return Control(
        lagrangian=(dx**2 + dy**2) / 2,
        force={x: u, y: v},
        cost=u**2 + v**2 + 60 * exp(-12 * (x**2 + (y - c) ** 2)),
        duration=2,
        start={x: -1, y: 0, dx: 1, dy: 0},
        end={x: 1, y: 0, dx: 1, dy: 0},
        guess={y: -0.6 * sin(pi * t / 2) * tanh(40 * (c - 0.22))},
        steps=20,
    )
'''
C = np.linspace(-1.0, 1.0, 41)


@pytest.fixture
def hill(folder):
    """The problem, whose guess is on the wrong side of the hill for 0 < c < 0.22."""
    (folder / "hill.py").write_text(HILL)
    return "hill.py"


def test_a_planted_jump_is_found_and_mended(hill):
    """The optimum is even in c, as the problem is but for its guess."""
    module = compiled(codegen.build(hill).path)
    alone = module.solve(20, c=0.1)
    assert alone.status == "solved"
    data = codegen.sweep(hill, {"c": C}, steps=20, workers=1)
    assert (data.status == "solved").all()
    np.testing.assert_allclose(data.cost, data.cost[::-1], rtol=1e-8)
    case = data.sel(c=0.1, method="nearest")
    assert case.improvement > 5.0
    np.testing.assert_allclose(
        case.cost + case.improvement, point.cost(module.make_grid(20, c=0.1), alone.unknowns), rtol=1e-9
    )
    np.testing.assert_array_equal(np.flatnonzero(data.improvement > 0.0), [21, 22, 23])  # from 0.05 to 0.15
    assert (data.jump == 0).all()
    # Where nothing is suspected nothing is tried.
    np.testing.assert_array_equal(data.iterations[:20], codegen.sweep(hill, {"c": C[:20]}, workers=1).iterations)


@pytest.mark.parametrize("c", [np.linspace(0.1, 0.9, 5), np.linspace(0.9, 0.1, 5), np.linspace(0.05, 0.8, 6)])
def test_a_case_at_the_end_of_a_line_is_mended(hill, c):
    """Only the case at the end is on the wrong side of the hill; on the other side of zero none is."""
    data, mirrored = (codegen.sweep(hill, {"c": side * c}, workers=1, keep=()) for side in (1.0, -1.0))
    assert (mirrored.improvement == 0.0).all()
    np.testing.assert_allclose(data.cost, mirrored.cost, rtol=1e-8)
    np.testing.assert_array_equal(np.flatnonzero(data.improvement > 2.0), np.flatnonzero(c < 0.2))
    assert (data.jump == 0).all()


def test_a_jump_between_chunks_is_left_and_told(hill):
    words = ("sweep", hill, "--vary", "c=-1:1:41", "--chunk", 23, "--workers", 1, "--out", "s.zarr")
    done = run(*words, "--plot", "s.png")
    assert done.exit_code == 0
    assert Path("s.png").stat().st_size > 1000
    assert "1 case was improved" in done.stderr
    assert "1 jump of the cost remains" in done.stderr
    assert "a larger --chunk" in done.stderr
    data = xarray.open_zarr("s.zarr", chunks=None)
    np.testing.assert_array_equal(np.flatnonzero(data.jump == 1), [22])
    again = run(*words, "--resume", "--json")
    assert json.loads(again.stdout)["jumps"] == 1


def mirrored(hill, cases):
    """The costs of cases on the other side of zero, where none is on the wrong side of the hill."""
    return codegen.sweep(hill, cases={**cases, "c": -np.abs(cases["c"])}, workers=1, keep=()).cost.values


def test_a_planted_jump_is_found_in_a_table_in_any_order(hill):
    c = np.random.default_rng(1).permutation(C)
    data = codegen.sweep(hill, cases={"c": c}, workers=1, keep=())
    np.testing.assert_allclose(data.cost, mirrored(hill, {"c": c}), rtol=1e-8)
    np.testing.assert_allclose(np.sort(c[data.improvement.values > 0.0]), [0.05, 0.1, 0.15])
    assert (data.jump == 0).all()
    # Where nothing is suspected nothing is tried.
    smooth = {"c": c[c <= 0.0]}
    apart = codegen.sweep(hill, cases=smooth, chunk=1, workers=1)  # each by itself
    np.testing.assert_array_equal(codegen.sweep(hill, cases=smooth, workers=1).iterations, apart.iterations)


def test_a_planted_jump_is_found_among_samples_of_two_quantities(hill):
    given = {"c": "uniform(-1, 1)", "end.dx": "uniform(0.8, 1.2)"}
    data = codegen.sweep(hill, samples=given, cases=300, sampling="latin", workers=1, chunk=300, keep=("q",))
    c = data.c.values
    right = mirrored(hill, {name: data[name].values for name in given})
    wrong = np.abs(data.cost.values / right - 1.0) > 1e-7
    before = (c > 0.0) & (c < 0.22)
    assert before.sum() == 33
    assert wrong.sum() <= 3
    assert not wrong[~before].any()
    won = data.improvement.values > 0.0
    np.testing.assert_array_equal(won, before & ~wrong & (data.cost + data.improvement > right * (1.0 + 1e-7)))
    # The motion is that of the better solution.
    assert (data.q.sel(coordinate="y").values[won, 10] < 0.0).all()


def test_jumps_among_samples_are_the_same_by_any_executor_and_after_any_end(hill, monkeypatch):
    words = ("sweep", hill, "--sample", "c=uniform(-1, 1)", "--cases", 120, "--sampling", "latin", "--chunk", 40)
    assert run(*words, "--workers", 1, "--out", "one.zarr").exit_code == 0
    assert run(*words, "--workers", 2, "--out", "two.zarr").exit_code == 0
    with monkeypatch.context() as patched:
        patched.setattr(Store, "write", _interrupted(Store.write))
        assert run(*words, "--workers", 1, "--out", "resumed.zarr").exit_code != 0
    done = run(*words, "--workers", 1, "--out", "resumed.zarr", "--resume", "--json")
    one, *others = (xarray.open_zarr(f"{name}.zarr", chunks=None) for name in ("one", "two", "resumed"))
    assert json.loads(done.stdout)["improved"] == int((one.improvement > 0.0).sum()) >= 9
    for other in others:
        for name in set(one.data_vars) - {"seconds"}:
            np.testing.assert_array_equal(one[name].values, other[name].values)


def _interrupted(write):
    written = []

    def until_the_second(store, region, rows):
        written.append(region)
        if len(written) == 2:
            raise KeyboardInterrupt
        write(store, region, rows)

    return until_the_second
