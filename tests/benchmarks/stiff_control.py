"""A stiff actuator in optimal control: cost and states by scheme and number of intervals, against the closed form.

    python tests/benchmarks/stiff_control.py [SCHEME ...]

A mass moves from rest to rest over a unit distance in unit time. The force F follows the command u with a lag,
tau F' = u - F, and the integral of u^2 is least. For tau = 1e-2, 1e-4 and 1e-6, and with values of the command at the
stages of each scheme, an error is the relative error of the cost, and the distance of the positions and velocities at
the nodes, from the solution in 25 digits. For schemes with negative weights the command is constant on intervals. By
default all schemes for first-order dynamics are measured that have one step in an interval.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import sys
from typing import Any

import mpmath
import numpy as np
from rich.console import Console
from rich.table import Table

import codegen
from codegen import Control, control, parameter, states
from codegen.discretise import schemes

COUNTS, LAGS = (10, 20, 40, 80, 160), (1e-2, 1e-4, 1e-6)


def actuator() -> Control:
    """Return the problem as an author writes it; the force starts at zero and is free at the end."""
    x, v, force = states("x v F")
    u, tau = control("u"), parameter("tau", 1e-4)
    return Control(
        dynamics={x: v, v: force, force: (u - force) / tau},
        cost=u**2,
        duration=1,
        start={x: 0, v: 0, force: 0},
        end={x: 1, v: 0},
    )


def exact(tau: float, times: Any) -> tuple[float, Any]:
    """Return the least cost and (x, v) at given times, from the Gramian of the controllable directions.

    The force is free at the end, so that the command is a sum of the impulse responses of x and v, backward in time.
    Its two coefficients follow from the integrals of products of these responses (Luenberger 1969, section 3.10).
    """
    with mpmath.workdps(25):
        lag = mpmath.mpf(tau)

        # Responses of x and v at T to a unit impulse of u at T - s: v by 1 - e^{-s/tau}, x by its integral.
        def velocity(s: Any) -> Any:
            return 1 - mpmath.exp(-s / lag)

        def position(s: Any) -> Any:
            return s - lag * (1 - mpmath.exp(-s / lag))

        def integral(f: Any, end: Any) -> Any:
            return mpmath.quad(f, [0, *[p for k in (1, 4, 16, 64, 256) if (p := k * lag) < end], end])

        one = mpmath.mpf(1)
        gram = mpmath.matrix(
            [
                [integral(lambda s, f=f, g=g: f(s) * g(s), one) for g in (position, velocity)]
                for f in (position, velocity)
            ]
        )
        c = mpmath.lu_solve(gram, mpmath.matrix([1, 0]))
        cost = c[0]  # the integral of u^2 is target' W^-1 target
        values = []
        for t in map(mpmath.mpf, times):
            # u(t - s) = c . (position, velocity)(1 - t + s)
            def command(s: Any, t: Any = t) -> Any:
                return c[0] * position(1 - t + s) + c[1] * velocity(1 - t + s)

            values.append(
                [float(integral(lambda s, f=f: f(s) * command(s), t)) if t > 0 else 0.0 for f in (position, velocity)]
            )
        return float(cost), np.array(values)


def main() -> None:
    """Print a table for each lag."""
    offered = [s.name for s in schemes.of_method(schemes.FIRST_ORDER) if not s.parts]
    modules: dict[str, Any] = {}
    for name in sys.argv[1:] or offered:
        # A cost of controls at stages with negative weights has no minimum.
        is_positive = min(schemes.find(name, schemes.FIRST_ORDER).step().tableau.weights) >= 0
        modules[name] = codegen.compile(actuator(), scheme=name, controls="stages" if is_positive else "interval")
    for tau in LAGS:
        cost, states_at_tenths = exact(tau, np.linspace(0.0, 1.0, 11))
        chart = Table(
            "scheme", "order", "N", "status", "iterations", "ms", "error of cost", "order of cost", "error of x, v",
            "order of x, v", title=f"lag {tau:g}: least cost {cost:.12g}",
        )  # fmt: skip
        for name, solver in modules.items():
            before: tuple[float, float] | None = None
            for count in COUNTS:
                result = solver.solve(steps=count, parameters={"tau": tau}, repeat=3)
                if result.status != "solved":
                    chart.add_row(name, str(solver.module.metadata.order), str(count), result.status)
                    before = None
                    continue
                gap = np.abs(result.q[:: count // 10, :2] - states_at_tenths).max()
                errors = abs(result.cost - cost) / cost, float(gap)
                orders = [f"{np.log2(a / b):.2f}" for a, b in zip(before, errors, strict=True)] if before else ["", ""]
                chart.add_row(
                    name, str(solver.module.metadata.order), str(count), result.status, str(result.iterations),
                    f"{1e3 * result.seconds_solve:.2f}", f"{errors[0]:.1e}", orders[0], f"{errors[1]:.1e}", orders[1],
                )  # fmt: skip
                before = errors
            chart.add_section()
        Console(width=120).print(chart)


if __name__ == "__main__":
    main()
