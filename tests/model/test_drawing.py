"""Drawings: what an author may write, what a model makes of it, and its numbers along a motion."""

from __future__ import annotations

import inspect
import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sympy
from conftest import PROBLEMS
from sympy import cos, pi, sin

from codegen import (
    Control,
    Simulate,
    body_number,
    canonical_pair,
    control,
    coordinate,
    coordinates,
    free_parameter,
    parameter,
    time,
)
from codegen.author.symbols import recorded_declarations
from codegen.compiler import generate_from_model
from codegen.drawing import ITEMS, Arrow, Box, Circle, Ground, Item, Mass, Rod, Trail
from codegen.errors import ExpressionError, SymbolError
from codegen.lower.module import Origin
from codegen.model import Model, normalise
from codegen.model.from_file import load_problem
from codegen.naming import Choices
from codegen.pictures.scene import fine_times, scene
from codegen.solutions.result import Result

DRAWN = (
    "acrobot brachistochrone cart_pendulum cart_pole convoy crane four_bar hovercraft linear_pendulum "
    "low_thrust n_link_pendulum orbital_transfer pendulum pendulum_swing_up quadrotor spherical_pendulum two_link_arm"
).split()


def oscillator(drawing: Any, **changes: Any) -> Model:
    """A model of an oscillator; the drawing is a function of (q, dq, u, k), called while declarations are recorded."""
    with recorded_declarations() as declared:
        q, dq = coordinate("q")
        u, k = control("u"), parameter("k", 3)
        items = drawing(q, dq, u, k) if callable(drawing) else drawing
        arguments = {"duration": 2, "start": {q: 0, dq: 0}, "end": {q: 1, dq: 0}, "drawing": items, **changes}
        problem = Control(lagrangian=dq**2 / 2 - k * q**2 / 2, force={q: u}, cost=u**2, **arguments)
    return normalise(problem, declared)


def motion(model: Model, t: Any, q: Any, u: Any, **summary: float) -> Any:
    """What `scene` reads of a result; columns of several bodies stand side by side."""
    given = {"t": np.array(t, float), "q": np.array(q, float), "u": np.array(u, float), "summary": summary}
    empty = dict.fromkeys(("problem", "title", "task", "method", "scheme", "driver", "status", "message"), "")
    return Result(**empty, steps=1, residual=0.0, iterations=0, p=given["q"], names={}, **given)


class TestItems:
    @pytest.mark.parametrize("kind", ITEMS)
    def test_every_expression_is_seen_and_replaced_once(self, kind):
        points, names = {"start", "end", "centre", "vector", "point", "place"}, kind.__dataclass_fields__
        item = kind(*((1.0, 2.0) if name in points else 3.0 for name in names if name != "label"))
        values = [value for _, value in item.expressions()]
        doubled = item.mapped(lambda value: 2 * value)
        assert [value for _, value in doubled.expressions()] == [2 * value for value in values]
        assert type(doubled) is kind
        assert len(values) >= 2

    def test_a_label_is_no_expression(self):
        rod = Rod((0, 1), (2, 3), label="boom")
        assert [name for name, _ in rod.expressions()] == ["start", "start", "end", "end"]
        assert rod.mapped(float).label == "boom"

    @pytest.mark.parametrize(
        ("make", "finding", "remedy"),
        [
            (lambda: Ground(-2.5), "Ground.*'end'", r"Ground(start, end, *, label='') with (x, y) as start and as end"),
            (lambda: Mass((0, 0)), "'radius'", "Mass(centre, radius, *, label='') with (x, y) as centre"),
            (lambda: Box((0, 0), 1, 1, 0, "x"), "too many", "Box(centre, width, height, angle=0, *, label='')"),
            (lambda: Rod((0, 0), (1, 1), colour="red"), "'colour'", "Rod(start, end, *, label='')"),
        ],
    )
    def test_arguments_that_do_not_fit_are_answered_by_those_that_do(self, make, finding, remedy):
        with pytest.raises(ExpressionError, match=finding) as caught:
            make()
        assert remedy in caught.value.remedy

    @pytest.mark.parametrize("kind", ITEMS)
    def test_the_site_lists_the_arguments_of_every_kind(self, kind):
        arguments = list(inspect.signature(kind.__init__).parameters.values())[1:-1]
        written = ", ".join(a.name if a.default is a.empty else f"{a.name}={a.default}" for a in arguments)
        assert f"| `{kind.__name__}({written})` |" in (PROBLEMS.parent / "docs" / "guide" / "problems.md").read_text()

    def test_copies_are_equal(self):
        box = Box((0, 1), 2, 3, label="cart")
        assert pickle.loads(pickle.dumps(box)) == replace(box) == box


class TestModel:
    def test_in_plain_symbols(self):
        model = oscillator(lambda q, dq, u, k: [Rod((0, 0), (sin(q), k)), Arrow((q, 0), (u, 0), label="force")])
        q, u, k = sympy.symbols("q u k", real=True)
        zero = sympy.S.Zero
        assert model.drawing == (
            Rod((zero, zero), (sin(q), k)),
            Arrow((q, zero), (u, zero), label="force"),
        )

    def test_none_by_default(self):
        assert oscillator(()).drawing == ()

    def test_lists_do_as_points(self):
        model = oscillator(lambda q, dq, u, k: [Trail([q, 1])])
        assert model.drawing[0].point == (sympy.Symbol("q", real=True), 1)

    def test_time_and_body_number_may_occur_in_it_alone(self):
        t = time("tau")
        assert str(oscillator(lambda q, dq, u, k: [Trail((q, t))]).drawing[0].point[1]) == "t"
        body = body_number()
        model = oscillator(lambda q, dq, u, k: [Trail((q, body))], bodies=3)
        assert model.drawing[0].point[1] == sympy.Symbol("body", real=True)
        assert model.body is None

    def test_simulations_are_drawn_too(self):
        q, p = canonical_pair("q", "p")
        problem = Simulate(hamiltonian=p**2 / 2 + q**2, duration=1, start={q: 1, p: 0}, drawing=[Mass((q, 0), 1)])
        assert len(normalise(problem).drawing) == 1

    @pytest.mark.parametrize(
        ("drawing", "error", "fragment"),
        [
            ({}, ExpressionError, "drawing is a dict"),
            ([(0, 0)], ExpressionError, r"drawing\[0\] is a tuple"),
            ([Item()], ExpressionError, r"drawing\[0\] is a Item"),
            ([Mass((0, 0), 1), Trail((0, 0, 0))], ExpressionError, r"drawing\[1\], a Trail, point .*project"),
            ([Trail(0)], ExpressionError, "two coordinates"),
            ([Rod((0, 0), (1, "x"))], ExpressionError, "end is 'x'"),
            ([Mass((0, 0), None)], ExpressionError, "radius is None"),
            ([Trail((0, 0), label=1)], ExpressionError, "label 1"),
            ([Trail((0, sympy.oo))], ExpressionError, "point contains oo"),
            ([Trail((0, sympy.Symbol("z")))], SymbolError, "z in .* was never declared"),
            ([Mass((0, 0), 0)], ExpressionError, r"radius of drawing\[0\], a Mass, is 0"),
            ([Box((0, 0), 1, -2)], ExpressionError, "height .* is -2"),
            (lambda q, dq, u, k: [Circle((0, 0), 2 - k)], ExpressionError, "radius .* is -1"),
            (lambda q, dq, u, k: [Trail((q, dq))], ExpressionError, "depends on dq"),
            (lambda q, dq, u, k: [Trail((q.of(0), 0))], ExpressionError, "depends on q_0"),
            (lambda q, dq, u, k: [Trail((q, parameter("size", 1)))], SymbolError, "size occurs in the drawing only"),
            (lambda q, dq, u, k: [Trail((q, coordinate("z")[0]))], SymbolError, "z occurs in the drawing only"),
        ],
    )
    def test_what_cannot_be_drawn_is_refused(self, drawing, error, fragment):
        with pytest.raises(error, match=fragment):
            oscillator(drawing)

    def test_one_time_only(self):
        (q, dq), u, t, other = coordinate("q"), control("u"), time(), time("tau")
        arguments = {"lagrangian": dq**2 / 2 + t * q, "force": {q: u}, "cost": u**2, "duration": 1}
        with pytest.raises(SymbolError, match="two times"):
            normalise(Control(**arguments, drawing=[Trail((q, other))]))

    def test_it_changes_nothing_that_is_derived(self):
        model = oscillator(lambda q, dq, u, k: [Rod((0, 0), (q, k)), Arrow((q, 0), (u, 0))])
        origin = Origin("oscillator.py", "codegen build oscillator.py", "0", ())
        drawn, plain = (generate_from_model(m, Choices(), origin) for m in (model, replace(model, drawing=())))
        assert drawn == plain


class TestScene:
    def test_one_body(self):
        model = oscillator(lambda q, dq, u, k: [Rod((0, 0), (sin(q), -cos(q))), Arrow((q, k), (u, 0)), Mass((1, 2), k)])
        found = scene(model, motion(model, [0, 1, 2], [[0], [pi / 2], [pi]], [[5], [7]]))
        rod, arrow, mass = found.items
        np.testing.assert_array_equal(found.t, [0, 1, 2])
        np.testing.assert_allclose(rod.end[0], [[0, 1, 0]], atol=1e-15)
        np.testing.assert_allclose(rod.end[1], [[-1, 0, 1]], atol=1e-15)
        np.testing.assert_array_equal(rod.start[0], [[0, 0, 0]])
        # The control of an interval holds from its left node on; the last node has that of the last interval.
        np.testing.assert_array_equal(arrow.vector[0], [[5, 7, 7]])
        assert mass.radius.tolist() == [[3.0]]

    def test_between_nodes(self):
        model = oscillator(lambda q, dq, u, k: [Arrow((q, 0), (u, 0))])
        found = scene(model, motion(model, [0, 1, 2], [[0], [2], [6]], [[5], [7]]), np.array([0.5, 1.75]))
        np.testing.assert_allclose(found.items[0].start[0], [[1, 5]])
        np.testing.assert_allclose(found.items[0].vector[0], [[5, 7]])

    def test_controls_at_nodes_are_interpolated(self):
        model = oscillator(lambda q, dq, u, k: [Arrow((q, 0), (u, 0))])
        found = scene(model, motion(model, [0, 2], [[0], [2]], [[5], [7]]), np.array([0.5]))
        np.testing.assert_allclose(found.items[0].vector[0], [[5.5]])

    def test_several_bodies(self):
        with recorded_declarations() as declared:
            (x, y), (dx, dy) = coordinates("x y")
            f, body = control("f"), body_number()
            problem = Control(
                lagrangian=(dx**2 + dy**2) / 2,
                force={x: f},
                cost=f**2,
                duration=1,
                bodies=2,
                drawing=[Trail((x, y)), Circle((body, 0), 1), Mass((0, 0), 1)],
            )
        model = normalise(problem, declared)
        # Columns: x and y of body 0, x and y of body 1.
        trail, circle, mass = scene(model, motion(model, [0, 1], [[1, 2, 3, 4], [5, 6, 7, 8]], [[0, 0]])).items
        np.testing.assert_array_equal(trail.point[0], [[1, 5], [3, 7]])
        np.testing.assert_array_equal(trail.point[1], [[2, 6], [4, 8]])
        np.testing.assert_array_equal(circle.centre[0], [[0], [1]])
        assert mass.radius.shape == (1, 1)

    def test_time_and_free_parameters(self):
        T = free_parameter("T", 1)
        t = time()
        model = oscillator(lambda q, dq, u, k: [Trail((t, T))], duration=T)
        found = scene(model, motion(model, [0, 4], [[0], [1]], [[0]], T=4.0))
        np.testing.assert_array_equal(found.items[0].point, [[[0, 4]], [[4, 4]]])

    def test_what_has_no_value_is_nan(self):
        model = oscillator(lambda q, dq, u, k: [Trail((sympy.sqrt(q), 1 / q))])
        x, y = scene(model, motion(model, [0, 1], [[-1], [0]], [[0]])).items[0].point
        assert np.isnan(x[0, 0])
        assert np.isinf(y[0, 1])

    @pytest.mark.parametrize("name", DRAWN)
    def test_gallery(self, name):
        """Every drawing of the gallery has finite numbers along a made-up motion."""
        model = load_problem(PROBLEMS / f"{name}.py")
        count, controls = len(model.coordinates) * model.bodies, len(model.controls) * model.bodies
        grid = np.linspace(0.0, 1.0, 5)
        q = np.array([[0.3 + 0.1 * i + 0.2 * t for i in range(count)] for t in grid])
        free = {f.symbol.name: 2.0 for f in model.free_parameters}
        found = scene(model, motion(model, grid, q, np.full((4, controls), 0.5), **free))
        assert len(found.items) == len(model.drawing) > 2
        for item in found.items:
            shapes = {array.shape for _, array in item.expressions()}
            assert len(shapes) == 1
            assert shapes < {(1, 1), (1, 5), (model.bodies, 5)} or shapes == {(model.bodies, 5)}
            assert all(np.isfinite(array).all() for _, array in item.expressions())
        assert any(array.shape[1] == 5 for item in found.items for _, array in item.expressions())

    def test_fine_times_keep_the_nodes(self):
        t = np.array([0.0, 1.0, 3.0])
        fine = fine_times(t, least=8)
        np.testing.assert_allclose(fine, [0, 0.25, 0.5, 0.75, 1, 1.5, 2, 2.5, 3])
        np.testing.assert_array_equal(fine_times(t, least=1), t)
