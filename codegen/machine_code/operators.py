"""Have numba find the meaning of an operator once for each kind of arguments, not anew in every line.

numba looks through all meanings of `+`, of `*`, of `a[i]` for every line, once for the type of its result and again for
its code. In the long straight-line kernels of a solver that is nearly half of the time of compilation.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def remembered_operators() -> Iterator[None]:
    """Remember the meanings of operators, and of the functions of `math`, while the block runs."""
    from numba.core import types
    from numba.core.errors import TypingError

    functions: Any = types.Function
    look_up = functions.get_call_type
    known: dict[Any, Any] = {}

    def get_call_type(self: Any, context: Any, arguments: Any, keywords: Any) -> Any:
        if keywords or getattr(self.typing_key, "__module__", None) not in ("_operator", "math"):
            return look_up(self, context, arguments, keywords)
        key = self, tuple(arguments)
        if key not in known:
            try:
                known[key] = look_up(self, context, arguments, keywords)
            except TypingError as error:
                if not all(isinstance(a, (types.Number, types.Literal, types.Omitted)) for a in arguments):
                    raise  # it may be found once numba has loaded more of itself
                known[key] = error
        found = known[key]
        if isinstance(found, TypingError):
            raise found.with_traceback(None)
        return found

    functions.get_call_type = get_call_type
    try:
        yield
    finally:
        functions.get_call_type = look_up
