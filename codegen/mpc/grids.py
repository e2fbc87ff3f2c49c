"""The grids of sampling times: what stays from one to the next, bounds and a solver's storage, is made once.

The shifted solution: what a plan says of the time that follows, as the start of the next solve. By a whole number of
intervals values move to earlier nodes and intervals; by another, they are interpolated, linearly between nodes, and in
the mean where controls are constant. Beyond the end nodes follow the last interval's straight line, and controls stay.
Source: Diehl, Bock and Schloeder (2005), A real-time iteration scheme for nonlinear optimization in optimal feedback
control, SIAM J. Control Optim. 43.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from codegen.errors import NumericsError
from codegen.mpc.interface import Interface
from codegen.runtime.search.bounds import contradictory_bounds
from codegen.runtime.search.iterates import on_grid, search_on
from codegen.solving.loading import Grid, Indices, Vector


class Grids:
    """Makes grids of so many steps of a module, and keeps the last one, whose state alone most often changes.

    `search` is what a search on the last grid can take over from those before, or None. Grids on which
    nothing `is_searched` have no bounds either.
    """

    def __init__(self, module: Any, interface: Interface, steps: int, is_searched: bool = True) -> None:
        self._module, self._steps, self._interface, self._is_searched = module, steps, interface, is_searched
        self._is_bounded = is_searched and bool(module.metadata.inequalities)
        self._given: dict[str, Any] | None = None
        self._last: Any = None
        self.search: Any = None

    def at(self, given: dict[str, Any], start: Vector | None = None) -> Grid:
        """The grid with run-time values, and with its bounds; it holds until the next one is asked for.

        The state is `start` (states,), by default the problem's own. Raises NumericsError for values that are unusable.
        """
        if start is None or self._given != given:
            self._keep(self.separate(given))
            self._given = None if start is None else given
        if start is not None:
            self._last.parameters[0, self._interface.start] = start
        return self._last  # type: ignore[no-any-return]

    def separate(self, given: dict[str, Any]) -> Grid:
        """A grid of its own with run-time values, among which the state may be."""
        try:
            return self._module.make_grid(self._steps, **given)  # type: ignore[no-any-return]
        except ValueError as error:  # modules know nothing of errors of this package
            raise NumericsError(str(error), "correct the run-time values") from error

    def _keep(self, grid: Any) -> None:
        """Keep a grid; where its bounds are those of the last one, with these, and with the search that has them."""
        module, same = self._module, self.search is not None
        if self._is_bounded:
            bounds = module.variable_bounds(grid)
            same = same and all(map(_are_same, bounds, self._last.bounds))
            grid = grid._replace(bounds=self._last.bounds if same else bounds)
        self._last = grid
        if self._is_searched:
            is_contradictory = not same and self._is_bounded and contradictory_bounds(grid) >= 0
            self.search = on_grid(self.search, grid) if same else None if is_contradictory else search_on(grid)


def _are_same(one: Vector, other: Vector) -> bool:
    """Return True if two arrays hold the same bits, in a tenth of the time of `array_equal`."""
    return one.tobytes() == other.tobytes()


@dataclass(frozen=True, eq=False)
class Shift:
    """A linear map of unknowns (n,): each is a sum of two others, `one` and `two`, with weights.

    `is_single` says that it is the first of them alone.
    """

    one: Indices
    two: Indices
    weight_one: Vector
    weight_two: Vector
    is_single: bool

    def __call__(self, unknowns: Vector) -> Vector:
        """The unknowns (n,) of the plan as it is at the next sampling time."""
        if self.is_single:
            return self.weight_one * unknowns.take(self.one)
        return self.weight_one * unknowns[self.one] + self.weight_two * unknowns[self.two]


def shift_by(module: Any, grid: Grid, intervals: float) -> Shift:
    """The shift by so many intervals of a grid, a number that need not be whole; intervals are equally long.

    What only the ends have, such as their velocities, stays where it is, since it is zero at inner nodes; so do
    unknowns that no node has.
    """
    numbers = np.arange(grid.is_multiplier.size, dtype=float)
    of_nodes, of_intervals = module.views(grid, numbers)
    one, two, first, second = numbers.copy(), numbers.copy(), np.ones(numbers.size), np.zeros(numbers.size)
    (one_node, one_interval), (two_node, two_interval) = (module.views(grid, indices) for indices in (one, two))
    (node_first, interval_first), (node_second, interval_second) = (
        module.views(grid, weights) for weights in (first, second)
    )
    # Nodes lie on the line through two neighbours, which beyond the end is that of the last interval.
    places, last = np.arange(grid.steps + 1) + intervals, grid.steps - 1
    left = np.minimum(places.astype(int), last)
    one_node[:], two_node[:] = of_nodes[:, left], of_nodes[:, left + 1]
    node_second[:] = (places - left)[:, None]
    node_first[:] = 1.0 - node_second
    # Intervals have the mean of what two of them have.
    places = places[:-1]
    left = places.astype(int)
    one_interval[:], two_interval[:] = (of_intervals[:, np.minimum(which, last)] for which in (left, left + 1))
    interval_second[:] = np.where(left < last, places - left, 0.0)[:, None]
    interval_first[:] = 1.0 - interval_second
    for only in module.problem.structure.only_at_ends:
        one_node[:, :, only] = of_nodes[:, :, only]
        node_first[:, :, only] = node_second[:, :, only] = 0.0
        node_first[:, [0, -1], only] = 1.0
    return Shift(one.astype(np.intp), two.astype(np.intp), first, second, not second.any())
