"""What is asked of a sweep, and what is refused about it whatever the problem is."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codegen.batch import cases as reading
from codegen.batch.cases import NUMBER, Cases, require_method, samples
from codegen.batch.executors.team import team_size
from codegen.batch.executors.work import counted
from codegen.errors import ArgumentError, NumericsError, clause
from codegen.solving.request import Request
from codegen.solving.results.output import require_folder

if TYPE_CHECKING:
    from codegen.solving.loading import GeneratedModule

STORES, FILES = (".zarr",), (".nc",)
OPTIONS = (
    "driver", "arguments", "scheme", "formulation", "controls", "steps", "every", "tolerance", "max_iterations",
    "time_limit", "scaling", "sensitivities", "points",
)  # fmt: skip
"""Options of a solve that all cases share."""


@dataclass(frozen=True, eq=False)
class SweepRequest:
    """The solve that all cases share, the cases and where they come from, and what becomes of the results.

    `keep` are names of arrays, all that fit where it is None; `chunk` is the number of cases of a chunk, about a second
    of work where it is None; `cluster` is the address of a
    scheduler of dask, a client of one, "local", or None.
    """

    solve: Request
    cases: Cases
    origin: str
    out: Path | None
    resume: bool
    keep: Sequence[str] | None
    workers: int
    warm_starts: bool
    chunk: int | None
    cluster: Any

    @property
    def is_store(self) -> bool:
        """Whether results go to a zarr store as they come."""
        return self.out is not None and self.out.suffix in STORES


def sweep_request(
    problem: Path | str | GeneratedModule,
    vary: Mapping[str, Any] | None = None,
    *,
    zipped: Sequence[Sequence[str]] = (),
    samples: Mapping[str, Any] | None = None,
    cases: Any = None,
    method: str = "random",
    seed: int = 0,
    out: Path | str | None = None,
    resume: bool = False,
    keep: Sequence[str] | None = None,
    workers: int | None = None,
    warm_starts: bool = False,
    chunk: int | None = None,
    cluster: Any = None,
    **options: Any,
) -> SweepRequest:
    """The request that these arguments make; see `codegen.sweep`, whose arguments they are.

    Raises ArgumentError for what does not exist or does not fit together, and NumericsError for unusable numbers.
    """
    _require_known(options)
    if "formulation" in options:
        options["method"] = options.pop("formulation")
    if not isinstance(out, str | PathLike | None):
        raise ArgumentError(f"--out {clause(repr(out))} is no path", 'give one, such as "sweep.zarr"')
    place = None if out is None else Path(out)
    if place is not None:
        _require_place(place, resume)
    elif resume:
        raise ArgumentError("--resume without --out", "name the store to go on with")
    solve = Request(problem, **options)
    made, origin = _cases(vary, zipped, samples, cases, method, seed)
    if keep is not None and (isinstance(keep, str) or not all(isinstance(name, str) for name in keep)):
        raise ArgumentError(f"--keep {clause(repr(keep))}", 'give names of arrays, such as ("q", "u")')
    if chunk is not None and (isinstance(chunk, bool) or not isinstance(chunk, int) or chunk < 1):
        raise NumericsError(f"--chunk {clause(repr(chunk))}", "give a positive integer")
    used = team_size(workers, cluster)
    kept = None if keep is None else tuple(dict.fromkeys(keep))
    return SweepRequest(solve, made, origin, place, resume, kept, used, warm_starts, chunk, cluster)


def _require_known(options: Iterable[str]) -> None:
    for name in options:
        if name not in OPTIONS:
            close = difflib.get_close_matches(name, OPTIONS, 1)
            remedy = f"did you mean {close[0]}?" if close else f"use some of {', '.join(OPTIONS)}"
            raise ArgumentError(f"codegen.sweep has no option {clause(name)}", remedy)


def _require_place(out: Path, resume: bool) -> None:
    """Refuse a place that cannot be written to, or that something is at already."""
    if out.suffix not in STORES + FILES:
        raise ArgumentError(f"--out {out}: unknown kind of file", "let it end in .zarr or .nc")
    require_folder(out.absolute().parent, "--out")
    if resume and out.suffix in FILES:
        raise ArgumentError(f"--resume: {out} is written at the end, as a whole", "let --out end in .zarr")
    if out.exists() and not resume:
        remedy = "choose another name" if out.suffix in FILES else "choose another name, or --resume to go on with it"
        raise ArgumentError(f"--out {out} is there already", remedy)


def _cases(
    vary: Mapping[str, Any] | None,
    zipped: Sequence[Sequence[str]],
    distributions: Mapping[str, Any] | None,
    given: Any,
    method: str,
    seed: int,
) -> tuple[Cases, str]:
    """The cases, and in a few words where they come from."""
    require_method(method)
    is_number = isinstance(given, int) and not isinstance(given, bool)
    if zipped and not vary:
        raise ArgumentError("--zip without --vary", "name what varies together by --vary")
    if sum(map(bool, (vary, distributions, given is not None and not is_number))) > 1:
        raise ArgumentError("cases are given in several ways", "give --vary, or --sample, or --cases FILE")
    if is_number and not distributions:
        raise ArgumentError(f"{given} cases of what?", "give distributions, as --sample 'm=normal(100, 5)'")
    if vary:
        return reading.grid(_named(vary, "vary"), zipped), "grid"
    if distributions:
        number = NUMBER if given is None else given
        made = samples(_named(distributions, "samples"), number, method, seed)
        return made, f"{counted(number, f'{method} sample')}, seed {seed}"
    if given is None:
        raise ArgumentError("nothing varies", "give --vary, --sample or --cases, as --vary r1=5.5:6.5:101")
    return reading.table(given), "table"


def _named(given: Any, name: str) -> Mapping[str, Any]:
    if not isinstance(given, Mapping) or not all(isinstance(key, str) for key in given):
        raise ArgumentError(f"{name} is {clause(repr(given))}", 'give names and values, such as {"r1": [5.5, 6, 6.5]}')
    return given
