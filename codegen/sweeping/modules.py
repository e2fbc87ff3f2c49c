"""The modules of a sweep: one for each combination of arguments of problem() that vary, derived and compiled once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from codegen import compiler, loading
from codegen.author.problem_file import argument_names
from codegen.errors import ArgumentError, CodegenError
from codegen.machine_code import ahead_of_time
from codegen.solving.request import Request
from codegen.sweeping.case import Variant
from codegen.sweeping.cases import Cases
from codegen.sweeping.layout import shapes_of
from codegen.sweeping.quantities import as_argument
from codegen.tasks import task_of

MOST = 100
"""The most modules of a sweep: each takes seconds to derive and compile."""


@dataclass(frozen=True, eq=False)
class Modules:
    """The modules by the texts of the arguments that vary, in their order; the first of them that could be derived."""

    arguments: tuple[str, ...]
    variants: dict[tuple[str, ...], Variant]
    first: Any
    said: tuple[str, ...]

    @property
    def texts(self) -> Iterator[bytes]:
        """What stands in their files."""
        for variant in self.variants.values():
            path = variant.path or getattr(self.first, "__file__", None)
            yield variant.message.encode() if path is None else Path(path).read_bytes()


def modules_of(request: Request, cases: Cases, working: Callable[[str], AbstractContextManager[Any]]) -> Modules:
    """Derive and compile what the cases need.

    A combination that cannot be derived is a variant without a module, unless none can; a value that an argument does
    not take is an ArgumentError.
    """
    if request.is_built:
        return _built(request)
    assert isinstance(request.problem, str | Path), "what is not built is a file"
    known = argument_names(request.problem)
    names = tuple(name for name in cases.columns if name in known)
    twice = next((name for name in names if name in request.arguments), None)
    if twice:
        raise ArgumentError(f"{twice} varies and is given by --set", "leave one of them out")
    combinations = _combinations(names, cases)
    variants, said, errors = dict[tuple[str, ...], Variant](), list[str](), list[CodegenError]()
    first: Any = None
    for number, key in enumerate(combinations, start=1):
        count = f" (module {number} of {len(combinations)})" if len(combinations) > 1 else ""
        try:
            with _own_words():
                module, path, told = _made(request, dict(zip(names, key, strict=True)), working, count)
        except ArgumentError:
            raise
        except CodegenError as error:
            errors.append(error)
            variants[key] = Variant(None, None, str(error))
            continue
        said += told
        first = module if first is None else first
        _require_sweepable(module)
        variants[key] = Variant(path, shapes_of(module, request.every))
    if first is None:
        raise errors[0]
    return Modules(names, variants, first, tuple(said))


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


def _made(
    request: Request, arguments: dict[str, str], working: Callable[[str], AbstractContextManager[Any]], count: str
) -> tuple[Any, Path, list[str]]:
    """A module that is derived and compiled, its file, and what there is to say."""
    assert isinstance(request.problem, str | Path), "what is not built is a file"
    with working(f"Deriving{count}"):
        made = compiler.build(
            request.problem, {**request.arguments, **arguments}, scheme=request.scheme, method=request.method,
            controls=request.controls,
        )  # fmt: skip
    module = loading.load(made.path)
    _require_sweepable(module)
    said: list[str] = []
    if request.driver_for(module).name == "newton":
        _, said = ahead_of_time.require(made.path, module, made.written, working)
    return module, made.path, said


def _built(request: Request) -> Modules:
    """The one module that there is already."""
    module: Any = request.problem
    if isinstance(request.problem, str | Path):
        module = loading.load(request.problem)
    _require_sweepable(module)
    request.driver_for(module)
    file = getattr(module, "__file__", None)
    return Modules((), {(): Variant(Path(file) if file else None, shapes_of(module, request.every))}, module, ())


def _require_sweepable(module: Any) -> None:
    if task_of(module).outline is None:
        remedy = "sweep a simulation or an optimisation; codegen warp registers many pairs of images"
        raise ArgumentError(f"particles that are connected cannot be swept ({module.metadata['problem']})", remedy)


@contextmanager
def _own_words() -> Iterator[None]:
    """Errors that name the options of a sweep, where `--method` is that of samples."""
    try:
        yield
    except CodegenError as error:
        parts = (text.replace("--method", "--formulation") for text in (error.finding, error.remedy))
        raise type(error)(*parts) from error
