"""Families of alike rows, against the rows from which they were made."""

import pytest
from sympy import Symbol, cos, sin, symbols

from codegen.symbolic.terms import are_many, families

pytestmark = pytest.mark.fast
X = symbols("x0:60", real=True)
K = Symbol("k", real=True)


def spring(i):
    return K * (X[i + 1] - X[i]) - K * (X[i] - X[i - 1]), cos(X[i])


def test_rows_of_a_chain_are_one_family_that_gives_every_row_back():
    rows = [spring(i) for i in range(1, 50)]
    (family,) = families(rows)
    assert [member.row for member in family.members] == list(range(49))
    for member, row in zip(family.members, rows, strict=True):
        symbols_of_row = dict(zip(family.slots, member.symbols, strict=True))
        assert tuple(value.xreplace(symbols_of_row) for value in family.template) == row


def test_other_functions_numbers_and_kinds_make_other_families():
    rows = [spring(1), spring(9), (spring(2)[0], sin(X[2])), (2 * spring(2)[0], cos(X[2])), spring(3)]
    found = families(rows, lambda symbol: symbol in X[:4])
    assert [[member.row for member in family.members] for family in found] == [[0], [1], [2], [3], [4]]
    assert [[member.row for member in family.members] for family in families(rows)] == [[0, 1, 4], [2], [3]]


def test_few_rows_and_rows_of_many_kinds_are_not_many():
    assert are_many(families([spring(i) for i in range(1, 50)]))
    assert not are_many(families([spring(i) for i in range(1, 20)]))
    assert not are_many(families([(X[i] ** (2 + i // 2),) for i in range(50)]))
