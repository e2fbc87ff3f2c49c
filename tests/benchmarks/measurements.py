"""Published problems with measurements: optima, builds with ten times as many samples, how often intervals hold.

    python tests/benchmarks/measurements.py [--sets M] [--scheme NAME]

Prints, for gas oil, methanol and predator and prey, by the problem's own scheme and steps and by hermite-simpson: the
optimum, its relative distance from what is published, iterations, milliseconds of a solve; then seconds of a build,
with machine code, for the data as published and for ten times as many samples of the fitted motion, and whether the
kernels of both are the same text. Then the Monte Carlo: from the fitted motion of gas oil M sets of data are made with
normal errors of the deviation that was estimated, each is fitted by the same module, and the share of 95 % intervals
that hold the true parameter is printed, with and without a given standard deviation.
"""

import argparse
import os
import sys
import tempfile
from pathlib import Path
from time import perf_counter
from typing import Any

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from dataclasses import replace

import numpy as np
from compiled_modules import compiled
from published_references import PUBLISHED

from codegen.solving.compiler import build
from codegen.solving.loading import time_grid
from codegen.solving.results.control import held_at_bounds
from codegen.solving.results.estimates import Fit, estimates_of

PROBLEMS = Path(__file__).resolve().parents[2] / "problems"
NAMES = ("gas_oil", "methanol", "predator_prey")
FINE_STEPS = 200
"""Intervals of hermite-simpson."""
STEPS = 380
"""Intervals in the Monte Carlo: samples of gas oil lie at nodes."""
REFERENCES = {reference.problem: reference for reference in PUBLISHED}


def timed_build(path: Path, cache: Path, scheme: str | None = None) -> tuple[Any, float]:
    """A module with machine code of all that `solve` calls, in a cache of its own, and the seconds it took."""
    os.environ["CODEGEN_CACHE_DIR"] = str(cache)
    begin = perf_counter()
    module = compiled(build(path, scheme=scheme).path)
    return module, perf_counter() - begin


def kernels(module: Any) -> str:
    """The text of a module without its header and without its measurements."""
    text = Path(module.__file__).read_text()
    before, _, behind = text.partition("OBSERVATIONS = (")
    return before.partition("NODE = ")[2] + behind.partition("# of each body")[2]


def solved(name: str, module: Any, steps: int) -> Any:
    """Solve twice and print a row."""
    module.solve(steps)
    begin = perf_counter()
    solution = module.solve(steps)
    seconds = perf_counter() - begin
    error = solution.cost / REFERENCES[name].value - 1.0
    row = f"{name:14} {module.metadata.scheme:16} {steps:6} {solution.cost:.9e} {error:+.1e}"
    print(f"{row} {solution.iterations:4} {1e3 * seconds:8.1f}")
    return solution


def with_more_samples(name: str, module: Any, solution: Any, folder: Path, factor: int = 10) -> Path:
    """The problem with as many times as many samples, of the fitted motion at times in between."""
    told, rows = module.metadata.observations, module.OBSERVATIONS[0]
    times = np.interp(np.linspace(0, len(rows) - 1, factor * len(rows)), np.arange(len(rows)), rows[:, 0])
    given = np.full((times.size, rows.shape[1]), 1.0)
    given[:, 0] = times
    fit = Fit(module, module.make_grid(module.metadata.steps, observations=given), solution.unknowns)
    (folder / "data").mkdir(exist_ok=True)
    (folder / "published").mkdir(exist_ok=True)
    lines = [",".join([told.time, *told.columns])]
    lines += [",".join(map(repr, map(float, (t, *values)))) for t, values in zip(times, fit.fitted, strict=True)]
    (folder / "data" / f"{name}.csv").write_text("\n".join(lines) + "\n")
    path = folder / "published" / f"{name}.py"
    path.write_text((PROBLEMS / "published" / f"{name}.py").read_text())
    return path


def coverage(module: Any, sets: int) -> None:
    """Fit synthetic data of gas oil and print how often intervals hold what is true."""
    best, grid = module.solve(STEPS), time_grid(module, STEPS)
    found = estimates_of(module, grid, best.unknowns, held_at_bounds(module, grid, best.unknowns))
    assert found is not None
    truth, own = Fit(module, grid, best.unknowns).fitted, module.OBSERVATIONS[0]
    generator, columns = np.random.default_rng(20), truth.shape[1]
    original = module.metadata
    for known in (False, True):
        held, failed, begin = np.zeros(len(found.names)), 0, perf_counter()
        sigmas = (found.deviation,) * columns if known else (None,) * columns
        module.metadata = replace(original, observations=replace(original.observations, sigmas=sigmas))
        for _ in range(sets):
            rows = own.copy()
            rows[:, 1 : 1 + columns] = truth + found.deviation * generator.standard_normal(truth.shape)
            rows[:, 1 + columns :] = found.deviation if known else 1.0
            solution = module.solve(STEPS, observations=rows, guess=best.unknowns, warm=True)
            if solution.status != "solved":
                failed += 1
                continue
            grid = module.make_grid(STEPS, observations=rows)
            one = estimates_of(module, grid, solution.unknowns, held_at_bounds(module, grid, solution.unknowns))
            assert one is not None
            low, high = one.intervals.T
            held += (low <= found.values) & (found.values <= high)
        module.metadata = original
        shares = ", ".join(f"{n} {100 * h / (sets - failed):.1f} %" for n, h in zip(found.names, held, strict=True))
        sigma = "given" if known else "estimated"
        seconds = perf_counter() - begin
        print(f"sigma {sigma}: intervals hold {shares}; {failed} of {sets} not solved; {seconds:.1f} s")


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=1000, help="synthetic sets of data")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print("problem        scheme           steps  optimum         error  iterations  ms")
        builds, modules = [], {}
        for problem in NAMES:
            path = PROBLEMS / "published" / f"{problem}.py"
            module, seconds = timed_build(path, folder / "own")
            solution = modules[problem] = solved(problem, module, module.metadata.steps)
            solved(problem, timed_build(path, folder / "own", "hermite-simpson")[0], FINE_STEPS)
            more, longer = timed_build(with_more_samples(problem, module, solution, folder), folder / "more")
            assert more.solve().status == "solved"
            builds.append((problem, seconds, longer, kernels(module) == kernels(more)))
            modules[problem] = module
        print("\nproblem        build (s)  with ten times as many samples (s)  same kernels")
        for problem, seconds, longer, same in builds:
            print(f"{problem:14} {seconds:9.1f}  {longer:34.1f}  {same}")
        print()
        coverage(modules["gas_oil"], options.sets)


if __name__ == "__main__":
    main()
