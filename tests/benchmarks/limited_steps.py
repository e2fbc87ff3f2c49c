"""Close the loop of a cart-pole that is pushed over, with limits of a controller's warm searches.

    python tests/benchmarks/limited_steps.py [--samples N] [--seeds M]

Pushes of 12, 18 and 22 N every three seconds, to either side, are more than a limit of 20 N can always bear. Printed
are, for each limit of iterations and steps of restorations, the part of the time in which the pole leans by less than
half a radian, the part of the steps that were solved, and the mean and the longest time of a step in milliseconds.
"""

import argparse
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

import codegen
from codegen.mpc import controller as controllers

FILE = Path(__file__).resolve().parents[2] / "problems" / "cart_pole_balance.py"
LIMITS = 100, 200, 400, math.inf
NOISE = {"x": 1e-3, "theta": 2e-3, "dx": 5e-3, "dtheta": 1e-2}


def push(force: float) -> Callable[[float], float]:
    """A push for a tenth of a second every three seconds, to either side."""
    return lambda t: math.copysign(force, math.sin(math.pi * t / 3.0 + 0.1)) if t % 3.0 < 0.1 else 0.0


def main() -> None:
    """Print a line for each limit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=240)
    parser.add_argument("--seeds", type=int, default=4)
    options = parser.parse_args()
    controller = codegen.Controller(FILE)
    print(f"{'limit':>6} upright solved   mean longest")
    for limit in LIMITS:
        controllers.MOST_WARM = limit  # type: ignore[assignment]
        upright, solved, seconds = [], [], []
        for force in (12.0, 18.0, 22.0):
            for seed in range(options.seeds):
                loop = codegen.close_loop(
                    controller, FILE, arguments={"plant": True}, samples=options.samples, noise=NOISE, seed=seed,
                    disturbances={"m2": 0.35, "push": push(force)},
                )  # fmt: skip
                upright.append(np.mean(np.abs(loop.states[:, 1]) < 0.5))
                solved.append(np.mean(loop.statuses == "solved"))
                seconds += loop.latencies[1:].tolist()
        print(
            f"{limit:6} {np.mean(upright):7.3f} {np.mean(solved):6.3f} {1e3 * np.mean(seconds):6.2f} "
            f"{1e3 * max(seconds):7.1f}", flush=True,
        )  # fmt: skip


if __name__ == "__main__":
    main()
