"""Leave out of the loops over intervals what a problem lacks: branches, loops and summands for absent features.

The loops in `templates/loops.txt` are written for every problem. Sizes such as SHARED are literal numbers in a
generated module, so `if SHARED:` and `for j in range(SHARED):` are decided when the module is made: their bodies are
included, without the test, or left out.
"""

from __future__ import annotations

import ast
import re
import textwrap
from collections.abc import Mapping


def specialise(text: str, sizes: Mapping[str, int]) -> str:
    """Source text in which every branch on the name of a size, and every loop over an empty one, has been decided.

    `if NAME:` and `if NAME and other:` are understood, with an `else` that is no `elif`, and `for ... in range(NAME):`.
    In a sum `... + NAME`, a size that is zero is left out.
    """
    while _may_be_undecided(text, sizes):
        lines, chosen = text.splitlines(), list[_Site]()
        # What lies inside, or on a line of, something decided has to wait for the next round.
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, _Site) and _decided(node, lines, sizes) and not any(_meet(node, c) for c in chosen):
                chosen.append(node)
        if not chosen:
            return text
        for node in sorted(chosen, key=lambda node: -node.lineno):  # so that lines above keep their numbers
            lines = _decided(node, lines, sizes) or lines
        text = "\n".join(lines) + "\n"
    return text


def _may_be_undecided(text: str, sizes: Mapping[str, int]) -> bool:
    """Whether a text has words that look like something to decide; parsing it, to be certain, takes far longer."""
    names, zeros = "|".join(sizes), "|".join(name for name, size in sizes.items() if size == 0)
    tests, empty = rf"\bif ({names})\b", rf"(\bin range\(|\+ )({zeros})\b"
    return bool((names and re.search(tests, text)) or (zeros and re.search(empty, text)))


_Site = ast.If | ast.For | ast.BinOp
"""Where there may be something to decide."""


def _meet(one: _Site, other: _Site) -> bool:
    """Whether two sites have a line in common."""
    return one.lineno <= (other.end_lineno or 0) and other.lineno <= (one.end_lineno or 0)


def _decided(node: _Site, lines: list[str], sizes: Mapping[str, int]) -> list[str] | None:
    """The lines with one statement decided, or None when there is nothing to decide about it."""
    if isinstance(node, ast.BinOp):
        return _without_zero(lines, node, sizes)
    if isinstance(node, ast.For):
        empty = isinstance(node.iter, ast.Call) and [sizes.get(getattr(a, "id", ""), 1) for a in node.iter.args] == [0]
        return _replaced(lines, node, []) if empty else None
    combined = isinstance(node.test, ast.BoolOp) and isinstance(node.test.op, ast.And)
    name = getattr(node.test.values[0] if isinstance(node.test, ast.BoolOp) and combined else node.test, "id", "")
    if name not in sizes:
        return None
    assert not any(_is_elif(branch, lines) for branch in node.orelse), f"an elif beside {name}"
    if sizes[name] == 0:
        return _replaced(lines, node, node.orelse)
    if combined:
        first = node.lineno - 1
        return [*lines[:first], lines[first].replace(f"{name} and ", "", 1), *lines[first + 1 :]]
    return _replaced(lines, node, node.body)


def _is_elif(statement: ast.stmt, lines: list[str]) -> bool:
    """Whether a statement is the `elif` of another one, from which it cannot be told by its syntax tree."""
    return isinstance(statement, ast.If) and lines[statement.lineno - 1].lstrip().startswith("elif ")


def _without_zero(lines: list[str], node: ast.BinOp, sizes: Mapping[str, int]) -> list[str] | None:
    """The lines without the name of a size that is zero and is added, on one line, to something else."""
    name = getattr(node.right, "id", "")
    if not isinstance(node.op, ast.Add) or sizes.get(name, 1) or node.lineno != node.end_lineno:
        return None
    row, (begin, end) = node.lineno - 1, (node.left.end_col_offset, node.right.end_col_offset)
    line = lines[row].encode()  # columns count bytes
    assert line[begin:end] == f" + {name}".encode(), "a left operand in parentheses"
    return [*lines[:row], (line[:begin] + line[end:]).decode(), *lines[row + 1 :]]


def _replaced(lines: list[str], node: ast.If | ast.For, kept: list[ast.stmt]) -> list[str]:
    """The lines with a statement replaced by some of the statements inside it."""
    inner = lines[_first_line(kept[0]) - 1 : kept[-1].end_lineno] if kept else []
    body = textwrap.indent(textwrap.dedent("\n".join(inner)), " " * node.col_offset).splitlines()
    return [*lines[: node.lineno - 1], *body, *lines[node.end_lineno :]]


def _first_line(node: ast.stmt) -> int:
    """The line where a statement begins, with its decorators."""
    decorators: list[ast.expr] = getattr(node, "decorator_list", [])
    return min([node.lineno, *(decorator.lineno for decorator in decorators)])
