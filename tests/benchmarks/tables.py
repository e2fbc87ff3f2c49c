"""Minimum time to climb with tables against the same program, with the same splines, in CasADi and IPOPT.

    python tests/benchmarks/tables.py [--steps N ...] [--repeat R] [--compiled]

Prints how far both splines are apart at random points, and for every N of both programs the optimum, the iterations
and the milliseconds of the best of R solves: IPOPT with its own defaults (its optimum with a tolerance of 1e-12 and
without relaxed bounds), ours with its own; with `--compiled` CasADi's functions are C code compiled by gcc -O3. In
CasADi unknowns are in units of their sizes, since IPOPT does not find those of unknowns.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import subprocess
import tempfile
from pathlib import Path
from time import perf_counter

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from peers.casadi_control import COMPILER, IPOPT_OPTIONS

import codegen
from codegen import Table

PROBLEM = Path(__file__).parents[2] / "problems" / "published" / "time_to_climb.py"
SIZES = np.array([1e4, 1e2, 1.0, 1e4])
PRECISE = {"ipopt.tol": 1e-12, "ipopt.bound_relax_factor": 0.0}
TABLES = {
    "thrust": ("f4_thrust.csv", ("mach", "altitude")),
    **dict.fromkeys(("C_D0", "C_La", "kappa"), ("f4_aerodynamics.csv", ("mach",))),
    **dict.fromkeys(("density", "sound"), ("f4_atmosphere.csv", ("altitude",))),
}


def interpolants() -> tuple[dict[str, ca.Function], float]:
    """CasADi's cubic B-splines through the tables, and by how much of their sizes they differ from ours."""
    splines, worst = {}, 0.0
    generator = np.random.default_rng(1)
    for name, (file, inputs) in TABLES.items():
        table = Table(PROBLEM.parents[1] / "data" / file, inputs, name)
        axes, values = table.data.axes, table.values
        splines[name] = ca.interpolant(name, "bspline", axes, values.ravel(order="F"))
        at = [generator.uniform(axis[0], axis[-1], 200) for axis in axes]
        peers = np.array([float(splines[name](point)) for point in zip(*at, strict=True)])
        ours = np.array([float(table(*point)) for point in zip(*at, strict=True)])
        worst = max(worst, float(np.abs(ours - peers).max() / np.abs(values).max()))
    return splines, worst


def interval(splines: dict[str, ca.Function]) -> ca.Function:
    """(x_k, x_k+1, alpha, h) to the defects of the midpoint rule and to the Mach numbers in the middle and after it."""
    x0, x1, alpha, step = ca.MX.sym("x0", 4), ca.MX.sym("x1", 4), ca.MX.sym("alpha"), ca.MX.sym("step")
    h, v, gamma, m = ca.vertsplit((x0 + x1) / 2 * SIZES)
    mach = v / splines["sound"](h)
    thrust = splines["thrust"](ca.vertcat(mach, h))
    pressure, lift_slope, g = splines["density"](h) * v**2 / 2 * 49.2386, splines["C_La"](mach), 9.80665
    drag = pressure * (splines["C_D0"](mach) + splines["kappa"](mach) * lift_slope * alpha**2)
    rates = ca.vertcat(
        v * ca.sin(gamma),
        (thrust * ca.cos(alpha) - drag) / m - g * ca.sin(gamma),
        (thrust * ca.sin(alpha) + pressure * lift_slope * alpha) / (m * v) - g * ca.cos(gamma) / v,
        -thrust / (g * 1600),
    )
    after = x1[1] * SIZES[1] / splines["sound"](x1[0] * SIZES[0])
    return ca.Function("interval", [x0, x1, alpha, step], [x1 - x0 - step * rates / SIZES, ca.vertcat(mach, after)])


def program(splines: dict[str, ca.Function], steps: int) -> tuple[dict[str, ca.MX], dict[str, NDArray[np.float64]]]:
    """The nonlinear program, and its bounds and guess."""
    x, alpha, duration = ca.MX.sym("x", 4, steps + 1), ca.MX.sym("alpha", 1, steps), ca.MX.sym("T")
    lengths = ca.repmat(100 * duration / steps, 1, steps)
    defects, mach = interval(splines).map(steps)(x[:, :-1], x[:, 1:], alpha, lengths)
    end = x[1, -1] * SIZES[1] - splines["sound"](x[0, -1] * SIZES[0])
    constraints = ca.vertcat(ca.vec(defects), ca.vec(mach), end)
    unknowns = ca.vertcat(ca.vec(x), ca.vec(alpha), duration)
    low, high = (
        np.tile([100.0, 10.0, -1.5, -np.inf], (steps + 1, 1)),
        np.tile([2e4, np.inf, 1.5, np.inf], (steps + 1, 1)),
    )
    start = [100.0, 135.964, 0.0, 19030.468]
    low[0] = high[0] = start
    low[-1, [0, 2]] = high[-1, [0, 2]] = [2e4, 0.0]
    share = np.linspace(0, 1, steps + 1)
    guess = np.stack([100 + 19900 * share, 136 + 150 * share, 0 * share, 19030 - 2100 * share], axis=1)
    limit = 8 * np.pi / 180
    given = {
        "lbx": np.concatenate([(low / SIZES).ravel(), np.full(steps, -limit), [1.0]]),
        "ubx": np.concatenate([(high / SIZES).ravel(), np.full(steps, limit), [6.0]]),
        "x0": np.concatenate([(guess / SIZES).ravel(), np.zeros(steps), [3.0]]),
        "lbg": np.concatenate([np.zeros(4 * steps), np.full(2 * steps, -np.inf), [0.0]]),
        "ubg": np.concatenate([np.zeros(4 * steps), np.full(2 * steps, 1.8), [0.0]]),
    }
    return {"x": unknowns, "f": 100 * duration, "g": constraints}, given


def solver_of(nlp: dict[str, ca.MX], options: dict[str, object], compiled: bool) -> ca.Function:
    """IPOPT on the program, its functions evaluated by CasADi's virtual machine or as compiled C."""
    solver = ca.nlpsol("solver", "ipopt", nlp, options)
    if not compiled:
        return solver
    folder = Path(tempfile.mkdtemp())
    solver.generate_dependencies("climb.c")
    Path("climb.c").rename(folder / "climb.c")
    subprocess.run([*COMPILER, str(folder / "climb.c"), "-o", str(folder / "climb.so")], check=True)
    return ca.nlpsol("solver", "ipopt", str(folder / "climb.so"), options)


def measured(solver: ca.Function, given: dict[str, NDArray[np.float64]], repeat: int) -> tuple[float, int, float, bool]:
    """Optimum, iterations, least milliseconds, and whether it was found."""
    best = np.inf
    for _ in range(repeat):
        begin = perf_counter()
        found = solver(**given)
        best = min(best, perf_counter() - begin)
    statistics = solver.stats()
    return float(found["f"]), int(statistics["iter_count"]), 1e3 * best, bool(statistics["success"])


def main() -> None:
    """Print a row for every number of steps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, nargs="+", default=[50, 100, 200])
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--compiled", action="store_true", help="compile CasADi's functions")
    arguments = parser.parse_args()
    splines, difference = interpolants()
    print(f"splines differ by {difference:.1e} of their sizes")
    module = codegen.load(codegen.build(PROBLEM).path)
    print("    N      optimum by CasADi   iterations      ms      ours relative   iterations      ms    ratio")
    for steps in arguments.steps:
        nlp, given = program(splines, steps)
        options = IPOPT_OPTIONS | {"error_on_fail": False}
        exact = measured(ca.nlpsol("solver", "ipopt", nlp, options | PRECISE), given, 1)
        _, iterations, ms, found = measured(solver_of(nlp, options, arguments.compiled), given, arguments.repeat)
        result = codegen.solve(module, steps=steps, repeat=arguments.repeat)
        ours = 1e3 * result.seconds_solve
        relative = result.cost / exact[0] - 1 if result.solved and exact[3] else np.nan
        print(
            f"{steps:5d} {exact[0]:22.12f} {iterations:12d}{' ' if found else '!'} {ms:7.1f} {relative:18.1e} "
            f"{result.iterations:12d} {ours:7.1f} {ms / ours:8.1f}"
        )


if __name__ == "__main__":
    main()
