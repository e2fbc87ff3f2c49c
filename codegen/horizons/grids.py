"""The grids of sampling times: what stays from one to the next, bounds and a solver's storage, is made once."""

from __future__ import annotations

from typing import Any

from codegen.errors import NumericsError
from codegen.horizons.interface import Interface
from codegen.interfaces import Grid, Vector
from codegen.runtime.search.bounds import contradictory_bounds
from codegen.runtime.search.iterates import on_grid, search_on


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
