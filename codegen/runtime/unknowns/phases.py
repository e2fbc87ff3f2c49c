"""Several phases in one chain: N intervals of each, whose time runs from the number of the phase to the next number.

The first interval of a phase, which follows the switch, may have other unknowns than the rest of it.
"""

import numpy as np

from codegen.runtime.stand_ins.example import PHASE_LACKS, PHASES, SWITCH_LACKS, phase_durations


def lacking_unknowns(intervals):
    """Which unknowns each of the `intervals` of all phases does not have: (intervals, STRIDE - NODE)."""
    steps = intervals // PHASES
    lacking = np.repeat(PHASE_LACKS, steps, axis=0)
    lacking[steps::steps] = SWITCH_LACKS
    return lacking


def node_times(grid, unknowns):
    """Times (N + 1,) of all nodes; phases follow each other."""
    switches = np.concatenate([[0.0], np.cumsum(phase_durations(grid, unknowns))])
    return np.interp(grid.nodes / (grid.steps // PHASES), np.arange(PHASES + 1), switches)


def interval_times(grid, unknowns):
    """Times (N,) of the middles of all intervals."""
    t = node_times(grid, unknowns)
    return 0.5 * (t[:-1] + t[1:])
