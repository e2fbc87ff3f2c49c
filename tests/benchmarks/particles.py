"""Problems of particles, measured: accuracy, speed, sizes, hard cases, long motions.

    python tests/benchmarks/particles.py [table speed sizes threads hard pairs planets] [--repeat R] [--plot FILE.png]

`table` stands beside times and errors of Matlab on data/trilobite40.csv, `speed` compares with scipy's fsolve over
vectorised numpy in the same run, `sizes` grows the number of landmarks and draws a plot on request, `threads` compares
one thread with several, `hard` rotates, brings neighbours together and adds noise, `pairs` connects 200 random pairs of
the trilobites of the package ktch, which has to be installed for it, `planets` follows the outer solar system over a
million days. Times are the best of R warm solves.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import resource
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
import scipy.optimize
from matplotlib import pyplot
from rich.console import Console
from rich.table import Table
from scipy.integrate import solve_ivp

from codegen.problem.points import PointSet, read_points
from codegen.solving import api
from codegen.solving.compiler import build
from codegen.solving.loading import load

ROOT = Path(__file__).resolve().parents[2]
REGISTRATION = ROOT / "problems" / "image_registration.py"
TRILOBITES = ROOT / "problems" / "data" / "trilobite40.csv"
REFERENCE = 1.0220537180672813
MATLAB = {"midpoint": (9399.0, 1.729e-3), "lsoda": (63.30, 2.803e-6), "explicit-euler": (19.14, 3.751e-3)}
CONSOLE = Console(width=120)


def module(scheme: str, method: str | None = None) -> Any:
    """The generated module of a scheme."""
    return load(build(REGISTRATION, scheme=scheme, method=method).path)


def best(run: Callable[[], Any], repeat: int, clock: Callable[[], float] = perf_counter) -> tuple[Any, float]:
    """The last result and the least time of several warm runs."""
    result, seconds = run(), np.inf
    for _ in range(repeat):
        begin = clock()
        result = run()
        seconds = min(seconds, clock() - begin)
    return result, seconds


def table(repeat: int) -> None:
    """Costs, errors and times on the trilobites beside those of Matlab, which were on 40 other points."""
    points = read_points(TRILOBITES, 2)
    exact = api.solve(module("dop853"), points=points, tolerance=1e-13).cost
    shown = Table("scheme", "cost", "error", "Matlab", "seconds", "Matlab ", title=f"exact {exact:.12f}")
    for scheme, tolerance in (("midpoint", None), ("lsoda", 1e-2), ("lsoda", 1e-6), ("dop853", 1e-6),
                              ("explicit-euler", None), ("symplectic-euler", None), ("rk4", None)):  # fmt: skip
        result = api.solve(module(scheme), points=points, tolerance=tolerance, repeat=repeat)
        seconds, error = MATLAB.get(scheme, (np.nan, np.nan))
        name = scheme if tolerance is None else f"{scheme} {tolerance:g}"
        row = (name, f"{result.cost:.13f}", f"{abs(result.cost - exact):.3e}", f"{error:.3e}")
        shown.add_row(*row, f"{result.seconds_solve:.4f}", f"{seconds:.2f}")
        assert result.solved, result.message
    CONSOLE.print(shown)


def numpy_kernel(q: Any) -> tuple[Any, Any]:
    """G between all points, shape (n, n), and its derivative by the first of each two, shape (n, n, 2)."""
    difference = q[:, None] - q[None]
    s = (difference**2).sum(-1)
    a = 1 - (q**2).sum(-1)
    w = a[:, None] * a[None]
    safe = np.where(s > 0, s, 1.0)
    log = np.log1p(w / safe)
    green = w / 2 - np.where(s > 0, s * log / 2, 0.0)
    by_s = np.where(s > 0, w / (s + w) - log, 0.0) / 2
    by_a = a[:, None] * a[None] ** 2 / (2 * (s + w))
    return green, 2 * by_s[..., None] * difference - 2 * by_a[..., None] * q[:, None]


def numpy_rates(q: Any, p: Any) -> tuple[Any, Any, float]:
    """The field H_p and -H_q, both of shape (n, 2), and 2 H."""
    green, slope = numpy_kernel(q)
    dots = p @ p.T
    return green @ p, -(dots[..., None] * slope).sum(1), float((dots * green).sum())


def numpy_path(start: Any, momenta: Any, steps: int, place: float = 0.0) -> tuple[Any, float]:
    """Where steps arrive, and the discrete cost: explicit Euler for `place` 0, iterated midpoint for 1/2."""
    q, p, cost = start.copy(), momenta.reshape(start.shape), 0.0
    for _ in range(steps):
        by_p, by_q, energy = numpy_rates(q, p)
        change, left = np.inf, 40 if place else 0
        while change > 1e-14 and left > 0:
            before, left = by_p, left - 1
            by_p, by_q, energy = numpy_rates(q + place * by_p / steps, p + place * by_q / steps)
            change = np.abs(by_p - before).max()
        cost += energy / steps
        q, p = q + by_p / steps, p + by_q / steps
    return q, cost


def numpy_fsolve(points: PointSet, steps: int, place: float) -> tuple[float, float]:
    """The same shooting by scipy's fsolve with finite differences over vectorised numpy: cost and seconds."""
    q0, q1 = points.start, points.target
    start = np.linalg.solve(numpy_kernel(q0)[0], q1 - q0).ravel()
    begin = process_time()
    found = scipy.optimize.fsolve(lambda p: (numpy_path(q0, p, steps, place)[0] - q1).ravel(), start, xtol=1e-12)
    seconds = process_time() - begin
    return numpy_path(q0, found, steps, place)[1], seconds


def speed(repeat: int) -> None:
    """Explicit Euler and midpoint on the trilobites, five points, and numpy with fsolve in the same run."""
    points = read_points(TRILOBITES, 2)
    few = PointSet(points.start[:5], points.target[:5], points.sigma[:5])
    euler, midpoint = module("explicit-euler"), module("midpoint")
    for name, made, used in (("euler 40", euler, points), ("midpoint 40", midpoint, points), ("euler 5", euler, few)):
        solution, seconds = best(lambda m=made, u=used: m.solve(u.start, u.target), repeat)
        CONSOLE.print(f"{name}: {solution.status}, cost {solution.cost:.13f}, {1e3 * seconds:.3f} ms")
        if made is euler and used is points:
            CONSOLE.print(f"cost minus reference {solution.cost - REFERENCE:.1e}")
    for name, made, place in (("euler", euler, 0.0), ("midpoint", midpoint, 0.5)):
        solution, ours = best(lambda m=made: m.solve(points.start, points.target), repeat, process_time)
        cost, theirs = numpy_fsolve(points, 10, place)
        CONSOLE.print(
            f"{name} 40, processor time: {1e3 * ours:.3f} ms; numpy and fsolve: {theirs:.3f} s, {theirs / ours:.0f} "
            f"times ours; cost minus numpy's {solution.cost - cost:.1e}"
        )


def smooth_pair(count: int, seed: int = 1) -> PointSet:
    """Random points of the disc and where a smooth displacement carries them."""
    generator = np.random.default_rng(seed)
    radius, angle = 0.9 * np.sqrt(generator.random(count)), 2 * np.pi * generator.random(count)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    start = np.stack([x, y], axis=1)
    shift = np.stack([np.sin(2 * y + 0.3) - 0.3 * x * y, np.cos(1.5 * x) - 0.5 * y], axis=1)
    return PointSet(start, start + 0.15 * ((1 - radius**2) ** 2)[:, None] * shift, np.zeros(count))


def sizes(repeat: int, plot: Path | None = None) -> None:
    """Time and memory against the number of landmarks; the module, and so its code and build, is the same for all."""
    begin = perf_counter()
    euler = module("explicit-euler")
    size = Path(euler.__file__).stat().st_size
    CONSOLE.print(f"one module for all, {size} bytes, had after {perf_counter() - begin:.2f} s")
    counts, times = (5, 10, 20, 50, 100, 200, 500, 1000, 2000), list[float]()
    for count in counts:
        points = smooth_pair(count)
        runs, begin = repeat if count < 500 else 1, perf_counter()
        solution, used = best(lambda p=points: euler.solve(p.start, p.target), runs, process_time)
        seconds = (perf_counter() - begin) / (runs + 1)
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        times.append(used)
        CONSOLE.print(
            f"nc {count:5d}: {solution.status}, residual {solution.residual:.1e}, {solution.iterations} iterations, "
            f"{solution.tangents} tangents, {used:.4f} s of processor time, {seconds:.4f} s by the clock, "
            f"peak {memory:.0f} MB"
        )
    if plot is not None:
        figure, axes = pyplot.subplots(figsize=(5, 3.5), layout="constrained")
        axes.loglog(counts, times, "o-")
        for power, style in ((2, ":"), (3, "--")):
            line = [times[6] * (n / counts[6]) ** power for n in counts[4:]]
            axes.loglog(counts[4:], line, style, color="0.4", label=f"power {power}")
        ticks = [n for n in counts if str(n)[0] in "15" or n == counts[-1]]
        axes.set(
            xlabel="landmarks", ylabel="seconds, explicit Euler, 10 steps", xticks=ticks, xticklabels=map(str, ticks)
        )
        axes.xaxis.minorticks_off()
        axes.legend(frameon=False)
        figure.savefig(plot, dpi=150)


def threads(repeat: int) -> None:
    """Whole solves by one thread and by several, in turn, and the gradient alone; the answers are equal."""
    one = module("explicit-euler")
    several: Any = load(build(REGISTRATION, {"parallel": "true"}, scheme="explicit-euler").path)
    for count in (40, 100, 200, 500, 1000, 2000):
        points, found = smooth_pair(count), []
        state, out = np.stack([points.start, points.target]), np.empty((2, count, 2))
        for _ in range(max(1, min(repeat, 4000 // count))):
            for made in (one, several):
                case, runs = made.make_case(points.start, points.target), max(1, 2000 // count)
                solution, solve = best(lambda m=made, c=case: m.solve_case(c), 1)
                gradient = partial(made.hamiltonian_gradient, state, case.own, case.parameters, out)
                found.append((solution.p, solve, best(gradient, runs)[1]))
        assert np.array_equal(found[0][0], found[1][0])
        for what, k in (("solve", 1), ("gradient", 2)):
            by_one, shared = (1e3 * min(row[k] for row in found[made::2]) for made in (0, 1))
            CONSOLE.print(
                f"nc {count:5d}: {what} {by_one:.4g} and {shared:.4g} ms, {by_one / shared:.2f} times as fast"
            )


def hard(repeat: int) -> None:
    """Rotations, neighbours that move apart, noisy targets."""
    euler, generator = module("explicit-euler"), np.random.default_rng(7)
    points = read_points(TRILOBITES, 2)

    def report(name: str, solution: Any) -> None:
        tried = solution.attempts[-1].split(":")[0]
        error = solution.residual
        CONSOLE.print(f"{name}: {solution.status} by {tried}, cost {solution.cost:.6g}, residual {error:.1e}")

    for degrees in (30, 60, 90):
        angle = np.deg2rad(degrees)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        report(f"rotation by {degrees} degrees", euler.solve(points.start, points.start @ turn.T, 20))
    for distance in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        start, target = points.start.copy(), points.target.copy()
        start[1], target[1] = start[0] + [distance, 0.0], target[0] + [0.0, distance]
        report(f"neighbours at {distance:g}, turned by 90 degrees", euler.solve(start, target, 20))
    for seed in range(3):
        noisy = points.target + 0.03 * np.random.default_rng(seed).normal(size=points.target.shape)
        report("targets with noise of 0.03", euler.solve(points.start, noisy, 20))
        report("the same with sigma = 0.03", euler.solve(points.start, noisy, 20, sigma=0.03))
    del generator, repeat


def specimens() -> Any:
    """All points of 300 trilobite cephala, shape (300, 88, 2); see the package ktch for their source."""
    from ktch.datasets import load_landmark_trilobite_cephala  # type: ignore[import-not-found]

    found = load_landmark_trilobite_cephala()
    return np.array([np.vstack([a, *curves]) for a, curves in zip(found.landmarks, found.curves, strict=True)])


def aligned(one: Any, other: Any, count: int = 40) -> PointSet:
    """Homologous points far from each other in both specimens, after a similarity, in the disc of radius 0.7."""
    known = np.isfinite(one).all(axis=1) & np.isfinite(other).all(axis=1)  # some landmarks are missing
    one, other = (x[known] - x[known].mean(axis=0) for x in (one, other))
    u, s, v = np.linalg.svd(other.T @ one)
    sign = np.diag([1.0, np.sign(np.linalg.det(u @ v))])
    other = other @ (u @ sign @ v) * (s * np.diag(sign)).sum() / (other**2).sum()
    scale = 0.7 / max(np.linalg.norm(x, axis=1).max() for x in (one, other))
    one, other = one * scale, other * scale

    def away(k: int) -> Any:
        return np.minimum(np.linalg.norm(one - one[k], axis=1), np.linalg.norm(other - other[k], axis=1))

    chosen, distance = [0], away(0)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, away(chosen[-1]))
    return PointSet(one[chosen], other[chosen], np.zeros(count))


def pairs(repeat: int) -> None:
    """Share of random pairs that is connected, in how many steps, and whether each success holds when stepped anew.

    What 10 steps do not connect is tried with more, as the message advises.
    """
    euler, everyone = module("explicit-euler"), specimens()
    generator, ways, times, false = np.random.default_rng(2), dict[str, int](), list[float](), 0
    for _ in range(200):
        first, second = generator.choice(len(everyone), 2, replace=False)
        points = aligned(everyone[first], everyone[second])
        for steps in (10, 20, 40, 80):
            begin = perf_counter()
            solution = euler.solve(points.start, points.target, steps)
            times.append(perf_counter() - begin)
            if solution.status == "solved":
                break
        way = f"in {steps} steps by {solution.attempts[-1].split(':')[0]}"
        way = way if solution.status == "solved" else solution.status
        ways[way] = ways.get(way, 0) + 1
        if solution.status == "solved":
            false += arrival_error(solution, points, steps) > 1e-8
        else:
            CONSOLE.print(f"specimens {first} and {second}: {solution.message}")
    for way, count in sorted(ways.items()):
        CONSOLE.print(f"{count:4d} {way}")
    CONSOLE.print(f"{false} false successes; median {np.median(times):.3f} s, slowest {max(times):.1f} s")
    del repeat


def arrival_error(solution: Any, points: PointSet, steps: int) -> float:
    """How far the targets are missed from the solution's momenta, by explicit Euler steps in numpy."""
    end = numpy_path(points.start, solution.p[0], steps)[0]
    return float(np.abs(end - points.target).max())


def planets(repeat: int) -> None:
    """Energy over a million days, and steps per second beside DOP853 at the same error of the energy."""
    path = ROOT / "problems" / "outer_solar_system.py"
    for scheme, steps in (("stormer-verlet", 100_000), ("midpoint", 10_000), ("explicit-euler", 100_000)):
        made: Any = load(build(path, scheme=scheme).path)
        solution, seconds = best(lambda m=made, n=steps: m.solve(n, every=10), min(repeat, 3))
        error = np.abs(solution.energy - solution.energy[0])
        half = error.size // 2
        CONSOLE.print(
            f"{scheme}, {steps} steps: energy error {error[:half].max():.2e} in the first half, "
            f"{error[half:].max():.2e} in the second, of {solution.energy[0]:.4e}; "
            f"{steps / seconds:.3g} steps/s, {seconds:.3f} s"
        )
    grid = made.make_grid(1)
    gradient_free = made

    def field(_: float, y: Any) -> Any:
        q, p = y.reshape(2, 6, 3)
        masses = grid.own[:, 0]
        d = q[:, None] - q[None]
        cube = ((d**2).sum(-1) + np.eye(6)) ** 1.5
        pull = grid.parameters[0] * (masses[:, None] * masses[None] / cube)[..., None] * d
        return np.concatenate([(p / masses[:, None]).ravel(), -pull.sum(1).ravel()])

    scale = np.concatenate([np.ones(18), np.repeat(grid.own[:, 0], 3) * 1e-3])
    for tolerance in (1e-7, 1e-9):
        begin = perf_counter()
        found = solve_ivp(field, (0, 1e6), grid.start.ravel(), "DOP853", rtol=tolerance, atol=tolerance * scale)
        seconds = perf_counter() - begin
        energy = [gradient_free.energy(y, 0.0, grid.parameters) for y in found.y.T]
        error = np.abs(np.array(energy) - energy[0]).max()
        CONSOLE.print(f"DOP853 at {tolerance:g}: energy error {error:.2e}, {found.t.size - 1} steps, {seconds:.3f} s")


def main() -> None:
    """Run the named parts, or all."""
    parts: dict[str, Callable[[int], None]] = {
        function.__name__: function for function in (table, speed, sizes, threads, hard, pairs, planets)
    }
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", choices=[*parts, []])
    parser.add_argument("--repeat", type=int, default=20)
    parser.add_argument("--plot", type=Path, help="where sizes draws time against the number of landmarks, as PNG")
    chosen = parser.parse_args()
    parts["sizes"] = partial(sizes, plot=chosen.plot)
    for name in chosen.parts or parts:
        CONSOLE.rule(name)
        parts[name](chosen.repeat)


if __name__ == "__main__":
    main()
