"""Have numba optimise what is called from outside only, and compile no function twice: for processes that compile.

numba runs LLVM's whole optimiser over every function and makes machine code of it, although a function that only
compiled functions call is then optimised once more as part of each of its callers, into which its intermediate code is
linked. A solver is made of many short functions, so that this takes a quarter of all time. And numba compiles a
function anew when an argument is a constant of the module and not a variable, which makes no difference to the code.

What is here belongs to a process that compiles a module for the disk and runs it no further: functions that are called
from compiled functions only have no machine code in it. Nothing of this changes what a solver computes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from numba.core import config, types
from numba.core.codegen import JITCodeLibrary
from numba.core.registry import cpu_target

ENTRY = "_ZN7cpython"
"""How numba begins the name of the entry by which Python calls a function."""


class LinkedLibrary(JITCodeLibrary):
    """The code of one function; if Python cannot call it, it stays intermediate code, to be linked into its callers."""

    optimised: frozenset[str] = frozenset()
    """Names of functions so long that it pays to shorten them once, before their callers take them in."""
    unpacked: frozenset[str] = frozenset()
    """Names of functions that are called so seldom that looking for operations to pack does not pay."""

    @property
    def is_inner(self) -> bool:
        """Whether Python cannot call the function."""
        # Of what is read from the disk as machine code, the intermediate code is beside it.
        code = self._final_module if any(True for _ in self._final_module.functions) else self._shared_module
        return code is None or not any(f.name.startswith(ENTRY) and not f.is_declaration for f in code.functions)

    def _optimize_final_module(self) -> None:
        if self.is_inner and self.name not in self.optimised:
            return
        settings: Any = config
        before = settings.SLP_VECTORIZE
        settings.SLP_VECTORIZE = before and self.name not in self.unpacked
        try:
            super()._optimize_final_module()
        finally:
            settings.SLP_VECTORIZE = before

    def _finalize_final_module(self) -> None:
        if not self.is_inner:
            super()._finalize_final_module()
            return
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Address of the machine code; zero where there is none."""
        self._ensure_finalized()
        return 0 if self.is_inner else int(super().get_pointer_to_function(name))

    def serialize_using_object_code(self) -> tuple[str, str, Any]:
        """What goes to the disk: beside machine code, if there is any, the intermediate code."""
        if self.is_inner:
            return self.serialize_using_bitcode()  # type: ignore[no-any-return]
        return super().serialize_using_object_code()  # type: ignore[no-any-return]


def link_inner_functions() -> Callable[[], None]:
    """From now on, let this process make machine code of those functions only that Python can call; what undoes that.

    numba must have compiled something before, so that its own run-time library is there.
    """
    generator = cpu_target.target_context.codegen()
    before, set_environment = generator._library_class, generator.set_env

    def set_environment_if_any(name: str, environment: Any) -> None:
        if generator._engine.is_symbol_defined(name):
            set_environment(name, environment)

    def undo() -> None:
        generator._library_class, generator.set_env = before, set_environment

    generator._library_class, generator.set_env = LinkedLibrary, set_environment_if_any
    return undo


def optimise_by_themselves(long: Iterable[str]) -> None:
    """Optimise functions of these names even if Python cannot call them."""
    LinkedLibrary.optimised = frozenset(long)


def leave_unpacked(seldom: Iterable[str]) -> None:
    """Have functions of these names optimised without looking for operations to pack."""
    LinkedLibrary.unpacked = frozenset(seldom)


def forget_constants(function: Any) -> None:
    """Compile a function for the types of its arguments, whether or not a caller knows their values."""
    template_for = function.get_call_template

    def template(arguments: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
        plain = tuple(types.unliteral(a) if isinstance(a, types.IntegerLiteral) else a for a in arguments)
        return template_for(plain, keywords)

    function.get_call_template = template
