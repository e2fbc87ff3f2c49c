"""Nelder and Mead's simplex method, for comparison. Source: scipy.optimize, method Nelder-Mead."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from codegen.solving.drivers.quiet import quiet_single_thread
from codegen.solving.drivers.shared import require_at_most, require_method, verdict
from codegen.solving.loading import ConnectModule, Vector
from codegen.solving.results.motions import case_of
from codegen.solving.results.result import ConnectAttempt, Run

LIMIT = 24


def connect(module: ConnectModule, run: Run) -> ConnectAttempt:
    """Minimise the squared distance between arrival and targets over the initial momenta, and return the attempt."""
    require_method(module, "fmin", ("stepping",))
    case = case_of(module, run)
    require_at_most(case.start.size, LIMIT, "fmin")
    start = module.first_momenta(case).ravel()

    def distance(momenta: Vector) -> float:
        value = float(np.sum(module.residual(case, momenta) ** 2))
        return value if np.isfinite(value) else 1e10

    with quiet_single_thread():
        solution = minimize(
            distance, start, method="Nelder-Mead",
            options={"maxiter": 400 * start.size, "maxfev": 800 * start.size, "xatol": 1e-10, "fatol": 1e-18,
                     "adaptive": start.size > 6},
        )  # fmt: skip
    return verdict(
        module, "fmin", case, module.trajectory(case, solution.x)[1], int(solution.nit), 1e-6, solution.message
    )
