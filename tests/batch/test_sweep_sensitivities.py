"""Sensitivities in sweeps: closed forms case by case, differences of costs, refusals as words, tangents as starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import codegen
from codegen.batch.case import Attempt, Start, unknowns_of
from codegen.batch.cases import grid
from codegen.batch.layout import Shapes, layout_of
from codegen.batch.request import CaseRates, Quantity, Tangent
from codegen.batch.store import Frame
from codegen.errors import ArgumentError
from codegen.show.figures.pareto import is_dominated
from codegen.solving.results.result import Outline

ALL = ("t", "q", "u", "multipliers", "d_t", "d_q", "d_u", "d_multipliers")
MISSING = "no sensitivities: "


@pytest.fixture
def swept(interpreted):
    """Sweeps a problem of the gallery with sensitivities, without machine code."""

    def sweep(name: str, vary=None, **options):
        module = interpreted(name, sensitivities=True)
        given = {"steps": 10, "workers": 1, "sensitivities": True, **options}
        with np.errstate(all="ignore"):  # as in compiled code
            return codegen.sweep(module, vary, **given)

    return sweep


def test_least_effort_in_closed_form(swept):
    """The discrete optimum is in proportion to x^2/T^3, and controls to x/T^2."""
    data = swept("double_integrator_effort", {"end.x": [0.5, 1.0, 2.0], "duration": [1.0, 1.5]}, keep=ALL)
    distance, duration = data["end.x"], data["duration"]
    np.testing.assert_allclose(data.d_cost.sel(by="end.x"), 2.0 * data.cost / distance, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(data.d_cost.sel(by="duration"), -3.0 * data.cost / duration, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(data.d_u.sel(by="end.x"), data.u / distance, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(data.d_u.sel(by="duration"), -2.0 * data.u / duration, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        data.d_q.sel(by="end.x", coordinate="x"), data.q.sel(coordinate="x") / distance, rtol=1e-9
    )
    np.testing.assert_allclose(data.d_t.sel(by="duration"), data.t / duration, rtol=1e-12)
    multipliers = data.multipliers / distance
    np.testing.assert_allclose(data.d_multipliers.sel(by="end.x"), multipliers, rtol=1e-9, atol=1e-9)
    assert (data.d_message == "").all()


def test_free_parameters_are_kept_and_have_derivatives(swept):
    """The time of the brachistochrone is in proportion to g^(-1/2)."""
    data = swept("brachistochrone", {"g": [5.0, 9.80665]})
    np.testing.assert_allclose(data["T"], data.cost, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(data.t[:, -1], data["T"], rtol=1e-12)
    for name in ("d_cost", "d_T"):
        np.testing.assert_allclose(data[name].sel(by="g"), -0.5 * data["T"] / data.g, rtol=1e-7)


WEIGHTED = '''"""Two costs with weights."""
from codegen import Control, control, coordinate, parameters
def problem() -> Control:
    (x, dx), u, (a, b) = coordinate("x"), control("u"), parameters(a=1, b=1)
    return Control(lagrangian=dx**2 / 2, force={x: u}, cost=a * u**2 + b * dx**2, duration=1,
                   start={x: 0, dx: 0}, end={x: 1, dx: 0}, steps=10)
'''


def test_derivatives_by_weights_are_the_terms_of_the_cost(interpreted):
    """By the envelope theorem, so that a sweep over weights has a front of two costs."""
    module = interpreted("weighted", WEIGHTED, sensitivities=True)
    with np.errstate(all="ignore"):
        data = codegen.sweep(module, {"b": [0.1, 1.0, 10.0, 100.0]}, workers=1, sensitivities=True)
    effort = 0.1 * (data.u.sel(control="u") ** 2).sum("interval")
    speed = 10.0 * (data.q.sel(coordinate="x").diff("node") ** 2).sum("node")
    np.testing.assert_allclose(data.d_cost.sel(by="a"), effort, rtol=1e-8)
    np.testing.assert_allclose(data.d_cost.sel(by="b"), speed, rtol=1e-8)
    one, other = (data.d_cost.sel(by=name).values for name in "ab")
    assert not is_dominated(one, other).any()


def test_what_varies_follows_nothing(swept):
    """With the radius at the end given, r1 acts on the rest alone: as differences of costs have it."""
    data = swept("orbital_transfer", {"end.r": [6.0], "r1": [5.999, 6.0, 6.001]}, tolerance=1e-12)
    slope = (data.cost[0, 2] - data.cost[0, 0]) / 0.002
    found = data.d_cost.isel({"end.r": 0, "r1": 1})
    np.testing.assert_allclose(found.sel(by="r1"), slope, rtol=1e-4)
    both = swept("orbital_transfer", {"r1": [6.0]}).d_cost[0]
    assert abs(float(both.sel(by="r1")) / float(slope) - 1.0) > 0.1


def test_where_there_are_none_a_word_says_why(swept):
    """With an even number of intervals all controls of the fastest transfer are at bounds: nothing is left free."""
    data = swept("double_integrator", {"end.x": [1.0, 2.0]}, max_iterations=100)
    assert (data.status == "solved").all()
    assert data.d_cost.isnull().all()
    assert set(data.d_message.values) == {f"{MISSING}equations, or active bounds, depend on each other at the solution"}
    failed = swept("orbital_transfer", {"r1": [5.9, 6.0]}, max_iterations=1)
    assert failed.d_cost.isnull().all()
    assert set(failed.d_message.values) == {f"{MISSING}the problem was not solved"}


def test_stores_and_processes_have_the_same(swept, tmp_path):
    axes = {"end.x": [0.5, 1.0, 2.0, 3.0]}
    one = swept("double_integrator_effort", axes, chunk=2, keep=("q", "d_q"))
    two = swept("double_integrator_effort", axes, chunk=2, keep=("q", "d_q"), workers=2, out=tmp_path / "s.zarr")
    for name in ("q", "d_q", "d_cost", "cost", "d_message"):
        np.testing.assert_array_equal(one[name].values, two[name].values, name)
    with pytest.raises(ArgumentError, match="another sweep"):
        swept("double_integrator_effort", axes, keep=("q", "d_q", "d_u"), out=tmp_path / "s.zarr", resume=True)


def test_tangents_find_the_same_as_secants_in_fewer_iterations(swept):
    """Samples have no straight paths, on which a secant could be followed."""
    samples = {"r1": "normal(6, 0.1)", "m": "normal(100, 5)"}
    cold, last, tangent = (
        swept("orbital_transfer", samples=samples, cases=8, steps=8, warm_starts=warm, sensitivities=rates)
        for warm, rates in ((False, False), (True, False), (True, True))
    )
    np.testing.assert_allclose(last.cost, cold.cost, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(tangent.cost, cold.cost, rtol=1e-9, atol=1e-9)
    assert tangent.iterations.sum() < last.iterations.sum() < cold.iterations.sum()


X, Y = Quantity("x", "parameter", "x"), Quantity("y", "parameter", "y")


def attempt(values, path, slopes=None):
    """A solution that follows a path; with its slopes, if there are some."""
    rates = None if slopes is None else CaseRates(tangent=Tangent((X, Y), np.array(values), slopes))
    return Attempt(Outline("solved", "", 0.0, 0.0, {}, path), 4, 1, 0.0, rates)


def test_tangents_are_exact_for_lines_and_with_a_secant_for_parabolas():
    a, b, c = np.random.default_rng(0).normal(size=(3, 5))

    def path(x, y):
        return a + b * (x + 2.0 * y) + c * (x + 2.0 * y) ** 2

    def slopes(x, y):
        return (b + 2.0 * c * (x + 2.0 * y)) * np.array([[1.0], [2.0]])

    last = attempt((1.0, 0.5), path(1.0, 0.5), slopes(1.0, 0.5))
    line = unknowns_of(None, 4, Start(last, is_along_tangent=True), {X: 1.5, Y: 0.0})
    np.testing.assert_allclose(line, path(1.0, 0.5) + (0.5 - 2.0 * 0.5) * (b + 2.0 * c * 2.0), atol=1e-12)
    before = attempt((0.0, 0.0), path(0.0, 0.0))
    parabola = unknowns_of(None, 4, Start(last, before, 0.7, True), {X: 1.7, Y: 0.85})
    np.testing.assert_allclose(parabola, path(1.7, 0.85), atol=1e-12)


def test_a_varied_quantity_without_derivatives_has_secants(swept):
    data = swept("double_integrator_effort", {"steps": [8, 10], "end.x": [1.0, 1.1, 1.2]}, steps=None, warm_starts=True)
    assert (data.status == "solved").all()
    np.testing.assert_allclose(data.d_cost.sel(by="end.x"), 2.0 * data.cost / data["end.x"], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "options", "fragment"),
    [
        ("linear_pendulum", {"sensitivities": False, "keep": ("q", "d_q")}, "give --sensitivities as well"),
        ("linear_pendulum", {"keep": ("q", "d_v")}, "--keep d_v: there is no such array"),
        ("linear_pendulum", {"sensitivities": "yes"}, "give True or False"),
    ],
)
def test_what_is_refused(swept, name, options, fragment):
    with pytest.raises(ArgumentError, match=fragment):
        swept(name, {"duration": [1.0]}, **options)


def test_a_module_without_them_is_refused(interpreted):
    with pytest.raises(ArgumentError, match="build it with --sensitivities"):
        codegen.sweep(interpreted("linear_pendulum"), {"duration": [1.0]}, sensitivities=True)


def test_first_order_spread_is_that_of_samples(swept):
    """Of small deviations the cost is as good as a linear function: squares of slopes times deviations add up."""
    given = {"r1": "normal(6, 0.002)", "m": "normal(100, 0.1)"}
    data = swept("orbital_transfer", samples=given, cases=64, sampling="sobol", steps=6)
    slopes = data.d_cost[0].sel(by=["r1", "m"]).values
    expected = np.sqrt(((slopes * [0.002, 0.1]) ** 2).sum())
    assert float(data.cost.std()) == pytest.approx(expected, rel=0.1)


def test_modules_with_other_quantities_share_a_dimension():
    """An argument of problem() may decide which parameters there are."""
    rows = {"t": "node", "q": "node", "p": "node", "u": 1, "multipliers": "node"}
    columns = {"q": ("x",), "u": ("u",)}
    one, other = (Shapes(rows, columns, 1, 0, 1, 4, by=by) for by in (("m", "k"), ("k", "c")))
    layout = layout_of((one, other), None, ("q", "d_q"), 1)
    assert layout.names["by"] == ("m", "k", "c")
    assert layout.dims["d_q"] == ("by", "node", "coordinate")
    found = layout.placed_rates("d_q", np.arange(10.0).reshape(2, 5, 1), other)
    np.testing.assert_array_equal(found[:, :, 0], [[np.nan] * 5, np.arange(5.0), np.arange(5.0, 10.0)])
    np.testing.assert_array_equal(layout.placed_rates("d_cost", np.array([1.0, 2.0]), one), [1.0, 2.0, np.nan])
    assert layout.words == ("status", "message", "d_message")
    assert layout_of((replace(one, by=()),), None, ("q",), 1).words == ("status", "message")


def test_free_parameters_that_are_called_like_variables_get_an_underscore():
    shapes = Shapes({"t": "node", "q": "node", "p": "node"}, {"q": ("x",)}, 1, 0, 1, 4, ("T", "cost"), ("m",))
    layout = layout_of((shapes,), None, ("q",), 1)
    assert list(layout.numbers)[-2:] == ["T", "cost_"]
    assert {"d_cost", "d_T", "d_cost_"} <= set(layout.dims)
    frame = Frame(grid({"T": [1.0, 2.0], "d_T": [0.0, 1.0]}), layout, {})
    assert frame.case_dims == ("T_", "d_T_")
    assert set(frame.outlined().data_vars) == set(frame.variables)
