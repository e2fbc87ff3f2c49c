"""Pictures: what is in them, for every kind of result, and that nothing in them overlaps."""

from __future__ import annotations

from dataclasses import replace

import matplotlib
import numpy as np
import pytest
from invented_results import BOUNDED, PAIR, column, invented, overlaps, picture, unsolved
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from codegen.drawing import Arrow, Mass, Scene, Trail
from codegen.errors import ArgumentError
from codegen.show import figures
from codegen.show.figures import panels
from codegen.show.figures.picture import STYLE, Picture, using, words_of, write
from codegen.show.figures.quantities import Inequality, Quantity, relation
from codegen.solving import api


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("r", "$r$"),
        ("phi", r"$\varphi$"),
        ("p_phi", r"$p_{\varphi}$"),
        ("ETA", r"$\mathrm{ETA}$"),  # LaTeX and matplotlib have no such letter
        ("dTheta", r"$\dot{\Theta}$"),
        ("_", r"$\mathrm{\_}$"),
        ("theta2", r"$\theta_{2}$"),
        ("p_theta2", r"$p_{\theta,2}$"),
        ("lambda_x", r"$\lambda_{x}$"),
        ("dtheta", r"$\dot{\theta}$"),
        ("dx", r"$\dot{x}$"),
        ("force", r"$\mathrm{force}$"),
        ("drive", r"$\mathrm{drive}$"),
        ("x_left", r"$x_{\mathrm{left}}$"),
        ("d_max", r"$d_{\mathrm{max}}$"),
    ],
)
def test_labels(name, label):
    assert figures.label(name) == label


def test_relations():
    assert relation("w1**2 + 3*w2 <= 1") == "w1^2 + 3·w2 ≤ 1"
    assert relation("x" * 50, 10) == "x" * 9 + "…"


def texts(figure):
    return {axes.get_ylabel() for axes in figure.axes} | {figure.get_suptitle()}


def _at(x, y):
    shape = np.broadcast_shapes(np.shape(x), np.shape(y))
    return np.broadcast_to(x, shape or (1, 1)), np.broadcast_to(y, shape or (1, 1))


class TestControlFigure:
    def test_orbit(self, interpreted):
        module = interpreted("orbital_transfer")
        with np.errstate(all="ignore"):  # as in compiled code
            result = api.solve(module, steps=8)
        figure = figures.control_figure(module, result, unit="nondimensional")
        assert {"$r$", r"$\varphi$", "$p_{r}$", r"$p_{\varphi}$", r"$\lambda_{r}$", "$u$", "max-norm"} <= texts(figure)
        assert "8 steps" in figure.get_suptitle()
        assert "Transfer a satellite" in figure.get_suptitle()
        assert "NOT SOLVED" not in figure.get_suptitle()
        lowest = {axes.get_xlabel() for axes in figure.axes}
        assert lowest == {"", "iteration", "time (nondimensional)"}

    def test_failure_is_named(self, interpreted):
        module = interpreted("bounded", BOUNDED)
        figure = figures.control_figure(module, unsolved(module))
        assert "NOT SOLVED: stalled" in figure.get_suptitle()
        legend = [text.get_text() for text in figure.legends[0].get_texts()]
        assert legend == ["last iterate", "initial guess", "bound", "forbidden"]

    def test_bounds_are_drawn(self, interpreted):
        module = interpreted("bounded", BOUNDED)
        result = unsolved(module)
        figure = figures.control_figure(module, replace(result, u=column(2.0, 2.0, 0.0, -1.0)))
        control = next(axes for axes in figure.axes if axes.get_ylabel() == "$f$")
        dashed = [line.get_ydata()[0] for line in control.lines if line.get_linestyle() == "--"]
        assert sorted(dashed) == [-1.0, 2.0]
        low, high = control.get_ylim()
        assert low < -1.0 < 2.0 < high
        (highlighted,) = control.collections
        heights = [segment[0][1] for segment in highlighted.get_segments()]
        assert heights == [2.0, 2.0, -1.0]
        shaded = [patch.get_bbox() for patch in control.patches if isinstance(patch, matplotlib.patches.Rectangle)]
        assert sorted((box.y0, box.y1) for box in shaded) == [(low, -1.0), (2.0, high)]
        assert "active" in [text.get_text() for text in figure.legends[0].get_texts()]

    def test_a_bound_far_away_does_not_flatten_the_curve(self):
        axes = Figure().add_subplot()
        shown = Quantity("f", "control", np.arange(4.0), column(0, 1, 0), np.array([-100.0]), np.array([100.0]))
        panels.quantity(axes, shown)
        assert max(map(abs, axes.get_ylim())) < 2.0
        assert axes.get_title(loc="right") == "out of view: ≥ -100, ≤ 100"

    def test_many_inequalities_become_a_strip(self):
        axes = Figure().add_subplot()
        shown = [Inequality(f"g{i} <= 0", np.arange(3.0), column(0, i, 1)) for i in range(6)]
        panels.strip(axes, shown)
        assert [text.get_text() for text in axes.get_yticklabels()] == [f"g{i} ≤ 0" for i in range(6)]
        np.testing.assert_array_equal(axes.lines[3].get_ydata(), [3, np.nan, np.nan])

    def test_an_expression_is_drawn_between_its_bounds(self):
        axes, t = Figure().add_subplot(), np.arange(3.0)
        upper = Inequality("a*x <= 3", t, column(3, 1, 0), 0, "a*x", np.full(3, 3.0))
        lower = Inequality("a*x >= -t", t, column(0, 3, 5), 0, "a*x", -t, is_lower=True)
        panels.inequality(axes, [upper, lower])
        curves = [line.get_ydata() for line in axes.lines if line.get_linestyle() == "-" and line.get_linewidth() < 2]
        np.testing.assert_array_equal(curves, [[0, 2, 3], [0, 2, 3]])
        (changing,) = [line.get_ydata() for line in axes.lines if line.get_linestyle() == "--"]
        np.testing.assert_array_equal(changing, -t)
        (constant,) = [lines for lines in axes.collections if isinstance(lines, LineCollection)]
        np.testing.assert_array_equal(constant.get_segments(), [[[0.0, 3.0], [2.0, 3.0]]])
        low, high = axes.get_ylim()
        assert low < -2.0 < 3.0 < high
        assert axes.get_ylabel() == "a·x"
        assert axes.get_title(loc="left") == "a·x ≤ 3, a·x ≥ -t"

    def test_a_bound_of_an_expression_far_away_is_named(self):
        axes, t = Figure().add_subplot(), np.arange(3.0)
        panels.inequality(axes, [Inequality("v <= 90", t, column(90, 89, 88), 0, "v", np.full(3, 90.0), unit="m/s")])
        assert axes.get_title(loc="left") == "out of view: v ≤ 90"
        assert (axes.get_ylabel(), max(axes.get_ylim()) < 3.0) == ("$v$ (m/s)", True)

    def test_bounds_of_one_phase_end_with_the_phase(self):
        axes, t = Figure().add_subplot(), np.array([0.25, 0.75])
        first = Inequality("x <= 2", t, column(1, 2), 0, "x", np.full(2, 2.0), spans=((0.0, 1.0),))
        second = replace(first, name="x <= 3", t=t + 1.0, bound=np.full(2, 3.0), spans=((1.0, 2.0),))
        panels.inequality(axes, [first, second])
        lines = [one.get_segments()[0].tolist() for one in axes.collections if isinstance(one, LineCollection)]
        assert lines == [[[0.0, 2.0], [1.0, 2.0]], [[1.0, 3.0], [2.0, 3.0]]]
        assert axes.get_title(loc="left") == "x ≤ 2, x ≤ 3"

    def test_an_expression_that_stays_at_its_bound_is_a_straight_line(self):
        axes, t = Figure().add_subplot(), np.arange(3.0)
        panels.inequality(axes, [Inequality("a*a <= 1", t, column(1e-9, 2e-8, 0), 0, "a*a", np.ones(3))])
        low, high = axes.get_ylim()
        assert low < 0.8
        assert high > 1.1

    def test_a_figure_for_a_paper_shows_no_initial_guess(self, interpreted):
        module = interpreted("bounded", BOUNDED)
        result = replace(unsolved(module), status="solved")
        pages = {style: figures.figure(module, result, style=style) for style in ("page", "paper", "talk")}
        words = {style: {text.get_text() for text in page.legends[0].get_texts()} for style, page in pages.items()}
        assert {style for style, own in words.items() if "initial guess" in own} == {"page", "talk"}

    def test_the_drawing_for_a_paper_shows_the_optimum_alone(self, interpreted):
        module = interpreted("pair", PAIR)
        result = replace(unsolved(module), status="solved")
        drawn = Scene(result.t, (Trail((result.q.T, np.zeros((2, 4)))),))
        page = figures.figure(module, result, figures.Drawings(drawn, drawn), style="paper")
        assert not {axes.get_title() for axes in page.axes} & {"initial guess", "optimum"}

    def test_iterations_with_a_barrier(self):
        axes = Figure().add_subplot()
        panels.iterations(axes, np.array([[1, 1e-1, 0, 0, 1, 0.1], [1, 1e-9, 1e-8, 0, 1, 1e-9]]))
        assert [line.get_label() for line in axes.lines] == ["residual", "stationarity", "barrier"]
        assert axes.get_yscale() == "log"

    def test_guess_and_optimum_side_by_side(self, interpreted):
        module = interpreted("pair", PAIR)
        result = unsolved(module)
        drawn = Scene(result.t, (Trail((result.q.T, np.zeros((2, 4)))), Arrow(_at(result.q.T, 0.0), _at(1.0, 0.5))))
        figure = figures.control_figure(module, replace(result, status="solved"), figures.Drawings(drawn, drawn))
        titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
        assert titles == ["initial guess", "optimum"]
        left, right = figure.axes[:2]
        assert left.get_aspect() == right.get_aspect() == 1.0
        assert left.get_xlim() == right.get_xlim()
        legend = {text.get_text() for text in right.get_legend().get_texts()}
        assert legend == {"start", "end"}
        squares = [line for line in right.lines if line.get_marker() == "s"]
        np.testing.assert_array_equal(np.concatenate([line.get_xdata() for line in squares]), result.q[-1])


@pytest.mark.parametrize(
    ("states", "controls", "bodies", "form", "conditions", "height"),
    [
        (1, 1, 1, "lagrangian", 0, None),
        (1, 1, 1, "first-order", 1, None),
        (2, 1, 1, "lagrangian", 1, 1.0),
        (2, 2, 1, "lagrangian", 6, 8.0),
        (5, 3, 1, "first-order", 2, 0.1),
        (12, 12, 1, "lagrangian", 4, None),
        (3, 2, 3, "lagrangian", 0, 1.0),
        (3, 2, 20, "lagrangian", 2, 1.0),
    ],
)
def test_nothing_overlaps(states, controls, bodies, form, conditions, height):
    module, result = invented(states, controls, bodies, form, conditions)
    drawn = picture(bodies, height) if height is not None else None
    with matplotlib.rc_context(STYLE):
        figure = figures.control_figure(
            module, result, figures.Drawings(drawn, drawn) if drawn else None, "nondimensional"
        )
        assert overlaps(figure) == []
    assert figure.get_figheight() < 30.0
    panels_of = {axes.get_ylabel() for axes in figure.axes}
    assert {figures.label(f"x{i + 1}") for i in range(states)} <= panels_of


@pytest.mark.parametrize("chosen", [["x2"], ["u1", "x1", "p_x2"], ["x1", "x2", "u1", "p_x1", "lambda_x1"]])
def test_chosen_panels_are_the_only_ones_in_their_order(chosen):
    module, result = invented(2, 1, 1, "lagrangian", 1)
    with matplotlib.rc_context(STYLE):
        figure = figures.control_figure(module, result, chosen=chosen)
        assert overlaps(figure) == []
    assert [axes.get_ylabel() for axes in figure.axes] == [figures.label(name) for name in chosen]
    assert "initial guess" not in [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def test_unknown_panels_are_refused_with_all_names():
    module, result = invented(1, 1, 1, "lagrangian")
    for chosen in (["y"], []):
        with pytest.raises(ArgumentError, match="choose from x1, p_x1, u1"):
            figures.control_figure(module, result, chosen=chosen)


def test_what_does_not_fit_is_counted():
    module, result = invented(14, 13, 1, "lagrangian")
    title = figures.control_figure(module, result).get_suptitle().replace("\n", " ")
    assert "2 further states not shown, 1 further controls not shown" in title


@pytest.mark.parametrize(("number", "everywhere"), [(np.nan, True), (np.inf, False), (-np.inf, False)])
def test_numbers_that_are_none(tmp_path, number, everywhere):
    """A failed solution is drawn as far as it has numbers."""
    module, result = invented(2, 1, 1, "lagrangian", 1)
    place = slice(None) if everywhere else slice(2, 4)
    names = ("q", "p", "u", "multipliers", "log")
    broken = {name: getattr(result, name).copy() for name in names}
    for name in names:
        broken[name][place] = number
    broken_result = replace(result, status="non-finite", cost=float(number), **broken)
    write(figures.figure(module, broken_result), tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 1000


class TestSimulation:
    def test_phase_portrait_and_energy(self, interpreted):
        module = interpreted("pendulum")
        result = api.solve(module, steps=50)
        figure = figures.simulation_figure(result)
        over_time, portrait, energy = figure.axes
        assert (over_time.get_xlabel(), over_time.get_ylabel()) == ("time", "$q$")
        np.testing.assert_array_equal(over_time.lines[0].get_xydata(), np.column_stack([result.t, result.q[:, 0]]))
        assert (portrait.get_xlabel(), portrait.get_ylabel()) == ("$q$", "$p$")
        assert energy.get_ylabel() == "change of energy"
        np.testing.assert_array_equal(portrait.lines[0].get_xdata(), result.q[:, 0])
        np.testing.assert_allclose(np.abs(energy.lines[0].get_ydata()).max(), result.summary["energy_drift"])

    def test_with_a_drawing(self, interpreted, tmp_path):
        result = api.solve(interpreted("pendulum"), steps=50)
        bob = np.sin(result.q.T), -np.cos(result.q.T)
        scene = Scene(result.t, (Trail(bob), Mass(bob, 0.1 + 0 * bob[0])))
        with matplotlib.rc_context(STYLE):
            figure = figures.simulation_figure(result, scene, "nondimensional")
            assert overlaps(figure) == []
        assert len(figure.axes) == 4
        assert figure.axes[-1].get_xlabel() == "time (nondimensional)"

    @pytest.mark.parametrize(("coordinates", "height"), [(3, 8.0), (10, 11.0), (30, 13.0)])
    def test_many_coordinates_stand_side_by_side(self, coordinates, height):
        names = {"q": [f"x{i}" for i in range(coordinates)], "p": [f"p_x{i}" for i in range(coordinates)]}
        result = replace(invented(coordinates, 1, 1, "lagrangian")[1], energy=np.linspace(1.0, 1.1, 7), names=names)
        result = replace(result, summary={"energy_drift": 0.1})
        with matplotlib.rc_context(STYLE):
            figure = figures.simulation_figure(result)
            assert overlaps(figure) == []
        assert figure.get_figheight() <= height
        assert len(figure.axes) == 2 * min(coordinates, 12) + 1
        assert ("18 further coordinates not shown" in figure.get_suptitle()) is (coordinates == 30)

    def test_what_is_conserved_is_said_in_place_of_rounding(self):
        result = invented(1, 1, 1, "lagrangian")[1]
        rounding = 1e-15 * np.array([0, 1, -2, 3, 0, 1, -1])
        result = replace(
            result, p=(8.775825619 + rounding)[:, None], energy=2.0 + rounding, summary={"energy_drift": 0}
        )
        result = replace(result, names={"q": ["x"], "p": ["p_x"]})
        _, portrait, energy = figures.simulation_figure(result).axes
        assert portrait.get_title(loc="right") == "conserved to 5e-15"
        assert portrait.get_ylim() == pytest.approx((8.775825619 / 2, 1.5 * 8.775825619))
        assert energy.get_title(loc="right") == "conserved to 5e-15"
        assert max(map(abs, energy.get_ylim())) < 1e-8

    def test_the_energy_of_what_is_driven_is_no_error(self, interpreted):
        result = api.solve(interpreted("driven", DRIVEN), steps=40)
        assert "energy_drift" not in result.summary
        assert result.summary["energy_change"] == result.energy[-1] - result.energy[0]
        axes = figures.simulation_figure(result).axes[-1]
        assert axes.get_ylabel() == "energy (J)"
        np.testing.assert_array_equal(axes.lines[0].get_ydata(), result.energy)

    def test_long_paths_are_thinned(self):
        t = np.linspace(0.0, 1.0, 100_001)
        result = replace(
            invented(1, 1, 1, "lagrangian")[1], t=t, q=t[:, None], p=t[:, None], energy=t, names={"q": "x", "p": "p"}
        )
        assert figures.simulation_figure(result).axes[0].lines[0].get_xdata().size <= 20_001


class TestStyles:
    @pytest.mark.parametrize(
        ("name", "width", "letters"), [("page", 12.0, 11.0), ("paper", 7.1, 8.7), ("talk", 13.3, 17.4)]
    )
    def test_sizes_and_that_nothing_overlaps(self, name, width, letters):
        module, result = invented(2, 1, 1, "lagrangian", 1)
        drawn = picture(1, 1.0)
        figure = figures.figure(module, result, figures.Drawings(drawn, drawn), style=name)
        if name == "talk":  # a slide is at least this wide, with an aspect ratio of 16:9
            assert figure.get_figwidth() >= width
            assert figure.get_figwidth() / figure.get_figheight() == pytest.approx(16 / 9)
        else:
            assert figure.get_figwidth() == pytest.approx(width)
        if name != "paper":
            assert result.title.rstrip(".") in " ".join(figure.get_suptitle().split("\n"))
            assert figure._suptitle.get_fontsize() == pytest.approx(letters, abs=0.1)
        assert result.title.rstrip(".") in words_of(figure)
        with using(name):
            assert overlaps(figure) == []

    def test_a_paper_has_neither_title_nor_multipliers_nor_iterations(self):
        module, result = invented(2, 1, 1, "lagrangian", 1)
        labels = {}
        for name in ("page", "paper"):
            figure = figures.figure(module, result, style=name)
            labels[name] = texts(figure) | {axes.get_xlabel() for axes in figure.axes}
            assert bool(figure.get_suptitle()) is (name == "page")
        assert any("lambda" in text for text in labels["page"])
        assert not any("lambda" in text for text in labels["paper"])
        assert "iteration" in labels["page"] - labels["paper"]

    def test_a_paper_says_that_a_problem_is_not_solved(self):
        module, result = invented(1, 1, 1, "lagrangian")
        stalled = replace(result, status="stalled")
        assert "NOT SOLVED" in figures.figure(module, stalled, style="paper").get_suptitle()

    def test_others_are_refused(self):
        module, result = invented(1, 1, 1, "lagrangian")
        with pytest.raises(ArgumentError, match="there is no style 'poster'; give one of page, paper, talk"):
            figures.figure(module, result, style="poster")


class TestWords:
    def test_a_figure_says_what_it_shows_with_units(self, interpreted):
        result = api.solve(interpreted("driven", DRIVEN), steps=40)
        text = words_of(figures.simulation_figure(result))
        assert text.startswith("Drive an oscillator. variational, midpoint, 40 steps. Shown: theta_1 (m) from ")
        low, high = result.q.min(), result.q.max()
        assert f"theta_1 (m) from {low:.3g} to {high:.3g}; " in text
        assert "p_theta,1 (kg·m/s) from " in text
        assert "over theta_1 (m)" in text
        assert "energy (J) from " in text

    @pytest.mark.parametrize("ending", ["png", "svg"])
    def test_files_have_the_text(self, tmp_path, ending):
        module, result = invented(1, 1, 1, "lagrangian")
        Picture(figures.figure(module, result)).save(tmp_path / f"a.{ending}")
        assert b"; p_x,1 from 0 to 9.97e-05; " in (tmp_path / f"a.{ending}").read_bytes()


DRIVEN = '''"""Drive an oscillator."""
from codegen import Simulate, coordinate, parameters, time
from sympy import cos
def problem():
    q, v = coordinate("theta1", unit="m")
    t = time()
    m, k, F, w = parameters(m=(1, "kg"), k=(4, "N/m"), F=(1, "N"), w=(1.5, "1/s"))
    return Simulate(
        lagrangian=m * v**2 / 2 - k * q**2 / 2, force={q: F * cos(w * t)}, start={q: 0, v: 0}, duration=5, steps=50
    )
'''


@pytest.mark.parametrize(("suffix", "signature"), [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_files(tmp_path, suffix, signature):
    module, result = invented(1, 1, 1, "lagrangian")
    drawn = picture(1)
    write(figures.figure(module, result, figures.Drawings(drawn, drawn)), tmp_path / f"a.{suffix}")
    assert (tmp_path / f"a.{suffix}").read_bytes().startswith(signature)


def test_pictures_are_reproducible(tmp_path):
    module, result = invented(2, 1, 2, "lagrangian")
    for name in ("a.svg", "b.svg"):
        write(figures.figure(module, result), tmp_path / name)
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
