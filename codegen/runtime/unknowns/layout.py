"""Which unknowns are multipliers, and which no boundary condition fixes: functions of the number of intervals alone."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from codegen.runtime.stand_ins.example import (
    BODIES, COUPLINGS, END_PINNED, FREE_TIMES, INNER_LACKS, INNER_PRESENT, INNER_TIMES, INNER_UNKNOWNS, IS_MULTIPLIER,
    NODE, ONLY_AT_ENDS, OWN, PHASES, ROOT, SHARED_IS_MULTIPLIER, SHARED_MULTIPLIERS, START_PINNED, STRIDE,
)  # fmt: skip
from codegen.runtime.unknowns.phases import lacking_unknowns


class Layout(NamedTuple):
    """Masks (n,) of multipliers and of free unknowns, indices of the free primal ones and of the free multipliers."""

    is_multiplier: np.ndarray
    is_free: np.ndarray
    primal: np.ndarray
    multipliers: np.ndarray


@lru_cache(maxsize=4)
def layout(steps):
    """The layout of `steps` intervals, kept for the next solve; its arrays are read-only."""
    chain = steps * STRIDE + NODE
    is_multiplier, is_free = np.zeros(BODIES * chain + ROOT, dtype=bool), np.ones(BODIES * chain + ROOT, dtype=bool)
    chains = is_multiplier[: BODIES * chain].reshape(BODIES, chain)
    chains[:, :-NODE].reshape(BODIES, steps, STRIDE)[:] = IS_MULTIPLIER
    chains[:, -NODE:] = IS_MULTIPLIER[:NODE]
    if COUPLINGS:
        is_multiplier[is_multiplier.size - COUPLINGS :] = True
    if SHARED_MULTIPLIERS:
        first = BODIES * (chain + OWN)
        is_multiplier[BODIES * chain : first].reshape(BODIES, OWN)[:] = SHARED_IS_MULTIPLIER[:OWN]
        is_multiplier[first : is_multiplier.size - COUPLINGS] = SHARED_IS_MULTIPLIER[OWN:]
    chains = is_free[: BODIES * chain].reshape(BODIES, chain)
    for i in ONLY_AT_ENDS:
        chains[:, i + STRIDE : -NODE : STRIDE] = False
    chains[:, START_PINNED] = False
    chains[:, chain - NODE + END_PINNED] = False
    if PHASES:
        intervals = chains[:, : steps * STRIDE].reshape(BODIES, steps, STRIDE)
        intervals[:, :, NODE:] &= ~lacking_unknowns(steps)
    primal, multipliers = np.flatnonzero(is_free & ~is_multiplier), np.flatnonzero(is_free & is_multiplier)
    for array in (is_multiplier, is_free, primal, multipliers):
        array.flags.writeable = False
    return Layout(is_multiplier, is_free, primal, multipliers)


if INNER_TIMES:

    @lru_cache(maxsize=4)
    def inner_layout(steps, numbers):
        """The layout of `steps` intervals whose nodes of these `numbers` are at inner times, read-only."""
        plain, chain = layout(steps), steps * STRIDE + NODE
        is_free = plain.is_free.copy()
        for first in range(0, BODIES * chain, chain):
            nodes = first + STRIDE * np.arange(steps + 1)
            for j, present in zip(INNER_UNKNOWNS, INNER_PRESENT.T):
                is_free[nodes + j] = False
                is_free[nodes[np.array(numbers)[present]] + j] = True
            if FREE_TIMES:
                for j in INNER_LACKS:
                    is_free[nodes[np.array(numbers)] + j] = False
        primal = np.flatnonzero(is_free & ~plain.is_multiplier)
        multipliers = np.flatnonzero(is_free & plain.is_multiplier)
        for array in (is_free, primal, multipliers):
            array.flags.writeable = False
        return Layout(plain.is_multiplier, is_free, primal, multipliers)


def free_unknowns(grid):
    """Boolean mask (n,) of the unknowns that no boundary condition fixes and that mean something."""
    if INNER_TIMES:
        return inner_layout(grid.steps, grid.inner).is_free
    else:
        return layout(grid.steps).is_free


def primal_unknowns(grid):
    """Indices of the free primal unknowns."""
    if INNER_TIMES:
        return inner_layout(grid.steps, grid.inner).primal
    else:
        return layout(grid.steps).primal


def multiplier_unknowns(grid):
    """Indices of the multipliers whose equations are imposed."""
    if INNER_TIMES:
        return inner_layout(grid.steps, grid.inner).multipliers
    else:
        return layout(grid.steps).multipliers
