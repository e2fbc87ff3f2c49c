"""Modules for a report: two worker processes derive and compile them into a folder beside the page.

A survey of a problem file lists the methods and schemes that may apply, and the optimal cost where the problem has a
closed form. Surveys and builds need sympy, so that they run in the workers only.
"""

from __future__ import annotations

import multiprocessing
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from codegen.errors import CodegenError
from codegen.evidence.report.store import Case, Store, Values
from codegen.evidence.stress.pool import end_with_parent
from codegen.solving.loading import (
    ControlModule,
    GeneratedModule,
    SimulateModule,
    few_steps,
    is_control,
    is_simulation,
    load,
    machine_code_counts,
)

WORKERS = 2
MODULES, SURVEYS = "modules", "surveys"
"""Sections of the store."""


@dataclass(frozen=True)
class Variant:
    """A problem with a method, a scheme of a stated order and arguments of problem().

    `general` asks for the general form of the module, which leaves nothing out.
    """

    problem: Path
    method: str
    scheme: str
    order: int
    arguments: tuple[tuple[str, str], ...] = ()
    general: bool = False

    @property
    def label(self) -> str:
        """Method, scheme and arguments in words."""
        settings = "".join(f", {name} = {value}" for name, value in self.arguments)
        return f"{self.method} {self.scheme}{settings}{', general form' if self.general else ''}"

    @property
    def case(self) -> str:
        """The name of the variant in the store."""
        return f"{self.problem.stem}; {self.label}"

    def run(self, steps: int) -> str:
        """The name of a solve with a number of steps in the store."""
        return f"{self.label}; N {steps}"

    def rows(self, store: Store, section: str) -> list[Values]:
        """The solves of the variant in a section of the store, by growing number of steps."""
        rows = [values for name, values in store.rows(section) if name.startswith(f"{self.label}; N ")]
        return sorted(rows, key=lambda values: values["steps"])


class Workshop:
    """Builds variants and returns their modules; a module that was built before is not built again."""

    def __init__(self, folder: Path, store: Store) -> None:
        """Modules are written to `folder`; build times and refusals go to the store."""
        self.folder, self.store = folder, store
        self._paths: dict[Variant, Path] = {}

    def module(self, variant: Variant) -> GeneratedModule:
        """The module of a variant that was built; raises CodegenError for a variant that was refused."""
        if variant not in self._paths:
            values = self.store.get(MODULES, variant.case)
            path = self.folder / values["file"] if values is not None and values.get("file") else None
            self._paths[variant] = path if path is not None and path.is_file() else _derived(variant, self.folder)
        return load(self._paths[variant])

    def control(self, variant: Variant) -> ControlModule:
        """The module of an optimal control problem."""
        module = self.module(variant)
        assert is_control(module)
        return module

    def simulation(self, variant: Variant) -> SimulateModule:
        """The module of a simulation."""
        module = self.module(variant)
        assert is_simulation(module)
        return module

    def built(self, variants: Iterable[Variant]) -> list[Variant]:
        """The variants that have a module."""
        return [v for v in variants if (self.store.get(MODULES, v.case) or {}).get("status") == "built"]


@contextmanager
def workers() -> Iterator[ProcessPoolExecutor]:
    """Worker processes, so that neither sympy nor a compilation disturbs the measurements."""
    pool = ProcessPoolExecutor(WORKERS, multiprocessing.get_context("spawn"), _prepare_worker)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)  # an interrupted report does not wait for builds that have not begun


def gather(
    pool: ProcessPoolExecutor,
    store: Store,
    section: str,
    jobs: Mapping[str, Callable[[], Values]],
    report_progress: Callable[[str], None],
) -> None:
    """Let the workers do the jobs of a section that the store does not contain yet."""
    pending = {name: pool.submit(job) for name, job in jobs.items() if store.get(section, name) is None}
    for name, future in pending.items():
        report_progress(name)
        store.measured(Case(section, name, future.result))


def _prepare_worker() -> None:
    """Import slow libraries and let numba compile a function, so that no build time contains these."""
    threading.Thread(target=end_with_parent, daemon=True).start()
    from numba import njit

    import codegen.solving.compiler

    assert codegen.solving.compiler
    njit(lambda x: x)(0.0)


def survey_of(problem: Path) -> Values:
    """Task, form, number of phases, usable methods and schemes, and the optimal cost, as plain values for JSON.

    A scheme is a row (method, name, order, True if it is symplectic). The default of the problem comes first. Only the
    build tells whether a scheme applies. The optimal cost is None unless the maximum principle has a closed-form
    solution. A file that cannot be read is recorded as refused. Runs in a worker.
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
        listed = [[method, scheme.name, scheme.order, scheme.symplectic] for method, scheme in rows]
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


def build_one(variant: Variant, folder: Path) -> Values:
    """Derive, write and compile a module; return times, sizes and omissions. Runs in a worker."""
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
    module = load(path)
    loaded = time.perf_counter()
    if is_simulation(module):
        api.solve(module, steps=few_steps(module, 2))
    else:
        compile_all(module)
    compiled, busy_compiled = time.perf_counter(), time.process_time()
    if is_control(module):
        steps = few_steps(module, min(10, module.metadata.steps))
        api.solve(module, steps=steps)  # compiles what scipy's optimisers call
    is_new = bool(machine_code_counts(module)[0])  # else the machine code was read from disk
    # Processor seconds that the derivation of either form takes once sympy's caches know the problem.
    times = {}
    for name, general in (("plain", False), ("general", True)) if variant.general else ():
        begin = time.process_time()
        generate(variant.problem, dict(variant.arguments), Choices(variant.scheme, variant.method, general=general))
        times[f"{name} derivation processor seconds"] = time.process_time() - begin
    # Kernel lines are the first part of the module, which is special to the problem.
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
        variant.problem, arguments, scheme=variant.scheme, method=variant.method, general=variant.general, out=folder
    ).path
