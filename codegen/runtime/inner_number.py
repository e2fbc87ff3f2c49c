"""Numbers of the nodes at inner times: each has one for every such time, and other nodes have zeros."""

from numba import njit


@njit(error_model="numpy", forceinline=True)
def inner_number(parameters, first, count, number, t, h):
    """Return the number of the given index of the node at time t, before an interval of length h.

    From `first` on `parameters` (P + SHARED,) hold the `count` inner times, then for every number its values at these.
    """
    found = 0.0
    for i in range(first, first + count):
        found += parameters[i + (number + 1) * count] if abs(t - parameters[i]) < 1e-6 * h else 0.0
    return found
