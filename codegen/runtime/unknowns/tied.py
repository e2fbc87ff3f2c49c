"""Unknowns that equal shared ones follow them where an interior point method moves what has bounds."""

from codegen.runtime.stand_ins.example import with_pinned_values


def with_tied_values(grid, unknowns):
    """A copy of `unknowns` (n,) with prescribed values, and with what equals a shared unknown, as they must be."""
    if grid.sizes.size:
        return with_pinned_values(grid, unknowns * grid.sizes) / grid.sizes
    return with_pinned_values(grid, unknowns)
