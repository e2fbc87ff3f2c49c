"""A sweep: many solves of one problem, for a grid, a table or samples of cases, by several workers, as one data set.

The steps are: derive the modules, choose the layout of the arrays and the chunks, solve the chunks by an executor, and
mark the jumps of the cost that remain.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from codegen.batch import store
from codegen.batch.cases import Cases
from codegen.batch.executors import Done, Progress, Tally, Team, connected, counted, silent
from codegen.batch.jumps import Costs, along, jumps_of
from codegen.batch.layout import MOST, Chunks, Layout, Rows, about_a_second, blocks_of, layout_of
from codegen.batch.request import GUESS, OPTIONS, STEPS, STORES, SweepRequest, sweep_request
from codegen.batch.store import Frame, Store, resumable, write_netcdf
from codegen.batch.work import Modules, Work, modules_of
from codegen.errors import ArgumentError, ExtraError
from codegen.files import only_one
from codegen.machine import versions
from codegen.problem.sources import ProblemFile, ProblemObject
from codegen.solving.api import require_memory
from codegen.solving.compiler import workers_folder
from codegen.solving.drivers import task_of
from codegen.solving.progress import Working, building
from codegen.solving.results.result import Run, component_units

if TYPE_CHECKING:
    from xarray import Dataset


def sweep(*positional: Any, **options: Any) -> Dataset:  # noqa: D417  the signature is that of sweep_request
    """Solve a problem for many values of its parameters, and return all solutions as one data set.

    Cases are defined by one of `vary`, `cases` and `samples`. Quantities that can vary are parameters of the module,
    durations, prescribed values (`start.r`, `end.phi`), `steps`, `guess`, and arguments of problem(). Each combination
    of arguments has its own module.

    Parameters
    ----------
    problem : Path, str or module
        The problem, as for `codegen.solve`.
    vary : dict of str to array (n,), optional
        Values of quantities; all combinations are cases, and each quantity is a dimension of the data set.
    zipped : sequence of sequences of str
        Groups of names in `vary` that vary together along one dimension, such as `[("m", "r0")]`.
    samples : dict of str to distribution, optional
        Distributions such as `normal(100, 5)`, `uniform(4.9, 5.1)` (from, to), one of scipy.stats with its arguments,
        or a frozen distribution of scipy.
    cases : path, dict of str to array (n,), or int, optional
        A file of comma-separated values, or columns by name, with a case for each row. With `samples` the number of
        samples, 1000 by default.
    sampling : {"random", "latin", "sobol"}
        The sampling method.
    seed : int
        The same seed gives the same samples.
    out : path, optional
        A zarr store (.zarr), which is written chunk by chunk, or a netCDF file (.nc). Existing files are kept.
    resume : bool
        Continue a store of the same sweep.
    keep : sequence of str, optional
        Names of arrays to store among t, q, p, u, multipliers, energy, event_counts and event_times. With
        `sensitivities` also the derivatives d_t, d_q, d_p, d_u and d_multipliers. By default all arrays but these
        derivatives are stored. If all arrays would take more than 250 MB without compression, p, multipliers and energy
        are left out.
    workers : int, optional
        Number of threads, or of processes where Python code takes much of the time, as for particles; by default the
        number of processors. Results do not depend on this number. Where processes are spawned, as on Windows and
        macOS, a script needs `if __name__ == "__main__"`.
    executor : {"threads", "cuda"}
        The threads and processes of this machine, or its GPU, as for `codegen.solve_many`.
    cluster : str or distributed.Client, optional
        The address of a scheduler of dask, a client, or "local" for a new cluster on this machine.
    warm_starts : bool
        Start an optimisation from the last solved neighbour. This takes fewer iterations for slowly changing solutions,
        but stays at the same local optimum. The initial guess is extrapolated along the secant if the path through the
        cases is straight, and with `sensitivities` along the tangent. By default a neighbour's solution is tried only
        if the problem's own guess fails.
    chunk : int, optional
        Number of cases that are solved and written together, by default as many as take about a second.
    sensitivities : bool
        Compute derivatives of the cost with respect to all parameters, prescribed values and a fixed duration.
    **options
        `driver`, `arguments`, `scheme`, `method`, `controls`, `steps`, `every`,
        `tolerance`, `max_iterations`, `time_limit`, `scaling` and `points`, as for `codegen.solve`.

    Returns
    -------
    xarray.Dataset
        In the units of the problem file: t (..., node), q and p (..., node, names), u and multipliers on nodes or
        intervals, padded with NaN where `steps` vary. For each case cost, residual (evaluated outside the driver),
        iterations and seconds of all attempts, status, message, and free parameters. A simulation with events has
        event_counts (..., event) and the first times of each event, event_times (..., occurrence, event). The names of
        gaps have the ending `impact`, `rest` or `opening`. With sensitivities d_cost
        (..., by), d_T for a free parameter T, d_q (..., by, node, names), and d_message with the reason of NaN. For
        optimisations `improvement`, the reduction of the cost by a new solve from the better side of a jump, and
        `jump`, 1 if a better neighbour remains. A failed case has NaN in cost and arrays.

    Raises
    ------
    ArgumentError
        For unknown names and options, and for options that do not apply.
    ExtraError
        Without xarray and zarr, or without dask for a cluster.
    ClusterError
        If the scheduler does not answer, has no workers, or is lost.
    CodegenError
        As `codegen.solve`, for a problem that cannot be read, derived or stored.
    """
    try:
        inspect.signature(sweep_request).bind(*positional, **options)
    except TypeError as error:
        raise ArgumentError(f"codegen.sweep: {error}", "give a problem, what varies, and options by name") from None
    return outcome_of(sweep_request(*positional, **options), building).dataset()


setattr(sweep, "__signature__", inspect.signature(sweep_request).replace(return_annotation="Dataset"))  # noqa: B010

MOST_LOOKED_THROUGH = 10_000_000
"""Largest grid in which jumps between chunks are marked, which needs all costs in memory."""


@dataclass(frozen=True, eq=False)
class SweepOutcome:
    """The outcome of a sweep: the tally, the time, messages for the user, and the results.

    `before` is the number of cases that the store already had; their solves are not part of `seconds`. `dataset` opens
    the results, and `layout` has the stored arrays.
    """

    tally: Tally
    before: int
    seconds: float
    messages: tuple[str, ...]
    out: Path | None
    dataset: Callable[[], Dataset]
    layout: Layout

    @property
    def record(self) -> dict[str, object]:
        """The JSON object of `--json`."""
        tally, before = self.tally, {"before": self.before} if self.before else {}
        return {
            "cases": tally.cases, **before, "solved": tally.solved, "failed": tally.failed, "seconds": self.seconds,
            "out": None if self.out is None else str(self.out), **tally.won,
        }  # fmt: skip


def outcome_of(
    request: SweepRequest,
    working: Working = nullcontext,
    progress: Progress = silent,
    require: Callable[[Dataset], None] = lambda outlined: None,
) -> SweepOutcome:
    """Run a sweep and return its outcome; errors in the request are raised before the first solve. See `codegen.sweep`.

    `working` and `progress` show progress. `require` checks the data set before the first solve, still without results.
    """
    begin = time.perf_counter()
    for name in ("xarray", "zarr"):
        if find_spec(name) is None:  # a quick test: both are slow to import
            remedy = "pip install xarray zarr netCDF4"
            raise ExtraError(f"a sweep needs {name}, which is not installed", remedy)
    with connected(request.cluster) as cluster:
        modules = modules_of(request.solve, request.cases, working)
        solve, cases, module, task = request.solve, request.cases, modules.first, task_of(modules.first)
        shapes = [variant.shapes for variant in modules.variants.values() if variant.shapes is not None]
        kinds = {quantity.kind for quantity in modules.quantities}
        steps = int(np.max(cases.columns[STEPS])) if STEPS in kinds else solve.steps
        most = steps or max(own.steps for own in shapes)
        run = Run(
            most, solve.every, tolerance=solve.tolerance, max_iterations=solve.max_iterations, scaling=solve.scaling,
            time_limit=np.inf if solve.time_limit is None else solve.time_limit, points=modules.points,
        )  # fmt: skip
        require_memory(task.numbers(module.metadata, run), most)
        has_jumps = task.name == "control" and GUESS not in kinds
        layout = replace(layout_of(shapes, steps, request.keep, cases.number), has_jumps=has_jumps)
        warm = request.warm_starts and task.name == "control"
        single = Chunks(cases.shape, (1,) * len(cases.shape))
        work = Work(
            solve.driver, run, steps, cases, modules.quantities, modules.variants, layout, single, warm,
            is_on_device=request.is_on_device,
        )  # fmt: skip
        if request.is_on_device:
            work.require_on_device()
        frame = Frame(cases, layout, _attributes(request, modules, work))
        require(frame.outlined())
        is_store = request.out is not None and request.out.suffix in STORES  # written during the sweep
        finish = _into_store if is_store else _into_memory
        team = Team(request.workers, cluster, working, progress)
        tally, before, dataset = finish(request, modules, work, frame, team)
    messages = (*modules.messages, *team.notes)
    return SweepOutcome(tally, before, time.perf_counter() - begin, messages, request.out, dataset, work.layout)


def _into_memory(
    request: SweepRequest, modules: Modules, work: Work, frame: Frame, team: Team
) -> tuple[Tally, int, Callable[[], Dataset]]:
    """Solve all cases in memory, write the requested file, and return (tally, 0, function for the data set)."""
    import xarray

    arrays: Rows = {
        name: np.full(shape, {"str": "", "i4": -1}.get(kind, np.nan), object if kind == "str" else kind)
        for name, (_, shape, kind) in frame.variables.items()
    }
    work = replace(work, chunks=_chunks(request, modules, work, _tried(work, team)))

    def keep(number: int, done: Done) -> None:
        assert done.rows is not None, "without a sink the rows are returned"
        write(work.chunks.region(number), done.rows)

    def write(region: tuple[slice, ...], rows: Rows) -> None:
        for name, array in rows.items():
            arrays[name][region] = array

    tally = team.do(work, range(work.chunks.number), work.cases.number, Tally(), keep)
    tally = _marked(work, tally, lambda: arrays["cost"], write, team)
    variables = {
        name: (dims, arrays[name].astype(np.str_) if kind == "str" else arrays[name])
        for name, (dims, _, kind) in frame.variables.items()
    }
    data = xarray.Dataset(variables, frame.coordinates, dict(frame.attributes))
    if request.out is not None:
        write_netcdf(data, request.out)
    return tally, 0, lambda: data


def _into_store(
    request: SweepRequest, modules: Modules, work: Work, frame: Frame, team: Team
) -> tuple[Tally, int, Callable[[], Dataset]]:
    """Solve the missing chunks of a store; return (tally, cases stored before, function for the data set)."""
    assert request.out is not None, "a store has a path"
    digest, target = _digest(request, modules, work), Store(request.out.absolute())
    taken = ArgumentError(
        f"--out {request.out}: another process is at work on it", "wait until it ends, or choose another name"
    )
    with only_one(workers_folder(), str(request.out.resolve()), taken):
        is_resumed = request.resume and request.out.exists()
        if is_resumed:
            journal = store.resumed(request.out, frame, digest)
        else:
            journal = store.begun(request.out, frame, _chunks(request, modules, work, _tried(work, team)), digest)
        remaining = [number for number in range(journal.chunks.number) if number not in journal.finished]
        before = sum(journal.finished.values(), Tally())
        with resumable(request.out, journal):
            if is_resumed and remaining:
                _tried(work, team)
            work = replace(work, chunks=journal.chunks, sink=target)
            total = work.cases.number
            tally = team.do(work, remaining, total, before, lambda number, done: journal.add(number, done.tally))
            tally = _marked(work, tally, lambda: target.read("cost"), target.write, team)
        return tally, before.cases, target.dataset


def _marked(
    work: Work, tally: Tally, read: Callable[[], Costs], write: Callable[[tuple[slice, ...], Rows], None], team: Team
) -> Tally:
    """Mark the jumps that remain between chunks of a grid, and return the tally with the number of all jumps.

    `read` returns the costs of all cases. Workers have marked jumps inside chunks. Across the border of chunks no case
    was started from the other side.
    """
    is_cut = work.layout.has_jumps and work.chunks.number > 1 and work.cases.is_grid
    if not is_cut or work.cases.number > MOST_LOOKED_THROUGH:
        return tally
    costs = read()
    words = {work.cases.axes[own.name] for own in work.quantities if own.kind == "argument"}
    places = [np.zeros(0) if axis in words else along(work.cases.points_along(axis)) for axis in range(costs.ndim)]
    flags = np.zeros(costs.shape, np.int32)
    flags.ravel()[[worse for worse, _ in jumps_of(costs, places, certain=True)]] = 1
    if flags.any() or tally.jumps:
        write((slice(None),) * costs.ndim, {"jump": flags})
    jumps = int(flags.sum())
    if between := max(0, jumps - tally.jumps):
        lie, them = ("lies", "it") if between == 1 else ("lie", "them")
        note = f"{counted(between, 'jump')} of the cost {lie} between chunks; a larger --chunk may mend {them}"
        team.notes[f"codegen: note: {note}"] = None
    return replace(tally, jumps=jumps)


def _chunks(request: SweepRequest, modules: Modules, work: Work, tried: Done) -> Chunks:
    """Return chunks of the requested size, or of about a second, from the iterations of a tried case.

    Dimensions of arguments of problem() are cut into single values, because each value has its own module.
    """
    cases = work.cases
    arguments = {cases.axes[own.name] for own in work.quantities if own.kind == "argument"}
    whole = [axis not in arguments or not cases.is_grid for axis in range(len(cases.shape))]
    iterations = max(0, int(tried.rows["iterations"].item()))
    size = request.chunk or about_a_second(modules.first, work.driver, work.run, iterations, work.layout.has_rates)
    if request.is_on_device and request.chunk is None:
        size = MOST
    return blocks_of(cases.shape, size, whole)


def _tried(work: Work, team: Team) -> Done:
    """Solve the first, else the middle, else the last case with every module; return the first solved result.

    This happens before workers are forked, so that machine code is loaded once and missing code is compiled once.
    """
    tried = list[Done]()
    with team.working("Solving a first case"):
        for variant in work.variants.values():
            if variant.shapes is None:
                continue
            for index in dict.fromkeys((0, work.cases.number // 2, work.cases.number - 1)):
                tried.append(work.tried(variant, index))
                if tried[-1].tally.solved:
                    break
    return next((done for done in tried if done.tally.solved), tried[-1])


def _attributes(request: SweepRequest, modules: Modules, work: Work) -> dict[str, str | int]:
    """Return the attributes of the data set, which describe its origin."""
    own = modules.first.metadata
    packages = {**versions(), **{name: metadata.version(name) for name in ("xarray", "zarr")}}
    # The text of the problem: an object, its file, or the file of its module.
    problem = request.solve.problem if request.solve.is_built else request.solve.source
    if isinstance(problem, ProblemObject):
        text = problem.text
    else:
        path = problem.path if isinstance(problem, ProblemFile) else getattr(problem, "__file__", None) or ""
        file = Path(problem if isinstance(problem, str | Path) else path)
        text = file.read_text(encoding="utf-8", errors="replace") if file.is_file() else ""
    counts = {work.steps or variant.shapes.steps for variant in work.variants.values() if variant.shapes}
    is_one = len(counts) == 1 and not any(quantity.kind == STEPS for quantity in work.quantities)
    steps = {"steps": int(counts.pop())} if is_one else {}
    return {
        "title": own.title,
        "problem": own.problem,
        "task": str(own.task),
        "formulation": str(own.method),
        "scheme": own.scheme,
        **({"units": json.dumps(component_units(own), ensure_ascii=False)} if own.units else {}),
        "driver": work.driver,
        **steps,
        "cases": request.origin,
        "warm_starts": "on" if work.warm_starts else "off",
        "options": _options(request),
        "versions": ", ".join(f"{name} {version}" for name, version in packages.items()),
        "problem_text": text,
    }


def _options(request: SweepRequest) -> str:
    """Return the options of the solve that all cases share, as JSON."""
    values = {name: getattr(request.solve, name) for name in OPTIONS if name != "points"}
    return json.dumps({**values, "arguments": dict(request.solve.arguments)}, default=str)


def _digest(request: SweepRequest, modules: Modules, work: Work) -> str:
    """Return a digest of modules, cases, stored arrays, options and versions, but not of the number of workers."""
    cases: Cases = request.cases
    digest = hashlib.sha256()
    parts = []
    for variant in modules.variants.values():
        path = variant.path or getattr(modules.first, "__file__", None)
        parts.append(variant.message.encode() if path is None else Path(path).read_bytes())
    parts += [
        versions()["codegen"].encode(), _options(request).encode(), repr(work.warm_starts).encode(),
        repr((cases.dims, cases.shape, dict(cases.axes), tuple(work.layout.dims))).encode(),
    ]  # fmt: skip
    if modules.points is not None:
        parts.append(np.ascontiguousarray(modules.points.table).tobytes())
    for name, column in cases.columns.items():
        parts += [name.encode(), column.dtype.str.encode(), np.ascontiguousarray(column).tobytes()]
    for part in parts:
        digest.update(f"{len(part)}:".encode() + part)
    return digest.hexdigest()
