"""Derivatives on graphs against sympy's derivatives of trees, and against differences in 120-digit arithmetic."""

import subprocess
import sys
from pathlib import Path

import mpmath
import pytest
import sympy
from hypothesis import given, settings
from hypothesis import strategies as st
from sympy import Max, Min, Piecewise, Rational, atan2, cos, exp, log, sin, sqrt, symbols

from codegen.discretise import transcribe
from codegen.discretise.model.from_problem import load_problem
from codegen.emit.differentiation import control_derivatives
from codegen.evidence.checks.base import DIGITS, function_of, gradient, random_points, second_differences
from codegen.symbolic.derivatives import second_derivatives
from codegen.symbolic.graph import Graph, StraightLine
from codegen.symbolic.zeros import vanishing

ROOT = Path(__file__).parents[2]
X, Y, Z, P = symbols("x y z p", real=True)
UNKNOWNS = (X, Y, Z)


def _next(parts):
    pairs = st.tuples(parts, parts)
    return st.one_of(
        pairs.map(lambda ab: ab[0] + ab[1]),
        pairs.map(lambda ab: ab[0] - ab[1]),
        pairs.map(lambda ab: ab[0] * ab[1]),
        pairs.map(lambda ab: ab[0] / (2 + ab[1] ** 2)),
        pairs.map(lambda ab: atan2(ab[0], 1 + ab[1] ** 2)),
        st.tuples(parts, st.integers(2, 3)).map(lambda an: an[0] ** an[1]),
        parts.map(sin),
        parts.map(cos),
        parts.map(lambda a: exp(sin(a)) - 1),
        parts.map(lambda a: log(1 + a**2)),
        parts.map(lambda a: sqrt(1 + a**2)),
        parts.map(lambda a: (2 + cos(a)) ** P),
    )


NUMBERS = st.sampled_from([Rational(1, 2), Rational(-3), Rational(2, 3), sympy.pi, sqrt(2)])
SMOOTH = st.recursive(st.sampled_from([X, Y, Z, P]) | NUMBERS, _next, max_leaves=14)
KINKED = SMOOTH.flatmap(
    lambda a: SMOOTH.map(lambda b: a * Max(a, b) + Min(a, b, 1) ** 2 + Piecewise((a * b, a < b), (b**2, True)) + abs(a))
)
POINT = {X: 0.7, Y: -0.4, Z: 1.3, P: 0.9}


def evaluated(program: StraightLine, point) -> list:
    """The values of a straight-line program."""
    known = {symbol: sympy.Float(value, DIGITS) for symbol, value in point.items()}
    for symbol, value in program.assignments:
        known[symbol] = value.xreplace(known).evalf(DIGITS)
    return [value.xreplace(known).evalf(DIGITS) for value in program.values]


def assert_number(found, wanted) -> None:
    with mpmath.workdps(DIGITS):
        found, wanted = mpmath.mpmathify(found), mpmath.mpmathify(wanted)
        assert abs(found - wanted) <= 1e-25 * max(1, abs(wanted)), (found, wanted)


@settings(max_examples=40)
@given(SMOOTH)
def test_derivatives_are_those_of_the_tree(scalar):
    found, point = second_derivatives(scalar, UNKNOWNS), {s: sympy.Float(v, DIGITS) for s, v in POINT.items()}
    first = evaluated(found.gradient, POINT)
    second = dict(zip(found.indices, evaluated(found.hessian, POINT), strict=True))
    for i, x in enumerate(UNKNOWNS):
        slope = sympy.diff(scalar, x)
        assert_number(first[i], slope.xreplace(point).evalf(DIGITS))
        for j in range(i + 1):
            assert_number(second.get((i, j), 0), sympy.diff(slope, UNKNOWNS[j]).xreplace(point).evalf(DIGITS))


@settings(max_examples=40)
@given(KINKED)
def test_derivatives_of_functions_with_branches(scalar):
    numbers = [POINT[symbol] for symbol in (*UNKNOWNS, P)]
    function = function_of((*UNKNOWNS, P), [scalar])
    pairs = [(i, j) for i in range(3) for j in range(i + 1)]
    slopes, curvatures = gradient(function, numbers, range(3)), second_differences(function, numbers, pairs)
    found = second_derivatives(scalar, UNKNOWNS)
    first = evaluated(found.gradient, POINT)
    second = dict(zip(found.indices, evaluated(found.hessian, POINT), strict=True))
    for value, wanted in zip(first, slopes, strict=True):
        assert_number(value, wanted)
    for pair in pairs:
        assert_number(second.get(pair, 0), curvatures[pair])


@settings(max_examples=40)
@given(SMOOTH)
def test_assignments_read_only_what_stands_before_them_and_entries_without_unknowns_read_none(scalar):
    found = second_derivatives(scalar, UNKNOWNS)
    for program in (found.gradient, found.hessian):
        assigned = set()
        for symbol, value in program.assignments:
            assert symbol not in scalar.free_symbols | assigned
            assert value.free_symbols <= {*UNKNOWNS, P} | assigned
            assigned.add(symbol)
        for value in program.values:
            assert value.free_symbols <= {*UNKNOWNS, P} | assigned
    for (i, j), value in zip(found.indices, found.hessian.values, strict=True):
        if sympy.diff(scalar, UNKNOWNS[i], UNKNOWNS[j]).free_symbols <= {P}:
            assert value.free_symbols <= {P} or not value.free_symbols - {P} <= set(UNKNOWNS)


def test_entries_that_cancel_are_left_out():
    scalar = sin(X + Y) - sin(X) * cos(Y) - cos(X) * sin(Y) + X * Z
    assert second_derivatives(scalar, UNKNOWNS).indices == ((2, 0),)


def test_constant_entries_are_written_in_parameters_alone():
    scalar = P * (X**2 + Y) ** 2 + P**2 * Z * (X - 3 * Y) + Z**2 / P
    found = second_derivatives(scalar, UNKNOWNS)
    entries = dict(zip(found.indices, found.hessian.values, strict=True))
    assert entries[2, 0] == P**2
    assert entries[2, 1] == -3 * P**2
    assert entries[2, 2] == 2 / P
    assert entries[1, 1] == 2 * P
    assert all(symbol.name != "p" for symbol in entries[0, 0].free_symbols - {P})


def test_nothing_is_said_to_vanish_where_functions_have_branches():
    graph = Graph((X,))
    assert vanishing(graph, [graph.of(Max(X, 2) - 2)]) == set()
    assert vanishing(graph, [graph.of(sin(X) ** 2 + cos(X) ** 2 - 1)]) != set()


def test_equal_values_have_one_node():
    graph = Graph(UNKNOWNS)
    pairs = [
        (2 * X + 2 * Y, X + Y, 2),
        (X * Y**2, Y * (Y * X), 1),
        ((X - Y) * Z, (Y - X) * Z, -1),
        (sqrt(X + Y) ** 2, X + Y, 1),
    ]
    for one, other, factor in pairs:
        left, right = graph.scaled(graph.of(one)), graph.scaled(graph.of(other))
        assert left[1] == right[1]
        assert left[0] == factor * right[0]


@pytest.mark.parametrize(("scalar", "digits"), [(log(1 + X**2), "log1p"), (3 * exp(X) - 3, "expm1")])
def test_what_loses_digits_is_rewritten(scalar, digits):
    assert digits in str(second_derivatives(scalar + X * Y * Z, UNKNOWNS, (scalar,)).gradient)


def test_a_deep_expression_takes_neither_long_nor_many_operations():
    scalar = X
    for _ in range(12):
        scalar = sin(scalar) * scalar + Y
    found = second_derivatives(scalar, UNKNOWNS)
    assert len(found.hessian.assignments) < 250  # the tree has 4096 leaves
    step = mpmath.mpf(10) ** -35
    with mpmath.workdps(DIGITS):

        def at(x, y):
            value = x
            for _ in range(12):
                value = mpmath.sin(value) * value + y
            return value

        x, y = mpmath.mpf(0.3), mpmath.mpf(0.2)
        slope = (at(x + step, y) - at(x - step, y)) / (2 * step)
        curvature = (at(x + step, y) - 2 * at(x, y) + at(x - step, y)) / step**2
    point = {X: 0.3, Y: 0.2}
    assert_number(evaluated(found.gradient, point)[0], slope)
    assert_number(evaluated(found.hessian, point)[found.indices.index((0, 0))], curvature)


@pytest.mark.parametrize("method", ["variational", "hamiltonian"])
def test_element_of_a_chain_of_three_pendulums(method):
    program = transcribe.transcribe(
        load_problem(ROOT / "problems" / "n_link_pendulum.py", {"links": "3"}), None, method
    )
    found = control_derivatives(program).element
    assert found.hessian_assignments
    others = sorted(program.element.free_symbols - set(found.unknowns), key=str)
    symbols_ = [*found.unknowns, *others]
    scalar = function_of(symbols_, [program.element])
    (point,) = random_points([program.element], symbols_, program.model, count=1)
    numbers = [point[symbol] for symbol in symbols_]
    indices = range(len(found.unknowns))
    pairs = [(i, j) for i in indices for j in range(i + 1)]
    slopes, curvatures = gradient(scalar, numbers, indices), second_differences(scalar, numbers, pairs)
    entries = {(row, column): value for row, column, value in found.hessian}
    assert len(entries) == len(found.hessian)
    first = evaluated(StraightLine(found.gradient_assignments, found.gradient), point)
    second = evaluated(StraightLine(found.hessian_assignments, tuple(entries.values())), point)
    stored = dict(zip(entries, second, strict=True))
    for value, wanted in zip(first, slopes, strict=True):
        assert_number(value, wanted)
    for pair in pairs:
        assert_number(stored.get(pair, 0), curvatures[pair])


def test_the_same_program_whatever_the_hash_seed():
    code = (
        "from sympy import *; from codegen.symbolic.derivatives import second_derivatives;"
        "q, r, v, w, m = symbols('q r v w m', real=True);"
        "l = m*(cos(q)*v + cos(r)*w)**2 + m*(sin(q)*v + sin(r)*w)**2 + exp(q*r)/m + Max(q, v)*w;"
        "print(second_derivatives(l, (q, r, v, w), (l*m,)))"
    )
    texts = {
        subprocess.run(
            [sys.executable, "-c", code],
            env={"PYTHONHASHSEED": seed, "PYTHONPATH": str(ROOT)},
            capture_output=True, text=True, check=True,
        ).stdout
        for seed in ("0", "1", "2")
    }  # fmt: skip
    assert len(texts) == 1
