"""Modules for a report: derived and compiled by two worker processes at once, into a folder beside the page."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from codegen.errors import CodegenError
from codegen.evidence.report.store import Case, Store, Values
from codegen.solving.loading import GeneratedModule, few_steps, is_control, is_simulation, load, machine_code_counts

WORKERS = 2
MODULES, SURVEYS = "modules", "surveys"
"""Sections of the store."""


@dataclass(frozen=True)
class Variant:
    """A problem with a method and a scheme of a stated order, arguments of problem(), and its form."""

    problem: Path
    method: str
    scheme: str
    order: int
    arguments: tuple[tuple[str, str], ...] = ()
    general: bool = False
    """Whether nothing is left out."""

    @property
    def label(self) -> str:
        """Method, scheme and arguments in words."""
        settings = "".join(f", {name} = {value}" for name, value in self.arguments)
        return f"{self.method} {self.scheme}{settings}{', general form' if self.general else ''}"

    @property
    def case(self) -> str:
        """Its name in the store."""
        return f"{self.problem.stem}; {self.label}"


class Workshop:
    """Builds variants and hands out their modules; what was built before is not built again."""

    def __init__(self, folder: Path, store: Store) -> None:
        """Modules go to `folder`; how long they took, and what was refused, to the store."""
        self.folder, self.store = folder, store
        self._paths: dict[Variant, Path] = {}

    def module(self, variant: Variant) -> GeneratedModule:
        """The module of a variant that was built; raises CodegenError for one that was refused."""
        if variant not in self._paths:
            values = self.store.get(MODULES, variant.case)
            path = self.folder / values["file"] if values is not None and values.get("file") else None
            self._paths[variant] = path if path is not None and path.is_file() else _derived(variant, self.folder)
        return load(self._paths[variant])

    def built(self, variants: Iterable[Variant]) -> list[Variant]:
        """Those variants that have a module."""
        return [v for v in variants if (self.store.get(MODULES, v.case) or {}).get("status") == "built"]


@contextmanager
def workers() -> Iterator[ProcessPoolExecutor]:
    """Processes of their own, so that neither sympy nor a compilation disturbs what is measured."""
    pool = ProcessPoolExecutor(WORKERS, multiprocessing.get_context("spawn"), _get_ready)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)  # whoever interrupts a report does not wait for what is still to be built


def surveyed(
    pool: ProcessPoolExecutor, store: Store, problems: Iterable[Path], report_progress: Callable[[str], None]
) -> None:
    """Find out what every problem offers; a file that cannot be read is recorded as refused."""
    _gather(store, SURVEYS, {p.stem: (survey_of, (p,)) for p in problems}, pool, report_progress)


def build_all(
    pool: ProcessPoolExecutor, workshop: Workshop, variants: Iterable[Variant], report_progress: Callable[[str], None]
) -> None:
    """Derive and compile variants that the store does not know yet."""
    jobs: dict[str, Any] = {v.case: (build_one, (v, workshop.folder)) for v in variants}
    _gather(workshop.store, MODULES, jobs, pool, report_progress)


def _gather(
    store: Store, section: str, jobs: dict[str, Any], pool: ProcessPoolExecutor, report_progress: Callable[[str], None]
) -> None:
    pending: dict[str, Future[Values]] = {
        name: pool.submit(function, *arguments)
        for name, (function, arguments) in jobs.items()
        if store.get(section, name) is None
    }
    for name, future in pending.items():
        report_progress(name)
        store.measured(Case(section, name, future.result))


def _get_ready() -> None:
    """Import what is slow, and let numba compile something, so that no module's times contain it."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    from numba import njit

    import codegen.evidence.report.survey
    import codegen.solving.compiler

    assert codegen.solving.compiler
    assert codegen.evidence.report.survey
    njit(_nothing)(0.0)


def _end_with_parent() -> None:
    """Do not wait for ever where whoever gave the work was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _nothing(x: Any) -> Any:
    return x


def survey_of(problem: Path) -> dict[str, Any]:
    """What a problem offers, with its optimal cost where that has a closed form; runs in a worker."""
    from codegen.evidence.report.survey import exact_cost, survey

    try:
        return {"status": "read", **survey(problem), "exact cost": exact_cost(problem)}
    except CodegenError as error:
        return {"status": "refused", "message": str(error)}


def build_one(variant: Variant, folder: Path) -> dict[str, Any]:
    """Derive, write and compile; times of each, size of the text, and what was left out. Runs in a worker."""
    from codegen.solving import api
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
    # Lines and bytes of a module, and lines of its kernels, that is of what is special about the problem.
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
        **(_derivations(variant) if variant.general else {}),
        "order": module.metadata.order,
        "steps": module.metadata.steps,
    }


def _derived(variant: Variant, folder: Path) -> Path:
    from codegen.solving.compiler import build

    arguments = dict(variant.arguments)
    return build(
        variant.problem, arguments, scheme=variant.scheme, method=variant.method, general=variant.general, out=folder
    ).path


def _derivations(variant: Variant) -> dict[str, float]:
    """Processor seconds of deriving a module in both forms, when sympy has met the problem already."""
    from codegen.emit.naming import Choices
    from codegen.solving.compiler import generate

    found = {}
    for name, general in (("plain", False), ("general", True)):
        begin = time.process_time()
        generate(variant.problem, dict(variant.arguments), Choices(variant.scheme, variant.method, general=general))
        found[f"{name} derivation processor seconds"] = time.process_time() - begin
    return found
