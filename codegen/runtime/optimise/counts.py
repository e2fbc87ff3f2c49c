"""Whether numbers that were given can be counts, and a duration."""

import numpy as np


def checked_count(name, number):
    """A positive integer, which may be written as a float; ValueError names what is not."""
    try:
        is_count = number == int(number) and number >= 1 and not isinstance(number, bool)
    except (TypeError, ValueError, OverflowError):
        is_count = False
    if not is_count:
        raise ValueError(f"{name} is {number!r}, expected a positive integer")
    return int(number)


def checked_times(steps, duration):
    """The number of steps and the duration of all; ValueError when they are not positive, or not finite."""
    steps = checked_count("steps", steps)
    if not 0.0 < duration < np.inf:
        raise ValueError(f"duration is {duration!r}, expected a positive number")
    return steps, float(duration)
