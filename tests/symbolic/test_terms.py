"""Terms of conditions sorted into kinds."""

import sympy
from sympy import acos, sqrt, symbols

from codegen.symbolic.terms import sorted_terms

a, b, c, d = QUANTITIES = symbols("a b c d", real=True)
INDICES = {symbol: index for index, symbol in enumerate(QUANTITIES)}


def kinds_and_values(conditions, point):
    """The number of kinds, and every condition's value as the sum of its instances'."""
    kinds, instances = sorted_terms(conditions, INDICES)
    values = [sympy.S.Zero] * len(conditions)
    for instance in instances:
        kind = kinds[instance.kind]
        values[instance.row] += kind.expression.subs(
            dict(zip(kind.arguments, (point[index] for index in instance.indices), strict=True)), simultaneous=True
        )
    return len(kinds), values


def test_squared_differences_of_either_sign_are_one_kind():
    conditions = [(a - b) ** 2 + (c - d) ** 2 - 1, (c - a) ** 2 + (d - b) ** 2 - 1]
    point = (2, 3, 5, 11)
    kinds, values = kinds_and_values(conditions, point)
    assert kinds == 2  # a squared difference and a constant
    assert values == [1 + 36 - 1, 9 + 64 - 1]


def test_odd_powers_and_parts_of_other_functions_keep_their_values():
    conditions = [(a - b) ** 3, (b - a) ** 3 + acos(1 / sqrt((d - a) ** 2 + 1)), (c - a) * (c - d)]
    point = (2, 3, 5, 11)
    _, values = kinds_and_values(conditions, point)
    exact = [condition.subs(dict(zip(QUANTITIES, point, strict=True))) for condition in conditions]
    assert values == exact
