"""How much a report measures."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Extent:
    """Limits: doublings of the number of steps, schemes per control problem, seconds of a solve, repetitions.

    A ladder of steps is taken no further once a solve takes more than `limit` seconds; the mesh sequence in which
    orders of optima are measured begins no grid after `sequence_seconds`; drivers of scipy are only asked
    where there are at most `driver_unknowns` unknowns. At most `most_schemes` schemes of a control problem count,
    and `most_simulated` of a simulation; those of a control problem have at most the order `most_order`, since modules
    of schemes with many stages take long to make, and with `only_default_of_phases` several phases have one scheme.
    The general form, which leaves nothing out, is made of modules of up to `general_operations` operations.
    The energy of a simulation is followed over `drift_steps` steps, where these are not zero.
    """

    quick: bool = False
    simulation_doublings: int = 12
    control_doublings: int = 4
    sequence_seconds: float = 30.0
    most_schemes: int = 10
    most_simulated: int = 99
    most_order: int = 6
    only_default_of_phases: bool = False
    limit: float = 2.0
    repeat: int = 3
    driver_unknowns: int = 300
    general_operations: int = 100_000
    drift_steps: int = 1_000_000


FULL = Extent()
"""One problem with all schemes."""
GALLERY = Extent(
    control_doublings=3,
    sequence_seconds=10.0,
    most_schemes=2,
    most_order=2,
    only_default_of_phases=True,
    most_simulated=8,
    limit=1.0,
    repeat=2,
    driver_unknowns=150,
    general_operations=60,
    drift_steps=0,
)
"""A folder of problems in less than 20 minutes on two processors."""
QUICK = Extent(
    quick=True,
    simulation_doublings=5,
    control_doublings=3,
    sequence_seconds=2.0,
    most_schemes=2,
    most_order=2,
    most_simulated=4,
    limit=0.5,
    repeat=1,
    driver_unknowns=0,
    general_operations=0,
    drift_steps=0,
)
"""What continuous integration can afford."""
QUICK_PROBLEMS = ("pendulum", "linear_pendulum")
"""Of a folder, these are measured in the quick form."""
