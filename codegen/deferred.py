"""Functions that are imported when they are called first, by name: the only imports by strings inside the package."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Any


@dataclass(frozen=True)
class Deferred:
    """A function by its file below `codegen` and its name there, called as if it were the function.

    `tests/test_import_graph.py` reads the strings, and lists those that name a higher floor.
    """

    file: str
    name: str

    def __call__(self, *positional: Any, **named: Any) -> Any:
        """Import the file if necessary, and call the function."""
        return getattr(_imported(self.file), self.name)(*positional, **named)


@cache
def _imported(file: str) -> ModuleType:
    """Return a module below `codegen`. The import system takes longer than some of the functions."""
    return import_module(f"codegen.{file}")
