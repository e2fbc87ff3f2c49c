"""What is written as a relation in normal form: g = 0 or g <= 0."""

from __future__ import annotations

from typing import Any

import pytest
import sympy
from hypothesis import given
from hypothesis import strategies as st
from sympy import Eq, Ge, Gt, Le, Lt, sqrt

from codegen.discretise.model.relations import relation
from codegen.errors import CodegenError

Q, U, R = sympy.symbols("q u R", real=True)
RELATIONS = [
    (Q**2 + U**2 <= R**2, "q**2 + u**2 <= R**2", Q**2 + U**2 - R**2, False),
    (Ge(Q, R), "q >= R", R - Q, False),
    (Lt(Q, R), "q <= R", Q - R, False),
    (Gt(Q, R), "q >= R", R - Q, False),
    (Le(1, Q, evaluate=False), "1 <= q", 1 - Q, False),
    (Eq(Q, sqrt(R)), "q = sqrt(R)", Q - sqrt(R), True),
    (Q - U, "q - u = 0", Q - U, True),
    (Le(0.1 * Q, 2.5), "0.1*q <= 2.5", 0.1 * Q - 2.5, False),
]


@pytest.mark.parametrize(("written", "name", "expression", "equality"), RELATIONS, ids=[row[1] for row in RELATIONS])
def test_relations(written: Any, name: str, expression: sympy.Expr, equality: bool) -> None:
    found_name, found, is_equality = relation(written, "path[0]")
    assert (found_name, is_equality) == (name, equality)
    assert sympy.expand(found - expression) == 0


numbers = st.integers(-9, 9)


@given(st.lists(numbers, min_size=6, max_size=6), numbers, numbers, st.sampled_from([Le, Ge, Lt, Gt, Eq]))
def test_a_normal_form_holds_where_the_relation_does(weights: list[int], q: int, u: int, kind: Any) -> None:
    left, right = (a * Q**2 + b * U + c for a, b, c in (weights[:3], weights[3:]))
    gap = (left - right).subs({Q: q, U: u})
    holds = {Le: gap <= 0, Lt: gap <= 0, Ge: gap >= 0, Gt: gap >= 0, Eq: gap == 0}[kind]
    found, refusal = None, ""
    try:
        _, found, is_equality = relation(kind(left, right), "path[0]")
    except CodegenError as error:
        refusal = str(error)
    if found is not None:
        value = found.subs({Q: q, U: u})
        assert bool(holds) == bool(value == 0 if is_equality else value <= 0)
        assert is_equality == (kind is Eq)
    elif "always holds" in refusal:
        assert holds
    else:
        assert "never holds" in refusal
        assert not holds or gap == 0
