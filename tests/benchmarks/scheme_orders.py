"""Every scheme on the pendulum: measured order, and the trend of the energy's error over a million steps.

`python tests/benchmarks/scheme_orders.py [SCHEME ...]`. The exact motion is that of elliptic functions, in 30 digits.
The slope is that of a straight line through the error, times the whole time; it is compared with the error's own
oscillation, and with the random walk of rounding errors, sqrt(evaluations) 1e-16.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import mpmath
import numpy as np

sys.path[:0] = [str(Path(__file__).parents[1])]

from simulation_systems import model_of, text_of  # noqa: E402

from codegen import emit, schemes  # noqa: E402
from codegen.compiler import cache_folder  # noqa: E402
from codegen.load import load  # noqa: E402

MOMENTUM, DURATION, LONG = 1.4, 2.0, 1_000_000
STEPS = {1: (100, 200, 400), 2: (100, 200, 400), 4: (40, 80, 160), 6: (6, 12, 24), 8: (5, 7, 10)}


def exact_position(t: float) -> float:
    """q with q(0) = 0 and p(0) = 2 k: sin(q/2) = k sn(t, k)."""
    with mpmath.workdps(30):
        k = mpmath.mpf(MOMENTUM) / 2
        return float(2 * mpmath.asin(k * mpmath.ellipfun("sn", t, m=k**2)))


def main() -> None:
    """Print a table."""
    chosen = sys.argv[1:] or list(schemes.METHODS["hamiltonian"])
    print(f"{'scheme':24} order measured   error  1e6 steps  trend of H    oscillation")
    for name in chosen:
        path = cache_folder() / f"bench_{name.replace('-', '_')}.py"
        emit.write(path, text_of(model_of("pendulum-hamiltonian"), name, "hamiltonian"))
        module = load(path)
        order = module.metadata["order"]
        counts, start = STEPS[order], (0.0, MOMENTUM)
        errors = [
            abs(module.solve(n, duration=DURATION, start=start).q[-1, 0] - exact_position(DURATION)) for n in counts
        ]
        measured = np.log(errors[-2] / errors[-1]) / np.log(counts[-1] / counts[-2])
        begin = time.perf_counter()
        solution = module.solve(LONG, duration=0.1 * LONG, start=start, every=500)
        seconds = time.perf_counter() - begin
        error = solution.energy - solution.energy[0]
        trend = np.polyfit(solution.t, error, 1)[0] * solution.t[-1]
        print(
            f"{name:24} {order:5d} {measured:8.3f} {errors[-1]:7.1e} {seconds:8.2f} s {trend:11.2e} "
            f"{np.ptp(error):13.2e}  {solution.status}",
            flush=True,
        )


if __name__ == "__main__":
    main()
