"""Many solves of one problem: a grid, a table or samples of cases, shared between processes, as one data set.

The way of a sweep: modules, layout, chunks, store, an executor that solves, and what is left at the end.
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
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from codegen.batch import store
from codegen.batch.case import Attempt
from codegen.batch.cases import Cases
from codegen.batch.executors import Progress, Team, Working, connected, silent
from codegen.batch.executors.chunks import Done, Tally, counted
from codegen.batch.jumps import Costs, along, jumps_of
from codegen.batch.layout import Chunks, Layout, about_a_second, blocks_of, layout_of
from codegen.batch.request import GUESS, OPTIONS, STEPS, SweepRequest, sweep_request
from codegen.batch.store import Frame, Memory, Store, only_sweep, require_xarray, resumable, write_netcdf
from codegen.batch.work import Modules, Rows, Work, modules_of
from codegen.errors import ArgumentError
from codegen.machine import versions
from codegen.problem.sources import ProblemFile, ProblemObject
from codegen.solving.request import Request
from codegen.solving.results.result import Run, component_units
from codegen.solving.run import require_memory
from codegen.solving.tasks import task_of

if TYPE_CHECKING:
    from xarray import Dataset


def sweep(*positional: Any, **options: Any) -> Dataset:
    """Solve a problem for many values of its parameters, and return all solutions as one xarray.Dataset.

    `problem` is as for `codegen.solve`. Cases are given in one of three ways:

    - `vary`: a dict of names and arrays (n,), all of whose combinations are cases; those in one of the groups `zipped`,
      such as `[("m", "r0")]`, vary together. The data set has a dimension for each quantity, or group;
    - `cases`: a file of comma-separated values, or a mapping of names to columns (n,): a case for each row;
    - `samples`: a dict of names and distributions, such as `normal(100, 5)`, `uniform(4.9, 5.1)` (from, to), any of
      scipy.stats by its name and arguments, or one that scipy has frozen; then `cases` is their number, 1000 unless
      said, `method` is random, latin or sobol, and the same `seed` gives the same samples.

    What varies are run-time parameters of the module, durations, prescribed values (`start.r`, `end.phi`), `steps`, and
    arguments of problem(), for each of whose values a module is built.

    - `out`: a zarr store (.zarr), written chunk by chunk, or a file of netCDF (.nc); what is there already is never
      overwritten. `resume` goes on with a store that was begun by the same sweep;
    - `keep`: which of t, q, p, u, multipliers and energy are kept of each case, unless said all, or t, q and u where
      all would take more than 250 MB of all cases, before they are compressed; with `sensitivities` also of d_t, d_q,
      d_p, d_u and d_multipliers, their derivatives;
    - `workers`: how many processes share the work, unless said as many as there are processors. Results do not depend
      on it. With `spawn` as the only way to start a process, a script needs its `if __name__ == "__main__"`;
    - `cluster`: the address of a scheduler of dask, a `distributed.Client`, or "local", for workers of a cluster;
    - `warm_starts`: whether an optimisation begins from its last solved neighbour, which takes fewer iterations where
      solutions change little, but stays with its local optimum. Otherwise it begins from the problem's own guess, and
      only where that fails from neighbours. With `sensitivities` the start follows the tangent at that neighbour, else
      the secant through the last two on a straight part of the path;
    - `sensitivities`: whether derivatives of the cost by all parameters, prescribed values and a given duration are
      kept, as `codegen.solve` finds them; those that vary follow no others;
    - `chunk`: how many cases are solved and written together, unless said about a second of work;
    - `driver`, `arguments`, `scheme`, `formulation` (the `method` of a solve), `controls`, `steps`, `every`,
      `tolerance`, `max_iterations`, `time_limit` and `scaling`: as for `codegen.solve`, the same for all cases.

    The data set has t (..., node), q and p (..., node, names), u and multipliers on nodes or intervals, padded with
    NaN where `steps` vary; cost, residual (evaluated again outside the driver), iterations and seconds of all
    attempts at a case, status and message; free parameters by their names; with sensitivities d_cost (..., by),
    likewise d_T of a free parameter T, and d_q (..., by, node, names), NaN where d_message says why there are none;
    of optimisations whose guesses do not vary `improvement`, what a case has won by a start from beyond a jump of the
    cost, and `jump`, 1 where a better neighbour is left. A case that fails is a row with these, and NaN in cost and
    arrays. All quantities are in the units of the problem file.

    Raises ArgumentError for names and options that do not exist or do not apply, ExtraError without xarray and zarr, or
    dask for a cluster, ClusterError when its scheduler does not answer, has no workers or is lost, and what
    `codegen.solve` raises for a problem that cannot be read, derived or stored.
    """
    pass

    try:
        inspect.signature(sweep_request).bind(*positional, **options)
    except TypeError as error:  # none, too many, or twice
        raise ArgumentError(f"codegen.sweep: {error}", "give a problem, what varies, and options by name") from None
    return outcome_of(sweep_request(*positional, **options)).dataset()


setattr(sweep, "__signature__", inspect.signature(sweep_request).replace(return_annotation="Dataset"))  # noqa: B010


MOST_LOOKED_THROUGH = 10_000_000
"""In a grid of so many cases jumps are looked for across chunks, which takes all costs at once."""


@dataclass(frozen=True, eq=False)
class SweepOutcome:
    """How the cases ended, the seconds that this took, what is to be said, and where the results are.

    `before` is how many cases were in the store already, whose solves are not part of the seconds; `layout` tells
    what is kept of each.
    """

    tally: Tally
    before: int
    seconds: float
    said: tuple[str, ...]
    out: Path | None
    dataset: Callable[[], Dataset]
    layout: Layout

    @property
    def record(self) -> dict[str, Any]:
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
    """Do what is asked; see `codegen.sweep`. What is wrong with the request is said before anything takes long.

    `require` is given the data set as it is before anything is solved, and may refuse it.
    """
    begin = time.perf_counter()
    require_xarray()
    with connected(request.cluster) as cluster:
        modules = modules_of(request.solve, request.cases, working)
        work, frame = _planned(request, modules)
        require(frame.outlined())
        finish = _into_store if request.is_store else _into_memory
        team = Team(request.workers, cluster, working, progress)
        tally, before, dataset = finish(request, modules, work, frame, team)
    said = (*modules.said, *team.notes)
    return SweepOutcome(tally, before, time.perf_counter() - begin, said, request.out, dataset, work.layout)


def _into_memory(
    request: SweepRequest, modules: Modules, work: Work, frame: Frame, team: Team
) -> tuple[Tally, int, Callable[[], Dataset]]:
    """All rows in memory, and then in a file, if there is to be one; none were there before."""
    memory = Memory(frame)
    work = replace(work, chunks=_chunks(request, modules, work, _tried(work, team)))

    def keep(number: int, done: Done) -> None:
        assert done.rows is not None, "without a sink rows come here"
        memory.write(work.chunks.region(number), done.rows)

    tally = team.do(work, range(work.chunks.number), work.cases.number, Tally(), keep)
    if _is_cut(work):
        tally = _marked(work, tally, memory.arrays["cost"], memory.write, team)
    found = memory.dataset()
    if request.out is not None:
        write_netcdf(found, request.out)
    return tally, 0, lambda: found


def _into_store(
    request: SweepRequest, modules: Modules, work: Work, frame: Frame, team: Team
) -> tuple[Tally, int, Callable[[], Dataset]]:
    """Chunk after chunk into a store that is laid out before, or was begun before; how many cases were there then."""
    assert request.out is not None, "a store has a place"
    digest, place = _digest(request, modules, work), Store(request.out.absolute())
    with only_sweep(request.out):
        was_begun = request.resume and request.out.exists()
        if was_begun:
            journal = store.resumed(request.out, frame, digest)
        else:
            journal = store.begun(request.out, frame, _chunks(request, modules, work, _tried(work, team)), digest)
        left = [number for number in range(journal.chunks.number) if number not in journal.finished]
        before = sum(journal.finished.values(), Tally())
        keep: Callable[[int, Done], None] = lambda number, done: journal.add(number, done.tally)  # noqa: E731
        with resumable(request.out, journal):
            if was_begun and left:
                _tried(work, team)
            work = replace(work, chunks=journal.chunks, sink=place)
            tally = team.do(work, left, work.cases.number, before, keep)
            if _is_cut(work):
                tally = _marked(work, tally, place.read("cost"), place.write, team)
        return tally, before.cases, place.dataset


def _is_cut(work: Work) -> bool:
    """Whether jumps of the cost may lie between chunks of a grid, and there is memory for looking."""
    is_looked_through = work.cases.is_grid and work.cases.number <= MOST_LOOKED_THROUGH
    return work.layout.has_jumps and work.chunks.number > 1 and is_looked_through


def _marked(
    work: Work, tally: Tally, costs: Costs, write: Callable[[tuple[slice, ...], Rows], None], team: Team
) -> Tally:
    """Mark the jumps that are left in all of the grid, where chunks have seen their own; the tally with their number.

    Those between chunks were not tried from the other side, whose solution another process had.
    """
    none, arguments = np.zeros(0), {own.name for own in work.quantities if own.kind == "argument"}
    others = {work.cases.axes[name] for name in arguments}
    places = [none if axis in others else along(work.cases.points_along(axis)) for axis in range(costs.ndim)]
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


def _planned(request: SweepRequest, modules: Modules) -> tuple[Work, Frame]:
    """What workers need but for the chunks, and what the data set is but for its numbers."""
    solve, cases, module = request.solve, request.cases, modules.first
    task = task_of(module)
    shapes = [variant.shapes for variant in modules.variants.values() if variant.shapes is not None]
    varied = any(quantity.kind == STEPS for quantity in modules.quantities)
    steps = int(np.max(cases.columns[STEPS])) if varied else solve.steps
    most = steps or max(own.steps for own in shapes)
    run = Run(
        most, solve.every, tolerance=solve.tolerance, max_iterations=solve.max_iterations, scaling=solve.scaling,
        time_limit=np.inf if solve.time_limit is None else solve.time_limit, points=modules.points,
    )  # fmt: skip
    require_memory(task.numbers(module.metadata, run), most)
    has_guesses = any(quantity.kind == GUESS for quantity in modules.quantities)
    has_jumps = task.name == "control" and not has_guesses
    layout = replace(layout_of(shapes, steps, request.keep, cases.number), has_jumps=has_jumps)
    warm = request.warm_starts and task.name == "control"
    loaded = None if all(variant.path or not variant.shapes for variant in modules.variants.values()) else module
    single = Chunks(cases.shape, (1,) * len(cases.shape))
    work = Work(
        solve.driver, run, steps, cases, modules.quantities, modules.variants, layout, single, warm, module=loaded
    )
    return work, Frame(cases, layout, _attributes(request, modules, work))


def _chunks(request: SweepRequest, modules: Modules, work: Work, tried: Attempt) -> Chunks:
    """Chunks of about a second, judged by a case; dimensions of arguments of problem() are cut into single values."""
    cases = work.cases
    arguments = {cases.axes[name] for name in modules.arguments}
    whole = [axis not in arguments or not cases.is_grid for axis in range(len(cases.shape))]
    run = replace(work.run, steps=tried.steps or work.run.steps)
    size = request.chunk or about_a_second(modules.first, work.driver, run, tried.iterations, work.layout.has_rates)
    return blocks_of(cases.shape, size, whole)


def _tried(work: Work, team: Team) -> Attempt:
    """A case of the first module that is solved, if the first, the middle or the last one is.

    One of every module is solved before workers are forked, so that machine code is read once, and missing code made.
    """
    found: list[Attempt] = []
    with team.working("Solving a first case"):
        for variant in work.variants.values():
            if variant.shapes is None:
                continue
            for index in dict.fromkeys((0, work.cases.number // 2, work.cases.number - 1)):
                found.append(work.tried(variant, index))
                if found[-1].is_solved:
                    break
    return next((attempt for attempt in found if attempt.is_solved), found[-1])


def _attributes(request: SweepRequest, modules: Modules, work: Work) -> dict[str, Any]:
    """What a data set says of where it comes from; texts and numbers."""
    own = modules.first.metadata
    known = {**versions(), **{name: metadata.version(name) for name in ("xarray", "zarr")}}
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
        "versions": ", ".join(f"{name} {version}" for name, version in known.items()),
        "problem_text": _text(request.solve),
    }


def _text(solve: Request) -> str:
    """What the problem says: its file, the file of its module, or an object as text."""
    problem = solve.problem if solve.is_built else solve.source
    if isinstance(problem, ProblemObject):
        return problem.text
    own = problem.path if isinstance(problem, ProblemFile) else getattr(problem, "__file__", None) or ""
    file = Path(problem if isinstance(problem, str | Path) else own)
    return file.read_text(encoding="utf-8", errors="replace") if file.is_file() else ""


def _options(request: SweepRequest) -> str:
    """The options of the solve that all cases share, as JSON."""
    names = {name: "method" if name == "formulation" else name for name in OPTIONS if name != "points"}
    given = {name: getattr(request.solve, field) for name, field in names.items()}
    return json.dumps(
        {name: dict(value) if name == "arguments" else value for name, value in given.items()}, default=str
    )


def _digest(request: SweepRequest, modules: Modules, work: Work) -> str:
    """What tells one sweep from another: modules, cases, what is kept, options and versions, but not who solves it."""
    cases: Cases = request.cases
    digest = hashlib.sha256()
    parts = [
        *modules.texts, versions()["codegen"].encode(), _options(request).encode(), repr(work.warm_starts).encode(),
        repr((cases.dims, cases.shape, dict(cases.axes), tuple(work.layout.dims))).encode(),
    ]  # fmt: skip
    if modules.points is not None:
        parts.append(np.ascontiguousarray(modules.points.table).tobytes())
    for name, column in cases.columns.items():
        parts += [name.encode(), column.dtype.str.encode(), np.ascontiguousarray(column).tobytes()]
    for part in parts:
        digest.update(f"{len(part)}:".encode() + part)
    return digest.hexdigest()
