"""The restriction of numba's machine code to functions that Python or C calls.

numba runs LLVM's optimiser over every function and makes machine code of the function. A function that only compiled
functions call is optimised again in each caller, into which numba links its intermediate code. This takes a third of
the compile time. Moreover, numba compiles a function again for each argument that is a constant of the module.

This is the only file that replaces anything in numba. With an unknown version of numba it changes nothing. A build then
takes longer, with the same result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numba
from numba import types

Base: Any = Any if TYPE_CHECKING else object

TRIED = (0, 61), (0, 68)
"""The oldest and the newest tested version of numba, which are also the limits in pyproject.toml."""
ENTRIES = ("_ZN7cpython", "cfunc.")
"""The beginnings of the names that numba gives to the entry points for Python and C."""
OF_LIBRARIES = (
    "_ensure_finalized", "_finalize_dynamic_globals", "_finalize_final_module", "_optimize_final_module",
    "_verify_declare_only_symbols", "get_pointer_to_function", "serialize_using_bitcode", "serialize_using_object_code",
)  # fmt: skip
OF_CODE = ("_final_module", "_shared_module")
OF_FUNCTIONS = ("get_call_template", "targetoptions", "stats")
"""The attributes of numba that this file needs: of the class for the code of one function (OF_LIBRARIES), of an object
of this class (OF_CODE), and of a function that numba compiles (OF_FUNCTIONS)."""


class InnerLibrary(Base):  # type: ignore[misc]
    """The code of one function, which stays intermediate code if neither Python nor C can call the function."""

    @property
    def is_inner(self) -> bool:
        """True if neither Python nor C can call the function."""
        # If numba has read machine code from the disk, the intermediate code is in another module.
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
        """Return the address of the machine code, or zero if the function has no machine code."""
        self._ensure_finalized()
        return 0 if self.is_inner else int(super().get_pointer_to_function(name))

    def serialize_using_object_code(self) -> tuple[str, str, object]:
        """Return the data for the disk: intermediate code, and machine code if the function has machine code."""
        kept = super().serialize_using_bitcode if self.is_inner else super().serialize_using_object_code
        return kept()  # type: ignore[no-any-return]


def applies(functions: Iterable[Any], version: str = numba.__version__) -> bool:
    """Return True if numba has a tested version and all attributes that this file replaces, sets or reads."""
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
    """From now on, make no separate machine code of `functions`: they become part of the code of their callers.

    Python must not call these functions any more. Further calls may add functions. With an unknown version of numba
    nothing happens.
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
    """From now on, compile each of `functions` once for all values of an argument, also for constants.

    numba would compile a function again for each argument that is a constant.
    """
    functions = list(functions)
    if applies(functions):
        for function in functions:
            function.get_call_template = _for_any_value(function.get_call_template)


def _where_defined(generator: Any, set_environment: Callable[[str, object], None]) -> Callable[[str, object], None]:
    """Return `set_environment`, restricted to functions whose machine code has a place for an environment."""
    defined = generator._engine.is_symbol_defined
    return lambda name, environment: set_environment(name, environment) if defined(name) else None


def _for_any_value(template_for: Callable[..., object]) -> Callable[..., object]:
    """Return `template_for`, changed to compile for the types of arguments even if a caller knows their values."""
    return lambda arguments, keywords: template_for(
        tuple(types.unliteral(a) if isinstance(a, types.Literal) else a for a in arguments), keywords
    )


def _generator() -> Any:
    """Return numba's generator of machine code for the processor."""
    from numba.core.registry import cpu_target

    return cpu_target.target_context.codegen()
