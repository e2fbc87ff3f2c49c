"""Processor times of solves, which are repeated in turns until their spread is known.

The time of a solve is the processor time of its thread. Other programs on the machine add to the wall clock, which is
recorded as well. In every round, each solve is repeated until its sample is long compared with the resolution of the
clock. A machine that becomes slower during the measurements slows all solves down, not only some grids of one scheme.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from codegen.evidence.report.building import Variant
from codegen.evidence.report.store import Case, Store, Values, section_of
from codegen.solving.drivers import DRIVERS
from codegen.solving.loading import GeneratedModule
from codegen.solving.results.result import Run

LEAST_SECONDS = 1e-3
"""The least processor time of a sample; shorter solves are repeated in it. The clock resolves a thousandth of it."""
LONG_SECONDS = 1e-2  # a solve that takes longer is not repeated before a sample: the caches are full within 0.1 ms
LEAST_SAMPLES, MOST_SAMPLES, SPREAD = 5, 15, 0.03
"""Limits of samples, and the spread below which no more are taken: interquartile range / (median sqrt(samples))."""
RULE = (
    "A time is processor time of the thread, the median of samples that are taken in turns over all schemes and grids "
    f"in one process, with warm machine code. Samples end once their interquartile range is below {100 * SPREAD:g} % "
    f"of the median times the root of their number (at least {LEAST_SAMPLES}), or with the budget of the report."
)


@dataclass(frozen=True)
class Time:
    """The median seconds of one solve by processor and wall clock, the relative spread, and the number of samples."""

    processor: float
    wall: float
    spread: float
    samples: int


def solver(module: GeneratedModule, steps: int, driver: str = "newton", every: int = 1) -> Callable[[], object]:
    """Return the function that solves on `steps` intervals from the problem's own guess without further checks."""
    return partial(DRIVERS[driver].function(str(module.metadata.task)), module, Run(steps, every))


def timed(run: Callable[[], object], budget: float) -> Time:
    """Return the time of a function, from samples that end by the rule or after `budget` seconds."""
    samples: list[Values] = []
    while not _is_settled(samples, budget):
        samples.append(_sample(run, samples))
    return _time_of(samples)


def cases(problem: Path, runs: Mapping[str, Callable[[], object]], store: Store, budget: float) -> Iterator[Case]:
    """Yield a case for each round, in which every function of `runs` whose spread is not known has one sample.

    No function is called for more than about `budget` seconds.
    """
    section = section_of(problem, "times")
    while True:
        samples = _samples(store, section)
        pending = {name: run for name, run in runs.items() if not _is_settled(samples.get(name, []), budget)}
        if not pending:
            return
        number = 1 + sum(1 for _ in store.rows(section))
        yield Case(section, f"round {number}", partial(_round, pending, samples))


def times(store: Store, problem: Path) -> dict[str, Time]:
    """Return the times of all solves of a problem by name."""
    return {name: _time_of(samples) for name, samples in _samples(store, section_of(problem, "times")).items()}


def timed_rows(store: Store, problem: Path, variant: Variant, part: str) -> list[Values]:
    """Return the solves of a variant in a section of the store, with their times; by increasing number of steps."""
    measured = times(store, problem)
    rows = list[Values]()
    for row in variant.rows(store, section_of(problem, part)):
        time_of = measured.get(variant.run(row["steps"]))
        rows.append({
            **row, "seconds": time_of and time_of.processor, "wall seconds": time_of and time_of.wall,
            "spread": time_of and time_of.spread,
        })  # fmt: skip
    return rows


def _round(runs: Mapping[str, Callable[[], object]], earlier: Mapping[str, Sequence[Values]]) -> Values:
    return {name: _sample(run, earlier.get(name, ())) for name, run in runs.items()}


def _sample(run: Callable[[], object], earlier: Sequence[Values]) -> Values:
    """Return the mean processor and wall seconds of a solve over so many solves that the clock resolves them.

    A solve before the sample fills the processor's caches, which hold other solves. A long solve fills them itself.
    """
    count = int(earlier[-1]["solves"]) if earlier else 1
    if not earlier or earlier[-1]["wall seconds"] < LONG_SECONDS:
        run()
    is_enabled = gc.isenabled()
    gc.disable()
    try:
        while True:
            wall, processor = time.perf_counter(), time.thread_time_ns()
            for _ in range(count):
                run()
            spent = 1e-9 * (time.thread_time_ns() - processor)
            wall = time.perf_counter() - wall
            if earlier or spent >= 0.5 * LEAST_SECONDS:
                return {"processor seconds": spent / count, "wall seconds": wall / count, "solves": count}
            count = math.ceil(1.5 * count * min(100.0, LEAST_SECONDS / max(spent, 1e-7)))
    finally:
        if is_enabled:
            gc.enable()


def _samples(store: Store, section: str) -> dict[str, list[Values]]:
    samples: dict[str, list[Values]] = {}
    for _, values in store.rows(section):
        for name, sample in values.items():
            samples.setdefault(name, []).append(sample)
    return samples


def _is_settled(samples: Sequence[Values], budget: float) -> bool:
    if len(samples) >= MOST_SAMPLES or sum(s["wall seconds"] * s["solves"] for s in samples) >= budget:
        return True
    return len(samples) >= LEAST_SAMPLES and _time_of(samples).spread <= SPREAD


def _time_of(samples: Sequence[Values]) -> Time:
    processor, wall = (np.array([s[f"{clock} seconds"] for s in samples]) for clock in ("processor", "wall"))
    low, median, high = np.percentile(processor, (25, 50, 75))
    spread = (high - low) / (median * math.sqrt(processor.size)) if median else 0.0
    return Time(float(median), float(np.median(wall)), float(spread), processor.size)
