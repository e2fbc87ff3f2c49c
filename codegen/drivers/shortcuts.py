"""Have numba take shorter ways to the same machine code.

Each shortcut replaces a method of numba by one that gives the same result in less time; what operators mean, which is
looked up once, matters most. Where a numba has no such method, or one of other arguments, that shortcut is left out;
where a value is of a kind that a shortcut does not know, numba's own method is called.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from codegen.drivers.operators import remembered_operators


@contextmanager
def quick_numba() -> Iterator[None]:
    """Take all shortcuts while the block runs."""
    from numba.core import ir
    from numba.core.runtime.context import NRTContext

    with ExitStack() as stack:
        stack.enter_context(remembered_operators())
        stack.enter_context(_silent_lock())
        for owner, name, parameters, make in (
            (ir.Expr, "list_vars", ["self"], _expression_variables),
            (ir.Stmt, "list_vars", ["self"], _statement_variables),
            (ir.Loc, "__deepcopy__", None, _shared_place),
            (NRTContext, "get_meminfos", ["self", "builder", "ty", "val"], _counted_parts),
        ):
            stack.enter_context(_replaced(owner, name, parameters, make))
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
