"""Pictures: what is in them, for every kind of result, and that nothing in them overlaps."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from codegen import drivers, plots
from codegen.drawing import Arrow, Box, Circle, Ground, Mark, Mass, Rod, Scene, Trail
from codegen.drivers.result import Result
from codegen.plots import panels, shapes, style
from codegen.plots.quantities import Inequality, Quantity, first_guess, inequalities, quantities


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("r", "$r$"),
        ("phi", r"$\phi$"),
        ("p_phi", r"$p_{\phi}$"),
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
    assert plots.label(name) == label


def test_relations():
    assert style.relation("w1**2 + 3*w2 <= 1") == "w1^2 + 3·w2 ≤ 1"
    assert style.relation("x" * 50, 10) == "x" * 9 + "…"


def texts(figure):
    return {axes.get_ylabel() for axes in figure.axes} | {figure.get_suptitle()}


def column(*values):
    return np.array(values, float)[:, None]


BOUNDED = '''"""Push a cart between walls."""
from codegen import Control, control, coordinate
def problem():
    x, dx = coordinate("x")
    f = control("f")
    return Control(
        lagrangian=dx**2/2, force={x: f}, cost=f**2, duration=2, start={x: 0, dx: 0}, end={x: 1, dx: 0}, steps=4,
        bounds={x: (None, 1.5), f: (-1, 2)}, path=[f + x <= 3],
    )
'''

PAIR = '''"""Two runners who meet."""
from codegen import Control, body_number, control, coordinate
def problem():
    x, dx = coordinate("x")
    f, body = control("f"), body_number()
    return Control(
        lagrangian=dx**2/2, force={x: f}, cost=f**2, duration=1, start={x: body, dx: 0}, end={dx: 0}, bodies=2, steps=3,
        end_conditions=[x.of(0) - x.of(1)], bounds={f: (-5 - body, None)},
    )
'''


def unsolved(module: Any) -> Result:
    """The first guess of a module as a result."""
    grid = module.make_grid()
    unknowns = module.initial_guess(grid)
    t, q, p, u, multipliers = module.unpack(grid, unknowns)
    names = drivers.result.component_names(module.metadata)
    return Result(
        problem="made-up", title="Made up.", task="control", method=module.metadata["method"], scheme="midpoint",
        driver="none", steps=grid.steps, status="stalled", message="", cost=1.0, residual=1.0, stationarity=1.0,
        iterations=0, t=t, q=q, p=p, u=u, multipliers=multipliers, energy=None, log=None, names=names,
        summary={}, unknowns=unknowns,
    )  # fmt: skip


class TestQuantities:
    def test_bounds_and_names(self, interpreted):
        module = interpreted("bounded", BOUNDED)
        found = quantities(module, unsolved(module))
        (x,), (p,), (f,), (multiplier,) = (found[kind] for kind in ("state", "momentum", "control", "multiplier"))
        assert [q.name for q in (x, p, f, multiplier)] == ["x", "p_x", "f", "lambda_x"]
        assert (x.lower.tolist(), x.upper.tolist()) == ([-np.inf], [1.5])
        assert (f.lower.tolist(), f.upper.tolist()) == ([-1.0], [2.0])
        assert not np.isfinite([*p.lower, *p.upper, *multiplier.lower, *multiplier.upper]).any()
        assert (x.on_intervals, f.on_intervals) == (False, True)
        np.testing.assert_allclose(x.guess[:, 0], np.linspace(0, 1, 5))
        assert p.guess is None

    def test_active(self):
        values = column(0.0, 1.9, 2.0 - 1e-7, 2.0, 1.0)
        free = np.array([-np.inf])
        quantity = Quantity("f", "control", np.arange(6.0), values, free, np.array([2.0]))
        assert quantity.active()[:, 0].tolist() == [False, False, True, True, False]
        assert not replace(quantity, upper=-free).active().any()

    def test_inequalities(self, interpreted):
        module = interpreted("bounded", BOUNDED)
        result = unsolved(module)
        (shown,) = inequalities(module, result)
        assert shown.name == "f + x <= 3"
        np.testing.assert_allclose(shown.t, [0.25, 0.75, 1.25, 1.75])
        # The distance at the middle of each interval, whatever the slack says.
        np.testing.assert_allclose(shown.distance[:, 0], 3.0 - np.array([0.125, 0.375, 0.625, 0.875]))
        violated = result.unknowns.copy()
        module.views(module.make_grid(), violated)[1][0, 1, module.metadata["interval"].index("f")] = 4.0
        (shown,) = inequalities(module, replace(result, unknowns=violated))
        assert shown.distance[1, 0] == pytest.approx(3.0 - 4.375)
        assert shown.active()[:, 0].tolist() == [False, True, False, False]

    def test_bodies(self, interpreted):
        module = interpreted("pair", PAIR)
        found = quantities(module, unsolved(module))
        (x,), (f,) = found["state"], found["control"]
        np.testing.assert_array_equal(x.values[0], [0, 1])
        np.testing.assert_array_equal(f.lower, [-5, -6])
        assert f.values.shape == (3, 2)

    def test_both_multipliers_of_a_hamiltonian_system(self, interpreted):
        module = interpreted("bounded", BOUNDED, method="hamiltonian")
        found = quantities(module, unsolved(module))
        assert [m.name for m in found["multiplier"]] == ["mu_x", "mu_p_x"]
        assert all(m.on_intervals for m in found["multiplier"])
        figure = plots.control_figure(module, unsolved(module))
        assert r"$\mu_{x}$, $\mu_{p,x}$" in texts(figure)


class TestControlFigure:
    def test_orbit(self, interpreted):
        module = interpreted("orbital_transfer")
        with np.errstate(all="ignore"):  # as in compiled code
            result = drivers.solve(module, steps=8)
        figure = plots.control_figure(module, result, unit="nondimensional")
        assert {"$r$", r"$\phi$", "$p_{r}$", r"$p_{\phi}$", r"$\lambda_{r}$", "$u$", "max-norm"} <= texts(figure)
        assert "8 steps" in figure.get_suptitle()
        assert "Transfer a satellite" in figure.get_suptitle()
        assert "NOT SOLVED" not in figure.get_suptitle()
        lowest = {axes.get_xlabel() for axes in figure.axes}
        assert lowest == {"", "iteration", "time (nondimensional)"}

    def test_failure_is_named(self, interpreted):
        module = interpreted("bounded", BOUNDED)
        figure = plots.control_figure(module, unsolved(module))
        assert "NOT SOLVED: stalled" in figure.get_suptitle()
        legend = [text.get_text() for text in figure.legends[0].get_texts()]
        assert legend == ["last iterate", "initial guess", "bound", "forbidden"]

    def test_bounds_are_drawn(self, interpreted):
        module = interpreted("bounded", BOUNDED)
        result = unsolved(module)
        figure = plots.control_figure(module, replace(result, u=column(2.0, 2.0, 0.0, -1.0)))
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

    def test_iterations_with_a_barrier(self):
        axes = Figure().add_subplot()
        panels.iterations(axes, np.array([[1, 1e-1, 0, 0, 1, 0.1], [1, 1e-9, 1e-8, 0, 1, 1e-9]]))
        assert [line.get_label() for line in axes.lines] == ["residual", "stationarity", "barrier"]
        assert axes.get_yscale() == "log"

    def test_guess_and_optimum_side_by_side(self, interpreted):
        module = interpreted("pair", PAIR)
        result = unsolved(module)
        drawn = Scene(result.t, (Trail((result.q.T, np.zeros((2, 4)))), Arrow(_at(result.q.T, 0.0), _at(1.0, 0.5))))
        figure = plots.control_figure(module, replace(result, status="solved"), plots.Drawings(drawn, drawn))
        titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
        assert titles == ["initial guess", "optimum"]
        left, right = figure.axes[:2]
        assert left.get_aspect() == right.get_aspect() == 1.0
        assert left.get_xlim() == right.get_xlim()
        legend = {text.get_text() for text in right.get_legend().get_texts()}
        assert legend == {"start", "end"}
        squares = [line for line in right.lines if line.get_marker() == "s"]
        np.testing.assert_array_equal(np.concatenate([line.get_xdata() for line in squares]), result.q[-1])


def _at(x, y):
    shape = np.broadcast_shapes(np.shape(x), np.shape(y))
    return np.broadcast_to(x, shape or (1, 1)), np.broadcast_to(y, shape or (1, 1))


def invented(states: int, controls: int, bodies: int, form: str, conditions: int = 0) -> tuple[Any, Result]:
    """A module with only what figures read of it, and a result of 6 intervals."""
    steps, t = 6, np.linspace(0.0, 1.0, 7)
    wave = np.sin(3.0 * t[:, None] + np.arange(states * bodies))
    u = np.cos(3.0 * t[:-1, None] + np.arange(controls * bodies))
    names = tuple(f"x{i + 1}" for i in range(states))
    inputs = tuple(f"u{i + 1}" for i in range(controls))
    rates = () if form == "first-order" else tuple(f"dx{i + 1}" for i in range(states))
    mu, slacks = tuple(f"mu_{name}" for name in names), tuple(f"s_{i}" for i in range(conditions))
    y = tuple(f"y_{i}" for i in range(conditions))
    method = "one-step" if form == "first-order" else "variational"
    multipliers = wave[:-1] if form == "first-order" else wave
    momenta = wave[:, :0] if form == "first-order" else 1e-4 * wave
    unpacked = t, wave, momenta, u, multipliers
    limits = [
        (t, np.full_like(wave, sign * 0.9), np.full_like(wave, sign * np.inf), np.full_like(u, sign * 0.8), t)
        for sign in (-1, 1)
    ]
    interval = (*mu, *y, *inputs, *slacks)
    module = SimpleNamespace(
        metadata={
            "task": "control", "method": method, "form": form, "bodies": bodies, "coordinates": names, "rates": rates,
            "control_names": inputs, "free_parameters": ("T",), "inequalities": True, "node": names,
            "interval": interval,
            "meanings": {s: f"slack of x{i} + x1**2 <= {i} at 1/2 of an interval" for i, s in enumerate(slacks)},
        },
        make_grid=lambda steps: SimpleNamespace(is_multiplier=np.zeros(9)),
        initial_guess=lambda grid: "guess",
        variable_bounds=lambda grid: ("lower", "upper"),
        unpack=lambda grid, vector: {"guess": unpacked, "lower": limits[0], "upper": limits[1]}[vector],
        evaluate=lambda grid, unknowns: SimpleNamespace(gradient="zeros"),
        views=lambda grid, vector: (None, np.full((bodies, steps, len(interval)), 0.0 if vector == "zeros" else 0.3)),
    )  # fmt: skip
    if conditions:
        first = len(names)
        module.SLACKS = first + np.arange(len(interval) - conditions, len(interval))
        module.SLACK_MULTIPLIERS = first + np.arange(len(mu), len(mu) + conditions)
    result = Result(
        problem="invented", title="Move " + "very " * 30 + "far.", task="control", method=method, scheme="midpoint",
        driver="newton", steps=steps, status="solved", message="", cost=1.0, residual=0.0, stationarity=0.0,
        iterations=3, t=t, q=wave, p=momenta, u=u, multipliers=multipliers, energy=None,
        log=10.0 ** -np.arange(18.0).reshape(3, 6), names={}, summary={"T": 1.0}, unknowns=np.zeros(1),
    )  # fmt: skip
    return module, result


def overlaps(figure: Figure) -> list[str]:
    """Pairs of panels whose boxes, with all labels, titles and legends, overlap, and what leaves the page."""
    FigureCanvasAgg(figure)
    figure.draw_without_rendering()
    renderer = figure.canvas.get_renderer()
    parts = [(axes.get_ylabel() or "drawing", axes.get_tightbbox(renderer)) for axes in figure.axes]
    parts += [("legend", legend.get_window_extent(renderer)) for legend in figure.legends]
    parts.append(("title", figure._suptitle.get_window_extent(renderer)))
    found = []
    for (one, a), (other, b) in itertools.combinations(parts, 2):
        wide, high = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
        found += [f"{one} and {other}"] if wide > 1.0 and high > 1.0 else []
    page = figure.bbox
    found += [name for name, box in parts if box.x0 < -1 or box.y0 < -1 or box.x1 > page.x1 + 1 or box.y1 > page.y1 + 1]
    return found


def picture(bodies: int, height: float = 1.0) -> Scene:
    """All kinds of items, for some bodies."""
    t = np.linspace(0.0, 1.0, 7)
    x, y = t + 0.3 * np.arange(bodies)[:, None], height * t**2 + 0.0 * np.arange(bodies)[:, None]
    one = np.ones((1, 1))
    place = (x, y)
    return Scene(
        t,
        (
            Ground((-one, 0 * one), (3 * one, 0 * one), label="ground"),
            Circle((one, one), one, label="target"),
            Mark((one, one), label="centre"),
            Trail(place, label="path"),
            Rod((0 * x, 0 * y), place, label="arm"),
            Box(place, 0.2 + 0 * x, 0.1 + 0 * x, x, label="hull"),
            Mass(place, 0.05 + 0 * x, label="bob"),
            Arrow(place, (0.3 + 0 * x, 0.1 + 0 * y), label="force"),
        ),
    )


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
    with matplotlib.rc_context(style.STYLE):
        figure = plots.control_figure(module, result, plots.Drawings(drawn, drawn) if drawn else None, "nondimensional")
        assert overlaps(figure) == []
    assert figure.get_figheight() < 30.0
    panels_of = {axes.get_ylabel() for axes in figure.axes}
    assert {plots.label(f"x{i + 1}") for i in range(states)} <= panels_of


def test_what_does_not_fit_is_counted():
    module, result = invented(14, 13, 1, "lagrangian")
    title = plots.control_figure(module, result).get_suptitle().replace("\n", " ")
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
    plots.save(module, replace(result, status="non-finite", cost=float(number), **broken), tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 1000


class TestShapes:
    def test_extent(self):
        one = np.ones((1, 1))
        left, right, bottom, top = shapes.extent([Scene(np.zeros(1), (Mass((2 * one, 3 * one), one),))])
        assert left < 1.0 < 3.0 < right
        assert bottom < 2.0 < 4.0 < top
        box = Box((0 * one, 0 * one), 4 * one, 2 * one, np.pi / 2 * one)
        left, right, bottom, top = shapes.extent([Scene(np.zeros(1), (box,))])
        np.testing.assert_allclose([right, top], [1.2, 2.2])
        assert (left, bottom) == (-right, -top)

    def test_extent_of_nothing_finite(self):
        nothing = np.full((1, 2), np.nan)
        assert shapes.extent([Scene(np.zeros(2), (Trail((nothing, nothing)),))]) == (-1.0, 1.0, -1.0, 1.0)

    def test_instants(self):
        scene, room = picture(2), (-2.0, 2.0, -2.0, 2.0)
        still = list(shapes.instant(scene, 3, room, moving=False))
        assert len(still) == 4  # ground is a line and a band
        moving = list(shapes.instant(scene, 3, room, moving=True))
        assert len(moving) == 2 * 5
        trail = moving[0]
        np.testing.assert_allclose(trail.get_xdata(), scene.t[:4])

    def test_no_artist_where_there_is_no_number(self):
        x = np.array([[0.0, np.nan]])
        scene = Scene(np.arange(2.0), (Mass((x, x), 1 + 0 * x), Arrow((x, x), (1 + 0 * x, x))))
        assert len(list(shapes.instant(scene, 0, (0, 1, 0, 1), moving=True))) == 2
        assert list(shapes.instant(scene, 1, (0, 1, 0, 1), moving=True)) == []

    def test_ground_is_hatched_to_the_right(self):
        one = np.ones((1, 1))
        scene = Scene(np.zeros(1), (Ground((-one, 0 * one), (one, 0 * one)),))
        band, line = shapes.instant(scene, 0, (-1, 1, -1, 1), moving=False)
        assert band.get_hatch()
        assert band.get_xy()[:, 1].min() < 0.0 == band.get_xy()[:, 1].max()
        np.testing.assert_array_equal(line.get_ydata(), [0, 0])

    def test_several_bodies_leave_only_arrows_on_their_way(self):
        axes = Figure().add_subplot()
        scene = picture(3)
        shapes.course(axes, scene, shapes.extent([scene]))
        arrows = [patch for patch in axes.patches if isinstance(patch, matplotlib.patches.FancyArrowPatch)]
        assert len(arrows) == 3 * shapes.MANY_SHOTS
        assert len([p for p in axes.patches if isinstance(p, matplotlib.patches.Circle) and p.get_fill()]) == 0


class TestSimulation:
    def test_phase_portrait_and_energy(self, interpreted):
        module = interpreted("pendulum")
        result = drivers.solve(module, steps=50)
        figure = plots.simulation_figure(result)
        portrait, energy = figure.axes
        assert (portrait.get_xlabel(), portrait.get_ylabel()) == ("$q$", "$p$")
        np.testing.assert_array_equal(portrait.lines[0].get_xdata(), result.q[:, 0])
        np.testing.assert_allclose(np.abs(energy.lines[0].get_ydata()).max(), result.summary["energy_drift"])

    def test_with_a_drawing(self, interpreted, tmp_path):
        result = drivers.solve(interpreted("pendulum"), steps=50)
        bob = np.sin(result.q.T), -np.cos(result.q.T)
        scene = Scene(result.t, (Trail(bob), Mass(bob, 0.1 + 0 * bob[0])))
        with matplotlib.rc_context(style.STYLE):
            figure = plots.simulation_figure(result, scene, "nondimensional")
            assert overlaps(figure) == []
        assert len(figure.axes) == 3
        assert figure.axes[-1].get_xlabel() == "time (nondimensional)"

    def test_long_paths_are_thinned(self):
        t = np.linspace(0.0, 1.0, 100_001)
        result = replace(
            invented(1, 1, 1, "lagrangian")[1], t=t, q=t[:, None], p=t[:, None], energy=t, names={"q": "x", "p": "p"}
        )
        assert plots.simulation_figure(result).axes[0].lines[0].get_xdata().size <= 20_001


@pytest.mark.parametrize(("suffix", "signature"), [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_files(tmp_path, suffix, signature):
    module, result = invented(1, 1, 1, "lagrangian")
    drawn = picture(1)
    plots.save(module, result, tmp_path / f"a.{suffix}", plots.Drawings(drawn, drawn))
    assert (tmp_path / f"a.{suffix}").read_bytes().startswith(signature)


def test_pictures_are_reproducible(tmp_path):
    module, result = invented(2, 1, 2, "lagrangian")
    for name in ("a.svg", "b.svg"):
        plots.save(module, result, tmp_path / name)
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()


def test_first_guess(interpreted):
    module = interpreted("bounded", BOUNDED)
    result = replace(unsolved(module), q=np.full((5, 1), 7.0))
    guess = first_guess(module, result)
    np.testing.assert_allclose(guess.q[:, 0], np.linspace(0, 1, 5))
    assert guess.log is None
