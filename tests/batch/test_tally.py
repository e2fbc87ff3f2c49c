"""Tallies add up in any order, and survive a journal."""

from __future__ import annotations

import json

import pytest

from codegen.batch.executors import Tally

ONE = Tally({"solved": 3, "stalled": 1}, {"stalled": "at the first"}, 1.5, improved=1)
OTHER = Tally({"stalled": 2, "infeasible": 2, "solved": 1}, {"stalled": "later", "infeasible": "never"}, 0.5, jumps=2)


def test_counts_add_up_and_first_messages_stay():
    both = ONE + OTHER
    assert both.counts == {"solved": 4, "stalled": 3, "infeasible": 2}
    assert both.messages == {"stalled": "at the first", "infeasible": "never"}
    assert (both.seconds, both.improved, both.jumps) == (2.0, 1, 2)
    assert (both.cases, both.solved) == (9, 4)
    assert (OTHER + ONE).counts == both.counts
    assert ONE + Tally() == ONE


def test_failures_come_by_their_number_and_then_by_name():
    assert list((ONE + OTHER).failed.items()) == [("stalled", 3), ("infeasible", 2)]
    assert list(OTHER.failed.items()) == [("infeasible", 2), ("stalled", 2)]
    assert Tally({"solved": 5}).failed == {}


@pytest.mark.parametrize("tally", [Tally(), ONE, OTHER, ONE + OTHER])
def test_a_record_tells_the_tally(tally):
    assert Tally.from_record(json.loads(json.dumps(tally.as_record()))) == tally


@pytest.mark.parametrize(
    "record", [{}, {"counts": {"solved": "many"}, "messages": {}, "seconds": 0}, {"counts": 3}, {"counts": "ab"}]
)
def test_a_record_that_tells_none_is_an_error(record):
    with pytest.raises((KeyError, TypeError, ValueError)):
        Tally.from_record(record)
