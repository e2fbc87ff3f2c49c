"""Functions that are imported by name on their first call.

Other files of the package do not import modules by strings.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Any


@dataclass(frozen=True)
class Deferred:
    """A function that is imported on the first call, and is called like the function itself.

    `file` is the dotted name of its module below `codegen`. `tests/test_import_graph.py` reads these names, and lists
    all that refer to a higher layer of the package.
    """

    file: str
    name: str

    def __call__(self, *positional: Any, **named: Any) -> Any:
        """Import the module if necessary, and call the function."""
        return getattr(_imported(self.file), self.name)(*positional, **named)


@cache
def _imported(file: str) -> ModuleType:
    """Return a module below `codegen`, from a cache because the import system is slower than some of the functions."""
    return import_module(f"codegen.{file}")
