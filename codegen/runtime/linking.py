"""Restrict numba's machine code to functions that Python, or C, calls.

numba runs LLVM's whole optimiser over every function and makes machine code of it. A function that only compiled
functions call is optimised once more in each of its callers, into which its intermediate code is linked: this takes a
third of all time. Moreover, numba compiles a function again if an argument is a constant of the module.

This is the only file that replaces anything of numba. With an unknown version of numba it does nothing. A build then
takes longer, with the same result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numba
from numba import types

Base: Any = Any if TYPE_CHECKING else object

TRIED = (0, 61), (0, 68)
"""The oldest and the newest version that was tried; those that pyproject.toml allows."""
ENTRIES = ("_ZN7cpython", "cfunc.")
"""How numba begins the names of the entries by which Python and C call a function."""
OF_LIBRARIES = (
    "_ensure_finalized", "_finalize_dynamic_globals", "_finalize_final_module", "_optimize_final_module",
    "_verify_declare_only_symbols", "get_pointer_to_function", "serialize_using_bitcode", "serialize_using_object_code",
)  # fmt: skip
OF_CODE = ("_final_module", "_shared_module")
OF_FUNCTIONS = ("get_call_template", "targetoptions", "stats")
"""What numba's class of the code of one function, that code, and a function that numba compiles must have."""


class InnerLibrary(Base):  # type: ignore[misc]
    """The code of one function; if Python cannot call it, it stays intermediate code, to be linked into its callers."""

    @property
    def is_inner(self) -> bool:
        """True if neither Python nor C can call the function."""
        # Code that is read from the disk as machine code has its intermediate code in another module.
        code = self._final_module if any(True for _ in self._final_module.functions) else self._shared_module
        return code is None or not any(f.name.startswith(ENTRIES) and not f.is_declaration for f in code.functions)

    def _optimize_final_module(self) -> None:
        if not self.is_inner:
            super()._optimize_final_module()

    def _finalize_final_module(self) -> None:
        if not self.is_inner:
            super()._finalize_final_module()
            return
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Return the address of the machine code; zero if there is none."""
        self._ensure_finalized()
        return 0 if self.is_inner else int(super().get_pointer_to_function(name))

    def serialize_using_object_code(self) -> tuple[str, str, Any]:
        """Return the data for the disk: machine code, if there is any, with the intermediate code."""
        kept = super().serialize_using_bitcode if self.is_inner else super().serialize_using_object_code
        return kept()  # type: ignore[no-any-return]


def applies(functions: Iterable[Any], version: str = numba.__version__) -> bool:
    """Return True if numba has a tested version, and everything that this file replaces, sets or reads."""
    try:
        generator = _generator()
        callables = [getattr(generator._library_class, name) for name in OF_LIBRARIES]
        callables += [generator.set_env, generator._engine.is_symbol_defined, types.unliteral, types.Literal]
        things = [(generator.create_library("probe"), OF_CODE), *((function, OF_FUNCTIONS) for function in functions)]
        probed = [hasattr(thing, name) for thing, names in things for name in names]
        is_tried = TRIED[0] <= tuple(map(int, version.split(".")[:2])) <= TRIED[1]
        return is_tried and all([*probed, *map(callable, callables)])
    except (AttributeError, ImportError, ValueError):
        return False


def link_inner_functions(functions: Iterable[Any]) -> None:
    """Make no machine code of functions of their own: they become part of the code of their callers.

    Python must not call them any more. Further calls may add functions. Nothing happens with an unknown numba.
    """
    functions = list(functions)
    if not applies(functions):
        return
    generator = _generator()
    if not issubclass(generator._library_class, InnerLibrary):
        generator._library_class = type("LinkedLibrary", (InnerLibrary, generator._library_class), {})
        generator.set_env = _where_defined(generator, generator.set_env)
    for function in functions:
        if not function.targetoptions.get("no_cfunc_wrapper"):
            function.targetoptions["no_cfunc_wrapper"] = function.targetoptions["no_cpython_wrapper"] = True
            function.get_call_template = _for_any_value(function.get_call_template)


def compile_for_any_value(functions: Iterable[Any]) -> None:
    """From now on, compile functions once where numba would compile them again for constants among their arguments."""
    functions = list(functions)
    if applies(functions):
        for function in functions:
            function.get_call_template = _for_any_value(function.get_call_template)


def _where_defined(generator: Any, set_environment: Callable[[str, Any], None]) -> Callable[[str, Any], None]:
    """Give functions their environment only if their machine code has a place for it."""
    defined = generator._engine.is_symbol_defined
    return lambda name, environment: set_environment(name, environment) if defined(name) else None


def _for_any_value(template_for: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function for the types of its arguments, even if a caller knows their values."""
    return lambda arguments, keywords: template_for(
        tuple(types.unliteral(a) if isinstance(a, types.Literal) else a for a in arguments), keywords
    )


def _generator() -> Any:
    """Return numba's generator of machine code for this processor."""
    from numba.core.registry import cpu_target

    return cpu_target.target_context.codegen()
