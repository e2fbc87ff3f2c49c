"""Where nodes are in time: `nodes` (N + 1,) in parts of the mean interval, 0, 1, ..., N where all are as long.

Times are products with the mean length h, so that equal intervals have exactly that length.
"""

from numba import njit


@njit(error_model="numpy", forceinline=True)
def span(nodes, k, h):
    """The time at which interval k begins, and its length."""
    return nodes[k] * h, (nodes[k + 1] - nodes[k]) * h
