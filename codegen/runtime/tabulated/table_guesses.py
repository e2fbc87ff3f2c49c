"""Tables in guesses, which are arrays."""

import numpy as np


def along(values, parameters, number, *at):
    """Return values of a table, or of its derivative of a number, at arrays that fit each other."""
    at = np.broadcast_arrays(*at)
    return values(parameters, number, *(np.ascontiguousarray(a, dtype=float).ravel() for a in at)).reshape(at[0].shape)
