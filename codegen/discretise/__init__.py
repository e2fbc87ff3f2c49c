"""Problem x scheme -> the expressions of one time interval.

On the Lagrangian side these are the discrete Lagrangian, the discrete forces and the discrete cost; on the
Hamiltonian side, and for first-order systems, the equations of one step and the discrete cost; on both sides the
path conditions at the points where the scheme evaluates the dynamics. Values at the left and right node carry the
suffixes `_k` and `_k1`; h is the length of the interval and t the time at its left end.
"""

from codegen.discretise.nodes import FRACTION, LENGTHS, STEP, PathValue, Sites, StateValue, at_nodes, at_stage, repeated
from codegen.discretise.one_step import OneStepInterval, one_step_interval
from codegen.discretise.variational import VariationalInterval, variational_interval

__all__ = [
    "FRACTION",
    "LENGTHS",
    "STEP",
    "OneStepInterval",
    "PathValue",
    "Sites",
    "StateValue",
    "VariationalInterval",
    "at_nodes",
    "at_stage",
    "one_step_interval",
    "repeated",
    "variational_interval",
]
