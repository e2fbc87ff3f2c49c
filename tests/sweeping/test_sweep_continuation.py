"""Warm starts along a path: what each case is begun from, and what it falls back to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from codegen.sweeping.continuation import OTHERS, Continuation


@dataclass(frozen=True)
class Found:
    name: str
    is_start: bool


def continuation(places, families=None):
    points = np.array(places, dtype=float)[:, None]
    return Continuation(points, np.zeros(len(points), int) if families is None else np.array(families))


def recorded(chain, place, solvable=lambda start: True):
    """Where the attempts at a case began."""
    starts = []

    def attempt(start):
        starts.append(start and start.name)
        return Found(f"case {place}", solvable(start))

    return starts, chain.solve(place, attempt)


def test_the_first_from_its_own_guess_and_the_others_from_the_last():
    chain = continuation([0, 1, 2])
    assert recorded(chain, 0)[0] == [None]
    assert recorded(chain, 1)[0] == ["case 0"]
    assert recorded(chain, 2)[0] == ["case 1"]


def test_where_the_last_neighbour_is_no_help_the_own_guess_and_then_the_nearest():
    chain = continuation([0, 1, 2, 3, 4, 5.0])
    for place in range(5):
        recorded(chain, place)
    starts, attempts = recorded(chain, 5, lambda start: start is not None and start.name == "case 2")
    assert starts == ["case 4", None, "case 3", "case 2"]
    assert attempts[-1].is_start
    assert len(attempts) == 4


def test_where_nothing_helps_the_outcome_is_that_from_the_own_guess():
    chain = continuation(range(7))
    for place in range(6):
        recorded(chain, place)
    starts, attempts = recorded(chain, 6, lambda start: False)
    assert starts == ["case 5", None, "case 4", "case 3", "case 2"]
    assert len(starts) == 2 + OTHERS
    assert len(attempts) == len(starts)
    assert recorded(chain, 0, lambda start: False)[0][0] == "case 5"  # what failed is no start


def test_cases_of_other_modules_are_no_starts():
    chain = continuation([0, 1, 2], [0, 1, 0])
    recorded(chain, 0)
    assert recorded(chain, 1)[0] == [None]
    assert recorded(chain, 2)[0] == ["case 0"]
