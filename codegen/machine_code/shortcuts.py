"""Have numba take shorter ways to the same machine code.

Each shortcut replaces a method of numba by one that gives the same result in less time; what operators mean, which is
looked up once, matters most. Where a numba has no such method, or one of other arguments, that shortcut is left out;
where a value is of a kind that a shortcut does not know, numba's own method is called.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FunctionType
from typing import Any

from codegen.machine_code.entries import short_entries
from codegen.machine_code.operators import remembered_operators


@contextmanager
def quick_numba() -> Iterator[None]:
    """Take all shortcuts while the block runs."""
    from numba.core import base, ir
    from numba.core.codegen import CPUCodegen
    from numba.core.lowering import Lower
    from numba.core.postproc import PostProcessor
    from numba.core.runtime.context import NRTContext
    from numba.core.targetconfig import TargetConfig

    with ExitStack() as stack:
        stack.enter_context(remembered_operators())
        stack.enter_context(_silent_lock())
        for owner, name, parameters, make in (
            (ir.Expr, "list_vars", ["self"], _expression_variables),
            (ir.Stmt, "list_vars", ["self"], _statement_variables),
            (ir.Loc, "__deepcopy__", None, _shared_place),
            (NRTContext, "get_meminfos", ["self", "builder", "ty", "val"], _counted_parts),
            (PostProcessor, "run", ["self", "emit_dels", "extend_lifetimes"], _lives_when_asked_for),
            (TargetConfig, "values", ["self"], _options),
            (Lower, "create_cfunc_wrapper", ["self"], _no_entry_beside_none),
            (CPUCodegen, "_check_llvm_bugs", ["self"], _once),
            (base.BaseContext, "refresh", ["self"], _only_if_there_is_more),
            (base, "_has_loc", ["fn"], _by_code),
            (base.BaseContext, "get_function", ["self", "fn", "sig", "_firstcall"], short_entries),
        ):
            stack.enter_context(_replaced(owner, name, parameters, make))
        yield


@contextmanager
def blas_presumed() -> Iterator[None]:
    """Let numba believe that scipy has BLAS, which it asks once and for which it imports all of scipy.linalg.

    scipy is there, and what multiplies matrices looks for BLAS again.
    """
    from numba.np import linalg

    with _replaced(linalg, "ensure_blas", [], lambda own: lambda: None):
        yield


@contextmanager
def _replaced(
    owner: Any, name: str, parameters: list[str] | None, make: Callable[[Any], Callable[..., Any]]
) -> Iterator[None]:
    """Put what is made of a class's own method in its place, if its parameters are these (None: there is no method)."""
    own = vars(owner).get(name)
    found = None if own is None else list(inspect.signature(own).parameters)
    if found != parameters:
        yield
        return
    setattr(owner, name, make(own))
    try:
        yield
    finally:
        if own is None:
            delattr(owner, name)
        else:
            setattr(owner, name, own)


def _expression_variables(own: Any) -> Callable[..., Any]:
    """The variables of an expression; numba looks for them in whatever it holds, a dozen times for each."""
    from numba.core import ir

    plain = {type(None), str, int, bool, float, type(len), type(inspect.signature), ir.Loc}

    def list_vars(self: Any) -> Any:
        found: list[Any] = []
        for value in self._kws.values():
            kind = type(value)
            if kind is ir.Var:
                found.append(value)
            elif kind not in plain:
                found += self._rec_list_vars(value)
        return found

    return list_vars


def _statement_variables(own: Any) -> Callable[..., Any]:
    """The variables of a statement."""
    from numba.core import ir

    plain = {type(None), str, int, bool, ir.Loc, ir.Const, ir.Global}

    def list_vars(self: Any) -> Any:
        found: list[Any] = []
        for value in self.__dict__.values():
            kind = type(value)
            if kind is ir.Var:
                found.append(value)
            elif kind is ir.Expr:
                found += value.list_vars()
            elif kind not in plain:
                found += self._rec_list_vars(value)
        return found

    return list_vars


def _shared_place(own: Any) -> Callable[..., Any]:
    """A place in a file is never changed; numba would copy all lines of the file with it."""

    def same(self: Any, memo: Any) -> Any:
        return self

    return same


def _counted_parts(own: Any) -> Callable[..., Any]:
    """The parts of a value whose references are counted; numba takes all others out of it as well, and drops them."""
    counted: dict[Any, bool] = {}

    def has_any(model: Any, models: Any, builder: Any) -> bool:
        kind = model._fe_type
        if kind not in counted:
            parts = [models[part] for part, _ in model.traverse(builder)]
            counted[kind] = model.has_nrt_meminfo() or any(has_any(part, models, builder) for part in parts)
        return counted[kind]

    def get_meminfos(self: Any, builder: Any, ty: Any, val: Any) -> Any:
        models = self._context.data_model_manager
        model = models[ty]
        if not has_any(model, models, builder):
            return []
        found = [(ty, model.get_nrt_meminfo(builder, val))] if model.has_nrt_meminfo() else []
        for kind, part in model.traverse(builder):
            if has_any(models[kind], models, builder):
                found += self.get_meminfos(builder, kind, part(val))
        return found

    return get_meminfos


def _lives_when_asked_for(own: Callable[..., Any]) -> Callable[..., Any]:
    """Find out where variables live when it is asked for, mostly once; numba does after each of nine passes."""
    from numba.core.postproc import VariableLifetime
    from numba.core.transforms import canonicalize_cfg

    def run(self: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
        code = self.func_ir
        if code.is_generator:
            own(self, emit_dels, extend_lifetimes)
            return
        code.blocks = canonicalize_cfg(code.blocks)  # type: ignore[no-untyped-call]
        code.variable_lifetime = VariableLifetime(code.blocks)  # type: ignore[no-untyped-call]
        code.generator_info = None
        if emit_dels:
            self._insert_var_dels(extend_lifetimes=extend_lifetimes)

    return run


def _options(own: Callable[..., Any]) -> Callable[..., Any]:
    """The values of all options; numba asks for one after the other."""
    defaults: dict[type, dict[str, Any]] = {}

    def values(self: Any) -> dict[str, Any]:
        kind = type(self)
        if kind not in defaults:
            defaults[kind] = {name: option.default for name, option in self.options.items()}
        return {**defaults[kind], **self._values}

    return values


def _no_entry_beside_none(own: Callable[..., Any]) -> Callable[..., Any]:
    """No entry by which C calls a function that has none for Python: only compiled functions call that."""

    def create_cfunc_wrapper(self: Any) -> None:
        if not self.flags.no_cpython_wrapper:
            own(self)

    return create_cfunc_wrapper


def _once(own: Callable[..., Any]) -> Callable[..., Any]:
    """A check whose result changes with the settings of the country only."""
    done = False

    def check(self: Any) -> None:
        nonlocal done
        if not done:
            own(self)
            done = True

    return check


def _only_if_there_is_more(own: Callable[..., Any]) -> Callable[..., Any]:
    """Look for new definitions only after modules have been loaded or definitions been added."""
    from numba.core import imputils
    from numba.core.typing import templates

    lists = [
        *(getattr(imputils.builtin_registry, n) for n in ("functions", "getattrs", "setattrs", "casts", "constants")),
        *(getattr(templates.builtin_registry, n) for n in ("functions", "attributes", "globals")),
    ]
    known: dict[int, tuple[int, ...]] = {}

    def refresh(self: Any) -> None:
        size = (len(sys.modules), *map(len, lists))
        if known.get(id(self)) != size:
            own(self)
            known[id(self)] = (len(sys.modules), *map(len, lists))

    return refresh


def _by_code(own: Callable[..., Any]) -> Callable[..., Any]:
    """Whether a function takes a place in the source; numba reads its signature anew at each call in each line."""
    known: dict[Any, bool] = {}

    def has_loc(fn: Any) -> bool:
        if type(fn) is not FunctionType or hasattr(fn, "__wrapped__"):
            return bool(own(fn))
        if fn.__code__ not in known:
            known[fn.__code__] = own(fn)
        return known[fn.__code__]

    return has_loc


@contextmanager
def _silent_lock() -> Iterator[None]:
    """Tell nobody of each call of LLVM; numba would, twice, to measure times that nobody asks for."""
    from llvmlite.binding import ffi  # type: ignore[import-untyped]

    listeners = getattr(getattr(ffi.lib, "_lock", None), "_cblist", [])
    told, listeners[:] = listeners[:], []
    try:
        yield
    finally:
        listeners[:] = told
