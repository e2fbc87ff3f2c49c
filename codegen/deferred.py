"""Functions that are imported on their first call, by name: the only imports by strings inside the package."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Any


@dataclass(frozen=True)
class Deferred:
    """A function given by its module below `codegen` and its name, and called like the function itself.

    `tests/test_import_graph.py` reads the strings, and lists those that name a higher floor.
    """

    file: str
    name: str

    def __call__(self, *positional: Any, **named: Any) -> Any:
        """Import the module if necessary, and call the function."""
        return getattr(_imported(self.file), self.name)(*positional, **named)


@cache
def _imported(file: str) -> ModuleType:
    """Return a module below `codegen`; the import system takes longer than some of the functions."""
    return import_module(f"codegen.{file}")
