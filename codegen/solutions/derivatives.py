"""What sensitivities are: the derivatives of a solution by each quantity, and what is to be said of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from codegen.errors import NumericsError
from codegen.interfaces import Matrix, Vector

INACCURATE = 1e-7
"""Parts of their terms that linear equations may leave: beyond it derivatives are not what they should be."""
_NAMED = 3
"""Places that are told of those where strict complementarity fails."""


@dataclass(frozen=True)
class Derivatives:
    """Derivatives of a solution by one quantity, in the problem's units.

    Of the cost, of `durations` (D,), one for each phase, of `free` parameters by name, and of arrays of the result, of
    whose shapes they are: `t`, and at nodes that move with it `q` and `p`; `u`, `multipliers`, and `unknowns` (n,).
    """

    cost: float
    durations: Vector
    free: dict[str, float]
    t: Vector = field(repr=False)
    q: Matrix = field(repr=False)
    p: Matrix = field(repr=False)
    u: Matrix = field(repr=False)
    multipliers: Matrix = field(repr=False)
    unknowns: Vector = field(repr=False)


@dataclass(frozen=True, eq=False)
class Sensitivities(Mapping[str, Derivatives]):
    """Derivatives by all quantities: parameters by their names, boundary values such as `start.x`, and `duration`.

    Boundary values, and a given duration, follow parameters by the problem's formulas, as in a sweep. Where bounds
    hold, they are those with the same set of active bounds. `costs` (m,) are the derivatives of the cost, in the order
    of the names. `reason` says why there are no derivatives; `doubtful` names where strict complementarity fails: there
    bounds begin to hold or cease to, and derivatives are one-sided at best. `inaccuracy` is what is left of the linear
    equations, in parts of their terms.
    """

    names: tuple[str, ...]
    costs: Vector
    reason: str
    doubtful: tuple[str, ...]
    inaccuracy: float
    _by_name: Mapping[str, Derivatives] = field(repr=False)

    def __getitem__(self, name: str) -> Derivatives:
        """Derivatives by a quantity; NumericsError where there are none, KeyError for a name that is no quantity."""
        if self.reason and name in self.names:
            raise NumericsError(f"there are no derivatives by {name}: {self.reason}", "see its reason")
        return self._by_name[name]

    def __iter__(self) -> Iterator[str]:
        """The names of all quantities."""
        return iter(self.names)

    def __len__(self) -> int:
        """How many quantities there are."""
        return len(self.names)

    @property
    def notes(self) -> list[str]:
        """What a user should know, a line each."""
        found = [f"no sensitivities: {self.reason}"] if self.reason else []
        if self.doubtful:
            places, rest = ", ".join(self.doubtful[:_NAMED]), len(self.doubtful) - _NAMED
            more = f" and {rest} more" if rest > 0 else ""
            found.append(f"sensitivities may be one-sided: strict complementarity fails for {places}{more}")
        if not self.reason and self.inaccuracy > INACCURATE:
            found.append(f"sensitivities are inaccurate: {self.inaccuracy:.0e} of their linear equations is left")
        return found
