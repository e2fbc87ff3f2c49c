"""Generated modules whose kernels and loops run by the Python interpreter: for tests on many variants, few intervals.

What is common to all of them is machine code, compiled once: the search, and the linear system of any shape.
"""

import math
import types
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from numba import carray  # noqa: F401  what modules import

from codegen.problem.problem import Control, Phases
from codegen.runtime import kernels
from codegen.runtime.search import problem
from codegen.solving.compiler import build


def without_compilation(text: str, name: str = "interpreted") -> types.ModuleType:
    """Execute the text of a generated module with numba's decorator replaced by one that does nothing."""
    module = types.ModuleType(name)
    exec(_code(text, name), module.__dict__)
    return module


@lru_cache(maxsize=100)
def _code(text: str, name: str) -> types.CodeType:
    """What is executed anew for each module of the same text, whose translation takes a hundred times as long."""
    for before, after in _REPLACED.items():
        text = text.replace(before, after)
    return compile(text, f"<{name}>", "exec")


_REPLACED = {
    "import math\n": "from interpreted import silent_math as math\n",
    "\nfrom numba import ": "\nfrom interpreted import ",
    "\nfrom codegen.runtime.kernels import ": "\nfrom interpreted import ",
    "\nfrom codegen.runtime.formulas import ": "\nfrom interpreted import ",
    "import ControlProblem, Loop": "import ControlProblem\nfrom interpreted import Loop",
    "import ControlProblem, DataDerivatives, Loop": (
        "import ControlProblem, DataDerivatives\nfrom interpreted import Loop"
    ),
}
"""Imports of a generated module, and those in their place."""


class Loop(problem.Loop):
    """A loop that runs by the interpreter, with NaN where Python's numbers raise errors and machine code does not."""

    def __init__(self, function):
        def quiet(*arguments):
            with np.errstate(all="ignore"):
                try:
                    return function(*arguments)
                except (ValueError, OverflowError, ZeroDivisionError):
                    arguments[-1][0] = np.nan
                    return np.nan

        super().__init__(quiet, is_interpreted=True)


def Kernel(function):
    """A kernel that fills arrays, by the interpreter."""
    return kernels.Kernel(function, True)


def Value(function):
    """A kernel that returns a number, by the interpreter."""
    return kernels.Value(function, True)


Contracted = Kernel


@contextmanager
def all_uncompiled() -> Iterator[None]:
    """Let all that loads generated modules have them run by the interpreter, and nothing be compiled."""

    def loaded(path: Path | str) -> types.ModuleType:
        module = without_compilation(Path(path).read_text(encoding="utf-8"), Path(path).stem)
        module.__file__ = str(path)  # which solutions are asked for
        return module

    with pytest.MonkeyPatch.context() as patch, np.errstate(all="ignore"), warnings.catch_warnings():
        for place in ("solving.loading", "evidence.checks", "evidence.checks.particles"):
            patch.setattr(f"codegen.{place}.load", loaded)
        patch.setattr("codegen.solving.machine_code.processes.require", lambda *_: (0.0, []))
        warnings.simplefilter("ignore")
        yield


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


def inner_kernel(function):
    """A decorator that leaves a function as it is."""
    return function


def text_of(problem: Control | Phases, **choices: str) -> str:
    """The text of the module of a problem that is in no file, derived once for all worker processes."""
    return build(problem, **choices).path.read_text(encoding="utf-8")


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
