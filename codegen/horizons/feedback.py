"""What a controller says of one sampling time."""

from __future__ import annotations

from dataclasses import dataclass

from codegen.interfaces import Vector


@dataclass(frozen=True, eq=False, slots=True)
class Feedback:
    """What became of one sampling time.

    `inputs` (controls,) are to be applied until those of the next one, in the problem's units, from the time `t` of the
    measurement on or, with a delay, so much later. `status` is "solved" where all equations hold to the tolerance,
    evaluated again outside the solver; "iteration limit" or "time limit" where iterations or time ran out first; else
    it says how the solve failed. `message` says so in a sentence. `fell_back` tells that the inputs are those where the
    search began, as a rule the plan before, shifted.
    `residual` is the max-norm of the plan's equations, `cost` what the plan costs. `seconds` is the time from the
    call to the inputs; `in_time`: it is within the deadline.
    """

    t: float
    inputs: Vector
    status: str
    message: str
    cost: float
    residual: float
    iterations: int
    seconds: float
    in_time: bool
    fell_back: bool
