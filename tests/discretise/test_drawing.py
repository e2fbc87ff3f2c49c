"""Drawings: what an author may write, and what a model makes of it."""

from __future__ import annotations

import inspect
import pickle
from dataclasses import replace

import pytest
import sympy
from conftest import PROBLEMS
from drawn_oscillator import oscillator
from sympy import sin

from codegen import Control, Simulate, body_number, canonical_pair, control, coordinate, parameter, time
from codegen.discretise.model.from_problem import normalise
from codegen.drawing import ITEMS, Arrow, Box, Circle, Ground, Item, Mass, Rod, Trail
from codegen.emit.lower.module import Origin
from codegen.emit.naming import Choices
from codegen.errors import ExpressionError, SymbolError
from codegen.solving.compiler import generate_from_model


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
            (
                lambda: Ground(-2.5),
                "Ground.*'end'",
                r"Ground(start, end, *, label='') with (x, y) or (x, y, z) as start and as end",
            ),
            (lambda: Mass((0, 0)), "'radius'", "Mass(centre, radius, *, label='') with (x, y) or (x, y, z) as centre"),
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
            ([Mass((0, 0), 1), Trail((0, 0, 0, 0))], ExpressionError, r"drawing\[1\], a Trail, point .*three in space"),
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
