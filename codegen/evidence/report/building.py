"""Generation of the modules of a report, and the processor times of their solves.

Two processes derive and compile the modules into a folder next to the page. A survey of a problem file lists the
methods and schemes that may apply, and the optimal cost if a closed form exists. Surveys and builds need sympy, so they
run in the worker processes only.

The time of a solve is the processor time of its thread. Other programs on the machine add to the wall clock, which is
recorded as well. In every round, each solve is repeated until its sample is long compared with the resolution of the
clock. A machine that becomes slower during the measurements slows all solves down, not only some grids of one scheme.
"""

from __future__ import annotations

import gc
import math
import multiprocessing
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from codegen.errors import CodegenError
from codegen.evidence.report.store import Case, Store, Values, section_of
from codegen.evidence.stress.pool import end_with_parent
from codegen.solving import loading
from codegen.solving.drivers import DRIVERS
from codegen.solving.loading import GeneratedModule
from codegen.solving.results.result import Run

if TYPE_CHECKING:
    from codegen.discretise.schemes import Scheme

WORKERS = 2
_PLACES = {"interval": "", "stages": ", controls at stages", "linear": ", linear controls", "nodal": ", nodal controls"}
MODULES, SURVEYS = (
    "modules",
    "problem files",
)  # the sections of the store with the properties of modules and of problem files


@dataclass(frozen=True)
class Variant:
    """The inputs of one generated module: problem file, method, scheme with its stated order, arguments of problem().

    `general` asks for the general form of the module, which also contains the parts that the problem does not need.
    `controls` are constant on each "interval", at "stages", "linear", or "nodal".
    """

    problem: Path
    method: str
    scheme: str
    order: int
    arguments: tuple[tuple[str, str], ...] = ()
    general: bool = False
    controls: str = "interval"

    @property
    def label(self) -> str:
        """Return method, scheme, place of controls and arguments as text."""
        settings = "".join(f", {name} = {value}" for name, value in self.arguments)
        form = ", general form" if self.general else ""
        return f"{self.method} {self.scheme}{_PLACES[self.controls]}{settings}{form}"

    @property
    def case(self) -> str:
        """Return the name of the module's case in the store."""
        return f"{self.problem.stem}; {self.label}"

    def run(self, steps: int) -> str:
        """Return the name of the case in the store that solves with `steps` time steps."""
        return f"{self.label}; N {steps}"

    def rows(self, store: Store, section: str) -> list[Values]:
        """Return the solves of the variant in a section of the store, by increasing number of steps."""
        rows = [values for name, values in store.rows(section) if name.startswith(f"{self.label}; N ")]
        return sorted(rows, key=lambda values: values["steps"])


class Workshop:
    """A folder of generated modules by variant; a module without a file is built on demand."""

    def __init__(self, folder: Path, store: Store) -> None:
        """Set the folder of the modules, and the store that lists built and refused variants."""
        self.folder, self.store = folder, store
        self._paths: dict[Variant, Path] = {}

    def path(self, variant: Variant) -> Path:
        """Return the file of a variant's module; raise CodegenError if the variant cannot be built."""
        if variant not in self._paths:
            values = self.store.get(MODULES, variant.case)
            path = self.folder / values["file"] if values is not None and values.get("file") else None
            self._paths[variant] = path if path is not None and path.is_file() else _derived(variant, self.folder)
        return self._paths[variant]

    def module(self, variant: Variant) -> loading.GeneratedModule:
        """Return the module of a variant; raise CodegenError if the variant cannot be built."""
        return loading.load(self.path(variant))

    def control(self, variant: Variant) -> loading.ControlModule:
        """Return the module of an optimal control problem."""
        return load_control(self.path(variant))

    def simulation(self, variant: Variant) -> loading.SimulateModule:
        """Return the module of a simulation."""
        module = self.module(variant)
        assert loading.is_simulation(module)
        return module

    def built(self, variants: Iterable[Variant]) -> list[Variant]:
        """Return the variants that were built without an error."""
        return [v for v in variants if (self.store.get(MODULES, v.case) or {}).get("status") == "built"]


def load_control(path: Path) -> loading.ControlModule:
    """Return the module of an optimal control problem by its file."""
    module = loading.load(path)
    assert loading.is_control(module)
    return module


@contextmanager
def workers() -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of worker processes, so that neither sympy nor a compilation disturbs the measurements."""
    pool = ProcessPoolExecutor(WORKERS, multiprocessing.get_context("spawn"), _prepare_worker)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)  # an interrupted report does not wait for builds that have not begun


def gather(
    pool: ProcessPoolExecutor, store: Store, cases: Iterable[Case], report_progress: Callable[[str], None]
) -> None:
    """Measure in the pool all cases that the store does not contain, and store them."""
    new = {(case.section, case.name): case for case in cases if store.get(case.section, case.name) is None}
    pending = [(case, pool.submit(case.measure)) for case in new.values()]
    for number, (case, future) in enumerate(pending, start=1):
        report_progress(f"{case.name} ({number} of {len(pending)})")
        store.measured(Case(case.section, case.name, future.result))


def _prepare_worker() -> None:
    """Import slow libraries and let numba compile a function, so that build times do not contain either."""
    threading.Thread(target=end_with_parent, daemon=True).start()
    from numba import njit

    import codegen.solving.compiler

    assert codegen.solving.compiler
    njit(lambda x: x)(0.0)


def survey_of(problem: Path) -> Values:
    """Return the properties of a problem file for the store: task, form, number of phases, schemes, optimal cost.

    A scheme is a row (method, name, order, True if it is symplectic, place of controls, number of steps of another
    scheme of which it consists); the default of the problem comes first. Only a build shows if a scheme applies. The
    optimal cost is None unless the maximum principle has a closed-form solution. For a file that cannot be read, the
    status is "refused". The function runs in a worker process.
    """
    from codegen.discretise import schemes
    from codegen.discretise.model.definitions import Model
    from codegen.discretise.model.from_problem import load_problem
    from codegen.discretise.particles import PARTICLE_SCHEMES
    from codegen.discretise.transcribe import methods_for
    from codegen.evidence.analysis.maximum_principle import exact_optimum

    try:
        model = load_problem(problem, {})
        rows: list[tuple[str, schemes.Scheme]]
        if isinstance(model, Model):
            form, phases, methods = model.form, len(model.phases), methods_for(model)
            rows = [(method, scheme) for method in methods for scheme in schemes.of_method(method)]
        else:
            form, phases, methods = "particles", 0, ("stepping",) if model.connects else ("hamiltonian",)
            usable = [scheme for scheme in PARTICLE_SCHEMES.values() if not scheme.adaptive]
            rows = [(method, scheme) for method in methods for scheme in usable]
        rows.sort(key=lambda row: (row[0] != methods[0], row[1].name != "midpoint"))
        listed = [
            [method, scheme.name, scheme.order, scheme.symplectic, place, len(scheme.parts)]
            for method, scheme in rows
            for place in (_places(scheme) if model.task == "control" and not phases else ("interval",))
        ]
        cost = None
        if isinstance(model, Model) and model.task == "control":
            # Bounds, for example, and controls that the maximum principle does not determine, have no closed form.
            with suppress(CodegenError):
                optimum = exact_optimum(model)
                cost = None if optimum is None else optimum.cost_at()
    except CodegenError as error:
        return {"status": "refused", "message": str(error)}
    return {
        "status": "read", "task": model.task, "schemes": listed, "form": form, "phases": phases, "exact cost": cost,
    }  # fmt: skip


def _places(scheme: Scheme) -> tuple[str, ...]:
    """Return the places of controls that differ for a scheme.

    Controls at stages raise the order of the optimum above 2. Compositions and tables with negative weights are left
    out: a cost of controls at stages then has no minimum. Linear controls have at most the order 4.
    """
    if scheme.parts:
        return ("interval",)
    is_positive = scheme.variational or min(map(float, scheme.step().tableau.weights)) >= 0.0
    stages = ("stages",) if scheme.order > 2 and is_positive else ()
    return ("interval", *stages, *(("linear",) if 2 <= scheme.order <= 4 and scheme.resolves_lines else ()))


def build_one(variant: Variant, folder: Path) -> Values:
    """Derive, write and compile a module; return times, sizes and omitted parts. Runs in a worker process."""
    from codegen.emit.naming import Choices
    from codegen.solving import api
    from codegen.solving.compiler import generate
    from codegen.solving.machine_code.compilation import compile_all

    begin = time.perf_counter()
    try:
        path = _derived(variant, folder)
    except CodegenError as error:
        return {"status": "refused", "message": str(error)}
    derived, busy_derived = time.perf_counter(), time.process_time()
    module = loading.load(path)
    loaded = time.perf_counter()
    if loading.is_simulation(module):
        api.solve(module, steps=loading.few_steps(module, 2))
    else:
        compile_all(module)
    compiled, busy_compiled = time.perf_counter(), time.process_time()
    if loading.is_control(module):
        steps = loading.few_steps(module, min(10, module.metadata.steps))
        api.solve(module, steps=steps)  # compiles what scipy's optimisers call
    is_new = bool(loading.machine_code_counts(module)[0])  # else the machine code was read from disk
    # Processor seconds of the derivation of each form, while sympy's caches contain the problem.
    times = {}
    for name, general in (("plain", False), ("general", True)) if variant.general else ():
        busy = time.process_time()
        generate(
            variant.problem, dict(variant.arguments), Choices(variant.scheme, variant.method, variant.controls, general)
        )
        times[f"{name} derivation processor seconds"] = time.process_time() - busy
    # Kernel lines are the first part of the module, which is specific to the problem.
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    heads = [i for i, line in enumerate(lines) if line.startswith("# ---- ")]
    return {
        "status": "built",
        "file": path.name,
        "derivation seconds": derived - begin,
        "load seconds": loaded - derived,
        "compile seconds": compiled - loaded if is_new else None,
        "compile processor seconds": busy_compiled - busy_derived if is_new else None,
        **{"lines": len(lines), "bytes": len(text.encode()), "kernel lines": heads[1] - heads[0] if heads[1:] else 0},
        "operations": {name: list(counts) for name, counts in module.metadata.operations.items()},
        "left out": list(module.metadata.left_out),
        "solver": getattr(module.metadata, "solver", None),
        **times,
        "order": module.metadata.order,
        "steps": module.metadata.steps,
    }


def _derived(variant: Variant, folder: Path) -> Path:
    from codegen.solving.compiler import build

    arguments = dict(variant.arguments)
    return build(
        variant.problem,
        arguments,
        scheme=variant.scheme,
        method=variant.method,
        controls=variant.controls,
        general=variant.general,
        out=folder,
    ).path


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
