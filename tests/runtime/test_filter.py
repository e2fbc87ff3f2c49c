"""The filter of a line search: which trials it takes, what it keeps and when it forgets."""

from __future__ import annotations

from codegen.runtime.optimise import filter


def test_filter() -> None:
    kept = filter.Filter(10.0)
    kept.pairs.append((2.0, 4.0))
    assert kept.lets_pass(1.0, 5.0)
    assert kept.lets_pass(3.0, 3.0)
    assert not kept.lets_pass(2.0, 4.0)
    assert not kept.lets_pass(10.0, 3.0)
    kept = filter.Filter(10.0)
    assert not kept.accept(1.0, 2.0, 1.0, 2.0, -1.0, 1.0, 1e-4)
    assert kept.accept(1.0, 2.0, 0.5, 9.0, -1.0, 1.0, 1e-4)
    assert kept.pairs[1:] == [filter.envelope(1.0, 2.0)]
    # nearly feasible, the cost must fall as the slope promises, and the filter does not grow
    assert not kept.accept(0.0, 2.0, 0.0, 2.1, -1.0, 1.0, 1e-4)
    assert kept.accept(0.0, 0.0, 0.0, -0.5, -1.0, 0.5, 1e-4)
    assert len(kept.pairs) == 2


def test_a_cost_that_fell_as_promised_leaves_no_pair_behind() -> None:
    """However far from feasible (step A-7): the pair would bar the way back to the equations."""
    kept = filter.Filter(1e4)
    assert kept.accept(1.3, -140.0, 435.0, -142.4, -3.8, 0.8, 1e-4)
    assert len(kept.pairs) == 1


def test_a_filter_that_alone_shortens_five_steps_in_turn_is_emptied() -> None:
    kept = filter.Filter(1e4)
    kept.pairs.append((1.0, 0.0))
    for i in range(filter.MISLED):
        assert (1.0, 0.0) in kept.pairs
        violation = 100.0 - i
        assert not kept.accept(violation, -1.0, violation - 0.5, 1.0, 1.0, 1.0, 1e-4)  # better, but for the pair
        assert kept.accept(violation, -1.0, violation - 0.1, -1.0, 1.0, 0.5, 1e-4)
    assert kept.pairs[1:] == [filter.envelope(violation, -1.0)]
