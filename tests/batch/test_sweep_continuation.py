"""Warm starts along a path: what each case is begun from, and what it falls back to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from codegen.batch.case import OTHERS, Continuation


@dataclass(frozen=True)
class Found:
    name: str
    is_start: bool
    has_tangent: bool = False

    def without_tangent(self):
        return replace(self, has_tangent=False)


def continuation(places, families=None, warm=True):
    points = np.array(places, dtype=float)[:, None]
    return Continuation(points, np.zeros(len(points), int) if families is None else np.array(families), warm)


def secant(start):
    return f"{start.before.name} through {start.solution.name} by {start.factor:g}"


def recorded(chain, place, solvable=lambda start: True):
    """Where the attempts at a case began."""
    starts = []

    def attempt(start):
        starts.append(start and (start.solution.name if start.before is None else secant(start)))
        return Found(f"case {place}", solvable(start))

    return starts, chain.solve(place, attempt)


def test_the_first_from_its_own_guess_and_the_others_from_the_last():
    chain = continuation([0, 1, 9, 2])
    assert recorded(chain, 0)[0] == [None]
    assert recorded(chain, 1)[0] == ["case 0"]
    assert recorded(chain, 2)[0] == ["case 1"]  # too far to follow the secant


def test_on_a_straight_part_of_the_path_along_the_secant():
    chain = continuation([0, 1, 2.5, 2.5])
    recorded(chain, 0)
    recorded(chain, 1)
    assert recorded(chain, 2)[0] == ["case 0 through case 1 by 1.5"]
    assert recorded(chain, 3)[0] == ["case 1 through case 2 by 0"]
    points = np.array([[0, 0], [0, 1], [0, 2], [1, 2], [1, 1.0]])
    chain = Continuation(points, np.zeros(5, int), True)
    starts = [recorded(chain, place)[0] for place in range(5)]
    assert starts == [[None], ["case 0"], ["case 0 through case 1 by 1"], ["case 2"], ["case 3"]]


def test_along_the_tangent_where_it_is_known_and_along_both_on_a_straight_part():
    chain, starts = continuation([0, 1, 2, 9]), []

    def attempt(start):
        starts.append(start)
        return Found(f"case {len(starts) - 1}", True, has_tangent=True)

    for place in range(4):
        (found,) = chain.solve(place, attempt)
        assert not found.has_tangent  # what is kept takes no memory for it
    assert starts[0] is None
    assert [(s.solution.name, s.is_along_tangent, s.factor) for s in starts[1:]] == [
        ("case 0", True, 0.0), ("case 1", True, 1.0), ("case 2", True, 0.0),
    ]  # fmt: skip
    assert [s.before and s.before.name for s in starts[1:]] == [None, "case 0", None]
    assert all(s.solution.has_tangent for s in starts[1:])


def test_where_a_tangent_is_no_help_its_solution_is_tried_after_the_own_guess():
    chain = continuation([0, 1.0])
    chain.solve(0, lambda start: Found("case 0", True, has_tangent=True))
    starts = []

    def attempt(start):
        starts.append(start)
        return Found("case 1", len(starts) == 3)

    chain.solve(1, attempt)
    assert [start and start.is_along_tangent for start in starts] == [True, None, False]


def test_where_a_secant_is_no_help_its_end_is_tried_after_the_own_guess():
    chain = continuation([0, 1, 2.0])
    recorded(chain, 0)
    recorded(chain, 1)
    starts, _ = recorded(chain, 2, lambda start: start is not None and start.before is None)
    assert starts == ["case 0 through case 1 by 1", None, "case 1"]


def test_where_the_last_neighbour_is_no_help_the_own_guess_and_then_the_nearest():
    chain = continuation([0, 1, 2, 3, 4, 15.0])
    for place in range(5):
        recorded(chain, place)
    starts, attempts = recorded(chain, 5, lambda start: start is not None and start.solution.name == "case 2")
    assert starts == ["case 4", None, "case 3", "case 2"]
    assert attempts[-1].is_start
    assert len(attempts) == 4


def test_where_nothing_helps_the_outcome_is_that_from_the_own_guess():
    chain = continuation([*range(6), 60])
    for place in range(6):
        recorded(chain, place)
    starts, attempts = recorded(chain, 6, lambda start: False)
    assert starts == ["case 5", None, "case 4", "case 3", "case 2"]
    assert len(starts) == 2 + OTHERS
    assert len(attempts) == len(starts)
    assert recorded(chain, 6, lambda start: False)[0] == starts  # what failed is no start


def test_cases_of_other_modules_are_no_starts():
    chain = continuation([0, 1, 2], [0, 1, 0])
    recorded(chain, 0)
    assert recorded(chain, 1)[0] == [None]
    assert recorded(chain, 2)[0] == ["case 0"]


def test_unless_starts_are_warm_neighbours_are_for_what_fails():
    chain = continuation([0, 1, 2], warm=False)
    assert recorded(chain, 0)[0] == [None]
    assert recorded(chain, 1)[0] == [None]
    starts, attempts = recorded(chain, 2, lambda start: start is not None)
    assert starts == [None, "case 1"]
    assert attempts[-1].is_start
