"""What is made of jumps between local optima: the worse side is begun from the better one, and what then jumps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

import numpy as np

from codegen.sweeping.jumps import Costs, Pair

BETTER = 1e-7
"""What part of a cost has to be won for a solution to be another one."""


class Solved(Protocol):
    """What is known of a solution: its cost, and whether others may start from it."""

    @property
    def is_start(self) -> bool:
        """Whether they may."""

    @property
    def cost(self) -> float:
        """What it costs, NaN where it is none."""


class Neighbours(Protocol):
    """Which cases are neighbours; their costs (n,) are NaN where there is no solution."""

    def jumps(self, costs: Costs, certain: bool = False) -> list[Pair]:
        """Pairs of neighbours between which the cost jumps, or does so beyond doubt."""

    def followers(self, worse: int, better: int, costs: Costs) -> list[int]:
        """What may follow a case that was improved from its neighbour."""


Found = TypeVar("Found", bound=Solved)


def improved(
    outcomes: Sequence[Found], neighbours: Neighbours, attempt: Callable[[int, Found], Found]
) -> dict[int, list[Found]]:
    """Try the worse side of every jump from its neighbour, and what then jumps, until nothing improves.

    `outcomes` are those of all cases; `attempt` solves a case from a solution. Returns the further attempts at each
    case that has some; of these and its outcome the cheapest solution counts.
    """
    costs = np.array([outcome.cost if outcome.is_start else np.nan for outcome in outcomes])
    best, attempts, tried = list(outcomes), dict[int, list[Found]](), set[tuple[int, int, float]]()
    behind: list[Pair] = []
    while True:
        begun, pairs, behind = len(tried), [*neighbours.jumps(costs), *behind], []
        for worse, better in dict.fromkeys(pairs):
            key = (worse, better, float(costs[better]))
            # Each case may be improved from several sides, but a search has to end.
            if key in tried or len(tried) >= 2 * len(best):
                continue
            tried.add(key)
            found = attempt(worse, best[better])
            if is_better(found, best[worse]):
                best[worse], costs[worse] = found, found.cost
                behind += [(other, worse) for other in neighbours.followers(worse, better, costs)]
            attempts.setdefault(worse, []).append(found)
        if len(tried) == begun:
            return attempts


def is_better(found: Solved, than: Solved) -> bool:
    """Whether a solution is another one than a solution of the same case, and costs less."""
    return found.is_start and found.cost < than.cost - BETTER * abs(than.cost)
