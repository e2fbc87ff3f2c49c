"""The filter of a line search: pairs (violation, cost) that a trial point must improve on in one or the other.

Source: Waechter and Biegler (2006), On the implementation of an interior-point filter line-search algorithm, whose
equation numbers are quoted. Here `cost` is whatever the line search lowers: the cost, or a barrier function.
"""

import numpy as np

MISLED = 5  # steps in turn that the filter alone has shortened, after which it is emptied
EMPTIED = 5  # how often that may happen, so that a search cannot go round in circles


class Filter:
    """Pairs that a trial point must improve on, the first of which limits the violation for good.

    Points of long ago, nearly feasible and cheap, may bar the way for many iterations. Where the last trial that an
    iterate refused was refused by the filter alone, five times in turn, all pairs but the first are forgotten, as IPOPT
    does (its option filter_reset_trigger).
    """

    def __init__(self, greatest_violation):
        self.pairs = [(greatest_violation, -np.inf)]
        self.refused, self.in_turn, self.emptied = False, 0, 0

    def empty(self):
        """Forget all pairs but the first."""
        del self.pairs[1:]
        self.refused, self.in_turn = False, 0

    def lets_pass(self, violation, cost):
        """Whether no pair is better both in violation and in cost (18)."""
        for other, least in self.pairs:  # a loop takes a third of the time of all(...)
            if not (violation < other or cost < least):
                return False
        return True

    def add(self, violation, cost):
        """Note a point that is left: nothing comes back to it, nor as close as a small part of its violation."""
        self.pairs.append(envelope(violation, cost))

    def accept(self, violation, cost, trial_violation, trial_cost, slope, length, small_violation):
        """Whether a trial point may be taken (19, 20); the filter grows unless the cost fell as the slope promised."""
        rounding = 2e-15 * abs(cost)
        promising = slope < 0.0 and length * (-slope) ** 2.3 > violation**1.1
        fell = promising and trial_cost <= cost + 1e-8 * length * slope + rounding
        if promising and violation <= small_violation:
            better = fell
        else:
            least_violation, least_cost = envelope(violation, cost)
            better = trial_violation <= least_violation or trial_cost <= least_cost + rounding
        if not better or not self.lets_pass(trial_violation, trial_cost):
            self.refused = better
            return False
        self.in_turn = self.in_turn + 1 if self.refused else 0
        self.refused = False
        if self.in_turn == MISLED and self.emptied < EMPTIED:
            self.empty()
            self.emptied += 1
        if not fell:
            self.add(violation, cost)
        return True


def envelope(violation, cost):
    """A little less than the violation and cost of a point."""
    return (1.0 - 1e-5) * violation, cost - 1e-8 * violation
