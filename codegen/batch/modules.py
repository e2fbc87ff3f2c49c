"""The modules of a sweep: one for each combination of arguments of problem() that vary, derived and compiled once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from codegen.batch.case import Variant
from codegen.batch.cases import Cases
from codegen.batch.executors.team import Working
from codegen.batch.layout import Shapes, shapes_of
from codegen.batch.quantities import STEPS, Quantity, as_argument, quantities, require_fitting
from codegen.errors import ArgumentError, CodegenError
from codegen.solving import compiler, loading
from codegen.solving.drivers import DRIVERS
from codegen.solving.machine_code import processes
from codegen.solving.outcome import points_of
from codegen.solving.request import Request, require_apart_from_arrays, require_apart_from_delays
from codegen.solving.results.sensitivities import require_sensitive

if TYPE_CHECKING:
    from codegen.problem.points import PointSet

MOST = 100
"""The most modules of a sweep: each takes seconds to derive and compile."""


@dataclass(frozen=True, eq=False)
class Modules:
    """The modules by the texts of the arguments that vary, what varies beside, and lines to be said.

    `first` is the first module that could be derived; `points` are those to be connected, if any are.
    """

    arguments: tuple[str, ...]
    quantities: tuple[Quantity, ...]
    variants: dict[tuple[str, ...], Variant]
    first: Any
    said: tuple[str, ...]
    points: PointSet | None = None

    @property
    def texts(self) -> Iterator[bytes]:
        """What stands in their files."""
        for variant in self.variants.values():
            path = variant.path or getattr(self.first, "__file__", None)
            yield variant.message.encode() if path is None else Path(path).read_bytes()


def modules_of(request: Request, cases: Cases, working: Working) -> Modules:
    """Derive and compile what the cases need; nothing is compiled before all names and values are known to fit.

    A combination that cannot be derived is a variant without a module, unless none can. Raises ArgumentError for a
    value that an argument does not take, and for names that mean nothing.
    """
    if request.is_built:
        return _built(request, cases)
    known = request.source.arguments
    names = tuple(name for name in cases.columns if name in known)
    if twice := next((name for name in names if name in request.arguments), None):
        raise ArgumentError(f"{twice} varies and is given by --set", "leave one of them out")
    combinations = _combinations(names, cases)
    derived, errors = dict[tuple[str, ...], tuple[Any, compiler.Build]](), dict[tuple[str, ...], CodegenError]()
    varied: tuple[Quantity, ...] = ()
    for number, key in enumerate(combinations, start=1):
        count = f" (module {number} of {len(combinations)})" if len(combinations) > 1 else ""
        try:
            with _own_words(), working(f"Deriving{count}"):
                module, made = _derived(request, dict(zip(names, key, strict=True)))
        except ArgumentError:
            raise
        except CodegenError as error:
            errors[key] = error
            continue
        varied = _fitting(request, cases, module, names)
        derived[key] = module, made
    if not derived:
        raise next(iter(errors.values()))
    points, said = _points(request, [module for module, _ in derived.values()]), list[str]()
    for module, made in derived.values():
        if DRIVERS[request.driver].generated:
            said += processes.require(made.path, module, made.written, working)[1]
    variants = {
        key: Variant(derived[key][1].path, _shapes(request, derived[key][0], points))
        if key in derived
        else Variant(None, None, str(errors[key]))
        for key in combinations
    }
    return Modules(names, varied, variants, next(iter(derived.values()))[0], tuple(said), points)


def _points(request: Request, modules: Sequence[Any]) -> PointSet | None:
    """The points that all cases connect; ArgumentError where an argument of problem() decides on them."""
    first, *others = (points_of(request, module) for module in modules)
    for other in others:
        if first is not None and other is not None and not np.array_equal(first.table, other.table):
            raise ArgumentError("the points differ among values of an argument", "sweep over each value by itself")
    return first


def _shapes(request: Request, module: Any, points: PointSet | None) -> Shapes:
    return shapes_of(module, request.every, request.sensitivities, 0 if points is None else len(points.start))


def _derived(request: Request, arguments: dict[str, str]) -> tuple[Any, compiler.Build]:
    """A module, loaded, and where it is."""
    made = compiler.build(
        request.source, {**request.arguments, **arguments}, scheme=request.scheme, method=request.method,
        controls=request.controls, sensitivities=request.sensitivities,
    )  # fmt: skip
    return loading.load(made.path), made


def _fitting(request: Request, cases: Cases, module: Any, arguments: Sequence[str]) -> tuple[Quantity, ...]:
    """What varies, if a module can be swept, takes all options, and names and values mean something to it."""
    request.driver_for(module)
    if request.sensitivities:
        require_sensitive(module)
    others = [name for name in cases.columns if name not in arguments]
    require_apart_from_delays(module, others)
    require_apart_from_arrays(module, others)
    varied = quantities(cases.columns, module, arguments)
    require_fitting(varied, cases)
    if request.steps is not None and any(quantity.kind == STEPS for quantity in varied):
        raise ArgumentError("steps vary and are given by --steps", "leave one of them out")
    return varied


def _built(request: Request, cases: Cases) -> Modules:
    """The one module that there is already."""
    module: Any = request.problem
    if isinstance(request.problem, str | Path):
        module = loading.load(request.problem)
    varied = _fitting(request, cases, module, ())
    file = getattr(module, "__file__", None)
    points = _points(request, [module])
    variant = Variant(Path(file) if file else None, _shapes(request, module, points))
    return Modules((), varied, {(): variant}, module, (), points)


def _combinations(names: Sequence[str], cases: Cases) -> list[tuple[str, ...]]:
    """The texts of arguments that occur together."""
    axes = sorted({cases.axes[name] for name in names})
    own = [[name for name in names if cases.axes[name] == axis] for axis in axes]
    texts = {name: [as_argument(value) for value in cases.columns[name].tolist()] for name in names}
    along = [dict.fromkeys(zip(*(texts[name] for name in group), strict=True)) for group in own]
    order = [name for group in own for name in group]
    number = 1
    for rows in along:
        number *= len(rows)
    if number > MOST:
        finding = f"{' and '.join(names)} of problem() would need {number} modules, one for each value"
        raise ArgumentError(finding, f"take at most {MOST} values, or vary parameters of the module")
    found = []
    for parts in product(*along):
        values = dict(zip(order, (text for part in parts for text in part), strict=True))
        found.append(tuple(values[name] for name in names))
    return found


@contextmanager
def _own_words() -> Iterator[None]:
    """Errors that name the options of a sweep, where `--method` is that of samples."""
    try:
        yield
    except CodegenError as error:
        parts = (text.replace("--method", "--formulation") for text in (error.finding, error.remedy))
        raise type(error)(*parts) from error
