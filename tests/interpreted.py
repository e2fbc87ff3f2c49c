"""Generated modules run by the Python interpreter, uncompiled: what tests on many variants and few intervals need.

Only the elimination of dense rows, which is the same text in all of them, is machine code (`machine_coded.py`).
"""

import math
import types
from pathlib import Path

import numpy as np
from machine_coded import for_module

from codegen.author.problem import Control, Phases
from codegen.compiler import build, generate_from_model
from codegen.lower.module import Origin
from codegen.model import normalise
from codegen.naming import Choices


def without_compilation(text: str, name: str = "interpreted") -> types.ModuleType:
    """Execute the text of a generated module with numba's decorator replaced by one that does nothing."""
    assert text.count("\nfrom numba import ") == 1
    module = types.ModuleType(name)
    inner = text.replace("\nfrom numba import ", "\nfrom interpreted import ")
    exec(compile(inner, f"<{name}>", "exec"), module.__dict__)
    module.__dict__.update(for_module(text))
    return module


def as_machine_code(text: str, name: str = "interpreted") -> types.ModuleType:
    """The same with functions that return NaN and infinity, as in machine code, where Python's raise errors."""
    assert text.count("import math\n") == 1
    return without_compilation(text.replace("import math\n", "from interpreted import silent_math as math\n"), name)


def _silent(name):
    """A function of floats that never raises: that of `math`, and where it would, that of numpy, which takes longer."""
    ordinary, function = getattr(math, name), getattr(np, name)

    def called(*arguments):
        try:
            return np.float64(ordinary(*arguments))
        except (ValueError, OverflowError):
            with np.errstate(all="ignore"):
                return np.float64(function(*map(np.float64, arguments)))

    return called


silent_math = types.SimpleNamespace(
    **{name: value for name, value in vars(math).items() if not name.startswith("_")}
    | {name: _silent(name) for name in "sin cos tan sinh cosh tanh exp log log1p expm1 sqrt".split()}
)
"""The functions of `math` that kernels call most, without errors."""


prange = range  # of numba, which has threads share it
config = types.SimpleNamespace()  # of numba, for what is compiled


def njit(*_args, **_options):
    """A decorator that leaves a function as it is."""
    return lambda function: function


def text_of(problem: Control | Phases, **choices: str) -> str:
    """The text of the module of a problem that is in no file."""
    origin = Origin("test.py", "codegen build test.py", "0", ("codegen",))
    return generate_from_model(normalise(problem), Choices(**choices), origin)


def of_problem(problem: Control | Phases, **choices: str) -> types.ModuleType:
    """The module of a problem that is in no file."""
    return without_compilation(text_of(problem, **choices))


class Interpreted:
    """Makes uncompiled modules of problems in files or texts, each only once."""

    def __init__(self, folder: Path, problems: Path) -> None:
        self.folder, self.problems, self.made = folder, problems, {}

    def __call__(
        self, name: str, text: str | None = None, arguments: dict[str, str] | None = None, **choices: str | None
    ) -> types.ModuleType:
        key = (name, text, *sorted((arguments or {}).items()), *sorted(choices.items()))
        if key not in self.made:
            path = self.problems / f"{name}.py"
            if text is not None:
                path = self.folder / f"{name}.py"
                path.write_text(text)
            found = build(path, arguments or {}, **choices).path  # derived once for all worker processes
            self.made[key] = without_compilation(found.read_text(encoding="utf-8"), name)
        return self.made[key]
