"""Reading what the module's solver found: free parameters, and values along the motion in the author's symbols."""

from __future__ import annotations

from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray

from codegen.expressions.special_functions import NUMPY
from codegen.model import Model


def free_values(module: Any, solution: Any) -> NDArray[np.float64]:
    """The free parameters at a solution, in the order in which they were declared."""
    count = len(module.metadata.free_parameters)
    end = solution.unknowns.size - module.problem.structure.couplings
    return np.asarray(solution.unknowns[end - count : end])


def integral_of_cost(model: Model, module: Any, solution: Any) -> float:
    """The integral of the running cost of all bodies along a solution with controls on nodes, by Simpson's rule.

    Between nodes coordinates, momenta and controls are linear functions of time, and velocities are constant.
    """
    free = [parameter.symbol for parameter in model.free_parameters]
    symbols = [*model.coordinates, *model.rates, *model.controls, model.time, *model.parameters, *free]
    function = sympy.lambdify(symbols, model.cost, modules=NUMPY, cse=True)
    constants = [*model.defaults, *free_values(module, solution)]
    h, total = np.diff(solution.t), 0.0

    def of_body(values: NDArray[np.float64], width: int, body: int) -> NDArray[np.float64]:
        return values[:, body * width : (body + 1) * width]

    for body in range(model.bodies):
        q, u = (of_body(v, len(s), body) for v, s in ((solution.q, model.coordinates), (solution.u, model.controls)))
        slopes = np.diff(q, axis=0) / h[:, None]
        for weight, abscissa in ((1, 0.0), (4, 0.5), (1, 1.0)):
            q_here, u_here = ((1.0 - abscissa) * v[:-1] + abscissa * v[1:] for v in (q, u))
            rates = slopes if model.form == "lagrangian" else np.empty((h.size, 0))
            if model.form == "hamiltonian":
                p = of_body(solution.p, len(model.rates), body)
                rates = (1.0 - abscissa) * p[:-1] + abscissa * p[1:]
            values = function(*q_here.T, *rates.T, *u_here.T, solution.t[:-1] + abscissa * h, *constants)
            total += weight / 6.0 * float(np.sum(h * values))
    return total
