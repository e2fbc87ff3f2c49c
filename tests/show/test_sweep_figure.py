"""Figures of sweeps, by what is drawn: lines, maps, contours, marks of failures and jumps, quantiles of samples."""

from __future__ import annotations

import numpy as np
import pytest
import xarray
from matplotlib.collections import PolyCollection, QuadMesh
from matplotlib.contour import ContourSet

from codegen.show.figures import save_sweep, sweep
from codegen.show.figures.sweep import sweep_figure

ATTRIBUTES = {"title": "A test.", "formulation": "variational", "scheme": "midpoint", "steps": 4}


def made(axes, failed=(), jumps=(), cost=None, dims=None):
    """A data set over some axes, whose cost is the sum of the squares of what varies."""
    dims = tuple(axes) if dims is None else dims
    grids = np.meshgrid(*axes.values(), indexing="ij") if dims != ("case",) else list(axes.values())
    shape = grids[0].shape
    values = sum(grid**2 for grid in grids) if cost is None else cost
    status = np.full(shape, "solved", object)
    jump = np.zeros(shape, np.int32)
    for place in failed:
        status[place], values[place] = "infeasible", np.nan
    for place in jumps:
        jump[place] = 1
    t = np.broadcast_to(np.linspace(0.0, 1.0, 5), (*shape, 5))
    q = (grids[0][..., None] * t)[..., None]
    u = np.broadcast_to(grids[0][..., None, None], (*shape, 4, 1))
    variables = {
        "status": (dims, status.astype(str)), "cost": (dims, values), "jump": (dims, jump),
        "t": ((*dims, "node"), t), "q": ((*dims, "node", "coordinate"), q), "u": ((*dims, "interval", "control"), u),
    }  # fmt: skip
    named = {name: (dims if dims == ("case",) else (name,), values) for name, values in axes.items()}
    return xarray.Dataset(variables, {**named, "coordinate": ["r"], "control": ["u"]}, ATTRIBUTES)


def marks(axes, name):
    """Where marks of a kind are."""
    return [line.get_xydata() for line in axes.lines if line.get_label() == name]


X, Y = np.linspace(-1.0, 1.0, 11), np.linspace(0.0, 2.0, 9)


def test_a_line_over_one_quantity_with_failures_and_jumps_marked():
    figure = sweep_figure(made({"m": X}, failed=[3], jumps=[7]))
    axes = figure.axes[0]
    np.testing.assert_allclose(axes.lines[0].get_xydata(), np.c_[X, np.where(np.arange(11) == 3, np.nan, X**2)])
    (failed,), (jumps,) = marks(axes, "failed"), marks(axes, "jump")
    np.testing.assert_allclose(failed[:, 0], X[[3]])
    np.testing.assert_allclose(jumps, [[X[7], X[7] ** 2]])
    assert "11 cases, 1 FAILED" in figure.get_suptitle()
    curves = figure.axes[1]
    assert len(curves.lines) == 10  # a trajectory of each case that is solved
    np.testing.assert_allclose(curves.lines[0].get_ydata()[-1], X[0])


def test_units_of_a_sweep_stand_on_its_axes():
    data = made({"m": X, "start.r": Y})
    data.attrs["units"] = '{"m": "kg", "r": "m"}'
    axes = sweep_figure(data).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("$m$ (kg)", "$r$ at the start (m)")


UNITS = '{"m": "kg", "r": "m", "u": "N", "t": "s", "cost": "J"}'


def test_trajectories_and_the_cost_of_a_sweep_have_units():
    data = made({"m": X})
    data.attrs["units"] = UNITS
    cost, *curves, _ = sweep_figure(data).axes
    assert (cost.get_xlabel(), cost.get_ylabel()) == ("$m$ (kg)", "cost (J)")
    assert [axes.get_xlabel() for axes in curves] == ["time (s)", "time (s)"]
    assert [axes.get_ylabel() for axes in curves] == ["$r$ (m)", "$u$ (N)"]


def test_lines_and_samples_of_a_sweep_have_units():
    data = made({"m": X, "k": Y[:2]})
    data.attrs["units"] = UNITS.replace('"r"', '"k": "N/m", "r"')
    assert [text.get_text() for text in sweep_figure(data).axes[0].get_legend().get_texts()][:2] == [
        "$k$ = 0 N/m", "$k$ = 0.25 N/m",
    ]  # fmt: skip
    samples = made({"m": X}, dims=("case",))
    samples.attrs["units"] = UNITS
    labels = [(axes.get_xlabel(), axes.get_ylabel()) for axes in sweep_figure(samples).axes]
    assert labels == [
        ("cost (J)", "cases"), ("$m$ (kg)", "cost (J)"), ("time (s)", "$r$ (m)"), ("time (s)", "$u$ (N)"),
    ]  # fmt: skip


def test_final_states_of_a_sweep_have_units():
    data = made({"m": X}, cost=np.full(X.shape, np.nan))
    data.attrs["units"] = UNITS
    assert sweep_figure(data).axes[0].get_ylabel() == "$r$ at the end (m)"


def test_values_that_do_not_grow_are_drawn_in_order():
    axes = sweep_figure(made({"m": X[::-1]})).axes[0]
    np.testing.assert_allclose(axes.lines[0].get_xdata(), X)
    np.testing.assert_allclose(axes.lines[0].get_ydata(), X**2)


def test_few_values_of_a_second_quantity_are_lines():
    axes = sweep_figure(made({"m": X, "k": Y[:3]})).axes[0]
    assert [line.get_label() for line in axes.lines] == ["$k$ = 0", "$k$ = 0.25", "$k$ = 0.5"]
    np.testing.assert_allclose(axes.lines[2].get_ydata(), X**2 + 0.25)


def test_failed_cases_of_lines_stand_below_in_the_colour_of_their_line():
    axes = sweep_figure(made({"m": X, "k": Y[:3]}, failed=[(4, 0), (6, 2)])).axes[0]
    lines, crosses = axes.lines[:3], axes.lines[3:5]
    for cross, place, line in zip(crosses, (4, 6), (0, 2), strict=True):
        np.testing.assert_allclose(cross.get_xdata(), X[[place]])
        assert cross.get_color() == lines[line].get_color()
    assert crosses[0].get_ydata()[0] < crosses[1].get_ydata()[0]
    assert axes.get_legend_handles_labels()[1][3:] == ["failed"]


def test_lines_that_coincide_take_turns_and_the_legend_says_so():
    """Nothing depends on the quantity of the lines but for the last of them."""
    cost = X[:, None] ** 2 + np.where(np.arange(4) == 3, 0.5, 0.0)
    axes = sweep_figure(made({"m": X, "k": Y[:4]}, cost=cost)).axes[0]
    *lines, note = axes.lines
    assert note.get_label() == "in turn where they coincide"
    assert [line.get_markevery() for line in lines] == [(0, 3), (1, 3), (2, 3), None]
    # Of three dashes one is drawn, and at every place by one of the lines.
    dashes = [line._unscaled_dash_pattern for line in lines]
    assert dashes[3] == (0, None)
    place = np.arange(0.0, 48.0, 0.25) + 0.1
    drawn = [(place + offset) % (dash + gap) < dash for offset, (dash, gap) in dashes[:3]]
    assert (np.sum(drawn, axis=0) == 1).all()
    assert {handle.get_linestyle() for handle in axes.get_legend().get_lines()} == {"-", "None"}


def test_lines_that_cross_are_whole():
    cost = X[:, None] * np.array([1.0, -1.0, 0.5])
    axes = sweep_figure(made({"m": X, "k": Y[:3]}, cost=cost)).axes[0]
    assert [line.get_linestyle() for line in axes.lines] == ["-"] * 3


def test_a_slice_of_a_grid_is_named_and_all_its_cases_are_counted():
    figure = sweep_figure(made({"m": X, "k": Y[:3], "c": Y[:2]}, failed=[(0, 0, 0)]))
    title = " ".join(figure.get_suptitle().split())
    assert "66 cases, 1 FAILED; drawn are those at $c$ = 0.25" in title


@pytest.mark.parametrize("turned", [False, True])
def test_two_quantities_span_a_map_with_contours(turned):
    given = {"m": X, "k": Y}
    data = made(dict(reversed(given.items())) if turned else given, failed=[(2, 3)], jumps=[(4, 5)])
    axes = sweep_figure(data).axes[0]
    (mesh,) = (item for item in axes.collections if isinstance(item, QuadMesh))
    assert axes.get_xlabel() == "$m$"
    shown = np.ma.filled(mesh.get_array(), np.nan)
    np.testing.assert_allclose(shown[3, 0], data.cost.sel(m=X[0], k=Y[3]))
    np.testing.assert_allclose(shown[0, 4], data.cost.sel(m=X[4], k=Y[0]))
    assert any(isinstance(item, ContourSet) for item in axes.collections)
    (failed,), (jumps,) = marks(axes, "failed"), marks(axes, "jump")
    np.testing.assert_allclose(failed, [[X[3], Y[2]] if turned else [X[2], Y[3]]])
    np.testing.assert_allclose(jumps, [[X[5], Y[4]] if turned else [X[4], Y[5]]])


LONG = np.linspace(-1.0, 1.0, 41)


@pytest.mark.parametrize(
    ("cost", "labelled"),
    [
        (lambda x, y: x + 4.0 * y, {"0", "1.5", "3", "4.5", "6", "7.5"}),
        (lambda x, y: np.tanh(60.0 * x) + 1e-3 * y, set()),  # all lines lie within a cell
    ],
)
def test_contours_have_labels_where_there_is_room(cost, labelled):
    data = made({"m": LONG, "k": Y})
    data["cost"][...] = cost(*np.meshgrid(LONG, Y, indexing="ij"))
    figure = sweep_figure(data)
    axes = figure.axes[0]
    (lines,) = (item for item in axes.collections if isinstance(item, ContourSet))
    assert len(lines.levels) > 4
    assert {text.get_text() for text in axes.texts} == labelled
    figure.canvas.draw()
    boxes = [text.get_window_extent() for text in axes.texts]
    assert not any(one.overlaps(other) for k, one in enumerate(boxes) for other in boxes[:k])


def test_a_third_quantity_has_a_map_for_each_of_some_values():
    figure = sweep_figure(made({"m": X, "k": Y, "c": np.array([1.0, 2.0, 3.0])}))
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert titles == ["$c$ = 1", "$c$ = 2", "$c$ = 3"]


def test_samples_have_a_distribution_and_fans():
    rng = np.random.default_rng(1)
    data = made({"m": rng.normal(5.0, 1.0, 500)}, failed=[4, 9], jumps=[7], dims=("case",))
    figure = sweep_figure(data)
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    finite = data.cost.values[np.isfinite(data.cost.values)]
    assert f"median: {np.median(finite):.4g}" in labels
    assert f"95 %: {np.quantile(finite, 0.95):.4g}" in labels
    assert sum(bar.get_height() for bar in figure.axes[0].patches) == 498
    assert len(marks(figure.axes[1], "2 failed")[0]) == 2
    np.testing.assert_allclose(marks(figure.axes[1], "jump")[0], [[data.m[7], data.cost[7]]])
    fan = next(axes for axes in figure.axes if axes.get_ylabel() == "$r$")
    outer = next(item for item in fan.collections if isinstance(item, PolyCollection))
    solved = data.m.values[data.status.values == "solved"]
    edges = outer.get_paths()[0].vertices
    at_end = edges[np.isclose(edges[:, 0], 1.0), 1]
    low, high, _ = sweep.BANDS[0]
    np.testing.assert_allclose([at_end.min(), at_end.max()], np.quantile(solved, (low, high)))
    np.testing.assert_allclose(fan.lines[0].get_ydata()[-1], np.median(solved))


def with_states(data, states, controls):
    """The data with so many states and controls, all alike."""
    found = data.drop_vars(("q", "u", "coordinate", "control"))
    for name, dim, letter, number in (("q", "coordinate", "x", states), ("u", "control", "f", controls)):
        found[name] = data[name].isel({dim: [0] * number}).drop_vars(dim, errors="ignore")
        found[dim] = [f"{letter}{k}" for k in range(1, number + 1)]
    return found


@pytest.mark.parametrize(
    ("states", "controls", "drawn", "missing"),
    [(9, 4, 13, ""), (12, 9, 15, "; no room for $x_{10}$, $x_{11}$, $x_{12}$, $f_{7}$, $f_{8}$, $f_{9}$"),
     (40, 1, 15, "$x_{26}$ and 14 more")],
)  # fmt: skip
def test_states_and_controls_are_drawn_while_there_is_room(states, controls, drawn, missing):
    for data in (made({"m": X}), made({"m": X}, dims=("case",))):
        figure = sweep_figure(with_states(data, states, controls))
        assert sum(axes.get_xlabel() == "time" for axes in figure.axes) == drawn
        title = " ".join(figure.get_suptitle().split())
        assert title.endswith(missing or "11 cases")
    chosen = with_states(made({"m": X}), states, controls).sel(coordinate=["x9"], control=[])
    assert [axes.get_ylabel() for axes in sweep_figure(chosen).axes if axes.get_xlabel() == "time"] == ["$x_{9}$"]


def test_states_at_the_end_for_which_there_is_no_room_are_named():
    data = with_states(made({"m": X}), 6, 1)
    data["cost"][:] = np.nan
    figure = sweep_figure(data)
    assert figure.get_suptitle().endswith("; no room for $x_{5}$ at the end, $x_{6}$ at the end")


def test_without_a_cost_the_state_at_the_end_is_shown():
    data = made({"m": X})
    data["cost"][:] = np.nan
    axes = sweep_figure(data).axes[0]
    assert axes.get_ylabel() == "$r$ at the end"
    np.testing.assert_allclose(axes.lines[0].get_ydata(), X)


@pytest.mark.parametrize("axes", [{"m": X}, {"m": X, "k": Y}, {"m": np.array([1.0])}])
def test_where_nothing_is_solved_there_is_a_picture_all_the_same(tmp_path, axes):
    data = made(axes)
    data["status"][...], data["cost"][...] = "infeasible", np.nan
    save_sweep(data, tmp_path / "s.png")
    assert (tmp_path / "s.png").stat().st_size > 1000


def test_a_file_of_pixels_and_one_of_curves(tmp_path):
    for name in ("s.png", "s.svg", "s.pdf"):
        save_sweep(made({"m": X}, failed=[1]), tmp_path / name)
        assert (tmp_path / name).stat().st_size > 1000
