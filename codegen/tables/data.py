"""A table as numbers: breakpoints, and at each of them what the piecewise polynomials through it are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

KINDS = {
    "cubic": "a cubic spline with two continuous derivatives",
    "monotone": "cubics with one continuous derivative that are monotone where the data are",
    "linear": "straight lines, whose slope jumps at every breakpoint",
    "steps": "the value of the breakpoint before, with a slope of zero",
}
"""How values between breakpoints follow, and what that says of derivatives."""
OUTSIDE = {
    "error": "a solution that reads it outside its range is no solution",
    "clamp": "outside it has the value at the edge, and the slope zero",
    "extend": "outside the outermost polynomials go on",
}
"""What holds beyond the first and the last breakpoint."""


@dataclass(frozen=True)
class Shape:
    """What of a table a generated module is built for: everything but its numbers.

    `inputs` are one or two, `sizes` the numbers of breakpoints of each.
    """

    name: str
    inputs: tuple[str, ...]
    output: str
    kind: str
    outside: str
    sizes: tuple[int, ...]

    @property
    def lookup(self) -> str:
        """The emitted function that looks the table up."""
        return f"table_{self.name}"

    @property
    def width(self) -> int:
        """How many numbers stand at a breakpoint: the value, and for cubics what it needs of slopes."""
        return 1 if self.kind in ("linear", "steps") else 2 ** len(self.sizes)

    @property
    def count(self) -> int:
        """How many numbers the table is."""
        return sum(self.sizes) + int(np.prod(self.sizes)) * self.width


@dataclass(frozen=True)
class TableData:
    """A table: its shape, the file that it comes from, and its numbers, shape (count,).

    First come the breakpoints of each input; then, at every breakpoint (of two inputs the second runs fastest), the
    value, and for cubics the slopes: of one input f, f'; of two f, its slopes by the first and by the second, and the
    mixed second derivative. Cubic polynomials in Hermite's form follow from them, whatever the kind of spline.
    """

    shape: Shape
    source: str
    numbers: tuple[float, ...]

    @property
    def summary(self) -> str:
        """What the table is, on one line."""
        shape = self.shape
        ranges = " and ".join(
            f"{name} ({axis.size} from {axis[0]:g} to {axis[-1]:g})"
            for name, axis in zip(shape.inputs, self.axes, strict=True)
        )
        return f"{shape.name} = {shape.output} of {ranges}, {shape.kind}, from {self.source}"

    @property
    def axes(self) -> list[NDArray[np.float64]]:
        """The breakpoints of each input."""
        ends = np.cumsum(self.shape.sizes)
        return np.split(np.array(self.numbers[: ends[-1]]), ends[:-1])

    @property
    def heights(self) -> NDArray[np.float64]:
        """What stands at breakpoints, shape (*sizes, width)."""
        return np.array(self.numbers[sum(self.shape.sizes) :]).reshape(*self.shape.sizes, self.shape.width)


def fitted(shape: Shape, source: str, axes: Sequence[NDArray[np.float64]], values: NDArray[np.float64]) -> TableData:
    """The table through values, shape `sizes`, at the breakpoints of its axes.

    Cubic splines have the end conditions "not a knot"; of two inputs they are products of those of one. Sources: de
    Boor (2001), A practical guide to splines, chapters 4 and 17; Fritsch and Butland (1984), A method for constructing
    local monotone piecewise cubic interpolants, SIAM J. Sci. Stat. Comput. 5.
    """
    heights = [values]
    if shape.width > 1:
        heights = [values, *(_slopes(shape.kind, axis, values, index) for index, axis in enumerate(axes))]
        if len(axes) == 2:
            heights.append(_slopes(shape.kind, axes[1], heights[1], 1))
    stacked = np.stack(heights, axis=-1)
    numbers = np.concatenate([*axes, stacked.ravel()])
    return TableData(shape, source, tuple(map(float, numbers)))


def _slopes(kind: str, axis: NDArray[np.float64], values: NDArray[np.float64], index: int) -> NDArray[np.float64]:
    """The slopes at the breakpoints of the spline along one axis."""
    from scipy.interpolate import CubicSpline, PchipInterpolator

    spline = (CubicSpline if kind == "cubic" else PchipInterpolator)(axis, values, axis=index)
    return np.asarray(spline(axis, nu=1), dtype=float)
