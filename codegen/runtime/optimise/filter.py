"""The filter of a line search: pairs (violation, cost) that a trial point must improve on in one or the other.

Source: Waechter and Biegler (2006), On the implementation of an interior-point filter line-search algorithm, whose
equation numbers are quoted. Here `cost` is whatever the line search lowers: the cost, or a barrier function.
"""


def acceptable(violation, cost, filtered):
    """Whether no pair of the filter is better both in violation and in cost (18)."""
    for other, least in filtered:  # a loop takes a third of the time of all(...)
        if not (violation < other or cost < least):
            return False
    return True


def envelope(violation, cost):
    """What a point adds to the filter: a little less than its violation and cost."""
    return (1.0 - 1e-5) * violation, cost - 1e-8 * violation


def accept(violation, cost, trial_violation, trial_cost, slope, length, small_violation, filtered):
    """Whether a trial point may be taken (19, 20); the filter grows unless the cost decreased as the slope promised."""
    if not acceptable(trial_violation, trial_cost, filtered):
        return False
    rounding = 2e-15 * abs(cost)
    if violation <= small_violation and slope < 0.0 and length * (-slope) ** 2.3 > violation**1.1:
        return trial_cost <= cost + 1e-8 * length * slope + rounding
    least_violation, least_cost = envelope(violation, cost)
    if trial_violation > least_violation and trial_cost > least_cost + rounding:
        return False
    filtered.append((least_violation, least_cost))
    return True
