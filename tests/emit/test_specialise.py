"""Deciding branches on sizes beforehand changes the text of the numerics, never what it computes."""

from __future__ import annotations

import ast
import re
from importlib import resources

import pytest
from hypothesis import given
from hypothesis import strategies as st

from codegen.emit.rendering import specialise

NAMES = ("SHARED", "SHARED_MULTIPLIERS", "COUPLINGS", "PHASES")
LOOPS = resources.files("codegen.emit") / "templates" / "loops.txt"


def test_branch_is_included_without_its_test_or_left_out():
    text = "def f(x):\n    if SHARED:\n        # why\n        x += 1\n        x *= 2\n    return x\n"
    assert specialise(text, {"SHARED": 3}) == "def f(x):\n    x += 1\n    x *= 2\n    return x\n"
    assert specialise(text, {"SHARED": 0}) == "def f(x):\n    return x\n"


def test_other_branch():
    text = "if SHARED:\n    a = 1\nelse:\n    a = [\n        2,\n    ]\n"
    assert specialise(text, {"SHARED": 1}) == "a = 1\n"
    assert specialise(text, {"SHARED": 0}) == "a = [\n    2,\n]\n"


@pytest.mark.parametrize("size", [0, 1])
def test_elif_is_refused(size):
    """It looks like an `if` inside an `else`, and would become unconditional."""
    with pytest.raises(AssertionError, match="an elif after X"):
        specialise("if X:\n    a\nelif b:\n    c\n", {"X": size})


def test_combined_condition_keeps_what_is_unknown():
    text = "if SHARED and x > 0:\n    a = 1\nelse:\n    a = 2\n"
    assert specialise(text, {"SHARED": 2}) == "if x > 0:\n    a = 1\nelse:\n    a = 2\n"
    assert specialise(text, {"SHARED": 0}) == "a = 2\n"


def test_empty_loop():
    text = "for i in range(SHARED):\n    for j in range(3):\n        f(i, j)\nfor i in range(n, SHARED):\n    g(i)\n"
    assert specialise(text, {"SHARED": 0}) == "for i in range(n, SHARED):\n    g(i)\n"
    assert specialise(text, {"SHARED": 1}) == text


def test_function_with_its_decorator():
    text = "if SHARED:\n\n    @njit(cache=True)\n    def f(x):\n        return x\n\n\ng(1)\n"
    assert specialise(text, {"SHARED": 1}) == "@njit(cache=True)\ndef f(x):\n    return x\n\n\ng(1)\n"
    assert specialise(text, {"SHARED": 0}) == "\n\ng(1)\n"


def test_summand_that_is_zero():
    text = "a = f(LAST + SHARED + COUPLINGS)  # why\nfor i in range(2 * LAST + SHARED):\n    f(SHARED, SHARED + i)\n"
    expected = "a = f(LAST + COUPLINGS)  # why\nfor i in range(2 * LAST):\n    f(SHARED, SHARED + i)\n"
    assert specialise(text, {"SHARED": 0, "COUPLINGS": 1}) == expected
    assert specialise(text, {"SHARED": 1, "COUPLINGS": 1}) == text


def test_nested_branches():
    text = "if SHARED:\n    if COUPLINGS:\n        a = 1\n    else:\n        a = 2\n    b = 3\n"
    assert specialise(text, {"SHARED": 1, "COUPLINGS": 0}) == "a = 2\nb = 3\n"


@pytest.mark.parametrize(
    "text",
    [
        "if OTHER:\n    a = 1\n",
        "if not SHARED:\n    a = 1\n",
        "if SHARED or x:\n    a = 1\n",
        "a = SHARED if SHARED else 0\n",
    ],
)
def test_everything_else_stays(text):
    assert specialise(text, {"SHARED": 0}) == text


statements = st.deferred(lambda: simple | branches | loops)
simple = st.sampled_from(
    [
        "seen.append(1)",
        "seen.append(\n    2\n)",
        "x += 1",
        "seen.append(x)",
        "x += 2 + SHARED",
        "seen.append(x + SHARED + COUPLINGS)",
    ]
)
blocks = st.lists(statements, min_size=1, max_size=3).map("\n".join)
conditions = st.sampled_from(["SHARED", "COUPLINGS", "SHARED and x > 1", "COUPLINGS and SHARED", "x > 1"])


def indented(text: str) -> str:
    return "\n".join(f"    {line}" for line in text.splitlines())


branches = st.builds(
    lambda condition, body, other: (
        f"if {condition}:\n{indented(body)}\nseen.append('always')"
        if other is None
        else f"if {condition}:\n{indented(body)}\nelse:\n    seen.append('else')\n{indented(other)}"
    ),
    conditions,
    blocks,
    st.none() | blocks,
)
loops = st.builds(
    lambda count, body: f"for i in range({count}):\n{indented(body)}\nseen.append('after')",
    st.sampled_from(["SHARED", "COUPLINGS", "2"]),
    blocks,
)


@pytest.mark.slow
@given(text=blocks, sizes=st.fixed_dictionaries({name: st.integers(0, 2) for name in NAMES}))
def test_what_is_computed_stays_the_same(text, sizes):
    """An empty loop that is all there is in a block would leave the block empty; so blocks end with a statement."""
    results = []
    for version in (text, specialise(f"{text}\n", sizes)):
        names = {**sizes, "seen": [], "x": 0}
        exec(compile(version, "version", "exec"), names)
        results.append((names["seen"], names["x"]))
    assert results[0] == results[1]


@pytest.mark.parametrize("size", [0, 1])
def test_loops_leave_nothing_undecided(size):
    text = LOOPS.read_text(encoding="utf-8")
    names = sorted(set(re.findall(r"^ *if ([A-Z]+)(?: and .*)?:$", text, re.MULTILINE)))
    assert len(names) > 4
    tree = ast.parse(specialise(text, dict.fromkeys(names, size)))
    tests = [ast.unparse(node.test) for node in ast.walk(tree) if isinstance(node, (ast.If, ast.IfExp, ast.While))]
    assert [test for test in tests if any(name in test.split() for name in names)] == []
