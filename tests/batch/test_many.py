"""`codegen.solve_many`: optima of many cases at once, those of `codegen.solve` and of closed forms."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import codegen
from codegen.batch import optima
from codegen.errors import ArgumentError, NumericsError
from codegen.runtime.search import batch

PROBLEMS = Path(__file__).parents[2] / "problems"
KINDS = {
    "orbital_transfer": ({}, "r1", [5.6, 6.0, 6.4]),
    "linear_pendulum": ({}, "end.q", [0.8, 1.0, 1.2]),
    "cart_pole": ({}, "rod", [0.4, 0.5, 0.6]),
    "goddard_rocket": ({"scheme": "rk4"}, "c", [0.49, 0.5, 0.51]),
    "bouncing_ball": ({}, "g", [9.7, 9.8, 9.9]),
    "delayed_oscillator": ({}, "w", [0.09, 0.1, 0.11]),
    "bryson_denham": ({}, "wall", [0.1, 0.11, 0.12]),
}
"""Options of the build, a parameter and its values: equations alone, a linear-quadratic problem, bounds, an explicit
scheme with a free duration, phases, segments of a delay, and cases that are solved by themselves."""


def solver_of(name):
    return codegen.compile(PROBLEMS / f"{name}.py", **KINDS[name][0])


@pytest.mark.parametrize("name", KINDS)
def test_every_case_has_the_optimum_that_solve_finds(name):
    solver = solver_of(name)
    _, parameter, values = KINDS[name]
    found = codegen.solve_many(solver, {parameter: values}, threads=2)
    for i, value in enumerate(values):
        alone = solver.solve(parameters={parameter: value})
        assert (found.status[i], found.iterations[i]) == (alone.status, alone.iterations)
        np.testing.assert_array_equal(
            found.unknowns[i], alone.by_segments.unknowns if alone.by_segments else alone.unknowns
        )
        assert found.cost[i] == pytest.approx(alone.cost, rel=1e-12)
        assert found.residual[i] <= 1e-8
        for array in ("t", "q", "u"):
            np.testing.assert_allclose(getattr(found, array)[i], getattr(alone, array), rtol=0.0, atol=1e-12)


def test_costs_are_those_of_the_closed_form():
    """Bryson and Ho (1975), section 2.3: 12 x^2 / T^3 times N^2 / (N^2 - 1) on N intervals by the midpoint rule."""
    rng, steps = np.random.default_rng(3), 40
    places, times = rng.uniform(0.1, 10.0, 500), rng.uniform(0.5, 3.0, 500)
    found = codegen.solve_many(PROBLEMS / "double_integrator_effort.py", {"x_f": places, "T": times}, steps=steps)
    assert found.solved.all()
    np.testing.assert_allclose(found.cost, 12.0 * places**2 / times**3 * steps**2 / (steps**2 - 1.0), rtol=1e-9)
    np.testing.assert_allclose(found.q[:, -1, 0], places, rtol=1e-12)


def test_derivatives_of_the_cost_are_those_of_the_closed_form():
    places, times = np.array([0.5, 1.0, 2.0]), np.array([1.0, 0.8, 2.0])
    problem = PROBLEMS / "double_integrator_effort.py"
    found = codegen.solve_many(problem, {"x_f": places, "T": times}, steps=40, sensitivities=True)
    np.testing.assert_allclose(found.d_cost["x_f"], 2.0 * found.cost / places, rtol=1e-8)
    np.testing.assert_allclose(found.d_cost["T"], -3.0 * found.cost / times, rtol=1e-8)
    plain = codegen.solve_many(problem, {"x_f": places})
    with pytest.raises(ArgumentError, match="sensitivities"):
        plain.d_cost  # noqa: B018


def test_results_do_not_depend_on_the_number_of_threads():
    solver, radii = solver_of("orbital_transfer"), np.linspace(5.2, 6.8, 97)
    one, *others = (codegen.solve_many(solver, {"r1": radii}, steps=30, threads=threads) for threads in (1, 2, 5))
    for other in others:
        np.testing.assert_array_equal(one.unknowns, other.unknowns)
        np.testing.assert_array_equal(one.cost, other.cost)


def test_cases_that_fail_have_a_status_and_raise_nothing():
    solver = solver_of("cart_pole")
    found = codegen.solve_many(solver, {"duration": [2.0, -1.0, np.nan, 1e-3, 2.0]}, steps=20)
    assert found.status[[0, 1, 2, 4]].tolist() == ["solved", "unusable", "unusable", "solved"]
    assert found.status[3] not in ("solved", "unusable")
    assert np.isnan(found.cost[1:4]).all()
    assert np.isnan(found.q[1:4]).all()
    assert found.cost[0] == found.cost[4]
    assert "duration" in found.message[1]
    with pytest.raises(NumericsError, match="case 1"):
        found[1]
    assert found.counts["solved"] == 2


def test_warm_starts_need_fewer_iterations():
    solver, radii = solver_of("orbital_transfer"), np.linspace(5.5, 6.5, 20)
    first = codegen.solve_many(solver, {"r1": radii})
    near = codegen.solve_many(solver, {"r1": radii + 1e-3}, guess=first, warm=True)
    cold = codegen.solve_many(solver, {"r1": radii + 1e-3})
    assert near.iterations.sum() < cold.iterations.sum()
    np.testing.assert_allclose(near.cost, cold.cost, rtol=1e-9)


def test_an_optimum_that_does_not_hold_when_it_is_evaluated_again_is_not_called_solved(monkeypatch):
    """The search is made to return unknowns that are slightly wrong: each case is then solved by itself."""
    solver, radii, own = solver_of("orbital_transfer"), np.array([5.6, 6.4]), batch.solve_cases
    right = codegen.solve_many(solver, {"r1": radii}, steps=20)

    def wrong(*arguments):
        own(*arguments)
        arguments[-1].unknowns[:, 5] *= 1.0 + 1e-6

    alone, single = list[int](), batch.optimise
    monkeypatch.setattr(optima, "is_ready", lambda: True)
    monkeypatch.setattr(batch, "solve_cases", wrong)
    monkeypatch.setattr(batch, "optimise", lambda *arguments: alone.append(1) or single(*arguments))
    found = codegen.solve_many(solver, {"r1": radii}, steps=20)
    assert len(alone) >= 2
    np.testing.assert_allclose(found.cost, right.cost, rtol=1e-12)


def test_solutions_are_results_and_a_data_set():
    found = codegen.solve_many(PROBLEMS / "orbital_transfer.py", {"r1": [5.6, 6.4], "m": 100.0}, steps=20)
    assert len(found) == 2
    assert found[1].r[-1] == pytest.approx(6.4)
    assert "6.4" in found[1].plot().text
    assert [result.cost for result in found] == pytest.approx(found.cost.tolist())
    data = found.to_dataset()
    assert data["q"].sel(coordinate="r").values[:, -1] == pytest.approx([5.6, 6.4])
    assert dict(data.sizes)["case"] == 2
    assert "2 solved" in repr(found)


REFUSED = {
    "an unknown name": ({"r9": [1.0]}, {}, "r9"),
    "different lengths": ({"r1": [6.0, 6.1], "m": [1.0, 2.0, 3.0]}, {}, "same length"),
    "no cases": ({"r1": []}, {}, "zero"),
    "a table": ({"r1": [[6.0]]}, {}, "shape"),
    "words": ({"r1": ["six"]}, {}, "numbers"),
    "no names": ([6.0], {}, "by name"),
    "a guess of another problem": ({"r1": [6.0]}, {"guess": np.zeros(7)}, "shape"),
    "warm without a guess": ({"r1": [6.0]}, {"warm": True}, "guess"),
    "another driver": ({"r1": [6.0]}, {"driver": "slsqp"}, "driver"),
    "a misspelt option": ({"r1": [6.0]}, {"tolerence": 1e-8}, "tolerance"),
    "no threads": ({"r1": [6.0]}, {"threads": 0}, "positive"),
    "no steps": ({"r1": [6.0]}, {"steps": 0}, "positive"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_unusable_arguments_are_refused_in_one_line(name):
    parameters, options, word = REFUSED[name]
    with pytest.raises((ArgumentError, NumericsError), match=word) as caught:
        codegen.solve_many(PROBLEMS / "orbital_transfer.py", parameters, **options)
    assert "\n" not in str(caught.value)


def test_the_interpreter_finds_the_same_optima_without_machine_code():
    code = "import codegen, sys\nprint(*codegen.solve_many(sys.argv[1], {'x_f': [1.0, 2.0]}, steps=4).cost)"
    words = [sys.executable, "-c", code, str(PROBLEMS / "double_integrator_effort.py")]
    interpreted = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(words, env=interpreted, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert [float(word) for word in done.stdout.split()] == pytest.approx([12.8, 51.2], rel=1e-12)


def test_bounds_do_not_change_by_how_much_a_periodic_state_advances():
    """A state that advances by c in unit time at the least integral of its squared rate costs c^2."""
    (x,), u, c = codegen.states("x"), codegen.control("u"), codegen.parameter("c", 2)
    problem = codegen.Control(
        dynamics={x: u}, cost=u**2, duration=1, periodic={x: c}, bounds={x: (-1.5, 1.5)}, guess={x: c / 2}, steps=10
    )
    solver = codegen.compile(problem)
    assert solver.solve().cost == pytest.approx(4.0, rel=1e-9)
    found = codegen.solve_many(solver, {"c": [1.0, 2.0, 2.5]})
    assert list(found.status) == ["solved"] * 3
    np.testing.assert_allclose(found.cost, [1.0, 4.0, 6.25], rtol=1e-9)
    np.testing.assert_allclose(found.q[:, -1] - found.q[:, 0], [[1.0], [2.0], [2.5]], rtol=1e-12)
