"""Leave out of the numerics what a scene lacks: branches and loops over features of which there are none.

The files of `codegen/runtime` are written for every scene. Sizes such as SHARED are literal numbers in a generated
module, so `if SHARED:` and `for j in range(SHARED):` are decided when it is made: what they guard is included, without
the test, or left out.
"""

from __future__ import annotations

import ast
import textwrap
from collections.abc import Mapping


def specialise(text: str, sizes: Mapping[str, int]) -> str:
    """Source text in which every branch on the name of a size, and every loop over an empty one, has been decided.

    `if NAME:` and `if NAME and other:` are understood, with an `else` that is no `elif`, and `for ... in range(NAME):`.
    """
    while True:
        lines = text.splitlines()
        for node in ast.walk(ast.parse(text)):
            decided = _decided(node, lines, sizes)
            if decided is not None:
                text = "\n".join(decided) + "\n"
                break
        else:
            return text


def _decided(node: ast.AST, lines: list[str], sizes: Mapping[str, int]) -> list[str] | None:
    """The lines with one statement decided, or None when there is nothing to decide about it."""
    if isinstance(node, ast.For):
        empty = isinstance(node.iter, ast.Call) and [sizes.get(getattr(a, "id", ""), 1) for a in node.iter.args] == [0]
        return _replaced(lines, node, []) if empty else None
    if not isinstance(node, ast.If):
        return None
    combined = isinstance(node.test, ast.BoolOp) and isinstance(node.test.op, ast.And)
    name = getattr(node.test.values[0] if isinstance(node.test, ast.BoolOp) and combined else node.test, "id", "")
    if name not in sizes:
        return None
    if sizes[name] == 0:
        return _replaced(lines, node, node.orelse)
    if combined:
        first = node.lineno - 1
        return [*lines[:first], lines[first].replace(f"{name} and ", "", 1), *lines[first + 1 :]]
    return _replaced(lines, node, node.body)


def _replaced(lines: list[str], node: ast.If | ast.For, kept: list[ast.stmt]) -> list[str]:
    """The lines with a statement replaced by some of the statements inside it."""
    inner = lines[kept[0].lineno - 1 : kept[-1].end_lineno] if kept else []
    body = textwrap.indent(textwrap.dedent("\n".join(inner)), " " * node.col_offset).splitlines()
    return [*lines[: node.lineno - 1], *body, *lines[node.end_lineno :]]
