"""Code for blocks of points: arrays that hold one quantity after the other, of all points of the block.

The inner loop over the points then reads neighbours in memory, at distances that are known when it is compiled, and
calls nothing that has branches: a compiler turns it into operations on several points at once.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from codegen.lower.kernels import Line


@dataclass(frozen=True)
class BlockLoop:
    """A function that adds up what all particles j contribute to each point m of a block.

    `views` make arrays of pointers. `head` comes first; for each block `before` for each point m of it; `inputs` for
    each particle j, then for each m `point_inputs`, `body` and `outputs`; at last `after` for each m, in a loop whose
    code is `over_points` where it is not needed always. Blocks divide the points from `begin` to `end`, which are
    code.
    """

    name: str
    summary: str
    arguments: tuple[str, ...]
    decorator: str
    views: tuple[Line, ...]
    head: tuple[Line, ...]
    before: tuple[Line, ...]
    inputs: tuple[Line, ...]
    point_inputs: tuple[Line, ...]
    body: tuple[Line, ...]
    outputs: tuple[Line, ...]
    after: tuple[Line, ...]
    operations_before: int
    operations_after: int
    over_points: tuple[str, ...] = ()
    begin: str = "0"
    end: str = "z.shape[1]"


def entry(array: str, row: int, block: str) -> str:
    """The code of a quantity of point m, where `block` is the constant that holds the length of a row."""
    offset = "" if row == 0 else f"{block} + " if row == 1 else f"{row}*{block} + "
    return f"{array}[{offset}m]"


def packed(line: Line) -> Line:
    """A line with logarithms that have no branches in place of those of the C library."""
    code = re.sub(r"\b(?:math\.)?(log1p|x_minus_log1p|log1p_minus_ratio)\(", r"packed_\1(", line.code)
    return Line(line.target, code, line.comment, line.operator)
