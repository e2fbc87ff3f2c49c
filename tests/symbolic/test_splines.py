"""Tables as functions: their derivatives of every order against scipy's splines, in several arithmetics."""

from __future__ import annotations

from itertools import product

import mpmath
import numpy as np
import pytest
import sympy
from scipy.interpolate import CubicSpline, PchipInterpolator, RectBivariateSpline, RegularGridInterpolator

from codegen import Table
from codegen.problem.symbols import states
from codegen.symbolic.functions import numbers_of, table_function, tables_of
from codegen.symbolic.tables import TableData
from codegen.symbolic.zeros import identically_zero

X, Y = np.array([0.0, 0.3, 1.0, 1.4, 2.0, 3.1, 3.5]), np.array([-1.0, 0.0, 0.5, 2.0, 2.2])
HEIGHTS = np.random.default_rng(3).normal(size=X.size)
GRID = np.random.default_rng(4).normal(size=(X.size, Y.size))


@pytest.fixture
def files(folder):
    (folder / "curve.csv").write_text("x,f\n" + "".join(f"{x!r},{f!r}\n" for x, f in zip(X.tolist(), HEIGHTS.tolist())))
    rows = [
        f"{x!r},{y!r},{GRID[i, j].item()!r}\n" for (i, x), (j, y) in product(*map(enumerate, (X.tolist(), Y.tolist())))
    ]
    (folder / "grid.csv").write_text("x,y,f\n" + "".join(reversed(rows)))
    return folder


def derivative(table: Table, order: tuple[int, ...], at: tuple[np.ndarray, ...]) -> np.ndarray:
    return np.asarray(table_function(table.data, order)._imp_(*at), dtype=float)


AT = np.linspace(-0.4, 3.9, 60), np.linspace(-1.3, 2.5, 60)


@pytest.mark.parametrize("order", range(4))
@pytest.mark.parametrize(("kind", "spline"), [("cubic", CubicSpline), ("monotone", PchipInterpolator)])
def test_curves_are_scipys(files, kind, spline, order):
    found = derivative(Table("curve.csv", "x", "f", kind=kind), (order,), AT[:1])
    assert found == pytest.approx(spline(X, HEIGHTS)(AT[0], nu=order), rel=1e-11, abs=1e-9)


@pytest.mark.parametrize("order", [o for o in product(range(4), repeat=2) if sum(o) <= 3])
def test_surfaces_are_scipys(files, order):
    # Inside alone: RectBivariateSpline goes on with constants.
    at = np.clip(AT[0], X[0], X[-1] - 1e-9), np.clip(AT[1], Y[0], Y[-1] - 1e-9)
    found = derivative(Table("grid.csv", ("x", "y"), "f"), order, at)
    surface = RectBivariateSpline(X, Y, GRID, s=0)
    if max(order) <= 2:
        assert found == pytest.approx(surface.ev(*at, *order), rel=1e-9, abs=1e-8)
    else:  # of which scipy has no derivative: by differences of the second ones
        by = (1e-6, 0.0) if order[0] == 3 else (0.0, 1e-6)
        lower = tuple(o - (o == 3) for o in order)
        moved = [surface.ev(at[0] + s * by[0], at[1] + s * by[1], *lower) for s in (0, 1)]
        inside = np.searchsorted(X, at[0]) == np.searchsorted(X, at[0] + by[0])
        inside &= np.searchsorted(Y, at[1]) == np.searchsorted(Y, at[1] + by[1])
        assert found[inside] == pytest.approx(((moved[1] - moved[0]) / 1e-6)[inside], rel=1e-4, abs=1e-3)


def test_a_cubic_spline_has_two_continuous_derivatives(files):
    table = Table("grid.csv", ("x", "y"), "f")
    for order in [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]:
        left = derivative(table, order, (X[1:-1] - 1e-13, np.full(5, 0.7)))
        right = derivative(table, order, (X[1:-1] + 1e-13, np.full(5, 0.7)))
        assert left == pytest.approx(right, rel=1e-9, abs=1e-9)


def test_lines_are_straight(files):
    curve, surface = Table("curve.csv", "x", "f", kind="linear"), Table("grid.csv", ("x", "y"), "f", kind="linear")
    inside = np.clip(AT[0], X[0], X[-1]), np.clip(AT[1], Y[0], Y[-1])
    assert derivative(curve, (0,), inside[:1]) == pytest.approx(np.interp(inside[0], X, HEIGHTS))
    exact = RegularGridInterpolator((X, Y), GRID)(np.stack(inside, axis=1))
    assert derivative(surface, (0, 0), inside) == pytest.approx(exact)
    assert not derivative(curve, (2,), inside[:1]).any()


def test_monotone_tables_do_not_overshoot(folder):
    (folder / "step.csv").write_text("x,f\n0,0\n1,0\n2,1\n3,1\n")
    at = (np.linspace(0, 3, 200),)
    monotone, cubic = (derivative(Table("step.csv", "x", "f", kind=k), (0,), at) for k in ("monotone", "cubic"))
    assert monotone.min() >= 0 <= 1 >= monotone.max()
    assert cubic.max() > 1.02


def test_clamped_tables_stay_at_their_edges(files):
    table = Table("grid.csv", ("x", "y"), "f", outside="clamp")
    corner = (np.array([9.0]), np.array([-7.0]))
    assert derivative(table, (0, 0), corner) == GRID[-1, 0]
    assert not derivative(table, (1, 0), corner).any()
    beside = (np.array([9.0]), np.array([0.2]))
    edge = RectBivariateSpline(X, Y, GRID, s=0)
    assert derivative(table, (0, 1), beside) == pytest.approx(edge.ev([X[-1]], [0.2], 0, 1))
    assert not derivative(table, (1, 1), beside).any()


def test_derivatives_of_expressions(files):
    x, y = states("x y")
    curve, surface = Table("curve.csv", "x", "f"), Table("grid.csv", ("x", "y"), "f", name="g")
    expression = surface(sympy.sin(x), x * y) * curve(x) ** 2
    point = {x: 1.1, y: 0.9}
    with mpmath.workdps(60):
        function = sympy.lambdify([x, y], expression, "mpmath")
        for by in ((1, 0), (0, 1), (2, 0), (1, 1)):
            exact = mpmath.diff(function, (mpmath.mpf("1.1"), mpmath.mpf("0.9")), by, h=mpmath.mpf(10) ** -25)
            symbolic = sympy.diff(expression, *([x] * by[0] + [y] * by[1])).subs(point).evalf(30)
            assert float(symbolic) == pytest.approx(float(exact), rel=1e-12)
    step = 1e-200
    slope = sympy.lambdify([x, y], expression)(1.1 + 1j * step, 0.9).imag / step
    assert slope == pytest.approx(float(sympy.diff(expression, x).subs(point).evalf()), rel=1e-13)


def test_nothing_is_zero_that_is_not_proved(files):
    x, y = states("x y")
    surface = Table("grid.csv", ("x", "y"), "f")
    assert identically_zero(surface(x + y, y) - surface(y + x, y))
    assert not identically_zero(surface(x, y) - surface(y, x))
    assert not identically_zero(sympy.diff(surface(x, y), x, x))
    assert sympy.diff(surface(x, y), x, 4) == 0


def test_equal_tables_are_one(files):
    x = states("x")[0]
    one, other = (Table("curve.csv", "x", "f") for _ in range(2))
    assert one(x) == other(x)
    assert tables_of((one(x), {}), [other(2 * x)]) == (one.data,)
    assert len(numbers_of(one(x))) == 3 * X.size
    assert one(0.3) == pytest.approx(HEIGHTS[1])
    assert float(one(1).evalf()) == pytest.approx(HEIGHTS[2])  # a whole number is a number as well
    assert one(1).is_positive == (HEIGHTS[2] > 0)
    assert one.range == ((0.0, 3.5),)
    assert isinstance(one.data, TableData)


def test_comments_and_blanks_are_no_numbers(folder):
    (folder / "t.csv").write_text("# from a book\n\n x , f # names\n0,1\n 1 ,2 # measured\n,\n2,3\n3,5\n")
    table = Table("t.csv", "x", "f")
    assert table.values.tolist() == [1, 2, 3, 5]
