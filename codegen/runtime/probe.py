"""A test of the second-order condition with the factors of the KKT matrix."""

import numpy as np

from codegen.runtime.frontal import solve_kkt


def curves_upwards(grid, system, waves):
    """Whether the Hessian curves upwards along slow variations that respect the linearised equations.

    For a right-hand side r in the stationarity conditions alone, the primal part d of the solution keeps the equations
    and has d' W d = d . r, W being the Hessian. Sines of one, two, ... half waves over the time interval are tried,
    because that is where a problem without minimum gives itself away: short waves are held down by the controls.
    """
    place = np.arange(grid.is_multiplier.size) / grid.is_multiplier.size
    step = np.empty(place.size)
    for wave in range(1, waves + 1):
        force = np.where(grid.is_multiplier, 0.0, np.sin(wave * np.pi * place))
        solve_kkt(grid, system, -force, step)
        if not force @ step >= 0.0:
            return False
    return True
